"""What a refinement says: numbers before and after, view by view, and how far it moved things."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.data.capture import Capture
from humangs_jax.fitting.solvers import Outcome
from humangs_jax.geometry import quaternion

LEAST_IOU = 0.6
"""Bodies in clothes overlap masks by more than this; less means that the start was too far off."""
NAMES = {
    "silhouette_iou": ("silhouette IoU", "{:.3f}"),
    "keypoint_error_px": ("keypoints, median", "{:.2f} px"),
    "avatar_psnr": ("avatar like the photos", "{:.2f} dB"),
    "loss": ("loss", "{:.4f}"),
}


@dataclasses.dataclass(frozen=True)
class Moved:
    """How far two captures of one person differ, means: focal, as a factor; turn of cameras, degrees, and shift, metres; joints'
    rotations, degrees, over all, and the root's shift, metres.
    """

    focal: float
    turn: float
    shift: float
    bend: float
    place: float


@dataclasses.dataclass(frozen=True, eq=False)
class Refinement:
    """What came of it; `str()` is the report.

    capture: the better one. before, after: numbers of the start and of `capture`: silhouette_iou, keypoint_error_px and
    avatar_psnr where known, and loss, which decided. kept: "start" or "refined". views: by name, overlap before and after,
    NaN without a mask. moved: how far. stages: what was done with each, one line. outcomes: of the solvers, of "silhouettes"
    a batch of rounds.
    """

    capture: Capture
    before: dict[str, float]
    after: dict[str, float]
    kept: str
    views: dict[str, tuple[float, float]]
    moved: Moved
    stages: tuple[str, ...]
    outcomes: dict[str, Outcome]

    def __str__(self) -> str:
        """Before and after, view by view."""
        return _report(self)


def how_far(start: Capture, refined: Capture) -> Moved:
    """From the start to what came of it."""
    a, b = start.cameras, refined.cameras
    relative = jnp.matmul(b.cam_from_world[:, :3, :3], jnp.swapaxes(a.cam_from_world[:, :3, :3], -1, -2))
    joints = lambda capture: quaternion.matrix_from_axis_angle(capture.poses.rotations)
    between = jnp.matmul(jnp.swapaxes(joints(start), -1, -2), joints(refined))
    length = lambda x: float(np.linalg.norm(np.asarray(x), axis=-1).mean())
    return Moved(
        focal=float(np.mean(np.asarray(b.K[:, 0, 0] / a.K[:, 0, 0]))),
        turn=_mean_angle(relative),
        shift=length(b.center - a.center),
        bend=_mean_angle(between),
        place=length(refined.poses.translation - start.poses.translation),
    )


def _report(refinement):
    before, after, moved = refinement.before, refinement.after, refinement.moved
    width = max(4, *(len(name) for name in refinement.views))
    lines = [f"{'view':<{width}}  IoU before  after"]
    lines += [
        f"{name:<{width}}  {'no mask' if np.isnan(a) else f'{a:.3f}':>10}  {'' if np.isnan(b) else f'{b:.3f}'}".rstrip()
        for name, (a, b) in refinement.views.items()
    ]
    for key, (name, form) in NAMES.items():
        if key in before:
            lines.append(f"{name}: {form.format(before[key])} -> {form.format(after[key])}")
    lines += refinement.stages
    lines.append(f"kept: {refinement.kept}")
    if refinement.kept == "refined":
        lines.append(
            f"moved: focal length x {moved.focal:.4f}, cameras {moved.turn:.2f} degrees and {100 * moved.shift:.1f} cm, "
            f"joints {moved.bend:.2f} degrees, person {100 * moved.place:.1f} cm (means)"
        )
    if after.get("silhouette_iou", 1.0) < LEAST_IOU:
        lines.append(
            "warning: body and masks still do not agree: the start was too far off for this; `humangs check` tells why"
        )
    return "\n".join(lines)


def _mean_angle(rotations):
    """Degrees."""
    angles = quaternion.to_axis_angle(quaternion.from_matrix(rotations))
    return float(np.degrees(np.linalg.norm(np.asarray(angles), axis=-1)).mean())
