"""A small U-Net over maps, for systems that predict Gaussians texel by texel.

At each scale two 3x3 convolutions with a ReLU; 2x2 means going down, nearest texels going up,
joined with the maps of the same scale. A last 3x3 convolution gives the output, which starts near 0
(Ronneberger et al. 2015, https://arxiv.org/abs/1505.04597).
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
"""The coarsest map of the largest U-Net has two texels."""


def check_scales(name: str, widths: tuple[int, ...]) -> None:
    """Raises ValueError, naming the setting, unless there are 1 to `MOST_SCALES` positive
    widths.
    """
    if not 1 <= len(widths) <= MOST_SCALES or min(widths) < 1:
        raise ValueError(
            f"{name} {widths[:MOST_SCALES]}: expected 1 to {MOST_SCALES} positive numbers, one a"
            " scale"
        )


class UNet(nn.Module):
    """Maps (v, h, w, c) -> (v, h, w, features).

    widths: features at every scale, the finest first; both sides are multiples of 2^(len(widths) -
    1), or ValueError. bottleneck: a module that changes the coarsest maps, (v, h', w', c') and what
    the call gives as `context` -> the same shape. Several maps have an encoder each, whose results
    are joined at every scale; several numbers of features a decoder each, joined at the end.
    """

    widths: tuple[int, ...]
    features: tuple[int, ...]
    bottleneck: nn.Module | None = None
    dtype: Any = None

    @nn.compact
    def __call__(
        self, *given: Float[Array, "v h w _"], context: Any = None
    ) -> Float[Array, "v h w features"]:
        """The features of maps. Raises: ValueError for maps that cannot be halved often enough."""
        coarsest, (_, height, width, _) = 2 ** (len(self.widths) - 1), given[0].shape
        if height % coarsest or width % coarsest:
            raise ValueError(
                f"maps of {width} x {height}: a U-Net of {len(self.widths)} scales needs multiples"
                f" of {coarsest}"
            )

        def convolved(x, width, name):
            """Two convolutions."""
            for i in range(2):
                x = jax.nn.relu(Convolution(width, KAIMING, self.dtype, name=f"{name}_{i}")(x))
            return x

        def encoded(x, mark):
            """A map at every scale, finest first."""
            kept = []
            for i, width in enumerate(self.widths):
                x = convolved(x if i == 0 else halved(x), width, f"{mark}down_{i}")
                kept.append(x)
            return kept

        def decoded(x, features, mark):
            """Features at the finest scale, with what the encoders kept of each."""
            for i, skip in reversed(list(enumerate(kept))):
                x = convolved(
                    jnp.concatenate([doubled(x), skip], axis=-1), self.widths[i], f"{mark}up_{i}"
                )
            return Convolution(
                features, nn.initializers.normal(LAST_STD), self.dtype, name=f"{mark}out"
            )(x)

        def marks(many):
            """Beginnings of names, none where there is one of a kind."""
            return [""] if len(many) == 1 else [f"{i}_" for i in range(len(many))]

        scales = zip(
            *(encoded(x, mark) for x, mark in zip(given, marks(given), strict=True)), strict=True
        )
        kept = [jnp.concatenate(maps, axis=-1) for maps in scales]
        x = kept.pop()
        if self.bottleneck is not None:
            x = self.bottleneck(x, context)
        outputs = zip(self.features, marks(self.features), strict=True)
        return jnp.concatenate([decoded(x, features, mark) for features, mark in outputs], axis=-1)


def halved(x: Float[Array, "v h w c"]) -> Float[Array, "v i j c"]:
    views, height, width, channels = x.shape
    return jnp.mean(x.reshape(views, height // 2, 2, width // 2, 2, channels), axis=(2, 4))


def doubled(x: Float[Array, "v h w c"]) -> Float[Array, "v i j c"]:
    """Every element as a square of 2 x 2."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)
