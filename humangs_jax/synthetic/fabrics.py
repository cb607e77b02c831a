"""Fabrics and materials, which give points on a surface their colors.

A material maps `Spots` (points on a surface) to albedo. It is evaluated at each pixel or texel, so
that it is crisp at any resolution. A `Fabric` is a pattern, two dyes and a seed. All other random
numbers of a fabric are drawn from the seed again whenever colors are computed. Periods of patterns
are metres on the cloth; the finest is a few millimetres.
"""

import colorsys
import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.synthetic.anatomy import ARMHOLE, SAME_GIRTH, TRUNK_GIRTH, Vector, sewn_coordinates
from humangs_jax.synthetic.surfaces import Field, Points, Ripples, choice, hashed, lattice

_SHOULDER_RIDGE = -0.02
"""Template z of the line from neck to shoulder on which front and back are sewn together."""
ALBEDO_LIMIT = 0.88
"""Largest albedo. White clothes stay darker than the white background."""


@dataclasses.dataclass(frozen=True)
class Spots:
    """Points on a surface, as materials take them.

    Cloth coordinates on sleeves and trouser legs are recomputed, so that they change abruptly at
    seams, where patterns meet.
    """

    cloth: Float[np.ndarray, "n 4"]
    """Cloth coordinates, (n, 4), metres, see `anatomy.cloth_coordinates`."""
    template: Points
    """Template coordinates, (n, 3)."""

    def __post_init__(self):
        object.__setattr__(self, "cloth", sewn_coordinates(self.cloth, self.template))

    @property
    def around(self) -> Field:
        """Metres around the trunk or limb, (n,), 0 in front.

        On the front of the shoulders this is x. On their back it is half the length around the
        trunk minus |x|, with the sign of x. It changes abruptly between front and back.
        """
        girth = self.cloth[:, 3]
        turned = np.arctan2(self.cloth[:, 0], self.cloth[:, 2]) * girth
        # 0 where the cloth hangs
        flat = np.clip((self.cloth[:, 1] - 0.03) / 0.09, 0, 1) * self._on_trunk
        x = self.cloth[:, 0]
        across = np.where(self.template[:, 2] > _SHOULDER_RIDGE, x, np.sign(x) * np.pi * girth - x)
        return turned + flat * (across - turned)

    @property
    def along(self) -> Field:
        """Metres along the trunk or limb, (n,). This is y of the cloth coordinates.

        Towards the shoulders, the distance in z from the shoulder's ridge is subtracted.
        """
        rising = np.clip((self.template[:, 1] + 0.25) / 0.35, 0, 1) * self._on_trunk
        return self.cloth[:, 1] - rising * np.abs(self.template[:, 2] - _SHOULDER_RIDGE)

    @property
    def _on_trunk(self) -> Bool[np.ndarray, " n"]:
        """Whether each point is on the cloth of the trunk, between the armholes, (n,)."""
        return (np.abs(self.cloth[:, 3] - TRUNK_GIRTH) < SAME_GIRTH) & (
            np.abs(self.template[:, 0]) <= ARMHOLE
        )


@dataclasses.dataclass(frozen=True)
class Material:
    """The colors, folds and gloss of a surface."""

    albedo: Callable[[Spots], np.ndarray]
    """A function that returns the colors (n, 3) at `Spots`."""
    wrinkles: float = 0.0
    """Strength of the folds that are painted into the normals; 0 for none."""
    sheen: float = 0.0
    """Strength of a soft highlight, 0 to 1."""
    draped: bool = False
    """Whether the folds run down, as in hanging cloth."""


def color(hue: float, saturation: float, value: float) -> Vector:
    """Converts hue, saturation and value to RGB (3,). The hue may be any number, with period 1.
    Saturation and value are clipped to [0, 1].
    """
    return np.asarray(
        colorsys.hsv_to_rgb(hue % 1, np.clip(saturation, 0, 1), np.clip(value, 0, 1)), np.float32
    )


