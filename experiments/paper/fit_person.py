"""The Animatable-Gaussians-style system, fitted to one person after the other: its row of the paper's table 1.

    python experiments/paper/fit_person.py --quick                                        # minutes, one synthetic person
    python experiments/paper/fit_person.py --people PEOPLE --out runs/fits --steps 3000 --json fits.json

A fit starts from nothing, sees the photos of one capture only, and belongs to that person: the next one is another fit.
PEOPLE is a capture or a folder of them, each of several poses and with held_out/ (`humangs synth` writes both). Printed are
the seconds of the fit, those of a frame, for which the networks run again, and the scores of held-out views: in a pose of the
capture, and in others. A fit that was interrupted goes on when it is called again.
"""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, significant, write_json
from experiments.paper.bench import load_networks, measured, triple

SYSTEM = "animatable"
QUICK_STEPS, QUICK_SIZE = 60, 128


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=Path, help="captures of several poses, with held_out/")
    parser.add_argument("--lpips", type=Path, nargs="+", help="weights of LPIPS vgg: BACKBONE and HEADS")
    parser.add_argument("--quick", action="store_true", help="a synthetic person of 128 pixels, and few steps")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--out", type=Path, help="folder of the fits; default: they are not kept")
    parser.add_argument("--steps", type=int, default=3000, help="of each fit (default 3000; theirs 800,000)")
    parser.add_argument("--size", choices=("bench", "published"), default="bench", help="of the maps and networks")
    arguments = parser.parse_args()
    if not (arguments.people or arguments.quick):
        parser.error("--people is needed, or --quick")
    try:
        with tempfile.TemporaryDirectory() as folder:
            if arguments.people is None:
                arguments.people = write_quick_person(Path(folder) / "people")
                arguments.steps = min(arguments.steps, QUICK_STEPS)
            fit_all(arguments, arguments.out or Path(folder) / "fits")
    except (ValueError, OSError) as error:
        parser.error(str(error))


def write_quick_person(folder: Path) -> Path:
    """A person in 6 frames of a motion, 4 views each; held out are 2 views of the first pose and of another one."""
    from humangs_jax.people.writer import Layout, write_set

    layout = Layout(QUICK_SIZE, poses=6, views=4, held_out_views=2, novel_poses=1, frames=60)
    write_set(folder, 1, layout, "test", progress=False)
    return folder


def fit_all(arguments: argparse.Namespace, out: Path) -> None:
    """Fit and score every person."""
    from humangs_jax.data.loading.captures import find_captures

    networks, rows = load_networks(arguments.lpips), {}
    for capture in find_captures(arguments.people):
        weights, seconds = fit(capture, out / capture.name, arguments.steps, arguments.size)
        found = measured(weights, capture, 1, None, networks)
        if found is not None:
            rows[capture.name] = found | {"fit_s": seconds, "steps": arguments.steps, "size": arguments.size}
    header = ["person", "fit, s", "frame, s", "pose of the capture", "another pose"]
    lines = [
        [
            name,
            significant(row["fit_s"]),
            significant(row["frame_s"]),
            triple(row["reconstruction"]),
            triple(row["animation"]),
        ]
        for name, row in rows.items()
    ]
    print(markdown_table(header, lines, "lrrrr"))
    if arguments.json:
        write_json(arguments.json, rows)


def configuration(steps: int, size: Any) -> Any:
    """Their loss without LPIPS, whose part structural dissimilarity takes: L1, and 0.005 of the squared offsets."""
    from experiments.systems import SYSTEMS
    from humangs_jax.data.loader import ViewSampling
    from humangs_jax.training.config import LossConfig, TrainConfig
    from humangs_jax.training.optimizer import OptimizerConfig

    model = SYSTEMS[SYSTEM](size)
    return TrainConfig(
        model=model,
        views=ViewSampling(input_counts=(1,), target_count=3),  # a photo has to be given, and is not looked at
        loss=LossConfig(squared=0.0, absolute=1.0, tightness=0.005),
        optimizer=OptimizerConfig(
            learning_rate=5e-4 if size == "published" else 2e-3, warmup_steps=min(50, steps // 4)
        ),
        target_size=model.conventions.image_size,
        steps=steps,
        log_every=min(20, steps),
        checkpoint_every=min(200, steps),
    )


def fit(capture: Path, out: Path, steps: int, size: Any) -> tuple[tuple[Any, Any], float]:
    """((variables, configuration), seconds of all calls) of one person, whose run is the folder `out`."""
    from humangs_jax.data.capture import load_capture
    from humangs_jax.training.loop import train

    config, body = configuration(steps, size), load_capture(capture).body
    clock, start = out / "seconds.json", time.perf_counter()
    before = json.loads(clock.read_text()) if clock.exists() else 0.0
    state = train(config, body, [capture], out, progress=False)
    seconds = before + time.perf_counter() - start
    write_json(clock, seconds)
    if int(state.step) < steps:
        raise ValueError(f"{out}: interrupted at step {int(state.step)} of {steps}: call it again to go on")
    return (state.variables, config.model), seconds


if __name__ == "__main__":
    main()
