"""People of a bank (`synthetic.live`) as a source; apart, so that who loads files does not import the generator."""

import dataclasses

import jax

from humangs_jax.data.loading.generated import GeneratedSource
from humangs_jax.data.synthetic.live import LiveConfig, live_example
from humangs_jax.data.synthetic.live_bank import PeopleBank


def bank_source(
    bank: PeopleBank, config: LiveConfig, input_counts: tuple[int, ...] | None = None, on_host: bool = False
) -> GeneratedSource:
    """People of a bank (see `synthetic.live`), of the bank's own split.

    input_counts: numbers of input views; that of the configuration if not given. Each compiles once.
    """
    draw = jax.jit(live_example, static_argnames="config")
    make = lambda key, count: draw(bank, key, dataclasses.replace(config, input_views=count))
    return GeneratedSource(make, bank.split, input_counts or (config.input_views,), on_host)
