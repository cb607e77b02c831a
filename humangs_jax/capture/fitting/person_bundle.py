"""Finds cameras around a person from landmarks alone. A start is computed from the detector's 3D
landmarks, and bundle adjustment follows.

For one photo, a detector gives landmarks in metres in the axes of the photo's camera, as if the
camera looked straight at the person. Their depths are guesses, 5 to 10 cm off, and the landmarks as
a whole are turned by up to 20 degrees. The start consists of the rotations that bring the landmarks
of all photos together (generalised Kabsch: Gower 1975, https://doi.org/10.1007/BF02291478), and of
the positions at which they project to their pixels. Bundle adjustment then mainly uses the pixels.
The 3D landmarks keep the size, and decide what pixels leave open.

The cost is half the sum of the squares of these residuals, with X = R_v L_k, p = X + t_v, u = (p_x,
p_y) / p_z:

    pixels  sqrt(w) rho((f_v u - x) / noise_v)       rho(q) = q s / sqrt(s^2 + |q|^2), Geman and
                                                     McClure
    world   sqrt(w) (X - mean_v(X) - W) / std        W: the detector's 3D landmarks; means are
                                                     weighted by w
    size    (log r(X) - log r(W)) / std              r: the root of the sum over the views of the
                                                     weighted mean square distance from the mean
    bones   (|left bone| - |right bone|) / std
    focal   y_g, with f_v = f0_v exp(std_v y_g)      one y for each kind of camera, and
                                                     std_v = `Evidence.focal_std`

The std of world, size and bones are the fields of `STD`.

A pixel depends on one landmark, one camera and one y. So the landmarks can be eliminated (Schur
complement: Triggs et al. 2000, "Bundle adjustment: a modern synthesis", section 6.1), which leaves
a small system of equations for the cameras.

All of this runs on the host in float64, because JAX would compile another program for every number
of photos.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.core.array_types import Float, Int

NEAR = 0.05
"""Smallest depth, metres. Smaller depths are clamped to it."""


@dataclasses.dataclass(frozen=True)
class _Std:
    """Standard deviations of all evidence except the pixels."""

    world: float = 0.15
    """Standard deviation of the detector's 3D landmarks, metres. It includes errors that all
    landmarks share, so that pixels decide where several views see a landmark.
    """
    bones: float = 0.01
    """Standard deviation of the difference between the lengths of a left bone and its right
    partner, metres.
    """
    size: float = 0.01
    """Standard deviation of the logarithm of the person's size, relative to the size of the
    detector's 3D landmarks. This keeps the scale.
    """


STD = _Std()


ROBUST_SCALES = (40.0, 6.0)
"""Robust scales of pixels, in standard deviations. The solver runs once with each, in this order.
The first is large because the start is off by tens of standard deviations.
"""
EXACT = 1e-9
"""Tolerance of the solver for final results. It stops when a step decreases the cost by less than
this share.
"""
COARSE = 1e-3
"""Tolerance of the solver if costs are only compared. It stops when a step decreases the cost by
less than this share.
"""
_STILL = 1e-6
"""Number that is added to the diagonal of the normal equations. Unknowns on which no residual
depends then stay as they are.
"""
_FURTHEST = 5.0
"""Largest absolute change of the logarithm of a depth in one step, and of the logarithm of a focal
length from its start.
"""
VIEW = 9
"""Number of unknowns of a view: 3 for the rotation, 3 for the position, and 3 for the mean of its
rotated landmarks.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """The landmarks of a person in c photos, and what is known about the cameras."""

    points: Float[np.ndarray, "c k 2"]
    """Detected landmarks relative to the principal point, (c, k, 2), pixels."""
    weights: Float[np.ndarray, "c k"]
    """Weights of the landmarks, (c, k). 0 where a landmark is not seen."""
    noise: Float[np.ndarray, " c"]
    """Standard deviation of the detections, (c,), pixels."""
    world: Float[np.ndarray, "c k 3"]
    """The detector's 3D landmarks in the axes of each camera, relative to their weighted mean and
    scaled to one size, (c, k, 3), metres.
    """
    focal: Float[np.ndarray, " c"]
    """Focal lengths to begin with, (c,), pixels."""
    focal_std: Float[np.ndarray, " c"]
    """Standard deviations of the logarithms of the focal lengths, (c,)."""
    kinds: Int[np.ndarray, " c"]
    """Kind of each camera, (c,), from 0. The focal lengths of cameras of one kind change by a
    common unknown.
    """
    bones: Int[np.ndarray, "b 2 2"]
    """Indices of the landmarks at the ends of bones, (b, 2, 2). Axes are the bone, its side (left,
    right) and its end.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Rig:
    """A person's landmarks, and c cameras around the person."""

    landmarks: Float[np.ndarray, "k 3"]
    """Landmarks of the person, (k, 3), metres."""
    rotations: Float[np.ndarray, "c 3 3"]
    """Rotations from the landmarks' axes to each camera's axes, (c, 3, 3)."""
    places: Float[np.ndarray, "c 3"]
    """Position of the landmarks' origin in the axes of each camera, (c, 3), metres."""
    focal: Float[np.ndarray, " c"]
    """Focal lengths, (c,), pixels."""


