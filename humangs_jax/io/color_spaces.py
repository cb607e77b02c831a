"""Converts colors from a file's encoding to sRGB: ICC profiles, the code points of ITU-T H.273, and
gamma with chromaticities.

A conversion has three steps: a curve from levels to linear light, a matrix from the primaries of
the file to the primaries of sRGB, and the curve of sRGB (or of BT.709 for HLG). Profiles that
consist of tables (of printers, scanners, CMYK) are left to Little CMS. In images of high dynamic
range, the white of a sheet of paper counts as 1, and light above 0.75 is compressed below 1.
"""

import contextlib
import io
import struct
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.linalg import LinAlgError

from humangs_jax.core.array_types import Float, UInt
from humangs_jax.io.reading import InvalidFileError

Curve = Callable[[Float[np.ndarray, "*shape"]], Float[np.ndarray, "*shape"]]
"""A function from encoded levels in [0, 1] to linear light, in which white is 1."""


class Encoding(NamedTuple):
    """The way in which a file encodes colors."""

    curves: tuple[Curve, ...]
    """Curves from encoded levels to linear light, one for each channel or one for all."""
    matrix: Float[np.ndarray, "3 3"]
    """Matrix (3, 3) from light of the file's primaries to light of sRGB's."""
    bright: bool = False
    """Whether light may be far beyond white."""
    camera: bool = False
    """Whether the curves give the light in front of the camera (HLG), not the light of a screen.
    Such light is then encoded as cameras do (BT.709), not by the curve of sRGB.
    """


# Curves
# --------------------------------------------------------------------------------------------------


def srgb_to_light(levels: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Returns the linear light that sRGB levels encode (IEC 61966-2-1). White is 1."""
    return np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)


def light_to_srgb(light: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Returns the sRGB levels, in [0, 1], of linear light in [0, 1]. Inverse of `srgb_to_light`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def light_to_bt709(light: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Returns the levels, in [0, 1], by which cameras encode linear light in [0, 1] (ITU-R
    BT.709).
    """
    return np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)


def _pq_to_light(levels: np.ndarray) -> np.ndarray:
    """Returns the linear light that levels encode by the curve PQ (SMPTE ST 2084). White paper is
    1.
    """
    root = levels ** (1 / 78.84375)
    nits = 10_000 * (np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)) ** (
        1 / 0.1593017578125
    )
    return nits / 203  # candela per square metre that BT.2408 gives white paper


def _hlg_to_light(levels: np.ndarray) -> np.ndarray:
    """Returns the light in front of the camera that levels encode by the curve HLG (ARIB STD-B67).
    White paper is 1.
    """
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    light = np.where(levels <= 0.5, levels**2 / 3, (np.exp((levels - c) / a) + b) / 12)
    return light / 0.265  # white paper, the level 0.75 (BT.2408); 1 is the brightest


def _power(exponent: float) -> Curve:
    return lambda levels: np.maximum(levels, 0) ** exponent


