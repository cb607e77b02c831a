"""What a compiled JAX program costs: floating-point operations and bytes counted from XLA's optimised program.

    compiled = jax.jit(f).lower(*arguments).compile()
    costs = compiled_costs(compiled)

XLA's own `compiled.cost_analysis()` counts the body of a loop once, however often it runs; here it is counted as often
as it runs. What is counted:

- dots: 2 * (elements of the result) * (length of the contracted axes), also inside fusions and as calls of cuBLAS;
  cuDNN's fused attention as its two products (five in its gradient) over all keys, masked or not. Products with a
  vector, which XLA turns into multiply-and-sum, are no dots.
- convolutions: 2 * (elements of the result) * (spatial size of the kernel) * (input channels of a group). Taps that fall
  on padding count, zeros between the inputs of a transposed convolution do not: so the gradients of a convolution cost
  what it costs itself. (XLA leaves out padding, too.)
- transcendentals: elements of exp, log, tanh, sine, square root, power and the like, where XLA has not written them out
  as polynomials, and not those inside reducers. What the code of a fusion computes twice is not known.
- bytes: operands and results of what runs one after the other. Inside of a fusion nothing is read or written; slices
  read and updates write their part only. Caches are not modelled: it is the traffic of a machine without any.

Conditionals cost what their most expensive branch does. A loop counts as often as XLA knows (or its condition says) that
it runs; where that depends on data it counts once, and `unknown_trips` says how many such loops there are.
"""

import dataclasses
import functools
import math
import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

from experiments.common.hlo import Computation, Instruction, Program, known_trips, parse_program

if TYPE_CHECKING:
    import jax

# fmt: off
TRANSCENDENTALS = frozenset([
    "exponential", "exponential-minus-one", "log", "log-plus-one", "logistic", "power", "rsqrt", "sqrt", "cbrt",
    "sine", "cosine", "tan", "tanh", "atan2", "erf", "acos",
    "acosh", "asin", "asinh", "atanh", "cosh", "sinh",
])
# fmt: on
DOTS = ("dot", "scaled-dot")
UNCOUNTED = frozenset(["fft", "cholesky", "triangular-solve", "ragged-dot"])
"""Matrix arithmetic that nobody here needs; reported by name."""
ATTENTION_PRODUCTS = {False: 2, True: 5}
"""Of cuDNN's fused attention: q k^T and p v; its gradient computes q k^T again and has two products for each."""


@dataclasses.dataclass(frozen=True)
class CompiledCosts:
    """Of one call of a compiled program.

    dot_flops, convolution_flops: multiplications and additions. transcendentals: evaluations. bytes_accessed: read and
    written. uncounted: names of custom calls (and of matrix operations) whose arithmetic is not known and not in the
    sums. unknown_trips: loops whose length is not known, counted as if they ran once. temporary_bytes, argument_bytes,
    output_bytes: memory that the program needs besides its arguments and results, and what these two need (0 where the
    backend does not say).
    """

    dot_flops: int
    convolution_flops: int
    transcendentals: int
    bytes_accessed: int
    uncounted: tuple[str, ...]
    unknown_trips: int
    temporary_bytes: int
    argument_bytes: int
    output_bytes: int

    @property
    def matrix_flops(self) -> int:
        """Of dots and convolutions."""
        return self.dot_flops + self.convolution_flops


def compiled_costs(compiled: "jax.stages.Compiled") -> CompiledCosts:
    """Costs of `jax.jit(f).lower(...).compile()`, see the module. Raises ValueError for what is no HLO text."""
    memory = compiled.memory_analysis()
    size = lambda name: int(getattr(memory, f"{name}_size_in_bytes", 0) or 0)
    return dataclasses.replace(
        program_costs(compiled.as_text() or ""),
        temporary_bytes=size("temp"),
        argument_bytes=size("argument"),
        output_bytes=size("output"),
    )


def program_costs(text: str) -> CompiledCosts:
    """Costs of a program's HLO text; its memory is not in there and stays 0."""
    program = parse_program(text)
    counter = _Counter(program)
    tally = counter.computation(program.entry, fused=False)
    return CompiledCosts(
        *dataclasses.astuple(tally),
        uncounted=tuple(sorted(counter.uncounted)),
        unknown_trips=len(counter.unknown_loops),
        temporary_bytes=0,
        argument_bytes=0,
        output_bytes=0,
    )


@dataclasses.dataclass(frozen=True)
class Tally:
    """Sums over instructions, see `CompiledCosts`."""

    dots: int = 0
    convolutions: int = 0
    transcendentals: int = 0
    bytes: int = 0

    def __add__(self, other: "Tally") -> "Tally":
        pairs = zip(dataclasses.astuple(self), dataclasses.astuple(other), strict=True)
        return Tally(*(a + b for a, b in pairs))

    def times(self, count: int) -> "Tally":
        """That often."""
        return Tally(*(count * x for x in dataclasses.astuple(self)))


