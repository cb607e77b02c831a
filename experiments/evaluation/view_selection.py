"""What choosing photos by coverage gains over random ones: 20 photos of a person at random azimuths, of which 4 are used.

    python experiments/evaluation/view_selection.py --subjects 8 --json selection.json [--page docs/evaluation.md]

Held-out views are in the pose of the photos. "all" uses every photo.
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json

PHOTOS, HELD_OUT, DRAWS = 20, 8, 4
TABLE = "evaluation_view_selection"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=8, help="people of the validation seeds")
    parser.add_argument("--count", type=int, default=4, help="photos that are used")
    parser.add_argument("--json", type=Path, help="the numbers of every person")
    parser.add_argument("--page", type=Path, help="page whose table is written")
    arguments = parser.parse_args()
    people = evaluate(arguments.subjects, arguments.count)
    if arguments.json:
        write_json(arguments.json, people)
    text, means = section(people, arguments.count)
    print(text)
    if arguments.page:
        publish(arguments.page, TABLE, text, {"means": means, "people": people})


def evaluate(subjects, count):
    """Scores of every person by choice."""
    import numpy as np
    from tqdm import tqdm

    from humangs_jax.avatar.frames import capture_renderings
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.body.library import load_body
    from humangs_jax.data.view_selection import select_views
    from humangs_jax.evaluation.scores import score
    from humangs_jax.network.weights import load_weights
    from humangs_jax.people.cameras import cameras_around
    from humangs_jax.people.seeds import seeds_of
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import View, capture_views, sample_pose

    body, (variables, config) = load_body(), load_weights()
    people = []
    for seed in tqdm(seeds_of("validation", 0, subjects), desc="people"):
        rng = np.random.default_rng([seed, PHOTOS])
        subject = make_subject(seed, body)
        pose = sample_pose(subject, 0)
        cameras = cameras_around(rng, pose.vertices, rng.uniform(0, 2 * np.pi, PHOTOS + HELD_OUT), 256)
        views = [View(0, f"{i:02d}", cameras[i]) for i in range(PHOTOS + HELD_OUT)]
        capture = capture_views(subject, body, [pose], views)
        photos, held_out = capture.select(range(PHOTOS)), capture.select(range(PHOTOS, PHOTOS + HELD_OUT))

        def score_of(chosen, photos=photos, held_out=held_out):
            drawn = capture_renderings(reconstruct(variables, config, photos.select(chosen)), held_out)[1]
            found = score(np.stack([np.asarray(rendering.rgb) for rendering in drawn]), held_out)
            return {"psnr": found.psnr, "psnr_fg": found.psnr_fg}

        select_views(photos, count)  # compiles
        began = time.perf_counter()
        chosen = select_views(photos, count)
        seconds = time.perf_counter() - began
        draws = [score_of(rng.choice(PHOTOS, count, replace=False)) for _ in range(DRAWS)]
        random = {name: float(np.mean([draw[name] for draw in draws])) for name in draws[0]}
        row = {"chosen": score_of(chosen), "random": random, "all": score_of(range(PHOTOS))}
        people.append({"seed": seed, "seconds": seconds, "photos": chosen, **row})
    return people


def section(people, count):
    """The table and its means."""
    import numpy as np

    titles = {"random": f"{count} at random", "chosen": f"{count} chosen", "all": f"all {PHOTOS}"}
    means = {
        key: {name: float(np.mean([p[key][name] for p in people])) for name in ("psnr", "psnr_fg")} for key in titles
    }
    better = sum(p["chosen"]["psnr"] > p["random"]["psnr"] for p in people)
    seconds = float(np.median([p["seconds"] for p in people]))
    rows = [[title, *(f"{means[key][n]:.2f}" for n in ("psnr", "psnr_fg"))] for key, title in titles.items()]
    about = (
        f"Means over {len(people)} people of the validation seeds, {PHOTOS} photos of 256 pixels at random azimuths; "
        f"{DRAWS} random choices each. The chosen ones are better for {better} of {len(people)}; choosing takes {seconds:.2f} s."
    )
    return f"{about}\n\n{markdown_table(['photos', 'PSNR, dB', 'on the person, dB'], rows, 'lrr')}", means


if __name__ == "__main__":
    main()
