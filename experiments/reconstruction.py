"""Time, arithmetic and memory of one reconstruction: photos and body in, canonical Gaussians out.

The subject is the person that ships with the package, as the shipped weights see them: reconstructed from the four demo photos,
drawn from cameras of the published protocol. What the photos show changes no cost but one: how many patches the person touches.
Random weights cost what trained ones cost. Operations are counted from the traced programs, loops included (`costs.py`).
"""

import dataclasses
import functools
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from experiments.costs import costs_of, temporary_mb
from experiments.harness import Run, entry, figure
from experiments.results import markdown_table
from experiments.timing import medians, peak_rss_mb
from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.frames import draw_gaussians
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.model import pose_body, shape_body
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import load_capture
from humangs_jax.data.photos import DEMO_CAPTURE
from humangs_jax.data.views import SubjectViews, gaussian_body, prepare_inputs
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.network.config import HumanGSConfig, paper_parts
from humangs_jax.network.humangs import apply_humangs, decode, encode, needed_tokens, part_variables, read
from humangs_jax.network.maps import Convolution, sample_bilinear, texel_indices
from humangs_jax.network.presets import PRESETS
from humangs_jax.network.reader import COUNT_EPSILON, project_and_test, sum_over_views
from humangs_jax.network.weights import expected_variables, load_weights
from humangs_jax.people.cameras import VERTICAL_FOV, bounding_sphere
from humangs_jax.rendering.splatting import render, round_up

DISTANCE_FACTOR = 1.8
"""The nearest of the published protocol (1.8 to 2.2)."""
ELEVATION = np.deg2rad(5.0)
MATMUL_SHAPE = (4096, 768, 3072)
"""A product of the published network's MLP at 256 x 256: what "matrix-product peak" means here."""
LOG_SCALE, HEAD_SCALE = -4.6, 0.05
"""Bias of the scales before their softplus, and how much weaker random geometry heads are than other random layers."""


@functools.cache
def demo_avatar() -> tuple[Any, Any]:
    """(avatar, capture) of the demo."""
    capture = load_capture(DEMO_CAPTURE)
    return reconstruct(*load_weights(), capture), capture


def benchmark_views(views: int, size: int) -> tuple[Any, Any]:
    """(body, `SubjectViews`) of the benchmark subject: cameras evenly around, one pose."""
    avatar, capture = demo_avatar()
    pose, body = capture.pose(0), capture.body
    betas = jnp.asarray(capture.betas)
    posed = np.asarray(pose_body(body, shape_body(body, betas), pose).vertices)
    center, radius = bounding_sphere(posed)
    K = intrinsics_from_fov(VERTICAL_FOV, size, size)
    azimuths = jnp.arange(views, dtype=jnp.float32) * (2 * np.pi / views)
    target = jnp.asarray(center, jnp.float32)
    cameras = orbit(target, float(DISTANCE_FACTOR * radius), azimuths, float(ELEVATION), K, size, size)
    gaussians = animate(avatar, pose)
    drawn = list(draw_gaussians(iter([gaussians] * views), (cameras[i] for i in range(views))))
    repeat = lambda x: jnp.broadcast_to(jnp.asarray(x), (views, *np.shape(x)))
    return body, SubjectViews(
        images=jnp.stack([jnp.clip(x.rgb, 0, 1) for x in drawn]),
        masks=jnp.stack([x.alpha for x in drawn]),
        cameras=cameras,
        rotations=repeat(pose.rotations),
        translations=repeat(pose.translation),
        betas=betas,
    )


def benchmark_inputs(config: Any, views: int, size: int) -> Any:
    """`HumanGSInputs` of the benchmark subject, as a network of this configuration wants them."""
    body, photos = benchmark_views(views, size)
    prepare = jax.jit(prepare_inputs, static_argnames="config")
    return jax.block_until_ready(prepare(gaussian_body(body, config), photos, config))


def foreground(inputs: Any, config: Any) -> tuple[Any, int, float]:
    """(configuration for foreground tokens with room for these photos, tokens that the person touches, their share)."""
    touched = int(jax.jit(needed_tokens, static_argnames="config")(inputs, config))
    patches = int(np.prod(inputs.images.shape[:3])) // config.architecture.encoder.patch_size**2
    config = config.with_runtime(tokens="foreground", token_capacity=round_up(touched))
    return config, touched, touched / patches


