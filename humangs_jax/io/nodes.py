"""Reads the nodes of a glTF file: their tree, and their places at the times of an animation.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#nodes-and-hierarchy
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from humangs_jax.core.array_types import Float
from humangs_jax.io.reading import InvalidFileError, shown

PATHS = {"translation": 3, "rotation": 4, "scale": 3}
"""What a track of an animation may move, and how many values the track has for each time."""


Nodes = list[dict[str, Any]]
Track = tuple[Float[np.ndarray, " keys"], Float[np.ndarray, "keys c"], bool]
"""Times in ascending order, (keys,), seconds; values at these times, (keys, c); and whether a value
holds until the next time, instead of being interpolated.
"""
Tracks = dict[tuple[int, str], Track]
"""Tracks by (number of the node, path). The path is a key of `PATHS`."""


def node_parents(nodes: Nodes) -> list[int]:
    """Returns the number of each node's parent, -1 for roots.

    Raises: InvalidFileError for a child that is no node, or for a node with two parents. Other
    damage may raise other errors.
    """
    parents = [-1] * len(nodes)
    for i, node in enumerate(nodes):
        for child in node.get("children", []):
            if type(child) is not int or not 0 <= child < len(nodes) or parents[child] != -1:
                raise InvalidFileError(f"nodes: {shown(child)} is no node, or has two parents")
            parents[child] = i
    return parents


def with_ancestors(joints: Iterable[int], parents: Sequence[int]) -> list[int]:
    """Returns the joints and all nodes above them, parents first.

    Raises: InvalidFileError if a node lies above itself.
    """
    order: list[int] = []
    placed: set[int] = set()
    for joint in joints:
        path: list[int] = []
        while joint != -1 and joint not in placed:
            if len(path) > len(parents):
                raise InvalidFileError("nodes: one lies below itself")
            path.append(joint)
            joint = parents[joint]
        order += reversed(path)
        placed.update(path)
    return order


def world_matrices(
    nodes: Nodes,
    parents: Sequence[int],
    order: Sequence[int],
    tracks: Tracks,
    times: Float[np.ndarray, " m"],
) -> dict[int, Float[np.ndarray, "m 4 4"]]:
    """Returns the matrices (m, 4, 4), world from node, of the nodes in `order` at m times, by the
    number of the node. order: each node after its parent. times: seconds.

    Raises: InvalidFileError. Damaged numbers may raise other errors.
    """
    world: dict[int, np.ndarray] = {}
    for i in order:
        local = _local(
            nodes[i], {path: tracks[i, path] for path in PATHS if (i, path) in tracks}, times
        )
        if parents[i] == -1:
            world[i] = local
        else:
            world[i] = world[parents[i]] @ local
    return world


def node_matrices(nodes: Nodes) -> list[Float[np.ndarray, "4 4"]]:
    """Returns the matrix (4, 4), world from node, of each node of a glTF file. Animations are
    ignored.

    Raises: InvalidFileError. Damaged numbers may raise other errors.
    """
    parents = node_parents(nodes)
    world = world_matrices(
        nodes, parents, with_ancestors(range(len(nodes)), parents), {}, np.zeros(1)
    )
    return [world[i][0] for i in range(len(nodes))]


def _local(
    node: dict[str, Any], tracks: Mapping[str, Track], times: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m 4 4"]:
    local = np.tile(np.eye(4), (len(times), 1, 1))
    if "matrix" in node:
        local[:] = np.asarray(node["matrix"], np.float64).reshape(4, 4).T
        check_finite(local, "matrix")
        return local
    usual = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    parts = {}
    for path, still in usual.items():
        value = np.asarray(node.get(path, still), np.float64).reshape(1, PATHS[path])
        check_finite(value, path)
        if path in tracks:
            parts[path] = _sampled(tracks[path], times, path)
        else:
            parts[path] = np.tile(value, (len(times), 1))
    local[:, :3, :3] = (
        Rotation.from_quat(parts["rotation"]).as_matrix() * parts["scale"][:, None, :]
    )
    local[:, :3, 3] = parts["translation"]
    return local


def _sampled(track: Track, times: Float[np.ndarray, " m"], path: str) -> Float[np.ndarray, "m c"]:
    """Returns the values of a track at some times, (m, c). Before the first and after the last time
    of the track, its first and last value hold. path: what the track moves.
    """
    keys, values, stepped = track
    if stepped or len(keys) == 1:
        step = times[1] - times[0] if len(times) > 1 else 1.0
        times = times + 0.01 * step  # keys are rounded to float32
        return values[np.clip(np.searchsorted(keys, times, side="right") - 1, 0, len(keys) - 1)]
    times = np.clip(times, keys[0], keys[-1])
    if path == "rotation":
        return Slerp(keys, Rotation.from_quat(values))(times).as_quat()
    return np.stack([np.interp(times, keys, column) for column in values.T], axis=1)


def check_finite(values: Float[np.ndarray, "..."], what: str) -> None:
    """Checks that all numbers are finite. Raises: InvalidFileError."""
    if not np.isfinite(values).all():
        raise InvalidFileError(f"{what}: expected finite numbers")
