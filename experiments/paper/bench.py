"""What the experiments of the paper share: the variants that are trained, how one is trained and scored, printed numbers.

Every variant is a `TrainConfig` that differs from another one in what its name says. All see the same people, views and targets
in the same order, have the same losses and number of steps, and are compared on the same views of the same unseen people.
"""

import dataclasses
import json
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
from scipy.stats import t

from experiments.results import REPOSITORY, write_json
from experiments.systems import ONE_PHOTO as TAKE_ONE
from experiments.systems import SYSTEMS
from experiments.systems.grouped import GroupReader
from experiments.systems.pixel_queries import QueryDriver
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.data.loading import ViewSampling
from humangs_jax.data.views import gaussian_body
from humangs_jax.evaluation.cases import Predicted, draw_views
from humangs_jax.evaluation.run import evaluate
from humangs_jax.evaluation.tables import mean_scores
from humangs_jax.losses.loss_networks import load_loss_networks
from humangs_jax.network.config import paper_parts
from humangs_jax.network.upsampler import UpsamplerConfig
from humangs_jax.network.weights import load_weights
from humangs_jax.people.writer import Layout, write_set
from humangs_jax.training.config import LossConfig, OptimizerConfig, TrainConfig
from humangs_jax.training.forward import validate, validation_examples
from humangs_jax.training.loop import TrainingInterrupted, train
from humangs_jax.training.sources import cached_people

PAGE = REPOSITORY / "docs" / "paper.md"
SCORES = {"psnr": ("PSNR, dB", 2), "psnr_fg": ("foreground PSNR, dB", 2), "ssim": ("SSIM", 4)}
PHOTOS, TARGETS = 4, 6
"""Photos that a network is trained with, unless it takes one; views of each person that all are compared on."""
VIEW_COUNTS = (1, 2, 4, 6, 8)
PER_PERSON = ("animatable",)
"""Systems that are fitted to one person, and so have no place in a training on many."""
ABLATIONS = (", another seed", "tightness", "Gaussian", "no ", "features", "pooling", "all tokens", "canonical")
"""Marks of names that are no system of tables 1 to 3."""
ONE_PHOTO = ", 1 photo"
"""End of the names of variants that were trained with one."""
NOISE = "noise"
"""The claim of variants that differ from another one in the seed alone."""

