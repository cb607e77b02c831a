"""`humangs render` of Gaussians of any program, from a circle or from the cameras of a file."""

import json
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from small import small_avatar

import humangs_jax as hg
from humangs_jax import cli
from humangs_jax.avatar.camera_paths import file_cameras
from humangs_jax.avatar.export import EXPORTS
from humangs_jax.avatar.export.gaussians import export, world_matrix
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.splat_views import circle_cameras
from humangs_jax.geometry.camera import project
from humangs_jax.io.images import read_image

STEP = 0.51 / 255
"""Half a step of 8 bits, with a margin for rounding."""


def ball(g=60, seed=0):
    """Returns Gaussians on a ball of radius 1 m around (1, 2, 3), colored by direction."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(g, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    arrays = (
        d + np.asarray([1, 2, 3]),
        rng.normal(size=(g, 4)),
        np.full((g, 3), 0.1),
        np.full(g, 0.9),
        (d + 1) / 2,
    )
    return hg.Gaussians(*(jnp.asarray(x, jnp.float32) for x in arrays))


def rendered(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["humangs", "render", *map(str, words)])
    cli.main()


@pytest.mark.slow
def test_a_circle_shows_the_whole_scene_upright(tmp_path, monkeypatch, capsys):
    hg.save_gaussians(tmp_path / "a.ply", ball())
    out = tmp_path / "views"
    rendered(
        monkeypatch,
        tmp_path / "a.ply",
        "--out",
        out,
        "--views",
        3,
        "--size",
        64,
        "--background",
        "black",
    )
    assert "3 views of 60 Gaussians" in capsys.readouterr().out
    assert sorted(file.name for file in out.iterdir()) == [
        "view_000.png",
        "view_001.png",
        "view_002.png",
    ]
    loaded = hg.load_gaussians(tmp_path / "a.ply")
    cameras = circle_cameras(loaded, EXPORTS["ply"], 3, FrameSettings(size=64))
    for name, camera in cameras.items():
        drawn = hg.render(loaded, camera, background="black")
        np.testing.assert_allclose(
            read_image(out / f"{name}.png")[0], np.clip(drawn.rgb, 0, 1), atol=STEP
        )
        assert (
            np.mean(np.asarray(drawn.alpha) > 0.5) > 0.2 and np.asarray(drawn.alpha)[:2].max() < 0.1
        )
    # -y is up in a .ply: what has a small y is above
    rgb, alpha = np.asarray(drawn.rgb), np.asarray(drawn.alpha)
    green = (rgb[..., 1] * alpha).sum(1) / np.maximum(alpha.sum(1), 1e-6)
    assert green[alpha.sum(1) > 5][0] < green[alpha.sum(1) > 5][-1]


def person_like(far=0):
    """Returns Gaussians with the outline of a person with arms out, and `far` of them elsewhere."""
    rng = np.random.default_rng(0)
    body = rng.uniform(-1, 1, (2000, 3)) * [0.25, 0.5, 0.15] + [0, 1.2, 0]
    arms, feet = (
        rng.uniform(-1, 1, (200, 3)) * [0.9, 0.05, 0.05] + [0, 1.4, 0],
        rng.uniform(-0.1, 0.1, (60, 3)),
    )
    means = np.concatenate([body, arms, feet, rng.uniform(20, 30, (far, 3))])
    count = len(means)
    arrays = (
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), 0.01),
        np.full(count, 0.9),
        np.full((count, 3), 0.5),
    )
    return hg.Gaussians(*(jnp.asarray(x, jnp.float32) for x in arrays))


AXES = {"ply": "RDF", "splat": "RDF", "spz": "RUB", "glb": "LUF"}
"""Directions of x, y and z in the formats, by Niantic's converters: right or left, up or down,
front or back (https://github.com/nianticlabs/spz#coordinate-system).
"""


def looking(camera):
    """Returns the direction in which a camera looks."""
    return np.asarray(camera.cam_from_world)[2, :3]


@pytest.mark.parametrize("name", AXES)
def test_the_first_view_of_every_format_shows_a_person_upright_and_from_the_front(name, tmp_path):
    """The axes are those that converters and viewers of the formats use."""
    person = small_avatar()
    export(tmp_path / f"me.{name}", person)
    loaded = hg.load_gaussians(tmp_path / f"me.{name}")
    # our world has y up and a person who faces +z, so that x is to the left of the person
    signs = {"R": -1, "L": 1, "U": 1, "D": -1, "F": 1, "B": -1}
    np.testing.assert_array_equal(
        world_matrix(EXPORTS[name]), np.diag([signs[letter] for letter in AXES[name]])
    )
    (camera,) = circle_cameras(
        loaded, EXPORTS[name], 1, FrameSettings(size=64, elevation=0.0)
    ).values()
    up, front = (world_matrix(EXPORTS[name])[:, axis] for axis in (1, 2))
    np.testing.assert_allclose(looking(camera), -front, atol=1e-5)
    np.testing.assert_allclose(np.asarray(camera.cam_from_world)[1, :3], -up, atol=1e-5)


@pytest.mark.parametrize("up", ["-y", "y", "z"])
def test_another_axis_may_be_up_in_every_format(up, tmp_path):
    """The feet are at height 0 and the head is above them."""
    axis = {"-y": [0, -1, 0], "y": [0, 1, 0], "z": [0, 0, 1]}[up]
    for name in AXES:
        export(tmp_path / f"me.{name}", small_avatar(), up=up)
        heights = np.asarray(hg.load_gaussians(tmp_path / f"me.{name}").means) @ axis
        assert heights.max() > 0.1 and heights.min() == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("size", [(64, 64), (40, 64), (64, 40)])
def test_a_person_of_a_file_is_shown_with_a_margin(size):
    gaussians = person_like()
    for camera in circle_cameras(
        gaussians, EXPORTS["glb"], 4, FrameSettings(width=size[0], height=size[1])
    ).values():
        uv, depth = project(camera, gaussians.means)
        assert (depth > 0).all()
        assert (uv > 0.02 * np.asarray(size)).all() and (uv < 0.98 * np.asarray(size)).all()


def test_what_is_far_away_of_a_scene_does_not_make_it_small():
    near = circle_cameras(person_like(), EXPORTS["glb"], 1, FrameSettings(size=64))["view_000"]
    far = circle_cameras(person_like(40), EXPORTS["glb"], 1, FrameSettings(size=64))["view_000"]
    assert np.linalg.norm(far.center) < 1.5 * np.linalg.norm(near.center)


@pytest.mark.wings
def test_cameras_of_a_file_are_in_the_world_of_the_gaussians(tmp_path, monkeypatch):
    gaussians, pose = ball(), np.eye(4)
    pose[:3, 3] = [1, 2, 8]  # OpenGL's axes: looks along -z
    frames = [
        {"file_path": f"images/{name}.jpg", "transform_matrix": pose.tolist()}
        for name in ("b", "a", "c/a")
    ]
    lens = {"fl_x": 60.0, "fl_y": 62.0, "cx": 25.0, "cy": 15.0, "w": 48, "h": 32}
    (tmp_path / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    hg.save_gaussians(tmp_path / "a.ply", gaussians)
    out = tmp_path / "views"
    out.mkdir()
    (out / "mine.txt").write_text("stays")
    rendered(
        monkeypatch, tmp_path / "a.ply", "--camera", tmp_path / "transforms.json", "--out", out
    )
    assert sorted(file.name for file in out.iterdir()) == ["a.png", "a_2.png", "b.png", "mine.txt"]
    camera = hg.Camera.from_opencv(
        [[60.0, 0, 25], [0, 62, 15], [0, 0, 1]],
        [[1, 0, 0, -1], [0, -1, 0, 2], [0, 0, -1, 8], [0, 0, 0, 1]],
        48,
        32,
    )
    expected = np.clip(hg.render(gaussians, camera).rgb, 0, 1)
    np.testing.assert_allclose(read_image(out / "b.png")[0], expected, atol=STEP + 1e-4)
    assert np.mean(expected < 0.9) > 0.05
    larger = file_cameras(tmp_path / "transforms.json", FrameSettings(width=96, height=64))["b"]
    assert (larger.width, larger.height) == (96, 64) and float(larger.K[0, 0]) == pytest.approx(120)
