"""Rasterizes triangle meshes. Finds for every pixel centre which face is seen, the place on the
face, and the depth. Makes position maps from this.

Conventions: cameras are OpenCV's, pixel centres are at +0.5, and depth is the camera's z. The
nearest face wins, and of equally near faces the one with the lower index. Both sides of a face are
seen. A face covers the pixel centres inside it AND on its edges. Faces without area in the image
cover nothing. A face with a corner at z <= near is dropped. If another of its corners is in front
of the near plane, the image may lack the face, so `Fragments.overflow` counts it.

Method: the rasterizer works by scanlines. Faces of a body cover a few pixels or none, so tiles of
pixels times lists of faces would mostly test pixels that a face does not touch. Instead each face
is expanded to its rows of pixel centres, and each row to the pixels of its span (see `_window`).
These fragments meet in a z-buffer by two scatters: first the smallest depth of a pixel, then the
smallest face number at that depth. Both levels run in steps of a fixed number of slots, and take as
many steps as the mesh needs. So shapes are static, and the only limit is 2^30 rows of pixels of all
faces.

Watertightness: an edge function is computed relative to the pixel, (a - p) x (b - p), and the order
of the ends a and b depends on their positions alone. Two faces that share an edge therefore compute
the same number with opposite signs, however the compiler contracts the expression. Close to a
vertex the differences are exact: both faces may cover a pixel, but at least one of them does.

Derivatives: fragments are constants (`stop_gradient`). `interpolate_attributes` is differentiable
with respect to the attributes.
"""

from collections.abc import Callable
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.configuration import Range, Spread, configuration
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.core.pytree import Batchable, pytree_dataclass
from humangs_jax.geometry.camera import Camera, require_pinhole
from humangs_jax.rendering.tiling import SUM_LIMIT, cumsum, owners

NO_FACE = jnp.iinfo(jnp.int32).max
"""Face number of a pixel without a face. The smallest number wins, so any face replaces it."""

Slice = Annotated[int, Range(64, 1 << 24)]


@configuration
class RasterConfig:
    """Settings of the rasterizer. The image depends on `near` alone."""

    near: Spread = 0.01
    """Depth of the near plane, in the units of the vertices. Faces with a corner at z <= near are
    dropped.
    """
    rows_per_step: Slice = 1 << 15
    """Slots for rows of pixels in a step of the outer loop. Large steps spend time on empty slots,
    small steps on the overhead of more steps.
    """
    fragments_per_step: Slice = 1 << 16
    """Slots for pixels in a step of the inner loop. As with `rows_per_step`, large and small steps
    both cost time.
    """


DEFAULT_CONFIG = RasterConfig()


@pytree_dataclass
class Fragments(Batchable):
    """The seen face of a mesh, the place on the face, and the depth, at each pixel of a camera."""

    face_ids: Int[Array, "h w"]
    """Index of the face that is seen, (h, w); -1 where there is none."""
    barycentrics: Float[Array, "h w 3"]
    """Perspective-correct weights of the face's corners, (h, w, 3), >= 0, of sum 1; 0 where there
    is no face.
    """
    depth: Float[Array, "h w"]
    """z in the camera's frame, (h, w), in the units of the vertices; -1 where there is no face."""
    overflow: Int[Array, ""]
    """Number of faces that may be missing from the image. They cross the near plane, have pixel
    positions or an area in pixels that are not finite, or come after the first 2^30 rows of pixels.
    """


@compiled(static=["config"])
@checked_arguments
def rasterize_mesh(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
) -> Fragments:
    """Returns the nearest face at every pixel centre of one camera, a pinhole without distortion.
    Use `jax.vmap` for batches. Raises: ValueError for any other camera.
    """
    vertices, camera = lax.stop_gradient((vertices, camera))
    if faces.shape[0] == 0 or vertices.shape[0] == 0:  # a face without area stands for no face
        vertices, faces = jnp.ones((1, 3), vertices.dtype), jnp.zeros((1, 3), jnp.int32)
    width, height = camera.width, camera.height
    # from faces to rows of pixels
    corners = _project(vertices, camera)[faces.astype(jnp.int32)].reshape(-1, 9)
    drawn, overflow = _drawn(corners, config.near)
    first_row, rows = _rows(corners, drawn, width, height)
    row_end = cumsum(rows)
    # from rows to fragments, which the z-buffer decides between
    depth, face_ids = _z_buffer(corners, first_row, row_end - rows, row_end, width, height, config)
    covered = face_ids != NO_FACE
    # weights only of the winners
    weights = _weights_by_pixel(
        corners, jnp.where(covered, face_ids, 0), width, config.fragments_per_step
    )
    weights = jnp.where(covered[:, None], weights, 0.0)
    return Fragments(
        face_ids=jnp.where(covered, face_ids, -1).reshape(height, width),
        barycentrics=weights.reshape(height, width, 3),
        depth=jnp.where(covered, depth, -1.0).reshape(height, width),
        overflow=overflow + jnp.sum((rows > 0) & (row_end >= SUM_LIMIT), dtype=jnp.int32),
    )


