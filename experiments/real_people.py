"""Measures what `humangs start` makes of real people, and how well the avatar shows them where no
photo was taken.
"""

import dataclasses
import functools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageSequence

from experiments.harness import Run, entry
from experiments.held_out_photos import held_out_scores
from experiments.real_capture import FRAMES, RealFrame, prepare
from experiments.results import cells, markdown_table
from experiments.subjects import shipped_digest
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import images, motion_views, turntable_views
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.avatar.video import tile, write_video
from humangs_jax.core.array_types import Float
from humangs_jax.core.processes import enable_compile_cache
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.io.images import to_uint8, write_png
from humangs_jax.io.reading import write_json
from humangs_jax.motion import load_motion
from humangs_jax.network.weights import SHIPPED, load_weights
from humangs_jax.refinement.config import ITERATIONS, RefineConfig
from humangs_jax.refinement.refine import refine

COLUMNS = {
    "psnr_own": ("square, dB", 1),
    "fg_own": ("foreground, own pose", 2),
    "worst_own": ("worst view", 1),
    "corrected_own": ("colors corrected", 2),
    "fg_shared": ("foreground, shared pose", 2),
    "alex_own": ("LPIPS, own", 3),
    "alex_shared": ("LPIPS, shared", 3),
    "seconds": ("seconds", 0),
    "load": ("load", 0),
}
"""{number of a row: its heading and digits}."""
MEASURED = {"psnr": "psnr", "fg": "psnr_fg", "corrected": "psnr_corrected", "alex": "alex"}
"""{name of a number in a row: score of a held-out photo}."""
TURN = 8
"""Number of photos of the turning man, 45 degrees apart."""
RATE = 10
"""Frames a second of his video. 53 frames are a turn, which takes a person some five seconds."""
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix from OpenCV's axes of a camera to those of transforms.json."""
SIDES = 6
"""Pictures in a row of the sheet."""
WOMAN, ANGLES = "20_1", (0, 90, 180, 270)
"""The woman's number among the scans, and the degrees of the views that exist of her."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One way to photograph a person."""

    photos: Path
    """Folder of photos, or video, that `humangs start` gets."""
    options: tuple[str, ...] = ()
    """Further options of `humangs start`."""
    frame: RealFrame | None = None
    """Careful masks and photos without rims to score by. None: photos as `start` cuts them out."""


Cases = Iterator[tuple[str, Callable[[], Case]]]
"""Pairs of the name of a row and a function that makes its photos."""


# The people
# --------------------------------------------------------------------------------------------------


def known_man(source: Path, work: Path) -> Cases:
    """Yields the cases of the demo of `pose2sim`: four cameras, with and without calibration."""
    for way in ("calibrated", "photos alone"):
        yield f"known man, {way}", functools.partial(_known, source, work, way == "calibrated")


def _known(source: Path, work: Path, calibrated: bool) -> Case:
    """Writes the photos of the known man, and their cameras if they are calibrated."""
    number = FRAMES[0]
    frame = prepare(source, [number], straight=calibrated)[number]
    folder = work / f"known_{'calibrated' if calibrated else 'alone'}"
    for name, image in zip(frame.names, frame.images, strict=True):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        write_png(folder / "images" / f"{name}.png", image)
    if not calibrated:
        return Case(folder, (), frame)
    K, matrices = (np.asarray(x, float) for x in (frame.cameras.K, frame.cameras.cam_from_world))
    write_transforms(folder, frame.names, K, matrices, frame.images.shape[1])
    return Case(folder, ("--up=+y",), frame)


def turning_man(source: Path, work: Path) -> Cases:
    """Yields the cases of a man who turns before one camera, `input.gif`: photos, and the video."""
    for way in ("photos", "video"):
        yield f"turning man, {way}", functools.partial(_turning, source, work, way)


def _turning(source: Path, work: Path, way: str) -> Case:
    """Writes the photos or the video of the turning man."""
    with Image.open(source / "input.gif") as clip:
        frames = [np.asarray(each.convert("RGB")) for each in ImageSequence.Iterator(clip)]
    if way == "video":
        video = work / "turning.mp4"
        write_video(video, [each.astype(np.float32) / 255 for each in frames], RATE)
        return Case(video)
    folder = work / "turning_photos"
    folder.mkdir(parents=True, exist_ok=True)
    for number in np.round(np.arange(TURN) * len(frames) / TURN).astype(int).tolist():
        Image.fromarray(frames[number]).save(folder / f"frame_{number:03d}.png")
    return Case(folder)


