"""Imports photos and the calibration that another tool made of their cameras (`import_cameras`).
The result is a capture folder without body.

docs/cameras.md describes the formats and their conventions. Photos are copied unchanged if
possible. Otherwise they are turned upright, undistorted and padded as needed. capture.json names
body.npz, which `humangs fit` makes later.
"""

import dataclasses
import functools
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

import numpy as np

from humangs_jax.capture.calibration.checks import Checks, check_calibration, likely_unit
from humangs_jax.capture.calibration.others import (
    find_others,
    is_cut_off,
    not_photographed,
    others_imported,
)
from humangs_jax.capture.calibration.photos import (
    NO_CAMERA,
    Photo,
    Turn,
    check_masks,
    find_photos,
    find_turns,
    has_alpha,
    is_transparent,
    photo_of,
    photo_size,
    turn_notes,
    turned_cameras,
    unused_photos,
    with_photos,
)
from humangs_jax.capture.calibration.videos import photos_of_videos
from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.cameras import (
    ROTATION_TO_Y_UP,
    CalibratedCamera,
    Calibration,
    PixelCenters,
    in_capture_convention,
    read_calibration,
    undistort,
)
from humangs_jax.data.capture_checks import (
    CaptureError,
    check_names,
    check_place,
    checked_camera,
    counted,
    few,
)
from humangs_jax.data.folders import STILL, Unused, scan_folder, unused_line
from humangs_jax.data.photos import check_repeats, names_from_paths, read_checked, write_description
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.images import MASK, is_heic, read_grey, read_image, write_png
from humangs_jax.io.reading import check_limit, reading, write_json

_SIZES_SHOWN = 5
"""Largest number of sizes of photos that a report lists."""


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """What was imported, and how it was read. `str(report)` is what the command line prints."""

    out: Path
    """Folder of the capture."""
    cameras: int
    """Number of cameras."""
    frames: int
    """Number of frames."""
    views: int
    """Number of photos."""
    width: int
    """Width of the photos, pixels."""
    height: int
    """Height of the photos, pixels."""
    undistorted: int
    """Number of photos that were undistorted."""
    turned: int
    """Number of photos that were turned upright, or have a mask that was turned, because of EXIF
    orientations.
    """
    heic: int
    """Number of photos that are HEIC files or have a HEIC mask."""
    masks: bool
    """Whether the import had mask files."""
    checks: Checks
    """What was found out about the calibration."""
    read_as: str
    """How the calibration was read: format, axes, unit and pixel centres."""
    notes: tuple[str, ...]
    """Further lines of the report."""
    warnings: tuple[str, ...]
    """Likely mistakes, one line each."""
    unused: tuple[Unused, ...] = ()
    """Files in the folder of photos that were not used."""

    def __str__(self) -> str:
        photos, cameras = counted(self.views, "photo"), counted(self.cameras, "camera")
        size = f"{self.width} x {self.height}"
        lines = [
            f"{self.out}: {photos} of {size} pixels: {cameras}, {counted(self.frames, 'frame')}",
            self.read_as,
        ]
        if self.undistorted:
            lines.append(f"lens distortion removed from {counted(self.undistorted, 'photo')}")
        if self.checks.reprojection is not None:
            points = counted(self.checks.observations, "observation")
            lines.append(f"mean reprojection error: {self.checks.reprojection:.3g} px ({points})")
        if self.checks.distance is not None:
            lines.append(f"the cameras stand {self.checks.distance:.3g} m from where they look")
        lonely = [each for each in self.unused if each.why.because.startswith(NO_CAMERA)]
        expected = unused_line(each for each in self.unused if each not in lonely)
        warnings = [line for line in (unused_line(lonely), *self.warnings) if line is not None]
        lines += self.notes
        if expected is not None:
            lines.append(expected)
        return "\n".join([*lines, *(f"warning: {warning}" for warning in warnings)])


