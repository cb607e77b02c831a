import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.models.vertex_decoder import (
    RawGaussians,
    VertexDecoderConfig,
    VertexFeatures,
    activate,
    corrected_skinning_weights,
    decoder_input,
    positional_encoding,
)

CONFIG = VertexDecoderConfig(tight=1, free=1)


def random_raw(seed=0, n=4):
    rng = np.random.default_rng(seed)
    return RawGaussians(
        jnp.asarray(rng.normal(size=(n, 2, 10)), jnp.float32),
        jnp.asarray(rng.normal(size=(n, 2, 4)), jnp.float32),
        None,
    )


def test_positional_encoding_order():
    x = jnp.asarray([[0.1, -0.2, 0.3]])
    encoded = positional_encoding(x)
    assert encoded.shape == (1, 39) and np.array_equal(encoded[:, :3], x)
    assert np.allclose(encoded[0, 3:6], jnp.sin(np.pi * x[0]), atol=1e-6)
    assert np.allclose(encoded[0, 36:], jnp.cos(32 * np.pi * x[0]), atol=1e-5)


def test_inputs_are_concatenated_in_order():
    features = VertexFeatures(jnp.full((2, 3), 1.0), jnp.full(2, 2.0), jnp.full((2, 3), 0.75), jnp.full(2, 0.25))
    entering = decoder_input(features, jnp.zeros((2, 3)))
    assert entering.shape == (2, 3 + 2 + 39 + 4)
    assert np.array_equal(entering[0, :5], [1, 1, 1, 2, 2]) and np.array_equal(entering[0, -4:], [0.5, 0.5, 0.5, 0.25])


def test_offsets_are_bounded_by_their_scale_and_untouched_near_zero():
    raw, bounded = random_raw(), dataclasses.replace(CONFIG, offset_scale=0.1)
    far = dataclasses.replace(raw, geometry=100 * raw.geometry)
    near = dataclasses.replace(raw, geometry=1e-3 * raw.geometry)
    assert np.abs(activate(far, bounded).offsets).max() <= 0.1 < np.abs(activate(far, CONFIG).offsets).max()
    assert np.allclose(activate(near, bounded).offsets, activate(near, CONFIG).offsets, rtol=1e-3)


def test_residual_colours_start_from_the_photo_and_stay_correctable():
    raw = random_raw()
    photo = jnp.asarray([[0.2, 0.5, 0.8], [0.0, 1.0, 0.5], [1, 1, 1], [0, 0, 0]])
    config = dataclasses.replace(CONFIG, residual_color=True)
    silent = dataclasses.replace(raw, appearance=jnp.zeros_like(raw.appearance))
    assert np.allclose(activate(silent, config, photo).colors, photo[:, None], atol=0.0101)
    slope = jax.grad(lambda a: jnp.sum(activate(dataclasses.replace(raw, appearance=a), config, photo).colors))
    assert np.abs(slope(silent.appearance)[..., :3]).min() > 1e-3


def test_skinning_weights_are_corrected_by_their_logits():
    weights = jnp.asarray([[0.25, 0.75, 0.0], [1.0, 0.0, 0.0]])
    assert np.array_equal(corrected_skinning_weights(weights, None, 2), np.repeat(weights, 2, axis=0))
    offsets = jnp.zeros((4, 3)).at[1].set(jnp.asarray([jnp.log(3.0), 0, 0]))
    corrected = corrected_skinning_weights(weights, offsets, 2)
    assert np.allclose(corrected, [[0.25, 0.75, 0], [0.5, 0.5, 0], [1, 0, 0], [1, 0, 0]], atol=1e-6)
    assert np.isfinite(jax.grad(lambda w: jnp.sum(corrected_skinning_weights(w, offsets, 2) ** 2))(weights)).all()
