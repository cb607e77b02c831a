"""Finds in a fraction of a second what is wrong with a capture: whether photos, masks, cameras and
poses belong together.

The posed body is drawn as points into coarse silhouettes with numpy, so nothing is compiled. Where
a silhouette does not lie on its mask, common mistakes are undone on trial, and the one that
explains the view is named. `humangs reconstruct` and `refine` call this before they begin. `humangs
check` and `start` draw a sheet as well (`apps.check`).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.body_and_masks import points_in_image, surface_points
from humangs_jax.data.cameras import (
    OPENGL_FROM_OPENCV,
    ROTATION_TO_Y_UP,
    pose_matrix,
)
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import few


@dataclasses.dataclass(frozen=True)
class _Limits:
    """Thresholds for the agreement of body and photo."""

    iou: float = 0.5
    """Intersection over union below which body and mask do not agree. About a fifth of a silhouette
    is clothes and hair, which the body does not cover. If body and mask share less than half, the
    pose or the camera is wrong.
    """
    sure_iou: float = 0.6
    """Intersection over union that a view must have after a mistake is undone. Then the mistake
    explains the view.
    """
    inside: float = 0.5
    """Share of the body's points in the frame below which there is a warning."""
    sure_inside: float = 0.9
    """Share of the body's points that have to be in the frame once a mistake is undone."""
    height: float = 0.05
    """Least height of the body in the image, as a share of the image's height. The lengths of a
    smaller body are probably in another unit than metres.
    """
    turn: float = 2 * math.pi + 0.5
    """Length of the longest rotation vector that is accepted, radians. Rotation vectors are at most
    half a turn long, or a whole turn if a program kept counting. Values in degrees are far beyond.
    """
    better: float = 0.1
    """IoU that each view has to gain so that an exchange of cameras explains it."""
    dark: float = 0.12
    """A photo is too dark if 98 % of the person's values are below this, 0 to 1."""
    burnt: float = 0.98
    """A photo is burnt out if 60 % of the person's values are above this, 0 to 1."""


_LIMITS = _Limits()


VIEWS = 24
"""Largest number of views that are looked at before a reconstruction. They are evenly chosen."""

Matrix = Float[np.ndarray, "4 4"]
Cells = Bool[np.ndarray, "rows columns"]
_TO_Y_UP = pose_matrix(np.asarray(ROTATION_TO_Y_UP["+z"], float), np.zeros(3))
MISTAKES: dict[str, Callable[[Matrix, Float[np.ndarray, "3"]], Matrix]] = {
    "cam_from_world is the inverse (world_from_cam, camera to world)": lambda m, t: np.linalg.inv(
        m
    ),
    "the camera looks along -z with y up (OpenGL, Blender, NeRF): negate rows 2 and 3 of"
    " cam_from_world": (lambda m, t: OPENGL_FROM_OPENCV @ m),
    "the matrix is camera to world in OpenGL's convention (NeRF, Blender): invert it, then negate"
    " rows 2 and 3": (lambda m, t: OPENGL_FROM_OPENCV @ np.linalg.inv(m)),
    "the camera's translation is in millimetres": lambda m, t: pose_matrix(
        m[:3, :3], m[:3, 3] / 1000
    ),
    "the body's translation is in millimetres": lambda m, t: (
        m @ pose_matrix(np.eye(3), t / 1000 - t)
    ),
    "the cameras stand in a world with z up: multiply cam_from_world by (x, y, z) -> (x, -z, y)"
    " from the right": (lambda m, t: m @ _TO_Y_UP.T),
}
"""Common mistakes, each with a function that undoes it. The function takes the given
cam_from_world, (4, 4), and the body's translation, (3,), and returns the correct cam_from_world.
"""
MISTAKES_OF_IMAGES: dict[str, Callable[[Cells, Cells], tuple[Cells, Cells]]] = {
    "the mask is inverted": lambda body, mask: (body, ~mask),
    "the photo is mirrored": lambda body, mask: (body[:, ::-1], mask),
}
"""Common mistakes with photos, each with a function that undoes it. The function takes and returns
the silhouettes of body and mask.
"""


class Faults(NamedTuple):
    """What is wrong with a capture and its views."""

    whole: tuple[str, ...]
    """What is wrong with the capture as a whole, one line for each problem."""
    views: tuple[str | None, ...]
    """What is wrong with each view, one line; None if nothing is."""
    inside: tuple[float, ...]
    """For each view, the share of the body that lies in the frame, 0 to 1."""
    explained: set[int]
    """Indices of the views that `whole` explains."""


