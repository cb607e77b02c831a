"""Reads photos as float32 arrays in [0, 1], in sRGB, and writes PNG files.

PNG (8 and 16 bits a channel), JPEG, WebP and AVIF can be read. With the extra `heic`, HEIC photos
of phones can be read, too (libheif, by pi-heif). The content of a file decides its format, not its
name, and no other format is tried.

Photos say how their colors are encoded, by an ICC profile or numbers in their header. Such colors
are converted to sRGB. Colors of files that say nothing, or say sRGB, are values as stored, and so
are masks.

Pixels come as stored. Phones write an orientation flag into JPEG files (EXIF), and the functions
that read pixels ignore it. A caller that needs upright pixels reads the flag with `orientation` and
turns the pixels with `oriented`. HEIC photos come upright, because their format turns them without
the flag.
"""

import contextlib
import importlib
import io
import struct
import warnings
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float, UInt, UInt8
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.decoded import content_key, kept_photos
from humangs_jax.io.image_colors import colors_in_srgb
from humangs_jax.io.image_headers import (
    JPEG_START,
    check_png_chunks,
    is_webp,
    iso_kind,
    jpeg_scans,
    other_frame,
    webp_size,
)
from humangs_jax.io.reading import InvalidFileError, check_limit, open_file, read_bytes, reading

PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".avif", ".heic", ".heif")
"""Suffixes of the photos, masks and images that can be read. The likelier original comes first."""
FORMATS = ("PNG", "JPEG")
"""Formats of Pillow that `image_in` accepts by default. Pillow knows some forty more, one of which
starts Ghostscript.
"""
NAMES = {"HEIF": "HEIC", "AVIF": "AVIF", "WEBP": "WebP"}
"""Names of Pillow's formats, as people write them."""
HEAD = 256
"""Number of bytes at the start of a file that `is_heic` reads."""
GREY_SLACK = 16 / 255
"""Largest difference between the channels of an image that still counts as grey, after
compression.
"""
GREY_MASK = "grey from 0 (background) to 255 (person)"
EXIF_TAGS = 0x8769
"""Number of the tag that points to the table of EXIF tags."""
DIAGONAL_35MM = 43.27
"""Diagonal of a frame of 36 x 24 mm, millimetres. The 35-mm equivalent of a focal length sees the
same angle along the diagonal.
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
"""Byte strings, at least one of which is in every file with EXIF. In files without them, tags are
not looked for, because Pillow would decode a whole PNG to find them. "ftypavi" is among them
because an AVIF file may be turned without EXIF.
"""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_COLOR_TYPES = {2: "RGB", 4: "LA", 6: "RGBA"}
"""Color types of PNG files, with Pillow's names. If such a file has 16 bits, Pillow silently keeps
the upper 8 bits. Pillow keeps all bits of type 0 (grey).
"""
MARK_KEY = "Software"
DRAWN = "humangs_jax"
"""Value of the text `Software` in PNG files that show results. These are never photos."""
MASK = "humangs_jax mask"
"""Value of the text `Software` in PNG files that are masks."""


def read_image(
    path: str | Path,
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None]:
    """Returns the colors of a photo in sRGB, (h, w, 3), and its alpha channel, (h, w), or None
    without one. Grey images become three equal channels.

    If a color profile cannot be used, a warning says so, and the values are taken as stored.

    Raises: FileNotFoundError; FileError if the file cannot be read as a photo or has more pixels
    than the limit.
    """
    return _colors_and_alpha(_read_pixels(path))


def _colors_and_alpha(
    pixels: Float[np.ndarray, "h w c"],
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None]:
    if pixels.shape[-1] in (1, 3):
        return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3))), None
    colors = np.broadcast_to(pixels[..., :-1], (*pixels.shape[:2], 3))
    return np.ascontiguousarray(colors), np.ascontiguousarray(pixels[..., -1])


def read_grey(path: str | Path) -> Float[np.ndarray, "h w"]:
    """Returns a mask, coverage in [0, 1], (h, w), from a grey image or from another image that
    segmentation tools write.

    In an image with a palette and no transparency, the mask is 1 where the image has the only label
    besides the background. If label 0 is used, it is the background, and has to be black. Otherwise
    the only black label is the background. If no black label is used, the mask is 1 everywhere, but
    label 0 has to be black in the palette. A palette of several greys is read like a grey image.

    In an image with colors, the mask is 1 where the image has the only color besides black.

    An alpha channel that is not 1 everywhere is the mask if the visible colors are a photo's, or
    are all alike, or are the same mask.

    Raises: as `read_image`; FileError if it is not clear which part is the person. This is so if
    there are several labels or colors, if it is not clear which label is the background, if an
    image with colors has no black, or if the alpha channel and the greys differ.
    """
    # labels of a palette without transparency
    with open_image(path) as (image, data):
        if image.format == "PNG":
            check_png_chunks(data)
        if image.mode == "P" and image.convert("RGBA").getchannel("A").getextrema()[0] == 255:
            colors = np.asarray(image.getpalette("RGB") or (), int).reshape(-1, 3)
            return _mask_of_labels(
                np.asarray(image), np.pad(colors, ((0, 256 - len(colors)), (0, 0)))
            )
    # a mask in the alpha channel, in grey, or as one color on black
    colors, alpha = _colors_and_alpha(_read_pixels(path, as_stored=True))
    with reading(path, "mask"):
        if alpha is not None and alpha.min() < 1:
            return _mask_of_alpha(colors, alpha)
        if _is_grey(colors):
            if (colors == colors[..., :1]).all():
                return colors[..., 0]
            return colors.mean(axis=-1)
        codes = to_uint8(colors).astype(np.uint32) @ np.asarray([1 << 16, 1 << 8, 1], np.uint32)
        count = np.count_nonzero(np.unique(codes))
        if count != 1 or codes.all():
            black = ""
            if codes.all():
                black = " without black"
            raise InvalidFileError(
                f"{count} colors{black}: which is the person? expected one on black, or {GREY_MASK}"
            )
        return (codes > 0).astype(np.float32)


def _is_grey(colors: np.ndarray) -> bool:
    return float(np.ptp(colors, axis=-1).max()) <= GREY_SLACK


def _mask_of_labels(labels: np.ndarray, palette: np.ndarray) -> np.ndarray:
    """Returns the mask of a palette image, (h, w), in [0, 1].

    Arguments: labels (h, w); palette (256, 3): the colors of the labels, from 0 to 255.
    Raises: InvalidFileError if it is not clear which label is the person.
    """
    used = np.unique(labels)
    black = [label for label in used.tolist() if not palette[label].any()]
    # tools count the background as 0, people draw it black: where these differ nobody knows
    if 0 in used:
        background = 0 if 0 in black else None
    elif not black and not palette[0].any():
        background = 0
    else:
        background = black[0] if len(black) == 1 else None
    # one label besides the background, or none
    others = [label for label in used.tolist() if label != background]
    if background is not None and len(others) <= 1:
        return ((labels != background) & bool(others)).astype(np.float32)
    # greys of a palette
    colors = palette[used]
    if len(used) > 2 and colors.max() >= 128 and _is_grey(colors / 255):
        return palette[labels].mean(axis=-1, dtype=np.float32) / np.float32(255)
    shown = ", ".join(map(str, others[:5]))
    if len(others) > 5:
        shown += ", ..."
    which = "0 is not black: which is the background"
    if background is not None:
        which = "which is the person"
    raise InvalidFileError(
        f"a palette of the labels {shown}: {which}? expected one label besides a black 0, or"
        f" {GREY_MASK}"
    )


def _mask_of_alpha(colors: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    shown = colors[alpha > 0]
    flat = not len(shown) or np.ptp(shown, axis=0).max() <= GREY_SLACK
    if flat or not _is_grey(shown) or np.abs(shown[:, 0] - alpha[alpha > 0]).max() <= GREY_SLACK:
        return alpha
    raise InvalidFileError(
        "the image has an alpha channel besides its greys: which is the mask? expected one of them"
    )


def orientation(path: str | Path) -> int:
    """Returns the EXIF orientation of a photo, from 1 to 8, see `oriented`. 1 means that the photo
    is shown as stored. A photo without a flag has 1, too.

    Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        flag = _exif(image, data).get(0x0112, 1)
        return flag if flag in range(2, 9) else 1


def focal_length(path: str | Path) -> float | None:
    """Returns the focal length of a photo in pixels, from EXIF's 35-mm equivalent and the photo's
    diagonal.

    Returns None if EXIF has no equivalent above 0, or if the photo was cut out of the frame that
    EXIF describes, see `cropped_from`. EXIF defines: equivalent / 43.27 mm = focal length /
    diagonal.
    Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        tags = _exif(image, data, EXIF_TAGS)
        equivalent = tags.get(0xA405)
        if (
            not isinstance(equivalent, int)
            or equivalent <= 0
            or other_frame(tags, image.size) is not None
        ):
            return None
        return equivalent / DIAGONAL_35MM * float(np.hypot(*image.size))


def cropped_from(path: str | Path) -> tuple[int, int] | None:
    """Returns the width and height of the frame that a photo was cut out of, from EXIF, see
    `other_frame`. Returns None if EXIF shows no such frame, for example for a photo that was only
    made smaller or turned.

    Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        return other_frame(_exif(image, data, EXIF_TAGS), image.size)


