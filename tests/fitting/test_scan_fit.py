import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.data.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.data.photos import load_photos
from humangs_jax.fitting import scan_fit
from humangs_jax.fitting.files import save_scan_fit
from humangs_jax.fitting.residuals.scan import (
    Given,
    ScanMatches,
    Tolerances,
    body_surface,
    one_sided,
    pose_surface,
    pose_vertices,
    scan_problem,
    scan_residuals,
)
from humangs_jax.fitting.scan_files import (
    SCAN_LANDMARKS,
    Scan,
    checked_joints,
    joints_from_views,
    read_joints,
    read_mesh,
    read_scan,
    render_scan_views,
    sample_scan,
)
from humangs_jax.fitting.scan_fit import (
    Start,
    body_in_scan,
    facing_back,
    fit_scan,
    search_starts,
    start_state,
)
from humangs_jax.fitting.state import pose_prior
from humangs_jax.fitting.triangulation import Similarity
from humangs_jax.geometry.camera import project
from humangs_jax.io.arrays import read_npz
from humangs_jax.io.mesh import GREY
from humangs_jax.rendering.mesh.rasterizer import vertex_normals

LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
NAMES = (
    "nose",
    "left_ear",
    "right_ear",
    *(f"{side}_{part}" for part in LIMBS for side in ("left", "right")),
)


@pytest.fixture(scope="module", autouse=True)
def few_points():
    with pytest.MonkeyPatch.context() as quick:
        quick.setattr(scan_fit, "FINE_POINTS", 700)
        quick.setattr(scan_fit, "read_scan", lambda path: read_scan(path, 8000))
        yield


@pytest.fixture(scope="module")
def truth(body):
    """A person's vertices in a pose, normals and landmarks, metres; and the similarity to the
    scan's coordinates.
    """
    rng = np.random.default_rng(5)
    prior = pose_prior(body.joint_names)
    rotations = np.clip(
        prior.mean + 0.4 * prior.std * rng.normal(size=(55, 3)), prior.lower, prior.upper
    )
    rotations[0] = 0
    pose = BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros(3))
    betas = jnp.asarray(rng.normal(0, 0.4, 22), jnp.float32)
    model = landmark_model(body, NAMES)

    @jax.jit
    def posed(betas, pose):
        vertices = pose_body(body, shape_body(body, betas), pose).vertices
        return vertices, vertex_normals(vertices, body.faces), pose_landmarks(model, betas, pose)[0]

    vertices, normals, landmarks = (np.asarray(x, np.float64) for x in posed(betas, pose))
    place = Similarity(
        40.0, Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix(), np.asarray([300.0, -20.0, 7.0])
    )
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
    return fit_scan(path, body=body, joints=given_joints(truth), clothed=False)


def test_a_body_that_the_last_round_still_moved_is_said_to():
    points = np.eye(3)
    scan = Scan(points, points, False, 0.0)
    moving = lambda *costs: (
        "still moving"
        in str(scan_fit._report(scan, False, 1.0, "y", points[0], 1.0, jnp.asarray(costs)))
    )
    assert moving(1.0, 0.9) and not moving(1.0, 0.99) and not moving(0.0, 0.0)


@pytest.mark.slow
def test_a_bare_body_is_found_whatever_its_scale_turn_and_place_and_stands_in_our_world(
    bare, truth
):
    assert off(bare, truth).mean() < 8
    assert np.quantile(np.abs(bare.distances), 0.9) < 0.003
    report = bare.report
    assert (
        report.errors["scan_near_body"].after > 0.97
        and report.ok
        and "still moving" not in str(report)
    )
    assert abs(report.errors["scan_outside_median_mm"].after) < 1.5
    assert "given joints" in str(report)
    scan = bare.world_from_scan(truth[3](truth[0]))
    assert scan[:, 1].min() == pytest.approx(0, abs=0.01) and 1.3 < np.ptp(scan[:, 1]) < 2.2
    root = Rotation.from_rotvec(np.asarray(bare.pose.rotations[0])).as_matrix()
    assert root[1, 1] > 0.9 and root[2, 2] > 0.9  # upright, facing +z


@pytest.mark.slow
def test_clothes_are_outside(body, truth, tmp_path):
    """A layer of 15 mm that leaves the hands bare: the body is found under it, not in it."""
    surface = body_surface(body, NAMES, 13380)
    layer = 0.015 * np.asarray(surface.covered)[:, None]
    path = written(tmp_path / "dressed.ply", truth[0] + layer * truth[1], body, truth[3])
    fit = fit_scan(path, body=body, joints=given_joints(truth), clothed=True)
    inside = np.einsum("na,na->n", truth[3].inverse()(body_in_scan(fit)) - truth[0], truth[1])[
        layer[:, 0] > 0.014
    ]
    assert np.median(inside) < 0.010
    assert np.median(fit.distances) > 0


