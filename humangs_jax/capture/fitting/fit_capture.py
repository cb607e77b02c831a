"""Fits a body to photos with cameras and keypoints. Reports the uncertainty of the body, and how
well it agrees with the keypoints.
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel, kind_of, landmark_model
from humangs_jax.body.model import BodyModel, without_expression
from humangs_jax.capture.fitting.camera_errors import CameraError, find_camera_errors, mended
from humangs_jax.capture.fitting.files import FitRecord
from humangs_jax.capture.fitting.landmark_fit import (
    FEW,
    MOTION_SCALE,
    ROBUST_SCALES,
    LandmarkFit,
    accelerations,
    fit_frames,
    fit_landmarks,
    keypoint_problem,
)
from humangs_jax.capture.fitting.report import (
    Change,
    FitReport,
    ViewReport,
    keypoint_warnings,
    limit_violations,
    undetermined_joints,
)
from humangs_jax.capture.fitting.residuals.keypoints import (
    PLACE_STD,
    KeypointProblem,
    Observations,
    body_errors,
    found_noise,
    frame_residuals,
    group_by_frame,
    make_observations,
)
from humangs_jax.capture.fitting.swaps import (
    Swap,
    agreements,
    find_exchanged_hands,
    find_swaps,
)
from humangs_jax.capture.keypoints.keypoints import Keypoints, KeypointSet
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import Call
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import DEFAULT_BODY, Capture
from humangs_jax.data.capture_checks import few
from humangs_jax.data.hidden import hidden_line, with_hidden_parts
from humangs_jax.data.photos import Photos


class Uncertainty(NamedTuple):
    """The uncertainty of a fit of m frames."""

    joint_covariances: Float[np.ndarray, "m j 3 3"]
    """Covariances of the joints' positions, (m, j, 3, 3), square metres."""
    determined: Float[np.ndarray, "m j"]
    """How much of each joint's rotation the views determine, (m, j). It is the share of the prior's
    variance that the views remove, a mean over three axes. 1 is all, 0 is nothing. It is 0 for
    joints that no keypoint depends on.

    For the root it is 1 minus the standard deviation of its orientation in half turns, about the
    least certain axis.
    """
    shape_covariance: Float[np.ndarray, "s s"]
    """Covariance of the shape coefficients, (s, s)."""

    @property
    def joint_std(self) -> Float[np.ndarray, "m j"]:
        """Expected root mean square distance between each fitted joint and the true joint, (m, j),
        metres.
        """
        return np.sqrt(np.trace(self.joint_covariances, axis1=-2, axis2=-1))


def fit_uncertainty(
    model: LandmarkModel, observations: Observations, fit: LandmarkFit
) -> Uncertainty:
    """Returns the uncertainty of a fit to these observations. It is computed in float64 from
    derivatives in float32.
    """
    # derivatives of the residuals by the pose of their frame and by the shape that all share
    model = replace(model, certainty=fit.certainty)
    derivatives = _derivatives(model, replace(observations, noise=fit.noise), fit)
    residuals_by, joints_by = (np.asarray(x, np.float64) for x in derivatives)
    shapes = len(fit.betas)
    by_pose, by_shape = np.split(residuals_by, [residuals_by.shape[-1] - shapes], axis=-1)
    # Schur complement: the poses are eliminated, which leaves the information about the shape
    # keeps the inverse finite for frames without keypoints
    own = np.linalg.inv(
        np.einsum("mra,mrb->mab", by_pose, by_pose) + 1e-8 * np.eye(by_pose.shape[-1])
    )
    coupling = np.einsum("mra,mrs->mas", by_pose, by_shape)
    carried = own @ coupling
    shape_information = np.einsum("mrs,mrt->st", by_shape, by_shape) - np.einsum(
        "mas,mat->st", coupling, carried
    )
    shape = np.linalg.inv(shape_information + np.eye(shapes))
    # covariance of pose and shape together, frame by frame, and of the joints, which depend on both
    poses = own + carried @ shape @ carried.swapaxes(-1, -2)
    mixed = -carried @ shape
    whole = np.block(
        [
            [poses, mixed],
            [mixed.swapaxes(-1, -2), np.broadcast_to(shape, (len(own), shapes, shapes))],
        ]
    )
    covariances = np.einsum("mjap,mpq,mjbq->mjab", joints_by, whole, joints_by, optimize=True)
    return Uncertainty(covariances, _determined(keypoint_problem(model), poses), shape)


