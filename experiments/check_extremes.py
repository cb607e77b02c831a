"""What `reconstruct` makes of inputs at the extremes: an error, a warning or an avatar, and how good that is.

    python experiments/check_extremes.py --json docs/results/extremes.json [--table docs/stability.md] [--cases black inverted]

One person of the validation seeds, four photos of 256 pixels; each case changes one thing. "warned": the quick check, which
`humangs reconstruct` runs first, says something. "reach": largest distance of a Gaussian from its vertex, in body heights; all
numbers have to be finite. PSNR: held-out views of the same pose, by the true cameras and pose. "error": the avatar cannot be made
or not be drawn, with a line that names the array. --cases with --table: the other rows of the table stay.
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))
import numpy as np

from experiments.common.results import markdown_table, publish, write_json
from experiments.evaluation import changes
from experiments.evaluation.changes import (
    VIEWS,
    Change,
    at_the_pelvis,
    betas,
    cameras,
    far,
    focal,
    masks,
    photos,
    poses,
    random_turns,
    spoilt,
    tall,
    turned,
    without_weights,
    zoom,
)

TABLE = "extremes"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", help="words; only cases whose names have one of them")
    parser.add_argument("--json", type=Path, help="the numbers are written here")
    parser.add_argument("--table", type=Path, help="page whose table is written")
    arguments = parser.parse_args()
    results = measure(arguments.cases)
    if arguments.cases and arguments.table:
        known = json.loads((arguments.table.parent / "results" / f"{TABLE}.json").read_text())["numbers"] | results
        results = {name: known[name] for name in CASES if name in known}
    if arguments.json:
        write_json(arguments.json, results)
    text = section(results)
    print(text)
    if arguments.table:
        publish(arguments.table, TABLE, text, results)


@dataclasses.dataclass(frozen=True)
class Case:
    """photos, held_out: changes of the captures that the avatar is made of and compared with. photographed: the person is
    photographed anew, by the changed cameras. network: (variables, configuration) -> others.
    """

    photos: Change = lambda capture: capture
    held_out: Change = lambda capture: capture
    photographed: bool = False
    network: Callable[[Any, Any], tuple[Any, Any]] = lambda variables, config: (variables, config)


def measure(words: list[str] | None = None) -> dict[str, Any]:
    """{case: `changes.outcome`}. Raises: AssertionError: a number is not finite."""
    from tqdm import tqdm

    from humangs_jax.network.weights import load_weights

    (subject,), network, results = changes.subjects(1), load_weights(), {}
    chosen = {name: case for name, case in CASES.items() if not words or any(word in name for word in words)}
    for name, case in tqdm(chosen.items(), desc="cases"):
        capture = case.photos(subject.inputs(VIEWS))
        capture = changes.photographed(subject.seed, capture) if case.photographed else capture
        results[name] = changes.outcome(case.network(*network), capture, case.held_out(subject.held_out))
    return results


def section(results: dict[str, Any]) -> str:
    """The table."""
    rows = []
    for name, row in results.items():
        if "error" in row:
            rows.append([name, "error", "", "", "", row["error"]])
            continue
        numbers = [f"{row['reach']:.2f}", f"{row['psnr']:.1f}", f"{row['psnr_fg']:.1f}"]
        rows.append([name, "warned" if row["warnings"] else "avatar", *numbers, (row["warnings"] or [""])[0]])
    return markdown_table(["case", "result", "reach", "PSNR", "on the person", "first line"], rows, "llrrrl")


# Changes of the network -------------------------------------------------------------------------------------------------


def weights(change: Callable[[Any], Any]) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Other variables."""
    return lambda variables, config: (change(variables), config)


def computed(dtype: str) -> Callable[[Any, Any], tuple[Any, Any]]:
    """Another type of number for the encoder's products."""
    return lambda variables, config: (variables, config.with_runtime(dtype=dtype))


