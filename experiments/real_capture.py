"""A real capture, made ready: four synchronised videos of a man on a treadmill, from the demo of
PyPI `pose2sim` (BSD-3).

Of each chosen frame four photos without lens distortion, 512 pixels a side around the man, with his
cameras, BlazePose's keypoints and masks, and careful masks to score by: where a photo differs from
the background, the median over frames of what he does not cover. No photo is written but into the
folder that the user names.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy import ndimage

from humangs_jax.capture.detection.people import (
    LANDMARK_SIZE,
    Landmarks,
    Networks,
    bilinear,
    find_people,
    mask_in_photo,
)
from humangs_jax.capture.detection.sharpening import sharpened
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, Keypoints
from humangs_jax.core.array_types import Bool, Float, UInt8
from humangs_jax.core.progress import bar
from humangs_jax.data.cameras import distort
from humangs_jax.data.masks import person_box
from humangs_jax.data.photos import on_white_background, write_description
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.arrays import write_npz
from humangs_jax.io.images import resized, to_uint8, write_png

PACKAGE, VERSION = "pose2sim", "0.10.49"
FRAMES = (0, 12, 33, 66, 90)
"""Of the videos: those that are measured."""
DEMO = "Pose2Sim/Demo_SinglePerson"
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
STRAIGHT, BENT = "straight", "bent"
"""Photos without the lenses' distortion, and as they were taken."""
SIZE, PERSON = 512, 440
"""Pixels a side of a photo, and of the man's height in it."""
EVERY = 5
"""The background is the median over every fifth frame."""
Y_UP_FROM_Z_UP = np.asarray([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
SPREAD, DIFFERENT = 25, 0.07
"""Pixels of a video by which BlazePose's mask is dilated for the background; difference of colors
from which on one is his.
"""
SHADOW, TINT = (0.5, 1.02), 0.04
"""A shadow multiplies the background by so much, in all channels alike but for the second number.
"""
SAME, BRIGHT, SPECK = 0.03, 0.3, 800
"""Difference below which a pixel is the background's, if that is brighter than the second; pixels
of a part that is kept.
"""
NEAR, DEEP = 14, 7
"""Pixels of a video: he is nowhere further outside of BlazePose's mask than the first, and
everywhere further inside than the second."""
RIM = 3
"""Pixels of a photo: colors of the truth's rim are those from so far inside."""


class RealFrame(NamedTuple):
    """One moment in v views.

    images: (v, s, s, 3), with the room. detected, careful: (v, s, s) masks of the detector, and of
    what differs from the room.
    cameras: as published. keypoints: MediaPipe's 33. world: (v, 33, 3) landmarks in metres. crop:
    (v, 3, 3), pixels of the photos from pixels of the video (homogeneous). names: of the views.
    moments: whether each view has another pose, where the cameras are from the person; None: they
    are published.
    """

    images: Float[np.ndarray, "v s s 3"]
    detected: Float[np.ndarray, "v s s"]
    careful: Float[np.ndarray, "v s s"]
    cameras: Camera
    keypoints: Keypoints
    world: Float[np.ndarray, "v 33 3"]
    crop: Float[np.ndarray, "v 3 3"]
    names: tuple[str, ...]
    moments: bool | None = None

    def save(
        self, folder: Path, masks: Float[np.ndarray, "v s s"], cameras: Camera | None = None
    ) -> None:
        """A capture folder of the photos, with the room, and these masks. cameras: not the
        published ones.
        """
        views, cameras = [], cameras or self.cameras
        for i, name in enumerate(self.names):
            paths = {"image": f"images/{name}.png", "mask": f"masks/{name}.png"}
            for path, picture in zip(paths.values(), (self.images[i], masks[i]), strict=True):
                (folder / path).parent.mkdir(parents=True, exist_ok=True)
                write_png(folder / path, picture)
            matrices = {
                key: np.asarray(getattr(cameras, key)[i], float).tolist()
                for key in ("K", "cam_from_world")
            }
            views.append(paths | matrices | {"frame": i if self.moments else 0})
        write_description(folder, views)

    def truth(self) -> Float[np.ndarray, "v s s 3"]:
        """The man alone on white, by the careful masks, with rims in his colors."""
        return np.stack(
            [
                on_white_background(*pair)
                for pair in zip(self._without_rims(), self.careful, strict=True)
            ]
        )

    def _without_rims(self):
        for image, mask in zip(self.images, self.careful, strict=True):
            inner = ndimage.binary_erosion(
                mask > 0.5, ndimage.generate_binary_structure(2, 1), iterations=RIM
            )
            rows, columns = ndimage.distance_transform_edt(
                ~inner, return_distances=False, return_indices=True
            )
            yield image[rows, columns]


class VideoCamera(NamedTuple):
    """K (3, 3), the centre of the first pixel at (0.5, 0.5); cam_from_world (4, 4), y up;
    distortion: k1 k2 p1 p2 of OpenCV.
    """

    K: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "4 4"]
    distortion: Float[np.ndarray, "4"]

    def distorted(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where the video shows what a pinhole would show at these pixels."""
        focal, middle = self.K[[0, 1], [0, 1]], self.K[:2, 2]
        return distort((pixels - middle) / focal, np.append(self.distortion, 0.0)) * focal + middle

    def undistorted(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """The inverse, by iteration: the distortion is some pixels."""
        found = pixels
        for _ in range(10):
            found = found + pixels - self.distorted(found)
        return found


def unpacked(folder: Path) -> Path:
    """The demo's folder in `folder`. Raises: ValueError, saying how to put it there."""
    if not (folder / DEMO).is_dir():
        how = f"pip install --no-deps --target {folder} {PACKAGE}=={VERSION}"
        raise ValueError(f"{folder}: expected {DEMO} in it: {how}")
    return folder / DEMO


def read_cameras(file: Path) -> dict[str, VideoCamera]:
    """Qualisys's calibration by camera: intrinsics in 64ths of a pixel, rotations in axes of their
    own, millimetres.
    """
    found = {}
    for camera in ElementTree.parse(file).getroot().iter("camera"):
        lens, place, view = (
            _numbers(camera, name) for name in ("intrinsic", "transform", "fov_video")
        )
        K = np.eye(3)
        K[[0, 1], [0, 1]] = lens["focalLengthU"] / 64, lens["focalLengthV"] / 64
        K[:2, 2] = (
            lens["centerPointU"] / 64 - view["left"] + 0.5,
            lens["centerPointV"] / 64 - view["top"] + 0.5,
        )
        matrix = np.eye(4)
        rows = [[place[f"r{i}{j}"] for j in (1, 2, 3)] for i in (1, 2, 3)]
        matrix[:3, :3] = np.diag([1, -1, -1]) @ np.asarray(rows)
        matrix[:3, 3] = -matrix[:3, :3] @ np.asarray([place[axis] for axis in "xyz"]) / 1000
        bent = [lens[f"{kind}Distortion{i}"] for kind in ("radial", "tangental") for i in (1, 2)]
        found[camera.get("serial", "")] = VideoCamera(
            K, matrix @ np.linalg.inv(Y_UP_FROM_Z_UP), np.asarray(bent)
        )
    return found


def _numbers(camera: Any, name: str) -> dict[str, float]:
    return {key: float(value) for key, value in camera.find(name).attrib.items()}


def read_frames(video: Path, wanted: Collection[int]) -> dict[int, UInt8[np.ndarray, "h w 3"]]:
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(video))
    width, height = next(reader)["size"]
    frames = {i: raw for i, raw in enumerate(reader) if i in wanted}
    return {i: np.frombuffer(raw, np.uint8).reshape(height, width, 3) for i, raw in frames.items()}


def prepare(
    folder: Path, frames: Sequence[int] = FRAMES, *, straight: bool = True
) -> dict[int, RealFrame]:
    """The frames of the capture, from `folder`/prepared where they are there. straight: without the
    lenses' distortion.

    The empty room, as each camera sees it, is in room_NAME.png there.
    """
    place, kind = folder / "prepared", STRAIGHT if straight else BENT
    missing = [frame for frame in frames if not (place / f"{frame:03d}_{kind}.npz").exists()]
    if missing:
        demo, networks = unpacked(folder), Networks()
        place.mkdir(exist_ok=True)
        cameras, views = read_cameras(demo / "calibration" / "Calib.qca.txt"), []
        for name in bar(CAMERAS, desc="preparing videos", unit="video"):
            found, room = _views(networks, demo / "videos" / f"{name}.mp4", cameras[name], missing)
            write_png(place / f"room_{name}.png", room)
            views.append(found)
        for key in views[0]:
            arrays = {name: np.stack([view[key][name] for view in views]) for name in views[0][key]}
            write_npz(place / f"{key}.npz", arrays)
    return {frame: _load(place / f"{frame:03d}_{kind}.npz", frame) for frame in frames}


def _load(file, frame):
    with np.load(file) as stored:
        data = {name: stored[name] for name in stored.files}

    def as_share(name):
        return data[name].astype(np.float32) / 255

    cameras = [
        Camera.from_opencv(K, m, SIZE, SIZE)
        for K, m in zip(data["K"], data["cam_from_world"], strict=True)
    ]
    keypoints = Keypoints(data["points"], data["confidences"], MEDIAPIPE_33)
    names = tuple(f"{name}_{frame:03d}" for name in CAMERAS)
    images, detected, careful = (as_share(name) for name in ("images", "detected", "careful"))
    world, crop, cameras = data["world"], data["crop"], stack_cameras(cameras)
    return RealFrame(images, detected, careful, cameras, keypoints, world, crop, names)


def _views(networks, video, camera, frames):
    """Of one camera: name of a file -> arrays of its view; and the empty room."""
    photos = read_frames(video, {*frames, *range(0, 100, EVERY)})
    people = {
        i: largest_person(networks, photo.astype(np.float32) / 255) for i, photo in photos.items()
    }
    room, known = background(list(photos.values()), [person.mask for person in people.values()])
    found = {}
    for frame in frames:
        person, photo = people[frame], photos[frame].astype(np.float32) / 255
        pictures = {"images": photo, "detected": person.mask}
        pictures["careful"] = careful_mask(photo, room, known, person.mask)
        for kind, lens in ((STRAIGHT, camera), (BENT, camera._replace(distortion=np.zeros(4)))):
            found[f"{frame:03d}_{kind}"] = _view(pictures, person, lens)
    return found, room


def _view(pictures, person, camera):
    """A square around the man, with his landmarks and the camera of the square."""
    (top, bottom), (left, right) = person_box(pictures["careful"] > 0.5)
    side = (bottom - top) * SIZE / PERSON
    corner = np.asarray([left + right - side, top + bottom - side]) / 2
    crop = np.diag([SIZE / side, SIZE / side, 1.0]) @ [
        [1, 0, -corner[0]],
        [0, 1, -corner[1]],
        [0, 0, 1],
    ]
    found = {name: _cut(picture, camera, corner, side) for name, picture in pictures.items()}
    found |= {
        "K": crop @ camera.K,
        "cam_from_world": camera.cam_from_world,
        "crop": crop,
        "world": person.world,
    }
    points = (camera.undistorted(person.pixels) - corner) * SIZE / side
    return found | {
        "points": points.astype(np.float32),
        "confidences": person.visibility.astype(np.float32),
    }


def _cut(picture, camera, corner, side):
    """A square of a picture of the video, 8 bits: about one sample a pixel, then means by area."""
    fine = SIZE * max(1, round(side / SIZE))
    steps = (np.arange(fine) + 0.5) * side / fine
    grid = camera.distorted(np.stack(np.meshgrid(steps, steps), axis=-1) + corner) - 0.5
    return to_uint8(resized(bilinear(picture, grid, 0.0), SIZE, SIZE))


def largest_person(networks: Networks, photo: Float[np.ndarray, "h w 3"]) -> Landmarks:
    """The man fills a photo, bystanders do not. With the mask as the package sharpens it, at the
    size of the photo, and the centre of the first pixel at one half.
    """
    height, width = photo.shape[:2]
    people = find_people(networks, photo)
    masks = [mask_in_photo(person, width, height) for person in people]
    largest = int(np.argmax([float(mask.sum()) for mask in masks]))
    person = people[largest]
    mask = sharpened(masks[largest], photo, person.crop.side / LANDMARK_SIZE)
    return person._replace(mask=mask, pixels=person.pixels + 0.5)


def background(
    photos: Sequence[UInt8[np.ndarray, "h w 3"]], masks: Sequence[Float[np.ndarray, "h w"]]
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The median of what the person does not cover, and where there is anything of that in three
    photos or more.
    """
    ball = ndimage.generate_binary_structure(2, 1)
    free = np.stack(
        [~ndimage.binary_dilation(mask > 0.3, ball, iterations=SPREAD) for mask in masks]
    )
    stack, count = np.where(free[..., None], np.stack(photos), np.int16(999)), free.sum(0)
    stack.sort(axis=0)
    at = np.broadcast_to(np.maximum(count - 1, 0)[None, ..., None] // 2, (1, *stack.shape[1:]))
    return np.take_along_axis(stack, at, 0)[0].astype(np.float32) / 255, count >= 3


def careful_mask(
    photo: Float[np.ndarray, "h w 3"],
    room: Float[np.ndarray, "h w 3"],
    known: Bool[np.ndarray, "h w"],
    detected: Float[np.ndarray, "h w"],
) -> Float[np.ndarray, "h w"]:
    """Where a photo differs from the background, and is no shadow, near BlazePose's mask; that mask
    where nothing is known.
    """

    def smooth(image):
        return ndimage.gaussian_filter(image, (1.0, 1.0, 0))

    ours, theirs = smooth(photo), smooth(room)
    different = np.abs(ours - theirs).max(-1) > DIFFERENT
    ratio = (ours + 0.02) / (theirs + 0.02)
    middle = ratio.mean(-1)
    shadow = (middle > SHADOW[0]) & (middle < SHADOW[1]) & (np.ptp(ratio, axis=-1) < TINT)
    person = detected > 0.5
    far, deep = (ndimage.distance_transform_edt(~person), ndimage.distance_transform_edt(person))
    # dark shorts before the dark belt differ from it by nothing; a bright wall that is as it was is
    # no person
    wall = known & (np.abs(ours - theirs).max(-1) < SAME) & (theirs.max(-1) > BRIGHT)
    found = np.where(known, different & ~shadow, person)
    found = (found & (far < NEAR)) | ((deep > DEEP) & ~ndimage.binary_opening(wall, iterations=2))
    found = ndimage.median_filter(found.astype(np.uint8), 5) > 0
    found = ~_without_small(~_without_small(found))
    return np.clip(ndimage.gaussian_filter(found.astype(np.float32), 1.0), 0, 1)


def _without_small(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Without connected parts of fewer than `SPECK` pixels."""
    parts, _ = ndimage.label(inside)
    areas = np.bincount(parts.ravel())
    return (areas >= SPECK)[parts] & inside
