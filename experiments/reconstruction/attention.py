"""Exact attention on this machine: ours in blocks against `jax.nn.dot_product_attention`, in turns with a matrix product.

    python experiments/reconstruction/attention.py --tokens 1537 4097 --heads 12 --json OUT

Forward and with gradients, CPU ms of all threads, and the ratio to those of the same operations as plain products
(gradients: 3.5 times the forward operations); memory by XLA's analysis. A minute on 2 cores. Numbers:
docs/performance_reconstruction.md.
"""

import argparse
import functools
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.interleaved import medians, prepare_process
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.reconstruction.cases import compiled, matmul_program

FORMS = ("chunked", "xla")
GRADIENT_PRODUCTS = 3.5
"""Seven products where the forward pass has two: logits again, and two for each of the three gradients' factors."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tokens", type=int, nargs="+", default=[1537, 4097])
    parser.add_argument("--heads", type=int, default=12)
    parser.add_argument("--width", type=int, default=64, help="of a head")
    parser.add_argument("--repeats", type=int, default=3, help="timed rounds")
    add_outputs(parser, "attention")
    arguments = parser.parse_args()
    prepare_process()
    result = measure(arguments)
    write_outputs(arguments, "attention", table(result), result)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.network.transformer import attention

    product, product_flops = matmul_program("float32")
    rows = []
    for tokens in arguments.tokens:
        q, k, v = jax.random.normal(jax.random.key(0), (3, tokens, arguments.heads, arguments.width))
        flops = 4.0 * tokens**2 * arguments.heads * arguments.width
        runs, memory = {"matmul": product}, {}
        for form in FORMS:
            forward = lambda q, k, v, form=form: attention(q, k, v, implementation=form)
            loss = lambda q, k, v, forward=forward: jnp.sum(jnp.sin(forward(q, k, v)))
            for name, function in ((form, forward), (f"{form}, gradient", jax.grad(loss, (0, 1, 2)))):
                program, _ = compiled(function, q, k, v)
                memory[name] = program.memory_analysis().temp_size_in_bytes / 2**20
                runs[name] = functools.partial(wait, program, q, k, v)
        times = medians(runs, arguments.repeats)
        rate = product_flops / times["matmul"][1]
        for name, megabytes in memory.items():
            operations = flops * (GRADIENT_PRODUCTS if "gradient" in name else 1)
            wall, cpu = times[name]
            ratio = float(cpu * rate / operations)
            rows.append({"tokens": tokens, "form": name, "ms": float(wall), "cpu_ms": float(cpu), "ratio": ratio})
            rows[-1]["temporary_mb"] = megabytes
    return {"rows": rows, "heads": arguments.heads, "device": jax.devices()[0].device_kind, "jax": jax.__version__}


def wait(program: Any, *arguments: Any) -> None:
    """Run it to the end."""
    import jax

    jax.block_until_ready(program(*arguments))


def table(result: dict[str, Any]) -> str:
    """The rows as text."""
    header = ["form", "tokens", "CPU ms", "/ plain products", "MiB"]
    rows = [
        [r["form"], r["tokens"], f"{r['cpu_ms']:.0f}", f"{r['ratio']:.2f}", f"{r['temporary_mb']:.0f}"]
        for r in result["rows"]
    ]
    return markdown_table(header, rows)


if __name__ == "__main__":
    main()
