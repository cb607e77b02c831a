import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.fitting.files import save_scan_fit
from humangs_jax.fitting.residuals.scan import body_surface
from humangs_jax.fitting.scan_files import checked_joints, read_joints, sample_scan
from humangs_jax.fitting.scan_fit import body_in_scan, fit_scan
from humangs_jax.fitting.scan_search import ScanFitConfig, Start, facing_back, search_starts
from humangs_jax.fitting.similarity import Similarity
from humangs_jax.fitting.state import pose_prior
from humangs_jax.io.npz import read_npz
from humangs_jax.rendering.mesh.position_map import vertex_normals

LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
NAMES = ("nose", "left_ear", "right_ear", *(f"{side}_{part}" for part in LIMBS for side in ("left", "right")))
QUICK = ScanFitConfig(samples=8000, points=700)


@pytest.fixture(scope="module")
def truth(body):
    """A person's vertices in a pose, normals and landmarks, metres; and the similarity to the scan's coordinates."""
    rng = np.random.default_rng(5)
    prior = pose_prior(body.joint_names)
    rotations = np.clip(prior.mean + 0.4 * prior.std * rng.normal(size=(55, 3)), prior.lower, prior.upper)
    rotations[0] = 0
    pose = BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros(3))
    betas = jnp.asarray(rng.normal(0, 0.4, 22), jnp.float32)
    model = landmark_model(body, NAMES)

    @jax.jit
    def posed(betas, pose):
        vertices = pose_body(body, shape_body(body, betas), pose).vertices
        return vertices, vertex_normals(vertices, body.faces), pose_landmarks(model, betas, pose)[0]

    vertices, normals, landmarks = (np.asarray(x, np.float64) for x in posed(betas, pose))
    place = Similarity(40.0, Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix(), np.asarray([300.0, -20.0, 7.0]))
    return vertices, normals, landmarks, place


def given_joints(truth):
    _, _, landmarks, place = truth
    noise = np.random.default_rng(6).normal(0, 0.005, landmarks.shape)
    return dict(zip(NAMES, place(landmarks + noise), strict=True))


def written(path, vertices, body, place):
    trimesh.Trimesh(place(vertices), np.asarray(body.faces), process=False).export(path)
    return path


def off(fit, truth, millimetres=1000):
    """Distances of equal vertices in metres of the truth, in millimetres."""
    return millimetres * np.linalg.norm(truth[3].inverse()(body_in_scan(fit)) - truth[0], axis=1)


@pytest.fixture(scope="module")
def bare(tmp_path_factory, body, truth):
    path = written(tmp_path_factory.mktemp("bare") / "bare.ply", truth[0], body, truth[3])
    return fit_scan(path, body=body, joints=given_joints(truth), clothed=False, config=QUICK)


@pytest.mark.slow
def test_a_bare_body_is_found_whatever_its_scale_turn_and_place(bare, truth):
    assert off(bare, truth).mean() < 8
    assert np.quantile(np.abs(bare.distances), 0.9) < 0.003
    report = bare.report
    assert report.errors["scan_near_body"].after > 0.97 and report.ok and report.stages[-1].converged
    assert abs(report.errors["scan_outside_median_mm"].after) < 1.5
    assert "given joints" in str(report)


@pytest.mark.slow
def test_the_result_stands_in_our_world(bare, truth):
    scan = bare.world_from_scan(truth[3](truth[0]))
    assert scan[:, 1].min() == pytest.approx(0, abs=0.01)
    assert 1.3 < np.ptp(scan[:, 1]) < 2.2
    root = Rotation.from_rotvec(np.asarray(bare.pose.rotations[0])).as_matrix()
    assert root[1, 1] > 0.9  # upright
    assert root[2, 2] > 0.9  # facing +z


@pytest.mark.slow
def test_clothes_are_outside(body, truth, tmp_path):
    """A layer of 15 mm that leaves the hands bare: the body is found under it, not in it."""
    surface = body_surface(body, NAMES, 13380)
    layer = 0.015 * np.asarray(surface.covered)[:, None]
    path = written(tmp_path / "dressed.ply", truth[0] + layer * truth[1], body, truth[3])
    fit = fit_scan(path, body=body, joints=given_joints(truth), clothed=True, config=QUICK)
    inside = np.einsum("na,na->n", truth[3].inverse()(body_in_scan(fit)) - truth[0], truth[1])[layer[:, 0] > 0.014]
    assert np.median(inside) < 0.010
    assert np.median(fit.distances) > 0


