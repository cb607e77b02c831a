"""Where the error of reconstructions is: at the silhouette, in holes, in the colors of the person, or around the person.

    python experiments/evaluation/error_shares.py PEOPLE --weights before=OLD.safetensors now= [--sizes 256 512]
        [--views 4] [--targets 6] [--json OUT] [--page docs/evaluation.md]

PEOPLE is a folder of captures with masks, such as `humangs synth --poses 2 --views 12 --close-views 0` writes them. NAME=
without a file stands for the shipped weights. Numbers are means over all views of all people: PSNR; PSNR of the predicted
colors under the true coverage; shares of the squared error; semi-transparent foreground, also of the true images. About 20 s and
2 s a person on 2 CPU cores.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs

BAND = 3
"""Pixels to either side that count as the silhouette."""
LEAST_COVERAGE = 0.05
"""Below this coverage the predicted color is undefined; the true one is used."""
TABLE = "evaluation_error_shares"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("people", type=Path, help="folder of capture folders")
    parser.add_argument("--weights", nargs="+", default=["shipped="], metavar="NAME=FILE", help="weights to compare")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256], help="sides of photos and targets, pixels")
    parser.add_argument("--views", type=int, default=4, help="photos that the network sees")
    parser.add_argument("--targets", type=int, default=6, help="other views of each person")
    add_outputs(parser, TABLE)
    arguments = parser.parse_args()
    if arguments.views < 1 or arguments.targets < 1:
        parser.error("--views and --targets must be at least 1")
    if unnamed := [pair for pair in arguments.weights if "=" not in pair]:
        parser.error(f"--weights: expected NAME=FILE, got {unnamed[0]}")
    columns = {}
    for size in arguments.sizes:
        for name, file in (pair.split("=", 1) for pair in arguments.weights):
            columns[f"{name}, {size} px"] = measure(arguments, Path(file) if file else None, size)
    write_outputs(arguments, TABLE, section(columns), columns)


def section(columns: dict[str, dict[str, float]]) -> str:
    """The table: a column for each size and weights."""
    rows = [
        [name, *(f"{column[name]:.{2 if name.startswith('PSNR') else 3}f}" for column in columns.values())]
        for name in next(iter(columns.values()))
        if name != "squared error"
    ]
    return markdown_table(["", *columns], rows)


def measure(arguments: argparse.Namespace, weights: Path | None, size: int) -> dict[str, float]:
    """Means over people and views; shares are of the squared error of all."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from humangs_jax.body.library import load_body
    from humangs_jax.data.loader import ViewSampling, find_captures
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.network.weights import load_weights
    from humangs_jax.training.config import TrainConfig
    from humangs_jax.training.forward import predict
    from humangs_jax.training.sources import captured_people
    from humangs_jax.training.validation import validation_examples

    variables, model = load_weights(weights)
    model = model.with_conventions(image_size=size)
    views = ViewSampling(input_counts=(arguments.views,), target_count=arguments.targets)
    config = TrainConfig(model=model, views=views)
    body = load_body()
    folders = find_captures(arguments.people)
    examples = validation_examples(captured_people(folders, body), config, len(folders))
    body = gaussian_body(body, model)
    draw = jax.jit(predict, static_argnames="config")
    rows = []
    for example in examples:
        drawn, _ = draw(variables, body, example, config)
        targets = example.targets
        pictures = zip(*(np.asarray(x) for x in (drawn.rgb, drawn.alpha, targets.images, targets.masks)), strict=True)
        same = jnp.max(jnp.abs(targets.rotations - example.inputs.rotations[:1]), axis=(1, 2)) < 1e-3
        for pose, picture in zip(np.asarray(same), pictures, strict=True):
            found = shares(*picture)
            psnr = found.pop("PSNR")
            rows.append({f"PSNR, {'pose of the photos' if pose else 'other poses'}, dB": psnr, **found})
    names = dict.fromkeys(sorted({name for row in rows for name in row}, key=_order))
    means = {name: float(np.mean([row[name] for row in rows if name in row])) for name in names}
    total = means["squared error"]
    return {name: value / total if name.startswith("share") else value for name, value in means.items()}


def _order(name):
    """PSNR, then shares of the error, then semi-transparent foreground."""
    return not name.startswith("PSNR"), name.startswith("semi_transparent"), name


def shares(rgb, alpha, image, mask) -> dict[str, float]:
    """Squared error of one image by place, its PSNR, also under the true coverage, and semi-transparent foreground. (h, w, 3)
    and (h, w).
    """
    import jax.numpy as jnp
    import numpy as np
    from scipy import ndimage

    from humangs_jax.losses import metrics

    psnr = lambda drawn: float(metrics.psnr(jnp.asarray(drawn), jnp.asarray(image)))
    error = ((np.clip(rgb, 0, 1) - image) ** 2).mean(-1)
    inner = ndimage.binary_erosion(mask > 0.5, iterations=BAND)
    outer = ~ndimage.binary_dilation(mask > 0.5, iterations=BAND)
    color = np.clip((rgb - (1 - alpha[..., None])) / np.maximum(alpha, LEAST_COVERAGE)[..., None], 0, 1)
    color = np.where(alpha[..., None] > LEAST_COVERAGE, color, image)
    covered = color * mask[..., None] + 1 - mask[..., None]
    return {
        "PSNR": psnr(rgb),
        "PSNR with the true silhouette and the predicted colors, dB": psnr(covered),
        "squared error": float(error.mean()),
        "share at the silhouette": float((error * ~(inner | outer)).mean()),
        "share in holes": float((error * (1 - alpha) * inner).mean()),
        "share in colors": float((error * alpha * inner).mean()),
        "share around the person": float((error * outer).mean()),
        "semi_transparent": float(metrics.semi_transparent(jnp.asarray(alpha), jnp.asarray(mask))),
        "semi_transparent of the true images": float(metrics.semi_transparent(jnp.asarray(mask), jnp.asarray(mask))),
    }


if __name__ == "__main__":
    main()
