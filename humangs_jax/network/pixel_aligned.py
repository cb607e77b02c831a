"""Pixel-aligned features: vertices projected into the photos, maps read there, views pooled.

Lengths are normalised units throughout (see `network.inputs`): cameras, vertices and depth maps alike.

Shells are points off the body's surface, looked up in all photos: where loose clothes and hair are, and their color. Each vertex
has one point at every distance of a list along its posed normal. Where a photo shows the background, the point is not part of the
person. Points that all photos show on the person are in the visual hull (Laurentini 1994).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int, PyTree
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.bilinear import PixelGrid, sample_bilinear, sample_nearest, texel_indices
from humangs_jax.network.parts import Shells

DEPTH_EPSILON = 1e-6
"""Added to z before the division, as published."""
DEPTH_TOLERANCE = 0.05
"""A vertex counts as seen when it lies less than this behind the rasterized surface (normalised units)."""
COUNT_EPSILON = 1e-8
"""Added to the number of pooled views, as published: no view at all gives zeros."""
UNSEEN_COLOR = 0.5
"""Photo color of a vertex that no view sees."""


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
    grid: PixelGrid,
) -> Bool[Array, " n"]:
    """Which projected vertices lie inside the image, in front of the camera and not behind the rasterized surface.

    depth_map: rasterized z, -1 on background, so that a vertex over background is unseen. image_size: (width, height).
    """
    height, width = depth_map.shape
    indices = texel_indices(pixels, image_size, (width, height), grid)
    surface = sample_nearest(depth_map, indices)
    inside = jnp.all((pixels > 0) & (pixels < jnp.asarray(image_size, pixels.dtype)), axis=-1)
    return inside & (depths > 0) & (depths < surface + DEPTH_TOLERANCE)


def sum_over_views(
    read: Callable[[Array, Array], PyTree],
    maps: Float[Array, "v h w c"],
    indices: Float[Array, "v n 2"],
    weights: Float[Array, "v n"],
    capacity: int | None = None,
) -> PyTree:
    """Sum over views of weight * read(map of the view, texel indices), one view after the other: memory for one.

    read: (h, w, c), (m, 2) -> a pytree of (m, ...). capacity: vertices for which a view is read at most, the first ones of
    positive weight; None reads it for all of them, also where the weight is zero.
    """
    vertices = weights.shape[1]

    @jax.checkpoint  # what was read is read again for gradients: it is larger than the maps
    def add_view(total, view):
        texels, positions, weight = view
        if capacity is None or capacity >= vertices:
            values = read(texels, positions)
            return jax.tree.map(lambda t, x: t + _times(weight, x), total, values), None
        seen = jnp.nonzero(weight > 0, size=capacity, fill_value=vertices)[0]
        values = read(texels, positions.at[seen].get(mode="fill", fill_value=0))
        weight = weight.at[seen].get(mode="fill", fill_value=0)
        return jax.tree.map(lambda t, x: t.at[seen].add(_times(weight, x), mode="drop"), total, values), None

    shapes = jax.eval_shape(read, maps[0], indices[0])
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, jnp.result_type(x, weights)), shapes)
    return jax.lax.scan(add_view, empty, (maps, indices, weights))[0]


def _times(weight, values):
    return weight.reshape(-1, *[1] * (values.ndim - 1)) * values


def dropped_reads(weights: Float[Array, "v n"], capacity: int | None) -> Int[Array, ""]:
    """How many vertices, over all views, `sum_over_views` has no room for."""
    if capacity is None:
        return jnp.zeros((), jnp.int32)
    return jnp.sum(jnp.maximum(jnp.sum(weights > 0, axis=1, dtype=jnp.int32) - capacity, 0))


def photo_colors(
    images: Float[Array, "v h w 3"], pixels: Float[Array, "v n 2"], visible: Bool[Array, "v n"], grid: PixelGrid
) -> Float[Array, "n 3"]:
    """Mean photo color over the views that see each vertex, grey where none does."""
    size = (images.shape[2], images.shape[1])
    colors = jax.vmap(sample_bilinear)(images, texel_indices(pixels, size, size, grid))
    counts = jnp.sum(visible, axis=0)[:, None]
    mean = jnp.einsum("vnc,vn->nc", colors, visible.astype(colors.dtype)) / jnp.maximum(counts, 1)
    return jnp.where(counts > 0, mean, UNSEEN_COLOR)


WEIGHT_EPSILON = 1e-6
"""Views count by how much the surface faces them; a point with less than this in all is unseen."""
SQUARED_DISTANCE_EPSILON = 1e-6
"""Least squared distance between a camera and a point."""


def on_the_person(shells: Shells) -> Bool[Array, " n"]:
    """Whether any photo shows the person at any distance along the normal of a vertex; true for what no photo contains."""
    return jnp.any(shells.inside > 0, axis=1)


def sample_shells(
    images: Float[Array, "v h w 3"],
    foreground: Bool[Array, "v h w"],
    depth_maps: Float[Array, "v h w"],
    cameras: Camera,
    vertices: Float[Array, "v n 3"],
    normals: Float[Array, "v n 3"],
    distances: tuple[float, ...],
    present: Bool[Array, " v"],
    grid: PixelGrid,
) -> Shells:
    """Sample every view that is `present` at the points at `distances` from the posed vertices.

    images: in [0, 1]. foreground: pixels of the person or the body. depth_maps: rasterized z of the body, -1 on background.
    cameras, vertices: normalised units. normals: unit, of the posed body. distances: ascending, normalised units.
    """
    steps = jnp.asarray(distances, vertices.dtype)
    count = vertices.shape[1]
    size = (images.shape[2], images.shape[1])

    def view(image, mask, depth_map, camera, vertices, normals):
        points = (vertices[:, None] + steps[:, None] * normals[:, None]).reshape(-1, 3)
        pixels, depths = project_vertices(camera, points)
        indices = texel_indices(pixels, size, size, grid)
        mask = mask[..., None].astype(image.dtype)  # the color of the background is not used
        read = sample_bilinear(jnp.concatenate([image * mask, mask], axis=-1), indices)
        surface = sample_nearest(depth_map, indices)
        framed = jnp.all((pixels > 0) & (pixels < jnp.asarray(size, pixels.dtype)), axis=-1) & (depths > 0)
        visible = framed & ((surface < 0) | (depths < surface + DEPTH_TOLERANCE))
        towards = camera.center - points
        distance = jnp.sqrt(jnp.maximum(jnp.sum(towards**2, axis=-1), SQUARED_DISTANCE_EPSILON))
        facing = jnp.sum(towards * jnp.repeat(normals, len(distances), axis=0), axis=-1) / distance
        weight = jnp.where(visible, jnp.maximum(facing, 0), 0)
        return read[:, :3], read[:, 3], weight, framed

    colors, masks, weights, framed = jax.vmap(view)(images, foreground, depth_maps, cameras, vertices, normals)
    framed, weights = framed & present[:, None], weights * present[:, None]
    total = jnp.sum(weights * masks, axis=0)
    mean = jnp.einsum("vpc,vp->pc", colors, weights) / jnp.maximum(total, WEIGHT_EPSILON)[:, None]
    known = jnp.sum(framed, axis=0)
    inside = jnp.where(known > 0, jnp.sum(masks * framed, axis=0) / jnp.maximum(known, 1), 1)
    by_vertex = lambda x: x.reshape(count, len(distances), *x.shape[1:])
    return Shells(
        distances=steps,
        colors=by_vertex(jnp.where((total > WEIGHT_EPSILON)[:, None], mean, UNSEEN_COLOR)),
        seen=by_vertex(total / jnp.maximum(jnp.sum(present), 1)),
        inside=by_vertex(inside),
        hull=by_vertex(jnp.min(jnp.where(framed, masks, 1), axis=0)),
    )
