"""Finds how far the skin of a body must move to fill the masks.

The vertices of the body are moved along their normals until the body's silhouettes meet the masks
of all photos. A vertex may lie on the body's silhouette in a photo. The edge of the mask along the
vertex's normal then says how far the vertex should move, its target. A sparse least-squares fit
gives all vertices moves t along their normals. It minimizes this sum over the surface:

    sum over photos of (t - target)^2 + (WEAKNESS + held) t^2 + smoothness^4 (Laplacian t)^2

So the surface between the places that two photos show becomes round. `held` keeps hands and head
where they are. At the end, vertices that are still outside a mask move inwards. Clothes become part
of the body (as in "SMPL+D", https://arxiv.org/abs/1803.04758). All of this runs on the host, by
numpy and scipy: nothing is compiled.
"""

import dataclasses
import functools

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.data.body_and_masks import MASK_THRESHOLD, empty_views, shaped, skinned
from humangs_jax.data.capture import Capture
from humangs_jax.data.masks import box_of, signed_distance
from humangs_jax.geometry.mesh import unit, vertex_area_vectors, vertex_areas
from humangs_jax.io.images import resized

STEP = 0.0025
"""Distance between the points along a normal at which a mask's edge is looked for, metres."""
WEAKNESS = 0.002
"""Weight that keeps a vertex where it is. A photo that shows the vertex on the silhouette has
weight 1.
"""
HELD = 20.0
"""Weight that keeps vertices of hands and head where they are. It is multiplied by the share of the
vertex's skinning weights that belongs to these parts.
"""
HELD_JOINTS = ("head", "jaw", "eye", "wrist", "index", "middle", "pinky", "ring", "thumb")
NEAR = 2.5
"""A vertex may be on the body's silhouette if it is nearer to the silhouette's edge than this,
pixels.
"""
PROBE = 0.012
"""A vertex near the silhouette's edge is moved outwards along its normal by this, metres, to see
whether it leaves the silhouette.
"""
LEAVES = 0.6
"""A vertex near the silhouette's edge (see `NEAR`) is on the silhouette if the move by `PROBE`
takes it outwards, in the image, by more than this share of `PROBE`.
"""
DRAWN = 0.5
"""Silhouettes are drawn larger than they are by this much, pixels."""
WRAP = 0.07
"""Largest move of the last step, metres. In the last step, vertices outside a mask move inwards
until they are inside all masks by at least the first number of the inset.
"""
WRAP_ROUNDS = 6
"""How many times the moves of the last step (see `WRAP`) are averaged over neighbouring
vertices.
"""
OUTSIDE = 0.01
"""Distance outside of a mask beyond which a vertex counts as outside, metres, see `MISFIT`."""
MISFIT = 0.025
"""A body does not fit its masks if at least this share of its vertices (without head and hands)
lies more than `OUTSIDE` outside of a mask. Clothes do not raise the share, and it is 0 for true
bodies. The share was at least 0.03 for bodies that are a centimetre off. For a real man it was 0.02
to 0.06 with fits to keypoints alone, and at most 0.02 with fits refined by the masks.
"""
LONGEST = 480
"""The length of the longer side of the window around the person, pixels. Silhouettes are compared
in this window.
"""
MARGIN = 0.12
"""The room on each side of the person, as a share of the longer side of the person's box."""


Points = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]
PerVertex = Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class OffsetFitConfig:
    """How a surface moves to the edges of the masks. The defaults are for bodies. They are small,
    since the network knows naked bodies and adds clothes on top.
    """

    outwards: float = 0.05
    """The largest move outwards along a normal, metres. A mask's edge is looked for up to this
    distance.
    """
    inwards: float = 0.06
    """The largest move inwards along a normal, metres. A mask's edge is looked for up to this
    distance.
    """
    smoothness: float = 0.03
    """The length over which a move spreads to the vertices around it, metres."""
    inset: tuple[float, float] = (0.005, 0.025)
    """The least and the largest distance from the edges of the masks inwards to the surface,
    metres.
    """
    iterations: int = 2
    """How many times edges are looked for and the surface is moved."""


