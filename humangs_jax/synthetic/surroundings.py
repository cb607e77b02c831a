"""Makes cameras and light around a synthetic person, and shades the person's surface.

People that are written to files get cameras and light from a numpy generator. People made on the
fly get them from random numbers on the device. Cameras are like those of the published protocol:
around the person, near the horizon, with a vertical field of view of 60 degrees. The light is soft:
sky, ground, three wide lights, occlusion and soft shadows. Each side of a surface has the same
color from wherever it is seen. Occlusion and the shadow of the key light are computed at vertices,
in a voxel grid that holds the posed person.
"""

import functools
import math
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import ndtri

from humangs_jax.core.array_types import Array, Bool, Float, Int, Scalar, Vector3
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, look_at, orbit
from humangs_jax.synthetic.anatomy import Vector
from humangs_jax.synthetic.fabrics import ALBEDO_LIMIT
from humangs_jax.synthetic.surfaces import Points, choice

_VERTICAL_FOV = np.deg2rad(60.0)
"""Vertical field of view, radians."""
_ELEVATION = np.deg2rad(np.asarray([-5.0, 15.0]))
"""Range of elevations of cameras, radians."""
DISTANCE_FACTOR = (1.8, 2.2)
"""Range of distances of cameras, in bounding radii. Nearer than 1.7, heads and feet are cut off."""
_CLOSE_FACTOR = (0.8, 1.7)
"""Range of distances of close cameras, in bounding radii; they show parts of the person."""
CLOSE_SPREAD = 0.85
"""A close camera looks at a point on the way from the middle of the person to the surface. The
point is at most this share of the way from the middle.
"""
CLEARANCE = 0.3
"""Least distance of a close camera from the surface, metres."""
CAMERA_NUMBERS = 5
"""Number of random numbers that make a camera."""
Angles = Float[np.ndarray, " v"]
_Number = Float[Array, ""] | float
_Each = Float[Array | np.ndarray, "3 ..."]
"""Values of three lights or of three color channels."""


def bounding_sphere(vertices: Points) -> tuple[Vector, float]:
    """Returns the middle of the bounding box (3,) and the largest distance of a vertex from it, in
    metres.
    """
    center = 0.5 * (vertices.min(0) + vertices.max(0))
    return center, float(np.linalg.norm(vertices - center, axis=1).max())


def spread_azimuths(rng: np.random.Generator, count: int) -> Angles:
    """Draws sorted azimuths all around (count,), radians.

    They are evenly spaced from a random start, and each is then moved by up to 0.3 of the spacing.
    """
    spacing = 2 * np.pi / count
    start = rng.uniform(0, spacing)
    return start + spacing * (np.arange(count) + rng.uniform(-0.3, 0.3, count))


def cameras_around(
    rng: np.random.Generator, vertices: Points, azimuths: Angles, image_size: int
) -> Camera:
    """Makes a batch of square cameras that see the whole person, one for each azimuth in radians.

    Distances and elevations are drawn from the ranges of the protocol. A camera that would not see
    the whole person is moved away from the person until it does.
    """
    center, radius = bounding_sphere(vertices)
    distances = radius * rng.uniform(*DISTANCE_FACTOR, len(azimuths))
    elevations = rng.uniform(*_ELEVATION, len(azimuths))
    # padded to a multiple of 4096: few shapes are compiled
    points = np.pad(vertices - center, ((0, -len(vertices) % 4096), (0, 0)), mode="edge")
    near = _nearest_distances(
        jnp.asarray(points), *(jnp.asarray(x, jnp.float32) for x in (azimuths, elevations))
    )
    targets = np.broadcast_to(center, (len(azimuths), 3))
    return _orbits(
        image_size, targets, np.maximum(distances, np.asarray(near)), azimuths, elevations
    )


def close_cameras(
    rng: np.random.Generator, vertices: Points, azimuths: Angles, image_size: int
) -> Camera:
    """Makes a batch of square cameras that see parts of a person, one for each azimuth in radians.

    Each camera looks at a point between the middle of the person and the surface. Its distance from
    this point is drawn from `_CLOSE_FACTOR`, in bounding radii. It is moved away until no vertex is
    nearer than `CLEARANCE`.
    """
    center, radius = bounding_sphere(vertices)
    count = len(azimuths)
    towards = vertices[rng.integers(len(vertices), size=count)]
    targets = center + rng.uniform(0, CLOSE_SPREAD, (count, 1)) * (towards - center)
    distances = radius * rng.uniform(*_CLOSE_FACTOR, count)
    elevations = rng.uniform(*_ELEVATION, count)
    flat = np.cos(elevations)
    directions = np.stack(
        [flat * np.sin(azimuths), np.sin(elevations), flat * np.cos(azimuths)], -1
    )
    for i in range(count):
        while (
            np.linalg.norm(vertices - targets[i] - distances[i] * directions[i], axis=1).min()
            < CLEARANCE
        ):
            distances[i] += 0.05 * radius
    return _orbits(image_size, targets, distances, azimuths, elevations)


