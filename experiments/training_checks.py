"""Training at the extremes, and the gradient of every loss term against finite differences."""

import dataclasses
import functools
import json
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.training import ChangedSource, random_networks, settings, written_subject
from humangs_jax.body.library import load_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import CaptureCache, CaptureSource, Loader
from humangs_jax.data.views import gaussian_body
from humangs_jax.losses.losses import FAR_SURFACE, loss_terms, ray_spread
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import Drawn
from humangs_jax.people.writer import Layout, write_person
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.training.config import LossConfig, TrainConfig
from humangs_jax.training.forward import draw_targets, reconstruct_example, white_backgrounds
from humangs_jax.training.loop import train
from humangs_jax.training.sources import captured_people
from humangs_jax.training.state import init_state
from humangs_jax.training.step import subject_loss, train_step

PLAIN = "as it is"
PEOPLE, SIZE, CARRIERS, STEPS, LAST = 3, 64, 1000, 40, 5
REPEATED = 4


@entry
def training_extremes(run: Run, only: tuple[str, ...] = (), steps: int = STEPS) -> None:
    """Training at the extremes: what a run does, and what its log says.

    Short runs of the smallest network on three synthetic people, each as `humangs train` makes it, with one thing changed.
    "loss": mean of the last five steps, over the scale of the loss. "PSNR": of the training targets, the same five steps.
    "gradient": the largest norm before clipping. "clipped", "skipped": steps by the guard of `training.state`. "log": what
    the log reports beside numbers. All parameters, moments and batch statistics have to be finite at the end.

    Options:
    only: names of runs
    steps: of each run
    """
    jax.config.update("jax_disable_most_optimizations", True)  # most of the time of such short runs is compilation
    body, base = load_body(), base_config()
    with tempfile.TemporaryDirectory() as folder:

        @functools.cache
        def first():
            return init_humangs(jax.random.key(base.seed), base.model), written_people(Path(folder), body)

        def measure(name):
            (change, start, of), (variables, people) = runs()[name], first()
            out = Path(folder) / name.replace(" ", "_").replace(",", "")
            return outcome(base, change, start, variables, of(people, body), body, out, steps)

        chosen = [name for name in runs() if not only or name in only]
        results = run.rows({name: functools.partial(measure, name) for name in chosen}, {"steps": steps})
    rows = []
    for name, row in results.items():
        if "error" in row:
            rows.append([name, *[""] * 5, f"error: {row['error']}" if row["error"] else "no error"])
            continue
        told = ", ".join(f"{event}: {count}" for event, count in row["events"].items())
        loss, psnr = f"{row['loss']:.3g}", f"{row['psnr']:.1f}"
        rows.append([name, loss, psnr, f"{row['gradient']:.2g}", row["clipped"], row["skipped"], told or "nothing"])
    header = ["run", "loss", "PSNR", "gradient", "clipped", "skipped", "log"]
    run.show(markdown_table(header, rows, "lrrrrrl"), results)


def base_config() -> Any:
    config = settings("tiny", SIZE, 2, 2)
    model = config.model.with_conventions(body_vertices=CARRIERS).with_runtime(token_capacity=0)
    loss = dataclasses.replace(config.loss, structural_scales=2)
    every = {"steps": STEPS, "validate_every": STEPS, "checkpoint_every": STEPS}
    return dataclasses.replace(config, model=model, loss=loss, **every)


def written_people(folder: Path, body: Any) -> list[Path]:
    folders = [folder / f"person{seed}" for seed in range(PEOPLE)]
    for seed, path in enumerate(folders):
        write_person(path, seed, body, Layout(SIZE, views=6))
    return folders


