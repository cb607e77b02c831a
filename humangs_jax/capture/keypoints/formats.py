"""Reads files of keypoints: our own, and those of OpenPose, EasyMocap, COCO (also AlphaPose and
COCO-WholeBody) and MMPose.

Only our files have the centre of the first pixel at (0.5, 0.5). There are two kinds of our files.
`save_keypoints` writes the keypoints of one person: an npz of points (v, k, 2), confidences (v, k),
the set's name, and the names of the v views. `humangs detect` writes the people in photos:

    {"format": "humangs-people", "version": 1, "set": "mediapipe33", "images": [
        {"image": "front.jpg", "width": 1920, "height": 1080, "people": [
            {"presence": 0.99, "pixels": [[x, y], ...], "visibility": [...], "world": [[x, y, z],
            ...]}, null]}]}

"world" has positions in metres from the middle of the hips, in the camera's axes (x right, y down,
z away). The positions are as if the camera looked straight at the person, and the person had
average size. The i-th entry of "people" is the same person in all images, or null if the person is
not in the image. A person may also have "hands", see `SeenPerson.hands`.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.capture.keypoints.keypoints import (
    KEYPOINT_SETS,
    MEDIAPIPE_33,
    MEDIAPIPE_69,
    OPENPOSE_60,
    OPENPOSE_67,
    SETS_BY_COUNT,
    DetectedImage,
    Detections,
    KeypointFile,
    Keypoints,
    KeypointSet,
    detections_of,
    triples,
    with_hands,
)
from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import (
    CaptureError,
    checked_json,
    expect,
    file_numbers,
    members,
)
from humangs_jax.data.formats import SourceFormat
from humangs_jax.io.arrays import ArrayFile, write_npz
from humangs_jax.io.reading import check_limit, limits, shown, write_json

FORMAT = "humangs-people"
"""Value of the field "format" in our JSON files."""
VERSION = 1
"""Version of the format that is written. No other version is read."""
_DECIMALS = 4
"""Number of decimals in the file. Pixels are rounded to 0.0001, and metres to 0.1 mm."""


def recognizes_own(source: KeypointFile) -> bool:
    """Returns whether a file is one of ours. Every npz archive counts as ours."""
    return source.path.suffix.lower() == ".npz" or _is_people_file(source.json)


def read_own(source: KeypointFile, format: SourceFormat) -> Detections:
    """Returns the people in one of our files. An npz file has one person. If a person is not in an
    image, the confidences there are 0.

    Raises: CaptureError if the file is not valid. InvalidFileError if an npz file has too many
    views.
    """
    if source.path.suffix.lower() == ".npz":
        return _saved(source.path)
    kind, images = read_people(source.path, source.json)
    everybody = [each for image in images for each in image.people if each is not None]
    hands = any(each.hands is not None for each in everybody)
    if hands:
        kind = MEDIAPIPE_69
    nobody, seen = np.zeros((len(kind.names), 6)), []
    for image in images:
        people = tuple(nobody if each is None else columns_of(each, hands) for each in image.people)
        seen.append(DetectedImage(image.image, source.path, people, image.size))
    return Detections(kind if everybody else None, tuple(seen), offset=0.0)


def save_keypoints(path: str | Path, keypoints: Keypoints, names: Sequence[str]) -> None:
    """Writes the keypoints of one person in our own format (.npz). The file has points,
    confidences, the name of the set, and the names of the views. It has no 3D landmarks.

    names: one name for each view, as in the capture.
    Raises: ValueError if the path does not end in .npz, or if there is not one name per view.
    OSError if writing fails.
    """
    if len(names) != len(keypoints.points):
        raise ValueError(
            f"names: expected one for each of {len(keypoints.points)} views, got {len(names)}"
        )
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
    values = ArrayFile.open(file, CaptureError)
    name, views = (values.array(key) for key in ("set", "names"))
    kind = _set_of(str(name), file)
    check_limit("people", views.size, "people")
    shape = len(views.reshape(-1)), len(kind.names)
    points = file_numbers(values.array("points"), file, "points", (*shape, 2), nulls=True)
    confidences = file_numbers(values.array("confidences"), file, "confidences", shape, nulls=True)
    people = np.concatenate([points, confidences[..., None]], axis=-1)
    rows = zip(views.reshape(-1).tolist(), people, strict=True)
    return Detections(
        kind, tuple(DetectedImage(str(view), file, (person,)) for view, person in rows), offset=0.0
    )


def _set_of(name: str, file: Path) -> KeypointSet:
    if name not in KEYPOINT_SETS:
        raise CaptureError(file, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}")
    return KEYPOINT_SETS[name]


# People in photos
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class SeenPerson:
    """A person in an image."""

    points: Float[np.ndarray, "k 3"]
    """Pixels (x, y) and visibility of the points, (k, 3)."""
    world: Float[np.ndarray, "k 3"]
    """Positions of the points in space, (k, 3), metres, see the module's docstring."""
    presence: float
    """Probability that there is a person, in [0, 1]."""
    hands: Float[np.ndarray, "42 6"] | None = None
    """The 21 landmarks of the left and then of the right hand, (42, 6). The columns are x and y in
    pixels, confidence, and x, y and z in metres. The rows of a hand that was not seen are 0. None
    if neither was seen, or if hands were not looked for.
    """


