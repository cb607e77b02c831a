"""Compares variants of a training run with the run itself. The runs have the same people and seeds,
and the differences have intervals.

All runs are compared on the people, photos and targets that the base is validated on, whatever a
variant changes.
"""

import dataclasses
import functools
import importlib
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.stats import t as student

from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.core.configuration import ArgumentError, vary
from humangs_jax.core.progress import bar, say, text_table
from humangs_jax.core.registry import imported
from humangs_jax.data.loading.captures import CaptureSource
from humangs_jax.data.loading.examples import Mixture
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.training.config import TrainConfig, fitting_losses, missing_networks, read_config
from humangs_jax.training.forward import METRICS, as_validated, compared_as
from humangs_jax.training.loop import VALIDATED, train
from humangs_jax.training.sources import SYNTHETIC, SourceFactory, captured_people
from humangs_jax.training.state import init_state

BASE = "base"
CONFIDENCE = 0.95
DEFAULT_METRIC = "psnr_fg"
LONGEST_NAME = 100
"""Largest length of the name of a variant's folder, in characters, before a checksum is added. File
systems allow 255 bytes.
"""
People = int | Sequence[str | Path] | SourceFactory


class AblationRow(NamedTuple):
    """The result of a variant, compared with the base."""

    name: str
    """The name of the variant."""
    seeds: int
    """Number of seeds with a score."""
    mean: float
    """The mean score over these seeds."""
    difference: float
    """The mean difference from the base, over the seeds for which both have a score."""
    interval: float | None
    """Half the width of the 95 % confidence interval of `difference`, by Student's t over paired
    seeds. None with fewer than two pairs.
    """

    @property
    def clear(self) -> bool:
        """Whether the interval around the difference exists and does not contain 0."""
        return self.interval is not None and abs(self.difference) > self.interval


@dataclasses.dataclass(frozen=True)
class Ablation:
    """The result of `ablate`."""

    metric: str
    """The name of the score."""
    scores: dict[str, dict[int, float]]
    """The score of each seed, for the base and each variant by name."""

    @property
    def rows(self) -> list[AblationRow]:
        """The row of the base, then the rows of the variants, in their order. A variant has a row
        if it and the base have a score of the same seed.
        """
        base = self.scores[BASE]
        return [
            _row(name, own, base) for name, own in self.scores.items() if own.keys() & base.keys()
        ]

    def __str__(self) -> str:
        head = ["variant", "seeds", self.metric, "difference", f"{CONFIDENCE:.0%} interval"]
        cells = []
        for row in self.rows:
            if row.name == BASE:
                difference = "", ""
            else:
                difference = _shown(row)
            cells.append([row.name, str(row.seeds), f"{row.mean:.2f}", *difference])
        return "\n".join(text_table([head, *cells]))

    def plot(self) -> Any:
        """Returns a figure of the differences from the base with their intervals. A difference
        that is not clear is gray (see `AblationRow.clear`). If no variant has a row, the figure has
        a text instead.

        Raises: ImportError without matplotlib, which the extra `notebooks` installs.
        """
        rows = [row for row in self.rows if row.name != BASE][::-1]
        make = importlib.import_module("matplotlib.figure").Figure
        if not rows:
            figure = make(figsize=(6.4, 1.0), dpi=150)
            words = "no variant finished: there is nothing to compare"
            figure.text(0.5, 0.5, words, ha="center", va="center", fontsize="small")
            return figure
        figure = make(figsize=(6.4, 1.0 + 0.35 * len(rows)), dpi=150, layout="constrained")
        axis = figure.add_subplot()
        for place, row in enumerate(rows):
            color = "tab:blue" if row.clear else "0.6"
            axis.errorbar(row.difference, place, xerr=row.interval, fmt="o", color=color, capsize=3)
        axis.axvline(0, color="black", linewidth=0.8)
        axis.set(
            yticks=range(len(rows)),
            yticklabels=[row.name for row in rows],
            ylim=(-0.6, len(rows) - 0.4),
        )
        axis.set_xlabel(f"change of {self.metric}, with {CONFIDENCE:.0%} intervals by paired seeds")
        return figure


