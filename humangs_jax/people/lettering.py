"""Letters, words and emblems printed on clothes, drawn by the package itself: a 5 x 7 alphabet and a few closed shapes."""

import numpy as np

from humangs_jax.core.array_types import Bool, Float

ROWS, ADVANCE = 7, 6
"""Cells of a letter: rows, and columns from one letter to the next."""

_ALPHABET = {
    "A": "0E11111F111111", "B": "1E11111E11111E", "C": "0E11101010110E", "D": "1E11111111111E", "E": "1F10101E10101F",
    "F": "1F10101E101010", "G": "0E11101711110F", "H": "1111111F111111", "I": "0E04040404040E", "J": "0702020202120C",
    "K": "11121418141211", "L": "1010101010101F", "M": "111B1515111111", "N": "11191513111111", "O": "0E11111111110E",
    "P": "1E11111E101010", "Q": "0E11111115120D", "R": "1E11111E141211", "S": "0F10100E01011E", "T": "1F040404040404",
    "U": "1111111111110E", "V": "11111111110A04", "W": "11111115151B11", "X": "11110A040A1111", "Y": "11110A04040404",
    "Z": "1F01020408101F", "0": "0E11131519110E", "1": "040C040404040E", "2": "0E11010608101F", "3": "1F02040601110E",
    "4": "02060A121F0202", "5": "1F101E0101110E", "6": "0608101E11110E", "7": "1F010204080808", "8": "0E11110E11110E",
    "9": "0E11110F01020C",
}  # fmt: skip
"""Seven rows of five bits each, in hexadecimal."""

WORDS = (
    "OCEAN",
    "NORTH",
    "WILD",
    "NOVA",
    "CITY",
    "PEAK",
    "LOOP",
    "SUNNY",
    "TEAM",
    "RIVER",
    "ZERO",
    "MAGIC",
    "HELLO",
    "FOX",
)
EMBLEMS = ("disc", "star", "heart", "peaks", "sun", "diamond", "bolt", "ring")


def bitmap(text: str) -> Bool[np.ndarray, "7 w"]:
    """(7, 6 n) cells of a word of n letters; unknown letters are blanks."""
    cells = np.zeros((ROWS, ADVANCE * len(text)), bool)
    for i, letter in enumerate(text):
        code = bytes.fromhex(_ALPHABET.get(letter, "00" * ROWS))
        for row, bits in enumerate(code):
            cells[row, ADVANCE * i : ADVANCE * i + 5] = [bits >> (4 - k) & 1 for k in range(5)]
    return cells


def random_text(rng: np.random.Generator) -> str:
    """A word, a year or a made-up name."""
    kind = rng.random()
    if kind < 0.4:
        return str(rng.choice(WORDS))
    if kind < 0.6:
        return str(rng.integers(1, 100)) if rng.random() < 0.5 else str(rng.integers(1950, 2030))
    syllables = [
        str(rng.choice(list("BDFGKLMNPRSTVZ"))) + str(rng.choice(list("AEIOU"))) for _ in range(rng.integers(2, 4))
    ]
    return "".join(syllables)


def written(
    cells: Bool[np.ndarray, "7 w"], x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """(n,) ink of a word at points given in cells from its lower left corner, x to the right, y up; edges are rounded."""
    padded = np.pad(cells.astype(np.float32), 1)
    column = np.clip(x + 0.5, 0, padded.shape[1] - 1.001)
    row = np.clip(ROWS - y + 0.5, 0, padded.shape[0] - 1.001)
    i, k = np.floor(row).astype(int), np.floor(column).astype(int)
    u, w = row - i, column - k
    top = padded[i, k] * (1 - w) + padded[i, k + 1] * w
    bottom = padded[i + 1, k] * (1 - w) + padded[i + 1, k + 1] * w
    return np.clip(((top * (1 - u) + bottom * u) - 0.45) / 0.2 + 0.5, 0, 1).astype(np.float32)


def emblem(
    kind: str, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], points: int = 5
) -> Float[np.ndarray, " n"]:
    """(n,) how far inside of an emblem of radius 1 or so: positive inside, in units of x and y. `points`: of a star."""
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
