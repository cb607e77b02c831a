"""Means and tables of refinement, README's tables: without rendering anybody."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.pictures import DETAIL_PIXELS, DETAILS, details, frontal_view
from experiments.refinement import readme_quality, readme_times, refinement_means
from experiments.results import REPOSITORY, text_of
from humangs_jax.body.library import load_body
from humangs_jax.body.model import rest_pose, shape_body
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

SCORES = {
    "psnr": 27.44,
    "ssim": 0.9464,
    "psnr_fg": 18.75,
    "semi_transparent": 0.1,
    "psnr_boundary": 15.0,
    "lpips": None,
}


def test_gains_are_means_and_the_least_of_a_person():
    def row(*psnrs):
        return {
            "256": {
                seconds: {"novel": {"psnr": psnr}}
                for seconds, psnr in zip(("0", "5"), psnrs, strict=True)
            }
        }

    cell = refinement_means([row(20.0, 22.0), row(24.0, 24.5)])["256"]["5"]
    assert cell["novel"]["psnr"] == 23.25 and cell["least_gain"] == 0.5


TIMES = {
    "reconstruct": (11.63, 0.291),
    "animate": (2.07, 0.0341),
    "render_held_out": (6.87, 0.1236),
}
DEMO = SCORES | {
    "views": {"input": 4, "held_out": 6},
    "image_size": [256, 256],
    "gaussians": 20376,
    "timings": {name: {"compile": first, "run": run} for name, (first, run) in TIMES.items()},
    "total_seconds": 39.5,
}


def test_readme_quality_is_of_the_tables_of_the_docs_and_of_the_same_weights():
    stored = lambda name: json.loads((REPOSITORY / "docs" / "results" / f"{name}.json").read_text())
    people, refined = (stored(name)["numbers"] for name in ("evaluation_views", "appearance"))
    demo = DEMO | {"refined": SCORES | {"psnr": 29.16, "seconds": 15.2}}
    rows = readme_quality(demo, people, refined).splitlines()[2:]
    shown = text_of(stored("readme_quality")["blocks"]).splitlines()[2:]
    assert rows[4] == "| the demo's person, 256 px, refined for 15 s | 29.2 | 18.8 |  |"
    assert [*rows[:4], *rows[5:]] == [*shown[:4], *shown[5:]]
    for said, changed in {
        "expected `humangs demo` without": (DEMO, people, refined),
        "of different weights": (demo, people, refined | {"settings": {"weights": "b"}}),
    }.items():
        with pytest.raises(ValueError, match=said):
            readme_quality(*changed)


def test_readme_times():
    rows = readme_times(DEMO).splitlines()[2:]
    assert rows[0] == "| reconstruct: 4 photos of 256 px -> 20,376 Gaussians | 11.6 s | 291 ms |"
    assert rows[1] == "| animate: one pose | 2.1 s | 34 ms |" and rows[3].endswith("|  | 40 s |")


@pytest.mark.slow
def test_details_are_squares_around_the_joints():
    body = load_body()
    rest = shape_body(body, jnp.zeros(2))
    head = rest.joints[body.joint_names.index("left_eye")]
    cameras = orbit(
        head, 1.5, jnp.asarray([0.0, np.pi]), 0.0, intrinsics_from_fov(0.8, 64, 64), 64, 64
    )
    images = np.zeros((2, 64, 64, 3), np.float32)
    images[0, 24:40, 24:40] = [1, 0, 0]  # the middle of the picture: the face
    poses = jax.tree.map(lambda x: x[None], rest_pose(body))
    capture = Capture(
        images, None, cameras, np.zeros(2, int), body, np.zeros(2, np.float32), poses, ("a", "b")
    )
    found = details(images[0], capture, 0)
    assert found.shape == (len(DETAILS), DETAIL_PIXELS, DETAIL_PIXELS, 3)
    np.testing.assert_allclose(found[0][40:56, 40:56].mean((0, 1)), [1, 0, 0], atol=0.01)
    assert found[3][-10:].min() > 0.99 and found[3][:3].max() < 1  # the shoe is below the picture
    assert frontal_view(capture.select([1]), capture, (0, 1)) == 1
