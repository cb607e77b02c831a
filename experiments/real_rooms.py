"""Photos that come with nothing, for `real_person.py`: cameras from the person, people in rooms,
and `humangs start`.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image

from experiments.real_capture import (
    CAMERAS,
    DEMO,
    SIZE,
    RealFrame,
    body_ious,
    largest_person,
    prepare,
    read_frames,
)
from experiments.subjects import HeldOut, make_evaluation_subject
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import images, motion_views, turntable_views
from humangs_jax.avatar.shot import Shot
from humangs_jax.avatar.video import tile
from humangs_jax.body.library import load_body
from humangs_jax.capture.detection.people import Networks, bilinear
from humangs_jax.capture.fitting.fit_capture import fit_photos
from humangs_jax.capture.fitting.person_cameras import cameras_from_person
from humangs_jax.capture.fitting.person_moments import PersonViews
from humangs_jax.capture.fitting.refine import (
    CaptureRefineConfig,
    Scene,
    moved_capture,
    posed_vertices,
)
from humangs_jax.capture.fitting.state import StateStd
from humangs_jax.capture.fitting.triangulation import Similarity, align_points
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, Keypoints
from humangs_jax.core.array_types import Float
from humangs_jax.data.capture import Capture
from humangs_jax.data.photos import Photos
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.arrays import write_npz
from humangs_jax.io.images import image_size, read_image, resized, to_uint8
from humangs_jax.motion import load_motion

PHOTOS, NOVEL = 4, 4
COLUMNS = 6
"""Of the sheet of pictures."""
PIXELS = 12e6
"""Of each photo of `started`."""


def without_calibration(
    frame: RealFrame, sizes: list[tuple[int, int]], focal: Float[np.ndarray, " v"] | None = None
) -> RealFrame:
    """The frame with cameras from the person, and with left and right as they see them. sizes: of
    the whole photos, pixels.
    focal: lengths in their pixels, as EXIF tells them; None: unknown.

    Raises: ValueError where no cameras are found.
    """
    back = np.linalg.inv(frame.crop)
    points = frame.keypoints.points * back[:, None, [0, 1], [0, 1]] + back[:, None, :2, 2]
    focal = np.full(len(points), np.nan) if focal is None else focal
    found = cameras_from_person(
        PersonViews(
            points,
            frame.keypoints.confidences,
            frame.world,
            MEDIAPIPE_33.names,
            tuple(sizes),
            focal,
            frame.names,
        )
    )
    cameras = [
        Camera.from_opencv(crop @ np.asarray(own.K, float), own.cam_from_world, SIZE, SIZE)
        for crop, own in zip(frame.crop, found.cameras, strict=True)
    ]
    keypoints = frame.keypoints
    order = np.where(
        found.mirrored[:, None], MEDIAPIPE_33.mirror, np.arange(len(MEDIAPIPE_33.names))
    )
    pick = lambda values: np.take_along_axis(
        values, order.reshape(*order.shape, *[1] * (values.ndim - 2)), axis=1
    )
    world = pick(frame.world)
    keypoints = dataclasses.replace(
        keypoints,
        points=pick(keypoints.points),
        confidences=pick(keypoints.confidences),
        world=world.astype(np.float32),
    )
    return frame._replace(
        cameras=stack_cameras(cameras), keypoints=keypoints, world=world, moments=found.moments > 1
    )


def one_view_each(frames: Sequence[RealFrame]) -> RealFrame:
    """The first view of the first frame, the second of the second, and so on."""
    stack = lambda name: np.stack([getattr(frame, name)[view] for view, frame in enumerate(frames)])
    images, detected, careful = (stack(name) for name in ("images", "detected", "careful"))
    points, confidences = (
        np.stack([getattr(f.keypoints, n)[v] for v, f in enumerate(frames)])
        for n in ("points", "confidences")
    )
    cameras = stack_cameras([frame.cameras[view] for view, frame in enumerate(frames)])
    keypoints = dataclasses.replace(frames[0].keypoints, points=points, confidences=confidences)
    names = tuple(frame.names[view] for view, frame in enumerate(frames))
    return RealFrame(
        images, detected, careful, cameras, keypoints, stack("world"), stack("crop"), names
    )


def video_sizes(data: Path) -> list[tuple[int, int]]:
    """Width and height of each camera's photos."""
    return [image_size(data / "prepared" / f"room_{name}.png") for name in CAMERAS]


# Synthetic people
# --------------------------------------------------------------------------------------------------


