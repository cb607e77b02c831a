"""What the readers of motions know beside `data.formats`, as tables: names of joints, axes, limits
of decisions; and which way is up in the world of a motion.

The page reads motions too. `page_rules` is put into it when it is assembled (viewer/page.py); it
has no other tables.
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
from humangs_jax.data.formats import MOTIONS, PLACES
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
"""Numbers of a pose, by whose joints they are."""
MILLIMETRES = 1000.0
ORTHONORMAL = 0.05
"""R R^T of a rotation matrix in a file is this near to 1."""
NO_RATE = "the file says no frames per second: taken for {:g}"
NO_PLACES = "the file has no positions ({}): people stay in place"

# Names of joints
# --------------------------------------------------------------------------------------------------


def _finger(finger: str, i: int) -> tuple[str, ...]:
    """Names of the i-th joint of a finger, from 1 at the palm; Biped counts fingers from the
    thumb.
    """
    number = ("thumb", "index", "middle", "ring", "pinky").index(finger)
    words = (finger, "little") if finger == "pinky" else (finger,)
    plain = [
        form
        for w in words
        for form in (f"hand{w}{i}", f"{w}{i}", f"{w}0{i}", f"f{w}0{i}", f"f{w}{i}", f"{w}finger{i}")
    ]
    bones = (("proximal",), ("intermediate",), ("distal",))
    if finger == "thumb":
        bones = (("metacarpal", "proximal"), ("intermediate", "proximal"), ("distal",))
    plain += [w + bone for w in words for bone in bones[i - 1]]
    return (*plain, f"finger{number}{i - 1 or ''}")


SIDED = {
    "hip": ("upleg", "upperleg", "thigh", "thighbend", "hip", "femur", "legupper", "leg"),
    "knee": ("leg", "shin", "lowleg", "lowerleg", "calf", "knee", "shinbend", "tibia", "leglower"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "toe0", "ball", "foot"),
    "shoulder": (
        "arm",
        "uparm",
        "upperarm",
        "shldr",
        "shldrbend",
        "humerus",
        "armupper",
        "shoulder",
    ),
    "collar": ("collar", "clavicle", "scapula", "shoulder"),
    "elbow": ("forearm", "lowarm", "lowerarm", "elbow", "forearmbend", "armlower"),
    "wrist": ("hand", "wrist"),
    "eye": ("eye",),
    **{f"{finger}{i}": _finger(finger, i) for finger in FINGERS for i in (1, 2, 3)},
}
"""Joints with a side by the names of others, without it, lower case, letters and digits alone: CMU
(cgspeed), Mixamo, LaFAN, MotionBuilder, Biovision, Biped, SMPL, Unreal, Unity, VRM, Bandai-Namco,
Xsens, SOMA, Rigify, Daz, Advanced Skeleton. A joint of the file is taken once, by the first that
wants it: "shoulder" is the upper arm where there is no other, else the collar."""
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
"""Words in names that say nothing of the joint."""
ENDS = ("end", "nub", "top", "tip", "site")
"""How names of the ends of bones end."""
UNDER = (
    ("hip", "knee"),
    ("knee", "ankle"),
    ("ankle", "foot"),
    ("shoulder", "elbow"),
    ("elbow", "wrist"),
)
"""Which joints hang below which."""
LIKE = 0.15
"""Share by which the bones of two limbs may differ."""
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
"""Bones: each joint points to the next of its last chain that the file has.

