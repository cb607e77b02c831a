"""`.sog` of PlayCanvas, read only: a zip of meta.json and of pictures (WebP without loss, or PNG),
with a pixel for each Gaussian.

Version 2 is https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog. Positions
have 16 bits, one byte in each of two pictures. They stand for sign(x) log(1 + |x|) between two
bounds. Log scales and colors are bytes that stand for the numbers of a codebook, and opacities are
bytes. A quaternion has its three smaller components; alpha minus 252 is the place of the largest.
Harmonics are in a picture with up to 65,536 sets of them; the two bytes of a Gaussian's label
choose its set. Y points down, as in `.ply`.
"""

import io
import zipfile
from collections.abc import Sequence
from typing import Any

import numpy as np

from humangs_jax.avatar.export.gaussians import colors_of, loaded, with_largest
from humangs_jax.core.array_types import Float, UInt8
from humangs_jax.io.arrays import open_archive
from humangs_jax.io.image_headers import is_webp
from humangs_jax.io.images import image_in
from humangs_jax.io.reading import InvalidFileError, check_limit, parse_json, shown
from humangs_jax.rendering.gaussians import COUNTS, Gaussians

META = "meta.json"
VERSION = 2
USUAL = "default"
"""The usual `model` of a file; other models are "antialiased" and "2dgs"."""
LEVELS = 256
"""Largest number of entries in a codebook."""
FIRST_PLACE = 252
"""Alpha of a quaternion whose largest component is w. The next three values are for x, y and z."""
COLUMNS = 64
"""Number of sets of harmonics in a row of their picture."""


def read_sog(data: bytes, notes: list[str]) -> Gaussians:
    """Returns the Gaussians in the bytes of a bundle. Lines about what is left out are appended to
    `notes`.

    Raises: InvalidFileError; for damaged files also other errors.
    """
    with open_archive(io.BytesIO(data), len(data)) as archive:
        root = _root(archive)
        meta = parse_json(_member(archive, root + META, "text_bytes").decode("utf-8"))
        # the description in the bundle: other versions store other pictures
        if not isinstance(meta, dict) or meta.get("version") != VERSION:
            found = "none"
            if isinstance(meta, dict):
                found = shown(meta.get("version"))
            convert = "`npx @playcanvas/splat-transform scene.sog scene.ply` makes a .ply of it"
            raise InvalidFileError(f"{META}: version {found}, expected {VERSION}: {convert}")
        model = meta.get("model", USUAL)
        if model != USUAL:
            notes.append(
                f"model {shown(model)} is not applied (SplatConfig.antialiased draws such)"
            )
        # one pixel of a picture holds one Gaussian
        count = _whole(meta.get("count"), "count")
        check_limit("gaussians", count, "Gaussians")

        def pictures(part, number):
            return [_picture(archive, root + name, count) for name in _files(meta, part, number)]

        low, high = pictures("means", 2)
        scales, quats, colors = (pictures(part, 1)[0] for part in ("scales", "quats", "sh0"))
        harmonics = _harmonics(archive, root, meta, count)
    # bytes to numbers: two bytes for places, tables of values for scales and colors
    arrays = {
        "means": _positions(meta["means"], low, high),
        "quats": with_largest(
            (quats[:, :3] / 255 - 0.5) * np.sqrt(2), quats[:, 3].astype(int) - FIRST_PLACE
        ),
        "scales": np.exp(np.minimum(_codebook(meta, "scales")[scales[:, :3]], 99.0)),
        "opacity": colors[:, 3] / 255,
        "sh0": colors_of(_codebook(meta, "sh0")[colors[:, :3]]),
    }
    if (quats[:, 3] < FIRST_PLACE).any():
        raise InvalidFileError(
            f"quats: expected alpha from {FIRST_PLACE} on, got {quats[:, 3].min()}"
        )
    return loaded(arrays | harmonics, notes)


def _root(archive: zipfile.ZipFile) -> str:
    """Returns the folder in the archive that holds meta.json, with "/" at its end, or "" if
    meta.json is in no folder.

    Raises: InvalidFileError if there is not exactly one meta.json.
    """
    found = [name for name in archive.namelist() if name.rsplit("/", 1)[-1] == META]
    if len(found) != 1:
        raise InvalidFileError(f"no bundle of SOG: expected one {META} inside, found {len(found)}")
    return found[0].removesuffix(META)


def _member(archive: zipfile.ZipFile, name: str, limit: str) -> bytes:
    if name not in archive.NameToInfo:
        raise InvalidFileError(f"{shown(name)}: missing in the archive")
    check_limit(limit, archive.getinfo(name).file_size, f"bytes of {shown(name)}")
    return archive.read(name)


