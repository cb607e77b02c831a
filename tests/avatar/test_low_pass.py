import jax
import jax.numpy as jnp
import numpy as np
import pytest
from avatar_cases import two_balls

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.low_pass import with_low_pass, without_low_pass
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.reading import FileError
from humangs_jax.rendering.constants import EPS2D, MIP_EPS2D
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render

PIXEL = 0.0086
ROUNDING = 3e-4
"""Relative, of scales of a tenth of a pixel: float32 keeps 1e-7 of the variance that the low-pass has."""


def flat_avatar():
    avatar = two_balls(1)
    scales = avatar.gaussians.scales * jnp.asarray([1.0, 1.0, PIXEL / 10 / 0.0125])
    return replace(avatar, gaussians=replace(avatar.gaussians, scales=scales))


def test_variances_grow_by_the_low_pass_and_back():
    avatar = flat_avatar()
    wide = with_low_pass(avatar, PIXEL)
    grown = np.square(np.asarray(wide.gaussians.scales, np.float64)) - np.square(
        avatar.gaussians.scales, dtype=np.float64
    )
    np.testing.assert_allclose(grown, (EPS2D - MIP_EPS2D) * PIXEL**2, rtol=ROUNDING)
    np.testing.assert_array_equal(wide.gaussians.low_pass, jnp.full_like(wide.gaussians.opacities, PIXEL))
    back = without_low_pass(wide)
    np.testing.assert_allclose(back.gaussians.scales, avatar.gaussians.scales, rtol=ROUNDING)
    assert back.gaussians.low_pass is None


@pytest.mark.parametrize("draw", [render, render_reference])
def test_renderers_add_what_the_scales_do_not_contain(draw):
    gaussians = skin(with_low_pass(two_balls(1), PIXEL), BodyPose(jnp.zeros((3, 3)), jnp.zeros(3)))
    camera = orbit(jnp.asarray([0.0, 0.9, 0.0]), 3.0, jnp.zeros(1), 0.0, intrinsics_from_fov(0.7, 48, 48), 48, 48)[0]
    plain, less = replace(gaussians, low_pass=None), SplatConfig(eps2d=MIP_EPS2D)
    np.testing.assert_array_equal(draw(gaussians, camera).rgb, draw(plain, camera, less).rgb)
    assert jnp.abs(draw(gaussians, camera).rgb - draw(plain, camera).rgb).max() > 0.01
    none = SplatConfig(eps2d=0.0)
    np.testing.assert_array_equal(draw(gaussians, camera, none).rgb, draw(plain, camera, none).rgb)


def test_only_avatars_that_are_drawn_exactly_are_widened():
    avatar = replace(flat_avatar(), rendering="inria")
    assert with_low_pass(avatar, PIXEL) is avatar
    jax.tree.map(np.testing.assert_array_equal, without_low_pass(avatar), avatar)
    wide = with_low_pass(flat_avatar(), PIXEL)
    assert with_low_pass(wide, 2 * PIXEL) is wide


def test_files_keep_the_size_of_the_pixels(tmp_path):
    wide = with_low_pass(flat_avatar(), PIXEL)
    wide.save(tmp_path / "a.npz")
    loaded = Avatar.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(loaded.gaussians.low_pass, wide.gaussians.low_pass)
    with np.load(tmp_path / "a.npz") as arrays:
        spoiled = dict(arrays) | {"low_pass": -arrays["low_pass"]}
    np.savez(tmp_path / "b.npz", **spoiled)
    with pytest.raises(FileError, match="low_pass"):
        Avatar.load(tmp_path / "b.npz")
