"""Pixel rays and their Plücker coordinates (moment o × d, direction d), in the world frame."""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float
from humangs_jax.geometry.camera import Camera


def pixel_rays(camera: Camera) -> tuple[Float[Array, "3"], Float[Array, "h w 3"]]:
    """Camera centre and unit directions through the pixel centres (x + 0.5, y + 0.5) of one camera."""
    x = (jnp.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (jnp.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    x, y = jnp.meshgrid(x, y)
    in_camera = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    in_camera = in_camera / jnp.linalg.norm(in_camera, axis=-1, keepdims=True)  # z = 1: the norm is at least 1
    return camera.center, in_camera @ camera.cam_from_world[:3, :3]


def plucker_rays(camera: Camera) -> Float[Array, "h w 6"]:
    """Moment, then direction, of every pixel's ray (reference: HumanGS, after Sitzmann et al., Light Field Networks)."""
    origin, directions = pixel_rays(camera)
    moments = jnp.cross(jnp.broadcast_to(origin, directions.shape), directions)
    return jnp.concatenate([moments, directions], axis=-1)
