"""Light on the device, as in `shading`: sky and ground, wide lights, occlusion and soft shadows from a voxel grid.

The grid holds the posed person; openness is how empty it is in front of a point, and the shade of the key light is what
the grid holds on the way towards it. Both are per vertex and smooth: no shadow map, no rays, no noise. Exposure and white
balance differ from example to example, so that colours are no constants of a person.
"""

import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import ndtri

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.people.fabrics import ALBEDO_LIMIT
from humangs_jax.people.shading import CELL, DARKEST, LIFT, REACH, SCENES, SHADOW_DENSITY, SHOULDER, STRIDES, WHITEST

GRID = (112, 104, 80)
"""Voxels along x, y and z: 2.8 m x 2.6 m x 2 m, more than any pose takes; what lies beyond casts no shade."""
MARGIN = 6
"""Empty voxels around the person."""
WRAP, GLOSS = 0.25, 0.12
LIGHT_NUMBERS = 28
_SCENES = np.asarray([np.hstack(row) for row in SCENES.values()], np.float32)
"""Rows of `shading.SCENES`: odds; ranges of azimuth, height, key, fill and sky; warmth; bounce."""


@pytree_dataclass
class LiveLights:
    """directions: (k, 3) towards the lights, the key light first. strengths: (k, 3). sky, ground: (3,) ambient.

    gain: (3,) exposure and white balance.
    """

    directions: Float[Array, "k 3"]
    strengths: Float[Array, "k 3"]
    sky: Float[Array, "3"]
    ground: Float[Array, "3"]
    gain: Float[Array, "3"]


def lights_from(u: Float[Array, " light_numbers"]) -> LiveLights:
    """The scenes of `shading.sample_lights`; u: `LIGHT_NUMBERS` numbers in [0, 1)."""
    odds = np.cumsum(_SCENES[:, 0])
    row = jnp.asarray(_SCENES)[jnp.sum(u[0] * odds[-1] >= odds[:-1])]
    azimuth, height, key, fill, sky = row[1:11].reshape(5, 2)
    warmth, bounce = row[11], row[12]
    within = lambda limits, share: limits[0] + (limits[1] - limits[0]) * share
    sign = lambda number: jnp.where(number < 0.5, -1.0, 1.0)
    turns = jnp.stack([jnp.zeros(()), sign(u[1]) * within((1.4, 2.4), u[2]), np.pi + within((-0.5, 0.5), u[3])])
    angles = within(azimuth, u[4]) * sign(u[5]) + turns
    heights = jnp.stack([within(height, u[6]), within((0.1, 0.5), u[7]), within((0.4, 0.9), u[8])])
    horizontal = jnp.cos(heights)
    directions = jnp.stack([horizontal * jnp.sin(angles), jnp.sin(heights), horizontal * jnp.cos(angles)], -1)
    power = jnp.stack([within(key, u[9]), within(fill, u[10]), within((0.4, 1.2), u[11]) * fill[1]])
    warm = jnp.asarray([1.0, 0.0, -1.0])
    tint = 1 + within((-0.03, 0.03), u[12:21].reshape(3, 3)) + warmth * jnp.outer(jnp.asarray([1.0, 0.0, 0.0]), warm)
    colour = within(sky, u[21]) * (1 - 0.5 * warmth * warm)
    exposure, balance, green = 0.12 * _normal(u[22]) + 0.06, 0.045 * _normal(u[23]), 0.012 * _normal(u[24])
    gain = jnp.clip(jnp.exp(exposure), 0.72, 1.35) * jnp.stack([1 + balance, 1 + green, 1 - balance])
    ground = bounce * colour * (1 + within((-0.06, 0.06), u[25:28]))
    return LiveLights(directions, power[:, None] * tint, colour, ground, gain)


def _normal(u):
    """A normal number for one in [0, 1)."""
    return ndtri(jnp.clip(u, 1e-4, 1 - 1e-4))


