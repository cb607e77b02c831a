"""Writes views of an avatar as files: PNG images, and an OpenEXR file of layers for compositing
programs.

Layers of a view, besides the colors:

Z: depth along the camera's axis, metres.
position: the point of the world at this depth on the ray of the pixel, metres.
normal: unit normals of the body's surface, in the world. Each Gaussian has the normal of the
    vertex that is nearest to it in the T-pose, turned by its own skinning transform. The normal of
    a pixel is the mean of these normals, weighted as its color is, and scaled to length 1.
part: the number of the joint that moves the largest part of the pixel's color, counted from 1 in
    the header's `parts`. It is 0 where alpha is below 1/2. Each Gaussian counts for the joint of
    its largest skinning weight.

None of these is multiplied by alpha. All are 0 where alpha is 0.

The OpenEXR file is compressed without loss (ZIP). Each view is a part of the file. The header of a
part has the camera: `K` (3x3, pixels) and `cam_from_world` (4x4, OpenCV, metres), float32, exact.
R, G, B and A are premultiplied, as compositing programs expect. Colors are the values of the
photos, as in PNG files: they are sRGB-encoded, not linear in light.
"""

import dataclasses
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar, surface_normals, turned_normals
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import composite_over, draw, posed, splatting_of
from humangs_jax.body.model import BodyPose, blend_transforms, joint_transforms
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.compiled import compiled
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import COMPILING, bar
from humangs_jax.geometry.camera import Camera, require_pinhole
from humangs_jax.io.atomic import add_files, check_ours, replace_file
from humangs_jax.io.images import DRAWN, is_own_output, write_png
from humangs_jax.io.reading import limits
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import Rendering, render

LAYERS = ("rgba", "z", "position", "normal", "part")
EXR_NAME = "views.exr"
COVERED = 0.5
"""Pixels with an alpha below this belong to no part."""
RGBA = ("R", "G", "B", "A")
DEPTH = "Z"
WIDE = (DEPTH, "position.")
"""Channels whose names begin with one of these keep 32 bits when the others have 16. They are
lengths in metres, and half floats have steps of 4 mm beyond 4 m.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class ExrView:
    """One rendered view."""

    rgba: Float[np.ndarray, "h w 4"]
    """Premultiplied colors and coverage, (h, w, 4)."""
    depth: Float[np.ndarray, "h w"] | None
    """Depths along the camera's axis, (h, w), metres. None: they are not written."""
    K: Float[np.ndarray, "3 3"]
    """The camera matrix, (3, 3), pixels."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """From the world to the camera, (4, 4), metres."""
    name: str
    """The name of the part, unique in a file."""
    channels: Mapping[str, Float[np.ndarray, "h w"]] = dataclasses.field(default_factory=dict)
    """Further images by name, (h, w) each."""
    attributes: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Strings for the header, by name."""


@dataclasses.dataclass(frozen=True)
class ExrLayers:
    """Which layers an EXR file of views has, and with how many bits."""

    layers: tuple[str, ...] = ("rgba", "z")
    """The layers to write, names in `LAYERS`. Colors are always written."""
    half: bool = False
    """Whether colors, normals and parts have 16 bits. Z and positions keep 32: beyond 4 m half
    floats are 4 mm apart.
    """

    def check(self) -> None:
        """Check that all layers exist.

        Raises: ValueError naming a layer that does not exist.
        """
        unknown = [layer for layer in self.layers if layer not in LAYERS]
        if unknown:
            raise ArgumentError("channels", f"{unknown[0]!r}: expected some of {', '.join(LAYERS)}")

    def bytes_of(self, views: int, width: int, height: int) -> int:
        """Returns the size of all layers in memory, bytes, with 32 bits for each number."""
        channels = {"rgba": 4, "z": 1, "position": 3, "normal": 3, "part": 1}
        return 4 * views * width * height * sum(channels[name] for name in {"rgba", *self.layers})