# The start
# --------------------------------------------------------------------------------------------------


def align_views(
    worlds: Float[np.ndarray, "c k 3"], weights: Float[np.ndarray, "c k"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "c 3 3"]]:
    """Returns the mean of the landmarks of all views after they were rotated onto each other, (k,
    3), metres, and the rotations from this mean to the axes of each view, (c, 3, 3). The method is
    generalised Kabsch.
    """
    shape = worlds[int(np.argmax(weights.sum(1)))]
    rotations = np.tile(np.eye(3), (len(worlds), 1, 1))
    if len(worlds) == 1:
        return shape, rotations
    total = np.maximum(weights.sum(0), 1e-9)[:, None]
    # alternations of turns and mean shape: a mean of ten photos is still by then
    for _ in range(20):
        rotations = _turns_onto(shape, worlds, weights)
        shape = np.einsum("ck,cba,ckb->ka", weights, rotations, worlds) / total
    return shape, rotations


def _turns_onto(
    shape: Float[np.ndarray, "k 3"],
    worlds: Float[np.ndarray, "c k 3"],
    weights: Float[np.ndarray, "c k"],
) -> Float[np.ndarray, "c 3 3"]:
    """Returns the rotations, (c, 3, 3), that best map a shape onto the landmarks of each view
    (Kabsch 1976). If the points lie on a line, several rotations are best, and one of them is
    returned.
    """
    share = weights / weights.sum(1, keepdims=True)
    source = shape - (share @ shape)[:, None]
    target = worlds - np.einsum("ck,cka->ca", share, worlds)[:, None]
    u, _, vt = np.linalg.svd(np.einsum("ck,cka,ckb->cab", share, target, source))
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt


