"""The avatar in 16-bit arrays: the page reads the avatar, up to the step of its numbers."""

import gzip

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small import small_avatar, small_body

from humangs_jax.avatar.avatar import Avatar, Light
from humangs_jax.body.model import shape_body
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import EPS2D, MIP_EPS2D
from humangs_jax.viewer import page as packing

STEP = 1 / 65535
HALF = 0.5 * (1 + 1e-6)
"""Largest error in steps: half a step, and a margin for float64."""


def unpack(packed):
    """Returns the arrays by name, as the page reads them."""
    entries = packed.header["arrays"].items()

    def read(e):
        return np.frombuffer(packed.data, e["type"], int(np.prod(e["shape"])), e["offset"]).reshape(
            e["shape"]
        )

    return {name: read(entry) for name, entry in entries}


def decoded(packed):
    """Returns the arrays dequantized, as scene.js and project.frag do it."""
    arrays, header = unpack(packed), packed.header

    def spread(name):
        return np.asarray(header[name]["low"]) + arrays[name] * STEP * (
            np.asarray(header[name]["high"]) - np.asarray(header[name]["low"])
        )

    weights = np.zeros((header["count"], max(256, len(header["parents"]))))
    np.add.at(
        weights,
        (np.arange(header["count"])[:, None], arrays["weight_joints"]),
        arrays["weights"] * STEP,
    )
    return {
        "means": spread("means"),
        "scales": np.exp(spread("scales")),
        "colors": spread("colors"),
        "quats": arrays["quats"] / 32767,
        "opacities": arrays["opacities"] * STEP,
        "weights": weights[:, : len(header["parents"])],
    }


@given(st.integers(0, 10_000))
def test_what_the_page_reads_is_the_avatar(seed):
    avatar = small_avatar(seed)
    double = lambda x: np.asarray(x, np.float64)
    got, g = decoded(packing.pack(avatar)), avatar.gaussians
    means, logs, quats = double(g.means), np.log(double(g.scales)), double(g.quats)
    assert (np.abs(got["means"] - means) <= HALF * STEP * np.ptp(means, axis=0)).all()
    assert np.abs(np.log(got["scales"]) - logs).max() <= HALF * STEP * np.ptp(logs)
    assert np.abs(got["opacities"] - double(g.opacities)).max() <= HALF * STEP
    assert np.abs(got["colors"] - double(g.colors)).max() <= HALF * STEP
    assert (
        np.abs(got["quats"] - quats / np.linalg.norm(quats, axis=1, keepdims=True)).max()
        <= HALF / 32767
    )
    assert np.abs(got["weights"] - double(avatar.skinning_weights)).max() <= 3 * STEP


def test_harmonics_are_kept():
    avatar = small_avatar()
    harmonics = np.random.default_rng(0).normal(size=(len(avatar.gaussians.means), 8, 3))
    gaussians = replace(avatar.gaussians, harmonics=jnp.asarray(harmonics, jnp.float32))
    packed = packing.pack(replace(avatar, gaussians=gaussians))
    low, high = packed.header["harmonics"]["low"], packed.header["harmonics"]["high"]
    got = low + unpack(packed)["harmonics"] * STEP * (high - low)
    assert (
        got.shape == harmonics.shape
        and np.abs(got - harmonics).max() <= HALF * STEP * (high - low) + 1e-6
    )


def test_the_light_is_kept():
    avatar, rng = small_avatar(), np.random.default_rng(0)
    normals = rng.normal(size=avatar.gaussians.means.shape)
    numbers = (
        rng.normal(size=8),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        rng.normal(size=len(normals)),
    )
    light = Light(*(jnp.asarray(x, jnp.float32) for x in numbers))
    packed = packing.pack(replace(avatar, light=light))
    arrays, header = unpack(packed), packed.header
    low, high = header["light_shading"]["low"], header["light_shading"]["high"]
    assert header["light"] == [float(x) for x in light.coefficients]
    assert np.abs(arrays["light_normals"] / 127 - np.asarray(light.normals)).max() <= HALF / 127
    shading = low + arrays["light_shading"] * STEP * (high - low)
    assert np.abs(shading - np.asarray(light.shading, np.float64)).max() <= HALF * STEP * (
        high - low
    )


def test_colors_beyond_one_and_flat_gaussians_are_kept():
    avatar = small_avatar()
    gaussians = replace(
        avatar.gaussians,
        colors=2 * avatar.gaussians.colors - 0.5,
        scales=avatar.gaussians.scales * 0,
    )
    got = decoded(packing.pack(replace(avatar, gaussians=gaussians)))
    np.testing.assert_allclose(got["colors"], gaussians.colors, atol=2 * STEP)
    np.testing.assert_allclose(got["scales"], packing.SMALLEST_SCALE, rtol=1e-4)


def test_the_page_adds_no_more_than_the_scales_lack():
    avatar = small_avatar()
    refined = replace(
        avatar,
        gaussians=replace(
            avatar.gaussians, pixel_footprint=jnp.full_like(avatar.gaussians.opacities, 0.004)
        ),
    )
    drawn = [packing.pack(x).header["splatting"] for x in (avatar, refined)]
    assert [x["eps2d"] for x in drawn] == [EPS2D, MIP_EPS2D]
    assert [x["low_pass"] for x in drawn] == pytest.approx([0.0, 0.004])


