"""The solver of every fit: half the square sum of residuals is minimised over a pytree of numbers of about unit size.

    lbfgs   many unknowns, cheap under vmap; works through the renderer, which has a backward rule only
    lm      Levenberg and Marquardt by normal equations: few unknowns, quadratic near the solution

Robust losses enter as residuals whose squares they are.
"""

from collections.abc import Callable
from typing import Literal, TypeVar

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from humangs_jax.core.array_types import Array, Bool, Float, Int, PyTree
from humangs_jax.core.pytree import pytree_dataclass

T = TypeVar("T")
NORMAL_MAD = 1.4826
"""Standard deviations of a normal distribution per median absolute deviation."""


@pytree_dataclass
class Outcome:
    """What a solver did; () each, or a batch.

    before, after: half the square sum. steps: taken. converged: False if it ran out of steps or found nothing better.
    """

    before: Float[Array, ""]
    after: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def half_squares(tree: PyTree) -> Float[Array, ""]:
    """Half the square sum of all leaves."""
    return sum((0.5 * jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


def robust(errors: Float[Array, "*n d"], scale: Float[Array, ""] | float) -> Float[Array, "*n d"]:
    """Residuals whose square is Geman and McClure's loss of the length of the errors: e c / sqrt(c^2 + |e|^2), c the scale.

    Like e near 0, and no longer than c far off: a keypoint on another person pulls no harder than one that is a little off.
    """
    return errors * (scale / jnp.sqrt(scale * scale + jnp.sum(jnp.square(errors), axis=-1, keepdims=True)))


def solve(
    residuals: Callable[[T], PyTree],
    start: T,
    steps: int,
    *,
    method: Literal["lbfgs", "lm"],
    tolerance: float = 1e-4,
    free: T | None = None,
) -> tuple[T, Outcome]:
    """Minimise from a start.

    Arguments: residuals: any pytree. steps: at most. tolerance: of the unknowns and, relatively, of the loss. free: pytree of
    booleans like start; the others stay. Returns the solution, or the start where that is no worse, and so finite numbers.
    """
    with jax.default_matmul_precision("highest"):  # the solvers' own products, too
        return _solve(residuals, start, steps, method, tolerance, free)


def _solve(
    residuals: Callable[[T], PyTree], start: T, steps: int, method: Literal["lbfgs", "lm"], tolerance: float, free: T | None
) -> tuple[T, Outcome]:
    import lineax
    import optimistix

    flat, unravel = ravel_pytree(start)  # programs over one vector compile in half the time of those over trees
    moving = None if free is None else ravel_pytree(free)[0]
    hold = lambda y: y if moving is None else jnp.where(moving, y, flat)
    of = lambda y: residuals(unravel(hold(y)))
    if method == "lbfgs":
        lbfgs = optimistix.LBFGS(tolerance, tolerance, history_length=20)
        found = optimistix.minimise(lambda y, _: half_squares(of(y)), lbfgs, flat, max_steps=steps, throw=False)
    else:
        lm = optimistix.LevenbergMarquardt(tolerance, tolerance, linear_solver=lineax.Normal(lineax.Cholesky()))
        vector = lambda y, _: ravel_pytree(of(y))[0]
        found = optimistix.least_squares(vector, lm, flat, max_steps=steps, throw=False)
    before, after = half_squares(of(flat)), half_squares(of(found.value))
    better = after <= before  # False for NaN
    converged = better & (found.result == optimistix.RESULTS.successful)
    value = hold(jnp.where(better, found.value, flat))
    return unravel(value), Outcome(before, jnp.where(better, after, before), jnp.asarray(found.stats["num_steps"]), converged)
