"""The state and the solver that all fits share. A state holds shape and poses and, if a fit moves
them, cameras, clothing and the places of landmarks.

The numbers of a state are deviations from an `Origin`, in units of their expected size. So a state
of zeros is the origin, and a step of length 1 means as much in all directions. If a number has a
prior, half its square is the negative log prior.

    keypoints    betas, the pose of every frame, places of    origin: the mean shape in the usual
                 landmarks                                    pose
    refinement   betas, poses, cameras, clothing              origin: a capture

The rotation by global_orient is applied after the root's rotation in the origin. The two rotation
vectors are not added, because near half a turn a sum does not measure a small rotation.

The module also has the prior of poses. For each joint, by its name in SMPL-X, it has the usual
rotation vector, and for each component a standard deviation and two limits, all in radians. The
axes are those of the T-pose: x to the person's left, y up, z forward. The limits are generous for
joints that turn about several axes (hips, shoulders).

The values are written for the left side. The right side is its mirror image (x, -y, -z). A knee
bends about +x, the left elbow about -y, left fingers about -z. The left arm hangs at z = -1.4.

The solver minimises half the sum of squared residuals over a pytree of numbers of about unit size.
A robust loss enters as a residual whose square is the loss. There are two methods:

    lbfgs   for many unknowns; cheap under vmap, and works through the renderer, which has a
            backward rule only
    lm      Levenberg and Marquardt by normal equations, for few unknowns; converges fast near the
            solution
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from humangs_jax.body.joints import FINGERS
from humangs_jax.body.model import EXACT, BodyPose
from humangs_jax.core.array_types import Array, Float, Int, PyTree
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import Camera

T = TypeVar("T")
NORMAL_MAD = 1.4826
"""Ratio of the standard deviation to the median absolute deviation, for a normal distribution."""


def half_squares(tree: PyTree) -> Float[Array, ""]:
    """Returns half the sum of the squares of all leaves."""
    return sum((0.5 * jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


def robust(errors: Float[Array, "*n d"], scale: Float[Array, ""] | float) -> Float[Array, "*n d"]:
    """Returns e c / sqrt(c^2 + |e|^2) for each error e, where c is the scale. The squared lengths
    of these vectors are the Geman-McClure loss.

    Small errors hardly change, and no result is longer than c. So a keypoint on another person has
    a residual of at most c.
    """
    return errors * (
        scale / jnp.sqrt(scale * scale + jnp.sum(jnp.square(errors), axis=-1, keepdims=True))
    )


def solve(
    residuals: Callable[[T], PyTree],
    start: T,
    steps: int,
    *,
    method: Literal["lbfgs", "lm"],
    tolerance: float = 1e-4,
    free: T | None = None,
) -> tuple[T, Float[Array, ""]]:
    """Minimises half the sum of squared residuals.

    Args:
        residuals: function that returns a pytree of residuals.
        start: pytree of unknowns to begin with.
        steps: largest number of steps.
        method: see the module's docstring.
        tolerance: the solver stops when a step changes each unknown and the loss by less than this
            number times (1 + its size).
        free: pytree of booleans with the structure of `start`. A number moves only if its boolean
            is True. None: all numbers move.
    Returns: the solution and half its sum of squared residuals. If the solution is worse than the
    start, or not finite, the start and its value are returned.
    """
    import lineax
    import optimistix

    with jax.default_matmul_precision("highest"):  # the solvers' own products, too
        # programs over one vector compile in half the time of those over trees
        flat, unravel = ravel_pytree(start)
        moving = None if free is None else ravel_pytree(free)[0]

        def held(y):
            """Returns the unknowns, with numbers that are not free as at the start."""
            return y if moving is None else jnp.where(moving, y, flat)

        def of(y):
            return residuals(unravel(held(y)))

        if method == "lbfgs":
            lbfgs = optimistix.LBFGS(tolerance, tolerance, history_length=20)
            found = optimistix.minimise(
                lambda y, _: half_squares(of(y)), lbfgs, flat, max_steps=steps, throw=False
            )
        else:
            lm = optimistix.LevenbergMarquardt(
                tolerance, tolerance, linear_solver=lineax.Normal(lineax.Cholesky())
            )
            found = optimistix.least_squares(
                lambda y, _: ravel_pytree(of(y))[0], lm, flat, max_steps=steps, throw=False
            )
        before, after = half_squares(of(flat)), half_squares(of(found.value))
        better = after <= before  # False for NaN
        solution = jnp.where(better, found.value, flat)
        return unravel(held(solution)), jnp.where(better, after, before)


MIRROR = np.asarray([1.0, -1.0, -1.0])
"""Factors that turn a rotation vector into its mirror image."""
_UNLIMITED = np.pi
"""Limit for components of a rotation vector that have no real limit, radians."""


Vector = tuple[float, float, float]


class Range(NamedTuple):
    """The prior of one joint's rotation vector. Each entry has three components."""

    mean: Vector
    """Usual rotation vector, radians."""
    std: Vector
    """Standard deviation of each component, radians."""
    lower: Vector
    """Lower limit of each component, radians."""
    upper: Vector
    """Upper limit of each component, radians."""


