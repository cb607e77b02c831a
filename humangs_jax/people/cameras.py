"""Cameras like those of the published protocol: around the person, vertical field of view 60 degrees, near the horizon."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit

VERTICAL_FOV = np.deg2rad(60.0)
DISTANCE_FACTOR = (1.8, 2.2)
"""Distance in bounding radii: nearer than 1.7 the frame cuts heads and feet."""
ELEVATION = np.deg2rad(np.asarray([-5.0, 15.0]))
CLOSE_FACTOR = (0.8, 1.7)
"""The same of close views, which show parts of the person."""
CLOSE_SPREAD = 0.85
"""Close cameras look at points up to this share of the way from the middle of the person to its surface."""
CLEARANCE = 0.3
"""Metres: no close camera is nearer to a point of the surface."""
FRAME = 0.98
"""Share of the half frame that the person may reach; a camera that is too near for it steps back."""

_orbit = jax.jit(orbit, static_argnums=(5, 6))


@functools.partial(jax.jit, static_argnums=(5, 6))
def _orbits(targets, distances, azimuths, elevations, K, width, height):
    """Cameras that each look at a target of their own."""

    def one(target, distance, azimuth, elevation):
        return orbit(target, distance[None], azimuth[None], elevation[None], K, width, height)[0]

    return jax.vmap(one)(targets, distances, azimuths, elevations)


def bounding_sphere(vertices: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    """Middle of the bounding box (3,) and the largest distance from it."""
    center = 0.5 * (vertices.min(0) + vertices.max(0))
    return center, float(np.linalg.norm(vertices - center, axis=1).max())


def spread_azimuths(rng: np.random.Generator, count: int, jitter: float = 0.3) -> Float[np.ndarray, " count"]:
    """(count,) sorted azimuths, evenly spread from a random start, each moved by up to `jitter` of the spacing."""
    spacing = 2 * np.pi / count
    return rng.uniform(0, spacing) + spacing * (np.arange(count) + rng.uniform(-jitter, jitter, count))


def cameras_around(
    rng: np.random.Generator, vertices: Float[np.ndarray, "n 3"], azimuths: Float[np.ndarray, " v"], image_size: int
) -> Camera:
    """A batch of cameras at the azimuths, distances and elevations drawn from the protocol's ranges."""
    center, radius = bounding_sphere(vertices)
    distances = radius * rng.uniform(*DISTANCE_FACTOR, len(azimuths))
    elevations = rng.uniform(*ELEVATION, len(azimuths))
    near = [nearest_distance(vertices - center, a, e) for a, e in zip(azimuths, elevations, strict=True)]
    placed = (jnp.asarray(x, jnp.float32) for x in (np.maximum(distances, near), azimuths, elevations))
    K = intrinsics_from_fov(VERTICAL_FOV, image_size, image_size)
    target = jnp.asarray(center, jnp.float32)
    return _orbit(target, *placed, K, image_size, image_size)


def close_cameras(
    rng: np.random.Generator, vertices: Float[np.ndarray, "n 3"], azimuths: Float[np.ndarray, " v"], image_size: int
) -> Camera:
    """A batch of cameras that see parts: `CLOSE_FACTOR` bounding radii away from points between middle and surface."""
    center, radius = bounding_sphere(vertices)
    count = len(azimuths)
    towards = vertices[rng.integers(len(vertices), size=count)]
    targets = center + rng.uniform(0, CLOSE_SPREAD, (count, 1)) * (towards - center)
    distances = radius * rng.uniform(*CLOSE_FACTOR, count)
    elevations = rng.uniform(*ELEVATION, count)
    for i in range(count):
        direction = _direction(azimuths[i], elevations[i])
        while np.linalg.norm(vertices - targets[i] - distances[i] * direction, axis=1).min() < CLEARANCE:
            distances[i] += 0.05 * radius
    K = intrinsics_from_fov(VERTICAL_FOV, image_size, image_size)
    placed = (jnp.asarray(x, jnp.float32) for x in (targets, distances, azimuths, elevations))
    return _orbits(*placed, K, image_size, image_size)


def _direction(azimuth, elevation):
    """Unit vector from the target towards a camera."""
    sa, ca, se, ce = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    return np.asarray([ce * sa, se, ce * ca])


def nearest_distance(points: Float[np.ndarray, "n 3"], azimuth: float, elevation: float) -> float:
    """Least distance from the origin at which a camera that looks at it has all points (n, 3) in its square frame."""
    sa, ca, se, ce = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    towards, up, right = _direction(azimuth, elevation), np.asarray([-se * sa, ce, -se * ca]), np.asarray([ca, 0, -sa])
    reach = np.maximum(np.abs(points @ up), np.abs(points @ right))
    return float(np.max(reach / (FRAME * np.tan(VERTICAL_FOV / 2)) + points @ towards))
