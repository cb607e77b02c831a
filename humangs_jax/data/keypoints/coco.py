"""COCO's results and annotations, COCO-WholeBody's, and AlphaPose's results.

    results        [{image_id or file_name, keypoints, ...}], all images in one file
    annotations    {images, annotations}

The third number of a point is a confidence in results and a visibility in annotations: 0 not labelled, 1 labelled but hidden, 2
visible. COCO-WholeBody keeps feet, face and hands in lists of their own; others put all 133 points into keypoints.
"""

from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, expect, members
from humangs_jax.data.formats import SourceFormat
from humangs_jax.data.keypoints.keypoints import DetectedImage, Detections, Source, detections_of, triples
from humangs_jax.io.reading import limits, shown

PARTS = {"foot_kpts": 6, "face_kpts": 68, "lefthand_kpts": 21, "righthand_kpts": 21}
"""COCO-WholeBody's, in the order of its 133 points, after the 17 of the body."""
HIDDEN_CONFIDENCE = 0.5
"""For points that an annotator guessed behind something else."""
LARGEST_VISIBILITY = 2


def recognizes(source: Source) -> bool:
    """Whether a file has annotations, or a list of results that name their image."""
    if isinstance(source.json, dict):
        return "annotations" in source.json
    entries = source.json if isinstance(source.json, list) else []
    return any(isinstance(entry, dict) and entry.keys() & {"image_id", "file_name"} for entry in entries)


def read(source: Source, format: SourceFormat) -> Detections:
    """The images of a file, those of results in the order in which they first appear. Raises: CaptureError."""
    of_kind = _annotated_images if isinstance(source.json, dict) else _result_images
    return detections_of(of_kind(source.json, source.path))


def _result_images(entries: list[Any], file: Path) -> list[DetectedImage]:
    whole = _whole_body(entries)
    people: dict[str | int, list[Float[np.ndarray, "k 3"]]] = {}
    for i, entry in enumerate(entries):
        key = "file_name" if "file_name" in expect(entry, dict, file, f"[{i}]") else "image_id"
        image = _image_label(entry.get(key), file, f"[{i}].{key}")
        people.setdefault(image, []).append(_person(entry, file, f"[{i}]", whole))
    return [DetectedImage(image, file, tuple(each)) for image, each in people.items()]


def _annotated_images(content: dict[str, Any], file: Path) -> list[DetectedImage]:
    """Crowds, and annotations without keypoints, are ignored."""
    described, annotations = members(content, file, images=list, annotations=list)
    images: dict[str | int, tuple[dict[str, Any], list[Float[np.ndarray, "k 3"]]]] = {}
    for i, image in enumerate(described):
        expect(image, dict, file, f"images[{i}]")
        images[_image_label(image.get("id"), file, f"images[{i}].id")] = (image, [])
    whole = _whole_body(annotations)
    for i, entry in enumerate(annotations):
        field = f"annotations[{i}]"
        if expect(entry, dict, file, field).get("iscrowd") or "keypoints" not in entry:
            continue
        image = _image_label(entry.get("image_id"), file, f"{field}.image_id")
        if image not in images:
            raise CaptureError(file, f"{field}.image_id", f"expected the id of one of the images, got {shown(image)}")
        images[image][1].append(_by_visibility(_person(entry, file, field, whole), file, field))
    name = lambda image, key: _image_label(image.get("file_name", key), file, f"image {key}")
    found = images.items()
    return [DetectedImage(name(i, key), file, tuple(people), _stated_size(i, file)) for key, (i, people) in found]


def _image_label(value: Any, file: Path, field: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise CaptureError(file, field, f"expected the name or number of an image, got {shown(value)}")
    return value


def _whole_body(entries: list[Any]) -> bool:
    """Whether some person has a part of COCO-WholeBody; those who lack it have its points with confidence 0."""
    return any(isinstance(entry, dict) and not PARTS.keys().isdisjoint(entry) for entry in entries)


def _person(entry: dict[str, Any], file: Path, field: str, whole: bool) -> Float[np.ndarray, "k 3"]:
    (keypoints,) = members(entry, file, field, keypoints=list)
    body = triples(keypoints, file, f"{field}.keypoints", 17 if whole else None)
    if not whole:
        return body
    parts = [
        triples(entry[key], file, f"{field}.{key}", count) if entry.get(key) else np.zeros((count, 3))
        for key, count in PARTS.items()
    ]
    return np.concatenate([body, *parts])


def _by_visibility(person: Float[np.ndarray, "k 3"], file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    """Confidences from visibilities. Fractions occur in COCO-WholeBody, where any value above 0 means reliable."""
    visibility = person[:, 2]
    if not np.isnan(visibility).all() and (np.nanmin(visibility) < 0 or np.nanmax(visibility) > LARGEST_VISIBILITY):
        raise CaptureError(file, field, f"expected visibilities 0, 1 or 2, got {np.nanmax(np.abs(visibility)):g}")
    confidence = np.where(visibility == 1, HIDDEN_CONFIDENCE, np.where(visibility > 0, 1.0, 0.0))
    return np.concatenate([person[:, :2], np.where(np.isnan(visibility), np.nan, confidence)[:, None]], axis=1)


def _stated_size(image: dict[str, Any], file: Path) -> tuple[int, int] | None:
    """Width and height that the file states; 0 means unknown."""
    width, height = size = image.get("width"), image.get("height")
    if not width or not height:
        return None
    if not all(isinstance(side, int | float) and 1 <= side <= limits().side for side in size):
        raise CaptureError(file, "images", f"expected width and height in pixels, got {width!r} and {height!r}")
    return int(width), int(height)
