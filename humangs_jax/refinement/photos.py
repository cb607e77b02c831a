"""Prepares the photos that refinement compares with. They are cut to the person and reduced, and
some pixels are held out.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace
from humangs_jax.data.masks import person_box
from humangs_jax.data.prepared import PreparedCapture
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import Camera

MARGIN = 8
"""Width of the margin that a crop contains around the mask, pixels. The window of structural
similarity is 11 pixels wide, and in the margin the loss counts alpha beyond the silhouette.
"""
MULTIPLE = 16
"""Sides of crops are multiples of this number of pixels, so that few sizes are compiled. A crop is
no larger than its photo.
"""
COVERED = 0.02
"""Value of a mask above which a pixel belongs to the person."""
BLOCK = 8
"""Side of the blocks of pixels that are held out, pixels."""


@pytree_dataclass
class Photo(Batchable):
    """A view to compare with, and which of its pixels count."""

    image: Float[Array, "h w 3"]
    """The photo on white, (h, w, 3), in [0, 1]."""
    mask: Float[Array, "h w"]
    """The coverage by the person, (h, w), in [0, 1]."""
    counted: Bool[Array, "h w"]
    """Which pixels count, (h, w)."""
    camera: Camera
    """The camera that sees the crop."""
    rotations: Float[Array, "j 3"]
    """Axis-angle rotations of the joints, (j, 3), radians."""
    translation: Float[Array, "3"]
    """The translation of the body, (3,), metres."""


def photos_of(views: SubjectViews) -> Photo:
    """Returns the views of a person as a batch of photos. Pixels count unless somebody or something
    may hide the person there.
    """
    counted = from_host(np.ones(views.masks.shape, bool))
    if views.unknown is not None:
        counted = ~views.unknown
    leaves = views.images, views.masks, counted, views.cameras, views.rotations, views.translations
    return jax.vmap(Photo)(*leaves)


def crop_to_person(photos: PreparedCapture, image_size: int | None = None) -> SubjectViews:
    """Returns the photos cut to the person by windows of one size, with cameras that see these
    windows.

    Photos whose longer side exceeds `image_size` are reduced to it before they are cut.

    Raises: ValueError without masks.
    """
    capture = photos.capture
    if capture.masks is None:
        raise ValueError("crop_to_person: the capture has no masks")
    if image_size is not None and max(capture.images.shape[1:3]) > image_size:
        capture = capture.resized(image_size)
    assert capture.masks is not None
    boxes = [_bounds(mask) for mask in capture.masks]
    images, masks, cameras = windows(capture.images, capture.masks, capture.cameras, boxes)
    unknown = None
    if capture.unknown is not None:
        hidden = windows(capture.images, capture.unknown, capture.cameras, boxes)[1]
        unknown = hidden > 0
    frames = np.asarray(capture.frames)
    return SubjectViews(
        images=images,
        masks=masks,
        cameras=cameras,
        rotations=from_host(np.asarray(capture.poses.rotations)[frames]),
        translations=from_host(np.asarray(capture.poses.translation)[frames]),
        betas=from_host(capture.betas),
        unknown=unknown,
    )


def windows(
    images: Float[Array | np.ndarray, "v h w 3"],
    masks: Float[Array | np.ndarray, "v h w"] | Bool[Array | np.ndarray, "v h w"],
    cameras: Camera,
    boxes: Sequence[Sequence[Sequence[int]]],
) -> tuple[Float[Array, "v rows columns 3"], Float[Array, "v rows columns"], Camera]:
    """Returns the images, masks and cameras of windows, one around the box of each view. All
    windows have one size. The largest box fits into it with `MARGIN` on all sides, but no window is
    larger than the image.

    boxes: ((top, bottom), (left, right)) of each view, pixels.
    """
    height, width = masks.shape[1:]
    rows, columns = (
        _window([box[axis] for box in boxes], size) for axis, size in enumerate((height, width))
    )
    corners = [(_corner(box[0], rows, height), _corner(box[1], columns, width)) for box in boxes]

    def crop(
        arrays: Float[Array | np.ndarray, "v h w *c"] | Bool[Array | np.ndarray, "v h w"],
    ) -> Float[Array, "v rows columns *c"]:
        cut = [
            x[top : top + rows, left : left + columns]
            for x, (top, left) in zip(arrays, corners, strict=True)
        ]
        return from_host(np.stack(cut), jnp.float32)

    shift = np.zeros((len(images), 3, 3), np.float32)
    shift[:, 1, 2], shift[:, 0, 2] = np.transpose(corners)
    return (
        crop(images),
        crop(masks),
        replace(cameras, K=from_host(np.asarray(cameras.K) - shift), width=columns, height=rows),
    )


def held_out_blocks(shape: tuple[int, ...], share: float, seed: int) -> Bool[np.ndarray, "v h w"]:
    """Returns which pixels of v photos are held out, (v, h, w). They are random blocks that cover
    about `share` of all pixels. shape: (v, h, w).
    """
    v, height, width = shape
    blocks = (
        np.random.default_rng(seed).random((v, -(-height // BLOCK), -(-width // BLOCK))) < share
    )
    return blocks.repeat(BLOCK, axis=1).repeat(BLOCK, axis=2)[:, :height, :width]


def photo_order(views: Int[np.ndarray, " v"], steps: int, seed: int) -> Int[np.ndarray, " n"]:
    """Returns the view of each of `steps` steps, (steps,). All views are taken once in a random
    order, then in a new random order, and so on.
    """
    rng = np.random.default_rng(seed)
    return np.concatenate(
        [np.zeros(0, int), *(rng.permutation(views) for _ in range(-(-steps // len(views))))]
    )[:steps]


def _bounds(mask: Float[np.ndarray, "h w"]) -> Sequence[Sequence[int]]:
    """Returns ((top, bottom), (left, right)) of the person, pixels, or of the whole image if nobody
    is in it.
    """
    box = person_box(mask > COVERED).tolist()
    if any(box[0]):
        return box
    return [(0, size) for size in mask.shape]


def _window(bounds: Sequence[Sequence[int]], size: int) -> int:
    longest = max(stop - start for start, stop in bounds) + 2 * MARGIN
    return min(size, -(-longest // MULTIPLE) * MULTIPLE)


def _corner(bounds: Sequence[int], window: int, size: int) -> int:
    return int(np.clip((bounds[0] + bounds[1] - window) // 2, 0, size - window))
