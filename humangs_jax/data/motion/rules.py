"""What the readers of motions know about files, as tables: keys of arrays, names of joints, axes, limits of decisions.

The page reads motions too. `page_rules` is put into it when it is assembled (viewer/page.py); it has no tables of its own.
"""

import dataclasses
from typing import Any

import numpy as np

from humangs_jax.body.joints import BODY_NAMES, FINGERS, JOINT_NAMES
from humangs_jax.data.capture_checks import LARGEST_DISTANCE

DEFAULT_FPS = 30.0

# Files of arrays --------------------------------------------------------------------------------------------------------

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
_AMASS_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_MOVES = ("trans", "transl")


@dataclasses.dataclass(frozen=True)
class Format:
    """One kind of files of arrays.

    kind: ours, whole (all joints under one key), scaled (whole, translations in other units) or parts. keys: a file that has all
    of them is of this format. poses: of a whole pose; of parts the root, the body, three of the face, two of the hands. moves,
    rates: the first that is there. fps: frames per second without any, None: there must be one. up: the axis that is up in
    files of this format. fixed: whatever the poses look like. also: other axes that are up in some of them, see
    `world.up_axis`. scaling: the key of what translations are divided by, 1000 without it.
    """

    kind: str
    keys: tuple[str, ...]
    poses: tuple[str, ...]
    moves: tuple[str, ...]
    rates: tuple[str, ...]
    fps: float | None
    up: str
    fixed: bool = False
    also: tuple[str, ...] = ()
    scaling: str | None = None


def _whole(key: str, up: str, also: tuple[str, ...] = (), with_key: tuple[str, ...] = ()) -> Format:
    return Format("whole", (key, *with_key), (key,), _MOVES, _AMASS_RATES, None, up, also=also)


_FACE = ("jaw_pose", "leye_pose", "reye_pose")
FORMATS = (
    Format("ours", ("rotations",), ("rotations",), ("translations",), ("fps",), None, "y", fixed=True),
    Format(  # AIST++
        *("scaled", ("smpl_poses",), ("smpl_poses",), ("smpl_trans",), ("fps",), 60.0, "y"),
        **{"fixed": True, "scaling": "smpl_scaling"},
    ),
    _whole("poses", "y", with_key=("expressions",)),  # BEAT2
    _whole("poses", "z"),  # AMASS
    Format(  # LHM
        *("parts", ("root_pose",), ("root_pose", "body_pose", *_FACE, "lhand_pose", "rhand_pose")),
        *(("trans",), (), DEFAULT_FPS, "y", False, ("-y",)),
    ),
    Format(  # THuman4.0, AvatarReX; estimators write it in the coordinates of a camera, whose y points down
        *("parts", ("body_pose",), ("global_orient", "body_pose", *_FACE, "left_hand_pose", "right_hand_pose")),
        *(("transl",), ("fps", *_AMASS_RATES), DEFAULT_FPS, "y", False, ("-y",)),
    ),
    _whole("fullpose", "z"),
    _whole("pose", "z", also=("y", "-y")),
)
"""The first that fits a file is used."""

# Names of joints --------------------------------------------------------------------------------------------------------

