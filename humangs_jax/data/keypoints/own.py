"""Our own files. Unlike in all other formats the centre of the first pixel is at (0.5, 0.5).

The keypoints of one person, by `save_keypoints`: an npz of points (v, k, 2), confidences (v, k), the set's name, and the names of
the v views. The people in photos, by `humangs detect`:

    {"format": "humangs-people", "version": 1, "set": "mediapipe33", "images": [
        {"image": "front.jpg", "width": 1920, "height": 1080, "people": [
            {"presence": 0.99, "pixels": [[x, y], ...], "visibility": [...], "world": [[x, y, z], ...]}, null]}]}

world: metres from the middle of the hips in the camera's axes (x right, y down, z away), of a person of average size. The i-th of
every image is one and the same person; null: not in it.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, checked_json, file_numbers, members
from humangs_jax.data.formats import SourceFormat
from humangs_jax.data.keypoints.keypoints import DetectedImage, Detections, Keypoints, Source
from humangs_jax.data.keypoints.sets import KEYPOINT_SETS, MEDIAPIPE_33, KeypointSet
from humangs_jax.detection.people import DetectedPerson
from humangs_jax.io.arrays import ArrayFile, write_npz
from humangs_jax.io.reading import check_limit, write_json

FORMAT, VERSION = "humangs-people", 1
DECIMALS = 4
"""Of numbers in the file: a ten-thousandth of a pixel, a tenth of a millimetre."""


def recognizes(source: Source) -> bool:
    """Whether a file is one of ours; npz archives are taken for one."""
    return source.path.suffix.lower() == ".npz" or _is_people_file(source.json)


def read(source: Source, format: SourceFormat) -> Detections:
    """The keypoints of one person, or all people, with confidence 0 where they are not in the image. Raises: CaptureError."""
    if source.path.suffix.lower() == ".npz":
        return _saved(source.path)
    kind, images = read_people(source.path, source.json)
    nobody = np.zeros((len(kind.names), 6))
    columns = lambda each: nobody if each is None else np.column_stack([each.points, each.world])
    found = (tuple(map(columns, image.people)) for image in images)
    seen = tuple(DetectedImage(i.image, source.path, p, i.size) for i, p in zip(images, found, strict=True))
    return Detections(kind if any(any(image.people) for image in images) else None, seen, offset=0.0)


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


def _saved(file: Path) -> Detections:
    """What `save_keypoints` wrote."""
    values = ArrayFile.open(file, CaptureError)
    name, views = (values.array(key) for key in ("set", "names"))
    kind = _set_of(str(name), file)
    check_limit("people", views.size, "people")
    shape = len(views.reshape(-1)), len(kind.names)
    points = file_numbers(values.array("points"), file, "points", (*shape, 2), nulls=True)
    confidences = file_numbers(values.array("confidences"), file, "confidences", shape, nulls=True)
    people = np.concatenate([points, confidences[..., None]], axis=-1)
    rows = zip(views.reshape(-1).tolist(), people, strict=True)
    return Detections(kind, tuple(DetectedImage(str(view), file, (person,)) for view, person in rows), offset=0.0)


def _set_of(name: str, file: Path) -> KeypointSet:
    if name not in KEYPOINT_SETS:
        raise CaptureError(file, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}")
    return KEYPOINT_SETS[name]


# People in photos ------------------------------------------------------------------------------------------------------


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


def _described(person: SeenPerson) -> dict[str, Any]:
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
    if not _is_people_file(content):
        raise CaptureError(path, "format", f"expected {FORMAT!r}")
    version, name, images = members(content, path, version=int, set=str, images=list)
    if version != VERSION:
        raise CaptureError(path, "version", f"expected {VERSION}, got {version!r}")
    kind = _set_of(name, path)
    return kind, tuple(_image(each, len(kind.names), path, f"images[{i}]") for i, each in enumerate(images))


def _is_people_file(content: Any) -> bool:
    return isinstance(content, dict) and content.get("format") == FORMAT


def _image(image: Any, count: int, path: Path, field: str) -> ImagePeople:
    name, width, height, people = members(image, path, field, image=str, width=int, height=int, people=list)
    if min(width, height) < 1:
        raise CaptureError(path, field, f"expected width and height in pixels, got {width!r} and {height!r}")
    found = (_person(each, count, path, f"{field}.people[{i}]") for i, each in enumerate(people))
    return ImagePeople(name, (width, height), tuple(found))


def _person(person: Any, count: int, path: Path, field: str) -> SeenPerson | None:
    if person is None:
        return None
    shapes = {"pixels": (count, 2), "visibility": (count,), "world": (count, 3)}
    values = members(person, path, field, **dict.fromkeys(shapes, list), presence=float)
    pixels, visibility, world = (
        file_numbers(value, path, f"{field}.{key}", shape, nulls=True)
        for value, (key, shape) in zip(values, shapes.items(), strict=False)
    )
    return SeenPerson(np.concatenate([pixels, visibility[:, None]], axis=1), world, float(values[-1]))