@pytest.mark.parametrize("joints", [1, 3, 8, 20])
def test_the_largest_weights_come_first_and_sum_to_one(joints):
    rng = np.random.default_rng(joints)
    weights = rng.random((50, joints)) ** 6
    weights /= weights.sum(1, keepdims=True)
    chosen, whole = packing.largest_weights(weights)
    assert chosen.shape == whole.shape == (50, packing.WEIGHTS) and (chosen < joints).all()
    assert (whole.sum(1) == packing.STEPS).all() and (whole >= 0).all()
    assert (np.diff(whole[:, 1:], axis=1) <= 0).all() and (
        whole[:, 0] >= whole[:, 1] - packing.WEIGHTS
    ).all()
    dense = np.zeros((50, joints))
    np.add.at(dense, (np.arange(50)[:, None], chosen), whole * STEP)
    left_out = 1 - np.sort(weights, axis=1)[:, ::-1][:, : packing.WEIGHTS].sum(1)
    assert (np.abs(dense - weights).max(1) <= left_out + 8 * STEP).all()


def test_a_motion_is_kept_to_a_ten_thousandth_of_a_radian():
    rng = np.random.default_rng(0)
    motion = Motion(
        jnp.asarray(rng.uniform(-3, 3, (5, 3, 3)), jnp.float32),
        jnp.asarray(rng.normal(size=(5, 3)), jnp.float32),
    )
    packed = packing.pack(small_avatar(), motion)
    arrays, about = unpack(packed), packed.header["motion"]
    assert about["frames"] == 5 and about["fps"] == 30
    np.testing.assert_allclose(arrays["rotations"] * about["step"], motion.rotations, atol=1e-4)
    np.testing.assert_array_equal(arrays["translations"], motion.translations)


def test_the_shape_is_found_and_its_directions_move_vertices_and_joints():
    avatar, body = small_avatar(betas=(0.3, -1.2)), small_body()
    packed = packing.pack(avatar, body=body)
    arrays, about = unpack(packed), packed.header["shape"]
    np.testing.assert_allclose(about["betas"], [0.3, -1.2], atol=1e-4)
    assert list(about["names"]) == ["wide", "tall"]
    other = np.asarray([1.0, 0.5])
    moved = shape_body(body, jnp.asarray(other, jnp.float32))
    change = other - about["betas"]
    vertices = avatar.rest_vertices + np.einsum(
        "s,sna->na", change, arrays["shape_directions"] * about["step"]
    )
    np.testing.assert_allclose(vertices, moved.vertices, atol=2.5 * packing.SHAPE_STEP)
    np.testing.assert_allclose(
        avatar.rest_joints + np.einsum("s,sja->ja", change, arrays["shape_joints"]),
        moved.joints,
        atol=1e-5,
    )


def test_twenty_thousand_gaussians_take_less_than_two_megabytes_even_if_nothing_repeats():
    rng, g, j = np.random.default_rng(0), 20_000, 55
    weights = np.zeros((g, j))
    np.put_along_axis(weights, rng.integers(0, j, (g, 8)), rng.random((g, 8)), axis=1)
    f32 = lambda *shape: jnp.asarray(rng.random(shape), jnp.float32)
    avatar = Avatar(
        Gaussians(f32(g, 3), f32(g, 4), f32(g, 3), f32(g), f32(g, 3)),
        jnp.asarray(weights / weights.sum(1, keepdims=True), jnp.float32),
        f32(10, 3),
        f32(j, 3),
        jnp.zeros((1, 3), jnp.int32),
        parents=tuple(range(-1, j - 1)),
        joint_names=tuple(map(str, range(j))),
    )
    assert len(gzip.compress(packing.pack(avatar).data)) * 4 / 3 < 1.6e6


def spoiled(name, index, value):
    avatar = small_avatar()
    array = getattr(avatar.gaussians, name)
    return replace(
        avatar, gaussians=replace(avatar.gaussians, **{name: array.at[index].set(value)})
    )


STILL = Motion(jnp.zeros((2, 3, 3)), jnp.zeros((2, 3)), expression_names=("smile",))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((spoiled("means", (3, 1), np.nan),), r"gaussians\.means"),
        ((spoiled("opacities", 2, 1.5),), r"gaussians\.opacities"),
        (
            (small_avatar(), Motion(jnp.zeros((2, 52, 3)), jnp.zeros((2, 3)))),
            "the motion has 52 joints, the avatar has 3",
        ),
        (
            (small_avatar(), Motion(jnp.full((2, 3, 3), jnp.inf), jnp.zeros((2, 3)))),
            r"motion\.rotations",
        ),
        (
            (small_avatar(), replace(STILL, expressions=jnp.full((2, 1), jnp.nan))),
            r"motion\.expressions",
        ),
        ((small_avatar(), None, small_body(seed=9)), "does not explain the avatar's vertices"),
        ((jax.tree.map(lambda x: x[:0], small_avatar()),), "has no Gaussians"),
    ],
)
def test_what_cannot_be_drawn_is_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        packing.pack(*arguments)
    assert "\n" not in str(error.value)
