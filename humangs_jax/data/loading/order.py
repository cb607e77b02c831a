"""The order of examples, and mixtures of sources: pure functions of (seed, number), so that a run resumes from its step alone.

Example e = step * batch + i is the i-th of its batch. Each purpose draws from a stream of its own.
"""

import dataclasses
import functools
from collections.abc import Mapping, Sequence

import numpy as np

from humangs_jax.core.array_types import Int
from humangs_jax.data.loading.examples import Example, Source

ORDER_STREAM, VIEW_STREAM, BATCH_STREAM, MIX_STREAM, SUBJECT_STREAM = range(5)
"""First entry of the seeds: what a generator is for, so that no two purposes share random numbers."""

MIX_BLOCK = 256
"""Examples over which the shares of mixed sources are exact; smaller shares than one in a block are made one."""


def subject_order(seed: int, epoch: int, count: int) -> Int[np.ndarray, " count"]:
    """The order of subjects in one pass over them."""
    return np.random.default_rng([ORDER_STREAM, seed, epoch]).permutation(count)


def view_generator(seed: int, index: int) -> np.random.Generator:
    """The random generator for the views of the index-th example of a source."""
    return np.random.default_rng([VIEW_STREAM, seed, index])


def input_count_at(seed: int, step: int, counts: Sequence[int]) -> int:
    """Number of input views of a step."""
    return counts[int(np.random.default_rng([BATCH_STREAM, seed, step]).integers(len(counts)))]


def block_counts(weights: Sequence[float | int]) -> Int[np.ndarray, " sources"]:
    """How many of `MIX_BLOCK` examples come from each source; every source has at least one.

    Raises: ValueError unless the weights are positive and finite.
    """
    shares = np.asarray(weights, np.float64)
    if len(shares) == 0 or len(shares) > MIX_BLOCK or not (np.isfinite(shares).all() and (shares > 0).all()):
        raise ValueError(f"weights of mixed sources: expected positive numbers, got {list(weights)}")
    exact = MIX_BLOCK * shares / shares.sum()
    counts = np.maximum(np.floor(exact), 1).astype(int)
    while counts.sum() != MIX_BLOCK:  # by largest remainder
        step = 1 if counts.sum() < MIX_BLOCK else -1
        error = step * (exact - counts)
        counts[np.argmax(np.where(counts + step >= 1, error, -np.inf))] += step
    return counts


def source_at(seed: int, index: int, counts: Int[np.ndarray, " sources"]) -> tuple[int, int]:
    """(which source the index-th example comes from, its number among the examples of that source).

    Blocks of `MIX_BLOCK` examples are permutations of the same multiset: shares are exact over every block, and each source
    provides its own examples 0, 1, 2, ... without a gap.
    """
    block, position = divmod(index, MIX_BLOCK)
    labels = np.repeat(np.arange(len(counts)), counts)
    labels = np.random.default_rng([MIX_STREAM, seed, block]).permutation(labels)
    source = int(labels[position])
    return source, block * int(counts[source]) + int((labels[:position] == source).sum())


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Sources mixed by weight, see `source_at`; weights: one positive number each, relative to each other.

    Raises: ValueError if there are not as many weights as sources, one is not positive, or the sources disagree on
    `input_counts` (a step has one).
    """

    sources: tuple[Source, ...]
    weights: tuple[float | int, ...]

    def __post_init__(self):
        if len(self.sources) != len(self.weights):
            raise ValueError(f"{len(self.sources)} sources, but {len(self.weights)} weights")
        block_counts(self.weights)
        if len({source.input_counts for source in self.sources}) > 1:
            raise ValueError(f"input_counts differ: {[source.input_counts for source in self.sources]}")

    @functools.cached_property
    def _counts(self) -> Int[np.ndarray, " sources"]:
        return block_counts(self.weights)

    @property
    def input_counts(self) -> tuple[int, ...]:
        """Numbers of input views that a step may draw."""
        return self.sources[0].input_counts

    @property
    def broken(self) -> Mapping[str, str]:
        """What is left out so far, of all sources."""
        return {name: problem for source in self.sources for name, problem in source.broken.items()}

    def __len__(self) -> int:
        return sum(len(source) for source in self.sources)

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """See `Source`."""
        source, number = source_at(seed, index, self._counts)
        return self.sources[source].example(seed, number, input_count)

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """See `Source`."""
        source, number = source_at(seed, index, self._counts)
        return self.sources[source].describe(seed, number, input_count)