def columns_of(person: SeenPerson | None, hands: bool) -> Float[np.ndarray, "k 6"]:
    """Returns the points of a person, (k, 6), in the set `MEDIAPIPE_69` if `hands` is True, else in
    `MEDIAPIPE_33`. The columns are x and y in pixels, confidence, and x, y and z in metres. All are
    0 if the person is None.
    """
    if person is None:
        kind = MEDIAPIPE_69 if hands else MEDIAPIPE_33
        return np.zeros((len(kind.names), 6))
    body = np.column_stack([person.points, person.world])
    if not hands:
        return body
    own = (None, None) if person.hands is None else np.split(person.hands, 2)
    return with_hands(body, [each if each is not None and each.any() else None for each in own])


@dataclasses.dataclass(frozen=True, eq=False)
class ImagePeople:
    """The people that were found in an image."""

    image: str
    """Name of the image."""
    size: tuple[int, int]
    """Width and height of the image, pixels."""
    people: tuple[SeenPerson | None, ...]
    """One entry for each person in the photos. It is None if the person is not in this image."""


def write_people(path: str | Path, images: Sequence[ImagePeople]) -> None:
    """Writes the people of images to a file. If writing fails, no partial file is left.

    Raises: OSError.
    """
    described = []
    for image in images:
        people = [None if person is None else _described(person) for person in image.people]
        described.append(
            {
                "image": image.image,
                "width": image.size[0],
                "height": image.size[1],
                "people": people,
            }
        )
    write_json(
        path,
        {"format": FORMAT, "version": VERSION, "set": MEDIAPIPE_33.name, "images": described},
        indent=None,
    )


def _described(person: SeenPerson) -> dict[str, Any]:
    def rounded(values: np.ndarray) -> list:
        return np.round(values, _DECIMALS).tolist()

    hands = {} if person.hands is None else {"hands": rounded(person.hands)}
    return {
        "presence": round(person.presence, _DECIMALS),
        "pixels": rounded(person.points[:, :2]),
        "visibility": rounded(person.points[:, 2]),
        "world": rounded(person.world),
        **hands,
    }


def read_people(path: Path, content: Any = None) -> tuple[KeypointSet, tuple[ImagePeople, ...]]:
    """Returns the keypoint set and the images of a file of people. content: the JSON value of the
    file. None: the file is read.

    Raises: CaptureError, which names the file, and the field if one is missing or wrong.
    """
    content = checked_json(path) if content is None else content
    if not _is_people_file(content):
        raise CaptureError(path, "format", f"expected {FORMAT!r}")
    version, name, images = members(content, path, version=int, set=str, images=list)
    if version != VERSION:
        raise CaptureError(path, "version", f"expected {VERSION}, got {version!r}")
    kind = _set_of(name, path)
    return kind, tuple(
        _image(each, len(kind.names), path, f"images[{i}]") for i, each in enumerate(images)
    )