@dataclasses.dataclass(frozen=True)
class MaskedView:
    """One photo: the window around the person, and the body in the pose of the photo."""

    coverage: Float[np.ndarray, "h w"]
    """The share of each pixel that the person covers, (h, w), in [0, 1]."""
    project: Float[np.ndarray, "3 4"]
    """From the world in metres to homogeneous pixels of the window, (3, 4)."""
    linear: Float[np.ndarray, "n 3 3"]
    """The matrix that takes each vertex from the rest pose to the posed body, (n, 3, 3). `offset`
    is added afterwards.
    """
    offset: Float[np.ndarray, "n 3"]
    """The offset that is added to each vertex after `linear`, (n, 3), metres."""
    low: Float[np.ndarray, "2"]
    """The least x and y of points in the window that count as inside the photo, (2,), pixels. They
    lie `NEAR` inside the photo's upper left corner.
    """
    high: Float[np.ndarray, "2"]
    """The largest x and y of points in the window that count as inside the photo, (2,), pixels."""
    hidden: Float[np.ndarray, "h w"] | None = None
    """The largest share that somebody in front may hide of a pixel or of one of its neighbours, for
    each pixel, (h, w), in [0, 1]. The ends of masks say nothing there. None: nothing is hidden.
    """

    @functools.cached_property
    def mask(self) -> Float[np.ndarray, "h w"]:
        """The signed distance of each pixel to the edge of the mask, (h, w), pixels; positive
        inside.
        """
        return signed_distance(self.coverage).astype(np.float32)

    def seen(
        self, points: Float[np.ndarray, "*n 3"], index: np.ndarray | slice = slice(None)
    ) -> tuple:
        """Returns three values for points of the rest pose: their places in the window, (*n, 2),
        pixels; the pixels per metre there, (*n); and whether the photo shows them, (*n).

        index: the vertices whose transforms move the points.
        """
        posed = np.einsum("nab,n...b->n...a", self.linear[index], points)
        posed += self.offset[index].reshape(len(posed), *[1] * (points.ndim - 2), 3)
        clip = posed @ self.project[:, :3].T + self.project[:, 3]
        depth = np.maximum(clip[..., 2], 1e-3)
        pixels = clip[..., :2] / depth[..., None]
        within = (clip[..., 2] > 1e-3) & ((pixels > self.low) & (pixels < self.high)).all(-1)
        if self.hidden is not None:
            within &= at(self.hidden, pixels) < MASK_THRESHOLD
        # the first row is the focal length times the camera's x axis, plus the principal point's x
        # times the z axis, which does not count
        x, z = self.project[0, :3], self.project[2, :3]
        return pixels, np.linalg.norm(np.cross(x, z)) / depth, within


def fit_vertex_offsets(
    body: BodyModel,
    capture: Capture,
    inset: tuple[float, float] = OffsetFitConfig.inset,
    *,
    always: bool = True,
) -> Float[np.ndarray, "n 3"]:
    """Returns displacements of the vertices of a person's shaped body in the T-pose, (n, 3),
    metres. They make the body fill the masks. Each step of the fit limits how far vertices move
    (`OffsetFitConfig`, `WRAP`).

    Displacements are 0 if all masks are empty, or if the masks are not near the body.

    Arguments: body: the capture's body, or one of `data.views.gaussian_body`. capture: has masks;
    its views may show any frames, and any axis may be up. inset: see `OffsetFitConfig`. always:
    whether a body that fits the masks already is displaced, too, see `MISFIT`. If `always` is
    False, the displacements of such a body are 0, because others would make the clothes that the
    network adds worse.
    """
    assert capture.masks is not None
    rest = shaped(body, capture.betas)
    views = masked_views(body, rest, capture)
    total = np.zeros_like(rest)
    if not views:
        return total.astype(np.float32)
    faces = np.asarray(body.faces)
    held = (
        HELD
        * np.asarray(body.skinning_weights)
        @ [any(x in name for x in HELD_JOINTS) for name in body.joint_names]
    )
    if not always and _share_outside(views, rest, held < HELD / 2) < MISFIT:
        return total.astype(np.float32)
    total += to_edges(views, rest, faces, held, OffsetFitConfig(inset=inset))
    moved, normals = rest + total, unit(vertex_area_vectors(rest + total, faces))
    total -= _outside(views, moved, normals, faces, inset, held < HELD / 2)[:, None] * normals
    return total.astype(np.float32)


