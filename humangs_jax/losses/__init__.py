"""Unreduced losses and their weights, SSIM, perceptual loss, LPIPS."""
