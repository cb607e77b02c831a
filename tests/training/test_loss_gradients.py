"""The gradient of every loss term against differences, in float64.

Compared are derivatives in random directions, by relative error.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.training import random_networks
from humangs_jax.losses.losses import FAR_SURFACE, loss_terms
from humangs_jax.network.parts import Drawn
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.training.config import LossConfig, TrainConfig

OWN = 1e-7
"""Largest relative error of terms alone.

Central differences of step h have h^2 of truncation and 1e-16 / h of rounding. Some terms have
corners within a step.
"""
WHOLE = 1e-4
"""Largest relative error through the network.

Of thousands of pixels some cross a corner (an absolute value, a ReLU, a Gaussian's least alpha)
within a step, and some Gaussians exchange places in the order of depths.
"""
NETWORKS = ("perceptual", "vgg16", "lpips")
"""Terms that need another network."""
SIDE, TARGETS, VERTICES = 32, 2, 800
STEP_SIZES = (1e-4, 1e-5, 1e-6, 1e-8, 1e-9)
"""Steps of central differences, relative to the size of what is varied.

Within longer steps some of thousands of Gaussians exchange places in the order of depths, and
colors jump.
"""
TERMS = [
    each.name
    for each in dataclasses.fields(LossConfig)
    if each.name not in ("structural_scales", "random_background")
]
PLAIN = [name for name in TERMS if name not in NETWORKS]


def loss_of(names):
    """Returns a `LossConfig` with these terms and no others, for small images."""
    weights = dict.fromkeys(TERMS, 0.0) | dict.fromkeys(names, 1.0)
    return LossConfig(**weights, structural_scales=1, random_background=0.0)


def agreement(values, point, names, directions=3, steps=STEP_SIZES):
    """Returns {term: relative error of its derivatives} at a point.

    `values` is a differentiable function of a point that gives {term: number}; a point is a tree of
    float64.
    """
    vector = jax.jit(lambda point: jnp.stack([values(point)[name] for name in names]))
    gradient = jax.jit(jax.grad(lambda point, weights: jnp.dot(weights, vector(point))))
    rng = np.random.default_rng(0)
    size = lambda x: np.sqrt(np.mean(np.square(x)))
    ways = [
        jax.tree.map(lambda x: rng.normal(size=x.shape) * size(np.asarray(x)), point)
        for _ in range(directions)
    ]

    def inner(a, b):
        return sum(
            np.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        )

    gradients = [jax.device_get(gradient(point, weights)) for weights in np.eye(len(names))]
    derivatives = np.asarray([[inner(g, way) for way in ways] for g in gradients])
    best = np.full((len(names), directions), np.inf)
    along = lambda way, step: vector(jax.tree.map(lambda x, d: x + step * d, point, way))
    for step in steps:
        found = [np.asarray(along(way, step) - along(way, -step)) / (2 * step) for way in ways]
        best = np.fmin(best, np.abs(np.stack(found, axis=1) - derivatives))
    errors = np.linalg.norm(best, axis=1) / np.linalg.norm(derivatives, axis=1)
    return dict(zip(names, errors.tolist(), strict=True))


def own_case(names, side=SIDE):
    """Returns (function of a point that gives the loss terms, a point): made-up renderings."""
    rng = np.random.default_rng(1)
    pixels, vertices = (TARGETS, side, side), 5
    uniform = lambda *shape: rng.uniform(0.1, 0.9, shape)
    depth = 2 + uniform(*pixels)
    point = {
        "rgb": uniform(*pixels, 3),
        "alpha": uniform(*pixels),
        "depth": depth,
        "spread": 0.1 * uniform(*pixels),
        "opacities": uniform(3 * vertices),
        "tight_offsets": rng.normal(size=(vertices, 1, 3)),
    }
    images, masks = jnp.asarray(uniform(*pixels, 3)), jnp.asarray(uniform(*pixels))
    depths = jnp.asarray(depth + FAR_SURFACE * rng.uniform(-1.5, 1.5, pixels))
    config = loss_of(names)
    networks = random_networks(TrainConfig(loss=config))

    def values(point):
        point = {name: jnp.asarray(x) for name, x in point.items()}
        alpha = point["alpha"]

        def rendering_of(rgb, alpha, depth, spread):
            return Rendering(rgb, alpha, depth, jnp.zeros((), jnp.int32), distortion=spread)

        # distortion is at most the square of alpha times the range of depths
        spread = 2 * alpha**2 * point["spread"]
        rendering = jax.vmap(rendering_of)(point["rgb"], alpha, point["depth"], spread)
        drawn = Drawn(rendering, point["opacities"], point["tight_offsets"])
        return loss_terms(drawn, images, masks, depths, config, networks)

    return values, point


@pytest.mark.slow
def test_terms_on_their_own_inputs():
    with jax.enable_x64(True):
        errors = agreement(*own_case(PLAIN, 12), PLAIN)
    assert set(errors) == set(PLAIN) and all(error < OWN for error in errors.values()), errors


@pytest.mark.slow
def test_terms_with_networks_of_their_own():
    with jax.enable_x64(True):
        errors = agreement(
            *own_case(list(NETWORKS)), list(NETWORKS), directions=1, steps=(1e-6, 1e-8)
        )
    assert set(errors) == set(NETWORKS) and all(error < WHOLE for error in errors.values()), errors
