"""Paints what is sewn on or printed on cloth: prints, buttons, zips, seams, pockets, ribs, laces.

`sewn` returns the colors of a garment with its trimmings. The table `_SEWN_ON` says which garments
have which pockets, buttons, zips and sashes. A trimming is a function that takes the colors (n, 3)
of points, the points, a generator and the garment, and returns the colors with the trimming. Words
are set in an alphabet of 5 x 7 cells a letter, which is part of this module.
"""

from collections.abc import Callable

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.synthetic.anatomy import ARMHOLE, WAIST
from humangs_jax.synthetic.fabrics import Spots, accent, band, color, mix
from humangs_jax.synthetic.outfits import BOTTOMS, DRESSES, OUTER, TOPS, Garment
from humangs_jax.synthetic.surfaces import Field, Points, lattice

QUILT = 0.075
"""Period of quilted cloth, metres."""
PADDED = ("puffer", "vest")
"""Kinds of garments that are quilted."""

_ROWS = 7
"""Number of rows of cells of a letter."""
_ADVANCE = 6
"""Number of columns of cells from one letter to the next."""

_ALPHABET = {
    "A": "0E11111F111111", "B": "1E11111E11111E", "C": "0E11101010110E",
    "D": "1E11111111111E", "E": "1F10101E10101F",
    "F": "1F10101E101010", "G": "0E11101711110F", "H": "1111111F111111",
    "I": "0E04040404040E", "J": "0702020202120C",
    "K": "11121418141211", "L": "1010101010101F", "M": "111B1515111111",
    "N": "11191513111111", "O": "0E11111111110E",
    "P": "1E11111E101010", "Q": "0E11111115120D", "R": "1E11111E141211",
    "S": "0F10100E01011E", "T": "1F040404040404",
    "U": "1111111111110E", "V": "11111111110A04", "W": "11111115151B11",
    "X": "11110A040A1111", "Y": "11110A04040404",
    "Z": "1F01020408101F", "0": "0E11131519110E", "1": "040C040404040E",
    "2": "0E11010608101F", "3": "1F02040601110E",
    "4": "02060A121F0202", "5": "1F101E0101110E", "6": "0608101E11110E",
    "7": "1F010204080808", "8": "0E11110E11110E",
    "9": "0E11110F01020C",
}  # fmt: skip
"""Letters as seven rows of five bits each, in hexadecimal; the highest bit is on the left."""

EMBLEMS = ("disc", "star", "heart", "peaks", "sun", "diamond", "bolt", "ring")
"""Names of the shapes that are printed, see `emblem`."""


def bitmap(text: str) -> Bool[np.ndarray, "7 w"]:
    """Returns the cells (7, 6 n) of n letters, true where ink is. Unknown letters are blank."""
    cells = np.zeros((_ROWS, _ADVANCE * len(text)), bool)
    for i, letter in enumerate(text):
        code = bytes.fromhex(_ALPHABET.get(letter, "00" * _ROWS))
        for row, bits in enumerate(code):
            cells[row, _ADVANCE * i : _ADVANCE * i + 5] = [bits >> (4 - k) & 1 for k in range(5)]
    return cells


def _random_text(rng: np.random.Generator) -> str:
    """Draws a word, a number, a year or a made-up name."""
    kind = rng.random()
    if kind < 0.4:
        words = "OCEAN NORTH WILD NOVA CITY PEAK LOOP SUNNY TEAM RIVER ZERO MAGIC HELLO FOX"
        return str(rng.choice(words.split()))
    if kind < 0.6:
        if rng.random() < 0.5:
            return str(rng.integers(1, 100))
        return str(rng.integers(1950, 2030))
    word = ""
    for _ in range(rng.integers(2, 4)):
        word += str(rng.choice(list("BDFGKLMNPRSTVZ"))) + str(rng.choice(list("AEIOU")))
    return word