_UNKNOWN = Range(
    (0.0, 0.0, 0.0),
    (0.3, 0.3, 0.3),
    (-_UNLIMITED, -_UNLIMITED, -_UNLIMITED),
    (_UNLIMITED, _UNLIMITED, _UNLIMITED),
)
_SPINE = Range((0.03, 0.0, 0.0), (0.2, 0.15, 0.15), (-0.5, -0.5, -0.5), (0.8, 0.5, 0.5))
_NECK = Range((0.0, 0.0, 0.0), (0.25, 0.3, 0.2), (-0.8, -0.9, -0.6), (0.8, 0.9, 0.6))
_THUMB = Range((0.1, 0.15, -0.05), (0.3, 0.3, 0.3), (-0.8, -0.9, -1.0), (0.8, 1.2, 0.8))
_FINGER = Range((0.0, 0.0, -0.35), (0.1, 0.1, 0.5), (-0.4, -0.4, -1.9), (0.4, 0.4, 0.4))
_KNUCKLE = Range((0.0, 0.0, -0.3), (0.15, 0.2, 0.5), (-0.5, -0.6, -1.8), (0.5, 0.6, 0.6))

_RANGES = {
    "pelvis": _UNKNOWN._replace(std=(1.0, 1.0, 1.0)),
    "spine1": _SPINE,
    "spine2": _SPINE,
    "spine3": _SPINE,
    "neck": _NECK,
    "head": _NECK,
    "left_hip": Range((-0.2, 0.05, 0.05), (0.6, 0.3, 0.3), (-2.6, -1.2, -0.8), (0.8, 1.2, 1.6)),
    "left_knee": Range(
        (0.4, 0.0, 0.0), (0.6, 0.08, 0.08), (-0.15, -0.25, -0.25), (2.7, 0.25, 0.25)
    ),
    "left_ankle": Range((-0.1, 0.0, 0.0), (0.3, 0.15, 0.2), (-1.0, -0.6, -0.7), (1.0, 0.6, 0.7)),
    "left_foot": Range((0.0, 0.0, 0.0), (0.3, 0.05, 0.05), (-1.2, -0.2, -0.2), (0.5, 0.2, 0.2)),
    "left_collar": Range((0.0, 0.0, 0.0), (0.1, 0.12, 0.15), (-0.3, -0.5, -0.4), (0.3, 0.5, 0.7)),
    "left_shoulder": Range((0.0, -0.1, -0.8), (0.5, 0.6, 0.7), (-1.8, -2.4, -2.0), (1.8, 1.5, 2.0)),
    "left_elbow": Range((0.0, -0.5, 0.0), (0.35, 0.7, 0.2), (-1.3, -2.7, -0.7), (1.3, 0.15, 0.7)),
    "left_wrist": Range((0.0, 0.0, 0.0), (0.3, 0.3, 0.4), (-0.9, -0.8, -1.4), (0.9, 0.8, 1.4)),
    "jaw": Range((0.0, 0.0, 0.0), (0.1, 0.03, 0.03), (-0.1, -0.2, -0.2), (0.6, 0.2, 0.2)),
    "left_eye": Range((0.0, 0.0, 0.0), (0.1, 0.1, 0.03), (-0.5, -0.6, -0.2), (0.5, 0.6, 0.2)),
    **{f"left_thumb{k}": _THUMB for k in (1, 2, 3)},
    **{f"left_{finger}1": _KNUCKLE for finger in FINGERS if finger != "thumb"},
    **{f"left_{finger}{k}": _FINGER for finger in FINGERS if finger != "thumb" for k in (2, 3)},
}
"""Ranges of everyday movement by joint, for the joints in the middle and on the left side. They are
wider than measured joint angles, because components of a rotation vector are not joint angles.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class PosePrior:
    """The prior of the rotations of a body's j joints, in the body's order.

    For the root only the mean is used, because every orientation is equally likely.
    """

    mean: Float[np.ndarray, "j 3"]
    """Usual rotation vectors, (j, 3), radians."""
    std: Float[np.ndarray, "j 3"]
    """Standard deviations, (j, 3), radians."""
    lower: Float[np.ndarray, "j 3"]
    """Lower limits, (j, 3), radians."""
    upper: Float[np.ndarray, "j 3"]
    """Upper limits, (j, 3), radians."""


def pose_prior(joint_names: tuple[str, ...]) -> PosePrior:
    """Returns the prior of a body. Joints without a SMPL-X name have mean 0, standard deviation 0.3
    rad and no limits.
    """
    rows = []
    for name in joint_names:
        row = np.asarray(_RANGES.get(name.replace("right_", "left_", 1), _UNKNOWN))
        if name.startswith("right_"):
            row = row * np.stack([MIRROR, np.ones(3), MIRROR, MIRROR])
            row[2:] = np.sort(row[2:], axis=0)
        rows.append(row)
    return PosePrior(*np.stack(rows, axis=1).astype(np.float32))


def limit_residuals(
    prior: PosePrior, joints: tuple[int, ...], rotations: Float[Array, "j 3"]
) -> Float[Array, "a 3"]:
    """Returns how far joints turn beyond their limits, (a, 3), in standard deviations. joints:
    indices of the a joints. rotations: rotation vectors of all joints, (j, 3), radians.
    """
    rows = np.asarray(joints, int)
    turned = rotations[rows]
    beyond = jnp.maximum(prior.lower[rows] - turned, turned - prior.upper[rows])
    # 20 standard deviations per radian: 3 degrees count as much as one
    return 20.0 * jnp.maximum(beyond, 0.0)


_RADIANS = math.pi / 180
"""Radians in a degree."""
SAME = 1e-4
"""Two cameras count as one if all their numbers differ by less than this. The numbers are the
logarithm of the focal length, K divided by the focal length, and cam_from_world in metres.
"""


@pytree_dataclass
class StateStd:
    """Expected sizes of the deviations from an origin, as standard deviations.

    They are numbers, or arrays () if one compiled program is used for all values.
    """

    focal: Float[Array, ""] | float = 0.05
    """Standard deviation of the logarithm of focal lengths."""
    camera_rotation: Float[Array, ""] | float = 2.0
    """Standard deviation of a camera's rotation about each axis, degrees."""
    camera_center: Float[Array, ""] | float = 0.05
    """Standard deviation of a camera's position along each axis, metres."""
    global_orient: Float[Array, ""] | float = 3.0
    """Standard deviation of the person's orientation about each axis, degrees."""
    transl: Float[Array, ""] | float = 0.05
    """Standard deviation of the person's position along each axis, metres."""
    body_pose: Float[Array, ""] | float = 4.0
    """Standard deviation of each joint's rotation about each axis, degrees. Only refinements use
    it.
    """
    betas: Float[Array, ""] | float = 0.3
    """Standard deviation of the shape coefficients."""
    clothing: Float[Array, ""] | float = 0.03
    """Standard deviation of the thickness of clothes and hair on each segment of the body,
    metres.
    """