def runs() -> dict[str, tuple[Any, Any, Any]]:
    """{name: (change of the configuration, change of the first variables, source of (folders, body))}."""

    def scaled(factor):
        """All weights of the loss times a factor."""

        def change(config):
            weights = {name: factor * getattr(config.loss, name) for name in term_names()}
            return dataclasses.replace(config, loss=dataclasses.replace(config.loss, **weights))

        return change

    def rate(factor):
        optimizer = lambda config: dataclasses.replace(config.optimizer, learning_rate=factor * config.optimizer.learning_rate)
        return lambda config: dataclasses.replace(config, optimizer=optimizer(config))

    computed = lambda dtype: lambda config: dataclasses.replace(config, model=config.model.with_runtime(dtype=dtype))
    same, rounded = lambda x: x, lambda tree: jax.tree.map(lambda x: x.astype(jnp.bfloat16), tree)
    repeated = lambda config: dataclasses.replace(config, batch_size=REPEATED, microbatch_size=REPEATED)
    plain = captured_people
    return {
        PLAIN: (same, same, plain),
        "loss x 1e-6": (scaled(1e-6), same, plain),
        "loss x 1e6": (scaled(1e6), same, plain),
        "bfloat16 compute": (computed("bfloat16"), same, plain),
        "float16 compute": (computed("float16"), same, plain),
        "first parameters in bfloat16": (same, rounded, plain),
        "parameters in bfloat16": (same, None, plain),
        f"batch of one person, {REPEATED} times": (repeated, same, changed(index=lambda i: i // REPEATED * REPEATED)),
        "an all-white photo in every batch": (same, same, changed(whitened(slice(0, 1), slice(0, 0)))),
        "all photos and targets white": (same, same, changed(whitened(slice(None), slice(None)))),
        "learning rate x 100": (rate(100), same, plain),
    }


def whitened(inputs: slice, targets: slice) -> Any:
    """Example -> the same with white in the place of some of its images; masks as they are."""

    def white(views, which):
        images = np.array(views.images)
        images[which] = 1.0
        return replace(views, images=images)

    return lambda example, *_: replace(example, inputs=white(example.inputs, inputs), targets=white(example.targets, targets))


def changed(*how: Any, **named: Any) -> Any:
    """(folders, body) -> source of changed examples."""
    return lambda folders, body: lambda config: ChangedSource(captured_people(folders, body)(config), *how, **named)


def outcome(
    base: Any, change: Any, start: Any, variables: Any, make_source: Any, body: Any, out: Path, stop_at: int
) -> dict[str, Any]:
    """What becomes of one run. start None: parameters of another type are handed to the training step itself."""
    try:
        config = change(base)
        if start is None:  # one step of a state whose parameters somebody has made bfloat16
            state = init_state(config, variables)
            state = replace(state, params=jax.tree.map(lambda x: x.astype(jnp.bfloat16), state.params))
            batch = Loader(make_source(config), config.batch_size).batch_at(0)
            train_step(state, batch, gaussian_body(body, config.model), config)
            return {"error": None}
        state = train(config, body, make_source, out, variables=start(variables), stop_at=stop_at, progress=False)
    except ValueError as error:
        return {"error": str(error)}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.params, state.opt_state, state.batch_stats)))
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    steps = [line for line in lines if "event" not in line]
    events = Counter(line["event"] for line in lines if "event" in line)
    scale = config.loss.squared / base.loss.squared
    mean = lambda key: float(np.mean([line[key] for line in steps[-LAST:] if line[key] is not None]))
    norms = np.asarray([np.inf if (x := line["grad_norm"]) is None else x for line in steps])  # JSON has no infinity
    clip, skip = config.optimizer.clip_norm, config.optimizer.skip_norm
    return {
        "loss": mean("loss") / scale,
        "psnr": mean("psnr"),
        "gradient": float(norms.max()),
        "clipped": int(((norms > clip) & (norms <= skip)).sum()),
        "skipped": int(steps[-1]["skipped"]),
        "nonfinite": int(steps[-1]["nonfinite"]),
        "steps": len(steps),
        "events": dict(events),
    }


DIRECTIONS = 3
STEP_SIZES = (1e-4, 1e-5, 1e-6, 1e-8, 1e-9)
"""Of central differences, relative to the size of what is varied. Thousands of Gaussians move: within the longer steps some
exchange places in the depth order, and colors jump."""
NETWORKS = ("perceptual", "vgg16", "lpips")
"""Terms that need a network of their own."""
SIDE, TARGETS, VERTICES = 32, 2, 800


@entry
def loss_gradients(run: Run, quick: bool = False) -> None:
    """The gradient of every loss term against finite differences, in float64.

    "of its own inputs": renderings, opacities and offsets are random numbers, and each is varied. "of the network": the whole
    training step of the smallest network on a synthetic person, whose parameters, all of them, are varied. An error is that of
    the derivatives in three random directions, each at the best of a few step sizes, as a relative L2 norm. Networks of losses
    have random weights.

    Options:
    quick: of the terms' own inputs only
    """
    with jax.enable_x64(True):
        names = term_names()
        columns = {"of its own inputs": agreement(*own_case(names), names)}
        if not quick:
            columns["of the network"] = agreement(*network_case(names), names)
    numbers = {name: {column: found[name] for column, found in columns.items()} for name in names}
    rows = [[name, *(f"{error:.0e}" for error in row.values())] for name, row in numbers.items()]
    run.show(markdown_table(["term", *columns], rows), numbers)


def term_names() -> list[str]:
    settings = ("structural_scales", "random_background")
    return [field.name for field in dataclasses.fields(LossConfig) if field.name not in settings]


def loss_of(names: list[str]) -> Any:
    """A `LossConfig` with these terms and no others, for small images."""
    weights = dict.fromkeys(term_names(), 0.0) | dict.fromkeys(names, 1.0)
    return LossConfig(**weights, structural_scales=1, random_background=0.0)


