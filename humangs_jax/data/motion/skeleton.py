"""Skeletons of other programs in motion, brought to our joints: BVH and glTF.

Bones point where the file's bones point. Every joint of ours has a rotation A_j from our rest frame to the file's. It turns our
bone into the file's bone of the rest pose, and is the smallest such turn after that of the parent. With D_j(t) the rotation of
the file's joint j from its rest pose to frame t, in the world, ours is

    G_j(t) = D_j(t) A_j,    R_j = G_parent(j)^T G_j.

Twists about a bone are therefore relative to the file's rest pose. Where nobody can stand like that (in LaFAN's files all offsets
lie along one axis, the legs folded onto the spine), the smallest turn says nothing about twists. A_j is then turned about the
bone so that the twist of R_j is 0 on average over the frames.

Steps become as much longer as the legs are. Feet stay where the file's are: the pelvis moves up or down so that the lower foot is
as high above the floor as in the file, whatever the shares of thighs, shins and hips in the legs. The page does the same
(viewer/page/motion_files.js).
"""

import dataclasses
import functools
import re
from importlib import resources

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import FINGERS, JOINT_NAMES, PARENTS
from humangs_jax.body.library import read_body
from humangs_jax.core.array_types import Float
from humangs_jax.data.motion.world import nearest_axis, upright_matrix
from humangs_jax.io.reading import Refused

_SIDED = {
    "hip": ("upleg", "thigh", "hip"),
    "knee": ("leg", "shin", "lowleg", "lowerleg", "calf", "knee"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "ball", "foot"),
    "shoulder": ("arm", "uparm", "upperarm", "shldr", "shoulder"),
    "collar": ("collar", "clavicle", "shoulder"),
    "elbow": ("forearm", "lowarm", "lowerarm", "elbow"),
    "wrist": ("hand", "wrist"),
    "eye": ("eye",),
    **{f"{finger}{i}": (f"hand{finger}{i}", f"{finger}{i}", f"{finger}0{i}") for finger in FINGERS for i in (1, 2, 3)},
}
"""Joints with a side by the names of others, without it, lower case, letters and digits alone: CMU (cgspeed), Mixamo, LaFAN,
MotionBuilder, Biovision, SMPL, Unreal. A joint of the file is taken once, by the first that wants it: "shoulder" is the upper arm
where there is no other and else the collar bone."""
_MIDDLE = {
    **{"pelvis": ("hips", "hip", "pelvis", "root"), "neck": ("neck", "neck1", "neck01")},
    **{"head": ("head",), "jaw": ("jaw",)},
}
_CHAINS = (
    ("pelvis", "spine1", "spine2", "spine3", "neck", "head"),
    *(
        chain
        for side in ("left", "right")
        for chain in (
            tuple(f"{side}_{name}" for name in ("collar", "shoulder", "elbow", "wrist", "middle1")),
            tuple(f"{side}_{name}" for name in ("hip", "knee", "ankle", "foot")),
            *(tuple(f"{side}_{finger}{i}" for i in (1, 2, 3)) for finger in FINGERS),
        )
    ),
)
"""Bones: each joint points to the next of its last chain that the file has. Others are moved as their parents are."""
_NEXT = {name: chain[i + 1 :] for chain in _CHAINS for i, name in enumerate(chain)}
_NEEDED = ("pelvis", *(f"{s}_{n}" for n in ("hip", "knee", "ankle", "shoulder", "elbow") for s in ("left", "right")))
STANDING = -0.5
"""Cosine between legs and spine below which a person can stand in a rest pose."""
RATE_ROUNDING = 1e-4
"""Relative error of a frame rate: BVH files have as few as four digits of the time of a frame."""
FEW = 5
"""Joints that have to share the beginning of their names for it to be no part of them."""


