"""Scans from files, and images of scans."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image

from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.sets import COCO_17
from humangs_jax.data.photos import load_photos
from humangs_jax.fitting.scan_files import (
    directions_around,
    joints_from_views,
    read_mesh,
    read_scan,
    render_scan_views,
    sample_scan,
)
from humangs_jax.geometry.camera import project
from humangs_jax.io.mesh import GREY


def sphere(radius=1.0, subdivisions=3):
    return trimesh.creation.icosphere(subdivisions, radius)


def test_points_lie_on_the_surface_with_normals_outwards():
    scan = sample_scan(sphere(2.0).vertices + 7, sphere().faces, 500)
    outward = (scan.points - 7) / 2
    assert len(scan.points) > 480
    assert np.all(np.linalg.norm(outward, axis=1) > 0.98)
    assert np.einsum("pa,pa->p", outward, scan.normals).min() > 0.9
    assert not scan.turned


def test_points_are_as_many_per_area():
    wide = trimesh.creation.box((4, 1, 1))
    scan = sample_scan(wide.vertices, wide.faces, 4000)
    ends = np.mean(np.abs(scan.normals[:, 0]) > 0.5)
    assert ends == pytest.approx(2 / 18, abs=0.02)


def test_faces_inside_out_are_turned():
    scan = sample_scan(sphere().vertices, sphere().faces[:, ::-1], 500)
    assert scan.turned
    assert np.einsum("pa,pa->p", scan.points, scan.normals).min() > 0.9


def test_what_nobody_sees_is_left_out():
    inner, outer = sphere(0.8), sphere(1.0)
    both = trimesh.util.concatenate([outer, inner])
    scan = sample_scan(both.vertices, both.faces, 6000)
    assert np.linalg.norm(scan.points, axis=1).min() > 0.95
    assert scan.hidden == pytest.approx(0.64 / 1.64, abs=0.05)


def test_reading_is_the_same_every_time(tmp_path):
    sphere().export(tmp_path / "ball.ply")
    first, second = (read_scan(tmp_path / "ball.ply", 300) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "stl"])
def test_formats(tmp_path, suffix):
    sphere(1.5).export(tmp_path / f"ball.{suffix}")
    scan = read_scan(tmp_path / f"ball.{suffix}", 300)
    assert np.linalg.norm(scan.points, axis=1).mean() == pytest.approx(1.5, abs=0.02)


def test_parts_of_a_scene_are_where_the_scene_has_them(tmp_path):
    scene = trimesh.Scene()
    move = np.eye(4)
    move[0, 3] = 10
    scene.add_geometry(sphere(), node_name="here")
    scene.add_geometry(sphere(), node_name="there", transform=move)
    scene.export(tmp_path / "two.glb")
    assert np.ptp(read_mesh(tmp_path / "two.glb").vertices[:, 0]) == pytest.approx(12, abs=0.1)


def boxes(folder):
    """Objects and materials in turn, each with its own vertices, quads among triangles; as (vertices, faces) and as a file."""
    vertices, faces, lines = [], [], ["mtllib boxes.mtl"]
    for i in range(6):
        box = trimesh.creation.box((1, 1, 1)).subdivide()
        box.apply_translation([2.0 * i, 0, 0])
        start = sum(map(len, vertices))
        lines += [f"o box{i}", f"g part{i}", *(f"v {x} {y} {z}" for x, y, z in box.vertices), f"usemtl paint{i % 2}"]
        lines += ["f " + " ".join(f"{start + corner + 1}" for corner in face) for face in box.faces[:40]]
        lines += ["s off", f"usemtl paint{(i + 1) % 2}"]
        lines += ["f " + " ".join(f"{start + corner + 1}" for corner in face) for face in box.faces[40:]]
        vertices.append(box.vertices)
        faces.append(box.faces + start)
    (folder / "boxes.mtl").write_text("newmtl paint0\nKd 1 0 0\nnewmtl paint1\nKd 0 1 0\n")
    (folder / "boxes.obj").write_text("\n".join(lines))
    return np.concatenate(vertices), np.concatenate(faces)


@pytest.mark.parametrize("colors", [False, True])
def test_objects_and_materials_in_turn_keep_every_face(tmp_path, colors):
    vertices, faces = boxes(tmp_path)
    mesh = read_mesh(tmp_path / "boxes.obj", colors=colors)
    triangles = lambda corners: np.sort(np.round(corners.reshape(len(corners), -1), 6), axis=0)
    np.testing.assert_allclose(triangles(mesh.vertices[mesh.faces]), triangles(vertices[faces]), atol=1e-6)


def textured(folder, name="skin.png"):
    """A sphere whose texture is red, and named `name` in its material."""
    Image.new("RGB", (4, 4), (255, 0, 0)).save(folder / "skin.png")
    ball = sphere()
    (folder / "ball.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
    lines = ["mtllib ball.mtl", "usemtl skin", *(f"v {x} {y} {z}" for x, y, z in ball.vertices)]
    lines += [f"vt {x / 2 + 0.5} {y / 2 + 0.5}" for x, y, _ in ball.vertices]
    lines += ["f " + " ".join(f"{corner + 1}/{corner + 1}" for corner in face) for face in ball.faces]
    (folder / "ball.obj").write_text("\n".join(lines))
    return folder / "ball.obj"


def test_a_scan_has_the_colors_of_its_texture_and_is_grey_with_a_warning_without_it(tmp_path, caplog):
    red = read_mesh(textured(tmp_path), colors=True).visual.vertex_colors
    assert (red == [255, 0, 0, 255]).all() and not caplog.records
    grey = read_mesh(textured(tmp_path, "moved.png"), colors=True).visual.vertex_colors
    assert (grey[:, :3] == GREY).all()
    (record,) = caplog.records
    assert "ball.obj: left out 'moved.png':" in record.getMessage() and "no such file" in record.getMessage()


def bad_files(folder):
    ball = sphere()
    ball.export(folder / "good.obj")
    (folder / "text.obj").write_text("hello")
    (folder / "rubbish.glb").write_bytes(b"glTF rubbish")
    (folder / "cloud.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n")
    (folder / "triangle.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    broken = ball.vertices.copy()
    broken[3] = np.nan
    trimesh.Trimesh(broken, ball.faces, process=False).export(folder / "nan.ply")
    trimesh.Trimesh(np.zeros_like(broken), ball.faces, process=False).export(folder / "point.ply")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("missing.obj", "no such file"),
        ("text.obj", "no faces|not a mesh"),
        ("rubbish.glb", "not a mesh"),
        ("cloud.obj", "no faces"),
        ("triangle.obj", "1 faces: expected the surface of a person"),
        ("nan.ply", "not finite"),
        ("point.ply", "no area"),
    ],
)
def test_what_is_no_scan_is_refused_by_name(tmp_path, name, message):
    bad_files(tmp_path)
    with pytest.raises(ValueError, match=message) as error:
        read_scan(tmp_path / name)
    assert name in str(error.value)


def test_directions_are_spread():
    directions = directions_around(48)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    nearest = np.sort(directions @ directions.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 15


def blocks(path, up=2):
    """A tall box with a head, painted red, that stands along an axis, large and far from the origin."""
    body, head = trimesh.creation.box((40, 40, 150)), trimesh.creation.icosphere(2, 25)
    head.apply_translation([0, 0, 95])
    mesh = trimesh.util.concatenate([body.subdivide(), head])
    mesh.apply_transform({2: np.eye(4), 0: trimesh.geometry.align_vectors([0, 0, 1], [1, 0, 0])}[up])
    mesh.apply_translation([500, 20, -30])
    mesh.visual.vertex_colors = np.tile([255, 0, 0, 255], (len(mesh.vertices), 1))
    mesh.export(path)
    return np.asarray(mesh.vertices)


@pytest.mark.slow
@pytest.mark.parametrize("up", [2, 0])
def test_images_show_the_scan_upright_and_in_its_colors(tmp_path, up):
    blocks(tmp_path / "scan.ply", up)
    photos = load_photos(render_scan_views(tmp_path / "scan.ply", tmp_path / "views", views=2, size=64))
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
    import json

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
