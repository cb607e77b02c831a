"""Means and tables of refinement, README's tables: without rendering anybody."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.pictures import DETAIL_PIXELS, DETAILS, details, frontal_view
from experiments.refinement import readme_quality, readme_times, refinement_means, refinement_section
from humangs_jax.body.library import load_body
from humangs_jax.body.model import rest_pose, shape_body
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

SCORES = {"psnr": 27.44, "ssim": 0.9464, "psnr_fg": 18.75, "semi_transparent": 0.1, "psnr_boundary": 15.0, "lpips": None}


def row(*psnrs, name="256 4 0 Adam"):
    tasks = lambda psnr: dict.fromkeys(("novel", "animation"), SCORES | {"psnr": psnr})
    return {name: {seconds: tasks(psnr) for seconds, psnr in zip(("0", "5"), psnrs, strict=True)}}


def test_means_gains_and_the_table():
    means = refinement_means([row(20.0, 22.0), row(24.0, 24.5)])
    cell = means["256 4 0 Adam"]["5"]
    assert cell["novel"]["psnr"] == 23.25 and cell["least_gain"] == 0.5
    means |= {"256 4 0 4 iterations, Adam": means["256 4 0 Adam"]}
    table = refinement_section(means, {"split": "test", "off": [0]}, 2)
    rows = [line for line in table.splitlines() if line.startswith("| 4 of")]
    assert rows[0] == "| 4 of 256 px | none | 0 | 22.00 | 18.75 | 15.00 | 0.100 | 22.00 | 18.75 |  |" and len(rows) == 3
    assert rows[2] == "| 4 of 256 px | 4 iterations, Adam | 5 | 23.25 | 18.75 | 15.00 | 0.100 | 23.25 | 18.75 | 0.50 |"
    for task in ("novel", "animation"):
        for cell in means["256 4 0 Adam"].values():
            cell[task]["lpips"] = 0.05
    table = refinement_section(means, {"split": "test", "off": [2.5], "lpips_net": "alex"}, 2)
    assert "LPIPS alex;" in table
    assert "| 4 of 256 px | 0 mm | Adam | 5 | 23.25 | 18.75 | 0.050 | 15.00 | 0.100 | 23.25 | 18.75 | 0.050 | 0.50 |" in table


TIMES = {"reconstruct": (11.63, 0.291), "animate": (2.07, 0.0341), "render_held_out": (6.87, 0.1236)}
DEMO = SCORES | {
    "views": {"input": 4, "held_out": 6},
    "image_size": [256, 256],
    "gaussians": 20376,
    "timings": {name: {"compile": first, "run": run} for name, (first, run) in TIMES.items()},
    "total_seconds": 39.5,
}


def test_readme_quality_is_of_the_same_weights():
    settings = {"settings": {"weights": "a"}, "people": 3}
    baseline = {"baseline_psnr": 20.67, "baseline_psnr_fg": 11.28, "baseline_lpips": 0.1444, "lpips": 0.0712}
    people = settings | {"by_views": {"4": {"novel": SCORES | baseline}}}
    seen = {"default": SCORES | {"alex": 0.0506}, "iterations alone": {}}
    cells = {f"{size} 0 {task}": seen for size in (256, 512) for task in ("novel", "animation")}
    refined = settings | {"people": 2, "means": {"all": cells}}
    demo = DEMO | {"refined": SCORES | {"psnr": 29.16, "seconds": 15.2}}
    rows = readme_quality(demo, people, refined).splitlines()[2:]
    assert rows[0] == "| 3 synthetic people, 256 px, feed-forward | 27.4 | 18.8 |  |" and len(rows) == 6
    assert rows[1] == "| 2 of them, as `humangs reconstruct` makes them | 27.4 | 18.8 | 0.051 |"
    assert rows[4] == "| the demo's person, 256 px, refined for 15 s | 29.2 | 18.8 |  |"
    assert rows[5] == "| vertex-color baseline, 256 px | 20.7 | 11.3 |  |"
    alex = people | {"settings": {"weights": "a", "lpips_net": "alex"}}
    rows = readme_quality(demo, alex, refined).splitlines()[2:]
    assert rows[0].endswith("| 18.8 | 0.071 |") and rows[5].endswith("| 11.3 | 0.144 |")
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