def _is_people_file(content: Any) -> bool:
    return isinstance(content, dict) and content.get("format") == FORMAT


def _image(image: Any, count: int, path: Path, field: str) -> ImagePeople:
    name, width, height, people = members(
        image, path, field, image=str, width=int, height=int, people=list
    )
    found = (
        _own_person(each, count, path, f"{field}.people[{i}]") for i, each in enumerate(people)
    )
    return ImagePeople(name, (width, height), tuple(found))


def _own_person(person: Any, count: int, path: Path, field: str) -> SeenPerson | None:
    if person is None:
        return None
    shapes = {"pixels": (count, 2), "visibility": (count,), "world": (count, 3)}
    values = members(person, path, field, **dict.fromkeys(shapes, list), presence=float)
    pixels, visibility, world = (
        file_numbers(value, path, f"{field}.{key}", shape, nulls=True)
        for value, (key, shape) in zip(values, shapes.items(), strict=False)
    )
    hands = None
    if count == len(MEDIAPIPE_33.names) and person.get("hands") is not None:
        hands = file_numbers(person["hands"], path, f"{field}.hands", (42, 6), nulls=True)
    return SeenPerson(np.column_stack([pixels, visibility]), world, float(values[-1]), hands)


# OpenPose's --write_json
# -----------------------------------------------------------------------------------------------

BODY = "pose_keypoints_2d"
"""Key of the points of the body in OpenPose's files."""
_BODY_POINTS = (25, 18)
"""Possible numbers of points of a body: 25 for the models BODY_25 and BODY_25B, 18 for the model
COCO.
"""
_OTHER_MODELS = {15: "MPI", 135: "BODY_135", 20: "an animal of ControlNet"}
"""Names of models that cannot be read, by their number of points. They appear in error messages."""


def recognizes_openpose(source: KeypointFile) -> bool:
    """Returns whether a file is a JSON object with "people", or a list of such objects."""
    frames = source.json if isinstance(source.json, list) else [source.json]
    return bool(frames) and all(isinstance(frame, dict) and "people" in frame for frame in frames)


def read_openpose(source: KeypointFile, format: SourceFormat) -> Detections:
    """Returns the people of one image. If the file is a list of frames, it returns the people of
    each frame of a video. Node-based programs (ControlNet) write such lists.

    Raises: CaptureError if the file is not valid.
    """
    listed = isinstance(source.json, list)
    frames = source.json if listed else [source.json]
    of_nodes = any("canvas_width" in frame for frame in frames)
    own = not of_nodes and any("version" in frame for frame in frames)
    images = []
    for i, frame in enumerate(frames):
        field = f"[{i}]." if listed else ""
        (entries,) = members(frame, source.path, field.rstrip("."), people=list)
        people = tuple(
            _openpose_person(each, source.path, f"{field}people[{j}]", own)
            for j, each in enumerate(entries)
        )
        if not any(person.any() for person in people):
            people = ()
        # what OpenPose adds to the name of the image
        name: str | int = source.name.removesuffix("_keypoints")
        if len(frames) > 1:
            name = i if source.alone else f"{name}/{i}"
        images.append(DetectedImage(name, source.path, people, _canvas(frame, source.path)))
    found = detections_of(images, OPENPOSE_67, OPENPOSE_60)
    return dataclasses.replace(found, tool="OpenPose" if own else "")


def _canvas(frame: dict[str, Any], file: Path) -> tuple[int, int] | None:
    """Returns width and height of the image that the points refer to, pixels. None if the file does
    not state them.
    """
    width, height = frame.get("canvas_width"), frame.get("canvas_height")
    if width is None or height is None:
        return None
    return _stated_size({"width": width, "height": height}, file)


