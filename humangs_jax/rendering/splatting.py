"""Differentiable 3D Gaussian splatting in plain JAX, for CPU, GPU and TPU, under `jit`, `vmap` and `grad`.

Projection, depth order, (tile, splat) pairs, lists by tile and compositing have a module each; `drawing` composes them,
`buffers` sizes what they need. `reference` draws the same image by the definition. Gradients (reverse mode only) reach
means, quats, scales, opacities, colors, deformations, the background, and K and cam_from_world of the camera.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.core import Tracer

from humangs_jax.core.array_types import Array, Bool
from humangs_jax.core.checks import FINITE, check_values, checked_arguments
from humangs_jax.core.compiling import compiler_options
from humangs_jax.geometry.camera import Camera, camera_values
from humangs_jax.rendering import constants
from humangs_jax.rendering.buffers import (
    BufferOverflowError,
    plan_buffers,
    raise_on_overflow,
    warn_of_overflow,
    with_default_buffers,
)
from humangs_jax.rendering.drawing import Background, Rendering, draw, draw_views, with_background
from humangs_jax.rendering.gaussians import Gaussians, gaussian_values
from humangs_jax.rendering.splat_config import DEFAULT_CONFIG, SplatConfig, splat_config

__all__ = ["BufferOverflowError", "Rendering", "SplatConfig", "plan_buffers", "render", "render_views", "seen_from"]


@checked_arguments
def render(
    gaussians: Gaussians,
    camera: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    background: Background = None,
) -> Rendering:
    """Draws Gaussians as one camera sees them.

        rendering = render(gaussians, camera)             # eager: inputs are checked, buffers sized to the scene
        config = SplatConfig(warn_overflow=True)          # for calls inside jit, vmap and grad: buffers are sized once,
        config = plan_buffers(gaussians, cameras, config) # and a warning is logged should they ever be too small
        loss = lambda gaussians: jnp.mean((render(gaussians, camera, config).rgb - photo) ** 2)
        gradient = jax.jit(jax.grad(loss), compiler_options=compiler_options())(gaussians)

    Arguments: gaussians: (g, ...) one set, metres. camera: one camera; its size is the image's. config: what is drawn, and
    the buffers; or the name of one of `SPLAT_PRESETS`. background: (3,) RGB, three numbers, or a color's name; None: white.

    Raises: TypeError for arguments of other classes; ValueError for a batch of cameras or of sets, for shapes that do not fit
    each other, a background that is no color, values that are not finite, opacities outside of [0, 1] and negative scales or
    focal lengths; BufferOverflowError if `config.max_pairs` or `max_rows` is too small. Inside a transformation values are not
    checked. Pairs that do not fit are not drawn there, and are counted in `Rendering.overflow`; `SplatConfig.warn_overflow` logs
    them. Loops that draw often jit `render`, which saves both checks.

    After Kerbl et al. 2023 (https://arxiv.org/abs/2308.04079), with gsplat's conventions (see `constants`).
    """
    if camera.batch_shape:
        raise ValueError(
            f"render draws one camera, got a batch {camera.batch_shape}: use render_views(gaussians, cameras), "
            "or jax.vmap(render, in_axes=(None, 0))(gaussians, cameras) to draw all views at once"
        )
    return _render(_draw_image, gaussians, camera, config, background)


@checked_arguments
def render_views(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    background: Background = None,
) -> Rendering:
    """Draws every camera of a batch (leading axis v), one after the other: working memory does not grow with v
    (what a gradient keeps of each view does).

    `jax.vmap` of `render` draws all views at once (their tiles become one list of tiles) and holds the buffers of all. On
    CPUs it is as fast, but slower with gradients of many views. Arguments and errors: as `render`.

    Returns a Rendering with a leading axis v. Raises: also ValueError for a single camera or several batch axes.
    """
    if len(cameras.batch_shape) != 1:
        raise ValueError(
            "render_views draws cameras with one leading axis, got "
            + (f"a batch {cameras.batch_shape}" if cameras.batch_shape else "a single camera: use render")
        )
    return _render(draw_views, gaussians, cameras, config, background)


@checked_arguments
def seen_from(
    gaussians: Gaussians,
    cameras: Camera,
    config: SplatConfig | str = DEFAULT_CONFIG,
    threshold: float = constants.ALPHA_MIN,
) -> Bool[Array, " g"]:
    """Which Gaussians weigh at least `threshold` on some pixel of some camera (leading axis v).

    The others can be left out for cameras like these: an avatar's inside is never seen.
    """
    visibility = render_views(gaussians, cameras, dataclasses.replace(splat_config(config), visibility=True)).visibility
    assert visibility is not None
    return jnp.max(visibility, axis=0) >= threshold


def _render(draw: Callable[..., Rendering], gaussians: Gaussians, cameras: Camera, config, background) -> Rendering:
    if gaussians.batch_shape:
        raise ValueError(f"expected one set of Gaussians, got a batch {gaussians.batch_shape}: draw it with jax.vmap")
    config = splat_config(config)
    gaussians, cameras, background = with_background(gaussians, cameras, background)
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((gaussians, cameras, background))):
        config = with_default_buffers(gaussians, cameras, config)
        rendering = draw(gaussians, cameras, background, config)
        warn_of_overflow(rendering.overflow, config)
        return rendering
    check_values("render", gaussian_values(gaussians) | camera_values(cameras) | {"background": (background, FINITE)})
    if config.max_pairs is None:
        config = plan_buffers(gaussians, cameras, config, margin=1.0)
    rendering = _jitted(draw)(gaussians, cameras, background, config)
    raise_on_overflow(rendering.overflow, gaussians, cameras, config)
    return rendering


@functools.cache
def _jitted(draw):
    return jax.jit(draw, static_argnums=3, compiler_options=compiler_options())


def _draw_image(gaussians, camera, background, config):
    gaussians = jax.tree.map(lambda leaf: _once_per_image(leaf, camera), gaussians)
    return draw(gaussians, camera, background, config)


@jax.custom_vjp
def _once_per_image(array, camera: Camera):
    """The same array; where `vmap` shares it among cameras, each camera gets its own.

    Its gradient is then summed over the cameras once, and not at each of the dozen operations of the projection that mix
    what is shared with what is not, which on a CPU cost a fifth of the image.
    """
    return _own(array, camera.K)


_once_per_image.defvjp(
    lambda array, camera: (_own(array, camera.K), camera),
    lambda camera, cotangent: (cotangent, jax.tree.map(jnp.zeros_like, camera)),
)


@jax.custom_batching.custom_vmap
def _own(array, of):
    return array


@_own.def_vmap
def _own_in_batch(size, batched, array, of):
    return array if batched[0] else jnp.broadcast_to(array, (size, *array.shape)), True