def person_in_rooms(seed: int, data: Path) -> tuple[RealFrame, Capture, Capture]:
    """A synthetic person in the rooms of the real capture, as detected; the true capture of the
    photos; views held out.
    """
    subject = make_evaluation_subject(seed, load_body(), [PHOTOS], SIZE, HeldOut(NOVEL, 0, 0))
    true, networks = subject.inputs(PHOTOS), Networks()
    assert true.masks is not None
    images, people = [], []
    for image, mask, name in zip(true.images, true.masks, CAMERAS, strict=True):
        room = read_image(data / "prepared" / f"room_{name}.png")[0]
        height, width = room.shape[:2]
        room = resized(room[(height - width) // 2 :][:width], SIZE, SIZE)
        photo = image + (1 - mask[..., None]) * (room - 1)
        images.append((np.round(255 * photo) / 255).astype(np.float32))
        people.append(largest_person(networks, images[-1]))
    stack = lambda name: np.stack([getattr(person, name) for person in people])
    keypoints = Keypoints(
        stack("pixels").astype(np.float32), stack("visibility").astype(np.float32), MEDIAPIPE_33
    )
    same = np.broadcast_to(np.eye(3), (PHOTOS, 3, 3))
    names = tuple(f"person_{seed}_{name}" for name in CAMERAS)
    found = RealFrame(
        np.stack(images),
        stack("mask"),
        true.masks,
        true.cameras,
        keypoints,
        stack("world"),
        same,
        names,
    )
    return found, true, subject.held_out


def as_fitted(held_out: Capture, true: Capture, body: Capture, same_world: bool) -> Capture:
    """The held-out views with the found body. Unless it was found in the same world, a similarity
    that brings the true body to it places them.
    """
    cameras = held_out.cameras
    if not same_world:
        own, there = (
            posed_vertices(each.body, jnp.asarray(each.betas), each.poses)[0]
            for each in (body, true)
        )
        move, moved = (
            align_points(np.asarray(own, float), np.asarray(there, float), np.ones(len(own))),
            [],
        )
        for K, matrix in zip(cameras.K, cameras.cam_from_world, strict=True):
            matrix = np.asarray(matrix, float) @ move.matrix()
            matrix[:3] /= move.scale
            moved.append(Camera.from_opencv(K, matrix, SIZE, SIZE))
        cameras = stack_cameras(moved)
    return dataclasses.replace(
        held_out, cameras=cameras, betas=body.betas, poses=body.poses, body=body.body
    )


# The command
# --------------------------------------------------------------------------------------------------


def started(data: Path, frame: int) -> dict[str, float]:
    """Seconds of `humangs start` on four photos of 12 megapixels, with an empty compile cache and
    again; those of the processors, too, since the machine may be busy (load: processes at the end).
    """
    with tempfile.TemporaryDirectory() as place:
        photos = Path(place) / "photos"
        photos.mkdir()
        for name in CAMERAS:
            image = read_frames(data / DEMO / "videos" / f"{name}.mp4", [frame])[frame]
            height, width = image.shape[:2]
            larger = np.sqrt(PIXELS / (height * width))
            size = round(width * larger), round(height * larger)
            Image.fromarray(image).resize(size, Image.Resampling.BICUBIC).save(
                photos / f"{name}.jpg", quality=95
            )
        environment = os.environ | {"HUMANGS_COMPILE_CACHE": str(Path(place) / "cache")}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        seconds = {}
        for when in ("first", "compiled"):
            out = Path(place) / when
            begun, used = time.perf_counter(), _processor_time()
            command = [
                sys.executable,
                "-m",
                "humangs_jax.cli",
                "start",
                photos,
                "--out",
                out,
                "--no-browser",
            ]
            subprocess.run([str(word) for word in command], check=True, env=environment)
            seconds[when], seconds[f"{when}_processor"] = (
                time.perf_counter() - begun,
                _processor_time() - used,
            )
        return seconds | {"load": os.getloadavg()[0]}


def _processor_time():
    times = os.times()
    return times.children_user + times.children_system


# Pictures
# --------------------------------------------------------------------------------------------------


def draw_sheet(avatar: Avatar, body: Capture, path: Path) -> None:
    """The avatar from all sides in the pose of the photos, and walking; no photo."""
    shot = Shot(width=200, height=300)
    around = images(avatar, *turntable_views(avatar, body.pose(0), COLUMNS, shot), shot)
    motion = load_motion(rest_joints=avatar.rest_joints)
    chosen = np.linspace(0, len(motion.translations) - 1, COLUMNS).astype(int)
    poses, cameras = motion_views(avatar, motion, dataclasses.replace(shot, azimuth=40))
    walking = images(avatar, poses[chosen], cameras[chosen], shot)
    sheet = to_uint8(tile(np.stack([*around, *walking]), columns=COLUMNS))
    Image.fromarray(sheet).save(path, quality=90)


STD = StateStd(
    focal=0.005,
    camera_rotation=1.5,
    camera_center=0.03,
    body_pose=10.0,
    global_orient=6.0,
    betas=1.0,
    clothing=0.001,
)
CONFIG = CaptureRefineConfig(std=STD, coefficients=22, robust_scales=(1.0, 1.0), independent=100.0)
"""A body that fills the masks: for cameras, not for avatars."""
TIMES = 4
"""Refinements one after the other: with this number of unknowns one does not converge."""


class Reference(NamedTuple):
    """The cameras of the videos, without distortion. K: (v, 3, 3). cam_from_world: (v, 4, 4)."""

    K: Float[np.ndarray, "v 3 3"]
    cam_from_world: Float[np.ndarray, "v 4 4"]

    def of(self, frame: RealFrame) -> Camera:
        """A batch of the cameras of a frame's photos."""
        pairs = zip(frame.crop @ self.K, self.cam_from_world, strict=True)
        return stack_cameras([Camera.from_opencv(K, matrix, SIZE, SIZE) for K, matrix in pairs])


def reference_cameras(folder: Path) -> Reference:
    """Found once, then read from `folder`/prepared/cameras.npz."""
    file = folder / "prepared" / "cameras.npz"
    if not file.exists():
        write_npz(file, _found(list(prepare(folder).values()))._asdict())
    with np.load(file) as stored:
        return Reference(stored["K"], stored["cam_from_world"])


def _found(frames):
    """From all frames, each camera in one square that holds its squares of all: equal cameras count
    as one.
    """
    views, back = range(len(CAMERAS)), np.linalg.inv(np.stack([frame.crop for frame in frames]))
    corners = np.einsum("fvab,kb->fvka", back, [[0, 0, 1], [SIZE, SIZE, 1]])[..., :2]
    least, most = corners[:, :, 0].min(0), corners[:, :, 1].max(0)
    common = np.stack([_square(*each) for each in zip(least, most, strict=True)])
    masks, points, cameras, numbers = [], [], [], []
    for number, frame in enumerate(frames):
        for view in views:
            matrix = frame.crop[view] @ np.linalg.inv(common[view])
            steps = np.arange(SIZE) + 0.5
            grid = np.stack(np.meshgrid(steps, steps), axis=-1) * matrix[0, 0] + matrix[:2, 2]
            masks.append(bilinear(frame.careful[view], grid - 0.5, 0.0))
            points.append((frame.keypoints.points[view] - matrix[:2, 2]) / matrix[0, 0])
            K = np.linalg.inv(matrix) @ np.asarray(frame.cameras.K[view], float)
            if number:
                K = cameras[view].K  # of equal cameras, exactly
            cameras.append(Camera.from_opencv(K, frame.cameras.cam_from_world[view], SIZE, SIZE))
            numbers.append(number)
    keypoints = dataclasses.replace(
        frames[0].keypoints,
        points=np.asarray(points, np.float32),
        confidences=np.concatenate([frame.keypoints.confidences for frame in frames]),
    )
    names, white = (
        tuple(name for frame in frames for name in frame.names),
        np.ones((SIZE, SIZE, 3), np.float32),
    )
    images = np.broadcast_to(white, (len(masks), *white.shape))
    photos = Photos(
        images, np.stack(masks), stack_cameras(cameras), np.asarray(numbers, np.int32), names
    )
    found = fit_photos(photos, keypoints, load_body()).capture
    for _ in range(TIMES):
        scene = Scene(found, keypoints, CONFIG)
        found = moved_capture(found, scene.origin, scene.run()[0])
    print(
        "silhouettes with the cameras of all frames:",
        np.round(body_ious(found, np.stack(masks)), 3),
    )
    first = [
        np.asarray(each[: len(CAMERAS)], float)
        for each in (found.cameras.K, found.cameras.cam_from_world)
    ]
    return Reference(np.linalg.inv(common) @ first[0], first[1])


def _square(least, most):
    side = float((most - least).max())
    return np.diag([SIZE / side, SIZE / side, 1.0]) @ [
        [1, 0, -least[0]],
        [0, 1, -least[1]],
        [0, 0, 1],
    ]


def to_reference(own: Camera, reference: Camera) -> Similarity:
    """From the world of cameras (a batch) to that of the same cameras elsewhere: by their axes,
    then by their places.
    """
    (rotations, centers), (targets, places) = (_axes(each) for each in (own, reference))
    u, _, vt = np.linalg.svd(np.einsum("vba,vbc->ac", targets, rotations))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    x, y = centers - centers.mean(0), places - places.mean(0)
    scale = float((y * (x @ rotation.T)).sum() / (x * x).sum())
    return Similarity(scale, rotation, places.mean(0) - scale * rotation @ centers.mean(0))


def camera_errors(
    own: Camera, reference: Camera
) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Degrees, and centimetres of the reference's world, after one similarity."""
    move = to_reference(own, reference)
    (rotations, centers), (targets, places) = (_axes(each) for each in (own, reference))
    turns = targets @ move.rotation @ np.swapaxes(rotations, 1, 2)
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))), 100 * np.linalg.norm(
        move(centers) - places, axis=1
    )


def seen_from(own: Camera, used: Sequence[int], reference: Camera, view: int) -> Camera:
    """A camera of the reference, a batch of one, in the world of own cameras, which are those of
    the used views.
    """
    at = np.asarray(used)
    move = to_reference(own, jax.tree.map(lambda leaf: leaf[at], reference))
    matrix = np.asarray(reference.cam_from_world[view], float) @ move.matrix()
    matrix[:3] /= move.scale
    return stack_cameras([Camera.from_opencv(reference.K[view], matrix, SIZE, SIZE)])


def _axes(cameras):
    matrices = np.asarray(cameras.cam_from_world, float)
    return matrices[:, :3, :3], np.linalg.inv(matrices)[:, :3, 3]
