"""Maps are sampled, convolved, sampled before they are convolved, and upsampled."""

import dataclasses
import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from network_cases import random_like

from humangs_jax.network import encoder
from humangs_jax.network.encoder import NOWHERE, sample_triplane
from humangs_jax.network.maps import (
    Convolution,
    convolve,
    convolve_neighborhoods,
    sample_bilinear,
    sample_nearest,
    sample_neighborhoods,
    texel_indices,
)
from humangs_jax.network.upsampler import MOMENTUM, UpConvolution, Upsampler, UpsamplerConfig

RTOL32 = 1e-5
"""Rounding of three float32 products and sums of numbers of order one."""
FLOAT64 = 1e-12
"""Rounding of sums in another order, float64."""


def oracle(grid, indices):
    """Returns sums over ALL texels of tent(x - i) tent(y - j): bilinear, with zeros outside."""
    height, width, _ = grid.shape
    tent = lambda x: np.maximum(0, 1 - np.abs(x))
    wx, wy = tent(indices[:, :1] - np.arange(width)), tent(indices[:, 1:] - np.arange(height))
    return np.einsum("py,px,yxc->pc", wy, wx, grid)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 6), (5, 4)])
def test_agrees_with_a_sum_over_all_texels(height, width):
    rng = np.random.default_rng(height)
    grid = rng.normal(size=(height, width, 3))
    indices = rng.uniform(-2, 8, (60, 2))
    indices[:20] = np.round(indices[:20])  # on texel centres, edges and one texel outside
    with jax.enable_x64(True):
        ours = jax.jit(sample_bilinear)(jnp.asarray(grid), jnp.asarray(indices))
        assert ours.dtype == jnp.float64
        np.testing.assert_allclose(ours, oracle(grid, indices), rtol=FLOAT64, atol=FLOAT64)
    ours = jax.jit(sample_bilinear)(
        jnp.asarray(grid, jnp.float32), jnp.asarray(indices, jnp.float32)
    )
    np.testing.assert_allclose(ours, oracle(grid, indices), rtol=RTOL32, atol=RTOL32)


def test_far_and_broken_positions_read_zero_with_zero_gradient():
    bad = [np.inf, -np.inf, np.nan, 1e30, -1e30, 3e9]
    positions = jnp.asarray([p for x in bad for p in ([x, 1.0], [1.0, x], [x, x])])
    read = lambda p: jnp.sum(sample_bilinear(jnp.ones((4, 5, 2)), p))
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(read)))(positions)
    assert np.array_equal(values, np.zeros(18)) and np.array_equal(gradients, np.zeros((18, 2)))
    assert np.array_equal(sample_nearest(jnp.ones((4, 5)), positions), np.zeros(18))


def test_gradients_agree_with_differences():
    rng = np.random.default_rng(1)
    with jax.enable_x64(True):
        grid, indices = (
            jnp.asarray(rng.normal(size=(4, 5, 2))),
            jnp.asarray(rng.uniform(0.1, 2.9, (6, 2))),
        )
        check_grads(
            jax.jit(sample_bilinear), (grid, indices), order=1, modes=("rev",), atol=1e-6, rtol=1e-6
        )


def test_nearest_rounds_halves_to_even():
    grid = jnp.arange(1.0, 7.0)[None]
    indices = jnp.asarray(
        [[0.5, 0], [1.5, 0], [2.5, 0], [3.5, 0], [-0.5, 0], [5.5, 0], [2.0, 0.5], [2.0, 0.6]]
    )
    assert np.array_equal(sample_nearest(grid, indices), [1, 3, 3, 5, 1, 0, 3, 0])


