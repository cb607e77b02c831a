"""Convex outlines of a body part, slice by slice: what a taut cloth around the part would measure.

The part is cut across an axis into slices; the outline of a slice is given by its radius around the slice's centre at
`ANGLES` angles, angle 0 at +z and growing towards +x (for slices across y). Convex outlines bridge hollows as cloth does.
"""

import dataclasses

import numpy as np

ANGLES = 48
EMPTY = 1e-3
"""Radius (metres) of a slice without points."""

_GRID = np.arange(ANGLES) * (2 * np.pi / ANGLES)
_TURN = np.cos(_GRID[:, None] - _GRID[None, :])
_INVERSE = np.where(_TURN > 0.1, 1 / np.maximum(_TURN, 0.1), np.inf)
"""radius(a) = min over b of support(b) / cos(a - b)."""


@dataclasses.dataclass(frozen=True)
class Outlines:
    """levels: (l,) increasing positions along the axis. centers: (l, 2) across it. radii: (l, ANGLES). Metres."""

    levels: np.ndarray
    centers: np.ndarray
    radii: np.ndarray

    def center(self, level: np.ndarray) -> np.ndarray:
        """(n, 2) centre of the slice at each position along the axis."""
        return np.stack([np.interp(level, self.levels, self.centers[:, i]) for i in range(2)], -1).astype(np.float32)

    def radius(self, level: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """(n,) radius at positions along the axis and angles around it, bilinear."""
        t = np.clip(np.interp(level, self.levels, np.arange(len(self.levels))), 0, len(self.levels) - 1.001)
        a = (angle / (2 * np.pi) * ANGLES) % ANGLES
        i, k = t.astype(int), a.astype(int) % ANGLES
        u, w = t - i, a - np.floor(a)
        k1 = (k + 1) % ANGLES
        low = self.radii[i, k] * (1 - w) + self.radii[i, k1] * w
        high = self.radii[i + 1, k] * (1 - w) + self.radii[i + 1, k1] * w
        return (low * (1 - u) + high * u).astype(np.float32)

    def with_radii(self, radii: np.ndarray) -> "Outlines":
        """The same slices with other radii."""
        return dataclasses.replace(self, radii=radii)


def polar(across: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angle and radius of points across the axis (n, 2) = (x, z) around centres (n, 2)."""
    d = across - center
    return np.arctan2(d[:, 0], d[:, 1]), np.sqrt(np.sum(d * d, -1))


def outlines(
    along: np.ndarray, across: np.ndarray, levels: np.ndarray, centers: np.ndarray | None, window: float
) -> Outlines:
    """Outlines of the points with position `along` (n,) on the axis and (n, 2) across it.

    levels: (l,) increasing. centers: (l, 2), or None for the middle of each slice. window: half thickness of a slice, metres.
    """
    directions = np.stack([np.sin(_GRID), np.cos(_GRID)])
    support = np.full((len(levels), ANGLES), EMPTY)
    found = np.zeros((len(levels), 2)) if centers is None else np.asarray(centers, float)
    order = np.argsort(along, kind="stable")
    along, across = along[order], across[order]
    starts, ends = np.searchsorted(along, levels - window), np.searchsorted(along, levels + window)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        if end <= start:
            if centers is None and i:
                found[i] = found[i - 1]
            continue
        points = across[start:end]
        if centers is None:
            found[i] = 0.5 * (points.min(0) + points.max(0))
        support[i] = np.maximum(((points - found[i]) @ directions).max(0), EMPTY)
    radii = np.min(support[:, None, :] * _INVERSE[None], axis=-1)
    return Outlines(levels, found, radii)


def blurred(shape: Outlines, times: int = 1) -> Outlines:
    """Radii averaged over neighbouring slices and angles."""
    radii = shape.radii
    for _ in range(times):
        padded = np.concatenate([radii[:1], radii, radii[-1:]])
        radii = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
        radii = 0.25 * np.roll(radii, 1, 1) + 0.5 * radii + 0.25 * np.roll(radii, -1, 1)
    return shape.with_radii(radii)


def hanging(shape: Outlines, slope: float, downwards: bool = True) -> Outlines:
    """Cloth that hangs: it keeps the largest radius of the slices before it, less `slope` metres per metre.

    downwards: before means above (larger level), else below.
    """
    radii = shape.radii.copy()
    order = range(len(radii) - 2, -1, -1) if downwards else range(1, len(radii))
    step = 1 if downwards else -1
    for i in order:
        drop = slope * abs(shape.levels[i] - shape.levels[i + step])
        radii[i] = np.maximum(radii[i], radii[i + step] - drop)
    return shape.with_radii(radii)
