"""fit.npz: what a fit was made from and how well it is known, beside the body.npz that it gave.

set, names (v,), points (v, k, 2), confidences (v, k)    the keypoints, as `humangs_jax.data.keypoints` stores them
noise (m,)               standard deviation of the detections, pixels
deviations (m, j)        of the joints' positions, metres; determined (m, j): share of their rotations that the views decide
shape_covariance (s, s)
"""

import dataclasses
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, numbers
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.sets import KEYPOINT_SETS
from humangs_jax.io.atomic import replace_file
from humangs_jax.io.npz import read_npz

FIT_FILE = "fit.npz"
KEYS = ("set", "names", "points", "confidences", "noise", "deviations", "determined", "shape_covariance")


@dataclasses.dataclass(frozen=True, eq=False)
class FitRecord:
    """What is kept of a fit, see the module."""

    keypoints: Keypoints
    names: tuple[str, ...]
    noise: Float[np.ndarray, " m"]
    deviations: Float[np.ndarray, "m j"]
    determined: Float[np.ndarray, "m j"]
    shape_covariance: Float[np.ndarray, "s s"]


def write_fit_record(path: str | Path, record: FitRecord) -> None:
    """Write fit.npz, whole or not at all."""
    arrays = {
        "set": np.asarray(record.keypoints.set.name),
        "names": np.asarray(record.names),
        "points": record.keypoints.points.astype(np.float32),
        "confidences": record.keypoints.confidences.astype(np.float32),
        **{key: np.asarray(getattr(record, key), np.float32) for key in KEYS[4:]},
    }
    replace_file(path, lambda temporary: np.savez(temporary, **arrays))  # ty: ignore[invalid-argument-type]


def read_fit_record(path: str | Path) -> FitRecord:
    """Raises: CaptureError naming file and key."""
    path = Path(path)
    try:
        values, pickled = read_npz(path)
    except OSError as error:
        raise CaptureError(path, "", error.strerror or error) from error
    if pickled:
        raise CaptureError(path, pickled[0], "expected plain arrays, got a pickled object")
    for key in KEYS:
        if key not in values:
            raise CaptureError(path, key, "missing: expected a file that `humangs fit` wrote")
    name = str(values["set"])
    if name not in KEYPOINT_SETS:
        raise CaptureError(path, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}")
    names, kind = tuple(str(x) for x in values["names"]), KEYPOINT_SETS[name]
    v, k = len(names), len(kind.names)
    points = numbers(values["points"], path, "points", (v, k, 2))
    confidences = numbers(values["confidences"], path, "confidences", (v, k))
    noise = numbers(values["noise"], path, "noise")
    deviations = numbers(values["deviations"], path, "deviations")
    determined = numbers(values["determined"], path, "determined", deviations.shape)
    if noise.shape != deviations.shape[:1]:
        raise CaptureError(path, "noise", f"expected {deviations.shape[:1]} moments, got {noise.shape}")
    covariance = numbers(values["shape_covariance"], path, "shape_covariance")
    return FitRecord(Keypoints(points, confidences, kind), names, noise, deviations, determined, covariance)
