"""Fits a body to the keypoints of one person in stages. At the end all frames are fitted together
with one shape. The functions are pure, so that they can be vmapped over people.

    rigid   fits position and orientation of a resting body
    points  fits body joints and shape to triangulated points, or to the keypoints in frames that
            have no such points
    body    fits body joints and shape to the keypoints of every view
    hands   fits all joints that a keypoint depends on, with a smaller robust scale
    person  fits all frames at once with one shape. Frames and landmarks have the noise that was
            found. If there are at least four frames, and several views in a frame, the places at
            which the detector sees its landmarks move too
    motion  fits all frames with smooth motion if that is requested, see `smooth_motion`

The first four stages are one program that runs with different weights and free unknowns, because
compilation dominates the time. They run from each of the best starts of a frame, and the result
with the least cost is kept.
"""

import functools
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.landmarks import LandmarkModel, pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.capture.fitting.residuals.keypoints import (
    RAYLEIGH_MEDIAN,
    KeypointProblem,
    Observations,
    Targets,
    focal_lengths,
    found_noise,
    frame_residuals,
    in_cameras,
    keypoint_errors,
    keypoint_residuals,
    trunk_weights,
)
from humangs_jax.capture.fitting.state import (
    FREE,
    FitState,
    betas_of,
    frame_axes,
    half_squares,
    pose_of,
    pose_prior,
    robust,
    solve,
    state_of,
    usual_origin,
    zero_state,
)
from humangs_jax.capture.fitting.triangulation import triangulate_robustly
from humangs_jax.capture.keypoints.keypoints import mirrored_name
from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.transform import EXACT

ROBUST_SCALES = {"rigid": 30.0, "points": 15.0, "body": 15.0, "hands": 10.0, "person": 5.0}
"""Robust scales of keypoints in each stage, as multiples of the keypoints' standard deviation."""
STEPS = 150
"""Largest number of steps of the solver in a stage."""
_TOLERANCE = 3e-4
"""Tolerance of the solver, see `state.solve`."""
MOTION_SCALE = 5.0
"""Robust scale of accelerations, as a multiple of the expected acceleration. It is small, so that a
frame that shows another person hardly affects the other frames.
"""
FEW = 6
"""If a frame shows fewer landmarks than this, its pose comes mostly from the prior. Smooth motion
interpolates such a frame.
"""


@pytree_dataclass
class LandmarkFit:
    """The result of a fit of a person in m frames."""

    betas: Float[Array, " s"]
    """Shape coefficients, (s,)."""
    poses: BodyPose
    """Poses in all frames, a batch of m."""
    landmarks: Float[Array, "m k 3"]
    """Landmarks of the body, (m, k, 3), metres."""
    joints: Float[Array, "m j 3"]
    """Joints of the body, (m, j, 3), metres."""
    noise: Float[Array, " m"]
    """Standard deviation of the detections in each frame, (m,), pixels."""
    state: FitState
    """State at the end of the fit: deviations from the origin of `keypoint_problem`."""
    smoothness: Float[Array, ""]
    """Expected acceleration that was used, (), metres per frame squared. 0 if frames are
    independent.
    """
    certainty: Float[Array, " k"]
    """Certainty of each landmark, (k,): the noise of all landmarks, divided by the noise of this
    one.
    """


@checked_arguments
def fit_landmarks(
    model: LandmarkModel, observations: Observations, smoothness: float = 0.0
) -> LandmarkFit:
    """Returns shape and poses of one person.

    The result is finite for all finite observations. Frames without keypoints get the prior's usual
    pose. If the motion is smooth, `smooth_motion` interpolates them.

    Args:
        model: landmarks of the keypoints on the body.
        observations: keypoints of all frames, a batch of m. They have to be in order of time if the
            motion is smooth.
        smoothness: expected acceleration of joints, metres per frame squared. If it is 0, or if
            there are fewer than three frames, frames are independent.
    """
    fit = fit_frames(model, observations)
    if smoothness and len(fit.noise) > 2:
        return smooth_motion(model, observations, fit, smoothness)
    return fit


