"""Whether what is imported makes sense: reprojection, axes that meet before the cameras, which side is up, distances; masks.

A wrong convention gives plausible numbers, but not cameras around a person that all look at the person. Some cameras do stand
otherwise: these checks only warn. Masks that the reader of captures would refuse are refused.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.calibration.calibration import (
    CONVENTIONS,
    OPENGL_FROM_OPENCV,
    ROTATION_TO_Y_UP,
    WORLD_FROM_CAM_OPENGL,
    CalibratedCamera,
    Calibration,
    distort,
)
from humangs_jax.data.calibration.photos import Photo
from humangs_jax.data.capture_checks import CaptureError, few
from humangs_jax.data.photos import read_checked, read_mask
from humangs_jax.data.usable_views import MASK_THRESHOLD
from humangs_jax.io.images import image_size, open_image, read_image

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
    """What was measured, and warnings."""

    reprojection: float | None
    """Mean over all observations, pixels; None without any."""
    observations: int
    """How many."""
    distance: float | None
    """Median from the cameras to where their axes meet, metres; None where they are parallel (one camera)."""
    warnings: tuple[str, ...]


def check_calibration(source: Calibration, converted: Calibration, up: str) -> Checks:
    """Check cameras as their source has them, and as they came into the capture's convention with that axis up."""
    matrices = lambda calibration: np.stack([camera.cam_from_world for camera in calibration.cameras])
    reprojection = mean_reprojection_error(converted)
    depths, _ = axes_meeting(matrices(converted))
    distance = None if depths is None else float(np.median(np.abs(depths)))
    warnings = []
    if reprojection is not None and reprojection > REPROJECTION_LIMIT:
        limit = f"(expected below {REPROJECTION_LIMIT:g})"
        warnings.append(f"the mean reprojection error is {reprojection:.3g} px {limit}: are these its points?")
    warnings += _convention_warnings(matrices(source), source.convention)
    low, high = DISTANCES
    if distance is not None and not low <= distance <= high:
        stand = f"the cameras stand {distance:.3g} m from where they look (expected {low:g} to {high:g})"
        warnings.append(f"{stand}: is scale, the metres in a unit of the source, right? Measure one distance")
    warnings += _up_warnings(matrices(converted), up)
    warnings += [warning for camera in converted.cameras for warning in _center_warnings(camera)][:1]
    count = 0 if converted.observations is None else len(converted.observations.points)
    return Checks(reprojection, count, distance, tuple(warnings))


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


def axes_meeting(poses: Float[np.ndarray, "v 4 4"]) -> tuple[Float[np.ndarray, " v"] | None, Float[np.ndarray, " v"] | None]:
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
    return ((point - centers) * axes).sum(axis=-1), np.linalg.norm(np.einsum("vij,vj->vi", across, point - centers), axis=-1)


def _miss(poses: Float[np.ndarray, "v 4 4"]) -> float:
    """How far axes pass the point where they meet before all cameras, as a share of its distance; infinite if none is."""
    depths, misses = axes_meeting(poses)
    farthest = np.linalg.norm(poses[:, :3, 3], axis=-1).max()
    if depths is None or misses is None or depths.min() <= 0 or np.median(depths) < COINCIDENT * farthest:
        return np.inf
    share = float(np.sqrt(np.mean(misses**2)) / np.median(depths))
    return share if share < MISS else np.inf


def _convention_warnings(poses: Float[np.ndarray, "v 4 4"], convention: str) -> list[str]:
    """Whether another meaning of the matrices in the file would let the cameras look at one place."""
    if axes_meeting(poses)[0] is None or np.isfinite(_miss(poses)):
        return []
    matrices = np.linalg.inv(OPENGL_FROM_OPENCV @ poses) if convention == WORLD_FROM_CAM_OPENGL else poses
    misses = {name: _miss(meaning(matrices)) for name, meaning in CONVENTIONS.items()}
    best = min(misses, key=lambda name: misses[name])
    problem = "the cameras do not look at one place before them"
    if np.isfinite(misses[best]):
        return [f"{problem}; they would if the matrices in the file were {best} (the format says {convention})"]
    return [f"{problem}: is this calibration of photos around a person?"]