def _compressed(light: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns light whose largest channel is compressed below 1. If the largest channel is at most
    0.75, the light is unchanged. All three channels are scaled alike, so the hue stays.
    """
    knee = 0.75  # light up to here stays
    largest = np.maximum(light.max(axis=-1, keepdims=True), 1e-6)
    beyond = np.maximum(largest - knee, 0) / (1 - knee)
    return light * np.where(largest > knee, (1 - (1 - knee) * np.exp(-beyond)) / largest, 1)


# Primaries
# --------------------------------------------------------------------------------------------------

D65 = (0.3127, 0.3290)
"""Chromaticity x, y of the white of sRGB."""
D50 = (0.3457, 0.3585)
"""Chromaticity x, y of the white of ICC profiles."""
BRADFORD = np.asarray(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
PRIMARIES = {
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),
}
"""Chromaticities of red, green and blue, by their code point (H.273): BT.2020 and Display P3. All
other primaries are read as sRGB's.
"""
CURVES: dict[int, Curve] = {
    4: _power(2.2),
    5: _power(2.8),
    8: _power(1.0),
    16: _pq_to_light,
    18: _hlg_to_light,
}
"""Curves by their code point (H.273). All other curves are read as sRGB's. Other programs show
BT.709 and similar curves in this way, too.
"""
PQ = 16
"""Number of the transfer function PQ in H.273."""
HLG = 18
"""Number of the transfer function HLG in H.273."""
UNSPECIFIED = 2
"""Code point of H.273 by which a file leaves its primaries or its curve open."""


def _xyz(xy: tuple[float, float]) -> np.ndarray:
    x, y = xy
    return np.asarray([x / y, 1.0, (1 - x - y) / y])


def _to_xyz(primaries: tuple[tuple[float, float], ...], white: tuple[float, float]) -> np.ndarray:
    """Returns the matrix (3, 3) from light of three primaries to XYZ. White becomes D50, the white
    of ICC profiles.
    """
    columns = np.stack([_xyz(each) for each in primaries], axis=1)
    matrix = columns * np.linalg.solve(columns, _xyz(white))
    gains = (BRADFORD @ _xyz(D50)) / (BRADFORD @ _xyz(white))
    return np.linalg.solve(BRADFORD, gains[:, None] * BRADFORD) @ matrix


FROM_XYZ = np.linalg.inv(_to_xyz(SRGB, D65))
OF_SRGB = Encoding((srgb_to_light,), np.eye(3))
"""The encoding of sRGB."""


def of_code_points(primaries: int, transfer: int) -> Encoding | None:
    """Returns the encoding that two code points of H.273 stand for, or None if both are read as
    sRGB's. PNG's cICP, nclx of HEIC and AVIF, and videos have such numbers.
    """
    if primaries not in PRIMARIES and transfer not in CURVES:
        return None
    matrix = FROM_XYZ @ _to_xyz(PRIMARIES.get(primaries, SRGB), D65)
    bright = transfer in (PQ, HLG)
    return Encoding((CURVES.get(transfer, srgb_to_light),), matrix, bright, camera=transfer == HLG)


def of_gamma(gamma: float | None, chromaticities: tuple[float, ...] | None) -> Encoding | None:
    """Returns the encoding that PNG's gAMA and cHRM describe. None if it is sRGB's.

    A gamma that cannot be used is read as sRGB's curve, and chromaticities that are no real colors
    as sRGB's primaries. Each is judged without the other. chromaticities: x and y of white, red,
    green and blue, in this order.
    """
    curve, matrix = srgb_to_light, np.eye(3)
    # PNG files say 1 / 2.2 of sRGB; what programs write of videos (1 / 1.96) is shown as sRGB, too
    if gamma is not None and 0.1 < gamma < 10 and abs(gamma - 1 / 2.2) > 0.06:
        curve = _power(1 / gamma)
    if chromaticities is not None and len(chromaticities) == 8:
        points = tuple(zip(chromaticities[::2], chromaticities[1::2], strict=True))
        found = np.full((3, 3), np.inf)
        with np.errstate(all="ignore"), contextlib.suppress(ZeroDivisionError, LinAlgError):
            found = FROM_XYZ @ _to_xyz(points[1:], points[0])
        # larger factors are of primaries that do not exist
        if np.abs(found).max() < 10:
            matrix = found
    encoding = Encoding((curve,), matrix)
    if is_srgb(encoding):
        return None
    return encoding


def is_srgb(encoding: Encoding) -> bool:
    """Says whether colors of this encoding are sRGB already, to within half a level of 8 bits."""
    steps = np.linspace(0, 1, 9)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    return bool(np.abs(in_srgb(grid, encoding) - grid).max() < 0.5 / 255)


# To sRGB
# --------------------------------------------------------------------------------------------------


def in_srgb(levels: Float[np.ndarray, "n 3"], encoding: Encoding) -> Float[np.ndarray, "n 3"]:
    """Converts a file's levels to sRGB. levels and result: (n, 3), in [0, 1]."""
    curves = encoding.curves * (3 // len(encoding.curves))
    light = np.stack([curve(levels[:, i]) for i, curve in enumerate(curves)], axis=-1)
    return _encode(encoding)(_light_in_srgb(light, encoding))


def _light_in_srgb(light: Float[np.ndarray, "n 3"], encoding: Encoding) -> Float[np.ndarray, "n 3"]:
    light = light @ encoding.matrix.T.astype(light.dtype)
    if encoding.bright:
        light = _compressed(light)
    return np.clip(light, 0, 1)


def _encode(encoding: Encoding) -> Curve:
    if encoding.camera:
        return light_to_bt709
    return light_to_srgb


def pixels_in_srgb(
    levels: UInt[np.ndarray, "h w c"], most: int, encoding: Encoding
) -> Float[np.ndarray, "h w 3"]:
    """Returns an image's colors in sRGB, (h, w, 3), in [0, 1]. levels: integers from 0 to `most`,
    with one channel (grey) or three.
    """
    height, width, channels = levels.shape
    curves = encoding.curves * (3 // len(encoding.curves))
    tables = [curve(np.arange(most + 1) / most).astype(np.float32) for curve in curves]
    # the curve back to sRGB in a table, whose steepest part is off by 1/80 of a level of 8 bits
    last = (1 << 18) - 1
    back = _encode(encoding)(np.arange(last + 1) / last).astype(np.float32)
    found = np.empty((height, width, 3), np.float32)
    rows = max(1, (1 << 20) // width)
    # a block after the other: a photo of 64 million pixels takes no gigabytes
    for top in range(0, height, rows):
        block = levels[top : top + rows]
        light = np.stack([tables[i][block[..., i % channels]] for i in range(3)], axis=-1)
        light = _light_in_srgb(light.reshape(-1, 3), encoding)
        converted = back[np.rint(light * last).astype(np.int32)]
        found[top : top + rows] = converted.reshape(-1, width, 3)
    return found


def cube(encoding: Encoding, side: int = 49) -> str:
    """Returns a table of `in_srgb` as text that ffmpeg's filter lut3d reads (.cube). Red changes
    fastest.
    """
    steps = np.linspace(0, 1, side)
    blue, green, red = (axis.ravel() for axis in np.meshgrid(steps, steps, steps, indexing="ij"))
    rows = in_srgb(np.stack([red, green, blue], axis=-1), encoding)
    return f"LUT_3D_SIZE {side}\n" + "".join(
        f"{r:.6f} {g:.6f} {b:.6f}\n" for r, g, b in rows.tolist()
    )


# ICC profiles
# --------------------------------------------------------------------------------------------------

SPACES = {b"RGB ": "colors", b"GRAY": "greys", b"CMYK": "CMYK"}


class Profile(NamedTuple):
    """An ICC profile."""

    space: str
    """One of the values of `SPACES`."""
    encoding: Encoding | None
    """The encoding of its colors. None: the profile consists of tables, which Little CMS reads."""


def read_profile(data: bytes) -> Profile:
    """Returns the ICC profile in some bytes.

    Raises: InvalidFileError if the profile is damaged, has more than 4 MiB, or does not describe a
    photo in RGB, grey or CMYK.
    """
    # the header: size (profiles of presses have up to 3 MB), signature, kind of device and colors
    most = 4 << 20
    if len(data) > most:
        raise InvalidFileError(f"it has {len(data):,} bytes, expected at most {most:,}")
    if len(data) < 132 or data[36:40] != b"acsp" or int.from_bytes(data[:4], "big") > len(data):
        raise InvalidFileError("it is damaged or cut off")
    # monitors, scanners, printers and color spaces; links, names and effects describe no photo
    classes = (b"mntr", b"scnr", b"prtr", b"spac")
    if data[12:16] not in classes or data[16:20] not in SPACES:
        kind = f"{data[12:16]!r} of {data[16:20]!r}"
        raise InvalidFileError(
            f"it is of the kind {kind}, expected one of a photo in RGB, grey or CMYK"
        )
    # its curves, if colors are not given by tables alone
    space = SPACES[data[16:20]]
    try:
        tags = _tags(data)
        if space == "CMYK" or b"A2B0" in tags:
            return Profile(space, None)
        with np.errstate(all="ignore"):
            if space == "greys":
                encoding = Encoding((_curve(tags[b"kTRC"]),), np.eye(3))
            else:
                encoding = _of_colors(tags)
            steps = np.linspace(0, 1, 256)
            if not all(np.isfinite(curve(steps)).all() for curve in encoding.curves):
                raise InvalidFileError("its curves are no numbers")
    except (LookupError, struct.error, OverflowError, ValueError) as error:
        why = "it is damaged"
        if isinstance(error, InvalidFileError):
            why = str(error)
        raise InvalidFileError(why) from error
    return Profile(space, encoding._replace(curves=tuple(map(_within_white, encoding.curves))))


def _within_white(curve: Curve) -> Curve:
    """Returns the curve with its values bounded to [0, 1]. A formula of a file may leave this
    range, or give NaN, between the levels that were tested.
    """

    def bounded(levels: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
        with np.errstate(all="ignore"):
            return np.clip(np.nan_to_num(curve(levels)), 0, 1)

    return bounded


def _tags(data: bytes) -> dict[bytes, bytes]:
    count = int.from_bytes(data[128:132], "big")
    if count > 200:
        raise InvalidFileError(f"it has {count:,} parts, expected at most 200")
    entries = [struct.unpack_from(">4sII", data, 132 + 12 * i) for i in range(count)]
    return {name: data[at : at + size] for name, at, size in entries}


def _of_colors(tags: dict[bytes, bytes]) -> Encoding:
    columns = [struct.unpack_from(">3i", tags[name + b"XYZ"], 8) for name in (b"r", b"g", b"b")]
    to_xyz = np.asarray(columns, float).T / 65536
    if np.abs(to_xyz.sum(axis=1) - _xyz(D50)).max() > 0.1:
        raise InvalidFileError("its primaries do not make white")
    return Encoding(
        tuple(_curve(tags[name + b"TRC"]) for name in (b"r", b"g", b"b")), FROM_XYZ @ to_xyz
    )


def _curve(tag: bytes) -> Curve:
    """Returns the curve of an ICC tag. The tag is "curv" (a table, or an exponent) or "para" (the
    numbers g and a to f of a formula).
    """
    # "curv": no entry is the identity, one is an exponent, more are a table
    if tag[:4] == b"curv":
        count = int.from_bytes(tag[8:12], "big")
        table = np.frombuffer(tag[12 : 12 + 2 * count], ">u2")
        if len(table) != count:
            raise InvalidFileError("it has a curve that is cut off")
        if count == 0:
            return _power(1.0)
        if count == 1:
            return _power(float(table[0]) / 256)
        return lambda levels: np.interp(levels, np.linspace(0, 1, count), table / 65535)
    if tag[:4] != b"para":
        raise InvalidFileError("it has a curve of an unknown kind")
    # "para": later kinds have more of the numbers; those that a kind lacks are neutral
    kind = int.from_bytes(tag[8:10], "big")
    g, *rest = (each / 65536 for each in struct.unpack_from(f">{(1, 3, 4, 5, 7)[kind]}i", tag, 12))
    a, b, c, d, e, f = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if kind == 1:
        a, b = rest
        d = -b / a if a else 0.0
    elif kind == 2:
        a, b, e = rest
        d = -b / a if a else 0.0
        f = e
    elif kind == 3:
        a, b, c, d = rest
    elif kind == 4:
        a, b, c, d, e, f = rest
    return lambda levels: np.where(
        levels >= d, np.maximum(a * levels + b, 0) ** g + e, c * levels + f
    )


def by_tables(image: Any, profile: bytes) -> Any:
    """Returns a PIL.Image converted to sRGB with an ICC profile that consists of tables. Returns
    `image` itself if the profile calls itself sRGB.

    Raises: InvalidFileError if the profile cannot be used.
    """
    from PIL import ImageCms

    try:
        source = ImageCms.getOpenProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return image
        intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(
            image, source, target, intent, outputMode="RGB", flags=flags
        )
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError) as error:
        raise InvalidFileError("it is damaged, or not for this photo") from error
