"""Colours as functions of position on the cloth: plain, stripes, checks, dots, prints, noise; skin, eyes and hair.

A material maps `Spots` (points on a surface) to albedo in [0, ALBEDO_LIMIT]. Patterns are evaluated per pixel, so that they are
crisp at any resolution; their finest period is a few millimetres.
"""

import colorsys
import dataclasses
from collections.abc import Callable

import numpy as np

from humangs_jax.array_types import Float
from humangs_jax.data.synthetic.noise import Ripples, hashed, lattice

ALBEDO_LIMIT = 0.88
"""White clothes stay darker than the white background."""


@dataclasses.dataclass(frozen=True)
class Spots:
    """Points on a surface. cloth: (n, 4), see `anatomy.cloth_coordinates`. template: (n, 3) template coordinates."""

    cloth: Float[np.ndarray, "n 4"]
    template: Float[np.ndarray, "n 3"]

    @property
    def around(self) -> Float[np.ndarray, " n"]:
        """(n,) metres around the trunk or limb, 0 in front."""
        return np.arctan2(self.cloth[:, 0], self.cloth[:, 2]) * self.cloth[:, 3]

    @property
    def along(self) -> Float[np.ndarray, " n"]:
        """(n,) metres along the trunk or limb (height)."""
        return self.cloth[:, 1]


@dataclasses.dataclass(frozen=True)
class Material:
    """albedo: Spots -> (n, 3). wrinkles: strength of the folds painted into the normals. sheen: soft highlight in [0, 1]."""

    albedo: Callable[[Spots], np.ndarray]
    wrinkles: float = 0.0
    sheen: float = 0.0


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


def plain(rng, base):
    """One dye, slightly uneven."""
    cloud = Ripples(rng, 0.12)
    return lambda s: base * (1 + 0.03 * cloud(s.cloth[:, :3]))[:, None]


def stripes(rng, base, other, upright=False):
    """Stripes around (or, upright, along) the limb."""
    period = rng.choice([0.02, 0.035, 0.055, 0.09])
    share = rng.uniform(0.25, 0.6)

    def albedo(s):
        x = s.around if upright else s.along
        phase = (x / period) % 1
        return mix(base, other, band(phase * period, 0.0, share * period))

    return albedo


def checks(rng, base, other):
    """Gingham or tartan."""
    period = rng.choice([0.03, 0.05, 0.08])
    third, thin = accent(rng, base), rng.random() < 0.6

    def albedo(s):
        across = band((s.around / period) % 1 * period, 0, period / 2)
        along = band((s.along / period) % 1 * period, 0, period / 2)
        result = mix(base, other, 0.5 * (across + along))
        if thin:
            lines = np.maximum(
                band((s.around / period + 0.25) % 1 * period, 0, 0.004),
                band((s.along / period + 0.25) % 1 * period, 0, 0.004),
            )
            result = mix(result, third, 0.7 * lines)
        return result

    return albedo


def dots(rng, base, other):
    """Polka dots in a triangular grid."""
    period, size = rng.choice([0.03, 0.045, 0.07]), rng.uniform(0.2, 0.34)

    def albedo(s):
        row = np.floor(s.along / period)
        x = ((s.around / period + 0.5 * (row % 2)) % 1 - 0.5) * period
        y = ((s.along / period) % 1 - 0.5) * period
        return mix(base, other, band(np.sqrt(x * x + y * y), -1, size * period, 0.002))

    return albedo


def flowers(rng, base, other):
    """Scattered blossoms of five petals in two dyes."""
    period, seed, third = rng.choice([0.05, 0.075]), int(rng.integers(1 << 20)), accent(rng, base)

    def albedo(s):
        plane = np.stack([s.around, s.along], -1) / period
        cell = np.floor(plane).astype(np.int64)
        jitter = np.stack([hashed(cell, seed), hashed(cell, seed + 1)], -1) * 0.4 + 0.3
        d = (plane - cell - jitter) * period
        r, a = np.sqrt(np.sum(d * d, -1)), np.arctan2(d[:, 1], d[:, 0]) + 6 * hashed(cell, seed + 2)
        petals = band(r, -1, period * (0.2 + 0.08 * np.cos(5 * a)), 0.002)
        dye = mix(other, third, (hashed(cell, seed + 3) > 0.5).astype(np.float32))
        result = mix(base, dye, petals)
        return mix(result, np.asarray([0.85, 0.75, 0.3], np.float32), band(r, -1, period * 0.07, 0.002))

    return albedo