def test_conventions():
    """Half-pixel indices see the same image at every resolution; mixed ones miss it by less than
    half a texel.
    """
    pixels = jnp.asarray([[0.5, 0.5], [8.0, 4.0], [15.5, 7.5]])
    half = texel_indices(pixels, (16, 8), (16, 8), "half_pixel")
    assert np.allclose(half, pixels - 0.5)
    assert np.allclose(texel_indices(pixels, (16, 8), (4, 2), "half_pixel"), pixels / 4 - 0.5)
    mixed = texel_indices(pixels, (16, 8), (4, 2), "mixed")
    ndc = pixels / jnp.asarray([16, 8]) * 2 - 1
    assert np.allclose(mixed, (ndc + 1) / 2 * jnp.asarray([3, 1]))
    # equal in the middle only
    assert np.allclose(mixed[1], texel_indices(pixels, (16, 8), (4, 2), "half_pixel")[1])


def test_half_pixel_sampling_reproduces_a_ramp_at_any_resolution():
    def ramp(n, size):
        return (jnp.arange(n) + 0.5) * size / n

    pixels = jnp.asarray([[3.0, 5.0], [7.25, 2.0]])
    for n in (4, 16):
        grid = jnp.broadcast_to(ramp(n, 16.0)[None, :, None], (n, n, 1))
        sampled = jax.jit(sample_bilinear)(
            grid, texel_indices(pixels, (16, 16), (n, n), "half_pixel")
        )
        assert np.allclose(sampled[:, 0], pixels[:, 0], atol=1e-5)


def test_planes_and_axes():
    """A plane is read at its two axes, the first of its name along the width."""
    r = 5
    centres = jnp.linspace(-1, 1, r)
    horizontal = jnp.broadcast_to(centres[None, :, None], (r, r, 1))
    vertical = jnp.swapaxes(horizontal, 0, 1)
    texture = jnp.broadcast_to(jnp.concatenate([horizontal, vertical], axis=-1), (3, r, r, 2))
    positions = jnp.asarray([[0.1, 0.7, -0.6], [-1.0, 1.0, 0.0]])
    x, y, z = positions.T
    expected = jnp.stack([x, y, x, z, y, z], axis=-1)
    assert np.allclose(jax.jit(sample_triplane)(texture, positions), expected, atol=1e-6)


def test_background_reads_the_last_texel_and_outside_is_zero():
    texture = jnp.arange(3 * 4 * 4 * 2, dtype=jnp.float32).reshape(3, 4, 4, 2)
    read = jax.jit(sample_triplane)(texture, jnp.asarray([[[1.0, 1, 1], [2, 2, 2]]]))
    assert read.shape == (1, 2, 6)
    assert np.allclose(read[0, 0], texture[:, -1, -1].ravel()) and np.array_equal(
        read[0, 1], np.zeros(6)
    )


def test_background_and_empty_slots_add_nothing_to_a_texture_one_by_one(monkeypatch):
    """An accelerator's additions to one place wait for each other; the background's are one sum."""
    texture = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4, 4, 2)), jnp.float32)
    inside = np.random.default_rng(1).uniform(-1, 1, (5, 3))
    positions = jnp.asarray([[1.0] * 3] * 4 + [[NOWHERE] * 3] * 3 + inside.tolist(), jnp.float32)

    def loss(texture):
        return jnp.sum(jnp.sin(sample_triplane(texture, positions)))

    here = jax.value_and_grad(loss)(texture)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there = jax.value_and_grad(loss)(texture)
    np.testing.assert_allclose(there[0], here[0], rtol=RTOL32)
    np.testing.assert_allclose(there[1], here[1], rtol=RTOL32, atol=RTOL32)
    # the first seven are a texel or more beyond the four of a plane
    places = []
    monkeypatch.setattr(encoder, "sample_bilinear", spied(places))
    jax.grad(loss)(texture)
    outside = [np.all(np.abs(np.asarray(x)[:7]) >= 2.5) for x in places]  # from the middle
    assert len(outside) == 3 and all(outside)