def written(cells: Bool[np.ndarray, "7 w"], x: Field, y: Field) -> Field:
    """Returns how much ink of a word is at each point (n,), 0 to 1. Edges are rounded.

    cells: as `bitmap` returns them. x, y: how far the points are to the right of the lower left
    corner of the word, and above it, in cells, (n,).
    """
    padded = np.pad(cells.astype(np.float32), 1)
    column = np.clip(x + 0.5, 0, padded.shape[1] - 1.001)
    row = np.clip(_ROWS - y + 0.5, 0, padded.shape[0] - 1.001)
    i, k = np.floor(row).astype(int), np.floor(column).astype(int)
    u, w = row - i, column - k
    top = padded[i, k] * (1 - w) + padded[i, k + 1] * w
    bottom = padded[i + 1, k] * (1 - w) + padded[i + 1, k + 1] * w
    return np.clip(((top * (1 - u) + bottom * u) - 0.45) / 0.2 + 0.5, 0, 1).astype(np.float32)


def emblem(kind: str, x: Field, y: Field, points: int = 5) -> Field:
    """Returns how far points are inside of an emblem (n,), negative outside.

    The emblem has a radius of about 1 around x = y = 0. kind: one of EMBLEMS. points: number of
    tips of a star.
    """
    r, a = np.sqrt(x * x + y * y), np.arctan2(x, y)
    if kind == "disc":
        return 1 - r
    if kind == "ring":
        return 0.18 - np.abs(r - 0.8)
    if kind == "star":
        wedge = np.abs((a / (2 * np.pi) * points + 0.5) % 1 - 0.5) * (2 * np.pi / points)
        inner, half = 0.42, np.pi / points
        # the edge from the tip (1, 0) to the notch (inner cos half, inner sin half)
        nx, ny = inner * np.sin(half), 1 - inner * np.cos(half)
        return (nx - (r * np.cos(wedge) * nx + r * np.sin(wedge) * ny)) / np.hypot(nx, ny)
    if kind == "heart":
        v = y + 0.15 - 0.65 * np.sqrt(np.abs(x))
        return 0.5 * (0.85 - np.sqrt(x * x + v * v))
    if kind == "peaks":
        ridge = np.maximum(0.8 - 1.3 * np.abs(x + 0.25), 0.45 - 1.2 * np.abs(x - 0.5)) - 0.2
        return np.minimum(ridge - y, y + 0.6) * 0.7
    if kind == "sun":
        rays = 0.55 + 0.35 * (np.cos(12 * a) > 0.2)
        return rays - r
    if kind == "diamond":
        return 0.7 * (1 - np.abs(x) * 1.3 - np.abs(y))
    slant = x + 0.35 * y - 0.25 * np.sign(y)
    return np.minimum(0.28 - np.abs(slant), 1 - np.abs(y))  # bolt


def _trunk(s: Spots) -> Field:
    """Returns 1 for points on the trunk and 0 for points on limbs, (n,)."""
    return band(s.cloth[:, 3], 0.13, 1.0, 0.01)


def _from_the_side(s: Spots) -> Field:
    """Returns the distance of points from the side of the trunk or limb, (n,), metres. Of the two
    sides the nearer one counts.
    """
    return np.abs(np.abs(s.around) - 0.5 * np.pi * s.cloth[:, 3])


def _darker(colors: Points, share: float | Float[np.ndarray, "n 1"], where: Field) -> Points:
    return mix(colors, colors * share, where)


def _seamed(colors: Points, s: Spots) -> Points:
    """Adds seams down the sides of trunk and limbs, and around the armholes."""
    armhole = np.where(s.template[:, 1] > -0.02, np.abs(np.abs(s.template[:, 0]) - ARMHOLE), 1.0)
    return _darker(
        colors, 0.8, np.maximum(band(_from_the_side(s), -1, 0.0022), band(armhole, -1, 0.0024))
    )


def _hemmed(colors: Points, s: Spots, hem: float, sleeve: float | None) -> Points:
    """Adds stitches at the height y = hem on trunk or legs, and at |x| = sleeve on arms.

    hem, sleeve: template coordinates. If `sleeve` is None, there are no stitches on arms.
    """
    x, y, _ = s.template.T
    on_arm = np.abs(x) > 0.2
    line = band(np.abs(y - hem), 0.0, 0.002) * ~on_arm
    if sleeve is not None:
        line = np.maximum(line, band(np.abs(np.abs(x) - sleeve), 0.0, 0.002) * on_arm)
    return _darker(colors, 0.8, line)


