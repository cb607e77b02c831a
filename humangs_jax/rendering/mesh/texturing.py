"""Textured meshes: texture lookup and anti-aliased images.

Texture coordinates follow OBJ files: u to the right, v UP, (0, 0) the lower left corner of the texture and (1, 1) its
upper right one; row 0 of the array is the top. Texel centres lie at half texels: texel
(row, column) is at u = (column + 0.5) / width, v = 1 - (row + 0.5) / height. Beyond the outermost centres the border
texels continue (no repetition).
"""

import functools

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.rasterizer import DEFAULT_CONFIG, RasterConfig, interpolate_attributes, rasterize_mesh


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


@functools.partial(jax.jit, static_argnames=("supersample", "config"))
def render_textured_mesh(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    uvs: Float[Array, "u 2"],
    uv_faces: Int[Array, "f 3"],
    texture: Float[Array, "th tw 3"],
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
    supersample: int = 1,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"], Float[Array, "h w"]]:
    """The mesh as seen by one camera: rgb over the background (None: white), alpha, and depth.

    A pixel is the mean of supersample x supersample samples of visibility and texture. alpha is its covered share,
    depth the mean z of its covered samples and 0 where there are none (as in `splatting.Rendering`). Differentiable with
    respect to texture, uvs and background. A texture much finer than the samples aliases: raise `supersample`.
    """
    background = jnp.ones(3, texture.dtype) if background is None else background
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    fragments = rasterize_mesh(vertices, faces, fine, config)
    uv = interpolate_attributes(fragments, uv_faces, uvs, jnp.zeros(2, uvs.dtype))
    covered = (fragments.face_ids >= 0)[..., None]
    color = jnp.where(covered, sample_texture(texture, uv), background)
    mean = lambda x: x.reshape(camera.height, supersample, camera.width, supersample, -1).mean(axis=(1, 3))
    alpha = mean(covered.astype(color.dtype))[..., 0]
    depth = mean(jnp.where(covered, fragments.depth[..., None], 0.0))[..., 0] / jnp.where(alpha > 0, alpha, 1.0)
    return mean(color), alpha, depth
