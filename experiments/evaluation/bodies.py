"""The same weights, people and photos on other bodies: another topology in SMPL-X's format, and fewer vertices.

    python experiments/evaluation/bodies.py --subjects 8 --views 4 --json bodies.json
        [--page docs/evaluation.md] [--images P.png]

Bodies: "default", the one that the weights were trained on; "SMPL-X format", a made-up body of another
topology, written as an SMPL-X file and read by its loader, to whose joints the poses go by name; "1/4" and "1/16" of the default
body's vertices, as they are (a knob for speed) and with long edges split as the weights want it. People, photos, held-out views
and scores are those of `evaluation/synthetic.py`.

--json writes {"bodies": {name: {"body_vertices": of the body, "vertices": that carry Gaussians, "novel", "animation": mean
scores, "costs": medians}}, "settings", "subjects": [{"seed", "bodies": {name: ...}}], "others": rows of people who are not asked
for} after every person; a later run continues. One of the names is the painted default body, the baseline, which has no costs.
Costs are the number of "gaussians" and seconds of compiled programs: "reconstruct" (photos to avatar, without choosing the body's
vertices, which is done once a body), "frame" (posing and drawing one image), and the same in CPU time ("_cpu"). About 10 s of
CPU time a person, and some minutes of compiling.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import check_section, markdown_table, publish, write_json
from experiments.evaluation.options import (
    COUNTS,
    add_people_options,
    check_people_options,
    load_lpips,
    load_network,
    seeds_asked_for,
    settings_of,
)
from experiments.evaluation.results import (
    SHOWN,
    TASK_NAMES,
    TASKS,
    Row,
    about,
    cell,
    finished,
    kept_rows,
    printed_table,
    without_people,
)
from humangs_jax.evaluation.tables import mean_scores

PAINTED = "painted default body"
"""Cell of a row that holds the scores of the baseline."""
COSTS = "costs"
"""Beside the tasks of a cell: what the body takes."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=4, choices=COUNTS, help="photos that the network sees")
    add_people_options(parser, subjects=8)
    parser.add_argument("--images", type=Path, help="write the truth and every body's image of one person here")
    arguments = parser.parse_args()
    check_people_options(parser, arguments)
    lpips = load_lpips(parser, arguments)
    try:
        if arguments.page:
            check_section(arguments.page, "evaluation_bodies")
        report = evaluate(arguments, lpips)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if arguments.page:
        publish(arguments.page, "evaluation_bodies", bodies_section(report), without_people(report))


def evaluate(arguments: argparse.Namespace, lpips: Any = None) -> dict[str, Any]:
    """Score every person on every body, and write what was asked for. lpips: its weights or None."""
    import jax
    from tqdm import tqdm

    from experiments.evaluation.body_cases import as_it_is, body_cases
    from experiments.evaluation.subjects import HeldOut, make_evaluation_subject, score_tasks
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.body.library import load_body
    from humangs_jax.evaluation.cases import draw_painted_body, draw_views, painted_body

    body, (variables, config, digest) = load_body(), load_network(arguments)
    seeds = seeds_asked_for(arguments, body)
    settings = settings_of(arguments, digest, config.tokens, lpips)
    settings |= {"views": arguments.views, "device": jax.devices()[0].device_kind}
    rows = kept_rows(arguments.json, settings, "bodies")
    cases, config = body_cases(body, config), as_it_is(config)
    sizes = {
        name: {"body_vertices": len(x.body.template), "vertices": len(x.carrier.template)} for name, x in cases.items()
    }
    held_out = HeldOut(arguments.held_out, arguments.poses, arguments.pose_views)
    drawn: dict[str, Any] = {}

    def add(seed: int) -> None:
        """The person's scores on every body, into rows, and its images into drawn."""
        subject = make_evaluation_subject(seed, body, [arguments.views], arguments.size, held_out)
        truth = subject.held_out
        painted = draw_painted_body(painted_body(subject.inputs(arguments.views)), truth)
        row = {PAINTED: score_tasks(painted, truth, lpips)}
        drawn["truth"] = truth.images
        for name, case in cases.items():
            other = subject.with_body(case.carrier)
            inputs = other.inputs(arguments.views)
            avatar, passes = timed(lambda inputs=inputs: jax.block_until_ready(reconstruct(variables, config, inputs)))
            drawn[name], frames = timed(lambda avatar=avatar, other=other: draw_views(avatar, other.held_out).images)
            seconds = {"reconstruct": passes, "frame": [x / truth.view_count for x in frames]}
            costs = {
                f"{step}{mark}": x for step, pair in seconds.items() for mark, x in zip(("", "_cpu"), pair, strict=True)
            }
            costs["gaussians"] = len(avatar.gaussians.means)
            row[name] = score_tasks(drawn[name], truth, lpips) | {COSTS: costs}
        rows[seed] = row

    names = [PAINTED, *cases]
    for seed in tqdm(seeds, desc="people"):
        if not finished(rows, [seed], names):
            add(seed)
            if arguments.json:
                write_json(arguments.json, bodies_report(rows, settings, seeds, names, sizes))
    report = bodies_report(rows, settings, seeds, names, sizes)
    print(
        printed_table(
            {name: {task: means[task] for task in TASKS if task in means} for name, means in report["bodies"].items()}
        )
    )
    if arguments.json:
        write_json(arguments.json, report)
    if arguments.images:
        add(seeds[0])  # whoever was scored last
        write_bodies(arguments.images, drawn, [0, arguments.held_out] if arguments.poses else [0])
    return report


