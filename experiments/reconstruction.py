"""Measures time, arithmetic and memory of one reconstruction, from photos and body to canonical
Gaussians.

The subject is the person of the demo, seen by cameras of the published protocol. Costs depend on
the contents of the photos only through the number of patches that the person touches. Random
weights cost what trained ones cost. Operations are counted in the traced programs, with their loops
(`costs.py`).
"""

import functools
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.costs import costs_of, temporary_mb
from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.timing import medians
from humangs_jax.avatar.reconstruct import reconstruct, reconstruct_views, stack_captures
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.data.views import gaussian_body, prepare_inputs, to_network_views
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.encoder import needed_tokens
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.presets import PRESETS
from humangs_jax.network.weights import expected_variables, load_weights
from humangs_jax.rendering.buffers import round_up

MATMUL_SHAPE = (4096, 768, 3072)
"""Sizes of a matrix product of the published network's MLP at 256 x 256 pixels, whose speed is the
peak that others are compared with.
"""
TOKENS = ("all", "foreground")
"""Which patches are tokens."""
LOG_SCALE, HEAD_SCALE = -4.6, 0.05
"""Bias of the scales before their softplus, and factor by which random geometry heads are weaker
than other random layers.
"""


def benchmark_inputs(config: Any, views: int, size: int) -> Any:
    """Returns the `HumanGSInputs` of `views` photos of the demo, for a network of this
    configuration.

    Photos are repeated if the demo has fewer. `size` is their side in pixels.
    """
    capture = load_capture(DEMO_CAPTURE)
    chosen = [i % capture.view_count for i in range(views)]
    photos = to_network_views(capture.select(chosen), size)
    prepare = jax.jit(prepare_inputs, static_argnames="config")
    return jax.block_until_ready(prepare(gaussian_body(capture.body, config), photos, config))


def foreground(inputs: Any, config: Any) -> tuple[Any, int, float]:
    """Returns the configuration for foreground tokens with room for these photos, the number of
    tokens that the person touches, and their share.
    """
    patch = config.architecture.encoder.patch_size
    touched = int(needed_tokens(inputs.foreground, inputs.view_count, patch))
    patches = int(np.prod(inputs.images.shape[:3])) // patch**2
    config = config.with_runtime(tokens="foreground", token_capacity=round_up(touched))
    return config, touched, touched / patches


def random_variables(config: Any) -> Any:
    """Returns random variables of a network, with which every number matters and Gaussians are
    about a centimetre large.

    NumPy draws them, because initialising the published network compiles for 10 s.
    """
    rng = np.random.default_rng(0)

    def draw(path, leaf):
        if path[-1].key in ("scale", "var"):
            return jnp.ones(leaf.shape, jnp.float32)
        fan_in = int(np.prod(leaf.shape[:-1])) if leaf.ndim > 1 else 100
        return jnp.asarray(rng.standard_normal(leaf.shape, np.float32) * fan_in**-0.5)

    variables = jax.tree_util.tree_map_with_path(draw, expected_variables(config))
    geometry = variables["params"]["decoder"]["geometry_out"]
    resting = jnp.asarray([0, 0, 0, 1, 0, 0, 0, *[LOG_SCALE] * 3], jnp.float32)
    geometry["kernel"] *= HEAD_SCALE
    geometry["bias"] = jnp.tile(resting, config.architecture.decoder.gaussians_per_vertex)
    return variables


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Any, float, int]:
    """Compiles a function, and returns the program, the seconds of tracing and compiling, and the
    number of operations.
    """
    start = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    program = traced.lower().compile()
    return program, time.perf_counter() - start, costs_of(traced).flops


def matmul_program(dtype: str) -> tuple[Callable[[], Any], float]:
    """Returns a function that does a plain matrix product in a dtype, and its floating-point
    operations.
    """
    rows, inner, columns = MATMUL_SHAPE
    rng = np.random.default_rng(0)
    a = jnp.asarray(rng.standard_normal((rows, inner)), dtype)
    b = jnp.asarray(rng.standard_normal((inner, columns)), dtype)
    product = jax.jit(lambda a, b: a @ b).lower(a, b).compile()
    return lambda: jax.block_until_ready(product(a, b)), 2.0 * rows * inner * columns


