"""The loader: which people and views a step has is a pure function of (seed, step); a run that
resumes sees the same batches.

A `Source` has examples by number: `CaptureSource` (people on disk: capture folders, written
synthetic sets, data sets), `GeneratedSource` (people made on the fly from keys) and `Mixture`
(several of these by weight). `Loader` makes batches of one: each process the rows of its devices,
some batches ahead of the loop. Several threads make examples in order, one prepares the batches
that are asked for next. Threads suffice: decoding and jitted functions release the interpreter's
lock.
"""

import collections
import dataclasses
import itertools
import time
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array
from humangs_jax.data.loading.captures import CaptureCache, CaptureSource, PeopleCache
from humangs_jax.data.loading.examples import Example, Mixture, Source, ViewSampling, input_count_at

__all__ = [
    "CaptureCache",
    "CaptureSource",
    "Example",
    "Loader",
    "Mixture",
    "PeopleCache",
    "Source",
    "ViewSampling",
]

AHEAD = 2
"""Batches prepared while one is worked on."""


@dataclasses.dataclass
class Waiting:
    """How long a loop waited for its data."""

    seconds: float = 0.0
    """The total, seconds."""
    first_seconds: float = 0.0
    """What the first item took of it, seconds."""
    items: int = 0
    """How many items the loop waited for."""

    def add(self, seconds: float) -> None:
        """One more item."""
        if self.items == 0:
            self.first_seconds = seconds
        self.seconds += seconds
        self.items += 1


@dataclasses.dataclass(frozen=True)
class Loader:
    """Batches from a source."""

    source: Source
    """What makes the examples."""
    batch_size: int = 1
    """Subjects of the global batch, over all processes."""
    seed: int = 0
    """The seed of order and views."""
    sharding: jax.sharding.Sharding | None = None
    """How a batch lies on the devices (only its first axis may be split); a process makes the rows
    that its own devices hold, so that replicas hold equal rows. None: everything on the default
    device.
    """
    first_step: int = 0
    """The step that the numbering of examples starts at: steps before it had other batches."""
    first_example: int = 0
    """The number of the first example of that step."""
    threads: int = 4
    """The number of threads that make examples."""

    @property
    def rows(self) -> tuple[int, ...]:
        """Rows of the global batch that this process makes."""
        if self.sharding is None:
            return tuple(range(self.batch_size))
        parts = self.sharding.addressable_devices_indices_map((self.batch_size,)).values()
        return tuple(
            sorted(
                {
                    row
                    for part in parts
                    if part is not None
                    for row in range(self.batch_size)[part[0]]
                }
            )
        )

    def input_count(self, step: int) -> int:
        """Number of input views of a step."""
        return input_count_at(self.seed, step, self.source.input_counts)

    def example_at(self, step: int, row: int) -> Example:
        """Row `row` of the global batch of a step."""
        return self.source.example(self.seed, self._number(step, row), self.input_count(step))

    def describe_at(self, step: int, row: int) -> str:
        """Names the person and views of that row, in words."""
        return self.source.describe(self.seed, self._number(step, row), self.input_count(step))

    def _number(self, step: int, row: int) -> int:
        return self.first_example + (step - self.first_step) * self.batch_size + row

    def batch_at(self, step: int) -> Example:
        """The batch of a step on the devices: an `Example` with a leading batch axis on every leaf.

        With a sharding, global arrays; without one, the rows of this process.
        """
        return self._place([self.example_at(step, row) for row in self.rows])

    def batches(
        self, start: int, stop: int, waiting: Waiting | None = None
    ) -> Generator[tuple[int, Example], None, None]:
        """(step, batch) for start <= step < stop; `AHEAD` batches are made and put on the devices
        by threads meanwhile.

        Errors of the threads are raised here, in their turn. Closing the generator (or leaving the
        loop over it) ends them.
        waiting: the time that the loop waited for batches is added to it.
        """
        rows, begun = self.rows, collections.deque[list[Future]]()
        # one thread places batches on the devices, so that they get there in order
        with (
            ThreadPoolExecutor(self.threads, "humangs-loader") as readers,
            ThreadPoolExecutor(1, "humangs-loader") as placer,
        ):

            def begin(step: int) -> None:
                examples = [readers.submit(self.example_at, step, row) for row in rows]
                begun.append(
                    [
                        placer.submit(lambda: self._place([each.result() for each in examples])),
                        *examples,
                    ]
                )

            try:
                # the first batches; after these, one is begun for each that is taken
                for step in range(start, min(start + AHEAD, stop)):
                    begin(step)
                for step in range(start, stop):
                    if step + AHEAD < stop:
                        begin(step + AHEAD)
                    began = time.perf_counter()
                    batch = begun.popleft()[0].result()
                    if waiting is not None:
                        waiting.add(time.perf_counter() - began)
                    yield step, batch
            finally:
                # the caller has left the loop, or an example failed: what has not begun is not
                # needed
                for future in itertools.chain(*begun):
                    future.cancel()

    def _place(self, examples: list[Example]) -> Example:
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


def _stack(*leaves: Array | np.ndarray) -> Array | np.ndarray:
    """Leaves that are all on a device stay there."""
    on_device = all(isinstance(leaf, jax.Array) for leaf in leaves)
    if on_device:
        return jnp.stack(leaves)
    return np.stack([np.asarray(leaf) for leaf in leaves])
