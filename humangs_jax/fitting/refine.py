"""Cameras, shape and poses refined against silhouettes, keypoints and photos: never worse than the start.

Silhouettes and keypoints first (`refine_rounds`), then, if asked for, the photos' colours. The result of each is kept only if
its score is better than before.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.usable_views import usable_indices
from humangs_jax.fitting.refine_rounds import (
    CaptureRefineConfig,
    Scene,
    capture_origin,
    moved_capture,
    start_state,
)
from humangs_jax.fitting.report import Change, FitReport, Stage, ViewReport, limit_violations
from humangs_jax.fitting.residuals.colors import Likeness, color_residuals, likeness
from humangs_jax.fitting.solve import Outcome, solve
from humangs_jax.fitting.state import cameras_of, pose_of
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
    photometric: bool = False,
    config: CaptureRefineConfig = DEFAULT_CONFIG,
) -> RefinedCapture:
    """Refine cameras (rotation, centre, focal length), shape and poses of a capture.

    Arguments: keypoints: of the capture's views. photometric: also by the photos' colours, with the weights that come with the
    package. config: after a fit to these keypoints, see `usual_config`. Views whose mask is empty take no part; those whose mask
    hardly meets the body take none in the colours.
    Raises: CaptureError if there is neither a mask that shows anybody nor a keypoint, or colours are asked for without masks;
    ValueError if the keypoints are of another number of views.
    """
    _check(capture, keypoints, photometric)
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
    psnrs = None
    if photometric:
        best, score, psnrs, stage, line = _refine_by_colors(scene, best, score, before, config)
        stages.append(stage)
        notes.append(line)
    return RefinedCapture(best, _report(capture, best, before, score, psnrs, tuple(stages), notes))


def _check(capture, keypoints, photometric):
    """Whether there is anything to refine by."""
    masks = capture.masks is not None and (np.asarray(capture.masks) > 0.5).any()
    if keypoints is not None and len(keypoints.points) != capture.view_count:
        raise ValueError(f"keypoints: of {len(keypoints.points)} views, but the capture has {capture.view_count}")
    seen = keypoints is not None and (keypoints.confidences > 0).any()
    if not masks and not seen:
        raise CaptureError(
            "capture", "masks", "none shows anybody, and there are no keypoints: refinement needs one or the other"
        )
    if photometric and not masks:
        raise CaptureError("capture", "masks", "needed for colours: without masks the room is taken for the person")


# Colours -------------------------------------------------------------------------------------------------------------


def _refine_by_colors(scene, capture, score, before, config):
    """The better capture, its score, PSNR of the avatar of the start and of the result, the stage, and a line about it."""
    from humangs_jax.network.weights import load_weights

    look, usable = functools.partial(likeness, *load_weights()), usable_indices(capture)
    shown = capture.select(usable)
    now = look(shown)
    first = now.psnr if capture is scene.capture else look(scene.capture.select(usable)).psnr
    moved, outcome = by_colors(now, shown, config)
    tried = _with_moved(capture, usable, moved)
    then, found = look(moved).psnr, scene.score(tried)
    better = then > now.psnr and found.loss <= before.loss
    line = f"photos: PSNR of the avatar {now.psnr:.2f} -> {then:.2f} dB, {'kept' if better else 'not kept'}"
    stage = Stage.of("photos", outcome)
    if better:
        return tried, found, (first, then), stage, line
    return capture, score, (first, now.psnr), stage, line


def _with_moved(capture, usable, moved):
    """A capture with the shape and poses of another one and, for the views that this one has, its cameras."""
    ours, theirs = capture.cameras, moved.cameras
    at = np.asarray(usable)
    cameras = replace(
        ours, K=ours.K.at[at].set(theirs.K), cam_from_world=ours.cam_from_world.at[at].set(theirs.cam_from_world)
    )
    return dataclasses.replace(capture, cameras=cameras, betas=moved.betas, poses=moved.poses)


def by_colors(found: Likeness, capture: Capture, config: CaptureRefineConfig) -> tuple[Capture, Outcome]:
    """A capture with cameras and poses moved so that its avatar is more like the photos, and what the solver did."""
    origin = capture_origin(capture, found.views.cameras, config)
    noise = jnp.asarray(found.noise)
    start = start_state(origin, config)
    free = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, bool), start)
    free = replace(free, betas=~free.betas, clothing=~free.clothing)  # the avatar has its own shape
    state, outcome = _solve_colors(found.avatar, found.views, origin, start, free, noise, config, found.splatting)
    return moved_capture(capture, origin, state), outcome


@functools.partial(jax.jit, static_argnames=("config", "splatting"))
def _solve_colors(avatar, views, origin, start, free, noise, config, splatting):
    def residuals(state):
        K, cam_from_world = cameras_of(origin, state)
        cameras = replace(views.cameras, K=K, cam_from_world=cam_from_world)
        poses = jax.tree.map(lambda leaf: leaf[origin.views.frame], pose_of(origin, state))
        colors = color_residuals(avatar, views, poses, cameras, splatting, noise, config.independent_colors)
        return {"colors": colors, "prior": state}

    return solve(residuals, start, config.color_steps, method="lbfgs", free=free)


# The report ----------------------------------------------------------------------------------------------------------


def _better(found, before, most_worse):
    known = found.keypoints is not None and before.keypoints is not None
    least = LEAST_GAIN if known else LEAST_GAIN_OF_MASKS
    worse = known and found.keypoints > most_worse * before.keypoints
    return not worse and before.loss - found.loss > max(least * before.loss, LEAST_DIFFERENCE)


def _report(start, best, before, after, psnrs, stages, notes):
    kept = best is not start
    pairs = {
        "silhouette_iou": (before.iou, after.iou),
        "keypoint_error_px": (before.keypoints, after.keypoints),
        "avatar_psnr": psnrs or (None, None),
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
