"""Holds keypoints in memory: those of a capture's views, those in a file, and the sets of points
that detectors are trained on.

The names of points are, with `side` left or right (the person's own):

    nose, `side`_eye, _ear, _shoulder, _elbow, _wrist, _hip, _knee, _ankle, _big_toe, _small_toe,
        _heel
    neck and mid_hip: the middle of the shoulders and of the hips (OpenPose and Halpe)
    head_top (Halpe and BODY_25B), upper_neck (BODY_25B)
    `side`_foot_index: the tip of the foot, between big and second toe (BlazePose only)
    face_0 to face_67: 300-W's landmarks; 0 is the jaw under the person's right ear
    `side`_hand_root, `side`_thumb_, index_, middle_, ring_, pinky_ with 1, 2, 3, tip: 1 is nearest
        to the palm

A point has the same name in every set that has it, although annotators of different sets mean
slightly different places, for example by "hip".

Sources: COCO's person_keypoints annotations; Fang-Haoshu/Halpe-FullBody; jin-s13/COCO-WholeBody's
data format; OpenPose's "Demo - Output" page; MediaPipe's "Pose landmark detection" page.
"""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.body.landmarks import (
    LandmarkDefinition,
    both_sides,
    mirrored_name,
    place,
    plain_places,
)
from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, checked_json, file_numbers
from humangs_jax.data.formats import KEYPOINTS

SIDES = ("left", "right")
"""Names of the sides, seen from the person."""
FINGERS = ("thumb", "index", "middle", "ring", "pinky")
"""Fingers in the order of OpenPose's hands."""
_FACE_POINTS = 68
"""Number of face landmarks in 300-W."""

