"""Soft light on posed surfaces: sky and ground, three wide lights, occlusion and soft shadows from a voxel grid, painted folds.

Everything is diffuse or nearly so and fixed in the world, so that a point has one colour from wherever it is seen.
"""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.people.fabrics import ALBEDO_LIMIT
from humangs_jax.people.surfaces import unit

CELL = 0.025
"""Edge of a voxel of the occupancy grid, metres."""
REACH = (0.045, 0.11)
"""Distances from the surface at which the grid is sampled, metres."""


STRIDES = (0.06, 0.085, 0.115, 0.155, 0.205, 0.27, 0.36, 0.47, 0.6)
"""Distances towards the key light at which the grid is sampled for shadows, metres."""
LIFT = 0.03
"""Metres above the surface at which the way to the light begins."""
SHADOW_DENSITY, DARKEST = 2.2, 0.4
"""Extinction per unit of what the samples find, and the share of the key light that is left at least."""

SHOULDER, WHITEST = 0.72, 0.97
"""Brightness from which highlights are compressed, and the one that they approach."""


@dataclasses.dataclass(frozen=True)
class Lights:
    """directions: (k, 3) towards the lights, the key light first. strengths: (k, 3).

    sky, ground: (3,) ambient from above and below. gain: (3,) exposure and white balance of the camera.
    """

    directions: Float[np.ndarray, "k 3"]
    strengths: Float[np.ndarray, "k 3"]
    sky: Float[np.ndarray, "3"]
    ground: Float[np.ndarray, "3"]
    gain: Float[np.ndarray, "3"]


SCENES = {
    "studio": (0.34, (-0.8, 0.8), (0.5, 1.0), (0.5, 0.75), (0.18, 0.34), (0.68, 0.82), 0.0, 0.68),
    "overcast": (0.22, (-3.1, 3.1), (0.7, 1.2), (0.15, 0.4), (0.05, 0.2), (0.85, 1.02), -0.03, 0.6),
    "sun": (0.2, (-3.1, 3.1), (0.45, 1.1), (0.85, 1.2), (0.08, 0.25), (0.56, 0.74), 0.10, 0.68),
    "room": (0.16, (-2.0, 2.0), (0.8, 1.35), (0.4, 0.7), (0.1, 0.3), (0.6, 0.78), 0.12, 0.78),
    "window": (0.08, (0.9, 1.9), (0.1, 0.5), (0.8, 1.1), (0.04, 0.15), (0.5, 0.66), -0.08, 0.8),
}
"""Kinds of light: odds; azimuth and elevation of the key light (radians), its strength, that of the fill, the sky's; how much
warmer the key is than the sky; and the ground's brightness against the sky's."""


def sample_lights(rng: np.random.Generator) -> Lights:
    """A studio, an overcast or a sunny day, a lit room or a window; exposed and balanced by a camera that errs."""
    odds = np.asarray([scene[0] for scene in SCENES.values()])
    scene = list(SCENES.values())[rng.choice(len(SCENES), p=odds / odds.sum())]
    _, azimuths, heights, key, fill, sky_range, warmth, bounce = scene
    azimuth = rng.uniform(*azimuths) * rng.choice([-1, 1])
    angles = azimuth + np.asarray([0.0, rng.uniform(1.4, 2.4) * rng.choice([-1, 1]), np.pi + rng.uniform(-0.5, 0.5)])
    elevation = np.asarray([rng.uniform(*heights), rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.9)])
    directions = np.stack(
        [np.cos(elevation) * np.sin(angles), np.sin(elevation), np.cos(elevation) * np.cos(angles)], -1
    )
    power = np.asarray([rng.uniform(*key), rng.uniform(*fill), rng.uniform(0.4, 1.2) * fill[1]])
    warm = np.asarray([1.0, 0.0, -1.0])
    tint = 1 + rng.uniform(-0.03, 0.03, (3, 3)) + warmth * np.asarray([[1.0], [0.0], [0.0]]) * warm
    sky = rng.uniform(*sky_range) * (1 + rng.uniform(-0.02, 0.02, 3) - 0.5 * warmth * warm)
    exposure, balance, green = np.exp(rng.normal(0.06, 0.12)), rng.normal(0, 0.045), rng.normal(0, 0.012)
    gain = np.clip(exposure, 0.75, 1.3) * np.asarray([1 + balance, 1 + green, 1 - balance])
    return Lights(
        directions.astype(np.float32),
        (power[:, None] * tint).astype(np.float32),
        sky.astype(np.float32),
        (bounce * sky * (1 + rng.uniform(-0.06, 0.06, 3))).astype(np.float32),
        gain.astype(np.float32),
    )


