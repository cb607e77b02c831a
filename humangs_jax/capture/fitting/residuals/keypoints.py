"""Keypoints as evidence: observations and their residuals. Observations have fixed shapes, so that
they can be vmapped over frames and people.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel, kind_of, pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.capture.fitting.state import (
    FitState,
    Origin,
    PosePrior,
    betas_of,
    limit_residuals,
    pose_of,
    robust,
)
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.photos import Photos
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.mesh import smallest_turns
from humangs_jax.geometry.transform import EXACT

AnyArray = Float[Array, "m c ..."] | Float[np.ndarray, "m c ..."]
NEAR = 0.05
"""Smallest depth, metres. Smaller depths are clamped to it."""
NOISE = 0.005
"""Expected standard deviation of detections, as a share of the person's size in the photo. It is 2
pixels for a person of 400 pixels.
"""
LEAST_NOISE = 0.3
"""The expected standard deviation of detections is at least this, pixels."""
OUTER = (0.03, 0.97)
"""A person's size is measured between these two quantiles of the coordinates, so that outliers do
not count.
"""
_NOISE_RANGE = (0.5, 8.0)
"""Smallest and largest noise that a fit can find, as multiples of the expected noise."""
PLACE_STD = 0.02
"""Standard deviation, along each axis, of the offset from the place on the body where a landmark is
expected to the place where a detector sees it, metres.
"""
_WORLD_STD = 0.15
"""Standard deviation of a detector's 3D landmarks, as a share of the person's size. The size is the
root mean square distance of the landmarks from their mean.
"""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a 2D vector with two normal components of standard deviation 1."""


@pytree_dataclass
class Observations(Batchable):
    """Keypoints of one frame in c views. The keypoints of a missing view have confidence 0."""

    points: Float[Array, "c k 2"]
    """Detected points, (c, k, 2), pixels, with the centre of the first pixel at (0.5, 0.5)."""
    confidences: Float[Array, "c k"]
    """Confidences, (c, k), in [0, 1]. 0 where a point is not seen."""
    K: Float[Array, "c 3 3"]
    """Intrinsics, (c, 3, 3), pixels."""
    cam_from_world: Float[Array, "c 4 4"]
    """Camera poses, (c, 4, 4), metres."""
    noise: Float[Array, ""]
    """Standard deviation of the detections, (), pixels."""
    world: Float[Array, "c k 3"] | None = None
    """Positions at which the detector sees the landmarks in space, (c, k, 3), in the camera's axes.
    Translation and scale are arbitrary. None without such positions.
    """


def make_observations(
    points: AnyArray,
    confidences: AnyArray,
    K: AnyArray,
    cam_from_world: AnyArray,
    world: AnyArray | None = None,
) -> Observations:
    """Returns a batch of m frames from arrays (m, c, ...). The noise of each frame is computed from
    the keypoints, see `expected_noise`.
    """
    noise = expected_noise(np.asarray(points), np.asarray(confidences))
    given = [points, confidences, K, cam_from_world, noise]
    if world is not None:
        given.append(world)
    return jax.vmap(Observations)(*(from_host(x, np.float32) for x in given))


def scaled_observations(cameras: Camera, keypoints: Keypoints, photos: Camera) -> Observations:
    """Returns keypoints of photos, in pixels of resized photos. The result is a batch of views with
    c = 1. All views have the same noise, computed from all of them together.

    cameras: cameras of the resized photos. photos: cameras of the photos.
    """
    scale = np.asarray(
        [cameras.width / photos.width, cameras.height / photos.height], keypoints.points.dtype
    )
    points = np.where(keypoints.confidences[..., None] > 0, keypoints.points, 0.0) * scale
    places = (cameras.K, cameras.cam_from_world)
    arrays = (points, keypoints.confidences, *map(np.asarray, places))
    noise = expected_noise(points[None], keypoints.confidences[None])
    return replace(
        make_observations(*(x[:, None] for x in arrays)),
        noise=from_host(np.repeat(noise, len(points))),
    )


