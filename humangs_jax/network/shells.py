"""Points off the body's surface, looked up in all photos: where loose clothes and hair are, and their colour.

Each vertex has one point at every distance of a list along its posed normal. Where a photo shows the background, the point is not
part of the person. Points that all photos show on the person are in the visual hull (Laurentini 1994). Lengths are
normalised units, as in `pixel_aligned`.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.bilinear import PixelGrid, sample_bilinear, sample_nearest, texel_indices
from humangs_jax.network.pixel_aligned import DEPTH_TOLERANCE, UNSEEN_COLOR, project_vertices

WEIGHT_EPSILON = 1e-6
"""Views count by how much the surface faces them; a point with less than this in all is unseen."""
SQUARED_DISTANCE_EPSILON = 1e-6
"""Least squared distance between a camera and a point."""


@pytree_dataclass
class Shells:
    """What the photos show at the s points along the normal of each vertex.

    distances: (s,). colors: (n, s, 3) mean photo colour over the views in which the point is visible and on the person, weighted
    by how much the posed normal faces them; grey without such a view. seen: (n, s) the sum of those weights over the number of
    views. inside: (n, s) mean mask at the point over the views that contain it. hull: (n, s) the minimum of the same, 0
    outside of the visual hull. A view that does not contain the point is ignored; without any view both are 1.
    """

    distances: Float[Array, " s"]
    colors: Float[Array, "n s 3"]
    seen: Float[Array, "n s"]
    inside: Float[Array, "n s"]
    hull: Float[Array, "n s"]


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
        mask = mask[..., None].astype(image.dtype)  # the colour of the background is not used
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