@functools.partial(jax.jit, static_argnums=0)
def _orbits(
    size: int,
    targets: Float[Array, "v 3"],
    distances: Float[Array, " v"],
    azimuths: Float[Array, " v"],
    elevations: Float[Array, " v"],
) -> Camera:
    """Makes a batch of square cameras of `size` pixels, one for each target that is looked at.

    distances: from the targets, metres. azimuths, elevations: radians.
    """
    K = intrinsics_from_fov(_VERTICAL_FOV, size, size)

    def one(target, distance, azimuth, elevation):
        cameras = orbit(target, distance[None], azimuth[None], elevation[None], K, size, size)
        return cameras[0]

    return jax.vmap(one)(targets, distances, azimuths, elevations)


def camera_from(
    u: Array,
    vertices: Float[Array, "n 3"],
    count: Int[Array, ""] | int,
    azimuth: _Number,
    close: _Number,
    size: int,
) -> Camera:
    """Makes a square camera of `size` pixels that looks at a posed person.

    u: random numbers in [0, 1), (5,). vertices: of the posed person, metres, with padding. count:
    number of vertices before the padding. azimuth: radians. close: probability of a close camera;
    any other camera sees the whole person.
    """
    is_close, tilt, spread, outwards, place = u
    low, high = vertices.min(0), vertices.max(0)
    center = 0.5 * (low + high)
    radius = jnp.sqrt(jnp.max(jnp.sum((vertices - center) ** 2, -1)))
    near = is_close < close
    elevation = _within(_ELEVATION, tilt)
    factor = jnp.where(near, _within(_CLOSE_FACTOR, spread), _within(DISTANCE_FACTOR, spread))
    towards_vertex = vertices[pick(place, count)] - center
    target = center + jnp.where(near, CLOSE_SPREAD * outwards, 0.0) * towards_vertex
    along = _along_axes(vertices - target, azimuth, elevation)
    ahead, above, aside = along
    # a camera on its axis comes no nearer than that to a point
    beside = CLEARANCE**2 - (above * above + aside * aside)
    clear = jnp.max(jnp.where(beside > 0, ahead + jnp.sqrt(jnp.maximum(beside, 0)), -jnp.inf))
    distance = jnp.maximum(factor * radius, jnp.where(near, clear, _nearest_distance(*along)))
    K = intrinsics_from_fov(_VERTICAL_FOV, size, size).astype(vertices.dtype)
    eye = target + distance * _axes(azimuth, elevation)[0]
    return look_at(eye, target, jnp.asarray((0.0, 1.0, 0.0), vertices.dtype), K, size, size)


def _nearest_distance(
    ahead: Float[Array, " n"], above: Float[Array, " n"], aside: Float[Array, " n"]
) -> Scalar:
    """Returns how far from the origin a camera must be to see all points, metres.

    The camera looks at the origin and has all points within 98 % of its square frame. ahead, above,
    aside: coordinates of the points along the camera's `_axes`.
    """
    slope = 0.98 * np.tan(_VERTICAL_FOV / 2)
    return jnp.max(jnp.maximum(jnp.abs(above), jnp.abs(aside)) / slope + ahead)


@jax.jit
def _nearest_distances(
    points: Float[Array, "n 3"], azimuths: Float[Array, " v"], elevations: Float[Array, " v"]
) -> Float[Array, " v"]:
    return jax.vmap(lambda a, e: _nearest_distance(*_along_axes(points, a, e)))(
        azimuths, elevations
    )


def _within(limits: tuple[float, float] | Float[np.ndarray, "2"], share: Scalar) -> Scalar:
    return limits[0] + (limits[1] - limits[0]) * share


