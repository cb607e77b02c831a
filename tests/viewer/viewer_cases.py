"""A tiny avatar on a tiny body."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyModel, shape_body
from humangs_jax.rendering.gaussians import Gaussians


def small_body(n=6, j=3, s=2, seed=0):
    rng = np.random.default_rng(seed)
    f32 = lambda x: jnp.asarray(x, jnp.float32)
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
        shape_names=("wide", "tall"),
    )


def small_avatar(seed=0, per_vertex=4, weights=None, betas=(0.3, -1.2)):
    body, rng = small_body(seed=seed), np.random.default_rng(seed)
    f32 = lambda x: jnp.asarray(x, jnp.float32)
    rest = shape_body(body, f32(betas))
    g = per_vertex * len(body.template)
    weights = rng.random((g, len(body.parents))) if weights is None else weights
    return Avatar(
        Gaussians(
            f32(rng.normal(size=(g, 3))),
            f32(rng.normal(size=(g, 4))),
            f32(np.exp(rng.normal(size=(g, 3)) - 4)),
            f32(rng.random(g)),
            f32(rng.random((g, 3))),
        ),
        f32(weights / weights.sum(1, keepdims=True)),
        rest.vertices,
        rest.joints,
        body.faces,
        parents=body.parents,
        joint_names=body.joint_names,
    )
