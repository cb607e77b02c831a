"""Checks whether a calibration makes sense.

A wrong convention gives plausible numbers, but the cameras do not stand around a person and look at
the person. Cameras of a right calibration can stand otherwise, too, so these checks only warn.
"""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.cameras import (
    CONVENTIONS,
    OPENGL_FROM_OPENCV,
    ROTATION_TO_Y_UP,
    WORLD_FROM_CAM,
    WORLD_FROM_CAM_OPENGL,
    CalibratedCamera,
    Calibration,
    distort,
    nearest_rotation,
)

REPROJECTION_LIMIT = 2.0
"""There is a warning if the mean reprojection error exceeds this, pixels. Calibrations usually have
less than 1.
"""
DISTANCES = (0.3, 30.0)
"""Smallest and largest plausible distance of cameras from a person, metres."""
UNITS = {1.0: "metres", 0.01: "centimetres", 0.001: "millimetres"}
"""Names of the units in which people calibrate. The key is the number of metres in the unit."""
USUAL_DISTANCE = 2.5
"""Usual distance of a camera from a person, metres. If several units are possible, the unit that
brings the cameras nearest to this distance is chosen.
"""
NEARLY_PARALLEL = np.sin(np.radians(2.0)) ** 2
"""If the optical axes differ from their mean direction by less than about 2 degrees (root mean
square), there is no reliable point where they meet. The smallest eigenvalue of the mean of I - a
a^T over the axes a is then below this number.
"""
MISS = 0.5
"""Optical axes count as meeting in a point if the root mean square of their distances from it,
divided by the point's median depth, is less than this. The number is large because some cameras
look at the person's feet and others at the face.
"""
TILT_LIMIT = 45.0
"""There is a warning if the angle between the mean upward direction of the photos and +y exceeds
this, degrees.
"""
OFF_CENTER = 0.25
"""There is a warning if the principal point is at least this share of the image's width or height
away from its middle. The intrinsics may then belong to an image of another size.
"""
COINCIDENT = 1e-3
"""Cameras count as standing in one place if the point where their axes meet is very near to them.
The point's median depth is then less than this share of the largest distance of a camera from the
world's origin.
"""


@dataclasses.dataclass(frozen=True)
class Checks:
    """Measured properties of a calibration, and warnings."""

    reprojection: float | None
    """Mean reprojection error over all observations, pixels. None without observations."""
    observations: int
    """Number of observations."""
    distance: float | None
    """Median distance from the cameras to the point where their optical axes meet, measured along
    the axes, metres. None if the axes are nearly parallel, or if there is one camera.
    """
    warnings: tuple[str, ...]
    """Properties that look wrong, one line each."""


def check_calibration(source: Calibration, converted: Calibration, up: str) -> Checks:
    """Returns measured properties of a calibration, and warnings if it looks wrong.

    source: cameras as their source has them. converted: the same cameras in the convention of
    captures. up: axis of the source that points up, such as "+y".
    """

    def matrices(calibration):
        return np.stack([camera.cam_from_world for camera in calibration.cameras])

    # what the points and the axes of the cameras say
    reprojection = _mean_reprojection_error(converted)
    depths, _ = _axes_meeting(matrices(converted))
    distance = None
    if depths is not None:
        distance = float(np.median(np.abs(depths)))
    warnings = []
    if reprojection is not None and reprojection > REPROJECTION_LIMIT:
        limit = f"(expected below {REPROJECTION_LIMIT:g})"
        warnings.append(
            f"the mean reprojection error is {reprojection:.3g} px {limit}: are these its points?"
        )
    # matrices are checked before the conversion, where a wrong convention shows
    warnings += _convention_warnings(matrices(source), source.convention)
    # a wrong unit shows in how far the cameras stand from the person
    low, high = DISTANCES
    if distance is not None and not low <= distance <= high:
        stand = (
            f"the cameras stand {distance:.3g} m from where they look (expected {low:g} to"
            f" {high:g})"
        )
        warnings.append(
            f"{stand}: is scale, the metres in a unit of the source, right? Measure one distance"
        )
    warnings += _up_warnings(matrices(converted), up)
    # one warning about principal points is enough: all cameras mostly share the cause
    warnings += [warning for camera in converted.cameras for warning in _center_warnings(camera)][
        :1
    ]
    count = 0
    if converted.observations is not None:
        count = len(converted.observations.points)
    return Checks(reprojection, count, distance, tuple(warnings))


def likely_unit(calibration: Calibration) -> tuple[float, str | None]:
    """Returns how many metres one unit of a calibration is, and a line about this choice. The line
    is None if nothing has to be reported.

    The unit is the one that the format states, or the metre if the format states none. If the
    cameras would then stand too near to the person or too far away, another unit of `UNITS` is
    chosen. It is the one that brings the cameras nearest to `USUAL_DISTANCE`. If no unit brings
    them within `DISTANCES`, no other unit is chosen.
    """
    # how far the cameras stand from the point where they look, in the calibration's unit
    known = calibration.unit or 1.0
    matrices = np.stack([camera.cam_from_world for camera in calibration.cameras])
    matrices[:, :3, :3] = [nearest_rotation(matrix[:3, :3]) for matrix in matrices]
    depths, _ = _axes_meeting(matrices)
    distance = None
    if depths is not None:
        distance = float(np.median(np.abs(depths)))

    # the stated unit, if it is plausible
    low, high = DISTANCES
    if distance is None or low <= known * distance <= high:
        line = (
            f"{calibration.format} is in {UNITS.get(known, 'an unusual unit')}: taken (--scale"
            " says otherwise)"
        )
        return known, line if known != 1 else None

    # else the plausible unit that brings the cameras nearest to their usual distance
    fitting = [unit for unit in UNITS if low <= unit * distance <= high]
    if not fitting:
        return known, None
    best = min(fitting, key=lambda unit: abs(np.log(unit * distance / USUAL_DISTANCE)))
    before, after = f"{known * distance:.3g} m", f"{best * distance:.3g} m"
    why = (
        f"in {UNITS.get(known, 'its unit')} the cameras stand {before} from where they look, so"
        f" {after}"
    )
    return best, f"the unit is taken for {UNITS[best]}: {why} (--scale says otherwise)"


