"""Corrects masks that are too large or too small: their silhouettes are moved to the edges in the
photos.

Segmentation leaves silhouettes that are some pixels off. A pixel too much shows the background at
the person's rim, and a pixel too little cuts the person. All photos have the same fault, so no
later stage can find it. Here the photo is searched along the normals of the silhouette for the
distance at which the colors change most, on average over the silhouette and near each of its
points.

A stripe along the rim may look like the background (rim light before a bright wall, piping). Its
inner side is then a stronger edge than the rim. So the silhouette is divided into sectors. A mask
is moved only if enough sectors, in its view and in all views, have an edge where the silhouette
would move to, and no edge where the mask ends now.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.io.images import resized

PERSON_HEIGHT = 200
"""Height of the person in units. Most lengths below are in units. A unit is a pixel if the person
is this many pixels high.
"""
REACH = 4.0
"""Largest distance by which a silhouette is moved, in units (see `PERSON_HEIGHT`)."""
STEP = 0.5
"""Distance between the moves that are tried, in units (see `PERSON_HEIGHT`)."""
NEIGHBORHOOD = 4.0
"""The move at a point depends on the colors along the silhouette around it. They are weighted by a
Gaussian with this standard deviation, in units (see `PERSON_HEIGHT`).
"""
SMOOTHING = 2.0
"""Standard deviation of the Gaussian that smooths the moves, in units (see `PERSON_HEIGHT`)."""
LEAST = 0.75
"""A mask stays as it is if its silhouette is off by less than this on average, in units (see
`PERSON_HEIGHT`). A move would only make exact masks worse (docs/stability.md).
"""
LEAST_MOVE = 0.5
"""Parts of the silhouette that would move by less than this stay where they are, in units (see
`PERSON_HEIGHT`).
"""
MOST_PIXELS = 400
"""Largest height of the person in the image that is searched, pixels. If the person is higher in
the photo, the photo is reduced.
"""
LEAST_PART = 0.005
"""Connected parts of a mask that have less than this share of the largest part's area are specks
and not the person.
"""
WHITE = 0.98
"""A photo shows no background if no pixel farther than `REACH` outside of the mask has a channel
below this. No edge can then be found.
"""
SECTORS = 16
"""Largest number of sectors. Sectors divide the silhouette by the angle about its middle, and have
equally many points.
"""
SECTOR_POINTS = 8
"""The least number of points of a sector. Where points are few, there are fewer sectors."""
AGREE = 0.7
"""A mask is moved only if at least this share of the votes is for the move. The votes of all views
that would be moved in the same direction are counted. Sectors vote, see `_sector_votes`.
"""
AGREE_ALONE = 0.5
"""A mask is moved only if at least this share of the votes of its own view is for the move."""
EDGE = 0.06
"""There is an edge where the mask ends if the colors change enough across this end. The change must
be more than (1 + `OF_TEXTURE`) times the change beside it plus `EDGE` times the strongest change in
the sector.
"""
OF_TEXTURE = 1.0
"""Weight of the change of colors beside an edge, see `EDGE`."""
SEEN_APART = 1.5
"""A sector votes for a move only if its edge is at most this many units away from where the
silhouette would move to. An edge where the mask ends is looked for only if the mask is off by at
least this many pixels of the image that is searched.
"""
CLEAR = 1.3
"""Colors are not blurred by an edge that is at least this far away, pixels."""
THIN = 0.0007
"""Largest area of the thin parts of a mask, divided by the area that the mask would lose, see
`_thin_parts`. The mean over all views that would be moved in the same direction counts. If it is
larger, none of these masks is moved.
"""


class _Shift(NamedTuple):
    """The correction of a mask that a photo suggests.

    excess: by how many pixels the mask is too large (negative: too small; 0: it stays). moves: the
    excess near each pixel of `window`, pixels. unit: pixels per unit, see `PERSON_HEIGHT`. votes:
    the number of sectors for and against the correction. thin: what `_thin_parts` returns.
    """

    excess: float
    window: tuple[slice, ...] = ()
    moves: np.ndarray = np.zeros((0, 0), np.float32)
    unit: float = 1.0
    votes: tuple[int, int] = (0, 0)
    thin: float = 0.0


class _Seen(NamedTuple):
    """The colors of a photo at n points along the silhouette, all at one depth. Or the change of
    these colors from one depth to another (`_change`).

    values: the colors of the points, (n, 3), or the distances between their colors at the two
    depths, (n,). counts: whether a point counts, (n,).
    """

    values: np.ndarray
    counts: np.ndarray


class _Edge(NamedTuple):
    """The strongest edge of a sector.

    depth: how far inside of the silhouette it is, pixels. change: the mean change of colors across
    it. clear: whether the change is at least twice the median of the changes at all depths.
    """

    depth: float
    change: float
    clear: bool


def masks_at_edges(
    images: Sequence[Float[np.ndarray, "_h _w 3"]], masks: Sequence[Float[np.ndarray, "_h _w"]]
) -> list[tuple[Float[np.ndarray, "_h _w"], float]]:
    """Returns each mask with its silhouette moved to the photo's edges, and by how many pixels of
    the photo it was too large (negative: too small).

    Arguments: images: the photos of one person with their background, values in [0, 1]. masks:
    coverage in [0, 1].

    A mask stays as it is, with 0, in these cases:

    - It is empty or full, it is only one pixel wide or high, or its photo shows no background.
    - It is off by less than `LEAST`.
    - Too small a share of the sectors votes for the move, in its view (`AGREE_ALONE`) or in all
      views that are off in the same direction (`AGREE`).
    - Fewer than half of the views, without those of the first case, are off in this direction.
    - The masks that are off in this direction have too many thin parts (`THIN`).
    """
    found = [_shift(image, mask) for image, mask in zip(images, masks, strict=True)]
    seen = [shift for shift in found if shift is not None]
    fitted = []
    for mask, shift in zip(masks, found, strict=True):
        if shift is None or not _believed(shift, seen):
            fitted.append((mask, 0.0))
        else:
            fitted.append((_moved(mask, shift), shift.excess))
    return fitted


def _believed(shift: _Shift, seen: Sequence[_Shift]) -> bool:
    """Returns whether a shift corrects the mask, and does not follow edges within the person. seen:
    the shifts of all views in which one was looked for.
    """
    alike = [other for other in seen if other.excess * shift.excess > 0]
    if not alike or 2 * len(alike) < len(seen) or np.mean([other.thin for other in alike]) > THIN:
        return False

    def share(votes):
        return votes[0] / max(sum(votes), 1)

    return bool(
        share(shift.votes) >= AGREE_ALONE
        and share(np.sum([other.votes for other in alike], axis=0)) >= AGREE
    )


def _moved(mask: Float[np.ndarray, "h w"], shift: _Shift) -> Float[np.ndarray, "h w"]:
    """Returns the mask with its silhouette moved to the photo's edges."""
    own = mask[shift.window].astype(np.float32)
    moved = np.clip(signed_distance(own) - shift.moves + 0.5, 0, 1)
    fitted = mask.copy()
    fitted[shift.window] = np.where(np.abs(shift.moves) > LEAST_MOVE * shift.unit, moved, own)
    return fitted