def to_edges(
    views: list[MaskedView], rest: Points, faces: Faces, held: PerVertex, reach: OffsetFitConfig
) -> Points:
    """Returns smooth displacements of the vertices of a surface in the T-pose, (n, 3), metres. They
    move the surface along its normals to the edges of the masks.

    held: for each vertex, the weight that keeps it where it is. Each photo that shows the vertex on
    the silhouette has weight 1. reach: how far and how smoothly the surface moves.
    """
    total = np.zeros_like(rest)
    for _ in range(reach.iterations):
        moved, normals = rest + total, unit(vertex_area_vectors(rest + total, faces))
        count, summed = _targets(views, moved, normals, faces, reach)
        total += _spread(moved, faces, count, summed, held, reach)[:, None] * normals
    return total


def masked_views(body: BodyModel, rest: Points, capture: Capture) -> list[MaskedView]:
    """Returns the views of a capture whose masks are not empty, cut to the person. Views whose body
    has numbers that are not finite are left out. rest: the vertices of the body in the T-pose,
    metres.
    """
    assert capture.masks is not None
    joints = np.asarray(body.joint_regressor, float) @ rest
    weights, views, posed = np.asarray(body.skinning_weights, float), [], {}
    empty = empty_views(capture.masks)
    for i, frame in enumerate(np.asarray(capture.frames).tolist()):
        if i in empty:
            continue
        if frame not in posed:
            posed[frame] = skinned(body, joints, capture.poses, frame, weights, corrected=True)
        # a body that is not finite is named by whoever poses it
        if not all(np.isfinite(x).all() for x in (rest, *posed[frame])):
            continue
        K = np.asarray(capture.cameras.K, float)[i]
        matrix = np.asarray(capture.cameras.cam_from_world, float)[i]
        hidden = None if capture.unknown is None else capture.unknown[i]
        mask = np.asarray(capture.masks[i])
        views.append(_window(mask, hidden, K @ matrix[:3], *posed[frame]))
    return views


def _window(
    mask: Float[np.ndarray, "h w"],
    hidden: Bool[np.ndarray, "h w"] | None,
    project: Float[np.ndarray, "3 4"],
    linear: Float[np.ndarray, "n 3 3"],
    offset: Points,
) -> MaskedView:
    """Returns a view cut to the person and resized, so that the window's longest side has `LONGEST`
    pixels. project: from the world to homogeneous pixels of the photo. linear, offset: see
    `MaskedView`.

    Outside of the photo the mask repeats the values at the photo's border.
    """
    (top, bottom), (left, right) = box_of(mask > MASK_THRESHOLD).tolist()
    margin = int(np.ceil(MARGIN * max(bottom - top, right - left)))
    top, left, bottom, right = top - margin, left - margin, bottom + margin, right + margin
    height, width = mask.shape
    pad = ((max(-top, 0), max(bottom - height, 0)), (max(-left, 0), max(right - width, 0)))
    cut = slice(max(top, 0), bottom), slice(max(left, 0), right)
    window = np.pad(mask[cut], pad, mode="edge")
    scale = LONGEST / max(window.shape)
    rows, columns = (max(1, round(side * scale)) for side in window.shape)
    x, y = columns / window.shape[1], rows / window.shape[0]
    to_window = np.asarray([[x, 0, -left * x], [0, y, -top * y], [0, 0, 1]])
    low = np.asarray([-left * x, -top * y])
    high = np.asarray([(width - left) * x, (height - top) * y])
    covers = None
    if hidden is not None and hidden[cut].any():
        share = resized(np.pad(hidden[cut], pad, mode="edge").astype(np.float32), columns, rows)
        # the mask's edge beside it is that of who stands in front
        covers = ndimage.maximum_filter(share, size=2 * int(np.ceil(NEAR)) + 1)
    return MaskedView(
        resized(window, columns, rows),
        to_window @ project,
        linear,
        offset,
        low + NEAR,
        high - NEAR,
        covers,
    )


