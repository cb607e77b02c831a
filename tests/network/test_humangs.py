import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import ALL_TOKENS, TINY, random_inputs, random_variables

from humangs_jax.core.pytree import replace
from humangs_jax.network import presets
from humangs_jax.network.config import Architecture, paper_parts
from humangs_jax.network.encoder import (
    PatchTransformer,
    needed_tokens,
    pack_patches,
    touched_patches,
)
from humangs_jax.network.humangs import apply_humangs, encode, read
from humangs_jax.network.parts import Encoding, subject_unit
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import Block, TransformerConfig
from humangs_jax.network.vertex_decoder import VertexDecoder
from humangs_jax.network.weights import expected_variables

FLOAT32_TOLERANCE = 1e-5
"""Sums in another order: a few layers of float32 roundings of numbers of order one."""
BFLOAT16_TOLERANCE = 0.05
"""Some twenty roundings in a row of numbers of order one: bfloat16 has 8 bits (0.4 %)."""


PER_VIEW = ("images", "posed_vertices", "posed_normals", "position_maps", "depth_maps")


@functools.partial(jax.jit, static_argnames=("config",))
def run(variables, inputs, config):
    """Returns (encoding, outputs), compiled once for each configuration and shape.

    The compiler merges what both compute.
    """
    return encode(variables, inputs, config), apply_humangs(variables, inputs, config)[0]


def close(a, b, tolerance=FLOAT32_TOLERANCE):
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.allclose(x, y, rtol=tolerance, atol=tolerance) for x, y in pairs)


ENCODER, READER, DECODER = paper_parts(TINY.architecture)


@functools.cache
def variables_of(config):
    return random_variables(config)


# shapes


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(presets.PRESETS))
def test_presets_have_the_shapes_they_promise(name):
    """The network is traced at full size, and nothing is computed."""
    config = presets.PRESETS[name]()
    views, vertices, size = 4, 37, config.conventions.image_size
    inputs = jax.eval_shape(
        lambda: jax.tree.map(jnp.asarray, random_inputs(0, views, vertices, size))
    )
    variables = expected_variables(config)
    encoding, outputs = jax.eval_shape(lambda v, x: run(v, x, config), variables, inputs)
    encoder, _, decoder = paper_parts(config.architecture)
    side = size // encoder.patch_size * (4 if encoder.upsampler else 1)
    width = encoder.upsampler.hidden // 2 if encoder.upsampler else encoder.transformer.width
    assert encoding.maps.shape == (views, side, side, width)
    assert (
        encoding.maps.dtype == (jnp.bfloat16 if config.runtime.dtype == "bfloat16" else jnp.float32)
        or side == size // 8
    )
    assert outputs.gaussians.means.shape == (vertices * decoder.gaussians_per_vertex, 3)
    assert outputs.tight_offsets.shape == (vertices, 1, 3)
    assert all(
        leaf.dtype == jnp.float32 for leaf in jax.tree.leaves((outputs.gaussians, variables))
    )


def test_the_published_network_has_99_million_parameters():
    params = expected_variables(presets.published())["params"]
    assert round(sum(leaf.size for leaf in jax.tree.leaves(params)) / 1e6) == 99


@pytest.mark.slow
@pytest.mark.parametrize("class_token", [True, False])
@pytest.mark.parametrize("sample_rgb", [True, False])
def test_the_decoder_is_as_wide_as_what_enters(class_token, sample_rgb):
    config = TINY.with_parts(
        encoder=dataclasses.replace(
            ENCODER,
            transformer=dataclasses.replace(ENCODER.transformer, class_token=class_token),
            upsampler=ENCODER.upsampler if class_token else None,
        ),
        reader=dataclasses.replace(
            READER, output_width=8 if class_token else None, sample_rgb=sample_rgb
        ),
        decoder=dataclasses.replace(DECODER, residual_color=sample_rgb),
    )
    variables = expected_variables(config)
    assert bool(variables["batch_stats"]) == class_token
    encoding, _ = jax.eval_shape(lambda v: run(v, random_inputs(), config), variables)
    assert (encoding.global_token is not None) == class_token
    kernel = variables["params"]["decoder"]["trunk_0"]["kernel"]
    local, width = 8 if class_token else 16, ENCODER.transformer.width
    assert kernel.shape[0] == local + width * class_token + 39 + 4 * sample_rgb + 3 + 7 * 6


