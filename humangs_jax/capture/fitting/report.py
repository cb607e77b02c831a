"""The report of a fit: what was fitted, errors by kind of evidence, limits, uncertainty and
warnings.

`str(report)` is what the command line prints. `report.to_json()` is stored beside the result.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import FINGERS
from humangs_jax.body.model import BodyPose
from humangs_jax.capture.fitting.state import pose_prior
from humangs_jax.capture.fitting.swaps import Swap
from humangs_jax.core.array_types import Float
from humangs_jax.core.progress import text_table
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import few


@dataclasses.dataclass(frozen=True)
class _Worth:
    """Limits that decide whether something in a fit gets a line in the report."""

    outliers: float = 0.3
    """A view gives a warning if more than this share of its keypoints are outliers. The fit itself
    tolerates more. But the detector has then probably seen somebody or something else.
    """
    off: float = 4.0
    """A view gives a warning if its median error exceeds the expected noise by more than this
    factor. The error is then more than 2 % of the person's size in the photo. Such a view shows
    another pose, or its camera is wrong.
    """
    beyond_limit: float = np.rad2deg(0.05)
    """A joint is reported if it exceeds its limit by more than this angle, degrees. Smaller
    violations are ignored, because limits are rough.
    """
    far_beyond: float = 10.0
    """A joint gives a warning if it exceeds its limit by more than this angle, degrees."""
    std: float = 0.03
    """A joint is undetermined if the standard deviation of its position exceeds this, metres."""
    determined: float = 0.1
    """A joint is undetermined if the views determine less than this share of its rotation. The
    share is a mean over three axes, and knees and fingers turn about only one.
    """
    named: int = 5
    """Largest number of items that are listed by name. Further items are only counted."""
    rows: int = 24
    """Largest number of rows of the printed table. If there are more views, those with the largest
    errors are shown.
    """


WORTH_A_LINE = _Worth()


_LABELS = {
    "keypoint_error_px": ("keypoints, median error", "{:.2f} px"),
    "silhouette_iou": ("silhouette IoU", "{:.3f}"),
    "loss": ("loss", "{:.4f}"),
}
"""Label and number format of each error, by the error's name."""


@dataclasses.dataclass(frozen=True)
class Change:
    """An error of the result, and the same error at the start of the fit."""

    after: float
    """Error of the result."""
    before: float | None = None
    """Error at the start of the fit. None if there was no start."""


@dataclasses.dataclass(frozen=True)
class ViewReport:
    """How well the body agrees with one view."""

    name: str
    """Name of the view."""
    frame: int
    """Index of the view's frame."""
    keypoints: int = 0
    """Number of keypoints that were compared."""
    median: float = float("nan")
    """Median error of the keypoints, pixels. NaN without keypoints."""
    high: float = float("nan")
    """90th percentile of the errors, pixels. NaN without keypoints."""
    outliers: float = 0.0
    """Share of the keypoints that are outliers."""
    iou_before: float | None = None
    """Intersection over union of body and mask at the start. NaN if the mask of the view is missing
    or empty. None for a fit to keypoints.
    """
    iou_after: float | None = None
    """Intersection over union of body and mask for the result. NaN and None as in `iou_before`."""


@dataclasses.dataclass(frozen=True)
class Violation:
    """A joint that exceeds its limit about an axis of the T-pose."""

    frame: int
    """Index of the frame."""
    joint: str
    """Name of the joint."""
    axis: str
    """Name of the axis: "x", "y" or "z"."""
    degrees: float
    """Angle beyond the limit, degrees."""