def _printed(colors: Points, s: Spots, rng: np.random.Generator, garment: Garment) -> Points:
    """Adds a print on the chest, and sometimes on the back.

    The print is a number, words, an emblem, words and an emblem, a small logo or a picture.
    """
    # everything is drawn first, so that front and back show the same print
    number, base = "number" in garment.details, garment.fabric.base
    ink = accent(rng, base)
    ink2 = accent(rng, ink)
    kind = "number"
    if not number:
        odds = {"words": 0.3, "emblem": 0.22, "both": 0.22, "logo": 0.13, "picture": 0.13}
        kind = str(rng.choice(list(odds), p=list(odds.values())))
    cells = bitmap(str(rng.integers(0, 100)) if number else _random_text(rng))
    width = cells.shape[1] - 1
    cell = min(rng.uniform(0.17, 0.26) / width, 0.026 if number else 0.014)
    height = rng.uniform(-0.05, 0.02)
    shape, points = str(rng.choice(EMBLEMS)), int(rng.integers(5, 8))
    size, seed = rng.uniform(0.05, 0.085), int(rng.integers(1 << 20))
    on_back, framed = number or rng.random() < 0.25, rng.random() < 0.3

    def words(x, y):
        return written(cells, x / cell + 0.5 * width, y / cell + 0.5 * _ROWS)

    def badge(x, y, size):
        return emblem(shape, x / size, y / size, points)

    # paint the print once, around its own middle
    def motif(result, x, y, where):
        """Returns colors with the print. x, y: places of the points relative to the middle of the
        print, metres. where: share of the print at each point, 0 to 1.
        """
        if kind in ("words", "number"):
            if framed and kind == "words":
                box = band(np.abs(x), -1, (0.5 * width + 1.5) * cell) * band(
                    np.abs(y), -1, 5.5 * cell
                )
                result = mix(result, ink2, box * where)
            return mix(result, ink, words(x, y) * where)
        if kind == "logo":
            return mix(
                result, ink, np.clip(badge(x - 0.075, y - 0.04, 0.02) * 8 + 0.5, 0, 1) * where
            )
        # a picture is noise in three colors
        if kind == "picture":
            inside = band(np.maximum(np.abs(x), 0.8 * np.abs(y)), -1, 1.2 * size)
            scene = lattice(np.stack([x / 0.05, y / 0.03], -1), seed)
            drawn = mix(
                mix(ink, ink2, (scene > 0.45).astype(np.float32)), base, band(scene, 0.62, 2, 0.02)
            )
            return mix(result, drawn, inside * where)
        inside = badge(x, y - 0.35 * size * (kind == "both"), size) * size / 0.0015 + 0.5
        result = mix(result, ink, np.clip(inside, 0, 1) * where)
        if kind == "both":
            result = mix(result, ink2, words(x * 1.25, (y + size * 1.1 + 5 * cell) * 1.25) * where)
        return result

    # the chest, and on the back mirrored, so that words can be read
    trunk, x, y = _trunk(s), 1.1 * s.template[:, 0], s.template[:, 1] - height
    result = motif(colors, x, y, trunk * (s.cloth[:, 2] > 0))
    if on_back:
        return motif(result, -x, y - 0.02, trunk * (s.cloth[:, 2] < 0))
    return result


def _side_striped(colors: Points, s: Spots, rng: np.random.Generator, garment: Garment) -> Points:
    """Adds one to three stripes down the outside of arms and legs."""
    ink, count = accent(rng, garment.fabric.base), int(rng.integers(1, 4))
    girth, wide = s.cloth[:, 3], 0.022 / count
    turned = np.where(s.template[:, 0] > 0, s.around, -s.around)
    outside = np.where(girth > 0.1, _from_the_side(s), 0)
    outside = np.where(girth < 0.12, turned - 0.5 * np.pi * girth, outside)
    phase = (outside + 0.011) / wide
    stripes = (
        band((phase % 1) * wide, 0.0, 0.6 * wide)
        * (np.floor(phase) >= 0)
        * (np.floor(phase) < count)
    )
    return mix(colors, ink, stripes * band(girth, 0.0, 0.12, 0.01))


