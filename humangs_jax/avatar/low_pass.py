"""The low-pass of images as a part of the scales, so that an avatar looks the same in images of every size.

A renderer adds `EPS2D` pixels^2 to the variances of each Gaussian, whatever the size of the image. Gaussians that fit images of
one size are therefore too wide in smaller images, and too narrow in larger ones. Here all but `MIP_EPS2D` of it goes into the
scales, for the size of the images that they fit (after Mip-Splatting, https://arxiv.org/abs/2311.16493), and `Gaussians.low_pass`
tells renderers so.
"""

import jax.numpy as jnp

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.constants import EPS2D, MIP_EPS2D

SMALLEST = 1e-5
"""Metres, a thousandth of a pixel; where more is to be taken away than a scale contains."""


def with_low_pass(avatar: Avatar, pixel: Float[Array, ""] | float) -> Avatar:
    """The avatar whose scales contain the low-pass of images with pixels of this size in metres.

    One that is drawn by other conventions than "exact", or has a low-pass already, is returned as it is.
    """
    gaussians = avatar.gaussians
    if avatar.rendering != "exact" or gaussians.low_pass is not None:
        return avatar
    low_pass = jnp.full_like(gaussians.opacities, pixel)
    return replace(avatar, gaussians=replace(gaussians, scales=_widened(gaussians.scales, low_pass), low_pass=low_pass))


def without_low_pass(avatar: Avatar, pixel: Float[Array, ""] | float | None = None) -> Avatar:
    """The avatar that `with_low_pass` had; with `pixel`, one that looks like this in images with pixels of this size."""
    gaussians = avatar.gaussians
    if gaussians.low_pass is None:
        return avatar
    left = gaussians.low_pass if pixel is None else jnp.full_like(gaussians.low_pass, pixel)
    return replace(avatar, gaussians=replace(gaussians, scales=_widened(gaussians.scales, left, -1), low_pass=None))


def _widened(scales, low_pass, sign=1):
    added = sign * (EPS2D - MIP_EPS2D) * jnp.square(low_pass)
    return jnp.sqrt(jnp.maximum(jnp.square(scales) + added[:, None], SMALLEST**2))