def likely_mistakes(capture: Capture) -> tuple[str, ...]:
    """Returns warnings about what looks wrong in a capture, one line each. Problems of the whole
    capture come first. Looks at no more than `VIEWS` views.
    """
    some = np.unique(
        np.linspace(0, capture.view_count - 1, min(capture.view_count, VIEWS)).round().astype(int)
    )
    found, by_problem = faults(capture.select(some)), {}
    for i, problem in enumerate(found.views):
        if problem is not None and i not in found.explained:
            by_problem.setdefault(problem, []).append(capture.names[some[i]])
    return (
        *found.whole,
        *(f"{problem}: view {few(names)}" for problem, names in by_problem.items()),
    )


def faults(capture: Capture) -> Faults:
    """Returns what is wrong with a capture as a whole, and with every view."""
    views = _coarse_views(capture)
    problems, inside = zip(*map(_fault, views), strict=True)
    largest = float(np.linalg.norm(np.asarray(capture.poses.rotations, float), axis=-1).max())
    if largest > _LIMITS.turn:
        degrees = (
            f"the poses seem to be in degrees: rotations up to {largest:.0f}, expected radians"
        )
        return Faults((degrees,), problems, inside, set(range(len(views))))
    exchanged = _exchanged_cameras(views)
    if exchanged:
        pairs = [f"{views[i].name} by the camera of {views[j].name}" for i, j in exchanged.items()]
        return Faults(
            (f"cameras are exchanged: the body would fit {few(pairs)}",),
            problems,
            inside,
            set(exchanged),
        )
    return Faults((), problems, inside, set())


class _View(NamedTuple):
    """The data of one view that is checked. The arrays are NumPy's, because JAX would compile each
    small operation.
    """

    name: str
    """Name of the view."""
    image: Float[np.ndarray, "h w 3"]
    """The photo, (h, w, 3), 0 to 1."""
    mask: Float[np.ndarray, "h w"] | None
    """The person's mask, (h, w), 0 to 1; None without masks."""
    cells: Cells | None
    """The mask as a coarse silhouette; None without masks."""
    points: Float[np.ndarray, "p 3"]
    """Points on the posed skin, (p, 3), metres, in the world."""
    K: Float[np.ndarray, "3 3"]
    """Intrinsics, (3, 3), pixels."""
    matrix: Matrix
    """`cam_from_world` of the camera, (4, 4)."""
    translation: Float[np.ndarray, "3"]
    """Translation of the body in the view's frame, (3,), metres."""


def _coarse_views(capture: Capture) -> list[_View]:
    # points on the surface of the body: several for each cell that it covers
    points = surface_points(capture.body, capture.betas, capture.poses, capture.frames, 6000)
    translations = np.asarray(capture.poses.translation, float)
    K = np.asarray(capture.cameras.K, float)
    matrices = np.asarray(capture.cameras.cam_from_world, float)
    views = []
    for i, frame in enumerate(capture.frames.tolist()):
        mask = None
        if capture.masks is not None:
            mask = capture.masks[i]
        cells = None if mask is None else _mask_cells(mask)
        view = _View(
            capture.names[i],
            capture.images[i],
            mask,
            cells,
            points[frame],
            K[i],
            matrices[i],
            translations[frame],
        )
        views.append(view)
    return views


def _fault(view: _View) -> tuple[str | None, float]:
    """Returns what is wrong with a view, in a line or None, and the share of the body in the frame,
    0 to 1.
    """
    body, inside, height = _silhouette(view)
    if view.cells is not None and not view.cells.any():
        return "the mask is empty", inside
    if inside < _LIMITS.inside:
        problem = "most of the body is outside the frame, or behind the camera"
    elif height < _LIMITS.height:
        problem = "the body is tiny, in metres it would not be"
    elif view.cells is not None and _overlap(body, view.cells) < _LIMITS.iou:
        problem = "body and mask do not agree"
    else:
        return _wrong_exposure(view), inside
    cause = _cause(view, body)
    return problem if cause is None else f"{problem}; it would fit if {cause}", inside


def _wrong_exposure(view: _View) -> str | None:
    """Returns what is wrong with the exposure of the person, who may be nearly black or burnt out;
    None if nothing is. Without a mask, it is only tested whether the whole photo is nearly black.
    """
    # without its blended edge
    person = view.image if view.mask is None else view.image[view.mask > 0.99]
    if person.size and np.quantile(person, 0.98) < _LIMITS.dark:
        return (
            "the person is nearly black; is the photo underexposed, or were its values divided by"
            " 255 twice"
        )
    if person.size and view.mask is not None and np.quantile(person, 0.4) > _LIMITS.burnt:
        return "most of the person is white; is the photo overexposed"
    return None


