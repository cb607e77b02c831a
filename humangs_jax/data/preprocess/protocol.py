"""The published protocol in numbers: alignment, cameras around a scan, splits, evaluation indices. numpy, float64.

Scans: the middle of the raw scan's bounding box becomes the origin, then the smallest rotation takes pelvis -> neck of the fitted
body to +y. Videos: the same rotation of frame 0 first, then the middle of the bounding box of the rotated body of frame 0.
"""

import random
from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.geometry.mesh import smallest_turns

T = TypeVar("T")

PELVIS, NECK = 0, 12
VERTICAL_FOV = np.deg2rad(60.0)
ELEVATIONS = (-5.0, 15.0)
"""Degrees, uniform."""
FACTORS = (1.0, 1.75)
"""Camera distance in bounding radii, uniform, as the paper has it. At 60 degrees below 1.7 the frame cuts heads and feet."""
NEAR_FACTORS = (2.0, 2.0)
"""The paper's "near" test set; also what the release uses for all sets."""
VIEWS, SIZE = 60, 512
TRAIN, TEST = 2300, 145
SPLIT_SEED, EVALUATION_SEED, CAMERA_SEED = 42, 777, 2026
"""The last is ours: how the release drew its cameras is not known."""
INPUT_COUNTS, TARGETS = (1, 2, 4, 6), 4
EVERY = 10
"""Every how many frames of a video are taken."""


def smallest_rotation(start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation about start x end that takes the direction of `start` to that of `end`. Raises: ValueError for a zero."""
    lengths = np.linalg.norm(start), np.linalg.norm(end)
    if not min(lengths) > 0:
        raise ValueError("the direction from pelvis to neck has no length")
    return smallest_turns(start / lengths[0], end / lengths[1], opposite=1e-24)


def box_middle(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Middle of the bounding box."""
    return 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64)


def rigid(rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """[[R, t], [0, 0, 0, 1]]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def moved(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Points through a rigid transform."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def scan_alignment(
    scan: Float[np.ndarray, "n 3"], pelvis: Float[np.ndarray, "3"], neck: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """`mesh_transform` of a scan, R @ T: first the middle of its bounding box to the origin, then upright."""
    R = smallest_rotation(neck - pelvis, np.asarray([0.0, 1.0, 0.0]))
    return rigid(R, -R @ box_middle(scan))


def video_alignment(
    body: Float[np.ndarray, "n 3"], pelvis: Float[np.ndarray, "3"], neck: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """`mesh_transform` of a video, T @ R: upright first, then the middle of the turned body of frame 0 to the origin."""
    R = smallest_rotation(neck - pelvis, np.asarray([0.0, 1.0, 0.0]))
    return rigid(R, -box_middle(body @ R.T))


def bounding_radius(points: Float[np.ndarray, "n 3"]) -> float:
    """The largest distance from the origin."""
    return float(np.linalg.norm(points, axis=1).max())


def intrinsics(size: int) -> Float[np.ndarray, "3 3"]:
    """K of square images, field of view `VERTICAL_FOV`."""
    focal = 0.5 * size / np.tan(0.5 * VERTICAL_FOV)
    return np.asarray([[focal, 0, 0.5 * size], [0, focal, 0.5 * size], [0, 0, 1]])


def scan_cameras(number: int, radius: float, views: int, factors: tuple[float, float]) -> Float[np.ndarray, "v 4 4"]:
    """cam_from_world of cameras that look at the origin, y up; azimuth, elevation and distance are drawn uniformly.

    number: of the scan, so that its cameras depend on nothing else. Equal factors: all at that distance.
    """
    rng = np.random.default_rng([CAMERA_SEED, number])
    azimuths = np.deg2rad(rng.uniform(0, 360, views))
    elevations = np.deg2rad(rng.uniform(*ELEVATIONS, views))
    distances = radius * rng.uniform(*factors, views)
    flat = np.cos(elevations)
    towards = np.stack([flat * np.sin(azimuths), np.sin(elevations), flat * np.cos(azimuths)], axis=-1)
    cameras = np.tile(np.eye(4), (views, 1, 1))
    right = np.stack([np.cos(azimuths), np.zeros(views), -np.sin(azimuths)], axis=-1)
    cameras[:, 0, :3] = right
    cameras[:, 1, :3] = np.cross(-towards, right)  # image rows go down
    cameras[:, 2, :3] = -towards
    cameras[:, 2, 3] = distances
    return cameras


def split_ids(names: Sequence[T], train: int = TRAIN, test: int = TEST) -> tuple[list[T], list[T]]:
    """numpy's shuffle of seed 42 of all sorted names: the first `train` of them, and the next `test`."""
    order = sorted(names)  # ty: ignore[invalid-argument-type]  strings
    np.random.RandomState(SPLIT_SEED).shuffle(order)  # the published one
    return order[:train], order[train : train + test]


def evaluation_indices(
    counts: Mapping[str, int], inputs: int, targets: int = TARGETS
) -> dict[str, dict[str, list[int]]]:
    """{scene: {"context": [...], "target": [...]}} of scenes in file order with their numbers of views.

    Python's generator of seed 777: `inputs` views, then `targets` of the others. Raises: ValueError for a scene of too few.
    """
    generator, found = random.Random(EVALUATION_SEED), {}
    for name, count in counts.items():
        if count < inputs + targets:
            raise ValueError(f"{name}: {count} views, but {inputs} inputs and {targets} targets are asked for")
        context = sorted(generator.sample(range(count), inputs))
        rest = [view for view in range(count) if view not in set(context)]
        found[name] = {"context": context, "target": sorted(generator.sample(rest, targets))}
    return found