_FOOT = ("big_toe", "small_toe", "heel")
_FEET = tuple(f"{side}_{part}" for side in SIDES for part in _FOOT)
_COCO = (
    "nose",
    *(
        f"{side}_{part}"
        for part in ("eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in SIDES
    ),
)
_BODY_25 = (
    *("nose", "neck"),
    *(f"{side}_{part}" for side in ("right", "left") for part in ("shoulder", "elbow", "wrist")),
    "mid_hip",
    *(f"{side}_{part}" for side in ("right", "left") for part in ("hip", "knee", "ankle")),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
    *_FEET,
)


@dataclasses.dataclass(frozen=True)
class KeypointSet:
    """The points that a detector finds, in the detector's order."""

    name: str
    """Name of the set in our npz files."""
    names: tuple[str, ...]
    """Names of the k points."""
    mirror: tuple[int, ...]
    """Index of each point's mirror image, (k,). A point in the middle of the body is its own mirror
    image.
    """
    places: tuple[LandmarkDefinition, ...] = ()
    """Places on the body of those points whose place a fit may move. Each place starts at its
    offset from a landmark of `body.landmarks`. The offset is 0 if it is not known where the
    detector sees the point.
    """
    certainty: tuple[float, ...] = ()
    """Certainty of each point as a fit has found it, (k,): the noise of all points, divided by the
    noise of this one. If the tuple is empty, `usual_certainty` is used.
    """

    @property
    def offsets(self) -> Float[np.ndarray, "k 3"]:
        """For each of the k points, the `offset` of its entry in `places`: the vector from its base
        landmark, (k, 3), metres in the T-pose. 0 for points without an entry.
        """
        known = {place.name: place.offset for place in self.places}
        return np.asarray([known.get(name, (0.0, 0.0, 0.0)) for name in self.names])

    def adapted(
        self, offsets: Float[np.ndarray, "k 3"], certainty: Float[np.ndarray, " k"]
    ) -> "KeypointSet":
        """Returns the set with the offsets and certainties that a fit has found. offsets: offsets
        of all points, (k, 3), metres. Offsets of points that are not in `places` are ignored.
        """
        own = dict(zip(self.names, np.asarray(offsets, float).tolist(), strict=True))
        places = tuple(place._replace(offset=tuple(own[place.name])) for place in self.places)
        return dataclasses.replace(
            self, places=places, certainty=tuple(np.asarray(certainty, float).tolist())
        )


def hand_names(side: str) -> tuple[str, ...]:
    """Returns the names of the 21 points of a hand, from the palm to the tips, in the order of
    OpenPose and COCO-WholeBody.
    """
    return (
        f"{side}_hand_root",
        *(f"{side}_{finger}_{joint}" for finger in FINGERS for joint in ("1", "2", "3", "tip")),
    )


def _keypoint_set(
    name: str, names: tuple[str, ...], places: tuple[LandmarkDefinition, ...] = ()
) -> KeypointSet:
    return KeypointSet(
        name,
        names,
        tuple(names.index(mirrored_name(each)) for each in names),
        places or plain_places(names),
    )


COCO_17 = _keypoint_set("coco17", _COCO)
"""COCO's 17 points of the body."""

COCO_WHOLEBODY_133 = _keypoint_set(
    "wholebody133",
    (
        *_COCO,
        *_FEET,
        *(f"face_{i}" for i in range(_FACE_POINTS)),
        *hand_names("left"),
        *hand_names("right"),
    ),
)
"""The 133 points of COCO-WholeBody: 17 of the body as in COCO, 6 of the feet, 68 of the face, 21 of
the left hand and 21 of the right hand.
"""

HALPE_26 = _keypoint_set(
    "halpe26",
    (
        *_COCO,
        "head_top",
        "neck",
        "mid_hip",
        *(f"{side}_{part}" for part in _FOOT for side in SIDES),
    ),
)
"""Halpe's 26 points of the body, which AlphaPose and RTMPose use. They are COCO's 17 points, three
in the middle of the body, and six of the feet.
"""

HALPE_136 = _keypoint_set(
    "halpe136",
    (
        *HALPE_26.names,
        *(f"face_{i}" for i in range(_FACE_POINTS)),
        *hand_names("left"),
        *hand_names("right"),
    ),
)
"""Halpe's 136 points, which AlphaPose uses: 26 of the body, 68 of the face, 21 of the left hand and
21 of the right hand.
"""

OPENPOSE_67 = _keypoint_set("openpose67", (*_BODY_25, *hand_names("left"), *hand_names("right")))
"""The 25 points of OpenPose's BODY_25, and its 21 points of the left and of the right hand.

OpenPose's 70 points of the face are not in this set, and are ignored.
"""

OPENPOSE_60 = _keypoint_set(
    "openpose60",
    (*_BODY_25[:8], *_BODY_25[9:19], *hand_names("left"), *hand_names("right")),
)
"""The 18 points of OpenPose's COCO model, and its 21 points of the left and of the right hand."""

OPENPOSE_67B = _keypoint_set(
    "openpose_b67",
    (*_COCO, "upper_neck", "head_top", *_FEET, *hand_names("left"), *hand_names("right")),
)
"""The 25 points of OpenPose's BODY_25B, and its 21 points of the left and of the right hand.

Files do not state whether they have BODY_25 or BODY_25B, see `orders`.
"""


def _both(part: str) -> tuple[str, str]:
    """Returns the names of the left and the right point of a part."""
    return f"left_{part}", f"right_{part}"


# millimetres. The mean over 12 synthetic people (`python -m experiments landmark_places`); those of
# hips, wrists, knees, ankles and feet are the mean of these and of a barefoot man's, since
# synthetic people wear shoes
_BLAZEPOSE_PLACES = (
    place("nose", "nose", ("head",), (0, 13, -12)),
    *both_sides(("face_42", "face_39"), "{side}_eye", ("head",), (-15, 9, 7)),
    *both_sides(_both("eye"), "{side}_eye", ("head",), (-4, 9, 0)),
    *both_sides(("face_45", "face_36"), "{side}_eye", ("head",), (6, 9, -7)),
    *both_sides(_both("ear"), "{side}_ear", ("head",), (-33, 1, 34)),
    *both_sides(("face_54", "face_48"), "jaw", ("head",), (15, 37, -2)),
    *both_sides(_both("shoulder"), "{side}_shoulder", ("{side}_collar",), (-9, 36, -4)),
    *both_sides(_both("elbow"), "{side}_elbow", ("{side}_shoulder", "{side}_elbow"), (-1, 4, 6)),
    *both_sides(_both("wrist"), "{side}_wrist", ("{side}_elbow", "{side}_wrist"), (2, 9, 1)),
    *both_sides(_both("pinky_1"), "{side}_pinky_1", ("{side}_wrist",), (-9, -7, 24)),
    *both_sides(_both("index_1"), "{side}_index_1", ("{side}_wrist",), (-21, -13, -16)),
    *both_sides(_both("thumb_2"), "{side}_thumb_2", ("{side}_wrist",), (6, 2, -28)),
    *both_sides(_both("hip"), "{side}_hip", ("pelvis",), (-11, -10, 25)),
    *both_sides(_both("knee"), "{side}_knee", ("{side}_hip", "{side}_knee"), (0, 0, -9)),
    *both_sides(_both("ankle"), "{side}_ankle", ("{side}_knee", "{side}_ankle"), (2, 9, 1)),
    *both_sides(_both("heel"), "{side}_heel", ("{side}_ankle",), (1, -14, 17)),
    *both_sides(_both("foot_index"), "{side}_foot_index", ("{side}_ankle",), (-8, -4, -20)),
)

MEDIAPIPE_33 = _keypoint_set(
    "mediapipe33",
    (
        *(
            "nose",
            "face_42",
            "left_eye",
            "face_45",
            "face_39",
            "right_eye",
            "face_36",
            "left_ear",
            "right_ear",
        ),
        *("face_54", "face_48"),
        *(f"{side}_{part}" for part in ("shoulder", "elbow", "wrist") for side in SIDES),
        *(f"{side}_{part}" for part in ("pinky_1", "index_1", "thumb_2") for side in SIDES),
        *(
            f"{side}_{part}"
            for part in ("hip", "knee", "ankle", "heel", "foot_index")
            for side in SIDES
        ),
    ),
    _BLAZEPOSE_PLACES,
)
"""MediaPipe's 33 points (BlazePose). Corners of eyes and mouth have the names of the corresponding
face points.
"""

_COARSE = ("pinky_1", "index_1", "thumb_2")
_HANDS = (*hand_names("left"), *hand_names("right"))
MEDIAPIPE_69 = _keypoint_set(
    "mediapipe69",
    (*(name for name in MEDIAPIPE_33.names if name.split("_", 1)[-1] not in _COARSE), *_HANDS),
    tuple(each for each in _BLAZEPOSE_PLACES if each.name.split("_", 1)[-1] not in _COARSE),
)
"""BlazePose's points except its three points of each hand, then mediapipe's 21 points of the left
hand, and its 21 points of the right hand.
"""

_DETECTORS = (
    COCO_17,
    HALPE_26,
    COCO_WHOLEBODY_133,
    HALPE_136,
    OPENPOSE_60,
    OPENPOSE_67,
    OPENPOSE_67B,
    MEDIAPIPE_33,
    MEDIAPIPE_69,
)
KEYPOINT_SETS = {each.name: each for each in _DETECTORS}
"""All sets by name. Our npz files use these names."""
SETS_BY_COUNT = {
    len(each.names): each for each in (COCO_17, HALPE_26, COCO_WHOLEBODY_133, HALPE_136)
}
"""Sets by their number of points, for lists of points without names.

OpenPose's sets are missing here, because its files have body and hands in separate lists.
"""


# Keypoints
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Keypoints:
    """One person's keypoints in each of v views, as numpy arrays."""

    points: Float[np.ndarray, "v k 2"]
    """Detected points, (v, k, 2), float32, pixels: x right and y down, with the centre of the first
    pixel at (0.5, 0.5). They are finite. Points with confidence 0 have to be ignored.
    """
    confidences: Float[np.ndarray, "v k"]
    """Confidences, (v, k), float32 in [0, 1]. 0 where the point is missing."""
    set: KeypointSet
    """The set of the k points."""
    missing: tuple[str, ...] = ()
    """Names of the views without a usable point."""
    world: Float[np.ndarray, "v k 3"] | None = None
    """The detector's 3D landmarks, (v, k, 3), metres, for a person of average size. The z axis is
    the ray from the camera to the person, and the translation is arbitrary. None if the detector
    has no such landmarks.
    """
    warnings: tuple[str, ...] = ()
    """Problems of a file that could still be read, one line each."""


@dataclasses.dataclass(frozen=True, eq=False)
class DetectedImage:
    """The people in one image of a file."""

    image: str | int
    """Name or path of the image as the file has it. A number if the file has only numbers."""
    file: Path
    """File from which the people were read."""
    people: tuple[Float[np.ndarray, "k columns"], ...]
    """Points of each person, (k, 3) or (k, 6), not yet checked. The columns are x and y in the
    tool's pixels, and confidence. If there are six, the 3D landmark follows, see `Keypoints.world`.
    Missing numbers are NaN.
    """
    size: tuple[int, int] | None = None
    """Width and height of the image, pixels. None if the file does not state them."""


@dataclasses.dataclass(frozen=True, eq=False)
class Detections:
    """The people in the images of a file or folder."""

    set: KeypointSet | None
    """The set of the points. None if no image has a person."""
    images: tuple[DetectedImage, ...]
    """The images, in the order of the file."""
    offset: float = 0.5
    """Number that has to be added to x and y so that pixel centres are at +0.5, pixels. It is 0.5
    for other tools, which have the centre of the first pixel at 0, and 0 for our files.
    """
    warnings: tuple[str, ...] = ()
    """Problems of the files, one line each."""
    tool: str = ""
    """Name of the tool that wrote the files. Empty if the files do not state it."""


@dataclasses.dataclass(frozen=True, eq=False)
class KeypointFile:
    """A file of keypoints, as the readers of all formats get it."""

    path: Path
    """Path of the file."""
    name: str
    """Path of the file within the folder, without the suffix. In some formats it is the name of the
    image or video.
    """
    alone: bool
    """Whether no other file is read with this one. If so, the frames of a video are named by their
    number. If not, they are named name/number.
    """

    @functools.cached_property
    def json(self) -> Any:
        """The JSON value of the file. None if the file's suffix belongs to a format that is not
        JSON.

        Raises: CaptureError if the file is not valid JSON.
        """
        return None if self.path.suffix.lower() in KEYPOINTS.suffixes else checked_json(self.path)


def detections_of(images: Sequence[DetectedImage], *more: KeypointSet) -> Detections:
    """Returns detections of these images, with the keypoint set that has the right number of
    points. The set is None if there is no person. more: sets to choose from in addition to
    `SETS_BY_COUNT`.

    Raises: CaptureError if no set has this number of points, or if people have different numbers.
    """
    people = [(len(person), image) for image in images for person in image.people]
    if not people:
        return Detections(None, tuple(images))
    known = SETS_BY_COUNT | {len(each.names): each for each in more}
    count, first = people[0]
    for other, image in people:
        if other != count:
            problem = (
                f"a person of {other} points, but another has {count}: expected one set of"
                " keypoints"
            )
            raise CaptureError(image.file, f"image {image.image}", problem)
    if count not in known:
        counts = " or ".join(f"{number} ({each.name})" for number, each in known.items())
        raise CaptureError(first.file, "keypoints", f"expected {counts} points, got {count}")
    return Detections(known[count], tuple(images))


def triples(
    value: Any, file: Path, field: str, count: int | None = None
) -> Float[np.ndarray, "k 3"]:
    """Returns x, y and confidence of each point, (k, 3), from a flat list of numbers. null becomes
    NaN. count: number of points. None: any number.

    Raises: CaptureError if the list has other values than numbers and null, or not 3 numbers for
    each point.
    """
    array = file_numbers(value, file, field, nulls=True)
    wanted = "a multiple of 3" if count is None else f"{3 * count} ({count} times x, y, confidence)"
    if array.ndim != 1 or array.size % 3 or (count is not None and array.size != 3 * count):
        raise CaptureError(
            file, field, f"expected a flat list of {wanted} numbers, got shape {array.shape}"
        )
    return array.reshape(-1, 3)


def with_hands(
    body: Float[np.ndarray, "33 *c"], hands: Sequence[Float[np.ndarray, "21 *c"] | None]
) -> Float[np.ndarray, "69 *c"]:
    """Returns the values of the points of `MEDIAPIPE_69`, (69, ...), from the values of BlazePose's
    points and of the points of the left and the right hand.

    If a hand is None, its values are 0, except for the points that BlazePose has, too.
    """
    names = MEDIAPIPE_33.names
    found = np.zeros((len(MEDIAPIPE_69.names), *body.shape[1:]), body.dtype)
    shared = [name for name in MEDIAPIPE_69.names if name in names]
    for name in shared:
        found[MEDIAPIPE_69.names.index(name)] = body[names.index(name)]
    for side, hand in zip(SIDES, hands, strict=True):
        if hand is not None:
            first = MEDIAPIPE_69.names.index(f"{side}_hand_root")
            found[first : first + len(hand)] = hand
    return found
