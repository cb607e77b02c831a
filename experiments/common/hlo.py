"""XLA's optimised programs (HLO text) as data: computations of instructions with their shapes.

    %name (parameters) -> result {
      ROOT %fusion.1 = f32[8,4]{1,0} fusion(%a, %b), kind=kLoop, calls=%fused_computation, metadata={...}
    }

Instructions run in the order in which they stand. The text of CPU, GPU and TPU programs differs in layouts (ignored
here), custom calls and backend configurations (kept as text).
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
