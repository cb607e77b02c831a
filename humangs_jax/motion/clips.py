"""Reads moving skeletons of other programs: BVH files, and animations of GLB files.

A BVH file (https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/BVH.html) has a tree of
joints with offsets and channels, then the numbers of each frame. Rotations are degrees about the
axes of the channels, in their order: R = R_first R_second R_third. Position channels replace the
offset. In files of MakeHuman they are added to it. In the rest pose all rotations are 0. A joint's
name may have spaces: the name ends with its line or before a brace.

Of a GLB file (https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#animations), one animation
is read, for the joints of the skin. The rest pose is the one in which the skin was bound to the
mesh (inverse bind matrices). Without these matrices it is the pose of the nodes. Splines are taken
at their keys and interpolated linearly.
"""

import re
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.kinematics import posed_tree
from humangs_jax.core.array_types import Float
from humangs_jax.io.mesh import parse_glb, read_accessor
from humangs_jax.io.nodes import (
    PATHS,
    Nodes,
    Tracks,
    check_finite,
    node_parents,
    with_ancestors,
    world_matrices,
)
from humangs_jax.io.reading import (
    InvalidFileError,
    check_limit,
    check_unpacked,
    read_bytes,
    read_text,
)
from humangs_jax.motion import Poses, Reading
from humangs_jax.motion.face_files import animated_face, face_alone
from humangs_jax.motion.rules import frame_times
from humangs_jax.motion.skeleton import Clip, bytes_of_clip

_CHANNELS = ("xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation")
_WORD = re.compile(r"(ROOT|JOINT|End)\s+([^\r\n{}]*)|[{}]|[^\s{}]+")
_MOTION = re.compile(r"(?<!\S)MOTION\s+Frames:\s*(\S+)\s+Frame\s+Time:\s*(\S+)")


def read_bvh(path: Path, options: object = None) -> Clip:
    """Reads the moving skeleton of a BVH file.

    Raises: FileNotFoundError; FileError if the file cannot be read as text; InvalidFileError if it
    is no BVH file or is damaged.
    """
    text = read_text(path)
    if text.split(maxsplit=1)[:1] != ["HIERARCHY"]:
        raise InvalidFileError("not a BVH file: expected HIERARCHY first")
    # the tree of joints, before the line that the motion begins with
    found = _MOTION.search(text)
    end = found.start() if found else len(text)
    names, parents, offsets, channels = _tree(text[:end])
    if found is None:
        raise InvalidFileError(
            "cut short, or damaged: expected MOTION, Frames: and Frame Time: after the joints"
        )
    count, seconds = _number(found[1]), _number(found[2])
    if not (count >= 1 and count == int(count) and seconds > 0 and np.isfinite(1 / seconds)):
        raise InvalidFileError(
            f"expected at least one frame and a positive Frame Time, got {found[1]} and {found[2]}"
        )
    # a row of numbers for each frame
    width = sum(len(each) for each in channels)
    numbers = _numbers(text[found.end() :])
    note = ""
    if width == 0 or not len(numbers) or len(numbers) % width:
        short = ": cut short?" if len(numbers) < count * width else ""
        raise InvalidFileError(
            f"expected {found[1]} frames of {width} numbers, got {len(numbers):,} numbers{short}"
        )
    if len(numbers) != count * width:  # of a file that somebody has shortened or joined
        note = f"the file says {found[1]} frames, but has {len(numbers) // width}: these are taken"
    rows = numbers.reshape(-1, width)
    check_unpacked(len(text), bytes_of_clip(len(rows), len(names)))
    turns, places = _posed(parents, offsets, channels, rows)
    bones = np.where(np.asarray(parents)[:, None] < 0, 0.0, offsets)
    rest = posed_tree(np.tile(np.eye(3), (len(parents), 1, 1)), bones, parents)[1]
    return Clip(names, parents, rest, turns, places, 1 / seconds, note=note)


