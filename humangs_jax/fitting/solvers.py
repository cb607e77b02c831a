"""Optimistix's solvers as fits use them: half a sum of squares is minimised, over a pytree of arrays of about unit size."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int, PyTree
from humangs_jax.core.pytree import pytree_dataclass


@pytree_dataclass
class Outcome:
    """What a solver did: () each, or a batch. before, after: half the square sum. steps taken. converged: or out of steps."""

    before: Float[Array, ""]
    after: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


def half_squares(tree: PyTree) -> Float[Array, ""]:
    """Half the square sum of all leaves."""
    return sum((0.5 * jnp.sum(jnp.square(leaf)) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


def minimise(
    residuals: Callable[[Any], PyTree], start: Any, steps: int, *, tolerance: float = 1e-4
) -> tuple[Any, Outcome]:
    """L-BFGS on half the square sum: many unknowns, cheap gradients, cheap under vmap, and through the renderer, whose
    gradient has a rule for backward mode only.
    """
    import optimistix

    solver = optimistix.LBFGS(tolerance, tolerance, history_length=20)
    objective = lambda y, _: half_squares(residuals(y))
    solution = optimistix.minimise(objective, solver, start, max_steps=steps, throw=False)
    return _safe(residuals, start, solution, optimistix)


def least_squares(
    residuals: Callable[[Any], PyTree], start: Any, steps: int, *, tolerance: float = 1e-4
) -> tuple[Any, Outcome]:
    """Damped least squares (Levenberg and Marquardt) by the normal equations: few unknowns, quadratic near the solution."""
    import lineax
    import optimistix

    solver = optimistix.LevenbergMarquardt(tolerance, tolerance, linear_solver=lineax.Normal(lineax.Cholesky()))
    solution = optimistix.least_squares(lambda y, _: residuals(y), solver, start, max_steps=steps, throw=False)
    return _safe(residuals, start, solution, optimistix)


def _safe(residuals, start, solution, optimistix):
    """The solution, or the start if that was no worse; never numbers that are not finite."""
    before, after = half_squares(residuals(start)), half_squares(residuals(solution.value))
    better = after <= before  # false for NaN
    value = jax.tree.map(lambda new, old: jnp.where(better, new, old), solution.value, start)
    converged = better & (solution.result == optimistix.RESULTS.successful)
    return value, Outcome(before, jnp.where(better, after, before), jnp.asarray(solution.stats["num_steps"]), converged)
