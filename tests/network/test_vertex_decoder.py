import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import TINY, random_inputs

from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.network.parts import Shells, VertexFeatures
from humangs_jax.network.vertex_decoder import (
    OBLIQUE,
    RawGaussians,
    VertexDecoder,
    activate,
    corrected_skinning_weights,
    decoder_input,
    normal_frames,
    positional_encoding,
)

CONFIG = VertexDecoder(tight=1, free=1)
NORMALS = jnp.asarray([[1.0, 0, 0], [0, 0.6, 0.8]])


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
    features = VertexFeatures(
        jnp.full((2, 3), 1.0), jnp.full(2, 2.0), jnp.full((2, 3), 0.75), jnp.full(2, 0.25)
    )
    entering = decoder_input(features, jnp.zeros((2, 3)))
    assert entering.shape == (2, 3 + 2 + 39 + 4)
    assert np.array_equal(entering[0, :5], [1, 1, 1, 2, 2]) and np.array_equal(
        entering[0, -4:], [0.5, 0.5, 0.5, 0.25]
    )


def test_offsets_are_bounded_by_their_scale_and_untouched_near_zero():
    raw, bounded = random_raw(), dataclasses.replace(CONFIG, offset_scale=0.1)
    far = dataclasses.replace(raw, geometry=100 * raw.geometry)
    near = dataclasses.replace(raw, geometry=1e-3 * raw.geometry)
    assert (
        np.abs(activate(far, bounded).offsets).max()
        <= 0.1
        < np.abs(activate(far, CONFIG).offsets).max()
    )
    assert np.allclose(activate(near, bounded).offsets, activate(near, CONFIG).offsets, rtol=1e-3)


def test_residual_colors_start_from_the_photo_and_stay_correctable():
    raw = random_raw()
    photo = jnp.asarray([[0.2, 0.5, 0.8], [0.0, 1.0, 0.5], [1, 1, 1], [0, 0, 0]])
    config = dataclasses.replace(CONFIG, residual_color=True)
    features = VertexFeatures(jnp.zeros((4, 1)), photo_colors=photo)
    silent = dataclasses.replace(raw, appearance=jnp.zeros_like(raw.appearance))
    assert np.allclose(activate(silent, config, features).colors, photo[:, None], atol=0.0101)
    slope = jax.grad(
        lambda a: jnp.sum(activate(dataclasses.replace(raw, appearance=a), config, features).colors)
    )
    assert np.abs(slope(silent.appearance)[..., :3]).min() > 1e-3


def test_skinning_weights_are_corrected_by_their_logits():
    weights = jnp.asarray([[0.25, 0.75, 0.0], [1.0, 0.0, 0.0]])
    assert np.array_equal(
        corrected_skinning_weights(weights, None, 2), np.repeat(weights, 2, axis=0)
    )
    offsets = jnp.zeros((4, 3)).at[1].set(jnp.asarray([jnp.log(3.0), 0, 0]))
    corrected = corrected_skinning_weights(weights, offsets, 2)
    assert np.allclose(corrected, [[0.25, 0.75, 0], [0.5, 0.5, 0], [1, 0, 0], [1, 0, 0]], atol=1e-6)
    assert np.isfinite(
        jax.grad(lambda w: jnp.sum(corrected_skinning_weights(w, offsets, 2) ** 2))(weights)
    ).all()


def shells_of(colors):
    """Returns three shells of two vertices; the last shell is outside of the hull."""
    seen, hull = jnp.ones((2, 3)), jnp.asarray([[1.0, 1, 0]] * 2)
    return Shells(jnp.asarray([0.0, 0.1, 0.2]), colors, seen, hull, hull)


@pytest.mark.slow
def test_gaussians_choose_their_shell_and_its_color():
    colors = jnp.asarray(np.random.default_rng(5).uniform(0.1, 0.9, (2, 3, 3)), jnp.float32)
    features = VertexFeatures(jnp.zeros((2, 1)), shells=shells_of(colors), normals=NORMALS)
    config, k = (
        dataclasses.replace(CONFIG, frame="normal", residual_color=True),
        CONFIG.gaussians_per_vertex,
    )
    logits = jnp.full((2, k, 3), -40.0).at[0, 0, 2].set(40).at[0, 1:, 0].set(40).at[1, :, 1].set(40)
    raw = RawGaussians(jnp.zeros((2, k, 10)).at[..., 3].set(1), jnp.zeros((2, k, 4)), None, logits)
    chosen = activate(raw, config, features)
    assert np.allclose(chosen.offsets[0, 0], [0.2, 0, 0], atol=1e-6) and np.allclose(
        chosen.offsets[0, 1:], 0
    )
    assert np.allclose(chosen.offsets[1], [0, 0.06, 0.08], atol=1e-6)
    assert np.allclose(chosen.colors[0, 0], colors[0, 2], atol=1e-3)
    assert np.allclose(chosen.colors[1], colors[1, 1], atol=1e-3)
    halfway = activate(dataclasses.replace(raw, shells=jnp.zeros_like(logits)), config, features)
    assert np.allclose(halfway.offsets[0], [0.1, 0, 0], atol=1e-6)
    slope = jax.grad(
        lambda x: jnp.sum(activate(dataclasses.replace(raw, shells=x), config, features).offsets)
    )
    assert np.all(np.abs(slope(jnp.zeros_like(logits))[..., (0, 2)]) > 1e-3)


def biases_of(decoder, features):
    """Returns fresh biases of the last layers, from which Gaussians start."""
    init = jax.jit(
        lambda features: decoder.init(
            jax.random.key(0), features, random_inputs(vertices=2), TINY.forward_context()
        )
    )
    params = init(features)["params"]
    return {name: layer["bias"] for name, layer in params.items()}


