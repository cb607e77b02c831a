"""`fit_scene`: what it accepts and refuses; it learns, grows, stops and continues bit for bit."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import humangs_jax as hg
from humangs_jax.geometry.camera import stack_cameras
from humangs_jax.io.reading import FileError
from humangs_jax.scenes import fitting
from humangs_jax.scenes.config import SceneRates
from humangs_jax.scenes.start import first_gaussians

SIDE = 24
FAST = hg.SceneConfig(
    capacity=150, steps=40, start=60, degree=1, relocate_every=10, growth=1.3, structural=0.2
)


def scene(count=80):
    rng = np.random.default_rng(0)
    d = rng.normal(size=(count, 3))
    return hg.Gaussians(
        jnp.asarray(0.8 * d / np.linalg.norm(d, axis=1, keepdims=True), jnp.float32),
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (count, 1)),
        jnp.full((count, 3), 0.12),
        jnp.full(count, 0.9),
        jnp.asarray(0.5 + 0.45 * np.sin(4 * d), jnp.float32),
    )


def orbit(count=6, side=SIDE):
    K = jnp.asarray([[1.2 * side, 0, side / 2], [0, 1.2 * side, side / 2], [0, 0, 1]])
    azimuths = jnp.linspace(0.0, 5.0, count)
    return hg.orbit(jnp.zeros(3), 3.0, azimuths, 0.3, K, side, side)


@pytest.fixture(scope="module")
def posed():
    cameras = orbit()
    return np.asarray(hg.render_views(scene(), cameras, background="black").rgb), cameras


@pytest.mark.slow
def test_a_scene_is_learned_from_random_points_and_grows_to_its_capacity(posed):
    photos, cameras = posed
    seen = []
    rates = SceneRates(
        means=2e-3, quats=1e-2, log_scales=2e-2, opacity_logits=5e-2, color_logits=5e-2
    )
    config = dataclasses.replace(FAST, steps=200, relocate_every=20, rates=rates)
    fit = hg.fit_scene(
        photos, cameras, config=config, watch=lambda i, g: seen.append((i, len(g.opacities)))
    )
    counts = [count for _, count in seen]
    assert [i for i, _ in seen] == list(range(20, 171, 20))
    assert counts == sorted(counts) and counts[0] > 60 and counts[-1] == 150
    assert fit.steps == 200 and not fit.interrupted and fit.seconds > 0
    assert len(fit.gaussians.opacities) == 150 and fit.gaussians.harmonics.shape == (150, 3, 3)
    start = first_gaussians(None, list(cameras), config)
    assert fit.psnr > 3 + fitting._mean_psnr(
        start, list(cameras), list(photos), jnp.zeros(3), config
    )


@pytest.mark.slow
def test_a_run_that_was_interrupted_continues_bit_for_bit(posed, tmp_path, monkeypatch):
    photos, cameras = posed
    points = np.asarray(scene().means)
    fit = lambda path: hg.fit_scene(photos, cameras, points, FAST, checkpoint=path)
    whole = fit(None)

    def stop(step, gaussians):
        if step == 20:
            raise KeyboardInterrupt

    path = tmp_path / "scene.npz"
    half = hg.fit_scene(photos, cameras, points, FAST, checkpoint=path, watch=stop)
    assert half.interrupted and half.steps == 20
    rest = fit(path)
    assert rest.steps == 40 and not rest.interrupted
    for a, b in zip(jax.tree.leaves(rest.gaussians), jax.tree.leaves(whole.gaussians), strict=True):
        np.testing.assert_array_equal(a, b)
    assert fit(path).steps == 40  # finished: nothing to do
    other = r"scene\.npz: of other photos, cameras, points, settings or another background"
    with pytest.raises(FileError, match=other):
        hg.fit_scene(photos[:, ::-1], cameras, points, FAST, checkpoint=path)
    with pytest.raises(FileError, match=other):
        hg.fit_scene(photos, cameras, points, FAST, checkpoint=path, background="white")
    other = tmp_path / "mine.npz"
    np.savez(other, x=1)
    before = other.read_bytes()
    with pytest.raises(FileError, match="not a checkpoint of fit_scene"):
        fit(other)
    assert other.read_bytes() == before


@pytest.mark.slow
def test_photos_of_several_sizes_and_lenses_from_files_are_fitted_together(tmp_path):
    small, large = orbit(2), orbit(2, 32)
    bent = hg.replace(large, distortion=jnp.tile(jnp.asarray([-0.1, 0.0, 0.0, 0.0]), (2, 1)))
    cameras = [*small, *bent]
    photos = []
    for i, camera in enumerate(cameras):
        image = np.asarray(hg.render(scene(), camera, background="black").rgb)
        Image.fromarray(np.rint(255 * image).astype(np.uint8)).save(tmp_path / f"{i}.png")
        photos.append(tmp_path / f"{i}.png")
    fit = hg.fit_scene(photos, cameras, scene(), dataclasses.replace(FAST, steps=8, growth=1.0))
    assert fit.psnr > 25 and len(fit.gaussians.opacities) == 80
    named = dict(zip("abcd", cameras, strict=True))
    again = hg.fit_scene(photos, named, scene(), dataclasses.replace(FAST, steps=8, growth=1.0))
    np.testing.assert_array_equal(fit.gaussians.means, again.gaussians.means)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            {"images": np.zeros((5, SIDE, SIDE, 3), np.uint8)},
            "images: expected one for each of 6 cameras, got 5",
        ),
        (
            {"images": np.zeros((6, SIDE, 20, 3), np.uint8)},
            r"images\[0\]: expected shape \(24, 24, 3\), got",
        ),
        (
            {"images": np.full((6, SIDE, SIDE, 3), 200.0)},
            r"images\[0\]: expected numbers in \[0, 1\], or bytes",
        ),
        (
            {"points": np.zeros((3, 2))},
            r"points: expected finite numbers \(n, 3\), got shape \(3, 2\)",
        ),
        ({"points": np.full((3, 3), np.nan)}, "points: expected finite numbers"),
        ({"points": (np.zeros((3, 3)), np.zeros((2, 3)))}, "colors of points: expected"),
        (
            {"points": np.random.default_rng(0).normal(size=(151, 3))},
            "151 are more than SceneConfig.capacity 150",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(change, problem):
    given = {"images": np.zeros((6, SIDE, SIDE, 3), np.uint8), "points": None} | change
    with pytest.raises(ValueError, match=problem):
        hg.fit_scene(given["images"], orbit(), given["points"], FAST)


def test_small_photos_say_what_to_set():
    cameras = orbit(side=8)
    photos = np.zeros((6, 8, 8, 3), np.uint8)
    with pytest.raises(
        ValueError, match=r"8 x 8 is too small for SceneConfig\.structural: set it to 0"
    ):
        hg.fit_scene(photos, cameras, config=FAST)


def test_it_begins_where_the_cameras_look_or_at_the_points():
    views = list(orbit())
    random = first_gaussians(None, views, FAST)
    assert random.means.shape == (60, 3) and random.harmonics.shape == (60, 3, 3)
    assert np.linalg.norm(random.means, axis=1).mean() < 2.0  # of a cube of 6 m around all cameras
    points = np.asarray([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]])
    at = first_gaussians((points, np.full((5, 3), 2.0)), views, FAST)
    np.testing.assert_array_equal(at.means, points)
    assert (at.colors == 1).all() and (at.scales > 0).all()
    one = first_gaussians(points[:1], views[:1], FAST)
    assert np.isfinite(one.scales).all()
    given = scene()
    assert first_gaussians(given, views, dataclasses.replace(FAST, degree=0)) is given


def test_every_photo_is_seen_once_before_any_is_seen_again():
    order = [fitting._photo_of_step(i, 7, 3) for i in range(21)]
    assert all(sorted(order[i : i + 7]) == list(range(7)) for i in (0, 7, 14))
    assert order[:7] != order[7:14] and order == [
        fitting._photo_of_step(i, 7, 3) for i in range(21)
    ]
    assert fitting._kind(orbit()[0]) == fitting._kind(stack_cameras(list(orbit()))[1])
