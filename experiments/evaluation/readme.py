"""README's tables of quality and of the demo's times, from two runs of the demo and from tables of the docs.

HUMANGS_COMPILE_CACHE=0 humangs demo --refine 0 --out a && humangs demo --out b
python experiments/evaluation/readme.py --timed a/report.json --refined b/report.json

The scores of the test people are those of docs/results/evaluation_views.json and refinement_32.json. Times are those of an idle
machine, from an empty compile cache.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import REPOSITORY, markdown_table, publish, significant

VIEWS, SIZE = "4", "256"
"""Photos, and their side in pixels in evaluation_views.json."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--timed", type=Path, help="report of the unrefined demo, nothing compiled before; without it times stay"
    )
    parser.add_argument("--refined", type=Path, required=True, help="report of the refined demo")
    arguments = parser.parse_args()
    refined = json.loads(arguments.refined.read_text())
    results = (REPOSITORY / "docs" / "results" / f"{name}.json" for name in ("evaluation_views", "refinement_32"))
    people = [json.loads(path.read_text())["numbers"] for path in results]
    tables = {"readme_quality": quality(refined, *people)}
    if arguments.timed:
        tables["readme_demo"] = times(json.loads(arguments.timed.read_text()))
    pages = {"readme_quality": REPOSITORY / "README.md", "readme_demo": REPOSITORY / "docs" / "performance.md"}
    for name, text in tables.items():
        print(text)
        publish(pages[name], name, text)


def quality(demo: dict[str, Any], people: dict[str, Any], refined: dict[str, Any]) -> str:
    """The demo person and the test people.

    Raises: ValueError if the demo was not refined, or the people or the weights of the two tables are not the same.
    """
    if "refined" not in demo:
        raise ValueError(
            "the report of the refined demo has no refined scores: expected `humangs demo` without --refine 0"
        )
    count = people["people"]
    if refined["people"] != count:
        raise ValueError(f"{refined['people']} people were refined: expected the same {count}")
    if people["settings"]["weights"] != refined["settings"]["weights"]:
        raise ValueError("evaluation_views and refinement_32 are of different weights: measure them again")
    by_size = {name.split()[0]: lengths for name, lengths in refined["means"].items()}
    rows = {
        f"{count} synthetic people, {SIZE} px, feed-forward": people["by_views"][VIEWS]["novel"],
        "the same, refined for 1 s": by_size[SIZE]["1"]["novel"],
        "512 px, refined for 1 s": by_size["512"]["1"]["novel"],
        "512 px, refined for 1 s, in poses that no photo shows": by_size["512"]["1"]["animation"],
        f"the demo's person, {demo['image_size'][0]} px, refined for 15 s": demo["refined"],
        f"baseline: the painted body mesh, {SIZE} px": {
            name: people["by_views"][VIEWS]["novel"].get(f"baseline_{name}") for name in ("psnr", "ssim", "psnr_fg")
        },
    }
    columns = {"psnr": 1, "ssim": 3, "psnr_fg": 1}
    cells = lambda scores: ["" if scores[key] is None else f"{scores[key]:.{n}f}" for key, n in columns.items()]
    return markdown_table(
        ["", "PSNR", "SSIM", "foreground PSNR"], [[name, *cells(scores)] for name, scores in rows.items()]
    )


def times(demo: dict[str, Any]) -> str:
    """Times of the demo's stages."""
    spent, views = demo["timings"], demo["views"]
    stages = {
        f"reconstruct: {views['input']} photos of {demo['image_size'][0]} px -> {demo['gaussians']:,} Gaussians": "reconstruct",
        "animate: one pose": "animate",
        f"render {views['held_out']} views": "render_held_out",
    }
    rows = [
        [name, f"{spent[stage]['compile']:.1f} s", f"{significant(1000 * spent[stage]['run'])} ms"]
        for name, stage in stages.items()
    ]
    whole = ["everything, files included, without refinement (`--refine 0`)", "", f"{demo['total_seconds']:.0f} s"]
    return markdown_table(["stage", "compile", "run"], [*rows, whole], "lll")


if __name__ == "__main__":
    main()
