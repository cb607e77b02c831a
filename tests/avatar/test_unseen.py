import jax
import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.avatar.unseen import (
    Regions,
    attended,
    body_regions,
    guess_line,
    guessed,
    unseen_sides,
)
from humangs_jax.body.library import load_body
from humangs_jax.body.model import shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.mesh.rasterizer import vertex_normals

RED, GREY, HAIR, SKIN = (0.9, 0.1, 0.1), (0.4, 0.4, 0.4), (0.2, 0.1, 0.0), (0.8, 0.6, 0.5)
PER_VERTEX = 2


@pytest.fixture(scope="module")
def body():
    return decimate(load_body(), 1500)


@pytest.fixture(scope="module")
def rest(body):
    return shape_body(body, jnp.zeros(body.shape_directions.shape[-1])).vertices


@pytest.fixture(scope="module")
def normals(body, rest):
    return vertex_normals(rest, body.faces)


def gaussians_on(rest, colors):
    """Returns `PER_VERTEX` Gaussians on each vertex, in the vertex's color."""
    count = PER_VERTEX * len(rest)
    return Gaussians(
        jnp.repeat(rest, PER_VERTEX, axis=0),
        jnp.tile(jnp.eye(4)[0], (count, 1)),
        jnp.full((count, 3), 0.01),
        jnp.full(count, 0.9),
        jnp.repeat(jnp.asarray(colors, jnp.float32), PER_VERTEX, axis=0),
    )


def colors_of(gaussians):
    return np.asarray(gaussians.colors).reshape(-1, PER_VERTEX, 3)[:, 0]


def dominant(body, *words):
    names = np.asarray(body.joint_names)[np.argmax(np.asarray(body.skinning_weights), axis=1)]
    return np.asarray([any(word in name for word in words) for name in names])


def seen_from_the_front(body, rest, normals, paint):
    """Returns the Gaussians after guessing what a photo from the front does not show."""
    regions = body_regions(body, rest)
    shown = jnp.maximum(normals[:, 2], 0)
    return guessed(gaussians_on(rest, paint), rest, normals, shown, regions)


def painted(body, rest, normals):
    """Returns colors of the vertices as a photo from the front shows them.

    Clothes are red, hair is dark, face and hands are skin; what is not shown is grey.
    """
    regions, front = body_regions(body, rest), np.asarray(normals[:, 2]) > 0.03
    head, hands = np.asarray(regions.head), dominant(body, "wrist", "index", "thumb", "pinky")
    paint = np.tile(RED, (len(rest), 1))
    paint[head | hands] = SKIN
    paint[head & np.asarray(regions.sources)] = HAIR
    paint[~front] = GREY
    return paint


def test_the_back_wears_what_the_front_wears(body, rest, normals):
    paint = painted(body, rest, normals)
    found = colors_of(seen_from_the_front(body, rest, normals, paint))
    back = (np.asarray(normals[:, 2]) < -0.5) & dominant(body, "spine", "pelvis", "hip", "knee")
    assert np.count_nonzero(back) > 100
    np.testing.assert_allclose(found[back], np.tile(RED, (back.sum(), 1)), atol=0.02)


def test_the_back_of_a_head_gets_hair_and_no_second_face(body, rest, normals):
    paint = painted(body, rest, normals)
    found = colors_of(seen_from_the_front(body, rest, normals, paint))
    regions = body_regions(body, rest)
    back = np.asarray(regions.head & regions.free) & (np.asarray(normals[:, 2]) < -0.5)
    assert np.count_nonzero(back) > 20
    np.testing.assert_allclose(found[back], np.tile(HAIR, (back.sum(), 1)), atol=0.02)


def test_a_face_that_no_photo_shows_stays_as_the_network_made_it(body, rest, normals):
    regions = body_regions(body, rest)
    own = gaussians_on(rest, np.random.default_rng(0).random((len(rest), 3)))
    found = guessed(own, rest, normals, jnp.maximum(-normals[:, 2], 0), regions)
    face = ~np.asarray(regions.free)
    assert np.count_nonzero(face) > 50
    np.testing.assert_array_equal(colors_of(found)[face], colors_of(own)[face])


def test_what_photos_show_keeps_its_bits(body, rest, normals):
    own = gaussians_on(rest, np.random.default_rng(0).random((len(rest), 3)))
    regions = body_regions(body, rest)
    everywhere = guessed(own, rest, normals, jnp.ones(len(rest)), regions)
    jax.tree.map(np.testing.assert_array_equal, everywhere, own)
    half = guessed(own, rest, normals, jnp.where(normals[:, 2] > 0, 1.0, 0.0), regions)
    shown = np.asarray(normals[:, 2]) > 0
    np.testing.assert_array_equal(colors_of(half)[shown], colors_of(own)[shown])
    assert (colors_of(half)[~shown] != colors_of(own)[~shown]).any(axis=1).mean() > 0.5


def test_without_anything_shown_nothing_is_guessed(body, rest, normals):
    own = gaussians_on(rest, np.random.default_rng(0).random((len(rest), 3)))
    found = guessed(own, rest, normals, jnp.zeros(len(rest)), body_regions(body, rest))
    jax.tree.map(np.testing.assert_array_equal, found, own)


