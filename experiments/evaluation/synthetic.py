"""Reconstruct unseen synthetic people from a few photos and compare with held-out views, in the same pose and in others.

    python experiments/evaluation/synthetic.py --subjects 32 --views 1 2 4 6 --json evaluation.json
        [--images sheet.png] [--plot views.png] [--page docs/evaluation.md]

Subjects are drawn from the test seeds (`humangs_jax.people.seeds`), which training never sees; choices are made
on `--split validation`. A person is made once, rendered from evenly spaced cameras (`evaluation/subjects.py`), reconstructed
from every number of photos asked for, and always compared with the same held-out views: "novel" ones in the pose of the photos,
and "animation" ones in unseen poses. The baseline is the body mesh, each vertex painted with the mean photo color over the
input views that see it (grey where none does), in the same pose. `evaluation/results.py` defines the scores.

--json writes {"psnr", "ssim", "lpips", "psnr_fg", "foreground", "baseline_psnr", "baseline_ssim",
"baseline_psnr_foreground", "baseline_lpips": means over people of the novel views with 4 photos (or the most asked for, see
"views"), "by_views": {"4": {"novel": the same keys, "animation": the same keys}, ...}, "settings": {...},
"subjects": [{"seed", the same keys, "by_views": {...}}, ...], "others": rows of people who are not asked for or not finished}
after every person. A later run continues: rows in the file with the same settings (weights, split, sizes, ...) are not
computed again; a file of other settings is replaced.

--images shows the best five people beside the worst five, by PSNR; --plot needs matplotlib (the `notebooks` extra);
--page writes the table evaluation_views of a page. LPIPS needs weights (`--lpips-backbone`, docs/loss_networks.md); without them
it is missing: null, and a dash in the table. About 10 s of CPU time a person with four numbers of views, and a minute or two of
compiling.
"""

import argparse
import sys
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import check_section, publish, write_json
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
    COLUMNS,
    extremes,
    headline,
    kept_rows,
    printed_table,
    table_row,
    views_report,
    views_section,
    without_people,
)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--views", type=int, nargs="+", default=[4], choices=COUNTS, help="numbers of photos that the network sees"
    )
    add_people_options(parser, subjects=8)
    parser.add_argument(
        "--images", "--pictures", type=Path, help="write the best five people beside the worst five here"
    )
    parser.add_argument("--plot", type=Path, help="draw PSNR against the number of photos here")
    arguments = parser.parse_args()
    check_people_options(parser, arguments)
    arguments.views = sorted(set(arguments.views))
    lpips = load_lpips(parser, arguments)
    try:
        if arguments.page:
            check_section(arguments.page, "evaluation_views")
        report = evaluate(arguments, lpips)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if arguments.page:
        section = views_section(report, arguments.page, arguments.images, arguments.plot)
        publish(arguments.page, "evaluation_views", section, without_people(report))


def evaluate(arguments: argparse.Namespace, lpips: Any = None) -> dict[str, Any]:
    """Make, reconstruct and score every person, and write what was asked for. lpips: its weights or None."""
    from tqdm import tqdm

    from experiments.evaluation.pictures import plot_views, strip_of, write_sheet
    from experiments.evaluation.subjects import HeldOut, draw_person, make_evaluation_subject, score_person
    from humangs_jax.body.library import load_body

    body, (variables, config, digest) = load_body(), load_network(arguments)
    seeds = seeds_asked_for(arguments, body)
    settings = settings_of(arguments, digest, config.tokens, lpips)
    rows = kept_rows(arguments.json, settings, "by_views")
    held_out = HeldOut(arguments.held_out, arguments.poses, arguments.pose_views)
    chosen, strips = headline(arguments.views), {}

    def add(seed: int, counts: Sequence[int]) -> None:
        """The person's scores with these numbers of photos, into rows, and its images into strips."""
        subject = make_evaluation_subject(seed, body, counts, arguments.size, held_out)
        for count in counts:
            drawn = draw_person(variables, config, subject, count)
            rows.setdefault(seed, {})[str(count)] = score_person(drawn, subject.held_out, lpips)
            if str(count) == chosen:
                strips[seed] = strip_of(drawn, subject.held_out)

    print(f"{'seed':>8}" + "".join(f"{heading:>11}" for heading, _ in COLUMNS.values()))
    if lpips is None:
        print("LPIPS is missing: no --lpips-backbone given")
    for seed in tqdm(seeds, desc="people"):
        if missing := [count for count in arguments.views if str(count) not in rows.get(seed, {})]:
            add(seed, missing)
            if arguments.json:
                write_json(arguments.json, views_report(rows, settings, seeds, arguments.views))
        tqdm.write(f"{seed:8d}{table_row(rows[seed][chosen]['novel'])}")
    report = views_report(rows, settings, seeds, arguments.views)
    print(printed_table(report["by_views"]))
    if arguments.json:
        write_json(arguments.json, report)
    if arguments.images:
        for row in chain(*extremes(report)):
            if row["seed"] not in strips:  # scored by an earlier run, which kept no images
                add(row["seed"], [int(chosen)])
        write_sheet(arguments.images, report, strips)
    if arguments.plot:
        plot_views(arguments.plot, report)
    return report


if __name__ == "__main__":
    main()