def _mean_reprojection_error(calibration: Calibration) -> float | None:
    """Returns the mean reprojection error over all observations, pixels. None if there are no
    observations.

    It is infinite if a point lies behind a camera that saw it.
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
        if camera.distortion is not None:
            plane = distort(plane, camera.distortion)
        pixels = plane * np.diag(camera.K)[:2] + camera.K[:2, 2]
        errors.append(np.linalg.norm(pixels - seen.pixels[mine], axis=-1))
    return float(np.concatenate(errors).mean())


def _axes_meeting(
    poses: Float[np.ndarray, "v 4 4"],
) -> tuple[Float[np.ndarray, " v"] | None, Float[np.ndarray, " v"] | None]:
    """Returns two values about the point that is nearest to all optical axes: its depth in each
    camera, (v,), and its distance from each axis, (v,). Depths are negative behind a camera.

    If the axes are nearly parallel, they do not meet, and the result is (None, None). poses:
    cam_from_world, (v, 4, 4), in any unit.
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


def _miss(poses: Float[np.ndarray, "v 4 4"]) -> float:
    """Returns how far the optical axes pass the point where they meet: the root mean square of
    their distances from the point, divided by the median depth of the point.

    The result is infinite if the axes are nearly parallel, if the point is behind a camera, if all
    cameras stand in one place, or if the ratio is `MISS` or more.
    """
    depths, misses = _axes_meeting(poses)
    farthest = np.linalg.norm(poses[:, :3, 3], axis=-1).max()
    if (
        depths is None
        or misses is None
        or depths.min() <= 0
        or np.median(depths) < COINCIDENT * farthest
    ):
        return np.inf
    share = float(np.sqrt(np.mean(misses**2)) / np.median(depths))
    return share if share < MISS else np.inf


def _convention_warnings(poses: Float[np.ndarray, "v 4 4"], convention: str) -> list[str]:
    """Returns a warning if the cameras do not all look at one place in front of them. Returns an
    empty list if they do, or if their axes are nearly parallel. If the cameras would look at one
    place with another convention for the matrices in the file, the warning names this convention.

    poses: cam_from_world as the source has them, (v, 4, 4). convention: the convention in which the
    matrices were read.
    """
    if _axes_meeting(poses)[0] is None or np.isfinite(_miss(poses)):
        return []
    matrices = poses
    if convention == WORLD_FROM_CAM:
        matrices = np.linalg.inv(poses)
    elif convention == WORLD_FROM_CAM_OPENGL:
        matrices = np.linalg.inv(OPENGL_FROM_OPENCV @ poses)
    misses = {name: _miss(meaning(matrices)) for name, meaning in CONVENTIONS.items()}
    best = min(misses, key=lambda name: misses[name])
    problem = "the cameras do not look at one place before them"
    if np.isfinite(misses[best]):
        return [
            f"{problem}; they would if the matrices in the file were {best} (the format says"
            f" {convention})"
        ]
    return [f"{problem}: is this calibration of photos around a person?"]


def _up_warnings(poses: Float[np.ndarray, "v 4 4"], up: str) -> list[str]:
    """Returns a warning if the mean upward direction of the photos is more than `TILT_LIMIT` from
    +y, or else an empty list. Most photos are upright, so this direction shows which axis is up. If
    the upward directions differ so much that the length of their mean is below 0.5, the list is
    empty, too.

    poses: cam_from_world, (v, 4, 4). up: axis of the source that was turned to y.
    """
    direction = -poses[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(direction)
    if length < 0.5 or direction[1] / length >= np.cos(np.radians(TILT_LIMIT)):
        return []
    in_source = np.asarray(ROTATION_TO_Y_UP[up]).T @ direction
    best = max(
        ROTATION_TO_Y_UP, key=lambda axis: float(f"{axis[0]}1") * in_source["xyz".index(axis[1])]
    )
    return [
        f"the photos do not stand upright with {up} up: --up={best} fits best (or were they taken"
        " sideways?)"
    ]


def _center_warnings(camera: CalibratedCamera) -> list[str]:
    if np.abs(camera.K[:2, 2] / (camera.width, camera.height) - 0.5).max() < OFF_CENTER:
        return []
    center = f"({camera.K[0, 2]:.1f}, {camera.K[1, 2]:.1f})"
    size = f"{camera.width} x {camera.height}"
    problem = f"the principal point {center} is far from the middle of {size}"
    return [f"{camera.name}: {problem}: is K that of photos of another size?"]
