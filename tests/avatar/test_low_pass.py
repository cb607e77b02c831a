import jax
import jax.numpy as jnp
import numpy as np
import pytest
from avatar_cases import two_balls
from changes import edit_npz

from humangs_jax.avatar.animate import (
    pixel_sizes,
    skin,
    with_pixel_footprint,
    without_pixel_footprint,
)
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.io.reading import FileError
from humangs_jax.rendering.gaussians import Gaussians, widened
from humangs_jax.rendering.projection import project_gaussians as project
from humangs_jax.rendering.reference import render_reference
from humangs_jax.rendering.splat_config import EPS2D, MIP_EPS2D, SplatConfig
from humangs_jax.rendering.splatting import render

PIXEL = 0.0086
ROUNDING = 3e-4
"""Relative error of scales of a tenth of a pixel: float32 keeps 1e-7 of the low-pass's variance."""


def flat_avatar():
    avatar = two_balls(1)
    scales = avatar.gaussians.scales * jnp.asarray([1.0, 1.0, PIXEL / 10 / 0.0125])
    return replace(avatar, gaussians=replace(avatar.gaussians, scales=scales))


def test_variances_grow_by_the_low_pass_and_back():
    avatar = flat_avatar()
    wide = with_pixel_footprint(avatar, PIXEL)
    grown = np.square(np.asarray(wide.gaussians.scales, np.float64)) - np.square(
        avatar.gaussians.scales, dtype=np.float64
    )
    np.testing.assert_allclose(grown, (EPS2D - MIP_EPS2D) * PIXEL**2, rtol=ROUNDING)
    np.testing.assert_array_equal(
        wide.gaussians.pixel_footprint, jnp.full_like(wide.gaussians.opacities, PIXEL)
    )
    back = without_pixel_footprint(wide)
    np.testing.assert_allclose(back.gaussians.scales, avatar.gaussians.scales, rtol=ROUNDING)
    assert back.gaussians.pixel_footprint is None


@pytest.mark.slow
@pytest.mark.parametrize("draw", [render, render_reference])
def test_renderers_add_what_the_scales_do_not_contain(draw):
    gaussians = skin(
        with_pixel_footprint(two_balls(1), PIXEL), BodyPose(jnp.zeros((3, 3)), jnp.zeros(3))
    )
    camera = orbit(
        jnp.asarray([0.0, 0.9, 0.0]),
        3.0,
        jnp.zeros(1),
        0.0,
        intrinsics_from_fov(0.7, 48, 48),
        48,
        48,
    )[0]
    plain, less = replace(gaussians, pixel_footprint=None), SplatConfig(eps2d=MIP_EPS2D)
    # nothing is dimmed
    of_larger_pixels = replace(gaussians, pixel_footprint=jnp.full_like(gaussians.opacities, 1.0))
    # float32
    np.testing.assert_allclose(
        draw(of_larger_pixels, camera).rgb, draw(plain, camera, less).rgb, atol=1e-6
    )
    assert jnp.abs(draw(gaussians, camera).rgb - draw(plain, camera).rgb).max() > 0.01
    none = SplatConfig(eps2d=0.0)
    np.testing.assert_array_equal(draw(gaussians, camera, none).rgb, draw(plain, camera, none).rgb)


def test_only_avatars_that_are_drawn_exactly_are_widened():
    avatar = replace(flat_avatar(), rendering="inria")
    assert with_pixel_footprint(avatar, PIXEL) is avatar
    jax.tree.map(np.testing.assert_array_equal, without_pixel_footprint(avatar), avatar)
    wide = with_pixel_footprint(flat_avatar(), PIXEL)
    assert with_pixel_footprint(wide, 2 * PIXEL) is wide


def test_files_keep_the_size_of_the_pixels(tmp_path):
    wide = with_pixel_footprint(flat_avatar(), PIXEL)
    wide.save(tmp_path / "a.npz")
    loaded = Avatar.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(loaded.gaussians.pixel_footprint, wide.gaussians.pixel_footprint)
    edit_npz(tmp_path / "a.npz", low_pass=lambda sizes: -sizes)
    with pytest.raises(FileError, match="low_pass"):
        Avatar.load(tmp_path / "a.npz")


