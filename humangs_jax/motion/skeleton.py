"""Converts moving skeletons of other programs, from BVH and glTF files, to our joints.

Bones point where the file's bones point. Every joint of ours has a rotation A_j from our rest pose
to the file's rest pose. A_j is the rotation A of the parent, followed by the smallest turn that
makes our bone point as the file's bone does. D_j(t) is the rotation of the file's joint j from its
rest pose to frame t, in the world. Then the rotation of our joint in the world, G_j, and relative
to the parent, R_j, are

    G_j(t) = C_j(t) D_j(t) A_j,    R_j = G_parent(j)^T G_j.

C_j(t) is the smallest turn that makes the bone point where the file's bone points in the frame. It
is the identity if the file's child hangs on the joint itself, but some files have further joints in
between. The pelvis has no bone. It turns so that the line between the hips points as in the file,
and the trunk shows how far it turns about this line. This is needed because some files turn the
pelvis's joint by any rotation, and turn the joints that carry hips and spine back.

Twists about a bone are relative to the file's rest pose. If nobody can stand in that pose, the
smallest turn says nothing about twists. (In LaFAN's files all offsets lie along one axis, and the
legs are folded onto the spine.) A_j is then turned about the bone so that the twist of R_j is 0 on
average over the frames.

Steps are scaled by the ratio of the lengths of the legs. The pelvis moves up or down so that the
lower foot is as high above the floor as in the file, whatever the shares of thighs, shins and hips
in the legs. The page does the same (viewer/page/skeletons.js).
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from importlib import resources

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.library import read_body
from humangs_jax.core.array_types import Float
from humangs_jax.geometry.axes import CLEARLY_UP, nearest_axis, upright_matrix
from humangs_jax.geometry.mesh import smallest_turns, unit
from humangs_jax.io.reading import InvalidFileError
from humangs_jax.motion import rules
from humangs_jax.motion.face_tracks import FaceTrack
from humangs_jax.motion.matching import matched
from humangs_jax.motion.rules import sampled_frames, up_axis


@dataclasses.dataclass(frozen=True)
class Clip:
    """A skeleton in motion, in the units and the world of its file."""

    names: tuple[str, ...]
    """Names of the s joints."""
    parents: tuple[int, ...]
    """Index of the parent of each joint, -1 for roots; parents come first."""
    rest: Float[np.ndarray, "s 3"]
    """Places of the joints in the rest pose, (s, 3)."""
    turns: Float[np.ndarray, "m s 3 3"]
    """Rotation of each joint from the rest pose to the frame, in the world, (m, s, 3, 3)."""
    places: Float[np.ndarray, "m s 3"]
    """Places of the joints in each frame, (m, s, 3)."""
    fps: float
    """Frames per second."""
    up: str | None = None
    """The axis that is up in the format. None: it is found from the rest pose and the motion."""
    note: str = ""
    """Note for the user about the file, "" if there is none."""
    face: FaceTrack | None = None
    """The face track of the file, None without one."""


def bytes_of_clip(frames: int, joints: int) -> int:
    """Returns the approximate number of bytes that a clip with these numbers of frames and joints
    takes.
    """
    return 96 * frames * joints


def whole_rate(fps: float) -> float:
    """Returns a rate in frames per second. It is rounded to a whole number if it differs from this
    number by less than the share `rules.RATE_ROUNDING`.

    A BVH file has 0.0083333 seconds per frame for 120 frames per second.
    """
    if abs(fps - round(fps)) < rules.RATE_ROUNDING * fps:
        return float(round(fps))
    return fps


@functools.cache
def shipped_joints() -> Float[np.ndarray, "j 3"]:
    """Returns the joints (j, 3) of the shipped body in T-pose and mean shape, metres."""
    with resources.as_file(resources.files("humangs_jax") / "assets" / "makehuman.npz") as file:
        body = read_body(file)
    return np.asarray(body.joint_regressor, np.float64) @ np.asarray(body.template, np.float64)


def retargeted(
    clip: Clip, joints: Float[np.ndarray, "j 3"], up: str = "auto"
) -> tuple[Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"], str]:
    """Returns the motion that makes a body with SMPL-X's joints move like a clip.

    joints: joints of the body in T-pose, (55, 3), metres. up: as in `load_motion`.

    Returns: rotations (m, j, 3), axis-angle, radians; translations (m, 3), metres; and a note about
    the axis that is up, or "".

    Raises: InvalidFileError if joints that are needed are not found in the clip, or if the body
    does not have SMPL-X's 55 joints.
    """
    if joints.shape != (len(JOINT_NAMES), 3):
        raise InvalidFileError(
            f"skeletons are brought to bodies of {len(JOINT_NAMES)} joints, this one has"
            f" {len(joints)}"
        )
    source = matched(clip.names, clip.parents, clip.rest, clip.places[0])
    # whether the rest pose stands, how large the body is, and which axis is up
    standing, note = _stands(clip, source), ""
    scale = _leg_length(joints, _INDEX) / max(_leg_length(clip.places[0], source), 1e-9)
    if up == "auto":
        if clip.up:
            up, note = clip.up, ""
        else:
            up, note = _up_of(clip, source, scale, standing)
    turn = upright_matrix(up)
    turns, places = turn @ clip.turns, clip.places @ turn.T
    # rotations of each joint in the axes of the one above it
    world = _body_turns(clip, source, joints, turns, places, by_motion=not standing)
    relative = [
        own if p < 0 else _transposed(world[p]) @ own for p, own in zip(PARENTS, world, strict=True)
    ]
    rotations = np.stack([Rotation.from_matrix(turn).as_rotvec() for turn in relative], axis=1)
    # the pelvis follows the file's, and the soles stand as high as the file's do
    moves = scale * places[:, source["pelvis"]]
    soles = None
    if standing:
        soles = _soles(clip, source, joints)
    moves[:, 1] += _steps(scale * places[..., 1], source, soles) - _steps_of_body(
        world, joints, moves, source
    )
    return rotations, moves - joints[0], note


_Source = Mapping[str, int]
"""For our names of joints, the index of the file's joint."""


