"""The painted body mesh on the people of the bench: what a system must beat before it counts as trained.

    python experiments/paper/painted.py --validation VALIDATION --people PEOPLE --page

VALIDATION: the folder `validation` that train_all.py writes into its OUT, scored on the views on which it scores every variant.
PEOPLE: the --people of tables.py, scored as there, in the pose of the photos. Folders that are missing are made (docs/paper.md).
The vertices have the mean colors of the photos that see them, grey where none does.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.paper.bench import PAINTED, PAINTED_TABLE, PHOTOS, TARGETS

VALIDATED = 8
COUNTS = (1, PHOTOS)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--validation", type=Path, required=True, help="captures of the validation people")
    parser.add_argument("--people", type=Path, required=True, help="captures of the test people, with held_out/")
    add_outputs(parser, PAINTED_TABLE)
    arguments = parser.parse_args()
    numbers = {
        "validation": {str(count): on_validation(made(arguments.validation, "validation"), count) for count in COUNTS},
        "test": {str(count): on_test(made(arguments.people, "test"), count) for count in COUNTS},
    }
    write_outputs(arguments, PAINTED_TABLE, text_of(numbers), numbers)


def made(folder: Path, split: Any) -> Path:
    """The folder, with people as docs/paper.md says if there were none."""
    from humangs_jax.people.writer import Layout, write_set

    if not folder.is_dir():
        validation, test = Layout(128, views=12, poses=2), Layout(128, views=12, held_out_views=4, novel_poses=2)
        write_set(folder, VALIDATED, validation if split == "validation" else test, split)
    return folder


def on_validation(folder: Path, count: int) -> dict[str, float]:
    """Scores of the views on which `bench.score` compares variants: drawn as `training.validation` draws them."""
    import numpy as np

    from humangs_jax.data.capture import load_capture
    from humangs_jax.data.loader import CaptureCache, ViewSampling, find_captures
    from humangs_jax.data.loading.captures import subject_order, view_generator
    from humangs_jax.data.loading.examples import draw_views

    folders, rows = find_captures(folder)[:VALIDATED], []
    cache = CaptureCache(folders, load_capture(folders[0]).body)
    sampling = ViewSampling((count,), target_count=TARGETS, jitter=0.0, scattered_share=0.0, mixed_pose_share=0.0)
    for index, subject in enumerate(subject_order(0, 0, len(folders))):
        boundary = cache.boundary(int(subject))
        assert boundary is not None
        inputs, targets = draw_views(view_generator(0, index), boundary, count, sampling)
        capture = load_capture(folders[int(subject)])
        rows.append(scores(capture.select(inputs), capture.select(targets)))
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def on_test(folder: Path, count: int) -> dict[str, float]:
    """Scores as in tables.py, of the views in the pose of the photos."""
    import numpy as np

    from humangs_jax.evaluation.cases import find_people

    people, rows = find_people(folder, count, None, None), []
    for index in range(len(people.names)):
        case = people.load(index)
        own = np.flatnonzero(np.asarray(case.truth.frames) == 0)
        rows.append(scores(case.inputs, case.truth.select(own.tolist())))
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def scores(inputs: Any, truth: Any) -> dict[str, float]:
    """Means over the views, with the names of `bench.SCORES`."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.evaluation.cases import draw_painted_body, painted_body
    from humangs_jax.losses.metrics import masked_psnr, psnr
    from humangs_jax.losses.ssim import similarity_map

    images, masks = jnp.asarray(truth.images), jnp.asarray(truth.masks)
    shown = jnp.clip(draw_painted_body(painted_body(inputs), truth), 0, 1)
    return {
        "psnr": float(jnp.mean(jax.vmap(psnr)(shown, images))),
        "psnr_fg": float(jnp.mean(jax.vmap(masked_psnr)(shown, images, masks))),
        "ssim": float(jnp.mean(jax.vmap(similarity_map)(shown, images))),
    }


def text_of(numbers: dict[str, Any]) -> str:
    """One row a set of people and number of photos."""
    rows = [
        [f"{PAINTED}, {split} people", count, f"{x['psnr']:.2f}", f"{x['psnr_fg']:.2f}", f"{x['ssim']:.3f}"]
        for split, counts in numbers.items()
        for count, x in counts.items()
    ]
    return markdown_table(["", "photos", "PSNR, dB", "foreground PSNR, dB", "SSIM"], rows)


if __name__ == "__main__":
    main()
