"""Cameras of a file around an avatar: fixed ones, or a path along a motion."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from avatar_cases import two_balls
from small import small_avatar

from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.camera_paths import camera_path, file_cameras, one_size, repeated, standing
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.body.model import BodyPose
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import intrinsics_from_fov, look_at, orbit, stack_cameras
from humangs_jax.io.images import read_image
from humangs_jax.motion import save_motion

TARGET = jnp.asarray([0.0, 0.9, 0.0])
BLENDER = np.diag([1.0, -1, -1, 1])
"""Turns OpenCV's camera axes into OpenGL's."""
Z_UP = np.asarray([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Turns a world with y up into one with z up."""


def around(azimuths, size=(40, 32), fov=0.6, distance=4.0):
    K = intrinsics_from_fov(fov, *size)
    return orbit(TARGET, distance, jnp.asarray(azimuths, jnp.float32), 0.2, K, *size)


def write_transforms(path, cameras, names=None, sizes=None):
    """Writes cameras as Blender's exporters do: z up, camera to world, OpenGL's axes."""
    frames = []
    for i, camera in enumerate(cameras):
        world_from_cam = Z_UP @ np.asarray(camera.world_from_cam, float) @ BLENDER
        width, height = sizes[i] if sizes else (camera.width, camera.height)
        lens = {
            "fl_x": camera.K[0, 0],
            "fl_y": camera.K[1, 1],
            "cx": camera.K[0, 2],
            "cy": camera.K[1, 2],
        }
        frame = {name: float(value) for name, value in lens.items()} | {"w": width, "h": height}
        name = names[i] if names else f"{i:04d}"
        frames.append(
            frame | {"file_path": f"{name}.png", "transform_matrix": world_from_cam.tolist()}
        )
    path.write_text(json.dumps({"frames": frames}))
    return path


def test_one_camera_stands_still_and_one_for_each_frame_is_taken_as_it_is():
    for count in (1, 7):
        cameras = around(np.linspace(0, 1, count))
        path = camera_path(cameras, 7)
        assert path.batch_shape == (7,)
        np.testing.assert_array_equal(
            path.cam_from_world, np.broadcast_to(cameras.cam_from_world, (7, 4, 4))
        )


def test_a_path_goes_through_all_cameras_and_turns_evenly_between_two():
    keys = around([0.0, 0.5, 1.5, 1.4])
    path = camera_path(keys, 31)
    np.testing.assert_allclose(path.cam_from_world[::10], keys.cam_from_world, atol=1e-5)
    np.testing.assert_allclose(path.K[::10], keys.K, rtol=1e-6)
    turns = np.asarray(path.cam_from_world)[:, :3, :3]
    np.testing.assert_allclose(
        turns @ turns.swapaxes(1, 2), np.broadcast_to(np.eye(3), (31, 3, 3)), atol=1e-5
    )
    steps = np.arccos(
        np.clip((np.trace(turns[1:] @ turns[:-1].swapaxes(1, 2), axis1=1, axis2=2) - 1) / 2, -1, 1)
    )
    for part in steps.reshape(3, 10):
        np.testing.assert_allclose(part, part.mean(), rtol=0.05)
    two = camera_path(around([0.0, 1.0]), 3)
    np.testing.assert_allclose(two.center[1], np.mean(two.center[::2], axis=0), atol=1e-5)


def test_a_path_does_not_overshoot():
    heights = [0.5, 0.5, 2.0, 2.0]
    keys = stack_cameras(
        [
            look_at(jnp.asarray([0.0, h, 3.0]), TARGET, jnp.asarray([0.0, 1, 0]), jnp.eye(3), 8, 8)
            for h in heights
        ]
    )
    path = np.asarray(camera_path(keys, 100).center)[:, 1]
    assert path.min() >= 0.5 - 1e-4 and path.max() <= 2 + 1e-4 and (np.diff(path) >= -1e-4).all()


