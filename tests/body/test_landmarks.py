import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import bound

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.landmarks import (
    LandmarkDefinition,
    landmark_model,
    mirrored_name,
    pose_landmarks,
    side_of,
)
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.capture.keypoints.keypoints import (
    COCO_17,
    COCO_WHOLEBODY_133,
    MEDIAPIPE_33,
    OPENPOSE_67,
)
from humangs_jax.core.pytree import replace

ATOL = 2e-6  # metres, float32
SYMMETRY = 0.004  # metres: the shipped body's feet are not quite mirror images
COARSER = (
    0.015  # metres: how far a vertex of a quarter of the mesh is from the best of the whole one
)
REST = BodyPose(jnp.zeros((55, 3)), jnp.zeros(3))

posed = jax.jit(pose_landmarks)


def at_rest(model):
    return np.asarray(posed(model, jnp.zeros(1), REST)[0])


@pytest.fixture(scope="module")
def small(body):
    return decimate(body, len(body.template) // 4)


@pytest.fixture(scope="module")
def whole(body):
    """Returns (model of all known landmarks, their places at rest by name)."""
    model = landmark_model(body, COCO_WHOLEBODY_133.names)
    return model, dict(zip(model.names, at_rest(model), strict=True))


def test_the_shipped_body_has_all_but_most_of_the_face(whole):
    model, _ = whole
    missing = {name for name, known in zip(model.names, model.known, strict=True) if not known}
    assert missing == {n for n in model.names if n.startswith("face_")} - {
        "face_8",
        "face_27",
        "face_30",
    }
    np.testing.assert_allclose(
        np.asarray(model.regressor).sum(1), np.asarray(model.known, float), atol=1e-6
    )


BENT = BodyPose(
    REST.rotations.at[JOINT_NAMES.index("left_elbow")].set(jnp.asarray([0, -np.pi / 2, 0])),
    jnp.zeros(3),
)
"""A pose with the left elbow bent forward by a right angle."""


@pytest.mark.parametrize(
    ("joints", "turned"),
    [(("left_shoulder",), (0.03, 0.02, 0.0)), (("left_elbow",), (0.0, 0.02, 0.03))],
)
def test_a_place_is_beside_its_joint_and_turns_with_its_bones(small, joints, turned):
    names = ("left_elbow", "nose")
    plain, moved = (
        landmark_model(small, names, places)
        for places in ((), (LandmarkDefinition(names[0], names[0], (0.03, 0.02, 0), joints),))
    )
    for betas in (jnp.zeros(2), jnp.asarray([2.0, -1.0])):
        (a, nose), (b, same) = (posed(model, betas, BENT)[0] for model in (plain, moved))
        np.testing.assert_allclose(b - a, turned, atol=ATOL)
        np.testing.assert_array_equal(nose, same)


def test_places_beside_a_vertex_move_with_its_bones_and_those_of_missing_joints_are_ignored(small):
    names = ("left_index_tip", "nose")
    places = (
        LandmarkDefinition(names[0], names[0], (0.0, 0.01, 0.0)),
        LandmarkDefinition("nose", "left_horn", (1.0, 0, 0)),
        LandmarkDefinition("nose", "nose", (1, 0, 0), ("tail",)),
    )
    plain, moved = (
        posed(landmark_model(small, names, own), jnp.zeros(1), BENT)[0] for own in ((), places)
    )
    np.testing.assert_allclose(moved - plain, [[0, 0.01, 0], [0, 0, 0]], atol=ATOL)  # up stays up


def test_left_and_right_are_mirror_images(body, whole):
    """The shipped body has every landmark of our detector."""
    model = landmark_model(body, MEDIAPIPE_33.names, MEDIAPIPE_33.places)
    assert all(model.known)
    for points in (whole[1], dict(zip(model.names, at_rest(model), strict=True))):
        for name, point in points.items():
            assert np.linalg.norm(point - points[mirrored_name(name)] * [-1, 1, 1]) < SYMMETRY, name
            side = {"left": 1, "right": -1}.get(name.split("_")[0], 0)
            assert side * point[0] > 0 or not side, name


@pytest.mark.parametrize("kind", [MEDIAPIPE_33, COCO_17], ids=lambda kind: kind.name)
def test_mirror_images_share_one_offset_with_x_turned_round(body, kind):
    """Points of the face are pairs, too: the corners of the eyes and of the mouth."""
    model = landmark_model(body, kind.names, kind.places)
    groups = {model.names[landmark]: (group, side) for landmark, group, side in model.placed}
    assert len({group for group, _ in groups.values()}) == len(
        {frozenset((n, mirrored_name(n))) for n in groups}
    )
    offsets = np.random.default_rng(0).normal(0, 0.01, (len(groups), 3))
    moved = dict(zip(model.names, model.by_landmark(jnp.asarray(offsets)), strict=True))
    x = {name: at_rest(model)[i, 0] for i, name in enumerate(model.names)}
    for name, (group, side) in groups.items():
        assert groups[mirrored_name(name)][0] == group
        other = mirrored_name(name)
        if other != name:
            np.testing.assert_allclose(moved[other], moved[name] * [-1, 1, 1], atol=1e-6)
            assert side * x[name] > 0, name


def test_the_sides_of_all_points_of_the_face():
    """300-W counts jaw, brows, nostrils and upper lips from the person's right to the left, and
    lower lips from left to right.
    """
    left = {*range(9, 17), *range(22, 27), 34, 35, *range(42, 48), 52, 53, 54, 55, 56, 63, 64, 65}
    middle = {8, *range(27, 31), 33, 51, 57, 62, 66}
    names = [f"face_{i}" for i in range(68)]
    assert {i for i in range(68) if mirrored_name(names[i]) == names[i]} == middle
    assert {i for i in range(68) if side_of(names[i]) > 0} == left | middle
    assert all(mirrored_name(mirrored_name(name)) == name for name in names)


@pytest.mark.slow
@pytest.mark.parametrize("correctives", [False, True])
def test_landmarks_are_the_posed_bodys(body, correctives):
    rng = np.random.default_rng(0)
    if correctives:
        directions = jnp.asarray(rng.normal(0, 0.001, (*body.template.shape, 9 * 54)), jnp.float32)
        body = replace(body, pose_directions=directions)
    names = ("nose", "left_heel", "right_index_tip", "left_knee", "neck", "right_ear", "face_3")
    model = landmark_model(body, names)
    betas = jnp.asarray(rng.normal(0, 1, 5), jnp.float32)
    pose = BodyPose(
        jnp.asarray(rng.normal(0, 0.4, (55, 3)), jnp.float32), jnp.asarray([0.3, -0.2, 1.0])
    )
    landmarks, joints = posed(model, betas, pose)
    whole = jax.jit(lambda b, s, p: pose_body(b, shape_body(b, s), p))(body, betas, pose)
    np.testing.assert_allclose(joints, whole.joints, atol=ATOL)
    vertices = np.asarray(whole.vertices)
    for name, found in zip(names[:3], np.asarray(landmarks), strict=False):
        assert np.linalg.norm(vertices - found, axis=1).min() < bound(ATOL), name
    shoulders = [JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")]
    np.testing.assert_allclose(landmarks[4], joints[np.asarray(shoulders)].mean(0), atol=ATOL)
    np.testing.assert_array_equal(landmarks[3], joints[JOINT_NAMES.index("left_knee")])
    np.testing.assert_array_equal(landmarks[6], 0.0)


def test_where_the_surface_landmarks_are(whole):
    at, height, depth = whole[1], 1, 2
    assert at["face_27"][height] > at["nose"][height] > at["face_8"][height]
    assert (
        at["nose"][depth] > max(at["face_27"][depth], at["face_8"][depth]) > at["left_ear"][depth]
    )
    assert at["left_small_toe"][0] > at["left_ankle"][0] > at["left_big_toe"][0]
    assert (
        at["left_big_toe"][depth]
        > at["left_small_toe"][depth]
        > at["left_ankle"][depth]
        > at["left_heel"][depth]
    )


def test_a_coarser_mesh_has_them_nearly_where_the_whole_one_has_them(small, whole):
    model = landmark_model(small, OPENPOSE_67.names)
    known = [name for name in model.names if name in whole[1]]
    assert len(known) > 60
    for name, point in zip(model.names, at_rest(model), strict=True):
        assert name not in known or np.linalg.norm(whole[1][name] - point) < COARSER, name


def test_movers_are_the_joints_that_move_a_landmark(small):
    model = landmark_model(small, ("left_wrist", "nose"))
    moved = {JOINT_NAMES[j] for j in model.movers}
    chain = {
        "pelvis",
        "spine1",
        "spine2",
        "spine3",
        "left_collar",
        "left_shoulder",
        "left_elbow",
        "neck",
        "head",
    }
    assert chain <= moved <= chain | {"jaw"}


def test_joints_of_other_names_are_refused(small):
    strange = dataclasses.replace(small, joint_names=tuple(f"bone{j}" for j in range(55)))
    with pytest.raises(ValueError, match=r"none of these landmarks.*bone0"):
        landmark_model(strange, COCO_17.names)
