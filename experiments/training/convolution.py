"""One 3x3 convolution with its gradients, alone and in a loop, as XLA differentiates it and as the network does.

    python experiments/training/convolution.py --json OUT --page docs/performance_training.md

A round gives the result, and the gradients of the map and of the kernel. "Alone" is one program; in a loop it is the
body of a loop over ROUNDS maps, as a training step is one over its microbatches, and the time is divided by ROUNDS. "ours" is
`humangs_jax/network/convolution.py`. CPU time of all threads, float32, the three in turns. It runs on the CPU whatever else is
there: elsewhere both are the same program. Two minutes on one core, nearly all of them in the loop as XLA differentiates it.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import medians, prepare_process
from experiments.common.results import add_outputs, markdown_table, write_outputs

MAPS = ((4, 16, 16, 256, 128), (4, 64, 64, 128, 128))
"""Views, height, width, channels in, channels out."""
ROUNDS = 2
"""XLA unrolls a loop of one."""
WAYS = ("alone", "in a loop, as XLA differentiates it", "in a loop, ours")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3, help="timed rounds")
    add_outputs(parser, "convolution")
    arguments = parser.parse_args()
    prepare_process()
    result = benchmark(MAPS, arguments.repeats)
    write_outputs(arguments, "convolution", table(result), result)


def benchmark(maps: Sequence[tuple[int, int, int, int, int]], repeats: int) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    jax.config.update("jax_platforms", "cpu")
    load = os.getloadavg()[0]
    return {
        "maps": [{"shape": shape, "cpu_ms": measure(shape, repeats)} for shape in maps],
        "rounds": ROUNDS,
        "repeats": repeats,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load_average": load,
        "jax": jax.__version__,
    }


def measure(shape: tuple[int, int, int, int, int], repeats: int) -> dict[str, float]:
    """CPU ms of one round, each way."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.network.convolution import KERNEL, LAYOUT, convolve

    views, height, width, channels, features = shape
    plain = lambda x, kernel: jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=LAYOUT)
    shapes = (views, height, width, channels), (KERNEL, KERNEL, channels, features), (views, height, width, features)
    x, kernel, cotangent = (jax.random.normal(jax.random.key(i), s, jnp.float32) for i, s in enumerate(shapes))

    def with_gradients(convolution):
        def one_round(kernel, x, cotangent):
            y, transpose = jax.vjp(convolution, x, kernel)
            return y, transpose(cotangent)

        return one_round

    def looped(convolution):
        return lambda kernel, *inputs: jax.lax.map(lambda one: with_gradients(convolution)(kernel, *one), inputs)

    def run(function, *inputs):
        program = jax.jit(function).lower(kernel, *inputs).compile()
        return lambda: jax.block_until_ready(program(kernel, *inputs))

    many = jnp.stack([x] * ROUNDS), jnp.stack([cotangent] * ROUNDS)
    alone = run(with_gradients(plain), x, cotangent)
    runs = dict(zip(WAYS, (alone, run(looped(plain), *many), run(looped(convolve), *many)), strict=True))
    times = medians(runs, repeats)
    return {name: float(times[name][1]) / (1 if name == "alone" else ROUNDS) for name in WAYS}


def table(result: dict[str, Any]) -> str:
    """Markdown: one line per map, and how it was measured."""
    name = lambda shape: " x ".join(map(str, shape[:4])) + f" -> {shape[4]}"
    rows = [[name(row["shape"]), *(f"{row['cpu_ms'][way]:.0f}" for way in WAYS)] for row in result["maps"]]
    cores = f"{result['cores']} core" + "s" * (result["cores"] > 1)
    how = f"{cores}, jax {result['jax']}, load {result['load_average']:.1f}, {result['repeats']} timed."
    return f"{markdown_table(['CPU ms', *WAYS], rows)}\n\n{how}"


if __name__ == "__main__":
    main()
