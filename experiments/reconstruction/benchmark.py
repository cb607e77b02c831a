"""Time, arithmetic and memory of one reconstruction: photos and body in, canonical Gaussians out.

    python experiments/reconstruction/benchmark.py --preset published --views 4 --size 256 --json OUT

With all tokens and with those of the foreground, in turns with a plain matrix product, which gives the peak of this run.
Random weights: they cost what trained ones cost. Floating-point operations and bytes are counted from the compiled
programs, loops included (`common/costs.py`); "published_flops" is the same network with its last convolution
evaluated at every pixel, as the release does. `--memory 1 4 8 16` adds the peak memory of programs for these numbers of views at
`--memory-size`, from XLA's memory analysis: they are compiled and not run. `--stages` times encoder, sampling and decoder.

Writes {"all", "foreground": {"ms", "cpu_ms", "compile_s", "tokens", "flops", "temporary_mb", "share_of_peak",
"ratio_to_matmul", "ratio_to_matmul_cpu": wall and CPU time over those of the same operations as plain products},
"ratio_to_published_matmul", "matmul_gflops", "foreground_share", "speed_up": {"promised", "measured", "fraction"},
"memory": {"all", "foreground": {views: {"temporary_mb", "flops"}}}, ...}.

Published at 256 with 4 views takes 3 minutes on 2 cores. Numbers: docs/performance.md.
"""

import argparse
import os
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import add_outputs, markdown_table, publish, write_outputs
from experiments.costs import temporary_mb
from experiments.reconstruction.cases import (
    benchmark_inputs,
    compiled,
    foreground,
    matmul_program,
    random_variables,
)
from experiments.timing import medians, peak_rss_mb, prepare_process

MEBI = 1 / 2**20


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="published", help="published, paper, small or tiny")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", type=int, default=256, help="side of the photos, pixels")
    parser.add_argument(
        "--dtype", choices=("auto", "float32", "bfloat16"), default="auto", help="auto: float32 on a CPU"
    )
    parser.add_argument("--repeats", type=int, default=3, help="timed iterations")
    parser.add_argument("--stages", action="store_true", help="also time the stages")
    parser.add_argument("--memory", type=int, nargs="*", default=[], help="numbers of views to analyse the memory for")
    parser.add_argument("--memory-size", type=int, default=512)
    add_outputs(parser, "reconstruction_benchmark")
    arguments = parser.parse_args()
    prepare_process()
    result = benchmark(arguments)
    write_outputs(arguments, "reconstruction_benchmark", table(result), result)
    if arguments.memory:
        print(memory_table(result))
        if arguments.page:
            publish(arguments.page, "reconstruction_memory", memory_table(result), result["memory"])


