"""Tables of docs/performance_reconstruction.md from what the benchmarks wrote.

    python experiments/reconstruction/results.py --results DIR --page docs/performance_reconstruction.md

DIR holds any of benchmark.json (`reconstruction/benchmark.py --memory 1 4 8 16`), savings.json
(`reconstruction/savings.py`), attention.json (`reconstruction/attention.py`), scaling.json (`reconstruction/scaling.py`) and
compilation.json (`reconstruction/compilation.py`). Sections of the page whose file is there are rewritten, others stay.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
import experiments.reconstruction.attention as benchmark_attention
import experiments.reconstruction.benchmark as benchmark_reconstruction
import experiments.reconstruction.compilation as transformer_compilation
import experiments.reconstruction.savings as reconstruction_savings
import experiments.reconstruction.scaling as reconstruction_scaling
from experiments.common.results import write_section

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