def _openpose_person(person: Any, file: Path, field: str, own: bool) -> Float[np.ndarray, "k 3"]:
    """Returns the points of a person, (k, 3). own: whether OpenPose itself has written the file.

    Raises: CaptureError for points of an unknown model.
    """
    if expect(person, dict, file, field).get(BODY) is None:
        person = person | {BODY: []}
    (body,) = members(person, file, field, **{BODY: list})
    count, rest = divmod(len(body), 3)
    if not rest and count in SETS_BY_COUNT:
        return triples(body, file, f"{field}.{BODY}")
    if rest or (count and count not in _BODY_POINTS):
        found = f"{count} points"
        if rest:
            found = f"{len(body)} numbers"
        elif count in _OTHER_MODELS:
            found += f" of {_OTHER_MODELS[count]}"
        known = ", ".join(map(str, sorted((*_BODY_POINTS, *SETS_BY_COUNT))))
        hint = " (OpenPose: --model_pose BODY_25)" if own else ""
        raise CaptureError(
            file,
            f"{field}.{BODY}",
            f"expected {known} points of x, y, confidence, got {found}{hint}",
        )
    # keys and their numbers of points. The face, if it is there, is not read
    hands = {"hand_left_keypoints_2d": 21, "hand_right_keypoints_2d": 21}
    return _parts(person, {BODY: count or _BODY_POINTS[0], **hands}, file, field)


def _parts(
    person: dict[str, Any], counts: dict[str, int], file: Path, field: str
) -> Float[np.ndarray, "k 3"]:
    """Returns the points of all parts of a person, one after the other, (k, 3). If the key of a
    part is missing, null or an empty list, the part was not detected, and its points are 0. counts:
    number of points of each part, by its key.
    """
    points = []
    for key, count in counts.items():
        if person.get(key) in (None, []):
            points.append(np.zeros((count, 3)))
        else:
            points.append(triples(person[key], file, f"{field}.{key}", count))
    return np.concatenate(points)


# EasyMocap's annots
# --------------------------------------------------------------------------------------------------


def recognizes_easymocap(source: KeypointFile) -> bool:
    """Returns whether a file is a JSON object with a list "annots"."""
    return isinstance(source.json, dict) and isinstance(source.json.get("annots"), list)


def read_easymocap(source: KeypointFile, format: SourceFormat) -> Detections:
    """Returns the people of one image, ordered by their personID. An ID counts if it is a whole
    number from 0 to 63 and no earlier person has it. If an entry has no ID, its index in the list
    takes the place of the ID. People whose ID does not count get the lowest numbers that are free.
    A number that nobody has stands for a person whose points are all 0.

    Raises: CaptureError if the file is not valid.
    """
    content, file, people, others = source.json, source.path, {}, []
    for i, entry in enumerate(content["annots"]):
        field = f"annots[{i}]"
        members(entry, file, field, keypoints=list)
        person = _part(entry, "keypoints", None, file, field)
        # BODY_25, perhaps with hands
        if len(person) == 25:
            # keys of the left and the right hand
            hands = [_part(entry, key, 21, file, field) for key in ("handl2d", "handr2d")]
            person = np.concatenate([person, *hands])
        number = entry.get("personID", i)
        # people are in the order of their IDs; beyond this many an ID is no count
        counted = type(number) is int and 0 <= number < 64 and number not in people
        if counted:
            people[number] = person
        else:
            others.append(person)
    free = (number for number in itertools.count() if number not in people)
    people |= dict(zip(free, others, strict=False))
    first = next(iter(people.values()), np.zeros((0, 3)))
    found = tuple(people.get(i, np.zeros_like(first)) for i in range(max(people, default=-1) + 1))
    name = content.get("filename")
    if not (isinstance(name, str) and name):
        name = source.name
    size = content.get("width"), content.get("height")
    known = all(type(side) is int and side > 0 for side in size)
    image = DetectedImage(name, file, found, size if known else None)
    return detections_of([image], OPENPOSE_67)


