import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled_programs import compiled_programs

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Light
from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.avatar.reconstruct import (
    make_avatar,
    reconstruct,
    reconstruct_batch,
    reconstruct_views,
    stack_captures,
    with_blended_leg_weights,
)
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, person_vertices, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.data import skirt
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.data.loading.examples import shrink
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.data.vertex_offsets import fit_vertex_offsets
from humangs_jax.data.views import (
    SubjectViews,
    cropped,
    gaussian_body,
    pad_views,
    prepare_inputs,
    to_network_views,
    world_up,
)
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit, project
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import HumanGSOutputs
from humangs_jax.network.presets import tiny
from humangs_jax.refinement.photos import crop_to_person
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.mesh.rasterizer import vertex_normals
from humangs_jax.rendering.splatting import SplatConfig, render

SIZE = 32
VMAP_TOLERANCE = 2e-5  # batched matrix products round differently
TURNED = 1e-6  # rounding of positions of some metres
DEPTH_TOLERANCE = (
    2e-6  # another program rounds the some ten operations of a depth differently: 16 ulps
)


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 500)


@pytest.fixture(scope="module")
def network():
    config = tiny().with_runtime(token_capacity=48)
    return init_humangs(jax.random.key(0), config), config


def avatars_of(batch):
    """Returns the avatars of a batch and checks that no capture failed."""
    found = list(batch)
    assert not [each.error for each in found if each.error is not None]
    return [each.avatar for each in found]


def ring(views, distance, width=SIZE, height=SIZE):
    K, middle = intrinsics_from_fov(np.pi / 3, width, height), jnp.asarray([0.0, 0.9, 0.0])
    return orbit(middle, distance, jnp.arange(float(views)), 0.1, K, width, height)


def subject_views(seed, views=2):
    rng = np.random.default_rng(seed)
    return SubjectViews(
        jnp.asarray(rng.random((views, SIZE, SIZE, 3)), jnp.float32),
        jnp.asarray(rng.random((views, SIZE, SIZE)) > 0.7, jnp.float32),
        ring(views, 2.0),
        jnp.asarray(0.2 * rng.normal(size=(views, 55, 3)), jnp.float32),
        jnp.asarray(0.1 * rng.normal(size=(views, 3)), jnp.float32),
        jnp.asarray(rng.normal(size=4), jnp.float32),
    )


@pytest.mark.slow
def test_pixels_outside_the_masks_are_seen_by_no_vertex(body, network):
    _, config = network
    views = subject_views(0)
    body_alone = replace(views, masks=0 * views.masks)
    person = config.with_conventions(pixels="person")
    whole, masked, unmasked = (
        jax.jit(prepare_inputs, static_argnames="config")(body, *pair)
        for pair in ((views, config), (views, person), (body_alone, person))
    )
    np.testing.assert_array_equal(masked.foreground, (views.masks > 0.5) & whole.foreground)
    outside = (whole.depth_maps >= 0) & (views.masks <= 0.5)
    assert outside.any()
    assert (masked.depth_maps[outside] == -1).all() and (masked.position_maps[outside] == 1).all()
    kept = ~np.asarray(outside)
    np.testing.assert_allclose(
        masked.depth_maps[kept], whole.depth_maps[kept], rtol=DEPTH_TOLERANCE
    )
    # photos without masks are not empty: the body is all that is known of the person
    np.testing.assert_allclose(unmasked.depth_maps, whole.depth_maps, rtol=DEPTH_TOLERANCE)
    np.testing.assert_array_equal(unmasked.foreground, whole.depth_maps >= 0)