def in_type(dtype: str) -> Callable[[Any], Any]:
    """All variables in another type of number."""

    def change(variables):
        import jax

        return jax.tree.map(lambda x: x.astype(dtype), variables)

    return change


def nan_in(variables: Any) -> Any:
    """NaN in one entry of the first array."""
    import jax

    leaves, structure = jax.tree.flatten(variables)
    leaves[0] = np.array(leaves[0])
    leaves[0].reshape(-1)[0] = np.nan
    return jax.tree.unflatten(structure, leaves)


NOISE = np.random.default_rng(0)
CASES: dict[str, Case] = {
    "as it is": Case(),
    "4 stops over": Case(photos(lambda x: 16 * x)),
    "4 stops under": Case(photos(lambda x: x / 16)),
    "black": Case(photos(np.zeros_like)),
    "white": Case(photos(np.ones_like)),
    "noise": Case(photos(lambda x: NOISE.random(x.shape).astype(np.float32))),
    "focal length x 2": Case(cameras(focal(2.0))),
    "focal length / 2": Case(cameras(focal(0.5))),
    "focal length x 10": Case(cameras(focal(10.0))),
    "focal length / 10": Case(cameras(focal(0.1))),
    "cameras inside the body": Case(at_the_pelvis),
    "cameras at 100 m": Case(far(100.0), photographed=True),
    "cameras look away": Case(cameras(matrix=turned)),
    "person of 1 pixel": Case(zoom(1 / 150)),
    "person of a twentieth of the frame": Case(zoom(0.06)),
    "person cut at the frame": Case(zoom(3.0)),
    "4 m tall": Case(tall(2.3), held_out=tall(2.3)),
    "0.4 m tall": Case(tall(0.23), held_out=tall(0.23)),
    "poses past joint limits": Case(poses(lambda x: 3 * x)),
    "every joint at random": Case(poses(random_turns)),
    "masks empty": Case(masks(np.zeros_like)),
    "masks full": Case(masks(np.ones_like)),
    "masks inverted": Case(masks(lambda x: 1 - x)),
    "no masks": Case(lambda capture: dataclasses.replace(capture, masks=None)),
    "1 view": Case(lambda capture: capture.select([0])),
    "32 views": Case(lambda capture: capture.select(list(range(VIEWS)) * 8)),
    "one view four times": Case(lambda capture: capture.select([0] * VIEWS)),
    "skinning weights of 0": Case(without_weights),
    "betas 0": Case(betas(0.0)),
    "betas 100": Case(betas(100.0)),
    "NaN in images": Case(spoilt("images")),
    "NaN in masks": Case(spoilt("masks")),
    "NaN in betas": Case(spoilt("betas")),
    "NaN in K": Case(spoilt("cameras.K")),
    "NaN in cam_from_world": Case(spoilt("cameras.cam_from_world")),
    "NaN in rotations": Case(spoilt("poses.rotations")),
    "NaN in translation": Case(spoilt("poses.translation")),
    "NaN in the template of the body": Case(spoilt("body.template")),
    "NaN in the shape directions": Case(spoilt("body.shape_directions")),
    "NaN in the joint regressor": Case(spoilt("body.joint_regressor")),
    "NaN in the skinning weights": Case(spoilt("body.skinning_weights")),
    "infinity in betas": Case(spoilt("betas", np.inf)),
    "NaN in the weights": Case(network=weights(nan_in)),
    "NaN in a pose to be drawn": Case(held_out=spoilt("poses.rotations")),
    "NaN in a camera that draws": Case(held_out=spoilt("cameras.K")),
    "weights in bfloat16": Case(network=weights(in_type("bfloat16"))),
    "weights in float16": Case(network=weights(in_type("float16"))),
    "float16 compute": Case(network=computed("float16")),
    "bfloat16 compute": Case(network=computed("bfloat16")),
}

if __name__ == "__main__":
    main()
