"""Ranges of use: how far a quantity may be off, alone, until the mean PSNR of some people has fallen by `BOUND`.

    python experiments/check_limits.py [--people 2] [--table docs/stability.md]

People of the validation seeds, four photos of 256 pixels; linear between the values tried. Writes humangs_jax/assets/limits.json
for `humangs check --limits`.
"""

import argparse
import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np

from experiments.common.results import markdown_table, publish, write_json
from experiments.evaluation.changes import (
    VIEWS,
    Change,
    cameras,
    far,
    focal,
    grown,
    moved_by,
    noise,
    outcome,
    person_of,
    photographed,
    photos,
    poses,
    subjects,
    turned_by,
)

ASSETS = Path(__file__).parents[1] / "humangs_jax" / "assets"
BOUND = 1.0
"""Decibels of PSNR."""
RENDERED = "distance of the cameras"
"""The quantity with new photos from the cameras as they are changed."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=2, help="how many")
    parser.add_argument("--table", type=Path, help="page whose table is written")
    arguments = parser.parse_args()
    results = measure(arguments.people)
    write_json(ASSETS / "limits.json", {"bound": BOUND, "ranges": results["ranges"]})
    text = section(results)
    print(text)
    if arguments.table:
        publish(arguments.table, "limits", text, results)


LIMITS: dict[str, tuple[str, float | None, dict[float, Change]]] = {
    "photos": ("", 4, {n: lambda c, n=n: c.select(list(range(0, VIEWS, VIEWS // n))) for n in (1, 2)}),
    "noise": (
        "standard deviation",
        0,
        {x: photos(lambda image, x=x: image + x * noise(4, image.shape)) for x in (0.05, 0.1, 0.2, 0.4)},
    ),
    "distance of the cameras": ("m", None, {x: far(x) for x in (1.2, 1.6, 2.0, 2.5, 3.0, 4.0, 6.0, 10.0, 30.0)}),
    "height of the person": ("pixels of 256", None, {x: person_of(x) for x in (25, 50, 75, 100, 130, 160, 190)}),
    "masks too large or small": ("pixels of 256", 0, {x: grown(x) for x in (-6, -3, -1, 1, 3, 6)}),
    "focal length": ("%", 0, {x: cameras(focal(1 + x / 100)) for x in (-10, -5, -2, 2, 5, 10)}),
    "cameras turned": ("degrees", 0, {x: turned_by(x) for x in (0.25, 0.5, 1, 2, 4)}),
    "joints turned": (
        "degrees",
        0,
        {x: poses(lambda r, x=x: r + np.radians(x) / 3**0.5 * noise(5, r.shape)) for x in (1, 2, 4, 8, 16)},
    ),
    "body moved": ("cm", 0, {x: moved_by(x) for x in (0.5, 1, 2, 4, 8)}),
    "shape coefficients": (
        "standard deviations",
        0,
        {
            x: lambda c, x=x: dataclasses.replace(
                c, betas=np.asarray(c.betas) + np.float32(x * noise(6, c.betas.shape))
            )
            for x in (0.25, 0.5, 1, 2)
        },
    ),
}
"""{quantity: (unit, the value at which nothing is changed, {value: change})}. None: it is somewhere among the values."""


def measure(people: int) -> dict[str, Any]:
    """{"losses": {quantity: {value: dB}}, "ranges": {quantity: {"unit", "low", "high"}}}."""
    from tqdm import tqdm

    from humangs_jax.network.weights import load_weights

    network, chosen = load_weights(), subjects(people)

    def score(name, change):
        scores = []
        for subject in chosen:
            capture = change(subject.inputs(VIEWS))
            capture = photographed(subject.seed, capture) if name == RENDERED else capture
            scores.append(outcome(network, capture, subject.held_out)["psnr"])
        return np.mean(scores)

    plain = score("", lambda capture: capture)
    losses = {
        name: {value: float(plain - score(name, change)) for value, change in tqdm(changes.items(), desc=name)}
        for name, (_, _, changes) in LIMITS.items()
    }
    return {"losses": losses, "ranges": {name: interval(name, losses[name]) for name in LIMITS}}


def interval(name: str, losses: dict[float, float]) -> dict[str, Any]:
    """The range around the best value in which the loss stays below `BOUND`; None for an end that was not reached."""
    unit, zero, _ = LIMITS[name]
    points = sorted((losses | ({} if zero is None else {zero: 0.0})).items())
    middle = min(range(len(points)), key=lambda i: points[i][1])

    def end(step):
        i = middle
        while 0 <= i + step < len(points):
            (x, loss), (y, more) = points[i], points[i + step]
            if more > BOUND:
                return x + (y - x) * (BOUND - loss) / (more - loss)
            i += step
        return None

    low, high = end(-1), end(1)
    low = 0.0 if low is None and points[0][0] == 0 else low  # errors that have no sign
    if name == "photos" and low is not None:
        low = math.ceil(low)
    return {"unit": unit, "low": low, "high": high}


def section(results: dict[str, Any]) -> str:
    """The table: ranges, and the losses behind them."""
    rows = []
    for name, losses in results["losses"].items():
        row = results["ranges"][name]
        ends = ["-" if row[end] is None else f"{row[end]:.3g}" for end in ("low", "high")]
        tried = ", ".join(f"{value:g}: {loss:.1f}" for value, loss in sorted(losses.items()))
        rows.append([f"{name}, {row['unit']}".rstrip(", "), *ends, tried])
    return markdown_table(["quantity", "from", "to", "dB lost at each value tried"], rows, "lrrl")


if __name__ == "__main__":
    main()
