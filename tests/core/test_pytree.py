import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small import small_avatar, small_body

import humangs_jax as hg
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose
from humangs_jax.core import pytree
from humangs_jax.core.pytree import pytree_dataclass, replace, shape_fault, static_field
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import Rendering


def camera(width=4):
    return Camera(jnp.eye(3), jnp.eye(4), width, 3)


def test_leaves_are_named_and_static_fields_belong_to_the_structure():
    paths = [
        jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(camera())
    ]
    assert paths == [".K", ".cam_from_world"]
    assert (
        jax.tree.structure(camera(4))
        == jax.tree.structure(camera(4))
        != jax.tree.structure(camera(5))
    )


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


def batch(size=3):
    K = jnp.arange(size)[:, None, None] + jnp.eye(3)
    return replace(camera(), K=K, cam_from_world=jnp.broadcast_to(jnp.eye(4), (size, 4, 4)))


def test_a_batch_can_be_indexed_counted_and_iterated_over():
    cameras = batch()
    assert len(cameras) == 3 and cameras.batch_shape == (3,)
    assert [float(one.K[0, 1]) for one in cameras] == [0, 1, 2]
    assert cameras[-1].K[0, 1] == 2 and cameras[-1].batch_shape == () and cameras[-1].width == 4
    assert len(cameras[1:]) == 2 and len(cameras[jnp.asarray([True, False, False])]) == 1
    assert cameras[jnp.asarray(2)].K[0, 1] == 2
    assert jax.jit(lambda c, i: c[i].K)(cameras, 1)[0, 1] == 1
    nested = jax.tree.map(lambda leaf: leaf[None], cameras)
    assert nested.batch_shape == (1, 3) and nested[0].batch_shape == (3,)


def test_an_index_out_of_range_is_refused_where_jax_would_clamp_it():
    cameras = batch()
    for index in (3, -4, np.int64(3), jnp.asarray(3)):
        with pytest.raises(
            IndexError, match=rf"Camera: index {int(index)} is out of range for a batch of 3"
        ):
            cameras[index]
    with pytest.raises(IndexError):
        jax.jit(lambda c: c[3].K)(cameras)
    # JAX indexes traced leaves
    for index in (np.asarray([0, 3]), jnp.asarray([[1, -4]])):
        for take in (lambda c, i=index: c[i], lambda c, i=index: jax.eval_shape(lambda x: x[i], c)):
            with pytest.raises(IndexError, match=r"Camera: index (3|-4) is out of range"):
                take(cameras)
    for index in (np.asarray([2, -3]), np.zeros(0, int), np.asarray([True, False, True])):
        traced = jax.eval_shape(lambda c, i=index: c[i], cameras)
        assert traced.K.shape == cameras[index].K.shape


def test_one_example_is_not_a_batch_but_it_is_there():
    for use in (len, iter, list, lambda c: c[0]):
        with pytest.raises(TypeError, match="this Camera is not a batch"):
            use(camera())
    assert camera() and not list(batch(0)) and batch(0)


def test_every_kind_of_batch_knows_its_axes():
    ones = lambda *shapes: [jnp.asarray(np.ones(shape, np.float32)) for shape in shapes]
    gaussians = Gaussians(*ones((5, 3), (5, 4), (5, 3), 5, (5, 3)))
    for one in (
        BodyPose(*ones((4, 3), 3)),
        gaussians,
        Rendering(*ones((2, 2, 3), (2, 2), (2, 2)), jnp.int32(0)),
    ):
        two = jax.tree.map(lambda leaf: np.stack([leaf] * 2), one)
        assert one.batch_shape == () and two.batch_shape == (2,)
        assert jax.tree.structure(two[1]) == jax.tree.structure(one) and two[1].batch_shape == ()


def test_pytrees_print_on_one_short_line():
    text = repr(camera())
    assert text == "Camera(K=f32[3,3], cam_from_world=f32[4,4], width=4, height=3)"
    body = repr(load_body())
    assert "\n" not in body and len(body) < 1500 and "tuple of 55" in body
    traced = []
    jax.jit(lambda c: (traced.append(repr(c)), c.K)[1])(camera())
    assert traced == [text]


