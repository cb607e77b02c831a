"""Tables of docs/performance_training.md from what `training/benchmark.py` wrote; its `--page` puts them there."""

from collections.abc import Callable
from typing import Any

from experiments.common.results import markdown_table


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


TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "steps": steps_table,
    "stages": stages_table,
    "variants": variants_table,
}
"""Section of the page: what makes its table from all of the JSON."""
