"""Cuts: fields over template coordinates (n, 3), positive where a garment has cloth. See `anatomy` for the coordinates."""

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.people.anatomy import FLOOR

Points = Float[np.ndarray, "n 3"]
Field = Float[np.ndarray, " n"]

TRUNK_HALF_WIDTH = 0.25
"""In T-pose everything further out than this is an arm."""
NECKLINES = {
    "crew": (0.0, 0.085),
    "vee": (0.0, 0.085),
    "scoop": (-0.012, 0.115),
    "high": (0.052, 0.085),
    "collar": (0.012, 0.085),
}
"""Lift of the neckline's plane, and distance from the neck's axis beyond which the shoulder is always covered."""


def neckline(template: Points, style: str, depth: float) -> Field:
    """Positive below the neckline. depth: of a vee or scoop, metres."""
    x, y, z = template.T
    radial = np.sqrt(x * x + (z + 0.005) ** 2)
    lift, wide = NECKLINES[style]
    plane = 0.152 + lift - 0.42 * z - y
    field = np.maximum(plane, np.minimum(radial - wide, 0.17 - y))  # shoulders, but not the head
    if style == "vee":
        opening = np.maximum.reduce([0.13 - depth + np.abs(x) * depth / 0.06 - y, np.abs(x) - 0.06, 0.02 - z])
        field = np.minimum(field, opening)
    if style == "scoop":
        inside = 1 - (x / 0.105) ** 2 - ((y - 0.15) / (0.02 + depth)) ** 2
        field = np.minimum(field, np.maximum(-0.05 * inside, 0.02 - z))
    return field


def sleeves(template: Points, end: float) -> Field:
    """Positive inside of |x| = end; for sleeveless tops (end < 0.2) an armhole down to the armpit."""
    x, y = np.abs(template[:, 0]), template[:, 1]
    return end + 1.6 * np.maximum(0.03 - y, 0) - x if end < 0.2 else np.where(y > -0.1, end - x, 0.5)


def above(template: Points, level: float) -> Field:
    """Positive above a height of the trunk or the legs."""
    return template[:, 1] - level


def trousers(template: Points, top: float, end: float) -> Field:
    """Positive on hips and legs between two heights."""
    x, y, _ = template.T
    return np.minimum.reduce([top - y, y - end, TRUNK_HALF_WIDTH - np.abs(x)])


def front_opening(template: Points, gap: float, spread: float) -> Field:
    """Positive outside of a gap in front, |x| < gap at the chest, wider by `spread` (m/m) downwards and at the neck."""
    x, y, z = template.T
    wide = gap + spread * np.maximum(-0.05 - y, 0) + 0.25 * np.maximum(y - 0.04, 0) * (y < 0.25)
    return np.maximum(np.abs(x) - wide, 0.03 - z)


def collar(template: Points, low: float, high: float, gap: float = 0.012) -> Field:
    """Positive on a band around the neck between two heights (of the neckline's plane), open in front."""
    x, y, z = template.T
    radial, plane = np.sqrt(x * x + (z + 0.005) ** 2), y + 0.42 * z
    return np.minimum.reduce([plane - low, high - plane, 0.125 - radial, np.where(z > 0, np.abs(x) - gap, 0.1)])


def lapel(template: Points, gap: float, spread: float, bottom: float) -> Field:
    """Positive on two tapering strips beside a front opening, from the collar down to `bottom`."""
    x, y, z = template.T
    width = np.clip((y - bottom) * 0.42, 0, 0.075) * np.clip((0.2 - y) / 0.05, 0, 1)
    inner = front_opening(template, gap, spread)
    return np.minimum.reduce([inner, width - inner, y - bottom, 0.19 - y, 0.4 * (z - 0.0), 0.14 - np.abs(x)])


def hips_and_legs(template: Points, top: float, bottom: float) -> Field:
    """Positive on what a tube around hips and legs hides, down to two hands above its hem: they may be seen from below."""
    x, y, _ = template.T
    return np.minimum.reduce([top - 0.03 - y, y - bottom - 0.16, TRUNK_HALF_WIDTH - np.abs(x)])


def shaft(template: Points, height: float) -> Field:
    """Positive on feet and legs below a height over the floor."""
    return FLOOR + height - template[:, 1]


def straps(template: Points, low_front: float, low_back: float) -> Field:
    """Positive on two strips over the shoulders, like a backpack's."""
    x, y, z = template.T
    low = np.where(z > -0.01, low_front, low_back)
    return np.minimum.reduce([0.021 - np.abs(np.abs(x) - 0.092), y - low, 0.2 - y])


def sash(template: Points, shoulder: float, hip: float, half_width: float) -> Field:
    """Positive on a strip across the trunk from one shoulder (x = shoulder, at the top) to the other hip (x = hip)."""
    x, y, _ = template.T
    along = np.asarray([hip - shoulder, -0.30 - 0.17])
    along = along / np.linalg.norm(along)
    across = (x - shoulder) * along[1] - (y - 0.17) * along[0]
    half_width = half_width * (
        1 - 0.6 * np.clip((x * np.sign(hip) - 0.06) / 0.08, 0, 1)
    )  # the side of the trunk is steep
    return np.minimum.reduce([half_width - np.abs(across), y + 0.29, np.where(y > -0.02, 0.186, 0.25) - np.abs(x)])


def necktie(template: Points, length: float, width: float) -> Field:
    """Positive on a strip down the chest that widens downwards and ends in a point; a knot on top."""
    x, y, z = template.T
    top = 0.137 - 0.42 * z
    bottom = 0.1 - length
    half = width * (0.42 + 0.58 * np.clip((top - y) / length, 0, 1)) + 0.007 * np.exp(
        -(((y - top + 0.012) / 0.014) ** 2)
    )
    return np.minimum.reduce([half - np.abs(x), y - bottom - np.abs(x), top - y, 4 * (z - 0.02)])


def bracelet(template: Points, side: float, low: float, high: float) -> Field:
    """Positive on one arm between two distances from the middle."""
    x, y, _ = template.T
    return np.where(y > -0.1, np.minimum(side * x - low, high - side * x), -1.0)


def sandal_straps(template: Points) -> tuple[Field, Field]:
    """Positive on a strap across the toes, and on one around the ankle."""
    y, z = template[:, 1] - FLOOR, template[:, 2]
    over_toes = np.minimum.reduce([0.02 - np.abs(z - 0.09 + 0.3 * y), 0.075 - y, y - 0.004])
    return over_toes, 0.009 - np.abs(y - 0.088 - 0.25 * z)
