"""Parts of a training step, and the step with one thing changed: `training/benchmark.py --stages --variants`.

Each part is compiled by itself and timed in turns; a gradient of a part contains the part.
"""

import copy
import unittest.mock
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from typing import Any

from experiments.common.compiled_costs import compiled_costs
from experiments.common.interleaved import medians
from experiments.training.cases import Case, first, fresh_state

MEBI = 1 / 2**20


def variants(case: Case) -> dict[str, tuple[dict[str, Any], dict[str, Any] | None, bool]]:
    """Changes to the settings, compiler options, and whether convolutions are differentiated by XLA alone."""
    from humangs_jax.core.compiler_options import compiler_options

    options = compiler_options()
    model = case.config.model
    return {
        "XLA's default compiler options": ({}, None, False),
        "with an upsampler": ({"upsampler": upsampler(model)}, options, False),
        "with an upsampler, convolutions as XLA differentiates them": ({"upsampler": upsampler(model)}, options, True),
        "all patches are tokens": ({"tokens": "all"}, options, False),
        "blocks recomputed, in a loop": ({"remat": "full", "scan": True}, options, False),
        "bfloat16": ({"dtype": "bfloat16"}, options, False),
    }


def upsampler(model: Any) -> Any:
    """One in proportion to the network."""
    from humangs_jax.network.upsampler import UpsamplerConfig

    return UpsamplerConfig(hidden=model.architecture.encoder.transformer.width // 3)


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


def stage_numbers(case: Case, repeats: int, warm_up: int) -> dict[str, list[float]]:
    """(wall, CPU ms) of parts of a step, each a program; of reading a batch from kept images and from disk."""
    import jax

    from humangs_jax.core.compiler_options import compiler_options

    programs = {}
    for name, (function, inputs) in stages(case).items():
        program = jax.jit(function, compiler_options=compiler_options()).lower(*inputs).compile()
        programs[name] = lambda program=program, inputs=inputs: jax.block_until_ready(program(*inputs))
    fresh = lambda: case.source().example(0, 0, case.config.views.input_counts[0])
    programs["data, from disk"] = fresh
    programs["data, kept"] = lambda: jax.block_until_ready(case.loader.batch_at(0))
    times = medians(programs, repeats, warm_up)
    return {name: list(map(float, time)) for name, time in times.items()}


def stages(case: Case) -> dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]:
    """Functions and arguments of the parts, for one subject."""
    import jax
    import jax.numpy as jnp
    import optax

    from humangs_jax.core.compiler_options import compiler_options
    from humangs_jax.core.pytree import replace
    from humangs_jax.data.views import prepare_inputs
    from humangs_jax.network.humangs import decode, part_variables
    from humangs_jax.network.humangs import read as read_features
    from humangs_jax.training.forward import DrawnTargets, draw_targets, white_backgrounds
    from humangs_jax.training.optimizer import make_optimizer
    from humangs_jax.training.step import loss_terms

    config, body, networks, example = case.config, case.body, case.networks, first(case.batch)
    targets, variables = example.targets, {"params": case.state.params, "batch_stats": case.state.batch_stats}
    jit = lambda function, *inputs: jax.jit(function, compiler_options=compiler_options())(*inputs)
    pose = lambda views: prepare_inputs(body, views, config.model)
    inputs = jit(pose, example.inputs)

    def encode(params):
        own = part_variables({**variables, "params": params}, "encoder")
        return config.model.architecture.encoder.apply(own, inputs, config.model.run(train=True))[0]

    def read(params, encoding):
        own = {**variables, "params": params}
        features = read_features(own, encoding, inputs, config.model)
        return decode(own, features, inputs, config.model)

    def draw(outputs, gaussians):
        outputs = replace(outputs, gaussians=gaussians)
        return draw_targets(outputs, body, example.inputs, targets, white_backgrounds(targets), config).rendering

    def compare(outputs, drawn, rgb):
        terms = loss_terms(
            DrawnTargets(replace(drawn, rgb=rgb)), outputs, targets.images, targets, config.loss, networks
        )
        return sum(getattr(config.loss, name) * term for name, term in terms.items())

    def update(state):
        optimizer = make_optimizer(config.optimizer, config.steps)
        updates, opt_state = optimizer.update(state.params, state.opt_state, state.params, value=jnp.ones(()))
        return optax.apply_updates(state.params, updates), opt_state

    def gradient(function, position=0):
        def total(*arguments):
            leaves = [x for x in jax.tree.leaves(function(*arguments)) if jnp.issubdtype(x.dtype, jnp.inexact)]
            return sum(jnp.sum(jnp.square(x.astype(jnp.float32))) for x in leaves)

        return jax.grad(total, position, allow_int=True)  # an encoding also counts dropped tokens

    params = variables["params"]
    encoding = jit(encode, params)
    outputs = jit(read, params, encoding)
    drawn = jit(draw, outputs, outputs.gaussians)
    return {
        "posing, position maps": (pose, (example.inputs,)),
        "encoder": (encode, (params,)),
        "encoder, gradient": (gradient(encode), (params,)),
        "reading, decoder": (read, (params, encoding)),
        "reading, decoder, gradient": (gradient(read, (0, 1)), (params, encoding)),
        "drawing": (draw, (outputs, outputs.gaussians)),
        "drawing, gradient": (gradient(draw, 1), (outputs, outputs.gaussians)),
        "losses, gradient": (jax.grad(compare, 2), (outputs, drawn, drawn.rgb)),
        "optimizer": (update, (case.state,)),
    }
