"""Keypoints in memory: of the views of a capture, and as files have them, not yet matched to views and persons."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, checked_json, file_numbers
from humangs_jax.data.formats import KEYPOINTS
from humangs_jax.data.keypoints.sets import SETS_BY_COUNT, KeypointSet

LISTED = 5
"""Names of views in a warning, at most."""
HALF_PIXEL = 0.5
"""Every tool that we read counts pixels: the centre of the first one is at 0. Ours is at 0.5."""


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """One person's keypoints in each of v views (numpy on the host).

    points: (v, k, 2) float32 pixels, x right and y down, the centre of the first pixel at (0.5, 0.5); finite, and to be
        ignored where the confidence is 0.
    confidences: (v, k) float32 in [0, 1]; 0: the point is missing.
    set: what the k points are. world: (v, k, 3) metres, where the detector has said it: a person of average size, in axes whose z
        is the ray to the person, up to a translation. missing: names of the views that the file has nothing for.
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
    largest: float = 1.0
    """Of the scores of the file, by which they were divided; 1 where they were in [0, 1]."""
    world: Float[np.ndarray, "v k 3"] | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Problems of a keypoint file that could be read, a line each."""
        found = []
        if self.missing:
            names = ", ".join(self.missing[:LISTED]) + (" ..." if len(self.missing) > LISTED else "")
            found.append(f"no keypoints of {len(self.missing)} views: {names}")
        if self.shifted:
            found.append(f"frames and photos are counted from different numbers and were matched in order: {self.shifted}")
        if self.largest > 1:
            found.append(f"scores of up to {self.largest:.4g}, of another scale than [0, 1]: divided by that")
        if self.not_finite:
            found.append(f"{self.not_finite} keypoints are not finite numbers and are ignored")
        if self.far_outside:
            found.append(
                f"{self.far_outside} keypoints lie far outside of their photo and are ignored: of photos of another size?"
            )
        return tuple(found)


@dataclasses.dataclass(frozen=True, eq=False)
class DetectedImage:
    """The people in one image.

    image: its name or path as the file has it, or a number where the file has no more.
    file: that the people are from. size: (width, height) in pixels where the file states it.
    people: each (k, 3): x and y in pixels of the tool, confidence; not yet checked, so that NaN and null are NaN. Or (k, 6), with
        `Keypoints.world`.
    """

    image: str | int
    file: Path
    people: tuple[Float[np.ndarray, "k columns"], ...]
    size: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Detections:
    """The images of a file or folder. offset: pixels to add to x and y so that pixel centres are at +0.5.

    set: None if no image has a person.
    """

    set: KeypointSet | None
    images: tuple[DetectedImage, ...]
    offset: float = HALF_PIXEL


@dataclasses.dataclass(frozen=True, eq=False)
class Source:
    """What a reader of a format gets."""

    path: Path
    """The file."""
    name: str
    """Of the image or video that it may be of: the path in its folder without the suffix."""
    alone: bool
    """Whether no other file is read with it: the frames of a video are known by their number, else by name/number."""

    @functools.cached_property
    def json(self) -> Any:
        """The value of the file, None where its suffix is that of another format. Raises: CaptureError."""
        return None if self.path.suffix.lower() in KEYPOINTS.suffixes else checked_json(self.path)


def detections_of(images: Sequence[DetectedImage]) -> Detections:
    """Images of people whose set is told by the number of their points. Raises: CaptureError for others, and for two sets."""
    people = [(len(person), image) for image in images for person in image.people]
    for count, image in people:
        if count != people[0][0]:
            problem = f"a person of {count} points, but another has {people[0][0]}: expected one set of keypoints"
            raise CaptureError(image.file, f"image {image.image}", problem)
    if people and people[0][0] not in SETS_BY_COUNT:
        known = " or ".join(f"{count} ({each.name})" for count, each in SETS_BY_COUNT.items())
        raise CaptureError(people[0][1].file, "keypoints", f"expected {known} points, got {people[0][0]}")
    return Detections(SETS_BY_COUNT[people[0][0]] if people else None, tuple(images))


def triples(value: Any, file: Path, field: str, count: int | None = None) -> Float[np.ndarray, "k 3"]:
    """x, y and confidence of each point, from a flat list of them; null is NaN.

    Raises: CaptureError if these are no numbers, or not 3 * count (any multiple of 3 if count is None).
    """
    array = file_numbers(value, file, field, nulls=True)
    wanted = "a multiple of 3" if count is None else f"{3 * count} ({count} times x, y, confidence)"
    if array.ndim != 1 or array.size % 3 or (count is not None and array.size != 3 * count):
        raise CaptureError(file, field, f"expected a flat list of {wanted} numbers, got shape {array.shape}")
    return array.reshape(-1, 3)
