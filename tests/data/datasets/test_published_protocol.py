"""The published protocol against independent computations.

Tested are alignment, cameras, splits and indices of the evaluation.
"""

import random

import numpy as np
import pytest
from dataset_files import (
    VERTICES,
    fit_values,
    model_arrays,
    scan_vertices,
    write_model,
    write_thuman,
)
from hypothesis import example, given
from hypothesis import strategies as st

from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.preprocess import protocol
from humangs_jax.data.preprocess.run import PreprocessConfig, scan_content

PUBLISHED = 2e-4
"""Largest error that the arrays may have, as a share of the body's size."""
UP = np.asarray([0.0, 1.0, 0.0])
vectors = (
    st.lists(st.floats(-1, 1), min_size=3, max_size=3)
    .map(np.asarray)
    .filter(lambda v: np.linalg.norm(v) > 1e-3)
)


@given(vectors, vectors)
@example(-UP, UP)
def test_the_smallest_rotation_turns_one_direction_into_the_other(start, end):
    R = protocol.smallest_rotation(start, end)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) > 0
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    np.testing.assert_allclose(R @ a, b, atol=1e-7)
    # smallest: its angle is that between the two
    assert np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)) == pytest.approx(
        np.arccos(np.clip(a @ b, -1, 1)), abs=1e-5
    )


def test_cameras_look_at_the_origin_from_the_protocols_ranges():
    cameras = protocol.scan_cameras(7, 2.0, 400, (1.0, 1.75))
    R, t = cameras[:, :3, :3], cameras[:, :3, 3]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (400, 1, 1)), atol=1e-12
    )
    assert (np.linalg.det(R) > 0).all() and (R[:, 1, 1] < 0).all()  # rows of the image go down
    np.testing.assert_allclose(t[:, :2], 0, atol=1e-12)
    assert 2.0 <= t[:, 2].min() < 2.05 and 3.45 < t[:, 2].max() <= 3.5
    centers = -np.einsum("vji,vj->vi", R, t)
    elevations = np.rad2deg(np.arcsin(centers[:, 1] / np.linalg.norm(centers, axis=1)))
    assert -5 <= elevations.min() < -4.5 and 14.5 < elevations.max() <= 15
    quarters = np.histogram(np.arctan2(centers[:, 0], centers[:, 2]), 4, (-np.pi, np.pi))[0]
    assert quarters.min() > 70
    np.testing.assert_array_equal(cameras, protocol.scan_cameras(7, 2.0, 400, (1.0, 1.75)))
    near = protocol.scan_cameras(7, 2.0, 10, protocol.NEAR_FACTORS)
    np.testing.assert_allclose(near[:, 2, 3], 4.0)
    focal = protocol.intrinsics(512)[1, 1]
    assert 2 * np.rad2deg(np.arctan(256 / focal)) == pytest.approx(60)


def test_the_split_is_that_of_numpys_seed_42():
    # what np.random.seed(42), np.random.shuffle(list of 10) make of 0 .. 9 (numpy's legacy
    # generator, frozen by NEP 19)
    assert protocol.split_ids(range(10), 6, 3) == ([8, 1, 5, 0, 7, 2], [9, 4, 3])
    names = [f"{i:04d}" for i in range(2445)]
    train, test = protocol.split_ids(names[::-1])  # in any order
    shuffled = list(names)
    np.random.RandomState(42).shuffle(shuffled)
    assert (train, test) == (shuffled[:2300], shuffled[2300:])


def test_evaluation_indices_are_those_of_pythons_seed_777():
    counts = {"b": 60, "a": 48, "c": 60}  # the order of the file
    found = protocol.evaluation_indices(counts, 4)
    state = random.getstate()
    random.seed(777)
    for name, count in counts.items():
        context = sorted(random.sample(range(count), 4))
        target = sorted(random.sample([i for i in range(count) if i not in context], 4))
        assert found[name] == {"context": context, "target": target}
    random.setstate(state)
    with pytest.raises(ValueError, match="7 views, but 4 inputs and 4 targets"):
        protocol.evaluation_indices({"a": 7}, 4)


def test_preprocessing_reproduces_the_published_arrays(tmp_path):
    """Expected arrays follow SMPL-X's equations joint by joint and the protocol step by step."""
    arrays, body = model_arrays(), write_model(tmp_path)
    folder = write_thuman(tmp_path / "thuman", arrays)
    for i, (name, kind) in enumerate(zip(open_thuman(folder)[0], "ABC", strict=True)):
        content = scan_content(folder, name, body, PreprocessConfig("thuman"))
        assert content.known["fit_kind"] == kind and content.known["fit_error_mm"][1] < 0.01
        rest, mesh, transforms = scan_vertices(arrays, fit_values(kind, i))
        # T: the middle of the raw scan's bounding box, here that of the mesh; R: pelvis -> neck
        # upright
        T, R = np.eye(4), np.eye(4)
        T[:3, 3] = -(mesh.min(0) + mesh.max(0)) / 2
        # joint j is vertex j here
        posed_joints = np.stack([(transforms[j] @ [*rest[j], 1])[:3] for j in (0, 12)])
        spine = posed_joints[1] - posed_joints[0]
        axis, angle = np.cross(spine, UP), np.arccos(spine[1] / np.linalg.norm(spine))
        x, y, z = axis / np.linalg.norm(axis)
        cross = np.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        R[:3, :3] = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        mesh_transform = R @ T
        bound = PUBLISHED * content.scale
        np.testing.assert_allclose(content.transform, mesh_transform, atol=bound)
        (posed,) = content.posed
        v_posed = mesh @ mesh_transform[:3, :3].T + mesh_transform[:3, 3]
        found = posed.vertices @ content.transform[:3, :3].T + content.transform[:3, 3]
        assert len(found) == VERTICES
        np.testing.assert_allclose(found, v_posed, atol=bound)
        np.testing.assert_allclose(posed.rest, rest, atol=bound)
        np.testing.assert_allclose(
            content.transform @ posed.joint_transforms, mesh_transform @ transforms, atol=bound
        )
        radius = np.linalg.norm(mesh @ R[:3, :3].T + mesh_transform[:3, 3], axis=1).max()
        assert content.known["radius"] >= radius - bound  # of the scan: a box around the body


def test_another_body_or_another_kind_of_fit_is_noticed_by_its_mesh(tmp_path):
    arrays = model_arrays()
    folder = write_thuman(tmp_path / "thuman", arrays)
    (tmp_path / "other").mkdir()
    other = write_model(tmp_path / "other", seed=1)
    with pytest.raises(
        ValueError,
        match=r"mesh_smplx.obj: the fit \(kind A\) is .* mm from this mesh on average.*male",
    ):
        scan_content(folder, "0000", other, PreprocessConfig("thuman"))
    with pytest.raises(ValueError, match=r"kind C.*neutral"):
        scan_content(folder, "0002", other, PreprocessConfig("thuman"))
