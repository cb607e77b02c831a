"""Makes UV atlases. A mesh is cut into charts that lie flat without folding over, and the charts
are packed into the unit square.

A chart is a connected set of faces of one piece that look towards about the same side, projected
along the mean of their normals. If a face is too oblique to the mean, the chart is projected along
one of `SIDES` instead. Where a chart folds over itself, the hidden faces become separate charts. To
find them, the charts are rasterized once with the highest face in front and once with the lowest.
Charts are placed as bitmaps, the largest first, each at the first free place. All charts have one
scale, which is multiplied by the density that the caller asks for.

Texture coordinates follow `rendering.mesh.rasterizer.sample_texture`: u to the right, v up.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

Points = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]

SIDES = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
"""The directions, (6, 3), of which each face is given one. A chart has faces of one direction."""
LEAST_COSINE = 0.45
"""Smallest cosine between the normal of a face and the side of a chart that it may join."""
PEELINGS = 3
"""Number of rounds in which charts that overlap themselves are split. The tests count what still
overlaps.
"""
GUTTER = 2
"""Smallest number of texels between charts."""
CELLS = 128
"""Number of cells along a side of the square in which charts are packed."""
SHRINKING = 0.97
"""Factor on the scale after a failed attempt to pack."""
VERTEX_STEP = 32768
"""The number of vertices is padded to a multiple of this, so that the rasterizer is compiled for
few shapes.
"""
FACE_STEP = 32768
"""The number of faces is padded to a multiple of this, so that the rasterizer is compiled for few
shapes.
"""


@dataclasses.dataclass(frozen=True)
class Atlas:
    """The charts of a mesh on one square texture."""

    uvs: Float[np.ndarray, "u 2"]
    """Texture coordinates, (u, 2), in [0, 1], v up."""
    faces: Faces
    """Indices into `uvs` of the corners of each face, (f, 3)."""
    vertices: Int[np.ndarray, " u"]
    """Vertex of the mesh that each texture coordinate belongs to, (u,)."""
    charts: Int[np.ndarray, " f"]
    """Chart of each face, (f,)."""
    size: int
    """Side of the texture, texels."""
    texel: float
    """Side of a texel in the plane of a chart with density 1, metres."""


def unwrap(
    vertices: Points,
    faces: Faces,
    pieces: Int[np.ndarray, " f"],
    size: int,
    density: Float[np.ndarray, " f"],
) -> Atlas:
    """Returns the atlas of a mesh: cuts the mesh into charts and packs them into a texture of size
    x size texels.

    pieces: number of each face's piece. No chart extends over two pieces. density: texels per metre
    on each face, relative to other faces. It must be the same all over a piece.

    Raises: ValueError for a size that is not a positive multiple of `CELLS`.
    """
    if size < CELLS or size % CELLS:
        raise ValueError(f"texture of {size} texels a side: expected a multiple of {CELLS}")
    corners = vertices[faces]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    pairs = _adjacent(faces)
    pairs = pairs[pieces[pairs[:, 0]] == pieces[pairs[:, 1]]]
    sides = _choose_sides(normals, pairs)
    layer = np.zeros(len(faces), np.int64)
    for peeling in range(PEELINGS + 1):
        charts = _connected(len(faces), pairs, sides + len(SIDES) * layer)
        flat = _flatten(vertices, faces, normals, charts, sides, density)
        if peeling < PEELINGS:
            hidden = _hidden(flat, size)
        else:
            hidden = np.zeros(len(faces), bool)
        if not hidden.any():
            break
        layer[hidden] += 1
    return _pack(flat, size)


@dataclasses.dataclass(frozen=True)
class _Flat:
    """Charts before packing."""

    points: np.ndarray
    """Points of all charts, (u, 2), metres times density, from the lower left corner of their
    chart.
    """
    heights: np.ndarray
    """Coordinates of the points along the axis of their chart, (u,), metres."""
    faces: np.ndarray
    """Indices of the points at the corners of each face, (f, 3)."""
    vertices: np.ndarray
    """Vertex of the mesh at each point, (u,)."""
    point_charts: np.ndarray
    """Chart of each point, (u,)."""
    charts: np.ndarray
    """Chart of each face, (f,)."""


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Returns vectors divided by their lengths along the last axis. Zero vectors stay zero."""
    return vectors / (np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True)) + 1e-12)