def _whole(value: Any, name: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise InvalidFileError(
            f"{META}: {name}: expected a whole number above 0, got {shown(value)}"
        )
    return value


def _part(meta: dict[str, Any], part: str) -> dict[str, Any]:
    if not isinstance(meta.get(part), dict):
        raise InvalidFileError(f"{META}: {part}: missing")
    return meta[part]


def _files(meta: dict[str, Any], part: str, number: int) -> Sequence[str]:
    files = _part(meta, part).get("files")
    if (
        not isinstance(files, list)
        or len(files) != number
        or not all(isinstance(f, str) for f in files)
    ):
        raise InvalidFileError(f"{META}: {part}.files: expected {number} names, got {shown(files)}")
    return files


def _numbers(values: Any, name: str, least: int, most: int) -> Float[np.ndarray, " n"]:
    ok = isinstance(values, list) and least <= len(values) <= most
    if not ok or not all(isinstance(x, int | float) for x in values):
        raise InvalidFileError(
            f"{META}: {name}: expected {least} to {most} numbers, got {shown(values)}"
        )
    return np.asarray(values, np.float64)


def _codebook(meta: dict[str, Any], part: str) -> Float[np.ndarray, "256"]:
    """Returns the numbers that the bytes of a part stand for. A short codebook is filled up with
    NaN, so that `loaded` leaves out Gaussians with bytes beyond its end.
    """
    found = _numbers(_part(meta, part).get("codebook"), f"{part}.codebook", 1, LEVELS)
    return np.pad(found, (0, LEVELS - len(found)), constant_values=np.nan)


def _pixels(archive: zipfile.ZipFile, name: str) -> UInt8[np.ndarray, "h w 4"]:
    data = _member(archive, name, "image_bytes")
    with image_in(data, ("WEBP",) if is_webp(data) else ("PNG",)) as image:
        if image.mode not in ("RGB", "RGBA", "L"):
            raise InvalidFileError(f"{shown(name)}: expected 8-bit RGB or RGBA, got {image.mode}")
        return np.asarray(image.convert("RGBA"))


def _picture(archive: zipfile.ZipFile, name: str, count: int) -> UInt8[np.ndarray, "g 4"]:
    """Returns the first `count` pixels of a picture, row by row."""
    pixels = _pixels(archive, name).reshape(-1, 4)
    if len(pixels) < count:
        raise InvalidFileError(f"{shown(name)}: {len(pixels):,} pixels for {count:,} Gaussians")
    return pixels[:count]


def _positions(
    means: dict[str, Any], low: UInt8[np.ndarray, "g 4"], high: UInt8[np.ndarray, "g 4"]
) -> Float[np.ndarray, "g 3"]:
    first, last = (_numbers(means.get(key), f"means.{key}", 3, 3) for key in ("mins", "maxs"))
    share = (low[:, :3].astype(np.float64) + 256.0 * high[:, :3]) / 65_535
    logs = first + (last - first) * share
    with np.errstate(over="ignore"):
        return np.sign(logs) * np.expm1(np.abs(logs))


def _harmonics(
    archive: zipfile.ZipFile, root: str, meta: dict[str, Any], count: int
) -> dict[str, Float[np.ndarray, "g k 3"]]:
    """Returns the harmonics (g, k, 3) under the name "shN". The dictionary is empty if there are
    none.
    """
    if meta.get("shN") is None:
        return {}
    bands = _whole(_part(meta, "shN").get("bands"), "shN.bands")
    if bands >= len(COUNTS):
        raise InvalidFileError(f"shN: harmonics of degree {bands}: expected degree 1 to 3")
    functions = COUNTS[bands]
    rows, labels = _files(meta, "shN", 2)
    pixels = _pixels(archive, root + rows)
    if pixels.shape[1] != COLUMNS * functions:
        expected = f"{COLUMNS * functions} for degree {bands}"
        raise InvalidFileError(f"{shown(rows)}: {pixels.shape[1]} pixels wide, expected {expected}")
    palette = pixels[..., :3].reshape(-1, functions, 3)
    label = _picture(archive, root + labels, count).astype(np.int64)
    label = label[:, 0] + 256 * label[:, 1]
    if label.max() >= len(palette):
        raise InvalidFileError(
            f"{shown(labels)}: label {label.max()} of {len(palette)} rows of harmonics"
        )
    return {"shN": _codebook(meta, "shN")[palette[label]]}
