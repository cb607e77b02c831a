"""Keypoints of the views of a capture, in memory."""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.keypoints.sets import KeypointSet


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """One person's keypoints in each of v views (numpy on the host).

    points: (v, k, 2) float32 pixels, x right and y down, the centre of the first pixel at (0.5, 0.5); finite, and without
        meaning where the confidence is 0.
    confidences: (v, k) float32 in [0, 1]; 0: the point is missing.
    set: what the k points are. missing: names of the views of which the file has nothing.
    not_finite: points that were NaN or infinite in the file. far_outside: points more than half an image outside of it.
        Both kinds have confidence 0.
    """

    points: Float[np.ndarray, "v k 2"]
    confidences: Float[np.ndarray, "v k"]
    set: KeypointSet
    missing: tuple[str, ...] = ()
    not_finite: int = 0
    far_outside: int = 0
