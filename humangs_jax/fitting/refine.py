"""Cameras, shape and poses refined against silhouettes and keypoints (`refine_iterations`): kept only if the score is better."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np

from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.fitting.refine_iterations import (
    CaptureRefineConfig,
    Scene,
    moved_capture,
)
from humangs_jax.fitting.report import Change, FitReport, Stage, ViewReport, limit_violations
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT

LEAST_GAIN, LEAST_GAIN_OF_MASKS = 0.02, 0.2
"""Share of the loss that a kept change removes, with keypoints, and by masks alone. Masks of clothes are fitted a little better
by wrong bodies: for four people who started at the truth, by up to 0.15; keypoints show that.
"""
LEAST_DIFFERENCE = 0.005
"""Least decrease of the loss that is kept: less than half a percent of the silhouettes is rounding of pixels."""
LEAST_IOU = 0.6
"""Bodies in clothes overlap masks by more than this; less means that the start was too far off."""

DEFAULT_CONFIG = CaptureRefineConfig()


@dataclasses.dataclass(frozen=True, eq=False)
class RefinedCapture:
    """capture: the better one of start and result; the very start if `report.kept` is False."""

    capture: Capture
    report: FitReport


def refine_capture(
    capture: Capture,
    *,
    keypoints: Keypoints | None = None,
    config: CaptureRefineConfig = DEFAULT_CONFIG,
) -> RefinedCapture:
    """Refine cameras (rotation, centre, focal length), shape and poses of a capture.

    Arguments: keypoints: of the capture's views. config: after a fit to these keypoints, see `usual_config`. Views whose mask is
    empty take no part.
    Raises: CaptureError if there is neither a mask that shows anybody nor a keypoint; ValueError if the keypoints are of another
    number of views.
    """
    _check(capture, keypoints)
    scene = Scene(capture, keypoints, config)
    state, outcome, move = scene.run()
    tried = moved_capture(capture, scene.origin, state)
    before, found = scene.score(capture), scene.score(tried)
    kept = _better(found, before, config.keypoints_worse)
    best, score = (tried, found) if kept else (capture, before)
    stages = [Stage.of("silhouettes", outcome)]
    kinds = {"silhouettes": before.iou, "keypoints": before.keypoints}
    kinds = " and ".join(name for name, value in kinds.items() if value is not None)
    verdict = "kept" if kept else "no sufficient improvement, the start is kept"
    notes = [f"{kinds}: loss {before.loss:.4f} -> {found.loss:.4f}, {verdict} (last move {move:.2g} expected std)"]
    return RefinedCapture(best, _report(capture, best, before, score, tuple(stages), notes))


def _check(capture, keypoints):
    """Whether there is anything to refine by."""
    masks = capture.masks is not None and (np.asarray(capture.masks) > 0.5).any()
    if keypoints is not None and len(keypoints.points) != capture.view_count:
        raise ValueError(f"keypoints: of {len(keypoints.points)} views, but the capture has {capture.view_count}")
    seen = keypoints is not None and (keypoints.confidences > 0).any()
    if not masks and not seen:
        raise CaptureError(
            "capture", "masks", "none shows anybody, and there are no keypoints: refinement needs one or the other"
        )


# The report ----------------------------------------------------------------------------------------------------------


def _better(found, before, most_worse):
    known = found.keypoints is not None and before.keypoints is not None
    least = LEAST_GAIN if known else LEAST_GAIN_OF_MASKS
    worse = known and found.keypoints > most_worse * before.keypoints
    return not worse and before.loss - found.loss > max(least * before.loss, LEAST_DIFFERENCE)


def _report(start, best, before, after, stages, notes):
    kept = best is not start
    pairs = {
        "silhouette_iou": (before.iou, after.iou),
        "keypoint_error_px": (before.keypoints, after.keypoints),
        "loss": (before.loss, after.loss),
    }
    errors = {name: Change(b, a) for name, (a, b) in pairs.items() if b is not None}
    ious = zip(start.names, start.frames.tolist(), before.ious.tolist(), after.ious.tolist(), strict=True)
    moved = how_far(start, best) if kept else {}
    notes = [*notes, f"kept: {'refined' if kept else 'start'}"]
    if kept:
        notes.append(
            "moved: focal length x {focal_factor:.4f}, cameras {camera_degrees:.2f} degrees and {camera_cm:.1f} cm, "
            "joints {joint_degrees:.2f} degrees, person {transl_cm:.1f} cm (means)".format(**moved)
        )
    warnings = []
    if after.iou is not None and after.iou < LEAST_IOU:
        warnings.append("body and masks do not agree: the start was too far off; `humangs check` shows why")
    return FitReport(
        fitted="refinement",
        kept=kept,
        errors=errors,
        views=tuple(ViewReport(name, frame, iou_before=a, iou_after=b) for name, frame, a, b in ious),
        stages=stages,
        moved=moved,
        violations=limit_violations(best.body.joint_names, best.poses),
        notes=tuple(notes),
        warnings=tuple(warnings),
    )


def how_far(start: Capture, refined: Capture) -> dict[str, float]:
    """How far two captures of one person differ, means: focal_factor; camera_degrees, camera_cm; joint_degrees of the joints'
    rotations, transl_cm of the root.
    """
    a, b = start.cameras, refined.cameras
    product = functools.partial(jnp.matmul, precision=EXACT)
    relative = product(b.cam_from_world[:, :3, :3], jnp.swapaxes(a.cam_from_world[:, :3, :3], -1, -2))
    joints = lambda capture: quaternion.matrix_from_axis_angle(capture.poses.rotations)
    between = product(jnp.swapaxes(joints(start), -1, -2), joints(refined))
    length = lambda x: float(np.linalg.norm(np.asarray(x), axis=-1).mean())
    degrees = lambda rotations: np.degrees(length(quaternion.to_axis_angle(quaternion.from_matrix(rotations))))
    return {
        "focal_factor": float(np.mean(np.asarray(b.K[:, 0, 0] / a.K[:, 0, 0]))),
        "camera_degrees": float(degrees(relative)),
        "camera_cm": 100 * length(b.center - a.center),
        "joint_degrees": float(degrees(between)),
        "transl_cm": 100 * length(refined.poses.translation - start.poses.translation),
    }
