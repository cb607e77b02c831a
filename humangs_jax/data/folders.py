"""Finds the photos to use in a folder, and the files that are not used, each with the reason.

Every command that looks for photos in a folder and its subfolders calls `scan_folder`. So all
commands take the same files and can say what they leave out. Names that begin with a dot are no
photos: macOS writes `._IMG_1.jpg` beside `IMG_1.jpg` on disks of other systems.
"""

import dataclasses
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

from humangs_jax.data.capture_checks import CaptureError, counted, few
from humangs_jax.io.images import PHOTO_SUFFIXES, is_own_picture
from humangs_jax.io.reading import reading, walk

VIDEO_SUFFIXES = (".mp4", ".m4v", ".mov", ".mkv", ".avi")
"""File types of videos that are read."""
OTHER_PICTURES = (
    ".tif",
    ".tiff",
    ".bmp",
    ".gif",
    ".jxl",
    ".jp2",
    ".jfif",
    ".mpo",
    ".psd",
    ".tga",
    ".exr",
    ".hdr",
    ".ppm",
    ".pgm",
)
"""File types of pictures that are not read, but that somebody may take for photos."""
RAW_PICTURES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2")
"""File types of raw pictures, which cameras write besides JPEG and which are not read."""
OTHER_VIDEOS = (".webm", ".mts", ".m2ts", ".3gp", ".wmv", ".mpg")
"""File types of videos that are not read."""
SYSTEM_FOLDERS = ("__MACOSX", "@eaDir")
"""Names of folders that archives of macOS and disks of Synology have beside the photos. They are
not searched.
"""
NAMES_SHOWN = 3
"""Largest number of unused files that are named for each reason."""

_WORDS = "(?:masks?|mattes?|alpha|silhouettes?|seg|segmentation)"
_MASK_BEHIND = re.compile(rf"(?P<photo>.+?)[._ -]+{_WORDS}", re.IGNORECASE)
_MASK_BEFORE = re.compile(rf"{_WORDS}[._ -]+(?P<photo>.+)", re.IGNORECASE)


@dataclasses.dataclass(frozen=True)
class Reason:
    """The reason why files are not used, as in "2 videos beside photos"."""

    noun: str
    """The kind of the files, in the singular."""
    because: str
    """The words that follow the kind, such as "beside photos"."""


CLIP = Reason("video", "beside photos")
STILL = Reason("photo", "beside the videos whose frames were asked for")
OWN = Reason("picture", "that humangs drew")
ELSEWHERE = Reason("photo", "outside of the folder of photos")
SAME_NAME = Reason("photo", "with the name of another one")
MASK = Reason("mask", "beside photos")
CAPTURE = Reason("folder", "that is a capture already")


@dataclasses.dataclass(frozen=True)
class Unused:
    """A file or a folder that is not used."""

    path: Path
    """The path of the file or folder."""
    why: Reason
    """The reason."""


@dataclasses.dataclass(frozen=True)
class FolderScan:
    """The photos in a folder and its subfolders, and the files that are not used."""

    folder: Path
    """The folder that was searched."""
    photos: tuple[Path, ...]
    """The photos, sorted by path."""
    unused: tuple[Unused, ...] = ()
    """The files and folders that are not used, sorted by path. Videos that could be read
    (`VIDEO_SUFFIXES`) are among them only if there are photos. Files that nobody takes for a photo
    or a video are not among them.
    """
    masks: tuple[Path, ...] = ()
    """The masks of the photos, if each photo has a mask in its own folder. Otherwise this is empty,
    and the masks are in `unused`.
    """


