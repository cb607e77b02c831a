"""Draws the images of an evaluation, with the same views of many people and their faces, hands,
hems and shoes, and the pictures of README.
"""

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from PIL import Image
from skimage.transform import resize

from experiments.harness import Run, entry
from humangs_jax.apps.video_motion import motion_from_video
from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.attach_face import with_face
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import (
    a_pose_of,
    images,
    motion_frames,
    motion_views,
    rest_pose_of,
    turntable_views,
)
from humangs_jax.avatar.video import tile, write_video
from humangs_jax.body.joints import FINGERS, JOINT_NAMES
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture, load_capture
from humangs_jax.geometry.camera import look_at, project
from humangs_jax.io.images import to_uint8
from humangs_jax.motion import load_motion
from humangs_jax.rendering.splatting import render
from humangs_jax.synthetic.subject import SPLITS, expressed_subject, make_subject, render_view
from humangs_jax.synthetic.writer import stand

CROP = 0.75
"""Share of the image's width that is shown. Images are square, and a person fills their height."""
DETAILS = {
    "face": (("left_eye", "right_eye"), 0.3),
    "hand": (("left_middle1", "left_index1"), 0.3),
    "hem": (("left_hip", "left_knee"), 0.5),
    "shoe": (("left_ankle", "left_foot"), 0.36),
}
"""{detail: (joints in whose middle it is, side of the square that shows it in metres)}."""
DETAIL_PIXELS = 96
"""Side of the picture of a detail."""


def cropped(image: np.ndarray) -> np.ndarray:
    """Returns the middle of an image, `CROP` of its width."""
    width = image.shape[1]
    left = round(0.5 * (1 - CROP) * width)
    return image[:, left : width - left]


def frontal_view(photos: Capture, held_out: Capture, views: Sequence[int]) -> int:
    """Returns the one of these views that looks most nearly in the direction of the first photo."""
    directions = np.asarray(held_out.cameras.cam_from_world)[list(views), 2, :3]
    return views[int(np.argmax(directions @ np.asarray(photos.cameras.cam_from_world)[0, 2, :3]))]


def details(image: np.ndarray, capture: Capture, view: int) -> np.ndarray:
    """Returns the details of an image of this view, (details, `DETAIL_PIXELS`, `DETAIL_PIXELS`, 3).

    They are white beyond the border of the image.
    """
    body, camera = capture.body, capture.cameras[view]
    pose = capture.pose(int(np.asarray(capture.frames)[view]))
    joints = pose_body(body, shape_body(body, jnp.asarray(capture.betas)), pose).joints
    squares = []
    for names, side in DETAILS.values():
        numbers = np.asarray([body.joint_names.index(name) for name in names])
        (x, y), depth = project(camera, joints[numbers].mean(0))
        half = max(2, round(0.5 * side * float(camera.K[0, 0]) / float(depth)))
        padded = np.pad(image, ((half, half), (half, half), (0, 0)), constant_values=1.0)
        top, left = (int(np.clip(round(float(value)), 0, image.shape[0])) for value in (y, x))
        square = padded[top : top + 2 * half, left : left + 2 * half]
        squares.append(resize(square, (DETAIL_PIXELS, DETAIL_PIXELS), order=1, anti_aliasing=True))
    return np.stack(squares)


def write_triples(
    path: Path,
    people: Mapping[Any, Sequence[np.ndarray]],
    across: int = 2,
    headers: tuple[str, ...] = ("truth", "feed-forward", "refined"),
) -> None:
    """Writes the same images of every person as a JPEG, with `across` people in a row."""
    tiles = np.stack([image for drawn in people.values() for image in drawn])
    headers *= min(across, len(people))
    sheet = Image.fromarray(to_uint8(tile(tiles, headers=headers, columns=len(headers))))
    sheet.save(path, format="JPEG", quality=85)


POSES: dict[str, dict[str, tuple[float, float, float]]] = {
    "wave": {
        "left_shoulder": (0, 0, -68),
        "right_shoulder": (0, 0, -35),
        "right_elbow": (0, 0, -55),
        "neck": (0, -15, 8),
    },
    "step": {
        "left_shoulder": (0, 35, -55),
        "right_shoulder": (0, 35, 60),
        "left_hip": (-55, 0, 0),
        "left_knee": (75, 0, 0),
        "left_elbow": (0, -50, 0),
        "spine1": (8, 0, 0),
    },
    "stretch": {
        "left_shoulder": (0, 0, 62),
        "right_shoulder": (0, 0, -62),
        "left_hip": (0, 0, 14),
        "right_hip": (0, 0, -14),
    },
}
"""Poses that no photo shows: degrees of axis-angle by joint."""


