"""Pixel-aligned features: vertices projected into the photographs, maps read there, views pooled.

Lengths are normalised units throughout (see `models.humangs`): cameras, vertices and depth maps alike.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp

from humangs_jax.array_types import Array, Bool, Float
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.sampling.bilinear import Convention, sample_bilinear, sample_nearest, texel_indices

DEPTH_EPSILON = 1e-6
"""Added to z before the division, as published."""
DEPTH_TOLERANCE = 0.05
"""A vertex counts as seen when it lies less than this behind the rasterized surface (normalised units)."""
COUNT_EPSILON = 1e-8
"""Added to the number of pooled views, as published: no view at all gives zeros."""
UNSEEN_COLOR = 0.5
"""Photo colour of a vertex that no view sees."""


@dataclasses.dataclass(frozen=True)
class PixelAlignedConfig:
    """How vertices read the photographs.

    pool: "visible" averages over the views that see the vertex (paper), "all" over every view (release).
    convention: "half_pixel" is correct, "mixed" is the published one (see `sampling.bilinear`).
    sample_rgb: also read the photo colour at each vertex, averaged over the views that see it, and their fraction.
    """

    pool: Literal["visible", "all"] = "visible"
    convention: Convention = "half_pixel"
    sample_rgb: bool = False


def project_vertices(camera: Camera, vertices: Float[Array, "n 3"]) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Pixel positions and depths z of one camera; finite, also in gradients, for vertices in its plane or behind."""
    p = transform.apply(camera.cam_from_world, vertices)
    depth = p[:, 2]
    divisor = depth + DEPTH_EPSILON
    divisor = jnp.where(jnp.abs(divisor) < DEPTH_EPSILON, DEPTH_EPSILON, divisor)
    focal = jnp.stack([camera.K[0, 0], camera.K[1, 1]])
    return focal * p[:, :2] / divisor[:, None] + camera.K[:2, 2], depth


def visible_vertices(
    pixels: Float[Array, "n 2"],
    depths: Float[Array, " n"],
    depth_map: Float[Array, "h w"],
    image_size: tuple[int, int],
    convention: Convention,
) -> Bool[Array, " n"]:
    """Which projected vertices lie inside the image, in front of the camera and not behind the rasterized surface.

    depth_map: rasterized z, -1 on background, so that a vertex over background is unseen. image_size: (width, height).
    """
    height, width = depth_map.shape
    indices = texel_indices(pixels, image_size, (width, height), convention)
    surface = sample_nearest(depth_map, indices)
    inside = jnp.all((pixels > 0) & (pixels < jnp.asarray(image_size, pixels.dtype)), axis=-1)
    return inside & (depths > 0) & (depths < surface + DEPTH_TOLERANCE)


def sample_views(
    maps: Float[Array, "v h w c"], pixels: Float[Array, "v n 2"], image_size: tuple[int, int], convention: Convention
) -> Float[Array, "v n c"]:
    """Each view's map at its projected vertices."""
    indices = texel_indices(pixels, image_size, (maps.shape[2], maps.shape[1]), convention)
    return jax.vmap(sample_bilinear)(maps, indices)


def pool_views(samples: Float[Array, "v n c"], weights: Float[Array, "v n"]) -> Float[Array, "n c"]:
    """Weighted mean over views; zeros where no view counts."""
    return jnp.einsum("vnc,vn->nc", samples, weights) / (jnp.sum(weights, axis=0) + COUNT_EPSILON)[:, None]


def photo_colors(samples: Float[Array, "v n 3"], visible: Bool[Array, "v n"]) -> Float[Array, "n 3"]:
    """Mean photo colour over the views that see each vertex, grey where none does."""
    seen = jnp.any(visible, axis=0)
    return jnp.where(seen[:, None], pool_views(samples, visible.astype(samples.dtype)), UNSEEN_COLOR)
