"""Moves a fixed number of Gaussians to where they are needed: 3D Gaussian Splatting as Markov Chain
Monte Carlo.

After Kheradmand et al. 2024 (https://arxiv.org/abs/2404.09591). A scene has as many slots as it
may ever have Gaussians, and `used` says which slots are Gaussians. These functions take the place
of cloning, splitting and pruning:

- `mcmc_relocate` moves Gaussians that have become transparent, and slots that are used from now on,
  onto other Gaussians. The other Gaussians are drawn at random in proportion to their opacity. The
  N Gaussians that then lie in one place look like the Gaussian that was there. If it had the
  opacity o and the scales s, each of the N has (equation 9)

      o' = 1 - (1 - o)^(1/N),
      s' = s o / sum_{i=1}^{N} sum_{k=0}^{i-1} C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1);

- `mcmc_noise` shakes the means along their covariances, transparent Gaussians most, so that they
  explore (equation 8);
- `mcmc_penalty` keeps opacities and scales small, so that Gaussians that are not needed become
  transparent (section 3.4).

All are pure functions of one scene, for any optimizer and loss. The double sum is an integral
without cancellation: with 1/sqrt(k+1) = 2/sqrt(pi) int_0^inf exp(-(k+1) t^2) dt it is 2/sqrt(pi)
int_0^inf 1 - (1 - o' exp(-t^2))^N dt.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool, Float, Int, Key
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.pytree import replace
from humangs_jax.rendering.gaussians import UnconstrainedGaussians, constrain, covariances

DEAD = 0.005
"""Opacity at and below which a Gaussian is moved. It is the paper's value."""
SHARPNESS = 100.0
"""Steepness of the sigmoid of the opacity by which noise fades around `DEAD`. It is the paper's
value.
"""
STEP = 0.1
"""Distance between the nodes at which the trapezoidal rule evaluates the integral. Tests compare
the result with the double sum.
"""
REACH = 5.0
"""The upper end of the integral, where exp(-t^2) is below float32's rounding."""
MOST = 1.0 - 1e-6
"""The largest opacity in `divided`. Gaussians with a larger opacity are split as if they had this
one. For an opacity of 1, (1 - o)^(1/N) is 0 and has no logarithm.
"""


class Relocated(NamedTuple):
    """A scene after `mcmc_relocate`."""

    parameters: UnconstrainedGaussians
    """Parameters of all slots."""
    used: Bool[Array, " g"]
    """Which slots hold a Gaussian, (g,)."""
    moved: Bool[Array, " g"]
    """Which slots have changed, (g,): the slots that were moved, and the slots onto which others
    were moved. The optimizer should reset its moments of these slots.
    """


def divided(
    opacity_logits: Float[Array, " g"], copies: Float[Array, " g"]
) -> tuple[Float[Array, " g"], Float[Array, " g"]]:
    """Divides each Gaussian into N = `copies` Gaussians that together look like it. Returns the
    logits of their opacities o', (g,), and the ratio s' / s of the new scales to the old ones,
    (g,).
    """
    logits = jnp.minimum(opacity_logits, math.log(MOST / (1 - MOST)))
    depth = jax.nn.softplus(logits) / copies  # -log(1 - o')
    opacity = -jnp.expm1(-depth)
    t = jnp.asarray(np.arange(0.0, REACH + STEP, STEP), logits.dtype)
    weights = jnp.full(t.shape, STEP, t.dtype).at[0].set(STEP / 2)
    rays = jnp.log1p(-opacity[:, None] * jnp.exp(-t * t))
    integral = 2 / math.sqrt(math.pi) * jnp.sum(-jnp.expm1(copies[:, None] * rays) * weights, -1)
    return jnp.log(jnp.expm1(depth)), jax.nn.sigmoid(logits) / integral


