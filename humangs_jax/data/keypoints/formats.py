"""What detectors write: people per image, not yet matched to views and persons. The content decides the format.

===================================  ==========================================================  ====================
from                                 file                                                        points
===================================  ==========================================================  ====================
OpenPose, --write_json               NAME_keypoints.json: {people: [{pose_keypoints_2d, ...}]}   BODY_25, hands
MMPose, inferencer or demo scripts   NAME.json: a list of instances, or frames of instances      17 or 133
COCO results, AlphaPose              one file: [{image_id or file_name, keypoints, ...}]         17 or 133
COCO annotations, COCO-WholeBody     one file: {images, annotations}                             17 or 133
ours, `save_keypoints`               one .npz                                                    any
ours, `humangs detect`               one file, see `people_file`                                 33
===================================  ==========================================================  ====================

A folder, with its sub-folders, is all of its JSON files together.

COCO: the third number of a point is a confidence in results and a visibility in annotations: 0 not labelled, 1 labelled but
hidden, 2 visible. COCO-WholeBody keeps feet, face and hands in lists of their own; others put all 133 points into keypoints.
MMPose: an instance has keypoints (k x 2) and keypoint_scores (k). An image's file is a list of instances, a video's a list
of {frame_id, instances}; the demo scripts put either under instance_info.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, checked_json
from humangs_jax.data.keypoints.people_file import is_people_file, read_people
from humangs_jax.data.keypoints.sets import COCO_17, COCO_WHOLEBODY_133, KEYPOINT_SETS, OPENPOSE_67, KeypointSet
from humangs_jax.io.npz import read_npz
from humangs_jax.io.reading import check_limit, limits, reading, shown, walk

UNDERSTOOD = (
    "OpenPose's people, MMPose's instances, COCO's results (AlphaPose's too), COCO's images and annotations, or ours"
)
HALF_PIXEL = 0.5
"""Every tool that we read counts pixels: the centre of the first one is at 0. Ours is at 0.5."""
SETS_BY_COUNT = {len(each.names): each for each in (COCO_17, COCO_WHOLEBODY_133)}
"""The set of a list of points without names. OpenPose's 67 are not in it: its files keep body and hands apart."""


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

    set: None if no image has a person.
    """

    set: KeypointSet | None
    images: tuple[DetectedImage, ...]
    offset: float = HALF_PIXEL


def read_detections(path: Path) -> Detections:
    """The people in the images of a file or folder; its content decides the format.

    Raises: CaptureError.
    """
    if path.is_dir():
        files = sorted(file for file in walk(path) if file.suffix == ".json")
        if not files:
            raise CaptureError(path, "", f"no JSON file in this folder: expected {UNDERSTOOD}")
        names = [file.relative_to(path).with_suffix("").as_posix() for file in files]
    elif not path.is_file():
        raise CaptureError(path, "", "no such file or folder")
    elif path.suffix == ".npz":
        return _saved_detections(path)
    else:
        files, names = [path], [path.stem]
    read, amount = [], 0
    for file, name in zip(files, names, strict=True):
        content = checked_json(file)
        amount += _amount(content)
        check_limit("people", amount, "people and images")
        if len(files) == 1 and is_people_file(content):
            return _people_detections(file, content)
        read.append(_images_of_file(content, file, name, len(files) == 1))
    images = [image for _, each in read for image in each]
    openpose = [is_openpose for is_openpose, _ in read]
    if any(openpose) and not all(openpose):
        problem = f"not OpenPose's, but {files[openpose.index(True)].name} is: expected files of one tool"
        raise CaptureError(files[openpose.index(False)], "", problem)
    anybody = any(image.people for image in images)
    return Detections((OPENPOSE_67 if anybody else None) if all(openpose) else _common_set(images), tuple(images))


def _amount(content: Any) -> int:
    """How many people and images a JSON file has, before any is looked at."""
    lists = [content]
    if isinstance(content, dict):
        lists = [content.get(key) for key in ("people", "images", "annotations", "instance_info")]
    entries = [entry for each in lists if isinstance(each, list) for entry in each]
    keys = ("instances", "people")
    inside = [entry[key] for entry in entries if isinstance(entry, dict) for key in keys if key in entry]
    return 1 + len(entries) + sum(len(each) for each in inside if isinstance(each, list))


def _images_of_file(content: Any, file: Path, name: str, alone: bool) -> tuple[bool, list[DetectedImage]]:
    """Whether a JSON file is OpenPose's, and its images."""
    if isinstance(content, dict):
        if "people" in content:
            return True, [_openpose_image(content, file, name)]
        if "annotations" in content:
            return False, _annotated_images(content, file)
        content = content.get("instance_info")  # MMPose's demo scripts
    if isinstance(content, list):
        keys = {key for entry in content if isinstance(entry, dict) for key in entry}
        if keys & {"image_id", "file_name"}:
            return False, _result_images(content, file)
        if keys & {"keypoint_scores", "frame_id"} or not content:
            return False, _mmpose_images(content, file, name, alone)
    raise CaptureError(file, "", f"no keypoints: expected {UNDERSTOOD}")