def spied(places):
    """Returns `sample_bilinear`, which adds the indices that it is given to `places`."""

    def read(grid, indices, origin):
        places.append(indices)
        return sample_bilinear(grid, indices, origin)

    return read


SHAPE, FEATURES = (2, 5, 7, 3), 4


def random(*shape):
    return jnp.asarray(np.random.default_rng(len(shape) + shape[0]).normal(size=shape))


def reference(x, kernel):
    padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    height, width = x.shape[1:3]
    shifted = lambda a, b: padded[:, a : a + height, b : b + width] @ kernel[a, b]
    return sum(shifted(a, b) for a in range(3) for b in range(3))


@pytest.mark.slow
def test_it_is_the_sum_over_a_neighbourhood_with_its_gradients():
    with jax.enable_x64(True):
        x, kernel, weights = (
            random(*SHAPE),
            random(3, 3, SHAPE[-1], FEATURES),
            random(*SHAPE[:3], FEATURES),
        )
        for function in (convolve, jax.jit(convolve)):
            np.testing.assert_allclose(
                function(x, kernel), reference(x, kernel), rtol=FLOAT64, atol=FLOAT64
            )
            gradients = [
                jax.grad(lambda *a, f=f: jnp.sum(weights * f(*a)), (0, 1))(x, kernel)
                for f in (function, reference)
            ]
            jax.tree.map(
                lambda a, b: np.testing.assert_allclose(a, b, rtol=FLOAT64, atol=FLOAT64),
                *gradients,
            )


def test_a_batch_of_maps():
    with jax.enable_x64(True):
        x, kernel = random(3, *SHAPE), random(3, 3, SHAPE[-1], FEATURES)
        loss = lambda f: lambda x, kernel: jnp.sum(jnp.sin(f(x, kernel)))
        gradient = lambda f: jax.jit(jax.vmap(jax.grad(loss(f), (0, 1)), (0, None)))(x, kernel)
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=FLOAT64, atol=FLOAT64)
        jax.tree.map(close, gradient(convolve), gradient(reference))


