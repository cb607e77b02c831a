"""The points of the trade of speed against accuracy; its tables, images and front."""

import dataclasses
from pathlib import Path
from typing import Any

from experiments.harness import Run, figure, means, staircase
from experiments.results import cells, markdown_table, significant
from humangs_jax.apps.settings import PRESETS, Settings
from humangs_jax.network.runtime import Runtime

SIZE = 512
"""Side of the frames that points are compared at."""


@dataclasses.dataclass(frozen=True)
class Point:
    """A way to make an avatar and draw it. size: side of the frames, pixels. start: "network", or
    of `NAIVE`, to compare with.
    """

    name: str
    knob: str
    settings: Settings
    size: int = SIZE
    start: str = "network"


def point(name: str, knob: str, size: int = SIZE, start: str = "network", **changes: Any) -> Point:
    fields = {field.name for field in dataclasses.fields(Runtime)}
    runtime = Runtime(**{key: value for key, value in changes.items() if key in fields})
    rest: dict[str, Any] = {"views": 4} | {
        key: value for key, value in changes.items() if key not in fields
    }
    return Point(name, knob, Settings(runtime=runtime, **rest), size, start)


DEFAULT = point("default", "default")
"""4 photos of 256 pixels, as the weights were trained, float32, no refinement; frames of 512
pixels, exact.
"""


def points() -> list[Point]:
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
"""Of the learned update, steps of Adam after them, and the size of the photos."""


def refined(iterations: int, steps: int, size: int) -> Point:
    """A point with iterations, named by what it does."""
    parts = [
        f"{iterations} iteration{'s' * (iterations > 1)}",
        *([f"{steps} steps"] if steps else []),
    ]
    name = ", ".join(parts) + (f" at {size}" if size != 256 else "")
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
"""Several knobs at once."""

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
    return point(
        ", ".join(SHORT[key].format(value) for key, value in fields.items()), "combined", **fields
    )


EQUAL = 1.05
"""Times of points that differ by less are taken for equal: they are measured beside other programs.
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
    """All tables, and what is asked for."""
    result = result | {
        "points": {
            name: found for name, found in result["points"].items() if "reconstruct" in found
        }
    }
    rows = rows_of(result)
    run.show(point_table(rows, result), kept(result), "tradeoff")
    run.show(preset_table(rows, result), table="tradeoff_presets")
    if image:
        for key, name in (("reconstruct", "reconstruction"), ("frame", "frames")):
            draw(rows, key, image.with_name(f"{image.name}_{name}.png"))


def kept(result: dict[str, Any]) -> dict[str, Any]:
    """With means in place of the rows of people."""
    points = {}
    for name, found in result["points"].items():
        people = found.get("people") or []
        points[name] = {key: value for key, value in found.items() if key != "people"}
        points[name] |= {"people": len(people)} | (means(people) if people else {})
    return result | {"points": points}


def rows_of(result: dict[str, Any]) -> list[Row]:
    """A row for each measured point: what it is, times, memory, and means over people by task."""
    rows = []
    for name, found in result["points"].items():
        row = {"name": name.removeprefix("preset "), **found["what"], **found}
        # docs/results have the number of people, and means
        people, of_people = found["people"], {}
        if isinstance(people, int):
            of_people = {task: found.get(task) for task in TASKS}
        elif people:
            of_people = means(people)
        row |= {task: of_people.get(task) for task in TASKS}
        rows.append(row)
    return rows


def quality(row: Row) -> float:
    """What points are ranked by, dB: the mean of both tasks."""
    return 0.5 * (row["novel"]["psnr"] + row["animation"]["psnr"])


def kind(row: Row) -> str:
    if row["start"] in NAIVE:
        return "no network"
    return (
        "refined"
        if row["settings"]["refine_steps"] or row["settings"]["refine_iterations"]
        else "feed-forward"
    )


def compared(rows: list[Row]) -> list[Row]:
    """Those with scores, of frames of one size."""
    return [row for row in rows if row["novel"] is not None and row["size"] == SIZE]


def front_of(rows: list[Row]) -> list[Row]:
    """The points of ours than which no other one is better and takes no longer, cheapest
    reconstruction first.
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
    return people if isinstance(people, int) else len(people)


def about(result: dict[str, Any]) -> str:
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
    def share(key):
        return significant(row[key]) if row.get(key) is not None else ""

    return [share("reconstruct"), share("frame"), *cells(row, SIZES, "")]


def scores(row: Row) -> list[str]:
    return [cell for task in TASKS for cell in cells(row[task] or {}, SCORES, "")]


SIZES = {"memory_mb": ("MiB", 0), "file_mb": ("file, MiB", 2), "gaussians": ("Gaussians", 0)}
MEASURES = ["reconstruction", "frame", *(heading for heading, _ in SIZES.values())]
HEADINGS = [
    f"{name}: {heading}" if i == 0 else heading
    for name in TASKS.values()
    for i, (heading, _) in enumerate(SCORES.values())
]


def point_table(rows: list[Row], result: dict[str, Any]) -> str:
    """All points; those of the front are bold."""
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
    """The presets, whether they are on the front, and what they give up."""
    presets = [row for row in rows if row["knob"] == "preset"]
    if not presets:
        return "no preset has been measured"
    front, best = {row["name"] for row in front_of(rows)}, max(presets, key=quality)

    def lost(row):
        return [f"{best[task]['psnr'] - row[task]['psnr']:.2f}" for task in TASKS]

    table = [
        [
            row["name"],
            *numbers(row),
            *scores(row),
            *lost(row),
            "yes" if row["name"] in front else "no",
        ]
        for row in presets
    ]
    header = [
        "preset",
        *MEASURES,
        *HEADINGS,
        "below best: same pose",
        "novel poses",
        "on the front",
    ]
    return f"{about(result)}\n\n{markdown_table(header, table)}"


# Images
# --------------------------------------------------------------------------------------------------


def draw(rows: list[Row], key: str, path: Path) -> None:
    """PSNR of both tasks against a time, with the front."""
    from matplotlib.ticker import LogLocator, NullFormatter

    points = compared(rows)
    with figure(path, 2, (10, 4.4)) as axes:
        for axis, (task, title) in zip(axes, TASKS.items(), strict=True):
            for name, color in KINDS.items():
                chosen = [row for row in points if kind(row) == name]
                x, y = [row[key] for row in chosen], [row[task]["psnr"] for row in chosen]
                axis.scatter(
                    x, y, s=18, color=color, marker="x" if name == "no network" else "o", label=name
                )
            steps = staircase(
                [(row[key], row[task]["psnr"]) for row in points if row["start"] == "network"]
            )
            axis.step(*zip(*steps, strict=True), where="post", color="k", lw=0.8, label="front")
            named = [row for row in points if row["knob"] == "preset" or row["name"] == "default"]
            for i, row in enumerate(sorted(named, key=lambda row: row[key])):
                at, line = (
                    (row[key], row[task]["psnr"]),
                    {"arrowstyle": "-", "lw": 0.6, "color": "0.4"},
                )
                place = (14, -26 - 26 * (i % 3))  # below the front, where there is room
                axis.annotate(
                    row["name"], at, place, fontsize=8, textcoords="offset points", arrowprops=line
                )
            label = f"{'reconstruction' if key == 'reconstruct' else 'frame'} time / default"
            axis.set(xscale="log", title=title, ylabel="PSNR, dB", xlabel=label)
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter("{x:g}")
            axis.xaxis.set_minor_formatter(NullFormatter())
        axes[0].legend(fontsize=7)