def import_cameras(
    source: str | Path,
    images: str | Path,
    out: str | Path,
    *,
    masks: str | Path | None = None,
    others: str | Path | None = None,
    scale: float | None = None,
    up: str | None = None,
    pixel_centers: str | None = None,
    every: int = 1,
    frames: int | None = None,
    overwrite: bool = False,
    also: Mapping[str, object] | None = None,
) -> ImportReport:
    """Writes a capture folder of photos and their calibration. If anything fails, nothing is
    written. The folder has no body.npz yet.

    Args:
        source: file or folder in any format of docs/cameras.md. The format is found from the
            content.
        images: folder with the photos, or with a video of each camera (CAMERA.mp4).
        out: the capture folder.
        masks: folder with a mask of each photo, or with a video of masks of each camera. Masks are
            named like their photos or videos. None: the masks that the calibration names, if any.
        others: folder of masks of other people and of things in front of the person. The masks have
            the photos' names. A photo in which nothing covers the person needs no mask.
        scale: metres per unit of the source. None: the unit of the format, or metres. If the
            cameras would then stand too near to a person or too far away, another unit that fits
            is chosen, if there is one.
        up: the axis of the source's world that points up, such as "+y" or "-z". None: as the format
            says.
        pixel_centers: position of the first pixel's centre in the source. "integer" means (0, 0),
            and "half" means (0.5, 0.5). None: as the format says.
        every: step between the frames of a video, or between the moments of several videos.
        frames: largest number of frames of each video. None: all.
        overwrite: whether a capture at `out` is replaced as a whole.
        also: further JSON files that are written to the folder: the content of each by its name.

    Returns: what was imported, and how.

    Raises: ArgumentError for a wrong option. CaptureError for wrong files, and if `out` exists and
    must not be replaced: one line with the file, the field if one is wrong, and the problem.
    OSError if writing fails.
    """
    source, images, out = Path(source), Path(images), Path(out)
    masks = None if masks is None else Path(masks)
    others = None if others is None else Path(others)
    _check_options(scale, up, pixel_centers, every, frames)
    for folder in (images, masks, others):
        if folder is not None and not folder.is_dir():
            raise CaptureError(folder, "", "no such folder")
    check_place(out, overwrite, (source, images, masks, others))
    with photos_of_videos(images, masks, out, every, frames) as found:
        calibration = read_calibration(
            source, functools.partial(photo_size_of, found.images, source)
        )
        calibration, left_out = with_photos(calibration, found.images)
        report = import_calibration(
            calibration,
            found.images,
            out,
            masks=found.masks,
            others=others,
            scale=scale,
            up=up,
            pixel_centers=pixel_centers,
            also=also,
        )
    unused = report.unused
    if found.images != images:  # frames of videos, which are all used
        unused = tuple(Unused(photo, STILL) for photo in scan_folder(images).photos)
    notes = [*report.notes, *found.notes]
    if left_out is not None:
        notes.append(left_out)
    warnings = (*report.warnings, *found.warnings)
    return dataclasses.replace(report, unused=unused, notes=tuple(notes), warnings=warnings)


def photo_size_of(images: Path, source: Path, name: str) -> tuple[int, int]:
    """Returns width and height of the photo that the source calls `name`, pixels.

    If there is no such photo, or if it cannot be read, returns the size of the first photo in the
    folder. An import leaves out a camera without a photo later.

    Raises: CaptureError if the folder has no photos, or if the first one cannot be read.
    """
    try:
        return photo_size(photo_of(images, name, source))
    except CaptureError:
        photos = scan_folder(images).photos
        if not photos:
            raise
        return photo_size(photos[0])