def edges_of(faces: Faces) -> Int[np.ndarray, "e 2"]:
    """Returns the directed edges of all faces, (e, 2), three per face."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def fill_gaps(
    image: Float[np.ndarray, "h w c"], known: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w c"]:
    """Returns the image with each unknown texel replaced by the nearest known texel."""
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return image[rows, columns]


def _adjacent(faces: np.ndarray) -> np.ndarray:
    """Returns pairs of faces that share an edge, (p, 2). An edge of k faces gives k - 1 pairs."""
    edges = np.sort(edges_of(faces).astype(np.int64), axis=1)
    keys = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    return np.stack([order[same], order[same + 1]], 1) % len(faces)


def _choose_sides(normals: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Returns the index in `SIDES` of the side that each face is given, (f,). Each face starts with
    the side that it looks towards most. In eight rounds, faces change to the side with the largest
    sum of the face's cosine and the neighbours' votes. The cosine with that side is at least
    `LEAST_COSINE`, unless the face's largest cosine is smaller.

    normals: unit normals of the faces, (f, 3). pairs: faces that are neighbours, (p, 2).
    """
    cosines = normals @ SIDES.T
    allowed = cosines >= np.minimum(LEAST_COSINE, cosines.max(1, keepdims=True))
    sides = np.argmax(cosines, axis=1)
    source, target = np.concatenate([pairs, pairs[:, ::-1]]).T
    for _ in range(8):
        votes = np.bincount(target * len(SIDES) + sides[source], minlength=cosines.size)
        # a neighbour counts as much as a cosine of 0.2
        gains = cosines + 0.2 * votes.reshape(cosines.shape)
        sides = np.argmax(np.where(allowed, gains, -np.inf), axis=1)
    return sides


