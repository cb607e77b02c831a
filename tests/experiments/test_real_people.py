"""Photos of real people: what is made of the given folders, and how a run continues."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image

from experiments import real_people
from experiments.harness import Run
from experiments.held_out_photos import in_shared_pose, psnr_corrected
from experiments.real_capture import unpacked
from experiments.real_people import turning_man, write_transforms
from humangs_jax.capture.fitting.own_poses import with_own_poses
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture

COUNT = 16


@pytest.fixture
def clip(tmp_path):
    """Returns a folder with a GIF whose frames become brighter."""
    frames = [Image.new("RGB", (32, 32), (10 * i, 10 * i, 10 * i)) for i in range(COUNT)]
    frames[0].save(tmp_path / "input.gif", save_all=True, append_images=frames[1:])
    return tmp_path


def test_eight_photos_of_a_turn_and_its_video_are_made_of_one_clip(clip):
    cases = dict(turning_man(clip, clip / "work"))
    folder = cases["turning man, photos"]().photos
    assert [path.stem for path in sorted(folder.iterdir())] == [
        f"frame_{number:03d}" for number in range(0, COUNT, 2)
    ]
    video = cases["turning man, video"]().photos
    assert video.suffix == ".mp4" and video.stat().st_size > 0


def test_cameras_are_written_as_transforms_of_opengl(tmp_path):
    (tmp_path / "images").mkdir()
    K = np.asarray([[[500.0, 0, 256], [0, 510, 250], [0, 0, 1]]])
    matrix = np.eye(4)
    matrix[:3, 3] = 0.1, 0.2, 3.0
    write_transforms(tmp_path, ["a"], K, matrix[None], 512)
    (frame,) = json.loads((tmp_path / "transforms.json").read_text())["frames"]
    assert [frame[key] for key in ("fl_x", "fl_y", "cx", "cy", "w")] == [500, 510, 256, 250, 512]
    back = np.linalg.inv(np.asarray(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1]))
    np.testing.assert_allclose(back, matrix, atol=1e-12)


def test_the_shared_pose_of_a_held_out_photo_is_the_mean_of_the_others():
    capture = with_own_poses(load_capture("demo_capture"))
    rotations = capture.poses.rotations * np.arange(1.0, 5.0)[:, None, None]
    poses = replace(capture.poses, rotations=rotations)
    capture = dataclasses.replace(capture, poses=poses)
    rest, shown = capture.select([0, 1, 3]), capture.select([2])
    found = in_shared_pose(rest, shown)
    mean = np.asarray(rotations)[[0, 1, 3]].mean(axis=0)
    for frame in found.frames.tolist():
        np.testing.assert_allclose(found.poses.rotations[frame], mean, atol=1e-6)


def test_gains_of_channels_are_no_error_of_corrected_colors_and_detail_is():
    rng = np.random.default_rng(0)
    photo, mask = rng.uniform(0.2, 0.8, (8, 8, 3)), np.ones((8, 8))
    mask[:, :4], other = 0, photo.copy()
    other[:, :4] = 0  # what is not the person does not count
    assert psnr_corrected(other * [0.7, 1.2, 0.9], photo, mask) > 100
    detail = photo + 0.1 * rng.choice([-1.0, 1.0], photo.shape)
    np.testing.assert_allclose(psnr_corrected(detail, photo, mask), 20.0, atol=0.5)


def test_folders_that_are_missing_are_one_line_and_nothing_is_fetched(tmp_path):
    with pytest.raises(ValueError, match="--known, --turning or --scan: expected"):
        real_people.real_people(Run(), tmp_path / "work")
    with pytest.raises(ValueError, match="nowhere: no such folder"):
        real_people.real_people(Run(), tmp_path / "work", known=tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"expected Pose2Sim/Demo_SinglePerson in it: pip install"):
        unpacked(tmp_path)
