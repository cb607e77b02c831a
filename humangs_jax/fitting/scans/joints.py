"""Landmarks that are known of a scan: their names, and the files that they are read from."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.keypoints.sets import FINGER_JOINTS, FINGERS
from humangs_jax.io.npz import read_npz

SIDES = ("left", "right")
PARTS = ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "big_toe", "small_toe", "heel")
SCAN_LANDMARKS = (
    *("nose", "neck", "mid_hip"),
    *(f"{side}_{part}" for part in PARTS for side in SIDES),
    *(f"{side}_{finger}_{joint}" for side in SIDES for finger in FINGERS for joint in FINGER_JOINTS),
)
"""What joints of a scan may be named: the landmarks of `body/landmarks.py` less doubles and the face's."""


def checked_joints(joints: Mapping[str, Any]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Points (k, 3) in the order of `SCAN_LANDMARKS` and which of them are known (k,).

    Raises: ValueError for unknown names and points that are not three finite numbers.
    """
    if unknown := sorted(set(joints) - set(SCAN_LANDMARKS)):
        raise ValueError(
            f"joint '{unknown[0]}' is no landmark of ours: expected names such as {', '.join(SCAN_LANDMARKS[:6])}"
        )
    points, known = np.zeros((len(SCAN_LANDMARKS), 3)), np.zeros(len(SCAN_LANDMARKS))
    for name, point in joints.items():
        values = np.asarray(point)
        if values.shape != (3,) or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise ValueError(f"joint '{name}': expected three finite numbers, got {point}")
        points[SCAN_LANDMARKS.index(name)], known[SCAN_LANDMARKS.index(name)] = values, 1
    return points, known


def read_joints(path: str | Path) -> dict[str, Float[np.ndarray, "3"]]:
    """Landmarks by name in a scan's coordinates: JSON {"left_hip": [x, y, z], ...}, or npz with names (k,) and points (k, 3).

    Raises: ValueError, naming the file, if it is neither, or a name or a point is not one.
    """
    path = Path(path)
    try:
        joints = _joints_of_npz(path) if path.suffix == ".npz" else json.loads(path.read_text())
        if not isinstance(joints, dict):
            raise ValueError('expected {"left_hip": [x, y, z], ...}')
        if not joints:
            raise ValueError("no joints: expected three at least")
        checked_joints(joints)
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: {error}") from error
    return {name: np.asarray(point, np.float64) for name, point in joints.items()}


def _joints_of_npz(path):
    arrays, _ = read_npz(path)
    if missing := {"names", "points"} - set(arrays):
        raise ValueError(f"{min(missing)}: missing: expected names (k,) and points (k, 3)")
    names, points = [str(name) for name in arrays["names"]], arrays["points"]
    if len(names) != len(points):
        raise ValueError(f"points: {len(points)}, but {len(names)} names: expected one for each")
    return dict(zip(names, points, strict=True))