def timed(run: Callable[[], Any]) -> tuple[Any, tuple[float, float]]:
    """The result of a run, and the seconds, by the clock and of CPU time, of the second of two: the first may compile."""
    run()
    clock, cpu = time.perf_counter(), time.process_time()
    result = run()
    return result, (time.perf_counter() - clock, time.process_time() - cpu)


def bodies_report(
    rows: dict[int, Row], settings: dict[str, Any], seeds: Sequence[int], names: Sequence[str], sizes: dict[str, Any]
) -> dict[str, Any]:
    """What is written, see above. At least one of the seeds has all its cells."""
    done = finished(rows, seeds, names)
    bodies = {}
    for name in names:
        cells = [rows[seed][name] for seed in done]
        bodies[name] = sizes.get(name, {}) | {
            task: mean_scores(x[task] for x in cells) for task in TASKS if task in cells[0]
        }
        if COSTS in cells[0]:
            bodies[name][COSTS] = {key: median(x[COSTS][key] for x in cells) for key in cells[0][COSTS]}
    return {
        "bodies": bodies,
        "settings": settings,
        "subjects": [{"seed": seed, "bodies": rows[seed]} for seed in done],
        "others": [{"seed": seed, "bodies": row} for seed, row in rows.items() if seed not in done],
    }


def bodies_section(report: dict[str, Any]) -> str:
    """The table of the page: a row a body, what it costs and how well it matches."""
    bodies, settings = report["bodies"], report["settings"]
    tasks = [task for task in TASKS if task in bodies[PAINTED]]
    keys = [key for key in ("psnr", "psnr_fg", "lpips") if bodies[PAINTED]["novel"].get(key) is not None]
    header = [
        "body",
        "vertices",
        "that carry Gaussians",
        "Gaussians",
        "reconstruct: wall, CPU s",
        "frame: wall, CPU ms",
    ]
    header += [f"{TASK_NAMES[task]}: {SHOWN[key]}" for task in tasks for key in keys]
    table = []
    for name, body in bodies.items():
        facts = ["-"] * 5
        if costs := body.get(COSTS):
            seconds = [f"{costs[key]:.2f}" for key in ("reconstruct", "reconstruct_cpu")]
            milliseconds = [f"{1e3 * costs[key]:.0f}" for key in ("frame", "frame_cpu")]
            facts = [
                body["body_vertices"],
                body["vertices"],
                int(costs["gaussians"]),
                ", ".join(seconds),
                ", ".join(milliseconds),
            ]
        table.append([name, *facts, *(cell(body[task], key) for task in tasks for key in keys)])
    said = about(settings, len(report["subjects"]))
    how = f"{settings['views']} photos. Medians of the seconds over people, compiled programs, device: {settings['device']}."
    return f"{said} {how}\n\n{markdown_table(header, table)}"


def write_bodies(path: Path, drawn: dict[str, Any], views: Sequence[int]) -> None:
    """Truth and every body, a row for each of the views."""
    import numpy as np

    from humangs_jax.avatar.sheets import contact_sheet

    tiles = np.stack([pictures[view] for view in views for pictures in drawn.values()])
    contact_sheet(tiles, path, headers=list(drawn), columns=len(drawn))


if __name__ == "__main__":
    main()