class _Counter:
    """Counts the computations of one program, each once; collects what it does not know."""

    def __init__(self, program: Program):
        self.program = program
        self.uncounted: set[str] = set()
        self.unknown_loops: set[tuple[str, str]] = set()

    @functools.cache  # noqa: B019, a counter lives as long as its program
    def computation(self, name: str, fused: bool) -> Tally:
        """Of all instructions of a computation; a fused one moves no bytes."""
        computation = self.program.computations[name]
        return self.total(self.instruction(computation, x, fused) for x in computation.instructions.values())

    @staticmethod
    def total(tallies: Iterable[Tally]) -> Tally:
        return sum(tallies, Tally())

    def instruction(self, computation: Computation, x: Instruction, fused: bool) -> Tally:
        """Of one instruction with all that it calls."""
        if x.opcode == "while":
            return self.loop(computation, x, fused)
        if x.opcode == "conditional":
            keys = ("branch_computations", "true_computation", "false_computation")
            branches = [self.computation(name, fused) for key in keys for name in x.names(key)]
            return max(branches, key=lambda y: (y.dots + y.convolutions, y.transcendentals, y.bytes))
        if x.opcode == "fusion":
            inside = self.total(self.computation(name, True) for name in x.names("calls"))
            return inside if fused else inside + Tally(bytes=fusion_bytes(self.program, x))
        if x.opcode == "call" or x.opcode.endswith("-start"):  # an asynchronous call; a "-done" only waits for it
            called = (*x.names("to_apply"), *x.names("calls"))
            if x.opcode == "call" or called:
                return self.total(self.computation(name, fused) for name in called)
        arithmetic = self.arithmetic(computation, x)
        return arithmetic if fused else arithmetic + Tally(bytes=moved_bytes(computation, x))

    def arithmetic(self, computation: Computation, x: Instruction) -> Tally:
        """Of one instruction that calls nothing."""
        if x.opcode in TRANSCENDENTALS:
            return Tally(transcendentals=x.elements)
        if x.opcode in DOTS:
            return Tally(dots=dot_flops(computation, x, x.numbers("lhs_contracting_dims")))
        if x.opcode == "convolution":
            return Tally(convolutions=convolution_flops(computation, x))
        if x.opcode == "custom-call":
            return self.custom_call(computation, x)
        if x.opcode in UNCOUNTED:
            self.uncounted.add(x.opcode)
        return Tally()

    def custom_call(self, computation: Computation, x: Instruction) -> Tally:
        """Of the libraries that XLA calls on a GPU, as far as they are known."""
        target = x.attribute("custom_call_target") or "custom-call"
        if target.startswith("__cublas$") and (axes := x.configured("lhs_contracting_dimensions")) is not None:
            contracted = tuple(int(i) for i in re.findall(r"\d+", axes))
            return Tally(dots=dot_flops(computation, x, contracted))
        if target.startswith("__cudnn$conv") and x.attribute("dim_labels"):
            return Tally(convolutions=convolution_flops(computation, x, target))
        if target.startswith("__cudnn$fmha") and (shape := _intermediate_shape(x)):
            width = computation.operand(x, 0).arrays[0].dimensions[-1]
            return Tally(dots=2 * ATTENTION_PRODUCTS["Backward" in target] * math.prod(shape) * width)
        self.uncounted.add(target)
        return Tally()

    def loop(self, computation: Computation, x: Instruction, fused: bool) -> Tally:
        """Of a while: its condition is evaluated once more than its body."""
        (condition,), (body,) = x.names("condition"), x.names("body")
        trips = known_trips(self.program, computation, x)
        if trips is None:
            self.unknown_loops.add((computation.name, x.name))
            trips = 1
        return self.computation(body, fused).times(trips) + self.computation(condition, fused).times(trips + 1)


def dot_flops(computation: Computation, x: Instruction, contracted: Iterable[int]) -> int:
    """Of a dot whose left operand has these contracted axes; of a call of cuBLAS, whose first result is the product."""
    left = computation.operand(x, 0).arrays[0].dimensions
    return 2 * x.arrays[0].elements * math.prod(left[axis] for axis in contracted)


def convolution_flops(computation: Computation, x: Instruction, target: str = "") -> int:
    """Of a convolution, or of a call of cuDNN: forward, or a gradient, which costs what the forward convolution does."""
    labels = re.search(r"dim_labels=\w+_(\w+)->", x.attributes)
    assert labels is not None  # every convolution names its axes
    output, kernel = x.arrays[0], computation.operand(x, 1).arrays[0]
    if "BackwardInput" in target:
        output = computation.operand(x, 0).arrays[0]
    elif "BackwardFilter" in target:
        output, kernel = kernel, output
    taps = kernel.elements // max(1, kernel.dimensions[labels[1].index("o")])
    inserted_zeros = re.search(r"lhs_dilate=([\dx]+)", x.attributes)
    dilation = math.prod(map(int, inserted_zeros[1].split("x"))) if inserted_zeros else 1
    return 2 * output.elements * taps // dilation


