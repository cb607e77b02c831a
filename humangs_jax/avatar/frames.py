"""Images of an avatar: along a motion, from a circle of cameras, or as a capture's cameras saw the person."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose, RestBody
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.progress import bar
from humangs_jax.data.capture import Capture
from humangs_jax.data.motion import Motion, grounded
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import BufferOverflowError, Rendering, plan_buffers, render

VERTICAL_FOV = np.pi / 6
"""Narrow enough that a person keeps natural proportions."""
MARGIN = 1.08
"""Room around a person in the frame."""
ARM_REACH = 0.3
"""Share of the height that swinging arms and striding legs reach from the root, sideways."""
ELEVATION = 0.1
"""Radians above the horizon."""

posed = jax.jit(skin)


def draw(
    avatar: Avatar, poses: Iterator[BodyPose], cameras: Iterator[Camera], background: Float[Array, "3"] | None = None
) -> Iterator[Rendering]:
    """One rendering per pose and camera."""
    return draw_gaussians((posed(avatar, pose) for pose in poses), cameras, background, SPLAT_PRESETS[avatar.rendering])


def draw_gaussians(
    gaussians: Iterator[Gaussians],
    cameras: Iterator[Camera],
    background: Float[Array, "3"] | None = None,
    how: SplatConfig = SPLAT_PRESETS["exact"],
) -> Iterator[Rendering]:
    """One rendering per frame of Gaussians and camera.

    Plans for the first frame with room to spare: compiles once per image size, and again only if a frame needs more
    room than that.
    """
    config = None
    for frame, camera in zip(gaussians, cameras, strict=True):
        config = config or plan_buffers(frame, camera, how)
        try:
            rendering = render(frame, camera, config, background)
        except BufferOverflowError:
            config = plan_buffers(frame, camera, how)
            rendering = render(frame, camera, config, background)
        yield rendering


def motion_frames(
    avatar: Avatar, motion: Motion, size: int, azimuth: float = 0.0, turn: float = 0.0, progress: bool = True
) -> Iterator[Float[np.ndarray, "size size 3"]]:
    """Frames of a moving avatar, each (size, size, 3) in [0, 1], drawn when asked for. azimuth and turn in degrees."""
    rest = RestBody(avatar.rest_vertices, avatar.rest_joints)
    motion = grounded(motion, rest, avatar.parents)
    count = len(motion.translations)
    azimuths = np.radians(azimuth + turn * np.arange(count) / max(count, 1))
    # the target stands still: the frame holds everywhere that the root goes
    path = np.asarray(motion.translations + avatar.rest_joints[0])[:, [0, 2]]
    height = float(np.ptp(np.asarray(avatar.rest_vertices)[:, 1]))
    middle = 0.5 * (path.min(0) + path.max(0))
    half_width = 0.5 * float(np.linalg.norm(np.ptp(path, axis=0))) + ARM_REACH * height
    half = MARGIN * max(0.5 * height, half_width)
    cameras = orbit(
        jnp.asarray([middle[0], 0.5 * height, middle[1]], jnp.float32),
        half / np.tan(0.5 * VERTICAL_FOV) + half_width,
        jnp.asarray(azimuths, jnp.float32),
        ELEVATION,
        intrinsics_from_fov(VERTICAL_FOV, size, size),
        size,
        size,
    )
    renderings = draw(avatar, (motion.pose(i) for i in range(count)), (cameras[i] for i in range(count)))
    shown = bar(renderings, total=count, desc="animate", unit="frame", shown=progress)
    return (np.clip(np.asarray(rendering.rgb), 0, 1) for rendering in shown)


def turntable_renderings(avatar: Avatar, views: int, size: int) -> tuple[Camera, list[Rendering]]:
    """The T-pose from `views` cameras on a circle, starting in front."""
    if views < 1 or size < 1:
        raise ValueError(f"--views and --size must be at least 1, got {views} and {size}")
    vertices = np.asarray(avatar.rest_vertices)
    center = 0.5 * (vertices.min(0) + vertices.max(0))
    radius = np.linalg.norm(vertices - center, axis=-1).max()
    cameras = orbit(
        jnp.asarray(center),
        MARGIN * radius / np.sin(0.5 * VERTICAL_FOV),
        jnp.linspace(0, 2 * np.pi, views, endpoint=False),
        ELEVATION,
        intrinsics_from_fov(VERTICAL_FOV, size, size),
        size,
        size,
    )
    pose = BodyPose(jnp.zeros((len(avatar.parents), 3)), jnp.zeros(3))
    return cameras, list(draw(avatar, iter([pose] * views), (cameras[i] for i in range(views))))


def capture_renderings(
    avatar: Avatar, capture: Capture, background: Float[Array, "3"] | None = None
) -> tuple[Camera, list[Rendering]]:
    """The avatar in the poses and from the cameras of a capture.

    Raises: ValueError if the capture's body has another number of joints than the avatar.
    """
    joints = capture.poses.rotations.shape[1]
    if joints != len(avatar.parents):
        raise ValueError(f"the capture's poses have {joints} joints, the avatar has {len(avatar.parents)}")
    poses = (capture.pose(int(frame)) for frame in capture.frames)
    cameras = (capture.cameras[i] for i in range(capture.view_count))
    return capture.cameras, list(draw(avatar, poses, cameras, background))


def write_renderings(out: str | os.PathLike, cameras: Camera, renderings: list[Rendering], exr: bool = False) -> int:
    """Write renderings onto white as view_000.png ... into a folder, and views.exr if asked; all of them or none.

    Returns the number of views.
    """
    from humangs_jax.io.atomic import add_files
    from humangs_jax.io.images import write_png

    def write(folder: Path):
        for i, rendering in enumerate(renderings):
            write_png(folder / f"view_{i:03d}.png", np.asarray(rendering.rgb))
        if exr:
            write_renderings_exr(folder / "views.exr", cameras, renderings, background=1.0)

    add_files(out, write)
    return len(renderings)


def write_renderings_exr(
    path: str | os.PathLike, cameras: Camera, renderings: list[Rendering], background: float = 0.0
) -> None:
    """Float32 RGBA, premultiplied as compositing programs expect it, Z in metres and the camera's matrices, one part per view.

    Arguments: background: the grey that they were rendered onto, which is taken away: colours are 0 where alpha is.
    """
    from humangs_jax.io.exr import ExrView, write_exr

    def premultiplied(rendering):
        alpha = np.asarray(rendering.alpha)[..., None]
        return np.concatenate([np.asarray(rendering.rgb) - np.float32(background) * (1 - alpha), alpha], axis=-1)

    write_exr(
        Path(path),
        [
            ExrView(
                name=f"view_{i:03d}",
                rgba=premultiplied(r),
                depth=np.asarray(r.depth),
                K=np.asarray(cameras.K[i]),
                cam_from_world=np.asarray(cameras.cam_from_world[i]),
            )
            for i, r in enumerate(renderings)
        ],
    )
