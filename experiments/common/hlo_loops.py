"""How often the loops of an optimised program run.

XLA writes down the trip count of loops that it understands. Where it did not, a loop whose element i of the state begins
as a constant, grows by a constant and is compared with a constant, `i < limit`, is understood here.
"""

import re
from typing import NamedTuple

from experiments.common.hlo import Computation, Instruction, Program

KNOWN = re.compile(r"known_trip_count\W+n\W+(\d+)")
SAME = ("copy", "bitcast", "convert", "opt-barrier")


class Affine(NamedTuple):
    """Element `index` of a loop's state plus `offset`; a constant where `index` is None."""

    index: int | None
    offset: int


def known_trips(program: Program, computation: Computation, loop: Instruction) -> int | None:
    """How often a while's body runs, None where that depends on data."""
    known = KNOWN.search(loop.attributes)
    if known:
        return int(known[1])
    condition = program.computations[loop.names("condition")[0]]
    body = program.computations[loop.names("body")[0]]
    comparison = _comparison(program, condition)
    if comparison is None:
        return None
    counter, limit = comparison
    states = computation.operand(loop, 0), body.instructions[body.root]
    if counter is None or any(state.opcode != "tuple" for state in states):
        return None
    initial, following = states
    start = evaluate(program, computation, initial.operands[counter])
    step = evaluate(program, body, following.operands[counter])
    if start is None or start.index is not None or step is None or step.index != counter or step.offset < 1:
        return None
    return max(0, -(-(limit - start.offset) // step.offset))


def _comparison(program, condition):
    """(i, limit) of `state[i] < limit`."""
    root, arguments = condition.instructions[condition.root], None
    if root.opcode in ("fusion", "call"):
        arguments = [evaluate(program, condition, operand) for operand in root.operands]
        condition = program.computations[(root.names("calls") or root.names("to_apply"))[0]]
        root = condition.instructions[condition.root]
    if root.opcode != "compare" or root.attribute("direction") != "LT":
        return None
    left, right = (evaluate(program, condition, operand, arguments) for operand in root.operands)
    if left is None or left.index is None or right is None or right.index is not None:
        return None
    return left.index, right.offset - left.offset


def evaluate(
    program: Program, computation: Computation, name: str, arguments: list[Affine | None] | None = None
) -> Affine | None:
    """A scalar integer as a function of the state, None for anything else.

    arguments: values of the parameters; without them the only parameter is the loop's state.
    """
    x = computation.instructions[name]
    if x.opcode == "constant":
        return Affine(None, int(x.operands[0])) if re.fullmatch(r"-?\d+", x.operands[0]) else None
    if x.opcode == "parameter":
        return None if arguments is None else arguments[int(x.operands[0])]
    if x.opcode == "get-tuple-element":
        state = computation.operand(x, 0).opcode == "parameter" and arguments is None
        return Affine(int(x.attribute("index") or 0), 0) if state else None
    values = [evaluate(program, computation, operand, arguments) for operand in x.operands] if x.elements == 1 else []
    if x.opcode in ("fusion", "call"):
        called = program.computations[(x.names("calls") or x.names("to_apply"))[0]]
        return evaluate(program, called, called.root, values)
    known = [value for value in values if value is not None]
    if x.opcode in SAME and known:
        return known[0]
    indices = [value.index for value in known if value.index is not None]
    if x.opcode == "add" and len(known) == len(x.operands) and len(indices) <= 1:
        return Affine(indices[0] if indices else None, sum(value.offset for value in known))
    return None
