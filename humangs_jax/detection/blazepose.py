"""BlazePose (https://arxiv.org/abs/2006.10204): one person of a photo -> 33 landmarks, metric 3D landmarks, a mask.

Two networks, run by LiteRT. The detector looks at a square window of the photo and finds, for each person, the middle of the
hips and a point whose distance from it is the size of the body. The landmark network looks at the square around them, turned so
that the person stands upright. Pre- and postprocessing are mediapipe's for its pose graph, in numpy: bilinear samples from the
crop's corner, no antialiasing. The networks depend on both.

Pixels in this file are mediapipe's: (x, y), the centre of the first at 0. `people` adds the half pixel of our convention.
"""

import contextlib
import functools
import importlib
import importlib.util
import os
import sys
from collections.abc import Generator
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float

DETECTOR, LANDMARKS = "pose_detection.tflite", "pose_landmark_heavy.tflite"
"""Files of `assets/blazepose`. The lite and full landmark networks exchange left and right often, heavy hardly ever."""
DETECTOR_SIZE, LANDMARK_SIZE = 224, 256
"""Pixels a side of the two networks' inputs."""
LANDMARK_COUNT = 33
ALIGNMENT = 6
"""The landmark network's further points; the first two are the detector's, found again."""
STRIDES = ((8, 2), (16, 2), (32, 6))
"""Of the detector's grids, and how many anchors a cell has."""
LEAST_SCORE = 0.5
"""Of a detection."""
SAME_BOX = 0.3
"""Intersection over union from which on detections of one window are one person."""
ENLARGED = 1.25
"""Side of the crop over the diameter of the circle through the detector's second point."""
PEAK, WINDOW = 0.5, 7
"""Least height of the heatmap around a landmark that is moved to the centroid, and side of the window."""