def ablate(
    base: TrainConfig | str,
    variants: Mapping[str, Mapping[str, Any]],
    *,
    seeds: int = 3,
    people: People = 16,
    validation: People = 4,
    out: str | Path = "ablation",
    metric: str = DEFAULT_METRIC,
    body: BodyModel | None = None,
    networks: LossNetworks = NO_NETWORKS,
    progress: bool = True,
) -> Ablation:
    """Trains a base and its variants with several seeds each, and compares them on other people.

    Each run has a folder `out/VARIANT/SEED`. The same call continues runs that were interrupted.

    Args:
        base: configuration of the base, or its name or file as `read_config` takes it, such as
            "tiny" or "small".
        variants: the changed fields of each variant, by the variant's name. The fields are given as
            `vary` takes them, as values by path.
        seeds: number of runs of the base and of each variant.
        people: people to train on, in one of three forms: a number of synthetic people, which are
            rendered during training; a list of capture folders; a function that makes a source.
        validation: other people to compare on, in the same three forms. If it is a function, the
            first eight people of its source are used, else all people. All variants are compared on
            the photos and targets of the base.
        out: folder of the runs.
        metric: name of the metric of validations to compare, such as "psnr", "psnr_fg" or "ssim".
        body: body that the people's parameters belong to. None: the shipped one.
        networks: networks of the losses that need them. If one is missing for a loss of the base,
            that loss is replaced (see `fitting_losses`).
        progress: whether a bar and the result are shown.

    Returns:
        The scores of all runs. `print` and `.plot()` show means, differences from the base and
        intervals.

    Raises:
        ValueError: before the first run, if there is no such metric, `seeds` is below 1, nobody in
            a list of folders can be used, or a variant cannot be trained. A variant cannot be
            trained if it is named "base", changes the seed, has a path that is no field or a value
            that the field refuses, describes a network that cannot be made, needs a loss network
            that is missing, or cannot use a person on disk that the base can use. During the runs,
            if a folder holds a run of other settings, or if there is nobody to compare on.
        FileNotFoundError: if `base` is the name of neither a preset nor a file.
        OSError: if another process trains into a folder, or if a file cannot be written.
        TrainingInterrupted: after Ctrl-C or SIGTERM. What is trained is kept.

    Examples:
        >>> class_token = "model.architecture.encoder.transformer.class_token"
        >>> result = hg.ablate("tiny", {"no class token": {class_token: False}})
        >>> result.plot()
    """
    if seeds < 1:
        raise ArgumentError("seeds", f"{seeds}: expected at least 1")
    _check_metric(metric, networks)
    base = fitting_losses(read_config(base) if isinstance(base, str) else base, networks)
    # what is compared is the end of a run
    base = dataclasses.replace(base, validate_every=base.steps, checkpoint_every=base.steps)
    # all variants, people and scores are checked before the first run
    runs = {BASE: base, **_checked_variants(base, variants, networks)}
    folders = {name: Path(out) / folder for name, folder in _folder_names(list(runs)).items()}
    if body is None:
        body = load_body()
    learned = _source(people, body, base, "train")
    compared, count = _compared(validation, body, base)
    if people and not isinstance(people, int):
        _check_people(runs, learned, body)
    if validation and not isinstance(validation, int):
        shown = {name: as_validated(config.at(config.steps - 1)) for name, config in runs.items()}
        _check_people(shown, compared, body)
    # seed after seed, so that a call that is interrupted leaves pairs to compare
    scores: dict[str, dict[int, float]] = {name: {} for name in runs}
    order = [(name, seed) for seed in range(seeds) for name in runs]
    for name, seed in bar(order, desc="ablate", unit="run", shown=progress):
        folder, config = folders[name] / str(seed), dataclasses.replace(runs[name], seed=seed)
        others = functools.partial(train, validation=compared, validated=count, networks=networks)
        others(config, body, learned, folder, progress=progress)
        found = _validated(folder, config.steps)
        if metric not in found:
            raise ArgumentError(
                "validation", f"{validation!r}: nobody was looked at: expected people to compare on"
            )
        scores[name][seed] = found[metric]
    result = Ablation(metric, scores)
    if progress:
        say(str(result))
    return result


def _check_metric(metric: str, networks: LossNetworks) -> None:
    """Checks that validation computes this metric.

    Raises: ArgumentError if it does not.
    """
    known = METRICS
    if networks.lpips is not None:
        known = *METRICS, "lpips"
    if metric not in known:
        usual_first = sorted(known, key=lambda name: (name != DEFAULT_METRIC, name))
        raise ArgumentError(
            "metric", f"{metric!r}: is none of validation: {', '.join(usual_first)}"
        )


def _checked_variants(
    base: TrainConfig, variants: Mapping[str, Mapping[str, Any]], networks: LossNetworks
) -> dict[str, TrainConfig]:
    """Returns the configuration of each variant, by name.

    Raises: ArgumentError if a variant cannot be trained. The error names the variant.
    """
    runs = {}
    for name, changes in variants.items():
        if name == BASE:
            raise ArgumentError(
                "variants", f"{BASE!r}: is the name of the run that variants are compared with"
            )
        if "seed" in changes:
            raise ArgumentError(
                "variants", f"{name!r}: seed: all variants have the seeds 0, 1, ... of `seeds`"
            )
        try:
            runs[name] = run = vary(base, changes)
            jax.eval_shape(lambda run=run: init_state(run, None))  # whether its network can be made
        except (TypeError, ValueError, ZeroDivisionError) as error:
            message = (str(error).splitlines() or [type(error).__name__])[0]
            raise ArgumentError("variants", f"{name!r}: {message}") from error
        missing = missing_networks(run, networks)
        if missing:
            raise ArgumentError(
                "variants", f"{name!r}: loss.{missing[0]}: expected its network in networks"
            )
    return runs