def occlusion(vertices: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """(n,) openness of each vertex in [0.35, 1]: how empty the grid is in front of it."""
    grid, low = _grid(vertices)
    dark = np.zeros(len(vertices), np.float32)
    for reach in REACH:
        dark += _trilinear(grid, (vertices + reach * normals - low) / CELL - 0.5) / len(REACH)
    return np.clip(1.08 - 2.6 * dark, 0.35, 1.0)


def lit_share(
    vertices: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "3"]
) -> Float[np.ndarray, " n"]:
    """(n,) share of a wide light from `direction` that reaches each vertex past the rest of the person, in [DARKEST, 1]."""
    grid, low = _grid(vertices)
    start = vertices + LIFT * normals
    found = np.zeros(len(vertices), np.float32)
    for stride in STRIDES:
        found += _trilinear(grid, (start + stride * direction - low) / CELL - 0.5)
    return np.maximum(np.exp(-SHADOW_DENSITY * found), DARKEST).astype(np.float32)


def _grid(vertices):
    """Blurred occupancy of voxels, and where the grid begins."""
    low = vertices.min(0) - 6 * CELL
    size = np.ceil((vertices.max(0) + 6 * CELL - low) / CELL).astype(int)
    cells = ((vertices - low) / CELL).astype(int)
    grid = np.zeros(size, np.float32)
    grid[tuple(cells.T)] = 1
    for _ in range(2):
        for axis in range(3):
            grid = (np.roll(grid, 1, axis) + grid + np.roll(grid, -1, axis)) / 3
    return grid, low


def _trilinear(grid, at):
    """Grid values at fractional indices (n, 3)."""
    at = np.clip(at, 0, np.asarray(grid.shape) - 1.001)  # the border of the grid is empty
    base = np.floor(at).astype(int)
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
    lit: Float[np.ndarray, " n"] | None = None,
) -> Float[np.ndarray, "n 3"]:
    """(n, 3) colours in [0, 1] of points with albedo (n, 3), unit normals (n, 3), openness (n,), sheen (n,).

    lit: (n,) share of the key light that arrives; None: all of it.
    """
    up = 0.5 + 0.5 * normals[:, 1:2]
    light = (lights.ground + (lights.sky - lights.ground) * up) * openness[:, None]
    half = openness[:, None] ** 0.5
    for i, (direction, strength) in enumerate(zip(lights.directions, lights.strengths, strict=True)):
        if i == 0 and lit is not None:
            strength = strength * lit[:, None]
        cosine = normals @ direction
        wrapped = np.clip((cosine + 0.25) / 1.25, 0, 1)  # a wide light reaches a little beyond the terminator
        light = light + strength * wrapped[:, None] * half
        gloss = np.clip(cosine, 0, 1) ** 12 * sheen
        albedo = albedo + 0.12 * gloss[:, None] * strength
    return rolled_off(np.minimum(albedo, ALBEDO_LIMIT) * light * lights.gain).astype(np.float32)


def rolled_off(colours: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Colours (n, 3) from 0 on, bent below WHITEST from SHOULDER on, as film and cameras do: nothing burns out at once."""
    above = np.maximum(colours - SHOULDER, 0)
    reach = WHITEST - SHOULDER
    return np.minimum(np.maximum(colours, 0), SHOULDER) + reach * (1 - np.exp(-above / reach))


def bend_normals(normals: Float[np.ndarray, "n 3"], slope: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Normals (n, 3) tilted against the gradient (n, 3) of a height field on the surface."""
    along = slope - np.sum(slope * normals, -1, keepdims=True) * normals
    return unit(normals - along)