def _part(
    entry: dict[str, Any], key: str, count: int | None, file: Path, field: str
) -> Float[np.ndarray, "k 3"]:
    """Returns the points of a part of a person, (k, 3). They are 0 if the part is missing or empty.
    count: number of points. None: any number.
    """
    if not entry.get(key):
        return np.zeros((count or 0, 3))
    return file_numbers(entry[key], file, f"{field}.{key}", (count, 3), nulls=True)


# COCO
# --------------------------------------------------------------------------------------------------

_COCO_PARTS = {
    "keypoints": 17,
    "foot_kpts": 6,
    "face_kpts": 68,
    "lefthand_kpts": 21,
    "righthand_kpts": 21,
}
"""Number of points of each part of COCO-WholeBody, by its key. Parts are in the order of the 133
points.
"""


def recognizes_coco(source: KeypointFile) -> bool:
    """Returns whether a file is a JSON object with "annotations", or a list of results that name
    their image.
    """
    if isinstance(source.json, dict):
        return "annotations" in source.json
    entries = source.json if isinstance(source.json, list) else []
    return any(
        isinstance(entry, dict) and entry.keys() & {"image_id", "file_name"} for entry in entries
    )


def read_coco(source: KeypointFile, format: SourceFormat) -> Detections:
    """Returns the people of all images of a file. If the file is a list of results, images are in
    the order in which they first appear.

    Raises: CaptureError if the file is not valid.
    """
    of_kind = _annotated_images if isinstance(source.json, dict) else _result_images
    return detections_of(of_kind(source.json, source.path))


def _result_images(entries: list[Any], file: Path) -> list[DetectedImage]:
    whole = _whole_body(entries)
    people: dict[str | int, list[Float[np.ndarray, "k 3"]]] = {}
    for i, entry in enumerate(entries):
        key = "file_name" if "file_name" in expect(entry, dict, file, f"[{i}]") else "image_id"
        image = _image_label(entry.get(key), file, f"[{i}].{key}")
        people.setdefault(image, []).append(_coco_person(entry, file, f"[{i}]", whole))
    return [DetectedImage(image, file, tuple(each)) for image, each in people.items()]


def _annotated_images(content: dict[str, Any], file: Path) -> list[DetectedImage]:
    """Returns the images of a file with "images" and "annotations". Crowds and annotations without
    keypoints are ignored.
    """
    described, annotations = members(content, file, images=list, annotations=list)
    # images first: annotations name them by their id
    images: dict[str | int, tuple[dict[str, Any], list[Float[np.ndarray, "k 3"]]]] = {}
    for i, image in enumerate(described):
        expect(image, dict, file, f"images[{i}]")
        images[_image_label(image.get("id"), file, f"images[{i}].id")] = (image, [])
    # people of each image
    whole = _whole_body(annotations)
    for i, entry in enumerate(annotations):
        field = f"annotations[{i}]"
        if expect(entry, dict, file, field).get("iscrowd") or "keypoints" not in entry:
            continue
        image = _image_label(entry.get("image_id"), file, f"{field}.image_id")
        if image not in images:
            raise CaptureError(
                file,
                f"{field}.image_id",
                f"expected the id of one of the images, got {shown(image)}",
            )
        images[image][1].append(
            _by_visibility(_coco_person(entry, file, field, whole), file, field)
        )
    found = []
    for key, (image, people) in images.items():
        name = _image_label(image.get("file_name", key), file, f"image {key}")
        found.append(DetectedImage(name, file, tuple(people), _stated_size(image, file)))
    return found


def _image_label(value: Any, file: Path, field: str) -> str | int:
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise CaptureError(
            file, field, f"expected the name or number of an image, got {shown(value)}"
        )
    return value


def _whole_body(entries: list[Any]) -> bool:
    """Returns whether any person has a part of COCO-WholeBody in addition to the body. If so, the
    points of parts that a person lacks are 0.
    """
    return any(
        isinstance(entry, dict) and len(_COCO_PARTS.keys() & entry.keys()) > 1 for entry in entries
    )


def _coco_person(
    entry: dict[str, Any], file: Path, field: str, whole: bool
) -> Float[np.ndarray, "k 3"]:
    (keypoints,) = members(entry, file, field, keypoints=list)
    if whole:
        return _parts(entry, _COCO_PARTS, file, field)
    return triples(keypoints, file, f"{field}.keypoints")


