"""Rendered views as OpenEXR files: lossless ZIP, cameras in the header; several views are parts of one file.

Channels R, G, B, A and Z (depth along the optical axis, metres, 0 for background), and further channels
under their own names (`position.X`), in 32 bits or in half precision. Header of each part: `K` (3x3, pixels) and
`cam_from_world` (4x4, OpenCV, metres), float32, exact. Colors are stored as given. Compositing programs expect them
premultiplied, that is rendered onto black. Ours are the values of the photos, as in PNG files: encoded for a display by the curve
of sRGB, not linear in light.
"""

import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.atomic import replace_file

RGBA = ("R", "G", "B", "A")
DEPTH = "Z"
WIDE = (DEPTH, "position.")
"""How the names of channels start that stay in 32 bits when others are halved: metres, of which half precision has steps of 2 mm
at 4 m."""
STANDARD_ATTRIBUTES = {"name", "type", "compression", "owner", "view", "comments"}
"""Header strings with a meaning of their own in OpenEXR: neither written nor returned as ours."""


@dataclasses.dataclass(frozen=True, eq=False)
class ExrView:
    """One rendered view.

    rgba: (h, w, 4) colors and coverage. depth: (h, w) metres, or None.
    K, cam_from_world: (3, 3) pixels and (4, 4) metres of its camera, both or neither.
    name: of the part; unique in a file. channels: further (h, w) images by name. attributes: strings for the header.
    """

    rgba: Float[np.ndarray, "h w 4"]
    depth: Float[np.ndarray, "h w"] | None = None
    K: Float[np.ndarray, "3 3"] | None = None
    cam_from_world: Float[np.ndarray, "4 4"] | None = None
    name: str = ""
    channels: Mapping[str, Float[np.ndarray, "h w"]] = dataclasses.field(default_factory=dict)
    attributes: Mapping[str, str] = dataclasses.field(default_factory=dict)


def write_exr(path: str | Path, views: ExrView | Sequence[ExrView], half: bool = False) -> None:
    """Write one view, or several as parts of one file (all of one size); the file appears whole or not at all.

    Unnamed views are called view000, view001, ... half: store all in 16 bits but Z and `position.*`, which stay in 32 like
    everything without it; numbers beyond 65504 become infinite.

    Raises: ValueError naming the view and what does not fit; OSError if the file cannot be written.
    """
    import OpenEXR  # ty: ignore[import-not-found]  a compiled module without stubs

    views = [views] if isinstance(views, ExrView) else list(views)
    if not views:
        raise ValueError("views: expected at least one, got none")
    names = [view.name or f"view{i:03d}" for i, view in enumerate(views)]
    if len(set(names)) < len(names):
        raise ValueError(f"views: expected different names, got {names}")
    if len({view.rgba.shape for view in views}) > 1:  # parts of a file share one display window
        raise ValueError(f"views: expected one image size, got {sorted({view.rgba.shape[:2] for view in views})}")
    parts = [_to_part(view, name, half) for view, name in zip(views, names, strict=True)]

    def write(temporary: Path):
        content = io.BytesIO()  # it knows names in UTF-8 only
        with OpenEXR.File(parts) as file:
            file.write(content)
        temporary.write_bytes(content.getvalue())

    try:
        replace_file(path, write)
    except RuntimeError as error:
        raise OSError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error


def _to_part(view: ExrView, name: str, half: bool) -> Any:
    import OpenEXR  # ty: ignore[import-not-found]  a compiled module without stubs

    height, width = view.rgba.shape[:2]
    channels = {channel: view.rgba[..., i] for i, channel in enumerate(RGBA)}
    if view.depth is not None:
        channels[DEPTH] = view.depth
    for channel, image in view.channels.items():
        if channel in channels:
            raise ValueError(f"view {name!r}: channels: {channel} is there already")
        channels[channel] = image
    # OpenEXR writes strided arrays wrongly in silence and refuses every type but its own
    kinds = {name: np.float16 if half and not name.startswith(WIDE) else np.float32 for name in channels}
    with np.errstate(over="ignore"):
        channels = {name: np.ascontiguousarray(image, kinds[name]) for name, image in channels.items()}
    for channel, image in channels.items():
        if image.shape != (height, width):
            raise ValueError(f"view {name!r}: channel {channel}: expected shape {(height, width)}, got {image.shape}")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for key, value in view.attributes.items():
        if key in STANDARD_ATTRIBUTES:
            raise ValueError(f"view {name!r}: attributes: {key} has a meaning of its own in OpenEXR")
        header[key] = str(value)
    if (view.K is None) != (view.cam_from_world is None):
        raise ValueError(f"view {name!r}: expected both K and cam_from_world, or neither")
    if view.K is not None:
        header["K"] = np.ascontiguousarray(view.K, np.float32)
        header["cam_from_world"] = np.ascontiguousarray(view.cam_from_world, np.float32)
    return OpenEXR.Part(header, channels, name)
