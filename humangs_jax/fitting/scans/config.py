"""Settings of a fit to a scan, and its rounds."""

import dataclasses

from humangs_jax.fitting.scans.rounds import Round


@dataclasses.dataclass(frozen=True)
class ScanFitConfig:
    """Settings of a fit to a scan; lengths in metres of a person.

    samples: points taken from the scan. points: of them, and of the body's vertices, that look for partners; coarse_points:
    likewise while starts are compared. effective: of how many independent points all of them have the weight, bare and clothed:
    errors of a surface are alike side by side. skin: standard deviation of a scan on bare skin, and of a body that pokes out of
    clothes. cloth: of clothes outside of the skin. joint_spread: of given joints. starts: that are followed. turned: how
    many of the best are followed the other way round as well. steps: of the solver in a round. shapes: coefficients fitted.
    """

    samples: int = 30_000
    points: int = 2500
    coarse_points: int = 600
    effective: tuple[float, float] = (1500.0, 300.0)
    skin: float = 0.004
    cloth: float = 0.015
    joint_spread: float = 0.01
    starts: int = 16
    turned: int = 2
    steps: int = 4
    shapes: int = 32


DEFAULT_CONFIG = ScanFitConfig()
LANDMARK_ROUNDS = (0.2, 0.1, 0.05, 0.02, 0.01)
"""Metres: standard deviations of given joints while a body is brought to them."""
LANDMARK_STEPS = 5
"""Of the solver in each of these."""
COARSE = (
    *(Round(1.0, 0.4, 3.0), Round(0.6, 0.3, 3.0), Round(0.5, 0.3, 2.0), Round(0.4, 0.2, 2.0)),
    *(Round(0.3, 0.15), Round(0.3, 0.15), Round(0.2, 0.1), Round(0.2, 0.1), Round(0.15, 0.07), Round(0.15, 0.07)),
)
"""Rounds that a start of the search is followed for."""
CLOSER = COARSE[4:]
"""Rounds of the best one with all its joints."""
FINE = (Round(0.15, 0.07), Round(0.1, 0.05), Round(0.1, 0.03), Round(0.08, 0.03), *(Round(0.05, 0.02),) * 6)
"""The last rounds."""
COARSE_NORMAL, FINE_NORMAL = 0.06, 0.02
"""Metres that a difference of 1 between normals counts like: where limbs are to be found, and where fingers are."""
LEAST_CUT = 0.03
"""Of clothed people, since folds are so deep."""
LOOSE = 0.01
"""Metres: standard deviation of the skin, on both sides, while starts are compared."""
SETTLED = 0.02
"""Share of the cost that the last round may still gain if the fit is to count as converged."""
