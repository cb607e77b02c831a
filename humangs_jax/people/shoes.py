"""Shoes and boots: the outlines of foot and ankle, slice by slice, on a sole."""

import numpy as np

from humangs_jax.people import slices
from humangs_jax.people.anatomy import FLOOR, Anatomy
from humangs_jax.people.garments import nearest_weights, smooth_weights
from humangs_jax.people.poses import LEFT_ANKLE
from humangs_jax.people.surfaces import Surface, grid_faces, join, turn_in_hems

COLUMNS = 32


def pair(anatomy: Anatomy, height: float, sole: float, ease: float) -> Surface:
    """Both shoes. height: of the shaft above the floor; sole: its thickness; ease: metres between foot and leather."""
    return join([_shoe(anatomy, side, height, sole, ease) for side in (0, 1)])


def _shoe(anatomy, side, height, sole, ease):
    template = anatomy.skin.attributes["template"]
    sign = 1 if side == 0 else -1
    own = np.flatnonzero((template[:, 0] * sign > 0) & (template[:, 1] < FLOOR + height + 0.06))
    points = anatomy.skin.vertices[own]
    floor = points[:, 1].min()
    shaft = (
        np.linspace(0.085, height, max(3, int((height - 0.085) / 0.03) + 1)) if height > 0.1 else np.asarray([height])
    )
    low = np.asarray([0.004, 0.012, 0.022, 0.033, 0.045, 0.058, 0.072])
    levels = floor + np.concatenate([low[low < height - 0.004], shaft])
    shape = _outlines(points, levels)
    shape = slices.hanging(shape, 0.6)  # the sole is as wide as what is above it
    angle = np.arange(COLUMNS) * (2 * np.pi / COLUMNS)
    rows = [
        (floor - sole, 0, 0.0),
        (floor - sole, 0, 0.0),
        (floor - 0.3 * sole, 0, 0.004),
        (floor + 0.004, 0, 0.004),
        (floor + 0.006, 0, 0.0),
    ]
    rows += [(level, i, 0.0) for i, level in enumerate(levels) if i > 0]
    rings = []
    for k, (y, i, extra) in enumerate(rows):
        radius = shape.radius(np.full(COLUMNS, levels[i]), angle) + ease + extra
        radius = np.zeros(COLUMNS) if k == 0 else radius
        rings.append(
            np.stack(
                [
                    shape.centers[i, 0] + radius * np.sin(angle),
                    np.full(COLUMNS, y),
                    shape.centers[i, 1] + radius * np.cos(angle),
                ],
                -1,
            )
        )
    vertices = np.concatenate(rings).astype(np.float32)
    faces = grid_faces(len(rows), COLUMNS, closed=True)[:, ::-1]
    weights = nearest_weights(anatomy, vertices, own)
    weights = smooth_weights(weights, faces, 3)
    ankle = anatomy.joints[LEFT_ANKLE + side]
    local = vertices - np.asarray([ankle[0], floor, ankle[2]])
    cloth = np.concatenate([local, np.full((len(local), 1), 0.06)], 1).astype(np.float32)
    surface = Surface(
        vertices, np.ascontiguousarray(faces), weights, {"template": local.astype(np.float32), "cloth": cloth}
    )
    return turn_in_hems(surface, 0.01)


def _outlines(points, levels):
    """Thin slices of the foot; thick ones, averaged, of the shin, where the body has few vertices."""
    thin, thick = (slices.outlines(points[:, 1], points[:, [0, 2]], levels, None, window) for window in (0.012, 0.03))
    shin = np.clip((levels - levels[0] - 0.08) / 0.03, 0, 1)[:, None]
    smooth = slices.blurred(thick, 2)
    mixed = [a + (b - a) * shin for a, b in ((thin.centers, thick.centers), (thin.radii, smooth.radii))]
    return slices.Outlines(levels, *mixed)
