import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import random_like

from humangs_jax.network.bilinear import sample_bilinear, sample_neighborhoods
from humangs_jax.network.upsampler import MOMENTUM, OutputConvolution, UpConvolution, Upsampler, UpsamplerConfig

CONFIG = UpsamplerConfig(hidden=4)


def random_maps(depths=4, views=2, side=3, width=6):
    rng = np.random.default_rng(0)
    return [jnp.asarray(rng.normal(size=(views, side, side, width)), jnp.float32) for _ in range(depths)]


def test_up_convolution_is_the_transposed_convolution():
    """Every input pixel adds its kernel, stride 2, minus a border of one."""
    rng = np.random.default_rng(1)
    x, kernel, bias = rng.normal(size=(2, 3, 4, 5)), rng.normal(size=(4, 4, 5, 6)), rng.normal(size=6)
    expected = np.zeros((2, 2 * 3 + 2, 2 * 4 + 2, 6))
    for i in range(3):
        for j in range(4):
            expected[:, 2 * i : 2 * i + 4, 2 * j : 2 * j + 4] += np.einsum("vc,abco->vabo", x[:, i, j], kernel)
    expected = expected[:, 1:-1, 1:-1] + bias
    with jax.enable_x64(True):
        params = {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
        ours = UpConvolution(6).apply({"params": params}, jnp.asarray(x))
        np.testing.assert_allclose(ours, expected, rtol=1e-12, atol=1e-12)


def test_statistics_follow_the_batch_only_in_training():
    maps = random_maps()
    module = Upsampler(CONFIG)
    variables = random_like(jax.eval_shape(module.init, jax.random.key(0), maps))
    evaluate = jax.jit(module.apply)
    trained, updated = jax.jit(lambda v, m: module.apply(v, m, True, mutable=["batch_stats"]))(variables, maps)
    still = evaluate(variables, maps)
    assert still.shape == trained.shape == (2, 12, 12, CONFIG.hidden // 2) and not np.allclose(
        still, trained, atol=1e-3
    )
    of_the_batch = lambda new, old: (new - MOMENTUM * old) / (1 - MOMENTUM)
    statistics = jax.tree.map(of_the_batch, updated["batch_stats"], variables["batch_stats"])
    assert all((norm["var"] > 0).all() for norm in statistics.values())
    assert np.allclose(evaluate({**variables, "batch_stats": statistics}, maps), trained, atol=1e-4)


def test_a_batch_may_share_its_statistics():
    maps = [jnp.stack([x, 2 * x + 1]) for x in random_maps(depths=1)]
    module = Upsampler(dataclasses.replace(CONFIG, features="final"), axis_name="b")
    variables = random_like(jax.eval_shape(module.init, jax.random.key(0), [x[0] for x in maps]))
    apply = lambda x: module.apply(variables, x, True, mutable=["batch_stats"])
    outputs, updated = jax.jit(jax.vmap(apply, axis_name="b"))(maps)
    for statistics in jax.tree.leaves(updated):
        assert np.array_equal(statistics[0], statistics[1])
    alone = dataclasses.replace(module, axis_name=None)
    in_one = lambda x: alone.apply(variables, x, True, mutable=["batch_stats"])[0]
    together = jax.jit(in_one)([x.reshape(-1, *x.shape[2:]) for x in maps])
    assert np.allclose(outputs.reshape(together.shape), together, atol=1e-4)


def test_final_features_only():
    module = Upsampler(dataclasses.replace(CONFIG, features="final"))
    shapes = jax.eval_shape(module.init, jax.random.key(0), random_maps(depths=1))
    assert [name for name in shapes["params"] if name.startswith("project")] == ["project_0"]
    assert shapes["params"]["fuse"]["kernel"].shape == (3, 3, CONFIG.hidden, 2 * CONFIG.hidden)


@pytest.mark.slow
def test_what_vertices_read_is_what_the_convolved_map_says():
    rng = np.random.default_rng(2)
    stem = jnp.asarray(rng.normal(size=(1, 6, 8, 3)), jnp.float32)
    positions = jnp.asarray(rng.uniform(-1, 9, (50, 2)), jnp.float32)
    readout = OutputConvolution(5, 3)
    neighborhoods, coverages = sample_neighborhoods(stem[0], positions)
    variables = random_like(jax.eval_shape(readout.init, jax.random.key(0), neighborhoods, coverages))
    everywhere = readout.apply(variables, stem, method="everywhere")
    assert everywhere.shape == (1, 6, 8, 5)
    ours = readout.apply(variables, neighborhoods, coverages)
    assert np.allclose(ours, sample_bilinear(everywhere[0], positions), atol=1e-5) and np.abs(ours).max() > 0.1


def test_padding_does_not_count_in_the_statistics():
    maps = random_maps()
    module = Upsampler(CONFIG)
    variables = random_like(jax.eval_shape(module.init, jax.random.key(0), maps))
    run = jax.jit(lambda m, present: module.apply(variables, m, True, present, mutable=["batch_stats"]))
    padded = [jnp.concatenate([x, 100 * jnp.ones_like(x)]) for x in maps]
    ours, statistics = run(padded, jnp.asarray([True, True, False, False]))
    expected, expected_statistics = run(maps, None)
    assert np.allclose(ours[:2], expected, atol=1e-4)
    for a, b in zip(jax.tree.leaves(statistics), jax.tree.leaves(expected_statistics), strict=True):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-6)
