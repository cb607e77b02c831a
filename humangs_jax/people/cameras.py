"""Cameras like those of the published protocol: around the person, vertical field of view 60 degrees, near the horizon.

`cameras_around` and `close_cameras` draw from a numpy generator for written people, `camera_from` takes numbers in [0, 1) and
runs on the device, for people made on the fly.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int, Matrix3, Scalar, Vector3
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, look_at, orbit
from humangs_jax.people.anatomy import Vector
from humangs_jax.people.surfaces import Points

VERTICAL_FOV, ELEVATION = np.deg2rad(60.0), np.deg2rad(np.asarray([-5.0, 15.0]))
DISTANCE_FACTOR, CLOSE_FACTOR = (1.8, 2.2), (0.8, 1.7)
"""Distance in bounding radii: nearer than 1.7 the frame cuts heads and feet. Close views show parts of the person."""
CLOSE_SPREAD, CLEARANCE = 0.85, 0.3
"""Close cameras look at points up to this share of the way from the middle of the person to its surface, and come no nearer to a
point of it than this (metres)."""
FRAME = 0.98
"""Share of the half frame that the person may reach; a camera that is too near for it steps back."""
POINT_STEP = 4096
"""Points are padded to a multiple of this: few shapes are compiled."""
CAMERA_NUMBERS = 5
UP = (0.0, 1.0, 0.0)
Angles = Float[np.ndarray, " v"]
Number = Float[Array, ""] | float


def bounding_sphere(vertices: Points) -> tuple[Vector, float]:
    """Middle of the bounding box (3,) and the largest distance from it."""
    center = 0.5 * (vertices.min(0) + vertices.max(0))
    return center, float(np.linalg.norm(vertices - center, axis=1).max())


def spread_azimuths(rng: np.random.Generator, count: int, jitter: float = 0.3) -> Angles:
    """(count,) sorted azimuths, evenly spread from a random start, each moved by up to `jitter` of the spacing."""
    spacing = 2 * np.pi / count
    return rng.uniform(0, spacing) + spacing * (np.arange(count) + rng.uniform(-jitter, jitter, count))


def cameras_around(rng: np.random.Generator, vertices: Points, azimuths: Angles, image_size: int) -> Camera:
    """A batch of cameras at the azimuths, distances and elevations drawn from the protocol's ranges."""
    center, radius = bounding_sphere(vertices)
    distances = radius * rng.uniform(*DISTANCE_FACTOR, len(azimuths))
    elevations = rng.uniform(*ELEVATION, len(azimuths))
    points = np.pad(vertices - center, ((0, -len(vertices) % POINT_STEP), (0, 0)), mode="edge")
    near = _nearest_distances(jnp.asarray(points), *(jnp.asarray(x, jnp.float32) for x in (azimuths, elevations)))
    targets = np.broadcast_to(center, (len(azimuths), 3))
    return _orbits(targets, np.maximum(distances, np.asarray(near)), azimuths, elevations, image_size)


def close_cameras(rng: np.random.Generator, vertices: Points, azimuths: Angles, image_size: int) -> Camera:
    """A batch of cameras that see parts: `CLOSE_FACTOR` bounding radii away from points between middle and surface."""
    center, radius = bounding_sphere(vertices)
    count = len(azimuths)
    towards = vertices[rng.integers(len(vertices), size=count)]
    targets = center + rng.uniform(0, CLOSE_SPREAD, (count, 1)) * (towards - center)
    distances = radius * rng.uniform(*CLOSE_FACTOR, count)
    elevations = rng.uniform(*ELEVATION, count)
    flat = np.cos(elevations)
    directions = np.stack([flat * np.sin(azimuths), np.sin(elevations), flat * np.cos(azimuths)], -1)
    for i in range(count):
        while np.linalg.norm(vertices - targets[i] - distances[i] * directions[i], axis=1).min() < CLEARANCE:
            distances[i] += 0.05 * radius
    return _orbits(targets, distances, azimuths, elevations, image_size)


def _orbits(targets: Float[np.ndarray, "v 3"], distances: Angles, azimuths: Angles, elevations: Angles, size: int) -> Camera:
    """A batch of cameras that each look at a target of their own."""
    placed = (jnp.asarray(x, jnp.float32) for x in (targets, distances, azimuths, elevations))
    return _placed(*placed, intrinsics_from_fov(VERTICAL_FOV, size, size), size)