def _axes(azimuth: _Number, elevation: Scalar) -> tuple[Vector3, Vector3, Vector3]:
    """Returns unit vectors (3,) towards a camera, up in its image, and right in its image.

    azimuth, elevation: of the camera, radians.
    """
    sa, ca, se, ce = jnp.sin(azimuth), jnp.cos(azimuth), jnp.sin(elevation), jnp.cos(elevation)
    zero = jnp.zeros_like(sa)
    return (
        jnp.stack([ce * sa, se, ce * ca]),
        jnp.stack([-se * sa, ce, -se * ca]),
        jnp.stack([ca, zero, -sa]),
    )


def _along_axes(
    points: Float[Array, "n 3"], azimuth: _Number, elevation: Scalar
) -> tuple[Float[Array, " n"], ...]:
    """Returns the coordinates of points along the three `_axes`, each (n,).

    Sums are written out, because matrix products have low precision on GPU and TPU.
    """
    return tuple(jnp.sum(points * axis, -1) for axis in _axes(azimuth, elevation))


def azimuths_from(
    u: Float[Array, " numbers"],
    jitter: float,
    scattered_share: float,
    count: Int[Array, ""] | None = None,
) -> Float[Array, " v"]:
    """Makes azimuths of v cameras, radians. They are evenly spaced, or, with a given probability,
    scattered.

    Evenly spaced azimuths have a random start, and each is off by up to half of `jitter` times the
    spacing. Scattered azimuths lie anywhere.

    u: 2 + 2 v random numbers in [0, 1). scattered_share: probability of scattered azimuths. count:
    number of evenly spaced azimuths in a full turn. None: all v.
    """
    v = len(u) // 2 - 1
    scattered, start, offsets, places = u[0], u[1], u[2 : 2 + v], u[2 + v :]
    spacing = 2 * np.pi / (v if count is None else count)
    even = spacing * (jnp.arange(v) + jitter * (offsets - 0.5)) + 2 * np.pi * start
    return jnp.where(scattered < scattered_share, 2 * np.pi * places, even)


def pick(u: Float[Array, "*b"], count: Int[Array, ""] | int) -> Int[Array, "*b"]:
    """Returns one of the integers 0 .. count - 1 for each u in [0, 1)."""
    return jnp.minimum((u * count).astype(jnp.int32), count - 1)


# Light
# --------------------------------------------------------------------------------------------------


CELL = 0.025
"""Edge of a voxel of the occupancy grid, metres."""
GRID = (112, 112, 80)
"""Numbers of voxels along x, y and z. The tallest people with raised arms fit in. What lies outside
casts no shadow.
"""
DARKEST = 0.4
"""Least share of the key light that arrives at a point in shadow."""
SHOULDER = 0.72
"""Brightness from which highlights are compressed."""
WHITEST = 0.97
"""Brightness that compressed highlights approach."""
LIGHT_NUMBERS = 28
"""Number of random numbers that make the lights of a scene."""
_WARM = np.asarray([1.0, 0.0, -1.0])
"""Direction in RGB from a neutral to a warm color."""

_SCENES = {
    "studio": (0.34, (-0.8, 0.8), (0.5, 1.0), (0.5, 0.75), (0.18, 0.34), (0.68, 0.82), 0.0, 0.68),
    "overcast": (0.22, (-3.1, 3.1), (0.7, 1.2), (0.15, 0.4), (0.05, 0.2), (0.85, 1.02), -0.03, 0.6),
    "sun": (0.2, (-3.1, 3.1), (0.45, 1.1), (0.85, 1.2), (0.08, 0.25), (0.56, 0.74), 0.10, 0.68),
    "room": (0.16, (-2.0, 2.0), (0.8, 1.35), (0.4, 0.7), (0.1, 0.3), (0.6, 0.78), 0.12, 0.78),
    "window": (0.08, (0.9, 1.9), (0.1, 0.5), (0.8, 1.1), (0.04, 0.15), (0.5, 0.66), -0.08, 0.8),
}
"""Kinds of light. Each row has, in this order: odds of the kind; ranges of the key light's azimuth
and elevation, radians; ranges of the strengths of key light, fill light and sky; how much warmer
the key light is than the sky; and the ground's brightness divided by the sky's."""
_SCENE_ROWS = np.asarray([np.hstack(row) for row in _SCENES.values()], np.float32)
"""The rows of `_SCENES` as an array, for the device."""


_Vectors = Float[Array, "*p 3"]
_Values = Float[Array, "*p"]