def _shift(image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"]) -> _Shift | None:
    """Returns the correction that one photo suggests; None where nothing can be found."""
    (top, bottom), _ = box = person_box(mask >= 0.5)
    if not bottom or mask.min() >= 0.5 or min(mask.shape) < 2:
        return None
    unit = (bottom - top) / PERSON_HEIGHT
    margin = int(np.ceil((REACH + 3 * STEP) * unit)) + 1
    window = tuple(slice(max(first - margin, 0), end + margin) for first, end in box.tolist())
    photo, own = image[window].astype(np.float32), mask[window].astype(np.float32)
    if photo[signed_distance(own) < -REACH * unit].min(initial=1.0) >= WHITE:
        return None
    reduced = min(1.0, MOST_PIXELS / (bottom - top))
    height, width = own.shape
    size = max(1, round(reduced * width)), max(1, round(reduced * height))
    if reduced < 1:
        small = resized(photo, *size), resized(own, *size)
    else:
        small = photo, own
    whole, moves = _boundary_moves(*small, reduced * unit)
    if abs(whole) < LEAST * reduced * unit:
        return _Shift(0.0)
    moves = resized(moves.astype(np.float32), width, height) / reduced
    votes = _sector_votes(*small, whole, reduced * unit)
    return _Shift(
        whole / reduced, window, moves, unit, votes, _thin_parts(own, whole / reduced / unit)
    )


def _boundary_moves(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"], unit: float
) -> tuple[float, Float[np.ndarray, "h w"]]:
    """Returns how far inside the mask's silhouette the photo has its edges, pixels (negative:
    outside). The first result is one number for the whole silhouette, the second a number near each
    pixel, (h, w).

    unit: pixels of this image per unit, see `PERSON_HEIGHT`.
    """
    distances = signed_distance(mask)
    normal = np.gradient(ndimage.gaussian_filter(distances, 1.0))
    slopes = np.gradient(ndimage.gaussian_filter(image, (0.7, 0.7, 0)), axis=(0, 1))
    contrast = np.linalg.norm(
        slopes[0] * normal[0][..., None] + slopes[1] * normal[1][..., None], axis=-1
    )

    def blurred(values):
        return ndimage.gaussian_filter(values, NEIGHBORHOOD * unit, truncate=2.5)

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


def _sector_votes(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"], whole: float, unit: float
) -> tuple[int, int]:
    """Returns the numbers of sectors for and against a move. A sector is against the move if there
    is an edge where the mask ends, or if the strongest edge of the sector is at the mask's end, or
    is not about `whole` pixels inside of it. Otherwise the sector is for the move.

    A sector does not count in three cases: it has neither a clear edge nor an edge where the mask
    ends, both sides of the mask's end are white, or too few of its points count.
    """
    distances = signed_distance(mask)
    # points on the end of the mask, with the direction inwards
    normal = np.stack(np.gradient(ndimage.gaussian_filter(distances, 1.0)))
    pixels = np.nonzero(np.abs(distances) < 0.5)
    if not len(pixels[0]):
        return 0, 0
    normal = normal[:, *pixels] / np.maximum(np.linalg.norm(normal[:, *pixels], axis=0), 1e-6)
    points = np.stack(pixels) - distances[pixels] * normal
    # sectors have equal numbers of points, by their angles about the middle
    angles = np.arctan2(*(points - points.mean(axis=1, keepdims=True)))
    count = max(1, min(SECTORS, len(angles) // SECTOR_POINTS))
    sectors = np.argsort(np.argsort(angles)) * count // len(angles)

    def colors(depth: float) -> _Seen:
        """Returns the colors `depth` pixels inside of the points."""
        return _colors_at(image, distances, points + depth * normal, depth)

    edges = _sector_edges(colors, sectors, count, unit)
    # on both sides of the mask's end, then two steps farther, where a mask that is off has no edge
    lag = min(unit, max(abs(whole) - CLEAR, 0.5))
    ends = [colors(-np.sign(whole) * lag * i) for i in (-1, 1, 3, 5)]
    return _votes(edges, ends, sectors, whole, unit)


def _colors_at(
    image: Float[np.ndarray, "h w 3"],
    distances: Float[np.ndarray, "h w"],
    places: Float[np.ndarray, "2 n"],
    depth: float,
) -> _Seen:
    """Returns the colors at places (rows, columns) that should be `depth` pixels inside of the
    silhouette. Places beyond the middle of a limb or outside of the image do not count.

    distances: see `signed_distance`.
    """

    def sample(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " n"]:
        return ndimage.map_coordinates(values, places, order=1, mode="nearest")

    last_pixel = np.subtract(distances.shape, 1)[:, None]
    framed = ((places >= 0) & (places <= last_pixel)).all(axis=0)
    before_middle = np.abs(sample(distances) - depth) < 0.75
    colors = np.stack([sample(image[..., channel]) for channel in range(3)], axis=-1)
    return _Seen(colors, before_middle & framed)


def _change(one: _Seen, other: _Seen) -> _Seen:
    """Returns how much the colors of each point differ. A point counts if it does at both
    depths.
    """
    return _Seen(np.linalg.norm(one.values - other.values, axis=-1), one.counts & other.counts)


def _sector_edges(
    colors: Callable[[float], _Seen], sectors: Int[np.ndarray, " n"], count: int, unit: float
) -> list[_Edge]:
    """Returns the edge of each of the `count` sectors: where colors change most from one step
    outside of a depth to one step inside of it.

    colors: returns the colors of the points at a depth, pixels. sectors: the sector of each point,
    (n,), from 0.
    """
    depths = np.arange(-REACH, REACH + STEP / 2, STEP) * unit
    line = [colors(depths[0] - STEP * unit)]
    line += [colors(depth) for depth in depths]
    line += [colors(depths[-1] + STEP * unit)]
    profile = np.zeros((count, len(depths)))
    for i in range(len(depths)):
        change = _change(line[i], line[i + 2])  # line[i + 1] is at the depth
        own = sectors[change.counts]
        total = np.bincount(own, change.values[change.counts], count)
        profile[:, i] = total / np.maximum(np.bincount(own, minlength=count), 1)
    edges = []
    for changes in profile:
        highest = changes.max()
        edges.append(_Edge(depths[changes.argmax()], highest, highest >= 2 * np.median(changes)))
    return edges


def _votes(
    edges: Sequence[_Edge],
    ends: Sequence[_Seen],
    sectors: Int[np.ndarray, " n"],
    whole: float,
    unit: float,
) -> tuple[int, int]:
    """Returns the numbers of sectors for and against a move, see `_sector_votes`.

    edges: the edge of each sector. ends: the colors on both sides of the mask's end, then at two
    more depths beside it. sectors: the sector of each point, (n,).
    """
    across, *textures = [_change(one, other) for one, other in itertools.pairwise(ends)]
    votes_for = votes_against = 0
    for sector, edge in enumerate(edges):
        own = sectors == sector
        # where both sides are white, or too few points count, the photo says nothing
        counted = across.counts & own
        if 2 * counted.sum() < SECTOR_POINTS:
            continue
        if all(np.median(side.values[counted].min(axis=-1)) >= WHITE for side in ends[:2]):
            continue

        # there is an edge at the mask's end if it stands out from the texture beside it
        texture = np.concatenate([beside.values[beside.counts & own] for beside in textures])
        least = np.inf
        if len(texture):
            least = (1 + OF_TEXTURE) * np.median(texture) + EDGE * edge.change
        at_end = abs(whole) >= SEEN_APART and np.median(across.values[counted]) > least

        if not (at_end or edge.clear):
            continue
        elsewhere = abs(edge.depth - whole) > SEEN_APART * unit
        too_near = abs(edge.depth) <= LEAST
        if at_end or elsewhere or too_near:
            votes_against += 1
        else:
            votes_for += 1
    return votes_for, votes_against


def _thin_parts(mask: Float[np.ndarray, "h w"], excess: float) -> float:
    """Returns the area of a mask's thin parts, divided by the area that the mask would lose. Thin
    parts are narrower than every part of a mask that has grown by `excess`. The result is 0 if
    `excess` is not positive. excess: in units, see `PERSON_HEIGHT`.

    A silhouette that has grown by some distance has no part thinner than twice that distance. A
    mask with thin fingers has not grown.
    """
    if excess <= 0:
        return 0.0
    top, bottom = person_box(mask >= 0.5)[0]
    scale = MOST_PIXELS / (bottom - top)
    inside = resized(mask, *(max(1, round(scale * side)) for side in mask.shape[::-1])) >= 0.5
    radius = excess * MOST_PIXELS / PERSON_HEIGHT
    depth = ndimage.distance_transform_edt(inside)
    grown = ndimage.distance_transform_edt(depth <= 0.65 * radius) <= 0.65 * radius + 2
    return float((inside & ~grown).sum() / max(1.0, radius * (inside & (depth <= 1)).sum()))


def person_box(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "2 2"]:
    """Returns `box_of` the person among the True pixels: the largest connected part, and others of
    at least `LEAST_PART` of its area.
    """
    parts, _ = ndimage.label(inside, np.ones((3, 3)))
    areas = np.bincount(parts.ravel())
    areas[0] = 0
    return box_of(inside & (areas >= LEAST_PART * areas.max())[parts])


def box_of(inside: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "2 2"]:
    """Returns the box of the True pixels: ((first row, row after the last), (first column, column
    after the last)); zeros if there are none.
    """
    box = np.zeros((2, 2), int)
    for i, axis in enumerate((1, 0)):
        line = np.flatnonzero(inside.any(axis))
        if len(line):
            box[i] = line[0], line[-1] + 1
    return box


def signed_distance(mask: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Returns the distance of each pixel from the silhouette, pixels, positive inside. Along the
    silhouette the values of the mask between 0 and 1 give the distance.
    """
    inside = mask >= 0.5
    whole = np.where(
        inside,
        ndimage.distance_transform_edt(inside) - 0.5,
        0.5 - ndimage.distance_transform_edt(~inside),
    )
    partly = (mask > 0.02) & (mask < 0.98) & (np.abs(whole) < 1.01)
    return np.where(partly, mask - 0.5, whole)


# Rims
# --------------------------------------------------------------------------------------------------
# Along the edge of a mask a photo mixes the person with the room, and on white the mixture would be
# the person's.

RIM_HEIGHT = 440
"""Height of the person in units. `DEPTH` and `SPREAD` are in these units."""
DEPTH = 2.0
"""Pixels outside the mask, and pixels inside that are nearer to its edge than this, are cleaned.
The cleaning compares two means: the color of the person at least this far inside, and the color of
the background at least this far outside. In units, see `RIM_HEIGHT`.
"""
SPREAD = 1.5
"""Standard deviation of the Gaussian that weights the two means (see `DEPTH`), in units (see
`RIM_HEIGHT`).
"""
LEAST_WEIGHT = 1e-3
"""Least weight of the pixels that are at least `DEPTH` inside of the mask. Where the weight is
less, the rim stays as it is. Fingers, for example, are too thin to have such pixels.
"""
CONTRAST = 0.02
"""A pixel may be cleaned if the two means (see `DEPTH`) are farther apart than this, as points in
RGB with values in [0, 1].
"""
CERTAIN = 0.15
"""A pixel is cleaned if the background's share in its color is more than this."""


def clean_rims(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Returns a photo in which the background's share is removed from the colors of pixels along
    and outside of the mask's edge.

    The share says where a pixel's color lies between two means: the color farther inside of the
    mask and the color farther outside. The difference of the means, times the share, is subtracted
    from the pixel. All other detail stays.
    """
    inside = mask > 0.5
    if not inside.any() or inside.all():
        return image
    low, high = person_box(inside)[0]
    unit = (high - low) / RIM_HEIGHT
    margin = int(np.ceil(4 * (DEPTH + SPREAD) * unit)) + 1
    window = tuple(
        slice(max(first - margin, 0), end + margin) for first, end in box_of(mask > 0).tolist()
    )
    own, depth = image[window].astype(np.float32), _depth(inside[window])
    (person, known), (room, _) = (
        _blurred(own, side * depth >= DEPTH * unit, SPREAD * unit) for side in (1, -1)
    )
    toward = room - person
    apart = (toward**2).sum(-1)
    mixed = np.clip(((own - person) * toward).sum(-1) / np.maximum(apart, CONTRAST**2), 0, 1)
    mixed = np.where((mixed > CERTAIN) & (apart > CONTRAST**2), mixed, 0)
    # what is not inside at all has nothing of the person that could be kept
    share = np.where(known, np.clip(DEPTH * unit - depth + 0.5, 0, 1), 0) * mixed
    cleaned = image.copy()
    cleaned[window] = np.clip(own - share[..., None] * toward, 0, 1)
    return cleaned


def _depth(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Returns the distance of each pixel's centre to the edge of the mask, pixels, negative
    outside. The border of the photo does not count as an edge.
    """

    def of(part):
        if part.any():
            return ndimage.distance_transform_edt(np.pad(part, 1, mode="edge"))[1:-1, 1:-1]
        return 0

    return np.where(inside, of(inside) - 0.5, 0.5 - of(~inside))


def _blurred(
    colors: Float[np.ndarray, "h w 3"], where: Bool[np.ndarray, "h w"], sigma: float
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Returns the mean color of the True pixels around each pixel, weighted by a Gaussian, and
    whether their weight is at least `LEAST_WEIGHT`.
    """

    def blur(values):
        return ndimage.gaussian_filter(
            values.astype(np.float32), sigma, truncate=4.0, mode="nearest"
        )

    weight = blur(where)
    found = np.stack([blur(colors[..., i] * where) for i in range(3)], axis=-1)
    return found / np.maximum(weight, LEAST_WEIGHT)[..., None], weight >= LEAST_WEIGHT
