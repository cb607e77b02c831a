"""The part of a capture that needs no body: photographs, masks, cameras, and which moment each view shows.

It is what `humangs import cameras` writes and `humangs fit` finds the body for.
"""

import dataclasses
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float, Int
from humangs_jax.data.capture_checks import CaptureError, checked_camera, numbers
from humangs_jax.data.capture_reading import names_from_paths, read_description, read_view, view_frame
from humangs_jax.geometry.camera import Camera, stack_cameras

DEMO_CAPTURE = "demo_capture"
"""Name of the capture of a synthetic person that comes with the package."""


@dataclasses.dataclass(frozen=True, eq=False)
class Photographs:
    """Photographs of one person (numpy on the host).

    images: (v, h, w, 3) in [0, 1], white behind the masks. masks: (v, h, w) coverage in [0, 1], or None.
    cameras: a batch of v, metres. frames: (v,) the moment that each view shows. names: one per view.
    """

    images: Float[np.ndarray, "v h w 3"]
    masks: Float[np.ndarray, "v h w"] | None
    cameras: Camera
    frames: Int[np.ndarray, " v"]
    names: tuple[str, ...]

    @property
    def frame_count(self) -> int:
        """Number of moments: one more than the last that a view shows."""
        return int(self.frames.max()) + 1


def load_photographs(path: str | Path) -> Photographs:
    """Read the photographs of a capture folder, whose body.npz need not exist.

    Raises: CaptureError, one line naming file and field.
    """
    folder = capture_folder(path)
    return read_photographs(folder, read_description(folder / "capture.json"))


def capture_folder(path: str | Path) -> Path:
    """The folder; "demo_capture", where no such folder is, stands for the one that comes with the package."""
    folder = Path(path)
    if not folder.exists() and folder.parts[:1] == (DEMO_CAPTURE,):
        return Path(str(resources.files("humangs_jax"))) / "assets" / folder
    return folder


def read_photographs(
    folder: Path,
    description: dict[str, Any],
    chosen: Sequence[int] | Int[np.ndarray, " any"] | None = None,
    poses: int | None = None,
) -> Photographs:
    """Photographs and cameras that a checked capture.json describes.

    Arguments: chosen: read these views only, in this order. poses: how many moments there are, None: as many as views say.
    Raises: CaptureError.
    """
    file = folder / "capture.json"
    views = description["views"]
    if chosen is not None:
        views = [views[i] for i in chosen]
    with_mask = ["mask" in view for view in views]
    if any(with_mask) and not all(with_mask):
        raise CaptureError(
            file, f"views[{with_mask.index(False)}].mask", "missing, but other views have one: give all or none"
        )
    if poses is None:
        poses = 1 + max(_frame_number(view, file, f"views[{i}].frame") for i, view in enumerate(description["views"]))
    frames = [view_frame(view, poses, file, f"views[{i}].frame") for i, view in enumerate(views)]
    matrices = [
        [
            numbers(view[key], file, f"views[{i}].{key}", shape)
            for key, shape in (("K", (3, 3)), ("cam_from_world", (4, 4)))
        ]
        for i, view in enumerate(views)
    ]
    images, masks = _pictures(folder, views, description.get("background", "photo") == "white")
    height, width = images.shape[1:3]
    cameras = [checked_camera(*matrices[i], width, height, file, f"views[{i}]") for i in range(len(views))]
    names = names_from_paths([view["image"] for view in views])
    return Photographs(images, masks, stack_cameras(cameras), np.asarray(frames, np.int32), names)


def _frame_number(view, file, field):
    frame = view.get("frame", 0)
    if isinstance(frame, bool) or not isinstance(frame, int) or frame < 0:
        raise CaptureError(file, field, f"expected an integer of at least 0, got {frame!r}")
    return frame


def _pictures(folder, views, on_white):
    """Images and masks (or None), all of one size."""
    images, masks = zip(*[read_view(folder, view, on_white) for view in views], strict=True)
    height, width = images[0].shape[:2]
    for view, image, mask in zip(views, images, masks, strict=True):
        if image.shape != images[0].shape:
            size = f"{image.shape[1]} x {image.shape[0]}"
            raise CaptureError(
                folder / view["image"], "size", f"{size}, but the first view has {width} x {height}: expected one size"
            )
        if (mask is None) != (masks[0] is None):
            raise CaptureError(folder / view["image"], "alpha", "expected an alpha channel in all images or in none")
    return np.stack(images), None if masks[0] is None else np.stack(masks)
