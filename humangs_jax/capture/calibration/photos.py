"""Finds the camera, the frame and the mask of each photo by file names, and finds by EXIF
orientation which way up the photo is.

Phones store a portrait photo on its side, with an EXIF flag that says so. About half of all
programs obey the flag. An import turns the pixels upright and writes photos without a flag.

If the camera was calibrated for the pixels as stored (COLMAP), the import turns the camera too. If
the camera was calibrated for the turned photo (OpenCV), its image size shows this.

No camera sees a mirrored photo. If the flag asks for mirroring, and the calibration is of the
pixels as stored, the photo is only turned.
"""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.core.registry import alternatives
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.cameras import CalibratedCamera, Calibration
from humangs_jax.data.capture_checks import CaptureError, checked_path, counted, few
from humangs_jax.data.folders import (
    SAME_NAME,
    SYSTEM_FOLDERS,
    Reason,
    Unused,
    is_photo,
    photo_of_mask,
    photos_in,
    scan_folder,
)
from humangs_jax.data.photos import read_checked, read_mask
from humangs_jax.io.images import (
    PHOTO_SUFFIXES,
    image_size,
    open_image,
    orientation,
    oriented,
    read_grey,
    read_image,
)

_LAYOUTS = "CAMERA/FRAME.jpg, FRAME/CAMERA.jpg or CAMERA.jpg"
"""Layouts in which photos of named cameras are stored, for error messages."""


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photo on disk."""

    image: Path
    """File of the photo."""
    mask: Path | None
    """File of its mask, or None."""
    camera: int
    """Number of its camera, from 0."""
    frame: int
    """Number of its frame, from 0."""
    key: str
    """Path of the photo relative to the folder of photos, with slashes and without suffix."""


MASK_FOLDERS = ("masks", "mask", "mattes", "matte", "silhouettes")
"""Names of folders of masks."""
OTHERS_FOLDERS = ("others", "occluders", "unknown")
"""Names of folders of masks of other people and of things in front of the person."""
NO_PHOTOS = (*MASK_FOLDERS, *OTHERS_FOLDERS)
"""Names of folders whose pictures are not photos of a capture."""
NO_CAMERA = "without a camera in"
"""Beginning of the reason that is given for a photo without a camera."""


def with_photos(calibration: Calibration, images: Path) -> tuple[Calibration, str | None]:
    """Returns the calibration without the cameras that have no photo, and a line about these
    cameras. The line is None if every camera has a photo.

    Raises: CaptureError if no camera has a photo. If the calibration has a camera for each image,
    the error is also raised if an image is missing and the folder has a photo that no camera names:
    the names probably do not match.
    """
    if calibration.per_image:
        there = [_photo_at(images, camera.name) is not None for camera in calibration.cameras]
    else:
        there = [bool(photos) for photos in _frames_of(calibration, images)]
    missing = [
        camera.name for camera, found in zip(calibration.cameras, there, strict=True) if not found
    ]
    if not missing:
        return calibration, None
    if not any(there):
        _refuse_missing(calibration, images, missing[0])
    kept = calibration.with_cameras([i for i, found in enumerate(there) if found])
    if calibration.per_image:
        unused = unused_photos(find_photos(kept, images, None), images, kept)
        if any(each.why.because.startswith(NO_CAMERA) for each in unused):
            # their names do not match: which photo is meant?
            _refuse_missing(calibration, images, missing[0])
    noun = "image" if calibration.per_image else "camera"
    whole = counted(len(there), noun)
    line = (
        f"left out, without a photo: {len(missing)} of {whole} of {calibration.file.name}"
        f" ({few(missing, 4)})"
    )
    return kept, line


def _refuse_missing(calibration: Calibration, images: Path, name: str) -> None:
    """Always raises CaptureError for a camera that has no photo. name: name of the camera."""
    if calibration.per_image:
        photo_of(images, name, calibration.file)
    raise CaptureError(
        calibration.file, name, f"no photo of this camera in {images}: expected {_LAYOUTS}"
    )


def find_photos(calibration: Calibration, images: Path, masks: Path | None) -> tuple[Photo, ...]:
    """Returns the photos of a calibration, ordered by frame and then by camera.

    masks: a folder of masks. None: use the masks that the calibration names, if these files exist.
    Raises: CaptureError if an image that the calibration names is missing, if a camera has no
    photo, if two cameras name the same photo, or if a photo lacks its mask in `masks`. Without
    `masks`, it is raised if some masks that the calibration names exist and others do not.
    """
    if calibration.per_image:
        owners: dict[Path, str] = {}
        for camera in calibration.cameras:
            photo = photo_of(images, camera.name, calibration.file)
            if photo in owners:
                problem = f"{photo} is the photo of {owners[photo]} already: expected one for each"
                raise CaptureError(calibration.file, camera.name, problem)
            owners[photo] = camera.name
        found = [(i, calibration.cameras[i].frame, photo) for i, photo in enumerate(owners)]
    else:
        found = _of_cameras(calibration, images)
    find_mask = None if masks is None else _masks_of(masks, images)
    named: dict[int, Path] = {}
    if masks is None and calibration.mask_key is not None:
        named = _named_masks(calibration, images)
    photos = []
    for camera, frame, image in sorted(found, key=lambda entry: (entry[1], entry[0])):
        key = image.relative_to(images).with_suffix("").as_posix()
        mask = named.get(camera) if find_mask is None else find_mask(image)
        photos.append(Photo(image, mask, camera, frame, key))
    return tuple(photos)


def unused_photos(photos: Sequence[Photo], images: Path, calibration: Calibration) -> list[Unused]:
    """Returns the files in the folder of photos that an import does not use, each with the reason.
    Subfolders with a name in `NO_PHOTOS` are not searched.

    Raises: CaptureError if the folder cannot be read.
    """
    used = {
        file.resolve() for photo in photos for file in (photo.image, photo.mask) if file is not None
    }
    names = {photo.image.with_suffix("") for photo in photos}
    no_camera = Reason("photo", f"{NO_CAMERA} {calibration.file.name}")
    scan = scan_folder(images, lambda place: place.name in NO_PHOTOS)
    unused = [each for each in scan.unused if each.path.resolve() not in used]
    for photo in scan.photos:
        if photo.resolve() not in used:
            why = SAME_NAME if photo.with_suffix("") in names else no_camera
            unused.append(Unused(photo, why))
    return unused


def _named_masks(calibration: Calibration, images: Path) -> dict[int, Path]:
    """Returns the masks that a calibration names, by index of the camera. Masks are looked for in
    the calibration's folder, in the folder of photos, and in the parent of that folder. If no mask
    exists, the result is empty.

    Raises: CaptureError if some cameras have a mask that exists and others have none.
    """
    found: dict[int, Path] = {}
    for i, camera in enumerate(calibration.cameras):
        if not camera.mask:
            continue
        name = camera.mask.replace("\\", "/")
        for folder in (calibration.file.parent, images, images.parent):
            path = _any_suffix(folder / name)
            if path is not None:
                checked_path(folder, path.absolute(), folder)
                found[i] = path
                break
    missing = next((camera for i, camera in enumerate(calibration.cameras) if i not in found), None)
    if found and missing is not None:
        what = f"{missing.mask}: no such mask" if missing.mask else "missing"
        problem = f"{what}, but other images have one: expected all or none, or a folder of masks"
        raise CaptureError(calibration.file, f"{missing.name}: {calibration.mask_key}", problem)
    return found


def photo_of(folder: Path, name: str, file: Path) -> Path:
    """Returns the photo that a calibration file names. The name is a path. It may lack its suffix,
    have another suffix, or begin with folders above `folder`.

    Raises: CaptureError if there is no such photo, or if the photo is a link to a file outside of
    the folder, see `io.reading.inside`.
    """
    photo = _photo_at(folder, name)
    if photo is None:
        raise CaptureError(
            file, name, f"no such photo ({alternatives(PHOTO_SUFFIXES)}) in {folder}"
        )
    checked_path(folder, photo.relative_to(folder), folder)
    return photo


def _photo_at(folder: Path, name: str) -> Path | None:
    parts = [
        part
        for part in PurePosixPath(name.replace("\\", "/")).parts
        if part not in (".", "..", "/")
    ]
    found = (_any_suffix(folder.joinpath(*parts[start:])) for start in range(len(parts)))
    return next((photo for photo in found if photo is not None), None)


def _any_suffix(path: Path) -> Path | None:
    """Returns the path if it is a photo that exists. Otherwise returns the path of an existing file
    whose name is the given name with a photo suffix appended, or with another photo suffix in
    place of its own. None if there is no such file.
    """
    stems, candidates = [path.name], []
    if is_photo(path):
        stems.append(path.stem)
        candidates.append(path)
    # without a suffix all lower or all upper case is looked for; with one, any mix will do
    suffixes = tuple(case(each) for case in (str.lower, str.upper) for each in PHOTO_SUFFIXES)
    candidates += [path.with_name(stem + suffix) for stem in stems for suffix in suffixes]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def photo_size(path: Path) -> tuple[int, int]:
    """Returns the width and height of a stored photo, pixels. The EXIF orientation is not applied.

    Raises: CaptureError if the file cannot be read as an image.
    """
    return read_checked(image_size, path)


def _masks_of(masks: Path, images: Path) -> Callable[[Path], Path]:
    """Returns a function that finds the mask of a photo, see `masks_named_like`. The function
    raises CaptureError if there is no mask.
    """
    find = masks_named_like(masks, images)

    def expect(image: Path) -> Path:
        mask = find(image)
        if mask is None:
            raise CaptureError(
                masks / image.relative_to(images),
                "",
                f"no mask ({alternatives(PHOTO_SUFFIXES)}): expected one for each photo, named"
                " like it",
            )
        return mask

    return expect


def masks_named_like(masks: Path, images: Path) -> Callable[[Path], Path | None]:
    """Returns a function that finds the mask of a photo. The photo lies in the folder `images`, and
    its mask at the same path in the folder `masks`. The function returns None if there is no such
    mask.

    The mask has the photo's name, perhaps with another suffix, with one more suffix (COLMAP) or
    with a word for masks (RealityScan's IMG.jpg.mask.png, Metashape's IMG_mask.png). The mask may
    also lie in a subfolder mask/pha of that place (AvatarReX). Photos and masks may lie in one
    folder. The photo itself is never returned as its mask.
    """
    # each folder is listed once: names with a word for masks, by the photo they are of
    listed: dict[Path, dict[str, Path]] = {}

    def by_words(place: Path) -> Path | None:
        folder = place.parent
        if folder not in listed:
            files = sorted(folder.iterdir()) if folder.is_dir() else []
            named = [
                (photo_of_mask(file.name), file)
                for file in files
                if is_photo(file) and file.is_file()
            ]
            listed[folder] = {name.casefold(): file for name, file in named if name is not None}
        known = listed[folder]
        return known.get(place.name.casefold()) or known.get(place.stem.casefold())

    # a mask of the same path first, then one with a word for masks
    def find(image: Path) -> Path | None:
        path = image.relative_to(images)
        for place in (masks / path, masks / path.parent / "mask" / "pha" / path.name):
            for mask in (_any_suffix(place), by_words(place)):
                if mask is not None and not mask.samefile(image):
                    return mask
        return None

    return find


def _frames_of(calibration: Calibration, images: Path) -> list[dict[str, Path]]:
    """Returns for each camera a mapping from the name of a frame to the camera's photo of it.

    There are three layouts: CAMERA/FRAME.jpg, FRAME/CAMERA.jpg and CAMERA.jpg. All cameras use the
    first of them in which any camera has photos.

    Raises: CaptureError if the name of a camera is a path that leads out of the folder.
    """
    names = [camera.name for camera in calibration.cameras]
    for name in names:  # of a file: "../.." would be any folder
        checked_path(images, name, images)
    # CAMERA/FRAME.jpg
    by_camera = [photos_in(images / name) for name in names]
    if any(by_camera):
        return by_camera
    # FRAME/CAMERA.jpg
    frames = {
        folder.name: photos_in(folder) for folder in images.iterdir() if _may_be_frame(folder)
    }
    by_frame = [
        {frame: photos[name] for frame, photos in frames.items() if name in photos}
        for name in names
    ]
    if any(by_frame):
        return by_frame
    # CAMERA.jpg
    alone = photos_in(images)
    return [{"": alone[name]} if name in alone else {} for name in names]


def _may_be_frame(folder: Path) -> bool:
    return (
        folder.is_dir()
        and not folder.name.startswith(".")
        and folder.name not in (*NO_PHOTOS, *SYSTEM_FOLDERS)
    )


def _of_cameras(calibration: Calibration, images: Path) -> list[tuple[int, int, Path]]:
    frames_of = _frames_of(calibration, images)
    for camera, photos in zip(calibration.cameras, frames_of, strict=True):
        if not photos:
            _refuse_missing(calibration, images, camera.name)
    numbers = {frame for photos in frames_of for frame in photos}
    # numbers are sorted as numbers: 10 after 9
    numbered = all(frame.isdecimal() for frame in numbers)
    order = sorted(numbers, key=lambda f: (int(f), f)) if numbered else sorted(numbers)
    frames = {frame: i for i, frame in enumerate(order)}
    return [
        (i, frames[f], photo) for i, photos in enumerate(frames_of) for f, photo in photos.items()
    ]


# Orientation
# --------------------------------------------------------------------------------------------------

MIRRORED = {2: 1, 4: 3, 5: 6, 7: 8}
"""For each EXIF flag that mirrors, the flag that asks for the same turn without mirroring.
Mirroring is left to right, after the turn.
"""
MIRROR = 2
"""The EXIF flag that mirrors left to right and does not turn."""


@dataclasses.dataclass(frozen=True)
class Turn:
    """How the pixels of a photo and of its mask are turned for an import."""

    photo: int
    """EXIF flag of the photo."""
    mask: int
    """EXIF flag by which the mask is turned."""
    quarters: int
    """Number of clockwise quarter turns of the camera. 0 if the camera was calibrated for the
    turned photo.
    """
    size: tuple[int, int]
    """Width and height of the turned photo, pixels."""
    certain: bool
    """Whether it is known which pixels were calibrated, the stored or the turned ones. It is not
    known if three things hold: the photo has a flag other than 1, the stored and the turned photo
    have the same size, and the format does not say.
    """
    mirrored: bool
    """Whether pixels are mirrored back. This is so if the flag mirrors and the calibration is of
    the pixels as stored.
    """

    def upright(
        self, pixels: Float[np.ndarray, "h w *c"], flag: int
    ) -> Float[np.ndarray, "height width *c"]:
        """Returns pixels turned and mirrored as an EXIF flag asks. If `mirrored` is set, they are
        then mirrored once more.
        """
        return oriented(oriented(pixels, flag), MIRROR if self.mirrored else 1)

    @property
    def rewrites(self) -> bool:
        """Whether the files have to be written anew, because the photo or its mask is turned."""
        return (self.photo, self.mask) != (1, 1)


def find_turns(calibration: Calibration, photos: Sequence[Photo]) -> tuple[Turn, ...]:
    """Returns the turn of each photo.

    Raises: CaptureError if neither the stored nor the turned photo has the size of its calibrated
    camera, or if a mask has another size than its photo. It is also raised if a camera was
    calibrated for the pixels as stored, and the flags of its photos ask for different turns.
    """
    turns = tuple(
        _find_turn(calibration.cameras[photo.camera], photo, calibration.upright)
        for photo in photos
    )
    first: dict[int, tuple[Photo, Turn]] = {}
    for photo, turn in zip(photos, turns, strict=True):
        other, known = first.setdefault(photo.camera, (photo, turn))
        if known.quarters != turn.quarters:
            problem = (
                f"EXIF orientation {turn.photo}, but {other.image.name} of the same camera has"
                f" {known.photo}"
            )
            raise CaptureError(
                photo.image, "", f"{problem}: expected one; turn the photos before calibrating"
            )
    return turns


def _find_turn(camera: CalibratedCamera, photo: Photo, upright: bool) -> Turn:
    flag, stored = read_checked(orientation, photo.image), photo_size(photo.image)
    shown = stored if flag < 5 else stored[::-1]
    calibrated = stored if camera.width is None else (camera.width, camera.height)
    if camera.width is None and flag >= 5:  # the principal point is near the middle
        calibrated = min(stored, shown, key=lambda size: np.abs(camera.K[:2, 2] / size - 0.5).max())
    if calibrated not in (stored, shown):
        flagged = "" if flag == 1 else f" (EXIF orientation {flag})"
        problem = f"was calibrated with {calibrated[0]} x {calibrated[1]}: expected the same"
        if calibrated == stored[::-1]:
            problem += "; was it turned (an EXIF orientation that got lost)?"
        raise CaptureError(photo.image, "size", f"{stored[0]} x {stored[1]}{flagged}, {problem}")
    as_stored = calibrated == stored and not upright
    mask = 1 if photo.mask is None else mask_flag(photo.mask, flag, stored, shown)
    # clockwise quarter turns that a flag asks for
    quarter_turns = {1: 0, 6: 1, 3: 2, 8: 3}
    quarters = quarter_turns[MIRRORED.get(flag, flag)] if as_stored else 0
    certain = flag == 1 or stored != shown or upright
    return Turn(flag, mask, quarters, shown, certain, as_stored and flag in MIRRORED)


def mask_flag(mask: Path, flag: int, stored: tuple[int, int], shown: tuple[int, int]) -> int:
    """Returns the EXIF flag by which a mask is turned.

    If the mask's own flag brings it to the size of the turned photo, this flag is returned. If the
    mask has no flag and is as large as the stored photo, the photo's flag is returned. If the
    stored and the turned photo have the same size, a mask without a flag counts as turned already,
    because most tools that make masks obey the photo's flag.

    flag: EXIF flag of the photo. stored and shown: width and height of the photo before and after
    it is turned, pixels.
    Raises: CaptureError for any other mask.
    """
    own, size = read_checked(orientation, mask), photo_size(mask)
    size = size if own < 5 else size[::-1]
    if size == shown:
        return own
    if own == 1 and size == stored:
        return flag
    wanted = " or ".join(f"{width} x {height}" for width, height in dict.fromkeys((shown, stored)))
    raise CaptureError(
        mask, "size", f"{size[0]} x {size[1]}, but its photo has {wanted}: expected the same"
    )


def upright_mask(masks: Path, images: Path, image: Path) -> Float[np.ndarray, "h w"]:
    """Reads the mask of a photo, turned as the photo is shown, (h, w), 0 to 1. masks: folder of
    masks. images: folder of photos. image: the photo.

    Raises: CaptureError if there is no mask, if it has another size than the photo, or if a file
    cannot be read.
    """
    return mask_as_shown(_masks_of(masks, images)(image), image)


def mask_as_shown(mask: Path, image: Path) -> Float[np.ndarray, "h w"]:
    """Reads a mask, turned as its photo is shown, (h, w), 0 to 1.

    Raises: CaptureError if the mask has another size than the photo, or if a file cannot be read.
    """
    flag, stored = read_checked(orientation, image), photo_size(image)
    shown = stored if flag < 5 else stored[::-1]
    return oriented(read_checked(read_grey, mask), mask_flag(mask, flag, stored, shown))


def turned_cameras(
    calibration: Calibration, photos: Sequence[Photo], turns: Sequence[Turn]
) -> Calibration:
    """Returns the calibration of the imported photos. Cameras and observed pixels are turned, and
    cameras have the sizes of the turned photos. The calibration has to be in the convention of
    captures.
    """
    cameras, seen = list(calibration.cameras), calibration.observations
    pixels = None if seen is None else seen.pixels.copy()
    turn_of = {photo.camera: turn for photo, turn in zip(photos, turns, strict=True)}
    for i, turn in turn_of.items():
        width, height = turn.size if turn.quarters % 2 == 0 else turn.size[::-1]
        camera = dataclasses.replace(cameras[i], width=width, height=height)
        for _ in range(turn.quarters):
            if seen is not None and pixels is not None:
                own = seen.cameras == i
                pixels[own] = np.stack([camera.height - pixels[own, 1], pixels[own, 0]], axis=-1)
            camera = _quarter_turned(camera)
        cameras[i] = camera
    if seen is not None and pixels is not None:
        seen = dataclasses.replace(seen, pixels=pixels)
    return dataclasses.replace(calibration, cameras=tuple(cameras), observations=seen)


def _quarter_turned(camera: CalibratedCamera) -> CalibratedCamera:
    """Returns the camera of the photo after a clockwise quarter turn. Pixel (x, y) moves to (height
    - y, x), and the camera's axes turn in the same way.
    """
    assert camera.width is not None and camera.height is not None
    turn = np.asarray([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    move = turn.copy()
    move[0, 2] = camera.height
    pose, distortion = camera.cam_from_world.copy(), camera.distortion
    pose[:3] = turn @ pose[:3]
    if distortion is not None:  # (p2, p1) is a vector of the image plane
        k1, k2, p1, p2, k3 = distortion
        distortion = np.asarray([k1, k2, p2, -p1, k3])
    return dataclasses.replace(
        camera,
        K=move @ camera.K @ turn.T + 0.0,
        cam_from_world=pose + 0.0,
        width=camera.height,
        height=camera.width,
        distortion=distortion,
    )


def turn_notes(photos: Sequence[Photo], turns: Sequence[Turn]) -> tuple[list[str], list[str]]:
    """Returns notes and warnings about EXIF orientations.

    A note counts the photos that have to be turned. One warning is about photos whose size does not
    show whether the calibration is of the stored or of the turned photo. Another warning names a
    photo that is turned but not mirrored, although its flag asks for both.
    """
    flagged = [(photo, turn) for photo, turn in zip(photos, turns, strict=True) if turn.photo != 1]
    if not flagged:
        return [], []
    whole = "the calibration is of the turned photos"
    if any(turn.quarters or turn.mirrored for _, turn in flagged):
        whole = "their cameras, too: the calibration is of the pixels as stored"
    notes = [f"turned upright by the EXIF orientation: {counted(len(flagged), 'photo')} ({whole})"]
    warnings = []
    unsure = [(photo, turn) for photo, turn in flagged if not turn.certain]
    if unsure:
        which = few([photo.image.name for photo, _ in unsure], 1)
        of_masks = ", the mask to be of the turned photo" if unsure[0][0].mask is not None else ""
        warnings.append(
            f"EXIF orientation {unsure[0][1].photo} of {which}: the calibration is taken to be of"
            f" the stored pixels{of_masks}; their sizes do not tell. If that is wrong, save the"
            " photos turned"
        )
    mirrored = [photo.image.name for photo, turn in flagged if turn.mirrored]
    if mirrored:
        warnings.append(
            f"EXIF asks to mirror {mirrored[0]}: turned, not mirrored, as no camera sees so"
        )
    return notes, warnings


# Masks
# --------------------------------------------------------------------------------------------------

_EMPTY = "the mask is empty, the photo will be left out"
"""Warning about a mask that shows nobody."""


def check_masks(photos: Sequence[Photo]) -> tuple[str, ...]:
    """Checks masks, which are files or alpha channels. Returns a warning for each kind of fault,
    with the names of the files. If there are neither masks nor transparent pixels, there is no
    warning.

    Raises: CaptureError if a mask is not valid, if no mask shows anybody, or if there are no mask
    files and only some photos have an alpha channel.
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
        if photo.mask is None:
            mask = read_checked(read_image, photo.image)[1]
        else:
            mask = read_mask(photo.mask, "its photo", *photo_size(photo.mask))
        opaque = opaque and mask.min() == 1
        problem = _mask_problem(mask > MASK_THRESHOLD)
        if problem is not None:
            found.setdefault(problem, []).append((photo.mask or photo.image).name)
    if not masked and opaque:
        return ()  # many programs write an opaque alpha channel: it says nothing
    if len(found.get(_EMPTY, ())) == len(photos):
        first = photos[0].mask or photos[0].image
        raise CaptureError(
            first, "mask", "empty, as are all of them: expected 255 where the person is"
        )
    return tuple(f"{problem}: {few(names)}" for problem, names in found.items())


def _mask_problem(person: Bool[np.ndarray, "h w"]) -> str | None:
    """Returns a line about what is wrong with a mask, or None. person: whether each pixel shows the
    person, (h, w).
    """
    if not person.any():
        return _EMPTY
    if person.all():
        return "the mask covers the whole photo: is nothing of it background?"
    border = np.concatenate([person[0], person[-1], person[1:-1, 0], person[1:-1, -1]])
    if border.mean() > 0.8:  # no person covers that much of it
        return (
            "the mask covers the border of the photo: is it inverted? expected 255 where the"
            " person is"
        )
    return None


def has_alpha(photo: Path) -> bool:
    """Returns whether a photo has an alpha channel, opaque or not.

    Raises: FileNotFoundError; FileError if the file cannot be read.
    """
    with open_image(photo) as (image, _):
        return "A" in image.getbands() or "transparency" in image.info


def is_transparent(photo: Path) -> bool:
    """Returns whether any pixel of a photo is transparent, fully or partly.

    Raises: CaptureError if the file cannot be read.
    """
    if not read_checked(has_alpha, photo):
        return False
    alpha = read_checked(read_image, photo)[1]
    return alpha is not None and bool(alpha.min() < 1)
