"""Measures how far inputs and number types may go: extremes of each quantity, ranges of use, and
errors of every stage.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments import changes
from experiments.changes import noise
from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.subjects import HeldOut, make_evaluation_subject
from humangs_jax.avatar.reconstruct import fit_buffers
from humangs_jax.body.library import load_body
from humangs_jax.core.progress import bar
from humangs_jax.data.loading import Example
from humangs_jax.data.views import gaussian_body, prepare_inputs, to_network_views
from humangs_jax.losses.loss_networks import NO_NETWORKS
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.weights import load_weights
from humangs_jax.synthetic.subject import seeds_of
from humangs_jax.training.config import LossConfig, TrainConfig
from humangs_jax.training.diagnose import Recorder, observe_subject
from humangs_jax.training.forward import draw_targets, white_backgrounds

# Extremes
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """One change of the inputs. Without arguments nothing is changed."""

    photos: changes.Change = lambda capture: capture
    """Change of the capture that the avatar is made of."""
    held_out: changes.Change = lambda capture: capture
    """Change of the capture that the avatar is compared with."""
    photographed: bool = False
    """Whether new photos of the person are made by the changed cameras."""
    network: Callable[[Any, Any], tuple[Any, Any]] = lambda variables, config: (variables, config)
    """Change of the network: (variables, configuration) to others."""


def computed(dtype: str) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Returns the change of a network that computes in a dtype."""
    return lambda variables, config: (variables, config.with_runtime(dtype=dtype))


