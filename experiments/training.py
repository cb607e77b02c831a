"""Measures time, arithmetic and memory of one step of training, counts what a step costs on many
chips, and draws the curve of a run.
"""

import dataclasses
import functools
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.costs import costs_of, temporary_mb
from experiments.harness import Run, entry, figure
from experiments.reconstruction import foreground, matmul_program, random_variables
from experiments.results import markdown_table
from experiments.timing import medians
from humangs_jax.body.library import load_body
from humangs_jax.core.processes import compiler_options, memory_status
from humangs_jax.data.loading import CaptureCache, CaptureSource, Example, Loader, ViewSampling
from humangs_jax.data.views import SubjectViews, gaussian_body, prepare_inputs
from humangs_jax.geometry.camera import Camera
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.losses.perceptual import (
    BACKBONES,
    VGG19,
    Convolution,
    Lpips,
    Vgg19,
    channels,
    convolutions,
)
from humangs_jax.synthetic.writer import Layout, write_person
from humangs_jax.training import sharding
from humangs_jax.training.config import PRESETS
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers, update


def settings(preset: str, size: int, views: int, targets: int, batch: int = 1) -> Any:
    """Returns the `TrainConfig` of a preset.

    Args:
        preset: a key of `PRESETS`
        size: side of photos and targets in pixels
        views: number of photos of an example
        targets: number of targets of an example
        batch: subjects of a step

    Raises: ValueError for an unknown preset.
    """
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset}: expected one of {', '.join(PRESETS)}")
    config = PRESETS[preset]()
    return dataclasses.replace(
        config,
        model=config.model.with_conventions(image_size=size),
        views=ViewSampling(input_counts=(views,), target_count=targets),
        target_size=size,
        batch_size=batch,
        stages=(),
    )


def with_model(config: Any, **runtime: Any) -> Any:
    """Returns a configuration with other fields of its network's runtime."""
    return dataclasses.replace(config, model=config.model.with_runtime(**runtime))


def random_weights(key: Any, slices: Any) -> Any:
    """Returns {layer: random weights} of the convolutions of a loss network."""

    def draw(layer, key):
        shape = (layer.size, layer.size, layer.inputs, layer.outputs)
        scale = (2 / (layer.size**2 * layer.inputs)) ** 0.5
        return Convolution(scale * jax.random.normal(key, shape), jnp.zeros(layer.outputs))

    layers = list(convolutions(slices))
    return {
        layer.name: draw(layer, key)
        for layer, key in zip(layers, jax.random.split(key, len(layers)), strict=True)
    }


def random_networks(config: Any) -> Any:
    """Returns `LossNetworks` with random weights for the losses that need networks.

    They cost as much as the real ones.
    """
    key = jax.random.key(0)
    perceptual = Vgg19(random_weights(key, VGG19)) if config.loss.perceptual else None
    lpips = None
    if config.loss.lpips or config.loss.vgg16:
        slices = BACKBONES["vgg"]
        heads = [jax.numpy.full(count, 1.0 / count) for count in channels(slices)]
        lpips = Lpips(random_weights(key, slices), tuple(heads), "vgg")
    return LossNetworks(perceptual, lpips)


def written_subject(folder: Path, config: Any, body: Any) -> Path:
    """Writes the capture of a synthetic person with as many views as an example takes, and returns
    its folder inside of `folder`.
    """
    views = config.views.input_counts[0] + config.views.target_count
    layout = Layout(config.model.conventions.image_size, views=views)
    write_person(folder / "person", 0, body, layout)
    return folder / "person"


CASES = {
    "small 256": ("small", 256, 4, 2),
    "published 256": ("published", 256, 4, 4),
    "published 512": ("published", 512, 4, 4),
    "tiny 32": ("tiny", 32, 2, 2),
}
"""{case: (preset, side of photos and targets, input views, targets)}. The last one is for tests."""


