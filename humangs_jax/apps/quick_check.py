"""Whether the photos, masks, cameras and poses of a capture belong together, in a fraction of a second.

The posed body is drawn as points into coarse silhouettes by numpy: nothing is compiled. Silhouettes that are not where the masks
are get explained by the mistakes that people make. `humangs reconstruct` and `refine` look first; `check` draws the whole sheet.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from humangs_jax.core.array_types import Bool
from humangs_jax.data.capture import Capture
from humangs_jax.data.surface_points import points_in_image, surface_points

LEAST_IOU = 0.5
"""Clothes and hair cover about a fifth of a silhouette that the body does not; half means another pose or camera."""
SURELY_IOU = 0.6
"""From here on a mistake that was undone explains a view."""
LEAST_INSIDE, SURELY_INSIDE = 0.5, 0.9
"""Share of the vertices in the frame: below the first it is a warning, the second is asked of an explanation."""
GRID = 64
"""Cells of a silhouette along the longer side of the image."""
POINTS = 6000
"""On the surface of the body: several for each cell that it covers."""
VIEWS = 24
"""Most views that are looked at, evenly chosen."""
LONGEST_TURN = 2 * math.pi + 0.5
"""Radians: rotation vectors are at most half a turn, and a whole one where someone counted on; degrees are far beyond."""
BETTER = 0.1
"""IoU by which an exchange has to explain each view better than the capture does."""
DARKEST, BURNT = 0.12, 0.98
"""A photo is too dark if 98 % of the person's values are below the first, and burnt out if 60 % are above the second."""
NAMED = 4
"""Views that are named in a warning; the others are counted."""

_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Points of a y-up world -> points of a z-up world."""


def _moved(offset):
    return np.block([[np.eye(3), np.reshape(offset, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


MISTAKES = {
    "cam_from_world is the inverse (world_from_cam, camera to world)": lambda m, t: np.linalg.inv(m),
    "the camera looks along -z with y up (OpenGL, Blender, NeRF): negate rows 2 and 3 of cam_from_world": (
        lambda m, t: _FLIP @ m
    ),
    "the matrix is camera to world in OpenGL's convention (NeRF, Blender): invert it, then negate rows 2 and 3": (
        lambda m, t: _FLIP @ np.linalg.inv(m)
    ),
    "the camera's translation is in millimetres": lambda m, t: np.block([[m[:3, :3], m[:3, 3:] / 1000], [m[3:]]]),
    "the body's translation is in millimetres": lambda m, t: m @ _moved(t / 1000 - t),
    "the cameras stand in a world with z up: multiply cam_from_world by (x, y, z) -> (x, -z, y) from the right": (
        lambda m, t: m @ _FROM_Y_UP
    ),
}
"""Usual mistakes, and the correct cam_from_world from the given one and the body's translation."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Views:
    """What is compared, in numpy: JAX would compile each of the small operations.

    points: on the skin, by frame. masks: cells of each view, or None. exposures: see `_exposure`.
    largest: the longest rotation vector of all poses.
    """

    names: tuple[str, ...]
    frames: list[int]
    points: dict[int, np.ndarray]
    masks: list[np.ndarray] | None
    exposures: list[str | None]
    K: np.ndarray
    cam_from_world: np.ndarray
    translations: np.ndarray
    width: int
    height: int
    largest: float


def likely_mistakes(capture: Capture) -> tuple[str, ...]:
    """Warnings, one line each, about what looks wrong in a capture; of what concerns all of it first."""
    views = _views(capture)
    whole, explained = _whole_capture(views)
    return (*whole, *_single_views(views, explained))


def whole_capture_mistakes(capture: Capture) -> tuple[str, ...]:
    """Mistakes that no view shows by itself: poses in degrees, cameras of other views."""
    return _whole_capture(_views(capture))[0]


def _views(capture) -> _Views:
    chosen = np.unique(
        np.linspace(0, capture.view_count - 1, min(capture.view_count, VIEWS)).round().astype(int)
    ).tolist()
    rotations = np.asarray(capture.poses.rotations, float)
    translations = np.asarray(capture.poses.translation, float)
    frames, masks = [int(capture.frames[i]) for i in chosen], capture.masks
    return _Views(
        names=tuple(capture.names[i] for i in chosen),
        frames=frames,
        points=surface_points(capture.body, np.asarray(capture.betas), rotations, translations, frames, POINTS),
        masks=None if masks is None else [_mask_cells(np.asarray(masks[i])) for i in chosen],
        exposures=[_exposure(capture.images[i], None if masks is None else masks[i]) for i in chosen],
        K=np.asarray(capture.cameras.K, float)[chosen],
        cam_from_world=np.asarray(capture.cameras.cam_from_world, float)[chosen],
        translations=translations,
        width=capture.cameras.width,
        height=capture.cameras.height,
        largest=float(np.linalg.norm(rotations, axis=-1).max()),
    )


def _whole_capture(views):
    """The mistakes, and the views that they explain."""
    if views.largest > LONGEST_TURN:
        degrees = f"the poses seem to be in degrees: rotations up to {views.largest:.0f}, expected radians"
        return (degrees,), set(range(len(views.names)))
    exchanged = _exchanged_cameras(views)
    if not exchanged:
        return (), set()
    pairs = [f"{views.names[i]} by the camera of {views.names[j]}" for i, j in exchanged.items()]
    return (f"cameras are exchanged: the body would fit {_listed(pairs)}",), set(exchanged)


