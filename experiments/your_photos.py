"""Makes a folder of photos of a synthetic person as a photographer has it, and its avatar."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw

from experiments.harness import Run, entry
from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import a_pose_of, images, turntable_views
from humangs_jax.avatar.video import tile
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.capture.keypoints.keypoints import COCO_WHOLEBODY_133
from humangs_jax.data.capture import load_capture
from humangs_jax.io.images import read_image, write_png
from humangs_jax.io.reading import write_json
from humangs_jax.synthetic.writer import Layout, write_person

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
SEED, VIEWS, SIZE, NOISE = 4_000_009, 4, 512, 2.0
"""Seed of the person, number of photos, their side in pixels, and standard deviation of the noise
of keypoints in pixels.
"""
OPENCV_FROM_Y_UP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Rotation between a world with y up and one with y down."""
WIDTH = 1200
"""Largest side of a figure in pixels."""


@entry
def your_photos(run: Run, out: Path, docs: bool = False) -> int:
    """Makes OUT/photos as a photographer has it, and OUT/me, which `humangs start` makes of it, for
    the figures of docs/your_photos.md.

    OUT/photos has images in a room, calibration.json of OpenCV, masks, and keypoints as MMPose
    writes them (with 2 pixels of noise). Takes two minutes.

    Options:
    out: a new folder
    docs: write the figures into docs/images
    """
    out.mkdir(parents=True)
    write_person(out / "truth", SEED, load_body(), Layout(SIZE, views=VIEWS, held_out_views=8))
    truth, photos, me = load_capture(out / "truth"), out / "photos", out / "me"
    points = landmarks_in(truth)
    points = points + np.random.default_rng(0).normal(0, NOISE, points.shape)
    write_material(photos, truth, points)
    code = cli.execute(["start", str(photos), "--out", str(me), "--refine", "15s", "--no-browser"])
    if not code and docs:
        draw_figures(out, points)
    return code


def write_material(folder: Path, capture, points: np.ndarray) -> None:
    """Writes photos, masks, calibration and keypoints (v, 133, 2) of a capture as other programs
    write them.
    """
    for name in ("images", "masks", "keypoints"):
        (folder / name).mkdir(parents=True)
    calibration = {}
    for i, name in enumerate(f"cam{i}" for i in range(capture.view_count)):
        write_png(folder / "images" / f"{name}.png", in_a_room(capture.images[i], capture.masks[i]))
        write_png(folder / "masks" / f"{name}.png", capture.masks[i])
        # OpenCV has the centre of the first pixel at 0, also for keypoints
        K = np.array(capture.cameras.K[i], float)
        K[:2, 2] -= 0.5
        matrix = np.array(capture.cameras.cam_from_world[i], float) @ OPENCV_FROM_Y_UP
        size = [capture.cameras.width, capture.cameras.height]
        calibration[name] = {
            "K": K.tolist(),
            "R": matrix[:3, :3].tolist(),
            "T": matrix[:3, 3].tolist(),
            "imgSize": size,
        }
        known = np.isfinite(points[i]).all(-1)
        person = {"keypoints": np.where(known[:, None], points[i] - 0.5, 0).tolist()}
        person["keypoint_scores"] = np.where(known, 0.9, 0.0).tolist()
        write_json(folder / "keypoints" / f"{name}.json", [person])
    write_json(folder / "calibration.json", calibration)


def landmarks_in(capture, names: tuple[str, ...] | None = None) -> np.ndarray:
    """Returns the places of landmarks in each photo, (v, k, 2) pixels.

    Landmarks that the body does not have are NaN. The default names are those of COCO-WholeBody.
    """
    model = landmark_model(capture.body, names or COCO_WHOLEBODY_133.names)
    known, betas = np.asarray(model.known)[:, None] > 0, jnp.asarray(capture.betas)
    points = []
    for i, frame in enumerate(capture.frames):
        landmarks = np.asarray(pose_landmarks(model, betas, capture.pose(int(frame)))[0])
        matrix, K = np.asarray(capture.cameras.cam_from_world[i]), np.asarray(capture.cameras.K[i])
        seen = (landmarks @ matrix[:3, :3].T + matrix[:3, 3]) @ K.T
        points.append(np.where(known, seen[:, :2] / seen[:, 2:], np.nan))
    return np.stack(points)


def in_a_room(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Returns a person on white in front of a wall and on a floor."""
    height, width = mask.shape
    y = np.linspace(0, 1, height)[:, None, None]
    wall, floor = np.array([0.62, 0.66, 0.70]), np.array([0.45, 0.38, 0.32])
    column = np.where(y < 0.78, wall * (1.05 - 0.25 * y), floor * (0.7 + 0.4 * y))
    room = column * np.ones((1, width, 1))
    # the share of white at the edge becomes that of the room
    return image - (1 - mask[..., None]) * (1 - room)


def draw_figures(out: Path, points: np.ndarray) -> None:
    """Draws the figures of the docs: the material, the check and the avatar."""

    def read(folder):
        paths = [out / "photos" / folder / f"cam{i}.png" for i in range(VIEWS)]
        return np.stack([read_image(path)[0] for path in paths])

    photos, masks = read("images"), read("masks")
    marked = np.stack([with_points(photo, own) for photo, own in zip(photos, points, strict=True)])
    rows = np.concatenate([photos, masks, marked])
    labels = [
        f"{folder}/cam{i}" for folder in ("images", "masks", "keypoints") for i in range(VIEWS)
    ]
    save(tile(rows, labels=labels, columns=VIEWS), IMAGES / "your_photos_material.jpg")
    save(read_image(out / "me" / "check.png")[0], IMAGES / "your_photos_check.jpg")
    avatar, shot = Avatar.load(out / "me" / "avatar.npz"), FrameSettings(size=SIZE)
    turn = turntable_views(avatar, a_pose_of(avatar), VIEWS, shot)
    drawn = np.stack(list(images(avatar, *turn, shot)))
    save(tile(drawn, columns=VIEWS), IMAGES / "your_photos_avatar.jpg")


def with_points(photo: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Returns a photo with a dot at each point that is known."""
    image = Image.fromarray((255 * photo).round().astype(np.uint8))
    pen = ImageDraw.Draw(image)
    for x, y in points[np.isfinite(points).all(-1)]:
        pen.ellipse([x - 3, y - 3, x + 3, y + 3], fill=(230, 30, 120), outline=(255, 255, 255))
    return np.asarray(image) / 255


def save(image: np.ndarray, path: Path) -> None:
    """Saves a figure as a JPEG of at most `WIDTH` pixels a side."""
    picture = Image.fromarray((255 * np.clip(image[..., :3], 0, 1)).round().astype(np.uint8))
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    picture.save(path, quality=88)
