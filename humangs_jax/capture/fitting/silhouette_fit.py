"""Refines cameras, shape and poses of a capture with its silhouettes and keypoints.

Each iteration matches the rendered silhouette of the body with the edge of the mask, as in the
iterative closest point method. It then takes a few steps of damped least squares, or of L-BFGS if
there are many unknowns. `StateStd` gives a Gaussian prior around the start. Without this prior,
cameras and people could move together. The result is kept only if its loss is clearly less than the
loss of the start, and if its keypoint error is not much larger.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from humangs_jax.body.joints import BODY_NAMES
from humangs_jax.body.landmarks import LandmarkModel, landmark_model, landmarks_from, pose_joints
from humangs_jax.body.model import (
    EXACT,
    BodyModel,
    BodyPose,
    SurfacePoints,
    pose_body,
    pose_features,
    pose_points,
    shape_body,
    without_expression,
)
from humangs_jax.capture.fitting.report import (
    Change,
    FitReport,
    ViewReport,
    how_far,
    limit_violations,
)
from humangs_jax.capture.fitting.residuals import silhouettes
from humangs_jax.capture.fitting.residuals.keypoints import (
    NEAR,
    Observations,
    body_errors,
    found_noise,
    keypoint_residuals,
    scaled_observations,
)
from humangs_jax.capture.fitting.state import (
    NORMAL_MAD,
    FitState,
    Origin,
    StateStd,
    betas_of,
    camera_origin,
    cameras_of,
    clothing_thickness,
    pose_of,
    segments,
    solve,
    zero_state,
)
from humangs_jax.capture.fitting.triangulation import reprojection_errors
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host, taken
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import Call
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry.camera import Camera


@dataclasses.dataclass(frozen=True)
class CaptureRefineConfig:
    """Settings of a refinement."""

    std: StateStd = dataclasses.field(default_factory=StateStd)
    """Standard deviations of the errors that the start may have."""
    coefficients: int = 10
    """The shape gets at least this many coefficients, as far as the body model has so many."""
    fixed_cameras: bool = False
    """Whether the cameras stay as they are, so that only shape and poses move."""
    iterations: int = 10
    """Number of times that the silhouettes of the body are matched with the masks."""
    longest_side: int = 512
    """Longest side of the photos that the refinement works on, pixels. Larger photos are shrunk."""
    points: int = 300
    """Number of points on the body's silhouette in a view, and number of points on the mask's
    silhouette.
    """
    reach: tuple[float, float] = (0.08, 0.015)
    """Largest distance at which points of the body and of the mask are matched, in the first and in
    the last matching. Both are shares of the person's height in the image.
    """
    independent: float = 30.0
    """In a view, all points of the silhouettes together weigh at most as much as this number of
    independent equations.
    """
    robust_scales: tuple[float, float] = (1.0, 0.5)
    """Robust scales for points of the body outside of the mask, and for points inside. Both are
    multiples of the reach.
    """
    keypoints_worse: float = 1.3
    """A result is discarded if its keypoint error exceeds the start's by more than this factor. The
    start's error is small, because it was fitted to the keypoints. For right results the factor is
    0.8 to 1.07, and for wrong bodies that fill clothes 1.8.
    """
    by_joint: tuple[tuple[str, float], ...] = ()
    """Pairs (word, factor). If the name of a joint contains the word, its standard deviation is
    `std.body_pose` times the factor. If several words fit, the first counts.
    """


def usual_config(
    fitted: bool,
    *,
    fixed_cameras: bool = False,
    bare: bool = False,
    tight: bool = False,
    calibrated: bool = True,
) -> CaptureRefineConfig:
    """Returns the settings that suit a start.

    Args:
        fitted: whether the start is a fit to the keypoints that the refinement gets.
        fixed_cameras: whether the cameras stay as they are.
        bare: whether the body itself has to fill the masks, without clothes.
        tight: whether the person wears tight clothes.
        calibrated: False for cameras that were found from the person.
    """
    std, config = StateStd(), CaptureRefineConfig(fixed_cameras=fixed_cameras)
    if fitted:
        # such a fit is off in shape and pose, more than in cameras that are calibrated; its
        # keypoints hold the joints where clothes would pull them away
        std = StateStd(body_pose=8.0, betas=1.0)
        if calibrated:
            std = replace(std, focal=0.005, camera_rotation=1.0, camera_center=0.02)
        else:
            std = replace(std, focal=0.05, camera_rotation=2.0, camera_center=0.08)
        config = dataclasses.replace(config, independent=100.0)
    # the masks are believed, or cameras were fitted to these very keypoints
    if bare or tight or not calibrated:
        config = dataclasses.replace(config, keypoints_worse=math.inf)
    # metres of clothes: 1.5 cm where they are tight, a millimetre where there are none
    if tight:
        std = replace(std, clothing=0.015, betas=2.0, body_pose=10.0)
    if bare:
        std = replace(std, clothing=0.001)
        config = dataclasses.replace(config, robust_scales=(1.0, 1.0))
    return dataclasses.replace(config, std=std)


def cameras_are_unseen(capture: Capture) -> bool:
    """Returns whether nothing in the capture determines how its cameras should move. This is so if
    the cameras were found from the person, and no two photos show the same pose.
    """
    return not capture.calibrated and capture.frame_count >= capture.view_count


# The state of a capture
# ----------------------------------------------------------------------------------------------


def capture_origin(capture: Capture, cameras: Camera, config: CaptureRefineConfig) -> Origin:
    """Returns the origin of a refinement: the cameras, shape and poses of the start, and the units
    of their deviations in the state.

    cameras: one camera for each view. Its images may have any size.
    """
    body = capture.body
    named = [j for j, name in enumerate(body.joint_names) if name in BODY_NAMES]
    joints = tuple(j for j in named or range(len(body.parents)) if body.parents[j] >= 0)
    known = without_expression(body).shape_directions.shape[-1]
    wanted = max(len(capture.betas), min(config.coefficients, known))
    return Origin(
        betas=from_host(np.pad(capture.betas, (0, wanted - len(capture.betas))), np.float32),
        pose=capture.poses,
        body_pose_std=_body_pose_std([body.joint_names[j] for j in joints], config),
        cameras=camera_origin(cameras, capture.frames),
        segment=from_host(segments(body.parents, joints)),
        joints=joints,
        std=config.std,
    )


def _body_pose_std(names: Sequence[str], config: CaptureRefineConfig) -> Float[Array, "a 3"]:
    """Returns the standard deviations of the free joints' rotations, (a, 3), radians. names: names
    of the free joints.
    """
    factors = [
        next((factor for word, factor in config.by_joint if word in name), 1.0) for name in names
    ]
    std = np.radians(config.std.body_pose) * np.asarray(factors)
    return from_host(np.repeat(std[:, None], 3, axis=1), np.float32)


def start_state(origin: Origin, config: CaptureRefineConfig) -> FitState:
    """Returns the state at the start, which is all zeros. Its cameras are None if they are
    fixed.
    """
    state = zero_state(origin)
    return replace(state, cameras=None) if config.fixed_cameras else state


def moved_capture(capture: Capture, origin: Origin, state: FitState) -> Capture:
    """Returns the capture with the cameras, shape and poses of a state.

    The images of the origin may have another size than the images of the capture. The result has no
    displacement, because a displacement belongs to the shape for which it was made.
    """
    own = replace(origin, cameras=replace(origin.views, K=capture.cameras.K))
    (K, cam_from_world), betas, poses = _moved(own, state)
    cameras = replace(capture.cameras, K=K, cam_from_world=cam_from_world)
    return dataclasses.replace(
        capture, cameras=cameras, betas=np.asarray(betas), poses=poses, displacement=None
    )


@compiled()
def _moved(
    origin: Origin, state: FitState
) -> tuple[tuple[Float[Array, "v 3 3"], Float[Array, "v 4 4"]], Float[Array, " s"], BodyPose]:
    return cameras_of(origin, state), betas_of(origin, state), pose_of(origin, state)


# Equations
# --------------------------------------------------------------------------------------------------


@pytree_dataclass
class Evidence:
    """The evidence of v views in one matching: points on silhouettes, their matches, and
    keypoints.
    """

    points: SurfacePoints
    """Points on the silhouettes of the body, a batch of v."""
    matches: silhouettes.Matches
    """Equations that match these points with the masks, a batch of v."""
    noise: Float[Array, ""]
    """Standard deviation of the silhouettes, (), pixels."""
    scales: Float[Array, "2"]
    """Robust scales outwards and inwards, (2,), pixels."""
    keypoints: Observations | None
    """Keypoints as a batch of v with one view each (c = 1). None if there are no keypoints."""


def _evidence_residuals(
    model: LandmarkModel, origin: Origin, state: FitState, evidence: Evidence, independent: float
) -> dict[str, Float[Array, "..."]]:
    """Returns the residuals of the views in standard deviations: "silhouettes", (v, e), and
    "keypoints", (v, 1, k, 2). If there are no keypoints, the second key is missing.
    """
    # all frames of the state, whose poses the views share
    K, cam_from_world = cameras_of(origin, state)
    betas, poses, frame = betas_of(origin, state), pose_of(origin, state), origin.views.frame
    transforms, joints = jax.vmap(lambda pose: pose_joints(model, betas, pose))(poses)
    features = jax.vmap(pose_features)(poses.rotations)

    # silhouettes of each view: the points of the body's rim, out by the thickness of clothes
    def silhouette_errors(points, matches, frame, K, matrix):
        """Returns the residuals of a view's silhouette, (e,)."""
        posed = pose_points(points, betas, features[frame], transforms[frame])
        seen = jnp.matmul(posed, matrix[:3, :3].T, precision=EXACT) + matrix[:3, 3]
        focal, depth = jnp.stack([K[0, 0], K[1, 1]]), jnp.maximum(seen[:, 2:], NEAR)
        clothes = clothing_thickness(origin, state, points.weights) * focal.mean() / depth[:, 0]
        pixels = seen[:, :2] / depth * focal + K[:2, 2]
        scales = evidence.scales[0], evidence.scales[1]
        return silhouettes.silhouette_residuals(
            matches, pixels, clothes, evidence.noise, scales, independent
        )

    views = evidence.points, evidence.matches, frame, K, cam_from_world
    parts = {"silhouettes": jax.vmap(silhouette_errors)(*views)}
    if evidence.keypoints is None:
        return parts

    # keypoints of each view alone, under the camera of the state
    def landmarks(features, transforms, joints):
        """Returns the landmarks of a frame, (k, 3), metres."""
        points = pose_points(model.points, betas, features, transforms)
        return landmarks_from(model, joints, points)

    def keypoint_errors(seen, points):
        """Returns the residuals of a view's keypoints, see `keypoint_residuals`. The robust scale
        is 5 standard deviations.
        """
        return keypoint_residuals(model, seen, points, 5.0)

    seen = replace(evidence.keypoints, K=K[:, None], cam_from_world=cam_from_world[:, None])
    points = jax.vmap(landmarks)(features, transforms, joints)[frame]
    parts["keypoints"] = jax.vmap(keypoint_errors)(seen, points)
    return parts


