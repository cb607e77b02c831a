"""Counts what a traced JAX program costs: the multiplications and additions of its matrix products
and convolutions, and the bytes that it sends between devices.

    costs = costs_of(jax.jit(f).trace(*arguments))

XLA's `cost_analysis()` counts the body of a loop once. Here it counts as often as it runs. The
program is counted as it is written: what nothing reads is left out, and fusion by XLA makes no
difference. A conditional costs what its most expensive branch costs. A loop whose length depends on
data counts once, and `unknown_trips` is the number of such loops. Zeros between the inputs of a
transposed convolution do not count, so that the gradients of a convolution cost as much as the
convolution. Padding counts. Operations and messages inside of `shard_map` are those of one device.
"""

import dataclasses
import math
from collections import Counter
from typing import Any

PASSES = {
    "all_gather": 1,
    "reduce_scatter": 1,
    "psum": 2,
    "psum_invariant": 2,
    "pmax": 2,
    "pmin": 2,
    "all_to_all": 1,
}
"""{kind of message: how often the array passes a device, except for the device's share of it}."""
MEBI = 1 / 2**20
"""MiB of a byte."""


@dataclasses.dataclass(frozen=True)
class Costs:
    """Costs of a program, which can be added."""

    dots: int = 0
    """Multiplications and additions of matrix products."""
    convolutions: int = 0
    """Multiplications and additions of convolutions."""
    unknown_trips: int = 0
    """Loops whose length depends on data."""
    messages: Counter = dataclasses.field(default_factory=Counter)
    """{kind: number of messages}."""
    sent: Counter = dataclasses.field(default_factory=Counter)
    """{kind: bytes that one device sends}."""

    @property
    def flops(self) -> int:
        """Multiplications and additions of products and convolutions together."""
        return self.dots + self.convolutions

    def __add__(self, other: "Costs") -> "Costs":
        return Costs(
            *(getattr(self, f.name) + getattr(other, f.name) for f in dataclasses.fields(self))
        )

    def times(self, count: int) -> "Costs":
        """Returns the costs of running the program this many times, with its loops of unknown
        length counted once.
        """

        def often(counter):
            return Counter({key: count * number for key, number in counter.items()})

        return Costs(
            count * self.dots,
            count * self.convolutions,
            self.unknown_trips,
            often(self.messages),
            often(self.sent),
        )


def costs_of(traced: Any) -> Costs:
    """Returns the costs of a program `jax.jit(f).trace(...)`."""
    from jax.interpreters.partial_eval import dce_jaxpr

    jaxpr = traced.jaxpr.jaxpr
    return _of_jaxpr(dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[0], {})


def temporary_mb(compiled: Any) -> float:
    """Returns the MiB that a compiled program needs besides its arguments and results."""
    return MEBI * compiled.memory_analysis().temp_size_in_bytes


def _of_jaxpr(jaxpr, devices) -> Costs:
    """Returns the costs of all equations of a program."""
    equations = getattr(jaxpr, "jaxpr", jaxpr).eqns
    return sum((_of_equation(equation, devices) for equation in equations), Costs())


def _of_equation(equation, devices) -> Costs:
    """Returns the costs of an equation. `devices` is {axis of the mesh: its number of devices}."""
    name, given, results = equation.primitive.name, equation.params, equation.outvars
    # operations of one device
    if name == "dot_general":
        left = equation.invars[0].aval.shape
        contracted = math.prod(left[axis] for axis in given["dimension_numbers"][0][0])
        return Costs(dots=2 * results[0].aval.size * contracted)
    if name == "conv_general_dilated":
        kernel, spec = equation.invars[1].aval.shape, given["dimension_numbers"].rhs_spec
        taps = kernel[spec[1]] * math.prod(kernel[axis] for axis in spec[2:])
        # zeros between the inputs do not count
        skipped = math.prod(given["lhs_dilation"])
        count = 2 * results[0].aval.size * taps // skipped // given["batch_group_count"]
        return Costs(convolutions=count)
    # messages between devices
    if name in PASSES or name == "ppermute":
        return _message(equation, devices)
    # loops, conditionals and calls of other programs
    if name == "scan":
        return _of_jaxpr(given["jaxpr"], devices).times(given["length"])
    if name == "while":
        parts = _of_jaxpr(given["cond_jaxpr"], devices) + _of_jaxpr(given["body_jaxpr"], devices)
        return parts + Costs(unknown_trips=1)
    if name == "cond":
        branches = [_of_jaxpr(branch, devices) for branch in given["branches"]]
        return max(branches, key=lambda costs: costs.flops)
    if name == "shard_map":
        devices = devices | dict(given["mesh"].shape)
    return sum((_of_jaxpr(inner, devices) for inner in _inner(given)), Costs())


def _inner(given):
    """Returns the programs that an equation calls. Custom gradients are left out."""
    for key in ("jaxpr", "call_jaxpr", "call"):
        if key in given:
            return [given[key]]
    return []


def _message(equation, devices) -> Costs:
    """Returns the message of an equation, and the bytes that each device sends for it."""
    name, given = equation.primitive.name, equation.params
    axes = given.get("axes", given.get("axis_name"))
    if not isinstance(axes, tuple):
        axes = (axes,)
    named = [axis for axis in axes if not isinstance(axis, int)]
    if not named:  # vmap has made it a sum over an axis of the array
        return Costs()
    size = math.prod(devices[axis] for axis in named)
    whole = sum(x.aval.size * x.aval.dtype.itemsize for x in equation.invars)
    if name == "all_gather":
        whole *= size
    share = 1 if name == "ppermute" else PASSES[name] * (size - 1) / size
    kind = name.removesuffix("_invariant")
    return Costs(messages=Counter({kind: 1}), sent=Counter({kind: math.ceil(whole * share)}))