FREE = StateStd(global_orient=math.degrees(0.3), transl=0.1, betas=1.0)
"""Units for a fit without a start. Orientation and position have no prior in such a fit, and their
units only set the step lengths of the solver. The shape has its usual standard deviation.
"""


@pytree_dataclass
class CameraState:
    """Deviations of c cameras and g focal lengths from the origin, in units of `StateStd`."""

    rotations: Float[Array, "c 3"]
    """Deviations of the rotations, (c, 3)."""
    centers: Float[Array, "c 3"]
    """Deviations of the centres, (c, 3)."""
    log_focals: Float[Array, " g"]
    """Deviations of the logarithms of the focal lengths, (g,)."""


@pytree_dataclass
class FitState:
    """The numbers that a fit moves, in units that the `Origin` gives. Parts that the fit does not
    move are None.

    In a fit of m frames the poses have a leading axis (m, ...), and all frames share one shape. The
    number of free joints is a.
    """

    betas: Float[Array, " s"]
    """Deviations of the shape coefficients, (s,)."""
    global_orient: Float[Array, "*m 3"]
    """Rotation vectors that are applied after the root's rotation in the origin, (3,) or (m, 3)."""
    transl: Float[Array, "*m 3"]
    """Deviations of the position, (3,) or (m, 3)."""
    body_pose: Float[Array, "*m a 3"]
    """Deviations of the rotation vectors of the free joints, (a, 3) or (m, a, 3)."""
    cameras: CameraState | None = None
    """Deviations of the cameras. None if the fit does not move them."""
    clothing: Float[Array, " b"] | None = None
    """Thickness of clothes on each segment of the body, (a + 1,), in units of `StateStd`. The
    segments belong to the root and to the free joints. None if the fit has no clothing.
    """
    places: Float[Array, "g 3"] | None = None
    """Deviations of the places of g groups of landmarks, (g, 3), see `LandmarkModel.moved`. Their
    unit is `residuals.keypoints.PLACE_STD`. None if the fit does not move them.
    """