@pytest.mark.slow
def test_reconstruct_and_render_lower_for_every_platform(body, network):
    variables, config = network

    def drawn(variables, views):
        avatar, dropped = reconstruct_views(variables, config, body, views)
        gaussians = skin(avatar, BodyPose(views.rotations[0], views.translations[0]))
        return render(gaussians, views.cameras[0], SplatConfig()).rgb, dropped

    exported = jax.export.export(jax.jit(drawn), platforms=("cpu", "cuda", "tpu"))(
        variables, subject_views(0)
    )
    assert set(exported.platforms) == {"cpu", "cuda", "tpu"}
    image, _ = exported.call(variables, subject_views(0))
    expected, _ = jax.jit(drawn)(variables, subject_views(0))
    np.testing.assert_allclose(image, expected, atol=1e-5)


def made(body, means, size, betas=(0.0,) * 4):
    """Returns an avatar of round Gaussians, one on each vertex."""
    count = len(means)
    gaussians = Gaussians(
        means,
        jnp.tile(jnp.eye(4)[0], (count, 1)),
        jnp.full((count, 3), size),
        jnp.full(count, 0.9),
        jnp.full((count, 3), 0.5),
    )
    return make_avatar(
        HumanGSOutputs(gaussians, jnp.zeros((count, 0, 3))),
        body,
        shape_body(body, jnp.asarray(betas)),
        tiny(),
    )


def test_blended_leg_weights_leave_gaussians_where_the_photos_saw_them(body):
    rng = np.random.default_rng(0)
    pose = BodyPose(jnp.asarray(0.3 * rng.normal(size=(55, 3)), jnp.float32), jnp.ones(3))
    count = len(body.template)
    means = body.template + jnp.asarray(
        rng.normal(size=(count, 3)) * 0.1 * (rng.random((count, 1)) < 0.2), jnp.float32
    )
    avatar = made(body, means, 1.0)
    spread = with_blended_leg_weights(avatar, pose, 0.04)
    changed = np.any(spread.skinning_weights != avatar.skinning_weights, axis=1)
    assert (
        0.05 < changed.mean() <= 0.25
        and not changed[np.linalg.norm(means - body.template, axis=1) < 0.03].any()
    )
    np.testing.assert_allclose(skin(spread, pose).means, skin(avatar, pose).means, atol=1e-5)
    other = BodyPose(-pose.rotations, pose.translation)
    assert np.abs(skin(spread, other).means - skin(avatar, other).means).max() > 0.005


def capture(body, height, width, views=2):
    cameras, images = (
        ring(views, 2.2, width, height),
        np.random.default_rng(0).random((views, height, width, 3)),
    )
    pose = np.zeros((1, 55, 3)), np.zeros((1, 3))
    return capture_from_arrays(
        images,
        np.asarray(cameras.K),
        np.asarray(cameras.cam_from_world),
        *pose,
        masks=np.ones_like(images[..., 0]),
        body=body,
    )


def test_photos_of_any_size_become_squares_with_cameras_that_follow(body):
    photos = capture(body, 48, 36)
    views = to_network_views(photos, SIZE)
    assert views.images.shape == (2, SIZE, SIZE, 3) and views.cameras.width == SIZE
    assert np.allclose(views.images[:, :, :3], 1, atol=1e-3)  # padded columns are white
    point = jnp.asarray([0.2, 1.1, 0.1])
    before, _ = project(photos.cameras[1], point)
    after, _ = project(views.cameras[1], point)
    np.testing.assert_allclose(
        after, (np.asarray(before) + np.asarray([6, 0])) * SIZE / 48, atol=1e-3
    )


def test_photos_reach_the_network_as_in_training(body):
    photos = capture(body, 2 * SIZE, 2 * SIZE)
    levels = np.rint(255 * photos.images).astype(np.uint8)
    photos.images[:], photos.masks[:, :, SIZE:] = levels / np.float32(255), 0
    views = to_network_views(photos, SIZE)
    np.testing.assert_allclose(views.images, shrink(levels, SIZE), atol=1e-6)
    np.testing.assert_array_equal(views.masks, photos.masks[:, ::2, ::2])


