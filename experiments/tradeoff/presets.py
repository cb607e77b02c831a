"""Whether the presets still take and gain what docs/tradeoff.md says, in one run on this machine.

    python experiments/tradeoff/presets.py [--results docs/results/tradeoff.json] [--people FOLDER]

Times as shares of the default point's, in turns with it, have to be within 20 % of those of the sweep, and the PSNR of the first
person within 0.3 dB. Exit status 1 if one is not. 10 minutes on one core.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import REPOSITORY, markdown_table
from experiments.timing import prepare_process

CLOSE, DECIBELS = 0.2, 0.3


def main() -> int:
    """Command line; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=REPOSITORY / "docs/results/tradeoff.json", help="of the sweep")
    parser.add_argument("--people", type=Path, help="folder where rendered people are kept")
    arguments = parser.parse_args()
    prepare_process()
    from experiments.tradeoff.points import points
    from experiments.tradeoff.sweep import Bench, settings_of

    claimed = json.loads(arguments.results.read_text())["numbers"]
    if claimed["settings"] != settings_of():
        print("the sweep was made with other weights or people: run sweep.py again")
        return 1
    bench, table, faults = Bench(1, arguments.people, iterations=3), [], 0
    for point in points():
        if point.knob == "preset":
            row = {"people": []}
            bench.measure(point, 0, row)
            said = claimed["points"][point.name]
            pairs = [
                (key, row[key], said[key], abs(row[key] / said[key] - 1) <= CLOSE) for key in ("reconstruct", "frame")
            ]
            found, told = ([each["people"][0][task]["psnr"] for task in ("novel", "animation")] for each in (row, said))
            names = ("PSNR, same pose", "PSNR, unseen poses")
            pairs += [(n, a, b, abs(a - b) <= DECIBELS) for n, a, b in zip(names, found, told, strict=True)]
            table += [[point.name, n, f"{a:.2f}", f"{b:.2f}", "yes" if ok else "NO"] for n, a, b, ok in pairs]
            faults += sum(not ok for *_, ok in pairs)
    print(markdown_table(["preset", "claim", "now", "sweep", "holds"], table, "llrrl"))
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
