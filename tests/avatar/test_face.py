"""Avatars with a face: what an expression moves, shows and hides. Without one nothing changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_npz
from small import small_avatar

from humangs_jax.avatar.animate import animate, skin, with_pixel_footprint
from humangs_jax.avatar.attach_face import with_face
from humangs_jax.avatar.avatar import Avatar, Light
from humangs_jax.avatar.face import between_lips
from humangs_jax.avatar.frames import motion_poses
from humangs_jax.body.library import load_body
from humangs_jax.body.model import rest_pose, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.io.reading import FileError
from humangs_jax.motion import load_motion, save_motion
from humangs_jax.rendering.gaussians import Gaussians

SKIN = 0.6


def person(count=None, per_vertex=1):
    """Returns (body, avatar): the shipped body, in one color."""
    body = load_body() if count is None else decimate(load_body(), count)
    rest = shape_body(body, jnp.zeros(0))
    g = per_vertex * len(body.template)
    gaussians = Gaussians(
        jnp.repeat(rest.vertices, per_vertex, axis=0),
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (g, 1)),
        jnp.full((g, 3), 0.004),
        jnp.full(g, 0.9),
        jnp.full((g, 3), SKIN),
    )
    weights = jnp.repeat(body.skinning_weights, per_vertex, axis=0)
    avatar = Avatar(
        gaussians,
        weights,
        rest.vertices,
        rest.joints,
        body.faces,
        body.parents,
        body.joint_names,
    )
    return body, avatar


@pytest.fixture(scope="module")
def someone():
    body, avatar = person(per_vertex=2)
    return body, avatar, with_face(avatar)


def pose_with(avatar, body, **values):
    names = avatar.face.expressions.names
    expression = jnp.asarray([values.get(name, 0.0) for name in names], jnp.float32)
    return replace(rest_pose(body), expression=expression)


def test_without_an_expression_a_face_changes_nothing(someone):
    body, plain, avatar = someone
    pose = replace(rest_pose(body), rotations=jnp.full((55, 3), 0.1))
    jax.tree.map(np.testing.assert_array_equal, skin(avatar, pose), skin(plain, pose))


def test_gaussians_follow_their_vertices(someone):
    body, plain, avatar = someone
    smiling = skin(avatar, pose_with(avatar, body, mouthSmileLeft=1.0, browInnerUp=0.5))
    g = len(plain.gaussians.means)
    moved = np.asarray(smiling.means[:g] - plain.gaussians.means).reshape(-1, 2, 3)
    np.testing.assert_allclose(moved[:, 0], moved[:, 1], atol=1e-6)
    names, shapes = avatar.face.expressions.names, np.asarray(body.expressions.directions)
    expected = np.zeros((len(body.template), 3), np.float32)
    expected[np.asarray(body.expressions.vertices)] = (
        shapes[..., names.index("mouthSmileLeft")] + 0.5 * shapes[..., names.index("browInnerUp")]
    )
    eyes = np.asarray(avatar.face.eyes).reshape(-1, 2, 2).sum(axis=(1, 2)) > 0
    np.testing.assert_allclose(moved[~eyes, 0], expected[~eyes], atol=1e-6)


def test_an_even_stretch_of_the_skin_stretches_its_gaussians(someone):
    body, plain, avatar = someone
    vertices = avatar.face.expressions.vertices
    places = plain.rest_vertices[vertices]
    wider = replace(
        avatar.face.expressions, directions=(0.2 * places * jnp.asarray([1.0, 0, 0]))[..., None],
        names=("wide",), joint_turns=None,
    )  # fmt: skip
    hidden = {
        name: getattr(avatar.face, name)[..., :1]
        for name in ("hidden_directions", "hidden_shown", "lip_directions")
    }
    stretched = replace(avatar, face=replace(avatar.face, expressions=wider, **hidden))
    pose = replace(rest_pose(body), expression=jnp.ones(1))
    found = np.asarray(skin(stretched, pose).deformations)
    rows = np.asarray(avatar.face.row)
    inside = np.isin(np.asarray(avatar.face.beside), len(vertices)).sum(axis=1) < 1
    own = inside[np.minimum(rows, len(vertices) - 1)] & (rows < len(vertices))
    across = found[: len(rows)][own][:, 0, 0]
    # normals along x are not stretched by what lies across: most of the face looks ahead
    assert np.median(across) == pytest.approx(1.2, abs=0.03) and across.max() < 1.21
    np.testing.assert_allclose(found[: len(rows)][own][:, 1, 1], 1, atol=1e-3)


def test_teeth_are_drawn_only_between_open_lips(someone):
    body, plain, avatar = someone
    g = len(plain.gaussians.means)

    def shown(**values):
        return np.asarray(animate(avatar, pose_with(avatar, body, **values)).opacities[g:])

    in_mouth = np.asarray(avatar.face.in_mouth) > 0
    assert not shown(mouthSmileLeft=1.0)[in_mouth].any()
    opened = shown(jawOpen=1.0)
    assert (opened[in_mouth] > 0.9).sum() > 50 and not opened[~in_mouth].any()
    closed_again = shown(jawOpen=1.0, mouthClose=1.0)[in_mouth]
    assert closed_again.sum() < 0.2 * opened[in_mouth].sum()


def test_closed_lids_have_the_color_of_the_skin_and_hide_the_eye(someone):
    body, plain, avatar = someone
    g = len(plain.gaussians.means)
    blinking = skin(avatar, pose_with(avatar, body, eyeBlinkLeft=1.0))
    lids = np.asarray(blinking.opacities[g:]) > 0.9
    assert lids.sum() > 40 and (blinking.means[g:][lids, 0] > 0).all()
    np.testing.assert_allclose(blinking.colors[g:][lids], SKIN, atol=1e-6)
    left = np.asarray(avatar.face.eyes[:, 0]) == 1
    assert left.any() and not blinking.opacities[:g][left].any()
    right = np.asarray(avatar.face.eyes[:, 1]) == 1
    np.testing.assert_array_equal(blinking.opacities[:g][right], plain.gaussians.opacities[right])


def test_gaussians_of_an_eye_turn_with_its_joint(someone):
    body, plain, avatar = someone
    g = len(plain.gaussians.means)
    looking = skin(avatar, pose_with(avatar, body, eyeLookOutLeft=1.0, eyeLookInRight=1.0))
    for side in range(2):
        eye = np.asarray(avatar.face.eyes[:, side]) == 1
        move = np.asarray(looking.means[:g] - plain.gaussians.means)[eye]
        assert move[:, 0].min() > -1e-3 and move[:, 0].mean() > 0.002  # to the left of the person


def test_hidden_gaussians_take_what_the_others_have(someone):
    body, plain, avatar = someone
    g = len(plain.gaussians.means)
    normals = jnp.tile(jnp.asarray([0, 0, 1.0]), (g, 1))
    lit = replace(avatar, light=Light(0.1 * jnp.ones(8), normals, jnp.zeros(g)))
    lit = with_pixel_footprint(lit, 0.002)
    gaussians = replace(lit.gaussians, harmonics=jnp.zeros((g, 3, 3)))
    opened = animate(replace(lit, gaussians=gaussians), pose_with(avatar, body, jawOpen=1.0))
    q = len(avatar.face.in_mouth)
    assert opened.harmonics.shape == (g + q, 3, 3) and opened.pixel_footprint.shape == (g + q,)
    assert np.isfinite(opened.colors).all()


def test_refined_and_coarser_avatars_get_a_face_and_others_none():
    _, coarse = person(4000)
    with pytest.raises(ValueError, match="not those of the shipped body"):
        with_face(coarse)  # no body that the shipped weights make
    assert len(with_face(coarse, decimate(load_body(), 4000)).face.row) == 4000
    _, avatar = person()
    some = avatar.select(np.arange(0, len(avatar.gaussians.means), 3))
    assert with_face(some).face.row.shape == some.gaussians.opacities.shape
    with pytest.raises(ValueError, match="not those of the shipped body"):
        with_face(small_avatar())


def test_an_avatar_without_a_face_says_how_it_gets_one(someone):
    body, plain, avatar = someone
    with pytest.raises(ValueError, match=r"has no face; avatar\.with_face"):
        animate(plain, pose_with(avatar, body))


def test_no_face_is_written_that_could_not_be_read(someone, tmp_path):
    avatar = someone[2]
    wrong = replace(avatar, face=replace(avatar.face, eyes=avatar.face.eyes.at[0, 0].set(jnp.nan)))
    with pytest.raises(FileError, match="face_eyes: expected numbers in"):
        wrong.save(tmp_path / "a.npz")
    assert not any(tmp_path.iterdir())


def test_files_of_avatars_hold_the_face(someone, tmp_path):
    _, _, avatar = someone
    avatar.save(tmp_path / "a.npz")
    loaded = Avatar.load(tmp_path / "a.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(avatar)
    jax.tree.map(np.testing.assert_array_equal, loaded, avatar)
    edit_npz(tmp_path / "a.npz", face_eyes=None)
    with pytest.raises(FileError, match="face_eyes"):
        Avatar.load(tmp_path / "a.npz")


def test_points_are_seen_through_the_opening_and_before_it():
    lips = jnp.asarray([[0, 0.01, 0], [0, -0.01, 0], [0.02, 0, 0], [-0.02, 0, 0.0]])
    points = jnp.asarray([[0, 0, -0.02], [0, 0.02, -0.02], [0.03, 0, -0.02], [0, 0.03, 0.01]])
    np.testing.assert_allclose(between_lips(points, lips), [1, 0, 0, 1], atol=1e-6)
    shut = lips.at[:2, 1].set(0)
    np.testing.assert_allclose(between_lips(points, shut), 0)


def test_a_motion_moves_the_face(someone, tmp_path):
    _, plain, avatar = someone
    walk = load_motion()
    frames = len(walk.translations)
    talking = replace(
        walk, expressions=jnp.linspace(0, 1, frames)[:, None], expression_names=("jawOpen",)
    )
    save_motion(tmp_path / "talk.npz", talking)
    read = load_motion(tmp_path / "talk.npz")
    jaw = avatar.face.expressions.names.index("jawOpen")
    poses = motion_poses(avatar, read)
    np.testing.assert_allclose(poses.expression[:, jaw], talking.expressions[:, 0])
    assert not np.delete(np.asarray(poses.expression), jaw, axis=1).any()
    assert motion_poses(plain, read).expression is None
    twice = read.at_rate(2 * read.fps)
    np.testing.assert_allclose(twice.expressions[1], talking.expressions[:2].mean(), atol=1e-6)
