"""The extremes of splatting: is everything finite, and how far is float32 from float64?

    python experiments/splatting/numerics.py [--json OUT] [--page docs/numerics.md] [--only WORD]

Every case of `splatting/numerics_cases.py` is rendered, with the gradients of a random loss with respect to everything, by the
tiled renderer in float32 and by the reference in float64 from the same numbers; and by the tiled renderer in float64, which shows
that only rounding remains. Prints a table of errors; --json writes the bounds, depth and float64 too. Exit status 1 if a number
is not finite, a bound is exceeded, or something is visible that should not be. Three minutes on two cores, nearly all of it
compilation.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs

if TYPE_CHECKING:
    from experiments.splatting.numerics_cases import Case, Outcome

    Row = tuple[Case, Outcome, Outcome]

HEADER = ("case", "image error", "gradient error", "of")


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_outputs(parser, "splatting_numerics")
    parser.add_argument("--only", default="", help="only cases whose name contains this")
    arguments = parser.parse_args()

    from experiments.splatting.numerics_cases import CASES, measure

    rows = []
    for name, case in CASES.items():
        if arguments.only in name:
            rows.append((case, measure(case), measure(case, in_float64=True)))
            print(f"{'ok' if passes(rows[-1]) else 'FAILED':7}{name}", flush=True)
    write_outputs(arguments, "splatting_numerics", table(rows), [as_json(row) for row in rows])
    return 0 if rows and all(map(passes, rows)) else 1


def passes(row: "Row") -> bool:
    """Whether float32 keeps the case's bounds, and float64 that of rounding."""
    from experiments.splatting.numerics_cases import FLOAT64

    case, single, double = row
    return single.passes(case) and max(double.image, double.gradient) <= FLOAT64


def table(rows: Sequence["Row"]) -> str:
    """One line per case: the float32 errors, and a mark where a bound is exceeded or a number is not finite."""
    number = lambda x: "0" if x == 0 else f"{x:.0e}"
    lines = []
    for case, single, double in rows:
        name = f"{case.group}: {case.name}" + ("" if passes((case, single, double)) else " **FAILED**")
        lines.append([name, number(single.image), number(single.gradient), single.worst])
    return markdown_table(HEADER, lines)


def as_json(row: "Row") -> dict[str, object]:
    """The numbers of one case."""
    case, single, double = row
    return {
        "case": f"{case.group}: {case.name}",
        "image_bound": case.image,
        "gradient_bound": case.gradient,
        "float32": dataclasses.asdict(single),
        "float64": dataclasses.asdict(double),
        "passes": passes(row),
    }


if __name__ == "__main__":
    sys.exit(main())
