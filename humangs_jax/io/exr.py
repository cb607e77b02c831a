"""Rendered views as OpenEXR files: lossless ZIP, cameras in the header; several views are parts of one file.

Channels R, G, B, A and Z (depth along the optical axis, metres, 0 for background), and further channels
under their own names (`position.X`), in 32 bits or in half precision. Header of each part: `K` (3x3, pixels) and
`cam_from_world` (4x4, OpenCV, metres), float32, exact. Colours are stored as given. Compositing programs expect them
premultiplied, that is rendered onto black. Ours are the values of the photos, as in PNG files: encoded for a display by the curve
of sRGB, not linear in light.
"""

import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.atomic import replace_file
from humangs_jax.io.reading import Refused, check_limit, open_file, reading

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

    rgba: (h, w, 4) colours and coverage. depth: (h, w) metres, or None.
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

    @property
    def camera(self) -> Camera:
        """The camera in the header. Raises: ValueError if there is none or it is not a camera."""
        if self.K is None or self.cam_from_world is None:
            raise ValueError(f"view {self.name!r}: no camera: expected K and cam_from_world")
        return Camera.from_opencv(self.K, self.cam_from_world, self.rgba.shape[1], self.rgba.shape[0])


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


def read_exr(path: str | Path) -> list[ExrView]:
    """The views of a file, one per part; half floats become float32. A part without alpha is opaque, grey is repeated.

    Raises: FileNotFoundError; FileError if it is no OpenEXR file, a damaged one, has more pixels than the limits allow, a part
    without colours, or one whose K or cam_from_world is no matrix.
    """
    import OpenEXR  # ty: ignore[import-not-found]  a compiled module without stubs

    path = Path(path)
    with reading(path, "OpenEXR file"):
        open_file(path).close()  # OpenEXR opens it by name
        if not OpenEXR.isOpenExrFile(str(path)):  # checked first: the reader prints to stderr before it raises
            raise Refused("not an OpenEXR file")
        with OpenEXR.File(str(path), header_only=True) as file:
            count = len(file.parts)
            check_limit("array_bytes", sum(_decoded_bytes(part) for part in file.parts), "bytes of pixels")
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if len(file.parts) < count:  # the binding drops parts that it cannot decode, with no more than a print
                raise Refused(f"damaged: {count - len(file.parts)} of {count} parts cannot be decoded")
            return [_from_part(part, path) for part in file.parts]


def _to_part(view, name, half):
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


def _decoded_bytes(part):
    """Of a part whose header is read: all channels in float32."""
    (left, top), (right, bottom) = (tuple(int(x) for x in corner) for corner in part.header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    check_limit("side", max(width, height), "pixels along a side")
    check_limit("pixels", width * height, f"pixels ({width} x {height})")
    return 4 * width * height * max(1, len(part.header["channels"]))


def _from_part(part, path):
    images = {name: np.asarray(channel.pixels, np.float32) for name, channel in part.channels.items()}
    grey = images.pop("Y", None)
    colours = [colour for channel in RGBA[:3] if (colour := images.pop(channel, grey)) is not None]
    if len(colours) < 3:
        raise ValueError(f"{path}: part {part.name()!r}: expected channels R, G, B, got {sorted(part.channels)}")
    alpha = images.pop("A", np.ones_like(colours[0]))
    depth = images.pop(DEPTH, None)
    matrices = [_matrix(part, key, size, path) for key, size in (("K", 3), ("cam_from_world", 4))]
    attributes = {k: v for k, v in part.header.items() if isinstance(v, str) and k not in STANDARD_ATTRIBUTES}
    return ExrView(np.stack([*colours, alpha], axis=-1), depth, *matrices, part.name(), images, attributes)


def _matrix(part, key, size, path):
    if key not in part.header:
        return None
    matrix = np.asarray(part.header[key])
    if matrix.shape != (size, size):
        raise ValueError(f"{path}: part {part.name()!r}: {key}: expected a {size} x {size} matrix, got {matrix.shape}")
    return matrix.astype(np.float32)
