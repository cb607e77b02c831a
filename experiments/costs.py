"""What a traced JAX program costs: multiplications and additions of its matrix products and
convolutions, and what it sends.

    costs = costs_of(jax.jit(f).trace(*arguments))

XLA's own `cost_analysis()` counts the body of a loop once; here it counts as often as it runs. The
program is counted as it is
written: what nothing reads is left out, what XLA fuses makes no difference. Conditionals cost what
their dearest branch does. A loop whose length depends on data counts once, and `unknown_trips` says
how many there are. Zeros between the inputs of a transposed convolution do not count, so that the
gradients of a convolution cost what it costs itself; padding does. Operations and messages inside
of `shard_map` are those of one device.
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
"""Of each message, how often the whole array passes a device, but for its own share of it."""
MEBI = 1 / 2**20


@dataclasses.dataclass(frozen=True)
class Costs:
    """dots, convolutions: operations. messages: calls by kind. sent: bytes that one device sends,
    by kind.
    """

    dots: int = 0
    convolutions: int = 0
    unknown_trips: int = 0
    messages: Counter = dataclasses.field(default_factory=Counter)
    sent: Counter = dataclasses.field(default_factory=Counter)

    @property
    def flops(self) -> int:
        """Of products and convolutions."""
        return self.dots + self.convolutions

    def __add__(self, other: "Costs") -> "Costs":
        return Costs(
            *(getattr(self, f.name) + getattr(other, f.name) for f in dataclasses.fields(self))
        )

    def times(self, count: int) -> "Costs":
        """That often."""

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
    """Costs of `jax.jit(f).trace(...)`."""
    from jax.interpreters.partial_eval import dce_jaxpr

    jaxpr = traced.jaxpr.jaxpr
    return _of_jaxpr(dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))[0], {})


def temporary_mb(compiled: Any) -> float:
    """MiB that a compiled program needs besides its arguments and results."""
    return MEBI * compiled.memory_analysis().temp_size_in_bytes


def _of_jaxpr(jaxpr, devices) -> Costs:
    return sum(
        (_of_equation(equation, devices) for equation in getattr(jaxpr, "jaxpr", jaxpr).eqns),
        Costs(),
    )


def _of_equation(equation, devices) -> Costs:
    """devices: how many an axis of the mesh has."""
    name, given, results = equation.primitive.name, equation.params, equation.outvars
    if name == "dot_general":
        left = equation.invars[0].aval.shape
        contracted = math.prod(left[axis] for axis in given["dimension_numbers"][0][0])
        return Costs(dots=2 * results[0].aval.size * contracted)
    if name == "conv_general_dilated":
        kernel, spec = equation.invars[1].aval.shape, given["dimension_numbers"].rhs_spec
        taps = kernel[spec[1]] * math.prod(kernel[axis] for axis in spec[2:])
        count = (
            2
            * results[0].aval.size
            * taps
            // math.prod(given["lhs_dilation"])
            // given["batch_group_count"]
        )
        return Costs(convolutions=count)
    if name in PASSES or name == "ppermute":
        return _message(equation, devices)
    if name == "scan":
        return _of_jaxpr(given["jaxpr"], devices).times(given["length"])
    if name == "while":
        parts = _of_jaxpr(given["cond_jaxpr"], devices) + _of_jaxpr(given["body_jaxpr"], devices)
        return parts + Costs(unknown_trips=1)
    if name == "cond":
        return max(
            (_of_jaxpr(branch, devices) for branch in given["branches"]),
            key=lambda costs: costs.flops,
        )
    if name == "shard_map":
        devices = devices | dict(given["mesh"].shape)
    return sum((_of_jaxpr(inner, devices) for inner in _inner(given)), Costs())


def _inner(given):
    """The programs that an equation calls; of a function with a custom gradient, the
    function.
    """
    for key in ("jaxpr", "call_jaxpr", "call"):
        if key in given:
            return [given[key]]
    return []


def _message(equation, devices) -> Costs:
    name, given = equation.primitive.name, equation.params
    axes = given.get("axes", given.get("axis_name"))
    named = [
        axis for axis in (axes if isinstance(axes, tuple) else (axes,)) if not isinstance(axis, int)
    ]
    if not named:  # vmap has made it a sum over an axis of the array
        return Costs()
    size = math.prod(devices[axis] for axis in named)
    whole = sum(x.aval.size * x.aval.dtype.itemsize for x in equation.invars) * (
        size if name == "all_gather" else 1
    )
    share = 1 if name == "ppermute" else PASSES[name] * (size - 1) / size
    kind = name.removesuffix("_invariant")
    return Costs(messages=Counter({kind: 1}), sent=Counter({kind: math.ceil(whole * share)}))