def benchmark(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)  # compile times are of a first run
    config = configured(arguments.preset, arguments.dtype, arguments.size)
    inputs = benchmark_inputs(config, arguments.views, arguments.size)
    variables = random_variables(config)
    packed, touched, share = foreground(inputs, config)
    cases = {"all": config.with_runtime(tokens="all"), "foreground": packed}
    patches = round(touched / share)

    product, product_flops = matmul_program(config.runtime.dtype)
    runs, facts = {"matmul": product}, {}
    for name, case in cases.items():
        program, facts[name] = reconstruction(variables, inputs, case)
        facts[name]["tokens"] = patches if name == "all" else case.runtime.token_capacity
        runs[name] = lambda program=program: jax.block_until_ready(program(variables, inputs))
        if arguments.stages:
            runs |= {f"{name} {stage}": run for stage, run in stages(variables, inputs, case).items()}
    load = os.getloadavg()[0]
    times = medians(runs, arguments.repeats)
    gflops = product_flops / times["matmul"][0] / 1e6
    for name, fact in facts.items():
        wall, cpu = times[name]
        ratio = wall / (fact["flops"] / gflops / 1e6)
        cpu_ratio = cpu / times["matmul"][1] * product_flops / fact["flops"]
        fact |= {"ms": wall, "cpu_ms": cpu, "ratio_to_matmul": ratio, "ratio_to_matmul_cpu": cpu_ratio}
        fact["share_of_peak"] = 1 / ratio
    published = whole_network_flops(variables, inputs, cases["all"])
    promised = facts["all"]["flops"] / facts["foreground"]["flops"]
    measured = facts["all"]["ms"] / facts["foreground"]["ms"]
    return {
        **facts,
        "published_flops": published,
        "ratio_to_published_matmul": facts["all"]["ms"] / (published / gflops / 1e6),
        "matmul_gflops": gflops,
        "foreground_share": share,
        "speed_up": {"promised": promised, "measured": measured, "fraction": measured / promised},
        "stages_ms": {name: list(map(float, times[name])) for name in runs if " " in name},
        "memory": {
            name: {str(views): memory(case, views, arguments.memory_size) for views in arguments.memory}
            for name, case in cases.items()
        },
        "memory_size": arguments.memory_size,
        "peak_rss_mb": peak_rss_mb(),
        "preset": arguments.preset,
        "views": arguments.views,
        "size": arguments.size,
        "vertices": int(inputs.canonical_vertices.shape[0]),
        "dtype": config.runtime.dtype,
        "repeats": arguments.repeats,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def configured(preset: str, dtype: str, size: int) -> Any:
    """A preset for photos of that size, in the dtype that suits the machine."""
    import jax

    from humangs_jax.network.presets import PRESETS

    if preset not in PRESETS:
        raise SystemExit(f"--preset {preset}: expected one of {', '.join(PRESETS)}")
    if dtype == "auto":
        dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    return PRESETS[preset]().with_conventions(image_size=size).with_runtime(dtype=dtype)


def reconstruction(variables: Any, inputs: Any, config: Any) -> tuple[Any, dict[str, Any]]:
    """(the network as one program, what it costs by count)."""
    from humangs_jax.network.humangs import apply_humangs

    program, seconds, flops = compiled(lambda v, x: apply_humangs(v, x, config)[0], variables, inputs)
    return program, {"compile_s": seconds, "flops": flops, "temporary_mb": temporary_mb(program)}


def stages(variables: Any, inputs: Any, config: Any) -> dict[str, Any]:
    """The three public stages, each compiled by itself."""
    import jax

    from humangs_jax.network.humangs import decode, encode, read

    encoding = encode(variables, inputs, config)
    features = read(variables, encoding, inputs, config)
    wait = jax.block_until_ready
    return {
        "encode": lambda: wait(encode(variables, inputs, config)),
        "read": lambda: wait(read(variables, encoding, inputs, config)),
        "decode": lambda: wait(decode(variables, features, inputs, config)),
    }


def whole_network_flops(variables: Any, inputs: Any, config: Any) -> int:
    """Operations of the network whose last convolution is evaluated at every pixel and not where vertices read it."""
    from humangs_jax.network.config import paper_parts
    from humangs_jax.network.humangs import apply_humangs

    here = compiled(lambda v, x: apply_humangs(v, x, config)[0], variables, inputs)[2]
    encoder, reader, _ = paper_parts(config.architecture)
    if encoder.upsampler is None or reader.output_width is None:
        return here
    views, height, width = inputs.images.shape[:3]
    pixels = views * (4 * height // encoder.patch_size) * (4 * width // encoder.patch_size)
    per_position = 2 * 9 * (encoder.upsampler.hidden // 2) * reader.output_width
    return here + per_position * (pixels - inputs.canonical_vertices.shape[0])


def memory(config: Any, views: int, size: int) -> dict[str, float]:
    """MiB that a program for that number of photos of that size needs besides its arguments and results; its operations."""
    import jax

    from humangs_jax.network.humangs import apply_humangs
    from humangs_jax.network.weights import expected_variables

    subject = benchmark_inputs(config.with_runtime(tokens="all"), views, size)
    if config.tokens == "foreground":
        config = foreground(subject, config)[0]
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), subject)
    program, _, flops = compiled(lambda v, x: apply_humangs(v, x, config)[0], expected_variables(config), shapes)
    return {"temporary_mb": temporary_mb(program), "flops": flops}


def table(result: dict[str, Any]) -> str:
    """The numbers as text."""
    rows = [
        [
            name,
            case["tokens"],
            f"{case['ms']:.0f}, {case['cpu_ms']:.0f}",
            f"{case['flops'] / 1e9:.0f}",
            f"{case['share_of_peak']:.2f}",
            f"{case['ratio_to_matmul']:.2f}, {case['ratio_to_matmul_cpu']:.2f}",
            f"{case['temporary_mb']:.0f}",
            f"{case['compile_s']:.1f}",
        ]
        for name, case in ((name, result[name]) for name in ("all", "foreground"))
    ]
    header = [
        "tokens",
        "slots",
        "wall, CPU ms",
        "GFLOP",
        "share of peak",
        "/ matmul (wall, CPU)",
        "MiB",
        "compile s",
    ]
    speed_up = result["speed_up"]
    lines = [
        f"{result['preset']}, {result['views']} views of {result['size']}, {result['dtype']}, {result['device']}",
        "",
        markdown_table(header, rows),
        "",
        f"Matrix products {result['matmul_gflops']:.0f} GFLOP/s. Published network {result['published_flops'] / 1e12:.3f} TFLOP: "
        f"all tokens take {result['ratio_to_published_matmul']:.2f} times as long as these as plain products.",
        f"Foreground share {result['foreground_share']:.3f}: speed-up {speed_up['measured']:.2f} measured, "
        f"{speed_up['promised']:.2f} promised by the operations, {speed_up['fraction']:.2f} of it.",
    ]
    stages = [f"{name} {wall:.0f} ({cpu:.0f})" for name, (wall, cpu) in result["stages_ms"].items()]
    if stages:
        lines += ["", f"Stages, wall (CPU) ms: {', '.join(stages)}."]
    return "\n".join(lines)


def memory_table(result: dict[str, Any]) -> str:
    """Memory and counted operations by number of views."""
    views = list(result["memory"]["all"])
    rows = []
    for tokens, by_views in result["memory"].items():
        for unit, key, scale, digits in (("MiB", "temporary_mb", 1, 0), ("TFLOP", "flops", 1e-12, 2)):
            rows.append([f"{tokens} tokens, {unit}", *(f"{scale * by_views[v][key]:.{digits}f}" for v in views)])
    return markdown_table([f"{result['preset']} at {result['memory_size']}", *(f"{v} views" for v in views)], rows)


if __name__ == "__main__":
    main()
