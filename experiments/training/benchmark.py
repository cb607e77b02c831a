"""Time, arithmetic and memory of one step of training, in turns with plain matrix products, which give the floor.

    python experiments/training/benchmark.py --json OUT                       # all cases: half an hour on 2 idle cores
    python experiments/training/benchmark.py --json OUT --page docs/performance.md

A synthetic person is made and read by the loader; all weights are random, also those of loss networks: they cost what trained
ones cost. Operations are counted from the traced step, loops included (`common/costs.py`). The floor is
the time that these operations take as plain products in the same turns. Results are added to OUT, so cases can be run one by
one; `--page` writes them into a page and runs nothing.

Numbers: docs/performance.md.
"""

import argparse
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json
from experiments.costs import temporary_mb
from experiments.timing import medians, peak_rss_mb, prepare_process
from experiments.training.cases import CASES, Case

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
    parser.add_argument("--repeats", type=int, default=3, help="timed iterations")
    parser.add_argument("--warm-up", type=int, default=1, help="iterations before these")
    parser.add_argument("--json", type=Path, help="add the numbers to this file")
    parser.add_argument("--page", type=Path, help="write the tables into this page from --json; nothing is run")
    arguments = parser.parse_args()
    result = json.loads(arguments.json.read_text()) if arguments.json and arguments.json.exists() else {}
    if arguments.page and not result:
        parser.error("--page writes the numbers of --json: there are none yet")
    if not arguments.page:
        prepare_process()
        for name in arguments.only:
            preset, size, views, targets = CASES[name]
            views, targets = arguments.views or views, arguments.targets or targets
            key = f"{name}, {views} + {targets} views"
            result[key] = benchmark(Case(preset, size, views, targets, arguments.dtype), arguments)
            print(key, json.dumps(result[key]), flush=True)
            if arguments.json:
                write_json(arguments.json, result)
    print(text := steps_table(result))
    if arguments.page:
        publish(arguments.page, "training_steps", text, result)


def benchmark(case: Case, arguments: argparse.Namespace) -> dict[str, Any]:
    """What the JSON holds of a case."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)
    with tempfile.TemporaryDirectory() as folder:
        case.prepare(Path(folder))
        return step_numbers(case, arguments)


def step_numbers(case: Case, arguments: argparse.Namespace) -> dict[str, Any]:
    """Of the whole step."""
    import jax

    from experiments.reconstruction.cases import matmul_program
    from humangs_jax.core.compiling import compiler_options

    program, compile_s, costs = case.compiled(compiler_options())
    case.program = program
    product, product_flops = matmul_program(case.config.model.runtime.dtype)
    load = os.getloadavg()[0]
    times = medians({"matmul": product, "step": lambda: case.run(program)}, arguments.repeats, arguments.warm_up)
    wall, cpu = map(float, times["step"])
    floor = costs.flops / product_flops * times["matmul"]
    return {
        "ms": wall,
        "cpu_ms": cpu,
        "samples_per_s": 1e3 * case.config.batch_size / wall,
        "flops": costs.flops,
        "unknown_trips": costs.unknown_trips,
        "matmul_gflops": product_flops / times["matmul"][0] / 1e6,
        "matmul_gflops_cpu": product_flops / times["matmul"][1] / 1e6,
        "share_of_floor": float(floor[0]) / wall,
        "share_of_floor_cpu": float(floor[1]) / max(cpu, 1e-9),
        "temporary_mb": temporary_mb(program),
        "peak_rss_mb": peak_rss_mb(),
        "compile_cpu_s": compile_s,
        "tokens": token_count(case.config),
        "gaussians": len(case.body.template) * case.config.model.architecture.decoder.gaussians_per_vertex,
        "parameters": sum(x.size for x in jax.tree.leaves(case.state.params)),
        "losses": case.metrics,
        "dtype": case.config.model.runtime.dtype,
        "repeats": arguments.repeats,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def token_count(config: Any) -> int:
    """Slots for tokens."""
    model = config.model
    patches = (
        config.views.input_counts[0] * (model.conventions.image_size // model.architecture.encoder.patch_size) ** 2
    )
    return model.runtime.token_capacity if model.tokens == "foreground" else patches


def steps_table(result: dict[str, Any]) -> str:
    """One line per case. The share is of CPU time on a CPU, which others use, too, and of wall time elsewhere."""
    header = [
        "one subject a step",
        "tokens",
        "Gaussians",
        "wall, CPU s",
        "samples/s",
        "TFLOP",
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


if __name__ == "__main__":
    main()