def group_by_frame(
    photos: Photos | Capture, keypoints: Keypoints
) -> tuple[Observations, Int[np.ndarray, "m c"]]:
    """Returns the keypoints as a batch of m frames, and the indices of each frame's views, (m, c).
    If a frame has fewer views than others, the remaining indices are -1. 3D landmarks are kept only
    if every frame has one view.
    """
    frames, count = np.asarray(photos.frames), photos.frame_count
    # frames with fewer views than others have missing ones, whose keypoints have confidence 0
    members = [np.flatnonzero(frames == frame) for frame in range(count)]
    views = np.full((count, max(len(own) for own in members)), -1)
    for row, own in zip(views, members, strict=True):
        row[: len(own)] = own
    confidences = np.where(views[..., None] < 0, 0.0, keypoints.confidences[views])
    points = np.where(confidences[..., None] > 0, keypoints.points[views], 0.0)
    K = np.asarray(photos.cameras.K)[views]
    places = np.asarray(photos.cameras.cam_from_world)[views]
    world = None
    # several views say more than what the detector sees in any of them
    if keypoints.world is not None and views.shape[1] == 1:
        # the ray goes through the hips, or through all landmarks where no hip is seen
        hips = np.asarray([kind_of(name) == "hip" for name in keypoints.set.names])
        of_hips = confidences * hips
        weights = np.where(of_hips.any(-1, keepdims=True), of_hips, confidences)
        world = in_camera_axes(keypoints.world[views], points, weights, K)
    observations = make_observations(points, confidences, K, places, world)
    return observations, views


