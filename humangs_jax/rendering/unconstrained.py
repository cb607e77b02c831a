"""Gaussians as parameters without bounds, which optimizers may move freely: log scales, logits of opacities and colors."""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.numerics import inverse_sigmoid
from humangs_jax.core.pytree import Batchable, pytree_dataclass
from humangs_jax.rendering.gaussians import Gaussians

SMALLEST_SCALE = 1e-6
"""Metres; keeps the logarithm finite for flat Gaussians."""
COLOR_MARGIN, OPACITY_MARGIN = 0.005, 0.001
"""How far both are pulled inside (0, 1), where the gradient of the sigmoid does not vanish; opacities less than the smallest that
is drawn, 1/255, so that what is hidden stays hidden."""


@pytree_dataclass
class UnconstrainedGaussians(Batchable):
    """Parameters of Gaussians, or a batch of them, for optax.

    means: (g, 3) metres. quats: (g, 4), of any length. log_scales: (g, 3) of metres. opacity_logits: (g,). color_logits: (g, 3).
    """

    means: Float[Array, "g 3"]
    quats: Float[Array, "g 4"]
    log_scales: Float[Array, "g 3"]
    opacity_logits: Float[Array, " g"]
    color_logits: Float[Array, "g 3"]


def unconstrain(gaussians: Gaussians) -> UnconstrainedGaussians:
    """Inverse of `constrain`, but for opacities and colors within `OPACITY_MARGIN` and `COLOR_MARGIN` of 0 or 1.

    A low-pass is no parameter: it stays in the scales. Raises: ValueError for Gaussians with deformations.

    Example:
        parameters = hg.unconstrain(gaussians)
        loss = lambda p: jnp.mean(jnp.square(hg.render(hg.constrain(p), camera, config).rgb - photo))
        updates, state = optimizer.update(jax.grad(loss)(parameters), state)
        parameters = optax.apply_updates(parameters, updates)
    """
    if gaussians.deformations is not None:
        raise ValueError("unconstrain: the Gaussians carry deformations: take rendering.gaussians.factored(gaussians)")
    return UnconstrainedGaussians(
        gaussians.means,
        gaussians.quats,
        jnp.log(jnp.maximum(gaussians.scales, SMALLEST_SCALE)),
        inverse_sigmoid(gaussians.opacities, OPACITY_MARGIN),
        inverse_sigmoid(gaussians.colors, COLOR_MARGIN),
    )


def constrain(parameters: UnconstrainedGaussians) -> Gaussians:
    """The Gaussians that parameters stand for: scales are positive, opacities and colors in (0, 1)."""
    return Gaussians(
        parameters.means,
        parameters.quats,
        jnp.exp(parameters.log_scales),
        jax.nn.sigmoid(parameters.opacity_logits),
        jax.nn.sigmoid(parameters.color_logits),
    )