def test_cloth_stands_off_the_back_as_far_as_off_the_front(body, rest, normals):
    own = gaussians_on(rest, np.tile(RED, (len(rest), 1)))
    height = jnp.where(normals[:, 2] > 0, 0.03, 0.0)
    own = replace(own, means=own.means + jnp.repeat(height[:, None] * normals, PER_VERTEX, axis=0))
    found = guessed(own, rest, normals, jnp.maximum(normals[:, 2], 0), body_regions(body, rest))
    heights = np.sum((np.asarray(found.means)[::PER_VERTEX] - rest) * normals, axis=-1)
    back = (np.asarray(normals[:, 2]) < -0.5) & dominant(body, "spine", "pelvis", "knee")
    np.testing.assert_allclose(heights[back], 0.03, atol=0.003)


def line(*places):
    """Returns regions of vertices on a line, all of which are free and are sources."""
    features = jnp.asarray(places, jnp.float32)[:, None]
    yes = jnp.ones(len(places), bool)
    return Regions(~yes, yes, yes, features, -features)


def test_a_guess_comes_from_the_nearest_source_or_its_mirror_image():
    regions = line(0.2, 0.25, -0.24, 0.6, 1.2)
    values = jnp.asarray([[1.0], [0.0], [0.0], [7.0], [0.0]])
    need, sure = jnp.asarray([0.0, 1, 1, 0, 1]), jnp.asarray([1.0, 0, 0, 1, 0])
    found = np.asarray(attended(values, need, sure, regions))[:, 0]
    np.testing.assert_allclose(found[:4], [1, 1, 1, 7], atol=1e-3)
    assert found[4] == 0  # too far from all


def test_half_a_need_takes_half_of_the_guess():
    found = attended(
        jnp.asarray([[1.0], [0.0]]), jnp.asarray([0, 0.5]), jnp.asarray([1.0, 0]), line(0.2, 0.21)
    )
    np.testing.assert_allclose(found[:, 0], [1, 0.5], atol=1e-6)


def test_guesses_have_gradients():
    need, sure = jnp.asarray([0.0, 1, 0.5]), jnp.asarray([1.0, 0, 0])
    total = lambda values: jnp.sum(attended(values, need, sure, line(0.2, 0.21, 0.19)))
    gradient = jax.grad(total)(jnp.asarray([[1.0], [2.0], [3.0]]))
    np.testing.assert_allclose(gradient[:, 0], [2.5, 0, 0.5], atol=1e-6)


def capture_from(body, azimuths, covered=None):
    """Returns a capture of a person who is photographed from `azimuths`, degrees, 0 in front.

    Masks end at the share `covered` of the height.
    """
    size, count = 64, len(azimuths)
    K = intrinsics_from_fov(np.pi / 3, size, size)
    angles = jnp.radians(jnp.asarray(azimuths, jnp.float32))
    cameras = orbit(jnp.zeros(3), 2.5, angles, 0.0, K, size, size)
    masks = np.ones((count, size, size), np.float32)
    if covered is not None:
        masks[:, int(covered * size) :] = 0
    height = np.asarray(body.template)[:, 1]
    return capture_from_arrays(
        np.ones((count, size, size, 3), np.float32),
        cameras.K,
        cameras.cam_from_world,
        np.zeros((1, len(body.parents), 3), np.float32),
        np.asarray([[0, -(height.min() + height.max()) / 2, 0]], np.float32),
        frames=np.zeros(count, int),
        masks=masks,
        body=body,
    )


def test_the_line_names_the_sides_that_no_photo_shows(body):
    front = guess_line(capture_from(body, [0]))
    assert front == "the back, the left side and the right side are guesses: no photo shows them"
    behind = guess_line(capture_from(body, [180]))
    assert behind.startswith("the front, the left side")
    three = guess_line(capture_from(body, [0, 90, 270]))
    assert three == "the back is a guess: no photo shows it"
    assert guess_line(capture_from(body, [0, 90, 180, 270])) is None


def test_the_line_names_the_parts_that_are_cut_off(body):
    around = [0, 90, 180, 270]
    assert unseen_sides(capture_from(body, around, covered=0.6)) == ["lower legs", "feet"]


def test_a_person_who_turns_is_shown_from_all_sides_by_one_camera(body):
    capture = capture_from(body, [0])
    turned = np.zeros((4, len(body.parents), 3), np.float32)
    turned[:, 0, 1] = np.radians([0, 90, 180, 270])
    place = np.asarray(capture.poses.translation[0])
    cameras = [0] * 4
    several = capture_from_arrays(
        np.ones((4, 64, 64, 3), np.float32),
        np.asarray(capture.cameras.K)[cameras],
        np.asarray(capture.cameras.cam_from_world)[cameras],
        turned,
        np.tile(place, (4, 1)),
        frames=np.arange(4),
        masks=np.ones((4, 64, 64), np.float32),
        body=body,
    )
    assert guess_line(several) is None