@pytree_dataclass
class CameraOrigin:
    """The cameras of v views at the start of a fit, and for each view the indices of its numbers in
    the state.
    """

    K: Float[Array, "v 3 3"]
    """Intrinsics, (v, 3, 3), pixels."""
    cam_from_world: Float[Array, "v 4 4"]
    """Camera poses, (v, 4, 4), metres."""
    camera: Int[Array, " v"]
    """Index of each view's camera in the state, (v,)."""
    focal: Int[Array, " v"]
    """Index of each view's focal length in the state, (v,)."""
    frame: Int[Array, " v"]
    """Index of each view's frame, (v,)."""


@pytree_dataclass
class Origin:
    """Shape, poses and cameras that a state of zeros stands for, and the units of a state's
    numbers.
    """

    betas: Float[Array, " s"]
    """Shape coefficients, (s,)."""
    pose: BodyPose
    """Pose of one frame, or a batch of m."""
    body_pose_std: Float[Array, "a 3"]
    """Standard deviations of the free joints' rotation vectors, (a, 3), radians."""
    cameras: CameraOrigin | None = None
    """Cameras of the views. None for a fit without cameras."""
    segment: Int[Array, " j"] | None = None
    """Index into `FitState.clothing` for each joint, (j,). None if the fit has no clothing."""
    joints: tuple[int, ...] = static_field(default=())
    """Indices of the a free joints. The root (joint 0) is always free and not among them."""
    std: StateStd = FREE
    """Units of all numbers of a state except joints' rotations and landmarks' places."""

    @property
    def views(self) -> CameraOrigin:
        """The cameras of the views.

        Raises: ValueError if the origin has no cameras.
        """
        if self.cameras is None:
            raise ValueError("expected an origin with cameras")
        return self.cameras