def mottled(rng, base, other):
    """Camouflage, batik, tie-dye: thresholded or soft noise."""
    scale, seed = rng.choice([0.03, 0.06, 0.1]), int(rng.integers(1 << 20))
    hard, third = rng.random() < 0.5, accent(rng, other)

    def albedo(s):
        p = s.cloth[:, :3] / scale
        n = 0.65 * lattice(p, seed) + 0.35 * lattice(2.1 * p, seed + 1)
        width = 0.02 if hard else 0.2
        first = np.clip((n - 0.47) / width + 0.5, 0, 1)
        second = np.clip((lattice(p * 1.2 + 7.7, seed + 2) - 0.62) / width + 0.5, 0, 1)
        return mix(mix(base, other, first), third, 0.8 * second)

    return albedo


def melange(rng, base, other):
    """Knit or tweed: fine grain."""
    seed, share = int(rng.integers(1 << 20)), rng.uniform(0.2, 0.5)

    def albedo(s):
        fine = lattice(np.stack([s.around / 0.006, s.along / 0.009], -1), seed)
        return mix(base, other, share * fine)

    return albedo


def denim(rng, base, _other):
    """Faded on the front of thighs, with side seams."""
    cloud, seed = Ripples(rng, 0.15), int(rng.integers(1 << 20))
    fade = rng.uniform(0.1, 0.5)

    def albedo(s):
        front = np.clip(s.cloth[:, 2] / 0.08, 0, 1) * np.exp(-(((s.along + 0.6) / 0.14) ** 2))
        grain = lattice(np.stack([s.around, s.along], -1) / 0.007, seed) - 0.5
        bright = 1 + 0.07 * cloud(s.cloth[:, :3]) + fade * front + 0.12 * grain
        seam = band(np.abs(s.around) - 0.5 * np.pi * s.cloth[:, 3], -0.003, 0.003)
        return base * (bright * (1 - 0.35 * seam))[:, None]

    return albedo


def colour_blocks(rng, base, other):
    """A chest (or thigh) in another dye, with a line between."""
    level, wide, third = rng.uniform(-0.15, 0.06), rng.uniform(0.01, 0.03), accent(rng, other)

    def albedo(s):
        upper = mix(base, other, band(s.along, level, 9.0))
        return mix(upper, third, band(s.along, level - wide, level))

    return albedo


PATTERNS = {
    "plain": (0.28, lambda rng, a, b: plain(rng, a)),
    "stripes": (0.16, stripes),
    "upright": (0.06, lambda rng, a, b: stripes(rng, a, b, upright=True)),
    "checks": (0.13, checks),
    "dots": (0.07, dots),
    "flowers": (0.07, flowers),
    "mottled": (0.08, mottled),
    "melange": (0.08, melange),
    "blocks": (0.07, colour_blocks),
}


def random_fabric(rng: np.random.Generator, plainness: float = 0.0) -> Callable[[Spots], np.ndarray]:
    """A random pattern in two random dyes; with probability `plainness` plain or fine-grained."""
    base = random_colour(rng)
    other = accent(rng, base)
    names = list(PATTERNS)
    name = names[rng.choice(len(names), p=[PATTERNS[n][0] for n in names])]
    if rng.random() < plainness:
        name = rng.choice(["plain", "melange"])
    return PATTERNS[name][1](rng, base, other)


