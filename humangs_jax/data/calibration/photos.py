"""Which photo belongs to which camera and to which frame, by file names."""

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from humangs_jax.data.calibration.calibration import Calibration
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import read_checked
from humangs_jax.io.images import image_size
from humangs_jax.io.reading import inside, reading

SUFFIXES = tuple(case(each) for case in (str.lower, str.upper) for each in (".png", ".jpg", ".jpeg", ".heic", ".heif"))
"""File types of photos that are looked for by a name without one; with one, any mix of cases will do."""
LAYOUTS = "CAMERA/FRAME.jpg, FRAME/CAMERA.jpg or CAMERA.jpg"


@dataclasses.dataclass(frozen=True)
class Photo:
    """A photo on disk: its camera and its frame (both counted from 0), and its mask or None.

    key: path relative to the folder of photos with slashes and without suffix.
    """

    image: Path
    mask: Path | None
    camera: int
    frame: int
    key: str


def find_photos(calibration: Calibration, images: Path, masks: Path | None) -> tuple[Photo, ...]:
    """The photos of a calibration, frame after frame.

    masks: a folder; None: where the calibration names masks that are there, these.
    Raises: CaptureError if an image of the calibration, or all of a camera, or a mask, is not there, or some of the named ones.
    """
    if calibration.per_image:
        names = [camera.name for camera in calibration.cameras]
        found = [(i, calibration.cameras[i].frame, photo) for i, photo in _of_images(images, names, calibration.file)]
        found.sort(key=lambda entry: (entry[1], entry[0]))
    else:
        found = _of_cameras(calibration, images)
    named = {} if masks is not None or calibration.mask_key is None else _named_masks(calibration, images)
    photos = []
    for camera, frame, image in found:
        key = image.relative_to(images).with_suffix("").as_posix()
        mask = named.get(camera) if masks is None else _mask(masks, images, image)
        photos.append(Photo(image, mask, camera, frame, key))
    return tuple(photos)


def _named_masks(calibration, images):
    """The masks that a calibration names, by camera: in its folder, in that of the photos or in the one around. All or none."""
    found, missing = {}, None
    for i, camera in enumerate(calibration.cameras):
        path = None
        for folder in (calibration.file.parent, images, images.parent) if camera.mask else ():
            path = _any_suffix(folder / camera.mask.replace("\\", "/"))
            if path is not None:
                _check_inside(folder, path.absolute())
                found[i] = path
                break
        if path is None and missing is None:
            missing = camera
    if found and missing is not None:
        what = f"{missing.mask}: no such mask" if missing.mask else "missing"
        problem = f"{what}, but other images have one: expected all or none, or a folder of masks"
        raise CaptureError(calibration.file, f"{missing.name}: {calibration.mask_key}", problem)
    return found


def find_photo(folder: Path, name: str) -> Path | None:
    """The photo of a path that may lack its suffix, have another one, or begin with folders above `folder`.

    Raises: CaptureError for a link to what is outside of the folder, see `io.reading.inside`.
    """
    parts = PurePosixPath(name.replace("\\", "/")).parts
    parts = [part for part in parts if part not in (".", "..", "/")]
    found = (_any_suffix(folder.joinpath(*parts[start:])) for start in range(len(parts)))
    photo = next((photo for photo in found if photo is not None), None)
    if photo is not None:
        _check_inside(folder, photo.relative_to(folder))
    return photo


def _check_inside(folder, name):
    with reading(folder, "path", CaptureError):
        inside(folder, str(name), photo=True)


def _any_suffix(path):
    """The file, or the one of that name with another suffix of photos, or with one more."""
    stems = [path.name, path.stem] if is_photo(path) else [path.name]
    candidates = [path] if is_photo(path) else []
    candidates += [path.with_name(stem + suffix) for stem in stems for suffix in SUFFIXES]
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def is_photo(path: Path) -> bool:
    """Whether a file is called like a photo."""
    return path.suffix.lower() in SUFFIXES


def photo_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, of the file's head alone. Raises: CaptureError if it is no image."""
    return read_checked(image_size, path)


def _of_images(images, names, file):
    """(camera, photo) where each image has a camera of its own."""
    photos: dict[Path, str] = {}
    for name in names:
        photo = find_photo(images, name)
        if photo is None:
            raise CaptureError(file, name, f"no such photo (PNG or JPEG) in {images}")
        if photo in photos:
            raise CaptureError(file, name, f"{photo} is the photo of {photos[photo]} already: expected one for each")
        photos[photo] = name
    return list(enumerate(photos))


def _mask(masks, images, image):
    """The mask at the same path in the folder of masks (COLMAP: with one more suffix); AvatarReX: in mask/pha beside the photo.

    AvatarReX has photos and masks in one folder, so that the photo itself can be what is found first.
    """
    path = image.relative_to(images)
    for place in (path, path.parent / "mask" / "pha" / path.name):
        if (mask := _any_suffix(masks / place)) is not None and not mask.samefile(image):
            return mask
    raise CaptureError(masks / path, "", "no mask (PNG or JPEG): expected one for each photo, named like it")


def _of_cameras(calibration, images):
    """(camera, frame, photo) where each camera took one photo or several."""
    names = [camera.name for camera in calibration.cameras]
    layouts = (_folders_of_cameras(images, names), _folders_of_frames(images, names), _single_photos(images, names))
    frames_of = next((layout for layout in layouts if any(layout)), None)
    if frames_of is None:
        shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
        raise CaptureError(images, "", f"no photo of the cameras {shown}: expected {LAYOUTS}")
    for name, photos in zip(names, frames_of, strict=True):
        if not photos:
            raise CaptureError(calibration.file, name, f"no photo of this camera in {images}: expected {LAYOUTS}")
    frames = {frame: i for i, frame in enumerate(_in_order({f for photos in frames_of for f in photos}))}
    found = [(i, frames[f], photo) for i, photos in enumerate(frames_of) for f, photo in photos.items()]
    return sorted(found, key=lambda entry: (entry[1], entry[0]))


def _folders_of_cameras(images, names):
    """For each camera, frame name -> photo."""
    for name in names:  # of a file: "../.." would be any folder
        _check_inside(images, name)
    return [{p.stem: p for p in _photos_in(images / name)} for name in names]


def _folders_of_frames(images, names):
    folders = [entry for entry in images.iterdir() if entry.is_dir()]
    of_frame = {folder.name: {p.stem: p for p in _photos_in(folder)} for folder in folders}
    return [{frame: photos[name] for frame, photos in of_frame.items() if name in photos} for name in names]


def _single_photos(images, names):
    photos = {p.stem: p for p in _photos_in(images)}
    return [{"": photos[name]} if name in photos else {} for name in names]


def _photos_in(folder):
    if not folder.is_dir():
        return []
    return [Path(entry.path) for entry in os.scandir(folder) if is_photo(Path(entry.name)) and entry.is_file()]


def _in_order(names: Iterable[str]) -> list[str]:
    """Names sorted by number where all are numbers (10 after 9), else by letter."""
    names = list(names)
    return sorted(names, key=lambda name: (int(name), name)) if all(n.isdecimal() for n in names) else sorted(names)
