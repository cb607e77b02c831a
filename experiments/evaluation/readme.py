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
    for name, text in tables.items():
        print(text)
        publish(REPOSITORY / "README.md", name, text)


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
    dashes = {"baseline_psnr": None, "baseline_psnr_fg": None}
    rows = {
        f"the shipped person, {demo['image_size'][0]} px ({demo['views']['held_out']} views)": demo,
        "the same, refined as `humangs demo` does (15 s)": demo["refined"] | dashes,
        f"{count} people of the test seeds, {SIZE} px, other cameras": people["by_views"][VIEWS]["novel"],
        f"these {count}, in poses that no photo shows": people["by_views"][VIEWS]["animation"],
    }
    for name, lengths in refined["means"].items():
        size = name.split()[0]
        for seconds in lengths:
            if (size, seconds) != (SIZE, "0"):
                how = f"{size} px" if seconds == "0" else f"{size} px, refined for {seconds} s"
                rows[f"these {count}, {how}, other cameras"] = lengths[seconds]["novel"] | dashes
                rows[f"{how}, in poses that no photo shows"] = lengths[seconds]["animation"] | dashes
    columns = {"psnr": 1, "ssim": 3, "psnr_fg": 1, "baseline_psnr": 1, "baseline_psnr_fg": 1}
    cells = lambda scores: ["" if scores[key] is None else f"{scores[key]:.{n}f}" for key, n in columns.items()]
    header = ["", "PSNR", "SSIM", "foreground PSNR", "painted body mesh: PSNR", "on the person"]
    return markdown_table(header, [[name, *cells(scores)] for name, scores in rows.items()])


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
