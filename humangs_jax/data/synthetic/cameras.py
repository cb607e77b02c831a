"""Cameras like those of the published protocol: around the person, vertical field of view 60 degrees, near the horizon."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Float
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit

VERTICAL_FOV = np.deg2rad(60.0)
DISTANCE_FACTOR = (1.8, 2.2)
"""Distance in bounding radii: nearer than 1.7 the frame cuts heads and feet."""
ELEVATION = np.deg2rad(np.asarray([-5.0, 15.0]))
FRAME = 0.98
"""Share of the half frame that the person may reach; a camera that is too near for it steps back."""

_orbit = jax.jit(orbit, static_argnums=(5, 6))


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


def nearest_distance(points: Float[np.ndarray, "n 3"], azimuth: float, elevation: float) -> float:
    """Least distance from the origin at which a camera that looks at it has all points (n, 3) in its square frame."""
    sa, ca, se, ce = np.sin(azimuth), np.cos(azimuth), np.sin(elevation), np.cos(elevation)
    towards, up, right = (
        np.asarray([ce * sa, se, ce * ca]),
        np.asarray([-se * sa, ce, -se * ca]),
        np.asarray([ca, 0, -sa]),
    )
    reach = np.maximum(np.abs(points @ up), np.abs(points @ right))
    return float(np.max(reach / (FRAME * np.tan(VERTICAL_FOV / 2)) + points @ towards))