def _connected(count: int, pairs: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Returns the number of the connected set that each face belongs to, (f,). Faces are connected
    if they share an edge and have the same label. count: number of faces. pairs: faces that share
    an edge, (p, 2). labels: label of each face, (f,).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = pairs[labels[pairs[:, 0]] == labels[pairs[:, 1]]].T
    graph = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _flatten(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    charts: np.ndarray,
    sides: np.ndarray,
    density: np.ndarray,
) -> _Flat:
    """Returns the charts, each projected onto a plane. The plane is perpendicular to the mean of
    the chart's normals. If the cosine between the mean and a normal is below `LEAST_COSINE`, the
    plane is perpendicular to the chart's side instead. Each chart is turned so that its bounding
    box is small, and scaled by its density.
    """
    count = int(charts.max()) + 1
    # a vertex is a point in each chart that it belongs to
    keys, inverse = np.unique(
        charts.repeat(3) * len(vertices) + faces.reshape(-1), return_inverse=True
    )
    owner, vertex = keys // len(vertices), keys % len(vertices)
    # the axis of a chart: its mean normal, or its side where that looks away from a face
    axis = unit(
        np.stack([np.bincount(charts, weights=normals[:, i], minlength=count) for i in range(3)], 1)
    )
    worst = np.full(count, np.inf)
    np.minimum.at(worst, charts, np.sum(normals * axis[charts], 1))
    some_side = np.zeros(count, np.int64)
    some_side[charts] = sides
    axis = np.where((worst < LEAST_COSINE)[:, None], SIDES[some_side], axis)
    # coordinates in the plane across the axis, turned and moved to the lower left corner
    helper = np.where(np.abs(axis[:, 1:2]) < 0.8, [[0.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]])
    right = unit(np.cross(helper, axis))
    up = np.cross(axis, right)
    flat = np.stack([np.sum(vertices[vertex] * side[owner], 1) for side in (right, up)], 1)
    flat = _turned(flat, owner, count)
    enlarged = np.ones(count)
    enlarged[charts] = density
    points = (
        (flat - _extreme(np.minimum, flat, owner, count)[owner]) * enlarged[owner, None]
    ).astype(np.float32)
    heights = np.sum(vertices[vertex] * axis[owner], 1)
    return _Flat(points, heights, inverse.reshape(-1, 3), vertex, owner, charts)


def _turned(flat: np.ndarray, owner: np.ndarray, count: int, angles: int = 8) -> np.ndarray:
    """Returns the points (u, 2) with every chart turned. Of `angles` angles, each chart takes the
    one that makes its bounding box smallest, with the wide side to the right.

    flat: points of the charts, (u, 2). owner: chart of each point.
    """
    best_area, best = np.full(count, np.inf), flat
    for angle in np.arange(angles) * (np.pi / angles):
        c, s = np.cos(angle), np.sin(angle)
        turned = flat @ np.asarray([[c, s], [-s, c]])
        width, height = (
            _extreme(np.maximum, turned, owner, count) - _extreme(np.minimum, turned, owner, count)
        ).T
        area = width * height + np.where(width < height, 1e-9, 0)
        better = area < best_area - 1e-12
        best_area = np.where(better, area, best_area)
        best = np.where(better[owner][:, None], turned, best)
    return best


def _extreme(function: np.ufunc, values: np.ndarray, owner: np.ndarray, count: int) -> np.ndarray:
    """Returns the smallest or the largest coordinates of each chart, (charts, 2). function:
    `np.minimum` or `np.maximum`. values: points of the charts, (u, 2). owner: chart of each point.
    """
    worst = np.inf if function is np.minimum else -np.inf
    result = np.full((count, 2), worst)
    function.at(result, owner, values)
    return result


def _sizes(flat: _Flat) -> np.ndarray:
    """Returns the widths and heights of the charts, (2, charts), metres times density."""
    return _extreme(np.maximum, flat.points, flat.point_charts, int(flat.charts.max()) + 1).T


def _hidden(flat: _Flat, size: int) -> np.ndarray:
    """Returns which faces lie below other faces of their chart, (f,). There are such faces where a
    chart overlaps itself.
    """
    corners, scale = _shelves(flat, size)
    pixels = (flat.points * scale + corners[flat.point_charts]).astype(np.float32)
    span = max(float(np.ptp(flat.heights)), 1e-6)
    depth = 2 - (flat.heights - flat.heights.min()) / span
    near = _rasterize(pixels, depth, flat.faces, size)[0]
    far = _rasterize(pixels, 3 - depth, flat.faces, size)[0]
    hidden = np.zeros(len(flat.faces), bool)
    hidden[far[near != far]] = True
    return hidden


def _shelves(flat: _Flat, size: int) -> tuple[np.ndarray, float]:
    """Returns the lower left corners of the charts in a simple arrangement, (charts, 2), texels,
    and the scale in texels per metre. The charts lie in rows, and the highest come first.
    """
    width, height = _sizes(flat)
    order = np.argsort(-height)
    scale = 0.9 * size / np.sqrt(np.sum(width * height))
    while True:
        corners, x, y, row = np.zeros((len(width), 2)), 0.0, 0.0, 0.0
        for chart in order:
            w, h = width[chart] * scale + GUTTER, height[chart] * scale + GUTTER
            if x + w > size:
                x, y, row = 0.0, y + row, 0.0
            corners[chart] = x + GUTTER / 2, y + GUTTER / 2
            x, row = x + w, max(row, h)
        if y + row <= size and width.max() * scale + GUTTER <= size:
            return corners, scale
        scale *= 0.95


def _rasterize(
    pixels: np.ndarray, depth: np.ndarray | np.floating, faces: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the face of every texel, (size, size), which is -1 where there is no face, and the
    weights of the face's corners, (size, size, 3). Row 0 is the top.

    pixels: points (u, 2), texels, y up. depth: depths of the points, (u,), or one for all. The face
    with the smallest depth is taken. faces: indices of the points at the corners of each face, (f,
    3).
    """
    points = np.stack(
        [pixels[:, 0] * depth, (size - pixels[:, 1]) * depth, depth * np.ones(len(pixels))], 1
    )
    points = np.pad(
        points.astype(np.float32), ((0, -len(points) % VERTEX_STEP), (0, 0)), constant_values=1
    )
    faces = np.pad(faces.astype(np.int32), ((0, -len(faces) % FACE_STEP), (0, 0)))
    camera = Camera(jnp.eye(3, dtype=jnp.float32), jnp.eye(4, dtype=jnp.float32), size, size)
    fragments = rasterize_mesh(jnp.asarray(points), jnp.asarray(faces), camera)
    return np.asarray(fragments.face_ids), np.asarray(fragments.barycentrics)


def texels(atlas: Atlas) -> tuple[Int[np.ndarray, "s s"], Float[np.ndarray, "s s 3"]]:
    """Returns the face that every texel shows, (s, s), and the weights of the face's corners, (s,
    s, 3). The face is -1 where there is none.

    Row 0 is the top (v = 1).
    """
    return _rasterize(atlas.uvs * atlas.size, np.float32(1), atlas.faces, atlas.size)


def _pack(flat: _Flat, size: int) -> Atlas:
    """Returns the atlas. Each chart, the largest first, is put at the first place where its bitmap
    of cells is free. If not all charts fit, all are made smaller.
    """
    # the boxes alone would fill the square: a start that is too large
    scale = size / np.sqrt(np.prod(_sizes(flat), 0).sum())
    corners = _place(flat, scale, size)
    while corners is None:
        scale *= SHRINKING
        corners = _place(flat, scale, size)
    uvs = (flat.points * scale + corners[flat.point_charts]) / size
    return Atlas(
        uvs.astype(np.float32),
        flat.faces.astype(np.int32),
        flat.vertices,
        flat.charts,
        size,
        1 / scale,
    )


def _place(flat: _Flat, scale: float, size: int) -> np.ndarray | None:
    """Returns the lower left corner of each chart, (charts, 2), texels, y up. None if the charts do
    not fit.
    """
    cell = size // CELLS
    masks = _bitmaps(flat, scale, cell)
    if sum(np.count_nonzero(mask) for mask in masks) > CELLS * CELLS:
        return None
    free = np.ones((CELLS, CELLS), bool)
    corners = np.zeros((len(masks), 2))
    for chart in sorted(range(len(masks)), key=lambda i: -masks[i].size):
        at = _first_free(free, masks[chart])
        if at is None:
            return None
        rows, columns = masks[chart].shape
        free[at[0] : at[0] + rows, at[1] : at[1] + columns] &= ~masks[chart]
        corners[chart] = at[1] * cell + GUTTER / 2, at[0] * cell + GUTTER / 2
    return corners


def _first_free(free: np.ndarray, mask: np.ndarray) -> tuple[int, int] | None:
    """Returns the first (row, column) at which all cells of a bitmap are free, by row, then column.
    None if there is no such place.
    """
    rows, columns = (n - m + 1 for n, m in zip(free.shape, mask.shape, strict=True))
    if rows < 1 or columns < 1:
        return None
    fits = np.ones((rows, columns), bool)
    for row, column in np.argwhere(mask):
        fits &= free[row : row + rows, column : column + columns]
    place = int(np.argmax(fits))
    if fits.flat[place]:
        return divmod(place, columns)
    return None


def _bitmaps(flat: _Flat, scale: float, cell: int) -> list[np.ndarray]:
    """Returns a mask of cells, (rows, columns), for every chart. It is True where a cell touches
    the bounding box of a face, widened by half a gutter.
    """
    corners = (flat.points * scale)[flat.faces]
    low = np.floor(corners.min(1) / cell).astype(np.int64)
    high = np.floor((corners.max(1) + GUTTER) / cell).astype(np.int64)
    count = int(flat.charts.max()) + 1
    extent = np.zeros((count, 2), np.int64)
    np.maximum.at(extent, flat.charts, high + 1)
    start = np.concatenate([[0], np.cumsum(extent[:, 0] * extent[:, 1])])
    cells = np.zeros(start[-1], bool)
    for step in np.ndindex(*((high - low).max(0) + 1)):
        x, y = np.minimum(low + step, high).T
        cells[start[flat.charts] + y * extent[flat.charts, 0] + x] = True
    return [
        cells[a:b].reshape(h, w) for a, b, (w, h) in zip(start[:-1], start[1:], extent, strict=True)
    ]