def test_small_people_that_are_enlarged_stay_within_the_range(body):
    photos = capture(body, 48, 36)
    photos.masks[:, :, 9:] = photos.masks[:, :12] = 0  # 36 x 9 pixels, which the body meets
    for larger in (photos.resized(101), to_network_views(photos, 60, crop=True)):
        for values in (larger.images, larger.masks):
            assert values.min() >= 0 and values.max() <= 1


def with_z_up(photos):
    """The same capture in a world whose z axis points up."""
    pelvis = np.asarray(shape_body(photos.body, jnp.asarray(photos.betas)).joints[0])
    turn = np.asarray([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # y becomes z
    rotations = np.asarray(photos.poses.rotations)
    rotations = np.concatenate([rotations[:, :1] + [np.pi / 2, 0, 0], rotations[:, 1:]], axis=1)
    shift = jnp.asarray([turn[:3, :3] @ pelvis - pelvis], jnp.float32)
    poses = replace(photos.poses, rotations=jnp.asarray(rotations, jnp.float32), translation=shift)
    cameras = replace(
        photos.cameras,
        cam_from_world=photos.cameras.cam_from_world @ jnp.asarray(turn.T, jnp.float32),
    )
    return dataclasses.replace(photos, cameras=cameras, poses=poses)


@pytest.mark.slow
def test_worlds_with_z_up_are_turned_and_leave_no_light(body, network):
    photos = capture(body, SIZE, SIZE)
    turned = with_z_up(photos)
    as_it_is, upright = prepare_capture(photos), prepare_capture(turned)
    assert as_it_is.up == "y" and as_it_is.capture.cameras is photos.cameras
    assert upright.up == "z" and upright.turned
    own, views = (to_network_views(x.capture, SIZE) for x in (as_it_is, upright))
    for got, expected in zip(jax.tree.leaves(views), jax.tree.leaves(own), strict=True):
        np.testing.assert_allclose(got, expected, atol=TURNED)
    avatars = [reconstruct(*network, x).gaussians for x in (photos, turned)]
    config = network[1].with_conventions(light=True)
    lit, unlit = avatars_of(reconstruct_batch(network[0], config, [photos, turned]))
    assert lit.light is not None and unlit.light is None
    for second, first in (avatars, (lit.gaussians, unlit.gaussians)):
        for got, expected in zip(jax.tree.leaves(second), jax.tree.leaves(first), strict=True):
            np.testing.assert_allclose(got, expected, atol=100 * TURNED)


@pytest.mark.slow
def test_pose_correctives_move_what_the_network_reads_and_not_gaussians(body, network):
    """As in the release, the network reads at the vertices of the whole body model, and Gaussians
    move by blend skinning alone.
    """
    _, config = network
    directions = (
        np.random.default_rng(0).normal(size=(*body.template.shape, 9 * (len(body.parents) - 1)))
        * 0.01
    )
    corrected, views = (
        replace(body, pose_directions=jnp.asarray(directions, jnp.float32)),
        subject_views(1),
    )
    read, plain = (prepare_inputs(x, views, config).posed_vertices for x in (corrected, body))
    assert np.abs(read - plain).max() > 0.01
    for x, expected in ((corrected, read), (body, plain)):
        own = jax.vmap(lambda r, t, x=x: person_vertices(x, views.betas, BodyPose(r, t)))
        # float32
        np.testing.assert_allclose(own(views.rotations, views.translations), expected, atol=1e-5)
    pose = BodyPose(views.rotations[0], views.translations[0])
    moved = [skin(made(x, body.template, 0.01, views.betas), pose) for x in (corrected, body)]
    np.testing.assert_array_equal(moved[0].means, moved[1].means)


@pytest.mark.slow
def test_light_shines_from_above_in_a_capture_of_another_world(body):
    """Fitting and drawing light give the same in a capture with z up."""
    photos = capture(body, SIZE, SIZE)
    bent = replace(
        photos.poses, rotations=photos.poses.rotations.at[:, 16].set(jnp.asarray([0.0, 0.0, -1.2]))
    )
    photos = dataclasses.replace(photos, poses=bent)
    avatar = made(body, body.template, 0.05)
    normals = vertex_normals(avatar.rest_vertices, body.faces)
    shining = Light(jnp.arange(8.0) / 8, normals, jnp.zeros(len(normals)))
    avatar, turned = replace(avatar, light=shining), with_z_up(photos)
    own, others = (
        np.asarray([r.rgb for r in capture_renderings(avatar, x)[1]]) for x in (photos, turned)
    )
    np.testing.assert_allclose(own, others, atol=100 * TURNED)
    unlit = np.asarray([r.rgb for r in capture_renderings(replace(avatar, light=None), photos)[1]])
    assert np.abs(own - unlit).max() > 0.05
    for got, expected in zip(
        *(jax.tree.leaves(crop_to_person(prepare_capture(x))) for x in (turned, photos)),
        strict=True,
    ):
        np.testing.assert_allclose(got, expected, atol=TURNED)


def test_people_who_lie_before_upright_cameras_are_left_lying(body):
    """A pose alone does not tell which way is up; captures have y up."""
    photos = capture(body, SIZE, SIZE)
    roots = np.zeros((photos.view_count, 3))
    roots[:, 0] = -np.pi / 2
    assert world_up(roots, photos.cameras) == "y"


def test_photos_cut_to_the_person_keep_what_a_pixel_shows(body):
    """The pixel at which a camera sees a point has the same color before and after cutting."""
    photos = capture(body, 48, 36)
    photos.masks[:] = 0
    # the second reaches the border
    photos.masks[0, 10:26, 4:12], photos.masks[1, 20:48, 20:30] = (
        1,
        1,
    )
    photos.images[0, 16:20, 6:10] = [0.2, 0.4, 0.6]
    cut = cropped(photos, 18)
    assert cut.images.shape == (2, 18, 18, 3) and cut.cameras.width == cut.cameras.height == 18
    assert cut.masks[0].any(0).sum() == 8 and cut.masks[0].any(1).sum() == 16
    point = jnp.asarray([0.2, 1.1, 0.1])
    for view, (low, side) in enumerate(((np.asarray([-1, 9]), 18), (np.asarray([9, 18]), 31))):
        before, after = (np.asarray(project(c.cameras[view], point)[0]) for c in (photos, cut))
        np.testing.assert_allclose(after, (before - low) * 18 / side, atol=1e-3)
    np.testing.assert_allclose(
        cut.images[0, 16 - 9 : 20 - 9, 6 + 1 : 10 + 1].reshape(-1, 3),
        [[0.2, 0.4, 0.6]] * 16,
        atol=1e-6,
    )
    specks = photos.masks.copy()
    specks[1, 0, 0] = 1  # of less than a half percent of the person
    np.testing.assert_array_equal(
        cropped(dataclasses.replace(photos, masks=specks), 18).images, cut.images
    )
    assert cropped(dataclasses.replace(photos, masks=None), SIZE).images is photos.images
    empty = dataclasses.replace(photos, masks=0 * photos.masks)
    assert cropped(empty, SIZE) is empty


def test_bodies_of_fewer_vertices_have_wider_gaussians(body):
    config = tiny().with_conventions(body_vertices=400, max_edge_length=0.2)
    usual, fewer = (
        gaussian_body(body, config),
        gaussian_body(body, config.with_runtime(body_vertices=200)),
    )
    assert len(fewer.template) < 0.7 * len(usual.template) and usual.relative_vertex_spacing is None
    np.testing.assert_allclose(
        fewer.relative_vertex_spacing, np.sqrt(len(usual.template) / len(fewer.template)), rtol=1e-6
    )
    # no fewer than usual
    assert (
        gaussian_body(body, config.with_runtime(body_vertices=900)).relative_vertex_spacing is None
    )
    with pytest.raises(
        ValueError, match="body_vertices asks for fewer vertices, max_edge_length for more"
    ):
        gaussian_body(body, config.with_runtime(body_vertices=200, max_edge_length=0.1))


def test_a_body_that_was_read_twice_is_remeshed_once(body):
    config = tiny().with_conventions(body_vertices=300)
    again = jax.tree.map(lambda leaf: jnp.array(leaf, copy=True), body)
    made = gaussian_body(body, config)
    assert gaussian_body(again, config) is made and len(made.template) == 300
    moved = gaussian_body(replace(body, template=body.template + 0.1), config)
    np.testing.assert_allclose(moved.template, made.template + 0.1, atol=1e-6)
    assert gaussian_body(replace(body, name="another"), config).name == "another"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: {"poses": replace(c.poses, rotations=c.poses.rotations[:, :24])},
            r"poses\.rotations: .*got \(1, 24, 3\)",
        ),
        (lambda c: {"poses": c.poses[0]}, r"poses\.rotations: expected shape"),
        (
            lambda c: {"cameras": c.cameras[0]},
            r"cameras\.K: expected shape \(2, 3, 3\), got \(3, 3\)",
        ),
        (
            lambda c: {"cameras": jax.tree.map(lambda x: x[:1], c.cameras)},
            r"cameras\.K: expected shape \(2, 3, 3\)",
        ),
        (lambda c: {"frames": c.frames + 1}, "frames: expected 0 to 0"),
        (
            lambda c: {"images": np.where(c.images == c.images[0, 3, 4, 1], np.nan, c.images)},
            r"images: .*\[0, 3, 4, 1\]: nan",
        ),
        (lambda c: {"images": c.images * 255}, "images: expected numbers in"),
        (lambda c: {"betas": np.full(3, np.inf, np.float32)}, "betas: expected finite numbers"),
        (
            lambda c: {"body": replace(c.body, template=np.nan * c.body.template)},
            r"body\.template: expected finite",
        ),
        (
            lambda c: {"body": replace(c.body, skinning_weights=np.nan * c.body.skinning_weights)},
            r"body\.skinning_weights: expected finite",
        ),
    ],
)
def test_captures_made_by_hand_are_checked(body, change, message):
    whole = capture(body, SIZE, SIZE)
    with pytest.raises(ValueError, match=f"reconstruct: capture: {message}"):
        reconstruct({}, tiny(), dataclasses.replace(whole, **change(whole)))


