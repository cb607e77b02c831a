"""Systems that run again for every target: gradients, and the properties that define them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from network_cases import random_inputs, random_variables
from system_cases import close
from target_cases import BLOCKS, DRIVEN, PATCH, PIXELS, SIZE, mapped_tube, small, views
from training_cases import tube

from experiments.systems import SYSTEMS
from experiments.systems.correction import CorrectionMLP, apply_corrections
from experiments.systems.pixel_queries import QueryDriver
from experiments.systems.stereo import StereoDecoder, nearest_pair
from experiments.systems.surface_gaussians import PoseAttention, PoseMapDriver, TextureDriver
from experiments.systems.surface_map import SurfaceMap
from experiments.systems.targets import PixelDriver, target_queries
from humangs_jax.avatar.reconstruct import make_avatar
from humangs_jax.body.model import BodyPose, person_vertices, shape_body
from humangs_jax.core.configuration import config_from_json, config_to_json
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.network.config import Architecture
from humangs_jax.network.humangs import apply_humangs, part_variables
from humangs_jax.network.parts import Encoding, Target
from humangs_jax.network.reader import project_vertices
from humangs_jax.network.vertex_decoder import COLOR_MARGIN
from humangs_jax.rendering.gaussians import Gaussians

TARGETS = views(seed=1, count=3)
BETAS = jnp.zeros(1)
QUERIES = jnp.asarray(np.random.default_rng(1).uniform(-1, 1, (3, SIZE, SIZE, 9)), jnp.float32)
OTHER_POSE = QUERIES.at[..., 6:].set(-QUERIES[..., 6:])
ask = jax.jit(
    lambda body, targets, config: target_queries(body, targets, config)[1], static_argnums=2
)


@functools.cache
def inputs_of(name):
    """Returns photos of noise and a body as large as the tube, with its map."""
    body = mapped_tube(small(name))
    inputs = random_inputs(vertices=len(body.template), size=SIZE)
    return replace(inputs, texels=body.texels, skinning_weights=body.skinning_weights)


@functools.cache
def drawing(name):
    """Returns the compiled function (variables, inputs, queries) -> images."""
    return jax.jit(functools.partial(draw, small(name)))


def draw(config, variables, inputs, queries):
    outputs, _ = apply_humangs(variables, inputs, config)
    own, nobody = part_variables(variables, "driver"), BodyPose(jnp.zeros((2, 3)), jnp.zeros(3))

    def driven_by(query):
        return config.architecture.driver.apply(
            own, outputs, Target(nobody, jnp.zeros((1, 3)), query), config.forward_context()
        )

    return jnp.stack([driven_by(query) for query in queries])


def frame_outputs(variables, outputs, body, at, config):
    target = Target(at, person_vertices(body, BETAS, at))
    return config.architecture.driver.apply(
        part_variables(variables, "driver"), outputs, target, config.forward_context()
    )


@functools.cache
def driving(name):
    """Returns the compiled function (variables, inputs, pose) -> (Gaussians, outputs)."""
    config, body = small(name), mapped_tube(small(name))

    def run(variables, inputs, pose):
        outputs, _ = apply_humangs(variables, inputs, config)
        return frame_outputs(variables, outputs, body, pose, config), outputs

    return jax.jit(run)


def pose(seed=2, root=None):
    rotations = jnp.asarray(np.random.default_rng(seed).normal(size=(2, 3)) * 0.5, jnp.float32)
    rotations = rotations if root is None else rotations.at[0].set(root)
    return BodyPose(rotations, jnp.asarray([0.3, 0.0, 0.1]))


def driven(name, inputs=None, at=None, variables=None):
    variables = random_variables(small(name)) if variables is None else variables
    return driving(name)(
        variables, inputs_of(name) if inputs is None else inputs, pose() if at is None else at
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", [*PIXELS, *DRIVEN])
def test_every_parameter_has_a_finite_gradient(name):
    config, run = small(name), drawing(name) if name in PIXELS else driving(name)
    last = QUERIES if name in PIXELS else pose()
    variables = random_variables(config)

    def loss(params):
        made = run({**variables, "params": params}, inputs_of(name), last)
        made = made if name in PIXELS else (made[0].gaussians, made[0].tight_offsets)
        return sum(jnp.sum(jnp.sin(7 * x)) for x in jax.tree.leaves(made))

    gradients = jax.grad(loss)(variables["params"])
    for path, gradient in jax.tree_util.tree_leaves_with_path(gradients):
        assert np.isfinite(gradient).all(), path
        assert np.abs(gradient).max() > 0, path


# Pixels
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", PIXELS)
def test_every_target_is_its_own_pass_and_the_order_of_photos_is_irrelevant(name):
    variables, inputs, asked = random_variables(small(name)), inputs_of(name), np.asarray(QUERIES)
    images = drawing(name)(variables, inputs, asked)
    assert images.shape == (3, SIZE, SIZE, 3) and 0 <= images.min() < images.max() <= 1
    close(images, drawing(name)(variables, inputs, asked[::-1])[::-1])
    changed = asked + np.asarray([0, 0.1, 0], np.float32)[:, None, None, None]
    np.testing.assert_array_equal(drawing(name)(variables, inputs, changed)[::2], images[::2])
    turn = lambda field: jax.tree.map(lambda x: np.asarray(x)[::-1], getattr(inputs, field))
    turned = replace(
        inputs, **{field: turn(field) for field in ("images", "cameras", "position_maps")}
    )
    close(images, drawing(name)(variables, turned, asked))
    padded = replace(inputs, view_count=np.asarray(1, np.int32))  # the other one is padding
    alone = drawing(name)(variables, padded, asked)
    assert np.abs(alone - images).max() > 1e-4
    hidden = replace(
        padded,
        images=np.asarray(inputs.images) * np.asarray([1, 0], np.float32)[:, None, None, None],
    )
    close(alone, drawing(name)(variables, hidden, asked))


@pytest.mark.slow
def test_humanram_knows_the_pose_from_the_target_s_position_map_and_lvsm_knows_none():
    for name, differs in (("lvsm", False), ("humanram", True)):
        variables, inputs = random_variables(small(name)), inputs_of(name)
        images = [drawing(name)(variables, inputs, asked) for asked in (QUERIES, OTHER_POSE)]
        posed = replace(
            inputs, posed_vertices=2 * inputs.posed_vertices, depth_maps=0 * inputs.depth_maps
        )
        np.testing.assert_array_equal(drawing(name)(variables, posed, QUERIES), images[0])
        mapped = replace(inputs, position_maps=-inputs.position_maps)
        for image in (images[1], drawing(name)(variables, mapped, QUERIES)):
            assert (np.abs(image - images[0]).max() > 1e-4) == differs


@pytest.mark.slow
def test_targets_ask_by_rays_and_their_pose_and_their_photos_are_not_read():
    config = small("humanram")
    asked = ask(tube(), TARGETS, config)
    moved = ask(tube(), replace(TARGETS, rotations=TARGETS.rotations + 0.3), config)
    np.testing.assert_array_equal(moved[..., :6], asked[..., :6])
    assert np.abs(moved[..., 6:] - asked[..., 6:]).max() > 0.1
    blank = replace(TARGETS, images=0 * TARGETS.images, masks=0 * TARGETS.masks)
    others = ask(tube(), blank, config.with_conventions(pixels="person"))
    # float32 rounding differs between two compiled programs
    np.testing.assert_allclose(others, asked, atol=1e-6)


@pytest.mark.slow
def test_humanram_without_its_texture_and_convolutions_is_lvsm():
    config = small("humanram")
    config = config.with_parts(driver=dataclasses.replace(config.architecture.driver, fusion=None))
    variables = random_variables(config)
    params = dict(variables["params"]["driver"])
    assert params["texture"].shape == (3, 8, 8, 2)
    untextured = {**params, "texture": jnp.zeros((3, 8, 8, 2))}
    lvsm = {name: value for name, value in params.items() if name != "texture"}
    for name, channels in (("photo_tokens", 9), ("target_tokens", 6)):
        kernel = params[name]["kernel"].reshape(PATCH**2, channels + 6, -1)
        lvsm[name] = {"kernel": kernel[:, :channels].reshape(PATCH**2 * channels, -1)}
    in_place = lambda params: {"params": {"driver": params}, "batch_stats": {}}
    theirs = jax.jit(functools.partial(draw, config))(
        in_place(untextured), inputs_of("lvsm"), QUERIES
    )
    close(theirs, drawing("lvsm")(in_place(lvsm), inputs_of("lvsm"), QUERIES))


@pytest.mark.slow
def test_a_target_of_any_size_is_drawn():
    config, variables, inputs = (
        small("humanram"),
        random_variables(small("humanram")),
        inputs_of("humanram"),
    )
    cameras = replace(TARGETS.cameras, width=SIZE - 3, height=SIZE - 9)
    cut = replace(TARGETS, cameras=cameras, images=TARGETS.images[:, : SIZE - 9, : SIZE - 3])
    driver, own = config.architecture.driver, part_variables(variables, "driver")
    images = jax.jit(
        lambda v: driver.images(own, apply_humangs(v, inputs, config)[0], tube(), cut, config)
    )(variables)
    assert images.shape == (3, SIZE - 9, SIZE - 3, 3)
    whole = drawing("humanram")(variables, inputs, ask(tube(), TARGETS, config)[:, : SIZE - 8])
    close(images, whole[:, : SIZE - 9, : SIZE - 3])


def test_a_network_that_draws_pixels_makes_no_avatar():
    config = small("lvsm")
    outputs = jax.eval_shape(
        lambda v: apply_humangs(v, inputs_of("lvsm"), config)[0], random_variables(config)
    )
    with pytest.raises(ValueError, match="PhotoDecoder draws images without Gaussians"):
        make_avatar(outputs, tube(), shape_body(tube(), BETAS), config)


# Drivers
# --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIVEN)
def test_a_frame_has_its_own_gaussians_and_untrained_corrections_are_none(name):
    frame, outputs = driven(name)
    other, same = driven(name, at=pose(seed=3))
    close(outputs.gaussians, same.gaussians, bound=0)  # the canonical ones know no target
    assert np.abs(frame.gaussians.means - other.gaussians.means).max() > 1e-4
    assert (
        np.abs(frame.gaussians.means - outputs.gaussians.means).max()
        < small(name).architecture.driver.offset_scale + 1e-6
    )
    fresh = random_variables(small(name))
    zeros = jax.tree_util.tree_map_with_path(
        lambda path, x: 0 * x if any(entry.key.endswith("out") for entry in path) else x,
        fresh["params"]["driver"],
    )
    fresh["params"]["driver"] = zeros
    frame, outputs = driven(name, variables=fresh)
    shown = jnp.clip(outputs.gaussians.colors, COLOR_MARGIN, 1 - COLOR_MARGIN)
    close(frame.gaussians, replace(outputs.gaussians, colors=shown), bound=2e-6)
    # the driver's; those of the decoder come first
    assert np.abs(frame.tight_offsets[:, -1]).max() == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["giga", "animatable"])
def test_texels_lie_on_the_surface_and_empty_ones_are_transparent(name):
    body = mapped_tube(small(name))
    frame, outputs = driven(name)
    covered = np.asarray(body.texels.covered).reshape(-1)
    assert 0 < covered.sum() < len(covered) == len(frame.gaussians.opacities)
    corners, weights = (
        np.asarray(x).reshape(-1, 3) for x in (body.texels.corners, body.texels.weights)
    )
    surface = np.einsum(
        "tk,tkc->tc", weights, np.asarray(inputs_of(name).canonical_vertices)[corners]
    )
    np.testing.assert_allclose(outputs.gaussians.means[covered], surface[covered], atol=1e-6)
    for gaussians in (frame.gaussians, outputs.gaussians):
        assert not gaussians.opacities[~covered].any() and (gaussians.opacities[covered] > 0).all()
    avatar = make_avatar(frame, body, shape_body(body, BETAS), small(name))
    np.testing.assert_allclose(avatar.skinning_weights.sum(axis=1), 1, atol=1e-6)
    expected = np.einsum("tk,tkj->tj", weights, np.asarray(body.skinning_weights)[corners])
    np.testing.assert_allclose(avatar.skinning_weights[covered], expected[covered], atol=1e-6)


@pytest.mark.slow
def test_the_texture_is_what_the_photos_show():
    inputs = inputs_of("giga")
    red = replace(
        inputs, images=jnp.broadcast_to(jnp.asarray([0.8, 0.2, 0.1]), inputs.images.shape)
    )
    outputs = driven("giga", red)[1]
    seen = np.asarray(outputs.scene.texture.seen).astype(bool)
    assert 0 < seen.sum() < seen.size
    np.testing.assert_allclose(
        outputs.scene.texture.colors[seen], np.tile([0.8, 0.2, 0.1], (seen.sum(), 1)), atol=1e-5
    )
    np.testing.assert_allclose(outputs.scene.texture.colors[~seen], 0.5)


@pytest.mark.slow
def test_animatable_reads_no_photo_and_a_place_in_the_world_is_no_pose():
    inputs = inputs_of("animatable")
    frame, _ = driven("animatable")
    noise = replace(
        inputs,
        images=1 - inputs.images,
        foreground=~inputs.foreground,
        posed_vertices=2 * inputs.posed_vertices,
    )
    close(driven("animatable", noise)[0].gaussians, frame.gaussians, bound=0)
    turned = driven("animatable", at=replace(pose(root=[0.0, 2.0, 0.0]), translation=jnp.ones(3)))[
        0
    ]
    straight = driven("animatable", at=pose(root=[0.0, 0.0, 0.0]))[0]
    close(turned.gaussians, straight.gaussians)


@pytest.mark.slow
def test_corrections_are_bounded_and_zeros_are_none():
    gaussians = driven("giga")[1].gaussians
    correct = jax.jit(
        lambda raw: apply_corrections(gaussians, jnp.full((len(gaussians.opacities), 14), raw), 0.1)
    )
    nothing, offsets = correct(0.0)
    shown = jnp.clip(gaussians.colors, COLOR_MARGIN, 1 - COLOR_MARGIN)
    close(nothing, replace(gaussians, colors=shown), bound=2e-6)
    assert not offsets.any()
    most, offsets = correct(1e4)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(most))
    np.testing.assert_allclose(jnp.linalg.norm(offsets, axis=1), 0.1 * 3**0.5, rtol=1e-5)


@pytest.mark.slow
def test_corrections_turn_gaussians_about_the_axes_of_the_body():
    """A quarter turn about z turns a Gaussian that is long along y into one that is long along x,
    whatever its quaternion.
    """
    half = 0.5**0.5
    gaussians = Gaussians(
        means=jnp.zeros((1, 3)),
        # a quarter turn about x: the long z axis points to -y
        quats=jnp.asarray([[half, half, 0.0, 0.0]]),
        scales=jnp.asarray([[0.01, 0.01, 0.1]]),
        opacities=jnp.asarray([0.5]),
        colors=jnp.full((1, 3), 0.5),
    )
    # added to the identity
    raw = jnp.zeros((1, 14)).at[0, 3:7].set(jnp.asarray([half - 1, 0, 0, half]))
    turned = apply_corrections(gaussians, raw, 0.1).gaussians
    long = quaternion.to_matrix(turned.quats)[0, :, 2]
    np.testing.assert_allclose(jnp.abs(long), [1, 0, 0], atol=1e-6)


@pytest.mark.slow
def test_texels_attend_by_scaled_products():
    """Products grow with the width, their softmax must not: for random features it is far from
    choosing one token.
    """
    module, width = PoseAttention(width=4, tokens=2), 4
    x, pose_vector = jnp.asarray([[[[1.0, 2, 3, 4]]]]), jnp.ones(3)
    params = jax.tree.map(jnp.zeros_like, module.init(jax.random.key(0), x, pose_vector)["params"])
    eye = {"kernel": jnp.eye(width)}
    context = jnp.asarray([[1.0, 0, 0, 0], [0, 0, 1.0, 0]])  # products with x: 1 and 3
    params |= {"query": eye, "key": eye, "value": eye, "out": eye}
    params["pose_1"] = params["pose_1"] | {"bias": context.reshape(-1)}
    seen = module.apply({"params": params}, x, pose_vector) - x
    share = 1 / (1 + np.exp((3 - 1) / width**0.5))
    np.testing.assert_allclose(seen[0, 0, 0], [share, 0, 1 - share, 0], rtol=1e-5)


@pytest.mark.slow
def test_a_sharper_softmax_of_views_takes_the_color_of_the_best_one():
    """Texels are seen by a red and a green photo, whose weights are exp(sharpness * cosine)."""
    inputs = inputs_of("giga")
    images = jnp.stack([jnp.full_like(inputs.images[0], 0).at[..., i].set(1.0) for i in range(2)])
    inputs = replace(inputs, images=images, depth_maps=0 * inputs.depth_maps + 100.0)
    config = small("giga")
    colors = {}
    for sharpness in (2.0, 4.0):
        reader = dataclasses.replace(config.architecture.reader, sharpness=sharpness)

        def read(inputs, reader=reader):
            return reader.apply(
                {}, Encoding(inputs.images, None, jnp.int32(0)), inputs, config.forward_context()
            )

        colors[sharpness] = jax.jit(read)(inputs).colors
    red = lambda sharpness: np.asarray(colors[sharpness][..., 0]).ravel()
    both = (
        (red(4.0) > 1e-4) & (red(4.0) < 1 - 1e-4) & (np.asarray(colors[4.0][..., 2]).ravel() < 0.1)
    )
    assert both.sum() > 3
    odds = lambda sharpness: np.log(red(sharpness)[both] / (1 - red(sharpness)[both]))
    assert np.abs(odds(2.0)).max() > 0.1
    np.testing.assert_allclose(odds(4.0), 2 * odds(2.0), atol=1e-3)  # log odds grow in proportion


# Pairs of photos
# --------------------------------------------------------------------------------------------------


@functools.cache
def stereo():
    """Returns (configuration, variables, inputs of four photos, function that gives Gaussians)."""
    config = SYSTEMS["gps"]("bench").with_parts(decoder=StereoDecoder((4, 8), planes=6))
    variables, inputs = random_variables(config), random_inputs(views=4, size=SIZE)
    return (
        config,
        variables,
        inputs,
        jax.jit(lambda x: apply_humangs(variables, x, config)[0].scene),
    )


@pytest.mark.slow
def test_a_pixel_s_gaussian_has_its_color_and_lies_on_its_ray_near_the_body():
    _, _, inputs, scene_of = stereo()
    inputs = replace(inputs, foreground=inputs.foreground.at[:, :4].set(False))
    found = scene_of(inputs).gaussians
    close(found.colors.reshape(inputs.images.shape), inputs.images, bound=0)
    opaque = np.asarray(found.opacities).reshape(4, SIZE, SIZE) > 0
    np.testing.assert_array_equal(opaque, inputs.foreground)
    for view in range(4):
        pixels, depths = project_vertices(inputs.cameras[view], found.means[view])
        centers = (
            np.stack(np.meshgrid(np.arange(SIZE), np.arange(SIZE)), axis=-1).reshape(-1, 2) + 0.5
        )
        np.testing.assert_allclose(pixels, centers, atol=1e-3)
        assert np.min(depths) > 1.5 and np.max(depths) < 4.5 and np.ptp(depths) > 0.01


@pytest.mark.slow
def test_a_target_is_drawn_from_the_two_photos_nearest_to_it():
    _, _, inputs, scene_of = stereo()
    scene, centers = scene_of(inputs), inputs.cameras.center  # at 0, 1.67, 3.33 and 5 radians
    assert nearest_pair(scene, centers[0]).opacities.shape == (2 * SIZE**2,)

    def used(center, scene):
        return {
            i
            for i in range(4)
            if np.isin(inputs.images[i], nearest_pair(scene, center).colors).all()
        }

    assert used(centers[0], scene) == {0, 3} and used(
        0.6 * centers[1] + 0.4 * centers[2], scene
    ) == {1, 2}
    padded = scene_of(replace(inputs, view_count=jnp.asarray(2)))
    assert used(centers[3], padded) == {0, 1}  # the others are padding
    lonely = nearest_pair(replace(padded, present=padded.present.at[1].set(False)), centers[0])
    assert lonely.opacities[: SIZE**2].any() and not lonely.opacities[SIZE**2 :].any()
    with pytest.raises(ValueError, match="1 photo: this system takes at least 2"):
        nearest_pair(replace(scene, present=scene.present[:1]), centers[0])


@pytest.mark.slow
def test_depths_come_from_what_two_photos_have_in_common():
    """With learned scores of 0, a photo's depths depend on the nearest other photo and on no third
    one.
    """
    config, variables, inputs, _ = stereo()
    zero = lambda path, x: 0 * x if path[-2].key == "0_out" else x
    still = jax.tree_util.tree_map_with_path(zero, variables)
    means = jax.jit(lambda x: apply_humangs(still, x, config)[0].scene.gaussians.means)
    before, change = (
        means(inputs),
        lambda i: replace(inputs, images=inputs.images.at[i].set(1 - inputs.images[i])),
    )
    moved = lambda i: np.abs(means(change(i)) - before).max(axis=(1, 2)) > 1e-6
    assert moved(1)[1] and not moved(2)[0] and moved(3)[0]  # of photo 0 the nearest is 3


@pytest.mark.slow
def test_a_pair_of_photos_has_finite_gradients_and_shows_no_other_pose():
    config, variables, inputs, _ = stereo()

    def loss(params):
        scene = apply_humangs({**variables, "params": params}, inputs, config)[0].scene
        return sum(
            jnp.sum(jnp.sin(7 * x))
            for x in jax.tree.leaves(nearest_pair(scene, inputs.cameras.center[1]))
        )

    for path, gradient in jax.tree_util.tree_leaves_with_path(
        jax.jit(jax.grad(loss))(variables["params"])
    ):
        assert np.isfinite(gradient).all() and np.abs(gradient).max() > 0, path
    assert not config.architecture.driver.moves


# Parts
# --------------------------------------------------------------------------------------------------


def test_architectures_are_recorded_whole():
    for name in (*PIXELS, *DRIVEN):
        architecture = small(name).architecture
        assert config_from_json(Architecture, config_to_json(architecture)) == architecture
        assert (
            isinstance(architecture.driver, PixelDriver)
            == (not architecture.driver.has_alpha)
            == (name in PIXELS)
        )


def test_parts_that_do_not_fit_are_refused():
    decoder = dataclasses.replace(
        small("giga").architecture.decoder, surface_map=SurfaceMap("atlas", 99)
    )
    with pytest.raises(ValueError, match=r"surface_map: expected one for all parts, got .*99"):
        small("giga").with_parts(decoder=decoder)
    with pytest.raises(ValueError, match="class_token: expected false"):
        QueryDriver(transformer=dataclasses.replace(BLOCKS, class_token=True))
    for wrong in (
        lambda: SurfaceMap(size=10**6),
        lambda: TextureDriver(widths=(8,) * 99),
        lambda: PoseMapDriver(widths=()),
        lambda: CorrectionMLP(layers=10**6),
    ):
        with pytest.raises(
            ValueError, match=r"(SurfaceMap.size|driver.widths|CorrectionMLP.layers).*expected 1 to"
        ):
            wrong()
    # drivers that do not fit the pose or the decoder are refused where the network is traced
    config, target = small("lca"), Target(pose(), tube().template)
    run = lambda variables: apply_humangs(variables, inputs_of("lca"), config)[0]
    outputs, ctx = jax.eval_shape(run, random_variables(config)), config.forward_context()
    for driver, problem in (
        (CorrectionMLP(8, 1, joints=5), r"driver\.joints 5: the pose has 2 joints"),
        (
            CorrectionMLP(8, 1, joints=2, gaussians_per_vertex=2),
            r"driver\.gaussians_per_vertex 2: the decoder gives",
        ),
    ):
        with pytest.raises(ValueError, match=problem):
            jax.eval_shape(
                functools.partial(driver.init, ctx=ctx), jax.random.key(0), outputs, target
            )
    with pytest.raises(ValueError, match="works on a map of the surface"):
        mapless = replace(inputs_of("animatable"), texels=None)
        jax.eval_shape(lambda: apply_humangs({}, mapless, small("animatable"))[0])


@pytest.mark.slow
def test_front_and_back_show_both_sides_of_the_body():
    body = tube()
    texels = SurfaceMap("front_back", 16).texels(body)
    assert texels.corners.shape == (16, 32, 3)
    sums = np.asarray(texels.weights.sum(axis=-1))
    covered = np.asarray(texels.covered)
    np.testing.assert_allclose(sums[covered], 1, atol=1e-6)
    points = np.asarray(texels.interpolate(body.template))
    front, back = points[:, :16], points[:, 16:]
    np.testing.assert_array_equal(covered[:, :16], covered[:, 16:][:, ::-1])
    middle = covered[:, 4:12].sum() / 2
    assert (front[..., 2] > 0.05).sum() >= middle / 2 and (back[..., 2] < -0.05).sum() >= middle / 2
    assert not (front[..., 2] < -0.05).any() and not (back[..., 2] > 0.05).any()
    rows, columns = np.nonzero(covered[:, :16])
    assert (
        np.corrcoef(columns, front[rows, columns, 0])[0, 1]
        > 0.9
        > -0.9
        > np.corrcoef(rows, front[rows, columns, 1])[0, 1]
    )


@pytest.mark.slow
def test_an_atlas_shows_the_whole_surface_once():
    body = tube()
    texels = SurfaceMap("atlas", 64).texels(body)
    covered = np.asarray(texels.covered)
    shown = np.unique(np.sort(np.asarray(texels.corners)[covered], axis=-1), axis=0)
    assert len(shown) == len(body.faces)
    np.testing.assert_allclose(np.asarray(texels.weights.sum(axis=-1))[covered], 1, atol=1e-6)
