"""What is wrong with a capture: whether its photos, masks, cameras and poses belong together, in a fraction of a second.

The posed body is drawn as points into coarse silhouettes by numpy: nothing is compiled. Where a silhouette is not on its mask,
mistakes that people make are undone on trial, and the one that explains it is named. `humangs reconstruct` and `refine` look
first; `humangs check` and `start` draw a sheet as well (`apps.check`).
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.body_and_masks import points_in_image, surface_points
from humangs_jax.data.calibration.calibration import (
    CAM_FROM_WORLD_OPENGL,
    CONVENTIONS,
    ROTATION_TO_Y_UP,
    WORLD_FROM_CAM,
    WORLD_FROM_CAM_OPENGL,
    pose_matrix,
)
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import few

LEAST_IOU = 0.5
"""Clothes and hair cover about a fifth of a silhouette that the body does not; half means another pose or camera."""
SURELY_IOU = 0.6
"""From here on a mistake that was undone explains a view."""
LEAST_INSIDE, SURELY_INSIDE = 0.5, 0.9
"""Share of the points in the frame: below the first it is a warning, the second is asked of an explanation."""
LEAST_HEIGHT = 0.05
"""Share of the image's height: a body smaller than this has its lengths in another unit."""
GRID = 64
"""Cells of a silhouette along the longer side of the image."""
POINTS = 6000
"""On the surface of the body: several for each cell that it covers."""
VIEWS = 24
"""Most views that are looked at before a reconstruction, evenly chosen."""
LONGEST_TURN = 2 * math.pi + 0.5
"""Radians: rotation vectors are at most half a turn, and a whole one where someone counted on; degrees are far beyond."""
BETTER = 0.1
"""IoU by which an exchange has to explain each view better than the capture does."""
DARKEST, BURNT = 0.12, 0.98
"""A photo is too dark if 98 % of the person's values are below the first, and burnt out if 60 % are above the second."""

Matrix = Float[np.ndarray, "4 4"]
Cells = Bool[np.ndarray, "rows columns"]
_TO_Y_UP = pose_matrix(np.asarray(ROTATION_TO_Y_UP["+z"], float), np.zeros(3))
MISTAKES: dict[str, Callable[[Matrix, Float[np.ndarray, "3"]], Matrix]] = {
    "cam_from_world is the inverse (world_from_cam, camera to world)": lambda m, t: CONVENTIONS[WORLD_FROM_CAM](m),
    "the camera looks along -z with y up (OpenGL, Blender, NeRF): negate rows 2 and 3 of cam_from_world": (
        lambda m, t: CONVENTIONS[CAM_FROM_WORLD_OPENGL](m)
    ),
    "the matrix is camera to world in OpenGL's convention (NeRF, Blender): invert it, then negate rows 2 and 3": (
        lambda m, t: CONVENTIONS[WORLD_FROM_CAM_OPENGL](m)
    ),
    "the camera's translation is in millimetres": lambda m, t: pose_matrix(m[:3, :3], m[:3, 3] / 1000),
    "the body's translation is in millimetres": lambda m, t: m @ pose_matrix(np.eye(3), t / 1000 - t),
    "the cameras stand in a world with z up: multiply cam_from_world by (x, y, z) -> (x, -z, y) from the right": (
        lambda m, t: m @ _TO_Y_UP.T
    ),
}
"""What people do wrong, and the correct cam_from_world from the given one and the body's translation."""
MISTAKES_OF_IMAGES: dict[str, Callable[[Cells, Cells], tuple[Cells, Cells]]] = {
    "the mask is inverted": lambda body, mask: (body, ~mask),
    "the photo is mirrored": lambda body, mask: (body[:, ::-1], mask),
}
"""The same for silhouettes of body and mask."""


@dataclasses.dataclass(frozen=True)
class ViewFault:
    """What is wrong with a view."""

    problem: str | None
    """A line; None: nothing."""
    inside: float
    """Share of the body in the frame."""


