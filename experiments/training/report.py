"""A training run from fresh weights, and its page: people, training, curve, validation images, numbers.

    python experiments/training/report.py --out runs/report

Makes 64 synthetic people of the training seeds and 8 of the validation seeds in runs/report, trains the preset `small` for 500
steps and writes OUT/report.md with its tables, and images in OUT/images. Ctrl-C saves; the same command continues, and
after the end it writes tables and images again. On 2 CPU cores about 5 minutes for the people and 15 for the run; expected: 22 dB
on the validation people, no step skipped. Needs matplotlib (the `notebooks` extra).

`--config tiny --people 3 --validation 2 --steps 10` tries all of it in two minutes.
"""

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import peak_rss_mb, prepare_process
from experiments.common.results import check_section, markdown_table, publish, write_json, write_text
from experiments.training.plot import draw_curve, read_lines, steps_of, validations_of

TABLES = ("training_run_steps", "training_run_facts")
SIZE, POSES, VIEWS = 256, 2, 12
"""Images of a person."""
COLUMNS = 5
"""Validations that are shown."""
AVERAGED = 20
"""Log lines that a number of the table averages, at most those since the validation before."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the run")
    parser.add_argument("--config", default="small", help="preset")
    parser.add_argument("--steps", type=int, default=500, help="length of the run")
    parser.add_argument("--people", type=int, default=64, help="people to train on")
    parser.add_argument("--validation", type=int, default=8, help="people to look at")
    parser.add_argument(
        "--page", type=Path, help="page of the tables training_run_*; default: OUT/report.md, which is made"
    )
    parser.add_argument("--images", type=Path, help="folder for its pictures; default: OUT/images")
    arguments = parser.parse_args()
    if min(arguments.steps, arguments.people, arguments.validation) < 1:
        parser.error("--steps, --people and --validation must be at least 1")
    images, page = arguments.images or arguments.out / "images", arguments.page or arguments.out / "report.md"
    if arguments.page is None and not page.is_file():
        sections = (f"<!-- table: {name} -->\n<!-- end -->\n" for name in TABLES)
        write_text(page, "\n".join(["# A training run\n", *sections]))
    for name in TABLES:
        check_section(page, name)
    prepare_process()
    if train(arguments):
        write_report(arguments.out, page, images)
        print(f"{page}: written")
    else:
        print("interrupted: the same command goes on")


def train(arguments: argparse.Namespace) -> bool:
    """Make people, train until the end or an interruption; whether it is the end. Facts go to out/report.json."""
    from experiments.training.data_loading import machine
    from humangs_jax.body.library import load_body
    from humangs_jax.people.writer import Layout, find_people, write_set
    from humangs_jax.training.config import PRESETS
    from humangs_jax.training.loop import train as run

    config = reported(PRESETS[arguments.config](), arguments.steps)
    people, others = arguments.out / "people", arguments.out / "validation"
    facts = read_facts(arguments.out)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    began = time.perf_counter()
    for folder, count, split in ((people, arguments.people, "train"), (others, arguments.validation, "validation")):
        write_set(folder, count, Layout(SIZE, POSES, VIEWS), split, workers=cores)
    if (seconds := time.perf_counter() - began) > 1:  # or they were there already
        facts["people_s"] = facts.get("people_s", 0.0) + seconds
    facts |= {name: getattr(arguments, name) for name in ("config", "people", "validation")}
    facts |= {"machine": machine(), "sessions": facts.get("sessions", 0) + 1}
    write_json(arguments.out / "report.json", facts)

    state = run(config, load_body(), find_people(people), arguments.out, validation=find_people(others, None))
    facts["peak_mb"] = max(facts.get("peak_mb", 0.0), peak_rss_mb())
    facts["load"] = os.getloadavg()[2]  # of the last quarter of an hour
    write_json(arguments.out / "report.json", facts)
    return int(state.step) == config.steps


def reported(config: Any, steps: int) -> Any:
    """The preset for a run of that many steps: ten validations, a hundred log lines, a warm-up of a tenth at most."""
    warmup = min(config.optimizer.warmup_steps, steps // 10)
    tenth = max(1, steps // 10)
    return dataclasses.replace(
        config,
        steps=steps,
        optimizer=dataclasses.replace(config.optimizer, warmup_steps=warmup),
        log_every=max(1, steps // 100),
        validate_every=tenth,
        checkpoint_every=tenth,
    )


def read_facts(out: Path) -> dict[str, Any]:
    """What earlier sessions noted; nothing at first."""
    path = out / "report.json"
    return json.loads(path.read_text()) if path.is_file() else {}


def write_report(out: Path, page: Path, images: Path) -> None:
    """The page's tables and images from a run's log, sheets, configuration and report.json."""
    lines, facts = read_lines(out / "log.jsonl"), read_facts(out)
    config = json.loads((out / "config.json").read_text())
    validated = [line["step"] for line in validations_of(lines)]
    images.mkdir(parents=True, exist_ok=True)
    draw_curve(lines, images / "training_run.png")
    draw_progress(out / "sheets", shown_steps(validated), config, images / "training_run_progress.jpg")
    draw_sheet(out / "sheets", validated[-1], images / "training_run_sheet.jpg")
    steps, about = table_of_steps(lines), table_of_facts(lines, facts, config)
    for name, table in zip(TABLES, (steps, about), strict=True):
        publish(page, name, table, facts)


def shown_steps(validated: Sequence[int]) -> list[int]:
    """Some of the validations: the first, the last, and between them ever fewer."""
    count = len(validated)
    chosen = {round((count - 1) * (i / (COLUMNS - 1)) ** 2) for i in range(COLUMNS)}
    return [validated[i] for i in sorted(chosen)]


def draw_progress(sheets: Path, steps: Sequence[int], config: dict[str, Any], path: Path) -> None:
    """For every validation person a photo that the network was not shown, and what it makes of it at some steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    pictures = [read_picture(sheets, step) for step in steps]
    inputs = validated_count(config)
    targets = config["views"]["target_count"]
    side = pictures[0].shape[1] // (inputs + 2 * targets)
    column = lambda picture, i: picture[:, i * side : (i + 1) * side]
    strip = np.concatenate([column(pictures[0], inputs), *(column(x, inputs + 1) for x in pictures)], axis=1)
    width = len(steps) + 1
    figure, axis = plt.subplots(figsize=(1.7 * width, 1.7 * len(strip) / side + 0.3))
    axis.imshow(strip, extent=(0, width, len(strip) / side, 0), interpolation="lanczos")
    axis.set_xticks(np.arange(width) + 0.5, ["photo", *(f"step {step}" for step in steps)])
    axis.set_yticks([])
    axis.xaxis.tick_top()
    axis.tick_params(length=0)
    axis.set_frame_on(False)
    figure.tight_layout(pad=0.2)
    figure.savefig(path, dpi=130, pil_kwargs={"quality": 85})
    plt.close(figure)


