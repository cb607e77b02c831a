"""Whether imported cameras make sense: reprojection, axes that meet before the cameras, which side is up, distances.

A wrong convention gives plausible numbers, but not cameras around a person that all look at the person. These checks only
warn: the cameras of some captures do stand otherwise.
"""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import (
    CONVENTIONS,
    OPENGL_FROM_OPENCV,
    ROTATION_TO_Y_UP,
    WORLD_FROM_CAM_OPENGL,
    Calibration,
    distort,
)

REPROJECTION_LIMIT = 2.0
"""Pixels; calibrations are usually good to less than one."""
DISTANCES = (0.3, 30.0)
"""Metres between which cameras stand from a person."""
NEARLY_PARALLEL = np.sin(np.radians(2.0)) ** 2
"""Axes within about 2 degrees of each other do not define a point where they meet."""
MISS = 0.5
"""Axes of cameras around a person pass within this share of the distance: some look at the feet, others at the face."""
TILT_LIMIT = 45.0
"""Degrees between the mean upward direction of the photos and +y."""
OFF_CENTER = 0.25
"""Share of the image from its middle beyond which a principal point belongs to an image of another size."""
COINCIDENT = 1e-3
"""Cameras that meet within this share of their distance to the world's origin stand all in one place."""


@dataclasses.dataclass(frozen=True)
class Checks:
    """What was measured, and warnings.

    reprojection: mean over all observations, pixels, or None without any. observations: how many.
    distance: median from the cameras to where their axes meet, metres, or None where they are parallel (one camera).
    """

    reprojection: float | None
    observations: int
    distance: float | None
    warnings: tuple[str, ...]


def check_calibration(source: Calibration, converted: Calibration, up: str) -> Checks:
    """Check cameras as their source has them, and as they came into the capture's convention with that axis up."""
    poses = np.stack([camera.cam_from_world for camera in source.cameras])
    reprojection = mean_reprojection_error(converted)
    converted_poses = np.stack([camera.cam_from_world for camera in converted.cameras])
    depths, _ = axes_meeting(converted_poses)
    distance = None if depths is None else float(np.median(np.abs(depths)))
    warnings = [
        _reprojection_warning(reprojection),
        _convention_warning(poses, source.convention),
        _distance_warning(distance),
        _up_warning(converted_poses, up),
        next((warning for warning in map(_center_warning, converted.cameras) if warning), ""),
    ]
    count = 0 if converted.observations is None else len(converted.observations.points)
    return Checks(reprojection, count, distance, tuple(warning for warning in warnings if warning))


def mean_reprojection_error(calibration: Calibration) -> float | None:
    """Pixels between where the calibration's points were seen and where its cameras see them; None without points.

    Infinite where a point lies behind a camera that saw it.
    """
    seen = calibration.observations
    if seen is None:
        return None
    errors = []
    for i, camera in enumerate(calibration.cameras):
        mine = seen.cameras == i
        p = seen.points[mine] @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        if (p[:, 2] <= 0).any():
            return float("inf")
        plane = p[:, :2] / p[:, 2:]
        plane = plane if camera.distortion is None else distort(plane, camera.distortion)
        pixels = plane * np.diag(camera.K)[:2] + camera.K[:2, 2]
        errors.append(np.linalg.norm(pixels - seen.pixels[mine], axis=-1))
    return float(np.concatenate(errors).mean())


def axes_meeting(
    poses: Float[np.ndarray, "v 4 4"],
) -> tuple[Float[np.ndarray, " v"] | None, Float[np.ndarray, " v"] | None]:
    """Depth of the point nearest to all optical axes before each camera, and its distance from each axis.

    (None, None) if the axes are nearly parallel: they meet nowhere. `poses` are cam_from_world, in any unit.
    """
    rotations, axes = poses[:, :3, :3], poses[:, 2, :3]
    centers = -np.einsum("vji,vj->vi", rotations, poses[:, :3, 3])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.mean(axis=0)
    if np.linalg.eigvalsh(normal)[0] < NEARLY_PARALLEL:
        return None, None
    point = np.linalg.solve(normal, np.einsum("vij,vj->i", across, centers) / len(poses))
    return ((point - centers) * axes).sum(axis=-1), np.linalg.norm(
        np.einsum("vij,vj->vi", across, point - centers), axis=-1
    )


def _miss(poses):
    """How far axes pass the point where they meet before all cameras, as a share of its distance; infinite if none is."""
    depths, misses = axes_meeting(poses)
    farthest = np.linalg.norm(poses[:, :3, 3], axis=-1).max()
    if depths is None or misses is None or depths.min() <= 0 or np.median(depths) < COINCIDENT * farthest:
        return np.inf
    share = np.sqrt(np.mean(misses**2)) / np.median(depths)
    return share if share < MISS else np.inf


def _convention_warning(poses, convention):
    if axes_meeting(poses)[0] is None or np.isfinite(_miss(poses)):
        return ""
    matrices = np.linalg.inv(OPENGL_FROM_OPENCV @ poses) if convention == WORLD_FROM_CAM_OPENGL else poses
    misses = {name: _miss(meaning(matrices)) for name, meaning in CONVENTIONS.items()}
    best = min(misses, key=lambda name: misses[name])
    problem = "the cameras do not look at one place before them"
    if np.isfinite(misses[best]):
        return f"{problem}; they would if the matrices in the file were {best} (the format says {convention})"
    return f"{problem}: is this calibration of photos around a person?"


def _reprojection_warning(error):
    if error is None or error <= REPROJECTION_LIMIT:
        return ""
    return (
        f"the mean reprojection error is {error:.3g} px (expected below {REPROJECTION_LIMIT:g}): are these its points?"
    )


def _distance_warning(distance):
    if distance is None or DISTANCES[0] <= distance <= DISTANCES[1]:
        return ""
    low, high = DISTANCES
    return (
        f"the cameras stand {distance:.3g} m from where they look (expected {low:g} to {high:g}): "
        "--scale is the number of metres in a unit of the source; measure one distance"
    )


def _up_warning(poses, up):
    """The photos are upright, most of them: the mean of their upward directions tells which axis is up."""
    direction = -poses[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(direction)
    if length < 0.5 or direction[1] / length >= np.cos(np.radians(TILT_LIMIT)):
        return ""
    best = max(ROTATION_TO_Y_UP, key=lambda axis: _axis(axis) @ np.asarray(ROTATION_TO_Y_UP[up]).T @ direction)
    return f"the photos do not stand upright with {up} up: --up={best} fits best (or were they taken sideways?)"


def _axis(name):
    return np.where(np.asarray(list("xyz")) == name[1], 1.0 if name[0] == "+" else -1.0, 0.0)


def _center_warning(camera):
    offset = np.abs(camera.K[:2, 2] / (camera.width, camera.height) - 0.5).max()
    if offset < OFF_CENTER:
        return ""
    center = f"({camera.K[0, 2]:.1f}, {camera.K[1, 2]:.1f})"
    return (
        f"{camera.name}: the principal point {center} is far from the middle of {camera.width} x {camera.height}: "
        "is K that of photos of another size?"
    )