def likely_mistakes(capture: Capture) -> tuple[str, ...]:
    """Warnings, one line each, about what looks wrong in a capture; of what concerns all of it first."""
    some = np.unique(np.linspace(0, capture.view_count - 1, min(capture.view_count, VIEWS)).round().astype(int))
    views = _Views.of(capture.select(some))
    whole, explained = _faults_of_all(views)
    found: dict[str, list[str]] = {}
    for i, name in enumerate(views.names):
        if i not in explained and (problem := _fault(views, i).problem):
            found.setdefault(problem, []).append(name)
    return (*whole, *(f"{problem}: view {few(names)}" for problem, names in found.items()))


def faults(capture: Capture) -> tuple[tuple[str, ...], tuple[ViewFault, ...]]:
    """What is wrong with a capture as a whole, a line each, and with every view."""
    views = _Views.of(capture)
    return _faults_of_all(views)[0], tuple(_fault(views, i) for i in range(capture.view_count))


@dataclasses.dataclass(frozen=True, eq=False)
class _Views:
    """What is compared, in numpy: JAX would compile each of the small operations."""

    names: tuple[str, ...]
    points: list[np.ndarray]
    """On the skin, of each view."""
    masks: list[Cells] | None
    exposures: list[str | None]
    K: np.ndarray
    cam_from_world: np.ndarray
    translations: list[np.ndarray]
    """Of the body, of each view."""
    size: tuple[int, int]
    largest: float
    """The longest rotation vector of all poses."""

    @classmethod
    def of(cls, capture: Capture) -> "_Views":
        rotations, translations = (np.asarray(x, float) for x in (capture.poses.rotations, capture.poses.translation))
        frames, masks = [int(frame) for frame in capture.frames], capture.masks
        points = surface_points(capture.body, np.asarray(capture.betas), rotations, translations, frames, POINTS)
        return cls(
            capture.names,
            [points[frame] for frame in frames],
            None if masks is None else [_mask_cells(mask) for mask in masks],
            [_exposure(image, None if masks is None else masks[i]) for i, image in enumerate(capture.images)],
            np.asarray(capture.cameras.K, float),
            np.asarray(capture.cameras.cam_from_world, float),
            [translations[frame] for frame in frames],
            (capture.cameras.width, capture.cameras.height),
            float(np.linalg.norm(rotations, axis=-1).max()),
        )


def _faults_of_all(views: _Views) -> tuple[tuple[str, ...], set[int]]:
    """Mistakes that no view shows by itself, and the views that they explain."""
    if views.largest > LONGEST_TURN:
        degrees = f"the poses seem to be in degrees: rotations up to {views.largest:.0f}, expected radians"
        return (degrees,), set(range(len(views.names)))
    if not (exchanged := _exchanged_cameras(views)):
        return (), set()
    pairs = [f"{views.names[i]} by the camera of {views.names[j]}" for i, j in exchanged.items()]
    return (f"cameras are exchanged: the body would fit {few(pairs)}",), set(exchanged)


