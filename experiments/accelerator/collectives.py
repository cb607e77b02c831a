"""What a device of a mesh sends to others in one call of a compiled program, counted from its text, loops included.

By rings, as the collective libraries do it: of n devices each sends (n - 1) / n of the gathered array (all-gather), of the
array to be summed (reduce-scatter), and twice that of one that all get the sum of (all-reduce).
"""

import dataclasses
import functools
import math
import re
from collections import Counter

from experiments.common.hlo import Computation, Instruction, Program, parse_program
from experiments.common.hlo_loops import known_trips

SENT = {"all-gather": 1, "reduce-scatter": 1, "all-reduce": 2, "all-to-all": 1}
"""Passes over the array. `collective-permute` sends it once, whole."""


@dataclasses.dataclass(frozen=True)
class Collectives:
    """By kind: calls, bytes of the whole arrays, and bytes that each device sends. unknown_trips: loops counted once."""

    calls: dict[str, int]
    array_bytes: dict[str, int]
    sent_bytes: dict[str, int]
    unknown_trips: int


def collectives(text: str, devices: int) -> Collectives:
    """Of an optimised program. devices: the size of a group where the program does not say (one group of all)."""
    counter = _Counter(parse_program(text), devices)
    total = counter.computation(counter.program.entry)
    pick = lambda what: {kind: number for (kind, name), number in sorted(total.items()) if name == what}
    return Collectives(pick("calls"), pick("array"), pick("sent"), len(counter.unknown))


def group_size(attributes: str, devices: int) -> int:
    """Devices of a group, of `replica_groups={{0,1},{2,3}}` or `[groups,size]<=[...]`."""
    if found := re.search(r"replica_groups=\[(\d+),(\d+)\]", attributes):
        return int(found[2])
    if found := re.search(r"replica_groups=\{\{([\d,]+)\}", attributes):
        return len(found[1].split(","))
    return devices


class _Counter:
    def __init__(self, program: Program, devices: int):
        self.program, self.devices = program, devices
        self.unknown: set[str] = set()

    @functools.cache  # noqa: B019, a counter lives as long as its program
    def computation(self, name: str) -> Counter:
        computation, total = self.program.computations[name], Counter()
        for x in computation.instructions.values():
            total.update(self.instruction(computation, x))
        return total

    def instruction(self, computation: Computation, x: Instruction) -> Counter:
        kind = x.opcode.removesuffix("-start")
        if kind in SENT or kind == "collective-permute":
            return self.collective(computation, x, kind)
        if x.opcode == "while":
            trips = known_trips(self.program, computation, x)
            if trips is None:
                self.unknown.add(x.name)
            body = self.computation(x.names("body")[0])
            return Counter({key: (1 if trips is None else trips) * number for key, number in body.items()})
        total = Counter()
        for key in ("calls", "to_apply", "branch_computations", "true_computation", "false_computation"):
            for name in x.names(key):
                if name in self.program.computations:
                    total.update(self.computation(name))
        return total

    def collective(self, computation: Computation, x: Instruction, kind: str) -> Counter:
        given = sum(computation.instructions[name].size for name in x.operands if name in computation.instructions)
        size = group_size(x.attributes, self.devices)
        whole = given * size if kind == "all-gather" else given
        share = 1 if kind == "collective-permute" else SENT[kind] * (size - 1) / size
        return Counter({(kind, "calls"): 1, (kind, "array"): whole, (kind, "sent"): math.ceil(whole * share)})