@pytest.mark.slow
def test_the_token_capacity_follows_the_photos(body, network):
    variables, config = network
    # full masks: 4 x 16 patches, more than the configuration's 48
    photos = capture(body, SIZE, SIZE, views=4)
    views = to_network_views(photos, SIZE)
    _, dropped = jax.jit(reconstruct_views, static_argnames="config")(
        variables, config, body, views
    )
    assert int(dropped) == 4 * 16 - 48
    roomy = config.with_runtime(token_capacity=64)
    expected, none_dropped = jax.jit(reconstruct_views, static_argnames="config")(
        variables, roomy, body, views
    )
    assert int(none_dropped) == 0
    avatar = reconstruct(variables, config, photos)
    np.testing.assert_allclose(
        avatar.gaussians.colors, expected.gaussians.colors, atol=VMAP_TOLERANCE
    )


@pytest.mark.parametrize(
    ("views", "message"),
    [
        ([], "0 views"),
        ([0] * 513, r"513 photos in capture: the limit network_views is 512 \(HUMANGS"),
    ],
)
def test_no_photos_and_more_than_the_limit_are_an_error(body, network, views, message):
    with pytest.raises(ValueError, match=message):
        reconstruct(*network, capture(body, SIZE, SIZE).select(views))


def test_a_batch_of_nobody_is_refused(network):
    with pytest.raises(ValueError, match="batch 0: expected at least 1"):
        list(reconstruct_batch(*network, [], batch=0))


