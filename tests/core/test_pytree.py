import dataclasses

import jax
import jax.numpy as jnp
import pytest

from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry.camera import Camera


def camera(width=4):
    return Camera(jnp.eye(3), jnp.eye(4), width, 3)


def test_leaves_are_named_and_static_fields_belong_to_the_structure():
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(camera())]
    assert paths == [".K", ".cam_from_world"]
    assert jax.tree.structure(camera(4)) == jax.tree.structure(camera(4)) != jax.tree.structure(camera(5))


def test_rebuilds_skip_the_shape_checks_that_construction_makes():
    batched = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), camera())
    assert batched.K.shape == (2, 3, 3) and batched.width == 4
    focal = jax.vmap(lambda c: c.K[0, 0])(batched)
    assert focal.shape == (2,)
    with pytest.raises(Exception, match="K"):
        Camera(jnp.zeros((2, 3, 3)), jnp.eye(4), 4, 3)


def test_scan_carries_and_jit_retraces_only_for_static_changes():
    traced = []

    @jax.jit
    def step(c):
        traced.append(c.width)
        return replace(c, K=c.K * 2)

    carried, _ = jax.lax.scan(lambda c, _: (step(c), None), camera(), None, length=3)
    assert carried.K[0, 0] == 8
    step(camera()), step(camera()), step(camera(7))
    assert traced.count(7) == 1 and traced.count(4) <= 2


def test_instances_are_immutable_and_replace_knows_the_fields():
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera().width = 3
    with pytest.raises(TypeError, match="no field"):
        replace(camera(), focal=1.0)


def test_defaults_of_static_fields():
    @pytree_dataclass
    class Scene:
        x: jax.Array
        name: str = static_field(default="a")

    assert Scene(jnp.ones(2)).name == "a" and jax.tree.leaves(Scene(jnp.ones(2)))[0].shape == (2,)
