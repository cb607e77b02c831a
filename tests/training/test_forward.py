"""Gaussians drawn as a training step draws them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.core.numerics import safe_divide
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import render
from humangs_jax.training.config import tiny
from humangs_jax.training.forward import draw_posed

SIZE, COUNT = 16, 6
CONFIG = dataclasses.replace(tiny(), loss=dataclasses.replace(tiny().loss, distortion=1.0))


def batched(tree):
    """Returns the tree with a leading axis of one, as `vmap` makes it."""
    return jax.tree.map(lambda x: x[None], tree)


def layered(seed=0):
    """Returns translucent Gaussians in front of each other."""
    rng = np.random.default_rng(seed)
    places = [
        0.1 * rng.normal(size=COUNT),
        0.1 * rng.normal(size=COUNT),
        rng.uniform(1.5, 4.0, COUNT),
    ]
    return Gaussians(
        means=jnp.asarray(np.stack(places, axis=-1), jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (COUNT, 1)),
        scales=jnp.full((COUNT, 3), 0.3),
        opacities=jnp.asarray(rng.uniform(0.2, 0.7, COUNT), jnp.float32),
        colors=jnp.asarray(rng.random((COUNT, 3)), jnp.float32),
        harmonics=jnp.asarray(rng.normal(size=(COUNT, 3, 3)), jnp.float32),
    )


def one_target():
    K = jnp.asarray([[16.0, 0, 8], [0, 16.0, 8], [0, 0, 1]])
    return SubjectViews(
        images=jnp.ones((1, SIZE, SIZE, 3)),
        masks=jnp.ones((1, SIZE, SIZE)),
        cameras=batched(Camera(K, jnp.eye(4), SIZE, SIZE)),
        rotations=jnp.zeros((1, 1, 3)),
        translations=jnp.zeros((1, 3)),
        betas=jnp.zeros(1),
    )


def drawn_for_training(gaussians, targets):
    white = jnp.ones((1, 3))
    return jax.jit(lambda posed: draw_posed(posed, targets, white, CONFIG))(batched(gaussians))


@pytest.mark.slow
def test_the_spread_of_rays_does_not_depend_on_harmonics():
    """The spread is that of depths: a depth that is drawn as a color would get harmonics, and be
    cut at 0.
    """
    gaussians, targets = layered(), one_target()
    drawn = drawn_for_training(gaussians, targets)
    z = gaussians.means[:, 2] - jnp.mean(gaussians.means[:, 2])
    expected = render(
        gaussians,
        targets.cameras[0],
        CONFIG.splat,
        features=jnp.stack([z, z**2, jnp.ones_like(z)], -1),
    )
    mean, squared = (safe_divide(expected.features[..., i], expected.alpha) for i in (0, 1))
    spread = 2 * expected.alpha**2 * (squared - mean**2)
    assert float(jnp.max(spread)) > 0.05
    np.testing.assert_allclose(drawn.rendering.distortion[0], spread, atol=1e-5)
    np.testing.assert_allclose(drawn.rendering.rgb[0], expected.rgb, atol=1e-6)
    assert drawn.rendering.features is None


def test_without_harmonics_the_spread_is_what_it_was():
    """Weights were trained with it: depths were drawn as the first two channels of a color."""
    gaussians, targets = replace(layered(1), harmonics=None), one_target()
    drawn = drawn_for_training(gaussians, targets)
    z = gaussians.means[:, 2] - jnp.mean(gaussians.means[:, 2])
    colored = replace(gaussians, colors=jnp.stack([z, z**2, 0 * z], -1))
    moments = jax.jit(lambda g: render(g, targets.cameras[0], CONFIG.splat, jnp.zeros(3)))(colored)
    mean, squared = (safe_divide(moments.rgb[..., i], moments.alpha) for i in (0, 1))
    np.testing.assert_allclose(
        drawn.rendering.distortion[0], 2 * moments.alpha**2 * (squared - mean**2), atol=1e-6
    )
