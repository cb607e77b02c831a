"""The photos that refinement compares with: cut to the person, reduced, with the pixels that are held out."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.masks import person_box
from humangs_jax.data.usable_views import usable_views
from humangs_jax.data.views import SubjectViews, upright

MARGIN = 8
"""Pixels around the mask: the window of structural similarity has 11, and Gaussians beyond the silhouette cost alpha there."""
MULTIPLE = 16
"""Sides of crops are multiples of it, so that few sizes are compiled."""
COVERED = 0.02
"""Coverage from which a pixel counts as the person's."""
BLOCK = 8
"""Side of the blocks of pixels that are held out."""


def crop_to_person(capture: Capture, image_size: int | None = None) -> SubjectViews:
    """The photos, cut to the person by windows of one size, with the cameras that see the windows.

    In a world with y up (`data.views.upright_world`). Photos whose longer side exceeds `image_size` are reduced to it. Views
    whose mask does not show the person are left out, see `usable_views`.

    Raises: ValueError without masks; CaptureError if no view is left.
    """
    if capture.masks is None:
        raise ValueError("crop_to_person: the capture has no masks")
    capture = usable_views(capture)
    if image_size is not None and max(capture.images.shape[1:3]) > image_size:
        capture = capture.resized(image_size)
    images, cameras, masks = capture.images, capture.cameras, capture.masks
    assert masks is not None
    height, width = masks.shape[1:]
    boxes = [_bounds(mask) for mask in masks]
    rows, columns = (_window([box[axis] for box in boxes], size) for axis, size in enumerate((height, width)))
    crop = lambda arrays: np.stack(
        [x[top : top + rows, left : left + columns] for x, (top, left) in zip(arrays, corners, strict=True)]
    )
    corners = [(_corner(box[0], rows, height), _corner(box[1], columns, width)) for box in boxes]
    shift = np.zeros((len(images), 3, 3), np.float32)
    shift[:, 1, 2], shift[:, 0, 2] = np.transpose(corners)
    frames = np.asarray(capture.frames)
    views = SubjectViews(
        images=jnp.asarray(crop(images), jnp.float32),
        masks=jnp.asarray(crop(masks), jnp.float32),
        cameras=replace(cameras, K=cameras.K - shift, width=columns, height=rows),
        rotations=jnp.asarray(capture.poses.rotations)[frames],
        translations=jnp.asarray(capture.poses.translation)[frames],
        betas=jnp.asarray(capture.betas),
    )
    return upright(views, capture.body)


def held_out_blocks(views: SubjectViews, share: float, seed: int) -> Bool[Array, "v h w"]:
    """Which pixels no step sees: random blocks, `share` of all."""
    v, height, width = views.masks.shape
    rng = np.random.default_rng(seed)
    blocks = rng.random((v, -(-height // BLOCK), -(-width // BLOCK))) < share
    return jnp.asarray(blocks.repeat(BLOCK, axis=1).repeat(BLOCK, axis=2)[:, :height, :width])


def _bounds(mask):
    """((top, bottom), (left, right)) of the person; the whole image if nobody is in it."""
    box = person_box(mask > COVERED).tolist()
    return box if any(box[0]) else [(0, size) for size in mask.shape]


def _window(bounds, size):
    longest = max(stop - start for start, stop in bounds) + 2 * MARGIN
    return min(size, -(-longest // MULTIPLE) * MULTIPLE)


def _corner(bounds, window, size):
    return int(np.clip((bounds[0] + bounds[1] - window) // 2, 0, size - window))
