"""A small U-Net over maps, for systems that predict Gaussians texel by texel.

Each scale has two 3x3 convolutions with a ReLU. Going down, maps are halved by means of 2x2. Going
up, they are doubled by nearest texels and joined with the maps of the same scale. A last 3x3
convolution makes the output, which is near 0 at first (Ronneberger et al. 2015,
https://arxiv.org/abs/1505.04597).
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float
from humangs_jax.network.maps import Convolution
from humangs_jax.network.upsampler import KAIMING
from humangs_jax.network.vertex_decoder import LAST_STD

MOST_SCALES = 12
"""Largest number of scales, with which the coarsest map of the largest U-Net has two texels a side.
"""


def check_scales(name: str, widths: tuple[int, ...]) -> None:
    """Raises a ValueError that names the setting unless there are 1 to `MOST_SCALES` positive
    widths.
    """
    if not 1 <= len(widths) <= MOST_SCALES or min(widths) < 1:
        raise ValueError(
            f"{name} {widths[:MOST_SCALES]}: expected 1 to {MOST_SCALES} positive numbers, one a"
            " scale"
        )


class UNet(nn.Module):
    """A U-Net from maps (v, h, w, c) to maps (v, h, w, sum of `features`).

    Each of several input maps has an encoder, and their results are joined at every scale. Each
    number of `features` has a decoder, and their results are joined at the end.
    """

    widths: tuple[int, ...]
    """Numbers of features at every scale, the finest first. Both sides of the maps are multiples of
    2^(len(widths) - 1).
    """
    features: tuple[int, ...]
    """Number of features that each decoder makes."""
    bottleneck: nn.Module | None = None
    """A module that changes the coarsest maps (v, h', w', c'), and also gets the `context` of the
    call. None: they are not changed.
    """
    dtype: Any = None
    """Number type of the products."""

    @nn.compact
    def __call__(
        self, *given: Float[Array, "v h w _"], context: Any = None
    ) -> Float[Array, "v h w features"]:
        """Returns the features of maps.

        Raises: ValueError for maps that cannot be halved often enough.
        """
        coarsest, (_, height, width, _) = 2 ** (len(self.widths) - 1), given[0].shape
        if height % coarsest or width % coarsest:
            raise ValueError(
                f"maps of {width} x {height}: a U-Net of {len(self.widths)} scales needs multiples"
                f" of {coarsest}"
            )

        def convolved(x, width, name):
            """Applies two convolutions."""
            for i in range(2):
                x = jax.nn.relu(Convolution(width, KAIMING, self.dtype, name=f"{name}_{i}")(x))
            return x

        def encoded(x, mark):
            """Returns the features of a map at every scale, the finest first."""
            kept = []
            for i, width in enumerate(self.widths):
                if i > 0:
                    x = halved(x)
                x = convolved(x, width, f"{mark}down_{i}")
                kept.append(x)
            return kept

        def decoded(x, features, mark):
            """Returns features at the finest scale, with what the encoders kept of each scale."""
            for i, skip in reversed(list(enumerate(kept))):
                joined = jnp.concatenate([doubled(x), skip], axis=-1)
                x = convolved(joined, self.widths[i], f"{mark}up_{i}")
            small = nn.initializers.normal(LAST_STD)
            return Convolution(features, small, self.dtype, name=f"{mark}out")(x)

        def marks(many):
            """Returns the beginnings of names, which are empty if there is only one."""
            return [""] if len(many) == 1 else [f"{i}_" for i in range(len(many))]

        # encoders are joined at every scale, and decoders at the end
        by_map = [encoded(x, mark) for x, mark in zip(given, marks(given), strict=True)]
        kept = [jnp.concatenate(maps, axis=-1) for maps in zip(*by_map, strict=True)]
        x = kept.pop()
        if self.bottleneck is not None:
            x = self.bottleneck(x, context)
        outputs = zip(self.features, marks(self.features), strict=True)
        return jnp.concatenate([decoded(x, features, mark) for features, mark in outputs], axis=-1)


def halved(x: Float[Array, "v h w c"]) -> Float[Array, "v i j c"]:
    """Returns the means of squares of 2 x 2 elements."""
    views, height, width, channels = x.shape
    return jnp.mean(x.reshape(views, height // 2, 2, width // 2, 2, channels), axis=(2, 4))


def doubled(x: Float[Array, "v h w c"]) -> Float[Array, "v i j c"]:
    """Returns every element as a square of 2 x 2 elements."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