def _counted(clothing: Float[Array, " b"]) -> Float[Array, " b"]:
    """Returns the thicknesses of clothes as the prior uses them, (b,). Negative thicknesses are
    multiplied by 5, because clothes cannot have them.
    """
    return jnp.where(clothing < 0, 5.0 * clothing, clothing)


def _as_motion(values: Float[Array, "m ..."], memory: Float[Array, " n"]) -> Float[Array, "m ..."]:
    """Returns the deviations of m frames, (m, ...), transformed so that they are independent with
    unit variance under the prior of a motion. memory: correlation of each frame with the one
    before, (m - 1,).
    """
    r = memory.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.concatenate([values[:1], (values[1:] - r * values[:-1]) / jnp.sqrt(1 - r * r)])


@compiled(static=["independent"])
def solve_round(
    model: LandmarkModel,
    origin: Origin,
    evidence: Evidence,
    state: FitState,
    independent: float,
    memory: Float[Array, " n"] | None = None,
) -> FitState:
    """Returns the state after some steps of the solver with fixed matches. memory: correlation of
    each of m poses with the one before, (m - 1,), see `refine_capture`.
    """

    def residuals(y):
        counted = replace(y, clothing=_counted(y.clothing))
        if memory is not None:
            names = ("global_orient", "transl", "body_pose")
            motion = {name: _as_motion(getattr(y, name), memory) for name in names}
            counted = replace(counted, **motion)
        return _evidence_residuals(model, origin, y, evidence, independent), counted

    # with more than 400 unknowns L-BFGS replaces least squares, whose Jacobian grows with rows
    # times columns; six of its steps are worth one
    if sum(leaf.size for leaf in jax.tree.leaves(state)) > 400:
        return solve(residuals, state, 24, method="lbfgs")[0]
    return solve(residuals, state, 4, method="lm")[0]


