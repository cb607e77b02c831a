"""Compares the page that shows avatars with `hg.render`, in Chromium with software WebGL."""

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
"""Longest edge in metres of a body that carries some 60,000 Gaussians."""
MOTION_WINDOW = (480, 600)
"""Width and height of the page in which the motion is compared, CSS pixels."""
PICTURE_WINDOW, WAIT = (1280, 800), 4.0
"""Width and height of the picture in CSS pixels, and seconds of the walk before it is taken."""
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
    """Compares the page that shows avatars (`humangs export --html`) with `hg.render`, in Chromium
    with software WebGL.

    Needs Debian's chromium and chromium-driver. Nine views (three cameras, three poses) are
    screenshots, compared with `hg.render` of the same camera and pose. For "motion" the page plays
    100 frames by itself and is paused. Its image is compared with `hg.render` from the camera and
    in the pose that it reports. Frames per second are those of a turning camera, whose images are
    posed, sorted and drawn without waiting for the screen. Measured are the shipped avatar and one
    with about 60,000 Gaussians (a body with shorter edges).

    Options:
    size: side of the images in pixels
    frames: images that are timed
    """
    reason = missing()
    if reason:
        raise ValueError(reason)
    # a column for each avatar, a line for each number
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
    """Writes the page of an avatar and returns its numbers."""
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
    """Returns three cameras, and {name: pose} of three poses in front of them."""
    rotations = {
        "T-pose": jnp.zeros((len(avatar.parents), 3)),
        "walk": load_motion().pose(WALK_FRAME).rotations,
        "held out": load_capture(f"{DEMO_CAPTURE}/held_out").pose(0).rotations,
    }
    height = float(np.ptp(np.asarray(avatar.rest_vertices)[:, 1]))
    middle = jnp.asarray(avatar.rest_vertices.mean(0))
    distance = 1.35 * 0.5 * height / np.tan(0.5 * VERTICAL_FOV)
    K = intrinsics_from_fov(VERTICAL_FOV, size, size)
    cameras = orbit(middle, distance, jnp.asarray(AZIMUTHS), jnp.asarray(ELEVATIONS), K, size, size)
    # the cameras look at the middle of the T-pose, so the poses are not moved away from there
    poses = {name: BodyPose(x, jnp.zeros(3)) for name, x in rotations.items()}
    return [cameras[i] for i in range(len(AZIMUTHS))], poses


def view_scores(browser: Chromium, avatar: Avatar, size: int) -> dict[str, tuple[float, float]]:
    """Returns {pose and camera: PSNR of the whole image and of the person in dB}."""
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
    """Returns the screenshot of one camera and pose on white, (h, w, 3)."""
    view = {
        name: np.asarray(getattr(camera, name), float).tolist() for name in ("K", "cam_from_world")
    }
    view |= {"width": camera.width, "height": camera.height}
    view |= {"rotations": np.asarray(pose.rotations, float).tolist()}
    view |= {"translation": np.asarray(pose.translation, float).tolist()}
    browser.run("humangs.draw(given[0])", view)
    return browser.screenshot()[: camera.height, : camera.width]


def compare(image: Any, avatar: Avatar, camera: Camera, pose: BodyPose) -> tuple[float, float]:
    """Returns the PSNR in dB of an image against `hg.render`, of the whole and of the person."""
    rendering = render(skin(avatar, pose), camera, SPLAT_PRESETS[avatar.rendering])
    truth, image = jnp.clip(rendering.rgb, 0, 1), jnp.asarray(image)
    return float(psnr(image, truth)), float(masked_psnr(image, truth, rendering.alpha))


def motion_scores(browser: Chromium, avatar: Avatar, frames: int) -> tuple[float, float]:
    """Lets the page play this many frames by itself, and compares its last image with `hg.render`.

    Returns the PSNR in dB of the whole image and of the person. The worker of the page sorts. The
    floor and the controls are hidden.
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
    """Takes a picture of the page that shows an avatar, a moment after it was opened. Needs
    Debian's chromium and chromium-driver.

    Options:
    avatar: file written by humangs reconstruct
    out: PNG to write
    """
    reason = missing()
    if reason:
        raise ValueError(reason)
    with tempfile.TemporaryDirectory() as folder, Chromium(*PICTURE_WINDOW) as browser:
        write_page(Path(folder) / "avatar.html", Avatar.load(avatar))
        browser.open(Path(folder) / "avatar.html")
        time.sleep(WAIT)
        Image.fromarray(to_uint8(browser.screenshot())).save(out, optimize=True)
