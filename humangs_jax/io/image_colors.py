"""Converts colors of a photo to sRGB from what the photo says of its encoding: an ICC profile, or
numbers in its header.
"""

import functools
import logging
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float, UInt
from humangs_jax.io.color_spaces import (
    OF_SRGB,
    UNSPECIFIED,
    Encoding,
    by_tables,
    is_srgb,
    of_code_points,
    of_gamma,
    pixels_in_srgb,
    read_profile,
)
from humangs_jax.io.image_headers import nclx_colors, png_chunks
from humangs_jax.io.reading import InvalidFileError

logger = logging.getLogger(__name__)


def colors_in_srgb(
    path: str | Path, image: Any, data: bytes, levels: UInt[np.ndarray, "h w c"], most: int
) -> Float[np.ndarray, "h w 3"] | None:
    """Returns the colors of a photo in sRGB, (h, w, 3), in [0, 1]. Returns None if the levels are
    to be taken as sRGB. That is so if the file says that it has sRGB, if it says nothing, or if its
    color profile cannot be used. A profile that cannot be used is logged.

    path: for the warning. image: the PIL.Image. data: bytes of the file. levels: the photo's
    levels, (h, w, c), from 0 to `most`.
    """
    channels = 1 if levels.shape[-1] < 3 else 3
    levels = levels[..., :channels]
    try:
        encoding = _encoding_in_header(image, data)
        profile = image.info.get("icc_profile")
        if encoding is None and profile:
            found = read_profile(profile)
            # photos in colors have profiles of colors; those in grey may have either
            own = {"CMYK": ("CMYK",), "RGB": ("colors",), "RGBA": ("colors",), "P": ("colors",)}
            if found.space not in own.get(image.mode, ("colors", "greys")):
                raise InvalidFileError(f"it is one of {found.space}, and the photo is none")
            if found.encoding is None:
                return _by_tables(image, profile, levels, most)
            encoding = found.encoding
    except InvalidFileError as error:
        _tell(f"{path}: its color profile is not used: {error}")
        return None
    if encoding is None or is_srgb(encoding):
        return None
    return pixels_in_srgb(levels, most, encoding)


def _encoding_in_header(image: Any, data: bytes) -> Encoding | None:
    """Returns the color encoding that numbers in a photo's header state. If the result is None, the
    ICC profile decides. Without a profile, None stands for sRGB.

    In a PNG, a cICP chunk decides first, then an ICC profile, then an sRGB chunk, then gAMA and
    cHRM. A cICP chunk with a code point for "unspecified" decides only if its other code point
    differs from sRGB's. In other formats, an ICC profile decides first.
    """
    if image.format == "PNG":
        chunks = png_chunks(data)
        points = chunks.get(b"cICP", b"")
        if len(points) >= 2:
            encoding = of_code_points(points[0], points[1])
            if encoding is not None:
                return encoding
            if UNSPECIFIED not in points[:2]:
                return OF_SRGB
        if b"iCCP" in chunks or b"sRGB" in chunks:
            return None
        return of_gamma(image.info.get("gamma"), image.info.get("chromaticity"))
    if image.info.get("icc_profile"):
        return None
    points = None
    if image.format == "AVIF":
        points = nclx_colors(data)
    nclx = image.info.get("nclx_profile")
    if image.format == "HEIF" and isinstance(nclx, dict):
        points = int(nclx.get("color_primaries", 1)), int(nclx.get("transfer_characteristics", 13))
    if points is None:
        return None
    return of_code_points(*points)


def _by_tables(
    image: Any, profile: bytes, levels: UInt[np.ndarray, "h w c"], most: int
) -> Float[np.ndarray, "h w 3"] | None:
    """Returns colors converted by Little CMS, (h, w, 3), in [0, 1]. None if the profile calls
    itself sRGB.

    Little CMS converts 8 bits of each channel. If the file has 16 bits, the lower 8 bits are added
    unchanged. Raises: InvalidFileError for a grey photo, or if the profile cannot be used.
    """
    from PIL import Image

    if levels.shape[-1] == 1:
        raise InvalidFileError("it is tables, and the photo is grey")
    stored = levels
    if most > 255:
        stored = (levels >> 8).astype(np.uint8)
    source = image
    if image.mode != "CMYK":
        source = Image.fromarray(stored)
    converted = by_tables(source, profile)
    if converted is source:
        return None
    colors = np.asarray(converted).astype(np.float32) / np.float32(255)
    if most > 255:
        colors += levels.astype(np.float32) / np.float32(most) - stored.astype(
            np.float32
        ) / np.float32(255)
    return np.clip(colors, 0, 1)


@functools.lru_cache(maxsize=1024)
def _tell(line: str) -> None:
    """Logs a warning once, although photos are read several times."""
    logger.warning("%s", line)
