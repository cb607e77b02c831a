"""Time, arithmetic and memory of one step of training, in turns with plain matrix products, which give the floor.

    python experiments/benchmark_training.py --json OUT                       # all cases: half an hour on 2 idle cores
    python experiments/benchmark_training.py --json OUT --only "small 256" --stages --variants
    python experiments/benchmark_training.py --json OUT --page docs/performance_training.md

A synthetic person is made and read by the loader; weights are random, of loss networks, too: they cost what trained ones
cost. Operations and bytes are counted from the compiled step, loops included (`compiled_costs.py`). The floor is the time
that these operations take as plain products in the same turns. `--stages` compiles parts of a step by themselves and times
them: gradients of a part include the part itself. `--variants` times the step with one thing changed at a time. Results are
added to OUT, so cases can be run one by one; `--page` writes them into a page and runs nothing.

Numbers: docs/performance_training.md.
"""

import argparse
import json
import os
import tempfile
import time
import unittest.mock
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from compiled_costs import compiled_costs
from interleaved import medians, peak_rss_mb, prepare_process
from report_tables import markdown_table, write_json, write_section

CASES = {
    "small 256": ("small", 256, 4, 2),
    "published 256": ("published", 256, 4, 4),
    "published 512": ("published", 512, 4, 4),
    "tiny 32": ("tiny", 32, 2, 2),
}
"""Preset, size of photographs and targets, input views, targets. The last one is for tests."""
MEBI = 1 / 2**20


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=CASES, nargs="+", default=list(CASES)[:3], help="cases to run")
    parser.add_argument("--views", type=int, help="input views, instead of the case's")
    parser.add_argument("--targets", type=int, help="target views, instead of the case's")
    parser.add_argument(
        "--dtype", choices=("auto", "float32", "bfloat16"), default="auto", help="auto: float32 on a CPU"
    )
    parser.add_argument("--repeats", type=int, default=3, help="timed rounds")
    parser.add_argument("--warm-up", type=int, default=1, help="rounds before these")
    parser.add_argument("--stages", action="store_true", help="also time parts of the step")
    parser.add_argument(
        "--variants", nargs="*", help="also time the step with one thing changed at a time (all, or these)"
    )
    parser.add_argument("--json", type=Path, help="add the numbers to this file")
    parser.add_argument("--page", type=Path, help="write the tables into this page from --json; nothing is run")
    arguments = parser.parse_args()
    result = json.loads(arguments.json.read_text()) if arguments.json and arguments.json.exists() else {}
    if not arguments.page:
        prepare_process()
        for name in arguments.only:
            preset, size, views, targets = CASES[name]
            views, targets = arguments.views or views, arguments.targets or targets
            key = f"{name}, {views} + {targets} views"
            for numbers in benchmark(Case(preset, size, views, targets, arguments.dtype), arguments):
                result[key] = result.get(key, {}) | numbers
                print(key, json.dumps(numbers), flush=True)
                if arguments.json:
                    write_json(arguments.json, result)
    for name, make in {"steps": steps_table, "stages": stages_table, "variants": variants_table}.items():
        text = make(result)
        print(text, end="\n\n")
        if arguments.page:
            write_section(arguments.page, name, text)


class Case:
    """Everything that a step of one configuration needs; `state` is what the last step gave."""

    def __init__(self, preset: str, size: int, views: int, targets: int, dtype: str, batch: int = 1):
        import jax
        from training_setups import random_networks, settings, with_model

        from humangs_jax.body.library import load_body

        if dtype == "auto":
            dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
        self.config = with_model(settings(preset, size, views, targets, batch), dtype=dtype)
        self.program: Any = None
        self.full_body = load_body()
        self.networks = random_networks(self.config)

    def prepare(self, folder: Path) -> "Case":
        """Makes the person, reads the batch, draws the weights."""
        import jax
        from training_setups import written_subject

        from humangs_jax.data.loader import Loader
        from humangs_jax.data.views import gaussian_body

        config = self.config
        self.capture = written_subject(folder, config, self.full_body)
        self.loader = Loader(self.source(), config.batch_size, reader="plain")
        self.body = gaussian_body(self.full_body, config.model)
        self.batch = jax.block_until_ready(self.loader.batch_at(0))
        self.fit()
        self.state = fresh_state(config)
        return self

    def source(self) -> Any:
        """Examples of the person; nothing is read yet."""
        from humangs_jax.data.loader import CaptureCache, CaptureSource

        cache = CaptureCache([self.capture], self.full_body)
        return CaptureSource(cache, self.config.views, self.config.model.image_size, self.config.target_size)

    def fit(self) -> None:
        """Room for the foreground tokens of this person, as a run would have."""
        import jax
        from training_setups import with_model

        from humangs_jax.data.views import prepare_inputs

        if self.config.model.tokens == "foreground":
            from reconstruction_cases import foreground

            inputs = jax.jit(prepare_inputs, static_argnames="config")(
                self.body, first(self.batch).inputs, self.config.model
            )
            self.config = with_model(
                self.config, token_capacity=foreground(inputs, self.config.model)[0].token_capacity
            )

    def compiled(self, options: dict[str, Any] | None) -> tuple[Any, float]:
        """(the step as a program, CPU seconds that it took to trace and compile)."""
        import jax

        from humangs_jax.training.step import jitted_train_step

        step = jax.jit(
            jitted_train_step().__wrapped__,
            static_argnames=("config", "mesh"),
            donate_argnames="state",
            compiler_options=options,
        )
        start = time.process_time()
        arguments = self.state, self.batch, self.body, self.networks
        program = step.lower(*arguments, config=self.config, mesh=None).compile()
        return program, time.process_time() - start

    def run(self, program: Any) -> None:
        """One step."""
        import jax

        self.state, metrics = program(self.state, self.batch, self.body, self.networks)
        self.metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}