def _exposure(image, mask) -> str | None:
    """What is wrong with a photo on which the person is nearly black or burnt out: nothing is to be seen there."""
    person = image if mask is None else image[mask > 0.99]  # without its blended edge
    if person.size and np.quantile(person, 0.98) < DARKEST:
        return "the person is nearly black; is the photo underexposed, or were its values divided by 255 twice"
    if person.size and mask is not None and np.quantile(person, 0.4) > BURNT:
        return "most of the person is white; is the photo overexposed"
    return None


def _exchanged_cameras(views) -> dict[int, int]:
    """For views that fit the camera of another one: that one. An exchange has to explain all of its views."""
    if views.masks is None:
        return {}
    drawn = lambda i, j: _silhouette(views, i, camera=j)[0]
    own = [_overlap(drawn(i, i), mask) for i, mask in enumerate(views.masks)]
    off = [i for i, overlap in enumerate(own) if overlap < SURELY_IOU]
    if len(off) < 2:
        return {}
    overlaps = np.array([[_overlap(drawn(i, j), views.masks[i]) for j in off] for i in off])
    from scipy.optimize import linear_sum_assignment  # takes longer to import than all else here to compute

    chosen = linear_sum_assignment(-overlaps)[1].tolist()
    found = {off[row]: (off[column], overlaps[row, column]) for row, column in enumerate(chosen) if row != column}
    explains = all(overlap > max(SURELY_IOU, own[i] + BETTER) for i, (_, overlap) in found.items())
    mirrored = [_overlap(drawn(i, i)[:, ::-1], views.masks[i]) for i in found]  # explains views around a person as well
    if not explains or sum(mirrored) >= sum(overlap for _, overlap in found.values()):
        return {}
    return {i: j for i, (j, _) in found.items()}


def _single_views(views, explained) -> Iterator[str]:
    """One warning for each cause, naming its views."""
    found: dict[str, list[str]] = {}
    for i, name in enumerate(views.names):
        if i not in explained and (problem := _problem(views, i)):
            found.setdefault(problem, []).append(name)
    for problem, names in found.items():
        yield f"{problem}: view {_listed(names)}"


def _problem(views, i):
    """What is wrong with a view, None if nothing is to be seen."""
    covered, inside = _silhouette(views, i)
    mask = None if views.masks is None else views.masks[i]
    if mask is not None and not mask.any():
        return "the mask is empty"
    own = None if mask is None else _overlap(covered, mask)
    if inside >= LEAST_INSIDE and (own is None or own >= LEAST_IOU):
        return views.exposures[i]
    told = "most of the body is outside the frame" if own is None else "body and mask do not agree"
    cause = _cause(views, i, covered, mask)
    return told if cause is None else f"{told}; they would if {cause}"


def _cause(views, i, covered, mask):
    """The mistake that, undone, explains a view."""
    tried = {}
    if mask is not None:
        tried["the mask is inverted"] = _overlap(covered, ~mask)
        tried["the photo is mirrored"] = _overlap(covered[:, ::-1], mask)
    for mistake, undo in MISTAKES.items():
        matrix = undo(views.cam_from_world[i], views.translations[views.frames[i]])
        drawn, inside = _silhouette(views, i, matrix=matrix)
        if inside > SURELY_INSIDE:
            tried[mistake] = 1.0 if mask is None else _overlap(drawn, mask)
    best = max(tried, key=lambda mistake: tried[mistake], default=None)
    if best is None or tried[best] <= SURELY_IOU or (mask is None and len(tried) > 1):
        return None
    return best


# Coarse silhouettes ---------------------------------------------------------------------------------------------------


def _silhouette(views, i, camera=None, matrix=None) -> tuple[Bool[np.ndarray, "rows columns"], float]:
    """The cells that the body of view i covers, and the share of its points in the image.

    Arguments: camera: of which view, None: its own. matrix: in place of that camera's.
    """
    camera = i if camera is None else camera
    matrix = views.cam_from_world[camera] if matrix is None else matrix
    points = views.points[views.frames[i]]
    pixels = points_in_image(points, views.K[camera], matrix, views.width, views.height)
    shape, cell = _shape(views.width, views.height), _cell(views.width, views.height)
    covered = np.zeros(shape, bool)
    column, row = np.minimum((pixels / cell).astype(int), np.asarray(shape[::-1]) - 1).T
    covered[row, column] = True
    return _closed(covered), len(pixels) / len(points)


def _closed(cells):
    """Without the gaps of one cell between the points of a surface: dilated, then eroded."""
    wide = np.pad(cells, 2)
    grown = np.logical_or.reduce([np.roll(wide, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)])
    closed = np.logical_and.reduce([np.roll(grown, (y, x), (0, 1)) for y in (-1, 0, 1) for x in (-1, 0, 1)])
    return closed[2:-2, 2:-2]


def _mask_cells(mask) -> Bool[np.ndarray, "rows columns"]:
    """The cells whose centres the mask has."""
    height, width = mask.shape
    rows, columns = _shape(width, height)
    cell = _cell(width, height)
    at = lambda count, most: np.minimum(((np.arange(count) + 0.5) * cell).astype(int), most - 1)
    return mask[at(rows, height)][:, at(columns, width)] > 0.5


def _cell(width, height):
    """Side of a cell in pixels."""
    return max(width, height) / GRID


def _shape(width, height):
    cell = _cell(width, height)
    return max(1, round(height / cell)), max(1, round(width / cell))


def _overlap(a, b):
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 0.0


def _listed(names):
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
