"""Masks, looked at when they are imported: what the reader of captures would refuse is refused, what is likely wrong is named."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.data.calibration.photos import Photo
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.photos import read_checked, read_mask
from humangs_jax.data.usable_views import MASK_THRESHOLD
from humangs_jax.io.images import image_size, open_image, read_image

AROUND = 0.8
"""Share of a photo's border that no person covers: a mask that does is inverted."""
EMPTY = "the mask is empty, the photo will be left out"
FULL = "the mask covers the whole photo: is nothing of it background?"
INVERTED = "the mask covers the border of the photo: is it inverted? expected 255 where the person is"
NAMED = 4
"""Photos that are named in a warning; the others are counted."""


def check_masks(photos: Sequence[Photo]) -> tuple[str, ...]:
    """Warnings about masks, files or alpha channels, one line for each kind of fault, naming the photos.

    Raises: CaptureError for a mask that no capture may have, for masks none of which shows anybody, and, where there are no mask
    files, for an alpha channel in some of the photos only.
    """
    masked = photos[0].mask is not None
    if not masked:
        alphas = [read_checked(has_alpha, photo.image) for photo in photos]
        if not any(alphas):
            return ()
        if not all(alphas):
            file = photos[alphas.index(False)].image
            raise CaptureError(file, "alpha", "expected an alpha channel in all images or in none")
    found: dict[str, list[str]] = {}
    opaque = True
    for photo in photos:
        mask = _mask(photo)
        opaque = opaque and mask.min() == 1
        if (problem := _problem(mask > MASK_THRESHOLD)) is not None:
            found.setdefault(problem, []).append((photo.mask or photo.image).name)
    if not masked and opaque:
        return ()  # many programs write an opaque alpha channel: it says nothing
    if len(found.get(EMPTY, ())) == len(photos):
        first = photos[0].mask or photos[0].image
        raise CaptureError(first, "mask", "empty, as are all of them: expected 255 where the person is")
    return tuple(f"{problem}: {_listed(names)}" for problem, names in found.items())


def _mask(photo):
    if photo.mask is None:
        return read_checked(read_image, photo.image)[1]
    width, height = read_checked(image_size, photo.mask)
    return read_mask(photo.mask, "its photo", width, height)


def _problem(person):
    if not person.any():
        return EMPTY
    if person.all():
        return FULL
    border = np.concatenate([person[0], person[-1], person[1:-1, 0], person[1:-1, -1]])
    return INVERTED if border.mean() > AROUND else None


def has_alpha(photo: Path) -> bool:
    """Whether a photo has an alpha channel, opaque or not."""
    with open_image(photo) as (image, _):
        return "A" in image.getbands() or "transparency" in image.info


def _listed(names):
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
