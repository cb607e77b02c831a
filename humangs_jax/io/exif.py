"""What EXIF says of a photo: how it is turned, its focal length, and the frame it was cut out
of.
"""

import contextlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.io.images import open_image

EXIF_TAGS = 0x8769
"""Number of the table of EXIF tags in the first table."""
DIAGONAL_35MM = 43.27
"""Diagonal of a frame of 36 x 24 mm, millimetres: the 35-mm equivalent of a focal length sees the
same angle along it.
"""
EXIF_MARKS = (
    b"Exif",
    b"eXIf",
    b"EXIF",
    b"ftypavi",
    b"Raw profile type",
    b"adobe.com/xap",
    b"com.adobe.xmp",
)
"""A file without any of these has no EXIF; looking further would decode a PNG.

An AVIF may be turned without it.
"""


def orientation(path: str | Path) -> int:
    """Returns the EXIF flag of a photo, 1 (none) to 8: how programs that obey it show it, see
    `oriented`.

    Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        flag = _exif(image, data).get(0x0112, 1)
        return flag if flag in range(2, 9) else 1


def focal_length(path: str | Path) -> float | None:
    """Returns the focal length in pixels, from EXIF's 35-mm equivalent and the diagonal of the
    photo; None where that is missing or 0.

    equivalent / 43.27 mm = focal length / diagonal, as EXIF defines it. Of a photo that was cut out
    of what EXIF describes, see `cropped_from`, it is not known. Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        tags = _exif(image, data, EXIF_TAGS)
        equivalent = tags.get(0xA405)
        if not isinstance(equivalent, int) or equivalent <= 0:
            return None
        if _other_frame(tags, image.size) is not None:
            return None
        return equivalent / DIAGONAL_35MM * float(np.hypot(*image.size))


def cropped_from(path: str | Path) -> tuple[int, int] | None:
    """Returns the width and height that EXIF says if the photo has another shape, because it was
    cut out of that; else None.

    Photos that were made smaller or turned have the shape that EXIF says. Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        return _other_frame(_exif(image, data, EXIF_TAGS), image.size)


def _exif(image: Any, data: bytes, folder: int | None = None) -> dict[int, Any]:
    """Returns the EXIF tags of the photo, or of a folder in them; none where they are damaged:
    nobody obeys these.
    """
    if any(mark in data for mark in EXIF_MARKS):
        with warnings.catch_warnings(), contextlib.suppress(Exception):
            warnings.simplefilter("ignore")
            tags = image.getexif()
            if folder is None:
                return dict(tags)
            return dict(tags.get_ifd(folder))
    return {}


def oriented(pixels: np.ndarray, flag: int) -> np.ndarray:
    """Turns pixels (h, w, ...) as an EXIF orientation from 1 to 8 wants them shown; from 5 on
    height and width are exchanged.
    """
    if flag >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    if flag in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if flag in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _other_frame(tags: dict[int, Any], size: tuple[int, int]) -> tuple[int, int] | None:
    """Returns the width and height in EXIF's tags if a photo of this size was cut out of such a
    frame, else None.
    """
    # EXIF's width and height of the photo as it was taken
    width, height = tags.get(0xA002), tags.get(0xA003)
    if not isinstance(width, int) or not isinstance(height, int):
        return None
    frame, turned = (width, height), (height, width)
    if not 0 < min(frame) <= max(frame) < 1 << 24 or _same_shape(size, frame):
        return None
    # 3 : 4 of a frame of 4 : 3 may be turned, or cut out of it at its full height
    cut_upright = size != turned and (size[0] == frame[0] or size[1] == frame[1])
    if _same_shape(size, turned) and not cut_upright:
        return None
    return frame


def _same_shape(size: tuple[int, int], frame: tuple[int, int]) -> bool:
    """Says whether two sizes have the same shape, but for a pixel and a hundredth, by rounding."""
    scale = np.hypot(*size) / np.hypot(*frame)
    off = np.abs(scale * np.asarray(frame) - size)
    return bool((off <= 1 + 0.01 * np.asarray(size)).all())
