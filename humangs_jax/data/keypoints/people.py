"""Which of the people in a view, and what of their points can be used."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.detections import DetectedImage

LARGEST_CONFIDENCE = 2.0
"""Heat maps overshoot 1 a little (1.02 is common) and undershoot 0; what is beyond 2 or -1 is on another scale."""
SMALLEST_CONFIDENCE = -1.0
CLEAR_CONFIDENCE, CLEAR_SHARE = 0.3, 0.25
"""A detection of more than this mean confidence and share of the points is a person, others are a detector's ghosts."""
FAR_OUTSIDE = 0.5
"""Detectors extrapolate a little beyond the image. Points further out than this share of its size mean nothing."""


class Person(NamedTuple):
    """points: (k, 2) pixels, centres at +0.5, finite. confidences: (k,) in [0, 1]. Counts as in `Keypoints`."""

    points: Float[np.ndarray, "k 2"]
    confidences: Float[np.ndarray, " k"]
    not_finite: int
    far_outside: int


def chosen_person(
    image: DetectedImage, view: str, person: int | None, offset: float, width: int, height: int
) -> Person | None:
    """The one person of a view, or the one asked for by number; None if there is none.

    Raises: CaptureError if there are several and no number was given, or if confidences are not in [0, 1].
    """
    field = f"view {view}"
    people = [_usable(each, offset, width, height, image, field) for each in image.people]
    if person is not None:
        return people[person] if person < len(people) else None
    clear = sum(_is_clear(each.confidences) for each in people)
    if clear > 1:
        raise CaptureError(
            image.file,
            field,
            f"{clear} people: expected one. --person I takes the I-th of each view, counted from 0 in the order of the "
            "file; or crop the photos, or delete the others from the file",
        )
    return _most_confident(people)


def _most_confident(people: Sequence[Person]) -> Person | None:
    return max(people, key=lambda each: each.confidences.sum(), default=None)


def _is_clear(confidences: Float[np.ndarray, " k"]) -> bool:
    present = confidences[confidences > 0]
    return len(present) > CLEAR_SHARE * len(confidences) and float(present.mean()) > CLEAR_CONFIDENCE


def _usable(
    values: Float[np.ndarray, "k 3"], offset: float, width: int, height: int, image: DetectedImage, field: str
) -> Person:
    confidences = values[:, 2]
    finite = np.logical_and.reduce(np.isfinite(values), axis=1)
    known = confidences[np.isfinite(confidences)]
    if known.size and (known.min() < SMALLEST_CONFIDENCE or known.max() > LARGEST_CONFIDENCE):
        got = f"{known.min():.4g} to {known.max():.4g}"
        raise CaptureError(image.file, field, f"expected confidences in [0, 1], got {got}")
    points = np.where(finite[:, None], values[:, :2], 0.0) + offset
    confidences = np.where(finite, np.clip(confidences, 0.0, 1.0), 0.0)
    far = (np.abs(points / (width, height) - 0.5) > 0.5 + FAR_OUTSIDE).any(axis=1) & (confidences > 0)
    return Person(
        points.astype(np.float32),
        np.where(far, 0.0, confidences).astype(np.float32),
        int((~finite).sum()),
        int(far.sum()),
    )
