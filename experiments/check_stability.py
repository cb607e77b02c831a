"""Error of every stage, from photos to images and back to gradients, by number type, against float64 from the same numbers.

    python experiments/check_stability.py --json docs/results/stability.json [--table docs/stability.md] [--seeds 3]

"shipped": the shipped weights on people of the validation seeds. "published": the published architecture with random weights,
drawn anew for every seed, on the demo person at --published-size. An error is a relative L2 norm, the largest over the arrays of
a stage and over the seeds: of what the stage gives, of the gradients that it sends back, and of those of its parameters.
float16 runs forward only (it is not for training). tf32: float32 with products as the device's matrix units compute them; left
out where the device has none.
"""

import argparse
import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
from experiments.common.results import markdown_table, publish, write_json

TYPES = ("float32", "tf32", "bfloat16", "float16")
COLUMNS = {"values": "value", "cotangents": "gradient sent back", "gradients": "gradient of parameters"}
TABLE = "stability"
VIEWS, TARGETS = 4, 2


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", nargs="+", choices=("shipped", "published"), default=["shipped", "published"])
    parser.add_argument("--types", nargs="+", choices=TYPES, default=list(TYPES), help="number types to compare")
    parser.add_argument("--seeds", type=int, default=3, help="people, or draws of the weights")
    parser.add_argument(
        "--published-size", type=int, default=128, help="side of the published network's photos, pixels"
    )
    parser.add_argument("--json", type=Path, help="the numbers are written here")
    parser.add_argument("--table", type=Path, help="page whose tables are written")
    arguments = parser.parse_args()
    results: dict[str, Any] = {}
    for network in arguments.networks:
        results[network] = measure(network, arguments)
        if arguments.json:
            write_json(arguments.json, results)
        text = section(network, results[network])
        print(text)
        if arguments.table:
            publish(arguments.table, f"{TABLE}_{network}", text, {"seeds": arguments.seeds} | results[network])


def measure(network, arguments):
    """{stage: {type: {column: {"error", "of": the leaf that has it}}}}."""
    import jax
    import numpy as np
    from tqdm import tqdm

    worst: dict[str, Any] = {}
    make = {"shipped": shipped_case, "published": published_case}[network]
    cases = with_room([make(seed, arguments.published_size) for seed in range(arguments.seeds)])
    types = [name for name in arguments.types if name != "tf32" or jax.default_backend() == "gpu"]
    bar = tqdm(total=arguments.seeds * (1 + len(types)), desc=network)
    for seed in range(arguments.seeds):
        case = cases[seed]
        reference = observe(case, "float64")
        bar.update()
        for name in types:
            for stage, columns in observe(case, name).items():
                for column, arrays in columns.items():
                    for leaf, array in arrays.items():
                        truth = np.asarray(reference[stage][column][leaf], np.float64)
                        error = relative_error(np.asarray(array, np.float64), truth)
                        cell = worst.setdefault(stage, {}).setdefault(name, {})
                        known = cell.get(column, {}).get("error", -1.0)
                        if np.isnan(error) or known < error:  # NaN is the worst
                            cell[column] = {"error": error, "of": leaf}
            bar.update()
    bar.close()
    return worst


def with_room(cases):
    """The cases, each (variables, config, body, example), with one body and one token capacity: a program serves all."""
    from humangs_jax.avatar.reconstruct import fit_buffers
    from humangs_jax.data.loader import Example
    from humangs_jax.data.views import gaussian_body, prepare_inputs, standardize

    config, body = cases[0][1], gaussian_body(cases[0][2], cases[0][1])
    size = config.conventions.image_size
    examples = [Example(standardize(photos, size), standardize(targets, size)) for *_, photos, targets in cases]
    fitted = [fit_buffers(prepare_inputs(body, example.inputs, config), config) for example in examples]
    config = max(fitted, key=lambda fit: fit.runtime.token_capacity)
    return [(variables, config, body, example) for (variables, *_), example in zip(cases, examples, strict=True)]


def relative_error(value, truth):
    """Norm of the difference over that of the truth; 0 where both vanish."""
    import numpy as np

    difference, norm = np.linalg.norm(value - truth), np.linalg.norm(truth)
    return float(difference / norm) if norm else float(difference)