def _share_outside(
    views: list[MaskedView], rest: Float[np.ndarray, "n 3"], free: Bool[np.ndarray, " n"]
) -> float:
    """Returns the share of the free vertices that are more than `OUTSIDE` outside of a mask. If the
    share of the free vertices that are outside by any distance is less than `MISFIT`, this larger
    share is returned, because it is faster to compute.
    """
    if not free.any():
        return 0.0
    outside, far = np.zeros((2, len(rest)), bool)
    seen = [view.seen(rest) for view in views]

    # outside at all, which needs no distances
    for view, (pixels, _, within) in zip(views, seen, strict=True):
        outside |= within & (at(view.coverage, pixels) < MASK_THRESHOLD)
    few = float(outside[free].mean())
    if few < MISFIT:
        return few

    for view, (pixels, per_metre, within) in zip(views, seen, strict=True):
        far |= within & (at(view.mask, pixels) < -OUTSIDE * per_metre)
    return float(far[free].mean())


def _targets(
    views: list[MaskedView], rest: Points, normals: Points, faces: Faces, how: OffsetFitConfig
) -> tuple[PerVertex, PerVertex]:
    """Returns for each vertex the number of photos that show it on the silhouette, and the sum of
    the moves that these photos ask for, metres.

    A photo asks for the smallest move after which the surface is inside the mask's edge by a
    distance in the range `how.inset`.
    """
    count, summed = np.zeros(len(rest)), np.zeros(len(rest))
    reach = np.arange(-how.inwards, how.outwards + STEP / 2, STEP)
    for view in views:
        pixels, per_metre, within = view.seen(rest)
        own = _silhouette_distance(pixels, faces, view.mask.shape)
        probed, _, _ = view.seen(rest + PROBE * normals)
        leaves = at(own, probed) < at(own, pixels) - LEAVES * PROBE * per_metre
        edge = np.flatnonzero(within & (np.abs(at(own, pixels)) < NEAR) & leaves)
        along = rest[edge, None] + reach[:, None] * normals[edge, None]
        pixels, _, within = view.seen(along, edge)
        there, found = _crossing(np.where(within, at(view.mask, pixels), np.nan), reach)
        here, known = _crossing(at(own, pixels), reach)
        found &= known
        count[edge[found]] += 1
        gap = (there - here)[found]
        summed[edge[found]] += gap - np.clip(gap, *how.inset)
    return count, summed


def _crossing(
    depths: Float[np.ndarray, "e r"], reach: Float[np.ndarray, " r"]
) -> tuple[Float[np.ndarray, " e"], Bool[np.ndarray, " e"]]:
    """Returns how far along each normal the edge of a silhouette is, metres, and whether an edge
    was found. If the start is inside of the silhouette, the edge is looked for outwards, otherwise
    inwards. The nearest edge counts.

    depths: signed distances to the edge at the places `reach` along each normal, positive inside;
    NaN where the photo shows nothing. reach: metres.
    """
    zero = int(np.argmin(np.abs(reach)))
    distance, found = np.zeros(len(depths)), np.zeros(len(depths), bool)
    starts_inside = depths[:, zero] > 0
    for inside, order in ((True, slice(zero, None)), (False, slice(zero, None, -1))):
        rows = np.flatnonzero(starts_inside == inside)
        values, places = depths[rows][:, order], reach[order]
        if inside:
            crossed = values[:, 1:] <= 0
        else:
            crossed = values[:, 1:] > 0
        unknown = np.isnan(values).cumsum(1)[:, 1:] > 0
        first = np.argmax(crossed & ~unknown, axis=1)
        hit = (crossed & ~unknown)[np.arange(len(rows)), first]
        a, b = values[np.arange(len(rows)), first], values[np.arange(len(rows)), first + 1]
        share = np.where(hit, a / np.where(a == b, 1, a - b), 0)
        distance[rows] = places[first] + np.clip(share, 0, 1) * (places[first + 1] - places[first])
        found[rows] = hit
    return distance, found


def _silhouette_distance(
    pixels: Float[np.ndarray, "n 2"], faces: Faces, shape: tuple[int, ...]
) -> Float[np.ndarray, "h w"]:
    """Returns the signed distance of each pixel to the edge of a surface's silhouette, pixels;
    positive inside.
    """
    # the side that faces the camera covers all
    a, b, c = np.moveaxis(pixels[faces], 1, 0)
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return signed_distance(silhouette(pixels, faces[turn < 0], shape)) - DRAWN


