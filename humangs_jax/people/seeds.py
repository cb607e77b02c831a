"""Which seeds and keys are for training, validation, test and documentation. The ranges share no person.

A seed names a person. Written people are made from the seed by numpy; people made on the fly from its keys, whose words are
(appearance, seed), so that the person, and the split, can be read off every key.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Key

GENERATOR_VERSION = 2
"""Raised whenever the same seed makes another person, pose or image. Manifests record it; sets of different versions are not
mixed in one folder."""

TRAIN = range(0, 1_000_000)
VALIDATION = range(1_000_000, 1_001_000)
TEST = range(2_000_000, 2_001_000)
"""Held out of training and of every choice made on the validation people."""
DEMO = range(3_000_000, 3_001_000)
"""People of the documentation and the tests."""
FITTING = range(4_000_000, 4_001_000)
"""People that fitting and refinement are tuned and measured on: no other result sees them."""
TRADEOFF = range(5_000_000, 5_001_000)
"""People that the presets of speed and accuracy are chosen on."""

SPLITS = {
    "train": TRAIN, "validation": VALIDATION, "test": TEST, "demo": DEMO, "fitting": FITTING, "tradeoff": TRADEOFF,
}  # fmt: skip

KEY_KIND = "threefry2x32"
"""Implementation of all keys of people: the words of such a key are its seed."""
APPEARANCES = 2**32


def split_of(seed: int) -> str:
    """Name of the range that a seed lies in. Raises ValueError if it lies in none."""
    for name, seeds in SPLITS.items():
        if seed in seeds:
            return name
    ranges = ", ".join(f"{name} {seeds.start}..{seeds.stop - 1}" for name, seeds in SPLITS.items())
    raise ValueError(f"seed {seed} lies in no range: {ranges}")


def seeds_of(split: str, first: int, count: int) -> range:
    """`count` seeds of a split from its `first`-th on. Raises ValueError if they reach beyond the split."""
    people = SPLITS[split]
    if first < 0 or count < 1 or first + count > len(people):
        asked = f"subjects {first}..{first + count - 1}"
        raise ValueError(f"{asked} reach beyond the split '{split}', which has {len(people)}")
    return people[first : first + count]


def subject_key(seed: int, appearance: int = 0) -> Key:
    """The key of a person; further appearances (other clothes, pose, light) have further keys.

    Raises: ValueError if the seed lies in no range of `SPLITS`.
    """
    split_of(seed)
    words = np.asarray([appearance % APPEARANCES, seed], np.uint32)
    return jax.random.wrap_key_data(jnp.asarray(words), impl=KEY_KIND)
