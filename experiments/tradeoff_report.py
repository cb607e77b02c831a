"""Lists the points of the trade of speed against accuracy, and shows their tables and images."""

import dataclasses
from pathlib import Path
from typing import Any

from experiments.harness import Run, figure, means, staircase
from experiments.results import cells, markdown_table, significant
from humangs_jax.apps.settings import PRESETS, Settings
from humangs_jax.network.runtime import Runtime

SIZE = 512
"""Side in pixels of the frames of points that are compared."""


@dataclasses.dataclass(frozen=True)
class Point:
    """A way to make an avatar and draw it."""

    name: str
    """Name in the table."""
    knob: str
    """The knob that differs from the default point."""
    settings: Settings
    """How the avatar is made and drawn."""
    size: int = SIZE
    """Side of the frames in pixels."""
    start: str = "network"
    """What the avatar is made of: "network", or one of `NAIVE` to compare with."""


def point(name: str, knob: str, size: int = SIZE, start: str = "network", **changes: Any) -> Point:
    """Returns a point of 4 photos with changes, which are fields of `Settings` or `Runtime`."""
    fields = {field.name for field in dataclasses.fields(Runtime)}
    runtime = Runtime(**{key: value for key, value in changes.items() if key in fields})
    rest: dict[str, Any] = {"views": 4}
    rest |= {key: value for key, value in changes.items() if key not in fields}
    return Point(name, knob, Settings(runtime=runtime, **rest), size, start)


DEFAULT = point("default", "default")
"""The point of 4 photos of 256 pixels, as the weights were trained, in float32, without refinement,
with exact frames of 512 pixels.
"""


def points() -> list[Point]:
    """Returns all points that are measured."""
    # presets and drawing
    found = [DEFAULT]
    found += [Point(f"preset {name}", "preset", settings) for name, settings in PRESETS.items()]
    found += [point(name, "splat preset", splat=name) for name in ("near_exact", "fast", "inria")]
    found += [point(f"frames of {n}", "frame size", size=n) for n in (128, 256, 1024)]
    found += [
        point("pruned", "Gaussians", prune=True),
        point("vertex-color baseline", "naive", start="vertex-color baseline"),
    ]
    found += [
        point(f"{n} steps", "refinement", refine_steps=n, refine_size=256) for n in (100, 200)
    ]
    for n in (0, 200):
        random: dict[str, Any] = {"refine_steps": n, "refine_size": 256}
        found += [point(f"random colors, {n} steps", "naive", start="random colors", **random)]
    found += [point(f"{n} photos" if n > 1 else "1 photo", "photos", views=n) for n in (1, 2, 3, 6)]
    found += [point(f"photos of {n}", "photo size", image_size=n) for n in (128, 192, 384, 512)]
    found += [point("all tokens", "tokens", tokens="all"), point("cropped", "tokens", crop=True)]
    found += [
        point(f"cropped, photos of {n}", "tokens", crop=True, image_size=n) for n in (192, 384)
    ]
    found += [point(dtype, "precision", dtype=dtype) for dtype in ("bfloat16", "float16")]
    found += [point(f"body of {n}", "Gaussians", body_vertices=n) for n in (1000, 2000, 3000)]
    found += [
        point(f"edges of {edge * 1e3:g} mm", "Gaussians", max_edge_length=edge)
        for edge in (0.024, 0.017)
    ]
    found += [refined(*limits) for limits in ITERATIONS]
    found += [combined(**fields) for fields in COMBINED]
    return found


ITERATIONS = (
    *((n, 0, 256) for n in (1, 2, 3, 4, 6)),
    (4, 100, 256),
    *((4, steps, 512) for steps in (0, 100)),
)
"""Points with refinement: iterations of the learned update, steps of Adam after them, and side of
the photos in pixels.
"""


def refined(iterations: int, steps: int, size: int) -> Point:
    """Returns a point with iterations, steps of Adam and a size of the photos, as in
    `ITERATIONS`.
    """
    name = f"{iterations} iterations" if iterations > 1 else "1 iteration"
    if steps:
        name += f", {steps} steps"
    if size != 256:
        name += f" at {size}"
    return point(
        name, "refinement", refine_iterations=iterations, refine_steps=steps, refine_size=size
    )


