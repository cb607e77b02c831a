import json

import equinox
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from changes import edit_npz
from small import small_avatar

from humangs_jax.avatar.animate import animate, skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.splats import write_ply
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.io.reading import FileError
from humangs_jax.rendering.gaussians import covariances

COVARIANCE_TOLERANCE = 2e-5  # relative to the largest entry: a float32 SVD and its squares


def make_avatar(seed=0):
    return small_avatar(seed, per_vertex=2)


def make_pose(seed=1):
    rng = np.random.default_rng(seed)
    return BodyPose(
        jnp.asarray(rng.normal(size=(3, 3)), jnp.float32),
        jnp.asarray(rng.normal(size=3), jnp.float32),
    )


def test_a_gradient_with_regard_to_an_avatar_leaves_its_integers_out():
    avatar, pose = make_avatar(), make_pose()
    loss = lambda avatar: jnp.sum(jnp.square(skin(avatar, pose).means))
    by_part = jax.grad(lambda part: loss(replace(avatar, gaussians=part)))(avatar.gaussians)
    floats, rest = equinox.partition(avatar, equinox.is_inexact_array)
    by_floats = jax.grad(lambda floats: loss(equinox.combine(floats, rest)))(floats)
    assert np.abs(by_part.means).max() > 0.1 and by_floats.faces is None
    jax.tree.map(np.testing.assert_array_equal, by_part, by_floats.gaussians)
    with_integers = jax.grad(loss, allow_int=True)(avatar)
    np.testing.assert_array_equal(with_integers.skinning_weights, by_floats.skinning_weights)


@pytest.mark.parametrize("functions", [0, 8])
def test_save_and_load_are_exact(tmp_path, functions):
    avatar = make_avatar()
    if functions:
        harmonics = jnp.asarray(
            np.random.default_rng(1).normal(size=(12, functions, 3)), jnp.float32
        )
        avatar = replace(avatar, gaussians=replace(avatar.gaussians, harmonics=harmonics))
    avatar.save(tmp_path / "a.npz")
    loaded = Avatar.load(tmp_path / "a.npz")
    assert jax.tree.structure(loaded) == jax.tree.structure(avatar)
    jax.tree.map(np.testing.assert_array_equal, loaded, avatar)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_batches_of_avatars_are_indexed_and_not_saved(tmp_path):
    people = [make_avatar(seed) for seed in range(3)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *people)
    assert len(batch) == 3 and batch.batch_shape == (3,)
    for one, person in zip(batch, people, strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, person)
    assert batch[-1].parents == people[2].parents and batch
    with pytest.raises(ValueError, match=r"expected one avatar, got a batch \(3,\): save each"):
        batch.save(tmp_path / "all.npz")
    with pytest.raises(
        ValueError, match=r"avatar\.rest_joints: expected shape \(3, 3\), got \(2, 3\)"
    ):
        replace(people[0], rest_joints=people[0].rest_joints[:2]).save(tmp_path / "all.npz")
    assert not any(tmp_path.iterdir())


def test_what_a_file_cannot_hold_is_refused_and_short_numbers_become_float32(tmp_path):
    avatar = make_avatar()
    posed = replace(avatar, gaussians=replace(avatar.gaussians, deformations=jnp.zeros((12, 3, 3))))
    with pytest.raises(ValueError, match="deformations: expected an avatar in the T-pose"):
        posed.save(tmp_path / "a.npz")
    assert not any(tmp_path.iterdir())
    short = jax.tree.map(lambda x: x.astype(jnp.bfloat16) if x.dtype == jnp.float32 else x, avatar)
    short.save(tmp_path / "a.npz")
    loaded = Avatar.load(tmp_path / "a.npz")
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(np.asarray(a, np.float32), b), short, loaded
    )
    assert loaded.gaussians.means.dtype == jnp.float32


def unlike(avatar, **changes):
    """Returns the avatar with other arrays, its own or those of its Gaussians."""
    own = {name: value for name, value in changes.items() if hasattr(avatar, name)}
    drawn = {name: value for name, value in changes.items() if name not in own}
    return replace(avatar, gaussians=replace(avatar.gaussians, **drawn), **own)


