"""Banks of people as a source of the loader."""

import dataclasses
import functools

import jax

from humangs_jax.core.array_types import Key
from humangs_jax.data.loading.examples import Example
from humangs_jax.people.generated import GeneratedSource
from humangs_jax.people.live import DEFAULT_CONFIG, LiveConfig, live_example
from humangs_jax.people.live_bank import PeopleBank
from humangs_jax.rendering.splatting import CPU_COMPILER_OPTIONS


def jitted_example(bank: PeopleBank, key: Key, config: LiveConfig = DEFAULT_CONFIG) -> Example:
    """`live_example`, compiled once per configuration and shape of the bank; on a CPU with the options that suit drawing."""
    return _compiled()(bank, key, config=config)


@functools.cache
def _compiled():
    options = CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None
    return jax.jit(live_example, static_argnames="config", compiler_options=options)


def live_source(
    bank: PeopleBank, config: LiveConfig, input_counts: tuple[int, ...] = (4,), on_host: bool = False
) -> GeneratedSource:
    """Examples of a bank for `loader.Loader` and `loader.Mixture`: of people of the bank's split, whatever the key.

    input_counts replace `config.input_views`; each is compiled once. on_host: see `GeneratedSource`.
    """

    def make(key: Key, input_count: int) -> Example:
        return jitted_example(bank, key, config=dataclasses.replace(config, input_views=input_count))

    return GeneratedSource(make=make, split=bank.split, input_counts=input_counts, on_host=on_host)
