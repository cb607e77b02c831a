"""Adds a skirt to a body: a tube of vertices around both legs, where the photos show cloth between
them.

Each leg of a body is a tube, and no vertex spans the gap between the legs. On a body alone, a long
skirt becomes a pair of ragged trousers. Each vertex of the skirt is a linear combination of
vertices of the legs. Its shape directions, pose directions and skinning weights are combined with
the same weights. A vertex in the gap combines one point on each leg, so that the skirt bends
smoothly between them. A row of the skirt follows the outer halves of both legs, and is straight
between them. From there the vertices are displaced along their normals to the edges of the masks,
as the body is (`data.vertex_offsets`).

Points between the legs that a photo shows beside both legs are compared with the masks. If enough
of them lie inside the masks, there is a skirt. It ends above the first row whose points lie outside
the masks. If no photo shows such points, there is no skirt. All of this runs on the host, by numpy
and scipy.
"""

import jax
import numpy as np
from scipy import sparse

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import (
    MASK_THRESHOLD,
    empty_views,
    shaped,
    skinned,
)
from humangs_jax.data.capture import Capture
from humangs_jax.data.vertex_offsets import (
    OffsetFitConfig,
    Points,
    at,
    masked_views,
    to_edges,
)
from humangs_jax.geometry.mesh import vertex_areas

LEGS = (("left_hip", "left_knee", "left_ankle"), ("right_hip", "right_knee", "right_ankle"))
TRUNK = ("pelvis", "spine1")
TOP = 0.08
"""The height where a skirt begins: 0 at the hips, 0.5 at the knees, 1 at the ankles. Above it the
body itself surrounds both legs.
"""
BOTTOM = 0.97
"""The lowest height where a skirt may end, in the measure of `TOP`."""
ROWS = 28
"""The number of rows of a skirt. All skirts have this number, so that they share one compiled
program.
"""
GAP = 11
"""Number of vertices of a row in each of the two gaps between the legs, in front and behind."""
HALF = 13
"""Number of vertices of a row on the outer half of each leg."""
SKIRT_VERTICES = ROWS * 2 * (GAP + HALF)
"""Number of vertices of a skirt. They are the last ones of a body that has a skirt."""
BESIDE = 0.02
"""A point between the legs counts only if it is farther than this from the skin of both legs in the
photo, metres. Trousers may stand off from the skin by this much.
"""
SHOWN = 0.8
"""A row that is judged (see `VOTES`) shows cloth if at least this share of its counted points is
inside the masks.
"""
VOTES = 4
"""A row is judged if at least this many of its points count, in all photos together."""
LEAST_ROWS = 4
"""The least number of rows of a skirt that have a point inside a mask and farther than `CLEAR` from
the skin of both legs. Wide trousers have fewer, and would look worse with a skirt.
"""
CLEAR = 0.06
"""A point that is farther than this from the skin of both legs is certainly cloth of a skirt,
metres, see `LEAST_ROWS`.
"""
LONG_CLEAR = 0.1
"""Distance that is used in place of `CLEAR` if the photos show no end of the cloth above `BOTTOM`,
metres.
"""
REACH = OffsetFitConfig(outwards=0.22, smoothness=0.06, inset=(0.0, 0.03), iterations=3)
HELD = 1e4
"""Weight that keeps the body's vertices where they are in the fit of the skirt."""