def shipped_case(seed, _):
    """Variables, configuration, body and example of a person of the validation seeds."""
    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject
    from humangs_jax.body.library import load_body
    from humangs_jax.network.weights import load_weights
    from humangs_jax.people.seeds import seeds_of

    body, (variables, config) = load_body(), load_weights()
    person = make_evaluation_subject(seeds_of("validation", seed, 1)[0], body, [VIEWS], 256, HeldOut(TARGETS, 0, 0))
    return variables, config, body, person.inputs(VIEWS), person.held_out


def published_case(seed, size):
    """The same for the published architecture with random weights, on the demo person."""
    import jax

    from humangs_jax.body.library import load_body
    from humangs_jax.data.capture import load_capture
    from humangs_jax.network import presets
    from humangs_jax.network.humangs import init_humangs

    body, capture = load_body(), load_capture("demo_capture")
    config = presets.published().with_conventions(image_size=size, body_vertices=4000)
    config = config.with_runtime(dtype="float32", tokens="foreground")
    variables = init_humangs(jax.random.key(seed), config)
    return variables, config, body, capture, load_capture("demo_capture/held_out").select(range(TARGETS))


def observe(case, name):
    """{stage: {column: {leaf: array}}} of one training step's forward and backward pass in a number type."""
    import jax
    import numpy as np

    from humangs_jax.training.config import LossConfig, TrainConfig
    from humangs_jax.training.diagnose import observe_subject
    from humangs_jax.training.step import NO_NETWORKS

    variables, config, body, example = case
    run = TrainConfig(model=config, loss=LossConfig(random_background=0.0), target_size=config.conventions.image_size)
    wide = name == "float64"
    number = np.float64 if wide else np.float32
    cast = lambda tree: jax.tree.map(lambda x: np.asarray(x, number) if is_real(x) else np.asarray(x), tree)
    products = {"float64": "highest", "float32": "highest", "tf32": "tensorfloat32"}.get(name, "highest")
    with jax.enable_x64(wide), jax.default_matmul_precision(products):
        learned = cast(variables["params"]), cast(variables.get("batch_stats", {}))
        if name == "float16":
            model = config.with_runtime(dtype="float16", scan=False)
            stages = {
                stage: {"values": values}
                for stage, values in observer(model, run)(*learned, cast(body), cast(example)).items()
            }
        else:
            run = dataclasses.replace(
                run, model=config.with_runtime(dtype="bfloat16" if name == "bfloat16" else "float32")
            )
            _, found = observe_subject(*learned, cast(body), cast(example), jax.random.key(0), run, NO_NETWORKS)
            stages = {x.name: {"values": x.values, "cotangents": x.cotangents, "gradients": x.gradients} for x in found}
        return jax.tree.map(lambda x: np.asarray(x, np.float64), jax.device_get(stages))


@functools.cache
def observer(model, run):
    """The stages of a forward pass, a compiled function of parameters, batch statistics, body and example."""
    import flax.linen as nn
    import jax

    from humangs_jax.data.views import prepare_inputs
    from humangs_jax.network.humangs import apply_humangs
    from humangs_jax.network.stages import Recorder
    from humangs_jax.training.forward import draw_targets, white_backgrounds

    def forward(params, batch_stats, body, example):
        recorder = Recorder()
        variables = {"params": params, "batch_stats": batch_stats}
        with nn.intercept_methods(recorder.watch):
            prepared = prepare_inputs(body, example.inputs, model)
            outputs, _ = apply_humangs(variables, prepared, model, True, None, recorder)
            backgrounds = white_backgrounds(example.targets)
            draw_targets(outputs, body, example.inputs, example.targets, backgrounds, run, recorder)
        return recorder.given

    return jax.jit(forward)


def is_real(x):
    """Whether an array holds floating-point numbers."""
    import jax.numpy as jnp

    return jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating)


def section(network, worst):
    """One row a stage, three columns a number type."""
    types = list(next(iter(worst.values())))
    columns = [(name, column) for name in types for column in COLUMNS if name != "float16" or column == "values"]
    header = ["stage", *(f"{name}: {COLUMNS[column]}" for name, column in columns)]
    show = lambda stage, name, column: f"{stage[name][column]['error']:.0e}" if column in stage.get(name, {}) else ""
    rows = [[title, *(show(stage, *pair) for pair in columns)] for title, stage in worst.items()]
    return markdown_table(header, rows, "l" + "r" * len(columns))


if __name__ == "__main__":
    main()
