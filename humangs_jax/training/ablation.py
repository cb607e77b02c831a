"""Variants of a training run against the run itself: the same people, steps and seeds, differences with intervals."""

import dataclasses
import importlib
import json
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.core.configuration import ArgumentError, vary
from humangs_jax.core.progress import bar, say, text_table
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.people.bank import build_bank
from humangs_jax.people.subject import seeds_of
from humangs_jax.training.config import TrainConfig, fitting_losses, read_config
from humangs_jax.training.loop import train
from humangs_jax.training.sources import MakeSource, on_the_fly_people

BASE = "base"
CONFIDENCE = 0.95
UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}
People = int | Sequence[str | Path] | MakeSource


class AblationRow(NamedTuple):
    """A variant. interval: half of the 95 % interval of `difference` by Student's t over paired seeds; None below two pairs."""

    name: str
    seeds: int
    mean: float
    difference: float
    interval: float | None

    @property
    def clear(self) -> bool:
        """Whether the difference is outside of its interval."""
        return self.interval is not None and abs(self.difference) > self.interval


@dataclasses.dataclass(frozen=True)
class Ablation:
    """What `ablate` found. scores: of each variant, `metric` by seed. missing: runs that the budget had no room for."""

    metric: str
    scores: dict[str, dict[int, float]]
    missing: int = 0

    @property
    def rows(self) -> list[AblationRow]:
        """The base first, then the variants that have a score, in their order."""
        base = self.scores[BASE]
        return [_row(name, own, base) for name, own in self.scores.items() if own.keys() & base.keys()]

    def __str__(self) -> str:
        head = ["variant", "seeds", self.metric, "difference", f"{CONFIDENCE:.0%} interval"]
        cells = [
            [row.name, str(row.seeds), f"{row.mean:.2f}", *(_shown(row) if row.name != BASE else ("", ""))] for row in self.rows
        ]
        missing = [f"{self.missing} runs are missing: the budget was used up"] if self.missing else []
        return "\n".join([*text_table([head, *cells]), *missing])

    def plot(self) -> Any:
        """Differences to the base with their intervals; gray where the interval contains 0.

        Raises: ImportError without matplotlib, which the extra `notebooks` installs.
        """
        rows = [row for row in self.rows if row.name != BASE][::-1]
        make = importlib.import_module("matplotlib.figure").Figure
        figure = make(figsize=(6.4, 1.0 + 0.35 * len(rows)), dpi=150, layout="constrained")
        axis = figure.add_subplot()
        for place, row in enumerate(rows):
            color = "tab:blue" if row.clear else "0.6"
            axis.errorbar(row.difference, place, xerr=row.interval, fmt="o", color=color, capsize=3)
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set(yticks=range(len(rows)), yticklabels=[row.name for row in rows], ylim=(-0.6, len(rows) - 0.4))
        axis.set_xlabel(f"change of {self.metric}, with {CONFIDENCE:.0%} intervals by paired seeds")
        return figure


