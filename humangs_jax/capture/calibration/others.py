"""Finds the unknown pixels of photos (docs/capture_format.md). There are two kinds. Pixels of the
first kind show other people, or things in front of the person. Pixels of the second kind were added
to the photo by the import, and no camera has seen them.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import ndimage

from humangs_jax.capture.calibration.photos import (
    Photo,
    Turn,
    mask_as_shown,
    mask_flag,
    masks_named_like,
    photo_size,
)
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.core.registry import alternatives
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.cameras import CalibratedCamera, undistort
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import read_checked
from humangs_jax.io.images import PHOTO_SUFFIXES, orientation, read_grey


def find_others(folder: Path | None, images: Path, photos: Sequence[Path]) -> dict[Path, Path]:
    """Returns the mask of others (other people, or things in front of the person) of each photo.
    Photos without such a mask are not in the result. If `folder` is None, the result is empty.

    Raises: CaptureError if no picture in the folder is named like a photo.
    """
    if folder is None:
        return {}
    find = masks_named_like(folder, images)
    named = {photo: find(photo) for photo in photos}
    found = {photo: mask for photo, mask in named.items() if mask is not None}
    if not found:
        raise CaptureError(
            folder,
            "",
            f"no mask ({alternatives(PHOTO_SUFFIXES)}) is named like a photo of {images}: expected"
            " some, white where somebody or something else is in front",
        )
    return found


def others_as_shown(
    folder: Path | None, images: Path, photos: Sequence[Path]
) -> list[Bool[np.ndarray, "_h _w"] | None]:
    """Returns for each photo which pixels show others in front of the person, (h, w), oriented as
    the photo is shown. None for a photo without a mask of others.

    Raises: CaptureError if no picture in the folder is named like a photo, if a file cannot be
    read, or if a mask has another size than its photo.
    """
    found = find_others(folder, images, photos)
    return [
        mask_as_shown(found[photo], photo) > MASK_THRESHOLD if photo in found else None
        for photo in photos
    ]


def others_imported(
    mask: Path, photo: Photo, turn: Turn, camera: CalibratedCamera, canvas: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels of an imported photo show others in front of the person, (h, w). The
    mask file is turned, undistorted and padded in the same way as the photo. canvas: width and
    height of the imported photo, pixels.

    Raises: CaptureError if a file cannot be read, or if the mask has another size than the photo.
    """
    stored = photo_size(photo.image)
    shown = stored if read_checked(orientation, photo.image) < 5 else stored[::-1]
    share = turn.upright(read_checked(read_grey, mask), mask_flag(mask, turn.photo, stored, shown))
    return _as_imported(share, camera, canvas) > MASK_THRESHOLD


def not_photographed(
    size: tuple[int, int], camera: CalibratedCamera, canvas: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels of an imported photo the camera has not seen, (h, w). Undistortion adds
    pixels beyond the border of the original photo. Padding to the common size adds more.

    Arguments: size: width and height of the upright photo, pixels. canvas: width and height of the
    imported photo, pixels.
    """
    width, height = size
    return _as_imported(np.ones((height, width), np.float32), camera, canvas) < MASK_THRESHOLD


def is_cut_off(person: Bool[np.ndarray, "h w"], unseen: Bool[np.ndarray, "h w"]) -> bool:
    """Returns whether the person comes within three pixels of the unseen area. If so, parts of the
    person may lie in that area.
    """
    # three pixels: a mask that ends so near to what the camera has not seen is cut off there
    near = ndimage.binary_dilation(unseen, iterations=3)
    return bool((person & near).any())


def _as_imported(
    share: Float[np.ndarray, "h w"], camera: CalibratedCamera, canvas: tuple[int, int]
) -> Float[np.ndarray, "height width"]:
    """Returns an upright mask undistorted and padded in the same way as its photo, (height, width).
    It is 0 where the camera has not seen anything.

    Arguments: share: the mask, 0 to 1. canvas: width and height of the imported photo.
    """
    if camera.distortion is not None:
        share = undistort(share, camera.K, camera.distortion, fill=0.0)
    height, width = share.shape
    return np.pad(share, ((0, canvas[1] - height), (0, canvas[0] - width)))
