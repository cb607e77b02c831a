"""Functions for arrays whose gradients have to stay finite.

The double-where rule: a `jnp.where` that selects a finite value still back-propagates NaN from the
branch it rejects, so the rejected branch must be evaluated at a harmless argument first. All
functions here obey it.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, PyTree


def at_least_float32(tree: PyTree) -> PyTree:
    """Returns the tree with all arrays of bfloat16, float16, integers and booleans converted to
    float32. Floating-point arrays that are at least as precise as float32 are unchanged.

    Gradients have the types of the given arrays.
    """

    def widen(a):
        dtype = jnp.promote_types(a.dtype, jnp.float32)
        if dtype != a.dtype:
            return a.astype(dtype)
        return a

    return jax.tree.map(widen, tree)


def safe_divide(
    numerator: Float[Array, "*#n"], denominator: Float[Array, "*#n"]
) -> Float[Array, "*n"]:
    """Returns numerator / denominator, and 0 with zero gradient where the denominator is 0."""
    zero = denominator == 0
    return jnp.where(zero, 0.0, numerator / jnp.where(zero, 1.0, denominator))


def safe_sqrt(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns sqrt(max(x, 0)) with zero gradient where x <= 0. The gradient of `jnp.sqrt` is
    infinite or undefined there.
    """
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def absolute(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Returns |x| with zero gradient at 0. The gradient of `jnp.abs` is 1 there, so an L1 loss of
    images would push where they agree.
    """
    return x * jax.lax.stop_gradient(jnp.sign(x))


def safe_normalize(x: Float[Array, "*b d"], fallback: Float[Array, " d"]) -> Float[Array, "*b d"]:
    """Returns x / |x|, and `fallback` with zero gradient where |x| is 0 or NaN.

    x is divided by its largest magnitude first, so that squares do not overflow and small vectors
    do not underflow.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=-1, keepdims=True))
    zero = ~(largest > 0)
    y = jnp.where(zero, fallback.astype(x.dtype), x / jnp.where(zero, 1.0, largest))
    unit = y * jax.lax.rsqrt(jnp.sum(jnp.square(y), axis=-1, keepdims=True))
    return jnp.where(zero, fallback.astype(x.dtype), unit)


def inverse_sigmoid(p: Float[Array, "*n"], margin: float = 1e-6) -> Float[Array, "*n"]:
    """Returns log(p / (1 - p)) with p clamped to [margin, 1 - margin]."""
    p = jnp.clip(p, margin, 1 - margin)
    return jnp.log(p) - jnp.log1p(-p)
