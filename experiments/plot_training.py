"""Draw the curve of a training run from its log.

    python experiments/plot_training.py runs/small/log.jsonl [more logs, in order] --out docs/images/training.png

Several logs are runs that continue each other: their steps are added up. Needs matplotlib (the `notebooks` extra).
"""

import argparse
import json
from pathlib import Path

SMOOTHING = 20
"""Log lines that a point of the training curve averages."""


def read_log(path: Path, offset: int) -> tuple[list, list, int]:
    """(step, loss) of the training lines, (step, dB) of the validations, and the last step."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    losses = [(offset + x["step"], x["loss"]) for x in lines if "loss" in x]
    decibels = [(offset + x["step"], x["val_psnr"]) for x in lines if "val_psnr" in x]
    return losses, decibels, offset + max(x["step"] for x in lines)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path, help="log.jsonl of a run")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    arguments = parser.parse_args()

    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    losses, decibels, offset = [], [], 0
    for path in arguments.logs:
        more_losses, more_decibels, offset = read_log(path, offset)
        losses += more_losses
        decibels += more_decibels
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2))
    steps, values = np.asarray(losses).T
    smooth = np.convolve(values, np.ones(SMOOTHING) / SMOOTHING, "valid")
    left.plot(steps, values, ".", ms=2, color="0.8")
    left.plot(steps[SMOOTHING - 1 :], smooth, color="C0")
    left.set(xlabel="step", ylabel="training loss", yscale="log")
    right.plot(*np.asarray(decibels).T, "o-", color="C1")
    right.set(xlabel="step", ylabel="PSNR of validation people, dB")
    for axis in (left, right):
        axis.grid(alpha=0.3)
    figure.tight_layout()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=110)
    print(f"{arguments.out}: {len(losses)} points, {len(decibels)} validations")


if __name__ == "__main__":
    main()