def _expect(value: Any, kind: type, file: Path, field: str) -> Any:
    """The value, which has to be a JSON object (dict) or list."""
    if not isinstance(value, kind):
        wanted = "an object" if kind is dict else "a list"
        raise CaptureError(file, field, f"expected {wanted}, got {type(value).__name__}")
    return value


def _triples(value: Any, file: Path, field: str, count: int | None = None) -> Float[np.ndarray, "k 3"]:
    """x, y and confidence of each point, from a flat list of them.

    Raises: CaptureError if these are no numbers, or not 3 * count (any multiple of 3 if count is None).
    """
    array = _floats(value, file, field)
    wanted = "a multiple of 3" if count is None else f"{3 * count} ({count} times x, y, confidence)"
    if array.ndim != 1 or array.size % 3 or (count is not None and array.size != 3 * count):
        raise CaptureError(file, field, f"expected a flat list of {wanted} numbers, got shape {array.shape}")
    return array.reshape(-1, 3)


def _floats(value: Any, file: Path, field: str) -> Float[np.ndarray, "..."]:
    """Numbers in float64; null is NaN."""
    try:
        array = np.asarray(value)
        numbers = array.dtype.kind in "fiu" or (
            array.dtype.kind == "O" and all(x is None or type(x) in (int, float) for x in array.flat)
        )
        if not numbers:  # numpy would read numbers in words, too
            raise TypeError
        return array.astype(np.float64)
    except (ValueError, TypeError, OverflowError):
        raise CaptureError(file, field, "expected numbers, as many for each point") from None


def _set_of_count(count: int, file: Path, field: str) -> KeypointSet:
    """The set of COCO's family that has this number of points."""
    if count not in SETS_BY_COUNT:
        raise CaptureError(file, field, f"expected 17 (COCO) or 133 (COCO-WholeBody) points, got {count}")
    return SETS_BY_COUNT[count]


def _common_set(images: Sequence[DetectedImage]) -> KeypointSet | None:
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
    return _set_of_count(first, people[0][1].file, "keypoints")


# COCO -----------------------------------------------------------------------------------------------------------------

_WHOLE_BODY_PARTS = {"foot_kpts": 6, "face_kpts": 68, "lefthand_kpts": 21, "righthand_kpts": 21}
"""COCO-WholeBody's, in the order of its 133 points, after the 17 of the body."""
HIDDEN_CONFIDENCE = 0.5
"""For points that an annotator guessed behind something else."""
LARGEST_VISIBILITY = 2


def _result_images(entries: list[Any], file: Path) -> list[DetectedImage]:
    """Images of a results file, in the order in which they first appear.

    Raises: CaptureError.
    """
    whole = _whole_body(entries)
    people: dict[str | int, list[Float[np.ndarray, "k 3"]]] = {}
    for i, entry in enumerate(entries):
        _expect(entry, dict, file, f"[{i}]")
        key = "file_name" if "file_name" in entry else "image_id"
        image = _image_label(entry.get(key), file, f"[{i}].{key}")
        people.setdefault(image, []).append(_coco_person(entry, file, f"[{i}]", whole))
    return [DetectedImage(image, file, tuple(each)) for image, each in people.items()]


