"""`humangs animate`, `render` and `view` write what was asked for."""

import dataclasses
import os

import numpy as np
import pytest
from avatar_cases import two_balls
from command_line import run
from exr_files import read_exr

from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.body.motion import Motion
from humangs_jax.cli.animate import Animate, Render
from humangs_jax.io.images import read_image
from humangs_jax.motion import save_motion


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Returns the working folder, with an avatar and a motion of a second."""
    import jax.numpy as jnp

    monkeypatch.chdir(tmp_path)
    avatar = two_balls(2)
    avatar.save(tmp_path / "avatar.npz")
    path = np.stack([np.zeros(12), np.zeros(12), np.linspace(0, 1, 12)], axis=-1)
    save_motion(
        tmp_path / "motion.npz", Motion(jnp.zeros((12, 3, 3)), jnp.asarray(path, jnp.float32), 12.0)
    )
    return tmp_path


def test_both_commands_have_the_options_of_a_shot(monkeypatch, capsys):
    for command in (Animate, Render):
        assert any(field.name == "shot" for field in dataclasses.fields(command))
    texts = [run(monkeypatch, capsys, command, "--help")[1] for command in ("animate", "render")]
    assert all(
        f"--{field.name}" in text for text in texts for field in dataclasses.fields(FrameSettings)
    )


@pytest.mark.slow
def test_what_is_written_is_what_was_asked_for(folder, monkeypatch, capsys):
    small = ("--width", "40", "--height", "64", "--splat", "fast")
    code, printed, error = run(
        monkeypatch,
        capsys,
        "animate",
        "avatar.npz",
        "--motion",
        "motion.npz",
        "--out",
        "frames",
        *small,
        "--background",
        "transparent",
        "--start",
        "0.5",
        "--fps",
        "6",
        "--loop",
        "2",
        "--prune",
    )
    assert (
        code == 0
        and " of 324 Gaussians are in no image\nframes: 6 frames of 40 x 64 at 6 frames per second"
        in printed
    ), error
    image, alpha = read_image("frames/frame_00005.png")
    assert (
        image.shape == (64, 40, 3)
        and alpha.max() > 0.9
        and alpha.min() == 0
        and len(os.listdir("frames")) == 6
    )
    rows = np.flatnonzero(alpha.max(axis=1) > 0.5)
    assert rows[-1] - rows[0] > 0.8 * 64  # followed and framed, whatever it walked

    code, printed, error = run(
        monkeypatch,
        capsys,
        "render",
        "avatar.npz",
        "--out",
        "turn.webm",
        "--views",
        "5",
        *small,
        "--pose",
        "a",
    )
    assert (
        code == 0
        and "Gaussians are in no image" not in printed
        and "turn.webm: 5 frames of 40 x 64 at 24" in printed
    ), error
    assert (folder / "turn.webm").stat().st_size > 500

    more = (
        "--exr",
        "--channels",
        "rgba,z,position",
        "--exr-type",
        "half",
        "--views",
        "2",
        "--background",
        "#000",
    )
    code, printed, error = run(
        monkeypatch, capsys, "render", "avatar.npz", "--out", "views", *small, *more
    )
    assert code == 0 and "views: 2 views of 40 x 64 and views.exr" in printed, error
    views = read_exr("views/views.exr")
    assert len(views) == 2 and set(views[0].channels) == {"position.X", "position.Y", "position.Z"}
    np.testing.assert_allclose(
        read_image("views/view_001.png")[0], views[1].rgba[..., :3], atol=3e-3
    )