# values


@pytest.mark.slow
def test_fresh_gaussians_sit_on_the_vertices_with_the_color_of_the_photos():
    inputs = random_inputs()
    inputs = replace(inputs, images=jnp.full_like(inputs.images, 0.7))
    plain = TINY.with_parts(
        reader=dataclasses.replace(READER, shells=()),
        decoder=dataclasses.replace(DECODER, frame="canonical"),
    )
    variables = variables_of(plain)
    features = read(variables, encode(variables, inputs, plain), inputs, plain)
    decoder = plain.architecture.decoder.init(
        jax.random.key(0), features, inputs, plain.forward_context()
    )
    variables = {**variables, "params": {**variables["params"], "decoder": decoder["params"]}}
    fresh = run(variables, inputs, plain)[1].gaussians
    unit, k = subject_unit(inputs.canonical_vertices), DECODER.gaussians_per_vertex
    assert np.abs(fresh.means - jnp.repeat(inputs.canonical_vertices, k, axis=0)).max() < 0.02
    assert np.allclose(fresh.scales, 0.0082 * unit, rtol=0.1)  # softplus(-4.8) = 8.2 mm
    assert np.allclose(fresh.opacities, jax.nn.sigmoid(-1.0), atol=0.01) and np.allclose(
        fresh.colors, 0.7, atol=0.01
    )
    assert np.allclose(jnp.abs(fresh.quats[:, 0]), 1, atol=0.01)


def test_deeper_blocks_begin_smaller():
    config = TransformerConfig(width=64, layers=4, head_width=32)
    kernel = jax.jit(Block(config, Runtime(), 3).init)(jax.random.key(0), jnp.zeros((2, 64)))[
        "params"
    ]["mlp_in"]["kernel"]
    assert np.isclose(kernel.std(), 0.02 / np.sqrt(2 * 4), rtol=0.05)


@pytest.mark.slow
def test_the_order_of_the_views_does_not_matter():
    """Maps are permuted like the views, and what is pooled stays."""
    inputs, order = random_inputs(), jnp.asarray([1, 0])
    per_view = {name: getattr(inputs, name) for name in PER_VIEW}
    permuted = replace(
        inputs,
        cameras=jax.tree.map(lambda x: x[order], inputs.cameras),
        **{name: x[order] for name, x in per_view.items()},
    )
    variables = variables_of(ALL_TOKENS)
    (encoding, outputs), (other_encoding, other_outputs) = (
        run(variables, x, ALL_TOKENS) for x in (inputs, permuted)
    )
    assert close(encoding.maps[order], other_encoding.maps) and not close(
        encoding.maps, other_encoding.maps
    )
    assert close(encoding.global_token, other_encoding.global_token) and close(
        outputs, other_outputs
    )