@dataclasses.dataclass(frozen=True)
class Clip:
    """A skeleton in motion, in the units and the world of its file.

    names: of its s joints. parents: -1 for roots; parents come first. rest: (s, 3) places in the rest pose. turns: (m, s, 3, 3)
    rotation of each joint from the rest pose to the frame, in the world. places: (m, s, 3). fps: frames per second. up: the axis
    that the format says is up; None: the rest pose tells.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    rest: Float[np.ndarray, "s 3"]
    turns: Float[np.ndarray, "m s 3 3"]
    places: Float[np.ndarray, "m s 3"]
    fps: float
    up: str | None = None


def bytes_of_clip(frames: int, joints: int) -> int:
    """Memory that a clip takes."""
    return 96 * frames * joints


def whole_rate(fps: float) -> float:
    """Frames per second, a whole number where they are one up to the rounding of the file: BVH has 0.0083333 for 120."""
    return float(round(fps)) if abs(fps - round(fps)) < RATE_ROUNDING * fps else fps


@functools.cache
def shipped_joints() -> Float[np.ndarray, "j 3"]:
    """Joints of the shipped body in T-pose, mean shape, metres."""
    with resources.as_file(resources.files("humangs_jax") / "assets" / "makehuman.npz") as file:
        body = read_body(file)
    return np.asarray(body.joint_regressor, np.float64) @ np.asarray(body.template, np.float64)


def retargeted(
    clip: Clip, joints: Float[np.ndarray, "j 3"], up: str = "auto"
) -> tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"]]:
    """Rotations (axis-angle) and translations of a body of SMPL-X's joints that moves as the clip.

    Arguments: joints: of the body in T-pose, metres. up: as in `load_motion`.
    Raises: Refused if joints of the clip that are needed have no name we know, or the body is no body of SMPL-X's joints.
    """
    if joints.shape != (len(JOINT_NAMES), 3):
        raise Refused(f"skeletons are brought to bodies of {len(JOINT_NAMES)} joints, this one has {len(joints)}")
    source = _matched(clip)
    if missing := [name for name in _NEEDED if name not in source]:
        found = ", ".join(clip.names[:12])
        raise Refused(f"no joint for {', '.join(missing)}: expected the names of CMU, Mixamo or LaFAN, got {found}")
    standing = _stands(clip, source)
    if up == "auto":
        up = clip.up or (nearest_axis(_spine(clip, source))[0] if standing else "y")
    turn = upright_matrix(up)
    turns, places = turn @ clip.turns, clip.places @ turn.T
    world = _body_turns(clip, source, joints, turns, by_motion=not standing)
    rotations = np.stack(
        [_rotation(own if p < 0 else _transposed(world[p]) @ own) for p, own in zip(PARENTS, world, strict=True)],
        axis=1,
    )
    scale = _leg_length(joints, _INDEX) / max(_leg_length(places[0], source), 1e-9)
    moves = scale * places[:, source["pelvis"]]
    soles = _soles(clip, source, joints) if standing else None
    moves[:, 1] += _steps(scale * places[..., 1], source, soles) - _steps_of_body(world, joints, moves, source)
    return rotations, moves - joints[0]


_INDEX = {name: i for i, name in enumerate(JOINT_NAMES)}


# Names ------------------------------------------------------------------------------------------------------------------


def _matched(clip):
    """Index of the clip's joint for each joint of ours that it has."""
    names = [re.sub(r"^.*[:|]", "", name) for name in clip.names]
    names = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in names]
    prefix = _common_start(names) if len(names) >= FEW else 0
    names = [re.sub(r"^mixamorig\d*", "", name[prefix:]) for name in names]
    source: dict[str, int] = {}

    def find(ours, theirs):
        taken = set(source.values())
        for name in theirs:
            if name in names and (index := names.index(name)) not in taken:
                source[ours] = index
                return

    for ours, theirs in _MIDDLE.items():
        find(ours, theirs)
    for ours, theirs in _SIDED.items():
        for side in ("left", "right"):
            find(f"{side}_{ours}", [form for x in theirs for form in (side + x, side[0] + x, x + side[0])])
    _match_spine(clip, source)
    return source


def _common_start(names):
    """How many first letters are the same in all names."""
    return next((i for i, letters in enumerate(zip(*names, strict=False)) if len(set(letters)) > 1), 0)