@entry
def training_steps(run: Run, only: tuple[str, ...] = ("small 256",), repeats: int = 3) -> None:
    """Measures time, arithmetic and memory of one step of training, in turns with plain matrix
    products, which give the floor.

    A synthetic person is made and read by the loader. All weights are random, also those of loss
    networks. Operations are counted in the traced step, with its loops. The floor is the time that
    these operations take as plain products in the same turns. `small` takes two minutes on 2 cores,
    `published` half an hour.

    Options:
    only: cases among "small 256", "published 256", "published 512", "tiny 32"
    repeats: timed iterations
    """
    unknown = set(only) - set(CASES)
    if unknown:
        raise ValueError(f"--only: {unknown.pop()} is none of {', '.join(CASES)}")
    cases = {
        f"{n}, {CASES[n][2]} + {CASES[n][3]} views": functools.partial(step_numbers, n, repeats)
        for n in only
    }

    # a line for each case
    rows, table = run.rows(cases, {"repeats": repeats}), []
    for name, row in rows.items():
        cells = [
            row["tokens"],
            f"{row['gaussians']:,}",
            f"{row['ms'] / 1e3:.1f}, {row['cpu_ms'] / 1e3:.2f}",
            f"{row['flops'] / 1e12:.2f}",
            f"{row['share_of_floor_cpu']:.2f}",
            f"{row['temporary_mb']:.0f}",
            f"{row['peak_rss_mb']:.0f}",
            f"{row['compile_cpu_s']:.0f}",
        ]
        table.append([name, *cells])
    header = ["one subject a step", "tokens", "Gaussians", "wall, CPU s", "TFLOP"]
    header += ["share of floor (CPU)", "MiB temporaries", "peak MiB", "compile, CPU s"]
    run.show(markdown_table(header, table), rows)


def step_numbers(name: str, repeats: int) -> dict[str, Any]:
    """Returns time, arithmetic and memory of a training step of a case."""
    jax.config.update("jax_enable_compilation_cache", False)
    config, body = settings(*CASES[name]), load_body()
    dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
    config = with_model(config, dtype=dtype)
    networks, carrier = random_networks(config), gaussian_body(body, config.model)
    size = config.model.conventions.image_size
    # a batch, as the loader of a run makes it
    with tempfile.TemporaryDirectory() as folder:
        cache = CaptureCache([written_subject(Path(folder), config, body)], body)
        source = CaptureSource(cache, config.views, size, config.target_size, config.loss.depth > 0)
        batch = jax.block_until_ready(Loader(source, config.batch_size).batch_at(0))
    # room for the person's foreground tokens, as a run would have
    if config.model.tokens == "foreground":
        first = jax.tree.map(lambda x: x[0], batch)
        prepare = jax.jit(prepare_inputs, static_argnames="config")
        inputs = prepare(carrier, first.inputs, config.model)
        model, _, _ = foreground(inputs, config.model)
        config = with_model(config, token_capacity=model.runtime.token_capacity)
    # the step is compiled apart from its runs
    state = init_state(config, random_variables(config.model))
    given = batch, carrier, networks, seed_numbers(config.seed)
    static, options = ("config", "mesh"), compiler_options()
    step = jax.jit(
        update, static_argnames=static, donate_argnames="state", compiler_options=options
    )
    start = time.process_time()
    traced = step.trace(state, *given, config=config, mesh=None)
    program = traced.lower().compile()
    compile_s, costs, metrics = time.process_time() - start, costs_of(traced), {}

    def once():
        nonlocal state
        state, found = program(state, *given)
        metrics.update({name: float(value) for name, value in jax.device_get(found).items()})

    # in turns with a matrix product, which gives the peak of this run
    product, product_flops = matmul_program(config.model.runtime.dtype)
    times = medians({"matmul": product, "step": once}, repeats)
    (wall, cpu), model = map(float, times["step"]), config.model
    floor = costs.flops / product_flops * times["matmul"]
    side = model.conventions.image_size // model.architecture.encoder.patch_size
    tokens = config.views.input_counts[0] * side**2
    if model.tokens == "foreground":
        tokens = model.runtime.token_capacity
    return {
        "ms": wall,
        "cpu_ms": cpu,
        "flops": costs.flops,
        "share_of_floor": float(floor[0]) / wall,
        "share_of_floor_cpu": float(floor[1]) / max(cpu, 1e-9),
        "temporary_mb": temporary_mb(program),
        "peak_rss_mb": memory_status("VmHWM"),
        "compile_cpu_s": compile_s,
        "tokens": tokens,
        "gaussians": len(carrier.template) * model.architecture.decoder.gaussians_per_vertex,
        "losses": metrics,
        "dtype": model.runtime.dtype,
        "device": jax.devices()[0].device_kind,
    }


# Many chips
# --------------------------------------------------------------------------------------------------

