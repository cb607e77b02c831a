"""Defines the state of a scene that is fitted, and two pure functions that make the next state. One
is a step of Adam with the noise of `scenes.mcmc`, the other relocates dead Gaussians.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

from humangs_jax.core.array_types import Array, Bool, Float, Int, Key, PyTree
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.losses.losses import structural_dissimilarity
from humangs_jax.rendering.gaussians import (
    Gaussians,
    UnconstrainedGaussians,
    constrain,
    unconstrain,
)
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import render
from humangs_jax.scenes.config import SceneConfig
from humangs_jax.scenes.mcmc import mcmc_noise, mcmc_penalty, mcmc_relocate

HIDDEN = -20.0
"""The logit of the opacity of unused slots. It is so low that unused slots touch no tile."""
ADAM = optax.scale_by_adam(eps=1e-15)


@pytree_dataclass
class SceneState:
    """The state of a scene between two steps."""

    step: Int[Array, ""]
    """The number of steps that are done."""
    parameters: UnconstrainedGaussians
    """The parameters of all slots, g of them."""
    used: Bool[Array, " g"]
    """Which slots are Gaussians, (g,)."""
    moments: PyTree
    """The state of Adam: its number of steps, and the two moments of each parameter."""
    overflow: Int[Array, ""]
    """The number of (splat, tile) pairs that did not fit, in the worst step since the buffers were
    planned.
    """


def begin_scene(gaussians: Gaussians, capacity: int) -> SceneState:
    """Returns a state with `capacity` slots, of which the first are these Gaussians.

    Raises: ValueError for more Gaussians than the capacity, or for Gaussians with deformations.
    """
    count = len(gaussians.opacities)
    if count > capacity:
        raise ValueError(f"points: {count:,} are more than SceneConfig.capacity {capacity:,}")

    def pad(leaf):
        return jnp.pad(leaf, [(0, capacity - count)] + [(0, 0)] * (leaf.ndim - 1))

    parameters, used = jax.tree.map(pad, unconstrain(gaussians)), jnp.arange(capacity) < count
    zero = jnp.zeros((), jnp.int32)
    return SceneState(zero, parameters, used, ADAM.init(parameters), zero)


def scene_gaussians(state: SceneState) -> Gaussians:
    """Returns the Gaussians of the used slots. It works outside of transformations only."""
    used = np.flatnonzero(state.used)
    return jax.tree.map(lambda leaf: leaf[used], constrain(state.parameters))


def drawn_gaussians(parameters: UnconstrainedGaussians, used: Bool[Array, " g"]) -> Gaussians:
    """Returns all slots as Gaussians; unused slots are transparent."""
    logits = jnp.where(used, parameters.opacity_logits, HIDDEN)
    return constrain(replace(parameters, opacity_logits=logits))


def scene_step(
    state: SceneState,
    camera: Camera,
    photo: Array,
    background: Float[Array, "3"],
    key: Key,
    extent: Float[Array, ""],
    config: SceneConfig,
    splat: SplatConfig,
) -> SceneState:
    """Returns the state after one step of Adam on one photo, with noise. photo: (h, w, 3), bytes or
    numbers in [0, 1]. extent: see `extent_of`, metres.
    """
    target = photo.astype(jnp.float32) / (255 if photo.dtype == jnp.uint8 else 1)

    # the error of the image, and what MCMC charges for opaque and large Gaussians
    def loss(parameters):
        drawn = render(drawn_gaussians(parameters, state.used), camera, splat, background)
        absolute = jnp.mean(jnp.abs(drawn.rgb - target))
        structural = jnp.mean(structural_dissimilarity(drawn.rgb, target))
        error = (1 - config.structural) * absolute + config.structural * 2 * structural
        penalty = mcmc_penalty(
            parameters, state.used, config.opacity_penalty, config.scale_penalty / extent
        )
        return error + penalty, drawn.overflow

    # Adam, whose rates fall with the steps; those of positions are relative to the extent of the
    # scene
    gradient, overflow = jax.grad(loss, has_aux=True)(state.parameters)
    updates, moments = ADAM.update(gradient, state.moments)
    done = state.step / config.steps
    names = [name for name, leaf in vars(state.parameters).items() if leaf is not None]
    rates = {name: getattr(config.rates, name) for name in names}
    shares = {name: config.other_final_share**done for name in rates}
    shares["means"] = config.final_share**done * extent
    moved = {
        name: getattr(state.parameters, name) - rate * shares[name] * getattr(updates, name)
        for name, rate in rates.items()
    }
    parameters = replace(state.parameters, **moved)
    noise = config.noise * rates["means"] * shares["means"] / jnp.square(extent)
    parameters = mcmc_noise(key, parameters, state.used, noise)
    overflow = jnp.maximum(state.overflow, overflow)
    return SceneState(state.step + 1, parameters, state.used, moments, overflow)


def relocate_scene(state: SceneState, key: Key, growth: Float[Array, ""] | float) -> SceneState:
    """Returns the state after a relocation: dead Gaussians are moved, `growth` times as many slots
    are used, up to all, and Adam's moments of changed slots are 0.
    """
    count = jnp.ceil(growth * jnp.sum(state.used)).astype(jnp.int32)
    found = mcmc_relocate(key, state.parameters, state.used, count)

    def forgotten(leaf):
        if leaf.ndim == 0:
            return leaf
        moved = found.moved.reshape(found.moved.shape + (1,) * (leaf.ndim - 1))
        return jnp.where(moved, 0.0, leaf)

    moments = jax.tree.map(forgotten, state.moments)
    return replace(state, parameters=found.parameters, used=found.used, moments=moments)


@functools.cache
def compiled_programs() -> tuple[Callable[..., SceneState], Callable[..., SceneState]]:
    """Returns the compiled step and the compiled relocation.

    States are not donated, since Ctrl-C may come before the next state is there.
    """
    step = jax.jit(scene_step, static_argnums=(6, 7), compiler_options=compiler_options())
    return step, jax.jit(relocate_scene)