def _match_spine(clip, source):
    """Spines have one to five joints, called differently everywhere: ours are the first, middle and last of the file's."""
    chain = []
    at = clip.parents[source["neck"]] if "neck" in source else clip.parents[source["head"]] if "head" in source else -1
    while at >= 0 and at != source.get("pelvis"):
        chain.insert(0, at)
        at = clip.parents[at]
    last = len(chain) - 1
    if at >= 0:
        ours = {"spine3": last, "spine1": 0 if last > 0 else -1, "spine2": last // 2 if last > 1 else -1}
        source.update({name: chain[i] for name, i in ours.items() if i >= 0})


# Rest poses -------------------------------------------------------------------------------------------------------------


def _top(source):
    return next(name for name in ("spine3", "neck", "left_shoulder") if name in source)


def _spine(clip, source):
    return _unit(clip.rest[source[_top(source)]] - clip.rest[source["pelvis"]])


def _stands(clip, source):
    legs = sum(clip.rest[source[f"{s}_ankle"]] - clip.rest[source[f"{s}_hip"]] for s in ("left", "right"))
    return float(_unit(legs) @ _spine(clip, source)) < STANDING


def _body_turns(clip, source, joints, turns, by_motion):
    """G_j (m, 3, 3) of our joints in the world."""
    frames_of, world = [], []
    for j, (name, parent) in enumerate(zip(JOINT_NAMES, PARENTS, strict=True)):
        align = _pelvis_frame(clip, source, joints) if parent < 0 else frames_of[parent]
        child = next((other for other in _NEXT.get(name, ()) if other in source), None)
        if parent >= 0 and name in source and child is not None:
            bone = _unit(joints[_INDEX[child]] - joints[j])
            align = _smallest_turn(align @ bone, _unit(clip.rest[source[child]] - clip.rest[source[name]])) @ align
            if by_motion:
                align = align @ _untwist(_transposed(world[parent]) @ turns[:, source[name]] @ align, bone)
        frames_of.append(align)
        world.append(turns[:, source[name]] @ align if name in source else world[parent])
    return world


def _pelvis_frame(clip, source, joints):
    """From our rest frame to the file's, by the line of the hips and the direction of the spine."""
    theirs = clip.rest[source["left_hip"]] - clip.rest[source["right_hip"]]
    top = joints[_INDEX[_top(source)]] - joints[0]
    ours = _frame(joints[_INDEX["left_hip"]] - joints[_INDEX["right_hip"]], top)
    return _frame(theirs, _spine(clip, source)) @ ours.T


def _frame(right, up):
    x = _unit(right)
    z = _unit(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=1)


def _smallest_turn(a, b):
    """The rotation matrix that turns the unit vector a into b by the smallest angle; none where b is zero."""
    cosine = float(a @ b)
    if cosine < -0.999999:
        side = _unit(np.cross(a, [1.0, 0, 0] if abs(a[0]) < 0.9 else [0, 1.0, 0]))
        return 2 * np.outer(side, side) - np.eye(3)
    return Rotation.from_quat([*np.cross(a, b), 1 + cosine]).as_matrix()


def _untwist(turns, bone):
    """The rotation about a bone that takes the mean twist about it out of rotations (m, 3, 3).

    The twist of a quaternion (w, v) about b is 2 arg(w + i v.b); the square has no sign and weighs those less that swing far.
    """
    q = Rotation.from_matrix(turns).as_quat()
    twist = np.angle(np.sum((q[:, 3] + 1j * (q[:, :3] @ bone)) ** 2))
    return Rotation.from_rotvec(-twist * bone).as_matrix()


# Steps and the floor ----------------------------------------------------------------------------------------------------


def _leg_length(places, index):
    bones = (("left_hip", "left_knee"), ("left_knee", "left_ankle"))
    return sum(float(np.linalg.norm(places[index[b]] - places[index[a]])) for a, b in bones)


def _feet(source):
    """Our names of the joints that may touch the floor: of both sides by kind."""
    kinds = [[f"{side}_{name}" for side in ("left", "right")] for name in ("ankle", "foot")]
    return [found for kind in kinds if (found := [name for name in kind if name in source])]


def _soles(clip, source, joints):
    """How high the joints of the file's feet are above the lowest of them in a rest pose that stands, in our metres."""
    axis, _ = nearest_axis(_spine(clip, source))
    scale = _leg_length(joints, _INDEX) / max(_leg_length(clip.rest, source), 1e-9)
    heights = scale * clip.rest @ upright_matrix(axis)[1]
    found = {name: heights[source[name]] for kind in _feet(source) for name in kind}
    return {name: height - min(found.values()) for name, height in found.items()}


def _steps(heights, source, soles):
    """(m,) how high the feet are above the floor, which is where they are lowest.

    soles: of each joint of the feet, how high it is when the foot stands; None: each kind as high as in its lowest frame.
    """
    if soles is None:
        lowest = [(kind, heights[:, [source[name] for name in kind]].min()) for kind in _feet(source)]
        soles = {name: low for kind, low in lowest for name in kind}
    feet = np.min([heights[:, source[name]] - sole for name, sole in soles.items()], axis=0)
    return feet - feet.min()


def _steps_of_body(world, joints, moves, source):
    """(m,) the same of our body, above a floor at the height of its lowest joint in T-pose."""
    places = {0: moves}

    def place(j):
        if j not in places:
            p = PARENTS[j]
            places[j] = place(p) + world[p] @ (joints[j] - joints[p])
        return places[j]

    feet = [_INDEX[name] for kind in _feet(source) for name in kind]
    return np.min([place(j)[:, 1] - (joints[j, 1] - joints[feet, 1].min()) for j in feet], axis=0)


def _unit(vector):
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _transposed(matrices):
    return np.swapaxes(matrices, -1, -2)


def _rotation(matrices):
    return Rotation.from_matrix(matrices).as_rotvec()
