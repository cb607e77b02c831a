"""Tables of several runs of `splatting/benchmark.py`.

    python experiments/splatting/results.py RUN.json [more] [--page docs/performance.md]

Prints, for every run, times and their ratios to the yardstick's, compile time and memory; then errors where a reference
was given. Seconds.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, write_section

TIMES = ("forward", "forward_backward")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="JSON of a benchmark run")
    parser.add_argument(
        "--page", type=Path, help="Markdown page whose section 'benchmark_splatting' becomes the tables"
    )
    arguments = parser.parse_args()
    runs = [json.loads(path.read_text()) for path in arguments.runs]
    text = "\n\n".join(part for part in (times(runs), errors(runs)) if part)
    print(text)
    if arguments.page:
        write_section(arguments.page, "benchmark_splatting", text)


def name_of(run: dict[str, Any]) -> str:
    """Scene, size and how many devices shared the image."""
    devices = len(run["devices"])
    return f"{run['scene']} {run['size']}" + (f", {devices} devices" if devices > 1 else "")


def times(runs: Sequence[dict[str, Any]]) -> str:
    """Wall and CPU ms, and their ratios to the yardstick's."""
    rows = []
    for run in runs:
        if run["forward_ms"] is None:
            continue
        cells = [name_of(run)]
        for name in TIMES:
            cells.append(f"{run[f'{name}_ms']:.0f}, {run[f'{name}_cpu_ms']:.0f}")
            ratio = run["ratio"]
            cells.append(f"{ratio[f'{name}_ms']:.2f}, {ratio[f'{name}_cpu_ms']:.2f}" if ratio else "-")
        cells.append(", ".join(f"{seconds:.1f}" for seconds in run["compile_s_each"].values()))
        rows.append([*cells, f"{run['peak_rss_mb']:.0f}"])
    header = ["wall, CPU", "forward, ms", "/ yardstick", "forward+backward, ms", "/ yardstick"]
    return markdown_table([*header, "compile each, s", "peak memory, MiB"], rows)


def errors(runs: Sequence[dict[str, Any]]) -> str:
    """Errors of images and gradients; empty where no run had a reference."""
    rows = []
    for run in runs:
        if run["psnr"] is None:
            continue
        cells = [f"{name_of(run)}, {run['dtype']}", f"{run['psnr']:.1f}", f"{run['max_abs_error']:.1e}"]
        cells.append(f"{run['fraction_above_2e-4']:.4%}")
        for measure, worst, form in (("relative_l2", max, ".1e"), ("cosine", min, ".8f"), ("signed_bias", max, ".0e")):
            values = [abs(value) for value in run[f"gradient_{measure}"].values() if value is not None]
            cells.append(format(worst(values), form) if values else "-")
        rows.append(cells)
    header = ["error to float64", "PSNR, dB", "largest", "pixels off by > 2e-4"]
    return markdown_table([*header, "gradients: relative L2", "cosine", "signed bias"], rows) if rows else ""


if __name__ == "__main__":
    main()