def _annotated_images(content: dict[str, Any], file: Path) -> list[DetectedImage]:
    """Images of an annotation file. Crowds, and annotations without keypoints, are ignored.

    Raises: CaptureError.
    """
    images: dict[Any, tuple[dict[str, Any], list[Float[np.ndarray, "k 3"]]]] = {}
    for i, image in enumerate(_expect(content.get("images"), list, file, "images")):
        _expect(image, dict, file, f"images[{i}]")
        images[_image_label(image.get("id"), file, f"images[{i}].id")] = (image, [])
    annotations = _expect(content["annotations"], list, file, "annotations")
    whole = _whole_body(annotations)
    for i, entry in enumerate(annotations):
        field = f"annotations[{i}]"
        _expect(entry, dict, file, field)
        if entry.get("iscrowd") or "keypoints" not in entry:
            continue
        image = _image_label(entry.get("image_id"), file, f"{field}.image_id")
        if image not in images:
            raise CaptureError(file, f"{field}.image_id", f"expected the id of one of the images, got {shown(image)}")
        images[image][1].append(_by_visibility(_coco_person(entry, file, field, whole), file, field))
    return [
        DetectedImage(
            _image_label(image.get("file_name", key), file, f"image {key}"),
            file,
            tuple(people),
            _stated_size(image, file),
        )
        for key, (image, people) in images.items()
    ]


