"""The paper's reader. It projects posed vertices into the photos, reads features there and pools
the views.

Vertices can also read the photos themselves, at the surface and on shells. Shells are points off
the body's surface, where loose clothes and hair are. Each vertex has one point at every distance of
a list along its posed normal, and all photos are read there. Where a photo shows the background,
the point is not part of the person. Points that all photos show on the person are in the visual
hull (Laurentini 1994). Functions here take cameras, vertices and depth maps in normalised units.
"""

import itertools
import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, PyTree
from humangs_jax.core.configuration import Spread, Width, part
from humangs_jax.core.loops import one_after_the_other, over
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.maps import (
    KERNEL,
    OUTSIDE,
    PixelGrid,
    convolve_neighborhoods,
    sample_bilinear,
    sample_nearest,
    sample_neighborhoods,
    texel_indices,
)
from humangs_jax.network.parts import (
    Encoding,
    ForwardContext,
    HumanGSInputs,
    Reader,
    Shells,
    VertexFeatures,
    subject_unit,
)
from humangs_jax.network.upsampler import KAIMING

DEPTH_EPSILON = 1e-6
"""Number that is added to the depth z of a vertex before x and y are divided by it, as published.
"""
DEPTH_TOLERANCE = 0.05
"""A vertex counts as seen if it lies less than this behind the rasterized surface, normalised
units.
"""
UNSEEN_COLOR = 0.5
"""Photo color of a vertex that no view sees."""
WEIGHT_EPSILON = 1e-6
"""A point counts as seen if the sum of the weights of its views is above this. The weight of a view
is the cosine of the angle between the normal and the direction to the camera, times the mask.
"""


@part
class PixelAlignedReader(Reader):
    """The paper's reader: each vertex reads the feature maps at the places where the photos show
    it.
    """

    output_width: Width | None = 768
    """Features of a last 3x3 convolution, which is evaluated only where vertices read the maps.
    None: no convolution.
    """
    sample_rgb: bool = False
    """Whether vertices also read their mean photo color over the views that see them, and the share
    of the views that see them.
    """
    shells: tuple[Spread, ...] = ()
    """Ascending distances along the vertex normals at which vertices also read the photos,
    normalised units. Empty: vertices do not read there.
    """

    def __post_init__(self):
        """Raises ValueError for distances that are negative, not finite or not ascending."""
        super().__post_init__()
        ascending = all(a < b for a, b in itertools.pairwise(self.shells))
        if not (ascending and all(0 <= x < math.inf for x in self.shells)):
            raise ValueError(
                f"shells {self.shells}: expected ascending distances, finite and at least 0"
            )

    @nn.compact
    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> VertexFeatures:
        """Returns the features of the n vertices.

        Raises ValueError for shells without posed normals.
        """
        grid = ctx.conventions.pixel_grid
        unit = subject_unit(inputs.canonical_vertices)
        maps = encoding.maps
        # where each view sees each vertex, and whether it counts
        cameras, vertices = inputs.cameras.in_units(unit), inputs.posed_vertices / unit
        pixels, visible = project_and_test(
            cameras, vertices, inputs.depth_maps, inputs.present, grid
        )
        pooled = visible
        if ctx.conventions.pool != "visible":
            pooled = inputs.present[:, None]
        weights = jnp.broadcast_to(pooled, visible.shape).astype(pixels.dtype)
        size = (cameras.width, cameras.height)
        indices = texel_indices(pixels, size, (maps.shape[2], maps.shape[1]), grid)
        indices = jnp.where(weights[..., None] > 0, indices, OUTSIDE)
        read = sample_neighborhoods
        if self.output_width is None:
            read = sample_bilinear
        counts = jnp.sum(weights, axis=0) + 1e-8  # as published: no view at all gives zeros

        def mean(sums):
            return jnp.einsum("n...,n->n...", sums, 1 / counts, precision=transform.EXACT)

        # the mean over views of what the maps hold there
        local = jax.tree.map(mean, sum_over_views(read, maps, indices, weights))
        if self.output_width is not None:
            kernel = self.param(
                "kernel", KAIMING, (KERNEL, KERNEL, maps.shape[-1], self.output_width)
            )
            bias = self.param("bias", nn.initializers.zeros, (self.output_width,))
            local = convolve_neighborhoods(*local, kernel, bias, ctx.runtime.compute_dtype)
        # what photos show at the vertices and along their normals
        colors = fraction = shells = None
        if self.sample_rgb:
            colors = photo_colors(inputs.images, pixels, visible, grid)
            fraction = (jnp.sum(visible, axis=0) / jnp.sum(inputs.present)).astype(pixels.dtype)
        if self.shells:
            if inputs.posed_normals is None:
                raise ValueError(
                    "reader.shells needs posed_normals of the inputs, see `prepare_inputs`"
                )
            photos = (inputs.images, inputs.foreground, inputs.depth_maps)
            points = (vertices, inputs.posed_normals)
            shells = sample_shells(*photos, cameras, *points, self.shells, inputs.present, grid)
        return VertexFeatures(
            local,
            encoding.global_token,
            colors,
            fraction,
            shells=shells,
            normals=inputs.canonical_normals,
        )


def project_and_test(
    cameras: Camera,
    vertices: Float[Array, "v n 3"],
    depth_maps: Float[Array, "v h w"],
    present: Bool[Array, " v"],
    grid: PixelGrid,
) -> tuple[Float[Array, "v n 2"], Bool[Array, "v n"]]:
    """Returns the pixels of the posed vertices in every view, (v, n, 2), and whether each view sees
    them, (v, n). Views that are padding see no vertex.
    """
    pixels, depths = jax.vmap(project_vertices)(cameras, vertices)

    def see(p, z, surface):
        return visible_vertices(p, z, surface, (cameras.width, cameras.height), grid)

    return pixels, jax.vmap(see)(pixels, depths, depth_maps) & present[:, None]