def place_person(
    points: Float[np.ndarray, "k 2"],
    weights: Float[np.ndarray, " k"],
    offsets: Float[np.ndarray, "k 3"],
    focal: float,
) -> Float[np.ndarray, "3"]:
    """Returns the position at which landmarks project to their pixels, (3,), metres.

    Let (x, y) be a pixel divided by the focal length, (X, Y, z) the landmark's offset, and t the
    position. Then x (z + t_z) = X + t_x and y (z + t_z) = Y + t_y, which is linear in t.

    Another depth follows from the person's size in the photo. If the two depths differ by more than
    a factor of 3, the position is computed with the depth from the size.

    points: (k, 2), pixels from the principal point. weights: (k,). offsets: landmarks relative to
    the position, in the camera's axes, (k, 3), metres. focal: focal length, pixels.
    """
    xy = points / focal
    rows = np.zeros((*xy.shape, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[..., 2] = -xy
    right = xy * offsets[:, 2:] - offsets[:, :2]
    w = np.sqrt(weights)[:, None]
    matrix = (w[..., None] * rows).reshape(-1, 3)
    place = np.linalg.lstsq(matrix, (w * right).ravel(), rcond=None)[0]
    share = weights / weights.sum()

    def spread(p: Float[np.ndarray, "k 2"]) -> float:
        """Returns the weighted root mean square distance of points from their weighted mean."""
        return float(np.sqrt(share @ np.sum((p - share @ p) ** 2, axis=1)))

    # by the size: farther away the person is smaller in the photo
    distance = spread(offsets[:, :2]) / max(spread(xy), 1e-9)
    if distance / 3 < place[2] < 3 * distance:
        return place
    return np.asarray([*(share @ (xy * distance - offsets[:, :2])), distance])


# Residuals
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Rows:
    """The residuals of a rig, in standard deviations."""

    seen: Float[np.ndarray, "c k 5"]
    """Residuals of pixels (2) and of 3D landmarks (3) for each landmark in each view, (c, k, 5)."""
    tied: Float[np.ndarray, " t"]
    """Residuals of size and bones, (t,). Each depends on several landmarks."""
    focal: Float[np.ndarray, " g"]
    """Residuals of the focal lengths: y of each kind of camera, (g,)."""

    @property
    def cost(self) -> float:
        """Half the sum of the squares of all residuals."""
        return 0.5 * float(np.sum(self.seen**2) + np.sum(self.tied**2) + np.sum(self.focal**2))


@dataclasses.dataclass(frozen=True, eq=False)
class Derivatives:
    """Derivatives of `Rows` by the unknowns of a `Step`.

    The derivatives of `Rows.focal` by y are 1.
    """

    by_landmark: Float[np.ndarray, "c k 5 3"]
    """Derivatives of each row of `seen` by its landmark, (c, k, 5, 3)."""
    by_view: Float[np.ndarray, "c k 5 9"]
    """Derivatives of each row of `seen` by rotation, position and mean of its view, (c, k, 5,
    9).
    """
    by_focal: Float[np.ndarray, "c k 5"]
    """Derivatives of each row of `seen` by the y of its camera's kind, (c, k, 5)."""
    tied: Float[np.ndarray, "t k 3"]
    """Derivatives of `tied` by all landmarks, (t, k, 3)."""


def pixel_errors(evidence: Evidence, rig: Rig) -> Float[np.ndarray, "c k 2"]:
    """Returns projected minus detected landmarks, (c, k, 2), pixels."""
    seen = _turned(rig) + rig.places[:, None]
    slopes = seen[..., :2] / np.maximum(seen[..., 2:], NEAR)
    return rig.focal[:, None, None] * slopes - evidence.points


def residuals(evidence: Evidence, rig: Rig, scale: float) -> Rows:
    """Returns the residuals of a rig.

    scale: scale of the robust loss (Geman-McClure) of pixel errors, in standard deviations of the
    detections. No residual of a pixel exceeds it.
    """
    root, turned = np.sqrt(evidence.weights)[..., None], _turned(rig)
    errors = pixel_errors(evidence, rig) / evidence.noise[:, None, None]
    errors = errors * scale / np.sqrt(scale**2 + np.sum(errors**2, axis=-1, keepdims=True))
    share = _shares(evidence)
    centered = turned - np.sum(share * turned, axis=1, keepdims=True)

    def log_radius(points: Float[np.ndarray, "c k 3"]) -> float:
        return 0.5 * np.log(np.sum(share * points**2) + 1e-12)

    size = (log_radius(centered) - log_radius(evidence.world)) / STD.size
    lengths = np.linalg.norm(_bones(evidence, rig), axis=-1)
    return Rows(
        seen=np.concatenate(
            [root * errors, root * (centered - evidence.world) / STD.world], axis=-1
        ),
        tied=np.append(size, (lengths[:, 0] - lengths[:, 1]) / STD.bones),
        focal=_factors(evidence, rig),
    )


def derivatives(evidence: Evidence, rig: Rig, scale: float) -> Derivatives:
    """Returns the derivatives of `residuals`, with one change: the mean of a view's landmarks,
    which `residuals` computes, is a separate unknown. The minimum is the same.
    """
    root, turned = np.sqrt(evidence.weights)[..., None, None], _turned(rig)
    c, k = evidence.weights.shape
    by_turn = -_cross(turned)  # a small turn by w moves X by w x X

    # d p / d place, for the changes of `moved`: sideways over the depth twice, and the logarithm of
    # the depth
    by_place = np.zeros((c, 3, 3))
    by_place[:, 0, 0] = by_place[:, 1, 1] = rig.places[:, 2]
    by_place[:, :, 2] = rig.places

    # d e / d p of e = f (p_x, p_y) / p_z - x; a clamped depth is a constant
    p = turned + rig.places[:, None]
    depth = np.maximum(p[..., 2], NEAR)
    by_point = np.zeros((c, k, 2, 3))
    by_point[..., 0, 0] = by_point[..., 1, 1] = 1 / depth
    by_point[..., 2] = np.where(p[..., 2:] > NEAR, -p[..., :2] / depth[..., None] ** 2, 0.0)
    by_point *= rig.focal[:, None, None, None]

    # d rho / d q = s / sqrt(s^2 + |q|^2) (1 - q q^T / (s^2 + |q|^2))
    q = pixel_errors(evidence, rig) / evidence.noise[:, None, None]
    square = (scale**2 + np.sum(q**2, axis=-1))[..., None, None]
    by_error = (
        root * scale / np.sqrt(square) * (np.eye(2) - q[..., :, None] * q[..., None, :] / square)
    )
    by_error /= evidence.noise[:, None, None, None]

    # a view's mean is an unknown, so the world residual depends on turn and mean, and not on place
    pixels = by_error @ by_point
    world = np.broadcast_to(root * np.eye(3) / STD.world, (c, k, 3, 3))
    none = np.zeros((c, k, 2, 3))
    zoom = evidence.focal_std[:, None, None] * (pixel_errors(evidence, rig) + evidence.points)
    by_focal = np.concatenate([(by_error @ zoom[..., None])[..., 0], np.zeros((c, k, 3))], axis=-1)
    by_own = np.concatenate([pixels, world], axis=2)
    by_view = [
        by_own @ by_turn,
        np.concatenate([pixels @ by_place[:, None], 0 * world], 2),
        np.concatenate([none, -world], 2),
    ]
    return Derivatives(
        by_landmark=by_own @ rig.rotations[:, None],
        by_view=np.concatenate(by_view, axis=-1),
        by_focal=by_focal,
        tied=_tied(evidence, rig, turned),
    )


def _tied(
    evidence: Evidence, rig: Rig, turned: Float[np.ndarray, "c k 3"]
) -> Float[np.ndarray, "t k 3"]:
    """Returns the derivatives of the residuals of size and bones by all landmarks, (t, k, 3).

    Before the division by `STD` they are d log r / d L = the sum over views of share R^T (X - mean)
    / r^2, and for bones d |a - b| / d a = (a - b) / |a - b|.
    """
    share = _shares(evidence)
    centered = turned - np.sum(share * turned, axis=1, keepdims=True)
    square = np.sum(share * centered**2) + 1e-12
    size = np.sum((share * centered) @ rig.rotations, axis=0) / square / STD.size
    bones = np.zeros((len(evidence.bones), *rig.landmarks.shape))
    vectors = _bones(evidence, rig)
    unit = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9) / STD.bones
    rows = np.arange(len(bones))
    for side, sign in ((0, 1.0), (1, -1.0)):
        bones[rows, evidence.bones[:, side, 0]] += sign * unit[:, side]
        bones[rows, evidence.bones[:, side, 1]] -= sign * unit[:, side]
    return np.concatenate([size[None], bones])


def _shares(evidence: Evidence) -> Float[np.ndarray, "c k 1"]:
    return (evidence.weights / evidence.weights.sum(axis=1, keepdims=True))[..., None]


def _turned(rig: Rig) -> Float[np.ndarray, "c k 3"]:
    return rig.landmarks @ np.swapaxes(rig.rotations, -1, -2)


def _bones(evidence: Evidence, rig: Rig) -> Float[np.ndarray, "b 2 3"]:
    ends = rig.landmarks[evidence.bones]
    return ends[:, :, 0] - ends[:, :, 1]


def _factors(evidence: Evidence, rig: Rig) -> Float[np.ndarray, " g"]:
    """Returns the y of each kind of camera, (g,). It is computed from one camera of the kind."""
    factors = np.zeros(1 + int(evidence.kinds.max()))
    factors[evidence.kinds] = np.log(rig.focal / evidence.focal) / evidence.focal_std
    return factors


def _cross(x: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Returns the matrix of the cross product with each vector, (..., 3, 3): `_cross(a) @ b` is
    `np.cross(a, b)`.
    """
    out = np.zeros((*x.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -x[..., 2], x[..., 1], -x[..., 0]
    return out - np.swapaxes(out, -1, -2)


# Adjustment
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """A change of all unknowns of a rig."""

    landmarks: Float[np.ndarray, "k 3"]
    """Shifts of the landmarks, (k, 3), metres."""
    views: Float[np.ndarray, "c 9"]
    """Changes of the views, (c, 9): rotation (3, radians), position (3), and the mean of the view
    (3), which follows from the other changes. The three numbers of the position are the changes of
    x / depth, y / depth, and log(depth).
    """
    focal: Float[np.ndarray, " g"]
    """Changes of the y of each kind of camera, (g,)."""


def moved(evidence: Evidence, rig: Rig, step: Step) -> Rig:
    """Returns the rig after a step."""
    turns, sideways = step.views[:, :3], step.views[:, 3:5]
    deeper = np.clip(step.views[:, 5:6], -_FURTHEST, _FURTHEST)
    depth = rig.places[:, 2:] * np.exp(deeper)  # never behind the camera
    factors = (_factors(evidence, rig) + step.focal)[evidence.kinds]
    aside = (rig.places[:, :2] / rig.places[:, 2:] + sideways) * depth
    return Rig(
        landmarks=rig.landmarks + step.landmarks,
        rotations=Rotation.from_rotvec(turns).as_matrix() @ rig.rotations,
        places=np.concatenate([aside, depth], axis=1),
        focal=evidence.focal * np.exp(np.clip(evidence.focal_std * factors, -_FURTHEST, _FURTHEST)),
    )


def adjust(
    evidence: Evidence,
    start: Rig,
    tolerance: float = EXACT,
    scales: Sequence[float] = ROBUST_SCALES,
) -> tuple[Rig, float]:
    """Runs bundle adjustment (Levenberg-Marquardt). Returns the rig, and its cost with the last
    robust scale.

    Arguments: tolerance: the solver stops when a step decreases the cost by less than this share.
    scales: robust scales of pixels, in standard deviations. The solver runs once with each, in this
    order.
    """
    rig, cost = start, np.inf
    for scale in scales:
        rig, cost = _descend(evidence, rig, scale, tolerance)
    return rig, cost


def _descend(evidence: Evidence, rig: Rig, scale: float, tolerance: float) -> tuple[Rig, float]:
    """Minimises the cost with one robust scale. Returns the rig and its cost.

    The damping follows Nielsen 1999, as in Madsen, Nielsen and Tingleff 2004, algorithm 3.16.
    """
    rows = residuals(evidence, rig, scale)
    normal = normal_equations(evidence, rows, derivatives(evidence, rig, scale))
    # the share of the diagonal of the normal equations that is added to it at first
    damping, growth = 1e-3, 2.0
    # steps of Levenberg and Marquardt at most, rejected ones included
    for _ in range(60):
        step, expected = solve(normal, damping)
        trial = moved(evidence, rig, step)
        after = residuals(evidence, trial, scale)
        gain = rows.cost - after.cost
        if not gain > 0:  # nor where it is not finite
            if not expected > tolerance * rows.cost or damping > 1e8:
                break
            damping, growth = damping * growth, 2 * growth
            continue
        done = gain < tolerance * rows.cost
        rig, rows = trial, after
        if done:
            break
        damping, growth = damping * max(1 / 3, 1 - (2 * gain / expected - 1) ** 3), 2.0
        normal = normal_equations(evidence, rows, derivatives(evidence, rig, scale))
    return rig, rows.cost


@dataclasses.dataclass(frozen=True, eq=False)
class NormalEquations:
    """Blocks of J^T J and J^T r of the normal equations. They are sums over the residuals `seen`
    and `focal` of `Rows`.

    The residuals `tied`, of size and bones, are not in these sums. They and their derivatives are
    kept as they are.

    The cameras have m = 9 c + g unknowns: 9 for each of c views, and 1 for each of g kinds of
    cameras.
    """

    landmarks: Float[np.ndarray, "k 3 3"]
    """Block of J^T J of each landmark, (k, 3, 3)."""
    cameras: Float[np.ndarray, "m m"]
    """Block of J^T J of the cameras, (m, m)."""
    between: Float[np.ndarray, "k 3 m"]
    """Blocks of J^T J between each landmark and the cameras, (k, 3, m)."""
    by_landmarks: Float[np.ndarray, "k 3"]
    """J^T r of the landmarks, (k, 3)."""
    by_cameras: Float[np.ndarray, " m"]
    """J^T r of the cameras, (m,)."""
    tied: Float[np.ndarray, "t k 3"]
    """Derivatives of the rows `tied` by all landmarks, (t, k, 3)."""
    tied_rows: Float[np.ndarray, " t"]
    """Residuals of the rows `tied`, (t,), in standard deviations."""
    kinds: int
    """Number of kinds of cameras, g."""


def normal_equations(evidence: Evidence, rows: Rows, of: Derivatives) -> NormalEquations:
    """Returns the normal equations of all residuals.

    There are c views, k landmarks, g kinds of camera, and m = 9 c + g unknowns of the cameras: nine
    of each view, then the y of each kind. A landmark's residuals in a view depend on the landmark,
    on the view's nine unknowns, and on the y of the view's kind.
    """
    c, k = evidence.weights.shape
    g = len(rows.focal)
    m = VIEW * c + g
    of_views, of_kinds = slice(0, VIEW * c), slice(VIEW * c, m)
    kind_of_view = np.eye(g)[evidence.kinds]  # (c, g), 1 at the kind of a view

    # J^T J between landmarks and cameras
    by_landmark_t = np.swapaxes(of.by_landmark, -1, -2)
    landmark_view = by_landmark_t @ of.by_view
    landmark_focal = (by_landmark_t @ of.by_focal[..., None])[..., 0]
    between = np.zeros((k, 3, m))
    between[..., of_views] = np.moveaxis(landmark_view, 0, 2).reshape(k, 3, VIEW * c)
    between[..., of_kinds] = np.einsum("cka,cg->kag", landmark_focal, kind_of_view)

    # J^T J between cameras, with all rows of a view along one axis
    by_view = of.by_view.reshape(c, -1, VIEW)
    by_focal = of.by_focal.reshape(c, -1, 1)
    by_view_t = np.swapaxes(by_view, 1, 2)
    view_kind = ((by_view_t @ by_focal) * kind_of_view[:, None]).reshape(VIEW * c, g)
    diagonal = kind_of_view.T @ np.sum(by_focal**2, axis=(1, 2))
    cameras = np.zeros((m, m))
    for view, block in enumerate(by_view_t @ by_view):
        own = slice(VIEW * view, VIEW * (view + 1))
        cameras[own, own] = block
    cameras[of_views, of_kinds] = view_kind
    cameras[of_kinds, of_views] = view_kind.T
    cameras[of_kinds, of_kinds] = np.diag(diagonal + 1)  # each y is a residual, too

    # J^T r
    seen = rows.seen.reshape(c, -1, 1)
    gradient_landmarks = np.sum(by_landmark_t @ rows.seen[..., None], axis=0)[..., 0]
    gradient_views = (by_view_t @ seen).ravel()
    gradient_kinds = kind_of_view.T @ np.sum(by_focal * seen, axis=(1, 2)) + rows.focal

    return NormalEquations(
        landmarks=np.sum(by_landmark_t @ of.by_landmark, axis=0),
        cameras=cameras,
        between=between,
        by_landmarks=gradient_landmarks,
        by_cameras=np.concatenate([gradient_views, gradient_kinds]),
        tied=of.tied,
        tied_rows=rows.tied,
        kinds=g,
    )


def solve(normal: NormalEquations, damping: float) -> tuple[Step, float]:
    """Returns the damped Gauss-Newton step, and the decrease of the cost that the linear model
    expects from the step.

    l is the step of the landmarks and q the step of the cameras. a and b are the J^T r of landmarks
    and cameras, without the rows `tied`. D, E and C are the blocks of the damped J^T J. U are the
    derivatives of the rows `tied`, r their residuals, and t = U l + r separate unknowns:

        D l + E q + U^T t = -a                  D block diagonal: landmarks by landmark
        E^T l + C q       = -b
        U l         - t   = -r

    With F = (E, U^T) and K = diag(C, -1), eliminating l = -D^-1 (a + F (q, t)) leaves (K - F^T D^-1
    F) (q, t) = F^T D^-1 a - (b, r).
    """
    # the damped blocks, named as above
    k, ties, m = len(normal.landmarks), len(normal.tied_rows), len(normal.by_cameras)
    diagonal = np.einsum("kaa->ka", normal.landmarks)
    damped = damping * diagonal + _STILL
    damped_cameras = damping * np.diag(normal.cameras) + _STILL
    D = normal.landmarks + damped[..., None] * np.eye(3)
    F = np.concatenate([normal.between, np.moveaxis(normal.tied, 0, 2)], axis=2)
    K = np.zeros((m + ties, m + ties))
    K[:m, :m] = normal.cameras + np.diag(damped_cameras)
    K[m:, m:] = -np.eye(ties)

    # the landmarks are eliminated, the cameras solved for, and put back
    solved = np.linalg.solve(
        D, np.concatenate([F, normal.by_landmarks[..., None]], axis=2)
    ).reshape(3 * k, -1)
    F = F.reshape(3 * k, -1)
    right = F.T @ solved[:, -1] - np.concatenate([normal.by_cameras, normal.tied_rows])
    cameras = np.linalg.solve(K - F.T @ solved[:, :-1], right)
    landmarks = -(solved[:, -1] + solved[:, :-1] @ cameras).reshape(k, 3)

    # decrease of the cost in the model with the rows linearised, for the gain ratio
    q = cameras[:m]
    a = normal.by_landmarks + np.einsum("tka,t->ka", normal.tied, normal.tied_rows)
    expected = 0.5 * (
        np.sum(landmarks * (damped * landmarks - a)) + q @ (damped_cameras * q - normal.by_cameras)
    )
    views = VIEW * ((m - normal.kinds) // VIEW)
    return Step(landmarks, q[:views].reshape(-1, VIEW), q[views:]), float(expected)