def test_the_world_of_a_file_is_turned_so_that_its_up_is_ours(tmp_path):
    cameras = around([0.0, 0.7, 2.0])
    found = file_cameras(
        write_transforms(tmp_path / "transforms.json", cameras, names=("c", "a", "b")),
        FrameSettings(),
        upright=True,
    )
    assert list(found) == ["c", "a", "b"]
    np.testing.assert_allclose(
        one_size(tmp_path, found).cam_from_world, cameras.cam_from_world, atol=1e-5
    )


def test_images_of_several_sizes_are_refused_unless_a_size_is_given(tmp_path):
    file = write_transforms(
        tmp_path / "transforms.json", around([0.0, 1.0]), sizes=[(40, 32), (32, 40)]
    )
    with pytest.raises(
        ValueError,
        match=r"several sizes, 0001 has 32 x 40, 0000 has 40 x 32: expected one size, or a width",
    ):
        one_size(file, file_cameras(file, FrameSettings(), upright=True))
    assert (
        one_size(file, file_cameras(file, FrameSettings(width=20, height=16), upright=True)).width
        == 20
    )


def test_whoever_stands_has_the_soles_on_the_floor_at_the_middle():
    avatar = small_avatar()
    avatar = replace(
        avatar, rest_vertices=avatar.rest_vertices + 3, rest_joints=avatar.rest_joints + 3
    )
    for pose in (None, BodyPose(jnp.zeros((3, 3)), jnp.asarray([5.0, 6, 7]))):
        moved = standing(avatar, pose)
        assert float(avatar.rest_vertices[:, 1].min() + moved.translation[1]) == pytest.approx(
            0, abs=1e-5
        )
        np.testing.assert_allclose(
            avatar.rest_joints[0, ::2] + moved.translation[::2], 0, atol=1e-5
        )
    assert repeated(moved, 4).batch_shape == (4,)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    two_balls(1).save(tmp_path / "me.npz")
    save_motion(tmp_path / "still.npz", Motion(jnp.zeros((6, 3, 3)), jnp.zeros((6, 3)), 6.0))
    write_transforms(
        tmp_path / "path.json", around([0.0, 1.0, 2.0]), names=("front", "side", "back")
    )
    return tmp_path


@pytest.mark.slow
def test_an_avatar_is_rendered_by_the_cameras_of_a_file(folder, humangs):
    code, out, err = humangs("render", "me.npz", "--camera", "path.json", "--out", "views", "--exr")
    assert code == 0 and "views: 3 views of 40 x 32 and views.exr" in out, err
    names = sorted(file.name for file in (folder / "views").iterdir())
    assert names == ["back.png", "front.png", "side.png", "views.exr"]
    front, side = (read_image(folder / "views" / f"{name}.png")[0] for name in ("front", "side"))
    assert front.min() < 0.7 and np.abs(front - side).max() > 0.1
    code, out, err = humangs(
        "render",
        "me.npz",
        "--camera",
        "path.json",
        "--out",
        "turn.mp4",
        "--width",
        "33",
        "--height",
        "21",
    )
    assert code == 0 and "turn.mp4: 3 frames of 34 x 22 at 24" in out, err


@pytest.mark.slow
def test_the_camera_travels_along_its_path_during_the_motion(folder, humangs):
    line = ("animate", "me.npz", "--motion", "still.npz", "--camera", "path.json")
    code, out, err = humangs(*line, "--out", "frames")
    assert code == 0 and "frames: 6 frames of 40 x 32 at 6" in out, err
    drawn = np.stack([read_image(file)[0] for file in sorted((folder / "frames").iterdir())])
    humangs("render", "me.npz", "--camera", "path.json", "--out", "views")
    for i, name in ((0, "front"), (5, "back")):
        np.testing.assert_allclose(
            drawn[i], read_image(folder / "views" / f"{name}.png")[0], atol=2 / 255
        )
    assert np.abs(np.diff(drawn, axis=0)).max(axis=(1, 2, 3)).min() > 0.02


def test_the_person_of_a_path_stands_as_in_an_export():
    """The feet are at height 0 and the person at x = z = 0, so a path made for an export fits."""
    avatar = two_balls(1)
    means = np.asarray(animate(avatar, standing(avatar)).means)
    assert abs(means[:, 1].min()) < 0.02