def _exif(image: Any, data: bytes, folder: int | None = None) -> dict[int, Any]:
    """Returns the EXIF tags of a photo, by number. folder: number of the tag that points to the
    table of the wanted tags. None: the main table. Damaged tags count as none.
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
    """Returns pixels (h, w, ...) turned and mirrored by an EXIF orientation from 1 to 8. From 5 on
    height and width are exchanged.
    """
    if flag >= 5:
        pixels = np.swapaxes(pixels, 0, 1)
    if flag in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if flag in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def write_png(
    path: str | Path,
    image: Float[np.ndarray, "h w *c"] | UInt8[np.ndarray, "h w *c"],
    compress_level: int = 6,
    mark: str | None = None,
) -> None:
    """Writes colors or grey in [0, 1] as an 8-bit PNG, rounded to the nearest level. Values outside
    are clipped, and bytes are written unchanged.

    A fourth channel is alpha. If writing fails, the path stays as it was.

    Arguments: compress_level: of zlib; level 1 takes a third of the time and a sixth more room.
    mark: DRAWN for a picture that shows results and must not be taken for a photo, MASK for a mask,
    None for a photo; see `mark_of`.
    Raises: OSError if the file cannot be written.
    """
    write_bytes(path, png_bytes(image, compress_level, mark))


def png_bytes(
    image: Float[np.ndarray, "h w *c"] | UInt8[np.ndarray, "h w *c"],
    compress_level: int = 6,
    mark: str | None = None,
) -> bytes:
    """Returns the bytes of the PNG file that `write_png` writes."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    texts = PngInfo()
    if mark is not None:
        texts.add_text(MARK_KEY, mark)
    file = io.BytesIO()
    Image.fromarray(to_uint8(image)).save(
        file, format="PNG", compress_level=compress_level, pnginfo=texts
    )
    return file.getvalue()


def mark_of(path: str | Path) -> str | None:
    """Returns the mark that `write_png` wrote into a file. None for files without a mark and for
    files that cannot be read.
    """
    with contextlib.suppress(OSError, ValueError), open_file(path, "image_bytes") as file:
        head = file.read(1024)  # the text stands before the pixels
        for mark in (DRAWN, MASK):
            text = f"{MARK_KEY}\0{mark}".encode()
            chunk = struct.pack(">I", len(text)) + b"tEXt" + text
            if head.startswith(PNG_SIGNATURE) and chunk in head:
                return mark
    return None


def is_own_picture(path: str | Path) -> bool:
    """Says whether a file is a picture that shows results: a sheet, a rendering or a texture.

    False for photos and masks.
    """
    return mark_of(path) == DRAWN


def is_own_output(path: str | Path) -> bool:
    """Says whether a new output may replace a file. It may if one of these holds: the file shows
    results (`is_own_picture`), its suffix is not .png, or it cannot be read as an image.
    """
    if Path(path).suffix.lower() != ".png" or is_own_picture(path):
        return True
    try:
        image_size(path)
    except (OSError, ValueError):
        return True
    return False


def image_row(
    images: Iterable[Float[np.ndarray, "h w c"]], height: int = 240
) -> Float[np.ndarray, "height w c"]:
    """Returns one image of all images side by side, each resized to a height of `height` pixels."""
    return np.concatenate(
        [resized(i, max(1, round(i.shape[1] * height / i.shape[0])), height) for i in images],
        axis=1,
    )


def to_uint8(
    image: Float[np.ndarray, "*shape"] | UInt8[np.ndarray, "*shape"],
) -> UInt8[np.ndarray, "*shape"]:
    """Returns numbers in [0, 1] as integers in 0..255, rounded and clipped. NaN becomes 0. Bytes
    are returned unchanged.
    """
    if np.asarray(image).dtype == np.uint8:
        return np.asarray(image)
    return np.rint(255 * np.clip(np.nan_to_num(np.asarray(image)), 0, 1)).astype(np.uint8)


