"""Draw the curve of a training run from its log.

    python experiments/training/plot.py runs/small/log.jsonl [more logs, in order] --out docs/images/training.png

Several logs are runs that continue each other: their steps are added up. Needs matplotlib (the `notebooks` extra).
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

SMOOTHING = 20
"""Log lines that a point of the smooth curves averages, at most a quarter of all."""


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The records of a log.jsonl."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def steps_of(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records of training steps: no events, no validations."""
    return [line for line in lines if "loss" in line and "event" not in line]


def validations_of(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The records of validations."""
    return [line for line in lines if "val_psnr" in line]


def joined(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The records of runs that continue each other, as if of one."""
    lines: list[dict[str, Any]] = []
    for path in paths:
        offset = max((line["step"] for line in lines), default=0)
        lines += [line | {"step": line["step"] + offset} for line in read_lines(path)]
    return lines


def draw_curve(lines: Sequence[dict[str, Any]], out: Path) -> None:
    """Loss, and PSNR of training views and of validation people, over the steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    trained = [line for line in steps_of(lines) if line["loss"] is not None]
    steps = [line["step"] for line in trained]
    count = max(1, min(SMOOTHING, len(trained) // 4))
    for axis, name, color in ((left, "loss", "C0"), (right, "psnr", "0.6")):
        if all(name in line for line in trained):
            values = np.asarray([line[name] for line in trained], float)
            smooth = np.convolve(values, np.ones(count) / count, "valid")
            axis.plot(steps, values, ".", ms=2, color="0.8")
            axis.plot(steps[count - 1 :], smooth, color=color, label="training views")
    left.set(xlabel="step", ylabel="training loss", yscale="log")
    validated = validations_of(lines)
    psnr = [line["val_psnr"] for line in validated]
    right.plot([line["step"] for line in validated], psnr, "o-", ms=4, color="C1", label="validation people")
    right.set(xlabel="step", ylabel="PSNR, dB")
    right.legend(loc="lower right")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)
    plt.close(figure)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path, help="log.jsonl of a run")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    arguments = parser.parse_args()
    lines = joined(arguments.logs)
    draw_curve(lines, arguments.out)
    print(f"{arguments.out}: {len(steps_of(lines))} points, {len(validations_of(lines))} validations")


if __name__ == "__main__":
    main()