def _tree(
    text: str,
) -> tuple[tuple[str, ...], tuple[int, ...], Float[np.ndarray, "s 3"], list[list[str]]]:
    """Reads names, parents, offsets (s, 3) and channels of the joints from a BVH file's HIERARCHY.

    Raises: InvalidFileError if the text is not a whole tree of joints.
    """
    # each word, and the name behind ROOT, JOINT and End
    found = _WORD.finditer(text, len("HIERARCHY") + text.index("HIERARCHY"))
    words = ((match[1] or match[0], match[2]) for match in found)
    names, parents, offsets, channels = [], [], [], []
    # joints whose braces are open, None for the end of a limb; and what waits for its brace
    open_joints, waiting = [], None
    try:
        for word, name in words:
            here = open_joints[-1] if open_joints else None
            if name is not None:
                waiting = (word, " ".join(name.split()))
            elif word == "{" and waiting is not None:
                # a joint begins, or the end of a limb, which is none
                if waiting[0] == "End":
                    open_joints.append(None)
                else:
                    open_joints.append(len(names))
                    names.append(waiting[1])
                    parents.append(-1 if here is None else here)
                    offsets.append(np.zeros(3))
                    channels.append([])
                    check_limit("joints", len(names), "joints")
                waiting = None
            elif word == "}" and open_joints:
                open_joints.pop()
            elif word == "OFFSET" and open_joints:
                offset = np.asarray([_number(next(words)[0]) for _ in range(3)])
                if here is not None:
                    offsets[here] = offset
            elif word == "CHANNELS" and here is not None:
                channels[here] = _channels(words, names[here])
            else:
                raise InvalidFileError(f"unknown word {word}")
    except StopIteration:
        raise InvalidFileError("cut short") from None
    # what a whole tree has
    if open_joints or waiting is not None or not names:
        what = "a brace of the joints is open" if names else "no joints"
        raise InvalidFileError(f"cut short: {what}")
    if parents.count(-1) != 1:
        raise InvalidFileError(f"expected one ROOT, got {parents.count(-1)}")
    return tuple(names), tuple(parents), np.stack(offsets), channels


def _channels(words: Iterator[tuple[str, str | None]], joint: str) -> list[str]:
    """Reads the channels of a joint, in lower case, from the words that follow CHANNELS.

    Raises: InvalidFileError for unknown channels; StopIteration if the words end too early.
    """
    amount = _number(next(words)[0])
    channels = [next(words)[0].lower() for _ in range(int(min(max(amount, 0), 7)))]
    if amount != len(channels) or not set(channels) <= set(_CHANNELS):
        raise InvalidFileError(f"joint {joint}: expected up to 6 channels such as Xrotation")
    return channels


def _number(word: str) -> float:
    """Converts a word to a finite number. Raises: InvalidFileError if it is none."""
    try:
        value = float(word)
    except ValueError:
        raise InvalidFileError(f"expected a number, got {word}") from None
    if not np.isfinite(value):
        raise InvalidFileError(f"expected finite numbers, got {word}")
    return value


def _numbers(text: str) -> Float[np.ndarray, " n"]:
    """Reads the numbers of all frames. Raises: InvalidFileError if one is not a finite number."""
    try:
        values = np.fromstring(text, np.float64, sep=" ")
    except ValueError as error:
        raise InvalidFileError(f"frames: expected numbers: {error}") from None
    if not np.isfinite(values).all():
        raise InvalidFileError(
            f"frames: expected finite numbers, got {values[np.argmin(np.isfinite(values))]}"
        )
    return values


def _posed(
    parents: tuple[int, ...],
    offsets: Float[np.ndarray, "s 3"],
    channels: list[list[str]],
    numbers: Float[np.ndarray, "m n"],
) -> tuple[Float[np.ndarray, "m s 3 3"], Float[np.ndarray, "m s 3"]]:
    """Returns rotations (m, s, 3, 3) and places (m, s, 3) of the joints in the world.

    parents, offsets, channels: as `_tree` returns them. numbers: a row for each frame, with the
    channels of all joints one after the other.
    """
    frames = len(numbers)
    turns, moves = np.empty((frames, len(parents), 3, 3)), np.empty((frames, len(parents), 3))
    moved = np.zeros((len(parents), 3), bool)  # what position channels move
    at = 0
    for joint, names in enumerate(channels):
        columns = numbers[:, at : at + len(names)]
        at += len(names)
        move = np.tile(offsets[joint], (frames, 1))
        turn = np.tile(np.eye(3), (frames, 1, 1))
        for i, name in enumerate(names):
            axis = name[0]
            if name.endswith("rotation"):
                angles = columns[:, [i]]
                turn = turn @ Rotation.from_euler(axis, angles, degrees=True).as_matrix()
            else:
                move[:, "xyz".index(axis)] = columns[:, i]
                moved[joint, "xyz".index(axis)] = True
        turns[:, joint], moves[:, joint] = turn, move
    # positions of most joints that are nearer to 0 than to the offsets are added to these
    moved[np.asarray(parents) < 0] = False
    own, offset = moves[:, moved], offsets[moved]
    most = moved.any(axis=1).sum() > len(parents) / 2
    if most and np.abs(own).sum() < np.abs(own - offset).sum():
        moves[:, moved] += offset
    return posed_tree(turns, moves, parents)


