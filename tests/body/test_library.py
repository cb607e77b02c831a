"""The shipped body, and files of bodies in the package's format."""

import itertools
from importlib import resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from body_cases import areas, is_closed, made_up_body, signed_volume
from scipy.spatial import cKDTree

from humangs_jax.body import library
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.core.pytree import replace

MEGABYTE = 1e6
# metres: MakeHuman's targets are written with 0.1 mm and differ between the sides by a few
SYMMETRY = 1e-3
# metres and weights: half a step of int16 or uint16, and the division by a sum of 7 rounded weights
STORED = 3e-5


@pytest.fixture(scope="module")
def joints(body):
    return dict(zip(JOINT_NAMES, np.asarray(shape_body(body, jnp.zeros(1)).joints), strict=True))


def test_sizes(body):
    assert body.template.shape == (13380, 3) and body.faces.shape == (26756, 3)
    assert body.joint_names == JOINT_NAMES and body.parents == PARENTS
    assert len(JOINT_NAMES) == len(PARENTS) == 55
    assert [JOINT_NAMES[i] for i in (25, 28, 31, 34, 39, 40, 54)] == [
        *(
            "left_index1",
            "left_middle1",
            "left_pinky1",
            "left_ring1",
            "left_thumb3",
            "right_index1",
            "right_thumb3",
        )
    ]
    assert [PARENTS[i] for i in (25, 26, 27, 28, 40, 41, 22)] == [20, 25, 26, 20, 21, 40, 15]
    assert len(body.shape_names) == body.shape_directions.shape[-1] >= 10
    assert {"sex_male", "age", "weight", "muscle", "height", "leg_length", "head_size"} <= set(
        body.shape_names
    )
    assert body.template.dtype == jnp.float32
    assert (
        resources.files("humangs_jax") / "assets" / "makehuman.npz"
    ).stat().st_size < 3 * MEGABYTE
    assert "CC0" in (resources.files("humangs_jax") / "assets" / "makehuman.LICENSE.md").read_text()


def test_a_person_of_ordinary_size_in_t_pose(body, joints):
    height = np.ptp(np.asarray(body.template)[:, 1])
    assert 1.5 < height < 1.8
    assert np.allclose(joints["pelvis"], [0, -0.35, 0], atol=STORED)
    assert joints["left_foot"][2] > joints["left_ankle"][2] + 0.05  # toes point to +z
    assert joints["left_eye"][2] > joints["head"][2] + 0.03
    for left in (name for name in JOINT_NAMES if name.startswith("left_")):
        assert joints[left][0] > 0
    for arm in ("left_elbow", "left_wrist", "left_middle1"):
        assert np.allclose(joints[arm][1:], joints["left_shoulder"][1:], atol=SYMMETRY)
    order = ("left_ankle", "left_knee", "pelvis", "spine1", "spine2", "spine3", "neck", "head")
    assert all(joints[a][1] < joints[b][1] for a, b in itertools.pairwise(order))
    soles = np.asarray(body.template)[np.asarray(body.skinning_weights)[:, 7] > 0.5]
    heel, toe = soles[soles[:, 2] < -0.02, 1].min(), soles[soles[:, 2] > 0.03, 1].min()
    assert abs(heel - toe) < 0.02


def test_left_and_right_mirror_each_other(body, joints):
    mirror = np.asarray([-1, 1, 1])
    template = np.asarray(body.template)
    distance, twin = cKDTree(template).query(template * mirror)
    # The rig weights the two elbows a little differently, which shows after the arms are raised.
    assert distance.max() < 5 * SYMMETRY and np.quantile(distance, 0.99) < SYMMETRY / 2
    directions = np.asarray(body.shape_directions)
    difference = np.abs(directions[twin] - directions * mirror[:, None]).max(axis=(0, 1))
    assert difference.max() < 5 * SYMMETRY  # per unit of a coefficient
    for left, right in (
        (n, n.replace("left", "right")) for n in JOINT_NAMES if n.startswith("left_")
    ):
        assert np.allclose(joints[left] * mirror, joints[right], atol=SYMMETRY)


def test_skinning_weights_and_regressor_are_averages(body):
    for weights in (np.asarray(body.skinning_weights), np.asarray(body.joint_regressor)):
        assert weights.min() >= 0
        assert np.allclose(weights.sum(1), 1, atol=1e-6)
    assert (np.asarray(body.skinning_weights) > 0).sum(1).max() <= 6
    assert np.asarray(body.skinning_weights)[:, 22:25].max() == 0  # jaw and eyes hang on the head
    assert (np.asarray(body.joint_regressor) > 0).sum(1).max() <= 32


def test_the_surface_is_closed_and_faces_outwards(body):
    faces, template = np.asarray(body.faces), np.asarray(body.template)
    assert is_closed(faces)
    assert np.unique(faces).size == len(template)
    assert areas(template, faces).min() > 0
    assert 0.045 < signed_volume(template, faces) < 0.07  # m^3: positive for outward normals; 55 kg
    uvs = np.asarray(body.uvs)
    assert uvs.min() >= 0 and uvs.max() <= 1
    assert body.uv_faces.shape == faces.shape and np.asarray(body.uv_faces).max() == len(uvs) - 1


