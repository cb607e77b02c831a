"""Numbers about arrays on their way: of values as they pass, of gradients as they come back.

A probe is an extra argument of zeros whose gradient is defined to be the statistics of the gradient that passes it. So one
differentiation of the loss with respect to all probes tells of every gradient on the way and keeps none of them.
"""

from collections.abc import Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

from humangs_jax.array_types import Array, Float, PyTree
from humangs_jax.pytree import pytree_dataclass

T = TypeVar("T")


@pytree_dataclass
class Statistics:
    """Of one array of r axes; all numbers are floats, so that they can be gradients.

    bad: entries that are not finite. first: the index of the first of those (zeros without). Of the finite entries:
    smallest and largest (+-inf without any), mean: of their magnitudes, norm: Euclidean.
    """

    bad: Float[Array, ""]
    first: Float[Array, " r"]
    smallest: Float[Array, ""]
    largest: Float[Array, ""]
    mean: Float[Array, ""]
    norm: Float[Array, ""]


def statistics(x: Float[Array, "..."]) -> Statistics:
    """The statistics of an array, in float32 at least."""
    x = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    zero = jnp.zeros((), x.dtype)
    if x.size == 0:
        return Statistics(zero, jnp.zeros(x.ndim, x.dtype), zero + jnp.inf, zero - jnp.inf, zero, zero)
    finite = jnp.isfinite(x)
    magnitudes = jnp.where(finite, jnp.abs(x), 0)
    # sums of what is at most 1: neither a mean nor a norm overflows that is a number itself
    scale = jnp.max(magnitudes)
    relative = magnitudes / jnp.where(scale > 0, scale, 1)
    position = jnp.unravel_index(jnp.argmax(~finite), x.shape) if x.ndim else []
    return Statistics(
        bad=jnp.sum(~finite, dtype=x.dtype),
        first=jnp.asarray(position, x.dtype),
        smallest=jnp.min(jnp.where(finite, x, jnp.inf)),
        largest=jnp.max(jnp.where(finite, x, -jnp.inf)),
        mean=scale * (jnp.sum(relative) / jnp.maximum(jnp.sum(finite, dtype=x.dtype), 1)),
        norm=scale * jnp.sqrt(jnp.sum(jnp.square(relative))),
    )


def tree_statistics(tree: PyTree) -> dict[str, Statistics]:
    """Statistics of every leaf that could be NaN, by its path, as cameras.K ("" for a bare array)."""
    return {name: statistics(leaf) for name, leaf in _inexact_leaves(tree)}


def _inexact_leaves(tree) -> Iterator[tuple[str, Any]]:
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if jnp.issubdtype(leaf.dtype, jnp.inexact):
            yield _name(path), leaf


def _name(path):
    return jax.tree_util.keystr(path, simple=True, separator=".")


@jax.custom_vjp
def observe(x: Float[Array, "*n"], probe: Statistics) -> Float[Array, "*n"]:
    """The same array; the gradient with respect to the probe is the statistics of that with respect to the array."""
    return x


observe.defvjp(lambda x, probe: (x, None), lambda _, cotangent: (cotangent, statistics(cotangent)))


class Recorder:
    """What the stages of one traced computation take and give, in the order of their first mention.

    probes: {stage: {leaf: zeros}} to differentiate with respect to; None at first, to learn of what shapes: `probes()`.
    """

    def __init__(self, probes: dict[str, dict[str, Statistics]] | None = None):
        self.given: dict[str, dict[str, Statistics]] = {}
        self._probes = probes
        self._shapes: dict[str, dict[str, Statistics]] = {}

    def take(self, stage: str, tree: T) -> T:
        """What a stage is given, observed: the gradients that it sends back will be known, apart from all other users'."""
        self.given.setdefault(stage, {})
        named = dict(_inexact_leaves(tree))
        if self._probes is None:
            self._shapes[stage] = jax.eval_shape(tree_statistics, tree)
            return tree
        observed = {name: observe(leaf, self._probes[stage][name]) for name, leaf in named.items()}
        return jax.tree_util.tree_map_with_path(lambda path, leaf: observed.get(_name(path), leaf), tree)

    def give(self, stage: str, tree: T) -> T:
        """What a stage returns."""
        self.given.setdefault(stage, {}).update(tree_statistics(tree))
        return tree

    def probes(self) -> dict[str, dict[str, Statistics]]:
        """Zeros for a second run of the same stages."""
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._shapes)
