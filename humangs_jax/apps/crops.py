"""Photos cut to the person, for sheets: in a dome a person has 200 of 1,920 pixels."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.capture import Capture

LARGEST_SHARE = 0.7
"""Share of the photo's area above which a window is not cut: the photo is shown whole."""


def around_person(
    capture: Capture,
    vertices: Mapping[int, Float[Array, "n 3"]],
    marks: Sequence[Float[np.ndarray, "k 2"]] | None = None,
) -> tuple[Capture, Int[np.ndarray, "v 2"]]:
    """The capture with photos, masks and cameras cut to windows of one size around the person, and
    their upper left corners.

    The capture as it is, and corners of 0, where the largest window is nearly the photo.

    Arguments: vertices: of the posed body, by frame. marks: further pixels of each view that are to
    be seen.
    """
    height, width = capture.images.shape[1:3]
    photo, count = np.asarray([width, height]), len(capture.images)
    boxes = [
        _box(capture, view, vertices[int(capture.frames[view])], marks) for view in range(count)
    ]
    sizes = [high - low for low, high in filter(None, boxes)]
    whole = capture, np.zeros((count, 2), int)
    if not sizes:
        return whole
    size = np.max(sizes, axis=0)
    # share of the person's longer side that is left free around the person, on each side
    size = np.minimum(np.ceil(size + 2 * 0.15 * size.max()), photo).astype(int)
    if size.prod() > LARGEST_SHARE * photo.prod():
        return whole
    # where the person is not seen, the middle of the photo is shown
    middles = [photo / 2 if box is None else np.mean(box, axis=0) for box in boxes]
    corners = np.clip(np.rint(middles - size / 2), 0, photo - size).astype(int)
    shift = np.zeros((count, 3, 3), np.float32)
    shift[:, :2, 2] = corners
    K = from_host(np.asarray(capture.cameras.K) - shift)
    cameras = replace(capture.cameras, K=K, width=int(size[0]), height=int(size[1]))
    masks = None
    if capture.masks is not None:
        masks = _cut(capture.masks, corners, size)
    unknown = None
    if capture.unknown is not None:
        unknown = _cut(capture.unknown, corners, size)
    images = _cut(capture.images, corners, size)
    cut = dataclasses.replace(capture, images=images, masks=masks, cameras=cameras, unknown=unknown)
    return cut, corners


def _cut(
    images: np.ndarray, corners: Int[np.ndarray, "v 2"], size: Int[np.ndarray, "2"]
) -> np.ndarray:
    """Windows of one size (width, height) at the corners (x, y)."""
    return np.stack(
        [
            image[y : y + size[1], x : x + size[0]]
            for image, (x, y) in zip(images, corners, strict=True)
        ]
    )


def _box(
    capture: Capture,
    view: int,
    vertices: Float[Array, "n 3"],
    marks: Sequence[Float[np.ndarray, "k 2"]] | None,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """The least and largest x and y of the body, the mask and the marks in a photo; None if nothing
    is in it.
    """
    K, pose = (
        np.asarray(x[view], float) for x in (capture.cameras.K, capture.cameras.cam_from_world)
    )
    points = np.asarray(vertices, float) @ pose[:3, :3].T + pose[:3, 3]
    points = points[points[:, 2] > 0]
    pixels = [points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + K[:2, 2]]
    if capture.masks is not None:
        pixels.append(np.argwhere(capture.masks[view] > MASK_THRESHOLD)[:, ::-1])  # rows are y
    if marks is not None:
        pixels.append(np.asarray(marks[view], float))
    photo = np.asarray(capture.images.shape[2:0:-1])
    seen = np.concatenate(pixels)
    seen = seen[
        np.isfinite(seen).all(axis=1) & (seen >= 0).all(axis=1) & (seen <= photo).all(axis=1)
    ]
    if len(seen):
        return seen.min(axis=0), seen.max(axis=0)
    return None