def test_no_avatar_is_written_that_could_not_be_read(tmp_path):
    avatar = make_avatar()
    drawn = avatar.gaussians
    path = tmp_path / "nobody.npz"
    for wrong, problem in (
        (avatar.select(np.zeros(0, int)), "means: expected at least one Gaussian"),
        (
            unlike(avatar, rest_vertices=jnp.zeros((0, 3))),
            "rest_vertices: expected at least one vertex",
        ),
        (unlike(avatar, means=drawn.means.at[3, 1].set(jnp.nan)), "means: expected numbers in"),
        (unlike(avatar, scales=drawn.scales.at[3, 1].set(jnp.inf)), "scales: expected numbers in"),
        (
            unlike(avatar, rest_joints=avatar.rest_joints.at[0].set(jnp.inf)),
            "rest_joints: expected numbers in",
        ),
        (
            unlike(avatar, skinning_weights=0 * avatar.skinning_weights),
            "skinning_weights: expected rows with the sum 1",
        ),
    ):
        with pytest.raises(FileError, match=problem) as caught:
            wrong.save(path)
        assert str(caught.value).startswith(f"{path}: ") and not any(tmp_path.iterdir())


def test_broken_files_are_refused_by_name(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(FileNotFoundError, match="no such file"):
        Avatar.load(path)
    path.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=r"a\.npz: not an avatar"):
        Avatar.load(path)
    make_avatar().save(path)
    archive = path.read_bytes()
    version = lambda header: json.dumps(json.loads(str(header)) | {"version": 9})
    for change, message in (
        ({"means": lambda means: means[:, :2]}, "means: expected shape"),
        ({"header": version}, "version 9"),
        ({"faces": None}, "missing keys"),
    ):
        path.write_bytes(archive)
        edit_npz(path, **change)
        with pytest.raises(ValueError, match=message):
            Avatar.load(path)


@pytest.mark.parametrize("skinning", ["affine", "rotation"])
def test_a_rigid_motion_moves_everything_rigidly(skinning):
    avatar = replace(make_avatar(), skinning=skinning)
    turn = jnp.zeros((3, 3)).at[0].set(jnp.asarray([0.3, -0.7, 0.2]))
    moved = animate(avatar, BodyPose(turn, jnp.asarray([0.1, 0.2, -0.3])))
    from humangs_jax.geometry.quaternion import matrix_from_axis_angle

    R, root = np.asarray(matrix_from_axis_angle(turn[0])), np.asarray(avatar.rest_joints[0])
    expected = (
        (np.asarray(avatar.gaussians.means) - root) @ R.T + root + np.asarray([0.1, 0.2, -0.3])
    )
    np.testing.assert_allclose(moved.means, expected, atol=1e-5)
    exact = R @ np.asarray(covariances(avatar.gaussians)) @ R.T
    assert (
        np.abs(np.asarray(covariances(moved)) - exact).max()
        < COVARIANCE_TOLERANCE * np.abs(exact).max()
    )


def test_five_arrays_say_what_the_deformation_says():
    avatar, pose = make_avatar(), make_pose()
    deformed, plain = skin(avatar, pose), animate(avatar, pose)
    assert deformed.deformations is not None and plain.deformations is None
    exact = np.asarray(covariances(deformed))
    scale = np.abs(exact).max(axis=(1, 2), keepdims=True)
    assert (np.abs(np.asarray(covariances(plain)) - exact) < COVARIANCE_TOLERANCE * scale).all()
    np.testing.assert_allclose(np.linalg.norm(plain.quats, axis=-1), 1, atol=1e-5)


def test_ply_has_the_fields_of_rest_that_some_viewers_want(tmp_path):
    import plyfile

    write_ply(tmp_path / "a.ply", make_avatar().gaussians, rest_fields=True)
    names = plyfile.PlyData.read(str(tmp_path / "a.ply"))["vertex"].data.dtype.names
    assert sum(name.startswith("f_rest_") for name in names) == 45


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda a, p: (a, replace(p, rotations=p.rotations.at[1, 2].set(jnp.nan))),
            r"pose\.rotations: .*\[1, 2\]: nan",
        ),
        (
            lambda a, p: (a, replace(p, translation=p.translation.at[0].set(jnp.inf))),
            r"pose\.translation",
        ),
        (
            lambda a, p: (
                replace(a, gaussians=replace(a.gaussians, opacities=a.gaussians.opacities + 9)),
                p,
            ),
            "opacities",
        ),
        (lambda a, p: (a, replace(p, rotations=p.rotations[:1])), "expected one pose of 3 joints"),
        (lambda a, p: (a, jax.tree.map(lambda x: x[None], p)), "use jax.vmap for a batch of poses"),
    ],
)
def test_animate_names_what_it_cannot_use(change, message):
    avatar, pose = change(make_avatar(), make_pose())
    with pytest.raises(ValueError, match=message):
        animate(avatar, pose)