def import_calibration(
    calibration: Calibration,
    images: Path,
    out: Path,
    *,
    masks: Path | None = None,
    others: Path | None = None,
    scale: float | None = None,
    up: str | None = None,
    pixel_centers: str | None = None,
    also: Mapping[str, object] | None = None,
) -> ImportReport:
    """Writes a capture folder of photos and a calibration that is in memory. images: folder with
    the photos. The other arguments and the result are as in `import_cameras`. A capture at `out` is
    replaced.

    Raises: CaptureError for wrong files. ValueError if something other than a capture is at `out`,
    see `replace_folder`. OSError if writing fails.
    """
    up, pixel_centers = up or calibration.up, pixel_centers or calibration.pixel_centers
    about_unit = None
    if scale is None:
        scale, about_unit = likely_unit(calibration)
    photos = find_photos(calibration, images, masks)
    check_repeats(calibration.file, [photo.image for photo in photos])
    in_front = find_others(others, images, [photo.image for photo in photos])
    # photos upright, of one size, with masks
    turns = find_turns(calibration, photos)
    canvas = _canvas(images, photos, turns)
    about_masks = check_masks(photos)
    converted = turned_cameras(
        in_capture_convention(calibration, scale, up, pixel_centers), photos, turns
    )
    for camera in converted.cameras:
        assert camera.width is not None and camera.height is not None  # those of its photos
        checked_camera(
            camera.K,
            camera.cam_from_world,
            camera.width,
            camera.height,
            calibration.file,
            camera.name,
        )
    # what the user should know
    checks = check_calibration(calibration, converted, up)
    frames = 1 + max(photo.frame for photo in photos)
    cameras = calibration.stations or len(converted.cameras)
    notes, warnings = turn_notes(photos, turns)
    heic = sum(map(_of_phones, photos))
    if heic:
        notes.append(f"written as PNG: {counted(heic, 'HEIC photo')}")
    notes += _padding_notes(turns, canvas)
    if about_unit is not None:
        notes.append(about_unit)
    warnings += about_masks
    named_masks, used = _mask_line(calibration, masks, photos)
    if named_masks is not None:
        lines = notes if used else warnings
        lines.append(named_masks)
    if cameras > 1 and frames == len(photos) > 1:
        warnings.append(_no_common_frame(calibration))
    names = names_from_paths([photo.key + ".png" for photo in photos])
    check_names(names, len(photos), images)
    # the folder, all of it or nothing
    cut: list[str] = []

    def write(folder: Path) -> None:
        cut.extend(_write(folder, converted, photos, turns, names, canvas, in_front))
        for name, content in (also or {}).items():
            write_json(folder / name, content)

    replace_folder(out, write, mark="capture.json")
    if cut:
        warnings.append(
            f"the person is cut off at the border of {few(cut, 1)}: what is beyond is unknown"
        )
    centers = "whole numbers (0.5 added to cx and cy)" if pixel_centers == "integer" else "+0.5"
    convention = f"{calibration.format} ({calibration.file}): {calibration.convention}"
    return ImportReport(
        out=out,
        cameras=cameras,
        frames=frames,
        views=len(photos),
        width=canvas[0],
        height=canvas[1],
        undistorted=sum(converted.cameras[photo.camera].distortion is not None for photo in photos),
        turned=sum(turn.rewrites for turn in turns),
        heic=heic,
        masks=photos[0].mask is not None,
        checks=checks,
        read_as=f"read as: {convention}; {up} up; {scale:g} m per unit; pixel centres at {centers}",
        notes=tuple(notes),
        warnings=(*checks.warnings, *warnings),
        unused=tuple(unused_photos(photos, images, calibration)),
    )


def _no_common_frame(calibration: Calibration) -> str:
    """Returns a warning for a calibration in which no two photos show the same frame."""
    if calibration.per_image:
        return "no two photos show the same moment: each is a frame with another pose"
    same = "photos of one frame must have the same file name"
    return f"no two cameras have a photo of the same frame: {same}"


def _mask_line(
    calibration: Calibration, masks: Path | None, photos: Sequence[Photo]
) -> tuple[str | None, bool]:
    """Returns a line about the masks that a calibration names, and whether these masks are used. If
    the calibration names no masks, it returns None and False.
    """
    if calibration.mask_key is None:
        return None, False
    named = f"{calibration.mask_key} of {calibration.file.name}"
    if masks is not None:
        return f"{named}: not used, the masks are those in {masks}", False
    if photos[0].mask is not None:
        return f"masks: those of {named}", True
    first = next(camera.mask for camera in calibration.cameras if camera.mask)
    return f"{named}: no such mask, {first}: imported without masks", False