def named_color(name: str) -> tuple[float, float, float]:
    """Returns red, green and blue in [0, 1] of a CSS name or "#rrggbb".

    Raises: ValueError if the name is no color, or has an alpha, as in "#rrggbbaa".
    """
    from PIL import ImageColor

    try:
        red, green, blue, *alpha = ImageColor.getrgb(name.strip())
    except ValueError:
        alpha = [0]
    if alpha:
        raise ValueError(f'background {name!r}: expected a color such as white or "#20a0ff"')
    return red / 255, green / 255, blue / 255


def resized(
    image: Float[np.ndarray, "h w *c"] | UInt[np.ndarray, "h w *c"], width: int, height: int
) -> Float[np.ndarray, "height width *c"]:
    """Returns the image resized to (height, width), in float32. An axis that becomes shorter is
    averaged by area; an axis that becomes longer is interpolated by cubics.

    The average is exact for every ratio. The photos that the shipped weights were trained on were
    made the same way. No value leaves the range of the image's values.
    """
    h, w, *rest = image.shape
    found = image.astype(np.float32, copy=False)
    for old, new in ((h, height), (w, width)):  # one axis, which goes to the end; then the other
        along = found.reshape(old, -1)
        if new != old:
            along = _axis_weights(old, new) @ along
        found = along.reshape(new, *found.shape[1:]).swapaxes(0, 1)
    return np.clip(found, image.min(), image.max(), order="C").reshape(height, width, *rest)


def _axis_weights(old: int, new: int) -> Any:
    """Returns a sparse matrix (new, old) that maps `old` pixels along an axis to `new` pixels."""
    from scipy.sparse import csr_array

    edges = np.arange(new + 1) * (old / new)
    if new < old:
        taps = np.floor(edges[:-1, None]) + np.arange(int(np.ceil(old / new)) + 1)
        shared = np.minimum(edges[1:, None], taps + 1) - np.maximum(edges[:-1, None], taps)
        weights = np.maximum(shared, 0) * (new / old)
    else:  # Keys' cubic convolution, a = -1/2; the rim goes on as it is
        places = (edges[:-1, None] + edges[1:, None]) / 2 - 0.5
        taps = np.floor(places) + np.arange(-1, 3)
        x = np.abs(places - taps)
        weights = np.where(x < 1, (1.5 * x - 2.5) * x**2 + 1, ((2.5 - 0.5 * x) * x - 4) * x + 2)
    columns = np.clip(taps, 0, old - 1).astype(np.int32)
    rows = np.arange(new + 1) * taps.shape[1]
    return csr_array((weights.astype(np.float32).ravel(), columns.ravel(), rows), shape=(new, old))


@contextlib.contextmanager
def open_image(path: str | Path) -> Generator[tuple[Any, bytes]]:
    """Opens a photo as a PIL.Image that is within the limits but not decoded yet. Yields the image
    and the bytes of its file.

    Raises: FileNotFoundError; FileError, also for any error inside the block.
    """
    with reading(path, "image"):
        data = read_bytes(path, "image_bytes")
        with image_in(data, _formats(data)) as image:
            yield image, data


def is_heic(path: str | Path) -> bool:
    """Says whether the first bytes of a file are those of a HEIC photo. Raises: FileNotFoundError;
    FileError.
    """
    with reading(path, "image"), open_file(path, "image_bytes") as file:
        return iso_kind(file.read(HEAD)) == "HEIF"


def _formats(data: bytes) -> tuple[str, ...]:
    """Returns the names of Pillow's formats that a file with these bytes may have. A decoder that
    Pillow lacks is registered first.

    Raises: InvalidFileError if the decoder is not installed.
    """
    kind = iso_kind(data)
    if kind == "HEIF":
        try:
            importlib.import_module("pi_heif").register_heif_opener()
        except ImportError:
            raise InvalidFileError(
                'a HEIC photo: expected PNG or JPEG, or pip install "humangs_jax[heic]"'
            ) from None
    elif kind == "AVIF":
        from PIL import features

        if not features.check("avif"):
            raise InvalidFileError(
                "an AVIF photo, which this Pillow cannot read: expected PNG or JPEG, or pip install"
                " -U Pillow"
            )
    elif is_webp(data):
        kind = "WEBP"
    return FORMATS if kind is None else (kind,)