_DYES = {
    "neutral": (0.28, (0, 1), (0, 0.06), (0.1, 0.18, 0.32, 0.5, 0.7, 0.85)),
    "muted": (0.28, (0, 1), (0.2, 0.5), (0.3, 0.8)),
    "vivid": (0.22, (0, 1), (0.5, 0.85), (0.35, 0.8)),
    "earth": (0.11, (0.05, 0.12), (0.3, 0.7), (0.2, 0.7)),
    "navy": (0.11, (0.56, 0.66), (0.4, 0.8), (0.12, 0.45)),
}
"""Kinds of dyes. Each has its probability, then hue, saturation and value. Two numbers are a range,
more numbers are values of which one is drawn.
"""


def _color_of(rng: np.random.Generator, ranges: Iterable[Sequence[float | int]]) -> Vector:
    numbers = [
        rng.uniform(values[0], values[1]) if len(values) == 2 else rng.choice(values)
        for values in ranges
    ]
    return color(*numbers)


def random_color(rng: np.random.Generator) -> Vector:
    """Draws a dye (3,): neutral, muted, vivid, an earth color or navy."""
    kind = rng.choice(list(_DYES), p=[odds for odds, *_ in _DYES.values()])
    return _color_of(rng, _DYES[kind][1:])


def accent(rng: np.random.Generator, base: Vector) -> Vector:
    """Draws a dye (3,) that stands out from the dye `base`."""
    for _ in range(8):
        other = random_color(rng)
        if np.abs(other - base).sum() > 0.6:
            return other
    return np.where(base.mean() > 0.45, base * 0.3, 0.3 + 0.55 * base).astype(np.float32)


def mix(a: Float[np.ndarray, "*#n 3"], b: Float[np.ndarray, "*#n 3"], amount: Field) -> Points:
    """Mixes colors: returns `a` where amount is 0 and `b` where it is 1, (n, 3).

    a, b: colors of the points (n, 3), or one for all points (3,). amount: (n,).
    """
    return a + (b - a) * amount[:, None]


def band(
    x: Field, low: float | int | Field, high: float | int | Field, soft: float = 0.0015
) -> Field:
    """Returns 1 where x is between low and high, else 0, with edges of width `soft`."""
    return np.clip((x - low) / soft + 0.5, 0, 1) * np.clip((high - x) / soft + 0.5, 0, 1)


@dataclasses.dataclass(frozen=True)
class Fabric:
    """The cloth of a garment: a pattern in two dyes."""

    pattern: str
    """Name of the pattern, a key of PATTERNS."""
    base: Vector
    """The main dye, (3,), 0 to 1."""
    other: Vector
    """The dye of the pattern, (3,), 0 to 1."""
    seed: int
    """Seed of all other random numbers of the fabric and of its prints and trimmings."""

    def rng(self, stream: int) -> np.random.Generator:
        """Returns a new generator of the fabric. Each kind of feature uses another stream."""
        return np.random.default_rng([self.seed, stream])

    def colors(self, s: Spots) -> Points:
        """Returns the colors of points, (n, 3)."""
        return PATTERNS[self.pattern][1](s, self.rng(0), self.base, self.other)