@dataclasses.dataclass(frozen=True)
class FitReport:
    """The report of a fit."""

    fitted: Literal["keypoints", "refinement"]
    """Kind of fit. "keypoints": a fit to keypoints alone. "refinement": a fit to masks, keypoints
    or both.
    """
    kept: bool = True
    """Whether the result is used. False: it was not clearly better than the start, and the start is
    used.
    """
    errors: dict[str, Change] = dataclasses.field(default_factory=dict)
    """Errors by name, see `_LABELS`."""
    views: tuple[ViewReport, ...] = ()
    """A row for each view."""
    moved: dict[str, float] = dataclasses.field(default_factory=dict)
    """How far a refinement moved cameras and body, with the keys of `how_far`. Empty if the start
    was kept, and for a fit to keypoints.
    """
    violations: tuple[Violation, ...] = ()
    """Joints that exceed their limits."""
    swaps: tuple[Swap, ...] = ()
    """Sides, hands or cameras that seem to be exchanged."""
    undetermined: tuple[str, ...] = ()
    """Joints, or groups of joints, that the views do not determine."""
    notes: tuple[str, ...] = ()
    """Further results, one line each."""
    warnings: tuple[str, ...] = ()
    """Signs of a mistake, one line each."""

    @property
    def ok(self) -> bool:
        """Whether there is no warning."""
        return not self.warnings

    def to_json(self) -> dict[str, Any]:
        """Returns the report as plain values for JSON. Numbers that are not finite are None."""
        return _plain(dataclasses.asdict(self))

    def __str__(self) -> str:
        """Returns a table of views, then errors, notes, undetermined joints and warnings."""
        lines = _view_rows(self.views) if self.views else []
        for key, change in self.errors.items():
            label, form = _LABELS[key]
            start = "" if change.before is None else f"{form.format(change.before)} -> "
            lines.append(f"{label}: {start}{form.format(change.after)}")
        lines += self.notes
        if self.undetermined:
            lines.append(
                f"not determined by the views, taken from the prior: {', '.join(self.undetermined)}"
            )
        return "\n".join([*lines, *(f"warning: {warning}" for warning in self.warnings)])


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(own) for key, own in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(own) for own in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _view_rows(views: Sequence[ViewReport]) -> list[str]:
    # of many views only those that fit worst, in their order
    errors = [view.median if view.iou_after is None else 1 - view.iou_after for view in views]
    worst = np.argsort(-np.nan_to_num(errors, nan=np.inf), kind="stable")[: WORTH_A_LINE.rows]
    masks = views[0].iou_after is not None
    rows = [["view", "keypoints", "median error", "90 % below", "outliers"]]
    if masks:
        rows = [["view", "IoU before", "after"]]
    for view in (views[i] for i in sorted(worst)):
        if not masks:
            median, high = f"{view.median:.1f} px", f"{view.high:.1f} px"
            if not view.keypoints:
                median = high = "-"
            rows.append([view.name, str(view.keypoints), median, high, f"{view.outliers:.0%}"])
        elif np.isfinite(view.iou_before):
            rows.append([view.name, f"{view.iou_before:.3f}", f"{view.iou_after:.3f}"])
        else:
            rows.append([view.name, "no mask"])
    # views that are not shown are counted
    lines = text_table(rows)
    if len(views) > WORTH_A_LINE.rows:
        lines.append(f"...  {len(views) - WORTH_A_LINE.rows} more that fit better")
    return lines


# What points to a mistake
# --------------------------------------------------------------------------------------------


_FINGERS = {
    side: [f"{side}_{finger}{i}" for finger in FINGERS for i in (1, 2, 3)]
    for side in ("left", "right")
}
_GROUPS = {
    "left hand": _FINGERS["left"],
    "right hand": _FINGERS["right"],
    "eyes": ["left_eye", "right_eye"],
    "feet": ["left_foot", "right_foot"],
    "spine": ["spine1", "spine2", "spine3"],
    "collars": ["left_collar", "right_collar"],
}
"""Joints of each group, by the name of the group. If all joints of a group are undetermined, the
report has the group's name in place of their names.
"""


def limit_violations(joint_names: tuple[str, ...], poses: BodyPose) -> tuple[Violation, ...]:
    """Returns the joints that exceed their limits in a batch of poses by more than
    `_Worth.beyond_limit`, ordered by frame.
    """
    prior, rotations = pose_prior(joint_names), np.asarray(poses.rotations)
    beyond = np.rad2deg(np.maximum(prior.lower - rotations, rotations - prior.upper))
    found = np.argwhere(beyond > WORTH_A_LINE.beyond_limit)
    return tuple(
        Violation(int(m), joint_names[j], "xyz"[axis], float(beyond[m, j, axis]))
        for m, j, axis in found
    )


def undetermined_joints(
    joint_names: tuple[str, ...],
    joint_std: Float[np.ndarray, "m j"],
    determined: Float[np.ndarray, "m j"],
) -> tuple[str, ...]:
    """Returns the names of the joints that the views do not determine in m frames.

    If all joints of a group in `_GROUPS` are undetermined, the group's name replaces theirs. If
    joints are undetermined in some frames only, the number of frames follows the name.

    Arguments: joint_std: standard deviation of each joint's position, (m, j), metres. determined:
    share of each joint's rotation that the views determine, (m, j).
    """
    unknown = (joint_std > WORTH_A_LINE.std) | (determined < WORTH_A_LINE.determined)
    counts = {
        name: count
        for name, count in zip(joint_names, unknown.sum(0).tolist(), strict=True)
        if count
    }
    found = []
    for group, members in _GROUPS.items():
        if all(name in counts for name in members):
            found.append((group, max(counts.pop(name) for name in members)))
    found += counts.items()
    total = len(unknown)
    return tuple(
        name if count == total else f"{name} (in {count} of {total} frames)"
        for name, count in found
    )


