"""Checks the values of capture, camera and keypoint files one by one. Every fault is a
`CaptureError` of one line.
"""

import functools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float
from humangs_jax.geometry.camera import Camera
from humangs_jax.io import arrays
from humangs_jax.io.atomic import check_replaceable
from humangs_jax.io.reading import FileError, inside, parse_json, read_text, reading, shown

COLOR_SLACK = 1e-3
"""Resampled images overshoot [0, 1] by less than this. Values further outside have another range,
such as 0 to 255.
"""


LARGEST_TURN = 1e3
"""The largest magnitude of a component of an axis-angle rotation, radians."""
LARGEST_DISTANCE = 1e4
"""The largest magnitude of a component of a translation, metres. Beyond it float32 loses
millimetres, and the unit is hardly the metre.
"""
LARGEST_BETA = 100.0
"""The largest magnitude of a shape coefficient. Bodies that exist have less than 10."""
LARGEST_DISPLACEMENT = 0.5
"""The largest magnitude of a component of a displacement, metres. Clothes are nearer to the skin
than this.
"""


class CaptureError(FileError):
    """A fault in a capture. The message is one line: the file, the field if a value is wrong, and
    what was expected.
    """


# Files
# --------------------------------------------------------------------------------------------------


def checked_text(file: Path, missing: str = "no such file") -> str:
    """Returns the text of a file. missing: the text of the error if there is no file. Raises:
    CaptureError.
    """
    try:
        return read_text(file)
    except FileNotFoundError:
        raise CaptureError(file, "", missing) from None
    except FileError as error:
        raise CaptureError("", "", error) from error


def checked_json(file: Path, text: str | None = None, missing: str = "no such file") -> Any:
    """Returns the value in a JSON file. text: the text of the file, if it is known. missing: the
    text of the error if there is no file. Raises: CaptureError.
    """
    with reading(file, "JSON file", CaptureError):
        return parse_json(checked_text(file, missing) if text is None else text)


def checked_path(folder: Path, name: object, where: object) -> Path:
    """Returns the path of a photo that a file in `folder` names, see `io.reading.inside`. where:
    the place that errors name. Raises: CaptureError.
    """
    with reading(where, "path", CaptureError):
        return inside(folder, str(name), photo=True)


def check_place(folder: Path, overwrite: bool, inputs: Iterable[Path | None] = ()) -> None:
    """Check that a capture may be written to a folder, see `io.atomic.check_replaceable`.

    Raises: CaptureError.
    """
    try:
        check_replaceable(folder, overwrite, "capture.json", inputs)
    except ValueError as error:
        raise CaptureError("", "", error) from error


def required(mapping: Mapping[str, Any], key: str, file: object, prefix: str = "") -> Any:
    """Returns `mapping[key]`.

    Raises: CaptureError if the key is missing.
    """
    if key not in mapping:
        raise CaptureError(file, f"{prefix}{key}", "missing")
    return mapping[key]


KINDS: dict[type, str] = {
    dict: "a JSON object",
    list: "a list",
    str: "a name or path",
    int: "an integer",
    float: "a number",
}
"""The types of JSON values, and their names in errors."""


def expect(value: Any, kind: type, file: object, field: str) -> Any:
    """Returns a JSON value after checking its type. Texts must not be empty, and booleans are no
    numbers. kind: the type, a key of `KINDS`.

    Raises: CaptureError.
    """
    allowed = int | float if kind is float else kind
    if not isinstance(value, allowed) or isinstance(value, bool) or value == "":
        raise CaptureError(file, field, f"expected {KINDS[kind]}, got {shown(value)}")
    return value


def members(value: Any, file: object, field: str = "", /, **kinds: type) -> list[Any]:
    """Returns the members of a JSON object that `kinds` names, in the order of `kinds`, after
    checking their types. kinds: the type of each member by name.

    Raises: CaptureError.
    """
    expect(value, dict, file, field)
    prefix = f"{field}." if field else ""
    return [
        expect(required(value, key, file, prefix), kind, file, f"{prefix}{key}")
        for key, kind in kinds.items()
    ]