def in_type(dtype: str) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Returns the change of a network that has its weights in a dtype."""
    return lambda variables, config: (jax.tree.map(lambda x: x.astype(dtype), variables), config)


def with_nan(variables: Any, config: Any) -> tuple[Any, Any]:
    """Sets one number of the first array of the weights to NaN."""
    leaves, structure = jax.tree.flatten(variables)
    leaves[0] = np.array(leaves[0])
    leaves[0].reshape(-1)[0] = np.nan
    return jax.tree.unflatten(structure, leaves), config


CASES: dict[str, Case] = {
    "as it is": Case(),
    "4 stops over": Case(changes.photos(lambda x: 16 * x)),
    "4 stops under": Case(changes.photos(lambda x: x / 16)),
    "black": Case(changes.photos(np.zeros_like)),
    "white": Case(changes.photos(np.ones_like)),
    "noise": Case(
        changes.photos(lambda x: np.random.default_rng(0).random(x.shape).astype(np.float32))
    ),
    "focal length x 2": Case(changes.cameras(changes.focal(2.0))),
    "focal length / 2": Case(changes.cameras(changes.focal(0.5))),
    "focal length x 10": Case(changes.cameras(changes.focal(10.0))),
    "focal length / 10": Case(changes.cameras(changes.focal(0.1))),
    "cameras inside the body": Case(changes.at_the_pelvis),
    "cameras at 100 m": Case(changes.far(100.0), photographed=True),
    "cameras look away": Case(changes.cameras(matrix=changes.turned)),
    "person of 1 pixel": Case(changes.zoom(1 / 150)),
    "person of a twentieth of the frame": Case(changes.zoom(0.06)),
    "person cut at the frame": Case(changes.zoom(3.0)),
    "4 m tall": Case(changes.tall(2.3), held_out=changes.tall(2.3)),
    "0.4 m tall": Case(changes.tall(0.23), held_out=changes.tall(0.23)),
    "poses past joint limits": Case(changes.poses(lambda x: 3 * x)),
    "every joint at random": Case(changes.poses(changes.random_turns)),
    "masks empty": Case(changes.masks(np.zeros_like)),
    "masks full": Case(changes.masks(np.ones_like)),
    "masks inverted": Case(changes.masks(lambda x: 1 - x)),
    "no masks": Case(lambda capture: dataclasses.replace(capture, masks=None)),
    "1 view": Case(lambda capture: capture.select([0])),
    "32 views": Case(lambda capture: capture.select(list(range(changes.VIEWS)) * 8)),
    "one view four times": Case(lambda capture: capture.select([0] * changes.VIEWS)),
    "skinning weights of 0": Case(changes.without_weights),
    "betas 0": Case(changes.betas(0.0)),
    "betas 100": Case(changes.betas(100.0)),
    "NaN in images": Case(changes.spoilt("images")),
    "NaN in masks": Case(changes.spoilt("masks")),
    "NaN in betas": Case(changes.spoilt("betas")),
    "NaN in K": Case(changes.spoilt("cameras.K")),
    "NaN in cam_from_world": Case(changes.spoilt("cameras.cam_from_world")),
    "NaN in rotations": Case(changes.spoilt("poses.rotations")),
    "NaN in translation": Case(changes.spoilt("poses.translation")),
    "NaN in the template of the body": Case(changes.spoilt("body.template")),
    "NaN in the shape directions": Case(changes.spoilt("body.shape_directions")),
    "NaN in the joint regressor": Case(changes.spoilt("body.joint_regressor")),
    "NaN in the skinning weights": Case(changes.spoilt("body.skinning_weights")),
    "infinity in betas": Case(changes.spoilt("betas", np.inf)),
    "NaN in the weights": Case(network=with_nan),
    "NaN in a pose to be drawn": Case(held_out=changes.spoilt("poses.rotations")),
    "NaN in a camera that draws": Case(held_out=changes.spoilt("cameras.K")),
    "weights in bfloat16": Case(network=in_type("bfloat16")),
    "weights in float16": Case(network=in_type("float16")),
    "float16 compute": Case(network=computed("float16")),
    "bfloat16 compute": Case(network=computed("bfloat16")),
}


@entry
def extremes(run: Run, cases: tuple[str, ...] = ()) -> None:
    """Measures what `reconstruct` makes of inputs at the extremes: an error, a warning or an
    avatar, and how good the avatar is.

    The subject is a person of the validation seeds with four photos of 256 pixels. Each case
    changes one thing. "warned": the quick check, which `humangs reconstruct` runs first, warns.
    "reach" is the largest distance of a Gaussian from its vertex, in body heights. All numbers have
    to be finite. PSNR is that of held-out views of the same pose, with the true cameras and pose.
    "error": the last column names the array.

    Options:
    cases: words; only cases whose names have one of them
    """
    if cases and run.publish:
        raise ValueError("--publish writes the whole table: expected no --cases")
    (subject,), network = changes.subjects(1), load_weights()

    # each case changes the photos, the network or the held-out views
    def measure(case):
        capture = case.photos(subject.inputs(changes.VIEWS))
        if case.photographed:
            capture = changes.photographed(subject.seed, capture)
        return changes.outcome(case.network(*network), capture, case.held_out(subject.held_out))

    chosen = [name for name in CASES if not cases or any(word in name for word in cases)]
    numbers = run.rows({name: functools.partial(measure, CASES[name]) for name in chosen})
    rows = []
    for name, row in numbers.items():
        if "error" in row:
            rows.append([name, "error", "", "", "", row["error"]])
            continue
        shown = [f"{row['reach']:.2f}", f"{row['psnr']:.1f}", f"{row['psnr_fg']:.1f}"]
        result, first_line = "avatar", ""
        if row["warnings"]:
            result, first_line = "warned", row["warnings"][0]
        rows.append([name, result, *shown, first_line])
    header = ["case", "result", "reach", "PSNR", "foreground PSNR", "first line"]
    run.show(markdown_table(header, rows, "llrrrl"), numbers)


# Ranges of use
# --------------------------------------------------------------------------------------------------

BOUND = 1.0
"""Loss of PSNR in decibels that ends a range of use."""
RENDERED = "distance of the cameras"
"""The quantity for which new photos are made by the changed cameras."""
LIMITS: dict[str, tuple[str, float | None, dict[float, changes.Change]]] = {
    "photos": (
        "",
        4,
        {
            n: lambda c, n=n: c.select(list(range(0, changes.VIEWS, changes.VIEWS // n)))
            for n in (1, 2)
        },
    ),
    "noise": (
        "standard deviation",
        0,
        {
            x: changes.photos(lambda i, x=x: i + x * noise(4, i.shape))
            for x in (0.05, 0.1, 0.2, 0.4)
        },
    ),
    "distance of the cameras": (
        "m",
        None,
        {x: changes.far(x) for x in (1.2, 1.6, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, 30.0)},
    ),
    "height of the person": (
        "pixels of 256",
        None,
        {x: changes.person_of(x) for x in (25, 50, 75, 100, 130, 160, 190)},
    ),
    "masks too large or small": (
        "pixels of 256",
        0,
        {x: changes.masks_grown(x) for x in (-6, -3, -1, 1, 3, 6)},
    ),
    "focal length": (
        "%",
        0,
        {x: changes.cameras(changes.focal(1 + x / 100)) for x in (-10, -5, -2, 2, 5, 10)},
    ),
    "cameras turned": ("degrees", 0, {x: changes.turned_by(x) for x in (0.25, 0.5, 1, 2, 4)}),
    "joints turned": (
        "degrees",
        0,
        {
            x: changes.poses(lambda r, x=x: r + np.radians(x) / 3**0.5 * noise(5, r.shape))
            for x in (1, 2, 4, 8, 16)
        },
    ),
    "body moved": ("cm", 0, {x: changes.moved_by(x) for x in (0.5, 1, 2, 4, 8)}),
    "shape coefficients": (
        "standard deviations",
        0,
        {
            x: lambda c, x=x: dataclasses.replace(
                c, betas=np.asarray(c.betas) + np.float32(x * noise(6, c.betas.shape))
            )
            for x in (0.25, 0.5, 1, 2)
        },
    ),
}
"""{quantity: (unit, the value at which nothing is changed, {value: change})}.

