"""The training step with one thing changed, in turns with the step as it is: `training/benchmark.py --variants`."""

import copy
import unittest.mock
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import Any

from experiments.common.compiled_costs import compiled_costs
from experiments.common.interleaved import medians
from experiments.training.case import Case, compiler_options, fresh_state

MEBI = 1 / 2**20


def variants(case: Case) -> dict[str, tuple[dict[str, Any], dict[str, Any] | None, bool]]:
    """Changes to the settings, compiler options, and whether convolutions are differentiated by XLA alone."""
    options = compiler_options()
    model = case.config.model
    return {
        "XLA's default compiler options": ({}, None, False),
        "with an upsampler": ({"upsampler": upsampler(model)}, options, False),
        "with an upsampler, convolutions as XLA differentiates them": ({"upsampler": upsampler(model)}, options, True),
        "all patches are tokens": ({"tokens": "all"}, options, False),
        "blocks recomputed, in a loop": ({"transformer": {"remat": True, "scan": True}}, options, False),
        "bfloat16": ({"dtype": "bfloat16"}, options, False),
    }


def upsampler(model: Any) -> Any:
    """One in proportion to the network."""
    from humangs_jax.network.upsampler import UpsamplerConfig

    width = model.transformer.width
    return UpsamplerConfig(hidden=width // 3, out=width)


def variant_numbers(
    case: Case, asked: Sequence[str], repeats: int, warm_up: int
) -> Iterator[tuple[str, dict[str, float]]]:
    """(name, numbers) of the variants asked for; of all if none is. `case.program` is the step as it is."""
    import jax

    from experiments.training.cases import with_model
    from humangs_jax.network import convolution

    for name in asked or list(variants(case)):
        fields, options, plain = variants(case)[name]
        changed = copy.copy(case)
        changed.config = with_model(case.config, **fields)
        changed.state = fresh_state(changed.config)
        with (
            unittest.mock.patch.object(convolution, "_convolve_on_cpu", convolution._convolve)
            if plain
            else nullcontext()
        ):
            program, seconds = changed.compiled(options)
        costs = compiled_costs(program)
        runs = {"as it is": lambda: case.run(case.program), name: lambda: changed.run(program)}  # noqa: B023, called in here
        times = medians(runs, repeats, warm_up)
        (_, base_cpu), (wall, cpu) = times["as it is"], times[name]
        yield (
            name,
            {
                "ms": float(wall),
                "cpu_ms": float(cpu),
                "as_it_is_cpu_ms": float(base_cpu),
                "flops": costs.matrix_flops,
                "temporary_mb": MEBI * costs.temporary_bytes,
                "compile_cpu_s": seconds,
            },
        )
        jax.clear_caches()  # the next one may differ in what is patched alone
