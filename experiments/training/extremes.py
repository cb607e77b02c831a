"""Training at the extremes: what a run does, and what its log says.

    python experiments/training/extremes.py --json OUT --page docs/stability.md --image training_extremes.png [--quick]

Short runs of the smallest network on three synthetic people, each as `humangs train` makes it, with one thing changed.
"loss": mean of the last five steps, over the scale of the loss. "PSNR": of the training targets, the same five steps.
"gradient": the largest norm before clipping. "clipped", "skipped": steps by the guard of `training.optimizer`. "log": what
the log reports beside numbers. All parameters, moments and batch statistics have to be finite at the end. Runs that are in
OUT are not made again.
--quick: 4 steps of three of the runs.
"""

import argparse
import dataclasses
import json
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, check_section, markdown_table, write_json, write_outputs

TABLE = "training_extremes"
PLAIN = "as it is"
PEOPLE, SIZE, VERTICES, STEPS, LAST = 3, 64, 1000, 40, 5
REPEATED = 4
QUICK = (PLAIN, "an all-white photo in every batch", "float16 compute")
DRAWN = (PLAIN, "learning rate x 100", "loss x 1e6")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few runs of few steps")
    parser.add_argument("--image", type=Path, help="the curves of some runs are drawn here")
    add_outputs(parser, TABLE)
    arguments = parser.parse_args()
    if arguments.page:
        check_section(arguments.page, TABLE)
    results = measure(arguments.quick, arguments.json)
    write_outputs(arguments, TABLE, section(results), results)
    if arguments.image:
        draw(results, arguments.image)


def measure(quick: bool = False, path: Path | None = None) -> dict[str, Any]:
    """{run: {"error"} or its numbers and curves}; those in a file are not made again, and each is added to it.

    Raises: AssertionError: something is not finite at the end of a run.
    """
    import jax
    from tqdm import tqdm

    from humangs_jax.body.library import load_body
    from humangs_jax.network.humangs import init_humangs

    jax.config.update("jax_disable_most_optimizations", True)  # most of the time of such short runs is compilation
    body, results = load_body(), {}
    if path is not None and path.is_file():
        results = json.loads(path.read_text())
    with tempfile.TemporaryDirectory() as folder:
        base = base_config()
        variables = init_humangs(jax.random.key(base.seed), base.model)
        people = written_people(Path(folder), body)
        for name, (change, start, of) in tqdm(runs().items(), desc="runs"):
            if name not in results and (not quick or name in QUICK):
                out = Path(folder) / name.replace(" ", "_").replace(",", "")
                results[name] = outcome(
                    base, change, start, variables, of(people, body), body, out, 4 if quick else STEPS
                )
                if path is not None:
                    write_json(path, results)
    return {name: results[name] for name in runs() if name in results}


def base_config() -> Any:
    """The preset `tiny`, for photos of `SIZE` pixels."""
    from experiments.training.cases import settings

    config = settings("tiny", SIZE, 2, 2)
    model = config.model.with_conventions(body_vertices=VERTICES).with_runtime(token_capacity=0)
    loss = dataclasses.replace(config.loss, structural_scales=2)
    every = {"steps": STEPS, "validate_every": STEPS, "checkpoint_every": STEPS}
    return dataclasses.replace(config, model=model, loss=loss, **every)


def written_people(folder: Path, body: Any) -> list[Path]:
    """Capture folders."""
    from humangs_jax.people.writer import Layout, write_person

    folders = [folder / f"person{seed}" for seed in range(PEOPLE)]
    for seed, path in enumerate(folders):
        write_person(path, seed, body, Layout(SIZE, views=6))
    return folders