def write_views(
    out: str | os.PathLike[str],
    avatar: Avatar,
    poses: BodyPose,
    cameras: Camera,
    shot: FrameSettings,
    exr: ExrLayers | None = None,
    progress: bool = True,
    exposure_gains: Float[np.ndarray, "v 3"] | None = None,
    names: Sequence[str] | None = None,
) -> int:
    """Draw v images of an avatar into a folder, pose i from camera i: view_000.png and so on. With
    `exr`, the file views.exr is written, too.

    exposure_gains: factors on the colors in each image, (v, 3), see `data.exposure`. names: the
    names of the images, in place of view_000 and so on.

    The files appear together when all are drawn. Images view_*.png and a views.exr of an earlier
    call are removed. Returns the number of views.

    Raises: ValueError if a file of the same name was not written by humangs; OSError if the files
    cannot be written. With `exr` also ValueError if a layer does not exist, if a camera has
    distortion or a lens other than a pinhole, or if the layers of all views have more bytes than
    the limit `array_bytes` (see docs/security.md).
    """
    out, count = Path(out), len(poses)
    if names is None:
        names = [f"view_{i:03d}" for i in range(count)]
    # an EXR file is checked before anything is drawn
    if exr is not None:
        exr.check()
        most, size = limits().array_bytes, exr.bytes_of(count, cameras.width, cameras.height)
        if size > most:
            raise ValueError(
                f"{out / EXR_NAME}: {count} views are {size:.3g} bytes, more than {most:.3g}:"
                " expected fewer or smaller ones"
            )
    how = splatting_of(shot, avatar)
    check_ours((out / f"{name}.png" for name in names), is_own_output)

    def write(folder: Path):
        drawn = draw(avatar, poses, cameras, jnp.zeros(3), how, exposure_gains)
        views = []
        for i, rendering in enumerate(
            bar(drawn, total=count, desc="render", unit="view", first=COMPILING, shown=progress)
        ):
            write_png(
                folder / f"{names[i]}.png", composite_over(rendering, shot.color()), mark=DRAWN
            )
            if exr is not None:
                views.append(
                    exr_view(names[i], avatar, poses[i], cameras[i], rendering, exr.layers, how)
                )
        if exr is not None:
            write_exr(folder / EXR_NAME, views, half=exr.half)

    # views of an earlier call go, so that the folder holds those of this one
    old = [file.name for file in (*out.glob("view_*.png"), *out.glob(EXR_NAME))]
    add_files(out, write, without=old, ours=is_own_output)
    return count


def exr_view(
    name: str,
    avatar: Avatar,
    pose: BodyPose,
    camera: Camera,
    rendering: Rendering,
    layers: Iterable[str],
    how: SplatConfig,
) -> ExrView:
    """Returns a view with its layers. rendering: the avatar in this pose, drawn from this camera
    onto black. layers: names in `LAYERS`. how: how the normals and parts are splatted.

    Raises: ValueError for a camera with distortion or a lens other than a pinhole.
    """
    layers, alpha = set(layers), np.asarray(rendering.alpha)
    channels, attributes = {}, {}
    # positions follow from the depth
    if "position" in layers:
        positions = np.where(
            alpha[..., None] > 0, unprojected(camera, np.asarray(rendering.depth)), 0
        )
        channels |= {f"position.{axis}": positions[..., i] for i, axis in enumerate("XYZ")}
    # normals and parts are drawn in one image, as features of the Gaussians
    values: dict[str, Float[Array, "g c"]] = {}
    if "normal" in layers:
        values["normal"] = gaussian_normals(avatar, pose)
    if "part" in layers:
        parts = gaussian_parts(avatar)
        present = np.unique(parts)
        values["part"] = jnp.asarray(parts[:, None] == present, jnp.float32)
    drawn: dict[str, Float[np.ndarray, "h w c"]] = {}
    if values:
        gaussians = posed(avatar, pose)
        planned = plan_buffers(gaussians, camera, how)
        together = jnp.concatenate(list(values.values()), axis=-1)
        image = np.asarray(render(gaussians, camera, planned, features=together).features)
        ends = np.cumsum([each.shape[1] for each in values.values()])
        drawn = dict(zip(values, np.split(image, ends[:-1], axis=-1), strict=True))
    if "normal" in layers:
        sums = drawn["normal"]
        length = np.linalg.norm(sums, axis=-1, keepdims=True)
        normals = np.divide(
            sums, length, out=np.zeros_like(sums), where=(length > 0) & (alpha[..., None] > 0)
        )
        channels |= {f"normal.{axis}": normals[..., i] for i, axis in enumerate("XYZ")}
    if "part" in layers:
        # each pixel that is covered shows one part
        channels["part"] = np.where(
            alpha >= COVERED, 1 + present[drawn["part"].argmax(axis=-1)], 0
        ).astype(np.float32)
        attributes["parts"] = ",".join(avatar.joint_names)
    plain = _plain_view(name, camera, rendering)
    depth = plain.depth if "z" in layers else None
    return dataclasses.replace(plain, depth=depth, channels=channels, attributes=attributes)