@pytest.mark.slow
def test_foreground_tokens_are_all_tokens_when_everything_is_foreground():
    inputs = random_inputs()
    patches = 2 * (32 // 8) ** 2
    config = TINY.with_runtime(token_capacity=patches + 50)
    variables = variables_of(ALL_TOKENS)
    (encoding, outputs), (all_encoding, all_outputs) = (
        run(variables, inputs, c) for c in (config, ALL_TOKENS)
    )
    assert close((encoding.maps, outputs), (all_encoding.maps, all_outputs))


@pytest.mark.slow
def test_background_patches_are_unseen_and_dropped_ones_are_counted():
    inputs = random_inputs()
    foreground = np.zeros((2, 32, 32), bool)
    foreground[0, 8:24, 16:32] = foreground[1, 3, 9] = True  # four patches, and one
    inputs = replace(inputs, foreground=jnp.asarray(foreground))
    variables = variables_of(TINY)
    roomy, exact, tight = TINY, *(TINY.with_runtime(token_capacity=n) for n in (5, 3))
    encoding, outputs = run(variables, inputs, roomy)
    exactly, same = run(variables, inputs, exact)
    # padding is nothing
    assert outputs.dropped_tokens == 0 and close((encoding.maps, outputs), (exactly.maps, same))
    touched = np.kron(foreground.reshape(2, 4, 8, 4, 8).any((2, 4)), np.ones((8, 8), bool))
    noise = jnp.where(touched[..., None], inputs.images, 0.123)
    assert close(encoding, run(variables, replace(inputs, images=noise), roomy)[0])
    assert not close(
        encoding,
        run(variables, replace(inputs, images=inputs.images.at[1, 0, 8].add(0.5)), roomy)[0],
    )
    assert (
        run(variables, inputs, tight)[1].dropped_tokens == 2
        and needed_tokens(inputs.foreground, None, 8) == 5
    )
    packing = pack_patches(touched_patches(inputs.foreground, None, 8), 3)
    assert packing.count == 3 and np.array_equal(packing.indices, [6, 7, 10])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [("bfloat16", BFLOAT16_TOLERANCE), ("float16", BFLOAT16_TOLERANCE / 4)]
)
def test_short_number_types_are_close(dtype, tolerance):
    variables, inputs = variables_of(ALL_TOKENS), random_inputs()
    encoding, outputs = run(variables, inputs, ALL_TOKENS.with_runtime(dtype=dtype))
    exact_encoding, exact = run(variables, inputs, ALL_TOKENS)
    assert encoding.maps.dtype == dtype
    scale = jnp.abs(exact_encoding.maps).max()
    assert (
        jnp.abs(encoding.maps.astype(jnp.float32) - exact_encoding.maps).max() < tolerance * scale
    )
    assert close(outputs.gaussians.means, exact.gaussians.means, tolerance)
    assert close(outputs.gaussians.colors, exact.gaussians.colors, 2 * tolerance)


@pytest.mark.slow
def test_unseen_vertices_are_grey_and_pool_nothing():
    inputs = replace(random_inputs(), depth_maps=jnp.full((2, 32, 32), -1.0))
    encoding = Encoding(jnp.ones((2, 16, 16, 4)), jnp.ones(16), jnp.int32(0))
    variables = variables_of(TINY)
    features = read(variables, encoding, inputs, TINY)
    assert np.array_equal(features.local, np.zeros((20, 8))) and np.array_equal(
        features.photo_colors, np.full((20, 3), 0.5)
    )
    assert np.array_equal(features.visible_fraction, np.zeros(20))
    every = TINY.with_conventions(pool="all")
    assert np.abs(read(variables, encoding, inputs, every).local).min(axis=1).max() > 0


# views that are padding, vertices that are not seen


def padded(inputs, views):
    """Returns the inputs with garbage behind their views."""
    missing = views - len(inputs.images)

    def extend(x, junk):
        return jnp.concatenate(
            [x, jnp.broadcast_to(jnp.asarray(junk, x.dtype), (missing, *x.shape[1:]))]
        )

    return replace(
        inputs,
        images=extend(inputs.images, 0.9),
        cameras=jax.tree.map(lambda x: extend(x, x[-1]), inputs.cameras),
        posed_vertices=extend(inputs.posed_vertices, 0.1),
        posed_normals=extend(inputs.posed_normals, 0.5),
        position_maps=extend(inputs.position_maps, 0.2),
        depth_maps=extend(inputs.depth_maps, 9.0),
        foreground=extend(inputs.foreground, True),
        view_count=jnp.asarray(len(inputs.images)),
    )


PUBLISHED_LIKE = ALL_TOKENS.with_conventions(pool="all", pixel_grid="mixed")


