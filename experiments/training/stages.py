"""Parts of a training step, each compiled by itself and timed in turns: `training/benchmark.py --stages`.

A gradient of a part contains the part.
"""

from collections.abc import Callable
from typing import Any

from experiments.common.interleaved import medians
from experiments.training.case import Case, compiler_options, first


def stage_numbers(case: Case, repeats: int, warm_up: int) -> dict[str, list[float]]:
    """(wall, CPU ms) of parts of a step, each a program; of reading a batch from kept pictures and from disk."""
    import jax

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

    from humangs_jax.core.pytree import replace
    from humangs_jax.data.views import prepare_inputs
    from humangs_jax.network.humangs import decode, encode_with_statistics, sample_vertices
    from humangs_jax.training.forward import draw_targets, white_backgrounds
    from humangs_jax.training.optimizer import make_optimizer
    from humangs_jax.training.step import loss_terms

    config, body, networks, example = case.config, case.body, case.networks, first(case.batch)
    targets, variables = example.targets, {"params": case.state.params, "batch_stats": case.state.batch_stats}
    jit = lambda function, *inputs: jax.jit(function, compiler_options=compiler_options())(*inputs)
    pose = lambda views: prepare_inputs(body, views, config.model, config.raster)
    inputs = jit(pose, example.inputs)

    def encode(params):
        return encode_with_statistics({**variables, "params": params}, inputs, config.model, True)[0]

    def read(params, encoding):
        own = {**variables, "params": params}
        features = sample_vertices(own, encoding, inputs, config.model)
        return decode(own, features, inputs.canonical_vertices, config.model)

    def draw(outputs, gaussians):
        outputs = replace(outputs, gaussians=gaussians)
        return draw_targets(outputs, body, targets, white_backgrounds(targets), config)

    def compare(outputs, drawn, rgb):
        terms = loss_terms(replace(drawn, rgb=rgb), outputs, targets.images, targets, config.loss, networks)
        return sum(getattr(config.loss, name) * term for name, term in terms.items())

    def update(state):
        optimizer = make_optimizer(config.optimizer, config.steps)
        updates, opt_state = optimizer.update(state.params, state.opt_state, state.params, value=jnp.ones(()))
        return optax.apply_updates(state.params, updates), opt_state

    def gradient(function, position=0):
        def total(*arguments):
            leaves = [x for x in jax.tree.leaves(function(*arguments)) if jnp.issubdtype(x.dtype, jnp.inexact)]
            return sum(jnp.sum(jnp.square(x.astype(jnp.float32))) for x in leaves)

        return jax.grad(total, position)

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