@pytest.mark.slow
def test_results_are_written_whole(bare, tmp_path):
    save_scan_fit(tmp_path / "fit", bare)
    arrays, pickled = read_npz(tmp_path / "fit" / "body.npz")
    assert (
        arrays["rotations"].shape == (1, 55, 3)
        and arrays["translations"].shape == (1, 3)
        and not pickled
    )
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


def test_joints_are_read_from_both_formats_and_put_in_order(tmp_path):
    joints = {"left_hip": [1.0, 2.0, 3.0], "nose": [0.0, 1e6, -1.0]}
    (tmp_path / "joints.json").write_text(json.dumps(joints))
    np.savez(tmp_path / "joints.npz", names=list(joints), points=list(joints.values()))
    for name in ("joints.json", "joints.npz"):
        read = read_joints(tmp_path / name)
        assert {key: value.tolist() for key, value in read.items()} == joints
    points, known = checked_joints(joints)
    assert known.sum() == 2 and points[SCAN_LANDMARKS.index("nose")].tolist() == joints["nose"]


def test_what_are_no_joints_or_too_few_is_refused(body, truth, tmp_path):
    for content, message in (
        ('{"left_hip": [1, 2]}', "three finite"),
        ('{"hip": [1, 2, 3]}', "'hip' is no landmark"),
        ("[]", "expected"),
        ("{}", "three at least"),
    ):
        (tmp_path / "joints.json").write_text(content)
        with pytest.raises(ValueError, match=rf"joints\.json.*{message}"):
            read_joints(tmp_path / "joints.json")
    path = written(tmp_path / "bare.ply", truth[0], body, truth[3])
    some = {
        name: point for name, point in given_joints(truth).items() if name in ("left_hip", "nose")
    }
    with pytest.raises(ValueError, match="at least three points"):
        fit_scan(path, body=body, joints=some)
    with pytest.raises(ValueError, match="height 170"):
        fit_scan(path, body=body, joints=some, height=170.0)


@pytest.mark.slow
def test_the_search_has_the_turn_and_the_scale_among_its_starts(body, truth):
    vertices, _, _, place = truth
    surface = body_surface(body, ("nose",), 1500)
    starts = search_starts(surface, sample_scan(place(vertices), np.asarray(body.faces), 4000), 8)
    angles = [
        np.degrees(np.arccos((np.trace(s.align.rotation @ place.rotation) - 1) / 2)) for s in starts
    ]
    best = starts[int(np.argmin(angles))]
    assert min(angles) < 30
    assert best.align.scale * place.scale == pytest.approx(1, abs=0.2)
    assert [s.cost for s in starts] == sorted(s.cost for s in starts)


def test_facing_back_twice_is_facing_forward(body):
    surface = body_surface(body, ("nose",), 1500)
    prior = pose_prior(body.joint_names)
    rotations, pelvis = (
        np.clip(0 * prior.mean, prior.lower, prior.upper),
        np.asarray(surface.landmarks.joints[0]),
    )
    start = Start(Similarity(2.0, np.eye(3), np.asarray([0.1, 0.2, 0.3])), rotations, 0.0)
    once = facing_back(surface, start, rotations, pelvis, 1.0)
    twice = facing_back(surface, once, rotations, pelvis, 1.0)
    points = np.random.default_rng(0).normal(size=(4, 3))
    assert np.abs(once.align(points) - start.align(points)).max() > 0.1
    np.testing.assert_allclose(twice.align(points), start.align(points), atol=1e-5)


# Scans from files, and images of scans
# --------------------------------------------------------------------------------


def sphere(radius=1.0, subdivisions=3):
    return trimesh.creation.icosphere(subdivisions, radius)


@pytest.mark.parametrize("turned", [False, True])
def test_points_lie_on_the_surface_with_normals_outwards_even_if_faces_are_inside_out(turned):
    scan = sample_scan(sphere(2.0).vertices + 7, sphere().faces[:, :: -1 if turned else 1], 500)
    outward = (scan.points - 7) / 2
    assert len(scan.points) > 480 and scan.turned == turned
    assert np.all(np.linalg.norm(outward, axis=1) > 0.98)
    assert np.einsum("pa,pa->p", outward, scan.normals).min() > 0.9


