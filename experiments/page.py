"""The page that shows avatars against `hg.render`, in Chromium with software WebGL."""

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image

from experiments.chromium import Chromium, missing
from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.subjects import shipped_person
from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.io.images import to_uint8
from humangs_jax.losses.losses import masked_psnr, psnr
from humangs_jax.motion import load_motion
from humangs_jax.rendering.splat_config import SPLAT_PRESETS
from humangs_jax.rendering.splatting import render
from humangs_jax.viewer.page import write_page

AZIMUTHS = (0.0, 1.1, 2.9)
ELEVATIONS = (0.1, 0.5, -0.2)
WALK_FRAME = 17
VERTICAL_FOV = math.pi / 6
FINE_EDGE = 0.017
"""Metres; the longest edge of a body that carries some 60,000 Gaussians."""
MOTION_WINDOW = (480, 600)
PICTURE_WINDOW, WAIT = (1280, 800), 4.0
"""Of the picture: CSS pixels, and seconds of the walk before it is taken."""
SHOWN = (
    ("least PSNR of nine views, dB", "whole"),
    ("foreground PSNR, dB", "person"),
    ("after 100 frames of motion, dB", "motion_whole"),
    ("foreground PSNR, dB", "motion_person"),
    ("size of the page, MB", "bytes"),
    ("first image after, s", "first_image_seconds"),
    ("frames per second, {size} px, software WebGL", "fps"),
    ("one sort by depth, ms", "sort_ms"),
)


@entry
def page(run: Run, size: int = 512, frames: int = 20) -> None:
    """The page that shows avatars (`humangs export --html`) against `hg.render`, in Chromium with
    software WebGL.

    Needs Debian's chromium and chromium-driver. Exact views: three cameras times three poses,
    screenshots against `hg.render` of the same camera and pose. "Motion": the page plays 100 frames
    on its own and is paused; its image is compared with `hg.render` from the camera and in the pose
    that it reports. Frames per second: a turning camera, posed, sorted and drawn without waiting
    for the screen, of the avatar and of one with about 60,000 Gaussians (a body of shorter edges).

    Options:
    size: side of the images in pixels
    frames: images that are timed
    """
    if reason := missing():
        raise ValueError(reason)
    avatars = {"avatar": shipped_person(), "finer": shipped_person(FINE_EDGE)}
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            _measured(each, Path(folder) / f"{name}.html", size, frames)
            for name, each in avatars.items()
        ]
    header = ["", *(f"{row['gaussians']:,} Gaussians" for row in rows)]

    def show(row, key):
        return f"{row[key] / 1e6:.2f}" if key == "bytes" else f"{row[key]:.1f}"

    lines = [[label.format(size=size), *(show(row, key) for row in rows)] for label, key in SHOWN]
    run.show(markdown_table(header, lines), {"size": size} | dict(zip(avatars, rows, strict=True)))


def _measured(avatar, file, size, frames):
    row: dict[str, Any] = {
        "gaussians": len(avatar.gaussians.means),
        "bytes": write_page(file, avatar),
    }
    with Chromium() as browser:
        browser.open(file)
        row["first_image_seconds"] = browser.run("return humangs.firstImage") / 1000
        views = view_scores(browser, avatar, size)
        row["whole"], row["person"] = (min(pair[i] for pair in views.values()) for i in (0, 1))
        row["views"] = views
        row["motion_whole"], row["motion_person"] = motion_scores(browser, avatar, 100)
        asked = {"frames": frames, "width": size, "height": size}
        timed = browser.run("return humangs.benchmark(given[0])", asked)
        return row | {
            "fps": timed["fps"],
            "sort_ms": timed["sort_ms"],
            "console": browser.problems(),
        }


