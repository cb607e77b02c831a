"""Texture lookup.

Texture coordinates follow OBJ files: u to the right, v UP, (0, 0) the lower left corner of the texture and (1, 1) its
upper right one; row 0 of the array is the top. Texel centres lie at half texels: texel
(row, column) is at u = (column + 0.5) / width, v = 1 - (row + 0.5) / height. Beyond the outermost centres the border
texels continue (no repetition).
"""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float


def sample_texture(texture: Float[Array, "th tw c"], uv: Float[Array, "h w 2"]) -> Float[Array, "h w c"]:
    """Bilinear texture lookup, v up. Differentiable with respect to the texture and, inside a texel, to uv."""
    height, width = texture.shape[:2]
    x = jnp.clip(uv[..., 0] * width - 0.5, 0, width - 1)
    y = jnp.clip((1 - uv[..., 1]) * height - 0.5, 0, height - 1)
    left, top = jnp.floor(x), jnp.floor(y)
    along_x, along_y = (x - left)[..., None], (y - top)[..., None]
    column, row = left.astype(jnp.int32), top.astype(jnp.int32)
    next_column, next_row = jnp.minimum(column + 1, width - 1), jnp.minimum(row + 1, height - 1)
    upper = texture[row, column] * (1 - along_x) + texture[row, next_column] * along_x
    lower = texture[next_row, column] * (1 - along_x) + texture[next_row, next_column] * along_x
    return upper * (1 - along_y) + lower * along_y
