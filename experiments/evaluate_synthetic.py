"""Reconstruct unseen synthetic people from a few photos and compare with held-out views.

    python experiments/evaluate_synthetic.py --subjects 8 --views 4 --json evaluation.json [--pictures sheet.png]

Subjects are drawn from the test seeds (`humangs_jax.data.synthetic.seeds`), which training never sees; choices are made
on `--split validation`. Prints a table, one row a subject, and writes {"psnr", "ssim", "lpips", "psnr_foreground",
"baseline_psnr", "baseline_psnr_foreground", "baseline_lpips", "foreground", "subjects": [...]}. LPIPS needs weights
(`--lpips-backbone`, docs/loss_networks.md); without them it is missing: null, and a dash in the table. The baseline is
the body mesh, each vertex painted with the mean photo colour over the input views that see it (grey where none does).
About 8 s a subject on 2 CPU cores.
"""

import argparse
import dataclasses
import json
import os
import tempfile
from pathlib import Path

COLUMNS = {  # heading and digits
    "psnr": ("PSNR", 2),
    "ssim": ("SSIM", 3),
    "lpips": ("LPIPS", 4),
    "psnr_foreground": ("fg PSNR", 2),
    "baseline_psnr": ("base", 2),
    "baseline_psnr_foreground": ("base fg", 2),
    "baseline_lpips": ("base LPIPS", 4),
    "foreground": ("share", 3),
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--subjects", type=int, default=8, help="how many people")
    parser.add_argument("--views", type=int, default=4, help="photos that the network sees")
    parser.add_argument("--held-out", type=int, default=8, help="views to compare with")
    parser.add_argument("--size", type=int, default=256, help="side of the photos in pixels")
    parser.add_argument("--first", type=int, default=0, help="index of the first subject within the split")
    parser.add_argument("--weights", type=Path, help="weights file; the shipped ones if not given")
    parser.add_argument("--split", choices=("validation", "test"), default="test", help="whom to look at")
    parser.add_argument(
        "--tokens",
        choices=("all", "foreground"),
        help="patches that the network looks at; as it was trained if not given",
    )
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument(
        "--pictures", type=Path, help="write truth, ours and baseline of two views of every subject here"
    )
    parser.add_argument("--lpips-backbone", type=Path, help="weights of the network under LPIPS")
    parser.add_argument("--lpips-heads", type=Path, help="heads of LPIPS, where the backbone's file does not have them")
    parser.add_argument("--lpips-net", choices=("vgg", "alex", "squeeze"), default="vgg", help="which network that is")
    arguments = parser.parse_args()
    if arguments.subjects < 1 or arguments.views < 1 or arguments.held_out < 1:
        parser.error("--subjects, --views and --held-out must be at least 1")
    from humangs_jax.objectives.loss_networks import load_loss_networks

    try:
        networks = load_loss_networks(None, arguments.lpips_backbone, arguments.lpips_heads, arguments.lpips_net)
    except (ValueError, OSError) as error:
        parser.error(str(error))
    result = evaluate(arguments, networks.lpips)
    if arguments.json:
        temporary = arguments.json.with_name(f".{arguments.json.name}.part")
        temporary.write_text(json.dumps(result, indent=2) + "\n")
        os.replace(temporary, arguments.json)


def evaluate(arguments: argparse.Namespace, lpips=None) -> dict:
    """Make, reconstruct and score every subject; means over subjects and the rows. lpips: its weights, if there are any."""
    import numpy as np

    from humangs_jax.avatar.evaluate import draw_painted_body, painted_body, score
    from humangs_jax.avatar.frames import capture_renderings
    from humangs_jax.avatar.pictures import contact_sheet
    from humangs_jax.avatar.reconstruct import reconstruct
    from humangs_jax.body.library import load_body
    from humangs_jax.data.capture import load_capture
    from humangs_jax.data.synthetic.seeds import SPLITS
    from humangs_jax.data.synthetic.writer import write_subject
    from humangs_jax.models.weights import load_weights

    lpips_of = lpips_scorer(lpips)
    body, (variables, config) = load_body(), load_weights(arguments.weights)
    config = dataclasses.replace(config, tokens=arguments.tokens or config.tokens)
    rows, pictures = [], []
    print(f"{'subject':>8}" + "".join(f"{heading:>11}" for heading, _ in COLUMNS.values()))
    if lpips is None:
        print("LPIPS is missing: no --lpips-backbone given")
    with tempfile.TemporaryDirectory() as folder:
        for index in range(arguments.first, arguments.first + arguments.subjects):
            seed = SPLITS[arguments.split][index]
            path = Path(folder) / f"subject_{index:05d}"
            write_subject(
                path,
                seed,
                body=body,
                image_size=arguments.size,
                input_views=arguments.views,
                held_out_views=arguments.held_out,
            )
            inputs, truth = load_capture(path, body=body), load_capture(path / "held_out", body=body)
            avatar = reconstruct(variables, config, inputs)
            ours = np.stack([np.asarray(r.rgb) for r in capture_renderings(avatar, truth)[1]])
            painted = draw_painted_body(painted_body(inputs), truth)
            scores, baseline = score(ours, truth), score(painted, truth)
            row = {
                "seed": seed,
                **dataclasses.asdict(scores),
                "baseline_psnr": baseline.psnr,
                "baseline_psnr_foreground": baseline.psnr_foreground,
                "lpips": lpips_of(ours, truth.images),
                "baseline_lpips": lpips_of(painted, truth.images),
            }
            rows.append(row)
            pictures += [x for i in (0, truth.view_count // 2) for x in (truth.images[i], ours[i], painted[i])]
            print(f"{index:8d}{table_row(row)}", flush=True)
    known = [key for key, value in rows[0].items() if key != "seed" and value is not None]
    means = {key: float(np.mean([row[key] for row in rows])) if key in known else None for key in COLUMNS}
    print(f"{'mean':>8}{table_row(means)}")
    if arguments.pictures:
        contact_sheet(
            np.stack(pictures),
            arguments.pictures,
            labels=["truth", "ours", "painted body"] * (len(pictures) // 3),
            columns=6,
        )
    return {
        **means,
        "lpips_net": arguments.lpips_net if lpips else None,
        "split": arguments.split,
        "tokens": config.tokens,
        "views": arguments.views,
        "image_size": arguments.size,
        "subjects": rows,
    }


def lpips_scorer(weights):
    """The mean LPIPS of pictures (v, h, w, 3), clipped to [0, 1], against true ones; None for any without weights."""
    if weights is None:
        return lambda predicted, truth: None
    import jax
    import numpy as np

    from humangs_jax.objectives.lpips import lpips

    distance = jax.jit(lpips)

    def mean(predicted, truth):
        pairs = zip(np.clip(np.asarray(predicted), 0, 1), np.asarray(truth), strict=True)
        return float(np.mean([distance(weights, *pair) for pair in pairs]))

    return mean


def table_row(row: dict) -> str:
    """The numbers of a row; a dash for what is missing."""
    texts = ["-" if row[key] is None else f"{row[key]:.{digits}f}" for key, (_, digits) in COLUMNS.items()]
    return "".join(f"{text:>11}" for text in texts)


if __name__ == "__main__":
    main()