def in_camera_axes(
    world: Float[np.ndarray, "*b k 3"],
    points: Float[np.ndarray, "*b k 2"],
    weights: Float[np.ndarray, "*b k"],
    K: Float[np.ndarray, "*b 3 3"],
) -> Float[np.ndarray, "*b k 3"]:
    """Returns a detector's 3D landmarks in the axes of the camera, (..., k, 3).

    world: landmarks in axes that have z along the ray from the camera through the weighted mean of
    `points`. points: pixels, (..., k, 2). weights: (..., k). K: intrinsics, (..., 3, 3), pixels.
    """
    total = weights.sum(-1, keepdims=True)
    middle = (weights[..., None] * points).sum(-2) / np.maximum(total, 1e-9)
    focal, center = np.diagonal(K, axis1=-2, axis2=-1)[..., :2], K[..., :2, 2]
    rays = np.concatenate(
        [np.where(total > 0, (middle - center) / focal, 0), np.ones_like(total)], axis=-1
    )
    optical_axis = np.asarray([0.0, 0.0, 1.0])
    turns = smallest_turns(optical_axis, rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    return np.einsum("...ab,...kb->...ka", turns, world)


def expected_noise(
    points: Float[np.ndarray, "m c k 2"], confidences: Float[np.ndarray, "m c k"]
) -> Float[np.ndarray, " m"]:
    """Returns the expected noise of the keypoints in each frame, (m,), pixels. It is proportional
    to the median size of the person in the views, and at least `LEAST_NOISE`. It is 1 if nothing is
    seen.
    """

    def of_frame(points, seen):
        sizes = [
            np.ptp(np.quantile(p[s], OUTER, axis=0), axis=0).max()
            for p, s in zip(points, seen, strict=True)
            if s.any()
        ]
        return max(NOISE * float(np.median(sizes)), LEAST_NOISE) if sizes else 1.0

    return np.asarray(
        [of_frame(p, seen) for p, seen in zip(points, confidences > 0, strict=True)], np.float32
    )


def found_noise(lengths: Array | np.ndarray, expected: Array | np.ndarray | np.floating) -> Any:
    """Returns the noise of keypoints. It is estimated from the median length of their errors, so
    that outliers hardly change it. It stays within `_NOISE_RANGE` times the expected noise.

    lengths: lengths of the errors, NaN where an error is missing. If all are missing, the expected
    noise is returned. All arguments and the result have the same unit. If `lengths` is a numpy
    array, the result is a value of numpy, else of JAX.
    """
    xp: Any = jnp
    if isinstance(lengths, np.ndarray):
        xp, lengths = np, lengths[~np.isnan(lengths)]
        if not len(lengths):
            return np.asarray(expected)
    median = xp.nanmedian(lengths)
    found = xp.where(xp.isnan(median), expected, median / RAYLEIGH_MEDIAN)
    return xp.clip(found, _NOISE_RANGE[0] * expected, _NOISE_RANGE[1] * expected)


def in_cameras(observations: Observations, points: Float[Array, "k 3"]) -> Float[Array, "c k 3"]:
    """Returns points of the world in the coordinates of every camera, (c, k, 3), metres."""
    rotation = observations.cam_from_world[:, :3, :3]
    translation = observations.cam_from_world[:, :3, 3]
    return jnp.einsum("cab,kb->cka", rotation, points, precision=EXACT) + translation[:, None]


def focal_lengths(observations: Observations) -> Float[Array, "c 1 2"]:
    """Returns fx and fy of every view, (c, 1, 2), pixels."""
    return jnp.stack([observations.K[:, 0, 0], observations.K[:, 1, 1]], axis=-1)[:, None]


def keypoint_errors(
    observations: Observations, landmarks: Float[Array, "k 3"]
) -> Float[Array, "c k 2"]:
    """Returns projected landmarks minus detections, (c, k, 2), pixels."""
    seen = in_cameras(observations, landmarks)
    pixels = seen[..., :2] / jnp.maximum(seen[..., 2:], NEAR) * focal_lengths(observations)
    return pixels + observations.K[:, None, :2, 2] - observations.points


@compiled(static=["errors"])
def body_errors(
    model: LandmarkModel,
    betas: Float[Array, " s"],
    poses: BodyPose,
    seen: Observations,
    frames: Int[Array | np.ndarray, " n"],
    errors: Callable[
        [Observations, Float[Array, "k 3"]], Float[Array, "c k ..."]
    ] = keypoint_errors,
) -> Float[Array, "n c k ..."]:
    """Returns the errors of a posed body for a batch of n observations, (n, c, k, ...), by the
    function `errors`. frames: index of each observation's pose in `poses`, (n,).
    """
    landmarks = jax.vmap(lambda pose: pose_landmarks(model, betas, pose)[0])(poses)
    return jax.vmap(errors)(seen, landmarks[frames])


_TRUNK = ("shoulder", "hip", "neck", "mid_hip", "nose", "eye", "ear")
"""Kinds of landmarks of trunk and head. Arms and legs do not move them."""


def trunk_weights(names: tuple[str, ...]) -> Float[np.ndarray, " k"]:
    """Returns weights of landmarks, (k,): 1 for trunk and head, and 0.02 for all others. The others
    therefore matter only if trunk and head are not seen.
    """
    return np.asarray([1.0 if kind_of(name) in _TRUNK else 0.02 for name in names], np.float32)


def keypoint_residuals(
    model: LandmarkModel,
    observations: Observations,
    landmarks: Float[Array, "k 3"],
    scale: Float[Array, ""] | float,
) -> Float[Array, "c k 2"]:
    """Returns the residuals of keypoints, (c, k, 2). They are robust errors in standard deviations,
    multiplied by the square root of the confidence. They are 0 for landmarks that the body lacks.
    scale: robust scale, in standard deviations.
    """
    errors = (
        keypoint_errors(observations, landmarks) / observations.noise * model.certainty[:, None]
    )
    weights = observations.confidences * np.asarray(model.known, np.float32)
    return _roots(weights)[..., None] * robust(errors, scale)


def _roots(weights: Float[Array, "c k"]) -> Float[Array, "c k"]:
    """Returns the square roots of weights. Their derivative is finite at 0."""
    return jnp.where(weights > 0, jnp.sqrt(jnp.where(weights > 0, weights, 1.0)), 0.0)


def world_residuals(
    model: LandmarkModel,
    observations: Observations,
    landmarks: Float[Array, "k 3"],
    scale: Float[Array, ""] | float,
) -> Float[Array, "c k"]:
    """Returns the residuals of depths, (c, k). They are robust differences between the depths of
    the body's landmarks and of the detector's 3D landmarks, in standard deviations, multiplied by
    the square root of the confidence. Both are first centred, and scaled to size 1. scale: robust
    scale, in standard deviations.
    """
    weights = observations.confidences * np.asarray(model.known, np.float32)
    total = jnp.maximum(jnp.sum(weights, axis=1), 1e-6)

    def centered(x):
        """Returns points minus their weighted mean."""
        return x - jnp.sum(weights[..., None] * x, axis=1, keepdims=True) / total[..., None, None]

    def size(x):
        """Returns the root mean square length of centred points, (c, 1)."""
        square = jnp.sum(weights * jnp.sum(jnp.square(x), axis=-1), axis=1) / total
        return jnp.sqrt(square + NEAR**2)[:, None]

    ours, theirs = centered(in_cameras(observations, landmarks)), centered(observations.world)
    errors = ours[..., 2] / size(ours) - theirs[..., 2] / size(theirs)
    return _roots(weights) * robust(errors[..., None] / _WORLD_STD, scale)[..., 0]


@pytree_dataclass
class Targets:
    """Triangulated landmarks, to which a stage of a fit pulls the body."""

    points: Float[Array, "k 3"]
    """Positions, (k, 3), metres."""
    known: Float[Array, " k"] | Bool[Array, " k"]
    """Weights, (k,). 0 for landmarks that were not triangulated."""
    pixel: Float[Array, ""]
    """Length at the person that corresponds to one pixel, (), metres."""


@dataclasses.dataclass(frozen=True, eq=False)
class KeypointProblem:
    """The constants of a fit to keypoints."""

    model: LandmarkModel
    """Landmarks of the body."""
    prior: PosePrior
    """Prior of poses and limits of joints."""
    origin: Origin
    """Shape and pose from which a state counts its deviations, and their units."""

    @property
    def known(self) -> Float[np.ndarray, " k"]:
        """1 for landmarks that the body has, 0 for others, (k,)."""
        return np.asarray(self.model.known, np.float32)

    def model_of(self, state: FitState) -> LandmarkModel:
        """Returns the landmark model with the state's places of landmarks. If the state has no
        places, it is the model of the problem.
        """
        return self.model if state.places is None else self.model.moved(PLACE_STD * state.places)

    def landmarks_and_joints(
        self, state: FitState
    ) -> tuple[Float[Array, "k 3"], Float[Array, "j 3"]]:
        """Returns the landmarks, (k, 3), and the joints, (j, 3), of the body in a state, metres."""
        return pose_landmarks(
            self.model_of(state), betas_of(self.origin, state), pose_of(self.origin, state)
        )


def frame_residuals(
    problem: KeypointProblem,
    observations: Observations,
    state: FitState,
    scale: Float[Array, ""] | float,
    targets: Targets | None = None,
) -> dict[str, Float[Array, "..."]]:
    """Returns all residuals of one frame by kind. Half the sum of their squares is the negative log
    posterior, up to a constant.

    scale: robust scale of keypoints, depths and targets, in standard deviations. targets:
    triangulated landmarks, or None.
    """
    betas, pose = betas_of(problem.origin, state), pose_of(problem.origin, state)
    landmarks, _ = pose_landmarks(problem.model_of(state), betas, pose)
    found = {
        "keypoints": keypoint_residuals(problem.model, observations, landmarks, scale),
        "pose": state.body_pose,
        "limits": limit_residuals(problem.prior, problem.origin.joints, pose.rotations),
        "shape": state.betas,
    }
    if observations.world is not None:
        found["world"] = world_residuals(problem.model, observations, landmarks, scale)
    if targets is not None:
        known = (targets.known * problem.known)[:, None]
        std = targets.pixel * observations.noise
        found["points"] = known * robust((landmarks - targets.points) / std, scale)
    return found
