"""Masks that are too large or too small, moved to where the photo has its edges.

Segmentation leaves outlines that are some pixels off. A pixel too much shows the background at the person's rim, a pixel too
little cuts the person, in all photos alike, so no later stage can find it. Here the photo is searched along the normals of the
outline: at which distance from it do the colours change most, on average over the outline, and near each of its points?
"""

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.io.images import resized

PERSON_HEIGHT = 200
"""Lengths below are in pixels of a person who is that high."""
REACH, STEP = 4.0, 0.5
"""Largest distance that an outline is moved, and the steps that are tried."""
NEIGHBORHOOD, SMOOTHING = 4.0, 2.0
"""Standard deviations: of the part of the outline whose colours decide about a point, and of the distances found."""
LEAST = 0.75
"""Masks whose outline is off by less on average stay as they are: exact ones would only lose (docs/stability.md)."""
LEAST_MOVE = 0.5
"""Parts of the outline that would move by less stay where they are."""
MOST_PIXELS = 400
"""Height of the person at which the photo is searched; larger photos are reduced."""
LEAST_PART = 0.005
"""Connected parts of a mask that are smaller, as a share of the largest one's area, are specks and not the person."""
WHITE = 0.98
"""A photo with nothing darker around the mask, beyond `REACH`, shows no background: there is nothing to find."""


def fit_mask(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], float]:
    """The mask with its outline at the photo's edges, and by how many pixels of the photo it was too large (negative: small).

    Arguments: image: the photo with its background, values in [0, 1]. mask: coverage in [0, 1].
    A mask that is empty, full or a line, off by less than `LEAST`, or of a photo without a background is kept, with 0.
    """
    rows, columns = (np.flatnonzero((mask >= 0.5).any(axis)) for axis in (1, 0))
    if not len(rows) or mask.min() >= 0.5 or min(mask.shape) < 2:
        return mask, 0.0
    unit = (rows[-1] + 1 - rows[0]) / PERSON_HEIGHT
    margin = int(np.ceil((REACH + 3 * STEP) * unit)) + 1
    window = tuple(slice(max(line[0] - margin, 0), line[-1] + 1 + margin) for line in (rows, columns))
    photo, own = image[window].astype(np.float32), mask[window].astype(np.float32)
    if photo[signed_distance(own) < -REACH * unit].min(initial=1.0) >= WHITE:
        return mask, 0.0
    reduced = min(1.0, MOST_PIXELS / (rows[-1] + 1 - rows[0]))
    height, width = own.shape
    size = max(1, round(reduced * width)), max(1, round(reduced * height))
    small = (resized(photo, *size), resized(own, *size)) if reduced < 1 else (photo, own)
    whole, moves = outline_moves(*small, reduced * unit)
    if abs(whole) < LEAST * reduced * unit:
        return mask, 0.0
    moves = resized(moves.astype(np.float32), width, height) / reduced
    moved = np.clip(signed_distance(own) - moves + 0.5, 0, 1)
    fitted = mask.copy()
    fitted[window] = np.where(np.abs(moves) > LEAST_MOVE * unit, moved, own)
    return fitted, whole / reduced


def outline_moves(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"], unit: float
) -> tuple[float, Float[np.ndarray, "h w"]]:
    """How far inside the mask's outline (pixels; negative: outside) the photo has its edges: on the whole, and near each pixel.

    unit: pixels of this image for one of a person `PERSON_HEIGHT` high.
    """
    distances = signed_distance(mask)
    normal = np.gradient(ndimage.gaussian_filter(distances, 1.0))
    slopes = np.gradient(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), axis=(0, 1))
    contrast = np.linalg.norm(slopes[0] * normal[0][..., None] + slopes[1] * normal[1][..., None], axis=-1)
    blurred = lambda values: ndimage.gaussian_filter(values, NEIGHBORHOOD * unit, truncate=2.5)
    best, moves, highest, whole = np.full(mask.shape, -np.inf), np.zeros(mask.shape), -np.inf, 0.0
    for step in np.arange(-REACH, REACH + STEP / 2, STEP) * unit:
        near = np.exp(-0.5 * ((distances - step) / (0.7 * STEP * unit)) ** 2)
        near[near < 1e-3] = 0
        everywhere = float(np.sum(contrast * near) / max(np.sum(near), 1e-6))
        here = blurred(contrast * near) / (blurred(near) + 1e-4) + everywhere
        moves, best = np.where(here > best, step, moves), np.maximum(here, best)
        if everywhere > highest:
            highest, whole = everywhere, float(step)
    return whole, ndimage.gaussian_filter(moves, SMOOTHING * unit)


def person_box(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "2 2"]:
    """`box_of` the person among the True pixels: the largest connected part, and others of at least `LEAST_PART` of its area."""
    parts, _ = ndimage.label(inside, np.ones((3, 3)))
    areas = np.bincount(parts.ravel())
    areas[0] = 0
    return box_of(inside & (areas >= LEAST_PART * areas.max())[parts])


def box_of(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "2 2"]:
    """First row and the one after the last, then columns, of the True pixels; zeros if there are none."""
    lines = [np.flatnonzero(inside.any(axis)) for axis in (1, 0)]
    return np.asarray([(line[0], line[-1] + 1) if len(line) else (0, 0) for line in lines])


def signed_distance(mask: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Pixels from the outline, positive inside; where the mask is neither 0 nor 1, its values say how far."""
    inside = mask >= 0.5
    whole = np.where(
        inside, ndimage.distance_transform_edt(inside) - 0.5, 0.5 - ndimage.distance_transform_edt(~inside)
    )
    partly = (mask > 0.02) & (mask < 0.98) & (np.abs(whole) < 1.01)
    return np.where(partly, mask - 0.5, whole)