@functools.partial(jax.jit, static_argnums=5)
def _placed(
    targets: Float[Array, "v 3"],
    distances: Float[Array, " v"],
    azimuths: Float[Array, " v"],
    elevations: Float[Array, " v"],
    K: Matrix3,
    size: int,
) -> Camera:
    one = lambda target, *rest: orbit(target, *(x[None] for x in rest), K, size, size)[0]
    return jax.vmap(one)(targets, distances, azimuths, elevations)


def camera_from(
    u: Array, vertices: Float[Array, "n 3"], count: Int[Array, ""] | int, azimuth: Number, close: Number, size: int
) -> Camera:
    """A square camera of `size` pixels that looks at a posed person from an azimuth.

    u: (5,) in [0, 1). count: vertices that are no padding. close: probability of a close camera; others see all of the person.
    """
    is_close, tilt, spread, outwards, place = u
    low, high = vertices.min(0), vertices.max(0)
    center = 0.5 * (low + high)
    radius = jnp.sqrt(jnp.max(jnp.sum((vertices - center) ** 2, -1)))
    near = is_close < close
    elevation = _within(ELEVATION, tilt)
    factor = jnp.where(near, _within(CLOSE_FACTOR, spread), _within(DISTANCE_FACTOR, spread))
    towards_vertex = vertices[pick(place, count)] - center
    target = center + jnp.where(near, CLOSE_SPREAD * outwards, 0.0) * towards_vertex
    along = _along_axes(vertices - target, azimuth, elevation)
    ahead, above, aside = along
    beside = CLEARANCE**2 - (above * above + aside * aside)  # a camera on its axis comes no nearer than that to a point
    clear = jnp.max(jnp.where(beside > 0, ahead + jnp.sqrt(jnp.maximum(beside, 0)), -jnp.inf))
    distance = jnp.maximum(factor * radius, jnp.where(near, clear, _nearest_distance(*along)))
    K = intrinsics_from_fov(VERTICAL_FOV, size, size).astype(vertices.dtype)
    eye = target + distance * _axes(azimuth, elevation)[0]
    return look_at(eye, target, jnp.asarray(UP, vertices.dtype), K, size, size)


def _nearest_distance(ahead: Float[Array, " n"], above: Float[Array, " n"], aside: Float[Array, " n"]) -> Scalar:
    """Least distance from the origin at which a camera that looks at it has all points in its square frame."""
    return jnp.max(jnp.maximum(jnp.abs(above), jnp.abs(aside)) / (FRAME * np.tan(VERTICAL_FOV / 2)) + ahead)


@jax.jit
def _nearest_distances(
    points: Float[Array, "n 3"], azimuths: Float[Array, " v"], elevations: Float[Array, " v"]
) -> Float[Array, " v"]:
    return jax.vmap(lambda a, e: _nearest_distance(*_along_axes(points, a, e)))(azimuths, elevations)


def _within(limits: tuple[float, float] | Float[np.ndarray, "2"], share: Scalar) -> Scalar:
    return limits[0] + (limits[1] - limits[0]) * share


def _axes(azimuth: Number, elevation: Scalar) -> tuple[Vector3, Vector3, Vector3]:
    """Unit vectors towards a camera, up and right in its image."""
    sa, ca, se, ce = jnp.sin(azimuth), jnp.cos(azimuth), jnp.sin(elevation), jnp.cos(elevation)
    zero = jnp.zeros_like(sa)
    return jnp.stack([ce * sa, se, ce * ca]), jnp.stack([-se * sa, ce, -se * ca]), jnp.stack([ca, zero, -sa])


def _along_axes(points: Float[Array, "n 3"], azimuth: Number, elevation: Scalar) -> tuple[Float[Array, " n"], ...]:
    """Coordinates (n,) along `_axes`; written out: matrix products are of low precision on GPU and TPU."""
    return tuple(jnp.sum(points * axis, -1) for axis in _axes(azimuth, elevation))


def azimuths_from(u: Float[Array, " numbers"], jitter: float, scattered_share: float) -> Float[Array, " v"]:
    """(v,) azimuths all around from a random start, each off by up to half `jitter` of the spacing; or anywhere.

    u: 2 + 2 v numbers in [0, 1).
    """
    count = len(u) // 2 - 1
    scattered, start, offsets, places = u[0], u[1], u[2 : 2 + count], u[2 + count :]
    even = 2 * np.pi / count * (jnp.arange(count) + jitter * (offsets - 0.5)) + 2 * np.pi * start
    return jnp.where(scattered < scattered_share, 2 * np.pi * places, even)


def pick(u: Float[Array, "*b"], count: Int[Array, ""] | int) -> Int[Array, "*b"]:
    """One of the numbers 0 .. count - 1 for each u in [0, 1)."""
    return jnp.minimum((u * count).astype(jnp.int32), count - 1)