def few(names: Sequence[str], most: int = 4) -> str:
    """Returns names for an error or a warning as one text. Names beyond the first `most` are only
    counted.
    """
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def counted(number: int, noun: str) -> str:
    """Returns a number with its noun, as in "1 photo" and "2 photos"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


# Numbers
# --------------------------------------------------------------------------------------------------


file_numbers = functools.partial(arrays.numbers, error=CaptureError)
"""Returns the numbers of a file as a float64 array, see `io.arrays.numbers`. Raises:
CaptureError.
"""
numbers = functools.partial(file_numbers, dtype=np.float32)
"""Returns the numbers of a file as a float32 array, see `file_numbers`."""


def floats(
    value: Any, file: object, field: str, shape: tuple[int, ...]
) -> Float[np.ndarray, "*shape"]:
    """Returns finite float64 numbers, reshaped to `shape` in row-major order. value: an array, or
    nested lists, of any shape with that many numbers.

    Raises: CaptureError if there are more or fewer numbers, if nested lists have unequal lengths,
    or if something is not a finite number.
    """
    array = file_numbers(value, file, field)
    if array.size != np.prod(shape):
        wanted = " x ".join(map(str, shape)) or "one"
        raise CaptureError(file, field, f"expected {wanted} numbers, got shape {array.shape}")
    return array.reshape(shape)


def in_unit_range(
    array: Float[np.ndarray, "*shape"], file: object, field: str
) -> Float[np.ndarray, "*shape"]:
    """Returns colors or coverage in [0, 1]. Values that overshoot by at most `COLOR_SLACK` are
    clipped. Raises: CaptureError for values farther outside.
    """
    low, high = float(array.min()), float(array.max())
    if low < -COLOR_SLACK or high > 1 + COLOR_SLACK:
        raise CaptureError(file, field, f"expected values in [0, 1], got {low:.4g} to {high:.4g}")
    return np.clip(array, 0, 1)


# Parts of a capture
# --------------------------------------------------------------------------------------------------


def checked_camera(
    K: np.ndarray, cam_from_world: np.ndarray, width: int, height: int, file: object, prefix: str
) -> Camera:
    """Returns the camera with these matrices, see `Camera.from_opencv`. Raises: CaptureError, for
    example for a pose that is not rigid or not right-handed.
    """
    try:
        return Camera.from_opencv(K, cam_from_world, width, height)
    except ValueError as error:
        raise CaptureError(file, prefix, error) from error


def checked_frame(frame: Any, count: int, file: object, field: str) -> int:
    """Returns the number of a pose, an integer from 0 to `count` - 1. Raises: CaptureError for
    other values.
    """
    if not 0 <= expect(frame, int, file, field) < count:
        raise CaptureError(
            file, field, f"expected 0 to {count - 1} (there are {count} poses), got {frame}"
        )
    return frame


def body_parameters(
    body: BodyModel,
    betas: Any,
    rotations: Any,
    translations: Any,
    file: object,
    shape_names: Sequence[str] | None = None,
    displacement: Any | None = None,
) -> tuple[
    Float[np.ndarray, " s"],
    Float[np.ndarray, "m j 3"],
    Float[np.ndarray, "m 3"],
    Float[np.ndarray, "n 3"] | None,
]:
    """Returns betas, rotations, translations and displacement in float32, after checking that they
    fit the body and are in range. The returned betas belong to the first of the body's shape
    directions.

    Arguments: shape_names: see `shape_coefficients`. displacement: see `Capture`; None: there is
    none.
    Raises: CaptureError.
    """
    joints = len(body.parents)
    rotations = numbers(rotations, file, "rotations")
    if rotations.ndim != 3 or rotations.shape[1:] != (joints, 3) or len(rotations) == 0:
        raise CaptureError(
            file,
            "rotations",
            f"expected shape (frames, {joints}, 3) for this body, got {rotations.shape}",
        )
    translations = numbers(translations, file, "translations", (len(rotations), 3))
    betas = numbers(betas, file, "betas")
    if displacement is not None:
        displacement = numbers(displacement, file, "displacement", body.template.shape)
    # larger numbers are of another unit, or damaged
    for field, array, largest in (
        ("rotations", rotations, LARGEST_TURN),
        ("translations", translations, LARGEST_DISTANCE),
        ("betas", betas, LARGEST_BETA),
        ("displacement", displacement, LARGEST_DISPLACEMENT),
    ):
        if array is None:
            continue
        most = np.abs(array).max(initial=0)
        if most > largest:
            raise CaptureError(
                file, field, f"expected numbers of at most {largest:g} in magnitude, got {most:.4g}"
            )
    if betas.ndim != 1:
        raise CaptureError(file, "betas", f"expected a list of numbers, got shape {betas.shape}")
    return shape_coefficients(body, betas, shape_names, file), rotations, translations, displacement


def shape_coefficients(
    body: BodyModel, betas: Float[np.ndarray, " s"], names: Sequence[str] | None, file: object
) -> Float[np.ndarray, " used"]:
    """Returns the shape coefficients in the order of the body's directions, up to the last one that
    is given. Missing ones before it are 0.

    Arguments: betas: the coefficients. names: for each of betas, the name of its direction, as in
    `BodyModel.shape_names`. None: betas belong to the first of the body's directions that are no
    expressions. If the names of these directions are not shape_0, shape_1 and so on, as SMPL-X has
    them, betas need a number for each of them, or have to be 0.

    Raises: CaptureError for a coefficient that is not 0 if the body has no such direction, and if
    there are not as many different names as coefficients.
    """
    directions = body.shape_names or tuple(
        f"shape_{i}" for i in range(body.shape_directions.shape[-1])
    )
    places = {name: i for i, name in enumerate(directions)}
    # numbers without names: those of SMPL-X's shape, or all of the body's directions
    if names is None:
        own = [name for name in directions if not name.startswith("expression_")]
        if betas[len(own) :].any():
            problem = (
                f"{len(betas)} coefficients, but body '{body.name}' has {len(own)} such directions"
            )
            raise CaptureError(file, "betas", problem)
        if "shape_0" in places or len(betas) == len(own) or not betas.any():
            return betas[: len(own)]
        names = [f"shape_{i}" for i in range(len(betas))]
    # named numbers: a direction that the body lacks may be named if its number is 0
    if len(names) != len(betas) or len(set(names)) < len(names):
        raise CaptureError(
            file, "shape_names", f"expected {len(betas)} different names, one for each of betas"
        )
    unknown = [
        name for name, value in zip(names, betas, strict=True) if value and name not in places
    ]
    if unknown:
        known = "none"
        if places:
            known = f"{len(places)}, from {directions[0]!r} to {directions[-1]!r}"
        problem = (
            f"{unknown[0]!r} is no shape direction of body '{body.name}': expected coefficients of"
            f" its own ({known})"
        )
        raise CaptureError(file, "betas", problem)
    # in the order of the body, up to the last direction that is named
    used = [places[name] for name in names if name in places]
    ordered = np.zeros(max(used, default=-1) + 1, betas.dtype)
    ordered[used] = [value for name, value in zip(names, betas, strict=True) if name in places]
    return ordered


def check_names(names: Sequence[str], count: int, file: object) -> None:
    """Check that views have one name each, that all names differ, and that they are safe as file
    names. Raises: CaptureError.
    """
    if len(names) != count or len(set(names)) < count:
        raise CaptureError(file, "names", f"expected {count} different names, got {list(names)}")
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"[\w-][\w.-]*", name):
            raise CaptureError(
                file, "names", f"expected letters, digits, '.', '_' and '-' only, got {shown(name)}"
            )