def random_variables(config: Any, seed: int = 0) -> Any:
    """Variables in which every number matters, of Gaussians about a centimetre large.

    Drawn by numpy: initialising the published network compiles for 10 s.
    """
    rng = np.random.default_rng(seed)

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
    """(compiled program, seconds that tracing and compiling took, operations)."""
    start = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    program = traced.lower().compile()
    return program, time.perf_counter() - start, costs_of(traced).flops


def matmul_program(dtype: str) -> tuple[Callable[[], Any], float]:
    """(a plain matrix product in that dtype, its floating-point operations)."""
    rows, inner, columns = MATMUL_SHAPE
    rng = np.random.default_rng(0)
    a = jnp.asarray(rng.standard_normal((rows, inner)), dtype)
    b = jnp.asarray(rng.standard_normal((inner, columns)), dtype)
    product = jax.jit(lambda a, b: a @ b).lower(a, b).compile()
    return lambda: jax.block_until_ready(product(a, b)), 2.0 * rows * inner * columns


def whole_network_flops(variables: Any, inputs: Any, config: Any) -> int:
    """Operations of the network whose last convolution is evaluated at every pixel and not where vertices read it."""
    here = whole(variables, inputs, config)[2]
    encoder, reader, _ = paper_parts(config.architecture)
    if encoder.upsampler is None or reader.output_width is None:
        return here
    views, height, width = inputs.images.shape[:3]
    pixels = views * (4 * height // encoder.patch_size) * (4 * width // encoder.patch_size)
    per_position = 2 * 9 * (encoder.upsampler.hidden // 2) * reader.output_width
    return here + per_position * (pixels - inputs.canonical_vertices.shape[0])


def everywhere(variables: Any, inputs: Any, config: Any) -> Any:
    """The package's, with its last convolution evaluated at every pixel and then sampled."""
    grid, reader = config.conventions.pixel_grid, paper_parts(config.architecture)[1]
    encoding = encode(variables, inputs, config)
    features = read(variables, encoding, inputs, config)
    if reader.output_width is not None:
        convolution = Convolution(reader.output_width, nn.initializers.zeros, config.runtime.compute_dtype)
        maps: Any = convolution.apply(part_variables(variables, "reader"), encoding.maps)
        pixels, visible = project_and_test(inputs, grid)
        pooled = visible if config.conventions.pool == "visible" else inputs.present[:, None]
        weights = jnp.broadcast_to(pooled, visible.shape).astype(pixels.dtype)
        size = (inputs.cameras.width, inputs.cameras.height)
        indices = texel_indices(pixels, size, (maps.shape[2], maps.shape[1]), grid)
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
    vertices = np.asarray(inputs.canonical_vertices)
    center = jnp.asarray(0.5 * (vertices.min(0) + vertices.max(0)))
    height = float(np.ptp(vertices[:, 1]))
    K = intrinsics_from_fov(np.pi / 6, 512, 512)
    camera = orbit(center, 2.2 * height, jnp.zeros(1), 0.1, K, 512, 512)[0]
    return np.clip(np.asarray(render(gaussians, camera).rgb), 0, 1)


WIDTH, LAYERS = 384, 6
COLORS = {"all": "#c0392b", "foreground": "#1f6f8b"}


def configured(preset: str, size: int, dtype: str = "auto") -> HumanGSConfig:
    """A preset for photos of that size, in the dtype that suits the machine. Raises ValueError for an unknown preset."""
    if preset not in PRESETS:
        raise ValueError(f"--preset {preset}: expected one of {', '.join(PRESETS)}")
    if dtype == "auto":
        dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    return PRESETS[preset]().with_conventions(image_size=size).with_runtime(dtype=dtype)


def whole(variables: Any, inputs: Any, config: HumanGSConfig) -> tuple[Any, float, int]:
    """The network as one program, see `compiled`."""
    return compiled(lambda v, x: apply_humangs(v, x, config)[0], variables, inputs)


# Entries -------------------------------------------------------------------------------------------------------------


@entry
def reconstruction_benchmark(
    run: Run,
    preset: str = "published",
    views: int = 4,
    size: int = 256,
    dtype: Literal["auto", "float32", "bfloat16"] = "auto",
    repeats: int = 3,
    memory: tuple[int, ...] = (1, 4, 8, 16),
    memory_size: int = 512,
) -> None:
    """Time, arithmetic and memory of a reconstruction, with all tokens and with those of the foreground.

    In turns with a plain matrix product, which gives the peak of this run. The published network's operations are those with its
    last convolution evaluated at every pixel, as the release does. Stages are timed, too. Memory is XLA's analysis of programs
    that are not run (table reconstruction_memory). Published at 256 with 4 views takes 3 minutes on 2 cores.

    Options:
    preset: published, paper, small or tiny
    size: side of the photos, pixels
    dtype: auto: float32 on a CPU
    repeats: timed iterations
    memory: numbers of views to analyse the memory for
    memory_size: side of the photos there
    """
    numbers = benchmark(configured(preset, size, dtype), views, size, repeats) | {"preset": preset}
    title = f"{preset}, {views} views of {size}, {numbers['dtype']}, {numbers['device']}"
    run.show(f"{title}\n\n{benchmark_text(numbers)}", numbers)
    if memory:
        config, rows = configured(preset, size, dtype), {}
        for tokens in ("all", "foreground"):
            rows[tokens] = [_memory(config.with_runtime(tokens=tokens), count, memory_size) for count in memory]
        table = [
            [f"{tokens} tokens, {unit}", *(f"{scale * row[key]:.{digits}f}" for row in of_views)]
            for tokens, of_views in rows.items()
            for unit, key, scale, digits in (("MiB", "temporary_mb", 1, 0), ("TFLOP", "flops", 1e-12, 2))
        ]
        header = [f"{preset} at {memory_size}", *(f"{count} views" for count in memory)]
        run.show(markdown_table(header, table), rows, "reconstruction_memory")


def benchmark(config: HumanGSConfig, views: int, size: int, repeats: int) -> dict[str, Any]:
    """Of all tokens and those of the foreground: ms, operations, MiB, shares of the peak; and of stages."""
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are of a first run
    inputs, variables = benchmark_inputs(config, views, size), random_variables(config)
    packed, touched, share = foreground(inputs, config)
    cases = {"all": config.with_runtime(tokens="all"), "foreground": packed}
    product, product_flops = matmul_program(config.runtime.dtype)
    runs, facts, wait = {"matmul": product}, {}, jax.block_until_ready
    for name, case in cases.items():
        program, seconds, flops = whole(variables, inputs, case)
        tokens = round(touched / share) if name == "all" else case.runtime.token_capacity
        facts[name] = {"compile_s": seconds, "flops": flops, "temporary_mb": temporary_mb(program), "tokens": tokens}
        runs[name] = lambda program=program: wait(program(variables, inputs))
        encoding = encode(variables, inputs, case)
        features = read(variables, encoding, inputs, case)
        runs[f"{name} encode"] = lambda case=case: wait(encode(variables, inputs, case))
        runs[f"{name} read"] = lambda case=case, x=encoding: wait(read(variables, x, inputs, case))
        runs[f"{name} decode"] = lambda case=case, x=features: wait(decode(variables, x, inputs, case))
    load = os.getloadavg()[0]
    times = {name: list(map(float, pair)) for name, pair in medians(runs, repeats).items()}
    gflops = product_flops / times["matmul"][0] / 1e6
    for name, fact in facts.items():
        wall, cpu = times[name]
        fact |= {"ms": wall, "cpu_ms": cpu, "share_of_peak": fact["flops"] / gflops / 1e6 / wall}
        fact["ratio_to_matmul_cpu"] = cpu / times["matmul"][1] * product_flops / fact["flops"]
    published = whole_network_flops(variables, inputs, cases["all"])
    promised, measured = (facts["all"][key] / facts["foreground"][key] for key in ("flops", "ms"))
    return facts | {
        "published_flops": published,
        "ratio_to_published_matmul": facts["all"]["ms"] / (published / gflops / 1e6),
        "matmul_gflops": gflops,
        "foreground_share": share,
        "speed_up": {"promised": promised, "measured": measured, "fraction": measured / promised},
        "stages_ms": {name: pair for name, pair in times.items() if " " in name},
        "peak_rss_mb": peak_rss_mb(),
        "views": views,
        "size": size,
        "vertices": int(inputs.canonical_vertices.shape[0]),
        "dtype": config.runtime.dtype,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
    }


def _memory(config, views, size):
    """MiB that a program for that number of photos of that size needs besides its arguments and results; its operations."""
    subject = benchmark_inputs(config.with_runtime(tokens="all"), views, size)
    if config.tokens == "foreground":
        config = foreground(subject, config)[0]
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), subject)
    program, _, flops = whole(expected_variables(config), shapes, config)
    return {"temporary_mb": temporary_mb(program), "flops": flops}