def with_print(rng: np.random.Generator, fabric: Callable) -> Callable:
    """A motif on the chest: disc, star, bar, letters or a picture of noise."""
    ink, ink2 = random_colour(rng), random_colour(rng)
    kind, size, height = (
        rng.choice(["disc", "star", "bar", "letters", "picture"]),
        rng.uniform(0.06, 0.1),
        rng.uniform(-0.08, 0.0),
    )
    seed, points = int(rng.integers(1 << 20)), int(rng.integers(4, 8))

    def albedo(s):
        base = fabric(s)
        x, y = s.around, s.along - height
        r, a = np.sqrt(x * x + y * y), np.arctan2(y, x)
        on_trunk = band(s.cloth[:, 3], 0.13, 1.0, 0.01)
        if kind == "disc":
            inside, second = band(r, -1, size), band(r, 0.6 * size, 0.8 * size)
        elif kind == "star":
            inside = band(r, -1, size * (0.7 + 0.3 * np.cos(points * a)))
            second = band(r, -1, 0.35 * size)
        elif kind == "bar":
            inside = band(x, -1.3 * size, 1.3 * size) * band(y, -0.35 * size, 0.35 * size)
            second = band(y, -0.1 * size, 0.1 * size)
        elif kind == "letters":
            cell = np.stack([np.floor(x / 0.011), np.floor(y / 0.011)], -1).astype(np.int64)
            gap = (cell[:, 0] % 4 != 0) & (cell[:, 1] % 6 != 0)
            inside = ((hashed(cell, seed) > 0.45) & gap & (np.abs(x) < 1.3 * size) & (np.abs(y) < 0.5 * size)).astype(
                np.float32
            )
            second = 0 * inside
        else:
            inside = band(np.maximum(np.abs(x), np.abs(y)), -1, size)
            second = (lattice(np.stack([x, y], -1) / 0.025, seed) > 0.5).astype(np.float32)
        front = (s.cloth[:, 2] > 0).astype(np.float32)
        return mix(mix(base, ink, inside * front * on_trunk), ink2, second * inside * front * on_trunk)

    return albedo


def with_buttons(rng: np.random.Generator, fabric: Callable, low: float, high: float) -> Callable:
    """A placket with buttons down the front (or a zip)."""
    ink, zipped = random_colour(rng), rng.random() < 0.3

    def albedo(s):
        base = fabric(s)
        x, y, front = s.cloth[:, 0], s.along, (s.cloth[:, 2] > 0) & (s.cloth[:, 3] > 0.13)
        front = front * band(y, low, high)
        edge = band(np.abs(x - 0.0), 0.012, 0.0145) * front
        base = mix(base, base * 0.55, edge)
        if zipped:
            return mix(base, ink, band(np.abs(x), -1, 0.004) * front)
        button = band(np.sqrt(x * x + ((y % 0.085) - 0.04) ** 2), -1, 0.0065) * front
        return mix(base, ink, button)

    return albedo


def with_band(fabric: Callable, ink: np.ndarray, low: float, high: float) -> Callable:
    """A belt or waistband between two heights of the trunk."""

    def albedo(s):
        belt = band(s.along, low, high) * band(s.cloth[:, 3], 0.1, 1.0, 0.01)
        buckle = belt * band(np.abs(s.cloth[:, 0]), -1, 0.022) * (s.cloth[:, 2] > 0)
        return mix(mix(fabric(s), ink, belt), np.asarray([0.6, 0.55, 0.4], np.float32), buckle * 0.8)

    return albedo


def with_side_stripe(fabric: Callable, ink: np.ndarray) -> Callable:
    """Stripes down the outside of arms and legs."""

    def albedo(s):
        side = np.abs(np.abs(s.around) - 0.5 * np.pi * s.cloth[:, 3])
        return mix(fabric(s), ink, band(side, 0.006, 0.016) * band(s.cloth[:, 3], 0.0, 0.1, 0.01))

    return albedo


def leather(rng, base, trim, sole_height):
    """Shoes: leather, a sole of another colour, laces on the instep."""

    def albedo(s):
        y, x, z = s.cloth[:, 1], s.cloth[:, 0], s.cloth[:, 2]
        result = mix(base, trim, band(y, -1, sole_height, 0.002))
        laces = (
            band((z / 0.014) % 1 * 0.014, 0, 0.005)
            * band(np.abs(x), -1, 0.018)
            * band(z, 0.035, 0.11)
            * band(y, 0.03, 1.0)
        )
        return mix(result, trim, laces)

    return albedo