def _up_warnings(poses: Float[np.ndarray, "v 4 4"], up: str) -> list[str]:
    """The photos are upright, most of them: the mean of their upward directions tells which axis is up."""
    direction = -poses[:, 1, :3].mean(axis=0)
    length = np.linalg.norm(direction)
    if length < 0.5 or direction[1] / length >= np.cos(np.radians(TILT_LIMIT)):
        return []
    in_source = np.asarray(ROTATION_TO_Y_UP[up]).T @ direction
    best = max(ROTATION_TO_Y_UP, key=lambda axis: float(f"{axis[0]}1") * in_source["xyz".index(axis[1])])
    return [f"the photos do not stand upright with {up} up: --up={best} fits best (or were they taken sideways?)"]


def _center_warnings(camera: CalibratedCamera) -> list[str]:
    if np.abs(camera.K[:2, 2] / (camera.width, camera.height) - 0.5).max() < OFF_CENTER:
        return []
    center, size = f"({camera.K[0, 2]:.1f}, {camera.K[1, 2]:.1f})", f"{camera.width} x {camera.height}"
    problem = f"the principal point {center} is far from the middle of {size}"
    return [f"{camera.name}: {problem}: is K that of photos of another size?"]


# Masks ----------------------------------------------------------------------------------------------------------------

AROUND = 0.8
"""Share of a photo's border that no person covers: a mask that does is inverted."""
EMPTY = "the mask is empty, the photo will be left out"
FULL = "the mask covers the whole photo: is nothing of it background?"
INVERTED = "the mask covers the border of the photo: is it inverted? expected 255 where the person is"


def check_masks(photos: Sequence[Photo]) -> tuple[str, ...]:
    """Warnings about masks, files or alpha channels, one line for each kind of fault, naming the photos.

    Raises: CaptureError for a mask that no capture may have, for masks none of which shows anybody, and, where there are no mask
    files, for an alpha channel in some of the photos only.
    """
    masked = photos[0].mask is not None
    if not masked:
        alphas = [read_checked(has_alpha, photo.image) for photo in photos]
        if not any(alphas):
            return ()
        if not all(alphas):
            file = photos[alphas.index(False)].image
            raise CaptureError(file, "alpha", "expected an alpha channel in all images or in none")
    found: dict[str, list[str]] = {}
    opaque = True
    for photo in photos:
        mask = _mask(photo)
        opaque = opaque and mask.min() == 1
        if (problem := _problem(mask > MASK_THRESHOLD)) is not None:
            found.setdefault(problem, []).append((photo.mask or photo.image).name)
    if not masked and opaque:
        return ()  # many programs write an opaque alpha channel: it says nothing
    if len(found.get(EMPTY, ())) == len(photos):
        first = photos[0].mask or photos[0].image
        raise CaptureError(first, "mask", "empty, as are all of them: expected 255 where the person is")
    return tuple(f"{problem}: {few(names)}" for problem, names in found.items())


def _mask(photo: Photo) -> Float[np.ndarray, "h w"]:
    if photo.mask is None:
        return read_checked(read_image, photo.image)[1]
    width, height = read_checked(image_size, photo.mask)
    return read_mask(photo.mask, "its photo", width, height)


def _problem(person: Bool[np.ndarray, "h w"]) -> str | None:
    if not person.any():
        return EMPTY
    if person.all():
        return FULL
    border = np.concatenate([person[0], person[-1], person[1:-1, 0], person[1:-1, -1]])
    return INVERTED if border.mean() > AROUND else None


def has_alpha(photo: Path) -> bool:
    """Whether a photo has an alpha channel, opaque or not."""
    with open_image(photo) as (image, _):
        return "A" in image.getbands() or "transparency" in image.info
