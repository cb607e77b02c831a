"""`import_cameras`: photos and the calibration that another tool made of their cameras -> a capture folder without body.

docs/cameras.md describes the formats and their conventions. Photos are copied as they are, or undistorted where the lens
asks for it; capture.json names body.npz, which `humangs fit` makes.
"""

import dataclasses
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from humangs_jax.data.calibration.calibration import (
    ROTATION_TO_Y_UP,
    Calibration,
    PixelCenters,
    in_capture_convention,
    undistort,
)
from humangs_jax.data.calibration.checks import Checks, check_calibration
from humangs_jax.data.calibration.formats import read_calibration
from humangs_jax.data.calibration.mask_checks import check_masks, has_alpha
from humangs_jax.data.calibration.orientation import Turn, find_turns, turn_notes, turned_cameras
from humangs_jax.data.calibration.photos import Photo, find_photo, find_photos, photo_size
from humangs_jax.data.calibration.videos import photos_of_videos
from humangs_jax.data.capture_checks import CaptureError, check_names, check_place, checked_camera
from humangs_jax.data.photos import check_repeats, names_from_paths, read_checked, write_description
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.images import read_grey, read_image, write_png

NO_COMMON_MOMENT = "no two photos show the same moment: each is a frame with a pose of its own"
NO_COMMON_FRAME = "no two cameras have a photo of the same frame: photos of one frame must have the same file name"


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What was imported and how it was read; `str(report)` is what the command line prints.

    notes: further lines about it. masks: whether it has mask files. turned: photos that were turned upright, see `orientation`.
    """

    out: Path
    format: str
    source: Path
    cameras: int
    frames: int
    views: int
    width: int
    height: int
    scale: float
    up: str
    pixel_centers: str
    convention: str
    undistorted: int
    checks: Checks
    notes: tuple[str, ...] = ()
    masks: bool = False
    turned: int = 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """Likely mistakes."""
        return self.checks.warnings

    def __str__(self) -> str:
        count = lambda n, noun: f"{n} {noun}{'' if n == 1 else 's'}"
        photos, frames, cameras = count(self.views, "photo"), count(self.frames, "frame"), count(self.cameras, "camera")
        centers = "whole numbers (0.5 added to cx and cy)" if self.pixel_centers == "integer" else "+0.5"
        lines = [
            f"{self.out}: {photos} of {self.width} x {self.height} pixels: {cameras}, {frames}",
            f"read as: {self.format} ({self.source}): {self.convention}; {self.up} up; "
            f"{self.scale:g} m per unit; pixel centres at {centers}",
        ]
        if self.undistorted:
            lines.append(f"lens distortion removed from {count(self.undistorted, 'photo')}")
        if self.checks.reprojection is not None:
            error, points = self.checks.reprojection, count(self.checks.observations, "observation")
            lines.append(f"mean reprojection error: {error:.3g} px ({points})")
        if self.checks.distance is not None:
            lines.append(f"the cameras stand {self.checks.distance:.3g} m from where they look")
        return "\n".join([*lines, *self.notes, *(f"warning: {warning}" for warning in self.warnings)])


def import_cameras(
    source: str | Path,
    images: str | Path,
    out: str | Path,
    *,
    masks: str | Path | None = None,
    scale: float | None = None,
    up: str | None = None,
    pixel_centers: str | None = None,
    every: int = 1,
    frames: int | None = None,
    overwrite: bool = False,
) -> ImportReport:
    """Write a capture folder (all of it or nothing) of photos and their calibration; body.npz is still to be made.

    Arguments:
        source: file or folder of any format in docs/cameras.md; its content decides which one.
        images: folder of the photos, or of a video of each camera (CAMERA.mp4). masks: folder of their masks, named alike.
        out: the capture folder. With `overwrite` a capture that is there is replaced as a whole.
        scale: metres per unit of the source; 1 if None.
        up: the axis of the source's world that points up, "+y", "-z", ...; None: the format's.
        every, frames: of videos, the frame step and the largest number of frames.
        pixel_centers: where the source has the centre of its first pixel, "integer": (0, 0), "half": (0.5, 0.5);
            None: as the format says.

    Raises: ValueError for an option, CaptureError (one line: file, field, what was expected) for everything else.
    """
    source, images, out = Path(source), Path(images), Path(out)
    masks = None if masks is None else Path(masks)
    scale = 1.0 if scale is None else scale
    _check_options(scale, up, pixel_centers)
    for name, value in (("every", every), ("frames", frames)):
        if value is not None and value < 1:
            raise ValueError(f"--{name} {value}: expected at least 1")
    _check_folders(source, images, masks, out, overwrite)
    with photos_of_videos(images, masks, out, every, frames) as (images, masks):
        return _import(source, images, masks, out, scale, up, pixel_centers)


def _import(source, images, masks, out, scale, up, pixel_centers):
    calibration = read_calibration(source, lambda name: _size_by_name(images, name, source))
    up, pixel_centers = up or calibration.up, pixel_centers or calibration.pixel_centers
    photos = find_photos(calibration, images, masks)
    check_repeats(calibration.file, [photo.image for photo in photos])
    turns = find_turns(calibration, photos)
    _check_one_size(photos, turns)
    about_masks = check_masks(photos)
    converted = turned_cameras(in_capture_convention(calibration, scale, up, pixel_centers), photos, turns)
    for camera in converted.cameras:
        checked_camera(camera.K, camera.cam_from_world, *_size(camera), calibration.file, camera.name)
    checks = check_calibration(calibration, converted, up)
    frames, cameras = 1 + max(photo.frame for photo in photos), calibration.stations or len(converted.cameras)
    notes, about_turns = turn_notes(photos, turns)
    more = [*about_turns, *about_masks, *_unused_masks(calibration, photos, masks)]
    if cameras > 1 and frames == len(photos) > 1:
        more.append(NO_COMMON_MOMENT if calibration.per_image else NO_COMMON_FRAME)
    checks = dataclasses.replace(checks, warnings=(*checks.warnings, *more))
    names = names_from_paths([photo.key + ".png" for photo in photos])
    check_names(names, len(photos), images)
    replace_folder(out, lambda folder: _write(folder, converted, photos, turns, names), mark="capture.json")
    return ImportReport(
        out=out,
        format=calibration.format,
        source=calibration.file,
        cameras=cameras,
        frames=frames,
        views=len(photos),
        width=_size(converted.cameras[0])[0],
        height=_size(converted.cameras[0])[1],
        scale=scale,
        up=up,
        pixel_centers=pixel_centers,
        convention=calibration.convention,
        undistorted=sum(converted.cameras[photo.camera].distortion is not None for photo in photos),
        checks=checks,
        notes=(*notes, *_named_masks(calibration, photos, masks)),
        masks=photos[0].mask is not None,
        turned=sum(turn.rewrites for turn in turns),
    )


def _named_masks(calibration, photos, masks):
    if masks is not None or photos[0].mask is None:
        return ()
    return (f"masks: those that {calibration.file.name} names ({calibration.mask_key})",)


def _unused_masks(calibration, photos, masks):
    """A warning about masks that the calibration names and the capture does not get."""
    if calibration.mask_key is None or (masks is None and photos[0].mask is not None):
        return ()
    named = f"{calibration.mask_key} of {calibration.file.name}"
    if masks is not None:
        return (f"{named}: not used, the masks are those in {masks}",)
    first = next(camera.mask for camera in calibration.cameras if camera.mask)
    return (f"{named}: no such mask, {first}: imported without masks",)


def _check_options(scale, up, pixel_centers):
    if not 0 < scale < float("inf"):
        raise ValueError(f"--scale {scale:g}: expected metres per unit of the source, more than 0")
    if up is not None and up not in ROTATION_TO_Y_UP:
        raise ValueError(f"--up {up}: expected one of {', '.join(ROTATION_TO_Y_UP)}")
    if pixel_centers is not None and pixel_centers not in get_args(PixelCenters):
        raise ValueError(f"--pixel-centers {pixel_centers}: expected {' or '.join(get_args(PixelCenters))}")


def _check_folders(source, images, masks, out, overwrite):
    for folder in (images, masks):
        if folder is not None and not folder.is_dir():
            raise CaptureError(folder, "", "no such folder")
    check_place(out, overwrite)
    inside = lambda path: Path(os.path.realpath(path)).is_relative_to(
        os.path.realpath(out)
    )  # resolve() raises for loops
    for path in (source, images, masks):
        if path is not None and inside(path):
            raise CaptureError(path, "", f"lies in {out}, which would be overwritten: expected another place")


def _size_by_name(images, name, source):
    photo = find_photo(images, name)
    if photo is None:
        raise CaptureError(source, name, f"no such photo (PNG or JPEG) in {images}")
    return photo_size(photo)


def _size(camera):
    assert camera.width is not None and camera.height is not None  # _with_photo_sizes has been here
    return camera.width, camera.height


def _check_one_size(photos, turns):
    """Raises: CaptureError unless all photos have one size when they are upright."""
    for photo, turn in zip(photos, turns, strict=True):
        if turn.size != turns[0].size:
            own, first = (" x ".join(map(str, size)) for size in (turn.size, turns[0].size))
            raise CaptureError(photo.image, "size", f"{own}, but {photos[0].image.name} has {first}: expected one size")


# Writing -------------------------------------------------------------------------------------------------------------


def _write(
    folder: Path, calibration: Calibration, photos: Sequence[Photo], turns: Sequence[Turn], names: Sequence[str]
) -> None:
    (folder / "images").mkdir(parents=True)
    if photos[0].mask is not None:
        (folder / "masks").mkdir()
    straight = all(camera.distortion is None for camera in calibration.cameras)
    changed = not straight or any(turn.rewrites for turn in turns)
    transparent = changed and any(_is_transparent(photo.image) for photo in photos)
    straight = straight and not transparent
    views = []
    for photo, turn, name in zip(photos, turns, names, strict=True):
        camera = calibration.cameras[photo.camera]
        as_it_is = not changed or (straight and not turn.rewrites and not read_checked(has_alpha, photo.image))
        files = _copy(folder, photo, name) if as_it_is else _rewrite(folder, photo, turn, name, camera, transparent)
        matrices = {"K": camera.K.tolist(), "cam_from_world": camera.cam_from_world.tolist()}
        views.append({**files, "frame": photo.frame, **matrices})
    write_description(folder, views)


def _copy(folder, photo, name):
    """The files as they are; their paths for capture.json."""
    files = {"image": f"images/{name}{photo.image.suffix}"}
    shutil.copyfile(photo.image, folder / files["image"])
    if photo.mask is not None:
        files["mask"] = f"masks/{name}{photo.mask.suffix}"
        shutil.copyfile(photo.mask, folder / files["mask"])
    return files


def _is_transparent(photo):
    """Whether any pixel is."""
    alpha = read_checked(read_image, photo)[1]
    return alpha is not None and alpha.min() < 1


def _rewrite(folder, photo, turn, name, camera, transparent):
    """Photo and mask (or its alpha) upright, and as a pinhole sees them; pixels that it does not see are white and background.

    A photo that has alpha besides its mask keeps it. Opaque alpha, where no photo is `transparent`, is left out.
    """
    image, alpha = read_checked(read_image, photo.image)
    image, alpha = turn.image(image), turn.image(alpha) if transparent and alpha is not None else None
    mask = alpha if photo.mask is None else turn.of_mask(read_checked(read_grey, photo.mask))
    if camera.distortion is not None:
        image = undistort(image, camera.K, camera.distortion, fill=1.0)
        mask, alpha = (x if x is None else undistort(x, camera.K, camera.distortion, fill=0.0) for x in (mask, alpha))
    if photo.mask is not None and alpha is not None:
        image = np.concatenate([image, alpha[..., None]], axis=-1)
    files = {"image": f"images/{name}.png"}
    write_png(folder / files["image"], image)
    if mask is not None:
        files["mask"] = f"masks/{name}.png"
        (folder / "masks").mkdir(exist_ok=True)
        write_png(folder / files["mask"], mask)
    return files