def validated_count(config: dict[str, Any]) -> int:
    """Photos of a validation, see `validation.validation_examples`."""
    counts = sorted(config["views"]["input_counts"])
    return counts[len(counts) // 2]


def draw_sheet(sheets: Path, step: int, path: Path) -> None:
    """A validation sheet as JPEG, not wider than the page."""
    from PIL import Image

    picture = Image.fromarray(read_picture(sheets, step))
    width = min(picture.width, 1400)
    picture.resize((width, picture.height * width // picture.width), Image.Resampling.LANCZOS).save(path, quality=85)


def read_picture(sheets: Path, step: int) -> Any:
    """The sheet of a step, (h, w, 3) bytes."""
    import numpy as np
    from PIL import Image

    with Image.open(sheets / f"{step:07d}.png") as picture:
        return np.asarray(picture.convert("RGB"))


def average_text(config: dict[str, Any]) -> str:
    """What is validated, if it is an average of weights."""
    decay = config["ema_decay"]
    return "" if decay is None else f"; averaged weights ({decay:g}) are validated"


def table_of_steps(lines: Sequence[dict[str, Any]]) -> str:
    """One row per validation."""
    header = [
        "step",
        "loss",
        "PSNR, training views",
        "gradient norm",
        "validation PSNR",
        "on the person",
        "SSIM",
        "LPIPS",
    ]
    rows, before = [], 0
    for validation in validations_of(lines):
        step = validation["step"]
        own = [line for line in steps_of(lines) if before < line["step"] <= step][-AVERAGED:]
        mean = lambda name, own=own: average([line[name] for line in own if line[name] is not None])
        lpips = validation.get("val_lpips")
        rows.append(
            [
                str(step),
                f"{mean('loss'):.4f}",
                f"{mean('psnr'):.2f} dB",
                f"{mean('grad_norm'):.3f}",
                f"{validation['val_psnr']:.2f} dB",
                f"{validation['val_psnr_mask']:.2f} dB",
                f"{validation['val_ssim']:.4f}",
                "no weights" if lpips is None else f"{lpips:.4f}",
            ]
        )
        before = step
    return markdown_table(header, rows)


def table_of_facts(lines: Sequence[dict[str, Any]], facts: dict[str, Any], config: dict[str, Any]) -> str:
    """The run, the machine, times, what went wrong."""
    steps, validated = steps_of(lines), {line["step"] for line in validations_of(lines)}
    total, plain, before = 0.0, [], 0
    for line in steps:
        # lines after a validation, and the first of a session, hold more than steps
        if "seconds_per_step" in line:
            total += line["seconds_per_step"] * (line["step"] - before)
            if before > 0 and before not in validated:
                plain.append((line["seconds_per_step"], line["data_seconds_per_step"]))
        before = line["step"]
    step_s, data_s = (median(values) for values in (zip(*plain, strict=True) if plain else ((), ())))
    machine, last = facts["machine"], steps[-1]
    dropped = {name: max(line[name] for line in steps) for name in ("dropped_tokens", "dropped_reads", "overflow")}
    made = f" in {facts['people_s'] / 60:.1f} min" if "people_s" in facts else ""
    cores = f"{machine['cores']} cores of {machine['architecture']} (load average {facts['load']:.1f})"
    views, optimizer = config["views"], config["optimizer"]
    counts = " or ".join(str(count) for count in sorted(set(views["input_counts"])))
    other = ("structural_scales", "random_background")
    terms = [f"{value:g} {name}" for name, value in config["loss"].items() if value and name not in other]
    rows = {
        "run": f"preset `{facts['config']}` from fresh weights, {config['steps']} steps of {config['batch_size']} people",
        "people": f"{facts['people']} for training, {POSES} poses x {VIEWS} views each; {facts['validation']} for validation",
        "photos": f"{counts} of {config['model']['conventions']['image_size']} px",
        "targets": f"{views['target_count']} of {config['target_size']} px",
        "loss": " + ".join(terms),
        "learning rate": f"{optimizer['learning_rate']:g} after {optimizer['warmup_steps']} steps{average_text(config)}",
        "machine": f"{cores}, {machine['device']}, JAX {machine['jax']}",
        "people made": f"{facts['people'] + facts['validation']}{made}",
        "a step": f"{step_s:.2f} s, {config['batch_size'] / step_s:.2f} subjects a second (median)",
        "of that, waiting for data": f"{data_s * 1e3:.0f} ms, {data_s / step_s:.1%}",
        "all steps with compilation, validations and checkpoints": f"{total / 60:.1f} min in {facts['sessions']} session(s)",
        "most memory of the process": f"{facts['peak_mb'] / 1024:.1f} GiB",
        "steps skipped": f"{last['skipped']:.0f}",
        "steps with anything not finite": f"{last.get('nonfinite', 0):.0f}",
        "patches, vertices, splats without room in any logged step": ", ".join(f"{x:.0f}" for x in dropped.values()),
    }
    return markdown_table(["", ""], list(rows.items()), "ll")


def average(values: Sequence[float]) -> float:
    """Mean, NaN of nothing."""
    return sum(values) / len(values) if values else float("nan")


def median(values: Sequence[float]) -> float:
    """The upper middle value, NaN of nothing."""
    return sorted(values)[len(values) // 2] if values else float("nan")


if __name__ == "__main__":
    main()
