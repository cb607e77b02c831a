"""Gaussians as unconstrained parameters, and one step of Adam on them.

Everything is a pure function of explicit state, for one person; batch with `jax.vmap`.
"""

import dataclasses
from typing import Any, cast

import jax.numpy as jnp
import optax

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.rendering.gaussians import Gaussians, widened
from humangs_jax.rendering.unconstrained import UnconstrainedGaussians, constrain, unconstrain

PULLED = ("means", "log_scales")
"""Parameters that each step moves back towards the start, by `DECAY` of the distance."""
DECAY = 2e-3
FINAL_RATE = 0.1
"""Share of the learning rates that is left at the end."""
ADAM = optax.scale_by_adam()


@pytree_dataclass
class Parameters:
    """What refinement moves, each without bounds.

    means: (g, 3) metres. quats: (g, 4). log_scales: (g, 3) of metres, no low-pass. opacity_logits: (g,). color_logits: (g, 3).
    rotations: (v, j, 3) and translations: (v, 3), what is added to the pose of each photo.
    """

    means: Float[Array, "g 3"]
    quats: Float[Array, "g 4"]
    log_scales: Float[Array, "g 3"]
    opacity_logits: Float[Array, " g"]
    color_logits: Float[Array, "g 3"]
    rotations: Float[Array, "v j 3"]
    translations: Float[Array, "v 3"]


def parameters_of(gaussians: Gaussians, views: int, joints: int) -> Parameters:
    """Inverse of `gaussians_of`, as far as `unconstrain` is one; poses unchanged."""
    free = unconstrain(replace(gaussians, scales=widened(gaussians.scales, gaussians.low_pass, -1)))
    return Parameters(**vars(free), rotations=jnp.zeros((views, joints, 3)), translations=jnp.zeros((views, 3)))


def gaussians_of(parameters: Parameters, low_pass: Float[Array, " g"] | None) -> Gaussians:
    """The Gaussians that the parameters stand for, with a low-pass on top of their scales."""
    names = [field.name for field in dataclasses.fields(UnconstrainedGaussians)]
    gaussians = constrain(UnconstrainedGaussians(**{name: getattr(parameters, name) for name in names}))
    return replace(gaussians, scales=widened(gaussians.scales, low_pass), low_pass=low_pass)


@pytree_dataclass
class RefineState:
    """State of a run. start: parameters before Adam's first step. trust: (g,) share of the rates at which a Gaussian moves."""

    parameters: Parameters
    start: Parameters
    trust: Float[Array, " g"]
    adam: optax.OptState


def init_state(parameters: Parameters, visibility: Float[Array, " g"], config: RefineConfig) -> RefineState:
    """visibility: largest weight of each Gaussian on the pixels of the photos."""
    trust = jnp.minimum(visibility / config.visible, 1.0)
    return RefineState(parameters, parameters, trust, ADAM.init(cast(Any, parameters)))


def update(
    state: RefineState,
    gradient: Parameters,
    progress: Float[Array, ""] | float,
    config: RefineConfig,
    share: Float[Array, ""] | float = 1.0,
) -> RefineState:
    """One step of Adam with a rate for each parameter. progress: how much of the run is over, in [0, 1]. share: of the rates.

    Adam's steps do not shrink with the gradient, so the trust multiplies the step and not the loss.
    """
    steps, adam = ADAM.update(cast(Any, gradient), state.adam)
    cosine = FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + jnp.cos(jnp.pi * progress))

    def moved(name):
        value, step = getattr(state.parameters, name), getattr(steps, name)
        rate = share * cosine * getattr(config.rates, name)
        if name in ("rotations", "translations"):
            return value - rate * step if config.poses else value
        trust = state.trust.reshape(-1, *[1] * (value.ndim - 1))
        value = value - rate * trust * step
        return value - DECAY * (value - getattr(state.start, name)) if name in PULLED else value

    names = [field.name for field in dataclasses.fields(Parameters)]
    return replace(state, parameters=Parameters(*map(moved, names)), adam=adam)