def add_skirt(
    body: BodyModel, capture: Capture, displacement: Float[np.ndarray, "n 3"]
) -> tuple[BodyModel, Float[np.ndarray, "m 3"]] | None:
    """Returns the body with a skirt, and the displacement of all its vertices, metres; None if the
    photos show no skirt, or if the body has a map of its surface.

    Arguments: body: one of `data.views.gaussian_body`; its vertices come first in the result.
    capture: has masks. displacement: that of the vertices of `body`, (n, 3), metres.
    """
    # a map of the surface has no place for it
    if body.texels is not None:
        return None
    hem = find_hem(body, capture)
    if hem is None:
        return None
    worn, count = with_tube(body, hem), len(body.template)

    # the skirt moves to the edges of the masks, and the body stays where it is
    rest, faces = shaped(worn, capture.betas), np.asarray(worn.faces)
    moved = np.concatenate([displacement, np.zeros((len(rest) - count, 3))])
    held = np.where(np.arange(len(rest)) < count, HELD, 0.0)
    views = masked_views(worn, rest, capture)
    moved[count:] = to_edges(views, rest + moved, faces, held, REACH)[count:]

    # how far its vertices are apart, beside those of the body
    sides = np.sqrt(vertex_areas(rest + moved, faces))
    if body.relative_vertex_spacing is None:
        own = np.ones(count)
    else:
        own = np.asarray(body.relative_vertex_spacing)
    spacing = np.concatenate([own, sides[count:] / np.median(sides[:count] / own)])
    return replace(
        worn, relative_vertex_spacing=from_host(spacing, body.template.dtype)
    ), moved.astype(np.float32)


def find_hem(body: BodyModel, capture: Capture) -> float | None:
    """Returns the height down to which the photos show a skirt, in the measure of `TOP`, from `TOP`
    to `BOTTOM`. Returns None if they show no skirt, if there are no masks, or if the body has no
    legs that hang in the T-pose.
    """
    legs = _legs(body)
    if legs is None or capture.masks is None:
        return None
    # where to look: points between the legs at several heights
    levels, rest = np.linspace(TOP, BOTTOM, ROWS), shaped(body, capture.betas)
    joints = np.asarray(body.joint_regressor, float) @ rest
    radii = _radii(body, rest, joints, legs, levels)
    shares = np.arange(1, GAP + 1)[:, None] / (GAP + 1)
    asked, shown, clear = np.zeros((3, ROWS))
    cameras, empty = jax.tree.map(np.asarray, capture.cameras), empty_views(capture.masks)
    # each view votes on the points that it sees apart from both legs
    for i in [i for i in range(capture.view_count) if i not in empty]:
        linear, offset = skinned(
            body, joints, capture.poses, int(capture.frames[i]), np.eye(len(joints))
        )
        axes = _along(np.einsum("jab,jb->ja", linear, joints) + offset, legs, levels)
        between = (1 - shares) * axes[0][:, None] + shares * axes[1][:, None]
        # where the points and the axes of the legs are in the photo
        project = cameras.K[i] @ cameras.cam_from_world[i, :3]
        points, sides = (
            x.reshape(-1, 3) @ project[:, :3].T + project[:, 3] for x in (between, axes)
        )
        if min(points[:, 2].min(), sides[:, 2].min()) <= 0:
            continue
        pixels, centers = points[:, :2] / points[:, 2:], sides[:, :2] / sides[:, 2:]
        focal = float(cameras.K[i, 0, 0])
        # how far each point is from the skin of the nearest leg, metres
        distances = (
            np.linalg.norm(pixels[:, None] - centers, axis=-1) - radii.ravel() * focal / sides[:, 2]
        )
        apart = distances.min(axis=1) * points[:, 2] / focal
        height, width = capture.masks[i].shape
        framed = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)
        beside = framed & (apart > BESIDE)
        inside = beside & (at(capture.masks[i], pixels) > MASK_THRESHOLD)
        # a point between the legs that lies on the mask is cloth
        asked += beside.reshape(ROWS, -1).sum(axis=1)
        shown += inside.reshape(ROWS, -1).sum(axis=1)
        clear = np.maximum(clear, np.where(inside, apart, 0).reshape(ROWS, -1).max(axis=1))
    # the skirt goes down to the first height that the votes are against
    decided = asked >= VOTES
    skirt = decided & (shown >= SHOWN * asked)
    ends = np.flatnonzero(decided & ~skirt)
    rows = np.flatnonzero(skirt[: ends[0] if len(ends) else ROWS])
    # wide trousers look like a skirt, so some cloth must be well clear of both legs
    certain = clear[rows] > (CLEAR if len(ends) else LONG_CLEAR)
    if np.count_nonzero(certain) >= LEAST_ROWS:
        return float(levels[rows[-1]])
    return None


