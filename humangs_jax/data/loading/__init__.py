"""Makes batches. The people and views of a step are a pure function of (seed, step), so that a run
that resumes sees the same batches.

A `Source` gives examples by number. `CaptureSource` has people on disk (capture folders, written
synthetic sets, data sets), `GeneratedSource` people who are made on the fly from keys, and
`Mixture` several sources by weight. `Loader` makes batches of the examples of one source. Each
process makes the rows of its devices, some batches ahead of the loop. Several threads make the
examples. One thread stacks them and puts the batches on the devices, in their order. Threads
suffice, because decoding and jitted functions release the interpreter's lock.
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
"""The number of further batches that are prepared while the loop works on one batch."""


@dataclasses.dataclass
class Waiting:
    """The time for which a loop waited for its data."""

    seconds: float = 0.0
    """The total, seconds."""
    first_seconds: float = 0.0
    """How long the loop waited for the first item, seconds. The total includes this time."""
    items: int = 0
    """How many items the loop waited for."""

    def add(self, seconds: float) -> None:
        """Count one more item, and add the time for which the loop waited for it, seconds."""
        if self.items == 0:
            self.first_seconds = seconds
        self.seconds += seconds
        self.items += 1


@dataclasses.dataclass(frozen=True)
class Loader:
    """Batches from a source."""

    source: Source
    """The source of the examples."""
    batch_size: int = 1
    """The number of subjects in the global batch, over all processes."""
    seed: int = 0
    """The seed of the order of subjects and of the choice of views."""
    sharding: jax.sharding.Sharding | None = None
    """How a batch lies on the devices. Only its first axis may be split. A process makes the rows
    that its devices hold. A row that several processes hold is the same in all of them. None:
    everything is on the default device.
    """
    first_step: int = 0
    """The step whose first example has the number `first_example`. The examples of later steps are
    numbered from there. Earlier steps may have had batches of another size.
    """
    first_example: int = 0
    """The number of the first example of `first_step`."""
    threads: int = 4
    """The number of threads that make examples."""

    @property
    def rows(self) -> tuple[int, ...]:
        """The rows of the global batch that this process makes."""
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
        """Returns the number of input views of a step."""
        return input_count_at(self.seed, step, self.source.input_counts)

    def example_at(self, step: int, row: int) -> Example:
        """Returns row `row` of the global batch of a step."""
        return self.source.example(self.seed, self._number(step, row), self.input_count(step))

    def describe_at(self, step: int, row: int) -> str:
        """Returns in words the person and the views of row `row` of the global batch of a step."""
        return self.source.describe(self.seed, self._number(step, row), self.input_count(step))

    def _number(self, step: int, row: int) -> int:
        return self.first_example + (step - self.first_step) * self.batch_size + row

    def batch_at(self, step: int) -> Example:
        """Returns the batch of a step on the devices: an `Example` with a leading batch axis on
        every leaf.

        With a sharding, the leaves are global arrays. Without one, they are on the default device
        and hold all rows.
        """
        return self._place([self.example_at(step, row) for row in self.rows])

    def batches(
        self, start: int, stop: int, waiting: Waiting | None = None
    ) -> Generator[tuple[int, Example], None, None]:
        """Yields (step, batch) for start <= step < stop. Meanwhile threads make `AHEAD` further
        batches and put them on the devices.

        An error in a thread is raised here when its batch is due. Closing the generator (or leaving
        the loop over it) ends the threads. waiting: the time for which the loop waited for batches
        is added to it.
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
        """Stack the rows of this process, and put them on the devices."""
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
    """Returns stacked leaves. Leaves that are all on a device stay there."""
    on_device = all(isinstance(leaf, jax.Array) for leaf in leaves)
    if on_device:
        return jnp.stack(leaves)
    return np.stack([np.asarray(leaf) for leaf in leaves])
