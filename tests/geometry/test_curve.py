import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.geometry.transform import along_curve


def test_neighbours_along_the_curve_are_neighbours_in_space():
    positions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (512, 3)), jnp.float32)
    ranks = jax.jit(along_curve, static_argnums=1)(positions, 1.2)
    assert sorted(ranks.tolist()) == list(range(512))
    ordered = np.asarray(positions)[np.argsort(ranks)]
    steps = np.linalg.norm(np.diff(ordered, axis=0), axis=-1).mean()
    assert steps < 0.4 * np.linalg.norm(np.diff(positions, axis=0), axis=-1).mean()


def test_points_off_the_curve_are_on_its_border():
    positions = jnp.asarray([[-9.0, -9.0, -9.0], [0.0, 0.0, 0.0], [9.0, 9.0, 9.0]])
    assert along_curve(positions, 1.0).tolist() == [0, 1, 2]