def project_vertices(
    camera: Camera, vertices: Float[Array, "n 3"]
) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """Returns the pixels (n, 2) and depths z (n,) of vertices in one camera. The results and their
    gradients are finite, also for vertices in the camera's plane or behind it.
    """
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
    """Returns which projected vertices lie inside the image, in front of the camera, and less than
    `DEPTH_TOLERANCE` behind the rasterized surface, (n,).

    depth_map: rasterized z, -1 on background, so that a vertex over background is unseen.
    image_size: (width, height).
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
) -> PyTree:
    """Returns the sum over the views of weight * read(map of the view, texel indices). A CPU takes
    one view after the other, with memory for one view.

    read: (h, w, c), (n, 2) -> a pytree of (n, ...).
    """

    @jax.checkpoint  # what was read is read again for gradients: it is larger than the maps
    def weighed(view):
        texels, positions, weight = view
        return jax.tree.map(
            lambda x: weight.reshape(-1, *[1] * (x.ndim - 1)) * x, read(texels, positions)
        )

    def add(total, view):
        return jax.tree.map(jnp.add, total, weighed(view)), None

    views = maps, indices, weights
    if not one_after_the_other():
        texels = maps.shape[1] * maps.shape[2]
        return jax.tree.map(lambda x: jnp.sum(x, axis=0), over(weighed, views, texels))
    shapes = jax.eval_shape(weighed, jax.tree.map(lambda x: x[0], views))
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.scan(add, empty, views)[0]


def photo_colors(
    images: Float[Array, "v h w 3"],
    pixels: Float[Array, "v n 2"],
    visible: Bool[Array, "v n"],
    grid: PixelGrid,
) -> Float[Array, "n 3"]:
    """Returns the mean photo color of each vertex over the views that see the vertex, (n, 3). A
    vertex that no view sees is grey.
    """
    size = (images.shape[2], images.shape[1])
    colors = jax.vmap(sample_bilinear)(images, texel_indices(pixels, size, size, grid))
    counts = jnp.sum(visible, axis=0)[:, None]
    sums = jnp.einsum("vnc,vn->nc", colors, visible.astype(colors.dtype), precision=transform.EXACT)
    return jnp.where(counts > 0, sums / jnp.maximum(counts, 1), UNSEEN_COLOR)


def on_the_person(shells: Shells) -> Bool[Array, " n"]:
    """Says for each vertex whether some photo shows the person at one of the vertex's points along
    the normal, (n,). Also True if one of these points is in no photo.
    """
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
    """Returns what the photos show at points along the normals of the posed vertices. Only views
    that are `present` count.

    images: in [0, 1]. foreground: pixels of the person or the body. depth_maps: rasterized z of the
    body, -1 on background. cameras, vertices: normalised units. normals: unit, of the posed body.
    distances: of the points from the vertices, ascending, normalised units.
    """
    steps = jnp.asarray(distances, vertices.dtype)
    count = vertices.shape[1]
    size = (images.shape[2], images.shape[1])

    def view(image, mask, depth_map, camera, vertices, normals):
        # what the photo shows at each point
        points = (vertices[:, None] + steps[:, None] * normals[:, None]).reshape(-1, 3)
        pixels, depths = project_vertices(camera, points)
        indices = texel_indices(pixels, size, size, grid)
        mask = mask[..., None].astype(image.dtype)  # the color of the background is not used
        read = sample_bilinear(jnp.concatenate([image * mask, mask], axis=-1), indices)
        # a view counts by how much the surface faces it, unless the body hides the point
        surface = sample_nearest(depth_map, indices)
        in_image = jnp.all((pixels > 0) & (pixels < jnp.asarray(size, pixels.dtype)), axis=-1)
        framed = in_image & (depths > 0)
        visible = framed & ((surface < 0) | (depths < surface + DEPTH_TOLERANCE))
        towards = camera.center - points
        distance = jnp.sqrt(jnp.maximum(jnp.sum(towards**2, axis=-1), 1e-6))
        facing = jnp.sum(towards * jnp.repeat(normals, len(distances), axis=0), axis=-1) / distance
        weight = jnp.where(visible, jnp.maximum(facing, 0), 0)
        return read[:, :3], read[:, 3], weight, framed

    colors, masks, weights, framed = jax.vmap(view)(
        images, foreground, depth_maps, cameras, vertices, normals
    )
    # means over the views that are there
    framed, weights = framed & present[:, None], weights * present[:, None]
    total = jnp.sum(weights * masks, axis=0)
    sums = jnp.einsum("vpc,vp->pc", colors, weights, precision=transform.EXACT)
    mean = sums / jnp.maximum(total, WEIGHT_EPSILON)[:, None]
    known = jnp.sum(framed, axis=0)
    inside = jnp.where(known > 0, jnp.sum(masks * framed, axis=0) / jnp.maximum(known, 1), 1)

    def by_vertex(x):
        return x.reshape(count, len(distances), *x.shape[1:])

    return Shells(
        distances=steps,
        colors=by_vertex(jnp.where((total > WEIGHT_EPSILON)[:, None], mean, UNSEEN_COLOR)),
        seen=by_vertex(total / jnp.maximum(jnp.sum(present), 1)),
        inside=by_vertex(inside),
        hull=by_vertex(jnp.min(jnp.where(framed, masks, 1), axis=0)),
    )