def agreement(
    values: Any, point: Any, names: list[str], directions: int = DIRECTIONS, steps: Sequence[float] = STEP_SIZES
) -> dict[str, float]:
    """{term: relative error of its derivatives}. values: point -> {term: number}; differentiable. point: a tree of float64."""
    vector = jax.jit(lambda point: jnp.stack([values(point)[name] for name in names]))
    gradient = jax.jit(jax.grad(lambda point, weights: jnp.dot(weights, vector(point))))
    rng = np.random.default_rng(0)
    size = lambda x: np.sqrt(np.mean(np.square(x)))
    ways = [jax.tree.map(lambda x: rng.normal(size=x.shape) * size(np.asarray(x)), point) for _ in range(directions)]
    inner = lambda a, b: sum(np.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    gradients = [jax.device_get(gradient(point, weights)) for weights in np.eye(len(names))]
    derivatives = np.asarray([[inner(g, way) for way in ways] for g in gradients])
    best = np.full((len(names), directions), np.inf)
    along = lambda way, step: vector(jax.tree.map(lambda x, d: x + step * d, point, way))
    for step in steps:
        found = [np.asarray(along(way, step) - along(way, -step)) / (2 * step) for way in ways]
        best = np.fmin(best, np.abs(np.stack(found, axis=1) - derivatives))
    errors = np.linalg.norm(best, axis=1) / np.linalg.norm(derivatives, axis=1)
    return dict(zip(names, errors.tolist(), strict=True))


def own_case(names: list[str], side: int = SIDE) -> tuple[Any, Any]:
    """(values, point) of the terms alone, on made-up renderings."""
    rng = np.random.default_rng(1)
    pixels, vertices = (TARGETS, side, side), 5
    uniform = lambda *shape: rng.uniform(0.1, 0.9, shape)
    depth = 2 + uniform(*pixels)
    point = {
        "rgb": uniform(*pixels, 3),
        "alpha": uniform(*pixels),
        "depth": depth,
        "spread": 0.1 * uniform(*pixels),
        "opacities": uniform(3 * vertices),
        "tight_offsets": rng.normal(size=(vertices, 1, 3)),
    }
    images, masks = jnp.asarray(uniform(*pixels, 3)), jnp.asarray(uniform(*pixels))
    depths = jnp.asarray(depth + FAR_SURFACE * rng.uniform(-1.5, 1.5, pixels))
    config = loss_of(names)
    networks = loss_networks(config)

    def values(point):
        point = {name: jnp.asarray(x) for name, x in point.items()}
        alpha, mean = point["alpha"], point["depth"]
        one = lambda rgb, alpha, depth: Rendering(rgb, alpha, depth, jnp.zeros((), jnp.int32))
        rendering = jax.vmap(one)(point["rgb"], alpha, mean)
        spread = ray_spread(alpha, mean, mean**2 + point["spread"])
        drawn = Drawn(rendering, spread, point["opacities"], point["tight_offsets"])
        return loss_terms(drawn, images, masks, depths, config, networks)

    return values, point


def loss_networks(config: Any) -> Any:
    """The `LossNetworks` that a `LossConfig` needs, with random weights."""
    return random_networks(TrainConfig(loss=config))


def network_case(names: list[str]) -> tuple[Any, Any]:
    """(values, point) of the smallest network's training step. The point is its parameters."""
    config = settings("tiny", SIDE, 2, TARGETS)
    model = config.model.with_conventions(body_vertices=VERTICES).with_runtime(token_capacity=0)
    config = dataclasses.replace(config, model=model, loss=loss_of(names))
    networks, key, body = loss_networks(config.loss), jax.random.key(0), load_body()
    with tempfile.TemporaryDirectory() as folder:
        person = written_subject(Path(folder), config, body)
        source = CaptureSource(CaptureCache([person], body), config.views, SIDE, SIDE)
        example = source.example(0, 0, 2)
    rng = np.random.default_rng(2)

    def wide(tree):
        cast = lambda x: x.astype(np.float64) if np.issubdtype(x.dtype, np.floating) else x
        return jax.tree.map(lambda x: jnp.asarray(cast(np.asarray(x))), tree)

    variables = wide(init_humangs(key, model))
    body, example = wide(gaussian_body(body, model)), wide(example)
    batch_stats = variables["batch_stats"]
    # a fresh network has zeros, to which nothing upstream of them has a derivative
    point = jax.tree.map(lambda x: x + 0.05 * rng.normal(size=x.shape), variables["params"])

    @jax.jit
    def depths(point):
        variables, targets = {"params": point, "batch_stats": batch_stats}, example.targets
        outputs, _ = reconstruct_example(variables, body, example.inputs, config, True)
        given = body, example.inputs, targets, white_backgrounds(targets), config
        return draw_targets(variables, outputs, *given).rendering.depth

    depth = depths(point)
    surface = depth + FAR_SURFACE * rng.uniform(-1.5, 1.5, depth.shape)
    example = replace(example, targets=replace(example.targets, depths=surface))

    def values(point):
        _, (_, terms) = subject_loss(point, batch_stats, body, example, key, config, networks)
        return terms

    return values, point