def runs() -> dict[str, tuple[Any, Any, Any]]:
    """{name: (change of the configuration, change of the first variables, source of (folders, body))}."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.training.config import LossConfig
    from humangs_jax.training.sources import captured_people

    def scaled(factor):
        """All weights of the loss times a factor."""

        def change(config):
            names = [
                f.name for f in dataclasses.fields(LossConfig) if f.type is float and f.name != "random_background"
            ]
            weights = {name: factor * getattr(config.loss, name) for name in names}
            return dataclasses.replace(config, loss=dataclasses.replace(config.loss, **weights))

        return change

    def rate(factor):
        optimizer = lambda config: dataclasses.replace(
            config.optimizer, learning_rate=factor * config.optimizer.learning_rate
        )
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
    import numpy as np

    from humangs_jax.core.pytree import replace

    def white(views, which):
        images = np.array(views.images)
        images[which] = 1.0
        return replace(views, images=images)

    return lambda example: replace(
        example, inputs=white(example.inputs, inputs), targets=white(example.targets, targets)
    )


def changed(change: Any = lambda example: example, index: Any = lambda i: i) -> Any:
    """(folders, body) -> source of changed examples; index: number of an example -> number of the one in its place."""
    from humangs_jax.training.sources import captured_people

    class Changed:
        def __init__(self, source):
            self._source = source

        def __getattr__(self, name):
            return getattr(self._source, name)

        def __len__(self):
            return len(self._source)

        def example(self, seed, i, input_count):
            return change(self._source.example(seed, index(i), input_count))

        def describe(self, seed, i, input_count):
            return self._source.describe(seed, index(i), input_count)

    return lambda folders, body: lambda config: Changed(captured_people(folders, body)(config))


def outcome(
    base: Any, change: Any, start: Any, variables: Any, make_source: Any, body: Any, out: Path, stop_at: int
) -> dict[str, Any]:
    """What becomes of one run. start None: parameters of another type are handed to the training step itself."""
    import jax
    import numpy as np

    from humangs_jax.training.loop import train

    try:
        config = change(base)
        if start is None:
            step_with_bfloat16(config, variables, make_source, body)
            return {"error": None}
        state = train(config, body, make_source, out, variables=start(variables), stop_at=stop_at, progress=False)
    except ValueError as error:
        return {"error": str(error)}
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.params, state.opt_state, state.batch_stats)))
    lines = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    steps = [line for line in lines if "event" not in line]
    events = Counter(line["event"] for line in lines if "event" in line)
    scale = config.loss.squared / base.loss.squared
    curve = {
        "loss": [None if line["loss"] is None else line["loss"] / scale for line in steps],
        "psnr": [line["psnr"] for line in steps],
        "gradient": [line["grad_norm"] for line in steps],
        "skipped": np.diff([0, *(line["skipped"] for line in steps)]).astype(int).tolist(),
    }
    norms = np.asarray([np.inf if x is None else x for x in curve["gradient"]])  # JSON has no infinity
    bounds = [config.optimizer.clip_norm, config.optimizer.skip_norm]
    return {
        "loss": float(np.mean([x for x in curve["loss"][-LAST:] if x is not None])),
        "psnr": float(np.mean([x for x in curve["psnr"][-LAST:] if x is not None])),
        "gradient": float(norms.max()),
        "clipped": int(((norms > bounds[0]) & (norms <= bounds[1])).sum()),
        "skipped": int(steps[-1]["skipped"]),
        "nonfinite": int(steps[-1]["nonfinite"]),
        "steps": len(steps),
        "events": dict(events),
        "curve": curve,
        "bounds": bounds,
    }


def step_with_bfloat16(config: Any, variables: Any, make_source: Any, body: Any) -> None:
    """One training step of a state whose parameters somebody has made bfloat16."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.core.pytree import replace
    from humangs_jax.data.loader import Loader
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.training.state import init_state
    from humangs_jax.training.step import train_step

    state = init_state(config, variables)
    state = replace(state, params=jax.tree.map(lambda x: x.astype(jnp.bfloat16), state.params))
    batch = Loader(make_source(config), config.batch_size).batch_at(0)
    train_step(state, batch, gaussian_body(body, config.model), config)


def section(results: dict[str, Any]) -> str:
    """The table."""
    rows = []
    for name, row in results.items():
        if "error" in row:
            rows.append([name, *[""] * 5, f"error: {row['error']}" if row["error"] else "no error"])
            continue
        told = ", ".join(f"{event}: {count}" for event, count in row["events"].items())
        loss, psnr = f"{row['loss']:.3g}", f"{row['psnr']:.1f}"
        rows.append([name, loss, psnr, f"{row['gradient']:.2g}", row["clipped"], row["skipped"], told or "nothing"])
    return markdown_table(["run", "loss", "PSNR", "gradient", "clipped", "skipped", "log"], rows, "lrrrrrl")


def draw(results: dict[str, Any], path: Path) -> None:
    """Loss and gradient norm of the runs of `DRAWN`, with the guard's bounds and the steps that it skipped."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4))
    for i, name in enumerate(name for name in DRAWN if name in results):
        curve, color = results[name]["curve"], f"C{i}"
        steps = np.arange(1, len(curve["loss"]) + 1)
        gradient, skipped = np.asarray(curve["gradient"], float), np.asarray(curve["skipped"], bool)
        left.plot(steps, np.asarray(curve["loss"], float), color=color, label=name)
        right.plot(steps, gradient, color=color, lw=1)
        right.plot(steps[skipped], gradient[skipped], "x", color=color, ms=4)
    clip, skip = results[PLAIN]["bounds"]
    right.axhline(clip, color="0.5", ls="--", lw=1)
    right.text(1, clip, " scaled down above", va="bottom", fontsize=7, color="0.3")
    right.axhline(skip, color="0.2", ls="--", lw=1)
    right.text(1, skip, " skipped above (x)", va="bottom", fontsize=7, color="0.3")
    left.set(xlabel="step", ylabel="loss, over its scale", yscale="log")
    right.set(xlabel="step", ylabel="gradient norm before clipping", yscale="log")
    left.legend(fontsize=7)
    for axis in (left, right):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