def _ribbed(colors: Points, s: Spots, _rng: np.random.Generator, garment: Garment) -> Points:
    """Adds knitted bands at the hem and the cuffs, a little darker than the cloth. Their ribs run
    along the trunk and the sleeves.
    """
    x, width = np.abs(s.template[:, 0]), 0.04
    at_hem = s.template[:, 1] < garment.sizes["bottom"] + 1.3 * width
    inside = np.where(x > 0.2, x > garment.sizes["sleeve"] - width, at_hem)
    ribs = 0.86 + 0.1 * np.cos(2 * np.pi * s.around / 0.009)
    return _darker(colors, ribs[:, None], inside.astype(np.float32))


def _quilted(colors: Points, s: Spots, _rng: np.random.Generator, _garment: Garment) -> Points:
    """Adds dark stitched lines around the garment, one every `QUILT` metres."""
    phase = (s.along / QUILT) % 1
    return _darker(colors, 0.55, np.exp(-((np.minimum(phase, 1 - phase) * QUILT / 0.006) ** 2)))


def _buttoned(colors: Points, s: Spots, rng: np.random.Generator, garment: Garment) -> Points:
    """Adds a placket with buttons down the front."""
    high = 0.2
    low = garment.sizes["end" if garment.kind in DRESSES else "bottom"]
    if garment.kind == "polo":
        low = 0.02
    dyed = rng.random() < 0.3
    if dyed:
        ink = accent(rng, garment.fabric.base)
    else:
        ink = color(0.1, 0.1, rng.choice([0.12, 0.8]))
    pitch, size = rng.uniform(0.07, 0.1), rng.uniform(0.005, 0.0075)
    x, y = s.cloth[:, 0], s.cloth[:, 1]
    front = (s.cloth[:, 2] > 0) * _trunk(s) * band(y, low, high)
    button = band(np.sqrt(x * x + ((y - low) % pitch - 0.5 * pitch) ** 2), -1, size) * front
    return mix(_darker(colors, 0.6, band(np.abs(x - 0.002), 0.0135, 0.016) * front), ink, button)


def _zipped(colors: Points, s: Spots, rng: np.random.Generator, garment: Garment) -> Points:
    """Adds a zip down the front, or one half of a zip along each edge of an open front."""
    ink = color(0.1, 0.05, rng.choice([0.15, 0.6, 0.75]))
    edge = max(garment.sizes.get("gap", 0.0), 0.0)
    front = (s.cloth[:, 2] > 0) * _trunk(s) * band(s.cloth[:, 1], garment.sizes["bottom"], 0.2)
    away = np.abs(np.abs(s.cloth[:, 0]) - edge)
    return mix(
        _darker(colors, 0.55, band(away, 0.004, 0.011) * front), ink, band(away, -1, 0.0035) * front
    )


def _boundary(x: Field, y: Field, half_width: float, half_height: float) -> Field:
    return band(np.abs(np.maximum(np.abs(x) - half_width, np.abs(y) - half_height)), -1, 0.0018)


def _pocketed(
    colors: Points, s: Spots, rng: np.random.Generator, _garment: Garment, kind: str
) -> Points:
    """Adds the stitched outlines of pockets.

    kind: "chest", "jacket" (in front), "jeans" (front and back) or "cargo" (on the thighs).
    """
    sides = rng.choice([1, 2]) if kind == "chest" else 2
    bright = 1.6 if kind == "jeans" and rng.random() < 0.5 else 0.6
    x, y, front = s.template[:, 0], s.template[:, 1], s.cloth[:, 2] > 0
    if kind == "chest":
        own = x > 0 if sides == 1 else np.abs(x) > 0
        line = _boundary(np.abs(x) - 0.075, y - 0.0, 0.042, 0.048) * front * own * _trunk(s)
    elif kind == "jacket":
        line = (
            band(np.abs(np.abs(x) - 0.09 + 0.3 * (y + 0.2)), -1, 0.0035)
            * band(y, -0.27, -0.15)
            * front
        )
    elif kind == "jeans":
        curve = np.abs((np.abs(x) - 0.16) ** 2 + ((y + 0.25) * 0.9) ** 2 - 0.0065) / 0.16
        fly = band(np.abs(x - 0.018), -1, 0.0018) * band(y, -0.36, -0.2)
        line = np.maximum(band(curve, -1, 0.0022) * band(y, -0.36, -0.22), fly) * front
        line = np.maximum(line, _boundary(np.abs(x) - 0.075, y + 0.315, 0.052, 0.06) * ~front)
    else:
        side, on_leg = _from_the_side(s), s.cloth[:, 3] < 0.12
        flap = band(np.abs(y + 0.57), -1, 0.002) * (side < 0.06)
        line = np.maximum(_boundary(side, y + 0.62, 0.06, 0.08), flap) * on_leg
    return mix(colors, np.clip(colors * bright, 0, 0.85), 0.75 * line)