@compiled()
@checked_arguments
def interpolate_attributes(
    fragments: Fragments,
    faces: Int[Array, "f 3"],
    attributes: Float[Array, "n c"],
    background: Float[Array, " c"],
) -> Float[Array, "h w c"]:
    """Returns the attributes interpolated over the seen surface, (h, w, c). They are `background`
    where there is no face.

    faces: indices into `attributes` of the corners of each face. Row i is for face i of the mesh
    that was rasterized, but may have other indices. With texture faces and texture coordinates, the
    result is the texture coordinate of every pixel.
    """
    if faces.shape[0] == 0:
        return jnp.broadcast_to(background, (*fragments.face_ids.shape, background.shape[0]))
    covered = fragments.face_ids >= 0
    corners = attributes[faces].reshape(faces.shape[0], -1)[
        jnp.where(covered, fragments.face_ids, 0)
    ]
    # three terms, not a sum over an axis of three: 70 times as fast on XLA's CPU backend
    a, b, c = jnp.split(corners, 3, axis=-1)
    weight_a, weight_b, weight_c = jnp.split(fragments.barycentrics, 3, axis=-1)
    return jnp.where(covered[..., None], weight_a * a + weight_b * b + weight_c * c, background)


def _project(vertices: Float[Array, "n 3"], camera: Camera) -> Float[Array, "n 3"]:
    """Returns the position x, y of vertices on the image, pixels, and their depth z, (n, 3).

    The products are written out, because matrix products have low precision on GPU and TPU.
    """
    require_pinhole("the rasterizer of meshes", camera)
    R, t, K = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3], camera.K
    x, y, z = (
        R[i, 0] * vertices[:, 0] + R[i, 1] * vertices[:, 1] + R[i, 2] * vertices[:, 2] + t[i]
        for i in range(3)
    )
    pixels = [K[0, 0] * (x / z) + K[0, 2], K[1, 1] * (y / z) + K[1, 2], z]
    return jnp.stack(pixels, axis=-1).astype(vertices.dtype)


def _first_pixel(low: Array, size: int) -> Array:
    """Returns the number of the first pixel whose centre is at `low` or after it, clipped to [0,
    size].
    """
    return jnp.clip(jnp.ceil(low - 0.5), 0, size).astype(jnp.int32)


def _last_pixel(high: Array, size: int) -> Array:
    """Returns the number of the last pixel whose centre is at `high` or before it, clipped to [-1,
    size - 1].
    """
    return jnp.clip(jnp.floor(high - 0.5), -1, size - 1).astype(jnp.int32)


