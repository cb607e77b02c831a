import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rounding import bound

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.landmarks import Place, landmark_model, pose_landmarks
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.data.keypoints.keypoints import COCO_17, COCO_WHOLEBODY_133, MEDIAPIPE_33, OPENPOSE_67, mirrored_name

ATOL = 2e-6  # metres, float32
SYMMETRY = 0.004  # metres: the shipped body's feet are not quite mirror images
COARSER = 0.015  # metres: how far a vertex of a quarter of the mesh is from the best of the whole one


def at_rest(model):
    joints = len(model.parents)
    return np.asarray(pose_landmarks(model, jnp.zeros(0), BodyPose(jnp.zeros((joints, 3)), jnp.zeros(3)))[0])


@pytest.mark.parametrize("kind", [COCO_17, COCO_WHOLEBODY_133, OPENPOSE_67], ids=lambda kind: kind.name)
def test_the_shipped_body_has_all_but_most_of_the_face(body, kind):
    model = landmark_model(body, kind.names)
    missing = {name for name, known in zip(kind.names, model.known, strict=True) if not known}
    assert missing == {n for n in kind.names if n.startswith("face_")} - {"face_8", "face_27", "face_30"}
    sums = np.asarray(model.regressor).sum(1)
    np.testing.assert_allclose(sums, np.asarray(model.known, float), atol=1e-6)


@pytest.fixture(scope="module")
def bent():
    """A pose whose left elbow is bent by a right angle, to the front; the body stands where it stood."""
    rotations = np.zeros((55, 3), np.float32)
    rotations[JOINT_NAMES.index("left_elbow")] = 0, -np.pi / 2, 0
    return BodyPose(jnp.asarray(rotations), jnp.zeros(3))


@pytest.mark.parametrize(("joints", "turned"), [(("left_shoulder",), (0.03, 0.02, 0.0)), (("left_elbow",), (0.0, 0.02, 0.03))])
def test_a_place_is_beside_its_joint_and_turns_with_its_bones(body, bent, joints, turned):
    places = (Place("left_elbow", "left_elbow", (0.03, 0.02, 0.0), joints),)
    plain, moved = landmark_model(body, ("left_elbow", "nose")), landmark_model(body, ("left_elbow", "nose"), places)
    for betas in (jnp.zeros(0), jnp.asarray([2.0, -1.0])):
        (a, nose), (b, same) = (pose_landmarks(model, betas, bent)[0] for model in (plain, moved))
        np.testing.assert_allclose(b - a, turned, atol=ATOL)
        np.testing.assert_array_equal(nose, same)


def test_a_place_beside_a_vertex_is_carried_by_the_same_bones(body, bent):
    wrist = landmark_model(body, ("left_index_tip",), (Place("left_index_tip", "left_index_tip", (0.0, 0.01, 0.0)),))
    plain = landmark_model(body, ("left_index_tip",))
    difference = pose_landmarks(wrist, jnp.zeros(0), bent)[0] - pose_landmarks(plain, jnp.zeros(0), bent)[0]
    np.testing.assert_allclose(difference, [[0, 0.01, 0]], atol=ATOL)  # up stays up


def test_places_of_a_body_that_lacks_their_joints_are_ignored(body):
    strange = (Place("left_elbow", "left_elbow", (1.0, 0, 0), ("tail",)), Place("nose", "left_horn", (1.0, 0, 0)))
    names = ("left_elbow", "nose")
    plain, same = landmark_model(body, names), landmark_model(body, names, strange)
    np.testing.assert_array_equal(at_rest(plain), at_rest(same))


def test_the_shipped_body_has_every_landmark_of_our_detector(body):
    model = landmark_model(body, MEDIAPIPE_33.names, MEDIAPIPE_33.places)
    assert all(model.known)
    points = dict(zip(MEDIAPIPE_33.names, at_rest(model), strict=True))
    for name, point in points.items():
        assert np.linalg.norm(point - points[mirrored_name(name)] * [-1, 1, 1]) < SYMMETRY, name


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
    pose = BodyPose(jnp.asarray(rng.normal(0, 0.4, (55, 3)), jnp.float32), jnp.asarray([0.3, -0.2, 1.0]))
    landmarks, joints = pose_landmarks(model, betas, pose)
    posed = jax.jit(lambda b, s, p: pose_body(b, shape_body(b, s), p))(body, betas, pose)
    np.testing.assert_allclose(joints, posed.joints, atol=ATOL)
    vertices = np.asarray(posed.vertices)
    for name, found in zip(names[:3], np.asarray(landmarks), strict=False):
        assert np.linalg.norm(vertices - found, axis=1).min() < bound(ATOL), name
    shoulders = [JOINT_NAMES.index(f"{side}_shoulder") for side in ("left", "right")]
    np.testing.assert_allclose(landmarks[4], joints[np.asarray(shoulders)].mean(0), atol=ATOL)
    np.testing.assert_array_equal(landmarks[3], joints[JOINT_NAMES.index("left_knee")])
    np.testing.assert_array_equal(landmarks[6], 0.0)


def test_left_and_right_are_mirror_images(body):
    names = tuple(n for n in COCO_WHOLEBODY_133.names if n.startswith(("left_", "right_")))
    points = dict(zip(names, at_rest(landmark_model(body, names)), strict=True))
    for name, point in points.items():
        mirrored = points[mirrored_name(name)] * [-1, 1, 1]
        assert np.linalg.norm(point - mirrored) < SYMMETRY, name
        assert point[0] > 0 if name.startswith("left_") else point[0] < 0, name


def test_where_the_surface_landmarks_are(body):
    names = ("nose", "face_27", "face_8", "left_ear", "left_big_toe", "left_small_toe", "left_heel", "left_ankle", "left_eye")
    at = dict(zip(names, at_rest(landmark_model(body, names)), strict=True))
    height, depth = 1, 2
    assert at["face_27"][height] > at["nose"][height] > at["face_8"][height]
    assert at["nose"][depth] > max(at["face_27"][depth], at["face_8"][depth]) > at["left_ear"][depth]
    assert at["left_small_toe"][0] > at["left_ankle"][0] > at["left_big_toe"][0]
    assert at["left_big_toe"][depth] > at["left_small_toe"][depth] > at["left_ankle"][depth] > at["left_heel"][depth]


def test_a_coarser_mesh_has_them_nearly_where_the_whole_one_has_them(body):
    names = OPENPOSE_67.names
    whole, coarse = (at_rest(landmark_model(b, names)) for b in (body, decimate(body, len(body.template) // 4)))
    assert np.linalg.norm(whole - coarse, axis=1).max() < COARSER


def test_movers_are_the_joints_that_move_a_landmark(body):
    model = landmark_model(body, ("left_wrist", "nose"))
    moved = {JOINT_NAMES[j] for j in model.movers}
    chain = {"pelvis", "spine1", "spine2", "spine3", "left_collar", "left_shoulder", "left_elbow", "neck", "head"}
    assert chain <= moved <= chain | {"jaw"}


def test_joints_of_other_names_are_refused(body):
    strange = dataclasses.replace(body, joint_names=tuple(f"bone{j}" for j in range(55)))
    with pytest.raises(ValueError, match=r"none of these landmarks.*bone0"):
        landmark_model(strange, COCO_17.names)