def shaded_vertices(
    vertices: Float[Array, "n 3"], normals: Float[Array, "n 3"], faces: Int[Array, "f 3"], direction: Float[Array, "3"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """(n,) openness in [0.35, 1] and (n,) share of the light from `direction` that arrives, in [DARKEST, 1]."""
    low = vertices.min(0) - MARGIN * CELL
    # the middles of faces as well: cloth has vertices farther apart than voxels
    middles = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3
    grid = _blurred(_occupancy(jnp.concatenate([vertices, middles]), low))
    place = lambda points: (points - low) / CELL - 0.5
    dark = sum(_trilinear(grid, place(vertices + reach * normals)) for reach in REACH) / len(REACH)
    openness = jnp.clip(1.08 - 2.6 * dark, 0.35, 1.0)
    start = vertices + LIFT * normals
    found = sum(_nearest(grid, place(start + stride * direction)) for stride in STRIDES)
    return openness, jnp.maximum(jnp.exp(-SHADOW_DENSITY * found), DARKEST)


def _occupancy(points, low):
    """Grid with 1 in the voxels that hold a point. Duplicates all write the same number: the order does not matter."""
    cells = ((points - low) / CELL).astype(jnp.int32)
    return jnp.zeros(GRID, points.dtype).at[cells[:, 0], cells[:, 1], cells[:, 2]].set(1.0, mode="drop")


def _blurred(grid):
    """Means over 3 x 3 x 3 voxels, twice; by banded matrices, which XLA does not unroll into one huge expression."""
    for axis, size in enumerate(GRID):
        apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
        weights = jnp.asarray(np.maximum(3 - apart, 0) / 9, grid.dtype)
        grid = jnp.moveaxis(jnp.tensordot(weights, grid, (1, axis), precision=lax.Precision.HIGHEST), 0, axis)
    return grid


def _nearest(grid, at):
    """Grid values (n,) at the voxels nearest to fractional indices (n, 3), 0 beyond the grid."""
    x, y, z = jnp.round(at).astype(jnp.int32).T
    size = jnp.asarray(GRID)
    index = (x * GRID[1] + y) * GRID[2] + z
    inside = (x >= 0) & (y >= 0) & (z >= 0) & (x < size[0]) & (y < size[1]) & (z < size[2])
    return jnp.where(inside, grid.reshape(-1)[jnp.where(inside, index, 0)], 0.0)


def _trilinear(grid, at):
    """Grid values (n,) at fractional indices (n, 3), which lie inside the grid (and its margin) or count as its border."""
    base = jnp.clip(jnp.floor(at).astype(jnp.int32), 0, jnp.asarray(GRID) - 2)
    t = jnp.clip(at - base, 0, 1)
    index = (base[:, 0] * GRID[1] + base[:, 1]) * GRID[2] + base[:, 2]
    flat = grid.reshape(-1)
    total = jnp.zeros(len(at), at.dtype)
    for corner in range(8):
        bits = np.asarray([corner & 1, corner >> 1 & 1, corner >> 2])
        share = jnp.where(bits, t, 1 - t)
        value = flat[index + (bits[0] * GRID[1] + bits[1]) * GRID[2] + bits[2]]
        total += share[:, 0] * share[:, 1] * share[:, 2] * value
    return total


def shade(
    lights: LiveLights,
    albedo: Float[Array, "*p 3"],
    normals: Float[Array, "*p 3"],
    openness: Float[Array, "*p"],
    lit: Float[Array, "*p"],
    sheen: Float[Array, "*p"],
) -> Float[Array, "*p 3"]:
    """Colours in [0, 1] of points; `lit` is the share of the key light that arrives. The formula of `shading.shade`."""
    up = 0.5 + 0.5 * normals[..., 1:2]
    light = (lights.ground + (lights.sky - lights.ground) * up) * openness[..., None]
    half = jnp.sqrt(openness)
    for k in range(lights.directions.shape[0]):
        arrives = half * lit if k == 0 else half
        x, y, z = lights.directions[k]
        cosine = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2] * z
        wrapped = jnp.clip((cosine + WRAP) / (1 + WRAP), 0, 1)  # a wide light reaches a little beyond the terminator
        light += lights.strengths[k] * (wrapped * arrives)[..., None]
        gloss = GLOSS * jnp.clip(cosine, 0, 1) ** 12 * sheen * (lit if k == 0 else 1.0)
        albedo = albedo + gloss[..., None] * lights.strengths[k]
    colours = jnp.maximum(jnp.minimum(albedo, ALBEDO_LIMIT) * light * lights.gain, 0)
    reach = WHITEST - SHOULDER  # highlights are bent as in `shading.rolled_off`
    return jnp.minimum(colours, SHOULDER) + reach * (1 - jnp.exp(-jnp.maximum(colours - SHOULDER, 0) / reach))


def bend_normals(normals: Float[Array, "*p 3"], slopes: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
    """Normals tilted against the gradient of a height field on the surface, see `shading.bend_normals`."""
    bent = normals - (slopes - jnp.sum(slopes * normals, -1, keepdims=True) * normals)
    return bent / (jnp.linalg.norm(bent, axis=-1, keepdims=True) + 1e-9)


def dyes_from(u: Float[Array, "4 m"], groups: Int[Array, " m"], dyeable: Float[Array, " m"]) -> Float[Array, "m 3 3"]:
    """(m, 3, 3) what turns the colours of each piece into other ones: hue, saturation and brightness of cloth.

    Pieces of one group are dyed alike. u: in [0, 1). Hues are turned about the grey axis for half of the pieces,
    brightness changes for all.
    """
    turned, turn, pale, bright = u
    hue = jnp.where(turned < 0.5, 2 * np.pi * (turn - 0.5), 0.0)
    saturation, brightness = jnp.exp(-0.6 + 0.6 * pale), jnp.exp(-0.5 + 0.8 * bright)
    grey = jnp.full((3, 3), 1 / 3)
    # Rodrigues' formula about (1, 1, 1) / sqrt(3)
    skew = jnp.asarray([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / math.sqrt(3)
    each = lambda values: values[:, None, None]
    rotation = each(jnp.cos(hue)) * (jnp.eye(3) - grey) + each(jnp.sin(hue)) * skew
    matrices = each(brightness) * (grey + each(saturation) * rotation)
    return jnp.where(each(dyeable) > 0, matrices[groups], jnp.eye(3))
