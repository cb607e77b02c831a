"""Reading a capture folder, piece by piece: capture.json, body.npz, photos and masks; every fault is a `CaptureError`."""

import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.capture_checks import CaptureError, checked_frame
from humangs_jax.io.images import read_grey, read_image
from humangs_jax.io.npz import read_npz

FORMAT = "humangs-capture"
VERSION = 1
DEFAULT_BODY = "makehuman"
"""Name of the body that comes with the package; any other `body` in body.npz is the path of a model file."""
TOP_KEYS = {"format", "version", "body", "background", "views"}
VIEW_KEYS = {"image", "mask", "K", "cam_from_world", "frame"}
BODY_KEYS = {"body", "betas", "rotations", "translations"}
BACKGROUNDS = ("photo", "white")


def read_description(file: Path) -> dict[str, Any]:
    """capture.json with all keys and types checked, except the matrices."""
    try:
        description = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CaptureError(file, "", "no such file: a capture is a folder with a capture.json") from None
    except (OSError, UnicodeDecodeError) as error:
        raise CaptureError(file, "", f"cannot be read: {error}") from error
    except json.JSONDecodeError as error:
        raise CaptureError(file, f"line {error.lineno}", f"not valid JSON: {error.msg}") from error
    if not isinstance(description, dict):
        raise CaptureError(file, "", f"expected a JSON object, got {type(description).__name__}")
    if description.get("format") != FORMAT:
        raise CaptureError(file, "format", f"expected {FORMAT!r}, got {description.get('format')!r}")
    if description.get("version") != VERSION:
        raise CaptureError(file, "version", f"expected {VERSION}, got {description.get('version')!r}")
    _check_keys(description, TOP_KEYS, TOP_KEYS - {"background"}, file, "")
    if not isinstance(description["body"], str):
        raise CaptureError(file, "body", f"expected the name of an npz file, got {description['body']!r}")
    if description.get("background", "photo") not in BACKGROUNDS:
        raise CaptureError(
            file, "background", f"expected one of {', '.join(BACKGROUNDS)}, got {description['background']!r}"
        )
    views = description["views"]
    if not isinstance(views, list) or not views:
        raise CaptureError(file, "views", "expected a list of at least one view")
    for i, view in enumerate(views):
        if not isinstance(view, dict):
            raise CaptureError(file, f"views[{i}]", f"expected a JSON object, got {view!r}")
        _check_keys(view, VIEW_KEYS, VIEW_KEYS - {"mask", "frame"}, file, f"views[{i}].")
        for key in ("image", "mask"):
            if key in view and not (isinstance(view[key], str) and view[key]):
                raise CaptureError(file, f"views[{i}].{key}", f"expected the path of a file, got {view[key]!r}")
    return description


def _check_keys(mapping: Iterable[str], known: set[str], required: set[str], file: Path, prefix: str) -> None:
    """Unknown keys are errors: most are misspelt optional ones, which would otherwise be ignored in silence."""
    for key in mapping:
        if key not in known:
            raise CaptureError(file, f"{prefix}{key}", f"unknown key: expected only {', '.join(sorted(known))}")
    for key in sorted(required):
        if key not in mapping:
            raise CaptureError(file, f"{prefix}{key}", "missing")


def read_parameters(file: Path) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    """Model name, betas, rotations and translations of body.npz, unchecked but for their presence."""
    try:
        values, pickled = read_npz(file)
    except FileNotFoundError:
        raise CaptureError(file, "", "no such file (capture.json: body names it); `humangs fit` makes one") from None
    except OSError as error:
        raise CaptureError(file, "", error.strerror or error) from error
    if pickled:
        raise CaptureError(file, pickled[0], "expected numbers, got a pickled object")
    _check_keys(values, BODY_KEYS, BODY_KEYS, file, "")
    name = values["body"]
    if name.shape != () or name.dtype.kind not in "US" or not str(name.item()):
        raise CaptureError(
            file, "body", f"expected the string {DEFAULT_BODY!r} or the path of a model file, got {name!r}"
        )
    return str(name.astype(str)), values["betas"], values["rotations"], values["translations"]


def read_view(
    folder: Path, view: dict[str, Any], on_white: bool
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None]:
    """Image on white where a mask or alpha is known, and the mask or None."""
    image, alpha = _read_file(read_image, folder / view["image"])
    if alpha is not None:
        image = on_white_background(image, alpha)
    if "mask" not in view:
        return image, alpha
    file = folder / view["mask"]
    mask = _read_file(read_grey, file)
    if mask.shape != image.shape[:2]:
        sizes = f"{mask.shape[1]} x {mask.shape[0]}, but its image has {image.shape[1]} x {image.shape[0]}"
        raise CaptureError(file, "size", f"{sizes}: expected the same")
    if 0 < mask.max() < 1.5 / 255:
        raise CaptureError(file, "values", "0 and 1: expected 0 (background) to 255 (person)")
    # where alpha has composited the image already, the mask file only says what the person is
    return (image if on_white or alpha is not None else on_white_background(image, mask)), mask


def _read_file(reader: Callable[[Path], Any], file: Path) -> Any:
    try:
        return reader(file)
    except FileNotFoundError:
        raise CaptureError(file, "", "no such image file (capture.json names it)") from None
    except OSError as error:
        raise CaptureError(file, "", f"not a readable image: {error.strerror or error}") from error
    except ValueError as error:
        raise CaptureError(file, "", error) from error


def view_frame(view: dict[str, Any], count: int, file: Path, field: str) -> int:
    """The pose that a view shows; may be left out when there is one."""
    if "frame" not in view and count > 1:
        raise CaptureError(file, field, f"missing: body.npz has {count} poses, which one does the photo show?")
    return checked_frame(view.get("frame", 0), count, file, field)


def names_from_paths(paths: list[str]) -> tuple[str, ...]:
    """File names without folder and suffix; with their folders where that alone is ambiguous."""
    names = [Path(path).stem for path in paths]
    if len(set(names)) < len(names):
        names = ["_".join(Path(path).with_suffix("").parts) for path in paths]
    if len(set(names)) < len(names):
        names = [f"{i:03d}_{name}" for i, name in enumerate(names)]  # one photo used twice
    return tuple(re.sub(r"[^\w.-]", "_", name).lstrip(".") or f"{i:03d}" for i, name in enumerate(names))


def on_white_background(
    image: Float[np.ndarray, "*v h w 3"], mask: Float[np.ndarray, "*v h w"]
) -> Float[np.ndarray, "*v h w 3"]:
    """The masked part over white."""
    return image * mask[..., None] + (1 - mask[..., None])