def benchmark_text(numbers: dict[str, Any]) -> str:
    """The table, and what follows from it."""
    rows = []
    for name in ("all", "foreground"):
        case = numbers[name]
        ratios = f"{1 / case['share_of_peak']:.2f}, {case['ratio_to_matmul_cpu']:.2f}"
        time, flops = f"{case['ms']:.0f}, {case['cpu_ms']:.0f}", f"{case['flops'] / 1e9:.0f}"
        memory, compiling = f"{case['temporary_mb']:.0f}", f"{case['compile_s']:.1f}"
        rows.append([name, case["tokens"], time, flops, f"{case['share_of_peak']:.2f}", ratios, memory, compiling])
    header = ["tokens", "slots", "wall, CPU ms", "GFLOP", "share of peak", "/ matmul (wall, CPU)", "MiB", "compile s"]
    gain = numbers["speed_up"]
    stages = ", ".join(f"{name} {wall:.0f} ({cpu:.0f})" for name, (wall, cpu) in numbers["stages_ms"].items())
    return (
        f"{markdown_table(header, rows)}\n\n"
        f"Matrix products {numbers['matmul_gflops']:.0f} GFLOP/s. Published network {numbers['published_flops'] / 1e12:.3f} "
        f"TFLOP: all tokens take {numbers['ratio_to_published_matmul']:.2f} times as long as these as plain products.\n"
        f"Foreground share {numbers['foreground_share']:.3f}: speed-up {gain['measured']:.2f} measured, "
        f"{gain['promised']:.2f} promised by the operations, {gain['fraction']:.2f} of it.\n\nStages, wall (CPU) ms: {stages}."
    )