@pytest.mark.slow
def test_results_are_written_whole(bare, truth, tmp_path):
    save_scan_fit(tmp_path / "fit", bare)
    arrays, pickled = read_npz(tmp_path / "fit" / "body.npz")
    assert arrays["rotations"].shape == (1, 55, 3) and arrays["translations"].shape == (1, 3) and not pickled
    report = json.loads((tmp_path / "fit" / "scan_fit.json").read_text())
    np.testing.assert_allclose(report["world_from_scan"], bare.world_from_scan.matrix())
    assert (
        report["fitted"] == "scan"
        and report["start"] == "landmarks"
        and report["errors"] == bare.report.to_json()["errors"]
    )
    mesh = trimesh.load(tmp_path / "fit" / "body_in_scan.ply", process=False)
    np.testing.assert_allclose(mesh.vertices, body_in_scan(bare), rtol=1e-4)
    with pytest.raises(ValueError, match="not empty"):
        save_scan_fit(tmp_path / "fit", bare)


def test_joints_are_read_from_both_formats(tmp_path):
    joints = {"left_hip": [1.0, 2.0, 3.0], "nose": [0.0, 1e6, -1.0]}
    (tmp_path / "joints.json").write_text(json.dumps(joints))
    np.savez(tmp_path / "joints.npz", names=list(joints), points=list(joints.values()))
    for name in ("joints.json", "joints.npz"):
        read = read_joints(tmp_path / name)
        assert {key: value.tolist() for key, value in read.items()} == joints


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"left_hip": [1, 2]}', "three finite"),
        ('{"hip": [1, 2, 3]}', "'hip' is no landmark"),
        ("[]", "expected"),
        ("{}", "no joints"),
    ],
)
def test_what_are_no_joints_is_refused(tmp_path, content, message):
    (tmp_path / "joints.json").write_text(content)
    with pytest.raises(ValueError, match=message) as error:
        read_joints(tmp_path / "joints.json")
    assert "joints.json" in str(error.value)


def test_joints_that_do_not_suffice_are_refused(body, truth, tmp_path):
    path = written(tmp_path / "bare.ply", truth[0], body, truth[3])
    some = {name: point for name, point in given_joints(truth).items() if name in ("left_hip", "nose")}
    with pytest.raises(ValueError, match="at least three points"):
        fit_scan(path, body=body, joints=some, config=QUICK)
    with pytest.raises(ValueError, match="height 170"):
        fit_scan(path, body=body, joints=some, height=170.0, config=QUICK)


def test_joints_are_put_in_order():
    points, known = checked_joints({"nose": [1, 2, 3]})
    assert known.sum() == 1 and points[known > 0].tolist() == [[1, 2, 3]]


@pytest.mark.slow
def test_the_search_has_the_turn_and_the_scale_among_its_starts(body, truth):
    vertices, _, _, place = truth
    surface = body_surface(body, ("nose",), 1500)
    starts = search_starts(surface, sample_scan(place(vertices), np.asarray(body.faces), 4000), 8)
    angles = [np.degrees(np.arccos((np.trace(s.align.rotation @ place.rotation) - 1) / 2)) for s in starts]
    best = starts[int(np.argmin(angles))]
    assert min(angles) < 30
    assert best.align.scale * place.scale == pytest.approx(1, abs=0.2)
    assert [s.cost for s in starts] == sorted(s.cost for s in starts)


def test_facing_back_twice_is_facing_forward(body):
    surface = body_surface(body, ("nose",), 1500)
    prior = pose_prior(body.joint_names)
    rotations, pelvis = np.clip(0 * prior.mean, prior.lower, prior.upper), np.asarray(surface.landmarks.joints[0])
    start = Start(Similarity(2.0, np.eye(3), np.asarray([0.1, 0.2, 0.3])), rotations, 0.0)
    once = facing_back(surface, start, rotations, pelvis, 1.0)
    twice = facing_back(surface, once, rotations, pelvis, 1.0)
    points = np.random.default_rng(0).normal(size=(4, 3))
    assert np.abs(once.align(points) - start.align(points)).max() > 0.1
    np.testing.assert_allclose(twice.align(points), start.align(points), atol=1e-5)
