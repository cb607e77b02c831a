"""Cameras like those of the published protocol: around the person, vertical field of view 60 degrees, near the horizon."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit

VERTICAL_FOV = np.deg2rad(60.0)
DISTANCE_FACTOR = (1.8, 2.2)
"""Distance in bounding radii: nearer than 1.7 the frame cuts heads and feet."""
ELEVATION = np.deg2rad(np.asarray([-5.0, 15.0]))


def bounding_sphere(vertices: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle of the bounding box (3,) and the largest distance from it."""
    center = 0.5 * (vertices.min(0) + vertices.max(0))
    return center, float(np.linalg.norm(vertices - center, axis=1).max())


def spread_azimuths(rng: np.random.Generator, count: int, jitter: float = 0.3) -> np.ndarray:
    """(count,) sorted azimuths, evenly spread from a random start, each moved by up to `jitter` of the spacing."""
    spacing = 2 * np.pi / count
    return rng.uniform(0, spacing) + spacing * (np.arange(count) + rng.uniform(-jitter, jitter, count))


def cameras_around(rng: np.random.Generator, vertices: np.ndarray, azimuths: np.ndarray, image_size: int) -> Camera:
    """A batch of cameras at the azimuths, distances and elevations drawn from the protocol's ranges."""
    center, radius = bounding_sphere(vertices)
    count = len(azimuths)
    distances = radius * rng.uniform(*DISTANCE_FACTOR, count)
    elevations = rng.uniform(*ELEVATION, count)
    K = intrinsics_from_fov(VERTICAL_FOV, image_size, image_size)
    return _orbit(
        jnp.asarray(center, jnp.float32),
        jnp.asarray(distances, jnp.float32),
        jnp.asarray(azimuths, jnp.float32),
        jnp.asarray(elevations, jnp.float32),
        K,
        image_size,
    )


def _orbit(center, distances, azimuths, elevations, K, size):
    return _jitted(center, distances, azimuths, elevations, K, size, size)


_jitted = jax.jit(orbit, static_argnums=(5, 6))