Others are moved as their parents are.
"""
NEXT = {name: chain[i + 1 :] for chain in _CHAINS for i, name in enumerate(chain)}
NEEDED = (
    "pelvis",
    *(f"{s}_{n}" for n in ("hip", "knee", "ankle", "shoulder", "elbow") for s in SIDES),
)
TOPS = ("spine3", "neck", "left_shoulder")
"""Where the trunk ends: the first that the file has."""
FEET = tuple(tuple(f"{side}_{name}" for side in SIDES) for name in ("ankle", "foot"))
"""Joints that may touch the floor, of both sides by kind."""
EXPECTED_NAMES = (
    "expected the names of CMU, Mixamo, Unity or another known program, or two legs and two arms of"
    " a person"
)
FEW = 5
"""Joints that have to share the beginning of their names for it to be no part of them."""

# Decisions
# --------------------------------------------------------------------------------------------------

STANDING = -0.5
"""Cosine between legs and spine below which a person can stand in a rest pose."""
BETTER_TILT = np.radians(10)
"""How much better the joints that carry the hips must agree with the trunk than the pelvis's own,
on average, to stand for it.
"""
LARGEST_BEND = np.radians(60)
"""Between pelvis and lowest spine, on average over the frames: beyond it the pelvis's rotation is
not that of a pelvis.
"""
RATE_ROUNDING = 1e-4
"""Relative error of a frame rate: BVH files have as few as four digits of the time of a frame."""

FLOOR_BAND = 0.05
"""Metres from the usual height of the lowest joint within which that joint is on the floor."""
STILL = (0.1, 0.3)
"""A joint rests on the floor if it moves by less than this many metres a second, or than this share
of the joints' mean speed.
"""
ON_THE_FLOOR = 0.5
"""Share of the frames with a joint on the floor from which on an axis has a floor; another axis has
none at less than half of that axis's share."""
TREADMILL = 0.8
"""Share of the frames with the lowest joint at one height from which on another axis has a floor
where nothing rests.
"""
MOST_FRAMES = 1000
"""Of a motion, evenly spread, that are asked for a floor."""
HANDS = tuple(
    i for i, name in enumerate(JOINT_NAMES) if any(x in name for x in ("elbow", "wrist", *FINGERS))
)
"""Joints that carry a person who is upside down."""


# Which way is up
# --------------------------------------------------------------------------------------------------


def sampled_frames(count: int) -> np.ndarray:
    """Frames that are asked for a floor, evenly spread, each followed by its next: 0, 1, 40, 41,
    ...
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
    """Gives the axis that is up, and a note about it ("": none).

    It is the usual one of the format. Another has to be the one along which the person stands, and
    the floor must agree: things rest on a floor, so that the lowest joint stays at one height and
    still. Lying, crawling and upside-down people stand along other axes, but rest on no floor
    there.

    Arguments: points: joints in space, metres, pairs of frames as `sampled_frames` has them.
    stands: the axis along which the person stands on average, if any. usual: the format's. also:
    axes that are up in other files of the format; they are believed unless the floor contradicts.
    Someone who is upside down on the hands stands on them.
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
    """Share of the frames in which something is on the floor, for the usual axis and for another,
    which has to be surer.
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
    """Joints in space of a body of SMPL-X's joints."""
    turns = Rotation.from_rotvec(rotations.reshape(-1, 3)).as_matrix()
    turns = turns.reshape(*rotations.shape, 3)
    bones = np.broadcast_to(bones_of(joints, PARENTS), rotations.shape)
    return posed_tree(turns, bones, PARENTS)[1] + translations[:, None]


def page_rules() -> dict[str, Any]:
    """All of it as JSON has it, for the page."""
    names = """BODY_NUMBERS HAND_NUMBERS MILLIMETRES SIDED MIDDLE NOISE ENDS UNDER LIKE SIDES NEXT
    NEEDED TOPS FEET EXPECTED_NAMES FEW STANDING BETTER_TILT LARGEST_BEND RATE_ROUNDING
    FLOOR_BAND STILL ON_THE_FLOOR TREADMILL MOST_FRAMES HANDS ORTHONORMAL NO_RATE NO_PLACES"""
    rules = {name: globals()[name] for name in names.split()}
    rules |= {"DEFAULT_FPS": DEFAULT_FPS, "PLACES": PLACES, "LARGEST_DISTANCE": LARGEST_DISTANCE}
    rules |= {"UPRIGHT": UPRIGHT, "CLEARLY_UP": CLEARLY_UP}
    formats = [
        dataclasses.asdict(each.arrays)
        for each in MOTIONS.values()
        if each.arrays is not None and each.arrays.page
    ]
    return rules | {"PELVIS": PELVIS.tolist(), "COLUMNS": list(COLUMNS), "FORMATS": formats}
