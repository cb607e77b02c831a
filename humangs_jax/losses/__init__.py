"""Losses before reduction and their weights, SSIM, the perceptual loss, LPIPS."""
