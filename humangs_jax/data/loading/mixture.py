"""Several sources as one, each with its share of the examples."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from humangs_jax.core.array_types import Int
from humangs_jax.data.loading.examples import Example
from humangs_jax.data.loading.order import block_counts, source_at
from humangs_jax.data.loading.source import Source


@dataclasses.dataclass(frozen=True)
class Mixture:
    """Sources mixed by weight, see `order.source_at`; weights: one positive number each, relative to each other.

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