@pytest.mark.slow
def test_a_body_that_is_not_finite_is_an_error(body, network):
    photos = capture(
        replace(body, joint_regressor=body.joint_regressor.at[0, 0].set(np.nan)), SIZE, SIZE
    )
    message = "the posed vertices, which all arrays of the body move: expected finite numbers.*nan"
    with pytest.raises(ValueError, match=f"reconstruct: capture: {message}"):
        reconstruct(*network, photos)
    with pytest.raises(ValueError, match=f"reconstruct: captures: {message}"):
        stack_captures(network[1], [photos])
    (found,) = reconstruct_batch(*network, [photos])
    assert found.avatar is None and "reconstruct: capture: the posed" in str(found.error)


@pytest.mark.slow
def test_the_body_is_decimated_to_what_the_weights_want(body, network):
    variables, config = network
    avatar = reconstruct(
        variables,
        config.with_conventions(body_vertices=300).with_runtime(token_capacity=64),
        capture(body, SIZE, SIZE),
    )
    per_vertex = config.architecture.decoder.gaussians_per_vertex
    assert len(avatar.rest_vertices) == 300 and len(avatar.gaussians.means) == 300 * per_vertex
    np.testing.assert_allclose(np.asarray(avatar.skinning_weights).sum(-1), 1, atol=1e-5)


