"""Draws a sheet of images that shows the options of `humangs animate` and `humangs render`."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image

from experiments.harness import Run, entry
from experiments.subjects import shipped_person
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import (
    a_pose_of,
    draw,
    images,
    motion_views,
    rest_pose_of,
    splatting_of,
    turntable_views,
)
from humangs_jax.avatar.layers import LAYERS, exr_view
from humangs_jax.avatar.video import tile
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.io.images import to_uint8
from humangs_jax.motion import load_motion

WALKED = 2.5
"""Metres that the person walks forward."""
SHOWN = 6
"""Images in a row of the sheet."""
FIRST = 10
"""Number of the frame of the walk that is shown where one frame is enough."""


@entry
def video(run: Run, image: Path) -> None:
    """Draws a sheet that shows options of `humangs animate` and `humangs render`, with the shipped
    person and walk, 2.5 m forward.

    The rows show a camera that follows, a camera that stands still, angles of the camera,
    backgrounds and poses, and layers.

    Options:
    image: JPEG to write
    """
    person, motion = shipped_person(), forward_walk()
    rows = [
        walked(person, motion, follow=True),
        walked(person, motion, follow=False),
        looked_at(person, motion),
        posed_before(person),
        layered(person, motion),
    ]
    sheet = []
    for row in rows:
        labels, pictures = zip(*row, strict=True)
        sheet.append(tile(np.stack(pictures), labels=list(labels), columns=SHOWN))
    Image.fromarray(to_uint8(np.concatenate(sheet))).save(image, quality=88)


def forward_walk() -> Motion:
    """Returns the shipped walk, which is on the spot, moved forward."""
    motion = load_motion()
    forward = np.linspace([0, 0, 0], [0, 0, WALKED], len(motion.translations))
    path = np.asarray(motion.translations) + forward
    return replace(motion, translations=jnp.asarray(path, jnp.float32))


def walked(avatar: Avatar, motion: Motion, follow: bool) -> list[tuple[str, np.ndarray]]:
    """Returns (label, image) of frames of the walk, seen from the side."""
    shot = FrameSettings(size=240, azimuth=70.0)
    poses, cameras = motion_views(avatar, motion, shot, follow=follow)
    chosen = np.linspace(0, len(poses) - 1, SHOWN).astype(int)
    drawn = images(avatar, poses[chosen], cameras[chosen], shot)
    name = "follows" if follow else "--no-follow"
    return [
        (f"{name}: {i / motion.fps:.1f} s", image) for i, image in zip(chosen, drawn, strict=True)
    ]


def looked_at(avatar: Avatar, motion: Motion) -> list[tuple[str, np.ndarray]]:
    """Returns (label, image) of a frame of the walk with other options of the camera and the
    renderer.
    """
    drawn = []
    changes = [
        ("azimuth", 180),
        ("elevation", 60),
        ("elevation", -30),
        ("fov", 90),
        ("distance", 1.5),
        ("splat", "fast"),
    ]
    for name, value in changes:
        shot = dataclasses.replace(FrameSettings(size=240, azimuth=20.0), **{name: value})
        poses, cameras = motion_views(avatar, motion, shot)
        one = slice(FIRST, FIRST + 1)
        drawn.append((f"--{name} {value}", next(images(avatar, poses[one], cameras[one], shot))))
    return drawn


def posed_before(avatar: Avatar) -> list[tuple[str, np.ndarray]]:
    """Returns (label, image) of poses in front of backgrounds."""
    drawn = []
    for name, pose in (("T-pose", rest_pose_of(avatar)), ("--pose a", a_pose_of(avatar))):
        for color in ("white", "#24425c", "transparent"):
            shot = FrameSettings(size=240, azimuth=30.0, background=color)
            image = next(images(avatar, *turntable_views(avatar, pose, 1, shot), shot))
            drawn.append((f"{name}, {color}", over_checks(image)))
    return drawn


def over_checks(image: np.ndarray) -> np.ndarray:
    """Returns a transparent image over grey squares, and an image without alpha unchanged."""
    if image.shape[-1] == 3:
        return image
    rows, columns = (np.arange(size) // 12 for size in image.shape[:2])
    checks = np.where((np.add.outer(rows, columns) % 2 == 0)[..., None], 0.8, 0.6)
    return image[..., :3] * image[..., 3:] + checks * (1 - image[..., 3:])


def layered(avatar: Avatar, motion: Motion) -> list[tuple[str, np.ndarray]]:
    """Returns (label, image) of the layers of an EXR file, as colors."""
    # one frame with all layers
    shot = FrameSettings(size=240, azimuth=20.0)
    poses, cameras = motion_views(avatar, motion, shot)
    pose, camera, how = poses[FIRST], cameras[FIRST], splatting_of(shot, avatar)
    rendering = next(draw(avatar, [pose], [camera], jnp.zeros(3), how))
    view = exr_view("view", avatar, pose, camera, rendering, LAYERS, how)
    seen = view.rgba[..., 3:] > 0
    assert view.depth is not None  # asked for

    # ranges of the numbers over the person, and a color for each part
    def vectors(name):
        return np.stack([view.channels[f"{name}.{axis}"] for axis in "XYZ"], -1)

    position, normal = vectors("position"), vectors("normal")
    inside = position[seen[..., 0]]
    low, high = inside.min(axis=0), inside.max(axis=0)
    near, far = view.depth[seen[..., 0]].min(), view.depth[seen[..., 0]].max()
    palette = np.random.default_rng(3).uniform(0.15, 1, (len(avatar.joint_names) + 1, 3))
    palette[0] = 0

    def grey(plane):
        return np.repeat(plane[..., None], 3, axis=-1)

    return [
        ("R G B, premultiplied", view.rgba[..., :3]),
        ("A", grey(view.rgba[..., 3])),
        ("Z", grey(np.where(seen[..., 0], 1 - 0.8 * (view.depth - near) / (far - near), 0))),
        ("position", np.where(seen, (position - low) / (high - low), 0)),
        ("normal", np.where(seen, 0.5 + 0.5 * normal, 0)),
        ("part", palette[view.channels["part"].astype(int)]),
    ]
