"""What matters when training: short runs that differ in one setting each, from the same start, compared on the same people.

    python experiments/train_pilots.py --bank runs/people.npz --people people --validation unseen --out runs/pilots
    python experiments/train_pilots.py ... --only "as it is" "rate 1e-3" --steps 150

Every run is whole: its learning rate ends at 0. The table is written to docs/training.md, the numbers to OUT/pilots.json; runs
that are in there are not repeated. About 5 CPU minutes a run of 150 steps.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

FIRST, MARK = "as it is", "pilots"
DOCS = Path(__file__).resolve().parents[1] / "docs" / "training.md"
TOKENS = 1024
"""For 4 photographs of 256 pixels."""
COLUMNS = ("psnr", "psnr_mask", "ssim")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bank", type=Path, required=True, help="live people: the people.npz of a run with --live")
    parser.add_argument("--people", type=Path, required=True, help="captures, mixed with the live people by halves")
    parser.add_argument("--validation", type=Path, required=True, help="captures of other people")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--start", type=Path, help="weights to start from; the shipped ones if not given")
    parser.add_argument("--fresh", action="store_true", help="start from nothing; has a table of its own")
    parser.add_argument("--steps", type=int, default=150, help="of each run")
    parser.add_argument("--only", nargs="+", help="names of the runs to make; all if not given")
    parser.add_argument("--docs", type=Path, default=DOCS, help="page with the table")
    arguments = parser.parse_args()
    from humangs_jax.allocator import keep_freed_memory

    keep_freed_memory()
    run(arguments, parser)


def variants(base, model):
    """Name -> (configuration, settings of the live people)."""
    replace = dataclasses.replace
    view = lambda **changes: replace(base, views=replace(base.views, **changes))
    loss = lambda **changes: replace(base, loss=replace(base.loss, **changes))
    rate = lambda x: replace(base, optimizer=replace(base.optimizer, learning_rate=x))
    k = lambda free: replace(base, model=replace(model, decoder=replace(model.decoder, free=free)))
    bare = replace(base, model=replace(model, sampling=replace(model.sampling, shells=())))
    published = replace(bare, model=replace(bare.model, decoder=replace(model.decoder, frame="canonical")))
    body = lambda vertices, edge, free: replace(
        base,
        model=replace(model, body_vertices=vertices, longest_edge=edge, decoder=replace(model.decoder, free=free)),
    )
    return {
        FIRST: (base, {}),
        "no shells": (bare, {}),
        "no shells, Gaussians in the canonical frame": (published, {}),
        "edges to 2 cm, K = 2": (body(6000, 0.02, 1), {}),
        "rate 1e-3": (rate(1e-3), {}),
        "rate 2e-4": (rate(2e-4), {}),
        "2 subjects a step, half of the steps": (replace(base, batch_size=2, steps=base.steps // 2), {}),
        "2 targets": (view(target_count=2), {}),
        "1, 2, 4, 4 or 6 inputs": (
            replace(
                view(input_counts=(1, 2, 4, 4, 6)),
                model=replace(model, token_capacity=model.token_capacity * 7 // 5),
            ),
            {},
        ),
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


def run(arguments, parser) -> None:
    """Make the runs that are missing, then write the table."""
    from report_tables import write_json

    from humangs_jax.configuration import config_to_json
    from humangs_jax.models.weights import load_weights
    from humangs_jax.training.config import LossConfig, small
    from humangs_jax.training.optimizer import OptimizerConfig

    variables, model = load_weights(arguments.start)
    base = small()
    base = dataclasses.replace(
        base,
        model=dataclasses.replace(model, token_capacity=TOKENS),
        views=dataclasses.replace(base.views, input_counts=(4,), target_count=4),
        loss=LossConfig(),
        optimizer=OptimizerConfig(learning_rate=4e-4, warmup_steps=20),
        steps=arguments.steps,
        validate_every=arguments.steps,
        checkpoint_every=arguments.steps,
    )
    if arguments.fresh:
        variables = {"params": {}, "batch_stats": {}}
    runs = variants(base, base.model)
    if unknown := set(arguments.only or ()) - set(runs):
        parser.error(f"--only {sorted(unknown)}: expected names of {', '.join(runs)}")
    path = arguments.out / "pilots.json"
    for name in arguments.only or runs:
        rows = json.loads(path.read_text()) if path.is_file() else {}
        if name in rows:
            continue
        config, live = runs[name]
        row = pilot(arguments, config, live, variables, name.replace(" ", "_").replace(",", ""))
        rows = json.loads(path.read_text()) if path.is_file() else {}  # another process may have added to it
        rows[name] = row | {"steps": config.steps, "config": json.loads(config_to_json(config)), "live": live}
        write_json(path, rows)
    write_table(arguments.docs, json.loads(path.read_text()), f"{MARK}, fresh" if arguments.fresh else MARK)


def pilot(arguments, config, live, variables, name) -> dict:
    """One run: scores on the validation people with 4 inputs and 6 targets each, and CPU seconds."""
    import jax

    from humangs_jax.body.library import load_body
    from humangs_jax.data.loader import CaptureCache, find_captures
    from humangs_jax.data.synthetic.live import LiveConfig
    from humangs_jax.data.synthetic.live_bank import load_bank
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.models.weights import fit_variables
    from humangs_jax.training.loop import train
    from humangs_jax.training.sources import captured_people, live_people, mixed_people
    from humangs_jax.training.validation import validate, validation_examples

    body, begin = load_body(), time.process_time()
    people = [
        captured_people(find_captures(arguments.people), body),
        live_people(load_bank(arguments.bank), LiveConfig(**live)),
    ]
    started = fit_variables(variables, config.model)
    state = train(config, body, mixed_people(people, [1, 1]), arguments.out / name, variables=started, progress=False)
    seconds = time.process_time() - begin
    # compared alike, whatever the run saw
    views = dataclasses.replace(config.views, input_counts=(4,), target_count=6)
    compared = dataclasses.replace(config, views=views)
    cache = CaptureCache(find_captures(arguments.validation), body)
    examples = validation_examples(cache, compared, len(cache))
    numbers, _ = validate(jax.device_get(state.variables), gaussian_body(body, config.model), examples, compared)
    return {key: numbers[key] for key in COLUMNS} | {"cpu_seconds": seconds}


def write_table(page: Path, rows: dict, mark: str) -> None:
    """One row a run, each score as a difference to the first."""
    from report_tables import markdown_table, write_section

    first = rows[FIRST]
    lines, forms = [], {True: ("{:.2f}", "{:.2f}", "{:.4f}"), False: ("{:+.2f}", "{:+.2f}", "{:+.4f}")}
    for name, row in rows.items():
        scores = [row[key] if name == FIRST else row[key] - first[key] for key in COLUMNS]
        texts = [form.format(score) for form, score in zip(forms[name == FIRST], scores, strict=True)]
        lines.append([name, *texts, row["steps"], f"{row['cpu_seconds']:.0f}"])
    header = ["run", "PSNR, dB", "in the foreground, dB", "SSIM", "steps", "CPU s"]
    write_section(page, mark, markdown_table(header, lines))


if __name__ == "__main__":
    main()
