"""Fits a motion to the keypoints of a video of one camera that stands still. All frames have one
shape. The stages are:

    start    finds the orientation and the position of the body in each frame from the keypoints and
             the detector's 3D landmarks, and smooths both over time
    shape    fits the shape, unless it is known, to frames from all over the video. The order of the
             frames is ignored
    motion   fits the poses in overlapping windows of at most `WINDOW` frames. Residuals are those
             of the keypoints, of the detector's depths, of the priors, and of the joints'
             accelerations and jerk
    feet     fits the motion once more, and holds feet still where the motion shows that they stand
    floor    turns the world so that the person stands along y, and moves the floor to y = 0

A window's state is x = x_0 + S u, where u are the unknowns of the solver. This preconditioning has
S = (1 + w D^T D)^(-1/2), where D takes third differences over time. In u the jerk is about as stiff
as the keypoints. So the solver carries a correction through all frames in few steps. The stages
shape, motion and feet share one compiled program.

The method follows HTD-Refine (https://arxiv.org/abs/2605.26879) and GVHMR
(https://arxiv.org/abs/2409.06662).
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import BODY_NAMES, FINGERS
from humangs_jax.body.landmarks import LandmarkModel, landmark_model, pose_landmarks
from humangs_jax.body.model import BodyModel, BodyPose, shape_body, without_expression
from humangs_jax.body.motion import Motion
from humangs_jax.capture.fitting.landmark_fit import accelerations, keypoint_problem
from humangs_jax.capture.fitting.residuals.keypoints import (
    KeypointProblem,
    Observations,
    frame_residuals,
    in_camera_axes,
    make_observations,
    trunk_weights,
)
from humangs_jax.capture.fitting.state import (
    FitState,
    Origin,
    frame_axes,
    half_squares,
    pose_of,
    robust,
    state_of,
    zero_state,
)
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry.transform import EXACT

WINDOW, OVERLAP = 120, 24
"""Largest number of frames in a window, and number of frames that two successive windows share."""
_STEPS, _STEP_LENGTH = 120, 0.1
"""Number of Adam steps in each fit of a window, and the learning rate at the first step."""
_ACCELERATION, _JERK = 10.0, 100.0
"""Expected standard deviations of a joint's acceleration, m/s^2, and of its jerk, m/s^3. They are
typical of people who dance.
"""


@dataclasses.dataclass(frozen=True)
class _MotionPrior:
    """Constants of the prior of motions."""

    keypoint: float = 0.008
    """Noise of a keypoint, expressed as a distance at the person, metres. Only the preconditioning
    uses it.
    """
    held_speed: float = 0.03
    """Standard deviation of the speed of a foot that stands still, metres a second."""
    height: float = 0.005
    """Standard deviation of a person's known height, metres."""
    anchor: float = 20.0
    """Weight of the residuals that hold the first frames of a window to the poses from the window
    before. It multiplies differences of the state.
    """
    robust_scale: float = 5.0
    """Robust scale of accelerations, jerk and speeds of feet, as a multiple of their standard
    deviations.
    """


_PRIOR = _MotionPrior()