def usual_origin(prior: PosePrior, joints: tuple[int, ...], coefficients: int) -> Origin:
    """Returns an origin with the mean shape, in the prior's usual pose, at the world's origin.
    joints: indices of the free joints. coefficients: number of shape coefficients.
    """
    pose = BodyPose(from_host(prior.mean), _zeros(3))
    std = from_host(prior.std[np.asarray(joints, int)])
    return Origin(betas=_zeros(coefficients), pose=pose, body_pose_std=std, joints=joints)


def zero_state(origin: Origin) -> FitState:
    """Returns the state of zeros, which stands for the origin."""
    frames, a = origin.pose.translation.shape[:-1], len(origin.joints)
    cameras = None
    views = origin.cameras
    if views is not None:
        count, focals = (int(np.max(np.asarray(x))) + 1 for x in (views.camera, views.focal))
        cameras = CameraState(
            rotations=_zeros(count, 3), centers=_zeros(count, 3), log_focals=_zeros(focals)
        )
    return FitState(
        betas=_zeros(len(origin.betas)),
        global_orient=_zeros(*frames, 3),
        transl=_zeros(*frames, 3),
        body_pose=_zeros(*frames, a, 3),
        cameras=cameras,
        clothing=None if origin.segment is None else _zeros(a + 1),
    )


def _zeros(*shape: int) -> Float[Array, "..."]:
    """Returns zeros that are made on the host, so that JAX compiles no program for them."""
    return from_host(np.zeros(shape, np.float32))


def frame_axes(state: FitState) -> FitState:
    """Returns the `in_axes` of `jax.vmap` for a state with one shape and a batch of frames."""
    none = jax.tree.map(lambda leaf: None, state)
    return replace(none, global_orient=0, transl=0, body_pose=0)


def betas_of(origin: Origin, state: FitState) -> Float[Array, " s"]:
    """Returns the shape coefficients of a state, (s,)."""
    return origin.betas + origin.std.betas * state.betas


def pose_of(origin: Origin, state: FitState) -> BodyPose:
    """Returns the pose of a state, or a batch of poses. It is differentiable everywhere.

    Joints that are not free keep the rotations of the origin.
    """
    rotations = origin.pose.rotations
    rotations = rotations.at[..., np.asarray(origin.joints, int), :].add(
        origin.body_pose_std * state.body_pose
    )
    turn = quaternion.from_axis_angle(_RADIANS * origin.std.global_orient * state.global_orient)
    root = quaternion.multiply(turn, quaternion.from_axis_angle(origin.pose.rotations[..., 0, :]))
    rotations = rotations.at[..., 0, :].set(quaternion.to_axis_angle(root))
    translation = origin.pose.translation + origin.std.transl * state.transl
    return replace(origin.pose, rotations=rotations, translation=translation)


def state_of(origin: Origin, betas: Float[Array, " s"], pose: BodyPose) -> FitState:
    """Returns the state that stands for a shape and a pose, or for a batch of poses. Joints that
    are not free are ignored.

    The state has no cameras, no clothing and no places of landmarks.
    """
    joints, start = np.asarray(origin.joints, int), origin.pose
    conjugate = quaternion.from_axis_angle(-start.rotations[..., 0, :])
    turn = quaternion.multiply(quaternion.from_axis_angle(pose.rotations[..., 0, :]), conjugate)
    turned = pose.rotations[..., joints, :] - start.rotations[..., joints, :]
    return FitState(
        betas=(betas - origin.betas) / origin.std.betas,
        global_orient=quaternion.to_axis_angle(turn) / (_RADIANS * origin.std.global_orient),
        transl=(pose.translation - start.translation) / origin.std.transl,
        body_pose=turned / origin.body_pose_std,
    )