# Iterations
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Score:
    """How well the body of a capture agrees with the masks and keypoints of its photos."""

    ious: Float[np.ndarray, " v"]
    """Intersection over union of body and mask in each view, (v,). NaN without a mask."""
    iou: float | None
    """Mean of `ious` over the views with a mask. None if no view has a mask."""
    keypoints: float | None
    """Median error of the keypoints, pixels. None without keypoints."""
    loss: float
    """1 - iou, plus the keypoint error as a share of the person's height. If there are no masks or
    no keypoints, their term is left out.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class SilhouetteFit:
    """The constants of a refinement of v photos: masks and keypoints at the reduced size at which
    the refinement works, and the origin of the state.
    """

    capture: Capture
    """The start, with the photos at their full size."""
    config: CaptureRefineConfig
    """Settings."""
    memory: Float[Array, " n"] | None
    """Correlation of each pose with the one before, (m - 1,). None: poses are independent."""
    cameras: Camera
    """Cameras of the photos at the reduced size."""
    masks: Float[np.ndarray, "v h w"]
    """Masks at the reduced size, (v, h, w), 0 to 1. Zeros if the capture has no masks."""
    unknown: Bool[np.ndarray, "v h w"] | None
    """Pixels that may or may not show the person, (v, h, w). None: there are no such pixels."""
    hidden: list[Bool[np.ndarray, "h w"] | None]
    """For each view, the unknown pixels and a rim around them, (h, w). In the rim the mask may end
    at an object in front of the person, and not at the edge of the person. None for a view without
    unknown pixels.
    """
    faces: Int[np.ndarray, "f 3"]
    """Faces of the body, (f, 3)."""
    edges: silhouettes.MeshEdges
    """Edges of the body's faces."""
    boundaries: list[silhouettes.Boundary]
    """Silhouettes of the masks, without the parts at `hidden` pixels."""
    model: LandmarkModel
    """Places of the keypoints on the body. Without keypoints, it has no landmarks."""
    keypoints: Observations | None
    """Keypoints in pixels of the photos at their full size. Scores use them. None if there are no
    keypoints.
    """
    observations: Observations | None
    """Keypoints in pixels of the reduced size. None if there are no keypoints."""
    scale: float
    """Reduced size of the photos, divided by their full size."""
    height: float
    """Height of the person in the image, pixels of the reduced size."""
    origin: Origin
    """Cameras, shape and poses of the start, from which the state counts its deviations."""

    @classmethod
    def of(
        cls,
        capture: Capture,
        keypoints: Keypoints | None,
        config: CaptureRefineConfig,
        memory: Float[np.ndarray, " n"] | None = None,
    ) -> "SilhouetteFit":
        """Returns the constants of a refinement of a capture. memory: see `refine_capture`.

        Raises: ValueError if there are keypoints, and the body has none of their landmarks.
        """
        # the photos are reduced to the size at which silhouettes are compared
        small = max(capture.images.shape[1:3]) <= config.longest_side
        looked_at = capture if small else capture.resized(config.longest_side)
        cameras, masks = looked_at.cameras, looked_at.masks
        if masks is None:
            masks = np.zeros(looked_at.images.shape[:3], np.float32)
        faces = np.asarray(capture.body.faces)
        hidden = _with_rim(looked_at.unknown, len(masks))

        # keypoints are in pixels of the given photos
        if keypoints is None:
            model = landmark_model(capture.body, ())
            in_photos = observations = None
        else:
            kind, photos = keypoints.set, capture.cameras
            model = landmark_model(capture.body, kind.names, kind.places, kind.certainty)
            in_photos = scaled_observations(photos, keypoints, photos)
            observations = scaled_observations(cameras, keypoints, photos)
        return cls(
            capture=capture,
            config=config,
            memory=None if memory is None else from_host(memory, np.float32),
            cameras=cameras,
            masks=masks,
            unknown=looked_at.unknown,
            hidden=hidden,
            faces=faces,
            edges=silhouettes.body_edges(faces),
            boundaries=[
                silhouettes.mask_boundary(mask, config.points, unseen)
                for mask, unseen in zip(masks, hidden, strict=True)
            ],
            model=model,
            keypoints=in_photos,
            observations=observations,
            scale=cameras.width / capture.cameras.width,
            height=_person_height(masks, observations),
            origin=capture_origin(capture, cameras, config),
        )

    def run(self) -> tuple[FitState, float]:
        """Returns the state after all iterations, and the largest change of a number of the state
        in the last iteration, in units of the number's standard deviation.
        """
        config, state, move = self.config, start_state(self.origin, self.config), 0.0
        first, last = config.reach
        for turn in range(config.iterations):
            # points look less and less far
            share = turn / max(config.iterations - 1, 1)
            evidence = self.look(state, self.height * first * (last / first) ** share)
            before = state
            state = solve_round(
                self.model, self.origin, evidence, state, config.independent, self.memory
            )
            moves = jax.tree.map(lambda a, b: np.abs(np.asarray(a) - np.asarray(b)), state, before)
            move = max(float(np.max(leaf, initial=0.0)) for leaf in jax.tree.leaves(moves))
        return state, move

    def calls(self) -> Iterator[Call]:
        """Yields the compiled functions that `run` and `score` call, with arguments of the right
        shapes. The function inside of `silhouettes.boundary_points` is left out. The function that
        takes longest to compile comes first. The values of the arguments do not matter.
        """
        state, capture = start_state(self.origin, self.config), self.capture
        betas, cameras = self.origin.betas, self.cameras
        evidence, count = self._no_evidence(), self.config.points
        solving = self.model, self.origin, evidence, state, self.config.independent, self.memory
        yield solve_round, solving
        vertices = np.zeros(capture.body.template.shape, np.float32)
        yield silhouettes.look, (vertices, capture.body.faces, cameras[0])
        yield _moved, (self.origin, state)
        yield posed_vertices, (capture.body, betas, capture.poses)
        if self.keypoints is not None:
            frames = capture.frames
            seen = self.model, betas, capture.poses, self.keypoints, frames, reprojection_errors
            yield body_errors, seen
        places = np.zeros((count, silhouettes.LOOKS, 2), np.float32)
        yield silhouettes.coverage, (np.zeros(self.masks.shape[1:], np.float32), places)

    def _no_evidence(self) -> Evidence:
        """Returns evidence without any matches. Its arrays have the same shapes as all other
        evidence of this fit.
        """
        views, count = len(self.masks), self.config.points
        pixels, ends = np.zeros((2, 0, 2), np.float32), np.zeros((0, 2), int)
        nothing = silhouettes.Boundary(*pixels, ends, np.zeros(0, np.float32))
        matches = silhouettes.matches_of((ends[:, 0], pixels[0], pixels[0, :, 0]), count)
        return Evidence(
            points=jax.eval_shape(
                lambda body: silhouettes.boundary_points(
                    body, [nothing] * views, count, len(self.origin.betas)
                ),
                self.capture.body,
            ),
            matches=jax.tree.map(lambda leaf: np.stack([leaf] * views), matches),
            noise=from_host(0, np.float32),
            scales=from_host(np.zeros(2, np.float32)),
            keypoints=self.observations,
        )

    def look(self, state: FitState, reach: float) -> Evidence:
        """Returns the evidence of the views for the body in this state. Silhouettes are matched
        within `reach` pixels.
        """
        count = self.config.points
        moved = moved_capture(self.capture, self.origin, state)
        boundaries = [
            silhouettes.body_boundary(view, self.faces, self.edges, count)
            for view in self.body_views(moved)
        ]
        views = zip(boundaries, self.masks, self.boundaries, self.hidden, strict=True)
        matches = [
            silhouettes.match(boundary, mask, other, reach, count, hidden)
            for boundary, mask, other, hidden in views
        ]
        # the noise of keypoints is what a body finds: a detector's own bias is no evidence against
        # the masks
        keypoints = self.observations
        if self.keypoints is not None and keypoints is not None:
            errors = self._keypoint_errors(moved, self.keypoints) * np.float32(self.scale)
            noise = found_noise(errors, np.asarray(keypoints.noise))
            keypoints = replace(keypoints, noise=from_host(noise, np.float32))
        return Evidence(
            points=silhouettes.boundary_points(
                self.capture.body, boundaries, count, len(self.origin.betas)
            ),
            matches=jax.tree.map(lambda *leaves: from_host(np.stack(leaves)), *matches),
            noise=from_host(_noise(boundaries, matches), np.float32),
            scales=from_host(reach * np.asarray(self.config.robust_scales), np.float32),
            keypoints=keypoints,
        )

    def _keypoint_errors(self, capture: Capture, seen: Observations) -> Float[np.ndarray, "v k"]:
        """Returns the distances between the body's landmarks and the keypoints, (v, k), pixels of
        the photos at full size. NaN where there is no keypoint, or the body lacks the landmark.
        """
        cameras = capture.cameras
        seen = replace(
            seen,
            K=np.asarray(cameras.K)[:, None],
            cam_from_world=np.asarray(cameras.cam_from_world)[:, None],
        )
        betas = from_host(capture.betas)
        errors = body_errors(
            self.model, betas, capture.poses, seen, capture.frames, reprojection_errors
        )
        known = np.asarray(seen.confidences) * np.asarray(self.model.known) > 0
        return np.where(known, errors, np.nan)[:, 0]

    def body_views(self, capture: Capture) -> list[silhouettes.BodyView]:
        """Returns the body as each view sees it at the reduced size. capture: the photos of this
        fit with any body and cameras.
        """
        cameras = capture.cameras.resized(self.cameras.width, self.cameras.height)
        vertices = posed_vertices(capture.body, from_host(capture.betas), capture.poses)
        faces = capture.body.faces
        return [
            silhouettes.view_body(taken(vertices, frame), faces, cameras[i])
            for i, frame in enumerate(capture.frames)
        ]

    def score(self, capture: Capture) -> Score:
        """Returns how well a body agrees with the masks and keypoints. capture: the photos of this
        fit with any body and cameras.
        """
        known = [None] * len(self.masks) if self.unknown is None else list(~self.unknown)
        pairs = zip(self.body_views(capture), self.masks, known, strict=True)
        ious = np.asarray([overlap(view.covered, mask, seen) for view, mask, seen in pairs])
        iou = None if np.isnan(ious).all() else float(np.nanmean(ious))
        loss = 0.0 if iou is None else 1 - iou
        keypoints = None
        if self.keypoints is not None:
            errors = self._keypoint_errors(capture, self.keypoints)
            if np.isfinite(errors).any():
                keypoints = float(np.nanmedian(errors))
                loss += keypoints * self.scale / self.height
        return Score(ious, iou, keypoints, loss)


