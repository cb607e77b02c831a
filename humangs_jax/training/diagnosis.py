"""What a diagnosis says: the stages of one step in numbers, the first one that is not finite, and all of that as text."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from humangs_jax.core.array_types import PyTree
from humangs_jax.core.progress import text_table
from humangs_jax.network.stages import inexact_leaves

_COUNTED = {
    "view": ("K", "cam_from_world", "translations"),
    "view joint": ("rotations",),
    "view vertex": ("posed_vertices",),
    "view row column": ("images", "masks", "position_maps", "depth_maps", "pixels", "maps", "encoding", "rgb", "alpha"),
    "view Gaussian": ("posed Gaussians", "projected splats"),
    "vertex": ("canonical_vertices", "vertex features"),
    "vertex Gaussian": ("raw heads", "tight_offsets"),
    "token": ("tokens", "input norm", "block", "final norm"),
    "feature": ("global_token",),
    "Gaussian": ("canonical Gaussians",),
}
AXES = {name: axes for axes, names in _COUNTED.items() for name in names}
"""What the leading axes of an array count: by the last part of its name, or else by its stage."""

Direction = Literal["stored", "forward", "backward"]


@dataclasses.dataclass(frozen=True)
class Leaf:
    """Numbers of one array. bad: entries that are not finite, the first of them at index `first`. Of the finite entries:
    smallest and largest (+-inf without any), the mean of their magnitudes, their Euclidean norm.
    """

    name: str
    bad: int
    first: tuple[int, ...]
    smallest: float
    largest: float
    mean: float
    norm: float

    @classmethod
    def of(cls, name: str, array: np.ndarray) -> "Leaf":
        """The numbers of an array."""
        wrong = ~np.isfinite(array.astype(np.promote_types(array.dtype, np.float32), copy=False))
        bad = int(np.count_nonzero(wrong))
        finite = (array[~wrong] if bad else array.reshape(-1)).astype(np.float64)
        return cls(
            name=name,
            bad=bad,
            first=tuple(int(i) for i in np.unravel_index(int(np.argmax(wrong)), array.shape)) if bad else (),
            smallest=float(np.min(finite, initial=np.inf)),
            largest=float(np.max(finite, initial=-np.inf)),
            mean=float(np.mean(np.abs(finite))) if finite.size else 0.0,
            norm=float(np.linalg.norm(finite)),
        )

    @property
    def magnitude(self) -> float:
        return max(abs(self.smallest), abs(self.largest)) if self.smallest <= self.largest else 0.0


@dataclasses.dataclass(frozen=True)
class StageReport:
    """values: what a stage gave (or what was stored there). cotangents: gradients that it sent back to what it was given.
    gradients: those of its parameters.
    """

    name: str
    values: tuple[Leaf, ...]
    cotangents: tuple[Leaf, ...] = ()
    gradients: tuple[Leaf, ...] = ()

    @property
    def gradient_norm(self) -> float:
        """Euclidean norm of the gradients of its parameters."""
        return math.hypot(*(leaf.norm for leaf in self.gradients))


@dataclasses.dataclass(frozen=True)
class Fault:
    """An array that is not finite: stored so (in the state or the batch), computed by a stage, or sent back by it."""

    direction: Direction
    stage: str
    leaf: Leaf

    def __str__(self) -> str:
        what = {
            "stored": "in the {}",
            "forward": "first computed by stage '{}'",
            "backward": "first in a gradient sent back by stage '{}'",
        }[self.direction].format(self.stage)
        return f"not finite {what}: {self.leaf.name or 'its value'}, {self.leaf.bad} entries, first at {self.place}"

    @property
    def place(self) -> str:
        """The first index in words, as: view 1, row 4, column 7 [2]."""
        last_part = self.leaf.name.rsplit(".", 1)[-1]
        stage = self.stage.split(" ")[0] if self.stage.startswith("block ") else self.stage
        axes = AXES.get(last_part, AXES.get(stage, ""))
        names = axes.split()[: len(self.leaf.first)]
        words = ", ".join(f"{name} {index}" for name, index in zip(names, self.leaf.first, strict=False))
        rest = list(self.leaf.first[len(names) :])
        return f"{words} {rest if rest or not words else ''}".strip()


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of one subject of a step: the first with a fault, or else the one with the largest gradient.

    step: steps done before it. stored: what the step began with, state and batch. stages: in the order of the forward
    pass. skip_norm: gradients longer than this are skipped. `str` of it is a report.
    """

    step: int
    subject: int
    loss: float
    skip_norm: float
    stored: tuple[StageReport, ...]
    stages: tuple[StageReport, ...]

    @property
    def gradient_norm(self) -> float:
        """Euclidean norm of the finite part of this subject's gradient."""
        return math.hypot(*(stage.gradient_norm for stage in self.stages))

    @property
    def faults(self) -> tuple[Fault, ...]:
        """All that was stored and is not finite; then the first stage to blame, going forward or else going back."""
        stored = [Fault("stored", part.name, leaf) for part in self.stored for leaf in part.values if leaf.bad]
        return (*stored, *([computed] if (computed := self._computed_fault()) else []))

    def _computed_fault(self) -> Fault | None:
        for stage in self.stages:
            for leaf in _bad(stage.values):
                return Fault("forward", stage.name, leaf)
        # a stage whose parameters or inputs get bad gradients, while all behind it sent good ones
        for stage in reversed(self.stages):
            for leaf in _bad((*stage.gradients, *stage.cotangents)):
                return Fault("backward", stage.name, leaf)
        return None

    @property
    def fault(self) -> Fault | None:
        """Where it began, None if all is finite."""
        return next(iter(self.faults), None)

    @property
    def verdict(self) -> str:
        """What was found, in one line or a few."""
        if self.faults:
            return "\n".join(map(str, self.faults))
        norm = self.gradient_norm
        if norm <= self.skip_norm:
            return f"all finite; gradient norm {norm:.3g} (a step is skipped above {self.skip_norm:g})"
        worst = max(self.stages, key=lambda stage: stage.gradient_norm)
        return (
            f"all finite, but the gradient norm {norm:.3g} is above {self.skip_norm:g}, where a step is skipped; "
            f"{(worst.gradient_norm / norm) ** 2:.0%} of its square is of stage '{worst.name}'"
        )

    def __str__(self) -> str:
        title = (
            f"step {self.step}, subject {self.subject}: loss {self.loss:.6g}, gradient norm {self.gradient_norm:.4g}"
        )
        return "\n".join([title, self.verdict, "", *_table((*self.stored, *self.stages))])