def banded(colors: Points, s: Spots, ink: np.ndarray, low: float, high: float) -> Points:
    """Adds a sash or waistband of color `ink` between two heights of the trunk."""
    return mix(colors, ink, band(s.cloth[:, 1], low, high) * band(s.cloth[:, 3], 0.1, 1.0, 0.01))


def _sashed(colors: Points, s: Spots, rng: np.random.Generator, garment: Garment) -> Points:
    """Adds a sash around the waist of a coat or a dress."""
    if garment.kind == "coat":
        return banded(colors, s, garment.fabric.base * 0.6, WAIST - 0.02, WAIST + 0.02)
    waist = garment.sizes["waist"]
    return banded(colors, s, garment.fabric.other, waist - 0.01, waist + rng.uniform(0.02, 0.05))


def _turned_up(colors: Points, s: Spots, _rng: np.random.Generator, garment: Garment) -> Points:
    """Adds turned-up hems of trouser legs, which show the paler inner side of the cloth."""
    pale = (0.5 * garment.fabric.base + 0.35).astype(np.float32)
    return mix(colors, pale, band(s.template[:, 1], -9.0, garment.sizes["end"] + 0.045))


_SEWN_ON = (
    (PADDED, None, _quilted),
    (TOPS, "pocket", _pocketed, "chest"),
    (("denim_jacket",), "pockets", _pocketed, "chest"),
    ({*OUTER} - {"denim_jacket"}, "pockets", _pocketed, "jacket"),
    (BOTTOMS, "pockets", _pocketed, "jeans"),
    (("cargo",), None, _pocketed, "cargo"),
    (("shirt", "blouse"), "closed collar", _buttoned),
    (("denim_jacket", "blazer", "cardigan", "coat"), "closed", _buttoned),
    (("polo", "shirt_dress"), None, _buttoned),
    (("hoodie",), "zip", _zipped),
    (("jacket", "puffer", "hooded_jacket", "vest"), None, _zipped),
    (("coat", *DRESSES), "sash", _sashed),
    (("jeans",), "turn_up", _turned_up),
)
"""Each row has kinds of garments; the detail that such a garment needs to have the trimming (None:
all have it); the function of the trimming; and further arguments of the function, if there are any.
The order matters, because all trimmings of a garment draw from one generator.
"""


def sewn(
    garment: Garment, hem: float, sleeve: float | None = None, seams: bool = True
) -> Callable[[Spots], Points]:
    """Returns a function that gives the colors (n, 3) of points of a garment.

    The colors are those of the fabric with stitches at the hem, and with seams, ribs, a print,
    stripes and trimmings of `_SEWN_ON` if the garment has them.

    hem: template height of the stitches at the hem. sleeve: |x| of the stitches at the cuffs. None:
    there are no cuffs and no ribs. seams: whether there are seams.
    """
    details = garment.details
    if "collar" in details and "open" not in details:
        details = details | {"closed collar"}

    def colors(s):
        rng = garment.fabric.rng(1)
        result = _hemmed(garment.fabric.colors(s), s, hem, sleeve)
        if seams:
            result = _seamed(result, s)
        if "ribbed" in details and sleeve is not None:
            result = _ribbed(result, s, rng, garment)
        if details & {"print", "number"}:
            result = _printed(result, s, rng, garment)
        if "side_stripe" in details:
            result = _side_striped(result, s, rng, garment)
        rng = garment.fabric.rng(2)
        for kinds, detail, trimming, *arguments in _SEWN_ON:
            if garment.kind in kinds and (detail is None or detail in details):
                result = trimming(result, s, rng, garment, *arguments)
        return result

    return colors


