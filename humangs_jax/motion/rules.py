"""Holds tables that the readers of motions share, and chooses the axis that is up in a motion.

The tables hold names of joints and limits of decisions. The page reads motions too, and gets all
its tables from `page_rules` when it is assembled (viewer/page.py).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import (
    BODY_NAMES,
    DEFAULT_FPS,
    FINGERS,
    JOINT_NAMES,
    PARENTS,
)
from humangs_jax.body.kinematics import bones_of, posed_tree
from humangs_jax.body.motion import PELVIS
from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import LARGEST_DISTANCE
from humangs_jax.data.formats import CAMERA_MOVES, MOTIONS, PLACES
from humangs_jax.geometry.axes import CLEARLY_UP, UPRIGHT, upright_matrix

# Files of arrays
# --------------------------------------------------------------------------------------------------

BODY_NUMBERS = 3 * len(BODY_NAMES)  # 66
HAND_NUMBERS = 45
COLUMNS = {
    3 * len(JOINT_NAMES): "SMPL-X",
    BODY_NUMBERS + 2 * HAND_NUMBERS: "SMPL-H",
    72: "SMPL",
    BODY_NUMBERS: "the body",
}
"""For each known number of columns of a pose, the body model that has it."""
MILLIMETRES = 1000.0
ORTHONORMAL = 0.05
"""A matrix R in a file counts as a rotation if it does not mirror, and if R R^T differs by less
than this from the identity.
"""
FAR = 25.0
"""If the median distance of a person from the camera is larger than this, metres, the program that
wrote the file has assumed a focal length (4D-Humans and others).
"""
ASSUMED_FOCAL = 5000 / 256
"""The focal length that these programs assume, divided by the longer side of the photo. Usual
lenses have a ratio of about 1.
"""
NEARER = "{} is of a focal length that was assumed: people are taken to be {:.3g} times nearer"
NO_RATE = "the file says no frames per second: taken for {:g}"
NO_PLACES = "the file has no positions ({}): people stay in place"

# Names of joints
# --------------------------------------------------------------------------------------------------

FINGER_JOINT = "joint"
"""Word that `matching` writes for the dash in MakeHuman's names of fingers: "finger1-2" is the
second joint of the thumb, but Biped's "Finger12" is the third of the index finger.
"""
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_ORDINALS = ("first", "second", "third", "fourth", "fifth")
"""The words that Xsens has for the fingers, from the thumb on."""


def _finger(finger: str, i: int) -> tuple[str, ...]:
    """Returns the known names of joint i of a finger. Joints are counted from 1 at the palm.

    In the names of Biped, fingers have numbers, counted from 0 at the thumb. Rokoko and MakeHuman
    count fingers from 1.
    """
    number = _FINGERS.index(finger)
    words = {"pinky": (finger, "little"), "middle": (finger, "mid")}.get(finger, (finger,))
    plain = [
        form
        for w in words
        for form in (f"hand{w}{i}", f"{w}{i}", f"{w}0{i}", f"f{w}0{i}", f"f{w}{i}", f"{w}finger{i}")
    ]
    bones = (("proximal", "pp"), ("intermediate", "medial", "mp"), ("distal", "dp"))
    if finger == "thumb":
        bones = (
            ("metacarpal", "proximal", "mc"),
            ("intermediate", "proximal", "pp"),
            ("distal", "dp"),
        )
    words = (*words, f"finger{number + 1}", _ORDINALS[number])
    plain += [w + bone for w in words for bone in bones[i - 1]]
    plain += [f"finger{number}{i - 1 or ''}", f"finger{number + 1}{FINGER_JOINT}{i}"]
    # some fingers have numbers from the second joint on
    return (*plain, finger) if i == 1 else tuple(plain)


SIDED = {
    "hip": (
        "upleg",
        "upperleg",
        "upperleg01",
        "thigh",
        "thighbend",
        "hip",
        "femur",
        "legupper",
        "leg",
    ),
    "knee": (
        *(
            "leg",
            "shin",
            "lowleg",
            "loleg",
            "lowerleg",
            "lowerleg01",
            "calf",
            "knee",
            "shinbend",
            "tibia",
        ),
        "leglower",
    ),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "toe0", "ball", "foot"),
    "shoulder": (
        "arm",
        "uparm",
        "upperarm",
        "upperarm01",
        "shldr",
        "shldrbend",
        "humerus",
        "armupper",
        "shoulder",
    ),
    "collar": ("collar", "clavicle", "clav", "scapula", "shoulder"),
    "elbow": (
        *(
            "forearm",
            "lowarm",
            "loarm",
            "lowerarm",
            "lowerarm01",
            "elbow",
            "forearmbend",
            "armlower",
        ),
        "radius",
    ),
    "wrist": ("hand", "wrist"),
    "eye": ("eye",),
    **{f"{finger}{i}": _finger(finger, i) for finger in FINGERS for i in (1, 2, 3)},
}
"""For each of our joints that has a side, its names in other programs: CMU (cgspeed), Mixamo,
LaFAN, MotionBuilder, Biovision, Biped, SMPL, Unreal, Unity, VRM, Bandai-Namco, Xsens, SOMA, Rigify,
Daz, Advanced Skeleton, Rokoko, Poser, MakeHuman. Names are without the side, and have lower-case
letters and digits only. Each joint of the file is used once, for the first of our joints that it
fits. So "shoulder" is the upper arm if no better name of the upper arm is there, else the collar.
"""
MIDDLE = {
    "pelvis": ("hips", "hip", "pelvis"),
    "neck": ("neck", "neck1", "neck01", "necklower"),
    "head": ("head",),
    "jaw": ("jaw",),
}
NOISE = (
    *(
        "j",
        "c",
        "m",
        "bip",
        "bip01",
        "bip001",
        "bip1",
        "biped",
        "def",
        "org",
        "jnt",
        "joint",
        "bind",
        "bone",
        "skin",
        "sk",
    ),
    *("ctrl", "rig", "armature", "character", "valvebiped", "avatar"),
)
"""Words in names that say nothing about the joint."""
ENDS = ("end", "nub", "top", "tip", "site")
"""Endings of the names that ends of bones have."""
UNDER = (
    ("hip", "knee"),
    ("knee", "ankle"),
    ("ankle", "foot"),
    ("shoulder", "elbow"),
    ("elbow", "wrist"),
)
"""Pairs of joints. The second joint of a pair must hang below the first."""
LIKE = 0.15
"""Largest difference between the bones of two limbs that are a pair, as a share of the longest of
these bones.
"""
SIDES = ("left", "right")
_CHAINS = (
    ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
    *(
        chain
        for side in SIDES
        for chain in (
            tuple(f"{side}_{name}" for name in ("collar", "shoulder", "elbow", "wrist", "middle1")),
            tuple(f"{side}_{name}" for name in ("hip", "knee", "ankle", "foot")),
            *(tuple(f"{side}_{finger}{i}" for i in (1, 2, 3)) for finger in FINGERS),
        )
    ),
)
"""Chains of joints. A bone goes from a joint to the next joint of its chain that the file has.