def _up_of(clip: Clip, source: _Source, scale: float, standing: bool) -> tuple[str, str]:
    """Returns the axis that points up, and a note about it. A BVH file does not name this axis, but
    a rest pose in which people stand shows it. In other rest poses, y is taken as the usual axis.

    scale: metres of our body per unit of the clip. standing: whether people stand in the rest pose.
    """
    usual = "y"
    if standing:
        usual = nearest_axis(_spine(clip, source))[0]
    trunk = clip.places[:, source[_top(source)]] - clip.places[:, source["pelvis"]]
    axis, cosine = nearest_axis(unit(trunk).mean(axis=0))
    chosen = sampled_frames(len(clip.places))
    points = scale * clip.places[chosen][:, sorted(source.values())]
    return up_axis(points, axis if cosine >= CLEARLY_UP else None, usual, clip.fps)


_INDEX = {name: i for i, name in enumerate(JOINT_NAMES)}


# Rest poses
# --------------------------------------------------------------------------------------------------


def _top(source: _Source) -> str:
    return next(name for name in rules.TOPS if name in source)


def _spine(clip: Clip, source: _Source) -> Float[np.ndarray, "3"]:
    return unit(clip.rest[source[_top(source)]] - clip.rest[source["pelvis"]])


def _stands(clip: Clip, source: _Source) -> bool:
    legs = sum(clip.rest[source[f"{s}_ankle"]] - clip.rest[source[f"{s}_hip"]] for s in rules.SIDES)
    return float(unit(legs) @ _spine(clip, source)) < rules.STANDING


def _body_turns(
    clip: Clip,
    source: _Source,
    joints: Float[np.ndarray, "j 3"],
    turns: Float[np.ndarray, "m s 3 3"],
    places: Float[np.ndarray, "m s 3"],
    by_motion: bool,
) -> list[Float[np.ndarray, "m 3 3"]]:
    """Returns the rotations G_j (m, 3, 3) of our joints in the world, see the module's docstring.

    turns, places: rotations and places of the clip's joints, with y up. by_motion: whether twists
    about bones are found from the motion, because nobody can stand in the rest pose.
    """
    frames_of, world = [], []
    for j, (name, parent) in enumerate(zip(JOINT_NAMES, PARENTS, strict=True)):
        if parent < 0:
            align = _pelvis_frame(clip, source, joints)
        else:
            align = frames_of[parent]
        child = next((other for other in rules.NEXT.get(name, ()) if other in source), None)
        if parent < 0:
            world.append(_pelvis_turns(clip, source, turns, places) @ align)
        elif name not in source:
            world.append(world[parent])
        elif child is None:
            # no toes tell where the foot points: as in T-pose on average
            if by_motion and name.endswith("_ankle"):
                align = _mean(_transposed(world[parent]) @ turns[:, source[name]]).T
            world.append(turns[:, source[name]] @ align)
        else:
            bone = unit(joints[_INDEX[child]] - joints[j])
            align = (
                smallest_turns(
                    align @ bone, unit(clip.rest[source[child]] - clip.rest[source[name]])
                )
                @ align
            )
            if by_motion:
                align = align @ _untwist(
                    _transposed(world[parent]) @ turns[:, source[name]] @ align, bone
                )
            own = turns[:, source[name]] @ align
            world.append(
                smallest_turns(own @ bone, unit(places[:, source[child]] - places[:, source[name]]))
                @ own
            )
        frames_of.append(align)
    return world


