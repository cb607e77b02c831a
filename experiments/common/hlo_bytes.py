"""Bytes that the instructions of an optimised program read and write (see `compiled_costs`).

A fusion reads its operands and writes its result; of a buffer that it only slices it reads the slices, and of a buffer
that it updates in place it writes the updates. The same holds for slices and updates that stand alone.
"""

from experiments.common.hlo import Computation, Instruction, Program

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
    """Of an instruction that stands in no fusion and calls nothing."""
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
    """Of a fusion that stands in no other."""
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
