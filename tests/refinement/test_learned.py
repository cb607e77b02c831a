"""The learned update: what it sees, what the shipped one gains; untrained it does nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement_cases import toy_avatar, toy_capture

from humangs_jax.core.pytree import replace
from humangs_jax.data.prepared import prepare_capture
from humangs_jax.refinement import learned
from humangs_jax.refinement.learned import (
    COLUMNS,
    PERSON,
    Refiner,
    Signals,
    clusters_of,
    graph_of,
    load_refiner,
    neighbor_mean,
    neighbors_of,
    photo_signals,
    refiner_iteration,
    save_refiner,
    stacked,
    unstacked,
)
from humangs_jax.refinement.objective import parameters_of, posed_gaussians
from humangs_jax.refinement.photos import crop_to_person, photos_of
from humangs_jax.rendering.buffers import plan_buffers
from humangs_jax.rendering.splatting import render

DIFFERENCE, DIFFERENCES = 1e-3, 2e-2  # of a color; float32 sums over some thousand pixels
ROUNDING = 1e-5


@pytest.fixture(scope="module")
def scene(body):
    """Returns (avatar, one photo of it in other colors, parameters, configuration of splatting)."""
    avatar = toy_avatar(body, 0.0)
    views = crop_to_person(prepare_capture(toy_capture(body, toy_avatar(body, 0.15))))
    photo = photos_of(views)[0]
    splat = dataclasses.replace(
        plan_buffers(avatar.gaussians, views.cameras, margin=2.0), visibility=True
    )
    return avatar, photo, parameters_of(avatar.gaussians), splat


iterate = jax.jit(refiner_iteration)


def drawn(scene, parameters):
    avatar, photo, _, splat = scene
    return render(posed_gaussians(parameters, avatar, photo), photo.camera, splat)


def signals_of(scene, photo=None):
    avatar, own, parameters, splat = scene
    return jax.jit(photo_signals, static_argnames="splat")(parameters, avatar, photo or own, splat)[
        0
    ]


def test_neighbors_are_mutual_and_near():
    means = np.random.default_rng(0).normal(size=(200, 3))
    graph = jax.tree.map(np.asarray, neighbors_of(means, 5))
    present = graph.share > 0
    pairs = {(i, int(j)) for i in range(200) for j in graph.index[i][present[i]]}
    assert pairs == {(j, i) for i, j in pairs} and all(i != j for i, j in pairs)
    distances = np.linalg.norm(means[:, None] - means[None], axis=-1)
    nearest = np.argsort(distances, axis=1)[:, 1:6]
    assert pairs == {(i, int(j)) for i in range(200) for j in nearest[i] if i in nearest[j]}
    np.testing.assert_allclose(graph.share.sum(axis=1), present.any(axis=1), atol=1e-6)


def test_the_gradient_of_the_mean_is_its_transpose():
    rng = np.random.default_rng(2)
    graph = neighbors_of(rng.normal(size=(60, 3)), 6)
    matrix = np.stack(
        [np.asarray(neighbor_mean(column[:, None], graph))[:, 0] for column in jnp.eye(60)], axis=1
    )
    values, cotangent = (jnp.asarray(rng.normal(size=(60, 2)), jnp.float32) for _ in range(2))
    mean, pull_back = jax.vjp(lambda x: neighbor_mean(x, graph), values)
    np.testing.assert_allclose(mean, matrix @ values, atol=ROUNDING)
    np.testing.assert_allclose(pull_back(cotangent)[0], matrix.T @ cotangent, atol=ROUNDING)


def test_clusters_are_of_equal_size_and_near():
    means = np.random.default_rng(4).normal(size=(1024, 3))
    members = clusters_of(means)
    assert members.shape == (512, 2) and (np.sort(members.ravel()) == np.arange(1024)).all()
    within = np.linalg.norm(means[members[:, 0]] - means[members[:, 1]], axis=-1).mean()
    assert within < 0.5 * np.linalg.norm(means[:512] - means[512:], axis=-1).mean()
    assert clusters_of(2 * means).tolist() == members.tolist()


@pytest.mark.parametrize("count", [1, 3, 700])
def test_every_gaussian_is_in_a_cluster_whatever_their_number(count):
    means = np.random.default_rng(5).normal(size=(count, 3))
    graph = jax.tree.map(np.asarray, graph_of(means))
    assert set(graph.members.ravel()) == set(range(count)) and graph.members.shape == (
        512,
        -(-count // 512),
    )
    assert graph.nearest.shape == graph.weights.shape == (count, 4)
    np.testing.assert_allclose(graph.weights.sum(axis=1), 1, atol=ROUNDING)
    assert (np.diff(graph.weights, axis=1) <= 0).all()


@pytest.mark.slow
def test_clusters_carry_what_one_end_knows_to_the_other(scene):
    avatar, _, parameters, _ = scene
    values, graph = stacked(parameters), graph_of(np.asarray(avatar.gaussians.means))
    signals = jax.tree.map(lambda x: x[None], signals_of(scene))
    hidden = jnp.zeros((len(values), Refiner.width))

    def moves(hidden):
        return iterate(load_refiner(), values, values, hidden, signals, graph, avatar)[0] - values

    lowest, highest = np.argsort(np.asarray(values[:, 1]))[[0, -1]]
    changed = moves(hidden.at[lowest].set(10.0)) - moves(hidden)
    assert np.abs(changed[highest]).max() > 0


def test_parameters_side_by_side_and_back(scene):
    parameters = scene[2]
    values = stacked(parameters)
    assert values.shape == (len(parameters.means), COLUMNS)
    jax.tree.map(np.testing.assert_array_equal, unstacked(values, parameters), parameters)


@pytest.mark.slow
def test_pixels_are_the_sums_of_the_weights(scene):
    signals, rendering = signals_of(scene), drawn(scene, scene[2])
    per_person = PERSON / float(scene[1].mask.sum())
    assert float(signals.pixels.sum()) == pytest.approx(
        per_person * float(rendering.alpha.sum()), rel=1e-4
    )
    assert (np.asarray(signals.pixels) >= -ROUNDING).all()
    np.testing.assert_allclose(signals.visibility, rendering.visibility, atol=ROUNDING)


def test_gradients_are_those_of_the_squared_error(scene):
    _, photo, parameters, _ = scene
    most = int(np.argmax(signals_of(scene).pixels))

    def error(shift):
        moved = replace(parameters, color_logits=parameters.color_logits.at[most].add(shift))
        rendering = drawn(scene, moved)
        squared = np.square(rendering.rgb - photo.image, dtype=np.float64)
        return (np.asarray(photo.mask, np.float64)[..., None] * squared).sum()

    slope = (error(DIFFERENCE) - error(-DIFFERENCE)) / (2 * DIFFERENCE)
    gradient = (
        np.asarray(signals_of(scene).gradients)[most, 11:].sum() * float(photo.mask.sum()) / PERSON
    )
    assert gradient == pytest.approx(slope, rel=DIFFERENCES)


def test_the_background_says_nothing_of_colors_but_something_of_the_rest(scene):
    # the rims of Gaussians stand before the background
    photo = replace(scene[1], mask=jnp.round(scene[1].mask))
    black = replace(photo, image=photo.mask[..., None] * photo.image)
    before, after = (np.asarray(signals_of(scene, x).gradients) for x in (photo, black))
    np.testing.assert_allclose(
        after[:, 11:], before[:, 11:], atol=ROUNDING * np.abs(before[:, 11:]).max()
    )
    assert np.abs(after - before)[:, :11].max() > 0.01 * np.abs(before[:, :11]).max()


def test_pixels_that_do_not_count_say_nothing(scene):
    photo = scene[1]
    signals = signals_of(scene, replace(photo, counted=jnp.zeros_like(photo.counted)))
    assert not np.asarray(signals.gradients).any() and np.asarray(signals.pixels).any()


def test_untrained_it_changes_nothing_and_trained_it_does(scene):
    avatar, _, parameters, _ = scene
    values, graph = stacked(parameters), graph_of(np.asarray(avatar.gaussians.means))
    signals = jax.tree.map(lambda x: x[None], signals_of(scene))
    hidden = jnp.zeros((len(values), Refiner.width))
    fresh = jax.jit(Refiner().init)(
        jax.random.key(0), values, values, hidden, signals, graph, jnp.zeros(3)
    )
    shipped = load_refiner()
    assert jax.tree.map(jnp.shape, fresh) == jax.tree.map(jnp.shape, shipped)
    same, carried = iterate(fresh, values, values, hidden, signals, graph, avatar)
    np.testing.assert_array_equal(same, values)
    assert np.asarray(carried).any()
    moved, _ = iterate(shipped, values, values, hidden, signals, graph, avatar)
    assert np.isfinite(moved).all() and (np.asarray(moved) != np.asarray(values)).any()


def test_the_order_of_photos_does_not_matter(scene):
    avatar, _, parameters, _ = scene
    rng, values = np.random.default_rng(3), stacked(parameters)
    graph, g = graph_of(np.asarray(avatar.gaussians.means)), len(values)
    signals = Signals(
        *(
            jnp.asarray(rng.random(shape), jnp.float32)
            for shape in ((3, g, COLUMNS), (3, g), (3, g))
        )
    )

    def run(s):
        return iterate(
            load_refiner(), values, values, jnp.zeros((g, Refiner.width)), s, graph, avatar
        )[0]

    np.testing.assert_allclose(
        run(signals), run(jax.tree.map(lambda x: x[::-1], signals)), atol=ROUNDING
    )


def test_weights_are_read_as_written(tmp_path, monkeypatch):
    changed = jax.tree.map(lambda x: x + 1, load_refiner())
    save_refiner(tmp_path / "refiner.safetensors", changed)
    monkeypatch.setattr(learned.resources, "files", lambda _: tmp_path)
    monkeypatch.setattr(learned, "SHIPPED", "refiner.safetensors")
    jax.tree.map(np.testing.assert_array_equal, learned.load_refiner.__wrapped__(), changed)