def test_shapes_are_plausible_people_and_keep_the_pelvis(body):
    faces, shaped = np.asarray(body.faces), jax.jit(shape_body)
    height = lambda rest: float(np.ptp(np.asarray(rest.vertices)[:, 1]))
    rests = {}
    for i, name in enumerate(body.shape_names):
        for sign in (-2.0, 2.0):
            rest = rests[name, sign] = shaped(
                body, jnp.zeros(len(body.shape_names)).at[i].set(sign)
            )
            assert 1.45 < height(rest) < 1.9, name
            assert 0.035 < signed_volume(rest.vertices, faces) < 0.1, name
            assert np.allclose(rest.joints[0], [0, -0.35, 0], atol=6e-3), name
            assert np.ptp(np.asarray(rest.joints)[[16, 18, 20], 1]) < 0.02, name  # still a T-pose
    assert height(rests["height", 2.0]) > height(rests["height", -2.0]) + 0.12
    legs = [
        float(rests["leg_length", sign].joints[1, 1] - rests["leg_length", sign].joints[7, 1])
        for sign in (-2.0, 2.0)
    ]
    assert legs[1] > legs[0] + 0.12


def test_limbs_bend_the_way_smplx_limbs_do(body, joints):
    pose = jax.jit(
        lambda rotations: pose_body(
            body, shape_body(body, jnp.zeros(1)), BodyPose(rotations, jnp.zeros(3))
        )
    )

    def posed(**rotations):
        vectors = np.zeros((55, 3), np.float32)
        for name, rotation in rotations.items():
            vectors[JOINT_NAMES.index(name)] = rotation
        return pose(vectors)

    wrist = np.asarray(posed(left_elbow=(0, -np.pi / 2, 0)).joints[20])
    assert (
        wrist[2] > joints["left_elbow"][2] + 0.15 and abs(wrist[0] - joints["left_elbow"][0]) < 0.02
    )
    # the heel goes back
    assert posed(right_knee=(np.pi / 2, 0, 0)).joints[8, 2] < joints["right_knee"][2] - 0.3
    arms = posed(left_shoulder=(0, 0, -1.2), right_shoulder=(0, 0, 1.2))
    assert np.asarray(arms.joints)[[20, 21], 1].max() < joints["left_shoulder"][1] - 0.3
    turned, template = posed(head=(0, 0.8, 0)), np.asarray(body.template)
    face = np.where(np.asarray(body.skinning_weights)[:, 15] > 0.9, template[:, 2], -1)
    # the nose goes towards the person's left
    assert turned.vertices[int(np.argmax(face)), 0] > 0.04
    assert np.allclose(turned.vertices[template[:, 1] < 0], template[template[:, 1] < 0], atol=1e-5)


def test_own_files_keep_a_body(tmp_path):
    body = made_up_body(1, pose_directions=False, dtype=np.float32)
    body = replace(
        body,
        uvs=jnp.asarray(np.random.default_rng(0).uniform(size=(12, 2)), jnp.float32),
        uv_faces=jnp.asarray(
            np.random.default_rng(1).integers(0, 12, size=body.faces.shape), jnp.int32
        ),
        joint_names=tuple("abcdefg"),
        shape_names=tuple("pqrs"),
        shape_directions=body.shape_directions / 4,
        name="someone",
    )
    library.save_body(tmp_path / "body.npz", body)
    again = load_body(tmp_path / "body.npz")
    assert jax.tree.structure(again) == jax.tree.structure(body)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(body), strict=True):
        assert a.dtype == b.dtype
        assert np.abs(np.asarray(a, np.float64) - b).max() < STORED
    large = replace(body, shape_directions=body.shape_directions * 1000)
    library.save_body(tmp_path / "large.npz", large)
    assert np.allclose(load_body(tmp_path / "large.npz").shape_directions, large.shape_directions)


def test_what_cannot_be_stored_or_read_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="pose directions"):
        library.save_body(tmp_path / "body.npz", made_up_body())
    library.save_body(tmp_path / "body.npz", made_up_body(pose_directions=False))
    arrays = dict(np.load(tmp_path / "body.npz"))
    del arrays["template"]
    np.savez(tmp_path / "part.npz", **arrays)
    with pytest.raises(ValueError, match=r"part\.npz: key 'template' is missing"):
        load_body(tmp_path / "part.npz")
    np.savez(tmp_path / "pickled.npz", uvs=np.asarray([None]), **arrays)
    with pytest.raises(ValueError, match=r"pickled\.npz: key 'uvs' cannot be read without pickles"):
        load_body(tmp_path / "pickled.npz")
    np.savez(tmp_path / "newer.npz", **{**arrays, "format": np.asarray("humangs-body-9")})
    with pytest.raises(ValueError, match=r"newer\.npz: not a 'humangs-body-1' file"):
        load_body(tmp_path / "newer.npz")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_body(tmp_path / "nowhere.npz")
    for arguments, words in (((), "to the shipped body"), ((tmp_path / "body.npz",), "body.npz")):
        with pytest.raises(TypeError, match=f"{words}.*shape_count"):
            load_body(*arguments, shape_count=3)