def _image_label(value: Any, file: Path, field: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise CaptureError(file, field, f"expected the name or number of an image, got {shown(value)}")
    return value


def _whole_body(entries: list[Any]) -> bool:
    """Whether some person has a part of COCO-WholeBody; those who lack it have its points with confidence 0."""
    return any(isinstance(entry, dict) and not _WHOLE_BODY_PARTS.keys().isdisjoint(entry) for entry in entries)


def _coco_person(entry: dict[str, Any], file: Path, field: str, whole: bool) -> Float[np.ndarray, "k 3"]:
    if "keypoints" not in entry:
        raise CaptureError(file, f"{field}.keypoints", "missing")
    body = _triples(entry["keypoints"], file, f"{field}.keypoints", 17 if whole else None)
    if not whole:
        return body
    parts = [
        _triples(entry[key], file, f"{field}.{key}", count) if entry.get(key) else np.zeros((count, 3))
        for key, count in _WHOLE_BODY_PARTS.items()
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


# OpenPose -------------------------------------------------------------------------------------------------------------

OPENPOSE_SUFFIX = "_keypoints"
"""What OpenPose adds to the name of the image."""
_OPENPOSE_PARTS = {"pose_keypoints_2d": 25, "hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21}
_OTHER_MODELS = {18: "COCO", 15: "MPI", 135: "BODY_135"}


def _openpose_image(content: dict[str, Any], file: Path, name: str) -> DetectedImage:
    """The people of one file; each (67, 3). The face, if it is there, is not read.

    Raises: CaptureError.
    """
    people = _expect(content["people"], list, file, "people")
    return DetectedImage(
        name.removesuffix(OPENPOSE_SUFFIX),
        file,
        tuple(_openpose_person(person, file, f"people[{i}]") for i, person in enumerate(people)),
    )


def _openpose_person(person: Any, file: Path, field: str) -> Float[np.ndarray, "67 3"]:
    _expect(person, dict, file, field)
    if "pose_keypoints_2d" not in person:
        raise CaptureError(file, f"{field}.pose_keypoints_2d", "missing")
    return np.concatenate(
        [_openpose_part(person.get(key, []), file, f"{field}.{key}", n) for key, n in _OPENPOSE_PARTS.items()]
    )


def _openpose_part(values: Any, file: Path, field: str, count: int) -> Float[np.ndarray, "k 3"]:
    """The points of the body or of a hand; an empty list means that it was not detected."""
    if not _expect(values, list, file, field):
        return np.zeros((count, 3))
    other = _OTHER_MODELS.get(len(values) // 3)
    if count != 21 and other is not None:
        problem = f"the {len(values) // 3} points of the model {other}: expected BODY_25 (--model_pose BODY_25)"
        raise CaptureError(file, field, problem)
    return _triples(values, file, field, count)


# MMPose ---------------------------------------------------------------------------------------------------------------

MMPOSE_PREFIX = "results_"
"""What the demo scripts put before the name of the image."""


def _mmpose_images(entries: list[Any], file: Path, name: str, alone: bool) -> list[DetectedImage]:
    """The images of one file: one image, or the frames of a video.

    Arguments:
        entries: the list of instances or frames. name: of the image or video, from the file's name.
        alone: there is no other file: the frames of a video are known by their number, else by name/number.

    Raises: CaptureError.
    """
    name = name.removeprefix(MMPOSE_PREFIX)
    if not any(isinstance(entry, dict) and "frame_id" in entry for entry in entries):
        return [DetectedImage(name, file, _mmpose_people(entries, file, "instances"))]
    images = []
    for i, entry in enumerate(entries):
        frame, instances = _video_frame(entry, file, f"[{i}]")
        label = frame if alone else f"{name}/{frame}"
        images.append(DetectedImage(label, file, _mmpose_people(instances, file, f"[{i}].instances")))
    return images


def _video_frame(entry: Any, file: Path, field: str) -> tuple[int, list[Any]]:
    frame = _expect(entry, dict, file, field).get("frame_id")
    if isinstance(frame, bool) or not isinstance(frame, int):
        raise CaptureError(file, f"{field}.frame_id", f"expected an integer, got {shown(frame)}")
    return frame, _expect(entry.get("instances"), list, file, f"{field}.instances")


def _mmpose_people(instances: list[Any], file: Path, field: str) -> tuple[Float[np.ndarray, "k 3"], ...]:
    return tuple(_mmpose_person(instance, file, f"{field}[{i}]") for i, instance in enumerate(instances))


def _mmpose_person(instance: Any, file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    _expect(instance, dict, file, field)
    for key in ("keypoints", "keypoint_scores"):
        if key not in instance:
            raise CaptureError(file, f"{field}.{key}", "missing")
    points = _floats(instance["keypoints"], file, f"{field}.keypoints")
    scores = _floats(instance["keypoint_scores"], file, f"{field}.keypoint_scores")
    if points.ndim != 2 or points.shape[1] != 2:
        raise CaptureError(file, f"{field}.keypoints", f"expected x and y of each point, got shape {points.shape}")
    if scores.shape != points.shape[:1]:
        problem = f"expected one for each of {len(points)} keypoints, got shape {scores.shape}"
        raise CaptureError(file, f"{field}.keypoint_scores", problem)
    return np.concatenate([points, scores[:, None]], axis=1)


# Ours -----------------------------------------------------------------------------------------------------------------


def _saved_detections(file: Path) -> Detections:
    """What `save_keypoints` wrote: one person in each image.

    Raises: CaptureError.
    """
    with reading(file, "keypoint file", CaptureError):
        values, pickled = read_npz(file)
    for key in ("points", "confidences", "set", "names"):
        if key not in values:
            raise CaptureError(file, key, "a pickled object, which is never read" if key in pickled else "missing")
    name = str(values["set"])
    if name not in KEYPOINT_SETS:
        raise CaptureError(file, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}")
    check_limit("people", values["names"].size, "people")
    views, k = [str(view) for view in values["names"].reshape(-1)], len(KEYPOINT_SETS[name].names)
    points, confidences = (_floats(values[key], file, key) for key in ("points", "confidences"))
    for key, array, shape in (("points", points, (len(views), k, 2)), ("confidences", confidences, (len(views), k))):
        if array.shape != shape:
            raise CaptureError(file, key, f"expected shape {shape}, views x points of {name}, got {array.shape}")
    people = np.concatenate([points, confidences[..., None]], axis=-1)
    images = tuple(DetectedImage(view, file, (person,)) for view, person in zip(views, people, strict=True))
    return Detections(KEYPOINT_SETS[name], images, offset=0.0)


def _people_detections(file: Path, content: Any) -> Detections:
    """What `humangs detect` wrote. People who are not in an image have confidence 0 there.

    Raises: CaptureError.
    """
    kind, images = read_people(file, content)
    nobody = np.zeros((len(kind.names), 3))
    found = (tuple(nobody if each is None else each.points for each in image.people) for image in images)
    seen = tuple(DetectedImage(i.image, file, people, i.size) for i, people in zip(images, found, strict=True))
    return Detections(kind if any(any(image.people) for image in images) else None, seen, offset=0.0)