def _with_rim(
    unknown: Bool[np.ndarray, "v h w"] | None, views: int
) -> list[Bool[np.ndarray, "h w"] | None]:
    """Returns the unknown pixels of each view together with a rim of three pixels around them, (h,
    w). None for a view without unknown pixels.
    """
    if unknown is None:
        return [None] * views
    return [ndimage.binary_dilation(each, iterations=3) if each.any() else None for each in unknown]


def overlap(
    covered: Bool[np.ndarray, "h w"],
    mask: Float[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"] | None = None,
) -> float:
    """Returns the intersection over union of a body and a mask. It is NaN if the mask is empty.

    known: pixels in which the body counts. None: all pixels. The mask counts in all pixels.
    """
    person = mask > 0.5
    if known is not None:
        covered = covered & known
    if not person.any():
        return float("nan")
    return float((covered & person).sum() / (covered | person).sum())


@compiled()
def posed_vertices(
    body: BodyModel, betas: Float[Array, " s"], poses: BodyPose
) -> Float[Array, "m n 3"]:
    """Returns the vertices of a person in each of m poses, (m, n, 3), metres."""
    rest = shape_body(body, betas)
    return jax.lax.map(lambda pose: pose_body(body, rest, pose).vertices, poses)


def _noise(
    boundaries: Sequence[silhouettes.Boundary], matches: Sequence[silhouettes.Matches]
) -> float:
    """Returns the standard deviation of the distances between the silhouettes of body and mask,
    pixels. It is estimated from their median, and is at least 0.7. It is 1.0 if nothing was
    matched.

    Clothes make the distances larger, and so does a body that has not moved to its place yet.
    Silhouettes are never more exact than 0.7 pixels.
    """
    found = [np.zeros(0)]
    for boundary, own in zip(boundaries, matches, strict=True):
        if len(boundary.positions):
            off = silhouettes.distances(own, boundary.positions.astype(np.float32))
            found.append(np.asarray(off)[np.asarray(own.weights) > 0])
    distances = np.abs(np.concatenate(found))
    if not len(distances):
        return 1.0
    return max(NORMAL_MAD * float(np.median(distances)), 0.7)


def _person_height(
    masks: Sequence[Float[np.ndarray, "h w"]] | Float[np.ndarray, "v h w"],
    observations: Observations | None,
) -> float:
    """Returns the height of the person in the images, pixels. It is the median over the views of
    the larger side of the mask's box. If all masks are empty, the box of the keypoints is used.
    Without masks and keypoints, the result is NaN.
    """
    sizes = [max(np.ptp(x) for x in np.nonzero(mask > 0.5)) for mask in masks if (mask > 0.5).any()]
    if not sizes and observations is not None:
        pairs = zip(
            np.asarray(observations.points)[:, 0],
            np.asarray(observations.confidences)[:, 0] > 0,
            strict=True,
        )
        sizes = [np.ptp(points[seen], axis=0).max() for points, seen in pairs if seen.any()]
    return float(np.median(sizes)) if sizes else float("nan")


DEFAULT_CONFIG = CaptureRefineConfig()


@dataclasses.dataclass(frozen=True, eq=False)
class RefinedCapture:
    """The result of a refinement."""

    capture: Capture
    """The refined capture, or the start itself if `report.kept` is False."""
    report: FitReport
    """What was fitted, and how well."""


def refine_capture(
    capture: Capture,
    *,
    keypoints: Keypoints | None = None,
    config: CaptureRefineConfig = DEFAULT_CONFIG,
    memory: Float[np.ndarray, " n"] | None = None,
) -> RefinedCapture:
    """Refines cameras (rotation, centre, focal length), shape and poses of a capture. Returns the
    refined capture and a report. If the refined capture is not clearly better, the start is
    returned in its place.

    If a view has an empty mask, only its keypoints count.

    Args:
        capture: the start.
        keypoints: keypoints in the capture's views, or None.
        config: settings. `usual_config` returns settings that suit the start.
        memory: correlation of each pose with the pose before, (m - 1,), in [0, 1), as in a video.
            None: poses are independent.

    Raises: CaptureError if there is neither a mask that shows anybody nor a keypoint. ValueError if
    the keypoints have another number of views than the capture, or if the body has none of their
    landmarks.
    """
    if keypoints is not None and len(keypoints.points) != capture.view_count:
        raise ValueError(
            f"keypoints: of {len(keypoints.points)} views, but the capture has {capture.view_count}"
        )
    masked = capture.masks is not None and (np.asarray(capture.masks) > 0.5).any()
    if not masked and (keypoints is None or not (keypoints.confidences > 0).any()):
        raise CaptureError(
            "capture",
            "masks",
            "none shows anybody, and there are no keypoints: refinement needs one or the other",
        )
    # the start stays unless the result is clearly better
    fit = SilhouetteFit.of(capture, keypoints, config, memory)
    state, move = fit.run()
    tried = moved_capture(capture, fit.origin, state)
    before, found = fit.score(capture), fit.score(tried)
    kept = _better(found, before, config.keypoints_worse)
    best, score = (tried, found) if kept else (capture, before)
    # what happened, in one line
    scores = {"silhouettes": before.iou, "keypoints": before.keypoints}
    kinds = " and ".join(name for name, value in scores.items() if value is not None)
    verdict = "kept" if kept else "no sufficient improvement, the start is kept"
    note = (
        f"{kinds}: loss {before.loss:.4f} -> {found.loss:.4f}, {verdict} (last move {move:.2g}"
        " expected std)"
    )
    return RefinedCapture(best, _report(capture, best, before, score, note))


def _better(found: Score, before: Score, most_worse: float) -> bool:
    """Returns whether a result is clearly better than the start. most_worse: see
    `CaptureRefineConfig.keypoints_worse`.
    """
    if found.keypoints is None or before.keypoints is None:
        # masks of clothes are fitted a little better by wrong bodies, which keypoints would show:
        # for four people who started at the truth, by up to 0.15 of the loss
        least = 0.2
    elif found.keypoints > most_worse * before.keypoints:
        return False
    else:
        least = 0.02
    # less than half a percent of the silhouettes is rounding of pixels
    return before.loss - found.loss > max(least * before.loss, 0.005)


def _report(start: Capture, best: Capture, before: Score, after: Score, note: str) -> FitReport:
    kept = best is not start
    # errors and silhouettes before and after
    names = {"silhouette_iou": "iou", "keypoint_error_px": "keypoints", "loss": "loss"}
    pairs = {name: (getattr(before, key), getattr(after, key)) for name, key in names.items()}
    errors = {name: Change(b, a) for name, (a, b) in pairs.items() if b is not None}
    ious = zip(
        start.names, start.frames.tolist(), before.ious.tolist(), after.ious.tolist(), strict=True
    )
    # how far the result is from the start
    moved = how_far(start, best) if kept else {}
    notes = [note, f"kept: {'refined' if kept else 'start'}"]
    if kept:
        notes.append(
            "moved: focal length x {focal_factor:.4f}, cameras {camera_degrees:.2f} degrees and"
            " {camera_cm:.1f} cm, joints {joint_degrees:.2f} degrees, person {transl_cm:.1f} cm"
            " (means)".format(**moved)
        )
        if start.displacement is not None:
            notes.append(
                "the displacement of body.npz is left out: it was made for the shape before"
            )
    # bodies in clothes overlap masks by more than this
    warnings = []
    if after.iou is not None and after.iou < 0.6:
        warnings.append(
            "body and masks do not agree: the start was too far off; `humangs check` shows why"
        )
    return FitReport(
        fitted="refinement",
        kept=kept,
        errors=errors,
        views=tuple(
            ViewReport(name, frame, iou_before=a, iou_after=b) for name, frame, a, b in ious
        ),
        moved=moved,
        violations=limit_violations(best.body.joint_names, best.poses),
        notes=tuple(notes),
        warnings=tuple(warnings),
    )
