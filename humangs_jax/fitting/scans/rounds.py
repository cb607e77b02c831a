"""Rounds of a fit to a scan: pairs as the body is, then a few steps of damped least squares with these pairs."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from humangs_jax.core.array_types import Array, Float
from humangs_jax.fitting.scans.matches import Target
from humangs_jax.fitting.scans.objective import Given, Matches, ScanProblem, ScanState, Tolerances, scan_residuals
from humangs_jax.fitting.solvers import Outcome, half_squares, least_squares

ALONE = 0.1
"""Metres: when starts are compared, a point without a partner counts as much as one whose partner is so far."""


@dataclasses.dataclass(frozen=True)
class Round:
    """Settings of a round: gate and cut of `Target.matches`, about metres; weight of the pose's prior."""

    gate: float
    cut: float
    prior: float = 1.0


def run_rounds(
    problem: ScanProblem,
    target: Target,
    given: Given,
    tolerances: Tolerances,
    state: ScanState,
    rounds: tuple[Round, ...],
    steps: int,
) -> tuple[ScanState, Outcome]:
    """The body after some rounds, and what the solver did in the last one."""

    def one(state, each):
        matches = target.matches(problem, state, each.gate, each.cut, tolerances)
        own = dataclasses.replace(tolerances, prior=jnp.float32(each.prior))
        return improve(problem, matches, given, own, state, steps)

    *first, last = rounds
    for each in first:
        state, _ = one(state, each)
    return one(state, last)


def leftover(problem: ScanProblem, target: Target, given: Given, tolerances: Tolerances, state: ScanState) -> float:
    """Half the square sum of all residuals with fresh pairs: what tells a good start from a bad one."""
    matches = target.matches(problem, state, ALONE, ALONE, tolerances)
    alone = float(jnp.sum(matches.weights == 0)) * target.effective / len(matches.weights)
    return (
        float(_cost(problem, matches, given, tolerances, state)) + 0.5 * alone * (ALONE / float(tolerances.inside)) ** 2
    )


@functools.partial(jax.jit, static_argnames="steps")
def improve(
    problem: ScanProblem, matches: Matches, given: Given, tolerances: Tolerances, state: ScanState, steps: int
) -> tuple[ScanState, Outcome]:
    """At most so many steps with these pairs."""
    flat, state_of_flat = ravel_pytree(state)  # one array each: blocks of a Jacobian are compiled one by one
    residuals = lambda y: ravel_pytree(scan_residuals(problem, matches, given, tolerances, state_of_flat(y)))[0]
    flat, outcome = least_squares(residuals, flat, steps)
    return state_of_flat(flat), outcome


@jax.jit
def _cost(
    problem: ScanProblem, matches: Matches, given: Given, tolerances: Tolerances, state: ScanState
) -> Float[Array, ""]:
    return half_squares(scan_residuals(problem, matches, given, tolerances, state))