COMBINED: tuple[dict[str, Any], ...] = (
    {"views": 1, "crop": True},
    {"views": 2, "crop": True},
    {"views": 6, "crop": True},
    {"views": 2, "crop": True, "image_size": 128, "splat": "near_exact"},
    {"views": 2, "crop": True, "image_size": 192},
    {"body_vertices": 2000, "splat": "fast"},
    {"body_vertices": 2000, "splat": "near_exact"},
    {"views": 1, "crop": True, "image_size": 128, "body_vertices": 2000, "splat": "fast"},
    {"crop": True, "refine_iterations": 4, "refine_size": 128},
    {"crop": True, "refine_iterations": 4, "refine_size": 256},
    {"crop": True, "refine_iterations": 4, "refine_size": 256, "splat": "near_exact"},
    {"views": 2, "crop": True, "refine_iterations": 4, "refine_size": 256},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_size": 256},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_steps": 100, "refine_size": 256},
    {"views": 6, "crop": True, "refine_iterations": 4, "refine_size": 512},
    {
        "body_vertices": 1000,
        "crop": True,
        "refine_iterations": 4,
        "refine_size": 256,
        "splat": "fast",
    },
    {"crop": True, "image_size": 384, "refine_iterations": 4, "refine_size": 512},
    {"crop": True, "max_edge_length": 0.02, "refine_iterations": 4, "refine_size": 256},
)
"""Points that change several knobs at once."""

SHORT = {
    "views": "{} photos",
    "image_size": "of {}",
    "crop": "cropped",
    "body_vertices": "body of {}",
    "max_edge_length": "edges of {} m",
    "refine_iterations": "{} iterations",
    "refine_steps": "{} steps",
    "refine_size": "at {}",
    "splat": "{}",
}


def combined(**fields: Any) -> Point:
    """Returns a point with several changes, which is named by them."""
    name = ", ".join(SHORT[key].format(value) for key, value in fields.items())
    return point(name, "combined", **fields)


EQUAL = 1.05
"""Ratio of times up to which points are taken for equally fast, because other programs ran during
the measurements.
"""
TASKS = {"novel": "same pose", "animation": "novel poses"}
SCORES = {
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "psnr_fg": ("foreground PSNR", 2),
    "lpips": ("LPIPS", 3),
}
NAIVE = ("vertex-color baseline", "random colors")
KINDS = {"feed-forward": "#1f6f8b", "refined": "#c0392b", "no network": "#7f8c8d"}
Row = dict[str, Any]


def show(run: Run, result: dict[str, Any], image: Path | None) -> None:
    """Shows the tables of all measured points, and draws the images if they are asked for."""
    points = result["points"]
    measured = {name: found for name, found in points.items() if "reconstruct" in found}
    result = result | {"points": measured}
    rows = rows_of(result)
    run.show(point_table(rows, result), kept(result), "tradeoff")
    run.show(preset_table(rows, result), table="tradeoff_presets")
    if image:
        for key, name in (("reconstruct", "reconstruction"), ("frame", "frames")):
            draw(rows, key, image.with_name(f"{image.name}_{name}.png"))


def kept(result: dict[str, Any]) -> dict[str, Any]:
    """Returns a result with means and the number of people in place of the rows of people."""
    points = {}
    for name, found in result["points"].items():
        people = found.get("people") or []
        points[name] = {key: value for key, value in found.items() if key != "people"}
        points[name]["people"] = len(people)
        if people:
            points[name] |= means(people)
    return result | {"points": points}


def rows_of(result: dict[str, Any]) -> list[Row]:
    """Returns a row for each measured point: its settings, times, memory, and means over people by
    task.
    """
    rows = []
    for name, found in result["points"].items():
        row = {"name": name.removeprefix("preset "), **found["what"], **found}
        # docs/results have means and the number of people instead of rows of people
        people, of_people = found["people"], {}
        if isinstance(people, int):
            of_people = {task: found.get(task) for task in TASKS}
        elif people:
            of_people = means(people)
        row |= {task: of_people.get(task) for task in TASKS}
        rows.append(row)
    return rows


def quality(row: Row) -> float:
    """Returns the PSNR in dB by which points are ranked, the mean of both tasks."""
    return 0.5 * (row["novel"]["psnr"] + row["animation"]["psnr"])


def kind(row: Row) -> str:
    """Returns the kind of a point, a key of `KINDS`."""
    if row["start"] in NAIVE:
        return "no network"
    if row["settings"]["refine_steps"] or row["settings"]["refine_iterations"]:
        return "refined"
    return "feed-forward"


def compared(rows: list[Row]) -> list[Row]:
    """Returns the rows that have scores of frames of `SIZE` pixels."""
    return [row for row in rows if row["novel"] is not None and row["size"] == SIZE]


def front_of(rows: list[Row]) -> list[Row]:
    """Returns the points on the front, the cheapest reconstruction first.

    A point with the network is on the front if no other such point is better and takes no longer.
    """
    ours = [row for row in compared(rows) if row["start"] == "network"]

    def no_longer(a, b):
        return all(a[key] <= EQUAL * b[key] for key in ("reconstruct", "frame"))

    def beaten(row):
        return any(quality(other) > quality(row) and no_longer(other, row) for other in ours)

    return sorted((row for row in ours if not beaten(row)), key=lambda row: row["reconstruct"])


# Tables
# --------------------------------------------------------------------------------------------------


def _count(people):
    """Returns the number of people, of a list of rows or as docs/results have it."""
    return people if isinstance(people, int) else len(people)