_LEATHER_SHOES = ("flats", "sandals", "ankle_boots", "boots")
_USUAL = {
    "denim": ((0.57, 0.63), (0.3, 0.75), (0.12, 0.6)),
    "cotton": ((0.06, 0.13), (0.15, 0.5), (0.2, 0.75)),
    "leather": ((0.05, 0.09), (0.2, 0.7), (0.06, 0.4)),
    "suit": ((0.58, 0.68), (0.05, 0.35), (0.06, 0.4)),
}
"""Ranges of hue, saturation and value of the usual dyes of cloths."""
_CLOTHS = {
    "jeans": ("denim", 0.85),
    "denim_jacket": ("denim", 0.9),
    "chinos": ("cotton", 0.6),
    "cargo": ("cotton", 0.65),
    "slim": ("suit", 0.5),
    "blazer": ("suit", 0.6),
    "coat": ("suit", 0.35),
    "flats": ("leather", 0.75),
    "boots": ("leather", 0.75),
    "ankle_boots": ("leather", 0.75),
    "belt": ("leather", 0.9),
    "sandals": ("leather", 0.7),
    "shoulder_bag": ("leather", 0.5),
    "watch": ("leather", 0.6),
    "glasses": ("leather", 0.6),
    "sunglasses": ("leather", 0.85),
    "track": ("suit", 0.5),
    "leggings": ("suit", 0.6),
    "wide": ("cotton", 0.4),
}
"""For each kind of garment its usual cloth, and the probability that it has a usual dye of this
cloth.
"""
_COLORS = (
    (("shirt", "socks", "sneakers"), 0.45, ((0, 1), (0, 0.05), (0.72, 0.87))),
    (("sneakers", "leggings", "coat", "puffer", "slim"), 0.4, ((0, 1), (0, 0.1), (0.06, 0.16))),
    (("sneakers", *_LEATHER_SHOES), 0.6, ((0.03, 0.12), (0.0, 0.5), (0.1, 0.7))),
)
"""Each row has kinds of garments, the probability that they have the dye of this row, and the
ranges of its hue, saturation and value. Rows are tried in order. If no row gives the dye, it is
random.
"""
_PATTERN_RULES = (
    (("jeans", "denim_jacket"), "denim", 1, ()),
    (("cargo", "hooded_jacket", "shorts"), "camouflage", 0.25, ()),
    (("puffer", "leggings", "backpack"), "plain", 0.7, ()),
    (("cap", "brim_hat"), "plain", 1, ("camouflage", "melange", "checks", "herringbone")),
    (("sneakers", *_LEATHER_SHOES, "belt", "watch", "necklace", "glasses"), "plain", 1, ()),
)
"""Each row has kinds of garments, a pattern, the probability that the pattern replaces the random
pattern of such a garment, and patterns that are never replaced.
"""


def sample_fabric(rng: np.random.Generator, kind: str, plainness: float) -> Fabric:
    """Draws a fabric that suits a kind of garment.

    plainness: probability that the pattern is drawn from the plain ones, which have one dye or show
    little of a second dye. Otherwise it is drawn by the odds in `PATTERNS`. Some kinds of garments
    then replace the pattern, see `_PATTERN_RULES`.
    """
    plain_ones = {"plain": 0.66, "melange": 0.2, "tweed": 0.14}
    odds = {name: share for name, (share, _) in PATTERNS.items() if share}
    if rng.random() < plainness:
        odds = plain_ones
    pattern = choice(rng, odds)
    base = _dye(rng, kind)
    for kinds, usual, odds, kept in _PATTERN_RULES:
        if kind in kinds and pattern not in kept and (odds == 1 or rng.random() < odds):
            pattern = usual
    return Fabric(pattern, base, accent(rng, base), int(rng.integers(1 << 31)))


def _dye(rng: np.random.Generator, kind: str) -> Vector:
    """Draws a dye (3,): one that is usual for a kind of garment, or a random one."""
    cloth, odds = _CLOTHS.get(kind, ("cotton", 0.0))
    for kinds, share, ranges in (((kind,), odds, _USUAL[cloth]), *_COLORS):
        if kind in kinds and rng.random() < share:
            return _color_of(rng, ranges)
    return random_color(rng)


def _lines(x: Field, period: float, width: float, shift: float = 0.0) -> Field:
    """Returns 1 on lines and 0 between them (n,).

    x: position across the lines. period: distance between lines. width: width of a line. All are in
    metres. shift: shift of the lines, in periods.
    """
    return band((x / period + shift) % 1 * period, 0, width)


def _grain(s: Spots, around: float, along: float, seed: int) -> Field:
    """Returns lattice noise (n,) on the cloth, in cells of `around` by `along` metres."""
    return lattice(np.stack([s.around / around, s.along / along], -1), seed)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 20))


