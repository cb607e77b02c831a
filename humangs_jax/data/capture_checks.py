"""What must hold of a capture, field by field; whatever does not is a `CaptureError` of one line."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float
from humangs_jax.geometry.camera import Camera

COLOUR_SLACK = 1e-3
"""Resampled images overshoot [0, 1] a little; what exceeds it by more is not in this range at all (0..255, say)."""


class CaptureError(ValueError):
    """Something is wrong with a capture; the message is one line: file, field, and what was expected."""

    def __init__(self, file: object, field: str, problem: object):
        parts = [str(part) for part in (file, field, problem) if part]
        super().__init__(" ".join(": ".join(parts).split()))


def numbers(value: Any, file: object, field: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Finite float32 numbers of a shape."""
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            raise TypeError
        array = array.astype(np.float32)
    except (ValueError, TypeError):
        wanted = "numbers" if shape is None else f"{' x '.join(map(str, shape))} numbers"
        raise CaptureError(file, field, f"expected {wanted}") from None
    if shape is not None and array.shape != shape:
        raise CaptureError(file, field, f"expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise CaptureError(file, field, f"expected finite numbers, got {array[where]} at index {list(where)}")
    return array


def check_range(array: np.ndarray, file: object, field: str) -> None:
    """Colours and coverage lie in [0, 1]."""
    low, high = float(array.min()), float(array.max())
    if low < -COLOUR_SLACK or high > 1 + COLOUR_SLACK:
        raise CaptureError(file, field, f"expected values in [0, 1], got {low:.4g} to {high:.4g}")


def checked_camera(
    K: np.ndarray, cam_from_world: np.ndarray, width: int, height: int, file: object, prefix: str
) -> Camera:
    """A camera of a rigid, right-handed pose."""
    try:
        return Camera.from_opencv(K, cam_from_world, width, height)
    except ValueError as error:
        raise CaptureError(file, prefix, error) from error


def checked_frame(frame: Any, count: int, file: object, field: str) -> int:
    """An integer that counts one of the poses."""
    if isinstance(frame, bool) or not isinstance(frame, int):
        raise CaptureError(file, field, f"expected an integer, got {frame!r}")
    if not 0 <= frame < count:
        raise CaptureError(file, field, f"expected 0 to {count - 1} (there are {count} poses), got {frame}")
    return frame


def body_parameters(
    body: BodyModel, betas: Any, rotations: Any, translations: Any, file: object
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "m j 3"], Float[np.ndarray, "m 3"]]:
    """betas, rotations and translations in float32, of the sizes that the body has."""
    joints, shapes = len(body.parents), body.shape_directions.shape[-1]
    rotations = numbers(rotations, file, "rotations")
    if rotations.ndim != 3 or rotations.shape[1:] != (joints, 3) or len(rotations) == 0:
        raise CaptureError(
            file, "rotations", f"expected shape (frames, {joints}, 3) for this body, got {rotations.shape}"
        )
    translations = numbers(translations, file, "translations", (len(rotations), 3))
    betas = numbers(betas, file, "betas")
    if betas.ndim != 1 or len(betas) > shapes:
        raise CaptureError(file, "betas", f"expected at most {shapes} numbers for this body, got shape {betas.shape}")
    return betas, rotations, translations


def check_names(names: Sequence[str], count: int, file: object) -> None:
    """One per view, different, and harmless as file names."""
    if len(names) != count or len(set(names)) < count:
        raise CaptureError(file, "names", f"expected {count} different names, got {list(names)}")
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"[\w-][\w.-]*", name):
            raise CaptureError(file, "names", f"expected letters, digits, '.', '_' and '-' only, got {name!r}")


def check_before_writing(capture: Any) -> None:
    """Everything that reading would check, of a `Capture` made by hand."""
    source, v = "capture", len(capture.images)
    check_names(capture.names, v, source)
    for field in ("images", "masks"):
        if (array := getattr(capture, field)) is not None:
            check_range(numbers(array, source, field), source, field)
    K, poses = np.asarray(capture.cameras.K), capture.poses
    cam_from_world = np.asarray(capture.cameras.cam_from_world)
    if len(K) != v:
        raise CaptureError(source, "cameras", f"expected {v}, one per image, got {len(K)}")
    height, width = capture.images.shape[1:3]
    if (capture.cameras.width, capture.cameras.height) != (width, height):
        got = f"{capture.cameras.width} x {capture.cameras.height}"
        raise CaptureError(source, "cameras", f"expected the image size {width} x {height}, got {got}")
    for i in range(v):
        checked_camera(K[i], cam_from_world[i], width, height, source, f"view {i}")
    body_parameters(capture.body, capture.betas, np.asarray(poses.rotations), np.asarray(poses.translation), source)
    for i, frame in enumerate(capture.frames):
        checked_frame(int(frame), capture.frame_count, source, f"frames[{i}]")