@pytest.mark.slow
@pytest.mark.parametrize("train", [False, True])
@pytest.mark.parametrize("config", [TINY.with_runtime(token_capacity=64), PUBLISHED_LIKE])
def test_padding_views_change_nothing(config, train):
    inputs, variables = random_inputs(), variables_of(PUBLISHED_LIKE)
    apply = jax.jit(lambda x: apply_humangs(variables, x, config, train))
    (outputs, statistics), (expected, expected_statistics) = apply(padded(inputs, 3)), apply(inputs)
    assert close((outputs, statistics), (expected, expected_statistics), 10 * FLOAT32_TOLERANCE)
    assert not close(outputs, apply(replace(padded(inputs, 3), view_count=jnp.asarray(3)))[0], 1e-3)


# gradients and batches


def loss(variables, inputs, config):
    outputs, _ = apply_humangs(variables, inputs, config, train=True)
    leaves = [*jax.tree.leaves(outputs.gaussians), outputs.tight_offsets]
    return sum(jnp.sum(jnp.sin(leaf)) for leaf in leaves)


@functools.partial(jax.jit, static_argnames="config")
def gradients(variables, continuous, inputs, config):
    def outputs_of(params, continuous):
        return loss({**variables, "params": params}, replace(inputs, **continuous), config)

    return jax.grad(outputs_of, (0, 1))(variables["params"], continuous)


@pytest.mark.slow
def test_gradients_are_finite_and_reach_every_parameter():
    inputs = random_inputs()
    cameras = inputs.cameras
    # in and behind the camera
    posed = inputs.posed_vertices.at[:, 0].set(cameras.center).at[:, 1].set(2 * cameras.center)
    # some vertices are seen by none
    inputs = replace(inputs, depth_maps=inputs.depth_maps.at[:, :16].set(-1.0))
    continuous = {
        "posed_vertices": posed,
        "images": inputs.images,
        "canonical_vertices": inputs.canonical_vertices,
    }
    config = TINY.with_runtime(remat="full")
    of_params, of_inputs = gradients(variables_of(TINY), continuous, inputs, config)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((of_params, of_inputs)))
    silent = [
        path
        for path, leaf in jax.tree_util.tree_leaves_with_path(of_params)
        if not np.abs(leaf).max() > 0
    ]
    assert not silent


@pytest.mark.slow
def test_a_vmap_over_subjects_is_a_loop():
    subjects = [random_inputs(seed) for seed in range(2)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *subjects)
    variables = variables_of(TINY)
    apply = functools.partial(apply_humangs, config=TINY, train=True)
    one = jax.jit(apply)
    looped = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(one(variables, x) for x in subjects))
    assert close(jax.jit(jax.vmap(apply, in_axes=(None, 0)))(variables, batch), looped)


# what is refused


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: TINY.with_conventions(image_size=100), "not a multiple of patch_size"),
        (lambda: TransformerConfig(width=100), "head_width"),
        (
            lambda: Architecture(reader=dataclasses.replace(READER, shells=(0.0, 0.1))),
            "along the normals",
        ),
        (lambda: dataclasses.replace(READER, shells=(0.1, 0.0)), "ascending"),
        (lambda: PatchTransformer(transformer=TransformerConfig(layers=3)), "layers"),
        (lambda: Architecture(decoder=VertexDecoder(residual_color=True)), "sample_rgb"),
        (lambda: VertexDecoder(tight=0, free=0), "tight"),
    ],
)
def test_configurations_that_do_not_fit_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_images_must_be_those_of_the_cameras():
    def apply(inputs):
        return jax.eval_shape(lambda x: apply_humangs(variables_of(TINY), x, TINY), inputs)

    inputs = random_inputs()
    with pytest.raises(ValueError, match="32 x 32 but their cameras say 64 x 32"):
        apply(replace(inputs, cameras=replace(inputs.cameras, width=64)))
    odd = random_inputs(size=36)
    with pytest.raises(ValueError, match="36 x 36 cannot be cut"):
        apply(odd)


@pytest.mark.slow
@pytest.mark.parametrize("missing", ["posed_normals", "canonical_normals"])
def test_shells_need_normals(missing):
    inputs = replace(random_inputs(), **{missing: None})
    with pytest.raises(ValueError, match=missing):
        jax.eval_shape(lambda v: run(v, inputs, TINY), expected_variables(TINY))