def _determined(
    problem: KeypointProblem, poses: Float[np.ndarray, "m p p"]
) -> Float[np.ndarray, "m j"]:
    """Returns `Uncertainty.determined`, (m, j). poses: covariance of a frame's unknowns, (m, p, p),
    in the order global_orient, transl, body_pose.
    """
    joints, variances = np.asarray(problem.origin.joints), np.diagonal(poses, axis1=-2, axis2=-1)
    left = variances[:, 6:].reshape(len(poses), len(joints), 3)
    std = np.radians(problem.origin.std.global_orient) * np.sqrt(variances[:, :3])
    determined = np.zeros((len(poses), len(problem.prior.std)))
    determined[:, joints] = 1 - np.clip(left.mean(-1), 0, 1)
    determined[:, 0] = 1 - np.clip((std / np.pi).max(-1), 0, 1)
    return determined


@compiled()
def _derivatives(
    model: LandmarkModel, observations: Observations, fit: LandmarkFit
) -> tuple[Float[Array, "m r u"], Float[Array, "m j 3 u"]]:
    """Returns the derivatives of each frame's residuals, (m, r, u), and of its joints in metres,
    (m, j, 3, u). The u unknowns are global_orient, transl, body_pose and the shape, in this order.
    The residuals are without the shape's prior.
    """
    problem, state, m = keypoint_problem(model), fit.state, len(observations.noise)
    poses = jnp.concatenate(
        [state.global_orient, state.transl, state.body_pose.reshape(m, -1)], axis=1
    )
    p = poses.shape[1]

    def both(vector, seen):
        pose = {
            "global_orient": vector[:3],
            "transl": vector[3:6],
            "body_pose": vector[6:p].reshape(-1, 3),
        }
        moved = replace(state, betas=vector[p:], **pose)
        found = frame_residuals(problem, seen, moved, ROBUST_SCALES["person"])
        found.pop("shape")
        return (
            jnp.concatenate([leaf.ravel() for leaf in found.values()]),
            problem.landmarks_and_joints(moved)[1],
        )

    vectors = jnp.concatenate([poses, jnp.tile(state.betas, (m, 1))], axis=1)
    return jax.lax.map(lambda each: jax.jacfwd(both)(*each), (vectors, observations))


@dataclasses.dataclass(frozen=True, eq=False)
class Examination:
    """A report that compares a body with keypoints, and the arrays from which it was made, for v
    views and k keypoints.
    """

    report: FitReport
    """The report."""
    landmarks: Float[np.ndarray, "v k 2"]
    """Landmarks of the body in the views, (v, k, 2), pixels."""
    compared: Bool[np.ndarray, "v k"]
    """Which keypoints were compared with the body, (v, k)."""
    outliers: Bool[np.ndarray, "v k"]
    """Which compared keypoints are outliers, (v, k)."""