def silhouette(
    pixels: Float[np.ndarray, "n 2"], faces: Faces, shape: tuple[int, ...]
) -> Float[np.ndarray, "h w"]:
    """Returns an image with 1 inside of triangles and 0 elsewhere. The triangles are drawn `DRAWN`
    pixels larger than they are. shape: the height and the width of the image.
    """
    image = Image.new("L", (shape[1], shape[0]))
    pen = ImageDraw.Draw(image)
    for corners in (pixels[faces] - 0.5).reshape(-1, 6).tolist():
        pen.polygon(corners, fill=1)
    return np.asarray(image, np.float32)


def _spread(
    vertices: Points,
    faces: Faces,
    count: PerVertex,
    summed: PerVertex,
    held: PerVertex,
    reach: OffsetFitConfig,
) -> PerVertex:
    """Returns the move of each vertex along its normal that solves the least-squares problem of the
    module's docstring, metres. The moves are limited by `reach`.

    count, summed: as `_targets` returns them. held: see `to_edges`.
    """
    areas = np.maximum(vertex_areas(vertices, faces), 1e-9)
    laplacian = _laplacian(vertices, faces)
    bending = reach.smoothness**4 * laplacian.T @ sparse.diags(1 / areas) @ laplacian
    matrix = sparse.diags(areas * (WEAKNESS + count + held)) + bending
    return np.clip(splu(matrix.tocsc()).solve(areas * summed), -reach.inwards, reach.outwards)


def _laplacian(vertices: Points, faces: Faces) -> sparse.csr_array | sparse.csr_matrix:
    """Returns the Laplacian of the mesh, weighted by cotangents of the angles. None of the weights
    is negative.
    """
    rows, columns, values = [], [], []
    for i in range(3):
        a, b, c = (faces[:, (i + k) % 3] for k in range(3))
        u, v = vertices[a] - vertices[c], vertices[b] - vertices[c]
        cotangent = (u * v).sum(-1) / np.maximum(np.linalg.norm(np.cross(u, v), axis=-1), 1e-10)
        rows = [*rows, a, b]
        columns = [*columns, b, a]
        values = [*values, *[np.clip(cotangent, 0.05, 5) / 2] * 2]
    size = len(vertices)
    weights = sparse.coo_array(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), (size, size)
    ).tocsr()
    return (sparse.diags(np.asarray(weights.sum(axis=1))) - weights).tocsr()


def _outside(
    views: list[MaskedView],
    rest: Points,
    normals: Points,
    faces: Faces,
    inset: tuple[float, float],
    free: Bool[np.ndarray, " n"],
) -> PerVertex:
    """Returns how far each vertex moves inwards, metres, so that vertices outside of a mask get
    into all masks. The moves of these vertices are smoothed over the mesh, so vertices near them
    move, too. Vertices that are not free are moved only by this smoothing. The largest move is
    `WRAP`.
    """
    reach = np.arange(0, WRAP + STEP / 2, STEP)
    inside = np.full((len(rest), len(reach)), np.inf)
    for view in views:
        pixels, per_metre, within = view.seen(rest[:, None] - reach[:, None] * normals[:, None])
        inside = np.minimum(inside, np.where(within, at(view.mask, pixels) / per_metre, np.inf))
    good = inside >= inset[0]
    move = np.where((inside[:, 0] < 0) & good.any(1) & free, reach[np.argmax(good, axis=1)], 0)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = len(rest)
    ones = np.ones(len(edges))
    near = sparse.coo_array((ones, (edges[:, 0], edges[:, 1])), (size, size)).tocsr()
    near = near + near.T + sparse.eye(size)
    near = sparse.diags(1 / np.asarray(near.sum(axis=1))) @ near
    for _ in range(WRAP_ROUNDS):
        move = near @ move
    return move


def at(
    image: Float[np.ndarray, "h w"], pixels: Float[np.ndarray, "*b 2"]
) -> Float[np.ndarray, "*b"]:
    """Returns the values of an image at pixels (x, y), (*b), interpolated bilinearly.

    The centre of the first pixel is (0.5, 0.5). Beyond the image its edge is repeated.
    """
    x, y = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    return ndimage.map_coordinates(image, [y, x], order=1, mode="nearest", prefilter=False)
