"""Neural texture: three feature planes over the canonical body, read at canonical positions.

Planes are xy, xz, yz; the first named axis is the horizontal texture coordinate. Positions in [-1, 1] span a plane from
the centre of its first texel to the centre of its last one (`align_corners=True`); outside are zeros.
"""

import dataclasses

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float
from humangs_jax.network.bilinear import sample_bilinear

PLANES = ((0, 1), (0, 2), (1, 2))


@dataclasses.dataclass(frozen=True)
class TriplaneConfig:
    """Size of the neural texture.

    resolution: texels along each side of a plane. channels: features per texel.
    """

    resolution: int = 128
    channels: int = 16


def sample_triplane(texture: Float[Array, "3 r r c"], positions: Float[Array, "*p 3"]) -> Float[Array, "*p 3*c"]:
    """Features of canonical positions (normalised units): those of plane xy, then xz, then yz."""
    middle = (texture.shape[1] - 1) / 2
    indices = positions * middle  # from the middle: a third of the rounding of (positions + 1) * middle
    features = [
        sample_bilinear(plane, indices[..., axes], middle)
        for plane, axes in zip(texture, map(list, PLANES), strict=True)
    ]
    return jnp.concatenate(features, axis=-1)
