"""Materials: functions from points on a surface to colour, and the dyes they are made of. Patterns are in `patterns`.

A material maps `Spots` (points on a surface) to albedo in [0, ALBEDO_LIMIT], evaluated per pixel, so that it is crisp at any
resolution.
"""

import colorsys
import dataclasses
from collections.abc import Callable

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.people.anatomy import ARMHOLE, SAME_GIRTH, TRUNK_GIRTH, sewn_coordinates

SHOULDER_RIDGE = -0.02
"""Template z of the line from neck to shoulder on which front and back are sewn together."""
ALBEDO_LIMIT = 0.88
"""White clothes stay darker than the white background."""


@dataclasses.dataclass(frozen=True)
class Spots:
    """Points on a surface. cloth: (n, 4), see `anatomy.cloth_coordinates`. template: (n, 3) template coordinates.

    Coordinates of sleeves and trouser legs are made sharp at their seams, where patterns meet, whatever was given.
    """

    cloth: Float[np.ndarray, "n 4"]
    template: Float[np.ndarray, "n 3"]

    def __post_init__(self):
        object.__setattr__(self, "cloth", sewn_coordinates(self.cloth, self.template))

    @property
    def around(self) -> Float[np.ndarray, " n"]:
        """(n,) metres around the trunk or limb, 0 in front; on the shoulders metres from the middle, back and front apart."""
        girth = self.cloth[:, 3]
        turned = np.arctan2(self.cloth[:, 0], self.cloth[:, 2]) * girth
        flat = self._on_shoulders
        if not flat.any():
            return turned
        x = self.cloth[:, 0]
        across = np.where(self.template[:, 2] > SHOULDER_RIDGE, x, np.sign(x) * np.pi * girth - x)
        return turned + flat * (across - turned)

    @property
    def along(self) -> Float[np.ndarray, " n"]:
        """(n,) metres along the trunk or limb: height, but towards the shoulders the way up to their ridge."""
        rising = np.clip((self.template[:, 1] + 0.25) / 0.35, 0, 1) * self._on_trunk
        return self.cloth[:, 1] - rising * np.abs(self.template[:, 2] - SHOULDER_RIDGE)

    @property
    def _on_trunk(self):
        """(n,) whether this is cloth of a trunk, inside of the armholes."""
        return (np.abs(self.cloth[:, 3] - TRUNK_GIRTH) < SAME_GIRTH) & (np.abs(self.template[:, 0]) <= ARMHOLE)

    @property
    def _on_shoulders(self):
        """(n,) 1 where a trunk's cloth lies flat, 0 where it hangs."""
        height = np.clip((self.cloth[:, 1] - 0.03) / 0.09, 0, 1)
        return height * self._on_trunk


@dataclasses.dataclass(frozen=True)
class Material:
    """albedo: Spots -> (n, 3). wrinkles: strength of the creases painted into the normals. sheen: soft highlight in [0, 1].

    draped: creases run down (skirts).
    """

    albedo: Callable[[Spots], np.ndarray]
    wrinkles: float = 0.0
    sheen: float = 0.0
    draped: bool = False


def colour(hue: float, saturation: float, value: float) -> Float[np.ndarray, "3"]:
    """(3,) linear-as-given RGB."""
    return np.asarray(colorsys.hsv_to_rgb(hue % 1, np.clip(saturation, 0, 1), np.clip(value, 0, 1)), np.float32)


def random_colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A dye: neutrals, denim blues, earth colours or something loud."""
    kind = rng.choice(["neutral", "muted", "vivid", "earth", "navy"], p=[0.28, 0.28, 0.22, 0.11, 0.11])
    if kind == "neutral":
        return colour(rng.random(), rng.uniform(0, 0.06), rng.choice([0.1, 0.18, 0.32, 0.5, 0.7, 0.85]))
    if kind == "muted":
        return colour(rng.random(), rng.uniform(0.2, 0.5), rng.uniform(0.3, 0.8))
    if kind == "vivid":
        return colour(rng.random(), rng.uniform(0.5, 0.85), rng.uniform(0.35, 0.8))
    if kind == "earth":
        return colour(rng.uniform(0.05, 0.12), rng.uniform(0.3, 0.7), rng.uniform(0.2, 0.7))
    return colour(rng.uniform(0.56, 0.66), rng.uniform(0.4, 0.8), rng.uniform(0.12, 0.45))


def accent(rng: np.random.Generator, base: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """A second dye that stands out from the first."""
    for _ in range(8):
        other = random_colour(rng)
        if np.abs(other - base).sum() > 0.6:
            return other
    return np.where(base.mean() > 0.45, base * 0.3, 0.3 + 0.55 * base).astype(np.float32)


def mix(
    a: Float[np.ndarray, "*#n 3"], b: Float[np.ndarray, "*#n 3"], amount: Float[np.ndarray, " m"]
) -> Float[np.ndarray, "m 3"]:
    """Colours, of points (m, 3) or one for all (3,): `a` where amount is 0, `b` where it is 1."""
    return a + (b - a) * amount[:, None]


def band(
    x: Float[np.ndarray, " n"],
    low: float | int | Float[np.ndarray, " n"],
    high: float | int | Float[np.ndarray, " n"],
    soft: float = 0.0015,
) -> Float[np.ndarray, " n"]:
    """1 between low and high (metres), with soft edges."""
    return np.clip((x - low) / soft + 0.5, 0, 1) * np.clip((high - x) / soft + 0.5, 0, 1)
