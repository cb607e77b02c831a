"""What is counted in the program of a training step."""

import jax
import jax.numpy as jnp
import pytest
from jax import lax

from experiments.step_programs_worker import executed


def counted(function, *arguments, platform="cpu"):
    return executed(jax.make_jaxpr(function)(*arguments).jaxpr, platform)


def twice(x):
    return 2 * x + 1


def test_what_a_loop_runs_counts_as_often_as_it_runs():
    def looped(x):
        return lax.scan(lambda carry, _: (twice(carry), None), x, length=7)[0]

    assert counted(twice, 1.0) == 2
    assert counted(looped, 1.0) == 14
    assert counted(jax.jit(twice), 1.0) == counted(jax.checkpoint(twice), 1.0) == 2


@pytest.mark.parametrize(("platform", "expected"), [("cpu", 2), ("cuda", 1)])
def test_what_depends_on_the_platform_counts_as_there(platform, expected):
    def chosen(x):
        return lax.platform_dependent(x, cpu=twice, default=jnp.sin)

    # and the question which platform it is
    assert counted(chosen, 1.0, platform=platform) == expected + 1


def test_of_branches_that_data_choose_the_longest_counts():
    def either(x):
        return lax.cond(x > 0, twice, jnp.sin, x)

    assert counted(either, 1.0) == 2 + len(["greater", "to a number of the branch"])


def test_a_loop_whose_end_the_data_decide_counts_once():
    def until(x):
        return lax.while_loop(lambda x: x < 9, twice, x)

    assert counted(until, 1.0) == 3
