"""What the loss networks cost for one pair of images: counted arithmetic, memory, time, alone and with the gradient.

    python experiments/training/loss_networks.py --json OUT [--page docs/loss_networks.md]

Weights are random: time does not depend on them. Counted are the multiplications and additions of the convolutions in the
compiled program (experiments/common/compiled_costs.py); memory is what the program needs besides arguments and results. CPU time
is that of all threads, the least of --repeats. About 2 minutes on 2 idle CPU cores.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_outputs(parser, "loss_networks")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="sides of the images, pixels")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()

    rows = [row for size in arguments.sizes for row in measure(size, arguments.repeats)]
    write_outputs(arguments, "loss_networks", table(rows), rows)


HEADER = ("loss", "side", "GFLOP", "with gradient", "MiB", "with gradient", "CPU s", "with gradient")


def measure(size: int, repeats: int) -> list[dict]:
    """One row for each network."""
    import jax
    import jax.numpy as jnp

    from experiments.common.compiled_costs import compiled_costs
    from experiments.common.interleaved import prepare_process, timed
    from humangs_jax.objectives.backbones import channels, random_weights
    from humangs_jax.objectives.lpips import BACKBONES, Lpips, lpips
    from humangs_jax.objectives.perceptual import VGG19, Vgg19, perceptual_loss

    prepare_process()
    key = jax.random.key(0)
    losses = {"perceptual (VGG-19)": (perceptual_loss, Vgg19(random_weights(key, VGG19)))}
    for net, slices in BACKBONES.items():
        heads = tuple(jnp.ones(count) for count in channels(slices))
        losses[f"LPIPS {net}"] = (lpips, Lpips(random_weights(key, slices), heads, net))
    images = jax.random.uniform(key, (2, size, size, 3))
    rows = []
    for name, (loss, weights) in losses.items():
        row = {"loss": name, "size": size, "platform": jax.devices()[0].platform, "jax": jax.__version__}
        for kind, function in (("forward", loss), ("gradient", jax.value_and_grad(loss, 1))):
            compiled = jax.jit(function).lower(weights, *images).compile()
            costs = compiled_costs(compiled)
            run = lambda compiled=compiled, weights=weights: jax.block_until_ready(compiled(weights, *images))
            run()
            wall, cpu = (min(times) for times in zip(*(timed(run) for _ in range(repeats)), strict=True))
            row[kind] = {
                "gflop": (costs.convolution_flops + costs.dot_flops) / 1e9,
                "temporary_mib": costs.temporary_bytes / 2**20,
                "cpu_seconds": cpu / 1e3,
                "wall_seconds": wall / 1e3,
            }
        print(row, file=sys.stderr, flush=True)
        rows.append(row)
    return rows


def table(rows: list[dict]) -> str:
    """One line for each network and size."""
    return markdown_table(HEADER, [format_row(row) for row in rows])


def format_row(row: dict) -> list[str]:
    """Cells of a row of the table."""
    pair = lambda field, digits: [f"{row[kind][field]:.{digits}f}" for kind in ("forward", "gradient")]
    numbers = [*pair("gflop", 0), *pair("temporary_mib", 0), *pair("cpu_seconds", 2)]
    return [row["loss"], str(row["size"]), *numbers]


if __name__ == "__main__":
    main()
