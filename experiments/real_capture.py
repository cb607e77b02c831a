"""Prepares a real capture: four synchronised videos of a man on a treadmill, from the demo of PyPI
`pose2sim` (BSD-3).

Each chosen frame becomes four photos around the man, without lens distortion, 512 pixels a side.
With them come their cameras, BlazePose's keypoints and masks, and careful masks to score by. A
careful mask is where a photo differs from the background, which is the median over frames of what
the man does not cover. Photos are written only into the folder that the user names.
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
"""Numbers of the frames that are measured."""
DEMO = "Pose2Sim/Demo_SinglePerson"
CAMERAS = ("cam01", "cam02", "cam03", "cam04")
STRAIGHT, BENT = "straight", "bent"
"""Photos without the lenses' distortion, and as they were taken."""
SIZE, PERSON = 512, 440
"""Side of a photo in pixels, and height of the man in it."""
EVERY = 5
"""Step between the frames whose median is the background."""
Y_UP_FROM_Z_UP = np.asarray([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Rotation of a world with z up into one with y up."""
SPREAD, DIFFERENT = 25, 0.07
"""Pixels of a video by which BlazePose's mask is dilated for the background, and the difference of
colors from which on a pixel belongs to the man.
"""
SHADOW, TINT = (0.5, 1.02), 0.04
"""Range of the factors by which a shadow multiplies the background, and the largest difference of
the factors of its channels.
"""
SAME, BRIGHT, SPECK = 0.03, 0.3, 800
"""Difference below which a pixel belongs to the background, brightness that the background has
there at least, and pixels of the smallest part that is kept.
"""
NEAR, DEEP = 14, 7
"""Pixels of a video outside of BlazePose's mask beyond which the man cannot be, and pixels inside
of it beyond which he must be.
"""
RIM = 3
"""Pixels of a photo from the rim of the man to the colors that his rim gets in the truth."""


class RealFrame(NamedTuple):
    """One moment in v views."""

    images: Float[np.ndarray, "v s s 3"]
    """Photos with the room."""
    detected: Float[np.ndarray, "v s s"]
    """Masks of the detector."""
    careful: Float[np.ndarray, "v s s"]
    """Masks of what differs from the room."""
    cameras: Camera
    """Published cameras of the photos."""
    keypoints: Keypoints
    """MediaPipe's 33 keypoints in each photo."""
    world: Float[np.ndarray, "v 33 3"]
    """Landmarks of each photo in metres."""
    crop: Float[np.ndarray, "v 3 3"]
    """Homogeneous matrices from pixels of the video to pixels of the photos."""
    names: tuple[str, ...]
    """Names of the views."""
    moments: bool | None = None
    """Whether each view has another pose, if the cameras come from the person. None: the cameras
    are published.
    """

    def save(
        self, folder: Path, masks: Float[np.ndarray, "v s s"], cameras: Camera | None = None
    ) -> None:
        """Writes a capture folder of the photos, which show the room, and of these masks.

        `cameras` are used instead of the published ones.
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
        """Returns the man alone on white, cut out by the careful masks, with rims in his colors."""
        pairs = zip(self._without_rims(), self.careful, strict=True)
        return np.stack([on_white_background(image, mask) for image, mask in pairs])

    def _without_rims(self):
        """Yields the photos with each pixel near or outside of the rim of the man in the color of
        the nearest pixel further inside.
        """
        ball = ndimage.generate_binary_structure(2, 1)
        for image, mask in zip(self.images, self.careful, strict=True):
            inner = ndimage.binary_erosion(mask > 0.5, ball, iterations=RIM)
            rows, columns = ndimage.distance_transform_edt(
                ~inner, return_distances=False, return_indices=True
            )
            yield image[rows, columns]


class VideoCamera(NamedTuple):
    """The camera of a video."""

    K: Float[np.ndarray, "3 3"]
    """Intrinsics, with the centre of the first pixel at (0.5, 0.5)."""
    cam_from_world: Float[np.ndarray, "4 4"]
    """Extrinsics in a world with y up, metres."""
    distortion: Float[np.ndarray, "4"]
    """Distortion of the lens: k1, k2, p1 and p2 of OpenCV."""

    def distorted(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Returns the pixels of the video that show what a pinhole would show at these pixels."""
        focal, middle = self.K[[0, 1], [0, 1]], self.K[:2, 2]
        return distort((pixels - middle) / focal, np.append(self.distortion, 0.0)) * focal + middle

    def undistorted(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Returns the inverse of `distorted` by iteration, for distortions of some pixels."""
        found = pixels
        for _ in range(10):
            found = found + pixels - self.distorted(found)
        return found


def unpacked(folder: Path) -> Path:
    """Returns the folder of the demo inside of `folder`.

    Raises: ValueError that describes how to put it there.
    """
    if not (folder / DEMO).is_dir():
        how = f"pip install --no-deps --target {folder} {PACKAGE}=={VERSION}"
        raise ValueError(f"{folder}: expected {DEMO} in it: {how}")
    return folder / DEMO


def read_cameras(file: Path) -> dict[str, VideoCamera]:
    """Reads the calibration of Qualisys as {serial number: camera}.

    The file has intrinsics in 64ths of a pixel, lengths in millimetres, and axes of cameras with y
    and z in other directions than OpenCV.
    """
    found = {}
    for camera in ElementTree.parse(file).getroot().iter("camera"):
        lens = _numbers(camera, "intrinsic")
        place = _numbers(camera, "transform")
        view = _numbers(camera, "fov_video")
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
    """Returns the attributes of an element inside of a camera's element as numbers."""
    return {key: float(value) for key, value in camera.find(name).attrib.items()}


def read_frames(video: Path, wanted: Collection[int]) -> dict[int, UInt8[np.ndarray, "h w 3"]]:
    """Reads {number: frame} of the frames of a video with these numbers."""
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(video))
    width, height = next(reader)["size"]
    frames = {i: raw for i, raw in enumerate(reader) if i in wanted}
    return {i: np.frombuffer(raw, np.uint8).reshape(height, width, 3) for i, raw in frames.items()}


def prepare(
    folder: Path, frames: Sequence[int] = FRAMES, *, straight: bool = True
) -> dict[int, RealFrame]:
    """Returns {number: frame} of the capture, from `folder`/prepared where they are there.

    Frames that are missing there are made from the videos. The empty room, as each camera sees it,
    is written to room_NAME.png there. `straight` takes out the lenses' distortion.
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
    """Loads a prepared frame."""
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
    """Makes the views of one camera.

    Returns {name of a file: arrays of the view}, and the empty room (h, w, 3).
    """
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
    """Returns the arrays of a square around the man, with his landmarks and the square's camera."""
    (top, bottom), (left, right) = person_box(pictures["careful"] > 0.5)
    side = (bottom - top) * SIZE / PERSON
    corner = np.asarray([left + right - side, top + bottom - side]) / 2
    shift = [[1, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1]]
    crop = np.diag([SIZE / side, SIZE / side, 1.0]) @ shift
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
    """Cuts a square out of a picture of the video, without distortion and with 8 bits.

    The picture is sampled about once a pixel, and then resized by means over areas.
    """
    fine = SIZE * max(1, round(side / SIZE))
    steps = (np.arange(fine) + 0.5) * side / fine
    grid = camera.distorted(np.stack(np.meshgrid(steps, steps), axis=-1) + corner) - 0.5
    return to_uint8(resized(bilinear(picture, grid, 0.0), SIZE, SIZE))


def largest_person(networks: Networks, photo: Float[np.ndarray, "h w 3"]) -> Landmarks:
    """Returns the person with the largest mask, who is the man and no bystander.

    The mask is sharpened as the package does it, and has the size of the photo. Pixels have the
    centre of the first one at one half.
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
    """Returns the median of what the person does not cover, and whether three photos or more show
    it at a pixel.
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
    """Returns the mask of what differs from the background near BlazePose's mask, and is no shadow.

    Where the background is not known, it is BlazePose's mask.
    """

    def smooth(image):
        return ndimage.gaussian_filter(image, (1.0, 1.0, 0))

    # pixels that differ from the room, and those that are only darker
    ours, theirs = smooth(photo), smooth(room)
    different = np.abs(ours - theirs).max(-1) > DIFFERENT
    ratio = (ours + 0.02) / (theirs + 0.02)
    middle = ratio.mean(-1)
    shadow = (middle > SHADOW[0]) & (middle < SHADOW[1]) & (np.ptp(ratio, axis=-1) < TINT)
    person = detected > 0.5
    far, deep = ndimage.distance_transform_edt(~person), ndimage.distance_transform_edt(person)
    # dark shorts do not differ from the dark belt behind them, so what is deep inside belongs to
    # the person, except where a bright wall is unchanged
    wall = known & (np.abs(ours - theirs).max(-1) < SAME) & (theirs.max(-1) > BRIGHT)
    found = np.where(known, different & ~shadow, person)
    found = (found & (far < NEAR)) | ((deep > DEEP) & ~ndimage.binary_opening(wall, iterations=2))
    found = ndimage.median_filter(found.astype(np.uint8), 5) > 0
    found = ~_without_small(~_without_small(found))
    return np.clip(ndimage.gaussian_filter(found.astype(np.float32), 1.0), 0, 1)


def _without_small(inside: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Returns a mask without its connected parts of fewer than `SPECK` pixels."""
    parts, _ = ndimage.label(inside)
    areas = np.bincount(parts.ravel())
    return (areas >= SPECK)[parts] & inside
