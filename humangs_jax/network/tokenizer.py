"""From photos to tokens: patches of rgb, Plücker rays and neural texture, one bias-free linear map.

Channel order of a pixel: 2 rgb - 1 (3), moment (3), direction (3), texture planes xy, xz, yz. Channels run fastest
inside a pixel, pixels row-major inside a patch, patches row-major inside a view, views in their order.

The neural texture is three feature planes over the canonical body, read at canonical positions. The first named axis of a plane
is the horizontal texture coordinate. Positions in [-1, 1] span a plane from the centre of its first texel to the centre of its
last one (`align_corners=True`); outside are zeros.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.configuration import Side, Width, configuration
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.bilinear import sample_bilinear
from humangs_jax.network.transformer import INIT_STD

TEXTURE_STD = 0.1
PLANES = ((0, 1), (0, 2), (1, 2))


@configuration
class TriplaneConfig:
    """Size of the neural texture. resolution: texels along each side of a plane. channels: features per texel."""

    resolution: Side = 128
    channels: Width = 16


def sample_triplane(texture: Float[Array, "3 r r c"], positions: Float[Array, "*p 3"]) -> Float[Array, "*p 3*c"]:
    """Features of canonical positions (normalised units): those of plane xy, then xz, then yz."""
    middle = (texture.shape[1] - 1) / 2
    indices = positions * middle  # from the middle: a third of the rounding of (positions + 1) * middle
    planes = zip(texture, map(list, PLANES), strict=True)
    return jnp.concatenate([sample_bilinear(plane, indices[..., axes], middle) for plane, axes in planes], axis=-1)


@pytree_dataclass
class Packing:
    """Which patches became tokens.

    indices: (l,) of the kept patches, in their order; the number of patches itself where a token is padding.
    count: number of real tokens, which come first; the rest is padding.
    """

    indices: Int[Array, " l"]
    count: Int[Array, ""]


def patchify(maps: Float[Array, "v h w c"], patch: int) -> Float[Array, "p pixels c"]:
    """Cut maps into square patches. Raises ValueError unless the patch size divides both sides."""
    views, height, width, channels = maps.shape
    if height % patch or width % patch:
        raise ValueError(f"images of {width} x {height} cannot be cut into patches of {patch} x {patch} pixels")
    x = maps.reshape(views, height // patch, patch, width // patch, patch, channels)
    return jnp.swapaxes(x, 2, 3).reshape(-1, patch * patch, channels)


def pack_patches(foreground: Bool[Array, " p"], capacity: int) -> Packing:
    """Indices of the foreground patches in a static number of slots; those beyond the capacity are left out."""
    indices = jnp.nonzero(foreground, size=capacity, fill_value=foreground.shape[0])[0]
    return Packing(indices, jnp.minimum(jnp.sum(foreground), capacity))


def unpack_tokens(tokens: Float[Array, "l d"], packing: Packing, patches: int) -> Float[Array, "p d"]:
    """Tokens back at their patches, zeros elsewhere."""
    return jnp.zeros((patches, tokens.shape[1]), tokens.dtype).at[packing.indices].set(tokens, mode="drop")


class Tokenizer(nn.Module):
    """Patches of pixels (l, pixels, 12: rgb, rays, canonical position) -> tokens (l, d); owns the neural texture."""

    stage_name = "tokens"
    learned_input = False
    width: int
    texture: TriplaneConfig
    dtype: Any = None

    @nn.compact
    def __call__(self, patches: Float[Array, "l pixels 12"]) -> Float[Array, "l d"]:
        shape = (3, self.texture.resolution, self.texture.resolution, self.texture.channels)
        texture = self.param("texture", nn.initializers.normal(TEXTURE_STD), shape)
        rgb, rays, positions = jnp.split(patches, (3, 9), axis=-1)
        pixels = jnp.concatenate([2 * rgb - 1, rays, sample_triplane(texture, positions)], axis=-1)
        dense = nn.Dense(
            self.width, use_bias=False, dtype=self.dtype, kernel_init=nn.initializers.normal(INIT_STD), name="linear"
        )
        return dense(pixels.reshape(pixels.shape[0], -1))
