import numpy as np
import pytest
import trimesh

from humangs_jax.fitting.scan_reading import directions_around, read_mesh, read_scan, sample_scan


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
