"""Keypoints of a capture's views from the files that people have; which format it is, the content tells.

===================================  ==========================================================  ====================
from                                 file                                                        points
===================================  ==========================================================  ====================
OpenPose, --write_json               NAME_keypoints.json: {people: [{pose_keypoints_2d, ...}]}   BODY_25, hands
MMPose, inferencer or demo scripts   NAME.json: a list of instances, or frames of instances      17 or 133
COCO results, AlphaPose              one file: [{image_id or file_name, keypoints, ...}]         17 or 133
COCO annotations, COCO-WholeBody     one file: {images, annotations}                             17 or 133
ours, `save_keypoints`               one .npz                                                    any
===================================  ==========================================================  ====================

A folder, with its sub-folders, is all of its JSON files together.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.coco import annotated_images, result_images
from humangs_jax.data.keypoints.detections import DetectedImage, Detections, common_set, read_json
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.matching import match_views
from humangs_jax.data.keypoints.mmpose import mmpose_images
from humangs_jax.data.keypoints.openpose import openpose_image
from humangs_jax.data.keypoints.people import Person, chosen_person
from humangs_jax.data.keypoints.sets import OPENPOSE_67, KeypointSet
from humangs_jax.data.keypoints.storage import saved_detections

UNDERSTOOD = (
    "OpenPose's people, MMPose's instances, COCO's results (AlphaPose's too), COCO's images and annotations, or our npz"
)
NORMALIZED = 2.0
"""If no coordinate of any view reaches this many pixels, they are no pixels but shares of the image."""


def read_keypoints(
    path: str | Path, names: Sequence[str], width: int, height: int, *, person: int | None = None
) -> Keypoints:
    """Keypoints of one person in the views of a capture.

    Arguments:
        path: a file or folder of one of the formats above.
        names: of the capture's views. Images of the file are matched by name, or by the number in the name where the file
            has only numbers; images of no view are passed over.
        width, height: pixels of the capture's photos, which the keypoints have to be of.
        person: which one to take where several people are seen, counted from 0 in the order of the file.

    Returns: v views of k points. Views of which the file has nothing have confidence 0 and are in `missing`.

    Raises: CaptureError, one line naming file and field: a file of no known format, damaged, of no view of this capture,
        of photos of another size, of several people (without `person`), or without any usable point.
    """
    path = Path(path)
    if person is not None and person < 0:
        raise ValueError(f"--person {person}: expected 0 for the first person, 1 for the second, ...")
    detections = _detections(path)
    if detections.set is None:
        raise CaptureError(path, "", "nobody in any of its images: expected one person")
    images = _images_of_views(path, detections, names, width, height)
    people = [
        None if image is None else chosen_person(image, name, person, detections.offset, width, height)
        for image, name in zip(images, names, strict=True)
    ]
    if person is not None and not any(people):
        most = max(len(image.people) for image in images if image is not None)
        raise CaptureError(path, f"--person {person}", f"no view has so many: expected 0 to {max(most - 1, 0)}")
    keypoints = _assemble(people, detections.set, names)
    _check_pixels(path, keypoints)
    return keypoints


def _detections(path: Path) -> Detections:
    if path.is_dir():
        files = sorted(file for file in path.rglob("*.json") if not file.name.startswith("."))
        if not files:
            raise CaptureError(path, "", f"no JSON file in this folder: expected {UNDERSTOOD}")
        names = [file.relative_to(path).with_suffix("").as_posix() for file in files]
    elif not path.is_file():
        raise CaptureError(path, "", "no such file or folder")
    elif path.suffix == ".npz":
        return saved_detections(path)
    else:
        files, names = [path], [path.stem]
    read = [_read_file(file, name, len(files) == 1) for file, name in zip(files, names, strict=True)]
    images = [image for _, each in read for image in each]
    openpose = [is_openpose for is_openpose, _ in read]
    if any(openpose) and not all(openpose):
        problem = f"not OpenPose's, but {files[openpose.index(True)].name} is: expected files of one tool"
        raise CaptureError(files[openpose.index(False)], "", problem)
    anybody = any(image.people for image in images)
    return Detections((OPENPOSE_67 if anybody else None) if all(openpose) else common_set(images), tuple(images))


def _read_file(file: Path, name: str, alone: bool) -> tuple[bool, list[DetectedImage]]:
    """Whether a JSON file is OpenPose's, and its images."""
    content = read_json(file)
    if isinstance(content, dict):
        if "people" in content:
            return True, [openpose_image(content, file, name)]
        if "annotations" in content:
            return False, annotated_images(content, file)
        content = content.get("instance_info")  # MMPose's demo scripts
    if isinstance(content, list):
        keys = {key for entry in content if isinstance(entry, dict) for key in entry}
        if keys & {"image_id", "file_name"}:
            return False, result_images(content, file)
        if keys & {"keypoint_scores", "frame_id"} or not content:
            return False, mmpose_images(content, file, name, alone)
    raise CaptureError(file, "", f"no keypoints: expected {UNDERSTOOD}")


def _images_of_views(
    path: Path, detections: Detections, names: Sequence[str], width: int, height: int
) -> list[DetectedImage | None]:
    """The image of each view, None where the file has none."""
    try:
        views = match_views([image.image for image in detections.images], names)
    except ValueError as error:
        raise CaptureError(path, "", error) from error
    images: list[DetectedImage | None] = [None] * len(names)
    for image, view in zip(detections.images, views, strict=True):
        if view is None:
            continue
        if image.size not in (None, (width, height)):
            size = " x ".join(map(str, image.size or ()))
            problem = f"{size}, but the capture's photos have {width} x {height}: expected keypoints of these"
            raise CaptureError(image.file, f"size of {image.image}", problem)
        images[view] = image
    if not any(images):
        seen = [str(image.image) for image in detections.images]
        problem = f"images {_few(seen)} are none of the views {_few(list(names))}: expected the same names"
        raise CaptureError(path, "", problem)
    return images


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f", ... ({len(names)})" if len(names) > 3 else "")


def _assemble(people: Sequence[Person | None], keypoint_set: KeypointSet, names: Sequence[str]) -> Keypoints:
    count = len(keypoint_set.names)
    nobody = Person(np.zeros((count, 2), np.float32), np.zeros(count, np.float32), 0, 0)
    filled = [nobody if each is None else each for each in people]
    confidences = np.stack([each.confidences for each in filled])
    return Keypoints(
        points=np.stack([each.points for each in filled]),
        confidences=confidences,
        set=keypoint_set,
        missing=tuple(name for name, row in zip(names, confidences, strict=True) if not row.any()),
        not_finite=sum(each.not_finite for each in filled),
        far_outside=sum(each.far_outside for each in filled),
    )


def _check_pixels(path: Path, keypoints: Keypoints) -> None:
    seen = keypoints.points[keypoints.confidences > 0]
    if not len(seen):
        problem = f"no point has a confidence above 0 (not finite: {keypoints.not_finite}, far outside of the photos: "
        raise CaptureError(path, "", f"{problem}{keypoints.far_outside}): expected keypoints of these photos")
    if np.abs(seen).max() < NORMALIZED:
        problem = f"no coordinate exceeds {NORMALIZED:g}: expected pixels, not shares of the image"
        raise CaptureError(path, "", f"{problem} (OpenPose: --keypoint_scale 0)")
