"""Checks that need eight devices, by name.

python eight_devices.py a_linear_model
"""

import dataclasses
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from humangs_jax.training import sharding

LOSSES = 1e-6
"""Relative error of float32 sums in another order."""
GRADIENTS = 1e-5
"""Error relative to the norm of all gradients, for most parameters."""
DECISIONS = 1e-2
"""Error for the other ones: rounding may decide whether a splat still reaches a pixel."""


def on_mesh(specs, mesh):
    return jax.tree.map(lambda spec: jax.sharding.NamedSharding(mesh, spec), specs)


def a_linear_model():
    """Divides a state among 8 or 4 devices.

    Values come back, and the gradient of the mean is that of one device.
    """
    generator = np.random.default_rng(0)
    params = {
        "kernel": generator.normal(size=(64, 48)).astype(np.float32),
        "bias": np.ones(48, np.float32),
    }
    x, y = (generator.normal(size=(16, width)).astype(np.float32) for width in (64, 48))
    loss = lambda params, x, y: jnp.mean((x @ params["kernel"] + params["bias"] - y) ** 2)
    expected = jax.grad(loss)(params, x, y)
    for fsdp, parts in ((8, 8), (4, 4), (1, 1)):
        mesh = sharding.training_mesh(fsdp)
        specs = sharding.partition(params, mesh)
        named = on_mesh(specs, mesh)
        placed = sharding.place(params, named)
        # large arrays are divided, small ones are whole on each device
        assert placed["kernel"].addressable_data(0).size == params["kernel"].size // parts
        assert placed["bias"].addressable_data(0).size == 48
        jax.tree.map(np.testing.assert_array_equal, sharding.whole(placed, mesh), params)
        batch = sharding.place((x, y), sharding.batch_sharding(mesh))

        def gradient(params, x, y, specs=specs, mesh=mesh):
            return sharding.mean_parts(
                jax.grad(loss)(sharding.gather(params, specs), x, y), specs, mesh
            )

        # each device sees some rows of the batch
        rows = PartitionSpec(sharding.AXES)
        mapped = jax.shard_map(
            gradient, mesh=mesh, in_specs=(specs, rows, rows), out_specs=specs, check_vma=False
        )
        found = jax.jit(mapped)(placed, *batch)
        assert found["kernel"].sharding.is_equivalent_to(named["kernel"], 2)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), found, expected)


def a_training_step():
    """Makes a step of 8 subjects on 8 devices, all of which or 4 divide the state.

    Loss, gradients, batch statistics and metrics are those of one device that works on all 8 at
    once.
    """
    from training_cases import tube, write_subject

    from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader
    from humangs_jax.data.loading.captures import find_captures
    from humangs_jax.losses.loss_networks import LossNetworks
    from humangs_jax.network.humangs import init_humangs
    from humangs_jax.training.config import tiny
    from humangs_jax.training.step import batch_gradients

    config = tiny()
    variables, body = init_humangs(jax.random.key(0), config.model), tube()
    assert variables["batch_stats"]  # shared among the devices
    keys = jax.random.split(jax.random.key(1), 8)
    with tempfile.TemporaryDirectory() as folder:
        write_subject(Path(folder) / "someone", body, 0)
        cache = CaptureCache(find_captures(folder), body)
        source = CaptureSource(
            cache, config.views, config.model.conventions.image_size, config.target_size
        )

        def result(fsdp, at_once):
            part, mesh = dataclasses.replace(config, microbatch_size=at_once), None
            params, statistics, rest, rows = (
                variables["params"],
                variables["batch_stats"],
                (body, LossNetworks()),
                keys,
            )
            if fsdp:
                mesh = sharding.training_mesh(fsdp)
                specs = sharding.partition(params, mesh)
                params = sharding.place(params, on_mesh(specs, mesh))
                statistics, rest = (
                    sharding.place(x, sharding.replicated(mesh)) for x in (statistics, rest)
                )
                rows = jax.device_put(keys, sharding.batch_sharding(mesh))
            batch = Loader(
                source, 8, sharding=None if mesh is None else sharding.batch_sharding(mesh)
            ).batch_at(0)
            step = jax.jit(lambda *x: batch_gradients(*x[:2], x[2][0], *x[3:], part, x[2][1], mesh))
            return jax.device_get(step(params, statistics, rest, batch, rows))

        loss, gradients, statistics, metrics = result(None, 8)
        norm = np.sqrt(sum(np.sum(x**2) for x in jax.tree.leaves(gradients)))
        for fsdp in (8, 4):
            other = result(fsdp, 1)
            np.testing.assert_allclose(other[0], loss, rtol=LOSSES)
            apart = jax.tree.map(lambda a, b: np.abs(a - b).max(initial=0), other[1], gradients)
            apart = np.asarray(jax.tree.leaves(apart)) / norm
            assert np.quantile(apart, 0.9) < GRADIENTS and apart.max() < DECISIONS
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), other[2], statistics
            )
            assert other[3].keys() == metrics.keys()
            for name, value in metrics.items():
                np.testing.assert_allclose(
                    other[3][name], value, rtol=1e-5, atol=1e-9, err_msg=name
                )


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_num_cpu_devices", 8)
    {f.__name__: f for f in (a_linear_model, a_training_step)}[sys.argv[1]]()