def ablate(
    base: TrainConfig | str,
    variants: Mapping[str, Mapping[str, Any]],
    *,
    seeds: int = 3,
    budget: str | None = None,
    people: People = 16,
    validation: People = 4,
    out: str | Path = "ablation",
    metric: str = "psnr_fg",
    body: BodyModel | None = None,
    networks: LossNetworks = NO_NETWORKS,
    progress: bool = True,
) -> Ablation:
    """Train a base and its variants with several seeds each, and compare them on other people.

    Runs are made seed by seed, so that differences are paired however far the budget reaches. Each run is a folder
    `out/VARIANT/SEED` that `train` goes on with: the same call resumes.

    Args:
        base: a run, or the name of a preset of training ("tiny", "small", "paper", "published").
        variants: fields that change, by their paths (`vary`), of each variant by its name.
        seeds: runs of each variant.
        budget: wall-clock time, such as "90s", "5min" or "2h": no run begins that would probably end after it. The first one,
            which compiles, may exceed it. None: all runs.
        people: to train on: a number of synthetic people, who are rendered during training; capture folders; or a source.
        validation: other people to compare on, likewise.
        out: folder of the runs.
        metric: of validation: "psnr", "psnr_fg", "ssim" and so on.
        body: that the people's parameters belong to. None: the shipped one.
        networks: of losses that need them; those without are replaced (`fitting_losses`).
        progress: show a bar.

    Returns:
        Rows with means, differences to the base and intervals; `print` and `.plot()` show them.

    Raises:
        ValueError: for a variant named "base", a path that is no field, a budget or a number of seeds that cannot be meant, or a
            folder with runs of other settings.
        TrainingInterrupted: after Ctrl-C; what is trained is kept.

    Examples:
        >>> result = hg.ablate("tiny", {"no class token": {"model.architecture.encoder.transformer.class_token": False}})
        >>> result.plot()
    """
    if BASE in variants:
        raise ArgumentError("variants", f"{BASE!r}: is the name of the run that variants are compared with")
    if seeds < 1:
        raise ArgumentError("seeds", f"{seeds}: expected at least 1")
    seconds = _seconds(budget)
    base = fitting_losses(read_config(base) if isinstance(base, str) else base, networks)
    # what is compared is the end of a run
    base = dataclasses.replace(base, validate_every=base.steps, checkpoint_every=base.steps)
    runs = {name: vary(base, changes) for name, changes in {BASE: {}, **variants}.items()}
    body = load_body() if body is None else body
    learned, compared = _source(people, body, base, "train"), _source(validation, body, base, "validation")
    scores: dict[str, dict[int, float]] = {name: {} for name in runs}
    began, longest = time.monotonic(), 0.0
    order = [(name, seed) for seed in range(seeds) for name in runs]
    for name, seed in bar(order, desc="ablate", unit="run", shown=progress):
        folder = Path(out) / re.sub(r"[^\w.+-]+", "_", name) / str(seed)
        start = time.monotonic()
        if seconds is not None and not _validated(folder, base.steps) and start - began + longest > seconds:
            continue
        config = dataclasses.replace(runs[name], seed=seed)
        train(config, body, learned, folder, validation=compared, networks=networks, progress=progress)
        found = _validated(folder, config.steps)
        if metric not in found:
            raise ArgumentError("metric", f"{metric!r}: is none of validation: {', '.join(sorted(found))}")
        scores[name][seed] = found[metric]
        longest = max(longest, time.monotonic() - start)
    result = Ablation(metric, scores, sum(seeds - len(own) for own in scores.values()))
    if progress:
        say(str(result))
    return result


def _row(name: str, own: Mapping[int, float], base: Mapping[int, float]) -> AblationRow:
    differences = np.asarray([own[seed] - base[seed] for seed in own.keys() & base.keys()])
    count, interval = len(differences), None
    if count > 1:
        interval = float(student.ppf((1 + CONFIDENCE) / 2, count - 1) * differences.std(ddof=1) / np.sqrt(count))
    return AblationRow(name, len(own), float(np.mean(list(own.values()))), float(differences.mean()), interval)


def _shown(row: AblationRow) -> tuple[str, str]:
    if row.interval is None:
        return f"{row.difference:+.2f}", "one seed"
    return f"{row.difference:+.2f}", f"+-{row.interval:.2f}{'' if row.clear else ', unclear'}"


def _seconds(budget: str | None) -> float | None:
    if budget is None:
        return None
    match = re.fullmatch(r"(\d+(?:\.\d*)?) ?(s|min|h)", budget)
    if match is None:
        raise ArgumentError("budget", f'{budget!r}: expected a time such as "90s", "5min" or "2h"')
    return float(match[1]) * UNITS[match[2]]


def _source(people: People, body: BodyModel, config: TrainConfig, split: str) -> Sequence[str | Path] | MakeSource:
    if not isinstance(people, int):
        return people
    texture = 128 if config.target_size <= 64 else 512 if config.target_size <= 256 else 1024
    return on_the_fly_people(build_bank(seeds_of(split, 0, people), body, split, texture_size=texture))


def _validated(folder: Path, step: int) -> dict[str, float]:
    """What the validation after that step found; empty if there was none."""
    file = folder / "log.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
    numbers = [item for line in lines if line.get("step") == step for item in line.items()]
    return {name.removeprefix("val_"): value for name, value in numbers if name.startswith("val_")}