@pytree_dataclass
class Lights:
    """The light that a person stands in, and the camera's exposure and white balance."""

    directions: Float[Array, "k 3"]
    """Unit directions towards the lights, (k, 3), the key light first."""
    strengths: Float[Array, "k 3"]
    """Colors of the lights, times their strength, (k, 3)."""
    sky: Float[Array, "3"]
    """Ambient light from above, (3,)."""
    ground: Float[Array, "3"]
    """Ambient light from below, (3,)."""
    gain: Float[Array, "3"]
    """Exposure and white balance of the camera, (3,)."""


def sample_lights(rng: np.random.Generator) -> Lights:
    """Draws light of a random kind: a studio, an overcast or sunny day, a lit room or a window.

    The camera's exposure and white balance have random errors.
    """
    scene = _SCENES[choice(rng, {name: row[0] for name, row in _SCENES.items()})]
    _, azimuths, heights, key, fill, sky_range, warmth, bounce = scene
    azimuth = rng.uniform(*azimuths) * rng.choice([-1, 1])
    angles = azimuth + np.asarray(
        [0.0, rng.uniform(1.4, 2.4) * rng.choice([-1, 1]), np.pi + rng.uniform(-0.5, 0.5)]
    )
    elevations = np.asarray([rng.uniform(*heights), rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.9)])
    power = np.asarray([rng.uniform(*key), rng.uniform(*fill), rng.uniform(0.4, 1.2) * fill[1]])
    tint = rng.uniform(-0.03, 0.03, (3, 3))
    sky = rng.uniform(*sky_range) * (1 + rng.uniform(-0.02, 0.02, 3) - 0.5 * warmth * _WARM)
    exposure = np.exp(rng.normal(0.06, 0.12))
    balance = rng.normal(0, 0.045)
    green = rng.normal(0, 0.012)
    gain = np.clip(exposure, 0.75, 1.3) * np.asarray([1 + balance, 1 + green, 1 - balance])
    ground = bounce * sky * (1 + rng.uniform(-0.06, 0.06, 3))
    return _lights(np, angles, elevations, power, tint, warmth, sky, ground, gain)


def lights_from(u: Float[Array, " light_numbers"]) -> Lights:
    """Makes light of the kinds of `sample_lights` on the device.

    u: `LIGHT_NUMBERS` random numbers in [0, 1).
    """
    odds = np.cumsum(_SCENE_ROWS[:, 0])
    # the first number chooses the scene, as its odds say
    row = jnp.asarray(_SCENE_ROWS)[jnp.sum(u[0] * odds[-1] >= odds[:-1])]
    azimuth, height, key, fill, sky = row[1:11].reshape(5, 2)
    warmth, bounce = row[11], row[12]

    def within(limits, share):
        return limits[0] + (limits[1] - limits[0]) * share

    def sign(number):
        return jnp.where(number < 0.5, -1.0, 1.0)

    # key light, fill light, and one from the opposite side
    turns = jnp.stack(
        [jnp.zeros(()), sign(u[1]) * within((1.4, 2.4), u[2]), np.pi + within((-0.5, 0.5), u[3])]
    )
    elevations = jnp.stack(
        [within(height, u[6]), within((0.1, 0.5), u[7]), within((0.4, 0.9), u[8])]
    )
    power = jnp.stack([within(key, u[9]), within(fill, u[10]), within((0.4, 1.2), u[11]) * fill[1]])
    tint = within((-0.03, 0.03), u[12:21].reshape(3, 3))
    color = within(sky, u[21]) * (1 - 0.5 * warmth * _WARM)
    # exposure and white balance err as those of real cameras
    normal = ndtri(jnp.clip(u[22:25], 1e-4, 1 - 1e-4))
    exposure = 0.12 * normal[0] + 0.06
    balance = 0.045 * normal[1]
    green = 0.012 * normal[2]
    gain = jnp.clip(jnp.exp(exposure), 0.72, 1.35) * jnp.stack(
        [1 + balance, 1 + green, 1 - balance]
    )
    ground = bounce * color * (1 + within((-0.06, 0.06), u[25:28]))
    angles = within(azimuth, u[4]) * sign(u[5]) + turns
    return _lights(jnp, angles, elevations, power, tint, warmth, color, ground, gain)