def examine(capture: Capture, keypoints: Keypoints, record: FitRecord | None = None) -> Examination:
    """Returns a report that compares the body of a capture with keypoints of its views.

    Args:
        capture: the capture with its body.
        keypoints: keypoints in the order of the capture's views.
        record: record of the fit to these keypoints, from which noise and undetermined joints are
            taken. None: the noise is estimated from the median error, and the report names no
            undetermined joints.
    Raises: ValueError if keypoints and capture differ in the number of views, if the record has
    fewer frames or another number of joints than the capture, or if the body has none of the
    landmarks.
    """
    _check_same_views(capture, keypoints, record)
    # distances of the body's landmarks from the keypoints, frame by frame
    observations, views = group_by_frame(capture, keypoints)
    kind = keypoints.set
    model = landmark_model(capture.body, kind.names, kind.places, kind.certainty)
    poses = jax.tree.map(lambda leaf: np.asarray(leaf)[: len(views)], capture.poses)
    betas = from_host(capture.betas)
    errors = np.asarray(body_errors(model, betas, poses, observations, np.arange(len(views))))
    compared = (np.asarray(observations.confidences) > 0) & np.asarray(model.known)
    lengths = np.where(compared, np.linalg.norm(errors, axis=-1), np.nan)
    # noise of the detections: from the fit, or else from the errors themselves
    expected = np.asarray(observations.noise)
    names, undetermined = capture.body.joint_names, ()
    if record is None:
        noise = np.asarray(list(map(found_noise, lengths, expected)))
    else:
        noise, shown = record.noise[: len(views)], np.flatnonzero(compared.any((1, 2)))
        undetermined = undetermined_joints(names, record.joint_std[shown], record.determined[shown])
    # outliers are beyond five standard deviations, the robust scale of the last stage of a fit
    outliers = compared & (lengths * np.asarray(model.certainty) > 5.0 * noise[:, None, None])

    # back from frames to the order of the views
    frame_of, slot_of = np.argwhere(views >= 0)[np.argsort(views[views >= 0])].T
    at = frame_of, slot_of
    of_views = zip(capture.names, frame_of.tolist(), lengths[at], outliers[at], strict=True)
    rows = tuple(_view_report(*own) for own in of_views)
    # what points to a mistake
    violations = limit_violations(names, poses)
    swaps = _exchanges(observations, keypoints, views, capture.names)
    turned = [
        f"{error}, as the keypoints show: `humangs fit` turns it back"
        for error in find_camera_errors(capture, keypoints)
    ]
    report = FitReport(
        fitted="keypoints",
        errors={"keypoint_error_px": Change(_quantile(lengths, 0.5))} if compared.any() else {},
        views=rows,
        violations=violations,
        swaps=swaps,
        undetermined=undetermined,
        notes=_worst_frame(np.asarray([_quantile(own, 0.5) for own in lengths])),
        warnings=(*turned, *keypoint_warnings(rows, expected, violations, swaps)),
    )
    landmarks = errors + np.asarray(observations.points)
    return Examination(report, landmarks[at], compared[at], outliers[at])


def _check_same_views(capture: Capture, keypoints: Keypoints, record: FitRecord | None) -> None:
    """Checks that keypoints and record have the views, frames and joints of a capture.

    Raises: ValueError, see `examine`.
    """
    views, joints = capture.view_count, len(capture.body.joint_names)
    if len(keypoints.points) != views:
        raise ValueError(f"keypoints of {len(keypoints.points)} views, but the capture has {views}")
    if record is None:
        return
    frames, known = capture.frames.max() + 1, record.joint_std.shape[1]
    if len(record.noise) < frames or known != joints:
        raise ValueError(
            f"the capture's fit is of {len(record.noise)} frames and {known} joints, but the"
            f" capture has {frames} and {joints}: fit it again"
        )


def _exchanges(
    observations: Observations,
    keypoints: Keypoints,
    views: Int[np.ndarray, "m c"],
    names: tuple[str, ...],
) -> tuple[Swap, ...]:
    """Returns the cameras, sides and hands that seem to be exchanged. Exchanged sides are not
    reported if the hands of the view, or of one of its alternatives, are exchanged.
    """
    hands = find_exchanged_hands(keypoints, names)
    explained = {swap.views[0] for swap in hands}
    others = [
        swap
        for swap in find_swaps(observations, keypoints.set, views, names)
        if swap.kind == "cameras" or explained.isdisjoint((*swap.views, *swap.instead))
    ]
    return (*others, *hands)


def _worst_frame(frames: Float[np.ndarray, " m"]) -> tuple[str, ...]:
    known = np.flatnonzero(np.isfinite(frames))
    if len(frames) < 2 or not len(known):
        return ()
    worst = known[np.argmax(frames[known])]
    middle = np.median(frames[known])
    return (
        f"frames: median error {middle:.1f} px, worst in frame {worst}: {frames[worst]:.1f} px",
    )


def _view_report(
    name: str, frame: int, lengths: Float[np.ndarray, " k"], outliers: Bool[np.ndarray, " k"]
) -> ViewReport:
    count = int(np.isfinite(lengths).sum())
    share = float(outliers.sum() / max(count, 1))
    return ViewReport(name, frame, count, _quantile(lengths, 0.5), _quantile(lengths, 0.9), share)


