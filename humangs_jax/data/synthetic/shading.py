"""Soft light on posed surfaces: a sky and ground, two or three wide lights, occlusion from a voxel grid, painted wrinkles.

Everything is diffuse or nearly so and fixed in the world, so that a point has one colour from wherever it is seen.
"""

import dataclasses

import numpy as np

from humangs_jax.array_types import Float
from humangs_jax.data.synthetic.fabrics import ALBEDO_LIMIT
from humangs_jax.data.synthetic.surfaces import unit

CELL = 0.025
"""Edge of a voxel of the occupancy grid, metres."""
REACH = (0.045, 0.11)
"""Distances from the surface at which the grid is sampled, metres."""


@dataclasses.dataclass(frozen=True)
class Lights:
    """directions: (k, 3) towards the lights. strengths: (k, 3). sky, ground: (3,) ambient from above and below."""

    directions: Float[np.ndarray, "k 3"]
    strengths: Float[np.ndarray, "k 3"]
    sky: Float[np.ndarray, "3"]
    ground: Float[np.ndarray, "3"]


def sample_lights(rng: np.random.Generator) -> Lights:
    """A key light from above in front, a fill from the other side, one from behind; nearly white."""
    azimuth = rng.uniform(-0.8, 0.8)
    angles = azimuth + np.asarray([0.0, rng.uniform(1.4, 2.4) * rng.choice([-1, 1]), np.pi + rng.uniform(-0.5, 0.5)])
    elevation = np.asarray([rng.uniform(0.5, 1.0), rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.9)])
    directions = np.stack(
        [np.cos(elevation) * np.sin(angles), np.sin(elevation), np.cos(elevation) * np.cos(angles)], -1
    )
    power = np.asarray([rng.uniform(0.55, 0.7), rng.uniform(0.2, 0.32), rng.uniform(0.25, 0.4)])
    tint = 1 + rng.uniform(-0.03, 0.03, (3, 3))
    sky = rng.uniform(0.62, 0.72) * (1 + rng.uniform(-0.02, 0.02, 3))
    return Lights(
        directions.astype(np.float32),
        (power[:, None] * tint).astype(np.float32),
        sky.astype(np.float32),
        (0.62 * sky).astype(np.float32),
    )


def occlusion(vertices: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """(n,) openness of each vertex in [0.35, 1]: how empty the grid is in front of it."""
    low = vertices.min(0) - 6 * CELL
    size = np.ceil((vertices.max(0) + 6 * CELL - low) / CELL).astype(int)
    cells = ((vertices - low) / CELL).astype(int)
    grid = np.zeros(size, np.float32)
    grid[tuple(cells.T)] = 1
    for _ in range(2):
        for axis in range(3):
            grid = (np.roll(grid, 1, axis) + grid + np.roll(grid, -1, axis)) / 3
    dark = np.zeros(len(vertices), np.float32)
    for reach in REACH:
        dark += _trilinear(grid, (vertices + reach * normals - low) / CELL - 0.5) / len(REACH)
    return np.clip(1.08 - 2.6 * dark, 0.35, 1.0)


def _trilinear(grid, at):
    """Grid values at fractional indices (n, 3)."""
    base = np.clip(np.floor(at).astype(int), 0, np.asarray(grid.shape) - 2)
    t = np.clip(at - base, 0, 1).astype(np.float32)
    total = np.zeros(len(at), np.float32)
    for corner in range(8):
        bits = np.asarray([corner & 1, corner >> 1 & 1, corner >> 2])
        total += np.prod(np.where(bits, t, 1 - t), axis=1) * grid[tuple((base + bits).T)]
    return total


def shade(
    lights: Lights,
    albedo: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    openness: Float[np.ndarray, " n"],
    sheen: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """(n, 3) colours in [0, 1] of points with albedo (n, 3), unit normals (n, 3), openness (n,), sheen (n,)."""
    up = 0.5 + 0.5 * normals[:, 1:2]
    light = (lights.ground + (lights.sky - lights.ground) * up) * openness[:, None]
    half = openness[:, None] ** 0.5
    for direction, strength in zip(lights.directions, lights.strengths, strict=True):
        cosine = normals @ direction
        wrapped = np.clip((cosine + 0.25) / 1.25, 0, 1)  # a wide light reaches a little beyond the terminator
        light = light + strength * wrapped[:, None] * half
        gloss = np.clip(cosine, 0, 1) ** 12 * sheen
        albedo = albedo + 0.12 * gloss[:, None] * strength
    return np.clip(np.minimum(albedo, ALBEDO_LIMIT) * light, 0, 0.97).astype(np.float32)


def bend_normals(normals: Float[np.ndarray, "n 3"], slope: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Normals (n, 3) tilted against the gradient (n, 3) of a height field on the surface."""
    along = slope - np.sum(slope * normals, -1, keepdims=True) * normals
    return unit(normals - along)