def woman(source: Path, work: Path) -> Cases:
    """Yields the case of a woman: renderings of a scan with calibrated cameras and masks. A girl
    stands in front of her.
    """
    yield "woman, calibrated, masks", functools.partial(_woman, source, work)


def _woman(source: Path, work: Path) -> Case:
    """Writes the photos, the masks and the cameras of the woman."""
    folder, names, K, matrices = work / "woman", [], [], []
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    # y of the images and of the world points down, and is turned up
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    for angle in ANGLES:
        parameters = source / "parameter" / WOMAN
        own, pose = np.load(parameters / f"{angle}_intrinsic.npy"), np.eye(4)
        pose[:3] = np.load(parameters / f"{angle}_extrinsic.npy")[:3]
        with Image.open(source / "img" / WOMAN / f"{angle}.jpg") as photo:
            side = photo.height
            photo.convert("RGB").save(folder / "images" / f"{angle:03d}.png")
        with Image.open(source / "mask" / WOMAN / f"{angle}.jpg") as mask:
            person = np.asarray(mask.convert("L")) > 127
        mask_picture = Image.fromarray(to_uint8(person.astype(np.float32)))
        mask_picture.save(folder / "masks" / f"{angle:03d}.png")
        own[1, 2] = side - own[1, 2]
        names.append(f"{angle:03d}")
        K.append(own)
        matrices.append(flip @ pose @ np.diag([-1.0, 1.0, 1.0, 1.0]))
    write_transforms(folder, names, np.stack(K), np.stack(matrices), side)
    return Case(folder, ("--up=+y",))


def write_transforms(
    folder: Path,
    names: Sequence[str],
    K: Float[np.ndarray, "v 3 3"],
    matrices: Float[np.ndarray, "v 4 4"],
    side: int,
) -> None:
    """Writes a transforms.json of square photos in `folder / "images"`.

    `matrices` are cam_from_world in the axes of OpenCV, and `side` is that of the photos in pixels.
    """
    frames = [
        {
            "file_path": f"images/{name}.png",
            **{"fl_x": own[0, 0], "fl_y": own[1, 1], "cx": own[0, 2], "cy": own[1, 2]},
            **{"w": side, "h": side},
            "transform_matrix": (np.linalg.inv(matrix) @ OPENGL).tolist(),
        }
        for name, own, matrix in zip(names, K, matrices, strict=True)
    ]
    write_json(folder / "transforms.json", {"frames": frames})


# What is measured
# --------------------------------------------------------------------------------------------------