# GLB
# --------------------------------------------------------------------------------------------------


def read_animation(path: Path, options: Reading | None = None) -> Clip | Poses:
    """Returns the moving skeleton of a GLB file, with its face. If the animation moves a face and
    turns no node, returns poses of a standing person with this face.

    Raises: OSError if the file cannot be read; InvalidFileError if it has no usable animation;
    KeyError, ValueError and other errors if its content is damaged.
    """
    data = read_bytes(path, "mesh_bytes")
    content, binary = parse_glb(data, "text_bytes")
    nodes, animations = content.get("nodes", []), content.get("animations", [])
    if not animations:
        raise InvalidFileError("a GLB file without an animation: expected a skeleton in motion")
    # the animation; one that moves a face alone has no skeleton
    animation, note = _chosen(animations, options.clip if options else None)
    alone = face_alone(content, binary, animation, note)
    if alone is not None:
        return alone
    parents = node_parents(nodes)
    # the joints of the skin, and the nodes above them, in motion
    joints, binding = _joints(content, binary, nodes)
    order = with_ancestors(joints, parents)
    check_limit("joints", len(order), "joints")
    tracks = _tracks(content, binary, animation, set(order))
    times, fps = _times(tracks)
    check_unpacked(len(data), 3 * bytes_of_clip(len(times), len(order)))
    posed = world_matrices(nodes, parents, order, tracks, times)
    rest = world_matrices(nodes, parents, order, {}, np.zeros(1))
    # turns are from the pose in which the skin was bound to that of a frame
    index = {joint: i for i, joint in enumerate(joints)}
    bind = np.stack([binding.get(joint, rest[joint][0]) for joint in joints])
    matrices = np.stack([posed[joint] for joint in joints], axis=1)
    turns = _rotations(matrices) @ np.swapaxes(_rotations(bind), -1, -2)
    # names by the humanoid extension, where there is one
    bones = _humanoid(content)
    names = tuple(bones.get(joint, str(nodes[joint].get("name", ""))) for joint in joints)
    above = tuple(index.get(_next_joint(parents, joint, index), -1) for joint in joints)
    face, of_face = animated_face(content, binary, animation, times)
    note = "; ".join(filter(None, (note, of_face)))
    return Clip(names, above, bind[:, :3, 3], turns, matrices[..., :3, 3], fps, "y", note, face)


_SHOWN = 12
"""Largest number of animations' names in a note or an error."""


def _chosen(animations: list[dict[str, Any]], clip: str | None) -> tuple[dict[str, Any], str]:
    """Returns an animation, and a note if it is the first of several and was not asked for, else
    "".

    clip: the name of the animation (case does not matter), or its number from 0. None: the first.

    Raises: InvalidFileError if there is no such animation.
    """
    names = [str(each.get("name", i)) for i, each in enumerate(animations)]
    listed = ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
    if clip is None:
        note = (
            f"{len(names)} animations ({listed}): the first is taken; the option or argument clip"
            " takes another"
        )
        return animations[0], note if len(names) > 1 else ""
    plain = [name.casefold() for name in names]
    if clip.casefold() in plain:
        return animations[plain.index(clip.casefold())], ""
    if clip.isdecimal() and int(clip) < len(names):
        return animations[int(clip)], ""
    raise InvalidFileError(f"clip {clip}: expected one of {listed}")


def _humanoid(content: dict[str, Any]) -> dict[int, str]:
    """Returns the names of humanoid bones, by the number of the node. Only VRM and VRMA files have
    such names. The nodes may have other names there. The result is empty for other files.
    """
    extensions = content.get("extensions")
    if not isinstance(extensions, dict):
        extensions = {}
    for each in extensions.values():
        bones = {}
        if isinstance(each, dict):
            bones = each.get("humanoid", {}).get("humanBones", {})
        if isinstance(bones, list):  # of VRM 0
            bones = {str(bone.get("bone")): bone for bone in bones if isinstance(bone, dict)}
        named = {
            bone["node"]: name
            for name, bone in bones.items()
            if isinstance(bone, dict) and type(bone.get("node")) is int
        }
        if named:
            return named
    return {}