def _check_people(
    runs: Mapping[str, TrainConfig], people: Sequence[str | Path] | SourceFactory, body: BodyModel
) -> None:
    """Checks that each run can use, in all of its stages, the people on disk that the base can use.

    No photo is decoded.

    Raises: ArgumentError, which names the variant; ValueError if nobody can be used.
    """
    if isinstance(people, Sequence):
        make = captured_people(people, body)
    else:
        make = people
    usual = _unusable(make, runs[BASE])
    for name, config in runs.items():
        lacking = {who: why for who, why in _unusable(make, config).items() if who not in usual}
        if lacking:
            who, why = next(iter(lacking.items()))
            problem = f"{name!r}: {len(lacking)} of the people cannot be used, {who}: {why}"
            raise ArgumentError("variants", problem)


def _unusable(make: SourceFactory, config: TrainConfig) -> dict[str, str]:
    """Returns the people on disk that some stage of a run cannot use, each with the reason."""
    problems: dict[str, str] = {}
    for first, _ in config.spans(0, config.steps):
        source = make(config.at(first))
        if isinstance(source, Mixture):
            parts = source.sources
        else:
            parts = (source,)
        for part in parts:
            if isinstance(part, CaptureSource):
                problems |= part.unusable()
    return problems


def _folder_names(names: Sequence[str]) -> dict[str, str]:
    """Returns the name of a folder for each variant.

    The folder is named as the variant, with `_` for characters that file systems dislike. A
    checksum is added in three cases: the name is longer than `LONGEST_NAME`, it has only the
    characters `.`, `+` and `-`, or another folder already has the same name, regardless of case.
    """
    plain = {name: re.sub(r"[^\w.+-]+", "_", name) for name in names}
    unusable = [
        name
        for name in names
        if not re.search(r"\w", plain[name]) or len(plain[name]) > LONGEST_NAME
    ]
    taken, folders = set[str](), {}
    # exact names keep theirs
    for name in sorted(names, key=lambda name: (name != BASE, plain[name] != name)):
        folder = plain[name]
        if name in unusable or folder.lower() in taken:
            folder = f"{folder.strip('.')[:LONGEST_NAME]}-{zlib.crc32(name.encode()):08x}"
        taken.add(folder.lower())
        folders[name] = folder
    return folders


def _compared(validation: People, body: BodyModel, base: TrainConfig) -> tuple[SourceFactory, int]:
    """Returns a function that makes a source of the people that all runs are compared on, and the
    number of people to look at.
    """
    found, count = _source(validation, body, base, "validation", each_once=True), VALIDATED
    if isinstance(validation, int):
        count = validation
    if not isinstance(found, Sequence):
        return compared_as(base, found), count
    # photos that are decoded once serve all runs
    captured = functools.cache(lambda: captured_people(found, body))
    return compared_as(base, lambda config: captured()(config)), len(found)


def _row(name: str, own: Mapping[int, float], base: Mapping[int, float]) -> AblationRow:
    differences = np.asarray([own[seed] - base[seed] for seed in own.keys() & base.keys()])
    count, interval = len(differences), None
    if count > 1:
        interval = float(
            student.ppf((1 + CONFIDENCE) / 2, count - 1) * differences.std(ddof=1) / np.sqrt(count)
        )
    return AblationRow(
        name, len(own), float(np.mean(list(own.values()))), float(differences.mean()), interval
    )


def _shown(row: AblationRow) -> tuple[str, str]:
    if row.interval is None:
        return f"{row.difference:+.2f}", "one seed"
    return f"{row.difference:+.2f}", f"+-{row.interval:.2f}{'' if row.clear else ', unclear'}"


def _source(
    people: People, body: BodyModel, config: TrainConfig, split: str, each_once: bool = False
) -> Sequence[str | Path] | SourceFactory:
    if not isinstance(people, int):
        return people
    drawn = imported(f"{SYNTHETIC}.sources:people_of_split")
    return drawn(people, body, split, config.target_size, each_once)


def _validated(folder: Path, step: int) -> dict[str, float]:
    """Returns the metrics that a run's log has of the validation after `step`, by name without
    "val_". Empty if the log has none.
    """
    file = folder / "log.jsonl"
    lines = []
    if file.is_file():
        lines = [json.loads(line) for line in file.read_text().splitlines()]
    numbers = [item for line in lines if line.get("step") == step for item in line.items()]
    return {name.removeprefix("val_"): value for name, value in numbers if name.startswith("val_")}