# What is handed in is checked by the annotations
# ----------------------------------------------------------------------

GAUSSIANS = Gaussians(
    jnp.zeros((7, 3)), jnp.ones((7, 4)), jnp.ones((7, 3)), jnp.ones(7), jnp.ones((7, 3))
)
BATCH = jax.tree.map(lambda x: jnp.stack([x, x]), GAUSSIANS)
BYTES = jnp.full((7, 3), 200, jnp.uint8)
FAULTS = {
    "a trailing axis": (
        GAUSSIANS,
        {"opacities": jnp.ones((7, 1))},
        r".opacities: expected shape (7,), got (7, 1)",
    ),
    "a leading axis": (
        GAUSSIANS,
        {"scales": jnp.ones((1, 7, 3))},
        r".scales: expected shape (7, 3), got (1, 7, 3)",
    ),
    "first of all": (
        GAUSSIANS,
        {"means": jnp.ones((7, 3, 1))},
        r".means: expected shape (g, 3), got (7, 3, 1)",
    ),
    "in a batch": (
        BATCH,
        {"opacities": jnp.ones((2, 7, 1))},
        r".opacities: expected shape (7,), got (2, 7, 1)",
    ),
    "too few in a batch": (
        BATCH,
        {"colors": jnp.ones((2, 6, 3))},
        r".colors: expected shape (2, 7, 3), got (2, 6, 3)",
    ),
    "bytes": (
        GAUSSIANS,
        {"colors": BYTES},
        ".colors: expected floating-point numbers, got uint8; colors of 0 to 255 are",
    ),
    "integers": (
        GAUSSIANS,
        {"means": jnp.zeros((7, 3), int)},
        ".means: expected floating-point numbers, got int32; ",
    ),
    "booleans": (
        GAUSSIANS,
        {"opacities": jnp.ones(7, bool)},
        ".opacities: expected floating-point numbers, got bool",
    ),
    "a list": (
        GAUSSIANS,
        {"quats": [[1.0] * 4] * 7},
        ".quats: expected an array of shape (7, 4), got list; jnp.asarray",
    ),
    "nothing": (GAUSSIANS, {"means": None}, ".means: expected an array of shape (g, 3), got None"),
    "pixels": (camera(), {"width": 64.0}, ".width: expected a whole number, got 64.0"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_field_that_does_not_fit_is_named(name):
    tree, changes, words = FAULTS[name]
    assert shape_fault(replace(tree, **changes)).startswith(words)


def test_what_fits_has_no_fault():
    none = replace(GAUSSIANS, pixel_footprint=None)
    of_numpy = jax.tree.map(np.asarray, GAUSSIANS)
    half = jax.tree.map(lambda x: x.astype(jnp.bfloat16), GAUSSIANS)
    for tree in (
        GAUSSIANS,
        none,
        BATCH,
        of_numpy,
        half,
        camera(),
        batch(),
        replace(camera(), width=np.int64(4)),
    ):
        assert shape_fault(tree) is None


# Files of jax.export
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "tree",
    [GAUSSIANS, BATCH, camera(), small_avatar(), small_body()],
    ids=lambda tree: type(tree).__name__,
)
def test_functions_of_public_classes_come_back_from_files_of_jax_export(tree):
    twice = jax.jit(lambda x: jax.tree.map(lambda leaf: leaf * 2, x))
    data = jax.export.export(twice)(tree).serialize()
    back = jax.export.deserialize(data).call(tree)
    assert jax.tree.structure(back) == jax.tree.structure(tree)
    jax.tree.map(np.testing.assert_array_equal, back, twice(tree))


def test_a_structure_comes_back_with_its_static_fields():
    body = small_body()
    back = jax.export.deserialize(jax.export.export(jax.jit(lambda x: x))(body).serialize()).in_tree
    assert back == jax.tree.structure(((body,), {}))


@pytest.mark.wings
def test_every_public_pytree_has_a_name_in_files_of_jax_export():
    values = [getattr(hg, name) for name in hg.__all__]
    public = [value for value in values if isinstance(value, type) and value in pytree._PYTREES]
    assert len(public) >= 5
    assert {f"humangs_jax.{each.__name__}" for each in public} <= set(pytree._EXPORTABLE)
