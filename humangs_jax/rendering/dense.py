"""The image by its definition: every Gaussian on every pixel, one after the other. The oracle of `splatting`.

Shares no code with the tiled renderer: its projection multiplies plain matrices, its compositing is the loop of the
formula, its gradients are autodiff's. Memory and time grow with Gaussians times pixels; use it in float64 on small
images.
"""

import functools

import jax
import jax.numpy as jnp
from jax import lax

from humangs_jax.array_types import Array, Float
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.numerics import at_least_float32
from humangs_jax.rendering.constants import LARGEST_FOOTPRINT
from humangs_jax.rendering.gaussians import Gaussians, covariance_factors
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig
from humangs_jax.rendering.splatting import Rendering


@functools.partial(jax.jit, static_argnames="config")
def render_dense(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig = DEFAULT_CONFIG,
    background: Float[Array, "3"] | None = None,
) -> Rendering:
    """Same arguments and meaning as `splatting.render`; buffers and schedule of `config` play no part."""
    if background is None:
        background = jnp.ones(3, gaussians.means.dtype)
    gaussians, camera, background = at_least_float32((gaussians, camera, background))
    centers, conics, depths, visible = _project(gaussians, camera, config)
    order = jnp.argsort(jnp.where(visible, depths, jnp.inf), stable=True)
    y, x = jnp.mgrid[: camera.height, : camera.width] + 0.5
    pixels = jnp.stack([x, y], axis=-1).astype(centers.dtype)

    def draw(state, splat):
        color, distance, transmittance, ended = state
        center, conic, depth, is_visible, opacity, rgb = splat
        d = pixels - center
        raw = opacity * jnp.exp(-0.5 * jnp.einsum("hwi,ij,hwj->hw", d, conic, d))
        alpha = jnp.where(raw < config.alpha_max, raw, config.alpha_max)
        alpha = jnp.where(is_visible & (raw >= config.alpha_min), alpha, 0.0)
        ended = ended | (transmittance * (1 - alpha) <= config.transmittance_stop)
        alpha = jnp.where(ended, 0.0, alpha)
        weight = alpha * transmittance
        state = color + weight[..., None] * rgb, distance + weight * depth, transmittance * (1 - alpha), ended
        return state, None

    blank = jnp.zeros((camera.height, camera.width), centers.dtype)
    state = jnp.zeros((*blank.shape, 3), blank.dtype), blank, blank + 1, blank > 0
    splats = centers, conics, depths, visible, gaussians.opacities, gaussians.colors
    (color, distance, transmittance, _), _ = lax.scan(draw, state, jax.tree.map(lambda leaf: leaf[order], splats))
    alpha = 1 - transmittance
    some = alpha > 0
    depth = jnp.where(some, distance / jnp.where(some, alpha, 1.0), 0.0)
    return Rendering(color + transmittance[..., None] * background, alpha, depth, jnp.int32(0))


def _project(gaussians, camera, config):
    """Centres (g, 2), conics (g, 2, 2), depths (g,) and whether each is drawn; those that are not lie at z = 1."""
    p = transform.apply(camera.cam_from_world, gaussians.means)
    visible = p[:, 2] > config.near
    depths = jnp.where(visible, p[:, 2], 1.0)
    slopes = jnp.where(visible[:, None], p[:, :2], 0.0) / depths[:, None]
    focal, center = jnp.stack([camera.K[0, 0], camera.K[1, 1]]), camera.K[:2, 2]

    at = slopes
    if config.jacobian_margin is not None:
        size = jnp.asarray([camera.width, camera.height], slopes.dtype)
        extra = config.jacobian_margin * 0.5 * size / focal
        at = jnp.clip(slopes, -center / focal - extra, (size - center) / focal + extra)
    jacobian = jnp.concatenate(
        [jnp.broadcast_to(jnp.eye(2, dtype=at.dtype), (*depths.shape, 2, 2)), -at[..., None]], axis=-1
    )
    jacobian = focal[:, None] * jacobian / depths[:, None, None]
    image_from_world = jacobian @ camera.cam_from_world[:3, :3]
    axes = image_from_world @ covariance_factors(gaussians)
    small = jnp.all(jnp.abs(axes) < LARGEST_FOOTPRINT, axis=(1, 2))
    axes = jnp.where(small[:, None, None], axes, 0.0)
    conics = jnp.linalg.inv(axes @ jnp.swapaxes(axes, 1, 2) + config.dilation * jnp.eye(2, dtype=at.dtype))
    return slopes * focal + center, conics, depths, visible & small