def cameras_of(
    origin: Origin, state: FitState
) -> tuple[Float[Array, "v 3 3"], Float[Array, "v 4 4"]]:
    """Returns K, (v, 3, 3), and cam_from_world, (v, 4, 4), of every view in a state. If the state
    has no cameras, they are the origin's.

    A camera is rotated about its centre, in its axes. Its centre is shifted, and its focal lengths
    are multiplied by a factor.
    Raises: ValueError if the origin has no cameras.
    """
    start, moved, std = origin.views, state.cameras, origin.std
    if moved is None:
        return start.K, start.cam_from_world
    turn = quaternion.matrix_from_axis_angle(
        _RADIANS * std.camera_rotation * moved.rotations[start.camera]
    )
    center = (
        transform.invert_rigid(start.cam_from_world)[:, :3, 3]
        + std.camera_center * moved.centers[start.camera]
    )
    rotation = jnp.matmul(turn, start.cam_from_world[:, :3, :3], precision=EXACT)
    translation = -jnp.einsum("vab,vb->va", rotation, center, precision=EXACT)
    zoom = jnp.exp(std.focal * moved.log_focals)[start.focal]
    factors = jnp.stack([zoom, zoom, jnp.ones_like(zoom)], axis=-1)
    K = start.K * (jnp.eye(3) * factors[:, None] + (1 - jnp.eye(3)))
    return K, transform.make(rotation, translation)


def clothing_thickness(
    origin: Origin, state: FitState, weights: Float[Array, "*p j"]
) -> Float[Array, "*p"]:
    """Returns how far masks reach beyond the body at points of the surface, (...), metres. It is 0
    if there is no clothing. weights: skinning weights of the points, (..., j).
    """
    if origin.segment is None or state.clothing is None:
        return jnp.zeros(weights.shape[:-1])
    return origin.std.clothing * jnp.matmul(
        weights, state.clothing[origin.segment], precision=EXACT
    )


def segments(parents: tuple[int, ...], joints: tuple[int, ...]) -> Int[np.ndarray, " j"]:
    """Returns the segment of each joint, (j,). It is 0 for the root, and 1 + i for joint
    `joints[i]`. Each other joint has the segment of its nearest ancestor with a segment.
    """
    number = {joint: i + 1 for i, joint in enumerate(joints)} | {parents.index(-1): 0}
    found = []
    for joint in range(len(parents)):
        while joint not in number:
            joint = parents[joint]
        found.append(number[joint])
    return np.asarray(found, np.int32)


def camera_origin(cameras: Camera, frames: Int[np.ndarray, " v"]) -> CameraOrigin:
    """Returns the origin of cameras. Views with the same K and cam_from_world share a camera in the
    state. Views with the same focal lengths share a focal length in the state. frames: frame of
    each view, (v,).
    """
    K, matrices = np.asarray(cameras.K, float), np.asarray(cameras.cam_from_world, float)
    camera = camera_numbers(K, matrices, SAME)
    focal = _numbered(np.log(K[:, [0, 1], [0, 1]]), SAME)
    return CameraOrigin(cameras.K, cameras.cam_from_world, *map(from_host, (camera, focal, frames)))


def camera_numbers(
    K: Float[np.ndarray, "v 3 3"], matrices: Float[np.ndarray, "v 4 4"], same: float
) -> Int[np.ndarray, " v"]:
    """Returns the number of each view's camera, (v,), from 0. Two views have the same number if
    their K and cam_from_world are the same. same: largest difference between views of one camera,
    see `SAME`.
    """
    focal = K[:, :1, 0]
    rows = [np.log(focal), K.reshape(len(K), -1) / focal, matrices.reshape(len(K), -1)]
    return _numbered(np.concatenate(rows, axis=1), same)


def _numbered(rows: Float[np.ndarray, "n d"], same: float) -> Int[np.ndarray, " n"]:
    """Returns a number for each row, (n,), from 0. A row gets the number of an earlier row if it
    differs by less than `same` in all columns from the first row with this number.
    """
    numbers, known = np.zeros(len(rows), np.int32), np.empty((0, rows.shape[1]))
    for i, row in enumerate(rows):
        alike = np.flatnonzero(np.abs(known - row).max(axis=1) < same)
        if len(alike):
            numbers[i] = alike[0]
        else:
            numbers[i] = len(known)
            known = np.concatenate([known, row[None]])
    return numbers
