"""Random cameras on the device, by the protocol of `cameras`: around the person, and for some views close to it."""

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, look_at
from humangs_jax.people.cameras import (
    CLEARANCE,
    CLOSE_FACTOR,
    CLOSE_SPREAD,
    DISTANCE_FACTOR,
    ELEVATION,
    FRAME,
    VERTICAL_FOV,
)
from humangs_jax.people.on_the_fly import pick

CAMERA_NUMBERS = 5


def camera_from(
    u: Float[Array, "5"],
    vertices: Float[Array, "n 3"],
    count: Int[Array, ""] | int,
    azimuth: Float[Array, ""],
    close_share: Float[Array, ""] | float,
    size: int,
) -> Camera:
    """A square camera of `size` pixels that looks at a posed person from an azimuth.

    u: in [0, 1). count: vertices that are no padding. With probability close_share it is a close one, see
    `cameras.close_cameras`; others see all of the person.
    """
    is_close, tilt, spread, outwards, place = u
    low, high = vertices.min(0), vertices.max(0)
    center = 0.5 * (low + high)
    radius = jnp.sqrt(jnp.max(jnp.sum((vertices - center) ** 2, -1)))
    close = is_close < close_share
    elevation = _within(ELEVATION, tilt)
    factor = jnp.where(close, _within(CLOSE_FACTOR, spread), _within(DISTANCE_FACTOR, spread))
    towards_vertex = vertices[pick(place, count)] - center
    target = center + jnp.where(close, CLOSE_SPREAD * outwards, 0.0) * towards_vertex
    towards, up, right = _axes(azimuth, elevation)
    points = vertices - target
    # written out: matrix products are of low precision on GPU and TPU
    ahead, above, aside = (jnp.sum(points * axis, -1) for axis in (towards, up, right))
    whole = jnp.max(jnp.maximum(jnp.abs(above), jnp.abs(aside)) / (FRAME * np.tan(VERTICAL_FOV / 2)) + ahead)
    beside = CLEARANCE**2 - (above * above + aside * aside)  # a camera on its axis comes no nearer than that to a point
    clear = jnp.max(jnp.where(beside > 0, ahead + jnp.sqrt(jnp.maximum(beside, 0)), -jnp.inf))
    distance = jnp.maximum(factor * radius, jnp.where(close, clear, whole))
    K = intrinsics_from_fov(VERTICAL_FOV, size, size).astype(vertices.dtype)
    return look_at(target + distance * towards, target, jnp.asarray([0.0, 1.0, 0.0], vertices.dtype), K, size, size)


def _within(limits, share):
    return limits[0] + (limits[1] - limits[0]) * share


def _axes(azimuth, elevation):
    """Unit vectors towards a camera, up and right in its picture."""
    sa, ca, se, ce = jnp.sin(azimuth), jnp.cos(azimuth), jnp.sin(elevation), jnp.cos(elevation)
    zero = jnp.zeros_like(sa)
    return jnp.stack([ce * sa, se, ce * ca]), jnp.stack([-se * sa, ce, -se * ca]), jnp.stack([ca, zero, -sa])


def azimuths_from(u: Float[Array, " numbers"], jitter: float, scattered_share: float) -> Float[Array, " v"]:
    """(v,) azimuths all around from a random start, each off by up to half `jitter` of the spacing; or anywhere.

    u: 2 + 2 v numbers in [0, 1).
    """
    count = len(u) // 2 - 1
    scattered, start, offsets, places = u[0], u[1], u[2 : 2 + count], u[2 + count :]
    even = 2 * np.pi / count * (jnp.arange(count) + jitter * (offsets - 0.5)) + 2 * np.pi * start
    return jnp.where(scattered < scattered_share, 2 * np.pi * places, even)
