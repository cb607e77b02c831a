"""COCO's JSON: results (AlphaPose's and many others') and annotations, with the extra parts of COCO-WholeBody.

Results are a list of {image_id or file_name, keypoints, ...}, annotations {images, annotations}. The third number of a
point is a confidence in results and a visibility in annotations: 0 not labelled, 1 labelled but hidden, 2 visible.
COCO-WholeBody keeps feet, face and hands in lists of their own; others put all 133 points into keypoints.
"""

from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.detections import DetectedImage, expect, triples

_PARTS = {"foot_kpts": 6, "face_kpts": 68, "lefthand_kpts": 21, "righthand_kpts": 21}
"""COCO-WholeBody's, in the order of its 133 points, after the 17 of the body."""
HIDDEN_CONFIDENCE = 0.5
"""Of a point that an annotator guessed behind something else."""
LARGEST_VISIBILITY = 2


def result_images(entries: list[Any], file: Path) -> list[DetectedImage]:
    """Images of a results file, in the order in which they first appear.

    Raises: CaptureError.
    """
    whole = _whole_body(entries)
    people: dict[str | int, list[Float[np.ndarray, "k 3"]]] = {}
    for i, entry in enumerate(entries):
        expect(entry, dict, file, f"[{i}]")
        key = "file_name" if "file_name" in entry else "image_id"
        image = _label(entry.get(key), file, f"[{i}].{key}")
        people.setdefault(image, []).append(_person(entry, file, f"[{i}]", whole))
    return [DetectedImage(image, file, tuple(each)) for image, each in people.items()]


def annotated_images(content: dict[str, Any], file: Path) -> list[DetectedImage]:
    """Images of an annotation file. Crowds, and annotations without keypoints, are passed over.

    Raises: CaptureError.
    """
    images: dict[Any, tuple[dict[str, Any], list[Float[np.ndarray, "k 3"]]]] = {}
    for i, image in enumerate(expect(content.get("images"), list, file, "images")):
        expect(image, dict, file, f"images[{i}]")
        images[_label(image.get("id"), file, f"images[{i}].id")] = (image, [])
    annotations = expect(content["annotations"], list, file, "annotations")
    whole = _whole_body(annotations)
    for i, entry in enumerate(annotations):
        field = f"annotations[{i}]"
        expect(entry, dict, file, field)
        if entry.get("iscrowd") or "keypoints" not in entry:
            continue
        image = _label(entry.get("image_id"), file, f"{field}.image_id")
        if image not in images:
            raise CaptureError(file, f"{field}.image_id", f"expected the id of one of the images, got {image!r}")
        images[image][1].append(_by_visibility(_person(entry, file, field, whole), file, field))
    return [
        DetectedImage(_label(image.get("file_name", key), file, f"image {key}"), file, tuple(people), _size(image))
        for key, (image, people) in images.items()
    ]


def _label(value: Any, file: Path, field: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise CaptureError(file, field, f"expected the name or number of an image, got {value!r}")
    return value


def _whole_body(entries: list[Any]) -> bool:
    """Whether some person has a part of COCO-WholeBody; those who lack it have its points with confidence 0."""
    return any(isinstance(entry, dict) and not _PARTS.keys().isdisjoint(entry) for entry in entries)


def _person(entry: dict[str, Any], file: Path, field: str, whole: bool) -> Float[np.ndarray, "k 3"]:
    if "keypoints" not in entry:
        raise CaptureError(file, f"{field}.keypoints", "missing")
    body = triples(entry["keypoints"], file, f"{field}.keypoints", 17 if whole else None)
    if not whole:
        return body
    parts = [
        triples(entry[key], file, f"{field}.{key}", count) if entry.get(key) else np.zeros((count, 3))
        for key, count in _PARTS.items()
    ]
    return np.concatenate([body, *parts])


def _by_visibility(person: Float[np.ndarray, "k 3"], file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    """Confidences from visibilities. Fractions occur in COCO-WholeBody, which says that above 0 they are reliable."""
    visibility = person[:, 2]
    if not np.isnan(visibility).all() and (np.nanmin(visibility) < 0 or np.nanmax(visibility) > LARGEST_VISIBILITY):
        raise CaptureError(file, field, f"expected visibilities 0, 1 or 2, got {np.nanmax(np.abs(visibility)):g}")
    confidence = np.where(visibility == 1, HIDDEN_CONFIDENCE, np.where(visibility > 0, 1.0, 0.0))
    return np.concatenate([person[:, :2], np.where(np.isnan(visibility), np.nan, confidence)[:, None]], axis=1)


def _size(image: dict[str, Any]) -> tuple[int, int] | None:
    """What the file states; placeholders of 0 are no statement."""
    width, height = image.get("width"), image.get("height")
    return (int(width), int(height)) if width and height else None