The value at which nothing is changed is None where it lies among the values and is not known.
"""


@entry
def limits(run: Run, people: int = 2) -> None:
    """Measures how far a single quantity may be off until the mean PSNR of people has fallen by
    1 dB.

    The people are of the validation seeds, with four photos of 256 pixels. Losses are interpolated
    linearly between the values that are tried.

    Options:
    people: number of people
    """
    network, chosen = load_weights(), changes.subjects(people)

    # mean PSNR with one quantity changed
    def score(name, change):
        scores = []
        for subject in chosen:
            capture = change(subject.inputs(changes.VIEWS))
            if name == RENDERED:
                capture = changes.photographed(subject.seed, capture)
            scores.append(changes.outcome(network, capture, subject.held_out)["psnr"])
        return float(np.mean(scores))

    tried = {
        (name, value): change
        for name, (_, _, each) in LIMITS.items()
        for value, change in each.items()
    }
    cases = {
        f"{name} {value:g}": functools.partial(score, name, change)
        for (name, value), change in tried.items()
    }
    plain = functools.partial(score, "", lambda capture: capture)
    scores = run.rows({"plain": plain} | cases, {"people": people})

    # what each value costs, and the range in which that is less than 1 dB
    losses: dict[str, Any] = {}
    for name, value in tried:
        losses.setdefault(name, {})[value] = scores["plain"] - scores[f"{name} {value:g}"]
    ranges, rows = {name: interval(name, losses[name]) for name in LIMITS}, []

    def shown(end):
        return "-" if end is None else f"{end:.3g}"

    for name, lost in losses.items():
        ends = [shown(ranges[name][end]) for end in ("low", "high")]
        values = ", ".join(f"{value:g}: {loss:.1f}" for value, loss in sorted(lost.items()))
        rows.append([f"{name}, {ranges[name]['unit']}".rstrip(", "), *ends, values])
    header = ["quantity", "from", "to", "dB lost at each value tried"]
    run.show(markdown_table(header, rows, "lrrl"), {"losses": losses, "ranges": ranges})


def interval(name: str, losses: dict[float, float]) -> dict[str, Any]:
    """Returns the range around the best value in which the loss stays below `BOUND`.

    An end that was not reached is None.
    """
    unit, zero, _ = LIMITS[name]
    if zero is not None:
        losses = losses | {zero: 0.0}
    points = sorted(losses.items())
    middle = min(range(len(points)), key=lambda i: points[i][1])

    def end(step):
        i = middle
        while 0 <= i + step < len(points):
            (x, loss), (y, more) = points[i], points[i + step]
            if more > BOUND:
                return x + (y - x) * (BOUND - loss) / (more - loss)
            i += step
        return None

    low, high = end(-1), end(1)
    # errors that have no sign begin at 0
    if low is None and points[0][0] == 0:
        low = 0.0
    if name == "photos" and low is not None:
        low = math.ceil(low)
    return {"unit": unit, "low": low, "high": high}


# Number types
# --------------------------------------------------------------------------------------------------

Types = Literal["float32", "tf32", "bfloat16", "float16"]
COLUMNS = {
    "values": "value",
    "cotangents": "gradient sent back",
    "gradients": "gradient of parameters",
}
"""{what a stage is compared by: its heading}."""
TARGETS = 2
"""Number of held-out views that are drawn."""


@entry
def stability(
    run: Run, types: tuple[Types, ...] = ("float32", "tf32", "bfloat16", "float16"), seeds: int = 3
) -> None:
    """Measures the error of every stage, from photos to images and back to gradients, by number
    type, against float64 from the same numbers.

    The shipped weights run on people of the validation seeds. An error is a relative L2 norm, the
    largest over the arrays of a stage and over the people. Compared are what the stage returns, the
    gradients that it sends back, and the gradients of its parameters. float16 runs forward only.
    tf32 is float32 with products as the device's matrix units compute them. It is left out where
    the device has none.

    Tables: stability_shipped

    Options:
    types: number types to compare
    seeds: number of people
    """
    # only GPUs have tf32
    if jax.default_backend() != "gpu":
        types = tuple(name for name in types if name != "tf32")
    worst = _worst(shipped_cases(seeds), types)
    columns = []
    for name in next(iter(worst.values())):
        columns += [(name, each) for each in COLUMNS if name != "float16" or each == "values"]

    def show(stage, name, column):
        if column not in stage.get(name, {}):
            return ""
        return f"{stage[name][column]['error']:.0e}"

    rows = [[title, *(show(stage, *pair) for pair in columns)] for title, stage in worst.items()]
    header = ["stage", *(f"{name}: {COLUMNS[column]}" for name, column in columns)]
    run.show(markdown_table(header, rows), {"seeds": seeds} | worst, "stability_shipped")


def _worst(cases, types):
    """Returns the largest errors, {stage: {type: {column: {"error", "of": the leaf that has
    it}}}}.
    """
    worst: dict[str, Any] = {}
    for case in bar(cases, desc="stability", unit="case"):
        reference = observe(case, "float64")
        for name in types:
            for stage, columns in observe(case, name).items():
                for column, arrays in columns.items():
                    for leaf, array in arrays.items():
                        truth = np.asarray(reference[stage][column][leaf], np.float64)
                        norm = np.linalg.norm(truth)
                        difference = np.linalg.norm(np.asarray(array, np.float64) - truth)
                        error = float(difference / (norm or 1.0))
                        cell = worst.setdefault(stage, {}).setdefault(name, {})
                        known = cell.get(column, {}).get("error", -1.0)
                        if np.isnan(error) or known < error:  # NaN is the worst
                            cell[column] = {"error": error, "of": leaf}
    return worst


def shipped_cases(count):
    """Returns (variables, config, body, example) of people of the validation seeds.

    All have one token capacity, so that one program serves all of them.
    """
    whole, (variables, config) = load_body(), load_weights()
    body, size, examples = gaussian_body(whole, config), config.conventions.image_size, []
    for seed in seeds_of("validation", 0, count):
        person = make_evaluation_subject(seed, whole, [changes.VIEWS], 256, HeldOut(TARGETS, 0, 0))
        seen = to_network_views(person.inputs(changes.VIEWS), size)
        examples.append(Example(seen, to_network_views(person.held_out, size)))
    inputs = [prepare_inputs(body, example.inputs, config) for example in examples]
    fitted = [fit_buffers(each.foreground, each.view_count, config) for each in inputs]
    config = max(fitted, key=lambda fit: fit.runtime.token_capacity)
    return [(variables, config, body, example) for example in examples]


def observe(case, name):
    """Runs the forward and the backward pass of a training step in a number type.

    Returns {stage: {column: {leaf: array}}}. float16 has only the forward pass.
    """
    variables, config, body, example = case
    run = TrainConfig(
        model=config,
        loss=LossConfig(random_background=0.0),
        target_size=config.conventions.image_size,
    )
    wide = name == "float64"
    number = np.float64 if wide else np.float32

    def real(x):
        return jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)

    def cast(tree):
        return jax.tree.map(lambda x: np.asarray(x, number) if real(x) else np.asarray(x), tree)

    # products are exact unless the type is about them
    precision = "tensorfloat32" if name == "tf32" else "highest"
    with jax.enable_x64(wide), jax.default_matmul_precision(precision):
        learned = cast(variables["params"]), cast(variables.get("batch_stats", {}))
        if name == "float16":
            model = config.with_runtime(dtype="float16", scan=False)
            values = observer(model, run)(*learned, cast(body), cast(example))
            stages = {stage: {"values": each} for stage, each in values.items()}
        else:
            dtype = "bfloat16" if name == "bfloat16" else "float32"
            run = dataclasses.replace(run, model=config.with_runtime(dtype=dtype))
            _, found = observe_subject(
                *learned, cast(body), cast(example), jax.random.key(0), run, NO_NETWORKS
            )
            stages = {
                x.name: {"values": x.values, "cotangents": x.taken, "gradients": x.gradients}
                for x in found
            }
        return jax.tree.map(lambda x: np.asarray(x, np.float64), jax.device_get(stages))


@functools.cache
def observer(model, run):
    """Returns a compiled function of parameters, batch statistics, body and example, which returns
    the stages of a forward pass.
    """

    def forward(params, batch_stats, body, example):
        recorder = Recorder()
        variables = {"params": params, "batch_stats": batch_stats}
        with nn.intercept_methods(recorder):
            inputs = prepare_inputs(body, example.inputs, model)
            outputs, _ = apply_humangs(variables, inputs, model, True)
            backgrounds = white_backgrounds(example.targets)
            draw_targets(
                variables, outputs, body, example.inputs, example.targets, backgrounds, run
            )
        return recorder.given

    return jax.jit(forward)
