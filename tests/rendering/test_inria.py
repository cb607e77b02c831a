"""The preset `inria` draws what diff-gaussian-rasterization does, here in numpy.

Pixel centres are at whole numbers and tiles have 16 pixels. A splat is drawn on all pixels of the
tiles that its square of three standard deviations meets, and on no other.
"""

import dataclasses

import jax
import numpy as np
import pytest
from splat_scenes import camera, random_gaussians

from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig, drawn_as
from humangs_jax.rendering.splatting import render

SAME = 1e-9
"""Rounding of float64."""

WIDTH, HEIGHT, TILE = 75, 53, 16
INRIA = dataclasses.replace(SPLAT_PRESETS["inria"], block=4, chunk=4)


def test_drawing_as_weights_were_trained_keeps_the_other_knobs():
    inria, own = (
        SPLAT_PRESETS["inria"],
        SplatConfig(near=0.05, radius_sigma=2.5, block=16, max_pairs=1000),
    )
    assert drawn_as(own, "exact") is own
    assert drawn_as(dataclasses.replace(inria, block=16), "inria") == dataclasses.replace(
        inria, block=16
    )
    assert drawn_as(own, "inria") == dataclasses.replace(inria, block=16, max_pairs=1000)
    assert drawn_as(dataclasses.replace(inria, chunk=4), "exact") == SplatConfig(chunk=4)


def rotation(quat):
    """Returns the matrix of a quaternion that is not normalised."""
    r, x, y, z = quat
    return np.asarray(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y)],
            [2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x)],
            [2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def project(gaussians, i, view):
    """Returns (centre, conic, radius, depth) of a splat, or None if it is not drawn."""
    K, pose = np.asarray(view.K), np.asarray(view.cam_from_world)
    p = pose[:3, :3] @ np.asarray(gaussians.means)[i] + pose[:3, 3]
    if p[2] <= 0.2:
        return None
    (fx, _, cx), (_, fy, cy) = K[0], K[1]
    # INRIA's frustum is symmetric; for a shifted one the limits lie 0.3 half fields of view beyond
    # each border
    low = np.asarray([-cx / fx - 0.3 * 0.5 * WIDTH / fx, -cy / fy - 0.3 * 0.5 * HEIGHT / fy])
    high = np.asarray(
        [(WIDTH - cx) / fx + 0.3 * 0.5 * WIDTH / fx, (HEIGHT - cy) / fy + 0.3 * 0.5 * HEIGHT / fy]
    )
    tx, ty = np.clip(p[:2] / p[2], low, high) * p[2]
    J = np.asarray([[fx / p[2], 0, -fx * tx / p[2] ** 2], [0, fy / p[2], -fy * ty / p[2] ** 2]])
    factor = rotation(np.asarray(gaussians.quats)[i]) * np.asarray(gaussians.scales)[i]
    factor = J @ pose[:3, :3] @ factor
    cov = factor @ factor.T + 0.3 * np.eye(2)
    det, middle = np.linalg.det(cov), 0.5 * np.trace(cov)
    radius = np.ceil(3 * np.sqrt(middle + np.sqrt(max(0.1, middle**2 - det))))
    center = np.asarray([fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy]) - 0.5
    return center, np.linalg.inv(cov), radius, p[2]


def draw(gaussians, view, background):
    """Draws splat by splat, each over its rectangle of tiles."""
    splats = [(i, project(gaussians, i, view)) for i in range(len(gaussians.means))]
    splats = sorted(((s[3], i, *s[:3]) for i, s in splats if s is not None), key=lambda s: s[:2])
    color, transmittance = np.zeros((HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH))
    done = np.zeros((HEIGHT, WIDTH), bool)
    for _, i, center, conic, radius in splats:
        grid = np.asarray([-(-WIDTH // TILE), -(-HEIGHT // TILE)])
        low = np.clip(((center - radius) / TILE).astype(int), 0, grid) * TILE  # cast: towards zero
        high = np.clip(((center + radius + TILE - 1) / TILE).astype(int), 0, grid) * TILE
        rows, columns = (slice(a, b) for a, b in zip(low[::-1], high[::-1], strict=True))
        y, x = np.mgrid[:HEIGHT, :WIDTH][:, rows, columns]
        d = np.stack([center[0] - x, center[1] - y], axis=-1)
        power = -0.5 * np.einsum("hwi,ij,hwj->hw", d, conic, d)
        alpha = np.minimum(0.99, float(gaussians.opacities[i]) * np.exp(power))
        drawn = (power <= 0) & (alpha >= 1 / 255) & ~done[rows, columns]
        after = transmittance[rows, columns] * (1 - alpha)
        ends = drawn & (after < 1e-4)
        done[rows, columns] |= ends
        drawn &= ~ends
        weight = np.where(drawn, alpha * transmittance[rows, columns], 0)
        color[rows, columns] += weight[..., None] * np.asarray(gaussians.colors[i])
        transmittance[rows, columns] = np.where(drawn, after, transmittance[rows, columns])
    return color + transmittance[..., None] * background, 1 - transmittance


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_draws_what_the_release_draws(seed):
    with jax.enable_x64(True):
        gaussians = random_gaussians(seed, count=60)
        gaussians = dataclasses.replace(gaussians, deformations=None)
        gaussians = dataclasses.replace(
            gaussians, quats=gaussians.quats * 0.4, scales=gaussians.scales * 0.3
        )
        view = camera(width=WIDTH, height=HEIGHT)
        view = dataclasses.replace(view, K=view.K.at[:2, :2].multiply(3.0))
        expected, alpha = draw(gaussians, view, np.ones(3))
        ours = render(gaussians, view, INRIA)
        np.testing.assert_allclose(ours.rgb, expected, atol=SAME)
        np.testing.assert_allclose(ours.alpha, alpha, atol=SAME)
        exact = render(gaussians, view)
        assert np.abs(exact.rgb - ours.rgb).max() > 1e-3  # the conventions matter
