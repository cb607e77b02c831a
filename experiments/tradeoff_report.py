"""The tables, the images and the front of `tradeoff`."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from experiments.harness import Run, figure, means
from experiments.results import REPOSITORY, markdown_table, significant, write_json

FRONT = REPOSITORY / "humangs_jax" / "assets" / "front.json"
SIZE = 512
"""Side of the frames that points are compared at."""
EQUAL = 1.05
"""Times of points that differ by less are taken for equal: they are measured beside other programs."""
TASKS = {"novel": "same pose", "animation": "unseen poses"}
SCORES = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 3), "psnr_fg": ("on the person", 2)}
NAIVE = ("painted body", "random colors")
KINDS = {"feed-forward": "#1f6f8b", "refined": "#c0392b", "naive": "#7f8c8d"}
Row = dict[str, Any]


def show(run: Run, result: dict[str, Any], image: Path | None, front: bool) -> None:
    """All tables, and what is asked for."""
    result = result | {"points": {name: found for name, found in result["points"].items() if "reconstruct" in found}}
    rows = rows_of(result)
    if front:
        write_json(FRONT, front_file(rows, result))
    run.show(point_table(rows, result), kept(result), "tradeoff")
    run.show(preset_table(rows, result), table="tradeoff_presets")
    run.show(naive_table(rows), table="tradeoff_naive")
    run.show(growth_table(rows, result), table="tradeoff_growth")
    if image:
        for key, name in (("reconstruct", "reconstruction"), ("frame", "frames")):
            draw(rows, key, image.with_name(f"{image.name}_{name}.png"))


def kept(result: dict[str, Any]) -> dict[str, Any]:
    """With means in place of the rows of people, and of presets the PSNR of the first person, which `presets` compares."""
    points = {}
    for name, found in result["points"].items():
        people = found.get("people") or []
        points[name] = {key: value for key, value in found.items() if key != "people"}
        points[name] |= {"people": len(people)} | (means(people) if people else {})
        if found["what"]["knob"] == "preset" and people:
            points[name]["first_person"] = [people[0][task]["psnr"] for task in TASKS]
    return result | {"points": points}


def rows_of(result: dict[str, Any]) -> list[Row]:
    """A row for each measured point: what it is, times, memory, and means over people by task."""
    rows = []
    for name, found in result["points"].items():
        row = {"name": name.removeprefix("preset "), **found["what"], **found}
        people = found["people"]  # of docs/results: their number, and means
        of_people = (
            {task: found.get(task) for task in TASKS} if isinstance(people, int) else means(people) if people else {}
        )
        row |= {task: of_people.get(task) for task in TASKS}
        rows.append(row)
    return rows


def quality(row: Row) -> float:
    """What points are ranked by, dB: the mean of both tasks."""
    return 0.5 * (row["novel"]["psnr"] + row["animation"]["psnr"])


def kind(row: Row) -> str:
    """Of `KINDS`."""
    if row["start"] in NAIVE:
        return "naive"
    return "refined" if row["settings"]["refine_steps"] or row["settings"]["refine_iterations"] else "feed-forward"


def compared(rows: list[Row]) -> list[Row]:
    """Those with scores, of frames of one size."""
    return [row for row in rows if row["novel"] is not None and row["size"] == SIZE]


def better(row: Row, rows: list[Row], keys: tuple[str, ...] = ("reconstruct", "frame")) -> list[Row]:
    """The points that are better and take no longer."""
    return [r for r in rows if quality(r) > quality(row) and all(r[key] <= EQUAL * row[key] for key in keys)]


def front_of(rows: list[Row], keys: tuple[str, ...] = ("reconstruct", "frame")) -> list[Row]:
    """The points of ours that no other one dominates, cheapest reconstruction first."""
    ours = [row for row in compared(rows) if row["start"] == "network"]
    return sorted((row for row in ours if not better(row, ours, keys)), key=lambda row: row["reconstruct"])


def front_file(rows: list[Row], result: dict[str, Any]) -> dict[str, Any]:
    """What `humangs tune` chooses from: the front, and the presets."""
    chosen = front_of(rows)
    chosen += [row for row in rows if row["knob"] == "preset" and row not in chosen]
    points = [
        {
            "name": row["name"],
            "settings": row["settings"],
            "make": row["reconstruct"] - row["refine_share"],
            "refine": row["refine_share"],
            "frame": row["frame"],
            "memory_mb": row["memory_mb"],
            "psnr": row["novel"]["psnr"],
            "psnr_poses": row["animation"]["psnr"],
        }
        for row in chosen
    ]
    return {"weights": result["settings"]["weights"], "points": points}


# Tables ------------------------------------------------------------------------------------------------------------------


def _count(people):
    return people if isinstance(people, int) else len(people)


def about(result: dict[str, Any]) -> str:
    """Of which weights, people and machine the numbers are."""
    default = result["points"]["default"]
    people, took = _count(default["people"]), f"{default['reconstruct_ms']:.0f} ms a reconstruction"
    return (
        f"Weights with SHA-256 {result['settings']['weights'][:16]}...; {people} of the people kept for this "
        f'(split "tradeoff"). CPU times of all threads are shares of the default point\'s, in turns with it: {took} and '
        f"{default['frame_ms']:.0f} ms a frame of {SIZE} pixels."
    )


def numbers(row: Row) -> list[str]:
    """Times, memory and size."""
    share = lambda key: significant(row[key]) if row.get(key) is not None else ""
    return [share("reconstruct"), share("frame")] + [
        f"{row[key]:,.{digits}f}" if row.get(key) is not None else ""
        for key, digits in (("memory_mb", 0), ("file_mb", 2), ("gaussians", 0))
    ]


def scores(row: Row) -> list[str]:
    """Of both tasks."""
    if row["novel"] is None:
        return [""] * (len(TASKS) * len(SCORES))
    return [f"{row[task][key]:.{digits}f}" for task in TASKS for key, (_, digits) in SCORES.items()]


MEASURES = ["reconstruction", "frame", "MiB", "file, MiB", "Gaussians"]
HEADINGS = [
    f"{name}: {heading}" if i == 0 else heading
    for name in TASKS.values()
    for i, (heading, _) in enumerate(SCORES.values())
]


def point_table(rows: list[Row], result: dict[str, Any]) -> str:
    """All points; those of the front are bold."""
    front = {row["name"] for row in front_of(rows)}
    named = lambda row: f"**{row['name']}**" if row["name"] in front else row["name"]
    table = [[row["knob"], named(row), *numbers(row), *scores(row)] for row in rows]
    text = f"{about(result)} {len(rows)} points; bold: no other point is better and as fast in both."
    header = ["knob", "point", *MEASURES, *HEADINGS]
    return f"{text}\n\n{markdown_table(header, table, 'll' + 'r' * (len(header) - 2))}"


def preset_table(rows: list[Row], result: dict[str, Any]) -> str:
    """The presets, whether they are on the front, and what they give up."""
    presets = [row for row in rows if row["knob"] == "preset"]
    if not presets:
        return "no preset has been measured"
    front, best = {row["name"] for row in front_of(rows)}, max(presets, key=quality)
    lost = lambda row: [f"{best[task]['psnr'] - row[task]['psnr']:.2f}" for task in TASKS]
    table = [
        [row["name"], *numbers(row), *scores(row), *lost(row), "yes" if row["name"] in front else "no"]
        for row in presets
    ]
    header = ["preset", *MEASURES, *HEADINGS, "below best: same pose", "unseen poses", "on the front"]
    return f"{about(result)}\n\n{markdown_table(header, table)}"


def naive_table(rows: list[Row]) -> str:
    """For each naive point the fastest of ours that dominates it."""
    ours = [row for row in compared(rows) if row["start"] == "network"]
    table = []
    for row in compared(rows):
        if kind(row) != "naive":
            continue
        above = better(row, ours)
        found = min(above, key=lambda r: r["reconstruct"] + r["frame"]) if above else None
        gain = "" if found is None else f"{quality(found) - quality(row):.2f}"
        times = [significant(row[key]) for key in ("reconstruct", "frame")]
        theirs = ["", ""] if found is None else [significant(found[key]) for key in ("reconstruct", "frame")]
        table.append([row["name"], *times, f"{quality(row):.2f}", found["name"] if found else "none", *theirs, gain])
    header = [
        "naive point",
        "reconstruction",
        "frame",
        "PSNR, both",
        "better and as fast",
        "reconstruction",
        "frame",
        "gain, dB",
    ]
    ours_front = front_of(rows)
    refined = sum(kind(row) == "refined" for row in ours_front)
    text = f"{len(ours_front)} of {len(ours)} points are on the front, {refined} of them refined."
    return f"{text} PSNR, both: the mean of both tasks.\n\n{markdown_table(header, table, 'lrrrlrrr')}"


def growth_table(rows: list[Row], result: dict[str, Any]) -> str:
    """Slopes of log time over log size, of the one-knob points with the default."""
    default = next(row for row in rows if row["name"] == "default")
    of = lambda *knobs: [row for row in rows if row["knob"] in knobs and row["start"] == "network"]
    options = lambda row: row["settings"]["runtime"]
    trained = 256
    series = {
        "photos": [(r["settings"]["views"], r["reconstruct"]) for r in [default, *of("photos")]],
        "pixels of a photo": [
            ((options(r)["image_size"] or trained) ** 2, r["reconstruct"]) for r in [default, *of("photo size")]
        ],
        "people in a batch": [(int(n), share) for n, share in result["growth"].get("batch", {}).items()],
        "Gaussians, of a frame": [
            (r["gaussians"], r["frame"]) for r in [default, *of("Gaussians")] if not r["settings"]["prune"]
        ],
        "pixels of a frame": [(r["size"] ** 2, r["frame"]) for r in [default, *of("frame size")]],
        "steps of refinement": [
            (r["settings"]["refine_steps"], r["refine_share"])
            for r in of("refinement")
            if r["settings"]["refine_size"] == trained and not r["settings"]["refine_iterations"]
        ],
        "background pixels of a frame": [(int(n) ** 2, share) for n, share in result["growth"].get("box", {}).items()],
    }
    table = []
    for name, pairs in series.items():
        if len(pairs) < 2:
            continue
        pairs = sorted(pairs)
        sizes, times = zip(*pairs, strict=True)
        slope = np.polyfit(np.log(sizes), np.log(times), 1)[0]
        table.append([name, ", ".join(f"{n:,}" for n in sizes), ", ".join(map(significant, times)), f"{slope:.2f}"])
    text = "Slope 1: in proportion. Background: a person of 256 pixels in larger and larger frames: only what is empty grows."
    return f"{text}\n\n{markdown_table(['growth with', 'sizes', 'time', 'slope'], table, 'lllr')}"


# Images ------------------------------------------------------------------------------------------------------------------


def draw(rows: list[Row], key: str, path: Path) -> None:
    """PSNR of both tasks against a time, with the front."""
    points = compared(rows)
    with figure(path, 2, (10, 4.4)) as axes:
        for axis, (task, title) in zip(axes, TASKS.items(), strict=True):
            for name, color in KINDS.items():
                chosen = [row for row in points if kind(row) == name]
                x, y = [row[key] for row in chosen], [row[task]["psnr"] for row in chosen]
                axis.scatter(x, y, s=18, color=color, marker="x" if name == "naive" else "o", label=name)
            steps = staircase([(row[key], row[task]["psnr"]) for row in points if row["start"] == "network"])
            axis.step(*zip(*steps, strict=True), where="post", color="k", lw=0.8, label="front")
            for row in (row for row in points if row["knob"] == "preset" or row["name"] == "default"):
                at = row[key], row[task]["psnr"]
                axis.annotate(row["name"], at, fontsize=7, xytext=(3, 3), textcoords="offset points")
            label = f"{'reconstruction' if key == 'reconstruct' else 'frame'} time / default"
            axis.set(xscale="log", title=title, ylabel="PSNR, dB", xlabel=label)
        axes[0].legend(fontsize=7)


def staircase(pairs: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that are better than all that are cheaper."""
    steps, highest = [], -math.inf
    for x, y in sorted(pairs):
        if y > highest:
            steps.append((x, y))
            highest = y
    return steps
