"""Which seeds are for what. Written down once: people of one range are never seen in another."""

TRAIN = range(0, 1_000_000)
VALIDATION = range(1_000_000, 1_001_000)
TEST = range(2_000_000, 2_001_000)
"""Held out of training and of every choice made on the validation people."""
DEMO = range(3_000_000, 3_001_000)
"""People of the documentation and the tests."""

SPLITS = {"train": TRAIN, "validation": VALIDATION, "test": TEST, "demo": DEMO}


def split_of(seed: int) -> str:
    """Name of the range that a seed lies in. Raises ValueError if it lies in none."""
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    raise ValueError(
        f"seed {seed} lies in no range: {', '.join(f'{n} {r.start}..{r.stop - 1}' for n, r in SPLITS.items())}"
    )
