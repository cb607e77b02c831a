"""Adaptive density: Gaussians are split where the photos still differ from the rendering; invisible ones give up their slots.

Buffers keep their size. A slot that is not in use holds a Gaussian too clear to be drawn.
"""

import dataclasses

import jax
import jax.numpy as jnp

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.objectives.metrics import OUTLINE
from humangs_jax.refinement.objective import Image, Photos
from humangs_jax.refinement.parameters import Parameters, RefineState

CLEAR = 0.02
"""A Gaussian of less opacity gives its slot away."""
SMALLEST_SPLIT = 1e-3
"""Metres: Gaussians whose longest axis is shorter are not split."""
HALF = 0.5**0.5
"""Standard deviation of the two halves, and their distance from the middle, relative to the whole: the same variance."""


def with_room(avatar: Avatar, growth: float) -> Avatar:
    """The avatar with `growth` times as many slots for Gaussians; the new ones are copies of the first, with opacity 0."""
    count = len(avatar.gaussians.means)
    slots = jnp.arange(round(growth * count))
    index = jnp.where(slots < count, slots, 0)
    avatar = avatar.select(index)
    gaussians = replace(avatar.gaussians, opacities=avatar.gaussians.opacities.at[count:].set(0.0))
    return replace(avatar, gaussians=gaussians)


def without_clear(avatar: Avatar, smallest: float) -> Avatar:
    """The avatar without the Gaussians too clear to be drawn. On the host."""
    return avatar.select(jnp.flatnonzero(avatar.gaussians.opacities >= smallest))


def inner_errors(image: Image, photo: Photos) -> Image:
    """Absolute errors of the colours of one photo. Their pull-back to the brightness of each Gaussian is its share of them.

    Pixels near the outline do not count: more Gaussians there fit the masks of the photos, and look like fur in other views.
    After Rota Bulo et al. 2024 (https://arxiv.org/abs/2404.06109).
    """
    inside = photo.counted & (eroded(photo.masks, round(OUTLINE * max(photo.masks.shape))) > 0.5)
    return jnp.abs(image[0] - photo.images) * inside[..., None], jnp.zeros_like(image[1])


def eroded(mask: Float[Array, "h w"], radius: int) -> Float[Array, "h w"]:
    """The minimum of a mask over the square of pixels within `radius`."""
    side = 2 * radius + 1
    return jax.lax.reduce_window(mask, jnp.inf, jax.lax.min, (side, side), (1, 1), "SAME")


def split(state: RefineState, avatar: Avatar, errors: Float[Array, " g"], count: int) -> tuple[RefineState, Avatar]:
    """Split the `count` Gaussians with the largest errors in two, as far as clear ones leave slots for them.

    The halves lie on the longest axis, and together have the same variance. They inherit the rest, also the moments of Adam.
    """
    p = state.parameters
    opacities, scales = jax.nn.sigmoid(p.opacity_logits), jnp.exp(p.log_scales)
    longest = jnp.argmax(scales, axis=-1)
    lengths = jnp.max(scales, axis=-1)
    eligible = (opacities >= CLEAR) & (lengths >= SMALLEST_SPLIT)
    errors, wholes = jax.lax.top_k(jnp.where(eligible, errors, 0.0), count)
    clearness, slots = jax.lax.top_k(-opacities, count)
    possible = (errors > 0) & (-clearness < CLEAR)
    total = len(opacities)
    slots = jnp.where(possible, slots, total)  # out of range: dropped
    wholes = jnp.where(possible, wholes, total)
    index = jnp.arange(total).at[slots].set(wholes, mode="drop")
    sides = jnp.zeros(total).at[wholes].set(-1.0, mode="drop").at[slots].set(1.0, mode="drop")

    axes = quaternion.to_matrix(quaternion.normalize(p.quats))
    axis = jnp.take_along_axis(axes, longest[:, None, None], axis=-1)[..., 0] * lengths[:, None]
    shift = sides[:, None] * HALF * axis[index]
    halved = jnp.abs(sides)[:, None] * jnp.log(HALF) * jax.nn.one_hot(longest[index], 3)

    def halves(parameters):
        own = {
            field.name: getattr(parameters, field.name)[index]
            for field in dataclasses.fields(Parameters)
            if field.name not in ("rotations", "translations")
        }
        own["means"] += shift
        own["log_scales"] += halved
        return replace(parameters, **own)

    gathered = lambda x: x[index] if x.ndim and len(x) == total else x
    adam = jax.tree.map(gathered, state.adam)
    state = replace(state, parameters=halves(p), start=halves(state.start), trust=state.trust[index], adam=adam)
    return state, avatar.select(index)