def _cause(view: _View, body: Cells) -> str | None:
    """Returns the mistake that explains a view: undoing it puts the body where the mask is. Without
    a mask, it is the only mistake whose undoing puts the body into the frame. None if no mistake
    explains the view.
    """
    tried = {}
    if view.cells is not None:
        tried = {
            mistake: _overlap(*undo(body, view.cells))
            for mistake, undo in MISTAKES_OF_IMAGES.items()
        }
    for mistake, undo in MISTAKES.items():
        drawn, inside, height = _silhouette(
            view._replace(matrix=undo(view.matrix, view.translation))
        )
        if inside > _LIMITS.sure_inside and height > _LIMITS.height:
            if view.cells is None:
                tried[mistake] = 1.0
            else:
                tried[mistake] = _overlap(drawn, view.cells)
    best = max(tried, key=lambda mistake: tried[mistake], default=None)
    if best is None or tried[best] <= _LIMITS.sure_iou or (view.cells is None and len(tried) > 1):
        return None
    return best


def _exchanged_cameras(views: Sequence[_View]) -> dict[int, int]:
    """Finds views whose cameras seem to be exchanged. Returns, for the index of each such view, the
    index of the view whose camera would fit it. The result is empty if the exchange does not
    explain every one of these views, or if mirrored photos would explain them as well.
    """

    def drawn(i, j):
        return _silhouette(views[i]._replace(K=views[j].K, matrix=views[j].matrix))[0]

    masks = {i: view.cells for i, view in enumerate(views) if view.cells is not None}
    own = {i: _overlap(drawn(i, i), mask) for i, mask in masks.items()}
    off = [i for i, overlap in own.items() if overlap < _LIMITS.sure_iou]
    if len(off) < 2:
        return {}
    # takes longer to import than all else here to compute
    from scipy.optimize import linear_sum_assignment

    overlaps = np.array([[_overlap(drawn(i, j), masks[i]) for j in off] for i in off])
    chosen = linear_sum_assignment(-overlaps)[1].tolist()
    found = {
        off[row]: (off[column], overlaps[row, column])
        for row, column in enumerate(chosen)
        if row != column
    }
    least = {i: max(_LIMITS.sure_iou, own[i] + _LIMITS.better) for i in found}
    explains = all(overlap > least[i] for i, (_, overlap) in found.items())
    # a mirrored photo explains views around a person as well
    mirrored = sum(_overlap(drawn(i, i)[:, ::-1], masks[i]) for i in found)
    if not explains or mirrored >= sum(overlap for _, overlap in found.values()):
        return {}
    return {i: j for i, (j, _) in found.items()}


# Coarse silhouettes
# --------------------------------------------------------------------------------------------------


def _silhouette(view: _View) -> tuple[Cells, float, float]:
    """Returns the cells that the body covers, the share of the body's points that are in the image,
    and the body's height as a share of the image's height.
    """
    height, width = view.image.shape[:2]
    pixels = points_in_image(view.points, view.K, view.matrix, width, height)
    (rows, columns), cell = _grid(width, height)
    covered = np.zeros((rows, columns), bool)
    column, row = np.minimum((pixels / cell).astype(int), (columns - 1, rows - 1)).T
    covered[row, column] = True
    # gaps between the points
    closed = ndimage.binary_closing(np.pad(covered, 2), np.ones((3, 3)))[2:-2, 2:-2]
    tall = 0.0
    if len(pixels):
        tall = float(np.ptp(pixels[:, 1])) / height
    return closed, len(pixels) / len(view.points), tall


def _mask_cells(mask: Float[np.ndarray, "h w"]) -> Cells:
    height, width = mask.shape
    (rows, columns), cell = _grid(width, height)

    def at(count, most):
        return np.minimum(((np.arange(count) + 0.5) * cell).astype(int), most - 1)

    return mask[at(rows, height)][:, at(columns, width)] > 0.5


def _grid(width: int, height: int) -> tuple[tuple[int, int], float]:
    # cells of a silhouette along the longer side of the image
    cell = max(width, height) / 64
    return (max(1, round(height / cell)), max(1, round(width / cell))), cell


def _overlap(a: Cells, b: Cells) -> float:
    union = (a | b).sum()
    return float((a & b).sum() / union) if union else 0.0