def test_views(avatar: Avatar, size: int) -> tuple[list[Camera], dict[str, BodyPose]]:
    """Three cameras and three poses; all look at the person in the pose."""
    rotations = {
        "T-pose": jnp.zeros((len(avatar.parents), 3)),
        "walk": load_motion().pose(WALK_FRAME).rotations,
        "held out": load_capture(f"{DEMO_CAPTURE}/held_out").pose(0).rotations,
    }
    height, middle = (
        float(np.ptp(np.asarray(avatar.rest_vertices)[:, 1])),
        jnp.asarray(avatar.rest_vertices.mean(0)),
    )
    distance, K = (
        1.35 * 0.5 * height / np.tan(0.5 * VERTICAL_FOV),
        intrinsics_from_fov(VERTICAL_FOV, size, size),
    )
    cameras = orbit(middle, distance, jnp.asarray(AZIMUTHS), jnp.asarray(ELEVATIONS), K, size, size)
    # the root moves from pose to pose: the cameras look at the T-pose's middle, so it is taken back
    # there
    return [cameras[i] for i in range(len(AZIMUTHS))], {
        name: BodyPose(x, jnp.zeros(3)) for name, x in rotations.items()
    }


def view_scores(browser: Chromium, avatar: Avatar, size: int) -> dict[str, tuple[float, float]]:
    """PSNR of the whole image and of the person, dB, by pose and camera."""
    cameras, poses = test_views(avatar, size)
    scores = {}
    browser.resize(size, size)
    for name, pose in poses.items():
        for index, camera in enumerate(cameras):
            image = exact_image(browser, camera, pose)
            scores[f"{name}, camera {index + 1}"] = compare(image, avatar, camera, pose)
    browser.run("humangs.resume()")
    browser.resize(1280, 800)
    return scores


def exact_image(browser: Chromium, camera: Camera, pose: BodyPose) -> Any:
    """The screenshot of one camera and pose on white, (h, w, 3)."""
    view = {
        name: np.asarray(getattr(camera, name), float).tolist() for name in ("K", "cam_from_world")
    }
    view |= {"width": camera.width, "height": camera.height}
    view |= {"rotations": np.asarray(pose.rotations, float).tolist()}
    view |= {"translation": np.asarray(pose.translation, float).tolist()}
    browser.run("humangs.draw(given[0])", view)
    return browser.screenshot()[: camera.height, : camera.width]


def compare(image: Any, avatar: Avatar, camera: Camera, pose: BodyPose) -> tuple[float, float]:
    """PSNR to `hg.render` of the whole image and of the person, dB."""
    rendering = render(skin(avatar, pose), camera, SPLAT_PRESETS[avatar.rendering])
    truth, image = jnp.clip(rendering.rgb, 0, 1), jnp.asarray(image)
    return float(psnr(image, truth)), float(masked_psnr(image, truth, rendering.alpha))


def motion_scores(browser: Chromium, avatar: Avatar, frames: int) -> tuple[float, float]:
    """The page plays by itself, sorted by its worker; then its image as `hg.render` draws it,
    person and floor apart.
    """
    browser.resize(*MOTION_WINDOW)
    browser.run(
        """document.getElementById("ground").checked && document.getElementById("ground").click();
        document.querySelector("#swatches button[title='#ffffff']").click();
        document.body.classList.add("hidden");"""
    )
    for _ in range(frames // 10):
        browser.run("await humangs.play(10)")
    browser.run("await humangs.settle()")
    view = browser.run("return humangs.view()")
    image = browser.screenshot()
    browser.run(
        "document.body.classList.remove('hidden'); document.getElementById('ground').click();"
    )
    browser.resize(1280, 800)
    pose = BodyPose(
        jnp.asarray(view["rotations"], jnp.float32), jnp.asarray(view["translation"], jnp.float32)
    )
    camera = Camera.from_opencv(
        np.asarray(view["K"]), np.asarray(view["cam_from_world"]), view["width"], view["height"]
    )
    return compare(image, avatar, camera, pose)


@entry
def viewer_picture(run: Run, avatar: Path, out: Path = Path("docs/images/viewer.png")) -> None:
    """A picture of the page that shows an avatar, a moment after it was opened. Needs Debian's
    chromium and chromium-driver.

    Options:
    avatar: file written by humangs reconstruct
    out: PNG to write
    """
    if reason := missing():
        raise ValueError(reason)
    with tempfile.TemporaryDirectory() as folder, Chromium(*PICTURE_WINDOW) as browser:
        write_page(Path(folder) / "avatar.html", Avatar.load(avatar))
        browser.open(Path(folder) / "avatar.html")
        time.sleep(WAIT)
        Image.fromarray(to_uint8(browser.screenshot())).save(out, optimize=True)
