"""Clean rims: along the edge of a mask a photo mixes the person with the room, and on white the mixture would be the person's."""

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Float
from humangs_jax.data.masks import box_of, person_box

PERSON_HEIGHT = 440
"""Lengths below are in pixels of a person who is that high."""
DEPTH, SPREAD = 2.0, 1.5
"""Pixels that are nearer to the edge than the first are cleaned, by the means of what lies further inside and further outside,
weighted by a Gaussian of the second."""
LEAST = 1e-3
"""Weight of what lies further inside below which there is nothing: of fingers, which are thinner, the rim stays as it is."""
CONTRAST, CERTAIN = 0.02, 0.15
"""A pixel is taken for a mixture where the means differ by more than the first, if the room's share exceeds the second."""


def clean_rims(image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """A photo without the room's share in the pixels along the edge of the mask, and beyond: what they have of the difference
    between the colors further outside and further inside is taken away, and all other detail stays.
    """
    inside = mask > 0.5
    if not inside.any() or inside.all():
        return image
    low, high = person_box(inside)[0]
    unit = (high - low) / PERSON_HEIGHT
    margin = int(np.ceil(4 * (DEPTH + SPREAD) * unit)) + 1
    window = tuple(slice(max(first - margin, 0), end + margin) for first, end in box_of(mask > 0).tolist())
    own, depth = image[window].astype(np.float32), _depth(inside[window])
    (person, known), (room, _) = (_blurred(own, side * depth >= DEPTH * unit, SPREAD * unit) for side in (1, -1))
    toward = room - person
    apart = (toward**2).sum(-1)
    mixed = np.clip(((own - person) * toward).sum(-1) / np.maximum(apart, CONTRAST**2), 0, 1)
    mixed = np.where((mixed > CERTAIN) & (apart > CONTRAST**2), mixed, 0)
    # what is not inside at all has nothing of the person that could be kept
    share = np.where(known, np.clip(DEPTH * unit - depth + 0.5, 0, 1), 0) * mixed
    cleaned = image.copy()
    cleaned[window] = np.clip(own - share[..., None] * toward, 0, 1)
    return cleaned


def _depth(inside):
    """Pixels from each pixel's centre to the edge, negative outside; the photo's own border is no edge of the person."""
    of = lambda part: ndimage.distance_transform_edt(np.pad(part, 1, mode="edge"))[1:-1, 1:-1] if part.any() else 0
    return np.where(inside, of(inside) - 0.5, 0.5 - of(~inside))


def _blurred(colors, where, sigma):
    """The mean color of what is nearby and True, and whether there is anything."""
    blur = lambda values: ndimage.gaussian_filter(values.astype(np.float32), sigma, truncate=4.0, mode="nearest")
    weight = blur(where)
    found = np.stack([blur(colors[..., i] * where) for i in range(3)], axis=-1)
    return found / np.maximum(weight, LEAST)[..., None], weight >= LEAST