def with_tube(body: BodyModel, hem: float) -> BodyModel:
    """Returns the body with a tube around its legs, from `TOP` down to `hem`, in the measure of
    `TOP`. The tube's vertices come after those of the body.

    Raises: ValueError if the body has no legs that hang in the T-pose, or if its skin is not around
    the lines from hip to knee to ankle.
    """
    # each vertex of the tube combines vertices of the body, and so does all that belongs to it
    combined = _tube(body, np.linspace(TOP, hem, ROWS))
    names = ("template", "shape_directions", "pose_directions", "skinning_weights")
    values = {name: getattr(body, name) for name in names}
    linear = {name: np.asarray(value) for name, value in values.items() if value is not None}
    for name, own in linear.items():
        added = (combined @ own.reshape(len(own), -1)).reshape(-1, *own.shape[1:])
        linear[name] = np.concatenate([own, added.astype(own.dtype)])
    # two triangles for each square of the tube
    added, loop = combined.shape[0], 2 * (GAP + HALF)
    upper = np.arange(added).reshape(ROWS, loop)[:-1]
    following, lower = np.roll(upper, -1, axis=1), loop
    corners = [(upper, following, upper + lower), (following, following + lower, upper + lower)]
    tube = np.concatenate([np.stack(each, axis=-1).reshape(-1, 3) for each in corners])
    # joints stay where they are
    regressor = np.pad(np.asarray(body.joint_regressor), ((0, 0), (0, added)))
    spacing = None
    if body.relative_vertex_spacing is not None:
        spacing = from_host(
            np.pad(np.asarray(body.relative_vertex_spacing), (0, added), constant_values=1)
        )
    return replace(
        body,
        **{name: from_host(x) for name, x in linear.items()},
        faces=from_host(
            np.concatenate([np.asarray(body.faces), len(body.template) + tube]), body.faces.dtype
        ),
        joint_regressor=from_host(regressor),
        relative_vertex_spacing=spacing,
        uvs=None,
        uv_faces=None,
        collapse_order=None,
        collapse_into=None,
    )


def _legs(body: BodyModel) -> Int[np.ndarray, "2 3"] | None:
    """Returns the joints of the legs, (2, 3): hip, knee and ankle of each; None if the legs do not
    hang in the T-pose.
    """
    names = list(body.joint_names)
    if not all(name in names for leg in LEGS for name in leg):
        return None
    legs = np.asarray([[names.index(name) for name in leg] for leg in LEGS])
    heights = (np.asarray(body.joint_regressor) @ np.asarray(body.template))[legs, 1]
    return legs if (np.diff(heights) < 0).all() else None


def _along(
    joints: Float[np.ndarray, "j 3"], legs: Int[np.ndarray, "2 3"], levels: Float[np.ndarray, " r"]
) -> Float[np.ndarray, "2 r 3"]:
    """Returns points on each leg's line from hip to knee to ankle, (2, r, 3), metres. levels: the
    heights of the points, in the measure of `TOP`.
    """
    lines = np.zeros((len(legs), len(levels), 3))
    for side, leg in enumerate(legs):
        for axis in range(3):
            lines[side, :, axis] = np.interp(levels, [0, 0.5, 1], joints[leg, axis])
    return lines


def _radii(
    body: BodyModel,
    rest: Points,
    joints: Float[np.ndarray, "j 3"],
    legs: Int[np.ndarray, "2 3"],
    levels: Float[np.ndarray, " r"],
) -> Float[np.ndarray, "2 r"]:
    """Returns the mean horizontal distance between the skin of each leg and the leg's line at each
    height, (2, r), metres. A vertex of the skin counts at the nearest height only, see `_along`.
    """
    lines = _along(joints, legs, levels)
    radii = np.zeros(lines.shape[:2])
    for side, leg in enumerate(legs):
        own = rest[np.asarray(body.skinning_weights)[:, leg].sum(axis=1) > 0.5]
        row = np.abs(own[:, 1, None] - lines[side, :, 1]).argmin(axis=1)
        distances = np.linalg.norm((own - lines[side, row])[:, [0, 2]], axis=1)
        radii[side] = np.bincount(row, distances, ROWS) / np.maximum(
            np.bincount(row, minlength=ROWS), 1
        )
    return radii