def keypoint_warnings(
    views: Sequence[ViewReport],
    expected: Float[np.ndarray, " m"],
    violations: Sequence[Violation],
    swaps: Sequence[Swap],
) -> tuple[str, ...]:
    """Returns lines about signs of a mistake: exchanges, views without keypoints, views whose
    keypoints do not fit the body, and joints far beyond their limits.

    expected: expected noise of the keypoints of each frame, (m,), pixels.
    """
    found = [str(swap) for swap in swaps[: WORTH_A_LINE.named]]
    if len(swaps) > WORTH_A_LINE.named:
        found.append(
            f"{len(swaps) - WORTH_A_LINE.named} more views or pairs of views seem exchanged"
        )
    # views without keypoints, with another body or camera than the rest, and with a detector that
    # errs
    blind = [view for view in views if not view.keypoints]
    off = [
        view
        for view in views
        if view.keypoints and view.median > WORTH_A_LINE.off * expected[view.frame]
    ]
    wild = [view for view in views if view not in off and view.outliers > WORTH_A_LINE.outliers]
    if blind:
        found.append(f"no keypoints in {_names(blind)}")
    if off:
        found.append(
            f"body and keypoints disagree in {_names(off)}: median error"
            f" {_span(off, 'median', '{:.0f}')} px"
        )
    if wild:
        found.append(
            f"many keypoints are outliers in {_names(wild)}: {_span(wild, 'outliers', '{:.0%}')}"
        )
    # joints far beyond their limits, a line for each joint and axis
    far: dict[tuple[str, str], list[Violation]] = {}
    for each in violations:
        if each.degrees > WORTH_A_LINE.far_beyond:
            far.setdefault((each.joint, each.axis), []).append(each)
    for (joint, axis), of in far.items():
        worst = max(each.degrees for each in of)
        frames = few([str(each.frame) for each in of], WORTH_A_LINE.named)
        found.append(
            f"{joint} is {worst:.0f} degrees beyond its limit about {axis}, in frame {frames}"
        )
    return tuple(found)


def _names(views: Sequence[ViewReport]) -> str:
    return f"view {few([view.name for view in views], WORTH_A_LINE.named)}"


def _span(views: Sequence[ViewReport], field: str, form: str) -> str:
    """Returns the smallest and the largest value of a field as text. If both have the same text, it
    is returned once.
    """
    ends = [form.format(of(getattr(view, field) for view in views)) for of in (min, max)]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def how_far(start: Capture, refined: Capture) -> dict[str, float]:
    """Returns how far two captures of the same photos differ. Each value is a mean.

    Keys: focal_factor, the refined focal length divided by the one at the start. camera_degrees and
    camera_cm, rotation and shift of the cameras. joint_degrees, rotation of the joints, root
    included. transl_cm, change of the poses' translations.
    """
    both = (start, refined)
    focal = [np.asarray(each.cameras.K, float)[:, 0, 0] for each in both]
    matrices = [np.asarray(each.cameras.cam_from_world, float) for each in both]
    centers = [np.linalg.inv(each)[:, :3, 3] for each in matrices]
    camera_turns = [Rotation.from_matrix(each[:, :3, :3]) for each in matrices]
    rotations = [np.asarray(each.poses.rotations, float) for each in both]
    joint_turns = [Rotation.from_rotvec(each.reshape(-1, 3)) for each in rotations]
    places = [np.asarray(each.poses.translation, float) for each in both]
    return {
        "focal_factor": float(np.mean(focal[1] / focal[0])),
        "camera_degrees": _mean_degrees(*camera_turns),
        "camera_cm": 100 * _mean_length(centers[1] - centers[0]),
        "joint_degrees": _mean_degrees(*joint_turns),
        "transl_cm": 100 * _mean_length(places[1] - places[0]),
    }


def _mean_degrees(first: Rotation, second: Rotation) -> float:
    """Returns the mean angle between corresponding rotations, degrees."""
    return float(np.degrees((first.inv() * second).magnitude().mean()))


def _mean_length(vectors: Float[np.ndarray, "*n 3"]) -> float:
    """Returns the mean length of vectors."""
    return float(np.linalg.norm(vectors, axis=-1).mean())
