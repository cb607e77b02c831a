"""Looks at arrays on their way: at values as they pass, and at gradients as they come back.

A probe is an extra argument of zeros whose gradient is what passes back through the array that it watches. So one
differentiation of the loss with respect to all probes tells of every gradient on the way.
"""

from collections.abc import Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, PyTree

T = TypeVar("T")

Named = dict[str, Array]
"""Arrays by their paths in a pytree, as cameras.K; "" for a bare array."""


def inexact_leaves(tree: PyTree) -> Iterator[tuple[str, Any]]:
    """(path, leaf) of all that could be NaN."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            yield _name(path), leaf


def _name(path):
    return jax.tree_util.keystr(path, simple=True, separator=".")


@jax.custom_vjp
def observe(x: Float[Array, "*n"], probe: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """x itself; its gradient is also that of the probe."""
    return x


observe.defvjp(lambda x, probe: (x, None), lambda _, cotangent: (cotangent, cotangent))


class Recorder:
    """What the stages of one traced computation take and give, in the order of their first mention.

    probes: {stage: {leaf: zeros}} to differentiate with respect to; None at first, to learn of what shapes: `probes()`.
    """

    def __init__(self, probes: dict[str, Named] | None = None):
        self.given: dict[str, Named] = {}
        self._probes = probes
        self._shapes: dict[str, Named] = {}

    def take(self, stage: str, tree: T) -> T:
        """What a stage is given, observed: the gradients that it sends back will be known, apart from all other users'."""
        self.given.setdefault(stage, {})
        leaves = dict(inexact_leaves(tree))
        if self._probes is None:
            self._shapes[stage] = jax.eval_shape(lambda: leaves)
            return tree
        observed = {name: observe(leaf, self._probes[stage][name]) for name, leaf in leaves.items()}
        return jax.tree_util.tree_map_with_path(lambda path, leaf: observed.get(_name(path), leaf), tree)

    def give(self, stage: str, tree: T) -> T:
        """What a stage returns."""
        self.given.setdefault(stage, {}).update(inexact_leaves(tree))
        return tree

    def probes(self) -> dict[str, Named]:
        """Zeros for a second run of the same stages."""
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._shapes)