def test_the_module_has_the_parameters_of_flax():
    x = random(*SHAPE).astype(jnp.float32)
    ours, theirs = Convolution(FEATURES, nn.initializers.ones), nn.Conv(FEATURES, (3, 3))
    variables = theirs.init(jax.random.key(0), x)
    assert jax.tree.structure(ours.init(jax.random.key(0), x)) == jax.tree.structure(variables)
    np.testing.assert_allclose(
        ours.apply(variables, x), theirs.apply(variables, x), rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("batch", [1, 2], ids=["unrolled", "looped"])
def test_in_a_loop_all_of_its_convolutions_are_those_that_the_library_knows(batch):
    """XLA makes nested loops over single numbers of other ones."""

    def total_gradient(xs, kernel):
        def add(total, x):
            return (
                total + jax.grad(lambda k: jnp.sum(jnp.sin(convolve(x, k))))(kernel),
                None,
            )

        return jax.lax.scan(add, jnp.zeros_like(kernel), xs)[0]

    shapes = [
        jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((batch, 2, 8, 8, 16), (3, 3, 16, 16))
    ]
    labels = re.findall(
        r"dim_labels=(\S+)", jax.jit(total_gradient).lower(*shapes).compile().as_text()
    )
    assert labels and {label.rstrip(",") for label in labels} == {"b01f_01io->b01f"}


HEIGHT, WIDTH, CHANNELS = SHAPE[1:]


@pytest.mark.slow
@pytest.mark.parametrize("where", ["inside", "border", "corners", "outside"])
def test_reading_before_the_convolution_is_reading_after_it(where):
    rng = np.random.default_rng(0)
    grid = rng.normal(size=(HEIGHT, WIDTH, CHANNELS))
    kernel, bias = rng.normal(size=(3, 3, CHANNELS, FEATURES)), rng.normal(size=FEATURES)
    positions = {
        "inside": rng.uniform([1, 1], [WIDTH - 2, HEIGHT - 2], (40, 2)),
        "border": rng.uniform([-1.5, -1.5], [WIDTH + 0.5, HEIGHT + 0.5], (200, 2)),
        "corners": np.asarray(
            [[x, y] for x in (-1, -0.5, 0, WIDTH - 1, WIDTH - 0.5) for y in (-0.99, 0, HEIGHT - 1)]
        ),
        "outside": np.asarray(
            [[-1.0, 2], [3, HEIGHT], [1e9, 0], [-1e30, 3], [np.inf, 1], [2, np.nan]]
        ),
    }[where]
    with jax.enable_x64(True):
        neighborhoods, coverages = sample_neighborhoods(jnp.asarray(grid), jnp.asarray(positions))
        ours = convolve_neighborhoods(
            neighborhoods, coverages, jnp.asarray(kernel), jnp.asarray(bias)
        )
        expected = sample_bilinear(
            reference(jnp.asarray(grid)[None], kernel)[0] + bias, jnp.asarray(positions)
        )
    assert np.abs(ours - expected).max() < FLOAT64
    assert (np.abs(ours).max() > 0) == (where != "outside")


@pytest.mark.slow
def test_gradients_are_finite_wherever_one_reads():
    positions = jnp.asarray(
        [[2.0, 2.0], [-1.0, 0.0], [-0.5, 4.5], [1e30, 0], [np.nan, 1], [WIDTH - 1, HEIGHT - 1]]
    )
    grid = jnp.asarray(np.random.default_rng(1).normal(size=(HEIGHT, WIDTH, CHANNELS)), jnp.float32)

    def total(grid, positions):
        return sum(jnp.sum(jnp.sin(x)) for x in sample_neighborhoods(grid, positions))

    of_grid, of_positions = jax.grad(total, (0, 1))(grid, positions)
    assert np.isfinite(of_grid).all() and np.isfinite(of_positions).all()
    assert np.array_equal(of_positions[3:5], np.zeros((2, 2))) and np.abs(of_grid).max() > 0


CONFIG = UpsamplerConfig(hidden=4)


def random_maps(depths=4, views=2, side=3, width=6):
    rng = np.random.default_rng(0)
    return [
        jnp.asarray(rng.normal(size=(views, side, side, width)), jnp.float32) for _ in range(depths)
    ]


def test_up_convolution_is_the_transposed_convolution():
    """Each input pixel adds its kernel with stride 2; a border of one is cut off."""
    rng = np.random.default_rng(1)
    x, kernel, bias = (
        rng.normal(size=(2, 3, 4, 5)),
        rng.normal(size=(4, 4, 5, 6)),
        rng.normal(size=6),
    )
    expected = np.zeros((2, 2 * 3 + 2, 2 * 4 + 2, 6))
    for i in range(3):
        for j in range(4):
            expected[:, 2 * i : 2 * i + 4, 2 * j : 2 * j + 4] += np.einsum(
                "vc,abco->vabo", x[:, i, j], kernel
            )
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
    trained, updated = jax.jit(lambda v, m: module.apply(v, m, True, mutable=["batch_stats"]))(
        variables, maps
    )
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


def test_padding_does_not_count_in_the_statistics():
    maps = random_maps()
    module = Upsampler(CONFIG)
    variables = random_like(jax.eval_shape(module.init, jax.random.key(0), maps))
    run = jax.jit(
        lambda m, present: module.apply(variables, m, True, present, mutable=["batch_stats"])
    )
    padded = [jnp.concatenate([x, 100 * jnp.ones_like(x)]) for x in maps]
    ours, statistics = run(padded, jnp.asarray([True, True, False, False]))
    expected, expected_statistics = run(maps, None)
    assert np.allclose(ours[:2], expected, atol=1e-4)
    for a, b in zip(jax.tree.leaves(statistics), jax.tree.leaves(expected_statistics), strict=True):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-6)