def about(result: dict[str, Any]) -> str:
    """Describes the weights, the people and the unit of the times."""
    default = result["points"]["default"]
    people, took = _count(default["people"]), f"{default['reconstruct_ms']:.0f} ms a reconstruction"
    return (
        f"Weights with SHA-256 {result['settings']['weights'][:16]}...; {people} of the people kept"
        " for this "
        '(split "tradeoff"). CPU times of all threads are shares of the default point\'s, in turns'
        f" with it: {took} and "
        f"{default['frame_ms']:.0f} ms a frame of {SIZE} pixels. LPIPS:"
        f" {result['settings'].get('lpips_net')}."
    )


def numbers(row: Row) -> list[str]:
    """Returns the cells of times, memory and sizes of a row."""

    def share(key):
        return "" if row.get(key) is None else significant(row[key])

    return [share("reconstruct"), share("frame"), *cells(row, SIZES, "")]


def scores(row: Row) -> list[str]:
    """Returns the cells of the scores of a row."""
    return [cell for task in TASKS for cell in cells(row[task] or {}, SCORES, "")]


SIZES = {"memory_mb": ("MiB", 0), "file_mb": ("file, MiB", 2), "gaussians": ("Gaussians", 0)}
MEASURES = ["reconstruction", "frame", *(heading for heading, _ in SIZES.values())]


def _headings() -> list[str]:
    """Returns the headings of the scores. The first one of each task names the task."""
    found = []
    for task in TASKS.values():
        first, *others = (heading for heading, _ in SCORES.values())
        found += [f"{task}: {first}", *others]
    return found


HEADINGS = _headings()


def point_table(rows: list[Row], result: dict[str, Any]) -> str:
    """Formats the table of all points. Those on the front are bold."""
    front = {row["name"] for row in front_of(rows)}

    def named(row):
        return f"**{row['name']}**" if row["name"] in front else row["name"]

    table = [[row["knob"], named(row), *numbers(row), *scores(row)] for row in rows]
    text = (
        f"{about(result)} {len(rows)} points; bold: no other point is better and as fast in both."
    )
    header = ["knob", "point", *MEASURES, *HEADINGS]
    return f"{text}\n\n{markdown_table(header, table, 'll' + 'r' * (len(header) - 2))}"


def preset_table(rows: list[Row], result: dict[str, Any]) -> str:
    """Formats the table of presets, with the PSNR that they lose against the best one, and whether
    they are on the front.
    """
    presets = [row for row in rows if row["knob"] == "preset"]
    if not presets:
        return "no preset has been measured"
    front, best = {row["name"] for row in front_of(rows)}, max(presets, key=quality)

    def lost(row):
        return [f"{best[task]['psnr'] - row[task]['psnr']:.2f}" for task in TASKS]

    table = []
    for row in presets:
        on_front = "yes" if row["name"] in front else "no"
        table.append([row["name"], *numbers(row), *scores(row), *lost(row), on_front])
    header = ["preset", *MEASURES, *HEADINGS]
    header += ["below best: same pose", "novel poses", "on the front"]
    return f"{about(result)}\n\n{markdown_table(header, table)}"


# Images
# --------------------------------------------------------------------------------------------------


def draw(rows: list[Row], key: str, path: Path) -> None:
    """Draws the PSNR of both tasks against a time, with the front."""
    from matplotlib.ticker import LogLocator, NullFormatter

    points = compared(rows)
    with figure(path, 2, (10, 4.4)) as axes:
        for axis, (task, title) in zip(axes, TASKS.items(), strict=True):
            for name, color in KINDS.items():
                chosen = [row for row in points if kind(row) == name]
                x, y = [row[key] for row in chosen], [row[task]["psnr"] for row in chosen]
                marker = "x" if name == "no network" else "o"
                axis.scatter(x, y, s=18, color=color, marker=marker, label=name)
            steps = staircase(
                [(row[key], row[task]["psnr"]) for row in points if row["start"] == "network"]
            )
            axis.step(*zip(*steps, strict=True), where="post", color="k", lw=0.8, label="front")

            # names of the presets below the front, where there is room
            named = [row for row in points if row["knob"] == "preset" or row["name"] == "default"]
            for i, row in enumerate(sorted(named, key=lambda row: row[key])):
                at, place = (row[key], row[task]["psnr"]), (14, -26 - 26 * (i % 3))
                line = {"arrowstyle": "-", "lw": 0.6, "color": "0.4"}
                axis.annotate(
                    row["name"], at, place, fontsize=8, textcoords="offset points", arrowprops=line
                )
            what = "reconstruction" if key == "reconstruct" else "frame"
            label = f"{what} time / default"
            axis.set(xscale="log", title=title, ylabel="PSNR, dB", xlabel=label)
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter(NullFormatter())
        axes[0].legend(fontsize=7)
