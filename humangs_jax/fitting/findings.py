"""What is worth a word about a body and its keypoints: in few words, however many views, moments and joints it is about."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from humangs_jax.body.joints import FINGERS
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.fitting.pose_prior import pose_prior, violations
from humangs_jax.fitting.swaps import Swap

MANY_OUTLIERS = 0.3
"""Share of the keypoints of a view: a fit bears more, but a detector that errs so often saw something else."""
OFF = 4.0
"""Times the expected noise: a view with this median error, 2 % of the person's height, shows another pose or camera."""
FAR_BEYOND = 10.0
"""Degrees beyond the range of a joint that are worth a warning: ranges are boxes of rotation vectors, and rough."""
UNSURE, UNDECIDED = 0.03, 0.1
"""A joint is open with a larger standard deviation than this, metres, or a smaller share of its rotation that is determined: a
mean over axes, of which knees and fingers have one that turns."""
NAMED = 5
"""So many are named, and the others counted."""

_FINGERS = {side: [f"{side}_{finger}{i}" for finger in FINGERS for i in (1, 2, 3)] for side in ("left", "right")}
GROUPS = {
    "left hand": _FINGERS["left"],
    "right hand": _FINGERS["right"],
    "eyes": ["left_eye", "right_eye"],
    "feet": ["left_foot", "right_foot"],
    "spine": ["spine1", "spine2", "spine3"],
    "collars": ["left_collar", "right_collar"],
}
"""Joints that are named together if all of them are open."""


@dataclasses.dataclass(frozen=True)
class ViewFit:
    """One view: keypoints that were compared, their median error and 90th percentile in pixels (NaN: none), share of outliers."""

    name: str
    moment: int
    keypoints: int
    median: float
    high: float
    outliers: float


@dataclasses.dataclass(frozen=True)
class Violation:
    """A joint that turns so many degrees further about an axis of the T-pose than joints do."""

    moment: int
    joint: str
    axis: str
    degrees: float


def limit_violations(joint_names: tuple[str, ...], poses: BodyPose) -> tuple[Violation, ...]:
    """Of a batch of poses, by moment."""
    prior, rotations = pose_prior(joint_names), np.asarray(poses.rotations)
    return tuple(
        Violation(moment, joint_names[j], "xyz"[axis], float(np.rad2deg(beyond)))
        for moment, own in enumerate(rotations)
        for j, axis, beyond in violations(prior, own)
    )


def open_joints(
    joint_names: tuple[str, ...],
    shown: Bool[np.ndarray, " m"],
    deviations: Float[np.ndarray, "m j"] | None,
    determined: Float[np.ndarray, "m j"] | None,
) -> tuple[str, ...]:
    """Joints that the views leave open in the moments `shown`, fingers and the like as one.

    Arguments: deviations: metres. determined: shares. Of one that is not given nothing is said.
    """
    undecided = np.zeros((len(shown), len(joint_names)), bool)
    if deviations is not None:
        undecided |= deviations > UNSURE
    if determined is not None:
        undecided |= determined < UNDECIDED
    counts = dict(zip(joint_names, undecided[shown].sum(0).tolist(), strict=True))
    counts = {name: count for name, count in counts.items() if count}
    found = []
    for group, members in GROUPS.items():
        if all(name in counts for name in members):
            found.append((group, max(counts.pop(name) for name in members)))
    found += counts.items()
    total = int(shown.sum())
    return tuple(name if count == total else f"{name} (in {count} of {total} moments)" for name, count in found)


def warnings(
    fits: Sequence[ViewFit],
    expected: Float[np.ndarray, " m"],
    violations: Sequence[Violation],
    swaps: Sequence[Swap],
) -> tuple[str, ...]:
    """What points to a mistake. expected: noise of the keypoints of each moment, pixels."""
    found = [str(swap) for swap in swaps[:NAMED]]
    if len(swaps) > NAMED:
        found.append(f"{len(swaps) - NAMED} more views or pairs of views seem exchanged")
    blind = [fit for fit in fits if not fit.keypoints]
    off = [fit for fit in fits if fit.keypoints and fit.median > OFF * expected[fit.moment]]
    wild = [fit for fit in fits if fit not in off and fit.outliers > MANY_OUTLIERS]
    if blind:
        found.append(f"no keypoints in {_views(blind)}")
    if off:
        found.append(
            f"the body is not where the keypoints are in {_views(off)}: {_span(off, 'median', '{:.0f}')} px off"
        )
    if wild:
        found.append(f"many keypoints are outliers in {_views(wild)}: {_span(wild, 'outliers', '{:.0%}')}")
    return (*found, *_contortions(violations))


def _contortions(violations):
    """A warning per joint and axis that is far beyond its range."""
    far: dict[tuple[str, str], list[Violation]] = {}
    for each in violations:
        if each.degrees > FAR_BEYOND:
            far.setdefault((each.joint, each.axis), []).append(each)
    for (joint, axis), of in far.items():
        moments = listed([str(each.moment) for each in of])
        worst = max(each.degrees for each in of)
        yield f"{joint} turns {worst:.0f} degrees further about {axis} than joints do, in moment {moments}"


def listed(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def _views(fits):
    return f"view {listed([fit.name for fit in fits])}"


def _span(fits, field, form):
    """The least and the greatest value of a field, or the one that all have."""
    ends = [form.format(of(getattr(fit, field) for fit in fits)) for of in (min, max)]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)