_LEVELS = ((30.0, 8.0), (10.0, 3.0), (5.0, 1.0))
"""Each row has the robust scale of keypoints and depths (in standard deviations), and the factor on
the expected accelerations and jerk. The stage motion fits all windows once with each row, in this
order. The stage shape uses the last two rows, and the stage feet uses the last row.
"""
_FEET = ("left_heel", "left_foot_index", "right_heel", "right_foot_index")
"""Landmarks of the feet. Each is held still where the motion shows that it stands still."""
_HIPS = ("left_hip", "right_hip")
"""Landmarks of the hips. Their middle is the origin of the detector's 3D landmarks."""
_LEAST_SEEN = 6
"""Smallest number of visible keypoints for a frame to get its own start. In other frames the
position is interpolated, and the orientation is that of the nearest frame with its own start.
"""
_LEAST_VISIBLE = 0.3
"""A keypoint counts as visible if its confidence exceeds this number."""
FLIP = np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32)
"""Pose of the camera at the start, (4, 4). It turns a world with y up and z towards the camera into
the camera's axes, and back.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class MotionFit:
    """The motion of a person in m frames of a video. The world has y up, and its floor is at y =
    0.
    """

    betas: Float[np.ndarray, " s"]
    """Shape of the person, (s,)."""
    motion: Motion
    """Poses in all frames."""
    joints: Float[np.ndarray, "m j 3"]
    """Joints in the world, (m, j, 3), metres."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """Pose of the camera, world to camera, (4, 4), metres. It is the same in all frames."""
    static: Float[np.ndarray, "m f"]
    """How certain it is that each landmark of `_FEET` stands still between the previous frame and
    this one, (m, f), 0 to 1.
    """


@pytree_dataclass
class _Window:
    """Inputs of `_solved` for one window, apart from its keypoints."""

    poses: BodyPose
    """Poses with which the fit begins, a batch of w frames."""
    betas: Float[Array, " s"]
    """Shape with which the fit begins, (s,)."""
    shape_is_free: Float[Array, ""]
    """1 if the shape is fitted, 0 if it stays as it is, ()."""
    smoother: Float[Array, "w w"]
    """Matrix S of the preconditioning, (w, w), see the module's docstring."""
    timed: Float[Array, " w"]
    """1 for frames that follow each other in time, (w,). 0 for frames whose order is ignored, and
    for frames that only fill the window.
    """
    held: Float[Array, "v f"]
    """How certain it is that each landmark of `_FEET` stands still from a frame to the next, (w -
    1, f), 0 to 1.
    """
    anchored: Float[Array, " w"]
    """1 for frames that are held to the poses with which the fit begins, 0 for others, (w,)."""
    height: Float[Array, "2"]
    """Height of the person, metres, and 1 if it is known, (2,). Both are 0 if it is not known."""
    tall: Float[Array, " s1"]
    """Height of the mean body, and then for each shape coefficient the height that a value of 1
    adds, (1 + s,), metres.
    """
    rate: Float[Array, ""]
    """Frames per second."""
    scales: Float[Array, "2"]
    """A row of `_LEVELS`, (2,)."""


def fit_motion(
    body: BodyModel,
    keypoints: Keypoints,
    K: Float[np.ndarray, "3 3"],
    fps: float,
    *,
    betas: Float[np.ndarray, " s"] | None = None,
    height: float | None = None,
    watch: Callable[[Iterable[Any], int], Iterable[Any]] = lambda stages, count: stages,
) -> MotionFit:
    """Returns the motion of a person in a video of one camera that stands still.

    Args:
        body: body model of the person.
        keypoints: keypoints of all frames, with the detector's 3D landmarks (`Keypoints.world`).
            The set needs the landmarks of `_HIPS` and `_FEET`.
        K: intrinsics of the camera, (3, 3), pixels.
        fps: frames per second.
        betas: shape of the person, (s,). None: the shape is fitted.
        height: height of the person, metres. None: the height follows from keypoints and prior.
            The argument has no effect if `betas` is given.
        watch: wraps an iterable with about one item for each fit of a window, for example to show
            a progress bar. It is called with this iterable and the number of windows, and returns
            an iterable over the same items.
    Raises: ValueError if no frame shows the person, if the keypoints have no 3D landmarks, if their
    set lacks hips or feet, or if the body has none of the set's landmarks.
    """
    body = without_expression(body)
    kind = keypoints.set
    missing = [name for name in (*_HIPS, *_FEET) if name not in kind.names]
    if missing:
        raise ValueError(
            f"keypoints of {kind.name} lack {', '.join(missing)}: expected a set that has them,"
            " such as mediapipe33"
        )
    model = landmark_model(body, kind.names, kind.places, kind.certainty)
    seen = _observations(keypoints, K)
    m = len(seen.noise)
    shape = np.zeros(body.shape_directions.shape[-1]) if betas is None else np.asarray(betas)
    tall = _tallness(body)
    if betas is None:
        shape = _of_height(shape, tall, height)
    poses = _start(model, seen, fps, shape)
    # the shape if it is fitted, then all levels and the feet of each window
    windows = _windows(m)
    fits = len(windows) * (len(_LEVELS) + 1)
    if betas is None:
        fits += len(_LEVELS) - 1
    stages = iter(watch(range(fits), len(windows)))

    def run(
        frames: np.ndarray, poses: BodyPose, scales: tuple[float, float], **options: Any
    ) -> tuple[BodyPose, np.ndarray]:
        next(stages, None)
        return _run(model, seen, frames, poses, shape, tall, fps, scales, height, **options)

    # the shape, from frames whose order is ignored
    if betas is None:
        spread = np.unique(np.linspace(0, m - 1, min(m, WINDOW)).round().astype(int))
        found = poses
        for scales in _LEVELS[1:]:
            found, shape = run(spread, found, scales, timed=False)
        shape = _of_height(shape, tall, height)
    # the motion; then once more, with the feet held that stand still
    for scales in _LEVELS:
        poses = _joined(windows, poses, functools.partial(run, scales=scales))
    static = _static_feet(model, shape, poses, fps)
    poses = _joined(
        windows, poses, functools.partial(run, scales=_LEVELS[-1]), lambda w: {"static": static[w]}
    )
    return _standing(model, body, shape, poses, static, fps)


