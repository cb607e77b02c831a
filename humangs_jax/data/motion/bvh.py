"""BVH files: a tree of joints with offsets and channels, then one line of numbers per frame.

https://research.cs.wisc.edu/graphics/Courses/cs-838-1999/Jeff/BVH.html. Rotations are degrees about the axes of the channels, in
their order: R = R_first R_second R_third. Position channels replace the offset. In the rest pose all rotations are 0. A joint's
name may have spaces: it ends with its line or before a brace.
"""

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.core.array_types import Float
from humangs_jax.data.motion.skeleton import Clip, bytes_of_clip
from humangs_jax.io.reading import Refused, check_limit, check_unpacked, read_text

CHANNELS = ("xposition", "yposition", "zposition", "xrotation", "yrotation", "zrotation")
_WORD = re.compile(r"(ROOT|JOINT|End)\s+([^\r\n{}]*)|[{}]|[^\s{}]+")
_MOTION = re.compile(r"(?<!\S)MOTION\s+Frames:\s*(\S+)\s+Frame\s+Time:\s*(\S+)")


def read_bvh(path: Path, options: object = None) -> Clip:
    """The skeleton of a file in motion. Raises: OSError; Refused or FileError, which say what was expected."""
    text = read_text(path)
    if text.split(maxsplit=1)[:1] != ["HIERARCHY"]:
        raise Refused("not a BVH file: expected HIERARCHY first")
    found = _MOTION.search(text)
    names, parents, offsets, channels = _tree(text[: found.start() if found else len(text)])
    if found is None:
        raise Refused("cut short, or damaged: expected MOTION, Frames: and Frame Time: after the joints")
    count, seconds = _number(found[1]), _number(found[2])
    if not (count >= 1 and count == int(count) and seconds > 0 and np.isfinite(1 / seconds)):
        raise Refused(f"expected at least one frame and a positive Frame Time, got {found[1]} and {found[2]}")
    width = sum(len(each) for each in channels)
    numbers = _numbers(text[found.end() :])
    if width == 0 or len(numbers) != count * width:
        raise Refused(f"expected {found[1]} frames of {width} numbers, got {len(numbers):,} numbers: cut short?")
    check_unpacked(len(text), bytes_of_clip(int(count), len(names)))
    turns, places = _posed(parents, offsets, channels, numbers.reshape(int(count), width))
    return Clip(names, parents, _chained(parents, offsets), turns, places, 1 / seconds)


def _tree(text: str) -> tuple[tuple[str, ...], tuple[int, ...], Float[np.ndarray, "s 3"], list[list[str]]]:
    """Names, parents, offsets and channels of the joints, parents first; the ends of limbs are left out."""
    found = _WORD.finditer(text, len("HIERARCHY") + text.index("HIERARCHY"))
    words = ((match[1] or match[0], match[2]) for match in found)  # and the name that follows
    number = lambda: _number(next(words)[0])
    names, parents, offsets, channels = [], [], [], []
    open_joints, waiting = [], None  # of the braces that are open; None for the end of a limb
    try:
        for word, name in words:
            here = open_joints[-1] if open_joints else None
            if name is not None:
                waiting = (word, " ".join(name.split()))
            elif word == "{" and waiting is not None:
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
                offset = np.asarray([number() for _ in range(3)])
                if here is not None:
                    offsets[here] = offset
            elif word == "CHANNELS" and here is not None:
                amount = number()
                channels[here] = [next(words)[0].lower() for _ in range(int(min(max(amount, 0), 7)))]
                if amount != len(channels[here]) or any(name not in CHANNELS for name in channels[here]):
                    raise Refused(f"joint {names[here]}: expected up to 6 channels such as Xrotation")
            else:
                raise Refused(f"unknown word {word}")
    except StopIteration:
        raise Refused("cut short") from None
    if open_joints or waiting is not None or not names:
        raise Refused("cut short: a brace of the joints is open" if names else "cut short: no joints")
    if parents.count(-1) != 1:
        raise Refused(f"expected one ROOT, got {parents.count(-1)}")
    return tuple(names), tuple(parents), np.stack(offsets), channels


def _number(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise Refused(f"expected a number, got {word}") from None
    if not np.isfinite(value):
        raise Refused(f"expected finite numbers, got {word}")
    return value


def _numbers(text: str) -> Float[np.ndarray, " n"]:
    try:
        values = np.fromstring(text, np.float64, sep=" ")
    except ValueError as error:
        raise Refused(f"frames: expected numbers: {error}") from None
    if not np.isfinite(values).all():
        raise Refused(f"frames: expected finite numbers, got {values[np.argmin(np.isfinite(values))]}")
    return values


def _chained(parents: tuple[int, ...], offsets: Float[np.ndarray, "s 3"]) -> Float[np.ndarray, "s 3"]:
    places = offsets.copy()
    places[0] = 0
    for joint, parent in enumerate(parents):
        if parent >= 0:
            places[joint] += places[parent]
    return places


def _posed(
    parents: tuple[int, ...], offsets: Float[np.ndarray, "s 3"], channels: list[list[str]], numbers: Float[np.ndarray, "m n"]
) -> tuple[Float[np.ndarray, "m s 3 3"], Float[np.ndarray, "m s 3"]]:
    """Rotations (m, s, 3, 3) and places (m, s, 3) of all joints in the world."""
    frames = len(numbers)
    turns, places = np.empty((frames, len(parents), 3, 3)), np.empty((frames, len(parents), 3))
    at = 0
    for joint, parent in enumerate(parents):
        names, columns = channels[joint], numbers[:, at : at + len(channels[joint])]
        at += len(names)
        move = np.tile(offsets[joint], (frames, 1))
        turning = [i for i, name in enumerate(names) if name.endswith("rotation")]
        for i in set(range(len(names))) - set(turning):
            move[:, "xyz".index(names[i][0])] = columns[:, i]
        turn = np.tile(np.eye(3), (frames, 1, 1))
        for i in turning:
            turn = turn @ Rotation.from_euler(names[i][0], columns[:, [i]], degrees=True).as_matrix()
        turns[:, joint] = turn if parent < 0 else turns[:, parent] @ turn
        places[:, joint] = move if parent < 0 else places[:, parent] + np.einsum("mab,mb->ma", turns[:, parent], move)
    return turns, places
