"""Cuts photos to the person, for sheets. In photos of 1,920 pixels from a camera dome a person is
only about 200 pixels large.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.capture import Capture

LARGEST_SHARE = 0.7
"""Area of the largest window that is cut out, as a share of the photo's area. If a larger window
would be needed, whole photos are shown.
"""


def around_person(
    capture: Capture,
    vertices: Mapping[int, Float[Array, "n 3"]],
    marks: Sequence[Float[np.ndarray, "_k 2"]] | None = None,
) -> tuple[Capture, Int[np.ndarray, "v 2"]]:
    """Cuts photos, masks and cameras of a capture to windows around the person. All windows have
    the same size. Returns the capture, and the upper left corner (x, y) of each window, (v, 2),
    pixels.

    If the windows would be larger than `LARGEST_SHARE` of the photo's area, or if no view shows the
    person, the capture stays as it is and corners are 0.

    Arguments: vertices: vertices of the posed body, by frame, (n, 3), metres. marks: further pixels
    (x, y) of each view that the window has to show.
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
    """Cuts each image to a window. size: width and height of all windows. corners: the upper left
    corner (x, y) of each window.
    """
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
    marks: Sequence[Float[np.ndarray, "_k 2"]] | None,
) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]] | None:
    """Returns the least and the largest (x, y), each (2,), of the pixels of body, mask and marks
    that lie in a photo. None if there are none. vertices: vertices of the posed body in the world,
    (n, 3), metres.
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