def _pelvis_turns(
    clip: Clip,
    source: _Source,
    turns: Float[np.ndarray, "m s 3 3"],
    places: Float[np.ndarray, "m s 3"],
) -> Float[np.ndarray, "m 3 3"]:
    """Returns the rotations of the pelvis from the rest pose to the frames, (m, 3, 3).

    They are usually the rotations of the pelvis's joint. If the hips hang on other joints that
    agree better with the trunk, the mean rotation of these joints is used. If the hips hang on the
    pelvis, and it bends far from the trunk, it is turned about the line between the hips so that it
    follows the lowest joint of the spine. In all cases the line between the hips points as in the
    file.
    """
    pelvis, left, right = (source[name] for name in ("pelvis", "left_hip", "right_hip"))
    rest_line, line = clip.rest[left] - clip.rest[right], places[:, left] - places[:, right]

    def meeting(candidate):
        return smallest_turns(unit(candidate @ rest_line), unit(line)) @ candidate

    def tilts(candidate, top):
        """Returns the angles, (m,), radians, by which candidate rotations have to be turned about
        the line of the hips to follow the trunk.

        Turned by a candidate rotation, the rest pose has a direction from the pelvis to the joint
        `top`. The angle is that between this direction and the direction in the frame. Both are
        first projected onto the plane perpendicular to the line of the hips.
        """
        axis = unit(line)

        def across(v):
            return v - np.sum(v * axis, axis=-1, keepdims=True) * axis

        a = across(candidate @ (clip.rest[top] - clip.rest[pelvis]))
        b = across(places[:, top] - places[:, pelvis])
        return np.arctan2(np.sum(np.cross(a, b) * axis, axis=-1), np.sum(a * b, axis=-1))

    own, top = meeting(turns[:, pelvis]), source[_top(source)]
    # hips that hang on joints other than the pelvis: their mean, if it agrees better with the trunk
    carriers = {clip.parents[left], clip.parents[right]}
    if min(carriers) >= 0 and carriers != {pelvis}:
        a, b = (
            Rotation.from_matrix(turns[:, joint])
            for joint in (clip.parents[left], clip.parents[right])
        )
        other = meeting((a * Rotation.from_rotvec(0.5 * (a.inv() * b).as_rotvec())).as_matrix())
        own_tilt, tilt = (np.abs(tilts(x, top)).mean() for x in (own, other))
        if tilt < own_tilt - rules.BETTER_TILT:
            return other
        return own
    # a pelvis that does not turn with the trunk is turned after the lowest joint of the spine
    spine = [top]
    while clip.parents[spine[0]] not in (-1, pelvis):
        spine.insert(0, clip.parents[spine[0]])
    apart = 0.01 * np.linalg.norm(clip.rest[top] - clip.rest[pelvis])
    lowest = next(
        (j for j in spine if np.linalg.norm(clip.rest[j] - clip.rest[pelvis]) > apart), top
    )
    tilt = tilts(own, lowest)
    if np.abs(tilt).mean() <= rules.LARGEST_BEND:
        return own
    return Rotation.from_rotvec(tilt[:, None] * unit(line)).as_matrix() @ own


def _pelvis_frame(
    clip: Clip, source: _Source, joints: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "3 3"]:
    theirs = clip.rest[source["left_hip"]] - clip.rest[source["right_hip"]]
    top = joints[_INDEX[_top(source)]] - joints[0]
    ours = _frame(joints[_INDEX["left_hip"]] - joints[_INDEX["right_hip"]], top)
    return _frame(theirs, _spine(clip, source)) @ ours.T