def _lights(
    numpy: ModuleType,
    angles: _Each,
    elevations: _Each,
    power: _Each,
    tint: _Each,
    warmth: _Number,
    sky: _Each,
    ground: _Each,
    gain: _Each,
) -> Lights:
    """Makes lights from their angles, strengths and tints.

    numpy: the module that the arrays belong to, numpy or jax.numpy. angles, elevations: of the
    three lights, radians, the key light first. power: strengths of the three lights. tint:
    deviations of their colors from white (3, 3). warmth: how warm the key light is. sky, ground,
    gain: as in `Lights`, (3,).
    """
    flat = numpy.cos(elevations)
    directions = numpy.stack(
        [flat * numpy.sin(angles), numpy.sin(elevations), flat * numpy.cos(angles)], -1
    )
    strengths = power[:, None] * (1 + tint + warmth * np.outer([1.0, 0.0, 0.0], _WARM))
    return Lights(
        *(jnp.asarray(x, jnp.float32) for x in (directions, strengths, sky, ground, gain))
    )


def shaded_vertices(
    vertices: _Vectors,
    normals: _Vectors,
    direction: Float[Array, "3"],
    faces: Int[Array, "f 3"] | None = None,
) -> tuple[_Values, _Values]:
    """Returns how much light reaches each vertex of a posed person.

    faces: triangles, for training on the fly. With them, the middles of the faces fill the grid,
    too, because meshes may have edges longer than a voxel. The way to the light is sampled at the
    nearest voxels, which takes an eighth of the lookups. None: only vertices fill the grid, and the
    samples on the way to the light are interpolated.

    Returns: the openness of each vertex to its surroundings (n,), in [0.35, 1], and the share of
    the light from `direction` that arrives at each vertex (n,), in [DARKEST, 1].
    """
    low = vertices.min(0) - 6 * CELL  # empty voxels around the person
    points, towards_light = vertices, _trilinear
    if faces is not None:
        middles = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3
        points, towards_light = jnp.concatenate([vertices, middles]), _nearest
    x, y, z = ((points - low) / CELL).astype(jnp.int32).T
    # duplicates all write the same number: the order does not matter
    grid = _blurred(jnp.zeros(GRID, points.dtype).at[x, y, z].set(1.0, mode="drop"))

    def place(points):
        """Returns the fractional indices of points in the grid."""
        return (points - low) / CELL - 0.5

    # openness: what is found at two distances from the surface, metres
    dark = sum(_trilinear(grid, place(vertices + away * normals)) for away in (0.045, 0.11)) / 2
    openness = jnp.clip(1.08 - 2.6 * dark, 0.35, 1.0)
    # shadow: what is found on the way to the light, which begins above the surface, metres
    start = vertices + 0.03 * normals
    strides = (0.06, 0.085, 0.115, 0.155, 0.205, 0.27, 0.36, 0.47, 0.6)
    found = sum(towards_light(grid, place(start + stride * direction)) for stride in strides)
    return openness, jnp.maximum(jnp.exp(-2.2 * found), DARKEST)


def _blurred(grid: Float[Array, "x y z"]) -> Float[Array, "x y z"]:
    """Replaces each voxel twice by the mean over the 3 x 3 x 3 voxels around it.

    It multiplies with banded matrices, which XLA does not unroll into one huge expression.
    """
    for axis, size in enumerate(GRID):
        apart = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
        weights = jnp.asarray(np.maximum(3 - apart, 0) / 9, grid.dtype)
        grid = jnp.moveaxis(
            jnp.tensordot(weights, grid, (1, axis), precision=lax.Precision.HIGHEST), 0, axis
        )
    return grid


