"""Scores and table of `experiments/evaluation/refinement.py`, without rendering anybody."""

import jax
import jax.numpy as jnp
import numpy as np

from experiments.evaluation.pictures import DETAIL_PIXELS, DETAILS, details, frontal_view
from experiments.evaluation.refinement import report_of, section
from humangs_jax.body.library import load_body
from humangs_jax.body.model import rest_pose, shape_body
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

TASKS = ("novel", "animation")


def row(psnr):
    scores = {
        "psnr": psnr,
        "ssim": 0.9,
        "psnr_fg": 18.0,
        "foreground": 0.1,
        "psnr_boundary": 15.0,
        "semi_transparent": 0.1,
    }
    return {task: scores for task in TASKS}


def test_means_gains_and_the_table():
    rows = {
        1: {"256 4 network": {"0": row(20.0), "5": row(22.0)}},
        2: {"256 4 network": {"0": row(24.0), "5": row(24.5)}},
    }
    report = report_of(rows, {"split": "test"}, [1, 2, 3])
    cell = report["means"]["256 4 network"]["5"]
    assert cell["novel"]["psnr"] == 23.25 and cell["least_gain"] == 0.5
    assert [person["seed"] for person in report["subjects"]] == [1, 2]
    table = section(report)
    assert "| 4 of 256 px | network | 5 | new views, same pose | 23.25 | 18.00 | 15.00 | 0.100 | 0.50 |" in table
    assert "| 4 of 256 px | network | 0 | new views, same pose | 22.00 | 18.00 | 15.00 | 0.100 |  |" in table


def test_details_are_squares_around_the_joints():
    body = load_body()
    rest = shape_body(body, jnp.zeros(2))
    head = rest.joints[body.joint_names.index("left_eye")]
    cameras = orbit(head, 1.5, jnp.asarray([0.0, np.pi]), 0.0, intrinsics_from_fov(0.8, 64, 64), 64, 64)
    images = np.zeros((2, 64, 64, 3), np.float32)
    images[0, 24:40, 24:40] = [1, 0, 0]  # the middle of the picture: the face
    poses = jax.tree.map(lambda x: x[None], rest_pose(body))
    capture = Capture(images, None, cameras, np.zeros(2, int), body, np.zeros(2, np.float32), poses, ("a", "b"))
    found = details(images[0], capture, 0)
    assert found.shape == (len(DETAILS), DETAIL_PIXELS, DETAIL_PIXELS, 3)
    np.testing.assert_allclose(found[0][40:56, 40:56].mean((0, 1)), [1, 0, 0], atol=0.01)
    assert found[3][-10:].min() > 0.99 and found[3][:3].max() < 1  # the shoe is below the picture
    assert frontal_view(capture.select([1]), capture, (0, 1)) == 1