def _joints(
    content: dict[str, Any], binary: bytes, nodes: Nodes
) -> tuple[list[int], dict[int, Float[np.ndarray, "4 4"]]]:
    """Returns the nodes that are joints, and the matrices of the joints when the skin was bound.

    The joints are those of the skin with most joints. If no skin has joints, all nodes are joints.
    The matrices (4, 4) are in a dict by node. The dict is empty if no skin has joints, if the skin
    has no matrices, or if the skin lists a joint twice.

    Raises: InvalidFileError for a joint that is no node, or for numbers that are not finite;
    LinAlgError for a matrix without an inverse.
    """
    skins = [skin for skin in content.get("skins", []) if skin.get("joints")]
    if not skins:
        return list(range(len(nodes))), {}
    skin = max(skins, key=lambda each: len(each["joints"]))
    joints = skin["joints"]
    if any(type(joint) is not int or not 0 <= joint < len(nodes) for joint in joints):
        raise InvalidFileError("skins: a joint that is no node")
    joints = list(dict.fromkeys(joints))
    if "inverseBindMatrices" not in skin or len(joints) != len(skin["joints"]):
        return joints, {}
    inverse = (
        read_accessor(content, binary, skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    )
    check_finite(inverse, "inverseBindMatrices")
    return joints, dict(zip(joints, np.linalg.inv(inverse), strict=True))


def _next_joint(parents: Sequence[int], joint: int, joints: Container[int]) -> int:
    """Returns the nearest joint above a joint. Nodes that are no joints are skipped. -1 if there is
    none.
    """
    joint = parents[joint]
    while joint != -1 and joint not in joints:
        joint = parents[joint]
    return joint


def _tracks(
    content: dict[str, Any], binary: bytes, animation: dict[str, Any], wanted: Container[int]
) -> Tracks:
    """Returns the tracks that move the wanted nodes, by node and path.

    Raises: InvalidFileError if they are damaged, or if none turns a node.
    """
    tracks: dict[tuple[int, str], Any] = {}
    for channel in animation["channels"]:
        node, path = channel["target"].get("node"), channel["target"]["path"]
        if node not in wanted or path not in PATHS:
            continue
        if (node, path) in tracks:
            raise InvalidFileError(f"animation: two tracks for the {path} of node {node}")
        sampler = animation["samplers"][channel["sampler"]]
        times = read_accessor(content, binary, sampler["input"])[:, 0]
        values = read_accessor(content, binary, sampler["output"])
        if sampler.get("interpolation") == "CUBICSPLINE":
            values = values.reshape(-1, 3, values.shape[1])[:, 1]  # between the tangents
        check_finite(values, path)
        if (
            not len(times)
            or values.shape != (len(times), PATHS[path])
            or not (np.diff(times) > 0).all()
        ):
            raise InvalidFileError(f"animation: expected one {path} for each of increasing times")
        check_finite(times, "times")
        tracks[node, path] = times, values, sampler.get("interpolation") == "STEP"
    if not any(path == "rotation" for _, path in tracks):
        raise InvalidFileError("an animation that turns no joint: expected a skeleton in motion")
    return tracks


def _times(tracks: Tracks) -> tuple[Float[np.ndarray, " m"], float | int]:
    """Returns evenly spaced times of frames (m,), seconds, and their rate in frames per second.

    Raises: InvalidFileError if tracks have very different lengths.
    """
    found = frame_times([keys for keys, _, _ in tracks.values()])
    if found is None:
        raise InvalidFileError("animation: tracks of very different lengths")
    return found


def _rotations(matrices: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 3 3"]:
    """Returns the rotations, (..., 3, 3), of matrices that rotate, scale and move.

    Raises: InvalidFileError if a matrix mirrors or scales to zero.
    """
    linear = matrices[..., :3, :3]
    lengths = np.linalg.norm(linear, axis=-2, keepdims=True)
    if not (lengths > 0).all() or not (np.linalg.det(linear) > 0).all():
        raise InvalidFileError(
            "a joint that is mirrored or without size: expected rotations, positions and scales"
        )
    flat = (linear / lengths).reshape(-1, 3, 3)
    return Rotation.from_matrix(flat).as_matrix().reshape(linear.shape)