VARIANTS = {
    "kept": {},
    "recomputed": {"scan": True, "remat": "full"},
    "foreground": {"tokens": "foreground"},
    "foreground, recomputed": {"tokens": "foreground", "scan": True, "remat": "full"},
}
"""{variant: fields of the runtime}, which say whether blocks are computed again in the backward
pass, and which patches become tokens.
"""
FOREGROUND_SHARE = 0.22
"""Share of the tokens that the foreground has room for. A person of the published protocol touches
a fifth (docs/performance.md).
"""
XLA_TOKENS = 8192
"""Number of tokens from which on attention is computed in chunks."""
PEAKS = {
    "TPU v5e: 197 TFLOP/s, 200 GB/s to other chips": (197, 200),
    "H100: 989 TFLOP/s, 50 GB/s beyond 8": (989, 50),
}
"""{chip: (TFLOP/s, GB/s)} of data sheets."""


@entry
def training_cost(
    run: Run,
    preset: str = "published",
    chips: int = 256,
    sizes: tuple[int, ...] = (256, 512),
    variants: tuple[str, ...] = ("kept", "recomputed", "foreground"),
) -> None:
    """Counts what a step of training costs on a mesh of many chips with one subject each, from the
    traced program.

    Counted are the operations of one chip in one step, and the bytes that it sends, without the
    chips and without running anything. The step is counted as it is written; XLA removes next to
    nothing of it. Takes a minute for each case. Loss networks have random weights. The last columns
    divide these counts by the numbers of data sheets.

    Options:
    sizes: sides of photos and targets, pixels
    variants: variants among "kept", "recomputed", "foreground", "foreground, recomputed"
    """
    # virtual devices of the CPU stand for the chips
    os.environ["XLA_FLAGS"] = (
        f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={chips}"
    )
    jax.config.update("jax_platforms", "cpu")

    def measure(size: int, variant: str) -> dict[str, Any]:
        mesh = sharding.training_mesh(None, jax.devices())
        return step_cost(as_variant(settings(preset, size, 4, 4, mesh.size), variant), mesh)

    cases = {
        f"{preset} {size} {v}": functools.partial(measure, size, v)
        for size in sizes
        for v in variants
    }

    # a line for each case, with the least time on each kind of chip
    rows, table = run.rows(cases, {"chips": chips}), []
    for what, row in rows.items():
        sent = sum(row["sent_bytes"].values())
        cells = [
            f"{row['flops'] / 1e12:.2f}",
            f"{row['convolution_flops'] / row['flops']:.0%}",
            sum(row["messages"].values()),
            f"{sent / 1e6:.0f}",
            f"{row['state_bytes'] / row['chips'] / 1e6:.1f}",
        ]
        for flops, bandwidth in PEAKS.values():
            cells.append(f"{1e-9 * row['flops'] / flops:.1f}; {1e-6 * sent / bandwidth:.1f}")
        table.append([what, *cells])
    header = ["one chip, one step", "TFLOP", "of them convolutions", "messages", "MB sent"]
    header += ["state, MB", *(f"{name}: ms; sending" for name in PEAKS)]
    run.show(markdown_table(header, table), rows)


def step_cost(config: Any, mesh: Any) -> dict[str, Any]:
    """Returns what one chip of a mesh does in a step of training, counted in the traced program."""
    body = gaussian_body(load_body(), config.model)

    # only shapes are needed, and where their arrays are placed
    def shapes(tree):
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)

    state = jax.eval_shape(lambda: init_state(config))
    networks = jax.eval_shape(lambda: random_networks(config))
    batch = abstract_batch(config, len(body.parents), body.shape_directions.shape[-1])

    def placed(tree, shardings):
        return jax.tree.map(
            lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), tree, shardings
        )

    def everywhere(tree):
        return placed(tree, jax.tree.map(lambda _: sharding.replicated(mesh), tree))

    state = placed(state, sharding.state_shardings(state, mesh))
    batch = placed(batch, jax.tree.map(lambda _: sharding.batch_sharding(mesh), batch))
    step = jax.jit(update, static_argnames=("config", "mesh"), donate_argnames="state")
    given = state, batch, everywhere(shapes(body)), everywhere(networks), seed_numbers(config.seed)
    costs = costs_of(step.trace(*given, config=config, mesh=mesh))
    return {
        "chips": mesh.size,
        "state_bytes": sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)),
        "flops": costs.flops,
        "convolution_flops": costs.convolutions,
        "unknown_trips": costs.unknown_trips,
        "messages": dict(costs.messages),
        "sent_bytes": dict(costs.sent),
    }