def _check_options(
    scale: float | None, up: str | None, pixel_centers: str | None, every: int, frames: int | None
) -> None:
    if scale is not None and not 0 < scale < float("inf"):
        raise ArgumentError(
            "scale", f"{scale:g}: expected metres per unit of the source, more than 0"
        )
    for name, word, known in (
        ("up", up, tuple(ROTATION_TO_Y_UP)),
        ("pixel_centers", pixel_centers, get_args(PixelCenters)),
    ):
        if word is not None and word not in known:
            raise ArgumentError(name, f"{word}: expected one of {', '.join(known)}")
    for name, value in (("every", every), ("frames", frames)):
        if value is not None and value < 1:
            raise ArgumentError(name, f"{value}: expected at least 1")


def _canvas(images: Path, photos: Sequence[Photo], turns: Sequence[Turn]) -> tuple[int, int]:
    """Returns the width and height, in pixels, that all written photos get. They are the largest
    width and the largest height of all upright photos.

    Raises: CaptureError if the photos of one camera have different sizes, or if photos have to be
    padded and would then exceed a limit of pixels.
    """
    first = {}
    for photo, turn in zip(photos, turns, strict=True):
        other, size = first.setdefault(photo.camera, (photo, turn.size))
        if turn.size != size:
            own, known = (_by(*each) for each in (turn.size, size))
            problem = (
                f"{own}, but {other.image.name} of the same camera has {known}: expected one size"
                " of a camera"
            )
            raise CaptureError(photo.image, "size", problem)
    width, height = (max(turn.size[axis] for turn in turns) for axis in (0, 1))
    if any(turn.size != (width, height) for turn in turns):
        with reading(images, "folder of photos", CaptureError):
            what = (
                f"pixels ({_by(width, height)}), to which photos of several sizes would be padded"
            )
            check_limit("pixels", width * height, what)
            check_limit(
                "capture_pixels", width * height * len(photos), f"{what}, {len(photos):,} of them"
            )
    return width, height


def _by(width: int, height: int) -> str:
    return f"{width} x {height}"


def _padding_notes(turns: Sequence[Turn], canvas: tuple[int, int]) -> list[str]:
    counts = Counter(turn.size for turn in turns)
    if set(counts) == {canvas}:
        return []
    sizes = ", ".join(
        f"{count} of {_by(*size)}"
        for size, count in sorted(counts.items(), reverse=True)[:_SIZES_SHOWN]
    )
    more = ", ..." if len(counts) > _SIZES_SHOWN else ""
    return [
        f"photos of {len(counts)} sizes ({sizes}{more}): white was added on the right and below, so"
        f" that all have {_by(*canvas)}; pixels keep their places: keypoints of the upright photos"
        " still fit"
    ]


# Writing
# --------------------------------------------------------------------------------------------------


def _write(
    folder: Path,
    calibration: Calibration,
    photos: Sequence[Photo],
    turns: Sequence[Turn],
    names: Sequence[str],
    canvas: tuple[int, int],
    in_front: Mapping[Path, Path],
) -> list[str]:
    """Writes photos, masks, masks of unknown pixels, and capture.json.

    Arguments: in_front: the mask of other people and of things in front, by photo.
    Returns: the names of the photos in which the person is cut off, see `is_cut_off`.
    """
    (folder / "images").mkdir(parents=True)
    if photos[0].mask is not None:
        (folder / "masks").mkdir()
    straight = all(camera.distortion is None for camera in calibration.cameras)
    rewrites = [
        turn.rewrites or turn.size != canvas or _of_phones(photo)
        for photo, turn in zip(photos, turns, strict=True)
    ]
    changed = not straight or any(rewrites)
    transparent = changed and any(is_transparent(photo.image) for photo in photos)
    straight = straight and not transparent
    views, cut = [], []
    for photo, turn, name, rewritten in zip(photos, turns, names, rewrites, strict=True):
        camera = calibration.cameras[photo.camera]
        hidden = None
        if not changed or (straight and not rewritten and not read_checked(has_alpha, photo.image)):
            files = _copy(folder, photo, name)
        else:
            files, mask = _rewrite(folder, photo, turn, name, camera, transparent, canvas)
            hidden = not_photographed(turn.size, camera, canvas)
            # the person who ends before that border does not go on beyond it
            if mask is not None and is_cut_off(mask > MASK_THRESHOLD, hidden):
                cut.append(photo.image.name)
            elif mask is not None:
                hidden = None
        if photo.image in in_front:
            others = others_imported(in_front[photo.image], photo, turn, camera, canvas)
            hidden = others if hidden is None else hidden | others
        if hidden is not None and hidden.any():
            files["unknown"] = f"unknown/{name}.png"
            (folder / "unknown").mkdir(exist_ok=True)
            write_png(folder / files["unknown"], hidden.astype(np.float32), mark=MASK)
        matrices = {"K": camera.K.tolist(), "cam_from_world": camera.cam_from_world.tolist()}
        views.append({**files, "frame": photo.frame, **matrices})
    write_description(folder, views, calibrated=not calibration.estimated)
    return cut


