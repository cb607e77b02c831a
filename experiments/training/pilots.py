"""Short training runs that differ in one setting each, compared on the same people.

    python experiments/training/pilots.py --bank runs/people.npz --people people --validation unseen --out runs/pilots
    python experiments/training/pilots.py ... --only "as it is" "rate 1e-3" --steps 150

The variants change the training (`--of training`) or the terms against fog (`--of fog`), starting from trained weights
(`--start`), or the network (`--of network`), from fresh weights.
The learning rate of every run ends at 0. The table is written to docs/training.md, the numbers to
OUT/pilots.json; runs that are in there are not repeated. About 3 CPU minutes a run of 60 steps.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

FIRST, TABLE = "as it is", "training_pilots"
DOCS = Path(__file__).resolve().parents[2] / "docs" / "training.md"
TOKENS = 1024
"""For 4 photos of 256 pixels."""
COLUMNS = {
    "psnr": ("PSNR, dB", 2),
    "psnr_mask": ("on the person, dB", 2),
    "psnr_outline": ("outline, dB", 2),
    "fog": ("fog", 4),
    "ssim": ("SSIM", 4),
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", type=Path, required=True, help="the people.npz of a run with --on-the-fly")
    parser.add_argument(
        "--people", type=Path, help="captures, mixed with the on-the-fly people by halves; none: the latter alone"
    )
    parser.add_argument("--validation", type=Path, required=True, help="captures of other people")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--start", type=Path, help="weights to start from; the shipped ones if not given")
    parser.add_argument(
        "--of", choices=("training", "network", "fog"), default="training", help="what the runs differ in"
    )
    parser.add_argument("--steps", type=int, default=150, help="of each run")
    parser.add_argument("--only", nargs="+", help="names of the runs to make; all if not given")
    parser.add_argument("--page", type=Path, default=DOCS, help="page with the table")
    arguments = parser.parse_args()
    from humangs_jax.core.allocator import keep_freed_memory

    keep_freed_memory()
    run(arguments, parser)


def training_variants(base):
    """Name -> (configuration, settings of the on-the-fly people): changes of the training, starting from weights."""
    replace = dataclasses.replace
    model = base.model
    view = lambda **changes: replace(base, views=replace(base.views, **changes))
    loss = lambda **changes: replace(base, loss=replace(base.loss, **changes))
    rate = lambda x: replace(base, optimizer=replace(base.optimizer, learning_rate=x))
    decoder = lambda model, **fields: model.with_parts(decoder=replace(model.architecture.decoder, **fields))
    k = lambda free: replace(base, model=decoder(model, free=free))
    counts = view(input_counts=(1, 2, 4, 4, 6))
    return {
        FIRST: (base, {}),
        "another seed": (replace(base, seed=1), {}),
        "rate 1e-3": (rate(1e-3), {}),
        "rate 2e-4": (rate(2e-4), {}),
        "2 subjects a step, half of the steps": (replace(base, batch_size=2, steps=base.steps // 2), {}),
        "2 targets": (view(target_count=2), {}),
        "1, 2, 4, 4 or 6 inputs": (replace(counts, model=model.with_execution(token_capacity=TOKENS * 7 // 5)), {}),
        "squared error alone": (loss(structural=0.0), {}),
        "structural 0.5": (loss(structural=0.5), {}),
        "silhouette 0.5": (loss(silhouette=0.5), {}),
        "all on white": (loss(random_background=0.0), {}),
        "K = 2": (k(1), {}),
        "K = 4": (k(3), {}),
        "no close targets": (base, {"close_share": 0.0}),
        "half close targets": (base, {"close_share": 0.5}),
        "clothes as made, none mirrored": (base, {"dyed_share": 0.0, "mirrored_share": 0.0}),
    }


def fog_variants(base):
    """Name -> (configuration, settings of the on-the-fly people): terms against fog, each alone."""
    loss = lambda **changes: (dataclasses.replace(base, loss=dataclasses.replace(base.loss, **changes)), {})
    return {
        FIRST: (base, {}),
        "absolute errors": loss(squared=0.0, silhouette=0.0, absolute=0.2, outline=0.1),
        "absolute coverage": loss(outline=0.1),
        "depth": loss(depth=0.3),
        "distortion": loss(distortion=1.0),
        "opaque": loss(opaque=0.003),
        "one shell": loss(shells=3.0),
    }


def network_variants(base):
    """Name -> (configuration, settings of the on-the-fly people): changes of the network, from fresh weights."""
    replace, model = dataclasses.replace, base.model
    parts = model.architecture
    bare = model.with_parts(reader=replace(parts.reader, shells=()))
    canonical = bare.with_parts(decoder=replace(parts.decoder, frame="canonical"))
    fine = model.with_parts(decoder=replace(parts.decoder, free=1))
    fine = fine.with_conventions(body_vertices=6000, longest_edge=0.02)
    networks = {
        FIRST: model,
        "no shells": bare,
        "no shells, Gaussians in the canonical frame": canonical,
        "edges to 2 cm, K = 2": fine,
    }
    return {name: (replace(base, model=network), {}) for name, network in networks.items()}


def run(arguments, parser) -> None:
    """Make the runs that are missing, then write the table."""
    from experiments.common.results import check_section, write_json
    from experiments.evaluation.results import file_digest
    from humangs_jax.core.configuration import config_to_json
    from humangs_jax.network.weights import load_weights
    from humangs_jax.training.config import LossConfig, small
    from humangs_jax.training.optimizer import OptimizerConfig

    variables, model = load_weights(arguments.start)
    base = small()
    base = dataclasses.replace(
        base,
        model=model.with_execution(token_capacity=TOKENS),
        views=dataclasses.replace(base.views, input_counts=(4,), target_count=4),
        loss=LossConfig(),
        optimizer=OptimizerConfig(learning_rate=4e-4, warmup_steps=20),
        steps=arguments.steps,
        validate_every=arguments.steps,
        checkpoint_every=arguments.steps,
    )
    runs = {"training": training_variants, "network": network_variants, "fog": fog_variants}[arguments.of](base)
    names = arguments.only or list(runs)
    if unknown := set(names) - set(runs):
        parser.error(f"--only {sorted(unknown)}: expected names of {', '.join(runs)}")
    start = None if arguments.of == "network" else file_digest(arguments.start) if arguments.start else "shipped"
    settings = {"steps": arguments.steps, "start": start, "bank": file_digest(arguments.bank)}
    path, table = arguments.out / "pilots.json", TABLE if arguments.of == "training" else f"{TABLE}_{arguments.of}"
    try:
        check_section(arguments.page, table)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    if FIRST not in {*names, *kept(path, settings, parser)}:
        parser.error(f"--only: the others are compared with {FIRST!r}, which is not in {path}")
    for name in names:
        if name in kept(path, settings, parser):
            continue
        config, on_the_fly = runs[name]
        started = None if arguments.of == "network" else (variables, model)
        row = pilot(arguments, config, on_the_fly, started, name.replace(" ", "_").replace(",", ""))
        row |= {"steps": config.steps, "config": json.loads(config_to_json(config)), "on_the_fly": on_the_fly}
        rows = kept(path, settings, parser) | {name: row}  # another process may have added to it
        write_json(path, {"settings": settings, "runs": rows})
    write_table(arguments.page, kept(path, settings, parser), table)


def kept(path, settings, parser):
    """The runs in a file, {} without a file; exits with a message if they had other settings."""
    if not path.is_file():
        return {}
    report = json.loads(path.read_text())
    if report["settings"] != settings:
        parser.error(f"{path} has runs of other settings, {report['settings']}: give another --out")
    return report["runs"]


def pilot(arguments, config, on_the_fly, started, name) -> dict:
    """One run: scores on the validation people with 4 inputs and 6 targets each, and CPU seconds."""
    import jax

    from experiments.training.grow import fit_variables
    from humangs_jax.body.library import load_body
    from humangs_jax.data.loader import find_captures
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.objectives.metrics import outline_psnr
    from humangs_jax.people.bank import load_bank
    from humangs_jax.people.on_the_fly import OnTheFlyConfig
    from humangs_jax.training.loop import train
    from humangs_jax.training.sources import captured_people, mixed_people, on_the_fly_people
    from humangs_jax.training.validation import validate, validation_examples

    body, begin = load_body(), time.process_time()
    people = [on_the_fly_people(load_bank(arguments.bank), OnTheFlyConfig(**on_the_fly))]
    if arguments.people:
        people.insert(0, captured_people(find_captures(arguments.people), body))
    variables = None if started is None else fit_variables(*started, config.model)
    state = train(
        config, body, mixed_people(people, [1] * len(people)), arguments.out / name, variables=variables, progress=False
    )
    if int(state.step) < config.steps:
        raise SystemExit(f"interrupted at step {int(state.step)} of {name!r}; the same command goes on there")
    seconds = time.process_time() - begin
    # the same validation for all runs
    views = dataclasses.replace(config.views, input_counts=(4,), target_count=6)
    compared = dataclasses.replace(config, views=views)
    folders = find_captures(arguments.validation)
    examples = validation_examples(captured_people(folders, body), compared, len(folders))
    numbers, shown = validate(jax.device_get(state.variables), gaussian_body(body, config.model), examples, compared)
    bands = [
        outline_psnr(*view)
        for example, images in zip(examples, shown, strict=True)
        for view in zip(images, example.targets.images, example.targets.masks, strict=True)
    ]
    numbers["psnr_outline"] = sum(bands) / len(bands)
    return {key: numbers[key] for key in COLUMNS} | {"cpu_seconds": seconds}


def write_table(page: Path, rows: dict, table: str) -> None:
    """One row a run, each score as a difference to the first."""
    from experiments.common.results import markdown_table, publish

    first = rows[FIRST]
    lines = []
    for name, row in rows.items():
        texts = []
        for key, (_, digits) in COLUMNS.items():
            change = row[key] if name == FIRST else row[key] - first[key]
            texts.append(f"{change:{'' if name == FIRST else '+'}.{digits}f}")
        lines.append([name, *texts, row["steps"], f"{row['cpu_seconds']:.0f}"])
    header = ["run", *(heading for heading, _ in COLUMNS.values()), "steps", "CPU s"]
    # the configurations stay in the runs' own file
    numbers = {name: {key: value for key, value in row.items() if key != "config"} for name, row in rows.items()}
    publish(page, table, markdown_table(header, lines), numbers)


if __name__ == "__main__":
    main()