For a joint in several chains the last chain counts. A joint without a bone turns as the file's
joint does. A joint that the file lacks moves as its parent does.
"""
NEXT = {name: chain[i + 1 :] for chain in _CHAINS for i, name in enumerate(chain)}
NEEDED = (
    "pelvis",
    *(f"{s}_{n}" for n in ("hip", "knee", "ankle", "shoulder", "elbow") for s in SIDES),
)
TOPS = ("spine3", "neck", "left_shoulder")
"""Joints where the trunk may end; the first one that the file has is used."""
FEET = tuple(tuple(f"{side}_{name}" for side in SIDES) for name in ("ankle", "foot"))
"""Joints that may touch the floor: one pair (left, right) for each kind of joint."""
EXPECTED_NAMES = (
    "expected the names of CMU, Mixamo, Unity or another known program, or two legs and two arms of"
    " a person"
)
FEW = 5
"""A beginning that all names share is removed if there are at least this many names."""

# Decisions
# --------------------------------------------------------------------------------------------------

STANDING = -0.5
"""People can stand in a rest pose if the cosine of the angle between legs and spine is less than
this.
"""
BETTER_TILT = np.radians(10)
"""In some files the hips hang on joints other than the pelvis. These joints give the rotation of
the pelvis if they agree better with the trunk: their mean angle to the trunk has to be smaller than
the pelvis's mean angle by more than this, radians.
"""
LARGEST_BEND = np.radians(60)
"""Largest mean angle between pelvis and lowest spine over the frames, radians. If the angle is
larger, the pelvis's joint does not turn as a pelvis does.
"""
RATE_ROUNDING = 1e-4
"""Largest relative error of a frame rate in a file. Some BVH files give the time of a frame in only
four digits.
"""

SHORT_STEPS = 0.1
"""If at least this share of the steps between keys of a GLB file is shorter than a frame at the
mean rate of the keys, a higher rate is taken. See `frame_times`.
"""
FRAMES_A_KEY = 16
"""Largest factor by which this higher rate exceeds the mean rate of the keys."""

FLOOR_BAND = 0.05
"""The lowest joint is at its usual height if it is within this distance of the median height of the
lowest joint, metres.
"""
STILL = (0.1, 0.3)
"""Two limits of the speed of a joint that rests on the floor. The first is in metres per second.
The second is a share of the mean speed of all joints. The larger limit counts.
"""
ON_THE_FLOOR = 0.5
"""An axis clearly has a floor below if two things hold. The lowest joint rests there in at least
this share of the frames. The share of the other axis is below this number and at most half as
large.
"""
TREADMILL = 0.8
"""If nothing rests on a floor along either axis, the unusual axis has a floor if the lowest joint
is at one height in at least this share of the frames.
"""
MOST_FRAMES = 1000
"""Largest number of pairs of successive frames, evenly spread, in which a floor is looked for."""
HANDS = tuple(
    i for i, name in enumerate(JOINT_NAMES) if any(x in name for x in ("elbow", "wrist", *FINGERS))
)
"""Indices of the joints on which an upside-down person may stand."""


# Frames of animations
# --------------------------------------------------------------------------------------------------


def frame_times(keys: Sequence[Float[np.ndarray, " _"]]) -> tuple[np.ndarray, float] | None:
    """Returns evenly spaced times of frames (m,), seconds, and their rate in frames per second.

    The rate is the mean rate of the track with most keys. Optimizers leave out keys that lie on a
    line between others, and animators set few keys. So if at least the share `SHORT_STEPS` of the
    steps between keys is shorter than a frame at that rate, the rate becomes that of the short
    steps, but at most `FRAMES_A_KEY` times as high.

    If no track has two keys, or if all keys have the same time, the result is the earliest time and
    `DEFAULT_FPS`. The result is None if there would be more than four frames, at the mean rate, for
    each key of the track with most keys. The tracks then have very different lengths. keys:
    increasing times of the keys of each track, seconds.
    """
    first, last = min(each[0] for each in keys), max(each[-1] for each in keys)
    dense = max(keys, key=len)
    if len(dense) < 2 or not last > first:
        return np.asarray([first]), DEFAULT_FPS
    fps = (len(dense) - 1) / float(dense[-1] - dense[0])
    if round((last - first) * fps) + 1 > 4 * len(dense):
        return None
    steps = np.concatenate([np.diff(each) for each in keys])
    shortest = float(np.quantile(steps, SHORT_STEPS, method="lower"))
    if shortest * fps < 0.99:
        fps = max(fps, min(1 / shortest, FRAMES_A_KEY * fps))
        # times are rounded to float32
        if abs(fps - round(fps)) < 0.01 * fps:
            fps = float(round(fps))
    return first + np.arange(round((last - first) * fps) + 1) / fps, fps


# Which way is up
# --------------------------------------------------------------------------------------------------


def sampled_frames(count: int) -> np.ndarray:
    """Returns indices of frames in which a floor is looked for, such as 0, 1, 40, 41, ...

    They are evenly spread pairs of a frame and the next one, at most `MOST_FRAMES` pairs.
    """
    first = np.unique(
        np.linspace(0, max(count - 2, 0), min(max(count - 1, 1), MOST_FRAMES)).astype(int)
    )
    return np.minimum(np.stack([first, first + 1], axis=1), count - 1).reshape(-1)


def up_axis(
    points: Float[np.ndarray, "n k 3"],
    stands: str | None,
    usual: str,
    fps: float,
    also: tuple[str, ...] = (),
) -> tuple[str, str]:
    """Returns the axis that is up, and a note about it, or "" if there is nothing to note.

    The axis is the usual one of the format, with two exceptions. In the first, the person stands
    along another axis, and only this axis has a floor below: the lowest joint stays at one height
    and rests there. The trunks of people who lie, crawl or are upside down also point along another
    axis, but these people rest on no floor below it. In the second, the person stands along an axis
    in `also`, no clear floor below the usual axis contradicts this, and the person is not upside
    down on the hands.

    points: joints in space, (n, k, 3), metres, in the frames of `sampled_frames`. stands: the axis
    along which the person stands on average; None: there is none. usual: the axis of the format.
    fps: frames per second of the motion. also: further axes that are up in some files of the
    format.
    """
    if stands is None or stands == usual:
        return usual, ""
    # the floor decides where it speaks clearly
    here, there = _floors(points, (usual, stands), fps)
    if here < ON_THE_FLOOR <= there and here <= 0.5 * there:
        usually = f"{stands} is up, not {usual} as usual in such files"
        return stands, f"{usually}: people stand and step on a floor below it"
    # else the axis along which people stand, unless they are on their hands
    contradicted = there < ON_THE_FLOOR <= here and there <= 0.5 * here
    opposite = stands.lstrip("-") == usual.lstrip("-")
    lowest = (points[::2] @ upright_matrix(usual)[1]).argmin(axis=1)
    on_hands = float(np.isin(lowest, HANDS).mean()) > 0.5
    if stands in also and not contradicted and not (opposite and on_hands):
        return stands, f"{stands} is up, not {usual}: people stand along it"
    if contradicted or opposite:
        return usual, ""
    lying = f"{usual} is up, as usual in such files, and people lie along {stands}"
    return usual, f"{lying}; if they should stand: --motion-up={stands} (in Python up={stands!r})"


def _floors(
    points: Float[np.ndarray, "pairs s 3"], axes: Sequence[str], fps: float | int
) -> list[float]:
    """Returns the shares of frames in which the lowest joint is on a floor, for the usual axis and
    for another axis.

    The lowest joint has to rest at its usual height. If it rests in less than the share
    `ON_THE_FLOOR` of the frames for both axes, as on a treadmill, it only has to be at this height.
    A share of the other axis that is below `TREADMILL` then becomes 0. points: as in `up_axis`.
    axes: the usual and the other axis.
    """
    moves = np.linalg.norm(points[1::2] - points[::2], axis=-1) * fps
    limit = max(STILL[0], STILL[1] * float(moves.mean()))
    level, resting = [], []
    for axis in axes:
        heights = points[::2] @ upright_matrix(axis)[1]
        lowest, least = heights.argmin(axis=1), heights.min(axis=1)
        level.append(np.abs(least - np.median(least)) <= FLOOR_BAND)
        resting.append(level[-1] & (moves[np.arange(len(moves)), lowest] <= limit))
    rests, stays = ([float(x.mean()) for x in shares] for shares in (resting, level))
    # on a treadmill nothing rests
    if max(rests) >= ON_THE_FLOOR:
        return rests
    return [stays[0], stays[1] if stays[1] >= TREADMILL else 0.0]


def joint_places(
    joints: Float[np.ndarray, "j 3"],
    rotations: Float[np.ndarray, "m j 3"],
    translations: Float[np.ndarray, "m 3"],
) -> Float[np.ndarray, "m j 3"]:
    """Returns the places of the joints of a body in motion, (m, j, 3), metres. The body has
    SMPL-X's joints. joints: joints at rest, (j, 3), metres. rotations: axis-angles, (m, j, 3),
    radians. translations: (m, 3), metres.
    """
    turns = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix()
    turns = turns.reshape(*rotations.shape, 3)
    bones = np.broadcast_to(bones_of(joints, PARENTS), rotations.shape)
    return posed_tree(turns, bones, PARENTS)[1] + translations[:, None]


def page_rules() -> dict[str, Any]:
    """Returns the tables of this module and of the formats, as the page gets them in JSON."""
    names = """BODY_NUMBERS HAND_NUMBERS MILLIMETRES SIDED MIDDLE NOISE ENDS UNDER LIKE SIDES NEXT
    FINGER_JOINT NEEDED TOPS FEET EXPECTED_NAMES FEW STANDING BETTER_TILT LARGEST_BEND RATE_ROUNDING
    SHORT_STEPS FRAMES_A_KEY FAR ASSUMED_FOCAL NEARER
    FLOOR_BAND STILL ON_THE_FLOOR TREADMILL MOST_FRAMES HANDS ORTHONORMAL NO_RATE NO_PLACES"""
    rules = {name: globals()[name] for name in names.split()}
    rules |= {"CAMERA_MOVES": CAMERA_MOVES}
    rules |= {"DEFAULT_FPS": DEFAULT_FPS, "PLACES": PLACES, "LARGEST_DISTANCE": LARGEST_DISTANCE}
    rules |= {"UPRIGHT": UPRIGHT, "CLEARLY_UP": CLEARLY_UP}
    formats = [
        dataclasses.asdict(each.arrays)
        for each in MOTIONS.values()
        if each.arrays is not None and each.arrays.page
    ]
    return rules | {"PELVIS": PELVIS.tolist(), "COLUMNS": list(COLUMNS), "FORMATS": formats}
