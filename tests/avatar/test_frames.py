"""Frames of an animation: one plan of buffers, made anew only for a frame that needs more room."""

import jax.numpy as jnp
import numpy as np
import pytest

from humangs_jax.avatar import frames
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.exr import read_exr
from humangs_jax.io.images import read_image
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import Rendering, render

ROUNDING = 1e-6
"""float32; other buffers are other programs."""


def blobs(count=80):
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(3, 4, (count, 1))], axis=1)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    arrays = means, quats, np.full((count, 3), 0.02), np.full(count, 0.8), rng.uniform(size=(count, 3))
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in arrays))


@pytest.mark.slow
def test_a_frame_that_needs_more_room_gets_it(monkeypatch):
    plans, gaussians = [], blobs()
    real = frames.plan_buffers
    monkeypatch.setattr(frames, "plan_buffers", lambda *arguments: plans.append(1) or real(*arguments))
    focal = [5.0, 5.2, 150.0, 6.0]  # the third one comes close
    cameras = [Camera(jnp.asarray([[f, 0, 36], [0, f, 36], [0, 0, 1]], jnp.float32), jnp.eye(4), 64, 64) for f in focal]
    drawn = list(frames.draw_gaussians(iter([gaussians] * 4), iter(cameras)))
    assert len(plans) == 2
    for rendering, camera in zip(drawn, cameras, strict=True):
        np.testing.assert_allclose(rendering.rgb, render(gaussians, camera).rgb, atol=ROUNDING)
        assert rendering.overflow == 0 and rendering.alpha.max() > 0.5


def test_exr_colours_are_premultiplied(tmp_path):
    """A compositing program shows what was rendered when it adds (1 - alpha) times the background."""
    alpha = np.asarray([[0.0, 0.5, 1.0]], np.float32)
    onto_white = 0.25 * alpha[..., None] + (1 - alpha[..., None]) * np.ones(3, np.float32)
    rendering = Rendering(jnp.asarray(onto_white), jnp.asarray(alpha), jnp.zeros((1, 3)), jnp.zeros((), jnp.int32))
    cameras = stack_cameras([Camera(jnp.eye(3), jnp.eye(4), 3, 1)])
    frames.write_renderings(tmp_path, cameras, [rendering], exr=True)
    (view,) = read_exr(tmp_path / "views.exr")
    np.testing.assert_allclose(view.rgba[..., :3], 0.25 * alpha[..., None] * np.ones(3), atol=ROUNDING)
    np.testing.assert_array_equal(view.rgba[..., 3], alpha)
    np.testing.assert_allclose(read_image(tmp_path / "view_000.png")[0], onto_white, atol=0.5 / 255 + ROUNDING)


def test_each_frame_needs_a_camera():
    with pytest.raises(ValueError, match="zip"):
        list(frames.draw_gaussians(iter([blobs()]), iter([])))