def _observations(keypoints: Keypoints, K: Float[np.ndarray, "3 3"]) -> Observations:
    """Returns the keypoints as observations of m frames with one view each, with the detector's 3D
    landmarks.

    Raises: ValueError if no frame shows the person, or if there are no 3D landmarks.
    """
    if keypoints.world is None:
        raise ValueError("expected keypoints of a detector that sees them in space, too")
    points, confidences = keypoints.points[:, None], keypoints.confidences[:, None]
    if not ((confidences > _LEAST_VISIBLE).sum(-1) >= _LEAST_SEEN).any():
        raise ValueError("the person is seen in no frame")
    cameras = np.broadcast_to(K, (len(points), 1, 3, 3))
    world = in_camera_axes(keypoints.world[:, None], points, confidences, cameras)
    places = np.broadcast_to(FLIP, (len(points), 1, 4, 4))
    return make_observations(points, confidences, cameras, places, world)


# The start
# --------------------------------------------------------------------------------------------------


def _start(
    model: LandmarkModel, seen: Observations, fps: float, betas: Float[np.ndarray, " s"]
) -> BodyPose:
    """Returns the poses with which the fit starts. All joints but the root have the mean rotations
    of the prior of poses. The body's orientation and position in each frame are found from the
    keypoints and the detector's 3D landmarks, and smoothed over time.

    Raises: ValueError if no frame shows the person in front of the camera.
    """
    problem = keypoint_problem(model)
    still = replace(zero_state(problem.origin), betas=jnp.asarray(betas, jnp.float32))
    resting, joints = problem.landmarks_and_joints(still)
    resting, pelvis = np.asarray(resting), np.asarray(joints[0])
    usual = np.asarray(problem.origin.pose.rotations)
    # trunks turn onto the detector's landmarks, whose axes are the camera's
    weights = trunk_weights(model.names) * problem.known
    world = np.asarray(seen.world)[:, 0] * np.diag(FLIP)[:3]
    turns = [_turn(resting, points, weights).as_matrix() for points in world]
    # sizes of the trunks say how large the detector's person is
    trunk = weights > 0.5
    scale = _radius(resting[trunk]) / np.maximum(_radius(world[:, trunk]), 1e-3)
    hips = [model.names.index(name) for name in _HIPS]
    offsets = (world - world[:, hips].mean(1, keepdims=True)) * scale[:, None, None]
    views = (np.asarray(x)[:, 0] for x in (seen.points, seen.confidences, seen.K))
    places = np.stack([_place(*each) for each in zip(*views, offsets, strict=True)])
    # frames that show nothing lie between the others
    shown = (np.asarray(seen.confidences)[:, 0] > _LEAST_VISIBLE).sum(-1) >= _LEAST_SEEN
    shown &= places[:, 2] < 0
    known, frames = np.flatnonzero(shown), np.arange(len(shown))
    if not len(known):
        raise ValueError("the person is seen in no frame")
    nearest = known[np.searchsorted((known[1:] + known[:-1]) / 2, frames)]
    between = [np.interp(frames, known, column[known]) for column in places.T]
    places = _steady(np.stack(between, axis=-1), fps)
    matrices = _steady(np.stack(turns)[nearest], fps)
    u, _, vt = np.linalg.svd(matrices)
    u[..., -1] *= np.linalg.det(u @ vt)[:, None]  # the nearest rotations
    roots = Rotation.from_matrix(u @ vt).as_rotvec()
    rotations = np.tile(usual, (len(frames), 1, 1))
    rotations[:, 0] = roots
    return jax.vmap(BodyPose)(
        jnp.asarray(rotations, jnp.float32), jnp.asarray(places - pelvis, jnp.float32)
    )


