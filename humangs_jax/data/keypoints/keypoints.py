"""Keypoints of the views of a capture in memory, and our own file of them.

The file is an npz of points (v, k, 2), confidences (v, k), the set's name, and the names of the v views. Unlike in all
other formats the centre of the first pixel is at (0.5, 0.5).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.keypoints.sets import KeypointSet
from humangs_jax.io.npz import write_npz

LISTED = 5
"""Names of views in a warning, at most."""


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """One person's keypoints in each of v views (numpy on the host).

    points: (v, k, 2) float32 pixels, x right and y down, the centre of the first pixel at (0.5, 0.5); finite, and to be
        ignored where the confidence is 0.
    confidences: (v, k) float32 in [0, 1]; 0: the point is missing.
    set: what the k points are. missing: names of the views that the file has nothing for.
    not_finite: points that were NaN or infinite in the file. far_outside: points more than half an image outside of it.
        Both kinds have confidence 0.
    shifted: an image and its view, where they are counted from different numbers and were matched in order; else "".
    """

    points: Float[np.ndarray, "v k 2"]
    confidences: Float[np.ndarray, "v k"]
    set: KeypointSet
    missing: tuple[str, ...] = ()
    not_finite: int = 0
    far_outside: int = 0
    shifted: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of a keypoint file that could be read, a line each."""
        found = []
        if self.missing:
            names = ", ".join(self.missing[:LISTED]) + (" ..." if len(self.missing) > LISTED else "")
            found.append(f"no keypoints of {len(self.missing)} views: {names}")
        if self.shifted:
            found.append(
                f"frames and photos are counted from different numbers and were matched in order: {self.shifted}"
            )
        if self.not_finite:
            found.append(f"{self.not_finite} keypoints are not finite numbers and are ignored")
        if self.far_outside:
            found.append(
                f"{self.far_outside} keypoints lie far outside of their photo and are ignored: of photos of another size?"
            )
        return tuple(found)


def save_keypoints(path: str | Path, keypoints: Keypoints, names: Sequence[str]) -> None:
    """Write our own format (.npz). names: of the views, as in the capture. `read_keypoints` reads exactly these back.

    Raises: ValueError if the path does not end in .npz, or there is not one name per view.
    """
    if len(names) != len(keypoints.points):
        raise ValueError(f"names: expected one for each of {len(keypoints.points)} views, got {len(names)}")
    arrays = {
        "points": np.asarray(keypoints.points, np.float32),
        "confidences": np.asarray(keypoints.confidences, np.float32),
        "set": keypoints.set.name,
        "names": np.asarray(list(names), np.str_),
    }
    if Path(path).suffix != ".npz":
        raise ValueError(f"{path}: expected a name ending in .npz")
    write_npz(path, arrays)