SIDED = {
    "hip": ("upleg", "thigh", "hip"),
    "knee": ("leg", "shin", "lowleg", "lowerleg", "calf", "knee"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toe0", "ball", "foot"),
    "shoulder": ("arm", "uparm", "upperarm", "shldr", "shoulder"),
    "collar": ("collar", "clavicle", "shoulder"),
    "elbow": ("forearm", "lowarm", "lowerarm", "elbow"),
    "wrist": ("hand", "wrist"),
    "eye": ("eye",),
    **{f"{finger}{i}": (f"hand{finger}{i}", f"{finger}{i}", f"{finger}0{i}") for finger in FINGERS for i in (1, 2, 3)},
}
"""Joints with a side by the names of others, without it, lower case, letters and digits alone: CMU (cgspeed), Mixamo, LaFAN,
MotionBuilder, Biovision, Biped, SMPL, Unreal. A joint of the file is taken once, by the first that wants it: "shoulder" is the
upper arm where there is no other and else the collar bone."""
MIDDLE = {
    **{"pelvis": ("hips", "hip", "pelvis", "root"), "neck": ("neck", "neck1", "neck01")},
    **{"head": ("head",), "jaw": ("jaw",)},
}
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
"""Bones: each joint points to the next of its last chain that the file has. Others are moved as their parents are."""
NEXT = {name: chain[i + 1 :] for chain in _CHAINS for i, name in enumerate(chain)}
NEEDED = ("pelvis", *(f"{s}_{n}" for n in ("hip", "knee", "ankle", "shoulder", "elbow") for s in SIDES))
TOPS = ("spine3", "neck", "left_shoulder")
"""Where the trunk ends: the first that the file has."""
FEET = tuple(tuple(f"{side}_{name}" for side in SIDES) for name in ("ankle", "foot"))
"""Joints that may touch the floor, of both sides by kind."""
EXPECTED_NAMES = "expected the names of CMU, Mixamo or LaFAN"
FEW = 5
"""Joints that have to share the beginning of their names for it to be no part of them."""

# Decisions --------------------------------------------------------------------------------------------------------------

STANDING = -0.5
"""Cosine between legs and spine below which a person can stand in a rest pose."""
BETTER_TILT = np.radians(10)
"""How much better the joints that carry the hips must agree with the trunk than the pelvis's own, on average, to stand for it."""
LARGEST_BEND = np.radians(60)
"""Between pelvis and lowest spine, on average over the frames: beyond it the pelvis's rotation is not that of a pelvis."""
RATE_ROUNDING = 1e-4
"""Relative error of a frame rate: BVH files have as few as four digits of the time of a frame."""

PELVIS = np.array([0.0, -0.35, 0.0])
"""Where SMPL-X's root joint (and the shipped body's) is in T-pose, metres: worlds are turned about it. Other
bodies are off by a constant, which `grounded` removes."""
UPRIGHT = {
    "y": (1.0, 0.0, 0.0, 0.0),
    "-y": (0.0, 1.0, 0.0, 0.0),
    "z": (np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0),
    "-z": (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0),
    "x": (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)),
    "-x": (np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)),
}
"""The rotation (quaternion, wxyz) that turns the named axis to +y."""
CLEARLY_UP = 0.5
"""Mean cosine between a person's own up and an axis from which on the person stands along that axis."""
FLOOR_BAND = 0.05
"""Metres from the usual height of the lowest joint within which that joint is on the floor."""
STILL = (0.1, 0.3)
"""A joint rests on the floor if it moves by less than so many metres a second, or than this share of the joints' mean speed."""
ON_THE_FLOOR = 0.5
"""Share of the frames with a joint on the floor from which on an axis has a floor; another axis has none at less than half of
that axis's share."""
TREADMILL = 0.8
"""Share of the frames with the lowest joint at one height from which on another axis has a floor where nothing rests."""
MOST_FRAMES = 1000
"""Of a motion, evenly spread, that are asked for a floor."""
HANDS = tuple(i for i, name in enumerate(JOINT_NAMES) if any(x in name for x in ("elbow", "wrist", *FINGERS)))
"""Joints that carry a person who is upside down."""


def page_rules() -> dict[str, Any]:
    """All of it as JSON has it, for the page."""
    names = (
        *("DEFAULT_FPS", "BODY_NUMBERS", "HAND_NUMBERS", "MILLIMETRES", "SIDED", "MIDDLE", "SIDES"),
        *("NEXT", "NEEDED", "TOPS", "FEET", "EXPECTED_NAMES", "FEW", "STANDING", "BETTER_TILT", "LARGEST_BEND"),
        *(
            "RATE_ROUNDING",
            "UPRIGHT",
            "CLEARLY_UP",
            "FLOOR_BAND",
            "STILL",
            "ON_THE_FLOOR",
            "TREADMILL",
            "MOST_FRAMES",
            "HANDS",
        ),
    )
    rules = {name: globals()[name] for name in names}
    formats = [dataclasses.asdict(each) for each in FORMATS]
    rules["LARGEST_DISTANCE"] = LARGEST_DISTANCE
    return rules | {"PELVIS": PELVIS.tolist(), "COLUMNS": list(COLUMNS), "FORMATS": formats}
