"""What each piece of work that a scene does not need would cost, and what leaving it out changes.

    python experiments/reconstruction/savings.py --preset paper --views 4 --size 256 [--weights W] --json OUT

Starts from the network as published (all tokens, the last convolution at every pixel, every view for every vertex) and
leaves out one thing after the other; the rows of a table are timed in turns. Errors are those of the Gaussians against
the first row (relative L2 of offsets from the vertices, and of colors) and of an image drawn from them (PSNR). With
random weights (the default) the rows that are exact by construction must show rounding only; what foreground tokens do
to a network that was trained with all of them, only `--weights` of such a network tell.

Published sizes at 256 take 2 minutes on 2 cores. Numbers: docs/performance.md.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, write_outputs
from experiments.costs import temporary_mb
from experiments.reconstruction.benchmark import configured
from experiments.reconstruction.cases import benchmark_inputs, compiled, foreground, random_variables
from experiments.timing import medians, prepare_process


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="paper", help="published, paper, small or tiny")
    parser.add_argument("--weights", type=Path, help="these weights, and their network, instead of a preset's")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", type=int, default=256, help="side of the photos, pixels")
    parser.add_argument(
        "--dtype", choices=("auto", "float32", "bfloat16"), default="auto", help="auto: float32 on a CPU"
    )
    parser.add_argument("--repeats", type=int, default=3, help="timed iterations; 0: errors only")
    add_outputs(parser, "reconstruction_savings")
    arguments = parser.parse_args()
    prepare_process()
    result = measure(arguments)
    write_outputs(arguments, "reconstruction_savings", table(result), result)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    from humangs_jax.network.config import paper_parts
    from humangs_jax.network.reader import needed_reads
    from humangs_jax.network.weights import load_weights

    config = configured(arguments.preset, arguments.dtype, arguments.size)
    variables = None
    if arguments.weights:
        variables, config = load_weights(arguments.weights)
    config = config.with_runtime(tokens="all")
    variables = variables or random_variables(config)
    inputs = benchmark_inputs(config, arguments.views, arguments.size)
    capacity = int(jax.jit(lambda x: needed_reads(x, config.run()))(inputs))
    seeing = lambda c: c.with_runtime(vertex_capacity=capacity)
    packed, touched, share = foreground(inputs, config)

    networks: dict[str, Callable[[Any, Any], Any]] = {"as published": lambda v, x: everywhere(v, x, config)}
    if paper_parts(config.architecture)[1].output_width is not None:
        networks["last convolution where read"] = lambda v, x: network(v, x, config)
    if config.conventions.pool == "visible":
        networks["only views that see the vertex"] = lambda v, x: network(v, x, seeing(config))
        networks["foreground tokens"] = lambda v, x: network(v, x, seeing(packed))
    else:
        networks["foreground tokens"] = lambda v, x: network(v, x, packed)

    programs = {name: compiled(function, variables, inputs) for name, function in networks.items()}
    outputs = {name: program(variables, inputs) for name, (program, _, _) in programs.items()}
    runs = {name: lambda p=p: jax.block_until_ready(p(variables, inputs)) for name, (p, _, _) in programs.items()}
    times = medians(runs, arguments.repeats) if arguments.repeats else {}
    reference = outputs["as published"]
    picture = drawn(reference, inputs)
    rows = {}
    for name, output in outputs.items():
        rows[name] = {
            "flops": programs[name][2],
            "temporary_mb": temporary_mb(programs[name][0]),
            "ms": float(times[name][0]) if times else None,
            "cpu_ms": float(times[name][1]) if times else None,
            **errors(output, reference, inputs),
            "psnr": psnr(drawn(output, inputs), picture),
        }
    return {
        "rows": rows,
        "foreground_share": share,
        "foreground_tokens": touched,
        "vertices_read": capacity,
        "vertices": int(inputs.canonical_vertices.shape[0]),
        "weights": arguments.weights.name if arguments.weights else "random",
        "preset": arguments.preset,
        "pool": config.conventions.pool,
        "views": arguments.views,
        "size": arguments.size,
        "dtype": config.runtime.dtype,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def network(variables: Any, inputs: Any, config: Any) -> Any:
    """The package's."""
    from humangs_jax.network.humangs import apply_humangs

    return apply_humangs(variables, inputs, config)[0].gaussians