def leaves(tree: PyTree) -> tuple[Leaf, ...]:
    """The numbers of all floating-point arrays of a tree."""
    return tuple(Leaf.of(name, np.asarray(leaf)) for name, leaf in inexact_leaves(tree))


def _bad(found: Sequence[Leaf]) -> Iterator[Leaf]:
    return (leaf for leaf in found if leaf.bad)


COLUMNS = ("values: bad", "smallest", "largest", "mean |x|", "sent back: bad", "largest", "parameters: bad", "norm")


def _table(reports: Sequence[StageReport]) -> list[str]:
    """Lines of a table; the arrays of a stage together."""
    rows = [["stage", *COLUMNS]]
    for report in reports:
        row = [report.name, *[""] * len(COLUMNS)]
        if report.values:
            row[1] = str(sum(leaf.bad for leaf in report.values))
            row[2] = f"{min(leaf.smallest for leaf in report.values):.3g}"
            row[3] = f"{max(leaf.largest for leaf in report.values):.3g}"
            row[4] = f"{np.mean([leaf.mean for leaf in report.values]):.3g}"
        if report.cotangents:
            row[5] = str(sum(leaf.bad for leaf in report.cotangents))
            row[6] = f"{max(leaf.magnitude for leaf in report.cotangents):.3g}"
        if report.gradients:
            row[7] = str(sum(leaf.bad for leaf in report.gradients))
            row[8] = f"{report.gradient_norm:.3g}"
        rows.append(row)
    return text_table(rows)
