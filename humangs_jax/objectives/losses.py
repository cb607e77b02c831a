"""Losses, unreduced: the caller weighs and averages."""

import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float


def squared_error(predicted: Float[Array, "*b"], target: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Squared difference, elementwise; of images in [0, 1], or of coverages and masks."""
    return jnp.square(predicted - target)


def tightness(tight_offsets: Float[Array, "n k 3"]) -> Float[Array, " n"]:
    """Distance of the tight Gaussians from their vertex: squared norm of the offset, averaged over the k of a vertex.

    Offsets are in normalised units (body height 1.8), so the weight of this term does not depend on the subject's size.
    Without tight Gaussians (k = 0) it is 0.
    """
    return jnp.sum(jnp.square(tight_offsets), axis=(-2, -1)) / max(1, tight_offsets.shape[-2])