def _intermediate_shape(x):
    """Batch, heads, queries, keys of fused attention."""
    found = re.search(r"intermediate_tensor_shape.*?dimensions\W*\[([^\]]*)\]", x.attributes)
    return None if found is None else [int(i) for i in re.findall(r"\d+", found[1])]


SLICES = ("slice", "dynamic-slice", "gather")
UPDATES = ("dynamic-update-slice", "scatter")
# fmt: off
FREE = frozenset([
    "parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all",
    "partition-id", "replica-id", "opt-barrier", "add-dependency", "domain", "get-dimension-size",
])
# fmt: on
"""These move nothing."""
LAZY = ("convert", "copy", "reshape", "transpose", "negate")
"""Inside a fusion, a slice of these reads no more of their operand than the slice holds."""


def moved_bytes(computation: Computation, x: Instruction) -> int:
    """Of an instruction outside of fusions that calls nothing."""
    if x.opcode in FREE or x.opcode.endswith(("-done", "-update")):
        return 0
    if x.opcode.endswith("-start") and len(x.arrays) > 1:
        return x.size  # operands and results are both in its shape
    operands = {name: computation.instructions[name].size for name in x.operands}
    if x.opcode in SLICES:
        return 2 * x.size + sum(operands.values()) - operands[x.operands[0]]
    if x.opcode in UPDATES:
        written = sum(update.size for update in updates_of(computation, x))
        combined = written if x.opcode == "scatter" else 0  # it reads what it adds to
        return written + combined + sum(operands.values()) - operands[x.operands[0]]
    return x.size + sum(operands.values())


def fusion_bytes(program: Program, x: Instruction) -> int:
    """Of a fusion outside of other fusions."""
    total = 0
    for name in x.names("calls"):
        called = program.computations[name]
        for parameter in map(called.instructions.__getitem__, called.parameters):
            total += read_elements(program, called, parameter.name) * parameter.size // max(1, parameter.elements)
        total += written_bytes(program, called, called.root)
    return total


def read_elements(
    program: Program, computation: Computation, name: str, updated: bool = False, in_place: bool = True
) -> int:
    """Elements of a value that a fused computation reads.

    updated: the value is a buffer of which a part was written; it only passes through. in_place: it lies where the
    parameter lay.
    """
    whole = computation.instructions[name].elements
    total = whole if name == computation.root and not updated else 0
    for user in computation.users[name]:
        buffer = user.operands[0] == name and user.operands.count(name) == 1
        if user.opcode in SLICES and buffer:
            total += user.elements
        elif user.opcode in UPDATES and buffer and in_place:
            combined = updates_of(computation, user) if user.opcode == "scatter" else []
            total += sum(update.elements for update in combined)
            total += read_elements(program, computation, user.name, updated=True)
        elif user.opcode == "bitcast":
            total += read_elements(program, computation, user.name, updated, in_place)
        elif user.opcode == "tuple" and user.name == computation.root:
            total += 0 if updated else whole
        elif user.opcode == "fusion":
            called = program.computations[user.names("calls")[0]]
            for parameter, operand in zip(called.parameters, user.operands, strict=True):
                total += read_elements(program, called, parameter, updated, in_place) if operand == name else 0
        elif user.opcode in LAZY and not updated:
            total += read_elements(program, computation, user.name, in_place=False)
        else:
            total += whole
    return min(total, whole)


def written_bytes(program: Program, computation: Computation, name: str) -> int:
    """Bytes that a fused computation writes to make a result of this value."""
    x = computation.instructions[name]
    if x.opcode == "tuple":
        return sum(written_bytes(program, computation, operand) for operand in x.operands)
    if x.opcode == "fusion":
        called = program.computations[x.names("calls")[0]]
        return written_bytes(program, called, called.root)
    return bytes_updated_in_place(computation, x) or x.size


def bytes_updated_in_place(computation: Computation, x: Instruction) -> int | None:
    """Bytes written into a parameter on the way to a value that lies where the parameter lay; None if it lies elsewhere."""
    if x.opcode == "parameter":
        return 0
    if x.opcode not in (*UPDATES, "bitcast"):
        return None
    before = bytes_updated_in_place(computation, computation.operand(x, 0))
    if before is None or x.opcode == "bitcast":
        return before
    return before + sum(update.size for update in updates_of(computation, x))


def updates_of(computation: Computation, x: Instruction) -> list[Instruction]:
    """What a dynamic-update-slice or a scatter writes."""
    # a scatter has as many updates as operands, and one array of indices between them
    names = x.operands[1:2] if x.opcode == "dynamic-update-slice" else x.operands[len(x.operands) // 2 + 1 :]
    return [computation.instructions[name] for name in names]
