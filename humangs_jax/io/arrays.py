"""Arrays of files: whether they are what they should be, and their checksums. Raises: Refused, see `io.reading`."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from humangs_jax.core.printable import printable
from humangs_jax.io.reading import Refused, check_limit


def check_array(
    name: str, array: np.ndarray, shape: tuple[int | None, ...], low: float = -math.inf, high: float = math.inf
) -> None:
    """Real numbers in [low, high] that are finite in float32, of a shape in which None is any size."""
    fits = array.ndim == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise Refused(f"{name}: expected shape ({wanted}), got {array.shape}")
    if array.dtype.kind not in "fiu":
        raise Refused(f"{name}: expected real numbers, got {array.dtype}")
    if not array.size:
        return
    least, most = float(array.min()), float(array.max())  # NaN if any entry is
    largest = float(np.finfo(np.float32).max)  # what becomes inf when it is cast is no number either
    if not (max(low, -largest) <= least and most <= min(high, largest)):
        words = "finite numbers" if math.inf in (-low, high) and low != 0 else f"numbers in [{low:g}, {high:g}]"
        raise Refused(f"{name}: expected {words}, got {least:.9g} to {most:.9g}")


SUM_TOLERANCE = 1e-2
"""Of weights of sum 1: eight of them in half floats are off by less."""


def check_row_sums(name: str, weights: np.ndarray) -> None:
    """Rows of weights that sum to 1."""
    sums = weights.sum(axis=1, dtype=np.float64)
    if sums.size and abs((worst := float(sums[np.abs(sums - 1).argmax()])) - 1) > SUM_TOLERANCE:
        raise Refused(f"{name}: expected rows with the sum 1, got {worst:.6g}")


def check_indices(name: str, array: np.ndarray, shape: tuple[int | None, ...], bound: int) -> None:
    """Integers in [0, bound)."""
    check_array(name, array, shape)
    if array.dtype.kind not in "iu" or (array.size and not 0 <= int(array.min()) <= int(array.max()) < bound):
        raise Refused(f"{name}: expected integers in [0, {bound})")


def check_joints(parents: Sequence[Any], names: Sequence[Any]) -> None:
    """A tree of joints with names and one root, whose parent is -1."""
    check_limit("joints", len(parents), "joints")
    count = len(parents)
    if not all(type(parent) is int and -1 <= parent < count for parent in parents) or list(parents).count(-1) != 1:
        raise Refused("parents: expected the number of the parent of each joint, -1 for one of them")
    up = np.asarray([*(count if parent == -1 else parent for parent in parents), count])
    for _ in range(count.bit_length()):
        up = up[up]  # twice as far up each time
    if (up != count).any():
        raise Refused("parents: expected joints that all descend from the root")
    if len(names) != len(parents) or not all(isinstance(name, str) and name == printable(name) for name in names):
        raise Refused(f"joint_names: expected {len(parents)} printable names")


def checksum(arrays: Mapping[str, Any], *texts: str) -> str:
    """SHA-256, in hexadecimal, of named arrays with their types and shapes, and of texts."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        if array.size:
            digest.update(array.reshape(-1).view(np.uint8).data)
    for text in texts:
        digest.update(f"{len(text)} {text}\n".encode())
    return digest.hexdigest()


def check_checksum(recorded: Any, found: str) -> None:
    """Whether a file records this checksum. None: a file of a version that wrote none."""
    if recorded not in (None, found):
        raise Refused(f"damaged: its contents have the checksum {found[:12]}, recorded is {str(recorded)[:12]}")