def test_points_are_as_many_per_area():
    wide = trimesh.creation.box((4, 1, 1))
    scan = sample_scan(wide.vertices, wide.faces, 4000)
    assert np.mean(np.abs(scan.normals[:, 0]) > 0.5) == pytest.approx(2 / 18, abs=0.02)


def test_what_nobody_sees_is_left_out():
    inner, outer = sphere(0.8), sphere(1.0)
    both = trimesh.util.concatenate([outer, inner])
    scan = sample_scan(both.vertices, both.faces, 6000)
    assert np.linalg.norm(scan.points, axis=1).min() > 0.95
    assert scan.hidden == pytest.approx(0.64 / 1.64, abs=0.05)


def test_formats_are_read_and_the_same_every_time(tmp_path):
    for suffix in ("obj", "ply", "glb", "stl"):
        sphere(1.5).export(tmp_path / f"ball.{suffix}")
        first, second = (read_scan(tmp_path / f"ball.{suffix}", 300) for _ in range(2))
        assert np.linalg.norm(first.points, axis=1).mean() == pytest.approx(1.5, abs=0.02), suffix
        np.testing.assert_array_equal(first.points, second.points)


def test_parts_of_a_scene_are_where_the_scene_has_them(tmp_path):
    scene = trimesh.Scene()
    move = np.eye(4)
    move[0, 3] = 10
    scene.add_geometry(sphere(), node_name="here")
    scene.add_geometry(sphere(), node_name="there", transform=move)
    scene.export(tmp_path / "two.glb")
    assert np.ptp(read_mesh(tmp_path / "two.glb").vertices[:, 0]) == pytest.approx(12, abs=0.1)


def boxes(folder):
    """Objects and materials in turn, each with its own vertices, quads among triangles; as
    (vertices, faces) and as a file.
    """
    vertices, faces, lines = [], [], ["mtllib boxes.mtl"]
    for i in range(6):
        box = trimesh.creation.box((1, 1, 1)).subdivide()
        box.apply_translation([2.0 * i, 0, 0])
        start = sum(map(len, vertices))
        lines += [
            f"o box{i}",
            f"g part{i}",
            *(f"v {x} {y} {z}" for x, y, z in box.vertices),
            f"usemtl paint{i % 2}",
        ]
        lines += [
            "f " + " ".join(f"{start + corner + 1}" for corner in face) for face in box.faces[:40]
        ]
        lines += ["s off", f"usemtl paint{(i + 1) % 2}"]
        lines += [
            "f " + " ".join(f"{start + corner + 1}" for corner in face) for face in box.faces[40:]
        ]
        vertices.append(box.vertices)
        faces.append(box.faces + start)
    (folder / "boxes.mtl").write_text("newmtl paint0\nKd 1 0 0\nnewmtl paint1\nKd 0 1 0\n")
    (folder / "boxes.obj").write_text("\n".join(lines))
    return np.concatenate(vertices), np.concatenate(faces)


def test_objects_and_materials_in_turn_keep_every_face(tmp_path):
    vertices, faces = boxes(tmp_path)
    triangles = lambda corners: np.sort(np.round(corners.reshape(len(corners), -1), 6), axis=0)
    for colors in (False, True):
        mesh = read_mesh(tmp_path / "boxes.obj", colors=colors)
        np.testing.assert_allclose(
            triangles(mesh.vertices[mesh.faces]), triangles(vertices[faces]), atol=1e-6
        )