def _quantile(values: Float[np.ndarray, "..."], share: float) -> float:
    """Returns the quantile `share` of the finite values. It is NaN if no value is finite."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if known.size else float("nan")


def calls_of_fit(body: BodyModel, kind: KeypointSet, views: int) -> Iterator[Call]:
    """Yields the compiled functions that `fit_photos` and its report call for photos of one moment,
    each with arguments of the right shapes. The shapes depend on the body, the set `kind` and the
    number of views. The function inside of `landmark_model` is left out, because the generator
    itself runs it.
    """
    model = landmark_model(without_expression(body), kind.names, kind.places, kind.certainty)
    k, one = len(kind.names), (1, views)
    matrices = (np.broadcast_to(np.eye(n), (*one, n, n)) for n in (3, 4))
    observations = make_observations(np.zeros((*one, k, 2)), np.zeros((*one, k)), *matrices)
    yield fit_frames, (model, observations)
    fit = fit_frames.eval_shape(model, observations)
    of_fit = replace(model, certainty=fit.certainty), replace(observations, noise=fit.noise), fit
    yield _derivatives, of_fit
    yield agreements, (observations, np.asarray(kind.mirror))
    yield body_errors, (model, fit.betas, fit.poses, observations, np.arange(1))


@dataclasses.dataclass(frozen=True, eq=False)
class FittedCapture:
    """The result of a fit: the capture with its body, and the record for fit.npz."""

    capture: Capture
    """Photos, cameras and the fitted body. The cameras in `camera_errors` are corrected."""
    record: FitRecord
    """Keypoints that were fitted, and the uncertainty of the result."""
    fit: LandmarkFit
    """Result of the optimisation."""
    notes: tuple[str, ...]
    """Further results of the fit, one line each."""
    warnings: tuple[str, ...]
    """Signs of a mistake in the fit, one line each."""
    camera_errors: tuple[CameraError, ...] = ()
    """Cameras whose rotation was corrected."""

    @functools.cached_property
    def report(self) -> FitReport:
        """Report on the quality of the fit. It is made when it is first read, because it takes time
        to try exchanges of views.
        """
        report = examine(self.capture, self.record.keypoints, self.record).report
        notes, warnings = (*report.notes, *self.notes), (*report.warnings, *self.warnings)
        return dataclasses.replace(report, notes=notes, warnings=warnings)


def fit_photos(
    photos: Photos,
    keypoints: Keypoints,
    body: BodyModel,
    *,
    body_file: str = DEFAULT_BODY,
    smoothness: float = 0.0,
    fixed_cameras: bool = False,
) -> FittedCapture:
    """Returns the capture with the fitted shape and poses of the person in photos. Cameras are
    corrected first if their rotation is wrong according to the keypoints. Pixels that something in
    front of the person covers become unknown, see `with_hidden_parts`.

    Args:
        photos: photos with cameras.
        keypoints: keypoints of each view, in the order of the photos.
        body: body model to fit.
        body_file: where the body comes from, see `Capture`.
        smoothness: see `fit_landmarks`.
        fixed_cameras: whether the cameras stay as they are. Cameras that were found from the person
            always stay.
    Raises: ValueError if photos and keypoints differ in the number of views, if no view has a
    keypoint that the body has, or if the body's root is not its first joint.
    """
    if len(keypoints.points) != len(photos.names):
        raise ValueError(
            f"keypoints of {len(keypoints.points)} views, but there are {len(photos.names)} photos"
        )
    if body.parents.index(-1) != 0:
        raise ValueError(
            f"body '{body.name}': expected the root to be its first joint, got joint"
            f" {body.parents.index(-1)}"
        )
    # cameras that the keypoints show to be turned are turned back first; those that were found from
    # such keypoints learn nothing new from them
    errors = ()
    if photos.calibrated and not fixed_cameras:
        errors = find_camera_errors(photos, keypoints)
    if errors:
        photos = mended(photos, errors)
    kind = keypoints.set
    # the fit, and how well its result is known
    model = landmark_model(without_expression(body), kind.names, kind.places, kind.certainty)
    observations, _ = group_by_frame(photos, keypoints)
    seen = np.asarray(observations.confidences) * np.asarray(model.known) > 0
    if not seen.any():
        raise ValueError("no view has a keypoint that the body has: nothing to fit")
    fit = fit_landmarks(model, observations, smoothness)
    found = fit_uncertainty(model, observations, fit)
    capture = Capture(
        **vars(photos), body=body, betas=np.asarray(fit.betas), poses=fit.poses, body_file=body_file
    )
    # the record keeps the set as this detector uses it, so that later refinements need not find it
    # again
    shown = with_hidden_parts(capture)
    line = hidden_line(capture, shown)
    moved = np.zeros((len(kind.names), 3))
    if fit.state.places is not None:
        moved = model.by_landmark(PLACE_STD * fit.state.places)
    keypoints = dataclasses.replace(
        keypoints, set=kind.adapted(kind.offsets + moved, np.asarray(fit.certainty))
    )
    known = (np.asarray(fit.noise), found.joint_std, found.determined, found.shape_covariance)
    record = FitRecord(keypoints, photos.names, *known)
    notes = [*_places(model, fit), *(f"{error}: turned back" for error in errors)]
    if line is not None:
        notes.append(line)
    motion = _motion_warnings(np.asarray(fit.joints, float), float(fit.smoothness), smoothness)
    warnings = (*_blind_frames(seen, smoothness > 0 and len(seen) > 2), *motion)
    return FittedCapture(shown, record, fit, tuple(notes), warnings, errors)


def _places(model: LandmarkModel, fit: LandmarkFit) -> Iterator[str]:
    """Yields a line if the detector sees kinds of landmarks more than 1 cm away from where the body
    model has them. It yields nothing if the fit did not estimate such offsets.
    """
    if fit.state.places is None:
        return
    moved = 1000 * PLACE_STD * np.linalg.norm(np.asarray(fit.state.places), axis=-1)
    kinds = {group: kind_of(model.names[landmark]) for landmark, group, _ in model.placed}
    # a centimetre is worth a line
    far = [
        f"{kinds[group]} {moved[group]:.0f} mm"
        for group in np.argsort(-moved)[:3]
        if moved[group] > 10.0
    ]
    if far:
        yield (
            "the detector sees landmarks beside where the body has them, which is undone:"
            f" {', '.join(far)}"
        )


def _blind_frames(seen: Bool[np.ndarray, "m c k"], smooth: bool) -> Iterator[str]:
    """Yields warnings about frames with few keypoints, and about frames that are seen by one view.
    seen: which keypoints are seen, (m, c, k). smooth: whether the motion is smooth.
    """
    taken = "interpolated between its neighbours" if smooth else "the prior's, not the photos'"
    single = []
    for frame, views in enumerate(seen):
        points, cameras = int(views.any(0).sum()), int(views.any(1).sum())
        if points < FEW:
            yield f"frame {frame}: {points} keypoints are seen: its pose is {taken}"
        elif cameras == 1:
            single.append(str(frame))
    if single:
        frames, each = ("frame", "") if len(single) == 1 else ("frames", "each ")
        effect = f"{each}seen by one view: distance and height are hardly determined"
        yield f"{frames} {few(single)}: {effect}"


def _motion_warnings(
    joints: Float[np.ndarray, "m j 3"], held: float, smoothness: float
) -> Iterator[str]:
    """Yields warnings about a motion for which the user asked smoothness. joints: positions, (m, j,
    3), metres. held: the expected acceleration that the fit used in the end, 0 if the frames are
    independent. smoothness: the expected acceleration that was asked for, 0 if none. Both in metres
    per frame squared.
    """
    if not smoothness:
        return
    if len(joints) < 3:
        yield f"smoothness: {len(joints)} frames have no acceleration: it changes nothing"
        return
    if not held:
        yield "smoothness: the keypoints contradict a smooth motion: frames are fitted one by one"
    elif held > 1.5 * smoothness:
        yield (
            f"smoothness {smoothness:g}: the keypoints contradict it: accelerations are held to"
            f" {held:g} instead"
        )
    off = np.linalg.norm(accelerations(joints), axis=-1).mean(-1) / 2
    around = np.linalg.norm(joints[2:] - joints[:-2], axis=-1).mean(-1)
    # a frame is far from its neighbours if its distance from their midpoint exceeds four times
    # half their distance
    for frame in 1 + np.flatnonzero(off > 4.0 * around / 2 + MOTION_SCALE * smoothness):
        yield (
            f"frame {frame}: {off[frame - 1]:.2f} m from where the frames beside it would have it:"
            " is it somebody else?"
        )
