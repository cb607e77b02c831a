"""Random inputs and variables for tests of the network."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network.parts import HumanGSInputs
from humangs_jax.network.presets import tiny
from humangs_jax.network.weights import expected_variables

TINY = tiny()
ALL_TOKENS = TINY.with_runtime(tokens="all")


def random_inputs(seed=0, views=2, vertices=20, size=32):
    """Returns photos of noise around vertices that every view sees."""
    rng = np.random.default_rng(seed)
    uniform = lambda low, high, *shape: jnp.asarray(rng.uniform(low, high, shape), jnp.float32)
    K = intrinsics_from_fov(0.8, size, size)
    azimuths = jnp.linspace(0.0, 5.0, views)
    canonical = uniform(-0.8, 0.8, vertices, 3)
    directions = np.random.default_rng([seed, 1]).normal(size=(views + 1, vertices, 3))
    normals = jnp.asarray(
        directions / np.linalg.norm(directions, axis=-1, keepdims=True), jnp.float32
    )
    return HumanGSInputs(
        images=uniform(0, 1, views, size, size, 3),
        cameras=orbit(jnp.zeros(3), 3.0, azimuths, 0.1, K, size, size),
        posed_vertices=canonical + uniform(-0.1, 0.1, views, vertices, 3),
        canonical_vertices=canonical,
        position_maps=uniform(-1, 1, views, size, size, 3),
        depth_maps=jnp.full((views, size, size), 5.0),
        foreground=jnp.ones((views, size, size), bool),
        posed_normals=normals[1:],
        canonical_normals=normals[0],
    )


def random_like(shapes, seed=0):
    """Returns variables in which every number matters.

    Fresh ones have zeros and tiny last layers.
    """
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        name = path[-1].key
        if name in ("scale", "var"):
            return jnp.asarray(rng.uniform(0.5, 1.5, leaf.shape), leaf.dtype)
        width = 1 if leaf.ndim < 2 else np.prod(leaf.shape[:-1])
        return jnp.asarray(
            rng.normal(size=leaf.shape) * (0.1 if leaf.ndim < 2 else width**-0.5), leaf.dtype
        )

    return jax.tree_util.tree_map_with_path(draw, shapes)


def random_variables(config, seed=0):
    """Returns random variables of a configuration, without the compilation of an initialisation."""
    return random_like(expected_variables(config), seed)
