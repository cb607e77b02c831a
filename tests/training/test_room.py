"""How much room for (splat, tile) pairs a training step has."""

import dataclasses
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from training_cases import batch_of

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.reconstruct import completed_avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.buffers import plan_buffers, round_up
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render
from humangs_jax.training import room
from humangs_jax.training.config import tiny
from humangs_jax.training.forward import reconstruct_example
from humangs_jax.training.room import needed_room, with_measured_room, with_twice_the_room
from humangs_jax.training.state import init_state

CONFIG = tiny()


@pytest.fixture
def measured(monkeypatch, body):
    """Returns a function (rows, pairs, config) -> configuration for targets with these needs.

    The usual room is 4000, and any measurement is worth its time.
    """
    monkeypatch.setattr(room, "usual_room", lambda config, body: 4000)
    monkeypatch.setattr(room, "WORTH", 1)

    def run(rows, pairs, config=CONFIG):
        monkeypatch.setattr(room, "needed_room", lambda *_: (np.int32(rows), np.int32(pairs)))
        return inspect.unwrap(with_measured_room)(config, {}, body, jnp.zeros((2, 1))).splat

    return run


def test_a_step_has_room_for_twice_what_its_targets_need(measured):
    splat = measured(100, 500)
    assert (splat.max_rows, splat.max_pairs) == (round_up(200), round_up(1000))


def test_where_nothing_is_saved_or_the_room_is_given_it_stays(measured, monkeypatch):
    assert measured(100, 2000) == CONFIG.splat
    given = dataclasses.replace(CONFIG, splat=SplatConfig(max_pairs=77))
    assert measured(1, 1, given) == given.splat
    monkeypatch.setattr(room, "WORTH", 4001)
    assert measured(1, 1) == CONFIG.splat


def test_what_overflows_gets_twice_the_room_and_never_more_than_usual(measured, body):
    config = dataclasses.replace(CONFIG, splat=measured(100, 500))
    first = with_twice_the_room(config, body)
    assert (first.splat.max_rows, first.splat.max_pairs) == (448, 2048)
    assert with_twice_the_room(first, body) == CONFIG


@pytest.mark.slow
def test_the_need_is_that_of_the_most_demanding_target(body, captures):
    batch = batch_of(body, captures, dataclasses.replace(CONFIG, batch_size=2))
    state = init_state(CONFIG)
    found = [int(x) for x in needed_room(state.variables, body, batch, CONFIG)]

    @jax.jit
    def posed(example):
        outputs, _ = reconstruct_example(state.variables, body, example.inputs, CONFIG)
        avatar = completed_avatar(outputs, body, example.inputs, CONFIG.model)
        poses = jax.vmap(BodyPose)(example.targets.rotations, example.targets.translations)
        return jax.vmap(lambda pose: skin(avatar, pose))(poses)

    needs = []
    for i in range(2):
        example = jax.tree.map(lambda x, i=i: x[i], batch)
        for v in range(CONFIG.views.target_count):
            one = jax.tree.map(lambda x, v=v: x[v], (posed(example), example.targets.cameras))
            planned = plan_buffers(*one, CONFIG.splat, margin=1.0)
            needs.append((planned.max_rows, planned.max_pairs))
    assert [round_up(most) for most in found] == np.max(needs, axis=0).tolist()


@pytest.mark.slow
def test_more_room_changes_no_bit_of_an_image_and_its_gradient():
    """A resumed run measures again, and must make the same steps."""
    generator = np.random.default_rng(0)
    camera = Camera(jnp.asarray([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]), jnp.eye(4), 32, 32)
    gaussians = Gaussians(
        means=jnp.asarray(generator.normal(size=(200, 3)) * 0.4 + [0, 0, 3], jnp.float32),
        quats=jnp.asarray(generator.normal(size=(200, 4)), jnp.float32),
        scales=jnp.full((200, 3), 0.05, jnp.float32),
        opacities=jnp.full(200, 0.5, jnp.float32),
        colors=jnp.asarray(generator.random((200, 3)), jnp.float32),
    )
    needed = plan_buffers(gaussians, camera, margin=1.0)

    def drawn(times):
        splat = SplatConfig(max_pairs=times * needed.max_pairs, max_rows=times * needed.max_rows)
        loss = lambda g: jnp.sum(jnp.sin(render(g, camera, splat).rgb))
        return jax.jit(jax.value_and_grad(loss))(gaussians)

    jax.tree.map(np.testing.assert_array_equal, drawn(1), drawn(3))
