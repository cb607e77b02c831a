"""Errors of `render` and `render_views` for inputs that they cannot draw.

JAX's transformations of these functions are not refused.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from splat_scenes import camera, random_gaussians

from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import stack_cameras
from humangs_jax.rendering.buffers import round_up
from humangs_jax.rendering.splatting import SplatConfig, render, render_views

CONFIG = SplatConfig(max_pairs=1 << 12)
BATCH = stack_cameras([camera(np.float32)] * 3)


def scene():
    return random_gaussians(1, np.float32)


def test_the_error_for_a_batch_of_cameras_names_the_right_function():
    words = (
        r"render draws one camera, got a batch \(3,\): use render_views\(gaussians, cameras\), or"
        r" jax.vmap"
    )
    for draw in (render, jax.jit(render)):
        with pytest.raises(ValueError, match=words):
            draw(scene(), BATCH)


def test_the_error_for_a_single_camera_names_the_right_function():
    with pytest.raises(
        ValueError,
        match="render_views draws cameras with one leading axis, got a single camera: use render",
    ):
        render_views(scene(), camera(np.float32))
    nested = jax.tree.map(lambda leaf: leaf[None], BATCH)
    with pytest.raises(ValueError, match=r"got a batch \(1, 3\)"):
        render_views(scene(), nested)


def test_the_error_for_a_batch_of_sets_names_the_right_function():
    sets = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), scene())
    with pytest.raises(
        ValueError,
        match=r"expected one set of Gaussians, got a batch \(2,\): draw it with jax.vmap",
    ):
        render(sets, camera(np.float32))


@pytest.mark.parametrize(
    ("name", "entry", "words"),
    [
        ("means", np.nan, "expected finite numbers"),
        ("quats", np.inf, "expected finite numbers"),
        ("scales", -1.0, "expected finite numbers >= 0"),
        ("opacities", 1.5, r"expected numbers in \[0, 1\]"),
        ("colors", np.nan, "expected finite numbers"),
        ("deformations", np.nan, "expected finite numbers"),
    ],
)
def test_wrong_values_of_gaussians_are_named(name, entry, words):
    gaussians = scene()
    array = getattr(gaussians, name)
    array = jnp.broadcast_to(jnp.eye(3), (len(gaussians.means), 3, 3)) if array is None else array
    wrong = replace(gaussians, **{name: array.at[5, *[1] * (array.ndim - 1)].set(entry)})
    for draw in (
        lambda: render(wrong, camera(np.float32), CONFIG),
        lambda: render_views(wrong, BATCH, CONFIG),
    ):
        with pytest.raises(
            ValueError,
            match=rf"^render: gaussians.{name}: {words}, but 1 of \d+ are not, the first at \[5",
        ):
            draw()


def test_wrong_values_of_cameras_are_named():
    view = camera(np.float32)
    for change, words in (
        ({"K": view.K.at[0, 2].set(np.nan)}, "camera.K: expected finite numbers"),
        ({"K": view.K.at[1, 1].set(-500.0)}, "camera.K focal lengths: expected finite numbers > 0"),
        (
            {"cam_from_world": view.cam_from_world.at[0, 3].set(np.inf)},
            "camera.cam_from_world: expected finite numbers",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            render(scene(), replace(view, **change), CONFIG)
    with pytest.raises(ValueError, match="render: background: expected finite numbers"):
        render(scene(), view, CONFIG, background=jnp.full(3, np.nan))


def test_inside_transformations_wrong_values_stay_what_they_are():
    gaussians = scene()
    wrong = replace(gaussians, colors=gaussians.colors.at[0].set(np.nan))
    draw = jax.jit(lambda g: render(g, camera(np.float32), CONFIG).rgb)
    assert np.isnan(draw(wrong)).any() and np.isfinite(draw(gaussians)).all()


@given(st.integers(0, 10**9))
def test_capacities_are_few_sufficient_and_not_wasteful(size):
    capacity = round_up(size)
    assert capacity >= max(size, 64) and (size <= 64 or 4 * capacity <= 5 * size + 4)
    while capacity % 2 == 0:
        capacity //= 2
    assert capacity in (1, 3, 5, 7)
    assert round_up(size) <= round_up(size + 1)