class Crop(NamedTuple):
    """A square of the photo. center: (2,) pixels; side: pixels; angle: radians, by which its upright is turned clockwise."""

    center: Float[np.ndarray, "2"]
    side: float
    angle: float

    @property
    def turn(self) -> Float[np.ndarray, "2 2"]:
        """The rotation from the crop's axes to the photo's."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.asarray([[c, -s], [s, c]])

    def to_photo(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Points of the crop, in [0, 1], in pixels of the photo."""
        return self.center + (points - 0.5) * self.side @ self.turn.T

    def from_photo(self, pixels: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of the photo in the crop, which is [0, 1] x [0, 1]."""
        return (pixels - self.center) @ self.turn / self.side + 0.5


class Detection(NamedTuple):
    """A person in a window. score: in [0, 1]. hips, head: (2,) pixels; the second is a point at the body's size from the hips."""

    score: float
    hips: Float[np.ndarray, "2"]
    head: Float[np.ndarray, "2"]

    def crop(self) -> Crop:
        """The square that the landmark network looks at."""
        x, y = self.head - self.hips
        return Crop(self.hips, 2 * ENLARGED * float(np.hypot(x, y)), float(np.pi / 2 - np.arctan2(-y, x)))


class Landmarks(NamedTuple):
    """What the landmark network says of a crop.

    pixels: (33, 2). visibility: (33,) probability that a landmark is seen and not hidden. world: (33, 3) metres from the middle
    of the hips in the camera's axes (x right, y down, z away), of a person of average size. presence: probability of a person.
    mask: (256, 256) probability, of the crop. again: where the detector's points are.
    """

    pixels: Float[np.ndarray, "33 2"]
    visibility: Float[np.ndarray, " 33"]
    world: Float[np.ndarray, "33 3"]
    presence: float
    mask: Float[np.ndarray, "256 256"]
    crop: Crop
    again: Detection


def available() -> bool:
    """Whether LiteRT is installed."""
    return importlib.util.find_spec("ai_edge_litert") is not None


class Networks:
    """The two networks. Raises: ImportError, saying what to install, without LiteRT."""

    def __init__(self) -> None:
        try:
            with _silent():
                # optional, and then unknown to type checkers
                interpreter = importlib.import_module("ai_edge_litert.interpreter").Interpreter
        except ImportError as error:
            raise ImportError(
                "finding people in photos needs LiteRT: pip install 'humangs_jax[photos]' (there is none for Macs with Intel "
                "processors: give keypoints and masks of another program there, see docs/your_photos.md)"
            ) from error
        folder = resources.files("humangs_jax") / "assets" / "blazepose"
        self._runs = [self._load(interpreter, folder / name) for name in (DETECTOR, LANDMARKS)]

    @staticmethod
    def _load(interpreter: Any, file: Any) -> Any:
        with _silent():
            network = interpreter(model_content=file.read_bytes(), num_threads=1)
            network.allocate_tensors()
        return network

    def _run(self, which: int, image: Float[np.ndarray, "size size 3"]) -> dict[str, np.ndarray]:
        network = self._runs[which]
        network.set_tensor(network.get_input_details()[0]["index"], image[None].astype(np.float32))
        network.invoke()
        return {output["name"]: network.get_tensor(output["index"])[0] for output in network.get_output_details()}

    def detect(self, photo: Float[np.ndarray, "h w 3"], window: Crop) -> list[Detection]:
        """People in an upright window of a photo with values in [0, 1]; black around it. The best first."""
        outputs = self._run(0, 2 * sampled(photo, window, DETECTOR_SIZE, outside=0.0) - 1)
        scores, raw = _sigmoid(outputs["Identity_1"][:, 0]), outputs["Identity"]
        kept = scores > LEAST_SCORE
        points = raw[kept] / DETECTOR_SIZE + np.tile(_anchors()[kept], 6)
        points[:, 2:4] -= _anchors()[kept]  # width and height are no places
        return [
            Detection(float(score), *(window.to_photo(box[i : i + 2]) for i in (4, 6)))
            for score, box in _merged(scores[kept], points)
        ]

    def landmarks(self, photo: Float[np.ndarray, "h w 3"], crop: Crop) -> Landmarks:
        """Landmarks of the person in a crop of a photo with values in [0, 1]."""
        outputs = self._run(1, sampled(photo, crop, LANDMARK_SIZE))
        raw = outputs["Identity"].reshape(LANDMARK_COUNT + ALIGNMENT, 5).astype(np.float64)
        points = refined(raw[:, :2] / LANDMARK_SIZE, _sigmoid(outputs["Identity_3"]))
        pixels = crop.to_photo(points)
        world = outputs["Identity_4"].reshape(-1, 3)[:LANDMARK_COUNT].astype(np.float64)
        world[:, :2] = world[:, :2] @ crop.turn.T
        presence = float(outputs["Identity_1"][0])
        return Landmarks(
            pixels=pixels[:LANDMARK_COUNT],
            visibility=_sigmoid(raw[:LANDMARK_COUNT, 3]),
            world=world,
            presence=presence,
            mask=_sigmoid(outputs["Identity_2"][..., 0]),
            crop=crop,
            again=Detection(presence, *pixels[LANDMARK_COUNT : LANDMARK_COUNT + 2]),
        )


def sampled(
    photo: Float[np.ndarray, "h w 3"], crop: Crop, size: int, outside: float | None = None
) -> Float[np.ndarray, "size size 3"]:
    """A crop of the photo, bilinear. outside: value beyond the photo; None: that of its edge."""
    steps = np.arange(size) / size
    points = crop.to_photo(np.stack(np.meshgrid(steps, steps), axis=-1))
    return bilinear(photo, points, outside)


def bilinear(
    image: Float[np.ndarray, "h w *c"], points: Float[np.ndarray, "a b 2"], outside: float | None = None
) -> Float[np.ndarray, "a b *c"]:
    """Values between pixels; whole numbers are pixels. outside: value beyond the image; None: that of its edge."""
    height, width = image.shape[:2]
    x, y = points[..., 0], points[..., 1]
    inside = (x > -1) & (x < width) & (y > -1) & (y < height)
    x, y = x.clip(0, width - 1), y.clip(0, height - 1)
    left, top = np.minimum(x.astype(int), max(width - 2, 0)), np.minimum(y.astype(int), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    shape = x.shape + (1,) * (image.ndim - 2)
    u, v = (x - left).reshape(shape).astype(np.float32), (y - top).reshape(shape).astype(np.float32)
    upper = image[top, left] * (1 - u) + image[top, right] * u
    lower = image[bottom, left] * (1 - u) + image[bottom, right] * u
    values = upper * (1 - v) + lower * v
    return values if outside is None else np.where(inside.reshape(shape), values, np.float32(outside))


def refined(points: Float[np.ndarray, "n 2"], heatmaps: Float[np.ndarray, "m m n"]) -> Float[np.ndarray, "n 2"]:
    """Points in [0, 1], moved to the centroid of the heatmap around them where it has a peak."""
    size, half, moved = len(heatmaps), WINDOW // 2, points.copy()
    for i, (column, row) in enumerate(np.trunc(points * size).astype(int)):
        if not (0 <= column < size and 0 <= row < size):
            continue
        rows, columns = (np.arange(max(0, at - half), min(size, at + half + 1)) for at in (row, column))
        heights = heatmaps[rows[:, None], columns, i].astype(np.float64)
        if heights.max() >= PEAK:
            moved[i] = np.asarray([heights.sum(0) @ columns, heights.sum(1) @ rows]) / heights.sum() / size
    return moved


def mask_at(found: Landmarks, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """The mask of a crop at pixels of the photo; 0 outside of the crop."""
    return bilinear(found.mask, found.crop.from_photo(pixels)[None] * LANDMARK_SIZE, outside=0.0)[0]


def mask_in_photo(found: Landmarks, width: int, height: int) -> Float[np.ndarray, "height width"]:
    """The mask of a crop at the size of the photo; 0 outside of the crop."""
    from PIL import Image

    mask = np.zeros((height, width), np.float32)
    corners = found.crop.to_photo(np.asarray([[0.0, 0], [0, 1], [1, 0], [1, 1]]))
    left, top = np.floor(corners.min(0)).astype(int).clip(0, [width, height])
    right, bottom = np.ceil(corners.max(0) + 1).astype(int).clip(0, [width, height])
    if right > left and bottom > top:
        corners = np.asarray([[0.0, 0], [1, 0], [0, 1]]) + np.asarray([left, top])
        origin, right_of, below = found.crop.from_photo(corners) * LANDMARK_SIZE
        across, down = right_of - origin, below - origin
        # Pillow counts from corners of pixels and adds the half pixel of the target itself; it is ten times faster than numpy
        start = origin + 0.5 - (across + down) / 2
        affine = tuple(np.stack([across, down, start], axis=-1).ravel().tolist())
        size = (int(right - left), int(bottom - top))
        picture = Image.fromarray(found.mask.astype(np.float32))
        mask[top:bottom, left:right] = picture.transform(size, Image.Transform.AFFINE, affine, Image.Resampling.BILINEAR)
    return mask


@functools.cache
def _anchors() -> Float[np.ndarray, "a 2"]:
    """Centres of the detector's cells, in [0, 1]: grid by grid, row by row, each as often as a cell has anchors."""
    grids = []
    for stride, copies in STRIDES:
        middles = (np.arange(DETECTOR_SIZE // stride) + 0.5) * stride / DETECTOR_SIZE
        grids.append(np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2).repeat(copies, axis=0))
    return np.concatenate(grids)


def _merged(scores: Float[np.ndarray, " n"], boxes: Float[np.ndarray, "n 12"]) -> list[tuple[float, np.ndarray]]:
    """Weighted non-maximum suppression: what overlaps the best is averaged by score."""
    left, merged = np.argsort(-scores), []
    while len(left):
        same = _overlaps(boxes[left[0]], boxes[left]) > SAME_BOX
        same[0] = True
        weights = scores[left[same], None]
        merged.append((float(scores[left[0]]), (boxes[left[same]] * weights).sum(0) / weights.sum()))
        left = left[~same]
    return merged


def _overlaps(box: Float[np.ndarray, "12"], boxes: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, " n"]:
    """Intersection over union with each; boxes begin with centre and size."""
    low = np.maximum(box[:2] - box[2:4] / 2, boxes[:, :2] - boxes[:, 2:4] / 2)
    high = np.minimum(box[:2] + box[2:4] / 2, boxes[:, :2] + boxes[:, 2:4] / 2)
    shared = np.prod(np.maximum(high - low, 0), axis=1)
    return shared / np.maximum(np.prod(box[2:4]) + np.prod(boxes[:, 2:4], axis=1) - shared, 1e-12)


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(x, -80, 80)))


@contextlib.contextmanager
def _silent() -> Generator[None]:
    """Without the line that LiteRT's C++ prints on standard error when it starts."""
    sys.stderr.flush()
    try:
        kept = os.dup(2)
    except OSError:  # closed
        yield
        return
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
