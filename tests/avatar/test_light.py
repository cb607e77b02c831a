"""The light and the albedo of two balls, whose normals turn through all directions, are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from avatar_cases import two_balls
from changes import edit_npz

from humangs_jax.avatar.animate import animate, skin
from humangs_jax.avatar.avatar import (
    LIMIT,
    Avatar,
    Light,
    light_terms,
    relit,
    surface_normals,
    turned_normals,
)
from humangs_jax.avatar.reconstruct import with_light
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.geometry.camera import orbit
from humangs_jax.io.reading import FileError

SUN = jnp.asarray([0.15, 0.3, -0.1, 0.05, -0.05, 0.02, 0.05, -0.04])
PHOTOS = jnp.asarray([[0.0, 0.4, 0.0], [0.3, 0.0, 0.1], [0.0, 0.0, 0.0]])
"""Axis-angle rotations of the joints in the photos; the balls turn about their centres."""
TURNED = BodyPose(jnp.asarray([[0.0, 2.0, 0.0], [0.0, 0.0, 1.5], [0.0, 0.0, 0.0]]), jnp.zeros(3))
ESTIMATED = 0.01
"""Largest error of colors up to 1; measured 0.003, from the ridge and from dyes that meet."""
ROUNDING = 2e-6


def in_pose(rotations, count=2):
    """Returns views of one pose, of which only the poses and their number are read."""
    blank, poses = jnp.zeros((count, 1, 1, 3)), jnp.tile(rotations, (count, 1, 1))
    cameras = orbit(jnp.zeros(3), 3.0, jnp.zeros(count), 0.0, jnp.eye(3), 1, 1)
    return SubjectViews(blank, blank[..., 0], cameras, poses, jnp.zeros((count, 3)), jnp.zeros(2))


def normals_in(avatar, pose):
    rest = surface_normals(avatar.rest_vertices, avatar.faces, avatar.gaussians.means)
    linear = skin(replace(avatar, light=None), pose).deformations
    return jnp.einsum("gab,gb->ga", linear, rest)  # these joints only turn


def lit(avatar, albedo, pose):
    """Returns the avatar with the colors that its albedo has in the sun."""
    colors = albedo * jnp.exp(light_terms(normals_in(avatar, pose)) @ SUN)[:, None]
    return replace(avatar, gaussians=replace(avatar.gaussians, colors=colors))


def albedo_of(avatar):
    """Returns an albedo of three dyes with sharp edges."""
    height = avatar.rest_vertices[:, 1:2]
    dyes = jnp.asarray([[0.5, 0.3, 0.2], [0.2, 0.3, 0.5], [0.4, 0.4, 0.4]])
    return jnp.where(height < 0.45, dyes[0], jnp.where(height < 1.3, dyes[1], dyes[2]))


@pytest.fixture(scope="module")
def person():
    avatar, photos = two_balls(3), BodyPose(PHOTOS, jnp.zeros(3))
    albedo = albedo_of(avatar)
    return with_light(lit(avatar, albedo, photos), in_pose(PHOTOS)), albedo


def test_turned_parts_are_lit_from_where_they_were(person):
    avatar, albedo = person
    truth = lit(avatar, albedo, TURNED).gaussians.colors
    assert jnp.abs(avatar.gaussians.colors - truth).mean() > 5 * ESTIMATED
    assert jnp.abs(skin(avatar, TURNED).colors - truth).max() < ESTIMATED
    np.testing.assert_allclose(
        animate(avatar, TURNED).colors, skin(avatar, TURNED).colors, atol=ROUNDING
    )


def test_in_the_pose_of_the_photos_colors_stay(person):
    avatar, _ = person
    posed = skin(avatar, BodyPose(PHOTOS, jnp.zeros(3)))
    np.testing.assert_allclose(posed.colors, avatar.gaussians.colors, atol=ROUNDING)


def test_padding_is_not_a_photo(person):
    avatar, _ = person
    views = in_pose(PHOTOS, 3)
    views = replace(views, rotations=views.rotations.at[2].add(1.0), view_count=jnp.asarray(2))
    np.testing.assert_allclose(
        with_light(avatar, views).light.shading, avatar.light.shading, atol=ROUNDING
    )


def test_colors_have_the_mean_light_of_photos_in_several_poses(person):
    avatar, _ = person
    both, other = in_pose(PHOTOS, 2), TURNED.rotations
    both = replace(both, rotations=both.rotations.at[1].set(other))
    found = with_light(avatar, both).light
    assert jnp.abs(found.coefficients).max() > ESTIMATED
    terms = [light_terms(normals_in(avatar, BodyPose(x, jnp.zeros(3)))) for x in (PHOTOS, other)]
    np.testing.assert_allclose(found.shading, sum(terms) / 2 @ found.coefficients, atol=ROUNDING)


@pytest.mark.slow
def test_bodies_of_one_brightness_have_no_light():
    avatar = two_balls(2)
    grey = replace(
        avatar,
        gaussians=replace(avatar.gaussians, colors=jnp.full_like(avatar.gaussians.colors, 0.4)),
    )
    assert jnp.abs(with_light(grey, in_pose(PHOTOS)).light.coefficients).max() < ROUNDING


@pytest.mark.parametrize("change", ["clear", "black", "one place"])
def test_what_says_nothing_about_the_light_gives_finite_numbers(change):
    avatar = two_balls(2)
    gaussians = avatar.gaussians
    if change == "clear":
        avatar = replace(
            avatar, gaussians=replace(gaussians, opacities=jnp.zeros_like(gaussians.opacities))
        )
    if change == "black":
        avatar = replace(
            avatar, gaussians=replace(gaussians, colors=jnp.zeros_like(gaussians.colors))
        )
    if change == "one place":
        avatar = replace(avatar, rest_vertices=jnp.ones_like(avatar.rest_vertices))
    light = with_light(avatar, in_pose(PHOTOS)).light
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(light))


def test_normals_of_stretched_surfaces_stay_perpendicular_to_them():
    rng = np.random.default_rng(1)
    normals, linear = (
        np.linalg.qr(rng.normal(size=(20, 3, 3)))[0],
        np.eye(3) + 0.4 * rng.normal(size=(20, 3, 3)),
    )
    linear = linear * np.sign(np.linalg.det(linear))[:, None, None]
    got = np.asarray(
        turned_normals(jnp.asarray(normals[:, :, 0], jnp.float32), jnp.asarray(linear, jnp.float32))
    )
    tangents = linear @ normals[:, :, 1:]
    cosines = np.einsum(
        "gi,gij->gj", got, tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    )
    assert np.abs(cosines).max() < 1e-5 and np.abs(np.linalg.norm(got, axis=1) - 1).max() < 1e-6
    assert (np.einsum("gi,gij,gj->g", got, linear, normals[:, :, 0]) > 0).all()


def test_colors_stay_in_range_and_have_gradients():
    normals = jnp.tile(jnp.asarray([[0.0, 0.0, 1.0]]), (3, 1))
    light = Light(jnp.zeros(8), normals, jnp.asarray([-9.0, 9.0, 0.0]))
    colors = jnp.asarray([[0.9, 0.3, 0.0], [0.5, 0.5, 0.5], [1.2, 0.1, 0.1]])
    got = relit(colors, light, jnp.tile(jnp.eye(3), (3, 1, 1)))
    brightest, darkest = np.exp(LIMIT), np.exp(-LIMIT)
    expected = [[1.0, 0.3 * brightest, 0.0], [0.5 * darkest] * 3, [1.2, 0.1, 0.1]]
    np.testing.assert_allclose(got, expected, rtol=1e-6)
    flat = jnp.zeros((3, 3, 3))  # no normal is left
    slope = jax.grad(lambda linear: relit(colors, light, linear).sum())(flat)
    assert np.isfinite(slope).all()


def test_files_keep_the_light_and_say_what_is_missing(person, tmp_path):
    avatar, _ = person
    avatar.save(tmp_path / "a.npz")
    jax.tree.map(np.testing.assert_array_equal, Avatar.load(tmp_path / "a.npz"), avatar)
    edit_npz(tmp_path / "a.npz", light_normals=None)
    with pytest.raises(FileError, match=r"missing keys \['light_normals'\]"):
        Avatar.load(tmp_path / "a.npz")


def test_selected_gaussians_keep_their_light(person):
    avatar, _ = person
    index = np.arange(0, len(avatar.gaussians.means), 3)
    few = avatar.select(index)
    np.testing.assert_allclose(
        skin(few, TURNED).colors, skin(avatar, TURNED).colors[index], atol=ROUNDING
    )
