"""The comparison systems: shapes, gradients, and the properties that make each of them that system."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import random_inputs, random_variables
from system_cases import HEAD, WIDTH, small_system

from humangs_jax.core.pytree import replace
from humangs_jax.network.cross_attention import CrossAttentionReader
from humangs_jax.network.humangs import apply_humangs, decode, encode, read
from humangs_jax.network.systems import ONE_PHOTO, SYSTEMS
from humangs_jax.network.two_stream import TwoStreamReader, along_curve
from humangs_jax.network.upsampler import UpsamplerConfig

OURS = ("cross_attention", "lhm", "lhm_views", "lhm_plus", "gst")
ATTENDING = tuple(name for name in OURS if name not in ONE_PHOTO)
VERTICES = 21
"""Not a multiple of what pools or groups have."""


def photos(name, **changes):
    return random_inputs(views=1 if name in ONE_PHOTO else 2, vertices=VERTICES, **changes)


def outputs_of(name, inputs, config=None):
    config = config or small_system(name)
    return jax.jit(lambda v, x: apply_humangs(v, x, config)[0].gaussians)(random_variables(config), inputs)


def close(a, b, bound=2e-5):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=bound)


@pytest.mark.parametrize("name", OURS)
def test_every_parameter_has_a_finite_gradient(name):
    config, inputs = small_system(name), photos(name)
    variables = random_variables(config)

    def loss(params):
        gaussians = apply_humangs({**variables, "params": params}, inputs, config)[0].gaussians
        assert gaussians.means.shape == (VERTICES * getattr(config.architecture.decoder, "gaussians_per_vertex", 1), 3)
        return sum(jnp.sum(jnp.sin(7 * x)) for x in jax.tree.leaves(gaussians))

    gradients = jax.jit(jax.grad(loss))(variables["params"])
    for path, gradient in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(gradient).all(), path
        assert np.abs(gradient).max() > 0, path


@pytest.mark.parametrize("name", ["lhm", "lhm_views", "gst"])
def test_cameras_and_poses_of_the_photos_are_irrelevant(name):
    inputs, others = photos(name), photos(name, seed=1)
    geometry = ("posed_vertices", "position_maps", "depth_maps", "posed_normals")
    changed = replace(inputs, cameras=others.cameras, **{field: getattr(others, field) for field in geometry})
    given, moved = (outputs_of(name, x) for x in (inputs, changed))
    close(given, moved, bound=0)
    other_photo = outputs_of(name, replace(inputs, images=others.images))
    assert np.abs(other_photo.colors - given.colors).max() > 1e-3


@pytest.mark.parametrize("name", ONE_PHOTO)
def test_a_second_photo_is_refused(name):
    config = small_system(name)
    with pytest.raises(ValueError, match="2 photos: this system takes 1"):
        jax.eval_shape(lambda v: apply_humangs(v, random_inputs(views=2), config)[0], random_variables(config))


@pytest.mark.parametrize("name", ATTENDING)
def test_the_order_of_photos_and_padding_are_irrelevant(name):
    inputs = photos(name)
    views = lambda x, order: jax.tree.map(lambda leaf: leaf[order], x)
    fields = ("images", "cameras", "posed_vertices", "position_maps", "depth_maps", "foreground", "posed_normals")
    taken = lambda order: replace(
        inputs, **{field: views(getattr(inputs, field), np.asarray(order)) for field in fields}
    )
    close(outputs_of(name, inputs), outputs_of(name, taken([1, 0])))
    padded = replace(inputs, view_count=jnp.asarray(1))
    close(outputs_of(name, padded), outputs_of(name, taken([0])))


def test_background_tokens_are_left_out_alike_by_encoder_and_reader():
    config = small_system("cross_attention")
    inputs = photos("cross_attention")
    inputs = replace(inputs, foreground=inputs.foreground.at[:, :16].set(False))
    packed = config.with_conventions(tokens="foreground")
    roomy = outputs_of("", inputs, packed)
    close(roomy, outputs_of("", inputs, packed.with_execution(token_capacity=16)))  # 2 views, 2 of 4 rows of 4 patches
    dropped = outputs_of("", inputs, packed.with_execution(token_capacity=15))
    assert np.abs(dropped.colors - roomy.colors).max() > 1e-5


def test_attention_needs_a_token_a_patch_and_whole_heads():
    config = small_system("cross_attention")
    encoder = dataclasses.replace(
        config.architecture.encoder,
        upsampler=UpsamplerConfig(hidden=8, features="final"),
    )
    with pytest.raises(ValueError, match=r"encoder\.upsampler must be None"):
        random_variables(config.with_parts(encoder=encoder))
    for reader in (CrossAttentionReader, TwoStreamReader):
        with pytest.raises(ValueError, match="width 10 is not a multiple of head_width 8"):
            reader(width=10, head_width=8)


def test_neighbours_along_the_curve_are_neighbours_in_space():
    positions = jnp.asarray(np.random.default_rng(0).uniform(-1, 1, (512, 3)), jnp.float32)
    ranks = along_curve(positions)
    assert sorted(ranks.tolist()) == list(range(512))
    ordered = np.asarray(positions)[np.argsort(ranks)]
    steps = np.linalg.norm(np.diff(ordered, axis=0), axis=-1).mean()
    assert steps < 0.4 * np.linalg.norm(np.diff(positions, axis=0), axis=-1).mean()


def test_pooled_points_are_fewer_tokens_and_every_vertex_keeps_its_own_place():
    config = small_system("lhm_plus")
    reader = config.architecture.reader
    assert reader.pooling == 4 and SYSTEMS["lhm_views"]("bench").architecture.reader.pooling == 1
    variables, inputs = random_variables(config), photos("lhm_plus")
    features = read(variables, encode(variables, inputs, config), inputs, config).local
    assert features.shape == (VERTICES, WIDTH)
    assert len(np.unique(np.asarray(features).round(5), axis=0)) == VERTICES


def test_a_group_token_moves_only_its_group():
    config, inputs = small_system("gst"), photos("gst")
    variables = random_variables(config)
    tokens = read(variables, encode(variables, inputs, config), inputs, config)
    assert tokens.shape == (5, 4, WIDTH)
    before = decode(variables, tokens, inputs, config).gaussians
    moved = decode(variables, tokens.at[:, 1].add(1.0), inputs, config).gaussians
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(moved), strict=True):
        same = np.all(np.asarray(a == b).reshape(VERTICES, -1), axis=1)
        assert same[:16].all() and not same[16:].any()  # groups of 16: the second has what is left
    offset = decode(variables, tokens.at[0, 0].add(1.0), inputs, config).gaussians
    assert np.abs(offset.means - before.means).max() > 0
    close(replace(offset, means=before.means), before, bound=0)


def test_a_body_that_has_no_room_in_the_groups_is_refused():
    config = small_system("gst")
    with pytest.raises(ValueError, match=r"a body of 65 vertices: 4 groups of decoder\.group_size 16 have 64"):
        jax.eval_shape(
            lambda v: apply_humangs(v, random_inputs(views=1, vertices=65), config)[0], random_variables(config)
        )


def test_every_system_has_both_sizes_and_heads_that_fill_them():
    assert HEAD < WIDTH
    for make in SYSTEMS.values():
        published, bench = make("published"), make("bench")
        assert bench.conventions.image_size == 128 < published.conventions.image_size
        kinds = lambda config: [type(part) for part in (config.architecture.reader, config.architecture.decoder)]
        assert kinds(published) == kinds(bench)
