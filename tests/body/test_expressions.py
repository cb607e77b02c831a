"""Expressions of bodies: the 52 shapes of the shipped one, SMPL-X's, and other resolutions."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from small import small_body

import humangs_jax
from humangs_jax.body.expressions import Expressions, _read_face, shipped_parts
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.library import load_body, read_body, save_body
from humangs_jax.body.model import BodyPose, pose_body, rest_pose, shape_body
from humangs_jax.body.resolution import decimate, split_long_edges
from humangs_jax.core.pytree import replace
from humangs_jax.io.reading import FileError
from humangs_jax.motion.face_tracks import ARKIT

FACE = Path(humangs_jax.__file__).parent / "assets" / "face.npz"


@pytest.fixture(scope="module")
def shipped():
    return load_body()


def coefficients(body, **values):
    return jnp.asarray([values.get(name, 0.0) for name in body.expressions.names], jnp.float32)


def face(body, **values):
    rest = shape_body(body, jnp.zeros(0))
    pose = replace(rest_pose(body), expression=coefficients(body, **values))
    return rest, pose_body(body, rest, pose)


def test_the_shipped_body_has_the_52_shapes_of_arkit(shipped):
    assert shipped.expressions.names == ARKIT
    rest, opened = face(shipped, jawOpen=1.0)
    moves = np.linalg.norm(opened.vertices - rest.vertices, axis=1)
    assert 0.038 < moves.max() < 0.0395 and (moves > 1e-5).sum() == 2249
    chin = np.argmax(moves)
    assert opened.vertices[chin, 1] < rest.vertices[chin, 1]  # it falls
    tongue = shipped.expressions.directions[..., ARKIT.index("tongueOut")]
    assert not np.asarray(tongue).any()  # the tongue is none of the skin


def test_left_and_right_shapes_are_of_the_side_of_the_person(shipped):
    for side, sign in (("Left", 1), ("Right", -1)):
        rest, blinking = face(shipped, **{f"eyeBlink{side}": 1.0})
        moves = np.linalg.norm(blinking.vertices - rest.vertices, axis=1)
        assert sign * np.average(rest.vertices[:, 0], weights=moves) > 0.02


def test_eyes_turn_by_their_joints(shipped):
    _, looking = face(shipped, eyeLookUpLeft=1.0)
    forward = [
        looking.joint_transforms[JOINT_NAMES.index(f"{side}_eye"), :3, 2]
        for side in ("left", "right")
    ]
    assert np.degrees(np.arcsin(forward[0][1])) == pytest.approx(9.65, abs=0.1)
    assert forward[1][2] == 1  # the other one looks ahead


def test_an_expression_of_zeros_is_the_face_at_rest(shipped):
    rest, still = face(shipped)
    plain = pose_body(shipped, rest, rest_pose(shipped))
    np.testing.assert_array_equal(still.vertices, plain.vertices)


def test_without_an_expression_a_body_is_posed_as_if_it_had_none(shipped):
    rest = shape_body(shipped, jnp.zeros(0))
    pose = rest_pose(shipped)
    without = pose_body(replace(shipped, expressions=None), rest, pose)
    np.testing.assert_array_equal(pose_body(shipped, rest, pose).vertices, without.vertices)


def test_an_expression_of_another_face_is_refused(shipped):
    rest, pose = shape_body(shipped, jnp.zeros(0)), rest_pose(shipped)
    with pytest.raises(ValueError, match=r"expected 52 coefficients.*got shape \(3,\)"):
        pose_body(shipped, rest, replace(pose, expression=jnp.zeros(3)))
    plain = small_body()
    with pytest.raises(ValueError, match="expected 0 coefficients"):
        pose_body(
            plain,
            shape_body(plain, jnp.zeros(2)),
            BodyPose(jnp.zeros((3, 3)), jnp.zeros(3), jnp.zeros(52)),
        )


def test_other_resolutions_keep_the_expressions(shipped):
    coarse = decimate(shipped, 4000)
    order = np.flatnonzero(np.asarray(shipped.collapse_order) < 4000)
    whole = np.zeros((len(shipped.template), 3, 52), np.float32)
    whole[np.asarray(shipped.expressions.vertices)] = shipped.expressions.directions
    kept = np.zeros((4000, 3, 52), np.float32)
    kept[np.asarray(coarse.expressions.vertices)] = coarse.expressions.directions
    np.testing.assert_array_equal(kept, whole[order])
    fine = split_long_edges(coarse, 0.03)[0]
    smile = dict(mouthSmileLeft=1.0, jawOpen=0.5)
    rest, posed = face(fine, **smile)
    move = np.asarray(posed.vertices - rest.vertices)
    rest, posed = face(coarse, **smile)
    np.testing.assert_allclose(move[:4000], posed.vertices - rest.vertices, atol=1e-6)
    assert (np.linalg.norm(move[4000:], axis=1) > 1e-3).sum() > 10  # middles of edges move, too


def test_files_of_bodies_hold_their_expressions(tmp_path):
    rng = np.random.default_rng(0)
    expressions = Expressions(
        vertices=jnp.asarray([1, 4]),
        directions=jnp.asarray(rng.normal(size=(2, 3, 3)), jnp.float32),
        joint_directions=jnp.asarray(rng.normal(size=(3, 3, 3)), jnp.float32),
        names=("happy", "sad", "odd"),
    )
    body = replace(small_body(), expressions=expressions)
    save_body(tmp_path / "body.npz", body)
    read = read_body(tmp_path / "body.npz").expressions
    assert read.names == expressions.names and read.joint_turns is None
    np.testing.assert_array_equal(read.directions, expressions.directions)
    np.testing.assert_array_equal(read.joint_directions, expressions.joint_directions)
    np.testing.assert_array_equal(read.vertices, expressions.vertices)


def test_teeth_lie_behind_the_lips_and_the_lower_ones_follow_the_jaw(shipped):
    parts = shipped_parts(np.asarray(shipped.template))
    lower = parts.parts == 1
    assert (parts.corners[lower][..., 2] < parts.lips[:2, 2].min()).all()
    jaw = ARKIT.index("jawOpen")
    falls = parts.directions[lower][..., 1, jaw]
    assert falls.max() < 0 and falls.min() < -0.02
    assert not parts.directions[parts.parts == 0][..., jaw].any()  # the upper ones stay


@pytest.mark.parametrize(
    ("key", "wrong"),
    [
        ("vertices", lambda x: x.astype("U8")),
        ("vertices", lambda x: x[:, None]),
        ("vertices", lambda x: x.astype(np.int64) - 5),
        ("vertices", lambda x: 1000 * x.astype(np.int64)),
        ("names", lambda x: np.asarray("jawOpen")),
        ("names", lambda x: np.arange(len(x))),
        ("offsets", lambda x: x[:, 1:]),
    ],
)
def test_a_wrong_array_of_a_face_file_is_named(key, wrong, tmp_path):
    with np.load(FACE) as file:
        arrays = dict(file)
    np.savez(tmp_path / "face.npz", **arrays | {key: wrong(arrays[key])})
    with pytest.raises(FileError, match=rf"face\.npz: .*{key}: expected"):
        _read_face(tmp_path / "face.npz")