def write_renderings_exr(
    path: str | os.PathLike[str], cameras: Camera, renderings: Iterable[Rendering]
) -> None:
    """Write renderings onto black as an EXR file with one part for each view: premultiplied RGBA in
    32 bits, Z in metres, and the camera.

    Raises: ValueError for a camera with distortion or a lens other than a pinhole; OSError if the
    file cannot be written.
    """
    each = enumerate(zip(cameras, renderings, strict=True))
    write_exr(
        Path(path),
        [_plain_view(f"view_{i:03d}", camera, rendering) for i, (camera, rendering) in each],
    )


def _plain_view(name: str, camera: Camera, rendering: Rendering) -> ExrView:
    require_pinhole("an .exr with its camera", camera)
    alpha = np.asarray(rendering.alpha)
    return ExrView(
        rgba=np.concatenate([np.asarray(rendering.rgb), alpha[..., None]], axis=-1),
        depth=np.asarray(rendering.depth),
        K=np.asarray(camera.K),
        cam_from_world=np.asarray(camera.cam_from_world),
        name=name,
    )


def unprojected(camera: Camera, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Returns the points of the world at given depths on the rays through the centres of the
    pixels, metres. depth: along the camera's axis, metres.

    Raises: ValueError for another lens than a pinhole, and for a camera with distortion.
    """
    require_pinhole("unprojection", camera)
    K = np.asarray(camera.K, np.float64)
    world_from_cam = np.linalg.inv(np.asarray(camera.cam_from_world, np.float64))
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    points = (depth[..., None] * rays) @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    return points.astype(np.float32)


def gaussian_parts(avatar: Avatar) -> Int[np.ndarray, " g"]:
    """Returns for each Gaussian the index of the joint with its largest skinning weight."""
    return np.asarray(avatar.skinning_weights).argmax(axis=-1)


def gaussian_normals(avatar: Avatar, pose: BodyPose) -> Float[Array, "g 3"]:
    """Returns a unit normal of the posed body's surface for each Gaussian. It is the normal of the
    vertex that is nearest to the Gaussian in the T-pose, turned by the Gaussian's skinning
    transform.
    """
    normals = surface_normals(avatar.rest_vertices, avatar.faces, avatar.gaussians.means)
    return _posed_normals(normals, avatar, pose)


@compiled()
def _posed_normals(
    normals: Float[Array, "g 3"], avatar: Avatar, pose: BodyPose
) -> Float[Array, "g 3"]:
    transforms = joint_transforms(
        avatar.rest_joints, avatar.parents, pose.rotations, pose.translation
    )
    return turned_normals(normals, blend_transforms(avatar.skinning_weights, transforms)[:, :3, :3])


# The file
# --------------------------------------------------------------------------------------------------


def write_exr(path: str | Path, views: Sequence[ExrView], half: bool = False) -> None:
    """Write views of one size as the parts of one file. If writing fails, the path stays as it was.

    half: see `ExrLayers`. In 16 bits numbers beyond 65504 become infinite. Raises: OSError if the
    file cannot be written.
    """
    import OpenEXR  # ty: ignore[import-not-found]  a compiled module without stubs

    parts = [_to_part(view, half) for view in views]

    def write(temporary: Path):
        content = io.BytesIO()  # it knows names in UTF-8 only
        with OpenEXR.File(parts) as file:
            file.write(content)
        temporary.write_bytes(content.getvalue())

    try:
        replace_file(path, write)
    except RuntimeError as error:
        raise OSError(f"{path}: cannot be written: {' '.join(str(error).split())}") from error


def _to_part(view: ExrView, half: bool) -> Any:
    import OpenEXR  # ty: ignore[import-not-found]  a compiled module without stubs

    channels = {channel: view.rgba[..., i] for i, channel in enumerate(RGBA)} | dict(view.channels)
    if view.depth is not None:
        channels[DEPTH] = view.depth
    # OpenEXR writes strided arrays wrongly in silence and refuses every type but its own
    narrow = {name for name in channels if half and not name.startswith(WIDE)}
    with np.errstate(over="ignore"):
        channels = {
            name: np.ascontiguousarray(image, np.float16 if name in narrow else np.float32)
            for name, image in channels.items()
        }
    camera = {
        name: np.ascontiguousarray(getattr(view, name), np.float32)
        for name in ("K", "cam_from_world")
    }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **view.attributes,
        **camera,
    }
    return OpenEXR.Part(header, channels, view.name)
