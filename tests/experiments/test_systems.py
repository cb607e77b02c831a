"""The comparison systems: shapes, gradients, and the properties that define each system."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import random_inputs, random_variables
from system_cases import WIDTH, close, small_system

from experiments.systems import ONE_PHOTO, SYSTEMS
from experiments.systems.cross_attention import CrossAttentionReader
from experiments.systems.shell_textures import DISTANCES, ShellTextureReader, fill_unseen
from experiments.systems.two_stream import TwoStreamReader
from experiments.systems.unet import UNet
from humangs_jax.body.model import Texels
from humangs_jax.core.pytree import replace
from humangs_jax.network.humangs import apply_humangs, decode, encode, read
from humangs_jax.network.maps import sample_bilinear
from humangs_jax.network.parts import subject_unit
from humangs_jax.network.reader import project_vertices
from humangs_jax.network.upsampler import UpsamplerConfig

ATTENDING = ("cross_attention", "lhm_views", "lhm_plus")
OURS = (*ATTENDING, *ONE_PHOTO, "ghg")
VERTICES, JOINTS, TEXELS = 21, 3, 8
"""Sizes of the body; the vertices are no multiple of what pools or groups have."""
PER_VIEW = (
    "images",
    "cameras",
    "posed_vertices",
    "position_maps",
    "depth_maps",
    "foreground",
    "posed_normals",
)


def photos(name, **changes):
    inputs = random_inputs(views=1 if name in ONE_PHOTO else 2, vertices=VERTICES, **changes)
    rng = np.random.default_rng(2)
    # a row shows nothing
    weights = rng.dirichlet([1, 1, 1], (TEXELS, TEXELS)) * (np.arange(TEXELS) > 0)[:, None, None]
    corners = rng.integers(0, VERTICES, (TEXELS, TEXELS, 3))
    texels = Texels(jnp.asarray(corners, jnp.int32), jnp.asarray(weights, jnp.float32))
    skinning = jnp.asarray(rng.dirichlet([1] * JOINTS, VERTICES), jnp.float32)
    return replace(inputs, texels=texels, skinning_weights=skinning)


def in_order(inputs, order):
    views = lambda x: jax.tree.map(lambda leaf: leaf[np.asarray(order)], x)
    return replace(inputs, **{field: views(getattr(inputs, field)) for field in PER_VIEW})


def outputs_of(name, inputs, config=None):
    config = config or small_system(name)
    return jax.jit(lambda v, x: apply_humangs(v, x, config)[0].gaussians)(
        random_variables(config), inputs
    )


@pytest.mark.parametrize("name", ["lhm_plus", "gst", "ghg"])
def test_each_makes_gaussians_that_can_be_posed(name):
    config, inputs = small_system(name), photos(name)
    shapes = jax.eval_shape(lambda v: apply_humangs(v, inputs, config)[0], random_variables(config))
    if name == "ghg":
        count = TEXELS**2 * len(DISTANCES)
        assert shapes.skinning_weights.shape == (count, JOINTS)
    else:
        count = VERTICES * getattr(config.architecture.decoder, "gaussians_per_vertex", 1)
        assert shapes.skinning_weights is None and shapes.tight_offsets.shape[0] == VERTICES
    assert shapes.gaussians.means.shape == (count, 3)
    assert config.architecture.driver is None  # re-posing runs no network


@pytest.mark.slow
@pytest.mark.parametrize("name", OURS)
def test_every_parameter_has_a_finite_gradient(name):
    config, inputs = small_system(name), photos(name)
    variables = random_variables(config)

    def loss(params):
        gaussians = apply_humangs({**variables, "params": params}, inputs, config)[0].gaussians
        return sum(jnp.sum(jnp.sin(7 * x)) for x in jax.tree.leaves(gaussians))

    gradients = jax.jit(jax.grad(loss))(variables["params"])
    for path, gradient in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(gradient).all(), path
        assert np.abs(gradient).max() > 0, path


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lhm", "lhm_views", "gst"])
def test_cameras_and_poses_of_the_photos_are_irrelevant(name):
    inputs, others = photos(name), photos(name, seed=1)
    geometry = ("posed_vertices", "position_maps", "depth_maps", "posed_normals")
    changed = replace(
        inputs, cameras=others.cameras, **{field: getattr(others, field) for field in geometry}
    )
    given, moved = (outputs_of(name, x) for x in (inputs, changed))
    close(given, moved, bound=0)
    other_photo = outputs_of(name, replace(inputs, images=others.images))
    assert np.abs(other_photo.colors - given.colors).max() > 1e-3


@pytest.mark.parametrize("name", ONE_PHOTO)
def test_a_second_photo_is_refused(name):
    config = small_system(name)
    with pytest.raises(ValueError, match="2 photos: this system takes 1"):
        jax.eval_shape(
            lambda v: apply_humangs(v, random_inputs(views=2), config)[0], random_variables(config)
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ATTENDING, "ghg"])
def test_the_order_of_photos_and_padding_are_irrelevant(name):
    inputs = photos(name)
    close(outputs_of(name, inputs), outputs_of(name, in_order(inputs, [1, 0])))
    padded = replace(inputs, view_count=jnp.asarray(1))
    close(outputs_of(name, padded), outputs_of(name, in_order(inputs, [0])))


@pytest.mark.slow
def test_background_tokens_are_left_out_alike_by_encoder_and_reader():
    config = small_system("cross_attention")
    inputs = photos("cross_attention")
    inputs = replace(inputs, foreground=inputs.foreground.at[:, :16].set(False))
    packed = config.with_conventions(tokens="foreground")
    roomy = outputs_of("", inputs, packed)
    # 2 views, 2 of 4 rows of 4 patches
    close(roomy, outputs_of("", inputs, packed.with_runtime(token_capacity=16)))
    dropped = outputs_of("", inputs, packed.with_runtime(token_capacity=15))
    assert np.abs(dropped.colors - roomy.colors).max() > 1e-5


def test_attention_needs_a_token_a_patch_and_whole_heads():
    config = small_system("cross_attention")
    encoder = dataclasses.replace(
        config.architecture.encoder, upsampler=UpsamplerConfig(hidden=8, features="final")
    )
    with pytest.raises(ValueError, match=r"encoder\.upsampler must be None"):
        random_variables(config.with_parts(encoder=encoder))
    for reader in (CrossAttentionReader, TwoStreamReader):
        with pytest.raises(ValueError, match="width 10 is not a multiple of head_width 8"):
            reader(width=10, head_width=8)
    with pytest.raises(ValueError, match="blocks 0: expected 1 to"):
        TwoStreamReader(blocks=0)


@pytest.mark.slow
def test_pooled_points_are_fewer_tokens_and_every_vertex_keeps_its_own_place():
    config = small_system("lhm_plus")
    variables, inputs = random_variables(config), photos("lhm_plus")
    features = read(variables, encode(variables, inputs, config), inputs, config).local
    assert features.shape == (VERTICES, WIDTH)
    assert len(np.unique(np.asarray(features).round(5), axis=0)) == VERTICES


@pytest.mark.slow
def test_a_group_token_moves_only_its_group():
    config, inputs = small_system("gst"), photos("gst")
    variables = random_variables(config)
    tokens = jnp.asarray(np.random.default_rng(0).normal(size=(5, 4, WIDTH)), jnp.float32)
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
    inputs, tokens = random_inputs(views=1, vertices=65), jnp.zeros((5, 4, WIDTH))
    with pytest.raises(
        ValueError, match=r"a body of 65 vertices: 4 groups of decoder\.group_size 16 have 64"
    ):
        jax.eval_shape(lambda v: decode(v, tokens, inputs, config), random_variables(config))


@pytest.mark.slow
def test_a_seen_texel_has_the_color_of_the_pixel_that_sees_it_best_and_every_mean_lies_on_a_shell():
    config, inputs = small_system("ghg"), photos("ghg")
    textures = read({}, encode({}, inputs, config), inputs, config)
    unit, texels = subject_unit(inputs.canonical_vertices), inputs.texels
    cameras = inputs.cameras.in_units(unit)
    colors, facing = [], []
    for view in range(2):
        normals = texels.interpolate(inputs.posed_normals[view])
        normals /= jnp.linalg.norm(normals, axis=-1, keepdims=True) + 1e-9
        points = texels.interpolate(inputs.posed_vertices[view] / unit)
        points = (points + jnp.asarray(DISTANCES)[:, None, None, None] * normals).reshape(-1, 3)
        pixels, _ = project_vertices(cameras[view], points)
        colors.append(sample_bilinear(inputs.images[view], pixels - 0.5))
        away = cameras[view].center - points
        away = (away / jnp.linalg.norm(away, axis=-1, keepdims=True)).reshape(-1, TEXELS, TEXELS, 3)
        framed = jnp.all((pixels > 0) & (pixels < 32), axis=-1).reshape(away.shape[:-1])
        facing.append(
            np.asarray(jnp.where(framed & texels.covered, jnp.sum(away * normals, axis=-1), 0))
        )
    expected = np.where((facing[0] >= facing[1]).reshape(-1, 1), *colors).reshape(
        textures.colors.shape
    )
    seen = np.maximum(*facing) > 0
    np.testing.assert_array_equal(textures.seen, seen)
    assert 0 < seen.mean() < 1
    np.testing.assert_allclose(np.asarray(textures.colors)[seen], expected[seen], atol=2e-5)

    gaussians = decode(random_variables(config), textures, inputs, config).gaussians
    base = texels.interpolate(inputs.canonical_vertices / unit)
    distances = np.linalg.norm(
        np.asarray(gaussians.means / unit).reshape(5, TEXELS, TEXELS, 3) - base, axis=-1
    )
    shown = np.broadcast_to(texels.covered, distances.shape)
    steps = np.broadcast_to(np.asarray(DISTANCES)[:, None, None], distances.shape)
    np.testing.assert_allclose(distances[shown], steps[shown], atol=1e-5)
    opaque = np.asarray(gaussians.opacities).reshape(distances.shape) > 0
    # filled from neighbours where no photo sees it
    np.testing.assert_array_equal(opaque[0], texels.covered)
    np.testing.assert_array_equal(opaque[1:], seen[1:])


@pytest.mark.slow
def test_unseen_texels_are_filled_from_their_neighbours():
    colors, seen = np.zeros((4, 4, 3), np.float32), np.zeros((4, 4), bool)
    colors[0, 0], colors[3, 3] = 0.8, 0.2
    seen[0, 0] = seen[3, 3] = True
    fill = jax.jit(fill_unseen)
    filled = fill(colors, seen)
    close(filled[0, 0], colors[0, 0], bound=0)
    close(filled[1, 1], np.full(3, 0.8))  # of its square of 2 x 2
    close(filled[0, 3], np.full(3, 0.5))  # of the whole map
    close(fill(colors, np.zeros_like(seen)), np.full((4, 4, 3), 0.5))


def test_shells_and_maps_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="expected ascending distances, the first 0"):
        ShellTextureReader(shells=(0.01, 0.02))
    with pytest.raises(
        ValueError, match=r"maps of 6 x 6: a U-Net of 3 scales needs multiples of 4"
    ):
        jax.eval_shape(
            lambda: UNet((2, 2, 2), (1,)).init(jax.random.key(0), jnp.zeros((1, 6, 6, 1)))
        )
    inputs, config = photos("ghg"), small_system("ghg")
    with pytest.raises(ValueError, match="shell textures need texels"):
        read({}, encode({}, inputs, config), replace(inputs, texels=None), config)


def test_every_system_has_both_sizes_of_the_same_parts():
    for make in SYSTEMS.values():
        published, bench = make("published"), make("bench")
        assert bench.conventions.image_size == 32 < published.conventions.image_size

        def kinds(config):
            return [
                type(part) for part in (config.architecture.reader, config.architecture.decoder)
            ]

        assert kinds(published) == kinds(bench)
    assert SYSTEMS["lhm_plus"]("bench").architecture.reader.pooling == 4
