"""Sources of people made on the fly: a pure function of a key, and keys that belong to one split."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Key
from humangs_jax.data.loading.examples import Example
from humangs_jax.data.loading.order import SUBJECT_STREAM
from humangs_jax.people.bank import PeopleBank
from humangs_jax.people.on_the_fly import ON_THE_FLY, OnTheFlyConfig, on_the_fly_example
from humangs_jax.people.seeds import SPLITS, subject_key
from humangs_jax.rendering.splatting import CPU_COMPILER_OPTIONS

MakeExample = Callable[[Key, int], Example]
"""(key, number of input views) -> Example; pure, usually jitted with the number static."""


@dataclasses.dataclass(frozen=True)
class GeneratedSource:
    """Examples that `make` computes from keys; all keys are of people of one split (`seeds.SPLITS`).

    make: called as make(key, input_count); runs wherever it is jitted to run. input_counts: see `ViewSampling`.
    on_host: bring the arrays to the host, where they mix with those of files and are divided among devices.

    Raises: ValueError if there is no such split.
    """

    make: MakeExample
    split: str = "train"
    input_counts: tuple[int, ...] = (4,)
    on_host: bool = False

    def __post_init__(self):
        if self.split not in SPLITS:
            raise ValueError(f"no split {self.split!r}: expected one of {', '.join(SPLITS)}")

    @property
    def broken(self) -> Mapping[str, str]:
        """Empty: there are no files."""
        return {}

    def __len__(self) -> int:
        return len(SPLITS[self.split])

    def drawn_key(self, seed: int, index: int) -> Key:
        """The key of the index-th example of a run: a random subject of the split, in its index-th appearance."""
        return subject_key(self._person(seed, index), index)

    def _person(self, seed, index):
        people = SPLITS[self.split]
        return people[int(np.random.default_rng([SUBJECT_STREAM, seed, index]).integers(len(people)))]

    def describe(self, seed: int, index: int, input_count: int) -> str:
        """See `Source`."""
        return f"synthetic person {self._person(seed, index)} in appearance {index}"

    def example(self, seed: int, index: int, input_count: int) -> Example:
        """See `Source`."""
        example = self.make(self.drawn_key(seed, index), input_count)
        return jax.tree.map(np.asarray if self.on_host else jnp.asarray, example)


def jitted_example(bank: PeopleBank, key: Key, config: OnTheFlyConfig = ON_THE_FLY) -> Example:
    """`on_the_fly_example`, compiled once per configuration and shape of the bank; with `CPU_COMPILER_OPTIONS` on a CPU."""
    return _compiled()(bank, key, config=config)


@functools.cache
def _compiled():
    options = CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
    return jax.jit(on_the_fly_example, static_argnames="config", compiler_options=options)


def on_the_fly_source(
    bank: PeopleBank, config: OnTheFlyConfig, input_counts: tuple[int, ...] = (4,), on_host: bool = False
) -> GeneratedSource:
    """Examples of a bank for `loader.Loader` and `loader.Mixture`: all of people of the bank's split.

    input_counts replace `config.input_views`; each is compiled once. on_host: see `GeneratedSource`.
    """

    def make(key: Key, input_count: int) -> Example:
        return jitted_example(bank, key, config=dataclasses.replace(config, input_views=input_count))

    return GeneratedSource(make=make, split=bank.split, input_counts=input_counts, on_host=on_host)