def abstract_batch(config: Any, joints: int, betas: int) -> Any:
    """Returns the shapes of an `Example` with a leading axis of `config.batch_size` subjects."""

    def views(count: int, size: int) -> SubjectViews:
        def camera(K, pose):
            return Camera(K, pose, size, size)

        return SubjectViews(
            images=jnp.zeros((count, size, size, 3)),
            masks=jnp.zeros((count, size, size)),
            cameras=jax.vmap(camera)(jnp.zeros((count, 3, 3)), jnp.zeros((count, 4, 4))),
            rotations=jnp.zeros((count, joints, 3)),
            translations=jnp.zeros((count, 3)),
            betas=jnp.zeros(betas),
        )

    def example(_: Any) -> Example:
        inputs = views(config.views.input_counts[0], config.model.conventions.image_size)
        return Example(inputs, views(config.views.target_count, config.target_size))

    return jax.eval_shape(jax.vmap(example), jax.ShapeDtypeStruct((config.batch_size,), jnp.int32))


def as_variant(config: Any, variant: str) -> Any:
    """Returns a configuration as a variant of `VARIANTS`, with one subject at a time."""
    fields: dict[str, Any] = dict(VARIANTS[variant])
    side = config.model.conventions.image_size // config.model.architecture.encoder.patch_size
    tokens = config.views.input_counts[0] * side**2
    if fields.get("tokens") == "foreground":
        tokens = fields["token_capacity"] = int(FOREGROUND_SHARE * tokens)
    # what "auto" would choose on the chips; it would look at the devices of this machine
    fields["attention"] = "xla" if tokens < XLA_TOKENS else "chunked"
    return dataclasses.replace(with_model(config, **fields), microbatch_size=1)


# The curve of a run
# --------------------------------------------------------------------------------------------------

SMOOTHING = 20
"""Number of log lines that a point of the smooth curves averages, at most a quarter of all."""


@entry
def training_curve(run: Run, logs: tuple[Path, ...], out: Path = Path("training.png")) -> None:
    """Draws the curve of a training run from its log: the loss, and the PSNR of training views and
    of validation people.

    Options:
    logs: log.jsonl of a run, and of runs that continue it; their steps are added up
    out: picture to write
    """
    # lines of all logs, with steps counted from the begin of the first run
    lines: list[dict[str, Any]] = []
    begins = []
    for path in logs:
        offset = max((line["step"] for line in lines), default=0)
        begins.append(offset)
        read = [json.loads(line) for line in path.read_text().splitlines()]
        lines += [line | {"step": line["step"] + offset} for line in read]
    trained = [line for line in lines if line.get("loss") is not None and "event" not in line]
    validated = [line for line in lines if "val_psnr" in line]

    # points and smooth curves of training, points of validation, and the begins of the runs
    steps, count = [line["step"] for line in trained], max(1, min(SMOOTHING, len(trained) // 4))
    with figure(out, 2, (9, 3.2)) as (left, right):
        for axis, name, color in ((left, "loss", "C0"), (right, "psnr", "0.6")):
            if all(name in line for line in trained):
                values = np.asarray([line[name] for line in trained], float)
                smooth = np.convolve(values, np.ones(count) / count, "valid")
                axis.plot(steps, values, ".", ms=2, color="0.8")
                axis.plot(steps[count - 1 :], smooth, color=color, label="training views")
        left.set(xlabel="step", ylabel="training loss", yscale="log")
        places = [line["step"] for line in validated]
        psnr = [line["val_psnr"] for line in validated]
        right.plot(places, psnr, "o-", ms=4, color="C1", label="validation people")
        right.set(xlabel="step", ylabel="PSNR, dB")
        right.legend(loc="lower right")
        for axis in (left, right):
            for number, begin in enumerate(begins, start=1):
                axis.axvline(begin, color="black", lw=0.8, ls=":")
                axis.annotate(
                    f"run {number}",
                    (begin, 1),
                    (3, -10),
                    fontsize=7,
                    xycoords=("data", "axes fraction"),
                    textcoords="offset points",
                )
    run.show(f"{out}: {len(trained)} points, {len(validated)} validations")