def test_shells_enter_the_decoder_and_start_at_the_surface():
    colors = jnp.full((2, 3, 3), 0.75)
    features = VertexFeatures(
        jnp.zeros((2, 1)),
        photo_colors=colors[:, 0],
        visible_fraction=jnp.ones(2),
        shells=shells_of(colors),
    )
    entering = decoder_input(features, jnp.zeros((2, 3)))
    assert entering.shape == (2, 1 + 39 + 4 + 3 * 6)
    assert np.allclose(entering[0, -18:], [0.5] * 9 + [1] * 3 + [1, 1, 0] * 2)
    first = biases_of(dataclasses.replace(CONFIG, hidden=8), features)["shells_out"].reshape(2, 3)
    assert np.all(jax.nn.softmax(first)[..., 0] > 0.9)


@pytest.mark.slow
def test_in_the_frame_of_the_normal_gaussians_lie_flat_on_the_surface():
    frames = normal_frames(NORMALS)
    axes = quaternion.to_matrix(frames)
    assert np.allclose(axes[..., 2], NORMALS, atol=1e-6)
    config = dataclasses.replace(CONFIG, frame="normal")
    entering = decoder_input(VertexFeatures(jnp.zeros((2, 1)), normals=NORMALS), jnp.zeros((2, 3)))
    assert np.array_equal(entering[:, -3:], NORMALS)
    features = VertexFeatures(jnp.zeros((2, 1)), normals=NORMALS)
    first = biases_of(dataclasses.replace(config, hidden=8), features)
    geometry = jnp.tile(first["geometry_out"].reshape(1, 2, 10), (2, 1, 1))
    raw = RawGaussians(geometry, jnp.zeros((2, 2, 4)), None)
    placed = activate(raw, config, VertexFeatures(jnp.zeros((2, 1)), normals=NORMALS))
    thin = placed.scales[..., 2] / placed.scales[..., 0]
    assert np.all((thin > 0.2) & (thin < 0.4))
    assert np.allclose(quaternion.to_matrix(placed.quats)[..., 2], NORMALS[:, None], atol=0.05)
    up = dataclasses.replace(raw, geometry=raw.geometry.at[..., :3].set(jnp.asarray([0, 0, 0.1])))
    offsets = activate(up, config, VertexFeatures(jnp.zeros((2, 1)), normals=NORMALS)).offsets
    assert np.allclose(offsets, 0.1 * NORMALS[:, None], atol=1e-6)


def test_frames_turn_smoothly_with_the_normal():
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals = normals[normals @ np.asarray(OBLIQUE) > -0.9]
    near = normals + 1e-3 * rng.normal(size=normals.shape)
    near /= np.linalg.norm(near, axis=-1, keepdims=True)
    a, b = (
        quaternion.to_matrix(normal_frames(jnp.asarray(x, jnp.float32))) for x in (normals, near)
    )
    assert np.abs(a - b).max() < 0.05


def test_scales_follow_the_spacing_of_vertices_and_nothing_else_does():
    inputs = random_inputs(vertices=4)
    decoder = VertexDecoder(hidden=8, tight=1, free=1)
    features = VertexFeatures(jnp.ones((4, 3)), jnp.ones(2))
    ctx = TINY.forward_context()
    variables = decoder.init(jax.random.key(0), features, inputs, ctx)
    spacing = jnp.asarray([1.0, 0.5, 0.25, 2.0])
    as_trained = decoder.apply(variables, features, inputs, ctx).gaussians
    finer = decoder.apply(
        variables, features, replace(inputs, relative_vertex_spacing=spacing), ctx
    ).gaussians
    np.testing.assert_allclose(
        finer.scales, as_trained.scales * jnp.repeat(spacing, 2)[:, None], rtol=1e-6
    )
    assert jax.tree.all(
        jax.tree.map(np.array_equal, replace(finer, scales=0), replace(as_trained, scales=0))
    )


def test_quaternions_are_unit_whatever_the_head_says():
    raw = random_raw(seed=3)
    for factor in (1e-3, 1.0, 1e3):
        quats = activate(dataclasses.replace(raw, geometry=factor * raw.geometry), CONFIG).quats
        assert np.allclose(np.linalg.norm(quats, axis=-1), 1, atol=1e-6)


def test_a_person_twice_as_large_has_gaussians_twice_as_large():
    """The network sees a body of 1.8 m; means, offsets and scales are in metres again."""
    decoder, features = (
        VertexDecoder(hidden=8, tight=1, free=1),
        VertexFeatures(jnp.ones((4, 3)), jnp.ones(2)),
    )
    inputs, ctx = random_inputs(vertices=4), TINY.forward_context()
    variables = decoder.init(jax.random.key(0), features, inputs, ctx)
    larger = replace(inputs, canonical_vertices=2 * inputs.canonical_vertices)
    one, two = (decoder.apply(variables, features, x, ctx) for x in (inputs, larger))
    for name, factor in {"means": 2, "scales": 2, "quats": 1, "opacities": 1, "colors": 1}.items():
        np.testing.assert_allclose(
            getattr(two.gaussians, name), factor * getattr(one.gaussians, name), rtol=1e-5
        )
    # in normalised units
    np.testing.assert_allclose(two.tight_offsets, one.tight_offsets, rtol=1e-5)
    height = float(jnp.ptp(inputs.canonical_vertices[:, 1]))
    np.testing.assert_allclose(
        one.gaussians.scales, jax.nn.softplus(-3.0) * height / 1.8, rtol=0.02
    )
