"""Losses and their weights, SSIM, PSNR, the perceptual loss, LPIPS, and comparisons after small
moves.
"""
