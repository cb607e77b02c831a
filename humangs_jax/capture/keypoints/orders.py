"""Finds the order of OpenPose's points, because its files do not state it. 25 points are BODY_25's
or BODY_25B's. 18 points are those of OpenPose's model COCO, or COCO's 17 points and a neck.

In the right order the bones are shortest on average. In a wrong order a bone can lead from a knee
to a wrist.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from humangs_jax.capture.keypoints.keypoints import (
    COCO_17,
    OPENPOSE_60,
    OPENPOSE_67,
    OPENPOSE_67B,
    SIDES,
    Detections,
    KeypointSet,
)
from humangs_jax.core.array_types import Float


class Order(NamedTuple):
    """A possible order of the points of the body."""

    name: str
    """Name of the order."""
    points: tuple[str, ...]
    """Names of the points, in this order."""
    set: KeypointSet
    """Set to which the points are converted. It has the same points of the body, perhaps in another
    order, and then the points of the hands.
    """


_ORDERS = {
    25: (
        Order("BODY_25", OPENPOSE_67.names[:25], OPENPOSE_67),
        Order("BODY_25B", OPENPOSE_67B.names[:25], OPENPOSE_67B),
    ),
    18: (
        Order("OpenPose's COCO", OPENPOSE_60.names[:18], OPENPOSE_60),
        Order("COCO with a neck", (*COCO_17.names, "neck"), OPENPOSE_60),
    ),
}
"""Possible orders, by the number of points. The usual order comes first."""
_BONES = (
    *(("nose", f"{side}_eye") for side in SIDES),
    *((f"{side}_eye", f"{side}_ear") for side in SIDES),
    *(
        (f"{side}_{a}", f"{side}_{b}")
        for side in SIDES
        for chain in (
            ("ear", "shoulder", "elbow", "wrist"),
            ("shoulder", "hip", "knee", "ankle", "heel"),
            ("ankle", "big_toe", "small_toe"),
        )
        for a, b in itertools.pairwise(chain)
    ),
    *((f"left_{part}", f"right_{part}") for part in ("shoulder", "hip")),
)
"""Pairs of points that are near each other on a person."""


@dataclasses.dataclass(frozen=True)
class _Known:
    """Limits that decide whether the order of points is clear from their positions."""

    shorter: float = 1.15
    """An order is clear only if every other order makes the mean length of the bones larger by at
    least this factor. This holds for 99 % of single people in random poses that are seen from
    anywhere, if the points have errors of 1 % of the person's height.
    """
    longest: float = 0.36
    """An order is clear only if the mean length of its bones is at most this, as a share of the
    person's size. It is 0.13 to 0.3 for people in random poses, 0.25 to 0.35 if only the trunk is
    seen, and 0.52 for points in random order.
    """
    fewest: int = 6
    """An order is clear only if all people together show at least this many bones."""
    confident: float = 0.1
    """A point is used if its confidence exceeds this number."""


KNOWN = _Known()


def in_order(detections: Detections, count: int) -> Detections:
    """Returns detections with the right keypoint set, and with the points in the order of this set.
    The order of the given points is found from their positions.

    count: number of points of the body, 25 or 18. Points of the hands may follow. If the order is
    not clear, the usual one is assumed. A warning names the order, except if 25 points are clearly
    BODY_25.
    """
    orders = _ORDERS[count]
    people = [person for image in detections.images for person in image.people]
    lengths = [_mean_bone(people, order.points, count) for order in orders]
    best = int(np.argmin(lengths))
    others = min(length for i, length in enumerate(lengths) if i != best)
    known = lengths[best] <= KNOWN.longest and others >= KNOWN.shorter * lengths[best]
    order = orders[best] if known else orders[0]
    warnings = detections.warnings
    usual = known and best == 0 and count == 25
    if not usual:
        warnings = (*warnings, _order_note(order, known, count))

    # the points of the body in the order of the set, and the hands behind them
    rows = [order.points.index(name) for name in order.set.names[:count]]
    images = []
    for image in detections.images:
        people = tuple(np.concatenate([person[rows], person[count:]]) for person in image.people)
        images.append(dataclasses.replace(image, people=people))
    return dataclasses.replace(detections, set=order.set, images=tuple(images), warnings=warnings)


def _order_note(order: Order, known: bool, count: int) -> str:
    if known:
        return f"{count} points in the order of {order.name}, by where they lie"
    others = " or ".join(each.name for each in _ORDERS[count] if each is not order)
    return (
        f"the order of the {count} points is not clear from where they lie: taken for {order.name},"
        f" not {others}"
    )


def _mean_bone(
    people: Sequence[Float[np.ndarray, "k columns"]], names: tuple[str, ...], count: int
) -> float:
    """Returns the mean length of the bones in an order, as a share of the person's size. It is
    infinite if there are too few bones. names: names of the points in this order.
    """
    index = {name: i for i, name in enumerate(names)}
    pairs = np.asarray([[index[a], index[b]] for a, b in _BONES if a in index and b in index])
    lengths: list[float] = []
    for person in people:
        points = person[:count]
        seen = np.isfinite(points).all(axis=1) & (points[:, 2] > KNOWN.confident)
        both = pairs[seen[pairs].all(axis=1)]
        if len(both):
            size = float(np.ptp(points[seen, :2], axis=0).max())
            bones = np.linalg.norm(points[both[:, 0], :2] - points[both[:, 1], :2], axis=1)
            lengths += (bones / max(size, 1e-6)).tolist()
    return float(np.mean(lengths)) if len(lengths) >= KNOWN.fewest else np.inf