def _exposure(image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"] | None) -> str | None:
    """What is wrong with a photo on which the person is nearly black or burnt out: nothing is to be seen there."""
    person = image if mask is None else image[mask > 0.99]  # without its blended edge
    if person.size and np.quantile(person, 0.98) < DARKEST:
        return "the person is nearly black; is the photo underexposed, or were its values divided by 255 twice"
    if person.size and mask is not None and np.quantile(person, 0.4) > BURNT:
        return "most of the person is white; is the photo overexposed"
    return None


def _exchanged_cameras(views: _Views) -> dict[int, int]:
    """For views that fit the camera of another one: that one. An exchange has to explain all of its views."""
    masks = views.masks or []
    own = [_overlap(_silhouette(views, i)[0], mask) for i, mask in enumerate(masks)]
    off = [i for i, overlap in enumerate(own) if overlap < SURELY_IOU]
    if len(off) < 2:
        return {}
    from scipy.optimize import linear_sum_assignment  # takes longer to import than all else here to compute

    overlaps = np.array([[_overlap(_silhouette(views, i, camera=j)[0], masks[i]) for j in off] for i in off])
    chosen = linear_sum_assignment(-overlaps)[1].tolist()
    found = {off[row]: (off[column], overlaps[row, column]) for row, column in enumerate(chosen) if row != column}
    explains = all(overlap > max(SURELY_IOU, own[i] + BETTER) for i, (_, overlap) in found.items())
    # a mirrored photo explains views around a person as well
    mirrored = [_overlap(_silhouette(views, i)[0][:, ::-1], masks[i]) for i in found]
    if not explains or sum(mirrored) >= sum(overlap for _, overlap in found.values()):
        return {}
    return {i: j for i, (j, _) in found.items()}


def _fault(views: _Views, i: int) -> ViewFault:
    body, inside, height = _silhouette(views, i)
    mask = None if views.masks is None else views.masks[i]
    if mask is not None and not mask.any():
        return ViewFault("the mask is empty", inside)
    if inside < LEAST_INSIDE:
        problem = "most of the body is outside the frame, or behind the camera"
    elif height < LEAST_HEIGHT:
        problem = "the body is tiny, in metres it would not be"
    elif mask is not None and _overlap(body, mask) < LEAST_IOU:
        problem = "body and mask do not agree"
    else:
        return ViewFault(views.exposures[i], inside)
    cause = _cause(views, i, body, mask)
    return ViewFault(problem if cause is None else f"{problem}; it would fit if {cause}", inside)


def _cause(views: _Views, i: int, body: Cells, mask: Cells | None) -> str | None:
    """The mistake that, undone, puts the body where the mask is; without a mask the only one that puts it in the frame."""
    tried = {}
    if mask is not None:
        tried = {mistake: _overlap(*undo(body, mask)) for mistake, undo in MISTAKES_OF_IMAGES.items()}
    for mistake, undo in MISTAKES.items():
        drawn, inside, height = _silhouette(views, i, undo(views.cam_from_world[i], views.translations[i]))
        if inside > SURELY_INSIDE and height > LEAST_HEIGHT:
            tried[mistake] = 1.0 if mask is None else _overlap(drawn, mask)
    best = max(tried, key=lambda mistake: tried[mistake], default=None)
    if best is None or tried[best] <= SURELY_IOU or (mask is None and len(tried) > 1):
        return None
    return best


# Coarse silhouettes ---------------------------------------------------------------------------------------------------


def _silhouette(views: _Views, i: int, matrix: Matrix | None = None, camera: int | None = None) -> tuple[Cells, float, float]:
    """The cells that the body of view i covers; the share of its points in the image; and its height there, of the image's.

    Arguments: matrix: in place of its camera's. camera: of another view.
    """
    camera, (width, height) = i if camera is None else camera, views.size
    matrix = views.cam_from_world[camera] if matrix is None else matrix
    pixels = points_in_image(views.points[i], views.K[camera], matrix, width, height)
    shape, cell = _grid(width, height)
    covered = np.zeros(shape, bool)
    column, row = np.minimum((pixels / cell).astype(int), np.asarray(shape[::-1]) - 1).T
    covered[row, column] = True
    tall = float(np.ptp(pixels[:, 1])) / height if len(pixels) else 0.0
    return _closed(covered), len(pixels) / len(views.points[i]), tall


def _closed(cells: Cells) -> Cells:
    """Without the gaps of one cell between the points of a surface: dilated, then eroded."""
    shifted = lambda x: [np.roll(x, (row, column), (0, 1)) for row in (-1, 0, 1) for column in (-1, 0, 1)]
    grown = np.logical_or.reduce(shifted(np.pad(cells, 2)))
    return np.logical_and.reduce(shifted(grown))[2:-2, 2:-2]


def _mask_cells(mask: Float[np.ndarray, "h w"]) -> Cells:
    height, width = mask.shape
    (rows, columns), cell = _grid(width, height)
    at = lambda count, most: np.minimum(((np.arange(count) + 0.5) * cell).astype(int), most - 1)
    return mask[at(rows, height)][:, at(columns, width)] > 0.5


def _grid(width: int, height: int) -> tuple[tuple[int, int], float]:
    cell = max(width, height) / GRID
    return (max(1, round(height / cell)), max(1, round(width / cell))), cell


def _overlap(a: Cells, b: Cells) -> float:
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 0.0