def everywhere(variables: Any, inputs: Any, config: Any) -> Any:
    """The package's, with its last convolution evaluated at every pixel and then sampled."""
    import jax.numpy as jnp

    from humangs_jax.core.pytree import replace
    from humangs_jax.network.bilinear import sample_bilinear, texel_indices
    from humangs_jax.network.config import paper_parts
    from humangs_jax.network.humangs import decode, encode, part_variables, read
    from humangs_jax.network.pixel_aligned import COUNT_EPSILON, sum_over_views
    from humangs_jax.network.reader import project_and_test, view_weights

    run, reader = config.run(), paper_parts(config.architecture)[1]
    encoding = encode(variables, inputs, config)
    features = read(variables, encoding, inputs, config)
    if reader.output_width is not None:
        convolution = reader.output(encoding.maps.shape[-1], run)
        maps: Any = convolution.apply(part_variables(variables, "reader"), encoding.maps, method="everywhere")
        pixels, visible = project_and_test(inputs, run)
        weights = view_weights(visible, inputs, run).astype(pixels.dtype)
        size = (inputs.cameras.width, inputs.cameras.height)
        indices = texel_indices(pixels, size, (maps.shape[2], maps.shape[1]), config.conventions.pixel_grid)
        sums = sum_over_views(sample_bilinear, maps, indices, weights)
        features = replace(features, local=sums / (jnp.sum(weights, axis=0) + COUNT_EPSILON)[:, None])
    return decode(variables, features, inputs, config).gaussians


def errors(gaussians: Any, reference: Any, inputs: Any) -> dict[str, float]:
    """Relative L2 errors of offsets from the vertices, and of colors."""
    per_vertex = len(reference.means) // len(inputs.canonical_vertices)
    vertices = np.repeat(np.asarray(inputs.canonical_vertices), per_vertex, axis=0)
    relative = lambda a, b: float(np.linalg.norm(a - b) / max(np.linalg.norm(b), 1e-30))
    return {
        "offsets_relative_l2": relative(np.asarray(gaussians.means) - vertices, np.asarray(reference.means) - vertices),
        "colors_relative_l2": relative(np.asarray(gaussians.colors), np.asarray(reference.colors)),
    }


def drawn(gaussians: Any, inputs: Any) -> np.ndarray:
    """An image of the T-pose from the front, 512 x 512 on white."""
    import jax.numpy as jnp

    from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
    from humangs_jax.rendering.splatting import render

    vertices = np.asarray(inputs.canonical_vertices)
    center = jnp.asarray(0.5 * (vertices.min(0) + vertices.max(0)))
    height = float(np.ptp(vertices[:, 1]))
    K = intrinsics_from_fov(np.pi / 6, 512, 512)
    camera = orbit(center, 2.2 * height, jnp.zeros(1), 0.1, K, 512, 512)[0]
    return np.clip(np.asarray(render(gaussians, camera).rgb), 0, 1)


def psnr(a: np.ndarray, b: np.ndarray) -> float | None:
    """dB; None where they are equal."""
    mean_square = float(np.mean((a - b) ** 2))
    return None if mean_square == 0 else -10 * float(np.log10(mean_square))


def table(result: dict[str, Any]) -> str:
    """The rows as text."""
    first = next(iter(result["rows"].values()))
    rows = []
    for name, row in result["rows"].items():
        gain = "" if row["cpu_ms"] is None else f"{first['cpu_ms'] / row['cpu_ms']:.2f}"
        time = "" if row["cpu_ms"] is None else f"{row['ms']:.0f}, {row['cpu_ms']:.0f}"
        pictured = "equal" if row["psnr"] is None else f"{row['psnr']:.1f}"
        error = f"{row['offsets_relative_l2']:.1e}, {row['colors_relative_l2']:.1e}"
        flops, memory = f"{row['flops'] / 1e9:.0f}", f"{row['temporary_mb']:.0f}"
        rows.append([name, flops, time, gain, memory, error, pictured])
    header = ["left out so far", "GFLOP", "wall, CPU ms", "gain (CPU)", "MiB", "offsets, colors", "picture, dB"]
    return (
        f"{result['weights']} weights, {result['preset']}, {result['views']} views of {result['size']}, "
        f"pool {result['pool']}, foreground share {result['foreground_share']:.3f}, "
        f"at most {result['vertices_read']} of {result['vertices']} vertices seen by a view\n\n"
        f"{markdown_table(header, rows)}"
    )


if __name__ == "__main__":
    main()
