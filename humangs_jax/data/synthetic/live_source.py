"""Banks of people as a source of the loader."""

import dataclasses
import functools

import jax

from humangs_jax.array_types import Key
from humangs_jax.data.loading.examples import Example
from humangs_jax.data.loading.generated import GeneratedSource
from humangs_jax.data.synthetic.live import LiveConfig, live_example
from humangs_jax.data.synthetic.live_bank import PeopleBank

jitted_example = functools.partial(jax.jit, static_argnames="config")(live_example)
"""`live_example`, compiled once per configuration and shape of the bank."""


def live_source(
    bank: PeopleBank, config: LiveConfig, input_counts: tuple[int, ...] = (4,), on_host: bool = False
) -> GeneratedSource:
    """Examples of a bank for `loader.Loader` and `loader.Mixture`: of people of the bank's split, whatever the key.

    input_counts replace `config.input_views`; each is compiled once. on_host: see `GeneratedSource`.
    """

    def make(key: Key, input_count: int) -> Example:
        return jitted_example(bank, key, config=dataclasses.replace(config, input_views=input_count))

    return GeneratedSource(make=make, split=bank.split, input_counts=input_counts, on_host=on_host)