@contextlib.contextmanager
def image_in(data: bytes, formats: tuple[str, ...] = FORMATS) -> Generator[Any]:
    """Opens an image from bytes, within the limits. It is not decoded yet. formats: Pillow's names
    of the formats that are accepted.

    Raises: InvalidFileError; anything that Pillow raises for damaged images, which is of many
    types.
    """
    from PIL import Image

    if data[:2] == JPEG_START:  # each scan may cost as much as all the pixels
        check_limit("scans", jpeg_scans(data), "scans of a JPEG")
    if formats == ("WEBP",):  # which takes memory for all the pixels when it is opened
        _check_size(*webp_size(data))
    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            _check_size(*image.size)
            yield image
    except Image.UnidentifiedImageError as error:
        if formats == FORMATS:
            wrong = f"neither {' nor '.join(FORMATS)}"
        else:
            wrong = f"damaged {NAMES[formats[0]]}"
        raise ValueError(wrong) from error


def _check_size(width: int, height: int) -> None:
    check_limit("pixels", width * height, f"pixels ({width} x {height})")
    check_limit("side", max(width, height), "pixels along a side")


def check_image(path: str | Path) -> tuple[tuple[int, int], bool]:
    """Checks an image, a PNG file by its checksums and others by decoding. Returns ((width,
    height), whether the image has an alpha channel).

    Raises: as `open_image`.
    """
    with open_image(path) as (image, data):
        found = image.size, "A" in image.getbands() or "transparency" in image.info
        if image.format == "PNG":
            check_png_chunks(data)
        else:
            image.load()
    return found


def image_size(path: str | Path) -> tuple[int, int]:
    """Returns the width and height of an image in pixels. Raises: as `open_image`."""
    with open_image(path) as (image, _):
        return image.size


def _read_pixels(path: str | Path, as_stored: bool = False) -> Float[np.ndarray, "h w c"]:
    """Returns float32 pixels (h, w, channels) in [0, 1], with 1 (grey), 2 (grey, alpha), 3 or 4
    channels. as_stored: whether colors are not converted to sRGB.
    """
    kept = kept_photos()
    with open_image(path) as (image, data):
        key, found = b"", None
        if kept is not None:
            key = content_key(data, as_stored)
            found = kept.find(key)
        if found is not None:
            return found
        levels, most = _levels(image, data)
        colors = None
        if not as_stored:
            colors = colors_in_srgb(path, image, data, levels, most)
        pixels = levels.astype(np.float32) / np.float32(most)
    if colors is not None:
        if pixels.shape[-1] in (2, 4):
            alpha = pixels[..., -1:]
        else:
            alpha = pixels[..., :0]
        pixels = np.concatenate([colors, alpha], axis=-1)
    if kept is not None:
        kept.keep(key, pixels)
    return pixels


def _levels(image: Any, data: bytes) -> tuple[UInt[np.ndarray, "h w c"], int]:
    """Returns the integer levels of an image, (h, w, channels), and the largest level that its type
    can hold. Images of 8 bits are converted to RGB or RGBA.
    """
    if data[:8] == PNG_SIGNATURE:
        check_png_chunks(data)
        if data[24] == 16 and data[25] in PNG_COLOR_TYPES:
            return _deep_pixels(data), 65535
    if image.mode.startswith("I"):  # 16-bit grey
        return np.asarray(image).astype(np.uint16)[..., None], 65535
    has_alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
    mode = "RGBA" if has_alpha else "RGB"
    return np.asarray(image.convert(mode)), 255


def _deep_pixels(data: bytes) -> UInt[np.ndarray, "h w c"]:
    """Returns the pixels of a PNG file with all of their 16 bits, (h, w, channels). Pillow keeps
    only the upper 8 bits, so the lower 8 bits are decoded separately.
    """
    if data[26:28] != b"\0\0" or data[28] > 1:
        raise InvalidFileError("not a readable image: a PNG header with unknown methods")
    if PNG_COLOR_TYPES[data[25]] == "LA":
        both = _decoded(data, "RGBA")  # the four bytes of a pixel
        return both[..., 0::2] << 8 | both[..., 1::2]
    mode = PNG_COLOR_TYPES[data[25]]
    return _decoded(data, f"{mode};16B") << 8 | _decoded(data, f"{mode};16L")


def _decoded(data: bytes, raw: str) -> UInt[np.ndarray, "h w c"]:
    """Returns 8 bits of each channel of a PNG file's pixels, (h, w, channels), in uint16. raw:
    Pillow's name of a pixel layout, which selects the bits.
    """
    with image_in(data) as image:
        image.tile = [(*tile[:3], raw) for tile in image.tile]
        return np.asarray(image).astype(np.uint16)