def measure(make: Callable[[], Case], out: Path, views: int) -> dict[str, Any]:
    """Makes a capture of a case by `humangs start`, and returns the numbers of held-out photos.

    A capture that an earlier run has finished is not made again.

    Args:
        make: makes the photos of the case
        out: folder of the capture
        views: number of photos that are held out, 0: all
    """
    # the command runs in a new process, whose time is that of a user
    case = make()
    times = out.with_name(f"{out.name}.json")
    if not (times.is_file() and (out / "avatar.html").is_file()):
        begun = time.perf_counter()
        command = ["start", case.photos, "--out", out, *case.options, "--no-browser"]
        command += ["--overwrite"] if out.exists() else []
        words = [sys.executable, "-m", "humangs_jax", *map(str, command)]
        subprocess.run(words, check=True)
        seconds = time.perf_counter() - begun
        write_json(times, {"seconds": seconds, "load": os.getloadavg()[0]})
    capture = load_capture(out)
    count = capture.view_count
    held = range(count)
    if views:
        held = np.unique(np.arange(views) * count // views).tolist()
    truth, masks = _careful(case.frame, capture)
    found = held_out_scores(capture, avatar_of, held, truth, masks)
    numbers = {
        f"{key}_{pose}": scores[name]
        for pose, scores in found.items()
        for key, name in MEASURED.items()
    }
    own = found["own"]["each"]
    return numbers | json.loads(times.read_text()) | {"worst_own": min(own), "each_own": own}


def _careful(
    frame: RealFrame | None, capture: Capture
) -> tuple[Float[np.ndarray, "v h w 3"] | None, Float[np.ndarray, "v h w"] | None]:
    """Returns the person on white and the masks to score by, in the order of a capture's views."""
    if frame is None:
        return None, None
    rows = [frame.names.index(name.rpartition("/")[2]) for name in capture.names]
    return frame.truth()[rows], frame.careful[rows]


def avatar_of(capture: Capture) -> Avatar:
    """Makes an avatar by the network, the iterations of the learned update, and the default steps
    on the head.
    """
    config = RefineConfig(iterations=ITERATIONS, steps=0, seconds=None, image_size=512)
    return refine(reconstruct(*load_weights(), capture), capture, config)


def draw_sheet(capture: Capture, path: Path) -> None:
    """Draws the avatar from six sides in the pose of its photos, and walking. No photo is shown."""
    avatar, shot = avatar_of(capture), FrameSettings(width=200, height=300)
    around = images(avatar, *turntable_views(avatar, capture.pose(0), SIDES, shot), shot)
    motion = load_motion(rest_joints=avatar.rest_joints)
    chosen = np.linspace(0, len(motion.translations) - 1, SIDES).astype(int)
    poses, cameras = motion_views(avatar, motion, dataclasses.replace(shot, azimuth=40))
    walking = images(avatar, poses[chosen], cameras[chosen], shot)
    sheet = to_uint8(tile(np.stack([*around, *walking]), columns=SIDES))
    Image.fromarray(sheet).save(path, quality=90)


def section(rows: dict[str, dict[str, Any]]) -> str:
    """Formats the table of the page."""
    lines = [[row, *cells(numbers, COLUMNS)] for row, numbers in rows.items()]
    return markdown_table(["row", *(heading for heading, _ in COLUMNS.values())], lines)


def _place_of(work: Path, row: str) -> Path:
    """Returns the folder of the capture of a row."""
    return work / f"start_{row.replace(', ', '_')}"


@entry
def real_people(
    run: Run,
    work: Path,
    known: Path | None = None,
    turning: Path | None = None,
    scan: Path | None = None,
    views: int = 0,
    rows: tuple[str, ...] = (),
    pictures: Path | None = None,
) -> None:
    """Measures what `humangs start` makes of real people, and how well the avatar shows them where
    no photo was taken.

    Nothing is fetched: the folders hold what their owners publish. Needs the extra `photos` and
    `imageio-ffmpeg`. Each photo is held out in turn. Body and cameras are found from all photos,
    the avatar from the others. "own pose" is the one that was found with the held-out photo.
    "shared pose" is the mean of the poses of the others. For "colors corrected" the gain of each
    channel is fitted to the held-out photo, in its own pose. "seconds" are those of `humangs
    start`; the first row compiles.

    Options:
    work: folder of photos, captures and times; a later run goes on from there
    known: unpacked `pose2sim` 0.10.49, with Pose2Sim/Demo_SinglePerson in it
    turning: assets/demos/iper_023_1_1 of github.com/JanaldoChen/Anim-NeRF
    scan: dataset/multihuman of github.com/DSaurus/DeepMultiCap
    views: photos that are held out, evenly spread; 0: all
    rows: beginnings of the names of rows, as "turning man, video"; default: all rows
    pictures: image to write, a sheet of the avatar of the first row
    """
    people = {known_man: known, turning_man: turning, woman: scan}
    given = {person: source for person, source in people.items() if source is not None}
    if not given:
        raise ValueError("--known, --turning or --scan: expected the folder of one person or more")
    for source in given.values():
        if not source.is_dir():
            raise ValueError(f"{source}: no such folder")

    # captures and times stay in the folder, and are not made again
    enable_compile_cache()
    work.mkdir(parents=True, exist_ok=True)
    cases = {
        row: functools.partial(measure, make, _place_of(work, row), views)
        for person, source in given.items()
        for row, make in person(source, work)
        if not rows or row.startswith(rows)
    }
    settings = {"views": views, "iterations": ITERATIONS, "weights": shipped_digest(SHIPPED)}
    found = run.rows(cases, settings)
    run.show(section(found), found)
    if pictures is not None:
        draw_sheet(load_capture(_place_of(work, next(iter(cases)))), pictures)