def scan_folder(folder: Path, skip: Callable[[Path], bool] = lambda place: False) -> FolderScan:
    """Find the photos of a folder and its subfolders, and the files that are not used. Subfolders
    that are captures are not searched. A folder that does not exist has no photos.

    Arguments: skip: returns whether a subfolder holds something other than photos. Such a subfolder
    is not searched.
    Raises: CaptureError if the folder cannot be read, or holds more than the limit `entries`.
    """
    if not folder.is_dir():
        return FolderScan(folder, ())
    # folders that are captures already, and those of previews, are not looked into
    captures: list[Path] = []

    def skipped(place: Path) -> bool:
        if place.name in SYSTEM_FOLDERS or skip(place):
            return True
        is_capture = (place / "capture.json").exists()
        if is_capture:
            captures.append(place)
        return is_capture

    with reading(folder, "folder of photos", CaptureError):
        files = sorted(walk(folder, skipped))
    # pictures are photos, masks of these, or drawn by this program
    pictures = [file for file in files if is_photo(file)]
    unused = [Unused(place, CAPTURE) for place in captures]
    unused += [Unused(file, OWN) for file in pictures if is_own_picture(file)]
    own = {each.path for each in unused}
    pictures = [file for file in pictures if file not in own]
    masks = _masks_beside(pictures)
    photos = [file for file in pictures if file not in masks]
    whole = len(set(masks.values())) == len(photos)  # else who knows which of them are meant
    if not whole:
        unused += [Unused(file, MASK) for file in masks]
    # what a user may have meant as photos is named, all else is not
    for file in files:
        suffix = file.suffix.lower()
        if suffix in VIDEO_SUFFIXES and photos:
            unused.append(Unused(file, CLIP))
        elif suffix in OTHER_PICTURES + RAW_PICTURES + OTHER_VIDEOS:
            unused.append(Unused(file, Reason("file", "in a format that is not read")))
    return FolderScan(
        folder,
        tuple(photos),
        tuple(sorted(unused, key=lambda each: each.path)),
        tuple(masks) if whole else (),
    )


def photos_in(folder: Path) -> dict[str, Path]:
    """Returns the photos that lie directly in a folder, by their names without suffix. Masks of
    these photos and pictures that humangs drew are left out.

    Of several photos with one name, the one with the first suffix of `PHOTO_SUFFIXES` is taken.
    """
    if not folder.is_dir():
        return {}
    with os.scandir(folder) as entries:
        files = [
            Path(entry.path) for entry in entries if is_photo(Path(entry.name)) and entry.is_file()
        ]
    files = [file for file in files if not is_own_picture(file)]
    beside = _masks_beside(files)
    photos = [file for file in files if file not in beside]
    preferred = sorted(
        photos,
        key=lambda file: (PHOTO_SUFFIXES.index(file.suffix.lower()), file.name),
        reverse=True,
    )
    return {file.stem: file for file in preferred}


def is_photo(path: Path) -> bool:
    """Returns whether a file has the name of a photo."""
    return path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")


def is_video(path: Path) -> bool:
    """Returns whether a file has the name of a video."""
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")


def photo_of_mask(name: str) -> str | None:
    """Returns the name of the photo that a mask belongs to, with or without suffix. Returns None if
    the name is not the name of a mask.

    "1.jpg.mask.png" and "mask_1.jpg.png" are masks of "1.jpg". "1_mask.png" and "1-matte.png" are
    masks of "1".
    """
    stem = Path(name).stem
    found = _MASK_BEHIND.fullmatch(stem) or _MASK_BEFORE.fullmatch(stem)
    return None if found is None else found["photo"]


def _masks_beside(pictures: Iterable[Path]) -> dict[Path, Path]:
    """Returns the photo of each mask. A picture is a mask if its name is made from the name of
    another picture in the same folder (see `photo_of_mask`).
    """
    pictures = list(pictures)
    named: dict[tuple[Path, str], Path] = {}
    for file in pictures:
        for name in (file.stem, file.name):
            named[file.parent, name.casefold()] = file
    masks = {}
    for file in pictures:
        photo = photo_of_mask(file.name)
        if photo is not None and (file.parent, photo.casefold()) in named:
            masks[file] = named[file.parent, photo.casefold()]
    return masks


def unused_line(unused: Iterable[Unused]) -> str | None:
    """Returns one line about the files that are not used: for each reason their number and some of
    their names. None if there are none.
    """
    groups: dict[Reason, list[str]] = {}
    for each in unused:
        groups.setdefault(each.why, []).append(each.path.name)
    if not groups:
        return None
    parts = [
        f"{counted(len(names), why.noun)} {why.because} ({few(names, NAMES_SHOWN)})"
        for why, names in groups.items()
    ]
    return f"not used: {'; '.join(parts)}"
