"""The posed body against the masks: which views show the person, and how far the body's skin moves
to fill the masks.

A mask that is empty, or nowhere near the body, does not only say nothing: the network takes its
white photo for the person, and refinement makes the avatar transparent there. All that reads photos
leaves such views out, by name.

The body is displaced: its vertices are moved along their normals until its silhouettes meet those
of all photos. Where a vertex lies on the body's own silhouette in a photo, the mask's edge along
its normal says how far it should move. A sparse least-squares fit carries this over the rest of the
mesh, smoothly:

    sum over photos of (t - target)^2 + WEAKNESS t^2 + SMOOTHNESS^4 (Laplacian t)^2,    per area,

so that a section between two photos becomes round. What is then still outside a mask is moved
inwards. Clothes become part of the body (as in "SMPL+D", https://arxiv.org/abs/1803.04758). All on
the host, by numpy and scipy: nothing is compiled.
"""

import dataclasses
import functools
import logging
from collections.abc import Callable, Sequence

import numpy as np
from PIL import Image, ImageDraw
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from humangs_jax.body.kinematics import bones_of, posed_tree
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.masks import box_of, signed_distance
from humangs_jax.geometry.mesh import face_areas, unit, vertex_area_vectors, vertex_areas
from humangs_jax.io.images import resized

logger = logging.getLogger(__name__)

MASK_THRESHOLD = 0.5
"""A pixel belongs to the person when its mask is above this."""
LEAST_SHARE = 0.05
"""The least share of the body in the frame that lies on the mask.

In the demo's photos the head alone has 6 to 7 %, an inverted mask 1.4 %.
"""
POINTS = 1000
"""The number of points on the skin."""


def report_left_out(names: Sequence[str], reasons: dict[int, str]) -> None:
    """Warns of views that are left out, by their names, with the reasons of `views_without_person`.

    Raises: CaptureError, one line that names the views, if none is left.
    """
    if not reasons:
        return
    lines = []
    for reason in dict.fromkeys(reasons.values()):
        views = [names[view] for view in reasons if reasons[view] == reason]
        lines.append(f"{', '.join(views)}: {reason}")
    if len(reasons) == len(names):
        problem = f"no view is left that shows the person: {'; '.join(lines)}"
        raise CaptureError("capture", "masks", problem)
    verb = "is" if len(reasons) == 1 else "are"
    count = f"{len(reasons)} of {len(names)} views {verb}"
    logger.warning("%s left out: %s", count, "; ".join(lines))


def views_without_person(capture: Capture) -> dict[int, str]:
    """The views whose mask is empty or hardly meets what of the posed body is in the frame, and
    which of the two.

    A body that is not finite is another fault, which whoever poses it names.
    """
    found = dict.fromkeys(empty_views(capture.masks), "the mask is empty")
    if capture.masks is None or len(found) == capture.view_count:
        return found
    points = surface_points(capture.body, capture.betas, capture.poses, capture.frames, POINTS)
    K, cam_from_world = np.asarray(capture.cameras.K), np.asarray(capture.cameras.cam_from_world)
    for i, frame in enumerate(capture.frames.tolist()):
        mask = np.asarray(capture.masks[i])
        if i in found or not np.isfinite(points[frame]).all():
            continue
        x, y = (
            points_in_image(points[frame], K[i], cam_from_world[i], *mask.shape[::-1]).astype(int).T
        )
        on_mask = mask[y, x] > MASK_THRESHOLD
        if capture.unknown is not None:
            # what may be hidden says nothing, unless that is nearly all
            seen = ~capture.unknown[i][y, x]
            if seen.mean() > LEAST_SHARE:
                on_mask = on_mask[seen]
        if not len(on_mask) or on_mask.mean() < LEAST_SHARE:
            found[i] = "mask and posed body hardly meet (`humangs check` draws both)"
    return dict(sorted(found.items()))


def empty_views(masks: Float[np.ndarray, "v h w"] | None) -> list[int]:
    """The views whose mask shows nobody."""
    if masks is None:
        return []
    return [i for i, mask in enumerate(masks) if not (np.asarray(mask) > MASK_THRESHOLD).any()]


# Points on the skin
# --------------------------------------------------------------------------------------------------