def _by_visibility(
    person: Float[np.ndarray, "k 3"], file: Path, field: str
) -> Float[np.ndarray, "k 3"]:
    """Returns the points of a person, (k, 3), with confidences in place of COCO's visibilities. The
    confidence is 1 for a visible point, 0.5 for a hidden one, and 0 for one without annotation.
    person: x, y and visibility, (k, 3).

    COCO-WholeBody also has fractions as visibilities. Any fraction above 0 means that the point is
    reliable.
    Raises: CaptureError for values outside of 0 to 2.
    """
    visibility = person[:, 2]
    # COCO's visibility of a point that is seen; 1 is hidden, 0 not annotated
    if not np.isnan(visibility).all() and (np.nanmin(visibility) < 0 or np.nanmax(visibility) > 2):
        raise CaptureError(
            file, field, f"expected visibilities 0, 1 or 2, got {np.nanmax(np.abs(visibility)):g}"
        )
    # confidence of points that an annotator guessed behind something else
    confidence = np.where(visibility == 1, 0.5, np.where(visibility > 0, 1.0, 0.0))
    return np.column_stack([person[:, :2], np.where(np.isnan(visibility), np.nan, confidence)])


def _stated_size(image: dict[str, Any], file: Path) -> tuple[int, int] | None:
    """Returns width and height that the file states for an image, pixels. None if one of them is 0
    or missing.

    Raises: CaptureError if the values cannot be a size.
    """
    width, height = size = image.get("width"), image.get("height")
    if not width or not height:
        return None
    if not all(isinstance(side, int | float) and 1 <= side <= limits().side for side in size):
        raise CaptureError(
            file, "images", f"expected width and height in pixels, got {width!r} and {height!r}"
        )
    return int(width), int(height)


# MMPose's inferencer and demo scripts
# ----------------------------------------------------------------------------------

_PREFIX = "results_"
"""MMPose's demo scripts put this before the name of the image."""


def recognizes_mmpose(source: KeypointFile) -> bool:
    """Returns whether a file has a list of instances or frames. An empty list is accepted, too,
    although another program may have written it.
    """
    entries = _entries(source)
    if not isinstance(entries, list):
        return False
    return not entries or any(
        isinstance(each, dict) and each.keys() & {"keypoint_scores", "frame_id"} for each in entries
    )


def read_mmpose(source: KeypointFile, format: SourceFormat) -> Detections:
    """Returns the people of an image, or of the frames of a video.

    Raises: CaptureError if the file is not valid.
    """
    name, file, entries = source.name.removeprefix(_PREFIX), source.path, _entries(source)
    if not any(isinstance(entry, dict) and "frame_id" in entry for entry in entries):
        return detections_of([DetectedImage(name, file, _people(entries, file, "instances"))])
    images = []
    for i, entry in enumerate(entries):
        frame, instances = members(entry, file, f"[{i}]", frame_id=int, instances=list)
        label = frame if source.alone else f"{name}/{frame}"
        images.append(DetectedImage(label, file, _people(instances, file, f"[{i}].instances")))
    return detections_of(images)


def _entries(source: KeypointFile) -> Any:
    return source.json.get("instance_info") if isinstance(source.json, dict) else source.json


def _people(instances: list[Any], file: Path, field: str) -> tuple[Float[np.ndarray, "k 3"], ...]:
    return tuple(
        _mmpose_person(instance, file, f"{field}[{i}]") for i, instance in enumerate(instances)
    )


def _mmpose_person(instance: Any, file: Path, field: str) -> Float[np.ndarray, "k 3"]:
    points, scores = members(instance, file, field, keypoints=list, keypoint_scores=list)
    points = file_numbers(points, file, f"{field}.keypoints", (None, 2), nulls=True)
    scores = file_numbers(scores, file, f"{field}.keypoint_scores", (len(points),), nulls=True)
    return np.column_stack([points, scores])