def _plain(s: Spots, rng: np.random.Generator, base: Vector, _other: Vector) -> Points:
    """Returns the colors of cloth in one dye, slightly uneven, (n, 3)."""
    return base * (1 + 0.03 * Ripples(rng, 0.12)(s.cloth[:, :3]))[:, None]


def _stripes(
    s: Spots, rng: np.random.Generator, base: Vector, other: Vector, upright: bool = False
) -> Points:
    """Returns the colors of cloth with stripes, (n, 3). They run around the trunk or limb, or along
    it if `upright`.
    """
    period, share = rng.choice([0.014, 0.02, 0.035, 0.055, 0.09]), rng.uniform(0.25, 0.6)
    return mix(base, other, _lines(s.around if upright else s.along, period, share * period))


def _checks(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of gingham, or of tartan with thin lines of a third dye, (n, 3)."""
    period, third, tartan = rng.choice([0.03, 0.05, 0.08]), accent(rng, base), rng.random() < 0.6
    result = mix(
        base,
        other,
        0.5 * (_lines(s.around, period, period / 2) + _lines(s.along, period, period / 2)),
    )
    lines = np.maximum(_lines(s.around, period, 0.004, 0.25), _lines(s.along, period, 0.004, 0.25))
    if tartan:
        return mix(result, third, 0.7 * lines)
    return result


def _dots(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of cloth with polka dots, (n, 3). Every other row of dots is shifted by
    half the distance between dots.
    """
    period, size = rng.choice([0.03, 0.045, 0.07]), rng.uniform(0.2, 0.34)
    row = np.floor(s.along / period)
    x = ((s.around / period + 0.5 * (row % 2)) % 1 - 0.5) * period
    y = ((s.along / period) % 1 - 0.5) * period
    return mix(base, other, band(np.sqrt(x * x + y * y), -1, size * period, 0.002))


def _flowers(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of scattered blossoms of five petals, in two dyes, (n, 3)."""
    period, seed, third = rng.choice([0.05, 0.075]), _seed(rng), accent(rng, base)
    plane = np.stack([s.around, s.along], -1) / period
    cell = np.floor(plane).astype(np.int64)
    jitter = np.stack([hashed(cell, seed), hashed(cell, seed + 1)], -1) * 0.4 + 0.3
    d = (plane - cell - jitter) * period
    r, a = np.sqrt(np.sum(d * d, -1)), np.arctan2(d[:, 1], d[:, 0]) + 6 * hashed(cell, seed + 2)
    petals = band(r, -1, period * (0.2 + 0.08 * np.cos(5 * a)), 0.002)
    dye = mix(other, third, (hashed(cell, seed + 3) > 0.5).astype(np.float32))
    return mix(
        mix(base, dye, petals),
        np.asarray([0.85, 0.75, 0.3], np.float32),
        band(r, -1, period * 0.07, 0.002),
    )


def _mottled(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of noise with sharp or soft edges, like batik or tie-dye, (n, 3)."""
    scale, seed = rng.choice([0.03, 0.06, 0.1]), _seed(rng)
    width = 0.02 if rng.random() < 0.5 else 0.2
    third = accent(rng, other)
    p = s.cloth[:, :3] / scale
    n = 0.65 * lattice(p, seed) + 0.35 * lattice(2.1 * p, seed + 1)
    first = np.clip((n - 0.47) / width + 0.5, 0, 1)
    second = np.clip((lattice(p * 1.2 + 7.7, seed + 2) - 0.62) / width + 0.5, 0, 1)
    return mix(mix(base, other, first), third, 0.8 * second)


def _melange(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of knitted cloth with a fine grain, (n, 3)."""
    seed, share = _seed(rng), rng.uniform(0.2, 0.5)
    return mix(base, other, share * _grain(s, 0.006, 0.009, seed))


def _denim(s: Spots, rng: np.random.Generator, base: Vector, _other: Vector) -> Points:
    """Returns the colors of denim, (n, 3). It is faded on the front of the thighs and at creases,
    has a grain along the thread, and sometimes has frayed holes at the knees.
    """
    cloud, seed = Ripples(rng, 0.15), _seed(rng)
    fade, holes = rng.uniform(0.1, 0.6), rng.random() < 0.12
    front = (
        np.clip(s.cloth[:, 2] / 0.08, 0, 1)
        * np.exp(-(((s.along + 0.6) / 0.14) ** 2))
        * (s.cloth[:, 3] < 0.14)
    )
    crease = np.clip(np.abs(_grain(s, 0.09, 0.022, seed + 1) - 0.5) * 8, 0, 1)
    worn = np.exp(-(((s.along + 0.47) / 0.05) ** 2)) + 0.5 * np.exp(
        -(((s.along + 0.78) / 0.06) ** 2)
    )
    bright = (
        1
        + 0.07 * cloud(s.cloth[:, :3])
        + fade * front
        + 0.14 * (_grain(s, 0.003, 0.016, seed) - 0.5)
    )
    result = base * (bright + 0.5 * fade * worn * (1 - crease))[:, None]
    if not holes:
        return result
    at = ((s.along + 0.72) / 0.03) ** 2 + (s.around / 0.05) ** 2
    frayed = band(at + 0.6 * _grain(s, 0.02, 0.004, seed + 2), -1, 0.8, 0.2)
    return mix(
        result, np.asarray([0.75, 0.74, 0.72], np.float32), 0.8 * frayed * (s.cloth[:, 2] > 0)
    )


_CAMOUFLAGES = np.asarray(
    [
        [[0.24, 0.26, 0.14], [0.10, 0.12, 0.07], [0.33, 0.24, 0.15], [0.52, 0.47, 0.32]],
        [[0.68, 0.58, 0.42], [0.52, 0.42, 0.29], [0.40, 0.32, 0.22], [0.78, 0.70, 0.56]],
        [[0.45, 0.46, 0.47], [0.14, 0.14, 0.15], [0.28, 0.29, 0.30], [0.72, 0.73, 0.74]],
        [[0.14, 0.20, 0.32], [0.06, 0.08, 0.14], [0.24, 0.33, 0.46], [0.45, 0.54, 0.62]],
    ],
    np.float32,
)
"""Four colors of each kind of camouflage, (4, 4, 3): earth, sand, town, sea."""


def _camouflage(s: Spots, rng: np.random.Generator, _base: Vector, _other: Vector) -> Points:
    """Returns the colors of camouflage, (n, 3): torn blots of three colors on a fourth one. Small
    blots lie on large ones.
    """
    dyes = _CAMOUFLAGES[rng.choice(4, p=[0.5, 0.2, 0.2, 0.1])]
    scale, seed = rng.uniform(0.045, 0.09), _seed(rng)
    p = s.cloth[:, :3] / scale * np.asarray([0.8, 1.4, 0.8], np.float32)
    warp = np.stack([lattice(2.3 * p + k, seed + k) for k in range(3)], -1) - 0.5
    result = np.broadcast_to(dyes[0], (len(p), 3))
    for k, level in ((1, 0.56), (2, 0.6), (3, 0.66)):
        blots = lattice((0.8 + 0.35 * k) * (p + 0.9 * warp) + 11.3 * k, seed + 10 * k)
        result = mix(result, dyes[k], np.clip((blots - level) / 0.03 + 0.5, 0, 1))
    return result


def _herringbone(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of cloth with zigzags of slanted threads, (n, 3)."""
    period = rng.choice([0.03, 0.045])
    pitch = rng.choice([0.008, 0.012])
    share = rng.uniform(0.35, 0.7)
    side = np.abs((s.around / period) % 2 - 1) * period
    return mix(base, base + share * (other - base), _lines(s.along + side, pitch, 0.5 * pitch))


def _argyle(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of cloth with diamonds and thin lines across, (n, 3)."""
    period, third = rng.choice([0.06, 0.09]), accent(rng, other)
    x, y = s.around / period, s.along / (1.6 * period)
    u, v = (x + y) % 1, (x - y) % 1
    diamond = band(u * period, 0, period / 2) * band(v * period, 0, period / 2)
    lines = np.maximum(*(band(((w + 0.25) % 1) * period, 0, 0.003) for w in (u, v)))
    return mix(mix(base, other, diamond), third, 0.8 * lines)


def _dip_dye(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of cloth on which one dye runs into another, (n, 3), along the garment or
    in rings (tie-dye).
    """
    rings, level, wide = rng.random() < 0.5, rng.uniform(-0.35, 0.0), rng.uniform(0.05, 0.25)
    wobble, third = lattice(s.cloth[:, :3] / 0.05, _seed(rng)) - 0.5, accent(rng, other)
    if not rings:
        return mix(base, other, np.clip((s.along + 0.05 * wobble - level) / wide + 0.5, 0, 1))
    r = np.sqrt(s.around**2 + (s.along + 0.1) ** 2) + 0.06 * wobble
    twist = (r / 0.13 + np.arctan2(s.around, s.along + 0.1) / np.pi) % 1
    return mix(
        mix(base, other, np.clip(np.abs(twist - 0.5) * 4 - 0.5, 0, 1)),
        third,
        band(twist, 0.4, 0.6, 0.15),
    )


def _tweed(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of cloth of two threads, (n, 3). The second thread shows little."""
    seed, share = _seed(rng), rng.uniform(0.08, 0.25)
    return mix(
        base, other, share * _grain(s, 0.004, 0.02, seed) * _grain(s, 0.02, 0.004, seed + 1) * 2
    )


def _cable_knit(s: Spots, rng: np.random.Generator, base: Vector, _other: Vector) -> Points:
    """Returns the colors of plaits of thick yarn, light and dark, in one dye, (n, 3)."""
    period = rng.choice([0.05, 0.07])
    x, y = (s.around / period) % 1 - 0.5, s.along / 0.045
    strand = np.sin(2 * np.pi * (y + 0.8 * np.abs(x))) * np.sign(x)
    inside = band(np.abs(x) * period, -1, 0.3 * period)
    ribs = np.cos(2 * np.pi * s.around / 0.008)
    return base * (1 + 0.13 * strand * inside + 0.07 * ribs * (1 - inside))[:, None]


def _color_blocks(s: Spots, rng: np.random.Generator, base: Vector, other: Vector) -> Points:
    """Returns the colors of cloth whose upper part has another dye, with a line in a third dye
    below it, (n, 3).
    """
    level, wide, third = rng.uniform(-0.15, 0.06), rng.uniform(0.01, 0.03), accent(rng, other)
    return mix(
        mix(base, other, band(s.along, level, 9.0)), third, band(s.along, level - wide, level)
    )


PATTERNS: dict[str, tuple[float, Callable]] = {
    "plain": (0.05, _plain),
    "stripes": (0.2, _stripes),
    "upright": (0.08, functools.partial(_stripes, upright=True)),
    "checks": (0.17, _checks),
    "dots": (0.06, _dots),
    "flowers": (0.09, _flowers),
    "mottled": (0.05, _mottled),
    "camouflage": (0.05, _camouflage),
    "melange": (0.03, _melange),
    "blocks": (0.09, _color_blocks),
    "herringbone": (0.03, _herringbone),
    "argyle": (0.03, _argyle),
    "dip_dye": (0.04, _dip_dye),
    "cable_knit": (0.03, _cable_knit),
    "tweed": (0.0, _tweed),
    "denim": (0.0, _denim),
}
"""Patterns by name: the odds of the pattern (see `sample_fabric`), and the function that colors
points. Patterns with odds of 0 are drawn in other ways.
"""
