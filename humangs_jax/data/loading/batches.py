"""Batches by step number: a pure function of (seed, step), each process making the rows that its devices hold."""

import dataclasses
from collections.abc import Generator

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.data.loading.examples import Example, Source
from humangs_jax.data.loading.order import input_count_at
from humangs_jax.data.loading.threads import Waiting, prefetched, read_in_order

AHEAD = 2
"""Batches prepared while one is worked on."""


@dataclasses.dataclass(frozen=True)
class Loader:
    """Batches from a source.

    batch_size: subjects of the global batch, over all processes. seed: of order and views.
    sharding: how a batch lies on the devices (only its first axis may be split); a process makes the rows that its own
        devices hold, so that replicas hold equal rows. None: everything on the default device.
    first_step, first_example: where the numbering of examples starts: those of steps before had other batches.
    process_index, process_count: where `sharding` is None, the part of the batch to make: equal runs of rows.
    threads: that make examples.

    Raises: ValueError if the batch cannot be divided among the processes.
    """

    source: Source
    batch_size: int = 1
    seed: int = 0
    sharding: jax.sharding.Sharding | None = None
    first_step: int = 0
    first_example: int = 0
    process_index: int = 0
    process_count: int = 1
    threads: int = 4

    def __post_init__(self):
        if self.batch_size % self.process_count or not 0 <= self.process_index < self.process_count:
            raise ValueError(
                f"a batch of {self.batch_size} cannot be divided among {self.process_count} processes "
                f"(this is {self.process_index})"
            )

    @property
    def rows(self) -> tuple[int, ...]:
        """Rows of the global batch that this process makes."""
        if self.sharding is None:
            share = self.batch_size // self.process_count
            return tuple(range(self.process_index * share, (self.process_index + 1) * share))
        parts = self.sharding.addressable_devices_indices_map((self.batch_size,)).values()
        return tuple(sorted({row for part in parts if part is not None for row in range(self.batch_size)[part[0]]}))

    def input_count(self, step: int) -> int:
        """Number of input views of a step."""
        return input_count_at(self.seed, step, self.source.input_counts)

    def example_at(self, step: int, row: int) -> Example:
        """Row `row` of the global batch of a step."""
        return self.source.example(self.seed, self._number(step, row), self.input_count(step))

    def describe_at(self, step: int, row: int) -> str:
        """Whom that row shows, in words."""
        return self.source.describe(self.seed, self._number(step, row), self.input_count(step))

    def _number(self, step, row):
        return self.first_example + (step - self.first_step) * self.batch_size + row

    def batch_at(self, step: int) -> Example:
        """The batch of a step on the devices: an `Example` with a leading batch axis on every leaf.

        With a sharding, global arrays; without one, the rows of this process.
        """
        return self._place([self.example_at(step, row) for row in self.rows])

    def batches(
        self, start: int, stop: int, waiting: Waiting | None = None
    ) -> Generator[tuple[int, Example], None, None]:
        """(step, batch) for start <= step < stop; `AHEAD` batches are made and put on the devices by threads meanwhile.

        Errors of the threads are raised here. Closing the generator (or leaving the loop over it) ends them.
        waiting: the time that the loop waited for batches is added to it.
        """

        def make():
            rows = self.rows
            examples = read_in_order(
                lambda i: self.example_at(start + i // len(rows), rows[i % len(rows)]),
                (stop - start) * len(rows),
                self.threads,
                AHEAD * len(rows),
            )
            try:
                for step in range(start, stop):
                    yield step, self._place([next(examples) for _ in rows])
            finally:
                examples.close()

        return prefetched(make, AHEAD, waiting)

    def _place(self, examples):
        """Stack the rows of this process and put them on the devices."""
        batch = jax.tree.map(_stack, *examples)
        sharding = self.sharding
        if sharding is None:
            return jax.tree.map(jnp.asarray, batch)
        position = {row: i for i, row in enumerate(self.rows)}

        def place(leaf):
            def shard(index):
                chosen = [position[row] for row in range(self.batch_size)[index[0]]]
                return leaf[chosen[0] : chosen[-1] + 1][(slice(None), *index[1:])]

            return jax.make_array_from_callback((self.batch_size, *leaf.shape[1:]), sharding, shard)

        return jax.tree.map(place, batch)


def _stack(*leaves):
    """Leaves that are all on a device stay there."""
    on_device = all(isinstance(leaf, jax.Array) for leaf in leaves)
    return jnp.stack(leaves) if on_device else np.stack([np.asarray(leaf) for leaf in leaves])
