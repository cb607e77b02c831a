import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.sets import COCO_17
from humangs_jax.data.photos import load_photos
from humangs_jax.fitting.scan_views import joints_from_views, render_scan_views
from humangs_jax.geometry.camera import project


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