def textured(folder, name="skin.png"):
    """A sphere whose texture is red, and named `name` in its material."""
    Image.new("RGB", (4, 4), (255, 0, 0)).save(folder / "skin.png")
    ball = sphere()
    (folder / "ball.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
    lines = ["mtllib ball.mtl", "usemtl skin", *(f"v {x} {y} {z}" for x, y, z in ball.vertices)]
    lines += [f"vt {x / 2 + 0.5} {y / 2 + 0.5}" for x, y, _ in ball.vertices]
    lines += [
        "f " + " ".join(f"{corner + 1}/{corner + 1}" for corner in face) for face in ball.faces
    ]
    (folder / "ball.obj").write_text("\n".join(lines))
    return folder / "ball.obj"


def test_a_scan_has_the_colors_of_its_texture_and_is_grey_with_a_warning_without_it(
    tmp_path, caplog
):
    red = read_mesh(textured(tmp_path), colors=True).visual.vertex_colors
    assert (red == [255, 0, 0, 255]).all() and not caplog.records
    grey = read_mesh(textured(tmp_path, "moved.png"), colors=True).visual.vertex_colors
    assert (grey[:, :3] == GREY).all()
    (record,) = caplog.records
    assert (
        "ball.obj: left out 'moved.png':" in record.getMessage()
        and "no such file" in record.getMessage()
    )


def test_what_is_no_scan_is_refused_by_name(tmp_path):
    ball = sphere()
    (tmp_path / "text.obj").write_text("hello")
    (tmp_path / "rubbish.glb").write_bytes(b"glTF rubbish")
    (tmp_path / "cloud.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    (tmp_path / "triangle.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    broken = ball.vertices.copy()
    broken[3] = np.nan
    trimesh.Trimesh(broken, ball.faces, process=False).export(tmp_path / "nan.ply")
    trimesh.Trimesh(np.zeros_like(broken), ball.faces, process=False).export(tmp_path / "point.ply")
    for name, message in (
        ("text.obj", "0 faces|not a mesh"),
        ("rubbish.glb", "not a mesh"),
        ("cloud.obj", "0 faces"),
        ("triangle.obj", "1 faces: expected the surface of a person"),
        ("nan.ply", "not finite"),
        ("point.ply", "without area"),
    ):
        with pytest.raises(ValueError, match=f"{name}.*({message})"):
            read_scan(tmp_path / name)
    for name, message in (("nobody.ply", "no such file"), ("", "a folder")):
        with pytest.raises(ValueError, match=f"{message}: expected a mesh"):
            read_mesh(tmp_path / name)
    with pytest.raises(ValueError, match="the faces have no area: expected a surface"):
        sample_scan(np.zeros((4, 3)), np.asarray([[0, 1, 2], [1, 2, 3]]))


def blocks(path, up=2):
    """A tall box with a head, painted red, that stands along an axis, large and far from the
    origin.
    """
    body, head = trimesh.creation.box((40, 40, 150)), trimesh.creation.icosphere(2, 25)
    head.apply_translation([0, 0, 95])
    mesh = trimesh.util.concatenate([body.subdivide(), head])
    mesh.apply_transform(
        {2: np.eye(4), 0: trimesh.geometry.align_vectors([0, 0, 1], [1, 0, 0])}[up]
    )
    mesh.apply_translation([500, 20, -30])
    mesh.visual.vertex_colors = np.tile([255, 0, 0, 255], (len(mesh.vertices), 1))
    mesh.export(path)
    return np.asarray(mesh.vertices)


@pytest.mark.slow
@pytest.mark.parametrize("up", [2, 0])
def test_images_show_the_scan_upright_and_in_its_colors(tmp_path, up):
    blocks(tmp_path / "scan.ply", up)
    photos = load_photos(
        render_scan_views(tmp_path / "scan.ply", tmp_path / "views", views=2, size=64)
    )
    rows, columns = np.nonzero(photos.masks[0])
    assert np.ptp(rows) > 35 and np.ptp(rows) > 2.5 * np.ptp(columns)
    inside = photos.images[0][photos.masks[0] > 0.9]
    assert inside[:, 0].min() > 0.3 and inside[:, 1:].max() < 0.1


@pytest.mark.slow
def test_what_a_detector_sees_comes_back_as_joints_of_the_scan(tmp_path):
    vertices = blocks(tmp_path / "scan.ply")
    folder = render_scan_views(tmp_path / "scan.ply", tmp_path / "views", views=4, size=64)
    photos = load_photos(folder)
    true = vertices[np.random.default_rng(0).integers(0, len(vertices), 17)]
    matrix = np.asarray(json.loads((folder / "scan.json").read_text())["world_from_scan"])
    world = jnp.asarray(true @ matrix[:3, :3].T + matrix[:3, 3], jnp.float32)
    points = np.stack([np.asarray(project(photos.cameras[i], world)[0]) for i in range(4)])
    confidences = np.ones((4, 17), np.float32)
    confidences[:, 3] = 0
    joints = joints_from_views(folder, Keypoints(points.astype(np.float32), confidences, COCO_17))
    assert len(joints) == 16 and COCO_17.names[3] not in joints
    for name, point in joints.items():
        np.testing.assert_allclose(point, true[COCO_17.names.index(name)], atol=0.5)  # of 200 units
    confidences[1:] = 0
    with pytest.raises(ValueError, match="agree on 0 landmarks"):
        joints_from_views(folder, Keypoints(points.astype(np.float32), confidences, COCO_17))


def test_wrong_axes_and_full_folders_are_refused(tmp_path):
    blocks(tmp_path / "scan.ply")
    with pytest.raises(ValueError, match="up y: expected one of"):
        render_scan_views(tmp_path / "scan.ply", tmp_path / "views", up="y")
    with pytest.raises(ValueError, match="not empty"):
        render_scan_views(tmp_path / "scan.ply", tmp_path)


@pytest.fixture(scope="module")
def problem(body):
    return scan_problem(body_surface(body, ("left_hip", "nose"), 1500), body.joint_names, 22)


@pytest.fixture(scope="module")
def case(problem):
    """Pairs, given landmarks, tolerances and a state, random."""
    rng, number = np.random.default_rng(0), lambda x: jnp.asarray(x, jnp.float32)
    rows = rng.integers(0, 1500, 600)
    normals = rng.normal(size=(600, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matches = ScanMatches(
        jnp.asarray(rows, jnp.int32),
        number(rng.normal(size=(600, 3))),
        number(normals),
        jnp.full(600, 0.02),
        jnp.ones(600),
    )
    given = Given(jnp.zeros((2, 3)), jnp.ones(2), number(0.1), number(1.8), number(1))
    state = start_state(problem, problem.prior.mean)
    return matches, given, Tolerances(number(0.01), number(0.02), number(1.0)), state


def test_the_surface_is_the_bodys(body):
    surface = body_surface(body, ("nose",), 13380)
    rng = np.random.default_rng(0)
    pose = BodyPose(
        jnp.asarray(0.3 * rng.normal(size=(55, 3)), jnp.float32), jnp.asarray([0.1, 0.2, 0.3])
    )
    betas = jnp.asarray(rng.normal(size=22), jnp.float32)
    true = pose_body(body, shape_body(body, betas), pose)
    vertices, normals = pose_surface(surface, betas, pose)
    some, _, joints = pose_vertices(surface, jnp.asarray([5, 2]), betas, pose)
    np.testing.assert_allclose(vertices, true.vertices, atol=1e-5)
    np.testing.assert_allclose(some, true.vertices[jnp.asarray([5, 2])], atol=1e-5)
    np.testing.assert_allclose(joints, true.joints, atol=1e-5)
    assert np.linalg.norm(normals, axis=1).min() > 0.99


def test_hands_are_what_is_not_covered(problem):
    surface, names = problem.surface, problem.surface.landmarks.joint_names
    owner = np.asarray(names)[np.asarray(surface.points.weights).argmax(1)]
    covered = np.asarray(surface.covered)
    assert covered[owner == "left_index3"].max() < 0.1
    assert covered[owner == "left_knee"].min() > 0.99


@pytest.mark.slow
def test_columns_of_the_jacobian_are_derivatives(problem, case):
    """XLA's CPU compiler got them wrong where the distances were sums over an axis."""
    matches, given, tolerances, state = case
    leaves, tree = jax.tree.flatten(state)
    residuals = lambda y: scan_residuals(
        problem, matches, given, tolerances, jax.tree.unflatten(tree, y)
    )["surface"]
    columns = jax.jit(jax.jacfwd(residuals))(leaves)
    one = jax.jit(lambda y, direction: jax.jvp(residuals, (y,), (direction,))[1])
    for i in (0, len(leaves) - 1):  # shape and size
        direction = [jnp.zeros_like(leaf) for leaf in leaves]
        direction[i] = direction[i].reshape(-1).at[0].set(1.0).reshape(leaves[i].shape)
        column = np.asarray(columns[i]).reshape(len(matches.rows), -1)[:, 0]
        np.testing.assert_allclose(column, one(leaves, direction), atol=2e-3)


@pytest.mark.slow
def test_a_smaller_scan_is_no_nearer(problem, case):
    """Shrinking body and scan together changes no distance: in the body's own metres it would."""
    matches, given, tolerances, state = case
    away = lambda s, m: np.asarray(scan_residuals(problem, m, given, tolerances, s)["surface"])
    posed, _ = pose_surface(problem.surface, *problem.body(state))
    exact = dataclasses.replace(matches, points=posed[matches.rows])
    assert np.abs(away(state, exact)).max() < 1e-3
    half = dataclasses.replace(
        state, log_scale=jnp.float32(np.log(0.5) / 0.05)
    )  # metres per unit of the frame
    twice = dataclasses.replace(matches, points=2 * posed[matches.rows] + 0.01 * matches.normals)
    np.testing.assert_allclose(away(half, twice), 0.01 / 0.02, atol=1e-3)


def test_outside_counts_less_than_inside():
    away = one_sided(jnp.asarray([0.01, -0.01]), jnp.asarray([0.02, 0.02]), jnp.asarray(0.005))
    np.testing.assert_allclose(away, [0.5, -2.0])