@compiled()
def fit_frames(model: LandmarkModel, observations: Observations) -> LandmarkFit:
    """Runs all stages except motion, and returns the fit. observations: a batch of m frames."""
    problem = keypoint_problem(model)
    states = jax.vmap(lambda seen: _fit_frame(problem, seen))(observations)
    observations = replace(observations, noise=_noise_found(problem, observations, states))
    model = replace(model, certainty=_certainty_found(problem, observations, states))
    problem = keypoint_problem(model)
    # where the detector sees its landmarks: fewer than four frames say too little about both shape
    # and places
    groups = len({group for _, group, _ in model.placed})
    frames, views = observations.points.shape[:2]
    placed = groups and frames >= 4 and views > 1
    places = jnp.zeros((groups, 3)) if placed else None
    start = replace(states, betas=jnp.median(states.betas, axis=0), places=places)
    residuals = functools.partial(_person_residuals, problem, observations)
    state, _ = solve(residuals, start, STEPS, method="lbfgs", tolerance=_TOLERANCE)
    return _result(problem, observations.noise, state, jnp.zeros(()))


def _result(
    problem: KeypointProblem,
    noise: Float[Array, " m"],
    state: FitState,
    smoothness: Float[Array, ""],
) -> LandmarkFit:
    betas = betas_of(problem.origin, state)
    poses = _poses(problem, state)
    landmarks, joints = jax.vmap(lambda pose: pose_landmarks(problem.model_of(state), betas, pose))(
        poses
    )
    return LandmarkFit(
        betas, poses, landmarks, joints, noise, state, smoothness, problem.model.certainty
    )


def _poses(problem: KeypointProblem, state: FitState) -> BodyPose:
    return jax.vmap(lambda own: pose_of(problem.origin, own), in_axes=(frame_axes(state),))(state)


def keypoint_problem(model: LandmarkModel) -> KeypointProblem:
    """Returns the problem of fitting a body to keypoints. Every joint that moves a landmark is
    free. The other joints stay in the usual pose.
    """
    prior, joints = pose_prior(model.joint_names), tuple(j for j in model.movers if j > 0)
    origin = usual_origin(prior, joints, model.joint_directions.shape[-1])
    return KeypointProblem(model, prior, origin)


def _fit_frame(problem: KeypointProblem, seen: Observations) -> FitState:
    """Returns the state of one frame after the stages rigid, points, body and hands. They run from
    several starts, and the state with the least cost is returned.
    """
    points, counts, weights = triangulate_robustly(seen)
    # one view leaves more orientations open than several
    followed = 2 if seen.points.shape[0] > 1 else 4
    starts = _rigid_starts(problem, seen, points, counts, followed)
    # metres per pixel where the points are, a mean over views and points
    centers = transform.invert_rigid(seen.cam_from_world)[:, :3, 3]
    distance = jnp.linalg.norm(points - centers[:, None], axis=-1)
    each = distance / seen.K[:, :1, 0]
    pixel = jnp.sum(weights * each) / jnp.maximum(jnp.sum(weights), 1e-6) + 1e-4
    stages = _stages(problem, Targets(points, counts >= 2, pixel))

    def run(state, stage):
        """Returns the state after one stage, and its cost."""
        weighted = replace(seen, confidences=seen.confidences * stage.landmark_weights)

        def residuals(y):
            return frame_residuals(problem, weighted, y, stage.scale, stage.targets)

        return solve(residuals, state, STEPS, method="lbfgs", tolerance=_TOLERANCE, free=stage.free)

    states, costs = jax.vmap(lambda start: jax.lax.scan(run, start, stages))(starts)
    best = jnp.argmin(costs[:, -1])
    return jax.tree.map(lambda leaf: leaf[best], states)


# The start of a frame
# ------------------------------------------------------------------------------------------------


