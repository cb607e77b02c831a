"""A body compared with the keypoints that it was found from: errors by view and frame, limits, exchanges.

Errors are distances in pixels between a keypoint and the body's landmark in the same view. Only what points to a mistake is a
warning: that the views do not determine the fingers is normal for 17 keypoints.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.fitting.camera_errors import find_camera_errors
from humangs_jax.fitting.files import FitRecord
from humangs_jax.fitting.report import (
    Change,
    FitReport,
    ViewReport,
    keypoint_warnings,
    limit_violations,
    undetermined_joints,
)
from humangs_jax.fitting.residuals.keypoints import found_noise, group_by_frame, keypoint_errors, landmark_certainty
from humangs_jax.fitting.swaps import Swap, find_exchanged_hands, find_swaps

OUTLIER = 5.0
"""Standard deviations of the noise beyond which a keypoint is an outlier: the robust scale of the last stage of a fit."""


REMEDIES = "`humangs fit` turns it back", "give its photos to other frames"
"""Of cameras that are turned, and late."""


@dataclasses.dataclass(frozen=True, eq=False)
class Examination:
    """The report on a body and keypoints, and the arrays behind it, of v views, m frames and k keypoints.

    frames: (m,) median error, pixels, NaN where no view has keypoints. noise: (m,) std of the keypoints, pixels. landmarks:
    (v, k, 2) of the body, pixels. compared, outliers: (v, k).
    """

    report: FitReport
    frames: Float[np.ndarray, " m"]
    noise: Float[np.ndarray, " m"]
    landmarks: Float[np.ndarray, "v k 2"]
    compared: Bool[np.ndarray, "v k"]
    outliers: Bool[np.ndarray, "v k"]


def examine(
    capture: Capture,
    keypoints: Keypoints,
    *,
    joint_std: Float[np.ndarray, "m j"] | None = None,
    determined: Float[np.ndarray, "m j"] | None = None,
    noise: Float[np.ndarray, " m"] | None = None,
    mirrored: tuple[Swap, ...] = (),
) -> Examination:
    """Compare the body of a capture with keypoints of its views, in the order of the views.

    Arguments: joint_std, determined: of joints, metres and shares, see `fit_uncertainty`. noise: pixels, as the fit found it;
    default: from the median error. mirrored: result of `find_mirrored`.
    Raises: ValueError if the number of views differs, or the body has none of the landmarks.
    """
    if len(keypoints.points) != capture.view_count:
        raise ValueError(f"keypoints of {len(keypoints.points)} views, but the capture has {capture.view_count}")
    observations, views = group_by_frame(capture, keypoints)
    expected, poses = np.asarray(observations.noise), jax.tree.map(lambda leaf: leaf[: len(views)], capture.poses)
    model = landmark_model(capture.body, keypoints.set.names, keypoints.set.places)
    errors = np.asarray(_errors(model, jnp.asarray(capture.betas), poses, observations))
    compared = np.asarray(observations.confidences > 0) & np.asarray(model.known)
    lengths = np.where(compared, np.linalg.norm(errors, axis=-1), np.nan)
    frames = np.asarray([_quantile(own, 0.5) for own in lengths])
    noise = np.asarray(found_noise(jnp.asarray(frames), observations.noise)) if noise is None else noise[: len(views)]
    outliers = compared & (lengths * landmark_certainty(model.names) > OUTLIER * noise[:, None, None])

    frame_of, slot_of = np.argwhere(views >= 0)[np.argsort(views[views >= 0])].T
    by_view = lambda values: values[frame_of, slot_of]
    numbers = zip(capture.names, frame_of.tolist(), by_view(lengths), by_view(outliers), strict=True)
    rows = tuple(_view_report(*own) for own in numbers)
    violations = limit_violations(capture.body.joint_names, poses)
    known = [None if values is None else values[: len(views)] for values in (joint_std, determined)]
    swaps = (*mirrored, *find_swaps(observations, keypoints.set, views, capture.names))
    swaps += find_exchanged_hands(keypoints, capture.names)
    report = FitReport(
        fitted="keypoints",
        errors={"keypoint_error_px": Change(_quantile(lengths, 0.5))} if compared.any() else {},
        views=rows,
        violations=violations,
        swaps=swaps,
        undetermined=undetermined_joints(capture.body.joint_names, compared.any((1, 2)), *known),
        notes=_worst_frame(frames),
        warnings=(
            *(
                f"{error}, as the keypoints show: {REMEDIES[error.late != 0]}"
                for error in find_camera_errors(capture, keypoints)
            ),
            *keypoint_warnings(rows, expected, violations, swaps),
        ),
    )
    landmarks = by_view(errors + np.asarray(observations.points))
    return Examination(report, frames, noise, landmarks, by_view(compared), by_view(outliers))


def examine_record(
    capture: Capture, record: FitRecord | None, keypoints: Keypoints | None = None
) -> tuple[Examination, Keypoints]:
    """Examine a capture with the record of its fit, or with other keypoints; also returns the keypoints, ordered by view.

    Raises: ValueError if both are None, if the record is of other views or of fewer frames, or as `examine` does.
    """
    if keypoints is not None:
        return examine(capture, keypoints), keypoints
    if record is None:
        raise ValueError("neither keypoints nor the record of a fit to examine the body with")
    keypoints = record.of_views(capture.names)
    if len(record.noise) <= capture.frames.max() or record.joint_std.shape[1] != len(capture.body.joint_names):
        raise ValueError(
            f"the capture's fit is of {len(record.noise)} frames and {record.joint_std.shape[1]} joints, but the capture has "
            f"{capture.frames.max() + 1} and {len(capture.body.joint_names)}: fit it again"
        )
    known = {name: getattr(record, name) for name in ("joint_std", "determined", "noise")}
    return examine(capture, keypoints, **known), keypoints


@jax.jit
def _errors(model, betas, poses, observations):
    """(m, c, k, 2) landmarks less keypoints, pixels."""
    landmarks = jax.vmap(lambda pose: pose_landmarks(model, betas, pose)[0])(poses)
    return jax.vmap(keypoint_errors)(observations, landmarks)


def _worst_frame(frames):
    known = np.flatnonzero(np.isfinite(frames))
    if len(frames) < 2 or not len(known):
        return ()
    worst = known[np.argmax(frames[known])]
    middle = np.median(frames[known])
    return (f"frames: median error {middle:.1f} px, worst in frame {worst}: {frames[worst]:.1f} px",)


def _view_report(name, frame, lengths, outliers):
    count = int(np.isfinite(lengths).sum())
    share = float(outliers.sum() / max(count, 1))
    return ViewReport(name, frame, count, _quantile(lengths, 0.5), _quantile(lengths, 0.9), share)


def _quantile(values, share):
    """A quantile of the values that are not NaN; NaN if all are."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, share)) if known.size else float("nan")