def _tube(body: BodyModel, levels: Float[np.ndarray, " r"]) -> sparse.csr_array:
    """Returns a matrix (r * loop, n) that computes the vertices of a tube from the vertices of the
    body. Each of the r rows of the tube is a closed loop.

    A loop goes over the front from the left to the right, around the right leg, over the back, and
    around the left leg.
    """
    legs = _legs(body)
    if legs is None:
        raise ValueError(f"body: expected joints {LEGS}, each below the one before")
    vertices, faces = np.asarray(body.template, float), np.asarray(body.faces)
    joints = np.asarray(body.joint_regressor, float) @ vertices
    names = [name for leg in LEGS for name in leg] + list(TRUNK)
    of_legs = [name in names for name in body.joint_names]
    own = np.asarray(body.skinning_weights)[:, of_legs].sum(axis=1) > 0.5
    faces = faces[own[faces].all(axis=1)]  # no hands

    # directions from the left leg, from the back over the left to the front
    turns = np.linspace(0, np.pi, HALF)
    outwards = np.stack([np.sin(turns), 0 * turns, -np.cos(turns)], axis=1)
    shares = np.arange(1, GAP + 1) / (GAP + 1)
    loops = []
    for origins in np.moveaxis(_along(joints, legs, levels), 1, 0):
        left, right = (
            _farthest(vertices, faces, origins[i], way * outwards)
            for i, way in enumerate((1.0, -1.0))
        )

        def gap(a, b):
            return sparse.csr_array((1 - shares)[:, None] * a + shares[:, None] * b)

        loops += [gap(left[[-1]], right[[0]]), right, gap(right[[-1]], left[[0]]), left]
    return sparse.vstack(loops, format="csr")


def _farthest(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    origin: Float[np.ndarray, "3"],
    rays: Float[np.ndarray, "r 3"],
) -> sparse.csr_array:
    """Returns the last point of a surface along each horizontal ray, in barycentric coordinates: a
    matrix (r, n) of weights of the vertices.

    A ray meets the triangle (v0, v1, v2) where origin + t ray = (1 - u - v) v0 + u v1 + v v2. By
    Cramer's rule

        t = (qvec . edge2) / det,    u = (pvec . tvec) / det,    v = (qvec . ray) / det,

    with edge1 = v1 - v0, edge2 = v2 - v0, tvec = origin - v0, pvec = ray x edge2,
    qvec = tvec x edge1 and det = pvec . edge1.

    Names as in the paper: Moller and Trumbore 1997, "Fast, minimum storage ray-triangle
    intersection", https://doi.org/10.1080/10867651.1997.10487468.

    Raises: ValueError where a ray does not meet the surface.
    """
    # only triangles at the height of the rays can be met
    heights = vertices[faces, 1]
    faces = faces[(heights.min(axis=1) <= origin[1]) & (heights.max(axis=1) >= origin[1])]

    # t, u and v of each ray and triangle, (r, f)
    v0, v1, v2 = np.moveaxis(vertices[faces], 1, 0)
    edge1, edge2 = v1 - v0, v2 - v0
    pvec = np.cross(rays[:, None], edge2)
    det = (pvec * edge1).sum(-1)
    # a ray parallel to a triangle has t = 0, so it does not meet it
    inv_det = 1 / np.where(np.abs(det) < 1e-15, np.inf, det)
    tvec = origin - v0
    u = (pvec * tvec).sum(-1) * inv_det
    qvec = np.cross(tvec, edge1)
    v = rays @ qvec.T * inv_det
    t = (qvec * edge2).sum(-1) * inv_det
    hit = (u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (t > 0)
    if not hit.any(axis=1).all():
        raise ValueError(
            "body: expected legs whose skin is around the lines from hip to knee to ankle"
        )

    # each ray's farthest triangle, and its vertices' weights
    ray = np.arange(len(rays))
    last = np.argmax(np.where(hit, t, -np.inf), axis=1)
    u, v = u[ray, last], v[ray, last]
    weights = np.stack([1 - u - v, u, v], axis=1)
    return sparse.csr_array(
        (weights.ravel(), (ray.repeat(3), faces[last].ravel())), (len(rays), len(vertices))
    )