def _rigid_starts(
    problem: KeypointProblem,
    observations: Observations,
    points: Float[Array, "k 3"],
    counts: Float[Array, " k"],
    kept: int,
) -> FitState:
    """Returns the `kept` best starts of a frame: states of a resting body with different positions
    and orientations, a batch. The starts with the smallest keypoint errors are kept.

    In one candidate the trunk of the resting body is rotated to fit the triangulated points (Kabsch
    1976). The other candidates have the 24 rotations of a cube. The position for each orientation
    is the solution of linear equations.

    Arguments: points: triangulated landmarks, (k, 3), metres. counts: number of views that agree
    with each landmark, (k,). 0 if the landmark is unknown.
    """
    resting = zero_state(problem.origin)
    landmarks, joints = problem.landmarks_and_joints(resting)
    pelvis = joints[0]
    # candidate orientations: the trunk turned onto triangulated points, and those of a cube
    weights = trunk_weights(problem.model.names) * problem.known
    product = functools.partial(jnp.matmul, precision=EXACT)
    turned = _kabsch(landmarks, points, weights * (counts >= 2))
    rotations = jnp.concatenate([turned[None], jnp.asarray(_cube_rotations(), jnp.float32)])
    positions = jax.vmap(
        lambda r: _position(observations, product(landmarks - pelvis, r.T), weights)
    )(rotations)
    # each candidate as a state
    vectors = quaternion.to_axis_angle(quaternion.from_matrix(rotations))

    def start(vector, position):
        return replace(
            resting,
            global_orient=vector / math.radians(FREE.global_orient),
            transl=(position - pelvis) / FREE.transl,
        )

    starts = jax.vmap(start)(vectors, positions)

    def cost(state):
        errors = keypoint_residuals(
            problem.model,
            observations,
            problem.landmarks_and_joints(state)[0],
            ROBUST_SCALES["rigid"],
        )
        return 0.5 * jnp.sum(weights[:, None] * jnp.square(errors))

    best = jnp.argsort(jax.vmap(cost)(starts))[:kept]
    return jax.tree.map(lambda leaf: leaf[best], starts)


def _cube_rotations() -> Float[np.ndarray, "24 3 3"]:
    """Returns the 24 rotations that map a cube to itself, (24, 3, 3)."""
    signed = (
        np.eye(3)[list(order)] * np.asarray(signs)[:, None]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1, -1), repeat=3)
    )
    return np.stack([m for m in signed if np.linalg.det(m) > 0])


def _kabsch(
    a: Float[Array, "k 3"], b: Float[Array, "k 3"], weights: Float[Array | np.ndarray, " k"]
) -> Float[Array, "3 3"]:
    """Returns the rotation, about the weighted means, that maps points a best onto points b. It is
    the identity if all weights are 0.
    """
    share = weights / jnp.maximum(jnp.sum(weights), 1e-9)
    centered_a, centered_b = (x - jnp.sum(share[:, None] * x, axis=0) for x in (a, b))
    u, _, vt = jnp.linalg.svd(
        jnp.einsum("k,ka,kb->ab", share, centered_b, centered_a, precision=EXACT)
        + 1e-9 * jnp.eye(3)
    )
    sign = jnp.sign(jnp.linalg.det(jnp.matmul(u, vt, precision=EXACT)))
    return jnp.matmul(u * jnp.stack([jnp.ones(()), jnp.ones(()), sign]), vt, precision=EXACT)


def _position(
    observations: Observations,
    offsets: Float[Array, "k 3"],
    weights: Float[Array | np.ndarray, " k"],
) -> Float[Array, "3"]:
    """Returns the position at which landmarks project to their detections, (3,), metres. offsets:
    landmarks relative to the position, (k, 3), metres.

    In the camera's axes, let (X, Y, z) be an offset, t the position, and (x, y) the detection
    relative to the principal point, divided by the focal length. Then x (z + t_z) = X + t_x and y
    (z + t_z) = Y + t_y, which is linear in t. These equations of all views are solved by weighted
    least squares.
    """
    rotation = observations.cam_from_world[:, :3, :3]
    xy = (observations.points - observations.K[:, None, :2, 2]) / focal_lengths(observations)
    known = in_cameras(observations, offsets)
    rows = rotation[:, None, :2] - xy[..., None] * rotation[:, None, 2:]
    right = xy * known[..., 2:] - known[..., :2]
    w = observations.confidences * weights
    matrix = jnp.einsum("ck,ckia,ckib->ab", w, rows, rows, precision=EXACT)
    vector = jnp.einsum("ck,ckia,cki->a", w, rows, right, precision=EXACT)
    scale = jnp.maximum(jnp.trace(matrix), 1e-9)
    return jnp.linalg.solve(matrix / scale + 1e-7 * jnp.eye(3), vector / scale)