SHIPPED = "HumanGS, shipped"
"""Name of the weights that come with the package."""
PAINTED, PAINTED_TABLE = "vertex-color baseline", "paper_painted"
"""The baseline without a network, and its table (`painted.py`)."""
MARGIN = 3.0
"""dB of foreground PSNR over the vertex-color baseline. With less all systems showed grey bodies, with more clothes."""
NOT_TRAINED = "not trained"
PAPER = "paper"
"""Marks a row of the printed paper in every table."""
HUMANRAM, LVSM, GHG, OURS = "HumanRAM", "LVSM", "GHG", "HumanGS"
ANIMATION = {
    "LHM (single view)": (23.72, 0.95, 0.045, 4.59, 0.053),
    HUMANRAM: (24.58, 0.96, 0.042, None, 0.287),
    "Animatable Gaussians": (25.51, 0.96, 0.041, 12000, 0.245),
    OURS: (25.24, 0.96, 0.04, 0.29, 0.048),
}
"""Table 1, AvatarReX: PSNR, SSIM, LPIPS, seconds to model, seconds a frame."""
RECONSTRUCTION = {
    HUMANRAM: ((28.98, 0.97, 0.021), (25.10, 0.96, 0.029)),
    LVSM: ((24.38, 0.96, 0.036), None),
    GHG: ((22.49, 0.95, 0.043), None),
    OURS: ((27.99, 0.97, 0.025), (25.53, 0.96, 0.029)),
}
"""Table 2, THuman4.0: reconstruction, and reconstruction + animation."""
DOMAINS = {
    HUMANRAM: ((33.16, 0.98, 0.018), (27.76, 0.97, 0.029)),
    LVSM: ((27.13, 0.95, 0.051), (20.86, 0.94, 0.056)),
    GHG: ((26.91, 0.96, 0.039), (22.69, 0.93, 0.088)),
    "GHG, released weights": ((22.80, 0.91, 0.067), None),
    "GST, released weights": ((21.58, 0.92, 0.091), None),
    OURS: ((30.81, 0.98, 0.024), (27.27, 0.97, 0.033)),
    "GIGA, on its split": ((20.19, 0.794, 0.070), None),
    "HumanGS, on GIGA's split": ((26.00, 0.945, 0.061), None),
}
"""Table 3, reconstruction: in the domain of training (THuman2.1), and in another one (AvatarReX)."""
VIEWS = {
    HUMANRAM: ((25.44, 0.946, 0.052), (27.39, 0.950, 0.044), (29.10, 0.960, 0.039), (29.90, 0.966, 0.036)),
    LVSM: ((17.78, 0.900, 0.101), (22.64, 0.930, 0.066), (25.96, 0.950, 0.055), (27.03, 0.950, 0.051)),
    GHG: ((21.71, 0.920, 0.094), (22.43, 0.930, 0.089), (22.69, 0.930, 0.088), (22.72, 0.930, 0.088)),
    OURS: ((24.07, 0.936, 0.068), (25.71, 0.946, 0.059), (27.19, 0.950, 0.054), (27.84, 0.950, 0.051)),
}
"""THuman2.1 near, with 1, 2, 4 and 6 photos."""
GAUSSIANS = {
    "THuman2.1": ((30.66, 0.970, 0.028), (30.81, 0.980, 0.024)),
    "THuman2.1 near": ((27.09, 0.950, 0.062), (27.19, 0.950, 0.054)),
    "AvatarReX": ((25.20, 0.960, 0.044), (25.24, 0.960, 0.040)),
    "THuman4.0": ((25.42, 0.960, 0.034), (25.53, 0.960, 0.029)),
}
"""1 Gaussian a vertex, and 1 tight + 4 free."""
FASTER_MODELLING = 15
"""Times that HumanGS models faster than LHM: 4.59 s against 0.29."""


class Variant(NamedTuple):
    """against: the variant that it is compared with; None for those that others are compared with. claim: what that tests."""

    config: Any
    against: str | None = None
    claim: str = ""