def _nearest(grid: Float[Array, "x y z"], at: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Returns the grid's values (n,) at the voxels nearest to fractional indices `at` (n, 3).

    Values outside of the grid are 0.
    """
    x, y, z = jnp.round(at).astype(jnp.int32).T
    size = jnp.asarray(GRID)
    index = (x * GRID[1] + y) * GRID[2] + z
    inside = (x >= 0) & (y >= 0) & (z >= 0) & (x < size[0]) & (y < size[1]) & (z < size[2])
    return jnp.where(inside, grid.reshape(-1)[jnp.where(inside, index, 0)], 0.0)


def _trilinear(grid: Float[Array, "x y z"], at: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Interpolates the grid's values (n,) at fractional indices `at` (n, 3).

    Outside of the grid they are the values at its border, which is empty if the person fits in.
    """
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


def seen_from_behind(
    vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"], eye: Float[Array, "3"]
) -> Bool[Array, " f"]:
    """Returns for each face whether the point `eye` sees the inner side of it, (f,)."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return jnp.sum(jnp.cross(b - a, c - a) * (eye - a), axis=-1) < 0


def light_points(
    lights: Lights,
    corners: Array,
    weights: _Vectors,
    behind: Array,
    albedo: _Vectors,
    slopes: _Vectors,
    sheen: _Values,
) -> _Vectors:
    """Returns the colors (p, 3) of points on faces.

    corners: values of the three corners of each point's face (p, 15). Each corner has five numbers:
    normal (3), openness, and the share of the key light that arrives. weights: the point's weights
    of the three corners (p, 3). behind: whether the inner side of the face is seen (p,). albedo,
    slopes, sheen: of the material at the point.
    """
    wa, wb, wc = (weights[:, i : i + 1] for i in range(3))
    blended = wa * corners[:, :5] + wb * corners[:, 5:10] + wc * corners[:, 10:]
    normals, openness, lit = _unit(blended[:, :3]), blended[:, 3], blended[:, 4]
    normals = jnp.where(behind[:, None], -normals, normals)
    openness = jnp.where(behind, 0.45, 1.0) * openness  # the inner side of cloth is darker
    # tilted against the gradient of a height field on the surface
    normals = _unit(normals - (slopes - jnp.sum(slopes * normals, -1, keepdims=True) * normals))
    return shade(lights, albedo, normals, openness, lit, sheen)


def shade(
    lights: Lights,
    albedo: _Vectors,
    normals: _Vectors,
    openness: _Values,
    lit: _Values,
    sheen: _Values,
) -> _Vectors:
    """Returns the colors in [0, 1] of points under the lights.

    normals: unit vectors. openness: how much of the surroundings a point sees. lit: share of the
    key light that arrives. sheen: strength of the gloss.
    """
    up = 0.5 + 0.5 * normals[..., 1:2]
    light = (lights.ground + (lights.sky - lights.ground) * up) * openness[..., None]
    half = jnp.sqrt(openness)
    wrap = 0.25  # cosine by which a wide light reaches beyond the terminator
    for k in range(lights.directions.shape[0]):
        arrives = half * lit if k == 0 else half
        x, y, z = lights.directions[k]
        cosine = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2] * z
        wrapped = jnp.clip((cosine + wrap) / (1 + wrap), 0, 1)
        light += lights.strengths[k] * (wrapped * arrives)[..., None]
        gloss = 0.12 * jnp.clip(cosine, 0, 1) ** 12 * sheen * (lit if k == 0 else 1.0)
        albedo = albedo + gloss[..., None] * lights.strengths[k]
    return rolled_off(jnp.minimum(albedo, ALBEDO_LIMIT) * light * lights.gain)


def rolled_off(colors: _Vectors) -> _Vectors:
    """Compresses highlights, as film and cameras do, so that no color is suddenly white.

    Values up to SHOULDER stay, higher ones approach WHITEST, and negative ones become 0.
    """
    reach = WHITEST - SHOULDER
    colors = jnp.maximum(colors, 0)
    return jnp.minimum(colors, SHOULDER) + reach * (
        1 - jnp.exp(-jnp.maximum(colors - SHOULDER, 0) / reach)
    )


def _unit(vectors: _Vectors) -> _Vectors:
    return vectors / (jnp.linalg.norm(vectors, axis=-1, keepdims=True) + 1e-9)


def dyes_from(
    u: Float[Array, "4 m"], groups: Int[Array, " m"], dyeable: Float[Array, " m"]
) -> Float[Array, "m 3 3"]:
    """Makes a matrix for each piece that changes the hue, saturation and brightness of its cloth.

    A group's hue is turned about the grey axis with a probability of 1/2. Saturation and brightness
    change for all groups. Pieces of one group are dyed alike, and pieces that are not dyeable have
    the identity.

    u: random numbers in [0, 1), (4, m). groups: the number of each piece's group (m,). dyeable:
    more than 0 where a piece may be dyed (m,).

    Returns: matrices (m, 3, 3).
    """
    turned, turn, pale, bright = u
    hue = jnp.where(turned < 0.5, 2 * np.pi * (turn - 0.5), 0.0)
    saturation, brightness = jnp.exp(-0.6 + 0.6 * pale), jnp.exp(-0.5 + 0.8 * bright)
    grey = jnp.full((3, 3), 1 / 3)
    # Rodrigues' formula about (1, 1, 1) / sqrt(3)
    skew = jnp.asarray([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / math.sqrt(3)
    hue, brightness, saturation = (x[:, None, None] for x in (hue, brightness, saturation))
    rotation = jnp.cos(hue) * (jnp.eye(3) - grey) + jnp.sin(hue) * skew
    matrices = brightness * (grey + saturation * rotation)
    return jnp.where(dyeable[:, None, None] > 0, matrices[groups], jnp.eye(3))
