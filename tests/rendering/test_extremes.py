"""Every extreme of docs/numerics.md, and random scenes over many decades.

Results are finite, and float32 is close to float64.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy_splatter import splat
from rounding import bound

from experiments import splatting_numerics as cases
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.splatting import SplatConfig, render

DECISION = 1e-5
"""Least image error that is no rounding.

An alpha at 1/255, a transmittance at the stop or two depths were then decided otherwise. Behind an
alpha of 0.999 the error may be a tenth, as in 2 of 3,000 scenes of the second sweep.
"""

SWEEP_GRADIENT = 5e-2
"""Largest relative L2 error of any one gradient, in natural units.

Of 1,500 scenes of the first sweep half are below 1.4e-5, 99 % below 9e-4 and all below 9e-3. The
second, with needles of 1e10 that are 1e8 pixels long, has 1.1e-5 and 7e-3, and one of 0.3.
"""

TYPICAL_GRADIENT = 1.4e-5
"""Relative L2 error of an ordinary scene's gradient: the median of the sweep above.

Without a bias the mean of n such errors has a standard deviation of TYPICAL_GRADIENT |g| / n. With
one it would be as large as TYPICAL_GRADIENT times the mean of |g|.
"""


SMALL = SplatConfig(block=4, chunk=4, max_pairs=256)
"""A configuration that compiles quickly."""


CASES = [
    pytest.param(case, id=name, marks=pytest.mark.slow if case.slow else ())
    for name, case in cases.CASES.items()
]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_case(case):
    # With bounds divided by 3 two cases fail, for reasons that stand: bfloat16 itself rounds by
    # 2^-9, half of its bound; for the needle of 1e6:1 one rounding of 6e-8 is 6e-4 of a gradient
    # that is 1e-4 of its terms, and the bound 2e-3 allows three.
    outcome = cases.measure(case)
    case = dataclasses.replace(case, image=bound(case.image), gradient=bound(case.gradient))
    assert outcome.passes(case), outcome


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_in_float64_only_rounding_is_left(case):
    outcome = cases.measure(case, in_float64=True)
    assert outcome.finite
    assert max(outcome.image, outcome.gradient) <= cases.FLOAT64, outcome


QUICK = [param for param in CASES if not param.marks]


@pytest.mark.parametrize("case", QUICK)
def test_case_against_plain_numpy(case):
    """The image is that of a splatter that shares no code with ours (numpy_splatter.py)."""
    scene = case.build()
    wide = lambda a: np.asarray(a, np.float64)
    arguments = dict(
        zip(
            cases.NAMES,
            map(wide, (*scene.gaussians, scene.K, scene.pose, scene.background)),
            strict=True,
        )
    )
    image, _ = cases.tiled(scene)
    rgb, alpha = splat(**arguments, width=scene.width, height=scene.height)
    np.testing.assert_allclose(wide(image.rgb), rgb, rtol=0, atol=bound(case.image))
    np.testing.assert_allclose(wide(image.alpha), alpha, rtol=0, atol=bound(case.image))


decade = lambda low, high: st.floats(low, high).map(lambda e: 10.0**e)


def check_sweep(scene):
    exact = cases.reference_in_float64(scene)
    outcome = cases.compare(scene, cases.tiled(scene), exact)
    assert outcome.finite
    # then it must be a decision: with more digits the same program is right
    if outcome.image >= bound(DECISION):
        assert cases.compare(scene, cases.tiled_in_float64(scene), exact).image <= cases.FLOAT64, (
            outcome
        )
        return
    assert outcome.gradient < bound(SWEEP_GRADIENT), outcome


def anything(seed, focal, nearest, farthest, smallest, largest):
    """Returns a random scene.

    Every Gaussian has a depth and three scales (metres), log-uniform within these ranges; any
    opacity, some 0, 1 and 1 - 1e-7; a quaternion of a norm from 1e-20 to 1e15; and a place on or
    beside the image.
    """
    rng, count = np.random.default_rng(seed), cases.COUNT
    scene = cases.ordinary(seed)
    K = scene.K.copy()
    K[:2, :2] *= focal / cases.FOCAL
    z = np.exp(rng.uniform(np.log(nearest), np.log(farthest), count))
    size = np.array([cases.WIDTH, cases.HEIGHT])
    slopes = (rng.uniform(-0.3 * size, 1.3 * size, (count, 2)) - K[:2, 2]) / K[[0, 1], [0, 1]]
    special = rng.uniform(size=count) < 0.2
    opacities = np.where(special, rng.choice([0, 1, 1 - 1e-7], count), rng.uniform(0, 1, count))
    scene = cases.changed(
        scene,
        means=np.concatenate([slopes * z[:, None], z[:, None]], axis=1),
        scales=np.exp(rng.uniform(np.log(smallest), np.log(largest), (count, 3))),
        quats=rng.normal(size=(count, 4)) * 10 ** rng.uniform(-20, 15, (count, 1)),
        opacities=opacities,
    )
    return dataclasses.replace(scene, K=K, pose=cases.UNTURNED, unit=float(np.median(z)))


@pytest.mark.slow
@settings(max_examples=100)
@given(
    st.integers(0, 2**20), decade(0, 6), decade(-1.99, 6), decade(0, 3), decade(-7, 3), decade(0, 2)
)
def test_random_scenes_over_many_decades(seed, focal, nearest, depths, smallest, ratio):
    """Scales lie within two decades of each other, depths within three."""
    check_sweep(
        anything(
            seed, focal, nearest, min(nearest * depths, 1e7), smallest, min(smallest * ratio, 1e3)
        )
    )


def test_random_scenes_of_every_size_at_every_depth_at_once():
    """The scenes are always the same hundred: one in 1,500 has other decisions."""
    rng = np.random.default_rng(0)
    for seed, exponent in zip(rng.integers(0, 2**20, 100), rng.uniform(0, 6, 100), strict=True):
        check_sweep(anything(int(seed), float(10**exponent), 0.0101, 1e6, 1e-7, 1e3))


def test_gradients_have_no_signed_bias():
    scenes = [cases.ordinary(seed) for seed in range(8)]
    pairs = [
        [cases.natural(s, draw(s)[1]) for draw in (cases.tiled, cases.reference_in_float64)]
        for s in scenes
    ]
    for name in cases.NAMES:
        found, exact = (np.concatenate([pair[i][name].ravel() for pair in pairs]) for i in (0, 1))
        n = np.count_nonzero(exact)  # K and the pose have zeros
        four_deviations = bound(4 * TYPICAL_GRADIENT) * np.linalg.norm(exact) / n
        assert abs(np.sum(found - exact)) / n < four_deviations, name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ordinary: nothing special", "order: coincident depths"])
def test_decisions_are_the_same_without_jit(name):
    """The image is drawn by `render`, within a larger program, and operation by operation."""
    scene = cases.CASES[name].build()
    gaussians, K, pose, background = scene.arguments()
    view = Camera(K, pose, scene.width, scene.height)
    eager = render(gaussians, view, SMALL, background)
    jitted = jax.jit(lambda g, c, b: render(g, c, SMALL, b))(gaussians, view, background)
    with jax.disable_jit():
        stepwise = render(gaussians, view, SMALL, background)
    for other in (jitted, stepwise):
        assert np.abs(np.asarray(other.rgb) - np.asarray(eager.rgb)).max() < DECISION
        np.testing.assert_array_equal(np.asarray(other.alpha) > 0, np.asarray(eager.alpha) > 0)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.bfloat16, np.float16])
def test_narrow_gaussians_give_a_float32_image_eagerly(dtype):
    scene = cases.narrow_everything(dtype)
    images = []
    for wanted in (None, np.float32):
        gaussians, K, pose, background = scene.arguments(wanted)
        images.append(
            render(gaussians, Camera(K, pose, scene.width, scene.height), SMALL, background).rgb
        )
    np.testing.assert_array_equal(*images)
    assert images[0].dtype == np.float32
