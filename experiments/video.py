"""What the options of `humangs animate` and `humangs render` give: a sheet of images, what presets and pruning cost and save."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image

from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.subjects import shipped_person
from experiments.timing import medians
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import (
    a_pose_of,
    draw,
    images,
    motion_views,
    rest_pose_of,
    splatting_of,
    turntable_views,
    without_unseen,
)
from humangs_jax.avatar.layers import LAYERS, exr_view
from humangs_jax.avatar.shot import Shot
from humangs_jax.avatar.video import tile
from humangs_jax.core.pytree import replace
from humangs_jax.data.motion import Motion, load_motion
from humangs_jax.io.images import to_uint8

WALKED = 2.5
"""Metres."""
SHOWN = 6
"""Images in a row of the sheet."""
FIRST = 10
"""The frame of the walk that stands for the others."""
TIMED = 12
"""Frames that are timed, evenly spaced."""


@entry
def video(run: Run, avatar: Path | None = None, image: Path | None = None, size: int = 512, repeats: int = 5) -> None:
    """What the options of `humangs animate` and `humangs render` give, and what presets and pruning cost and save.

    The walk is the shipped one, moved 2.5 metres forward. Times are CPU times of drawing the same frames of the walk, medians of
    iterations in which each way of drawing has its turn, as shares of that of the exact preset; PSNR is the lowest of the frames.

    Options:
    avatar: an avatar file instead of the shipped person, feed-forward
    image: write a sheet of images here
    size: side of the images that are timed, pixels
    repeats: iterations of timing; 0: none
    """
    person, motion = Avatar.load(avatar) if avatar else shipped_person(), forward_walk()
    if image:
        write_sheet(image, person, motion)
    if not repeats:
        return
    numbers = measure(person, motion, size, repeats)
    rows = []
    for name, row in numbers.items():
        if isinstance(row, dict):
            shown = name != "exact" and "psnr" in row
            quality = [f"{row['psnr']:.1f}", f"{255 * row['largest_error']:.1f}"] if shown else ["", ""]
            rows.append([name, f"{row['cpu_ms'] / numbers['exact']['cpu_ms']:.2f}", *quality])
    every = numbers["gaussians"]
    said = (
        f"{numbers['frames']} frames of {size} pixels. In these frames {numbers['seen'] / every:.1%} of {every:,} Gaussians are "
        f"seen, in a walk with a whole turn of the camera {numbers['seen_in_a_turn'] / every:.1%}."
    )
    table = markdown_table(("", "time", "least PSNR, dB", "largest error, of 255"), rows)
    run.show(f"{table}\n\n{said}", numbers)


def forward_walk() -> Motion:
    """The shipped walk, which is on the spot, moved forward."""
    motion = load_motion()
    path = np.asarray(motion.translations) + np.linspace([0, 0, 0], [0, 0, WALKED], len(motion.translations))
    return replace(motion, translations=jnp.asarray(path, jnp.float32))


def write_sheet(path: Path, avatar: Avatar, motion: Motion) -> None:
    """A row each: the camera follows, it stands still, its angles, backgrounds and poses, layers."""
    rows: list[list[tuple[str, np.ndarray]]] = [
        walked(avatar, motion, follow=True),
        walked(avatar, motion, follow=False),
        looked_at(avatar, motion),
        posed_before(avatar),
        layered(avatar, motion),
    ]
    sheet = [tile(np.stack([image for _, image in row]), labels=[label for label, _ in row], columns=SHOWN) for row in rows]
    Image.fromarray(to_uint8(np.concatenate(sheet))).save(path, quality=88)


def walked(avatar: Avatar, motion: Motion, follow: bool) -> list[tuple[str, np.ndarray]]:
    """Frames of the walk, seen from the side."""
    shot = Shot(size=240, azimuth=70.0)
    poses, cameras = motion_views(avatar, motion, shot, follow=follow)
    chosen = np.linspace(0, len(poses) - 1, SHOWN).astype(int)
    drawn = images(avatar, poses[chosen], cameras[chosen], shot)
    name = "follows" if follow else "--no-follow"
    return [(f"{name}: {i / motion.fps:.1f} s", image) for i, image in zip(chosen, drawn, strict=True)]


def looked_at(avatar: Avatar, motion: Motion) -> list[tuple[str, np.ndarray]]:
    shots = {
        "--azimuth 180": Shot(size=240, azimuth=180.0),
        "--elevation 60": Shot(size=240, azimuth=20.0, elevation=60.0),
        "--elevation -30": Shot(size=240, azimuth=20.0, elevation=-30.0),
        "--fov 90": Shot(size=240, azimuth=20.0, fov=90.0),
        "--distance 1.5": Shot(size=240, azimuth=20.0, distance=1.5),
        "--splat fast": Shot(size=240, azimuth=20.0, splat="fast"),
    }
    drawn = []
    for label, shot in shots.items():
        poses, cameras = motion_views(avatar, motion, shot)
        one = slice(FIRST, FIRST + 1)
        drawn.append((label, next(images(avatar, poses[one], cameras[one], shot))))
    return drawn


def posed_before(avatar: Avatar) -> list[tuple[str, np.ndarray]]:
    drawn = []
    for name, pose in (("T-pose", rest_pose_of(avatar)), ("--pose a", a_pose_of(avatar))):
        for color in ("white", "#24425c", "transparent"):
            shot = Shot(size=240, azimuth=30.0, background=color)
            image = next(images(avatar, *turntable_views(avatar, pose, 1, shot), shot))
            drawn.append((f"{name}, {color}", over_checks(image)))
    return drawn


def over_checks(image: "np.ndarray") -> "np.ndarray":
    """A transparent image over grey squares; another one as it is."""
    if image.shape[-1] == 3:
        return image
    rows, columns = (np.arange(size) // 12 for size in image.shape[:2])
    checks = np.where((np.add.outer(rows, columns) % 2 == 0)[..., None], 0.8, 0.6)
    return image[..., :3] * image[..., 3:] + checks * (1 - image[..., 3:])


def layered(avatar: Avatar, motion: Motion) -> list[tuple[str, np.ndarray]]:
    """The layers of an EXR file, as colors."""
    shot = Shot(size=240, azimuth=20.0)
    poses, cameras = motion_views(avatar, motion, shot)
    pose, camera, how = poses[FIRST], cameras[FIRST], splatting_of(shot, avatar)
    rendering = next(draw(avatar, [pose], [camera], jnp.zeros(3), how))
    view = exr_view("view", avatar, pose, camera, rendering, LAYERS, how)
    seen = view.rgba[..., 3:] > 0
    assert view.depth is not None  # asked for
    position, normal = (np.stack([view.channels[f"{name}.{axis}"] for axis in "XYZ"], -1) for name in ("position", "normal"))
    low, high = (np.asarray([edge(position[..., i][seen[..., 0]]) for i in range(3)]) for edge in (np.min, np.max))
    near, far = view.depth[seen[..., 0]].min(), view.depth[seen[..., 0]].max()
    palette = np.random.default_rng(3).uniform(0.15, 1, (len(avatar.joint_names) + 1, 3))
    palette[0] = 0
    grey = lambda plane: np.repeat(plane[..., None], 3, axis=-1)
    return [
        ("R G B, premultiplied", view.rgba[..., :3]),
        ("A", grey(view.rgba[..., 3])),
        ("Z", grey(np.where(seen[..., 0], 1 - 0.8 * (view.depth - near) / (far - near), 0))),
        ("position", np.where(seen, (position - low) / (high - low), 0)),
        ("normal", np.where(seen, 0.5 + 0.5 * normal, 0)),
        ("part", palette[view.channels["part"].astype(int)]),
    ]


def measure(avatar: Avatar, motion: Motion, size: int, repeats: int) -> dict[str, Any]:
    """PSNR and CPU time of presets, of the search for what is seen, and of drawing without the rest."""
    shot = Shot(size=size, azimuth=20.0)
    poses, cameras = motion_views(avatar, motion, shot)
    chosen = np.linspace(0, len(poses) - 1, TIMED).astype(int)
    poses, cameras = poses[chosen], cameras[chosen]
    exact = splatting_of(shot, avatar)
    seen = without_unseen(avatar, poses, cameras, exact)
    turned_poses, turned_cameras = motion_views(avatar, motion, shot, turn=360.0)
    turned = without_unseen(avatar, turned_poses[chosen], turned_cameras[chosen], exact)

    def drawing(person: Avatar, how: Any) -> Callable[[], list[np.ndarray]]:
        return lambda: [np.asarray(rendering.rgb) for rendering in draw(person, poses, cameras, None, how)]

    runs: dict[str, Callable[[], Any]] = {
        preset: drawing(avatar, splatting_of(dataclasses.replace(shot, splat=preset), avatar)) for preset in PRESETS
    }
    runs["--prune: finding what is seen"] = lambda: without_unseen(avatar, poses, cameras, exact)
    runs["--prune: drawing it"] = drawing(seen, exact)
    truth = runs["exact"]()
    numbers: dict[str, Any] = {
        "gaussians": len(avatar.gaussians.means),
        "seen": len(seen.gaussians.means),
        "seen_in_a_turn": len(turned.gaussians.means),
        "size": size,
        "frames": TIMED,
    }
    milliseconds = medians(runs, repeats)
    for name, run in runs.items():
        row: dict[str, Any] = {"cpu_ms": float(milliseconds[name][1]) / TIMED}
        if name != "--prune: finding what is seen":
            errors = [np.abs(a - b) for a, b in zip(truth, run(), strict=True)]
            row["psnr"] = min(float(-10 * np.log10(max(np.mean(e**2), 1e-20))) for e in errors)
            row["largest_error"] = max(float(e.max()) for e in errors)
        numbers[name] = row
    return numbers


PRESETS = ("exact", "near_exact", "fast")
