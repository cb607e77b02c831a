"""Small Gaussians, bodies and avatars."""

import functools

import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.gaussians import Gaussians


def f32(x):
    return jnp.asarray(x, jnp.float32)


def random_gaussians(seed=0, g=20, harmonics=0):
    """Returns Gaussians of some centimetres, a metre apart; `harmonics` is their number of
    functions.
    """
    rng = np.random.default_rng(seed)
    means, quats, scales = (
        rng.normal(size=(g, 3)),
        rng.normal(size=(g, 4)),
        np.exp(rng.normal(size=(g, 3)) - 3),
    )
    gaussians = Gaussians(
        f32(means),
        f32(quats),
        f32(scales),
        f32(rng.uniform(0.05, 0.95, g)),
        f32(rng.random((g, 3))),
    )
    if not harmonics:
        return gaussians
    return replace(gaussians, harmonics=f32(rng.uniform(-0.9, 0.9, (g, harmonics, 3))))


def small_body(n=6, j=3, s=2, seed=0):
    """Returns a body of a chain of joints, which move all vertices alike."""
    rng = np.random.default_rng(seed)
    regressor = rng.random((j, n))
    return BodyModel(
        template=f32(rng.normal(size=(n, 3))),
        shape_directions=f32(0.1 * rng.normal(size=(n, 3, s))),
        pose_directions=None,
        joint_regressor=f32(regressor / regressor.sum(1, keepdims=True)),
        skinning_weights=f32(np.full((n, j), 1 / j)),
        faces=jnp.asarray(rng.integers(0, n, (4, 3)), jnp.int32),
        parents=tuple(range(-1, j - 1)),
        joint_names=tuple("abcdefghijkl"[:j]),
        shape_names=("wide", "tall", "old", "young")[:s],
        name="small",
    )


def small_avatar(seed=0, per_vertex=4, weights=None, betas=(0.3, -1.2)):
    """Returns an avatar of the small body, by default with random skinning weights."""
    body, rng = small_body(seed=seed), np.random.default_rng(seed)
    rest, g = shape_body(body, f32(betas)), per_vertex * len(body.template)
    weights = rng.random((g, len(body.parents))) if weights is None else weights
    weights = f32(weights / weights.sum(1, keepdims=True))
    return Avatar(
        random_gaussians(seed, g),
        weights,
        rest.vertices,
        rest.joints,
        body.faces,
        body.parents,
        body.joint_names,
    )


@functools.cache
def tetrahedron(shape_names=()):
    """Returns a closed body of four vertices, five joints and three shape directions."""
    return BodyModel(
        template=f32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        shape_directions=jnp.ones((4, 3, 3)),
        pose_directions=None,
        joint_regressor=jnp.full((5, 4), 0.25),
        skinning_weights=jnp.full((4, 5), 0.2),
        faces=jnp.asarray([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        parents=(-1, 0, 1, 2, 3),
        joint_names=tuple("abcde"),
        shape_names=shape_names,
        name="tiny",
    )
