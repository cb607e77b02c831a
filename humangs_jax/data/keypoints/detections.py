"""What a detector's file says, before it is known which view and whose: people per image, and checked numbers."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.sets import COCO_17, COCO_WHOLEBODY_133, KeypointSet

HALF_PIXEL = 0.5
"""Every tool that we read counts pixels: the centre of the first one is at 0. Ours is at 0.5."""
SETS_BY_COUNT = {len(each.names): each for each in (COCO_17, COCO_WHOLEBODY_133)}
"""What lists of points without names are. 67 is not among them: OpenPose keeps body and hands apart."""


@dataclasses.dataclass(frozen=True, eq=False)
class DetectedImage:
    """The people in one image.

    image: its name or path as the file has it, or a number where the file has no more.
    file: that the people are from. size: (width, height) in pixels where the file states it.
    people: each (k, 3): x and y in pixels of the tool, confidence; not yet checked, so that NaN and null are NaN.
    """

    image: str | int
    file: Path
    people: tuple[Float[np.ndarray, "k 3"], ...]
    size: tuple[int, int] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Detections:
    """The images of a file or folder. offset: pixels to add to x and y so that pixel centres are at +0.5.

    set: None where there is nobody in any of the images.
    """

    set: KeypointSet | None
    images: tuple[DetectedImage, ...]
    offset: float = HALF_PIXEL


def read_json(file: Path) -> Any:
    """The content of a JSON file. NaN and Infinity, which Python's tools write, are accepted.

    Raises: CaptureError.
    """
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(file, "", f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
    except json.JSONDecodeError as error:
        raise CaptureError(file, f"line {error.lineno}", f"not valid JSON: {error.msg}") from error


def expect(value: Any, kind: type, file: Path, field: str) -> Any:
    """The value, which has to be a JSON object (dict) or list."""
    if not isinstance(value, kind):
        wanted = "an object" if kind is dict else "a list"
        raise CaptureError(file, field, f"expected {wanted}, got {type(value).__name__}")
    return value


def triples(value: Any, file: Path, field: str, count: int | None = None) -> Float[np.ndarray, "k 3"]:
    """x, y and confidence of each point, from a flat list of them.

    Raises: CaptureError if these are no numbers, or not 3 * count (any multiple of 3 if count is None).
    """
    array = floats(value, file, field)
    wanted = "a multiple of 3" if count is None else f"{3 * count} ({count} times x, y, confidence)"
    if array.ndim != 1 or array.size % 3 or (count is not None and array.size != 3 * count):
        raise CaptureError(file, field, f"expected a flat list of {wanted} numbers, got shape {array.shape}")
    return array.reshape(-1, 3)


def floats(value: Any, file: Path, field: str) -> Float[np.ndarray, "..."]:
    """Numbers in float64; null is NaN."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiuO":
            raise TypeError
        return array.astype(np.float64)
    except (ValueError, TypeError):
        raise CaptureError(file, field, "expected numbers, as many for each point") from None


def set_of_count(count: int, file: Path, field: str) -> KeypointSet:
    """The set of COCO's family that has this number of points."""
    if count not in SETS_BY_COUNT:
        raise CaptureError(file, field, f"expected 17 (COCO) or 133 (COCO-WholeBody) points, got {count}")
    return SETS_BY_COUNT[count]


def common_set(images: Sequence[DetectedImage]) -> KeypointSet | None:
    """The set of all people of COCO-like images, None where there are none.

    Raises: CaptureError if two people have different numbers of points.
    """
    people = [(len(person), image) for image in images for person in image.people]
    if not people:
        return None
    first = people[0][0]
    for count, image in people:
        if count != first:
            problem = f"a person of {count} points, but another has {first}: expected one set of keypoints"
            raise CaptureError(image.file, f"image {image.image}", problem)
    return set_of_count(first, people[0][1].file, "keypoints")