def capture_of(body, seed, views):
    """Returns a capture of noise with one pose for each photo."""
    subject = subject_views(seed, views)
    return capture_from_arrays(
        np.asarray(subject.images),
        np.asarray(subject.cameras.K),
        np.asarray(subject.cameras.cam_from_world),
        np.asarray(subject.rotations),
        np.asarray(subject.translations),
        betas=np.asarray(subject.betas)[: 4 - seed],
        shape_names=body.shape_names[: 4 - seed],
        masks=np.asarray(subject.masks),
        frames=np.arange(views),
        body=body,
    )


@pytest.mark.slow
def test_a_batch_of_people_with_different_numbers_of_views(body, network):
    variables, config = network
    captures = [capture_of(body, seed, views) for seed, views in enumerate((2, 1))]
    together = avatars_of(reconstruct_batch(variables, config, captures))
    for avatar, photos in zip(together, captures, strict=True):
        alone = reconstruct(variables, config, photos)
        assert jax.tree.structure(avatar) == jax.tree.structure(alone)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=VMAP_TOLERANCE, rtol=1e-4),
            avatar,
            alone,
        )


def outward(photos):
    """Returns the capture with its body a centimetre thicker."""
    rest = shape_body(photos.body, jnp.asarray(photos.betas))
    normals = np.asarray(vertex_normals(rest.vertices, photos.body.faces))
    return dataclasses.replace(photos, displacement=0.01 * normals)


def test_the_body_is_displaced_by_the_capture_or_its_masks_if_the_network_looks_at_the_person_alone(
    body, network
):
    config, photos = network[1].with_conventions(pixels="person"), capture_of(body, 0, 2)
    on, off, all_pixels = (
        config.with_runtime(displacement=True),
        config.with_runtime(displacement=False),
        {"pixels": "all"},
    )
    full = dataclasses.replace(photos, masks=np.ones_like(photos.masks))
    moved = lambda photos, config: prepare_capture(photos, config).displacement
    assert not moved(full, config).any()  # no body sticks out of masks that are full
    # then the result is what it was, bit for bit
    assert moved(dataclasses.replace(full, masks=None), on) is None
    assert moved(full, on.with_conventions(**all_pixels)) is None and moved(full, off) is None
    given = outward(photos)
    for each in (given, dataclasses.replace(given, masks=None)):
        np.testing.assert_array_equal(moved(each, on), given.displacement)
    assert moved(given, config.with_conventions(**all_pixels)) is None and moved(given, off) is None
    finer = config.with_conventions(max_edge_length=0.05)
    assert len(moved(given, finer)) == len(gaussian_body(body, finer).template) > len(body.template)


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [(np.zeros((7, 3)), r"shape \(500, 3\)"), (np.full((500, 3), np.nan), "finite")],
)
def test_a_displacement_of_another_body_is_named(body, network, wrong, expected):
    with pytest.raises(ValueError, match=f"displacement.*{expected}"):
        reconstruct(*network, dataclasses.replace(capture_of(body, 0, 2), displacement=wrong))