def configured(preset: str, size: int) -> HumanGSConfig:
    """Returns a preset for photos of `size` pixels, in the dtype that suits the machine.

    Raises: ValueError for an unknown preset.
    """
    if preset not in PRESETS:
        raise ValueError(f"--preset {preset}: expected one of {', '.join(PRESETS)}")
    dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    return PRESETS[preset]().with_conventions(image_size=size).with_runtime(dtype=dtype)


def whole(variables: Any, inputs: Any, config: HumanGSConfig) -> tuple[Any, float, int]:
    """Compiles the network as one program, see `compiled`."""
    return compiled(lambda v, x: apply_humangs(v, x, config)[0], variables, inputs)


@entry
def reconstruction_benchmark(
    run: Run,
    preset: str = "published",
    views: int = 4,
    size: int = 256,
    repeats: int = 3,
    memory: tuple[int, ...] = (1, 4, 8, 16),
    memory_size: int = 512,
) -> None:
    """Measures time, arithmetic and memory of a reconstruction, with all tokens and with those of
    the foreground.

    Programs are timed in turns with a plain matrix product, which gives the peak of this run.
    Operations are counted in traced programs. Memory is XLA's analysis of programs that are not run
    (table reconstruction_memory). The preset "published" at 256 pixels with 4 views takes 3 minutes
    on 2 cores.

    Options:
    preset: published, paper, small or tiny
    size: side of the photos, pixels
    repeats: timed iterations
    memory: numbers of views to analyse the memory for
    memory_size: side of the photos whose memory is analysed, pixels
    """
    config, large = configured(preset, size), configured(preset, memory_size)
    settings = {
        "preset": preset,
        "views": views,
        "size": size,
        "dtype": config.runtime.dtype,
        "repeats": repeats,
    }
    # times of one size; memory of programs that are not run, for several numbers of views
    cases = {"time": functools.partial(benchmark, config, views, size, repeats)}
    for name, count in itertools.product(TOKENS, memory):
        cases[f"{name}, {count}"] = functools.partial(
            _memory, large.with_runtime(tokens=name), count, memory_size
        )
    rows, table = run.rows(cases, settings | {"memory_size": memory_size}), []
    for name in TOKENS:
        case = rows["time"][name]
        cells = [
            f"{case['ms'] / 1e3:.1f}, {case['cpu_ms'] / 1e3:.1f}",
            f"{case['flops'] / 1e9:.0f}",
            f"{case['over_products']:.2f}",
            f"{case['temporary_mb']:.0f}",
            f"{case['compile_s']:.1f}",
        ]
        table.append([name, case["tokens"], *cells])
    header = ["tokens", "slots", "wall, CPU s", "GFLOP", "over plain products (CPU)", "MiB"]
    header += ["compile s"]
    title = f"{preset}, {views} views of {size}, {config.runtime.dtype}, {rows['time']['device']}."
    run.show(f"{title}\n\n{markdown_table(header, table)}", rows["time"] | settings)
    if memory:
        table = []
        for name in TOKENS:
            found = [rows[f"{name}, {count}"] for count in memory]
            mebibytes = [f"{row['temporary_mb']:.0f}" for row in found]
            operations = [f"{1e-12 * row['flops']:.2f}" for row in found]
            table.append([f"{name} tokens, MiB", *mebibytes])
            table.append([f"{name} tokens, TFLOP", *operations])
        header = [f"{preset} at {memory_size}", *(f"{count} views" for count in memory)]
        rows.pop("time")
        run.show(markdown_table(header, table), rows, "reconstruction_memory")