def _radius(points: Float[np.ndarray, "*m k 3"]) -> Float[np.ndarray, "*m"] | np.floating:
    """Returns the root mean square of the points' distances from their mean."""
    off = points - points.mean(-2, keepdims=True)
    return np.sqrt(np.square(off).sum(-1).mean(-1))


def _steady(values: Float[np.ndarray, "m ..."], fps: float) -> Float[np.ndarray, "m ..."]:
    """Returns values of frames, (m, ...), without outliers (median of 5 frames), and smoothed over
    time by a Gaussian with a standard deviation of 0.1 s, or half a frame if that is longer.
    """
    kept = median_filter(values, size=(5, *[1] * (values.ndim - 1)), mode="nearest")
    # over a tenth of a second, or half a frame
    return gaussian_filter1d(kept, max(0.1 * fps, 0.5), axis=0, mode="nearest")


def _turn(
    a: Float[np.ndarray, "k 3"], b: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"]
) -> Rotation:
    """Returns the rotation that best maps points a onto points b, after the weighted means are
    subtracted.
    """
    a, b = (x - np.average(x, axis=0, weights=weights) for x in (a, b))
    return Rotation.align_vectors(b, a, weights=weights)[0]


def _place(
    points: Float[np.ndarray, "k 2"],
    confidences: Float[np.ndarray, " k"],
    K: Float[np.ndarray, "3 3"],
    offsets: Float[np.ndarray, "k 3"],
) -> Float[np.ndarray, "3"]:
    """Returns the position t, (3,), metres, at which the body projects to its keypoints. t is in
    the axes of the world.

    Arguments: points: keypoints, (k, 2), pixels. offsets: points of the body relative to t, (k, 3),
    metres, in the axes of the world.

    In the camera's axes, let (X, Y, Z) be a point's offset, and (x, y) its keypoint relative to the
    principal point, divided by the focal length. Then x (Z + t_z) = X + t_x and y (Z + t_z) = Y +
    t_y, which is linear in t.
    """
    xy = (points - K[:2, 2]) / np.diagonal(K)[:2]
    off = offsets * np.diag(FLIP)[:3]
    rows = np.zeros((len(xy), 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1.0
    rows[..., 2] = -xy
    right = xy * off[:, 2:] - off[:, :2]
    weights = np.sqrt(confidences)[:, None]
    place = np.linalg.lstsq(
        (rows * weights[..., None]).reshape(-1, 3), (right * weights).ravel(), rcond=None
    )[0]
    return place * np.diag(FLIP)[:3]


def _tallness(body: BodyModel) -> Float[np.ndarray, " s1"]:
    """Returns the height of the mean body, and then for each shape coefficient the height that a
    value of 1 adds, (1 + s,), metres.
    """
    template = np.asarray(body.template)
    top, bottom = template[:, 1].argmax(), template[:, 1].argmin()
    directions = np.asarray(body.shape_directions)[:, 1]
    return np.append(np.ptp(template[:, 1]), directions[top] - directions[bottom])


def _of_height(
    betas: Float[np.ndarray, " s"], tall: Float[np.ndarray, " s1"], height: float | int | None
) -> Float[np.ndarray, " s"]:
    """Returns the shape nearest to `betas` for which the person has this height, (s,). height:
    metres. None: `betas` is returned. tall: see `_tallness`.
    """
    if height is None:
        return betas
    missing = height - tall[0] - tall[1:] @ betas
    return betas + tall[1:] * missing / np.sum(np.square(tall[1:]))


# Windows
# --------------------------------------------------------------------------------------------------


def _windows(m: int) -> list[np.ndarray]:
    """Returns the indices of the frames of each window. Successive windows share `OVERLAP`
    frames.
    """
    starts = range(0, max(m - OVERLAP, 1), WINDOW - OVERLAP)
    return [np.arange(start, min(start + WINDOW, m)) for start in starts]


def _joined(
    windows: list[np.ndarray],
    poses: BodyPose,
    run: Callable[..., tuple[BodyPose, np.ndarray]],
    more: Callable[[np.ndarray], dict[str, Any]] = lambda window: {},
) -> BodyPose:
    """Fits the windows one after the other, and returns the poses of all frames.

    Each window shares its first `OVERLAP` frames with the window before. In the first half of
    these, it is held to the poses that the window before found. more: returns further arguments of
    `run` for a window.
    """
    for i, window in enumerate(windows):
        anchored = np.zeros(len(window))
        anchored[: OVERLAP // 2] = i > 0
        poses, _ = run(window, poses, anchored=anchored, **more(window))
    return poses


def _run(
    model: LandmarkModel,
    seen: Observations,
    frames: np.ndarray,
    poses: BodyPose,
    betas: Float[np.ndarray, " s"],
    tall: Float[np.ndarray, " s1"],
    fps: float,
    scales: tuple[float, float],
    height: float | None,
    timed: bool = True,
    static: Float[np.ndarray, "w f"] | None = None,
    anchored: Float[np.ndarray, " w"] | None = None,
) -> tuple[BodyPose, Float[np.ndarray, " s"]]:
    """Fits the poses of one window, and the shape if `timed` is False. Returns the poses of all
    frames, with new poses in `frames`, and the shape.

    Args:
        frames: indices of the frames of the window, (w,), at most `WINDOW` of them.
        poses: poses of all frames, with which the fit starts.
        scales: a row of `_LEVELS`.
        timed: whether the frames follow each other in time. If so, the shape is not fitted.
        static: how certain it is that the feet stand still, (w, f), as in `MotionFit.static`. None:
            feet are not held.
        anchored: 1 for frames that are held to their poses in `poses`, 0 for others, (w,). None:
            no frame is held.
    """
    count = len(frames)
    # all windows are filled up to one length, so that they share one program; the keypoints of
    # added frames have confidence 0
    padded = np.append(frames, np.full(WINDOW - count, frames[-1]))

    def filled(x):
        return np.append(x, np.zeros((WINDOW - count, *np.shape(x)[1:])), axis=0)

    own = jax.tree.map(lambda x: x[padded], seen)
    own = replace(own, confidences=own.confidences * filled(np.ones(count))[:, None, None])
    window = _Window(
        poses=jax.tree.map(lambda x: x[padded], poses),
        betas=jnp.asarray(betas, jnp.float32),
        shape_is_free=jnp.asarray(not timed, jnp.float32),
        smoother=jnp.asarray(_smoother(fps) if timed else np.eye(WINDOW), jnp.float32),
        timed=jnp.asarray(filled(np.ones(count)) * timed, jnp.float32),
        held=jnp.asarray(filled(np.zeros((count, len(_FEET))) if static is None else static)[1:]),
        anchored=jnp.asarray(filled(np.zeros(count) if anchored is None else anchored)),
        height=jnp.asarray([height or 0.0, height is not None], jnp.float32),
        tall=jnp.asarray(tall, jnp.float32),
        rate=jnp.asarray(fps, jnp.float32),
        scales=jnp.asarray(scales, jnp.float32),
    )
    found, shape = _solved(model, own, window)
    poses = jax.tree.map(lambda old, new: old.at[frames].set(new[:count]), poses, found)
    return poses, np.asarray(shape)


@functools.cache
def _smoother(fps: float) -> Float[np.ndarray, "w w"]:
    """Returns the preconditioning matrix S, (w, w). See the module's docstring."""
    third = np.diff(np.eye(WINDOW), n=3, axis=0)
    values, vectors = np.linalg.eigh(third.T @ third)
    weight = (_PRIOR.keypoint * fps**3 / _JERK) ** 2
    return (vectors / np.sqrt(1 + weight * np.maximum(values, 0))) @ vectors.T


@compiled()
def _solved(
    model: LandmarkModel, seen: Observations, window: _Window
) -> tuple[BodyPose, Float[Array, " s"]]:
    """Fits a window, starting from its poses and shape. Returns the new poses and the shape."""
    problem = keypoint_problem(model)
    origins = _frame_origins(problem, window)
    start = _start_state(origins, window)

    def loss(unknowns: FitState) -> Float[Array, ""]:
        """Returns half the sum of the squares of all residuals."""
        state = _state_of_unknowns(unknowns, start, window)
        found, landmarks, joints = _residuals_of_frames(problem, origins, seen, window, state)
        found["shape"] = state.betas  # once, whatever the number of frames
        found["acceleration"], found["jerk"] = _smoothness_residuals(model, window, joints)
        found["feet"] = _foot_residuals(model, window, landmarks)
        found["anchor"] = _anchor_residuals(window, start, state)
        found["height"] = _height_residual(window, state.betas)
        return half_squares(found)

    unknowns = _descended(loss, jax.tree.map(jnp.zeros_like, start))
    state = _state_of_unknowns(unknowns, start, window)
    poses = jax.vmap(pose_of, in_axes=(0, frame_axes(state)))(origins, state)
    return poses, state.betas


def _frame_origins(problem: KeypointProblem, window: _Window) -> Origin:
    """Returns the origin of each frame, a batch of w. The root's rotation and the position are
    those with which the window begins. All other joints have their usual rotations, which are the
    means of the prior of poses.
    """
    origin = replace(problem.origin, betas=jnp.zeros_like(window.betas))
    begun = window.poses.rotations
    usual_joints = problem.origin.pose.rotations.at[0].set(0)
    roots = jnp.zeros_like(begun).at[:, 0].set(begun[:, 0])
    poses = replace(window.poses, rotations=usual_joints + roots)
    return jax.vmap(lambda pose: replace(origin, pose=pose))(poses)


def _start_state(origins: Origin, window: _Window) -> FitState:
    """Returns the state x_0 that stands for the poses and the shape with which the window begins.
    All frames share its shape.
    """

    def of_frame(origin: Origin, pose: BodyPose) -> FitState:
        return state_of(origin, window.betas, pose)

    start = jax.vmap(of_frame)(origins, window.poses)
    return replace(start, betas=window.betas)


def _state_of_unknowns(unknowns: FitState, start: FitState, window: _Window) -> FitState:
    """Returns the state x = x_0 + S u for the unknowns u, where x_0 is `start`. S mixes frames, so
    the shape is added without it.
    """

    def moved(old: Float[Array, "w ..."], u: Float[Array, "w ..."]) -> Float[Array, "w ..."]:
        return old + jnp.einsum("vw,w...->v...", window.smoother, u, precision=EXACT)

    return FitState(
        betas=start.betas + unknowns.betas * window.shape_is_free,
        global_orient=moved(start.global_orient, unknowns.global_orient),
        transl=moved(start.transl, unknowns.transl),
        body_pose=moved(start.body_pose, unknowns.body_pose),
    )


def _residuals_of_frames(
    problem: KeypointProblem,
    origins: Origin,
    seen: Observations,
    window: _Window,
    state: FitState,
) -> tuple[dict[str, Any], Float[Array, "w k 3"], Float[Array, "w j 3"]]:
    """Returns the residuals of `frame_residuals` for each frame, the body's landmarks in each
    frame, (w, k, 3), metres, and the body's joints, (w, j, 3), metres.
    """

    def of_frame(seen: Observations, state: FitState, origin: Origin) -> tuple[Any, Any]:
        from_origin = dataclasses.replace(problem, origin=origin)
        found = frame_residuals(from_origin, seen, state, window.scales[0])
        return found, from_origin.landmarks_and_joints(state)

    by_frame = jax.vmap(of_frame, in_axes=(0, frame_axes(state), 0))
    found, (landmarks, joints) = by_frame(seen, state, origins)
    return found, landmarks, joints


def _smoothness_residuals(
    model: LandmarkModel, window: _Window, joints: Float[Array, "w j 3"]
) -> tuple[Float[Array, "w2 e 3"], Float[Array, "w3 e 3"]]:
    """Returns the residuals of the joints' accelerations, (w - 2, e, 3), and of their jerk, (w - 3,
    e, 3). The e joints are the body's and the last one of each finger. Frames that do not follow
    each other in time have residuals of 0.
    """
    expected = {*BODY_NAMES, *(f"{side}_{each}3" for side in ("left", "right") for each in FINGERS)}
    chosen = np.asarray([name in expected for name in model.joint_names])
    times = window.timed[1:, None, None]
    acceleration = accelerations(joints[:, chosen]) * times[1:] * window.rate**2
    jerk = jnp.diff(acceleration, axis=0) * window.rate
    slack = window.scales[1]
    return (
        robust(acceleration / (_ACCELERATION * slack), _PRIOR.robust_scale),
        robust(jerk * times[2:] / (_JERK * slack), _PRIOR.robust_scale),
    )


def _foot_residuals(
    model: LandmarkModel, window: _Window, landmarks: Float[Array, "w k 3"]
) -> Float[Array, "v f 3"]:
    """Returns the residuals of the speeds of the landmarks of `_FEET`, (w - 1, f, 3). They are 0
    for landmarks that do not stand still (`_Window.held`).
    """
    steps = jnp.diff(landmarks[:, _foot_rows(model)], axis=0) * window.rate / _PRIOR.held_speed
    return robust(jnp.sqrt(window.held)[..., None] * steps, _PRIOR.robust_scale)


def _anchor_residuals(
    window: _Window, start: FitState, state: FitState
) -> list[Float[Array, "w ..."]]:
    """Returns the residuals that hold frames to the poses that another window found: one array,
    (w, ...), for each part of the state that poses a frame.
    """
    residuals = []
    for part in ("global_orient", "transl", "body_pose"):
        moved = getattr(state, part) - getattr(start, part)
        one_per_frame = (-1, *[1] * (moved.ndim - 1))
        weights = (_PRIOR.anchor * window.anchored).reshape(one_per_frame)
        residuals.append(weights * moved)
    return residuals


def _height_residual(window: _Window, betas: Float[Array, " s"]) -> Float[Array, ""]:
    """Returns the residual of the person's height, (). It is 0 if the height is not known."""
    tall = window.tall[0] + jnp.sum(window.tall[1:] * betas)
    known = window.height[1]
    return known * (tall - window.height[0]) / _PRIOR.height


def _descended(loss: Callable[[FitState], Float[Array, ""]], start: Any) -> FitState:
    """Returns the unknowns after `_STEPS` steps of Adam, with a cosine decay of the learning rate
    to 0.
    """
    optimizer = optax.adam(optax.cosine_decay_schedule(_STEP_LENGTH, _STEPS), b1=0.9, b2=0.95)

    def step(carry, _):
        unknowns, memory = carry
        updates, memory = optimizer.update(jax.grad(loss)(unknowns), memory)
        return (optax.apply_updates(unknowns, updates), memory), None

    (found, _), _ = jax.lax.scan(step, (start, optimizer.init(start)), length=_STEPS)
    return found


# Feet and floor
# --------------------------------------------------------------------------------------------------


@compiled()
def _landmarks(
    model: LandmarkModel, betas: Float[Array, " s"], poses: BodyPose
) -> tuple[Float[Array, "m k 3"], Float[Array, "m j 3"]]:
    return jax.vmap(lambda pose: pose_landmarks(model, betas, pose))(poses)


def _foot_rows(model: LandmarkModel) -> Int[np.ndarray, " f"]:
    """Returns the indices of the landmarks of `_FEET`, (f,)."""
    return np.asarray([model.names.index(name) for name in _FEET])


def _static_feet(
    model: LandmarkModel, betas: Float[np.ndarray, " s"], poses: BodyPose, fps: float
) -> Float[np.ndarray, "m f"]:
    """Returns how certain it is that each landmark of `_FEET` stands still between the previous
    frame and this one, (m, f), 0 to 1. It is 0 in the first frame.
    """
    points, _ = _landmarks(model, jnp.asarray(betas, jnp.float32), poses)
    feet = np.asarray(points)[:, _foot_rows(model)]
    moved = np.diff(feet, axis=0, prepend=np.nan) * fps
    moved[..., 2] /= 2  # depths of a single camera are unsteady
    speed = np.nan_to_num(np.linalg.norm(moved, axis=-1), nan=np.inf)
    # metres a second: a point that is slower than the first stands still, one that is faster than
    # the second moves
    slow, fast = 0.25, 0.5
    return np.clip((fast - speed) / (fast - slow), 0, 1)


def _standing(
    model: LandmarkModel,
    body: BodyModel,
    betas: Float[np.ndarray, " s"],
    poses: BodyPose,
    static: Float[np.ndarray, "m f"],
    fps: float,
) -> MotionFit:
    """Returns the motion in a world that is turned so that the person stands along y, and moved so
    that the floor is at y = 0. If the person leans by 50 degrees or more from the camera's upright
    direction, the person is taken to lie, and the world is not turned.
    """
    shape = jnp.asarray(betas, jnp.float32)
    joints = np.asarray(_landmarks(model, shape, poses)[1], np.float64)
    rest = shape_body(body, shape)
    pelvis = np.asarray(rest.joints[0], np.float64)
    # whoever stands has the neck above the ankles, in the mean over frames with a foot that stands
    named = {name: j for j, name in enumerate(model.joint_names)}
    ankles = joints[:, [named["left_ankle"], named["right_ankle"]]].mean(1)
    upwards = joints[:, named["neck"]] - ankles
    weights = static.max(1) + 1e-3
    upwards /= np.linalg.norm(upwards, axis=-1, keepdims=True)
    up = np.average(upwards, axis=0, weights=weights)
    up /= max(np.linalg.norm(up), 1e-9)
    turn = Rotation.identity()
    # beyond 50 degrees from the camera's upright people are taken to lie, and the camera to be
    # level
    if np.degrees(np.arccos(np.clip(up[1], -1, 1))) < 50.0:
        turn = Rotation.align_vectors([[0.0, 1, 0]], [up])[0]
    rotations = np.asarray(poses.rotations, np.float64).copy()
    rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    places = turn.apply(np.asarray(poses.translation, np.float64) + pelvis) - pelvis
    # the soles are on the floor
    sole = float(np.asarray(rest.joints)[:, 1].min() - np.asarray(rest.vertices)[:, 1].min())
    joints = turn.apply(joints.reshape(-1, 3)).reshape(joints.shape)
    floor = float(np.quantile(joints[..., 1].min(1), 0.05)) - sole
    shift = np.asarray([0.0, floor, 0.0])
    camera = FLIP.astype(np.float64) @ np.linalg.inv(_matrix(turn, -shift))
    motion = Motion(
        jnp.asarray(rotations, jnp.float32), jnp.asarray(places - shift, jnp.float32), float(fps)
    )
    return MotionFit(np.asarray(betas), motion, joints - shift, camera, static)


def _matrix(turn: Rotation, shift: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), shift
    return matrix


def betas_of_joints(
    body: BodyModel, rest_joints: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, " s"]:
    """Returns the shape coefficients for which the body's joints in the T-pose are nearest to
    `rest_joints`, (s,). A translation between both does not count, and large coefficients are
    avoided. rest_joints: joints in the T-pose, for example of an avatar, (j, 3), metres.

    Raises: ValueError if `rest_joints` is not an array (j, 3) for the body's j joints.
    """
    body = without_expression(body)
    mean = np.asarray(body.joint_regressor, np.float64) @ np.asarray(body.template, np.float64)
    if np.shape(rest_joints) != mean.shape:
        raise ValueError(f"expected {len(mean)} joints, got {len(rest_joints)}")
    directions = np.einsum("jn,nas->jas", body.joint_regressor, body.shape_directions)
    # places from the root, which is at its origin in both
    wanted = np.asarray(rest_joints, np.float64) - mean
    a = (directions - directions[:1])[1:].reshape(3 * (len(mean) - 1), -1)
    b = (wanted - wanted[:1])[1:].ravel()
    # a coefficient of 1 is usual; joints are known to a millimetre
    ridge = 1e-3 * np.eye(a.shape[1])
    right = np.append(b, np.zeros(len(ridge)))
    return np.linalg.lstsq(np.concatenate([a, ridge]), right, rcond=None)[0]
