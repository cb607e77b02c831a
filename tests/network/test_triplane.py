import jax.numpy as jnp
import numpy as np

from humangs_jax.network.encoder import sample_triplane


def test_planes_and_axes():
    """Each plane is read at its two axes, the first named one along the width."""
    r = 5
    centres = jnp.linspace(-1, 1, r)
    horizontal = jnp.broadcast_to(centres[None, :, None], (r, r, 1))
    vertical = jnp.swapaxes(horizontal, 0, 1)
    texture = jnp.broadcast_to(jnp.concatenate([horizontal, vertical], axis=-1), (3, r, r, 2))
    positions = jnp.asarray([[0.1, 0.7, -0.6], [-1.0, 1.0, 0.0]])
    x, y, z = positions.T
    expected = jnp.stack([x, y, x, z, y, z], axis=-1)
    assert np.allclose(sample_triplane(texture, positions), expected, atol=1e-6)


def test_background_reads_the_last_texel_and_outside_is_zero():
    texture = jnp.arange(3 * 4 * 4 * 2, dtype=jnp.float32).reshape(3, 4, 4, 2)
    read = sample_triplane(texture, jnp.asarray([[[1.0, 1, 1], [2, 2, 2]]]))
    assert read.shape == (1, 2, 6)
    assert np.allclose(read[0, 0], texture[:, -1, -1].ravel()) and np.array_equal(read[0, 1], np.zeros(6))