@pytest.mark.slow
def test_a_kept_displacement_gives_the_avatar_of_one_that_is_computed(body, network):
    variables, config = (
        network[0],
        network[1].with_conventions(pixels="person").with_runtime(displacement=True),
    )
    photos = capture_of(body, 0, 2)
    kept = dataclasses.replace(photos, displacement=fit_vertex_offsets(body, photos))
    assert kept.displacement.any()
    computed = reconstruct(variables, config, photos)
    with compiled_programs() as programs:
        again = reconstruct(variables, config, kept)
    jax.tree.map(np.testing.assert_array_equal, again, computed)
    assert not [name for name in programs if "_reconstruct" in name]


@pytest.mark.slow
def test_a_known_displacement_moves_the_skin_and_no_joint_alone_and_in_a_batch(body, network):
    variables, config = (
        network[0],
        network[1].with_conventions(pixels="person", max_edge_length=0.05),
    )
    bare = [capture_of(body, seed, views) for seed, views in enumerate((2, 1))]
    captures = [outward(bare[0]), dataclasses.replace(bare[1], masks=None)]  # with and without
    # whatever the masks say
    still = dataclasses.replace(bare[0], displacement=0 * captures[0].displacement)
    before, after = (reconstruct(variables, config, photos) for photos in (still, captures[0]))
    moved = np.asarray(after.rest_vertices - before.rest_vertices)
    np.testing.assert_allclose(moved[: len(body.template)], captures[0].displacement, atol=1e-6)
    # midpoints, too
    assert len(moved) > len(body.template) and np.median(np.linalg.norm(moved, axis=1)) > 0.009
    np.testing.assert_array_equal(after.rest_joints, before.rest_joints)
    together = avatars_of(reconstruct_batch(variables, config, captures))
    for avatar, photos in zip(together, captures, strict=True):
        alone = reconstruct(variables, config, photos)
        assert jax.tree.structure(avatar) == jax.tree.structure(alone)
        parts_of = lambda avatar: (avatar.rest_vertices, avatar.rest_joints, avatar.gaussians.means)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=VMAP_TOLERANCE, rtol=1e-4),
            parts_of(avatar),
            parts_of(alone),
        )


@pytest.mark.slow
def test_a_person_in_a_skirt_has_one_alone_and_among_others(body, network, monkeypatch):
    variables, config = network[0], network[1].with_conventions(pixels="person")
    skirted, plain = (
        dataclasses.replace(x, masks=np.ones_like(x.masks))
        for x in (capture_of(body, i, 2) for i in (0, 1))
    )
    shown = lambda _, capture: 0.6 if capture.images is skirted.images else None
    monkeypatch.setattr(skirt, "find_hem", shown)
    worn, bare = (reconstruct(variables, config, x) for x in (skirted, plain))
    added = skirt.ROWS * 2 * (skirt.GAP + skirt.HALF)
    assert len(worn.rest_vertices) == len(bare.rest_vertices) + added == len(body.template) + added
    per_vertex = config.architecture.decoder.gaussians_per_vertex
    assert len(worn.gaussians.means) == per_vertex * len(worn.rest_vertices)
    np.testing.assert_allclose(
        worn.rest_joints, shape_body(body, jnp.asarray(skirted.betas)).joints, atol=1e-6
    )
    np.testing.assert_allclose(np.asarray(worn.skinning_weights).sum(-1), 1, atol=1e-5)
    together = avatars_of(reconstruct_batch(variables, config, [skirted, plain]))
    for avatar, alone in zip(together, (worn, bare), strict=True):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, atol=VMAP_TOLERANCE, rtol=1e-4),
            avatar,
            alone,
        )
    off = reconstruct(variables, config.with_runtime(displacement=False), skirted)
    assert len(off.rest_vertices) == len(body.template)


