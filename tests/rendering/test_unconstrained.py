"""Gaussians as free parameters and back."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import humangs_jax as hg
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.gaussians import COLOR_MARGIN, OPACITY_MARGIN

ROUNDING = 2e-6
"""Of a logarithm and an exponential, a logit and a sigmoid, in float32."""
COUNT = 50


def gaussians():
    rng = np.random.default_rng(0)
    array = lambda x: jnp.asarray(x, jnp.float32)
    means, quats = array(rng.normal(size=(COUNT, 3))), array(rng.normal(size=(COUNT, 4)))
    scales, colors = array(rng.uniform(0.001, 0.3, (COUNT, 3))), array(rng.uniform(0.02, 0.98, (COUNT, 3)))
    return hg.Gaussians(means, quats, scales, array(rng.uniform(0.01, 0.99, COUNT)), colors)


def test_there_and_back():
    before = gaussians()
    after = hg.constrain(hg.unconstrain(before))
    for name in ("means", "quats", "scales", "opacities", "colors"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=ROUNDING)


def test_bounds_are_met_within_the_margins():
    edge = replace(gaussians(), opacities=jnp.ones(COUNT), colors=jnp.zeros((COUNT, 3)), scales=jnp.zeros((COUNT, 3)))
    after = hg.constrain(hg.unconstrain(edge))
    np.testing.assert_allclose(after.opacities, 1 - OPACITY_MARGIN, atol=ROUNDING)
    np.testing.assert_allclose(after.colors, COLOR_MARGIN, atol=ROUNDING)
    assert (after.scales > 0).all()


def test_optax_never_leaves_the_domain():
    optimizer, parameters = optax.adam(1.0), hg.unconstrain(gaussians())
    state = optimizer.init(parameters)

    def loss(parameters):
        g = hg.constrain(parameters)
        return sum(jnp.sum(jnp.square(x - 2.0)) for x in (g.opacities, g.colors, g.scales))

    for _ in range(20):
        updates, state = optimizer.update(jax.grad(loss)(parameters), state)
        parameters = optax.apply_updates(parameters, updates)
    after = hg.constrain(parameters)
    assert (
        ((after.opacities > 0) & (after.opacities <= 1)).all()
        and (after.colors <= 1).all()
        and (after.scales > 0).all()
    )


def test_deformations_are_refused():
    deformed = replace(gaussians(), deformations=jnp.tile(jnp.eye(3), (COUNT, 1, 1)))
    with pytest.raises(ValueError, match="factored"):
        hg.unconstrain(deformed)