@checked_arguments
def mcmc_relocate(
    key: Key,
    parameters: UnconstrainedGaussians,
    used: Bool[Array, " g"],
    count: Int[Array, ""] | int | None = None,
) -> Relocated:
    """Moves dead Gaussians onto other Gaussians, and uses more slots, up to `count`. The other
    Gaussians are drawn at random, in proportion to their opacity. The scene looks about the same
    afterwards. It is not exactly the same, because divided Gaussians keep an opacity of at least
    `DEAD`. If all Gaussians are dead, nothing changes.

    Args:
        key: a key of `jax.random`.
        parameters: the parameters of all slots, as `unconstrain` makes them.
        used: (g,) which slots are Gaussians.
        count: number of slots that are used afterwards. All slots are used if it is larger than
            their number. If it is None, or smaller than the number of used slots, that number does
            not change.

    Returns:
        Parameters, which slots are used, and which slots have changed.

    Examples:
        >>> moved = jax.jit(hg.mcmc_relocate)(key, parameters, used, jnp.sum(used) * 21 // 20)
        >>> parameters, used = moved.parameters, moved.used
    """
    opacities = jax.nn.sigmoid(parameters.opacity_logits)
    alive = used & (opacities > DEAD)
    room = 0
    if count is not None:
        room = jnp.asarray(count, jnp.int32) - jnp.sum(used, dtype=jnp.int32)
    grown = ~used & (jnp.cumsum(~used, dtype=jnp.int32) <= room)
    moving = ((used & ~alive) | grown) & jnp.any(alive)

    # a source for every slot, by the inverse of the running sum of the opacities
    sums = jnp.cumsum(jnp.where(alive, opacities, 0.0))
    places = jax.random.uniform(key, sums.shape, sums.dtype) * sums[-1]
    source = jnp.minimum(jnp.searchsorted(sums, places, side="right"), sums.shape[0] - 1)
    copies = 1 + jnp.zeros(sums.shape, sums.dtype).at[source].add(moving.astype(sums.dtype))
    split = copies > 1
    logits, shrink = divided(parameters.opacity_logits, copies)
    least = math.log(DEAD / (1 - DEAD))
    parameters = replace(
        parameters,
        opacity_logits=jnp.where(split, jnp.maximum(logits, least), parameters.opacity_logits),
        log_scales=parameters.log_scales + jnp.where(split, jnp.log(shrink), 0.0)[:, None],
    )

    def take(leaf):
        return jnp.where(_like(moving, leaf), leaf[source], leaf)

    return Relocated(jax.tree.map(take, parameters), used | (moving & grown), moving | split)


def _like(mask: Bool[Array, " g"], leaf: Array) -> Array:
    """Returns the mask with axes added, so that it broadcasts with another array."""
    return mask.reshape(mask.shape + (1,) * (leaf.ndim - 1))


@checked_arguments
def mcmc_noise(
    key: Key,
    parameters: UnconstrainedGaussians,
    used: Bool[Array, " g"],
    rate: Float[Array, ""] | float,
) -> UnconstrainedGaussians:
    """Moves the means at random, by `rate` times the covariance times normal numbers. The noise
    fades out where opacities rise above about 0.005.

    Args:
        key: a key of `jax.random`.
        parameters: the parameters of all slots.
        used: (g,) which slots are Gaussians; others stay.
        rate: weight of the noise, 1 / metres. The paper's is 5e5 times the learning rate of the
            means.

    Returns:
        Parameters with other means.

    Examples:
        >>> parameters = hg.mcmc_noise(key, parameters, used, 5e5 * 1.6e-4)
    """
    gaussians = constrain(parameters)
    normal = jax.random.normal(key, parameters.means.shape, parameters.means.dtype)
    share = jnp.where(used, jax.nn.sigmoid(SHARPNESS * (DEAD - gaussians.opacities)), 0.0)
    moves = jnp.sum(covariances(gaussians) * normal[:, None, :], axis=-1)
    return replace(parameters, means=parameters.means + rate * share[:, None] * moves)


@checked_arguments
def mcmc_penalty(
    parameters: UnconstrainedGaussians,
    used: Bool[Array, " g"],
    opacity: Float[Array, ""] | float = 0.01,
    scale: Float[Array, ""] | float = 0.01,
) -> Float[Array, ""]:
    """Returns the penalty that is added to the loss: the mean opacity and the mean scale (metres)
    of the used slots, each times its weight.

    Args:
        parameters: the parameters of all slots.
        used: (g,) which slots are Gaussians.
        opacity: weight of the mean opacity; the paper's is 0.01.
        scale: weight of the mean scale; the paper's is 0.01.

    Returns:
        A number.

    Examples:
        >>> loss = lambda parameters: error(parameters) + hg.mcmc_penalty(parameters, used)
    """
    gaussians = constrain(parameters)
    count = jnp.maximum(jnp.sum(used), 1)
    opacities = jnp.sum(jnp.where(used, gaussians.opacities, 0.0)) / count
    scales = jnp.sum(jnp.where(used[:, None], gaussians.scales, 0.0)) / (3 * count)
    return opacity * opacities + scale * scales