def leather(s: Spots, garment: Garment) -> Points:
    """Returns the colors of shoes (n, 3): upper, sole, laces, and details of the kind of shoe."""
    # colors of sole and laces; the order of the draws is part of the seed
    rng, kind, base = garment.fabric.rng(2), garment.kind, garment.fabric.base
    white, sneakers = rng.random() < 0.75, kind == "sneakers"
    dark = base * rng.uniform(0.35, 0.6)
    trim = dark
    if sneakers:
        trim = color(0.1, 0.05, 0.82 if white else 0.1)
    second = trim
    if rng.random() < 0.5:
        second = accent(rng, base)
    laced = sneakers or (kind in ("flats", "ankle_boots") and rng.random() < 0.6)
    swoosh, toe = rng.uniform(0.2, 0.8), sneakers and rng.random() < 0.5
    if kind == "ankle_boots" and rng.random() < 0.3:
        base, trim = color(0.095, 0.6, 0.6), color(0.08, 0.6, 0.25)
    # painted from the upper outwards: stripe at the side, toe cap, laces and tongue, sole
    y, x, z = s.cloth[:, 1], np.abs(s.cloth[:, 0]), s.cloth[:, 2]
    result = np.broadcast_to(base, (len(y), 3)).astype(np.float32)
    if sneakers:
        side = band(np.abs(y - 0.045 - swoosh * (z - 0.04)), -1, 0.011, 0.003) * band(
            z, -0.05, 0.12, 0.003
        )
        result = mix(result, second, side * (x > 0.022))
    if toe:
        result = mix(result, trim, band(z, 0.135, 1.0, 0.004))
    if laced:
        narrow, high = band(x, -1, 0.019), band(y, 0.03, 1.0)
        laces = band((z / 0.015) % 1 * 0.015, 0, 0.006) * narrow * band(z, 0.03, 0.11) * high
        shaft = band((y / 0.017) % 1 * 0.017, 0, 0.006) * narrow * (z > 0.02) * band(y, 0.09, 1.0)
        tongue = band(x, -1, 0.026) * (z > 0.025) * band(z, -1, 0.115) * high
        result = mix(_darker(result, 0.75, tongue), trim, np.maximum(laces, shaft))
    return mix(result, base * 0.3 if kind == "flats" else trim, band(y, -1, 0.004, 0.002))


def buckled(s: Spots, garment: Garment) -> Points:
    """Returns the colors (n, 3) of a belt with stitched edges, holes, and a buckle in front."""
    width = garment.sizes["width"]
    x = s.template[:, 0]
    y = s.template[:, 1] - (garment.sizes["top"] - 0.5 * width)
    front = s.cloth[:, 2] > 0
    if width > 0.035:
        metal = color(0.12, 0.3, 0.62)
    else:
        metal = color(0.6, 0.05, 0.6)
    result = _darker(
        garment.fabric.colors(s), 0.6, band(np.abs(np.abs(y) - 0.38 * width), -1, 0.0012)
    )
    frame = np.maximum(np.abs(x) / 0.026, np.abs(y) / (0.56 * width))
    holes = band(np.abs(x - 0.06) % 0.03, -1, 0.003) * band(np.abs(y), -1, 0.003) * (x > 0.03)
    return _darker(mix(result, metal, band(frame, 0.68, 1.02, 0.06) * front), 0.3, holes * front)


def bagged(s: Spots, garment: Garment) -> Points:
    """Returns the colors (n, 3) of a bag with a zip around the top and a front pocket.

    The template coordinates of a bag are positions in a box from -1 to 1.
    """
    rng, base = garment.fabric.rng(2), garment.fabric.base
    ink = color(0.1, 0.05, rng.choice([0.1, 0.7]))
    second = accent(rng, base) if rng.random() < 0.3 else base * 0.8
    x, y, z = s.template.T
    pocket = band(np.abs(x), -1, 0.72, 0.02) * (z > 0.3)
    result = mix(garment.fabric.colors(s), second, band(y, -0.8, 0.05, 0.02) * pocket)
    result = mix(result, ink, band(np.abs(y - 0.05), -1, 0.025, 0.02) * pocket)
    return mix(result, ink, band(np.abs(y - 0.72), -1, 0.025, 0.02) * (z > -0.2))