def variants(steps: int) -> dict[str, Variant]:
    """All that `train_all.py` trains, by name, in the order of its queue."""

    def run(model: Any, photos: int = PHOTOS, **fields: Any) -> Any:
        capacity = -(-model.runtime.token_capacity * (photos + 1) // (PHOTOS + 1))  # one may show more than its share
        settings: dict[str, Any] = {
            "model": model.with_runtime(token_capacity=capacity),
            "views": ViewSampling(input_counts=(photos,)),
            "loss": LossConfig(),
            "optimizer": OptimizerConfig(learning_rate=1e-3, warmup_steps=min(50, steps // 4)),
            "target_size": 128,
            "steps": steps,
            "validate_every": steps,
            "checkpoint_every": min(100, steps),
            "log_every": min(20, steps),
        }
        return TrainConfig(**(settings | fields))

    systems = {name: make("bench") for name, make in SYSTEMS.items()}
    ours, plain = systems["humangs"], systems["back_projection"]
    encoder, reader, decoder = paper_parts(ours.architecture)
    tight = lambda weight: run(ours, loss=LossConfig(tightness=weight))
    per_vertex = lambda free: run(ours.with_parts(decoder=decoder.clone(tight=1, free=free)))
    flat = reader.clone(shells=())
    bare = ours.with_parts(reader=flat)
    gray = {"reader": flat.clone(sample_rgb=False), "decoder": decoder.clone(residual_color=False)}
    tokenless = encoder.clone(transformer=dataclasses.replace(encoder.transformer, class_token=False))
    everywhere = ours.with_conventions(tokens="all").with_runtime(token_capacity=0)

    def upsampled(features: Any) -> Any:
        width = encoder.transformer.width
        raised = encoder.clone(upsampler=UpsamplerConfig(width // 3, features))
        return run(ours.with_parts(encoder=raised, reader=reader.clone(output_width=width)))

    found = {
        "back-projection": Variant(run(plain)),
        "cross-attention": Variant(run(systems["cross_attention"]), "back-projection", "what reads the photos"),
        "humangs": Variant(run(ours)),
        "pooling over all views": Variant(run(ours.with_conventions(pool="all")), "humangs", "pooling"),
        "no shells": Variant(run(bare), "humangs", "shells (ours)"),
        "no global token": Variant(run(ours.with_parts(encoder=tokenless)), "humangs", "global token"),
        "back-projection, another seed": Variant(run(plain, seed=1), "back-projection", NOISE),
        "humangs, another seed": Variant(run(ours, seed=1), "humangs", NOISE),
        "no photo colors": Variant(run(ours.with_parts(**gray)), "no shells", "photo colors (ours)"),
        "canonical frame": Variant(
            run(bare.with_parts(decoder=decoder.clone(frame="canonical"))), "no shells", "normal frame (ours)"
        ),
        "all tokens": Variant(run(everywhere), "humangs", "foreground tokens (ours)"),
        "features of the last layer": Variant(upsampled("final")),
        "features of four depths": Variant(upsampled("intermediate"), "features of the last layer", "depths"),
        "1 Gaussian a vertex": Variant(per_vertex(0)),
        "1 + 4 Gaussians a vertex": Variant(per_vertex(4), "1 Gaussian a vertex", "Gaussians a vertex"),
        "1 + 8 Gaussians a vertex": Variant(per_vertex(8), "1 Gaussian a vertex", "Gaussians a vertex"),
        "tightness 0": Variant(tight(0.0), "humangs", "tightness"),
        "tightness 10": Variant(tight(10.0), "humangs", "tightness"),
        "humangs, 1 photo": Variant(run(ours, 1)),
    }
    for name, model in systems.items():
        if name not in ("humangs", "back_projection", "cross_attention", *PER_PERSON):
            alone = name in TAKE_ONE
            against = "humangs, 1 photo" if alone else "humangs"
            found[name] = Variant(run(model, 1 if alone else PHOTOS), against, "systems")
    return found


def view_counts(name: str, config: Any) -> tuple[int, ...]:
    """Numbers of photos that a variant is scored with; only those that claims about few photos need have several."""
    if config.views.input_counts == (1,):
        return (1,)
    return (1, 2, PHOTOS, 6) if "global token" in name or name == "humangs" else (PHOTOS,)


def train_variant(
    config: Any, out: Path, people: Any, body: Any, validation: Any, views: tuple[int, ...]
) -> dict[str, Any] | None:
    """Train in the folder `out`, or go on there, and score; None if it was interrupted.

    people: a `sources.MakeSource`; body: the model of theirs and of `validation`, a `CaptureCache`. Returns scores by number of
    photos, steps, parameters, CPU and wall seconds of all calls.
    """
    clock = out / "seconds.json"
    before = json.loads(clock.read_text()) if clock.exists() else {"cpu": 0.0, "wall": 0.0}
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        state = train(config, body, people, out, progress=False)
    except TrainingInterrupted as stopped:
        state = stopped.state
    spent = {"cpu": before["cpu"] + time.process_time() - cpu, "wall": before["wall"] + time.perf_counter() - wall}
    write_json(clock, spent)
    if int(state.step) < config.steps:
        return None
    variables = jax.device_get(state.variables)
    by_views = {str(count): score(variables, gaussian_body(body, config.model), config, validation, count) for count in views}
    return {
        "by_views": by_views,
        "photos": config.views.input_counts[0],
        "steps": config.steps,
        "parameters": sum(x.size for x in jax.tree.leaves(variables["params"])),
        "cpu_seconds": round(spent["cpu"], 1),
        "wall_seconds": round(spent["wall"], 1),
    }


def score(variables: Any, body: Any, config: Any, people: Any, count: int) -> dict[str, float]:
    """Means over people of `TARGETS` views each, with that number of photos."""
    compared = dataclasses.replace(
        config,
        model=config.model.with_runtime(token_capacity=0),
        views=dataclasses.replace(config.views, input_counts=(count,), target_count=TARGETS),
    )
    examples = validation_examples(cached_people(people), compared, len(people))
    numbers, _ = validate(variables, body, examples, compared)
    names = (*SCORES, "semi_transparent", "dropped_tokens", "overflow")
    # JSON has no NaN: networks that draw pixels have no semi-transparent foreground
    return {name: x for name in names if (x := numbers[name]) == x}


def headline(row: Mapping[str, Any]) -> dict[str, float]:
    """The scores of a run with as many photos as it was trained with."""
    return row["by_views"][str(row["photos"])]


def seed_interval(rows: Mapping[str, Any], score: str = "psnr_fg") -> float | None:
    """Half of the 95 % interval, in dB, of a difference between two runs, by their seeds alone; None without a pair of seeds.

    From the pairs of runs that differ in their seed alone: Student's t with as many degrees of freedom as pairs, which takes
    into account that they are few. It says nothing about other people.
    """
    pairs = [(name, name.removesuffix(", another seed")) for name in rows if name.endswith(", another seed")]
    found = [headline(rows[a])[score] - headline(rows[b])[score] for a, b in pairs if b in rows]
    if not found:
        return None
    return float(t.ppf(0.975, len(found))) * math.sqrt(sum(x * x for x in found) / len(found))


def verdict(difference: float, interval: float | None) -> str:
    """What a difference is worth beside its interval."""
    if interval is None:
        return "noise unknown"
    return "within noise" if abs(difference) <= interval else "better" if difference > 0 else "worse"


def untrained(rows: Mapping[str, Any], painted: Mapping[str, Mapping[str, float]]) -> list[str]:
    """Names of the runs that have learned too little for a comparison: `MARGIN` over the vertex-color baseline is not reached.

    painted: its scores by number of photos, of the same people and views. That of `PHOTOS` counts for all.
    """
    least = painted[str(PHOTOS)]["psnr_fg"] + MARGIN
    return [name for name, row in rows.items() if headline(row)["psnr_fg"] < least]


def results(name: str) -> Any:
    """The unrounded numbers of docs/results/NAME.json."""
    return json.loads((PAGE.parent / "results" / f"{name}.json").read_text())["numbers"]


def untrained_on_the_page() -> list[str]:
    """`untrained` of what docs/paper.md shows."""
    return untrained(results("paper")["runs"], results(PAINTED_TABLE)["validation"])


# Trained systems on people of a folder -----------------------------------------------------------------------------------

QUICK_PEOPLE, QUICK_SIZE = 2, 128


@dataclasses.dataclass(frozen=True)
class Tested:
    """Options:
    runs: the OUT of `paper`; without it the shipped weights alone
    people: captures with held_out/, or any data set (docs/datasets.md)
    body: body model of a data set
    lpips: weights of LPIPS vgg: BACKBONE and HEADS
    quick: two synthetic people of 128 pixels, made in a minute
    """

    runs: Path | None = None
    people: Path | None = None
    body: Path | None = None
    lpips: tuple[Path, ...] = ()
    quick: bool = False

    def with_people(self, folder: Path) -> Self:
        """With the small people made in a folder, if none were given. Raises: ValueError where neither is asked for."""
        if not (self.people or self.quick):
            raise ValueError("--people is needed, or --quick")
        return self if self.people else dataclasses.replace(self, people=quick_people(folder / "people"))


def quick_people(folder: Path, split: str = "test") -> Path:
    """Small synthetic captures: 12 photos of one pose, held-out views of it and of another pose."""
    write_set(folder, QUICK_PEOPLE, Layout(QUICK_SIZE, views=12, held_out_views=2, novel_poses=1), split)
    return folder


def load_networks(paths: Any) -> tuple[Any, ...]:
    """LPIPS for the evaluator, or nothing."""
    found = load_loss_networks(None, paths[0], paths[1] if len(paths) > 1 else None, "vgg").lpips if paths else None
    return () if found is None else (found,)


def folder_of(name: str) -> str:
    """Of a variant, inside OUT."""
    return name.replace(" ", "_").replace(",", "").replace("+", "and")


def trained(runs: Path | None, names: Any = None) -> dict[str, tuple[Any, Any]]:
    """(variables, configuration) by name: the variants whose training is finished, and the shipped weights."""
    found = {}
    if runs is not None:
        finished = json.loads((runs / "results.json").read_text())["runs"]
        for name in finished if names is None else [name for name in names if name in finished]:
            found[name] = load_weights(runs / folder_of(name) / "weights.safetensors")
    return found | {SHIPPED: load_weights()}


def measured(
    weights: tuple[Any, Any], people: Path, photos: int, body: Path | None, networks: Any, indices: Any = None
) -> dict[str, Any] | None:
    """Scores of the views in the pose of the photos and in others, and the seconds to model and to draw a frame.

    None if the system takes no such number of photos. The first person is run twice, and only the second run is timed: the first
    one compiles.
    """
    config = weights[1]
    if takes_one(config) and photos > 1:
        return None
    seconds: dict[str, list[float]] = {"model": [], "frame": []}

    def method(case: Any, background: float) -> Any:
        if not seconds["frame"]:
            shown(weights, case, background)
        predicted, modelled, drawn = shown(weights, case, background)
        seconds["model"].append(modelled)
        seconds["frame"].append(drawn / case.truth.view_count)
        return predicted

    found = evaluate(people, method=method, inputs=None if indices else photos, indices=indices, lpips=networks, body=body)
    means: dict[str, Any] = {"photos": photos}
    for task, rows in (
        ("reconstruction", [row.scores for row in found.rows if row.frame == 0]),
        ("animation", [row.scores for row in found.rows if row.frame != 0]),
    ):
        means[task] = mean_scores(rows) if rows and (task == "reconstruction" or animatable(config)) else None
    per_target = config.architecture.driver is not None
    means["model_s"] = None if per_target else sum(seconds["model"]) / len(seconds["model"])
    means["frame_s"] = sum(seconds["frame"]) / len(seconds["frame"])
    return means


def shown(weights: tuple[Any, Any], case: Any, background: float = 1.0) -> tuple[Any, float, float]:
    """What a system shows of a `Case`, as `Predicted`; seconds to model, 0 if it runs for each target, and to draw all views."""
    start = modelled = time.perf_counter()
    if (driver := weights[1].architecture.driver) is not None:
        images, alpha = driver.show(*weights, case.inputs, case.truth, background)
        predicted = Predicted(images, alpha, tuple(range(case.truth.view_count)))
    else:
        avatar = jax.block_until_ready(reconstruct(*weights, case.inputs))
        modelled, predicted = time.perf_counter(), draw_views(avatar, case.truth, background)
    return predicted, modelled - start, time.perf_counter() - modelled


def takes_one(config: Any) -> bool:
    """Whether a system refuses a second photo."""
    reader = config.architecture.reader
    return isinstance(reader, GroupReader) or getattr(reader, "most_views", None) == 1


def animatable(config: Any) -> bool:
    """Whether a system can show a pose that no photo shows: LVSM knows no body."""
    driver = config.architecture.driver
    return not (isinstance(driver, QueryDriver) and driver.texture is None)


def triple(scores: Any) -> str:
    """PSNR / SSIM / LPIPS of a measured row or of a printed one; a dash where it is missing."""
    if scores is None:
        return "-"
    values = scores if isinstance(scores, tuple) else (scores["psnr"], scores["ssim"], scores.get("lpips_vgg"))
    texts = [f"{value:.{digits}f}" if value is not None else "-" for value, digits in zip(values, (2, 3, 3), strict=True)]
    return " / ".join(texts)
