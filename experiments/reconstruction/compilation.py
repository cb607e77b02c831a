"""What the transformer's loop over layers and its recomputation cost and save: compile time, memory, arithmetic.

    python experiments/reconstruction/compilation.py --preset published --tokens 4096 --json OUT

Compiles (and does not run) the blocks and their gradient, unrolled and as a loop (`TransformerConfig.scan`), keeping
everything for the backward pass, recomputing all but the products with weights (`remat_policy = "dots"`), and all.
Half a minute on 2 cores. Numbers: docs/performance_reconstruction.md.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any, cast

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.compiled_costs import compiled_costs
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.reconstruction.benchmark import configured

RECOMPUTED = {
    "nothing": "none",
    "all but products with weights": "dots",
    "blocks": "full",
}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="published", help="published, paper, small or tiny")
    parser.add_argument("--tokens", type=int, default=4096, help="4 views of 256 x 256: 4096")
    parser.add_argument(
        "--dtype", choices=("auto", "float32", "bfloat16"), default="auto", help="auto: float32 on a CPU"
    )
    add_outputs(parser, "transformer_compilation")
    arguments = parser.parse_args()
    result = measure(arguments)
    write_outputs(arguments, "transformer_compilation", table(result), result)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)
    config = configured(arguments.preset, arguments.dtype, 256)
    rows = []
    for scan in (False, True):
        for recomputed, how in RECOMPUTED.items():
            case = config.with_execution(scan=scan, remat=how)
            rows.append({"scan": scan, "recomputed": recomputed, **compilation(case, arguments.tokens)})
    return {
        "rows": rows,
        "preset": arguments.preset,
        "tokens": arguments.tokens,
        "dtype": config.execution.dtype,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def compilation(config: Any, tokens: int) -> dict[str, float]:
    """Seconds to trace and compile, MiB of temporaries and matrix operations, forward and with gradients."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.network.transformer import Transformer

    transformer = config.architecture.encoder.transformer
    module = Transformer(transformer, config.execution)
    variables = jax.eval_shape(module.init, jax.random.key(0), jnp.zeros((2, transformer.width)))
    x = jax.ShapeDtypeStruct((tokens, transformer.width), jnp.float32)
    forward = lambda variables, x: cast(list[Any], module.apply(variables, x))
    loss = lambda variables, x: sum(jnp.sum(output**2) for output in forward(variables, x))
    result = {}
    for name, function in (("forward", forward), ("gradient", jax.grad(loss))):
        start = time.perf_counter()
        program = jax.jit(function).lower(variables, x).compile()
        seconds = time.perf_counter() - start
        costs = compiled_costs(program)
        result |= {f"{name}_compile_s": seconds, f"{name}_mb": costs.temporary_bytes / 2**20}
        result[f"{name}_flops"] = costs.matrix_flops
    return result


def table(result: dict[str, Any]) -> str:
    """The rows as text."""
    header = ["recomputed", "layers", "compile s, forward", "gradient", "MiB, forward", "gradient", "GFLOP, gradient"]
    rows = [
        [
            row["recomputed"],
            "looped" if row["scan"] else "unrolled",
            f"{row['forward_compile_s']:.1f}",
            f"{row['gradient_compile_s']:.1f}",
            f"{row['forward_mb']:.0f}",
            f"{row['gradient_mb']:.0f}",
            f"{row['gradient_flops'] / 1e9:.0f}",
        ]
        for row in result["rows"]
    ]
    return markdown_table(header, rows)


if __name__ == "__main__":
    main()