@entry
def readme_pictures(
    run: Run, avatar: Path, out: Path = Path("docs/images"), size: int = 512
) -> None:
    """Draws README's row of pictures and its animation: the demo's photos, its avatar from two
    sides and in new poses, and the face of the avatar.

    Options:
    avatar: avatar.npz of `humangs demo`
    out: folder of the images
    size: height of a picture, pixels
    """
    person, photos = Avatar.load(avatar), load_capture("demo_capture")
    shot = FrameSettings(size=size, azimuth=0.0)

    def drawn(pose, shot):
        return next(images(person, *turntable_views(person, pose, 1, shot), shot))

    def posed(turns: Mapping[str, tuple[float, float, float]]) -> BodyPose:
        rotations = np.zeros((len(person.parents), 3), np.float32)
        for name, turn in turns.items():
            rotations[person.joint_names.index(name)] = np.radians(turn)
        return BodyPose(jnp.asarray(rotations), jnp.zeros(3))

    # the four photos in one square
    half = [
        np.asarray(Image.fromarray(to_uint8(x)).resize((size // 2, size // 2), 1)) / 255
        for x in photos.images[:4]
    ]
    pictures = [
        np.concatenate([np.concatenate(half[:2], axis=1), np.concatenate(half[2:], axis=1)])
    ]

    # the avatar in the A-pose and in new poses
    rest = a_pose_of(person)
    pictures += [drawn(rest, shot), drawn(rest, dataclasses.replace(shot, azimuth=130.0))]
    pictures += [
        drawn(posed(turns), dataclasses.replace(shot, azimuth=30.0)) for turns in POSES.values()
    ]

    # the face
    head = person.rest_joints[person.joint_names.index("head")]
    K = jnp.asarray([[2.6 * size, 0, size / 2], [0, 2.6 * size, size / 2], [0, 0, 1]])
    target = head + jnp.asarray([0, 0.06, 0.0])
    face = look_at(
        target + jnp.asarray([0.35, 0.05, 1.5]), target, jnp.asarray([0.0, 1, 0]), K, size, size
    )
    pictures.append(np.clip(np.asarray(render(animate(person, posed({})), face).rgb), 0, 1))
    strip = np.concatenate([_framed(x, size) for x in pictures], axis=1)
    Image.fromarray(to_uint8(strip)).save(out / "readme.jpg", quality=88)

    motion = load_motion()
    frames = images(
        person, *motion_views(person, motion, dataclasses.replace(shot, azimuth=25.0), 40.0), shot
    )
    write_video(out / "animation.gif", frames, motion.fps)
    run.show(f"{out / 'readme.jpg'}: {strip.shape[1]} x {strip.shape[0]}")


EXPRESSIONS: dict[str, dict[str, float]] = {
    "at rest": {},
    "smile": {"mouthSmileLeft": 1, "mouthSmileRight": 1,
              "cheekSquintLeft": 0.6, "cheekSquintRight": 0.6},
    "jawOpen": {"jawOpen": 1},
    "aa": {"jawOpen": 0.5, "mouthUpperUpLeft": 0.7, "mouthUpperUpRight": 0.7},
    "oh": {"jawOpen": 0.4, "mouthFunnel": 0.8},
    "mouthPucker": {"mouthPucker": 1},
    "tongueOut": {"tongueOut": 1, "jawOpen": 0.45},
    "blink": {"eyeBlinkLeft": 1, "eyeBlinkRight": 1},
    "wink": {"eyeBlinkLeft": 1, "mouthSmileLeft": 0.8, "cheekSquintLeft": 0.6},
    "surprise": {"browInnerUp": 1, "browOuterUpLeft": 1, "browOuterUpRight": 1,
                 "eyeWideLeft": 1, "eyeWideRight": 1, "jawOpen": 0.3},
    "frown": {"browDownLeft": 1, "browDownRight": 1, "mouthFrownLeft": 1, "mouthFrownRight": 1},
    "cheekPuff, look left": {"cheekPuff": 1, "eyeLookOutLeft": 1, "eyeLookInRight": 1},
}  # fmt: skip
"""{face: coefficients of ARKit's shapes}."""
FACE_CLOSE_UP = 4.6
"""Focal length over the size of the picture, with which a head fills it from 1.2 m."""


@entry
def expression_sheet(
    run: Run, avatar: Path, out: Path = Path("docs/images/expressions.jpg"), size: int = 224
) -> None:
    """Draws twelve expressions of an avatar, close up.

    Options:
    avatar: avatar.npz of `humangs demo`
    out: picture to write
    size: side of each face, pixels
    """
    person = with_face(Avatar.load(avatar))
    assert person.face is not None
    names, rest = person.face.expressions.names, rest_pose_of(person)
    head = person.rest_joints[person.joint_names.index("head")]
    focal = FACE_CLOSE_UP * size
    K = jnp.asarray([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    target = head + jnp.asarray([0, 0.02, 0.04])
    up = jnp.asarray([0.0, 1, 0])
    camera = look_at(target + jnp.asarray([0.25, 0.03, 1.2]), target, up, K, size, size)
    faces = []
    for shapes in EXPRESSIONS.values():
        expression = jnp.asarray([shapes.get(name, 0.0) for name in names], jnp.float32)
        pose = replace(rest, expression=expression)
        faces.append(np.clip(np.asarray(render(animate(person, pose), camera).rgb), 0, 1))
    sheet = tile(np.stack(faces), labels=list(EXPRESSIONS), columns=4)
    Image.fromarray(to_uint8(sheet)).save(out, quality=82)
    run.show(f"{out}: {sheet.shape[1]} x {sheet.shape[0]}")


def _framed(image: np.ndarray, size: int) -> np.ndarray:
    """Cuts an image to the columns that are not white, with a margin."""
    used = np.flatnonzero((image < 0.98).any(axis=(0, 2)))
    left, right = max(0, used[0] - size // 32), min(image.shape[1], used[-1] + size // 32)
    return image[:, left:right]


VIDEO_SIDE = (704, 960)
"""Width and height of a frame of the rendered video in pixels. The head is 120 pixels high."""
GESTURES = 54
"""Number of frames of the video."""
GESTURE_RATE = 18.0
"""Frames a second of the video."""


@entry
def motion_picture(run: Run, avatar: Path, out: Path = Path("docs/images/motion.gif")) -> None:
    """Draws two people side by side: a person in a video who waves, closes a hand and makes faces,
    and an avatar of another person that moves as `humangs motion` found it in the video.

    The video is rendered from a synthetic person, and then used like any other video.

    Options:
    avatar: avatar.npz of `humangs demo`
    out: picture to write
    """
    person = Avatar.load(avatar)
    with tempfile.TemporaryDirectory() as folder:
        video = Path(folder) / "video.mp4"
        frames = list(gestures())
        write_video(video, frames, GESTURE_RATE)
        motion = motion_from_video(video, avatar=person)
    shot = FrameSettings(width=VIDEO_SIDE[0] // 3, height=VIDEO_SIDE[1] // 3, background="white")
    drawn = list(motion_frames(with_face(person), motion, shot))
    pairs = [
        np.concatenate([resize(frame, image.shape, anti_aliasing=True), image], axis=1)
        for frame, image in zip(frames, drawn, strict=True)
    ]
    write_video(out, pairs, GESTURE_RATE)
    run.show(f"{out}: {len(pairs)} frames")


def gestures() -> Iterator[np.ndarray]:
    """Yields frames of a synthetic person who raises an arm, closes the hand, turns, smiles and
    speaks.
    """
    body = load_body()
    assert body.expressions is not None
    names = body.expressions.names
    subject = make_subject(list(SPLITS["fitting"])[300], body)
    width, height = VIDEO_SIDE
    K = jnp.asarray([[1.35 * height, 0, width / 2], [0, 1.35 * height, height / 2], [0, 0, 1]])
    eye, target, up = (jnp.asarray(x) for x in ([0.0, 1.1, 2.9], [0.0, 0.92, 0.0], [0.0, 1, 0]))
    camera = look_at(eye, target, up, K, width, height)
    for i in range(GESTURES):
        phase = 2 * np.pi * i / GESTURES
        # 0 at the beginning and the end, 1 in the middle
        raised = 0.5 - 0.5 * np.cos(phase)
        rotations = np.zeros((len(JOINT_NAMES), 3))
        rotations[JOINT_NAMES.index("pelvis"), 1] = 0.35 * np.sin(phase)
        rotations[JOINT_NAMES.index("left_shoulder"), 2] = -1.2 + 1.5 * raised
        rotations[JOINT_NAMES.index("right_shoulder"), 2] = 1.2 - 0.3 * raised
        rotations[JOINT_NAMES.index("left_elbow"), 2] = 1.3 * raised + 0.3 * np.sin(3 * phase)
        rotations[JOINT_NAMES.index("right_elbow"), 1] = 1.2 * raised
        closed = 0.5 - 0.5 * np.cos(2 * phase)
        for side, sign in (("left", -1), ("right", 1)):
            for finger in FINGERS[:4]:
                for knuckle in (1, 2, 3):
                    rotations[JOINT_NAMES.index(f"{side}_{finger}{knuckle}"), 2] = sign * closed
        amounts = {
            "jawOpen": 0.8 * max(0.0, np.sin(2 * phase)),
            "mouthSmileLeft": raised,
            "mouthSmileRight": raised,
            "browInnerUp": max(0.0, np.sin(phase)),
            "eyeBlinkLeft": float(i % 18 in (8, 9)),
            "eyeBlinkRight": float(i % 18 in (8, 9)),
        }
        coefficients = np.asarray([amounts.get(name, 0.0) for name in names], np.float32)
        posed = stand(expressed_subject(subject, body, coefficients), rotations)
        yield np.asarray(render_view(posed, camera)[0], np.float32)
