"""How the cost of a reconstruction grows with the number of photos.

    python experiments/reconstruction/scaling.py --size 256 --image OUT.png --json OUT

Half of the published network's width and depth (384, 6), so that 16 views of 256 x 256 take seconds and not minutes, with
all tokens and with those of the foreground; and, counted from compiled programs that are not run, the operations of the
published network itself. CPU time is that of all threads.

5 minutes on 2 cores. Expected: attention makes all tokens grow faster than the views from 4 of them on; foreground
tokens grow with them. Numbers: docs/performance.md.
"""

import argparse
import dataclasses
import functools
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.reconstruction.benchmark import configured
from experiments.reconstruction.cases import benchmark_inputs, compiled, foreground, random_variables
from experiments.timing import medians, prepare_process

WIDTH, LAYERS = 384, 6
COLORS = {"all": "#c0392b", "foreground": "#1f6f8b"}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, nargs="+", default=[1, 2, 4, 8, 16])
    parser.add_argument("--size", type=int, default=256, help="side of the photos, pixels")
    parser.add_argument("--repeats", type=int, default=1, help="timed iterations")
    add_outputs(parser, "reconstruction_scaling")
    parser.add_argument("--image", "--picture", type=Path, help="draw them here (.png)")
    arguments = parser.parse_args()
    prepare_process()
    result = measure(arguments)
    write_outputs(arguments, "reconstruction_scaling", table(result), result)
    if arguments.image:
        draw(result, arguments.image)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    full = configured("paper", "auto", arguments.size)
    encoder = full.architecture.encoder
    transformer = dataclasses.replace(encoder.transformer, width=WIDTH, layers=LAYERS)
    half = full.with_parts(encoder=dataclasses.replace(encoder, transformer=transformer))
    variables = random_variables(half)
    rows = []
    for views in arguments.views:
        inputs = benchmark_inputs(full, views, arguments.size)
        _, touched, share = foreground(inputs, full)
        row: dict[str, Any] = {"views": views, "foreground_tokens": touched, "foreground_share": share}
        programs = {}
        for name in COLORS:
            case, whole = (foreground(inputs, c)[0] if name == "foreground" else c for c in (half, full))
            programs[name], _, flops = network(variables, inputs, case)
            row[name] = {
                "flops": flops,
                "published_flops": network(shapes_of(whole), inputs, whole)[2],
            }
        call = lambda program, subject: jax.block_until_ready(program(variables, subject))
        runs = {name: functools.partial(call, program, inputs) for name, program in programs.items()}
        for name, (wall, cpu) in medians(runs, arguments.repeats).items():
            row[name] |= {"ms": float(wall), "cpu_ms": float(cpu)}
        rows.append(row)
    return {
        "rows": rows,
        "width": WIDTH,
        "layers": LAYERS,
        "size": arguments.size,
        "dtype": half.runtime.dtype,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def network(variables: Any, inputs: Any, config: Any) -> Any:
    """The compiled network, as `compiled` returns it."""
    from humangs_jax.network.humangs import apply_humangs

    return compiled(lambda v, x: apply_humangs(v, x, config)[0], variables, inputs)


def shapes_of(config: Any) -> Any:
    """Variables that are only compiled for."""
    from humangs_jax.network.weights import expected_variables

    return expected_variables(config)


def table(result: dict[str, Any]) -> str:
    """The rows as text."""
    header = ["views", "foreground", *(f"{name}, {what}" for name in COLORS for what in ("CPU s", "published TFLOP"))]
    rows = [
        [
            row["views"],
            f"{row['foreground_tokens']} ({row['foreground_share']:.2f})",
            *(
                cell
                for name in COLORS
                for cell in (f"{row[name]['cpu_ms'] / 1e3:.2f}", f"{row[name]['published_flops'] / 1e12:.2f}")
            ),
        ]
        for row in result["rows"]
    ]
    return markdown_table(header, rows)


def draw(result: dict[str, Any], path: Path) -> None:
    """Time and counted operations against the number of views."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    views = np.asarray([row["views"] for row in result["rows"]])
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for name, color in COLORS.items():
        of = lambda key, name=name: np.asarray([row[name][key] for row in result["rows"]])
        left.loglog(views, of("cpu_ms") / 1e3, "o-", color=color, label=f"{name} tokens")
        right.loglog(views, of("published_flops") / 1e12, "o-", color=color, label=f"{name} tokens")
        linear = of("cpu_ms")[0] / 1e3 * views / views[0]
        left.loglog(views, linear, ":", color=color, linewidth=1, label=f"{name}: proportional to views")
    left.set_ylabel(f"CPU seconds, {result['device']}")
    left.set_title(f"measured: width {result['width']}, {result['layers']} layers, {result['size']} px", fontsize=10)
    right.set_ylabel("TFLOP")
    right.set_title(f"counted: published network, {result['size']} px", fontsize=10)
    for axes in (left, right):
        axes.set_xlabel("views")
        axes.set_xticks(views, [str(count) for count in views])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
