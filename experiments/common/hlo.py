"""XLA's optimised programs (HLO text) as data: computations of instructions with their shapes.

    %name (parameters) -> result {
      ROOT %fusion.1 = f32[8,4]{1,0} fusion(%a, %b), kind=kLoop, calls=%fused_computation, metadata={...}
    }

Instructions run in the order in which they stand. The text of CPU, GPU and TPU programs differs in layouts (ignored
here), custom calls and backend configurations (kept as text).

XLA writes down the trip count of loops that it understands. Where it did not, `known_trips` understands a loop whose element i
of the state begins as a constant, grows by a constant and is compared with a constant, `i < limit`.
"""

import dataclasses
import functools
import math
import re
from collections import defaultdict
from typing import NamedTuple

ITEM_BITS = {"pred": 8, "token": 0, "opaque": 0}
"""Of the element types whose names do not end in their width."""

_COMPUTATION = re.compile(r"^(ENTRY )?%?([^\s(]+) \(.*\{\s*$")
_INSTRUCTION = re.compile(r"^\s+(ROOT )?%?(\S+) = (.*)$")
_ARRAY = re.compile(r"([a-z][a-z0-9]*)\[([^\]]*)\]")
_COMMENT = re.compile(r"/\*.*?\*/")
_METADATA = re.compile(r'metadata=\{(?:"(?:[^"\\]|\\.)*"|[^{}"])*\}')


class ArrayShape(NamedTuple):
    """Element type and dimensions of one array."""

    dtype: str
    dimensions: tuple[int, ...]

    @property
    def elements(self) -> int:
        """How many."""
        return math.prod(self.dimensions)

    @property
    def size(self) -> int:
        """Bytes."""
        bits = ITEM_BITS.get(self.dtype)
        if bits is None:
            width = re.match(r"[a-z]+(\d+)", self.dtype)
            bits = int(width[1]) if width else 8
        return -(-self.elements * bits // 8)


@dataclasses.dataclass(frozen=True)
class Instruction:
    """One line.

    arrays: of the result, the leaves of a tuple in order. operands: names of instructions of the same computation; for
    parameters and constants what stands between the brackets. attributes: the rest of the line, without metadata.
    """

    name: str
    opcode: str
    arrays: tuple[ArrayShape, ...]
    operands: tuple[str, ...]
    attributes: str

    @property
    def elements(self) -> int:
        """Of the result."""
        return sum(array.elements for array in self.arrays)

    @property
    def size(self) -> int:
        """Bytes of the result."""
        return sum(array.size for array in self.arrays)

    def attribute(self, key: str) -> str | None:
        """Value of `key=`: a name, or what its braces hold."""
        value = r'(?:\{([^{}]*)\}|"([^"]*)"|%?([^\s,(){}]+))'
        found = re.search(rf"(?<![\w.]){key}={value}", self.attributes)
        return None if found is None else next(group for group in found.groups() if group is not None)

    def numbers(self, key: str) -> tuple[int, ...]:
        """Integers of `key={1,2}`; none where it is missing."""
        return tuple(int(x) for x in re.findall(r"\d+", self.attribute(key) or ""))

    def names(self, key: str) -> tuple[str, ...]:
        """Computations of `key=%a` or `key={%a, %b}`."""
        return tuple(x.strip().lstrip("%") for x in (self.attribute(key) or "").split(",") if x.strip())

    def configured(self, key: str) -> str | None:
        """Value of a key of the JSON backend configuration, as text: a number, or what its brackets hold."""
        found = re.search(rf'\\?"{key}\\?"\s*:\s*(?:\[([^\]]*)\]|\\?"?([^,"\\}}]*))', self.attributes)
        return None if found is None else (found[1] if found[1] is not None else found[2])


@dataclasses.dataclass(frozen=True)
class Computation:
    """Instructions by name, in their order; root: the name of the result."""

    name: str
    instructions: dict[str, Instruction]
    root: str

    @functools.cached_property
    def users(self) -> dict[str, list[Instruction]]:
        """Instructions that take each one as an operand."""
        users = defaultdict(list)
        for instruction in self.instructions.values():
            for operand in dict.fromkeys(instruction.operands):
                users[operand].append(instruction)
        return users

    @functools.cached_property
    def parameters(self) -> list[str]:
        """Names of the parameters, in their order."""
        found = [x for x in self.instructions.values() if x.opcode == "parameter"]
        return [x.name for x in sorted(found, key=lambda x: int(x.operands[0]))]

    def operand(self, instruction: Instruction, index: int) -> Instruction:
        """The instruction that computes an operand."""
        return self.instructions[instruction.operands[index]]


class Program(NamedTuple):
    """All computations by name, and the name of the one that runs first."""

    computations: dict[str, Computation]
    entry: str


def parse_program(text: str) -> Program:
    """The text of one HLO module. Raises ValueError without an entry computation."""
    computations, entry, current = {}, None, None
    for line in text.splitlines():
        header = _COMPUTATION.match(line)
        if header:
            current = Computation(header[2], {}, "")
            if header[1]:
                entry = header[2]
        elif line.startswith("}") and current is not None:
            computations[current.name], current = current, None
        elif current is not None and (found := _INSTRUCTION.match(line)):
            instruction = _parse_instruction(found[2], found[3])
            current.instructions[instruction.name] = instruction
            if found[1] or not current.root:
                current = dataclasses.replace(current, root=instruction.name)
    if entry is None:
        raise ValueError("no ENTRY computation: not the text of an HLO module")
    return Program(computations, entry)


def _parse_instruction(name, text):
    text = _METADATA.sub("", _COMMENT.sub("", text))
    end = _closing(text, 0) + 1 if text.startswith("(") else text.index(" ")
    shape, rest = text[:end], text[end:].lstrip()
    opening = rest.index("(")
    closing = _closing(rest, opening)
    inside = rest[opening + 1 : closing]
    arrays = tuple(
        ArrayShape(dtype, tuple(int(x.lstrip("<=")) for x in dimensions.split(",") if x.strip()))
        for dtype, dimensions in _ARRAY.findall(shape)
    )
    opcode = rest[:opening]
    if opcode in ("parameter", "constant"):
        operands = (inside.strip(),)
    else:
        operands = tuple(part.split()[-1].lstrip("%") for part in _split(inside) if part.strip())
    return Instruction(name, opcode, arrays, operands, rest[closing + 1 :])


def _closing(text, opening):
    """Where the bracket at `opening` is closed; strings hold no brackets that count."""
    depth, quoted = 0, False
    for index in range(opening, len(text)):
        character = text[index]
        if character == '"' and text[index - 1] != "\\":
            quoted = not quoted
        elif not quoted and character in "({[":
            depth += 1
        elif not quoted and character in ")}]":
            depth -= 1
            if depth == 0:
                return index
    raise ValueError(f"unbalanced brackets: {text[:80]}")


def _split(text):
    """At the commas outside of all brackets."""
    parts, depth, start = [], 0, 0
    for index, character in enumerate(text):
        depth += (character in "({[") - (character in ")}]")
        if character == "," and depth == 0:
            parts.append(text[start:index])
            start = index + 1
    return [*parts, text[start:]]


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
