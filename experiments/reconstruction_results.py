"""Tables of docs/performance_reconstruction.md from what the benchmarks wrote.

    python experiments/reconstruction_results.py --results DIR --page docs/performance_reconstruction.md

DIR holds any of benchmark.json (`benchmark_reconstruction.py --memory 1 4 8 16`), savings.json
(`reconstruction_savings.py`), attention.json (`benchmark_attention.py`), scaling.json (`reconstruction_scaling.py`) and
compilation.json (`transformer_compilation.py`). Sections of the page whose file is there are rewritten, others stay.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import benchmark_attention
import benchmark_reconstruction
import reconstruction_savings
import reconstruction_scaling
import transformer_compilation
from report_tables import write_section

TABLES: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "benchmark": ("benchmark.json", benchmark_reconstruction.table),
    "memory": ("benchmark.json", benchmark_reconstruction.memory_table),
    "savings": ("savings.json", reconstruction_savings.table),
    "scaling": ("scaling.json", reconstruction_scaling.table),
    "attention": ("attention.json", benchmark_attention.table),
    "compilation": ("compilation.json", transformer_compilation.table),
}
"""Section of the page: its file, and what makes its table."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, help="folder of the benchmarks' JSON files")
    parser.add_argument("--page", type=Path, default=Path("docs/performance_reconstruction.md"))
    arguments = parser.parse_args()
    for section, (name, table) in TABLES.items():
        path = arguments.results / name
        if path.exists():
            write_section(arguments.page, section, table(json.loads(path.read_text())))
            print(f"{arguments.page}: {section}")


if __name__ == "__main__":
    main()
