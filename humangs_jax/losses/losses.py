"""Losses, unreduced: the caller weighs and averages."""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float

FAR_SURFACE = 0.1
"""Metres."""


def squared_error(predicted: Float[Array, "*b"], target: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Squared difference, elementwise; of images in [0, 1], or of coverages and masks."""
    return jnp.square(predicted - target)


def surface_distance(
    depth: Float[Array, "*b"], alpha: Float[Array, "*b"], target_depth: Float[Array, "*b"], mask: Float[Array, "*b"]
) -> Float[Array, "*b"]:
    """Distance between the surface drawn and the true one, in the unit of the depths, where both are the person's.

    0 where the true one is unknown (0). At most `FAR_SURFACE`: across a silhouette the nearest surfaces are different limbs.
    """
    known = target_depth > 0
    return alpha * mask * known * jnp.minimum(jnp.abs(depth - target_depth), FAR_SURFACE)


def ray_spread(alpha: Float[Array, "*b"], depth: Float[Array, "*b"], squared: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Distortion of the weights w along a ray: sum over pairs of w_i w_j (z_i - z_j)^2, squared units of z.

    alpha: the sum of w. depth, squared: mean of z and of its square, weighted by w. The loss of 2DGS
    (https://arxiv.org/abs/2403.17888, eq. 13) with squared differences, after mip-NeRF 360 (https://arxiv.org/abs/2111.12077).
    """
    return 2 * alpha**2 * jnp.maximum(squared - depth**2, 0)


def translucency(opacities: Float[Array, " g"]) -> Float[Array, " g"]:
    """4 o (1 - o): 0 for opacities of 0 and 1, 1 between them."""
    return 4 * opacities * (1 - opacities)


def tightness(tight_offsets: Float[Array, "n k 3"]) -> Float[Array, " n"]:
    """Distance of the tight Gaussians from their vertex: squared norm of the offset, averaged over the k of a vertex.

    Offsets are in normalised units (body height 1.8), so the weight of this term does not depend on the subject's size.
    Without tight Gaussians (k = 0) it is 0.
    """
    return jnp.sum(jnp.square(tight_offsets), axis=(-2, -1)) / max(1, tight_offsets.shape[-2])