def _frame(right: Float[np.ndarray, "3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x = unit(right)
    z = unit(np.cross(x, up))
    return np.stack([x, np.cross(z, x), z], axis=1)


def _mean(turns: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "3 3"]:
    quaternions = Rotation.from_matrix(turns).as_quat()
    signs = np.where(quaternions @ quaternions[0] < 0, -1.0, 1.0)
    return Rotation.from_quat(signs @ quaternions).as_matrix()


def _untwist(
    turns: Float[np.ndarray, "m 3 3"], bone: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation about a bone that removes the mean twist of rotations about that bone.

    The twist of a quaternion (w, v) about b is 2 arg(w + i v.b). Its square does not depend on the
    quaternion's sign, and rotations that swing far weigh less in the mean of the squares.
    """
    q = Rotation.from_matrix(turns).as_quat()
    twist = np.angle(np.sum((q[:, 3] + 1j * (q[:, :3] @ bone)) ** 2))
    return Rotation.from_rotvec(-twist * bone).as_matrix()


# Steps and the floor
# --------------------------------------------------------------------------------------------------


def _leg_length(places: Float[np.ndarray, "s 3"], index: _Source) -> float:
    bones = (("left_hip", "left_knee"), ("left_knee", "left_ankle"))
    return sum(float(np.linalg.norm(places[index[b]] - places[index[a]])) for a, b in bones)


def _feet(source: _Source) -> list[list[str]]:
    """Returns our names of the joints of the file that may touch the floor. There is one list for
    each kind (ankle, foot), with its left and its right joint.
    """
    present = [[name for name in kind if name in source] for kind in rules.FEET]
    return [found for found in present if found]


def _soles(clip: Clip, source: _Source, joints: Float[np.ndarray, "j 3"]) -> dict[str, float]:
    """Returns the heights of the joints of the feet above the lowest of them, in the rest pose, by
    our names. Heights are scaled to our body, metres. People have to be able to stand in the rest
    pose.
    """
    axis, _ = nearest_axis(_spine(clip, source))
    scale = _leg_length(joints, _INDEX) / max(_leg_length(clip.rest, source), 1e-9)
    heights = scale * clip.rest @ upright_matrix(axis)[1]
    found = {name: heights[source[name]] for kind in _feet(source) for name in kind}
    return {name: height - min(found.values()) for name, height in found.items()}


def _steps(
    heights: Float[np.ndarray, "m s"], source: _Source, soles: dict[str, float] | None
) -> Float[np.ndarray, " m"]:
    """Returns the height of the lower foot above the floor in each frame, (m,), in the unit of
    `heights`.

    The floor is where the feet are lowest over all frames.

    soles: the height of each joint of the feet when the foot stands, by our names. If it is None,
    the lowest height of any ankle over all frames is taken for both ankles, and the lowest height
    of any toe for both feet.
    """
    if soles is None:
        lowest = [
            (kind, heights[:, [source[name] for name in kind]].min()) for kind in _feet(source)
        ]
        soles = {name: low for kind, low in lowest for name in kind}
    feet = np.min([heights[:, source[name]] - sole for name, sole in soles.items()], axis=0)
    return feet - feet.min()


def _steps_of_body(
    world: Sequence[Float[np.ndarray, "m 3 3"]],
    joints: Float[np.ndarray, "j 3"],
    moves: Float[np.ndarray, "m 3"],
    source: _Source,
) -> Float[np.ndarray, " m"]:
    """Returns the height of the lower foot of our body in each frame, (m,), metres.

    The height of a joint is measured from its height in the T-pose, when the lowest joint of the
    feet is at y = 0.
    """
    places = {0: moves}

    def place(j):
        if j not in places:
            p = PARENTS[j]
            places[j] = place(p) + world[p] @ (joints[j] - joints[p])
        return places[j]

    feet = [_INDEX[name] for kind in _feet(source) for name in kind]
    return np.min([place(j)[:, 1] - (joints[j, 1] - joints[feet, 1].min()) for j in feet], axis=0)


def _transposed(matrices: Float[np.ndarray, "*b i j"]) -> Float[np.ndarray, "*b j i"]:
    return np.swapaxes(matrices, -1, -2)
