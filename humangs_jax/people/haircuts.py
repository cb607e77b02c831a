"""Hair as choices: cut, length, fringe, parting, beard. Geometry is in `hair`."""

import dataclasses

import numpy as np

CUTS = {
    "cropped": (0.22, 0.03),
    "short": (0.26, 0.10),
    "quiff": (0.10, 0.01),
    "curly": (0.08, 0.12),
    "afro": (0.05, 0.05),
    "buzz": (0.09, 0.01),
    "bald": (0.07, 0.004),
    "bob": (0.012, 0.17),
    "long": (0.025, 0.25),
    "ponytail": (0.02, 0.11),
    "bun": (0.03, 0.08),
    "braid": (0.01, 0.05),
}
"""Odds for men and women."""
LONG_CUTS = ("bob", "long")
FRINGES = {"straight": 0.28, "parted": 0.34, "side": 0.38}
"""Odds of what hangs over the forehead of longer hair."""
BEARDS = {"none": 0.5, "stubble": 0.2, "moustache": 0.05, "goatee": 0.09, "full": 0.16}
"""Odds for men."""


@dataclasses.dataclass(frozen=True)
class Haircut:
    """cut: one of CUTS. fringe: one of FRINGES. side: +1 or -1, of parting and braid. thickness in metres.

    bottom: template height where long hair ends. wave: height of its waves, metres. receding: shift of the hairline upwards.
    beard: one of BEARDS; beard_length in metres. grain: contrast of strands.
    """

    cut: str
    fringe: str
    side: float
    thickness: float
    bottom: float
    wave: float
    receding: float
    beard: str
    beard_length: float
    grain: float


def sample_haircut(rng: np.random.Generator, male: bool, years: float, worn: set[str]) -> Haircut:
    """A random cut that goes under what is worn on the head; old men lose hair."""
    odds = np.asarray([value[0 if male else 1] for value in CUTS.values()])
    names = list(CUTS)
    if male and years > 45:
        odds[names.index("bald")] *= 3.0
    if worn & {"cap", "beanie", "brim_hat", "headscarf"}:
        odds[[names.index(n) for n in ("curly", "afro", "quiff", "bun")]] = 0
    cut = str(rng.choice(names, p=odds / odds.sum()))
    thickness = {
        "cropped": rng.uniform(0.005, 0.010),
        "short": rng.uniform(0.012, 0.022),
        "quiff": rng.uniform(0.010, 0.016),
        "curly": rng.uniform(0.024, 0.045),
        "afro": rng.uniform(0.045, 0.085),
        "bob": rng.uniform(0.012, 0.024),
        "long": rng.uniform(0.010, 0.022),
    }.get(cut, 0.008)
    if worn & {"cap", "beanie", "brim_hat", "headscarf"}:
        thickness = min(thickness, 0.010)
    bottom = rng.uniform(0.15, 0.2) if cut == "bob" else rng.uniform(-0.17, 0.1)
    wave = rng.choice([rng.uniform(0.002, 0.004), rng.uniform(0.006, 0.014)], p=[0.55, 0.45])
    receding = rng.uniform(-0.004, 0.012 + 0.012 * (years > 45)) if male else rng.uniform(-0.006, 0.004)
    beards = np.asarray(list(BEARDS.values()))
    beard = str(rng.choice(list(BEARDS), p=beards / beards.sum())) if male and years > 17 else "none"
    long = 0.35 if rng.random() < 0.8 else 1.0
    return Haircut(
        cut=cut,
        fringe=str(rng.choice(list(FRINGES), p=list(FRINGES.values()))),
        side=float(rng.choice([-1, 1])),
        thickness=float(thickness),
        bottom=bottom,
        wave=float(wave),
        receding=receding,
        beard=beard,
        beard_length=rng.uniform(0.0025, 0.004) + long * rng.uniform(0.0, 0.016),
        grain=rng.uniform(0.5, 0.95),
    )