def fresh_state(config: Any) -> Any:
    """A training state of random weights."""
    from reconstruction_cases import random_variables

    from humangs_jax.training.state import init_state

    return init_state(config, random_variables(config.model))


def first(batch: Any) -> Any:
    """Its first subject."""
    import jax

    return jax.tree.map(lambda x: x[0], batch)


def compiler_options() -> dict[str, Any] | None:
    """Those of a training step here."""
    import jax

    from humangs_jax.rendering.splatting import CPU_COMPILER_OPTIONS

    return CPU_COMPILER_OPTIONS if jax.default_backend() == "cpu" else None


def benchmark(case: Case, arguments: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """What the JSON holds of a case, part by part."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)
    with tempfile.TemporaryDirectory() as folder:
        case.prepare(Path(folder))
        yield step_numbers(case, arguments)
        if arguments.stages:
            yield {"stages": stage_numbers(case, arguments)}
        if arguments.variants is not None:
            done = {}
            for name, numbers in variant_numbers(case, arguments):
                yield {"variants": done | {name: numbers}}
                done[name] = numbers


def step_numbers(case: Case, arguments: argparse.Namespace) -> dict[str, Any]:
    """Of the whole step."""
    import jax
    from reconstruction_cases import matmul_program

    program, compile_s = case.compiled(compiler_options())
    case.program = program
    costs = compiled_costs(program)
    product, product_flops = matmul_program(case.config.model.dtype)
    load = os.getloadavg()[0]
    times = medians({"matmul": product, "step": lambda: case.run(program)}, arguments.repeats, arguments.warm_up)
    wall, cpu = map(float, times["step"])
    floor = costs.matrix_flops / product_flops * times["matmul"]
    return {
        "ms": wall,
        "cpu_ms": cpu,
        "samples_per_s": 1e3 * case.config.batch_size / wall,
        "flops": costs.matrix_flops,
        "bytes": costs.bytes_accessed,
        "unknown_trips": costs.unknown_trips,
        "uncounted": list(costs.uncounted),
        "matmul_gflops": product_flops / times["matmul"][0] / 1e6,
        "matmul_gflops_cpu": product_flops / times["matmul"][1] / 1e6,
        "share_of_floor": float(floor[0]) / wall,
        "share_of_floor_cpu": float(floor[1]) / max(cpu, 1e-9),
        "temporary_mb": MEBI * costs.temporary_bytes,
        "argument_mb": MEBI * costs.argument_bytes,
        "peak_rss_mb": peak_rss_mb(),
        "compile_cpu_s": compile_s,
        "tokens": token_count(case.config),
        "gaussians": len(case.body.template) * case.config.model.decoder.gaussians_per_vertex,
        "parameters": sum(x.size for x in jax.tree.leaves(case.state.params)),
        "losses": case.metrics,
        "dtype": case.config.model.dtype,
        "repeats": arguments.repeats,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def token_count(config: Any) -> int:
    """Slots for tokens."""
    model = config.model
    patches = config.views.input_counts[0] * (model.image_size // model.patch_size) ** 2
    return model.token_capacity if model.tokens == "foreground" else patches


def stage_numbers(case: Case, arguments: argparse.Namespace) -> dict[str, list[float]]:
    """(wall, CPU ms) of parts of a step, each a program; of reading a batch from kept pictures and from disk."""
    import jax

    programs = {}
    for name, (function, inputs) in stages(case).items():
        program = jax.jit(function, compiler_options=compiler_options()).lower(*inputs).compile()
        programs[name] = lambda program=program, inputs=inputs: jax.block_until_ready(program(*inputs))
    fresh = lambda: case.source().example(0, 0, case.config.views.input_counts[0])
    programs["data, from disk"] = fresh
    programs["data, kept"] = lambda: jax.block_until_ready(case.loader.batch_at(0))
    times = medians(programs, arguments.repeats, arguments.warm_up)
    return {name: list(map(float, time)) for name, time in times.items()}


def stages(case: Case) -> dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]:
    """Functions and arguments of the parts, for one subject."""
    import jax
    import jax.numpy as jnp
    import optax

    from humangs_jax.data.views import prepare_inputs
    from humangs_jax.models.humangs import decode, encode_with_statistics, sample_vertices
    from humangs_jax.pytree import replace
    from humangs_jax.training.forward import draw_targets, white_backgrounds
    from humangs_jax.training.optimizer import make_optimizer
    from humangs_jax.training.step import loss_terms

    config, body, networks, example = case.config, case.body, case.networks, first(case.batch)
    targets, variables = example.targets, {"params": case.state.params, "batch_stats": case.state.batch_stats}
    jit = lambda function, *inputs: jax.jit(function, compiler_options=compiler_options())(*inputs)
    pose = lambda views: prepare_inputs(body, views, config.model, config.raster)
    inputs = jit(pose, example.inputs)

    def encode(params):
        return encode_with_statistics({**variables, "params": params}, inputs, config.model, True)[0]

    def read(params, encoding):
        own = {**variables, "params": params}
        features = sample_vertices(own, encoding, inputs, config.model)
        return decode(own, features, inputs.canonical_vertices, config.model)

    def draw(outputs, gaussians):
        outputs = replace(outputs, gaussians=gaussians)
        return draw_targets(outputs, body, targets, white_backgrounds(targets), config)

    def compare(outputs, drawn, rgb):
        terms = loss_terms(replace(drawn, rgb=rgb), outputs, targets.images, targets, config.loss, networks)
        return sum(getattr(config.loss, name) * term for name, term in terms.items())

    def update(state):
        optimizer = make_optimizer(config.optimizer, config.steps)
        updates, opt_state = optimizer.update(state.params, state.opt_state, state.params, value=jnp.ones(()))
        return optax.apply_updates(state.params, updates), opt_state

    def gradient(function, position=0):
        def total(*arguments):
            leaves = [x for x in jax.tree.leaves(function(*arguments)) if jnp.issubdtype(x.dtype, jnp.inexact)]
            return sum(jnp.sum(jnp.square(x.astype(jnp.float32))) for x in leaves)

        return jax.grad(total, position)

    params = variables["params"]
    encoding = jit(encode, params)
    outputs = jit(read, params, encoding)
    drawn = jit(draw, outputs, outputs.gaussians)
    return {
        "posing, position maps": (pose, (example.inputs,)),
        "encoder": (encode, (params,)),
        "encoder, gradient": (gradient(encode), (params,)),
        "reading, decoder": (read, (params, encoding)),
        "reading, decoder, gradient": (gradient(read, (0, 1)), (params, encoding)),
        "drawing": (draw, (outputs, outputs.gaussians)),
        "drawing, gradient": (gradient(draw, 1), (outputs, outputs.gaussians)),
        "losses, gradient": (jax.grad(compare, 2), (outputs, drawn, drawn.rgb)),
        "optimizer": (update, (case.state,)),
    }


def variants(case: Case) -> dict[str, tuple[dict[str, Any], dict[str, Any] | None, bool]]:
    """Changes to the settings, compiler options, and whether convolutions are differentiated by XLA alone."""
    options = compiler_options()
    model = case.config.model
    return {
        "XLA's default compiler options": ({}, None, False),
        "with an upsampler": ({"upsampler": upsampler(model)}, options, False),
        "with an upsampler, convolutions as XLA differentiates them": ({"upsampler": upsampler(model)}, options, True),
        "all patches are tokens": ({"tokens": "all"}, options, False),
        "blocks recomputed, in a loop": ({"transformer": {"remat": True, "scan": True}}, options, False),
        "bfloat16": ({"dtype": "bfloat16"}, options, False),
    }


def upsampler(model: Any) -> Any:
    """One in proportion to the network."""
    from humangs_jax.models.upsampler import UpsamplerConfig

    width = model.transformer.width
    return UpsamplerConfig(hidden=width // 3, out=width)


def variant_numbers(case: Case, arguments: argparse.Namespace) -> Iterator[tuple[str, dict[str, float]]]:
    """Of the step with one thing changed, in turns with the step as it is."""
    import jax
    from training_setups import with_model

    from humangs_jax.models import convolution

    asked = arguments.variants or list(variants(case))
    for name, (fields, options, plain) in ((name, variants(case)[name]) for name in asked):
        changed = object.__new__(Case)
        changed.__dict__.update(case.__dict__)
        changed.config = with_model(case.config, **fields)
        changed.state = fresh_state(changed.config)
        with (
            unittest.mock.patch.object(convolution, "_convolve_on_cpu", convolution._convolve)
            if plain
            else nullcontext()
        ):
            program, seconds = changed.compiled(options)
        costs = compiled_costs(program)
        runs = {"as it is": lambda: case.run(case.program), name: lambda: changed.run(program)}  # noqa: B023, called in here
        times = medians(runs, arguments.repeats, arguments.warm_up)
        (_, base_cpu), (wall, cpu) = times["as it is"], times[name]
        yield (
            name,
            {
                "ms": float(wall),
                "cpu_ms": float(cpu),
                "as_it_is_cpu_ms": float(base_cpu),
                "flops": costs.matrix_flops,
                "temporary_mb": MEBI * costs.temporary_bytes,
                "compile_cpu_s": seconds,
            },
        )
        jax.clear_caches()  # the next one may differ in what is patched alone


def steps_table(result: dict[str, Any]) -> str:
    """One line per case. The share is of CPU time on a CPU, which others use, too, and of wall time elsewhere."""
    header = [
        "one subject a step",
        "tokens",
        "Gaussians",
        "wall, CPU s",
        "samples/s",
        "TFLOP",
        "GB",
        "share of floor",
    ]
    header += ["MiB temporaries", "peak MiB", "compile, CPU s"]
    rows = [
        [
            name,
            row["tokens"],
            row["gaussians"],
            f"{row['ms'] / 1e3:.1f}, {row['cpu_ms'] / 1e3:.2f}",
            f"{row['samples_per_s']:.3f}",
            f"{row['flops'] / 1e12:.2f}",
            f"{row['bytes'] / 1e9:.0f}",
            f"{row['share_of_floor_cpu' if row['device'] == 'cpu' else 'share_of_floor']:.2f}",
            f"{row['temporary_mb']:.0f}",
            f"{row['peak_rss_mb']:.0f}",
            f"{row['compile_cpu_s']:.0f}",
        ]
        for name, row in result.items()
    ]
    machines = "; ".join(
        f"{name}: {row['dtype']}, {row['device']}, jax {row['jax']}, products {row['matmul_gflops']:.0f} GFLOP/s (wall), "
        f"load {row['load_average']:.1f}, {row['repeats']} timed"
        for name, row in result.items()
    )
    return markdown_table(header, rows) + f"\n\n{machines}."


def stages_table(result: dict[str, Any]) -> str:
    """One column per case, CPU ms."""
    cases = {name: row["stages"] for name, row in result.items() if "stages" in row}
    if not cases:
        return ""
    names = list(next(iter(cases.values())))
    rows = [[name, *(f"{case[name][1]:.0f}" for case in cases.values())] for name in names]
    step = ["the step", *(f"{result[name]['cpu_ms']:.0f}" for name in cases)]
    return markdown_table(["CPU ms", *cases], [*rows, step])


def variants_table(result: dict[str, Any]) -> str:
    """What one change does to the step."""
    rows = []
    for name, row in result.items():
        for variant, numbers in row.get("variants", {}).items():
            ratio = numbers["cpu_ms"] / numbers["as_it_is_cpu_ms"]
            cells = (numbers["cpu_ms"], ratio, numbers["ms"], numbers["flops"] / 1e9)
            rows.append(
                [f"{name}: {variant}", f"{cells[0]:.0f}", f"{cells[1]:.2f}", f"{cells[2]:.0f}", f"{cells[3]:.0f}"]
            )
            rows[-1] += [f"{numbers['temporary_mb']:.0f}", f"{numbers['compile_cpu_s']:.0f}"]
    header = ["step", "CPU ms", "/ as it is", "wall ms", "GFLOP", "MiB temporaries", "compile, CPU s"]
    return markdown_table(header, rows) if rows else ""


if __name__ == "__main__":
    main()