def _of_phones(photo: Photo) -> bool:
    """Returns whether the photo or its mask is a HEIC file. Captures contain no HEIC files, because
    many programs cannot read them.
    """
    return any(
        file is not None and read_checked(is_heic, file) for file in (photo.image, photo.mask)
    )


def _copy(folder: Path, photo: Photo, name: str) -> dict[str, str]:
    files = {"image": f"images/{name}{photo.image.suffix}"}
    shutil.copyfile(photo.image, folder / files["image"])
    if photo.mask is not None:
        files["mask"] = f"masks/{name}{photo.mask.suffix}"
        shutil.copyfile(photo.mask, folder / files["mask"])
    return files


def _rewrite(
    folder: Path,
    photo: Photo,
    turn: Turn,
    name: str,
    camera: CalibratedCamera,
    transparent: bool,
    canvas: tuple[int, int],
) -> tuple[dict[str, str], Float[np.ndarray, "h w"] | None]:
    """Writes a photo and its mask (or its alpha channel as the mask). Both are turned upright,
    undistorted to a pinhole camera, and padded to the canvas. Added pixels are white in the photo
    and 0 in the mask.

    If `transparent` is False, alpha channels are dropped. If it is True, a photo with a mask file
    keeps its alpha channel, too.
    Returns: the paths for capture.json, and the mask as it was written, or None if there is none.
    """
    # upright, and as a pinhole sees them
    image, alpha = read_checked(read_image, photo.image)
    image = turn.upright(image, turn.photo)
    alpha = turn.upright(alpha, turn.photo) if transparent and alpha is not None else None
    mask = alpha
    if photo.mask is not None:
        mask = turn.upright(read_checked(read_grey, photo.mask), turn.mask)
    if camera.distortion is not None:
        image = undistort(image, camera.K, camera.distortion, fill=1.0)
        if mask is not None:
            mask = undistort(mask, camera.K, camera.distortion, fill=0.0)
        if alpha is not None:
            alpha = undistort(alpha, camera.K, camera.distortion, fill=0.0)
    if photo.mask is not None and alpha is not None:
        image = np.concatenate([image, alpha[..., None]], axis=-1)

    files = {"image": f"images/{name}.png"}
    write_png(folder / files["image"], _padded(image, canvas, 1.0))
    if mask is not None:
        files["mask"] = f"masks/{name}.png"
        (folder / "masks").mkdir(exist_ok=True)
        mask = _padded(mask, canvas, 0.0)
        write_png(folder / files["mask"], mask)
    return files, mask


def _padded(
    pixels: Float[np.ndarray, "h w *c"], canvas: tuple[int, int], fill: float
) -> Float[np.ndarray, "height width *c"]:
    """Returns pixels padded on the right and below to the canvas (width, height). fill: value of
    all channels of the added pixels.
    """
    (height, width), (right, below) = pixels.shape[:2], canvas
    if (height, width) == (below, right):
        return pixels
    margins = ((0, below - height), (0, right - width), *((0, 0),) * (pixels.ndim - 2))
    return np.pad(pixels, margins, constant_values=fill)