# Stages
# --------------------------------------------------------------------------------------------------


@pytree_dataclass
class _Stage:
    """Settings of one run of the solver."""

    landmark_weights: Float[Array, " k"]
    """Weights of the keypoints of each landmark, (k,)."""
    targets: Targets
    """Triangulated points with their weights."""
    scale: Float[Array, ""]
    """Robust scale, standard deviations."""
    free: FitState
    """Whether each number of the state moves, as booleans in the form of a state."""


def _stages(problem: KeypointProblem, targets: Targets) -> _Stage:
    """Returns the stages rigid, points, body and hands, in one batch."""
    model, resting = problem.model, zero_state(problem.origin)
    trunk = jnp.asarray(trunk_weights(model.names))
    # joints that move before the hands do
    names = {*BODY_NAMES, "jaw"}
    body = np.asarray([model.joint_names[j] in names for j in problem.origin.joints])[:, None]
    ones, none = jnp.ones_like(trunk), jnp.zeros_like(trunk)

    def free(shape, joints):
        """Returns which numbers of a state move. Orientation and position always move. shape:
        whether the shape moves. joints: whether each joint moves.
        """
        return replace(
            resting,
            betas=jnp.full(resting.betas.shape, shape),
            global_orient=jnp.ones(3, bool),
            transl=jnp.ones(3, bool),
            body_pose=jnp.broadcast_to(jnp.asarray(joints), resting.body_pose.shape),
        )

    # points in space pull the body in one stage alone, and keypoints do not, if there are points
    points = replace(targets, known=targets.known * 1.0)
    unused = replace(targets, known=targets.known * 0.0)
    beside_points = jnp.where(jnp.any(targets.known), none, ones)
    scales = {name: jnp.asarray(scale) for name, scale in ROBUST_SCALES.items()}
    stages = [
        _Stage(trunk, unused, scales["rigid"], free(shape=False, joints=False)),
        _Stage(beside_points, points, scales["points"], free(shape=True, joints=body)),
        _Stage(ones, unused, scales["body"], free(shape=True, joints=body)),
        _Stage(ones, unused, scales["hands"], free(shape=True, joints=True)),
    ]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *stages)


def _noise_found(
    problem: KeypointProblem, observations: Observations, states: FitState
) -> Float[Array, " m"]:
    """Returns the noise of the detections in each frame, (m,), pixels. It is estimated from the
    errors of the keypoints in these states.
    """

    def of_frame(seen, state):
        errors = keypoint_errors(seen, problem.landmarks_and_joints(state)[0])
        known = seen.confidences * problem.known > 0
        lengths = jnp.where(known, jnp.linalg.norm(errors, axis=-1), jnp.nan)
        return found_noise(lengths, seen.noise)

    return jax.vmap(of_frame)(observations, states)