@entry
def reconstruction_savings(
    run: Run, preset: str = "paper", weights: Path | None = None, views: int = 4, size: int = 256, repeats: int = 3
) -> None:
    """What each piece of work that a scene does not need would cost, and what leaving it out changes.

    Starts from the network as published (all tokens, the last convolution at every pixel, every view for every vertex) and leaves
    out one thing after the other; the rows are timed in turns. Errors are those of the Gaussians against the first row, and of an
    image drawn from them. With random weights the rows that are exact by construction must show rounding only; what foreground
    tokens do to a network that was trained with all of them, only its --weights tell. 2 minutes on 2 cores.

    Options:
    preset: published, paper, small or tiny
    weights: these, and their network, instead of a preset's
    size: side of the photos, pixels
    repeats: timed iterations; 0: errors only
    """
    variables, config = load_weights(weights) if weights else (None, configured(preset, size))
    config = config.with_runtime(tokens="all")
    variables = variables or random_variables(config)
    inputs = benchmark_inputs(config, views, size)
    packed, touched, share = foreground(inputs, config)
    here = lambda config: lambda v, x: apply_humangs(v, x, config)[0].gaussians
    networks = {"as published": lambda v, x: everywhere(v, x, config)}
    if paper_parts(config.architecture)[1].output_width is not None:
        networks["last convolution where read"] = here(config)
    networks["foreground tokens"] = here(packed)
    programs = {name: compiled(function, variables, inputs) for name, function in networks.items()}
    outputs = {name: program(variables, inputs) for name, (program, _, _) in programs.items()}
    runs = {name: lambda p=p: jax.block_until_ready(p(variables, inputs)) for name, (p, _, _) in programs.items()}
    times = medians(runs, repeats) if repeats else {}
    reference = outputs["as published"]
    picture, rows = drawn(reference, inputs), {}
    for name, output in outputs.items():
        square = float(np.mean((drawn(output, inputs) - picture) ** 2))
        rows[name] = {"flops": programs[name][2], "temporary_mb": temporary_mb(programs[name][0])}
        rows[name] |= dict(zip(("ms", "cpu_ms"), map(float, times.get(name, ())), strict=False))
        rows[name] |= errors(output, reference, inputs) | {"psnr": -10 * float(np.log10(square)) if square else None}
    table = []
    for name, row in rows.items():
        time = [f"{row['ms']:.0f}, {row['cpu_ms']:.0f}", f"{rows['as published']['cpu_ms'] / row['cpu_ms']:.2f}"]
        error = f"{row['offsets_relative_l2']:.1e}, {row['colors_relative_l2']:.1e}"
        pictured = "equal" if row["psnr"] is None else f"{row['psnr']:.1f}"
        memory = f"{row['temporary_mb']:.0f}"
        table.append([name, f"{row['flops'] / 1e9:.0f}", *(time if times else ["", ""]), memory, error, pictured])
    header = ["left out so far", "GFLOP", "wall, CPU ms", "gain (CPU)", "MiB", "offsets, colors", "picture, dB"]
    vertices = len(inputs.canonical_vertices)
    about = (
        f"{weights.name if weights else 'random'} weights, {preset}, {views} views of {size}, pool {config.conventions.pool}, "
        f"foreground share {share:.3f}, {vertices} vertices"
    )
    numbers = {"rows": rows, "foreground_share": share, "foreground_tokens": touched}
    run.show(f"{about}\n\n{markdown_table(header, table)}", numbers)


