"""Reconstruct unseen synthetic people from a few photos and compare with held-out views.

    python experiments/evaluate_synthetic.py --subjects 8 --views 4 --json evaluation.json [--pictures sheet.png]

Subjects are drawn from the test seeds (`humangs_jax.data.synthetic.seeds`), which training never sees; choices are made
on `--split validation`. Prints a table, one row a subject, and writes {"psnr", "ssim", "psnr_foreground",
"baseline_psnr", "baseline_psnr_foreground", "foreground", "subjects": [...]}. The baseline is the body mesh, each vertex
painted with the mean photo colour over the input views that see it (grey where none does). About 8 s a subject on 2 CPU
cores.
"""

import argparse
import dataclasses
import json
import os
import tempfile
from pathlib import Path


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
    arguments = parser.parse_args()
    if arguments.subjects < 1 or arguments.views < 1 or arguments.held_out < 1:
        parser.error("--subjects, --views and --held-out must be at least 1")
    result = evaluate(arguments)
    if arguments.json:
        temporary = arguments.json.with_name(f".{arguments.json.name}.part")
        temporary.write_text(json.dumps(result, indent=2) + "\n")
        os.replace(temporary, arguments.json)


def evaluate(arguments: argparse.Namespace) -> dict:
    """Make, reconstruct and score every subject; means over subjects and the rows."""
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

    body, (variables, config) = load_body(), load_weights(arguments.weights)
    config = dataclasses.replace(config, tokens=arguments.tokens or config.tokens)
    rows, pictures = [], []
    print(f"{'subject':>8}{'PSNR':>8}{'SSIM':>8}{'fg PSNR':>9}{'base':>8}{'base fg':>9}{'share':>8}")
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
            }
            rows.append(row)
            pictures += [x for i in (0, truth.view_count // 2) for x in (truth.images[i], ours[i], painted[i])]
            print(
                f"{index:8d}{scores.psnr:8.2f}{scores.ssim:8.3f}{scores.psnr_foreground:9.2f}{baseline.psnr:8.2f}"
                f"{baseline.psnr_foreground:9.2f}{scores.foreground:8.3f}",
                flush=True,
            )
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "seed"}
    print(
        f"{'mean':>8}{means['psnr']:8.2f}{means['ssim']:8.3f}{means['psnr_foreground']:9.2f}{means['baseline_psnr']:8.2f}"
        f"{means['baseline_psnr_foreground']:9.2f}{means['foreground']:8.3f}"
    )
    if arguments.pictures:
        contact_sheet(
            np.stack(pictures),
            arguments.pictures,
            labels=["truth", "ours", "painted body"] * (len(pictures) // 3),
            columns=6,
        )
    return {
        **means,
        "split": arguments.split,
        "tokens": config.tokens,
        "views": arguments.views,
        "image_size": arguments.size,
        "subjects": rows,
    }


if __name__ == "__main__":
    main()