def _certainty_found(
    problem: KeypointProblem, observations: Observations, states: FitState
) -> Float[Array, " k"]:
    """Returns the certainty of each landmark, (k,): the noise of all landmarks, divided by the
    noise of this one.

    The noise of a landmark is estimated from the median error of its keypoints and of its mirror
    image's keypoints, in frames in which several views show the landmark. The noise that is used is
    a mean of this estimate and the usual noise, and at least half the usual noise. With fewer
    keypoints the usual noise has more weight.
    """
    names = problem.model.names

    def errors_of_frame(seen, state):
        """Returns the lengths of keypoint errors, (c, k), as multiples of the frame's noise. NaN if
        fewer than two views show the landmark.
        """
        errors = keypoint_errors(seen, problem.landmarks_and_joints(state)[0]) / seen.noise
        known = (seen.confidences > 0) & (problem.known > 0)
        shared = known & (jnp.sum(known, axis=0) > 1)
        return jnp.where(shared, jnp.linalg.norm(errors, axis=-1), jnp.nan)

    # left and right have one noise: each landmark has the errors of its mirror image, too
    mirror = np.asarray([names.index(mirrored_name(name)) for name in names])
    own = jax.vmap(errors_of_frame)(observations, states)
    found = jnp.stack([own, own[..., mirror]])
    ratio = jnp.nan_to_num(jnp.nanmedian(found, axis=(0, 1, 2)) / RAYLEIGH_MEDIAN, nan=1.0)
    # how many keypoints it comes from: of a pair the mean of its sides; a landmark in the middle is
    # in `found` twice and counts twice
    sides = 1 + (mirror != np.arange(len(mirror)))
    count = jnp.sum(~jnp.isnan(found), axis=(0, 1, 2)) / sides
    # the usual noise counts for 16 keypoints, and half of it is the least
    usual_count, least_share = 16, 0.5
    usual = 1 / problem.model.certainty
    variance = (usual_count * usual**2 + count * ratio**2) / (usual_count + count)
    return 1 / jnp.maximum(jnp.sqrt(variance), least_share * usual)


def _person_residuals(
    problem: KeypointProblem, observations: Observations, state: FitState
) -> dict[str, Float[Array, "..."]]:
    """Returns the residuals of all frames by kind. The person has the same body shape in all
    frames: "shape" and "places" are there once, and all other kinds for each frame. "places" is
    missing if the state has none.
    """

    def of_frame(seen, own):
        return frame_residuals(problem, seen, own, ROBUST_SCALES["person"])

    found = jax.vmap(of_frame, in_axes=(0, frame_axes(state)))(observations, state)
    found["shape"] = state.betas  # once, whatever the number of frames
    if state.places is not None:
        found["places"] = state.places
    return found


# Smooth motion
# --------------------------------------------------------------------------------------------------


@compiled()
def smooth_motion(
    model: LandmarkModel,
    observations: Observations,
    fit: LandmarkFit,
    smoothness: float | Float[Array, ""],
) -> LandmarkFit:
    """Returns a fit whose joints move as smoothly as `smoothness` expects, as far as the keypoints
    allow.

    Args:
        observations: the observations that were fitted.
        fit: the fit without smooth motion, of at least three frames.
        smoothness: expected acceleration of joints, metres per frame squared.

    Frames that show fewer than `FEW` landmarks are first interpolated between their neighbours.
    Then there are four solves, each from the result of the one before. They expect 64, 16, 4 and 1
    times `smoothness`. The first ones pull weakly, and bring those frames together that one view
    hardly determines.

    A solve is accepted if each frame agrees with its keypoints as well as in the fit, except for
    noise. The last accepted solve is the result. If no solve is accepted, the result is the
    interpolated fit if that is acceptable, else the fit.

    "Except for noise" means that the robust cost of a frame may exceed the fit's by p. Here p is
    the number of the frame's unknowns, or of its observed coordinates if these are fewer. The true
    pose exceeds the fit's cost by p / 2 on average: a fit with p unknowns removes p from the sum of
    the squared normal errors, and the cost is half that sum.
    """
    problem = keypoint_problem(replace(model, certainty=fit.certainty))
    seen = replace(observations, noise=fit.noise)
    costs = functools.partial(_keypoint_costs, problem, seen)
    # how much worse the keypoints of a frame may become: by its unknowns, or the numbers observed
    observed = 2 * jnp.sum(seen.confidences * problem.known > 0, axis=(1, 2))
    limit = costs(fit.state) + jnp.minimum(6 + 3 * len(problem.origin.joints), observed)

    def solve_level(carry, std):
        """Runs one solve, which starts from the result of the solve before. The result becomes the
        kept one if it is accepted.
        """
        state, kept, held = carry
        residuals = functools.partial(_motion_residuals, problem, seen, std)
        state, _ = solve(residuals, state, STEPS, method="lbfgs", tolerance=_TOLERANCE)
        good = jnp.all(costs(state) <= limit)
        kept, held = _chosen(good, (state, std), (kept, held))
        return (state, kept, held), None

    # frames without keypoints begin between their neighbours
    start = _bridged(problem, seen, fit.state)
    kept = _chosen(jnp.all(costs(start) <= limit), start, fit.state)
    levels = smoothness * jnp.asarray((64.0, 16.0, 4.0, 1.0))
    (_, state, held), _ = jax.lax.scan(solve_level, (start, kept, jnp.zeros(())), levels)
    return _result(problem, fit.noise, state, held)