WIDTH, LAYERS = 384, 6
COLORS = {"all": "#c0392b", "foreground": "#1f6f8b"}


@entry
def reconstruction_scaling(
    run: Run, views: tuple[int, ...] = (1, 2, 4, 8, 16), size: int = 256, repeats: int = 1, image: Path | None = None
) -> None:
    """How the cost of a reconstruction grows with the number of photos.

    Half of the published network's width and depth, so that 16 views of 256 x 256 take seconds, with all tokens and with those of
    the foreground; and, counted from programs that are not run, the operations of the published network itself. 5 minutes on 2
    cores. Expected: attention makes all tokens grow faster than the views from 4 of them on; foreground tokens grow with them.

    Options:
    size: side of the photos, pixels
    repeats: timed iterations
    image: draw them here (.png)
    """
    full = configured("paper", size)
    encoder = paper_parts(full.architecture)[0]
    transformer = dataclasses.replace(encoder.transformer, width=WIDTH, layers=LAYERS)
    half = full.with_parts(encoder=encoder.clone(transformer=transformer))
    variables, rows = random_variables(half), []
    for count in views:
        inputs, programs = benchmark_inputs(full, count, size), {}
        _, touched, share = foreground(inputs, full)
        row: dict[str, Any] = {"views": count, "foreground_tokens": touched, "foreground_share": share}
        for name in COLORS:
            small, large = (foreground(inputs, c)[0] if name == "foreground" else c for c in (half, full))
            programs[name], _, flops = whole(variables, inputs, small)
            published = whole(expected_variables(large), inputs, large)[2]
            row[name] = {"flops": flops, "published_flops": published}
        runs = {name: lambda p=p, x=inputs: jax.block_until_ready(p(variables, x)) for name, p in programs.items()}
        for name, (wall, cpu) in medians(runs, repeats).items():
            row[name] |= {"ms": float(wall), "cpu_ms": float(cpu)}
        rows.append(row)
    header = ["views", "foreground", *(f"{name}, {what}" for name in COLORS for what in ("CPU s", "published TFLOP"))]
    table = []
    for row in rows:
        pairs = [(row[name]["cpu_ms"] / 1e3, row[name]["published_flops"] / 1e12) for name in COLORS]
        numbers = [f"{number:.2f}" for pair in pairs for number in pair]
        table.append([row["views"], f"{row['foreground_tokens']} ({row['foreground_share']:.2f})", *numbers])
    run.show(markdown_table(header, table), {"rows": rows, "width": WIDTH, "layers": LAYERS, "size": size})
    if image:
        plot(image, rows)


def plot(path: Path, rows: list[dict[str, Any]]) -> None:
    """Time and counted operations against the number of views."""
    views = np.asarray([row["views"] for row in rows])
    with figure(path, 2, (9, 3.8)) as (left, right):
        for name, color in COLORS.items():
            of = lambda key, name=name: np.asarray([row[name][key] for row in rows])
            left.loglog(views, of("cpu_ms") / 1e3, "o-", color=color, label=f"{name} tokens")
            right.loglog(views, of("published_flops") / 1e12, "o-", color=color, label=f"{name} tokens")
            linear = of("cpu_ms")[0] / 1e3 * views / views[0]
            left.loglog(views, linear, ":", color=color, linewidth=1, label=f"{name}: proportional to views")
        left.set(ylabel="CPU seconds", title=f"measured: width {WIDTH}, {LAYERS} layers")
        right.set(ylabel="TFLOP", title="counted: published network")
        for axis in (left, right):
            axis.set_xlabel("views")
            axis.set_xticks(views, [str(count) for count in views])
            axis.minorticks_off()
            axis.legend(fontsize=8)
