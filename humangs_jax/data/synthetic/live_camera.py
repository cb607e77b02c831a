"""Random cameras on the device, by the protocol of `cameras`: around the person, and for some views close to it."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Array, Float, Key
from humangs_jax.data.synthetic.cameras import DISTANCE_FACTOR, ELEVATION, FRAME, VERTICAL_FOV
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, look_at

CLOSE_FACTOR = (0.8, 1.7)
"""Distances of close cameras, in bounding radii."""
AIM = (0.05, 0.95)
"""Heights of the person that close cameras look at, shares of the whole."""
CLEARANCE = 0.25
"""Metres that any camera keeps from the person, along its axis."""


def draw_camera(
    key: Key, vertices: Float[Array, "n 3"], azimuth: Float[Array, ""], close_share: Float[Array, ""] | float, size: int
) -> Camera:
    """A square camera of `size` pixels that looks at a posed person from an azimuth.

    With probability close_share it is a close one, which looks at some height of the person; others see all of it.
    """
    is_close, tilt, spread, level = jax.random.uniform(key, (4,), vertices.dtype)  # one draw: each costs compile time
    low, high = vertices.min(0), vertices.max(0)
    center = 0.5 * (low + high)
    radius = jnp.sqrt(jnp.max(jnp.sum((vertices - center) ** 2, -1)))
    close = is_close < close_share
    elevation = _within(ELEVATION, tilt)
    factor = jnp.where(close, _within(CLOSE_FACTOR, spread), _within(DISTANCE_FACTOR, spread))
    height = low[1] + _within(AIM, level) * (high[1] - low[1])
    target = center.at[1].set(jnp.where(close, height, center[1]))
    towards, up, right = _axes(azimuth, elevation)
    points = vertices - target
    ahead, above, aside = (points @ axis for axis in (towards, up, right))
    needed = jnp.max(jnp.maximum(jnp.abs(above), jnp.abs(aside)) / (FRAME * np.tan(VERTICAL_FOV / 2)) + ahead)
    distance = jnp.maximum(factor * radius, jnp.where(close, jnp.max(ahead) + CLEARANCE, needed))
    K = intrinsics_from_fov(VERTICAL_FOV, size, size).astype(vertices.dtype)
    return look_at(target + distance * towards, target, jnp.asarray([0.0, 1.0, 0.0], vertices.dtype), K, size, size)


def _within(limits, share):
    return limits[0] + (limits[1] - limits[0]) * share


def _axes(azimuth, elevation):
    """Unit vectors towards a camera, up and right in its picture."""
    sa, ca, se, ce = jnp.sin(azimuth), jnp.cos(azimuth), jnp.sin(elevation), jnp.cos(elevation)
    zero = jnp.zeros_like(sa)
    return jnp.stack([ce * sa, se, ce * ca]), jnp.stack([-se * sa, ce, -se * ca]), jnp.stack([ca, zero, -sa])


def spread_azimuths(key: Key, count: int, jitter: float, scattered_share: float) -> Float[Array, " count"]:
    """(count,) azimuths all around from a random start, each off by up to half `jitter` of the spacing; or anywhere."""
    drawn = jax.random.uniform(key, (2 + 2 * count,))
    scattered, start, offsets, places = drawn[0], drawn[1], drawn[2 : 2 + count], drawn[2 + count :]
    even = 2 * np.pi / count * (jnp.arange(count) + jitter * (offsets - 0.5)) + 2 * np.pi * start
    return jnp.where(scattered < scattered_share, 2 * np.pi * places, even)
