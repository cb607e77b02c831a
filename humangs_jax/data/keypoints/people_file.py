"""Our own file of the people in photos, as `humangs detect` writes it:

    {"format": "humangs-people", "version": 1, "set": "mediapipe33", "images": [
        {"image": "front.jpg", "width": 1920, "height": 1080, "people": [
            {"presence": 0.99, "pixels": [[x, y], ...], "visibility": [...], "world": [[x, y, z], ...]}, null]}]}

Unlike in other formats the centre of the first pixel is at (0.5, 0.5). world: metres from the middle of the hips in the camera's
axes (x right, y down, z away), of a person of average size. The i-th of every image is one and the same person; null: not in it.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, checked_json, required
from humangs_jax.data.keypoints.sets import KEYPOINT_SETS, MEDIAPIPE_33, KeypointSet
from humangs_jax.detection.people import DetectedPerson
from humangs_jax.io.reading import write_json

FORMAT, VERSION = "humangs-people", 1
DECIMALS = 4
"""Of numbers in the file: a ten-thousandth of a pixel, a tenth of a millimetre."""


@dataclasses.dataclass(frozen=True, eq=False)
class SeenPerson:
    """A person in an image. points: (k, 3) pixels and visibility. world: (k, 3) metres. presence: in [0, 1]."""

    points: Float[np.ndarray, "k 3"]
    world: Float[np.ndarray, "k 3"]
    presence: float


@dataclasses.dataclass(frozen=True, eq=False)
class ImagePeople:
    """An image, its (width, height) in pixels, and its people, None for those who are not in it."""

    image: str
    size: tuple[int, int]
    people: tuple[SeenPerson | None, ...]


def seen_person(person: DetectedPerson) -> SeenPerson:
    """What of a detected person is written."""
    points = np.concatenate([person.pixels, person.visibility[:, None]], axis=1)
    return SeenPerson(np.asarray(points, np.float64), person.world, person.presence)


def write_people(path: str | Path, images: Sequence[ImagePeople], kind: KeypointSet = MEDIAPIPE_33) -> None:
    """Write the file, whole or not at all."""
    described = [
        {
            "image": image.image,
            "width": image.size[0],
            "height": image.size[1],
            "people": [None if person is None else _described(person) for person in image.people],
        }
        for image in images
    ]
    write_json(path, {"format": FORMAT, "version": VERSION, "set": kind.name, "images": described}, indent=None)


def _described(person):
    rounded = lambda values: np.round(values, DECIMALS).tolist()
    return {
        "presence": round(person.presence, DECIMALS),
        "pixels": rounded(person.points[:, :2]),
        "visibility": rounded(person.points[:, 2]),
        "world": rounded(person.world),
    }


def read_people(path: Path, content: Any = None) -> tuple[KeypointSet, tuple[ImagePeople, ...]]:
    """The set and the images of a file. content: its JSON value, if it is known. Raises: CaptureError naming file and field."""
    content = checked_json(path) if content is None else content
    if not is_people_file(content):
        raise CaptureError(path, "format", f"expected {FORMAT!r}")
    if content.get("version") != VERSION:
        raise CaptureError(path, "version", f"expected {VERSION}, got {content.get('version')!r}")
    name = required(content, "set", path)
    if name not in KEYPOINT_SETS:
        raise CaptureError(path, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}")
    kind = KEYPOINT_SETS[name]
    images = required(content, "images", path)
    if not isinstance(images, list):
        raise CaptureError(path, "images", f"expected a list, got {type(images).__name__}")
    return kind, tuple(_image(each, len(kind.names), path, f"images[{i}]") for i, each in enumerate(images))


def is_people_file(content: Any) -> bool:
    """Whether a JSON value is such a file's."""
    return isinstance(content, dict) and content.get("format") == FORMAT


def _image(image, count, path, field):
    if not isinstance(image, dict):
        raise CaptureError(path, field, f"expected an object, got {type(image).__name__}")
    name, width, height, people = (
        required(image, key, path, f"{field}.") for key in ("image", "width", "height", "people")
    )
    if not isinstance(name, str) or not isinstance(people, list):
        raise CaptureError(path, field, "expected the image's name and a list of people")
    if not all(type(size) is int and size > 0 for size in (width, height)):
        raise CaptureError(path, field, f"expected width and height in pixels, got {width!r} and {height!r}")
    found = (_person(each, count, path, f"{field}.people[{i}]") for i, each in enumerate(people))
    return ImagePeople(name, (width, height), tuple(found))


def _person(person, count, path, field):
    if person is None:
        return None
    if not isinstance(person, dict):
        raise CaptureError(path, field, f"expected an object or null, got {type(person).__name__}")
    pixels, visibility, world = (
        _array(required(person, key, path, f"{field}."), shape, path, f"{field}.{key}")
        for key, shape in (("pixels", (count, 2)), ("visibility", (count,)), ("world", (count, 3)))
    )
    presence = _array(required(person, "presence", path, f"{field}."), (), path, f"{field}.presence")
    return SeenPerson(np.concatenate([pixels, visibility[:, None]], axis=1), world, float(presence))


def _array(value, shape, path, field):
    """Numbers of a shape; null is NaN."""
    try:
        array = np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        raise CaptureError(path, field, f"expected numbers of shape {shape}") from None
    if array.shape != shape:
        raise CaptureError(path, field, f"expected numbers of shape {shape}, got {array.shape}")
    return array