def test_fine_things_weigh_the_same_in_small_images():
    """Opacity times area of a Gaussian thinner than a pixel stays that of the images it was fitted
    to.
    """
    fine = 0.002
    one = Gaussians(
        jnp.zeros((1, 3)),
        jnp.asarray([[1.0, 0, 0, 0]]),
        jnp.full((1, 3), fine),
        jnp.asarray([0.5]),
        jnp.ones((1, 3)),
    )
    wide = replace(
        one, scales=widened(one.scales, jnp.full(1, fine)), pixel_footprint=jnp.full(1, fine)
    )

    def weight(gaussians, size):
        camera = orbit(
            jnp.zeros(3), 3.0, jnp.zeros(1), 0.0, intrinsics_from_fov(0.7, size, size), size, size
        )[0]
        seen = project(gaussians, camera)
        pixel = 3.0 / float(camera.K[0, 0])
        return float(
            seen.dimmed(gaussians.opacities)[0] * jnp.sqrt(seen.determinant[0])
        ) * pixel**2, pixel

    fitted = 3.0 / float(intrinsics_from_fov(0.7, 1, 1)[0, 0]) / fine
    exact, pixel = weight(wide, int(np.ceil(fitted)))
    assert pixel == pytest.approx(fine, rel=1e-3)
    for size in (512, 64, 8):
        assert weight(wide, size)[0] == pytest.approx(exact, rel=1e-3)
    larger, _ = weight(wide, 4096)
    assert larger < exact  # nothing becomes more opaque than it is
    assert weight(replace(wide, pixel_footprint=jnp.full(1, 1.0)), 32)[0] > 20 * exact


def test_nothing_is_dimmed_in_the_photos_that_give_the_size_of_the_pixels():
    """This also holds if their pixels are not square."""
    rest, blank = BodyPose(jnp.zeros((3, 3)), jnp.zeros(3)), jnp.zeros((1, 48, 48, 3))
    K = intrinsics_from_fov(0.7, 48, 48) * jnp.asarray([[0.5], [1.0], [1.0]]) + jnp.zeros(
        (3, 3)
    ).at[0, 2].set(12.0)
    cameras = orbit(jnp.asarray([0.0, 0.9, 0.0]), 3.0, jnp.zeros(1), 0.0, K, 48, 48)
    views = SubjectViews(
        blank, blank[..., 0], cameras, rest.rotations[None], rest.translation[None], jnp.zeros(2)
    )
    avatar = flat_avatar()
    seen = project(skin(with_pixel_footprint(avatar, pixel_sizes(avatar, views)), rest), cameras[0])
    np.testing.assert_allclose(seen.dimming, 1.0, atol=ROUNDING)
    smaller = with_pixel_footprint(avatar, 0.5 * pixel_sizes(avatar, views))
    assert project(skin(smaller, rest), cameras[0]).dimming.max() < 0.99


@pytest.mark.slow
def test_dimmed_splats_are_drawn_as_defined():
    gaussians = skin(
        with_pixel_footprint(flat_avatar(), PIXEL / 10), BodyPose(jnp.zeros((3, 3)), jnp.zeros(3))
    )
    camera = orbit(
        jnp.asarray([0.0, 0.9, 0.0]),
        3.0,
        jnp.zeros(1),
        0.0,
        intrinsics_from_fov(0.7, 48, 48),
        48,
        48,
    )[0]
    drawn, exact = render(gaussians, camera), render_reference(gaussians, camera)
    # float32; another order of operations
    np.testing.assert_allclose(drawn.rgb, exact.rgb, atol=1e-4)
    undimmed = replace(gaussians, pixel_footprint=jnp.ones_like(gaussians.opacities))
    assert jnp.abs(render(undimmed, camera).alpha - drawn.alpha).max() > 0.05


@pytest.mark.slow
def test_dimming_is_differentiable_at_any_size(float64):
    """Sizes include needles, points without extent, and footprints that overflow."""
    camera = orbit(jnp.zeros(3), 3.0, jnp.zeros(1), 0.0, intrinsics_from_fov(0.7, 32, 32), 32, 32)[
        0
    ]
    quats = jnp.asarray([[1.0, 0.2, 0.1, 0]] * 4)
    scales = jnp.asarray([[1e-9, 1e-9, 0.1], [0, 0, 0], [0.01, 0.02, 0.03], [1e7, 1e7, 1e7]])
    gaussians = Gaussians(
        jnp.zeros((4, 3)),
        quats,
        scales,
        jnp.ones(4),
        jnp.ones((4, 3)),
        pixel_footprint=jnp.full(4, 1e-3),
    )
    dimming = lambda scales: jnp.sum(project(replace(gaussians, scales=scales), camera).dimming)
    assert jnp.all(jnp.isfinite(jax.grad(dimming)(scales)))
    singles = replace(gaussians, scales=scales.astype(jnp.float32))
    assert jnp.all((project(singles, camera).dimming > 0) & (project(singles, camera).dimming <= 1))
    step = jnp.zeros((4, 3)).at[2].set(1e-6)
    along = (dimming(scales + step) - dimming(scales - step)) / 2
    assert float(along) == pytest.approx(float(jnp.sum(jax.grad(dimming)(scales) * step)), rel=1e-5)
