"""Has the steps of Adam: the state of a run, and a step on one photo that returns the next state.

All functions are pure and for one person. On the host they are a few compiled programs. Under
`jax.jit` and `jax.vmap` they are part of a single program.
"""

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import optax

from humangs_jax.avatar.animate import with_pixel_footprint_of
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.array_types import Array, Float, Int, PyTree
from humangs_jax.core.arrays import from_host
from humangs_jax.core.loops import over
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.views import SubjectViews
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.objective import (
    Comparison,
    avatar_of,
    compare,
    compiled_part,
    drawn_photo,
    loss_gradient,
    parameters_of,
    pulled,
)
from humangs_jax.refinement.photos import Photo, photos_of
from humangs_jax.rendering.gaussians import UnconstrainedGaussians
from humangs_jax.rendering.splat_config import SplatConfig

PULLED = ("means", "log_scales")
"""Parameters that each step moves back towards the start, by `DECAY` of the distance."""
DECAY = 2e-3
FINAL_RATE = 0.1
"""Share of the learning rates that is left at the end."""
OPTIMIZERS: dict[str, Callable[[], optax.GradientTransformation]] = {
    "adam": optax.scale_by_adam,
    "adabelief": optax.scale_by_belief,
    "lion": optax.scale_by_lion,
    "rmsprop": optax.scale_by_rms,
    "sgd": optax.identity,
}
"""The optimizers by their names in `RefineConfig.optimizer`."""


@pytree_dataclass
class RefineState:
    """The state of a run of steps, with all that a step needs to know of the run."""

    parameters: UnconstrainedGaussians
    """The parameters of the Gaussians."""
    start: UnconstrainedGaussians
    """The parameters before the first step. Steps pull the parameters in `PULLED` towards them."""
    trust: Float[Array, " g"]
    """Factor of the rates for each Gaussian, (g,), in [0, 1]."""
    moments: PyTree
    """The optimizer's state."""
    overflow: Int[Array, ""]
    """The number of (splat, tile) pairs that did not fit in the last step. In steps on the head:
    the sum over the last steps, see `head._steps`.
    """
    splat: SplatConfig
    """How photos are drawn, with buffers."""
    done: Int[Array, ""] | int = 0
    """The number of steps done."""
    total: Int[Array, ""] | int = 1
    """The number of steps of the whole run."""
    share: Float[Array, ""] | float = 1.0
    """Factor of all learning rates in this run, see `RefineConfig.full_steps`."""


def init_state(
    parameters: UnconstrainedGaussians, found: Comparison, config: RefineConfig, splat: SplatConfig
) -> RefineState:
    """Returns the state before the first step. found: the comparison of the parameters with all
    photos together (`Comparison.together`). Gaussians that no photo shows get the trust 0.
    """
    return started(parameters, _trust(from_host(found.visibility), config), config, splat)


def started(
    parameters: UnconstrainedGaussians,
    trust: Float[Array, " g"],
    config: RefineConfig,
    splat: SplatConfig,
) -> RefineState:
    """Returns the state before the first step, with a given trust, see `RefineState`."""
    none = from_host(0, jnp.int32)
    return RefineState(parameters, parameters, trust, _moments(parameters, config), none, splat)


@compiled_part
def _moments(parameters: UnconstrainedGaussians, config: RefineConfig) -> PyTree:
    return OPTIMIZERS[config.optimizer]().init(cast(Any, parameters))


@compiled_part
def _trust(visibility: Float[Array, " g"], config: RefineConfig) -> Float[Array, " g"]:
    return jnp.minimum(visibility / config.visible, 1.0)


def step(state: RefineState, photo: Photo, avatar: Avatar, config: RefineConfig) -> RefineState:
    """Returns the state after one step on a photo.

    If the returned state has an overflow, repeat the step with larger buffers.
    """
    image, pull_back, rendering = drawn_photo(state.parameters, avatar, photo, state.splat)
    gradient, _ = pulled(pull_back, loss_gradient(image, photo, config))
    return update(replace(state, overflow=rendering.overflow), gradient, config)


@compiled_part
def update(
    state: RefineState, gradient: UnconstrainedGaussians, config: RefineConfig
) -> RefineState:
    """Returns the state after one step of the optimizer, which has a rate for each parameter.

    Adam's steps do not shrink with the gradient, so the trust multiplies the step and not the loss.
    """
    steps, moments = OPTIMIZERS[config.optimizer]().update(cast(Any, gradient), state.moments)
    cosine = FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (
        1 + jnp.cos(jnp.pi * (state.done / state.total))
    )

    def moved(name: str) -> Array:
        value, step = getattr(state.parameters, name), getattr(steps, name)
        rate = state.share * cosine * getattr(config.rates, name)
        value = value - rate * state.trust.reshape(-1, *[1] * (value.ndim - 1)) * step
        if name in PULLED:
            return value - DECAY * (value - getattr(state.start, name))
        return value

    parameters = replace(state.parameters, **{name: moved(name) for name in vars(config.rates)})
    return replace(state, parameters=parameters, moments=moments, done=state.done + 1)


def refine_views(
    avatar: Avatar, views: SubjectViews, config: RefineConfig, splat: SplatConfig, steps: int
) -> tuple[Avatar, Int[Array, ""]]:
    """Makes `steps` steps of one photo each, in turns, on all pixels that count. Returns the avatar
    and the number of (splat, tile) pairs that did not fit. This is `refine` without its decisions,
    for `jax.jit` and `jax.vmap`.

    Static arguments are `config`, `splat` and `steps`. Only the loss, the optimizer, the rates and
    `visible` of the configuration are used. `splat` needs `max_pairs` (see `plan_buffers`). Batch
    over people whose arrays have the same shapes with `jax.vmap(..., in_axes=(0, 0, None, None,
    None))`.

    Raises: ValueError if the avatar has harmonics or deformations.
    """
    avatar, photos = with_pixel_footprint_of(avatar, views), photos_of(views)
    parameters = parameters_of(avatar.gaussians)
    found = over(
        lambda photo: compare(parameters, avatar, photo, config, splat),
        photos,
        views.cameras.width * views.cameras.height,
    )
    state = replace(init_state(parameters, found.together(), config, splat), total=steps)

    def one(state: RefineState, i: Int[Array, ""]) -> tuple[RefineState, Int[Array, ""]]:
        photo = jax.tree.map(lambda x: x[i % len(views.images)], photos)
        state = step(state, photo, avatar, config)
        return state, state.overflow

    # the loop carries arrays
    state = replace(
        state, done=jnp.zeros((), jnp.int32), total=jnp.asarray(steps), share=jnp.ones(())
    )
    state, overflow = jax.lax.scan(one, state, jnp.arange(steps))
    return avatar_of(state.parameters, avatar), jnp.sum(overflow)