def surface_points(
    body: BodyModel,
    betas: Float[np.ndarray, " s"],
    poses: BodyPose,
    frames: Int[np.ndarray, " v"],
    count: int,
) -> dict[int, Float[np.ndarray, "count 3"]]:
    """Points spread evenly over the skin, metres, by the frames that views show; without pose
    correctives.
    """
    rest = shaped(body, betas)
    joints = np.asarray(body.joint_regressor) @ rest
    corners, weights = _sampling(rest, np.asarray(body.faces), count)
    used, corners = np.unique(corners, return_inverse=True)
    skinning, corners = np.asarray(body.skinning_weights)[used], corners.reshape(weights.shape)
    posed = {}
    for frame in set(frames.tolist()):
        linear, offset = skinned(body, joints, poses, frame, skinning)
        vertices = np.einsum("nrc,nc->nr", linear, rest[used]) + offset
        posed[frame] = np.einsum("pc,pcx->px", weights, vertices[corners])
    return posed


def skinned(
    body: BodyModel,
    joints: Float[np.ndarray, "j 3"],
    poses: BodyPose,
    frame: int,
    weights: Float[np.ndarray, "n j"],
    corrected: bool = False,
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Matrices and offsets from the rest pose to a frame, of vertices with these skinning weights.

    joints: of the rest pose. corrected: with the body's pose correctives, if it has some; weights
    are those of all vertices.
    """
    turns = Rotation.from_rotvec(np.asarray(poses.rotations)[frame].astype(float)).as_matrix()
    world, places = posed_tree(turns, bones_of(joints, body.parents), body.parents)
    offsets = places - np.einsum("jab,jb->ja", world, joints)
    moves = np.concatenate([world, offsets[..., None]], axis=-1)
    blended = (weights @ moves.reshape(len(moves), -1)).reshape(-1, 3, 4)
    linear = blended[..., :3]
    offset = blended[..., 3] + np.asarray(poses.translation)[frame].astype(float)
    if corrected and body.pose_directions is not None:
        correction = np.asarray(body.pose_directions) @ (turns[1:] - np.eye(3)).ravel()
        offset = offset + np.einsum("nab,nb->na", linear, correction)
    return linear, offset


def points_in_image(
    points: Float[np.ndarray, "p 3"],
    K: Float[np.ndarray, "3 3"],
    cam_from_world: Float[np.ndarray, "4 4"],
    width: int,
    height: int,
) -> Float[np.ndarray, "q 2"]:
    """Where a camera sees the points, pixels; those that it does not see are left out."""
    seen = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    seen = seen[seen[:, 2] > 1e-6]
    pixels = (K @ (seen / seen[:, 2:]).T)[:2].T
    return pixels[((pixels >= 0) & (pixels < (width, height))).all(axis=-1)]


def _sampling(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], count: int
) -> tuple[Int[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    areas = face_areas(vertices, faces)
    rng = np.random.default_rng(0)
    chosen = np.searchsorted(np.cumsum(areas), (np.arange(count) + 0.5) / count * areas.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return faces[np.minimum(chosen, len(faces) - 1)], np.stack([1 - u - v, u, v], axis=-1)


# Displacement
# --------------------------------------------------------------------------------------------------

STEP = 0.0025
"""Metres along a normal, of the search for a mask's edge."""
WEAKNESS = 0.002
"""Weight of no displacement, beside 1 for each photo that shows a vertex on the silhouette."""
HELD = 20.0
"""The same, for hands and head."""
HELD_JOINTS = ("head", "jaw", "eye", "wrist", "index", "middle", "pinky", "ring", "thumb")
NEAR = 2.5
"""Pixels. A vertex may be on the body's silhouette if it is no farther from the edge."""
PROBE = 0.012
"""Metres by which such a vertex is moved along its normal, to see whether it leaves the
silhouette.
"""
LEAVES = 0.6
"""It is on the silhouette if that move leaves it by this share of PROBE."""
DRAWN = 0.5
"""Pixels by which polygons are drawn larger than they are."""
WRAP = 0.07
"""At last, vertices outside a mask move inwards by up to so many metres, until all masks contain
them by the inset.
"""
WRAP_ROUNDS = 6
"""How often these moves are averaged over the neighbours."""
OUTSIDE = 0.01
"""Metres outside of a mask from which on a vertex counts as outside."""
MISFIT = 0.025
"""A body does not fit its masks if more than this share of its vertices (no head, no hands) lies
more than OUTSIDE outside of a mask. Clothes never cause that: of true bodies the share is 0. It was
at least 0.03 for bodies that are a centimetre off, 0.02 to 0.06 for a real man fitted to keypoints
alone, and at most 0.02 for his fits refined by the masks.
"""
LONGEST = 480
"""Pixels of the window around the person in which silhouettes are compared."""
MARGIN = 0.12
"""The room around the person, as a share of its height."""


Points = Float[np.ndarray, "n 3"]
Faces = Int[np.ndarray, "f 3"]
PerVertex = Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class OffsetFitConfig:
    """How a surface moves to the edges of the masks. The defaults are those of bodies: the network
    adds clothes on top, and knows naked ones.
    """

    outwards: float = 0.05
    """How far outwards along a normal a mask's edge is looked for, and the largest move, metres."""
    inwards: float = 0.06
    """The same inwards, metres."""
    smoothness: float = 0.03
    """The length over which a move spreads to the vertices around it, metres."""
    inset: tuple[float, float] = (0.005, 0.025)
    """The least and the most that the surface may lie inside the masks, metres."""
    iterations: int = 2
    """How often edges are looked for and the surface is moved."""


@dataclasses.dataclass(frozen=True)
class MaskedView:
    """One photo: the window around the person, and the body as it is posed there."""

    coverage: Float[np.ndarray, "h w"]
    """The share of each pixel that the person covers, (h, w), in [0, 1]."""
    project: Float[np.ndarray, "3 4"]
    """From the world in metres to homogeneous pixels of the window, (3, 4)."""
    linear: Float[np.ndarray, "n 3 3"]
    """The linear part of the move from the rest pose to the posed body, for each vertex, (n, 3, 3).
    """
    offset: Float[np.ndarray, "n 3"]
    """The offset of that move, (n, 3), metres."""
    low: Float[np.ndarray, "2"]
    """The least x and y in the window that count as in the photo, (2,), pixels: `NEAR` inside its
    corner.
    """
    high: Float[np.ndarray, "2"]
    """The largest x and y that do, (2,), pixels."""
    hidden: Float[np.ndarray, "h w"] | None = None
    """Where somebody may be in front, (h, w), in [0, 1]: the ends of masks say nothing there. None:
    nowhere.
    """

    @functools.cached_property
    def mask(self) -> Float[np.ndarray, "h w"]:
        """Signed distance to the edge of the mask, pixels."""
        return signed_distance(self.coverage).astype(np.float32)

    def seen(
        self, points: Float[np.ndarray, "*n 3"], index: np.ndarray | slice = slice(None)
    ) -> tuple:
        """Pixels (*n, 2) of points in the rest pose, pixels for a metre there, and which the photo
        shows.
        """
        posed = np.einsum("nab,n...b->n...a", self.linear[index], points)
        posed += self.offset[index].reshape(len(posed), *[1] * (points.ndim - 2), 3)
        clip = posed @ self.project[:, :3].T + self.project[:, 3]
        depth = np.maximum(clip[..., 2], 1e-3)
        pixels = clip[..., :2] / depth[..., None]
        within = (clip[..., 2] > 1e-3) & ((pixels > self.low) & (pixels < self.high)).all(-1)
        if self.hidden is not None:
            within &= at(self.hidden, pixels) < MASK_THRESHOLD
        return pixels, np.linalg.norm(self.project[0, :3]) / depth, within


def fit_vertex_offsets(
    body: BodyModel,
    capture: Capture,
    inset: tuple[float, float] = OffsetFitConfig.inset,
    *,
    always: bool = True,
) -> Float[np.ndarray, "n 3"]:
    """How far the vertices of the shaped body of a person move in the T-pose, metres, so that it
    fills the masks; bounded.

    Arguments: body: the capture's, or one of `data.views.gaussian_body`. capture: with masks;
    frames and worlds may be any.
    always: else 0 where the body fits the masks already, see `MISFIT`: it then gains less than the
    network's own clothes lose. Where masks say nothing, or nothing of the body is near them, it is
    0.
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
    """How far the vertices of a surface in the T-pose move along its normals to the masks' edges,
    smoothly.

    held: weight of no displacement, beside 1 for each photo that shows a vertex on the silhouette.
    """
    total = np.zeros_like(rest)
    for _ in range(reach.iterations):
        moved, normals = rest + total, unit(vertex_area_vectors(rest + total, faces))
        count, summed = _targets(views, moved, normals, faces, reach)
        total += _spread(moved, faces, count, summed, held, reach)[:, None] * normals
    return total


def shaped(body: BodyModel, betas: Float[np.ndarray, " s"]) -> Points:
    """The vertices of the person's body in the T-pose."""
    betas = np.asarray(betas, float)
    return (
        np.asarray(body.template, float)
        + np.asarray(body.shape_directions, float)[..., : len(betas)] @ betas
    )


def masked_views(body: BodyModel, rest: Points, capture: Capture) -> list[MaskedView]:
    """The views of a capture whose masks are not empty, cut to the person."""
    joints = np.asarray(body.joint_regressor, float) @ rest
    weights, views, posed = np.asarray(body.skinning_weights, float), [], {}
    assert capture.masks is not None
    empty = empty_views(capture.masks)
    for i, frame in enumerate(np.asarray(capture.frames).tolist()):
        mask = np.asarray(capture.masks[i])
        if i in empty:
            continue
        if frame not in posed:
            posed[frame] = skinned(body, joints, capture.poses, frame, weights, corrected=True)
        K = np.asarray(capture.cameras.K, float)[i]
        matrix = np.asarray(capture.cameras.cam_from_world, float)[i]
        if all(
            np.isfinite(x).all() for x in (rest, *posed[frame])
        ):  # whoever poses the body names what is not
            hidden = None
            if capture.unknown is not None:
                hidden = capture.unknown[i]
            views.append(_window(mask, hidden, K @ matrix[:3], *posed[frame]))
    return views


def _window(
    mask: Float[np.ndarray, "h w"],
    hidden: Bool[np.ndarray, "h w"] | None,
    project: Float[np.ndarray, "3 4"],
    linear: Float[np.ndarray, "n 3 3"],
    offset: Points,
) -> MaskedView:
    """Cuts a view to the person and brings it to one size.

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
    """The share of the free vertices that are `OUTSIDE` outside of a mask, or, if few are outside
    at all, the share of these.
    """

    def share(outside: Callable[[MaskedView, np.ndarray, np.ndarray], np.ndarray]) -> float:
        found = np.zeros(len(rest), bool)
        for view in views:
            pixels, per_metre, within = view.seen(rest)
            found |= within & outside(view, pixels, per_metre)
        if free.any():
            return float(found[free].mean())
        return 0.0

    few = share(
        lambda view, pixels, _: at(view.coverage, pixels) < MASK_THRESHOLD
    )  # needs no distances
    if few < MISFIT:
        return few
    return share(lambda view, pixels, scale: at(view.mask, pixels) < -OUTSIDE * scale)


def _targets(
    views: list[MaskedView], rest: Points, normals: Points, faces: Faces, how: OffsetFitConfig
) -> tuple[PerVertex, PerVertex]:
    """For each vertex the number of photos that show it on the silhouette, and the sum of the
    distances to the masks' edges.
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
    """Where the mask ends along each normal, nearest to its start: outwards from the inside,
    inwards from the outside.
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
    """Signed distance to the edge of the silhouette of a surface, pixels; positive inside."""
    a, b, c = np.moveaxis(pixels[faces], 1, 0)
    turn = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    return (
        signed_distance(silhouette(pixels, faces[turn < 0], shape)) - DRAWN
    )  # the side that faces the camera covers all


def silhouette(
    pixels: Float[np.ndarray, "n 2"], faces: Faces, shape: tuple[int, ...]
) -> Float[np.ndarray, "h w"]:
    """1 where triangles lie, larger by `DRAWN` than they are."""
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
    """The smooth displacement that is nearest to the targets."""
    areas = np.maximum(vertex_areas(vertices, faces), 1e-9)
    laplacian = _laplacian(vertices, faces)
    bending = reach.smoothness**4 * laplacian.T @ sparse.diags(1 / areas) @ laplacian
    matrix = sparse.diags(areas * (WEAKNESS + count + held)) + bending
    return np.clip(splu(matrix.tocsc()).solve(areas * summed), -reach.inwards, reach.outwards)


def _laplacian(vertices: Points, faces: Faces) -> sparse.csr_array | sparse.csr_matrix:
    """By the cotangents of the angles, none of them negative."""
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
    """How far each vertex moves inwards until all masks contain it, smoothly."""
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
    """Bilinear; pixel centres at + 0.5."""
    x, y = pixels[..., 0] - 0.5, pixels[..., 1] - 0.5
    return ndimage.map_coordinates(image, [y, x], order=1, mode="nearest", prefilter=False)