def _pixel_centers(pixel: Array, width: int, dtype: np.dtype) -> tuple[Array, Array]:
    """Returns x and y of the centres of pixels. Pixels are numbered row by row."""
    return (pixel % width).astype(dtype) + 0.5, (pixel // width).astype(dtype) + 0.5


def _drawn(corners: Float[Array, "f 9"], near: float) -> tuple[Array, Array]:
    """Returns which faces lie in front of the near plane and have an area in the image, (f,), and
    the number of faces that are dropped but may be seen.
    """
    z = corners[:, 2::3]
    ab, ac = corners[:, 3:5] - corners[:, 0:2], corners[:, 6:8] - corners[:, 0:2]
    area = jnp.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    # an area below two roundings of its computation is none
    rounding = 2 * jnp.finfo(corners.dtype).eps * jnp.abs(ab).sum(-1) * jnp.abs(ac).sum(-1)
    whole = (z > near).all(-1) & jnp.isfinite(area)
    lost = ~whole & ~(z <= near).all(-1)  # also where z is NaN
    return whole & (area > rounding), jnp.sum(lost, dtype=jnp.int32)


def _rows(
    corners: Float[Array, "f 9"], drawn: Array, width: int, height: int
) -> tuple[Array, Array]:
    """Returns the first row of pixel centres of every face, (f,), and the number of rows, (f,). The
    number is 0 for a face that is not drawn, and if no pixel centre lies in its bounding box.
    """
    x, y = (jnp.where(drawn[:, None], corners[:, i::3], 0.0) for i in range(2))
    drawn &= _first_pixel(x.min(-1), width) <= _last_pixel(x.max(-1), width)
    first = _first_pixel(y.min(-1), height)
    return first, jnp.where(drawn, jnp.maximum(_last_pixel(y.max(-1), height) - first + 1, 0), 0)


def _spans(corners: Array, row: Array, width: int) -> tuple[Array, Array]:
    """Returns the columns whose pixel centres may lie inside a face, in one row of pixels: the
    first column, (n,), and the number of columns, (n,). corners: x, y and z of the corners of each
    face, (n, 9). row: number of the row for each face, (n,).
    """
    y = row.astype(corners.dtype) + 0.5
    left, right = jnp.full_like(y, jnp.inf), jnp.full_like(y, -jnp.inf)
    x = [corners[:, 3 * i] for i in range(3)]
    for a, b in ((0, 1), (1, 2), (2, 0)):
        ay, by = corners[:, 3 * a + 1], corners[:, 3 * b + 1]
        # a horizontal edge needs no part: its ends belong to the other two edges
        crosses = (jnp.minimum(ay, by) <= y) & (y <= jnp.maximum(ay, by)) & (ay != by)
        at = x[a] + (y - ay) / jnp.where(ay == by, 1.0, by - ay) * (x[b] - x[a])
        left = jnp.minimum(left, jnp.where(crosses, at, jnp.inf))
        right = jnp.maximum(right, jnp.where(crosses, at, -jnp.inf))
    largest = jnp.maximum(jnp.maximum(jnp.abs(x[0]), jnp.abs(x[1])), jnp.abs(x[2]))
    # widened by 16 roundings of the coordinates: the edge functions decide
    slack = 16 * jnp.finfo(corners.dtype).eps * (largest + 1.0)
    first = _first_pixel(left - slack, width)
    return first, jnp.maximum(_last_pixel(right + slack, width) - first + 1, 0)


def _weigh(corners: Array, x: Array, y: Array) -> tuple[list[Array], Array, Array]:
    """Returns the perspective-correct weights of the corners (three arrays), the depth, and whether
    the face covers the point (x, y).
    """
    # edge functions from the points' view, with the two ends of an edge in a fixed order
    corner_x = [corners[..., 3 * i] for i in range(3)]
    corner_y = [corners[..., 3 * i + 1] for i in range(3)]
    edges = []
    for a, b in ((1, 2), (2, 0), (0, 1)):
        ax, ay, bx, by = corner_x[a], corner_y[a], corner_x[b], corner_y[b]
        swap = (ay > by) | ((ay == by) & (ax > bx))
        ax, ay, bx, by = ax - x, ay - y, bx - x, by - y
        low_x, low_y, high_x, high_y = (
            jnp.where(swap, p, q) for p, q in ((bx, ax), (by, ay), (ax, bx), (ay, by))
        )
        edge = low_x * high_y - low_y * high_x
        edges.append(jnp.where(swap, -edge, edge))
    smallest = jnp.minimum(jnp.minimum(edges[0], edges[1]), edges[2])
    largest = jnp.maximum(jnp.maximum(edges[0], edges[1]), edges[2])
    # both windings; they are equal only if all are 0
    inside = ((smallest >= 0) | (largest <= 0)) & (smallest != largest)
    areas = [jnp.abs(edge) for edge in edges]
    total = areas[0] + areas[1] + areas[2]
    total = jnp.where(total > 0, total, 1.0)
    over_z = [area / total / corners[..., 3 * i + 2] for i, area in enumerate(areas)]
    depth = 1 / (over_z[0] + over_z[1] + over_z[2])
    return [value * depth for value in over_z], depth, inside


def _weights_by_pixel(corners: Array, face_ids: Array, width: int, pixels_per_step: int) -> Array:
    """Returns the weights of the corners of each pixel's face, (h w, 3).

    The pixels are computed in steps, because small buffers are several times faster on CPU.
    """

    def weights(pixel_and_face):
        pixel, face = pixel_and_face
        return jnp.stack(_weigh(corners[face], *_pixel_centers(pixel, width, corners.dtype))[0])

    pixels = jnp.arange(face_ids.shape[0], dtype=jnp.int32)
    return lax.map(weights, (pixels, face_ids), batch_size=pixels_per_step)


def _window(first: Array, end: Array, start: Array, size: int) -> tuple[Array, Array, Array]:
    """Returns three arrays for the slots start .. start + size - 1, (size,) each: the item that
    owns the slot, the place of the slot within the item, and whether the slot is used. Item i owns
    the slots first[i] .. end[i] - 1.
    """
    item = owners(first, size, start)
    slot = start + jnp.arange(size, dtype=jnp.int32)
    return item, slot - first[item], slot < end[-1]


class _ZBuffer(NamedTuple):
    """The nearest face so far at each pixel. Pixels are numbered row by row."""

    depth: Float[Array, " hw"]
    """z of the face, (h w,); infinity where there is none."""
    face_ids: Int[Array, " hw"]
    """Number of the face, (h w,); `NO_FACE` where there is none."""


def _z_buffer(
    corners: Array,
    first_row: Array,
    row_begin: Array,
    row_end: Array,
    width: int,
    height: int,
    config: RasterConfig,
) -> _ZBuffer:
    """Returns the z-buffer with all faces drawn. The first row of pixels of face i is first_row[i].
    Its rows own the slots row_begin[i] .. row_end[i] - 1.
    """

    def draw_rows(row_slot, buffer):
        # from faces to rows of pixels, and to the span of each row
        face, row_of_face, is_row = _window(row_begin, row_end, row_slot, config.rows_per_step)
        row = first_row[face] + row_of_face
        first_column, columns = _spans(corners[face], row, width)
        columns = jnp.where(is_row, columns, 0)
        pixel_end = cumsum(columns)
        pixel_begin = pixel_end - columns

        def draw_pixels(pixel_slot, buffer):
            # from spans to their pixels
            span, column_of_span, is_pixel = _window(
                pixel_begin, pixel_end, pixel_slot, config.fragments_per_step
            )
            pixel = row[span] * width + first_column[span] + column_of_span
            return _draw_fragments(buffer, corners, face[span], pixel, is_pixel, width)

        return _in_steps(draw_pixels, buffer, pixel_end, config.fragments_per_step)

    empty = _ZBuffer(
        depth=jnp.full(width * height, jnp.inf, corners.dtype),
        face_ids=jnp.full(width * height, NO_FACE, jnp.int32),
    )
    return _in_steps(draw_rows, empty, row_end, config.rows_per_step)


def _in_steps(
    draw: Callable[[Array, _ZBuffer], _ZBuffer], buffer: _ZBuffer, end: Array, size: int
) -> _ZBuffer:
    """Returns the buffer after draw(start, buffer) with start = 0, size, 2 size ... until all slots
    are drawn. end: end of each item's slots, as in `_window`.
    """

    def step(state):
        start, buffer = state
        buffer = draw(start, buffer)
        return start + size, buffer

    first = jnp.zeros((), jnp.int32)
    _, buffer = lax.while_loop(lambda state: state[0] < end[-1], step, (first, buffer))
    return buffer


def _draw_fragments(
    buffer: _ZBuffer, corners: Array, face: Array, pixel: Array, used: Array, width: int
) -> _ZBuffer:
    """Returns the buffer with fragments drawn: fragment i is of the face face[i] at the pixel
    pixel[i], (n,) each. Those that are not `used`, (n,), are left out.
    """
    nowhere = buffer.depth.shape[0]  # out of bounds: dropped
    x, y = _pixel_centers(pixel, width, corners.dtype)
    _, z, inside = _weigh(corners[face], x, y)
    drawn = jnp.where(used & inside, pixel, nowhere)
    # the smallest depth of each pixel
    before = buffer.depth.at[drawn].get(mode="fill", fill_value=-1.0)
    depth = buffer.depth.at[drawn].min(z, mode="drop")
    nearest = depth.at[drawn].get(mode="fill", fill_value=-1.0)
    # a pixel that came nearer forgets its face, and takes the lowest of the faces at its new depth
    nearer = jnp.where(nearest < before, drawn, nowhere)
    face_ids = buffer.face_ids.at[nearer].set(NO_FACE, mode="drop")
    winner = jnp.where(z == nearest, drawn, nowhere)
    face_ids = face_ids.at[winner].min(face, mode="drop")
    return _ZBuffer(depth, face_ids)


def sample_texture(
    texture: Float[Array, "th tw c"], uv: Float[Array, "h w 2"]
) -> Float[Array, "h w c"]:
    """Returns the texture's bilinear values at texture coordinates, (h, w, c). It is differentiable
    with respect to the texture and, except where u or v is at the centres of texels, to uv.

    As in OBJ files, u points right and v UP: (0, 0) is the lower left corner of the texture, (1, 1)
    its upper right one, and row 0 is the top. Texel (row, column) is at u = (column + 0.5) / width,
    v = 1 - (row + 0.5) / height. Beyond the outermost centres the border texels continue (no
    repetition).
    """
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


# Position maps: for every pixel, where the seen surface point is on the body in its canonical pose.
# The network looks its neural texture up there. Lengths are in the network's normalised units: the
# caller divides vertices and camera centre by the subject's scale. Pixels beside the body have the
# position (1, 1, 1) and depth -1. `plain_position_map` is the paper's: canonical positions,
# interpolated. The released network was trained on `gouraud_position_map`: positions as colors,
# through a Gouraud shader with a point light.

BACKGROUND = 1.0
"""Value of each coordinate of the position at pixels beside the body, normalised units."""
BACKGROUND_DEPTH = -1.0
"""Depth of pixels beside the body."""


def plain_position_map(
    posed_vertices: Float[Array, "n 3"],
    canonical_vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    """Returns the position map (h, w, 3) and the depth map (h, w) of one view. All lengths are in
    normalised units. Raises: as `rasterize_mesh`.
    """
    return _map(posed_vertices, canonical_vertices, faces, camera, config)


def gouraud_position_map(
    posed_vertices: Float[Array, "n 3"],
    canonical_vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    """Returns the position map (h, w, 3) of the released network, lit by a point light, and the
    depth map (h, w) of one view. All lengths are in normalised units. Raises: as `rasterize_mesh`.
    """
    albedo = (canonical_vertices + 1) / 2
    colors = _light(albedo, posed_vertices, vertex_normals(posed_vertices, faces), camera.center)
    return _map(posed_vertices, 2 * colors - 1, faces, camera, config)


@compiled()
def vertex_normals(vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]) -> Float[Array, "n 3"]:
    """Returns the unit normal of each vertex, (n, 3). It is the direction of the sum of the cross
    products of v1 - v0 and v2 - v0 over the vertex's faces. If the sum is 0, the normal is 0.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = jnp.cross(b - a, c - a)
    total = jnp.zeros_like(vertices).at[faces.reshape(-1)].add(jnp.repeat(normals, 3, axis=0))
    return safe_normalize(total, jnp.zeros(3))


@compiled()
def _light(albedo: Array, points: Array, normals: Array, eye: Array) -> Array:
    """Returns the colors of vertices by Phong's model, (n, 3): ambient and diffuse light times the
    albedo, plus a white highlight. eye: the camera's centre, (3,), normalised units.
    """

    def dot(a, b):
        return jnp.sum(a * b, axis=-1, keepdims=True)

    nowhere = jnp.zeros(3)
    light = jnp.asarray((0.0, 1.0, 0.0), points.dtype)  # its place, normalised units
    to_light = safe_normalize(light - points, nowhere)
    to_eye = safe_normalize(eye - points, nowhere)
    facing = dot(normals, to_light)
    reflected = 2 * facing * normals - to_light
    highlight = jnp.where(facing > 0, jnp.maximum(dot(reflected, to_eye), 0), 0) ** 64
    # shares of the ambient light, the light and the highlight: PyTorch3D's defaults
    return albedo * (0.5 + 0.3 * jnp.maximum(facing, 0)) + 0.2 * highlight


def _map(
    vertices: Array, values: Array, faces: Array, camera: Camera, config: RasterConfig
) -> tuple[Array, Array]:
    fragments = rasterize_mesh(vertices, faces, camera, config)
    return interpolate_attributes(
        fragments, faces, values, jnp.full(3, BACKGROUND, values.dtype)
    ), fragments.depth
