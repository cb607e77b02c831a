"""Named stages of one computation, and a recorder that watches them.

The pass, the drawing and the loss are written once. Each names its stages by calling them through a `StageCaller`:

    features = stage("vertex features", read, encoding)

`call` runs the function and nothing else. A `Recorder` also keeps what goes in and out, and, through probes, the gradients that
come back. A probe is an extra argument of zeros whose gradient is what passes back through the array that it watches, so one
differentiation with respect to all probes gives every gradient on the way.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, PyTree

T = TypeVar("T")

StageCaller = Callable[..., Any]
"""stage(name, function, *learned) -> function(*learned). learned: the arguments that depend on parameters."""
Named = dict[str, Array]
"""Arrays by their paths in a pytree, as cameras.K; "" for a bare array."""


def call(name: str, function: Callable[..., T], *learned: Any) -> T:
    """The plain stage: function(*learned)."""
    return function(*learned)


def inexact_leaves(tree: PyTree) -> Iterator[tuple[str, Any]]:
    """(path, leaf) of all floating-point arrays of a tree."""
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
    """A `StageCaller` that records what the stages of one traced computation take and give, in the order of their first use.

    outputs: {stage: what it returned}. given: {stage: {leaf: array}}, the floating-point arrays of the same. probes:
    {stage: {leaf: zeros}} to differentiate with respect to; None in a first run, which finds their shapes: `probes()`.
    """

    def __init__(self, probes: dict[str, Named] | None = None):
        self.outputs: dict[str, Any] = {}
        self.given: dict[str, Named] = {}
        self._probes = probes
        self._shapes: dict[str, Named] = {}

    def __call__(self, name: str, function: Callable[..., T], *learned: Any) -> T:
        """Run a stage."""
        taken = self.take(name, learned) if learned else learned
        return self.give(name, function(*taken))

    def take(self, stage: str, tree: T) -> T:
        """What a stage takes, observed: the gradients that this stage sends back are recorded apart from those of others."""
        self.given.setdefault(stage, {})
        leaves = dict(inexact_leaves(tree))
        if self._probes is None:
            self._shapes.setdefault(stage, {}).update(jax.eval_shape(lambda: leaves))
            return tree
        probes = self._probes[stage]
        observed = {name: observe(leaf, probes[name]) for name, leaf in leaves.items()}
        return jax.tree_util.tree_map_with_path(lambda path, leaf: observed.get(_name(path), leaf), tree)

    def give(self, stage: str, tree: T) -> T:
        """What a stage returns."""
        self.outputs[stage] = tree
        self.given.setdefault(stage, {}).update(inexact_leaves(tree))
        return tree

    def probes(self) -> dict[str, Named]:
        """Zeros for a second run of the same stages."""
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._shapes)

    def watch(self, run: Callable[..., Any], arguments: tuple, named: dict, context: Any) -> Any:
        """For `nn.intercept_methods`: Linen modules with a `stage_name` are stages of their own.

        Only their first argument is observed. They must lie outside of loops (`scan`) and recomputation (`remat`).
        """
        name = module_stage(context.module)
        if context.method_name != "__call__" or name is None:
            return run(*arguments, **named)
        first, *others = arguments
        # of the first module only the output is recorded: nothing that it takes depends on parameters
        taken = self.take(name, first) if getattr(context.module, "learned_input", True) else first
        return self.give(name, run(taken, *others, **named))


def module_stage(module: nn.Module) -> str | None:
    """The stage that a Linen module is: its own `stage_name`, or the one that its parent gives to it."""
    named_by_parent = getattr(module.parent, "stage_names", {})
    return getattr(module, "stage_name", None) or named_by_parent.get(module.name)