@pytest.mark.slow
def test_programs_are_compiled_once_per_bucket(body, network):
    variables, config = network
    config = config.with_runtime(tokens="all")
    with compiled_programs() as programs:
        for views in (17, 18, 19):
            reconstruct(variables, config, capture_of(body, 0, views))
    assert len([name for name in programs if "_reconstruct" in name]) == 1


def test_what_cannot_be_one_batch_is_named(body, network):
    photos = capture(body, SIZE, SIZE)
    with pytest.raises(ValueError, match="none given"):
        stack_captures(network[1], [])
    with pytest.raises(ValueError, match=r"captures\[1\]: 0 views"):
        stack_captures(network[1], [photos, photos.select([])])
    other = capture(decimate(load_body(), 400), SIZE, SIZE)
    with pytest.raises(
        ValueError, match=r"captures\[1\]: its body is not the one of captures\[0\]"
    ):
        stack_captures(network[1], [photos, other])


@pytest.mark.slow
def test_stacked_captures_are_a_batch_for_vmap(body, network):
    """The README's line gives what `reconstruct_batch` gives, bit by bit."""
    variables, config = network
    config = config.with_conventions(body_vertices=300, light=True).with_runtime(token_capacity=0)
    captures = [capture_of(body, seed, views) for seed, views in enumerate((2, 1))]
    made, views, fitted = stack_captures(config, captures)
    assert (
        len(made.template) == 300
        and fitted.runtime.token_capacity > 0
        and views.images.shape[:2] == (2, 2)
    )
    avatars, dropped = jax.vmap(reconstruct_views, in_axes=(None, None, None, 0))(
        variables, fitted, made, views
    )
    assert len(avatars) == 2 and dropped.tolist() == [0, 0]
    expected = avatars_of(reconstruct_batch(variables, config, captures))
    for avatar, other in zip(avatars, expected, strict=True):
        assert jax.tree.structure(avatar) == jax.tree.structure(other)
        jax.tree.map(np.testing.assert_array_equal, avatar, other)
    alone, _ = jax.jit(reconstruct_views)(
        variables, fitted, made, jax.tree.map(lambda x: x[0], views)
    )
    # the configuration needs no static_argnums
    assert alone.gaussians.means.shape == expected[0].gaussians.means.shape


def test_views_and_bodies_of_another_configuration_are_refused(body, network):
    variables, config = network
    config = config.with_conventions(body_vertices=300)
    made, views = gaussian_body(body, config), subject_views(0)
    with pytest.raises(
        ValueError,
        match=r"a body of 500 vertices that gaussian_body\(body, config\) has not made; .*stack",
    ):
        reconstruct_views(variables, config, body, views)
    with pytest.raises(ValueError, match="has not made"):
        reconstruct_views(variables, config, decimate(made, 200), views)
    with pytest.raises(
        ValueError,
        match=r"photos of 32 x 32, config wants 64 x 64; body, views, config = stack_captures",
    ):
        reconstruct_views(variables, config.with_runtime(image_size=64), made, views)
    with pytest.raises(
        ValueError, match=r"views\.images: expected shape \(v, h, w, 3\), got \(1, 2, 32, 32, 3\)"
    ):
        reconstruct_views(variables, config, made, jax.tree.map(lambda x: x[None], views))


def test_views_are_padded_to_a_number_not_below_their_own():
    views = subject_views(0)
    padded = pad_views(views, 3)
    assert padded.view_count == 2 and len(padded.cameras.K) == len(padded.images) == 3
    assert np.array_equal(padded.images[:2], views.images) and np.array_equal(
        padded.rotations[2], views.rotations[1]
    )
    with pytest.raises(ValueError, match="2 views cannot be padded to 1"):
        pad_views(views, 1)