def benchmark(config: HumanGSConfig, views: int, size: int, repeats: int) -> dict[str, Any]:
    """Measures a network with all tokens and with those of the foreground.

    Returns for each ms, operations, MiB, and the CPU time as a multiple of that of plain matrix
    products with as many operations.
    """
    # compile times are those of a first run
    jax.config.update("jax_enable_compilation_cache", False)
    inputs, variables = benchmark_inputs(config, views, size), random_variables(config)
    packed, touched, share = foreground(inputs, config)
    product, product_flops = matmul_program(config.runtime.dtype)
    runs, facts = {"matmul": product}, {}
    for name, case in zip(TOKENS, (config.with_runtime(tokens="all"), packed), strict=True):
        program, seconds, flops = whole(variables, inputs, case)
        tokens = round(touched / share) if name == "all" else case.runtime.token_capacity
        facts[name] = {
            "compile_s": seconds,
            "flops": flops,
            "temporary_mb": temporary_mb(program),
            "tokens": tokens,
        }

        def timed(program=program):
            return jax.block_until_ready(program(variables, inputs))

        runs[name] = timed

    # all programs take turns
    times = {name: list(map(float, pair)) for name, pair in medians(runs, repeats).items()}
    for name, fact in facts.items():
        wall, cpu = times[name]
        fact |= {
            "ms": wall,
            "cpu_ms": cpu,
            "over_products": cpu / times["matmul"][1] * product_flops / fact["flops"],
        }
    gflops = product_flops / times["matmul"][0] / 1e6
    return facts | {
        "matmul_gflops": gflops,
        "foreground_share": share,
        "device": jax.devices()[0].device_kind,
    }


def _memory(config: HumanGSConfig, views: int, size: int) -> dict[str, float]:
    """Returns the operations of a program for this number of photos, and the MiB that it needs
    besides its arguments and results.
    """
    subject = benchmark_inputs(config.with_runtime(tokens="all"), views, size)
    if config.tokens == "foreground":
        config = foreground(subject, config)[0]
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), subject)
    program, _, flops = whole(expected_variables(config), shapes, config)
    return {"temporary_mb": temporary_mb(program), "flops": flops}


@entry
def reconstruction_batches(
    run: Run, sizes: tuple[int, ...] = (1, 2, 4, 8, 16, 32), runs: int = 3
) -> None:
    """Measures how many subjects a second `hg.reconstruct_views` does under `vmap`, by the size of
    the batch, with four photos and the shipped weights.

    Options:
        sizes: sizes of the batches
        runs: timed calls of each, in turns; the median counts
    """
    # a compiled program for each size
    (variables, config), capture = load_weights(), load_capture(DEMO_CAPTURE)
    batched = jax.jit(jax.vmap(reconstruct_views, in_axes=(None, None, None, 0)))
    calls, memory = {}, {}
    for size in sizes:
        body, views, own = stack_captures(config, [capture] * size)
        program = batched.lower(variables, own, body, views).compile()
        memory[str(size)] = temporary_mb(program)

        def call(program=program, arguments=(variables, own, body, views)):
            return jax.block_until_ready(program(*arguments))

        calls[str(size)] = call
    each = {size: float(ms[0]) / int(size) for size, ms in medians(calls, runs).items()}
    first = each[str(sizes[0])]
    rows = [
        [size, f"{1000 / ms:.2f}", f"{first / ms:.2f}", f"{memory[size]:,.0f}"]
        for size, ms in each.items()
    ]
    header = ["subjects in a batch", "subjects a second", f"relative to {sizes[0]}"]
    header += ["working memory, MB"]
    run.show(markdown_table(header, rows, "rrrr"), {"ms": each, "memory_mb": memory})


@entry
def reconstruction_calls(run: Run, runs: int = 9) -> None:
    """Measures a call of `hg.reconstruct` once its programs are compiled, with the demo's four
    photos and the shipped weights, and how much of it the programs need.

    The rest is work on the host: checks, exposure, masks and crops. Each call gets a capture that
    was not prepared before.

    Options:
        runs: timed calls of each, in turns; the median counts
    """
    (variables, config), capture = load_weights(), load_capture(DEMO_CAPTURE)
    body, views, sized = stack_captures(config, [capture])
    views = jax.tree.map(lambda leaf: leaf[0], views)
    program = jax.jit(reconstruct_views).lower(variables, sized, body, views).compile()
    unprepared = itertools.cycle([load_capture(DEMO_CAPTURE) for _ in range(runs + 1)])
    times = medians(
        {
            "hg.reconstruct": lambda: jax.block_until_ready(
                reconstruct(variables, config, next(unprepared))
            ),
            "its programs": lambda: jax.block_until_ready(program(variables, sized, body, views)),
        },
        runs,
    )
    rows = [[name, *(f"{time:.0f}" for time in pair)] for name, pair in times.items()]
    found = {name: list(map(float, pair)) for name, pair in times.items()}
    run.show(markdown_table(["", "wall, ms", "CPU ms"], rows, "lrr"), found)
