"""Operations and messages, counted in traced programs, against sums by hand."""

import functools

import jax
import jax.numpy as jnp
import pytest
from jax.sharding import AxisType, PartitionSpec

from experiments.costs import costs_of, temporary_mb
from humangs_jax.network.maps import convolve

N = 8
A = jnp.zeros((N, N))
PRODUCT = 2 * N**3


def count(function, *arguments):
    return costs_of(jax.jit(function).trace(*arguments))


@jax.custom_batching.custom_vmap
def with_rule(a):
    return a @ a


@with_rule.def_vmap
def with_rule_in_batch(size, batched, a):
    return a @ a, True


PRODUCTS = {
    "a product": (lambda a: a @ a, 1),
    "one of three axes": (
        lambda a: jnp.einsum("bij,bjk->bik", jnp.stack([a, a]), jnp.stack([a, a])),
        2,
    ),
    "its gradient": (jax.grad(lambda a: jnp.sum(a @ a)), 2),
    "recomputed for the gradient": (
        jax.grad(jax.checkpoint(lambda a: jnp.sum(jnp.sin(a @ a) @ a))),
        5,
    ),
    "of what nobody reads": (lambda a: (a @ a, a)[1], 0),
    "in a loop": (lambda a: jax.lax.fori_loop(0, 7, lambda _, x: x @ a, a), 7),
    "in loops": (
        lambda a: jax.lax.scan(
            lambda x, _: (jax.lax.map(lambda y: y @ a, x[None])[0], None), a, length=5
        ),
        5,
    ),
    "in a branch": (
        lambda a: jax.lax.cond(a[0, 0] > 0, lambda x: x @ x @ x, lambda x: x @ x, a),
        2,
    ),
    "under vmap": (jax.vmap(lambda a: a @ a, axis_size=3, in_axes=None), 1),
    "with a rule for vmap": (with_rule, 1),
}


@pytest.mark.parametrize("name", PRODUCTS)
def test_products(name):
    function, expected = PRODUCTS[name]
    assert count(function, A).dots == expected * PRODUCT


def test_loops_of_unknown_length_count_once():
    costs = count(lambda a: jax.lax.while_loop(lambda x: jnp.sum(x) < 9, lambda x: x @ a, a), A)
    assert (costs.flops, costs.unknown_trips) == (PRODUCT, 1)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_convolution_and_its_gradients(stride):
    image, kernel = jnp.zeros((1, 8, 8, 3)), jnp.zeros((3, 3, 3, 5))
    apply = functools.partial(
        jax.lax.conv_general_dilated,
        window_strides=(stride, stride),
        padding="SAME",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )
    expected = 2 * (8 // stride) ** 2 * 9 * 3 * 5
    assert count(apply, image, kernel).convolutions == expected
    both = count(jax.grad(lambda i, k: jnp.sum(apply(i, k) ** 2), (0, 1)), image, kernel)
    assert both.convolutions == pytest.approx(3 * expected, rel=0.6)  # gradients count padding, too


def test_our_convolutions_cost_what_those_of_jax_do():
    x, kernel = jnp.zeros((2, 8, 8, 3)), jnp.zeros((3, 3, 3, 5))
    assert count(convolve, x, kernel).flops == 2 * 2 * 64 * 9 * 3 * 5


def test_messages_of_one_device():
    mesh = jax.sharding.AbstractMesh((4,), ("d",), axis_types=(AxisType.Auto,))
    spec = PartitionSpec("d")

    def body(x):
        whole = jax.lax.all_gather(x, "d", tiled=True)
        summed = jax.lax.fori_loop(0, 5, lambda _, y: jax.lax.psum(y, "d"), whole)
        return jax.lax.psum_scatter(summed, "d", tiled=True)

    costs = count(
        jax.shard_map(body, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False),
        jnp.zeros((64, 8)),
    )
    whole = 4 * 64 * 8
    assert costs.messages == {"all_gather": 1, "psum": 5, "reduce_scatter": 1}
    assert costs.sent == {
        "all_gather": whole * 3 // 4,
        "psum": 5 * 2 * whole * 3 // 4,
        "reduce_scatter": whole * 3 // 4,
    }


def test_temporaries():
    program = jax.jit(lambda a: jnp.sin(a @ a) @ a).lower(jnp.zeros((256, 256))).compile()
    assert 0 < temporary_mb(program) < 4