def _keypoint_costs(
    problem: KeypointProblem, observations: Observations, state: FitState
) -> Float[Array, " m"]:
    """Returns the robust cost of the keypoints of each frame, (m,). It is half the sum of the
    squared residuals, which are in standard deviations.
    """

    def of_frame(seen, landmarks):
        return half_squares(
            keypoint_residuals(problem.model, seen, landmarks, ROBUST_SCALES["person"])
        )

    axes = frame_axes(state)
    landmarks = jax.vmap(problem.landmarks_and_joints, in_axes=(axes,))(state)[0]
    return jax.vmap(of_frame)(observations, landmarks)


def _motion_residuals(
    problem: KeypointProblem, observations: Observations, std: Float[Array, ""], state: FitState
) -> dict[str, Float[Array, "..."]]:
    """Returns the residuals of `_person_residuals`, and with the key "motion" the residuals of the
    joints' accelerations. std: the expected acceleration, metres per frame squared.
    """
    axes = frame_axes(state)
    joints = jax.vmap(problem.landmarks_and_joints, in_axes=(axes,))(state)[1]
    motion = robust(accelerations(joints) / std, MOTION_SCALE)
    return _person_residuals(problem, observations, state) | {"motion": motion}


def _chosen(good: Bool[Array, ""], new: Any, old: Any) -> Any:
    """Returns the new pytree if `good`, else the old one."""
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), new, old)


def accelerations(joints: Float[Array, "m j 3"] | Float[np.ndarray, "m j 3"]) -> Any:
    """Returns the accelerations of joints, (m - 2, j, 3), metres per frame squared. The first and
    last frame have none.
    """
    return joints[2:] - 2 * joints[1:-1] + joints[:-2]


def _bridged(problem: KeypointProblem, seen: Observations, state: FitState) -> FitState:
    """Returns the state with new poses in frames that show fewer than `FEW` landmarks. A new pose
    is interpolated between the nearest frames before and after that show enough. If there is such a
    frame on one side only, its pose is taken. If there is none at all, poses stay as they are.
    """
    m = len(seen.noise)
    shown = jnp.sum(jnp.any(seen.confidences * problem.known > 0, axis=1), axis=1) >= FEW
    frames = jnp.arange(m)
    before = jax.lax.cummax(jnp.where(shown, frames, -1))
    after = jax.lax.cummin(jnp.where(shown, frames, m), reverse=True)
    # frames before the first that shows something, or behind the last, take that one's pose
    low, high = jnp.where(before < 0, after, before), jnp.where(after >= m, before, after)
    # if no frame shows enough, each keeps its pose
    low, high = (jnp.where(jnp.any(shown), x, frames) for x in (low, high))
    share = (frames - low) / jnp.maximum(high - low, 1)
    poses, betas = _poses(problem, state), betas_of(problem.origin, state)
    rotations, translations = poses.rotations, poses.translation
    between = replace(
        poses,
        rotations=quaternion.interpolate(rotations[low], rotations[high], share[:, None]),
        translation=translations[low] + share[:, None] * (translations[high] - translations[low]),
    )
    bridged = jax.vmap(lambda pose: state_of(problem.origin, betas, pose))(between)
    moved = {}
    for name in ("global_orient", "transl", "body_pose"):
        new, old = getattr(bridged, name), getattr(state, name)
        moved[name] = jnp.where(shown.reshape(m, *[1] * (old.ndim - 1)), old, new)
    return replace(state, **moved)
