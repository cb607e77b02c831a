"""One step of training: settings, arguments, program, time, arithmetic and memory; and the curve of a run."""

import dataclasses
import functools
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from experiments.costs import costs_of, temporary_mb
from experiments.harness import Run, entry, figure
from experiments.reconstruction import foreground, matmul_program, random_variables
from experiments.results import markdown_table
from experiments.timing import medians, peak_rss_mb
from humangs_jax.body.library import load_body
from humangs_jax.core.compiling import compiler_options
from humangs_jax.data.loading import CaptureCache, CaptureSource, Example, Loader, ViewSampling
from humangs_jax.data.views import SubjectViews, gaussian_body, prepare_inputs
from humangs_jax.geometry.camera import Camera
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.losses.perceptual import BACKBONES, VGG19, Convolution, Lpips, Vgg19, channels, convolutions
from humangs_jax.people.writer import Layout, write_person
from humangs_jax.training.config import PRESETS
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers, update


def settings(preset: str, size: int, views: int, targets: int, batch: int = 1) -> Any:
    """The `TrainConfig` of a preset for photos and targets of `size` pixels, numbers of views as given."""
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


def with_model(config: Any, upsampler: Any = None, **runtime: Any) -> Any:
    """With other fields of the network's `Runtime`, or with an upsampler in proportion to the network."""
    model = config.model.with_runtime(**runtime)
    if upsampler is not None:
        encoder, reader = model.architecture.encoder, model.architecture.reader
        model = model.with_parts(
            encoder=dataclasses.replace(encoder, upsampler=upsampler),
            reader=dataclasses.replace(reader, output_width=encoder.transformer.width),
        )
    return dataclasses.replace(config, model=model)


def abstract_batch(config: Any, joints: int, betas: int) -> Any:
    """Shapes of an `Example` with a leading axis of `config.batch_size` subjects."""

    def views(count: int, size: int):
        camera = lambda K, pose: Camera(K, pose, size, size)
        return SubjectViews(
            images=jnp.zeros((count, size, size, 3)),
            masks=jnp.zeros((count, size, size)),
            cameras=jax.vmap(camera)(jnp.zeros((count, 3, 3)), jnp.zeros((count, 4, 4))),
            rotations=jnp.zeros((count, joints, 3)),
            translations=jnp.zeros((count, 3)),
            betas=jnp.zeros(betas),
        )

    def example(_):
        inputs = views(config.views.input_counts[0], config.model.conventions.image_size)
        return Example(inputs, views(config.views.target_count, config.target_size))

    return jax.eval_shape(jax.vmap(example), jax.ShapeDtypeStruct((config.batch_size,), jnp.int32))


def random_weights(key: Any, slices: Any) -> Any:
    """Random weights of a network of `losses.perceptual`."""

    def draw(layer, key):
        shape = (layer.size, layer.size, layer.inputs, layer.outputs)
        scale = (2 / (layer.size**2 * layer.inputs)) ** 0.5
        return Convolution(scale * jax.random.normal(key, shape), jnp.zeros(layer.outputs))

    layers = list(convolutions(slices))
    return {layer.name: draw(layer, key) for layer, key in zip(layers, jax.random.split(key, len(layers)), strict=True)}


def random_networks(config: Any) -> Any:
    """`LossNetworks` with made-up weights for the losses that need some: they cost what the real ones cost."""
    key = jax.random.key(0)
    perceptual = Vgg19(random_weights(key, VGG19)) if config.loss.perceptual else None
    lpips = None
    if config.loss.lpips:
        slices = BACKBONES["vgg"]
        heads = [jax.numpy.full(count, 1.0 / count) for count in channels(slices)]
        lpips = Lpips(random_weights(key, slices), tuple(heads), "vgg")
    return LossNetworks(perceptual, lpips)


def written_subject(folder: Path, config: Any, body: Any, seed: int = 0) -> Path:
    """The capture folder of a synthetic person with as many views as an example takes; made if it is not there."""
    views = config.views.input_counts[0] + config.views.target_count
    path = folder / f"{config.model.conventions.image_size}_{views}"
    if not path.exists():
        write_person(path, seed, body, Layout(config.model.conventions.image_size, views=views))
    return path


CASES = {
    "small 256": ("small", 256, 4, 2),
    "published 256": ("published", 256, 4, 4),
    "published 512": ("published", 512, 4, 4),
    "tiny 32": ("tiny", 32, 2, 2),
}
"""Preset, size of photos and targets, input views, targets. The last one is for tests."""


class Case:
    """Everything that a step of one configuration needs; `state` is what the last step gave."""

    def __init__(self, preset: str, size: int, views: int, targets: int, dtype: str, batch: int = 1):
        if dtype == "auto":
            dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
        self.config = with_model(settings(preset, size, views, targets, batch), dtype=dtype)
        self.program: Any = None
        self.full_body = load_body()
        self.networks = random_networks(self.config)

    def prepare(self, folder: Path) -> "Case":
        """Makes the person, reads the batch, draws the weights."""
        config = self.config
        self.capture = written_subject(folder, config, self.full_body)
        self.loader = Loader(self.source(), config.batch_size)
        self.body = gaussian_body(self.full_body, config.model)
        self.batch = jax.block_until_ready(self.loader.batch_at(0))
        self.fit()
        self.state = fresh_state(config)
        return self

    def source(self) -> Any:
        """Examples of the person; nothing is read yet."""
        cache = CaptureCache([self.capture], self.full_body)
        return CaptureSource(
            cache, self.config.views, self.config.model.conventions.image_size, self.config.target_size
        )

    def fit(self) -> None:
        """Room for the foreground tokens of this person, as a run would have."""
        if self.config.model.tokens == "foreground":
            inputs = jax.jit(prepare_inputs, static_argnames="config")(
                self.body, first(self.batch).inputs, self.config.model
            )
            self.config = with_model(
                self.config, token_capacity=foreground(inputs, self.config.model)[0].runtime.token_capacity
            )

    def compiled(self, options: dict[str, Any] | None) -> tuple[Any, float, Any]:
        """(the step as a program, CPU seconds that it took to trace and compile, its `Costs`)."""
        static = ("config", "mesh")
        step = jax.jit(update, static_argnames=static, donate_argnames="state", compiler_options=options)
        start = time.process_time()
        arguments = self.state, self.batch, self.body, self.networks, seed_numbers(self.config.seed)
        traced = step.trace(*arguments, config=self.config, mesh=None)
        program = traced.lower().compile()
        return program, time.process_time() - start, costs_of(traced)

    def run(self, program: Any) -> None:
        """One step."""
        self.state, metrics = program(self.state, self.batch, self.body, self.networks, seed_numbers(self.config.seed))
        self.metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}


def fresh_state(config: Any) -> Any:
    """A training state of random weights."""
    return init_state(config, random_variables(config.model))


def first(batch: Any) -> Any:
    """Its first subject."""
    return jax.tree.map(lambda x: x[0], batch)


def steps_table(result: dict[str, Any]) -> str:
    """One line per case. The share is of CPU time on a CPU, which others use, too, and of wall time elsewhere."""
    header = ["one subject a step", "tokens", "Gaussians", "wall, CPU s", "samples/s", "TFLOP", "share of floor"]
    header += ["MiB temporaries", "peak MiB", "compile, CPU s"]
    rows = [
        [
            name,
            row["tokens"],
            row["gaussians"],
            f"{row['ms'] / 1e3:.1f}, {row['cpu_ms'] / 1e3:.2f}",
            f"{row['samples_per_s']:.3f}",
            f"{row['flops'] / 1e12:.2f}",
            f"{row['share_of_floor_cpu' if row['device'] == 'cpu' else 'share_of_floor']:.2f}",
            f"{row['temporary_mb']:.0f}",
            f"{row['peak_rss_mb']:.0f}",
            f"{row['compile_cpu_s']:.0f}",
        ]
        for name, row in result.items()
    ]
    machines = "; ".join(
        f"{name}: {row['dtype']}, {row['device']}, jax {row['jax']}, products {row['matmul_gflops']:.0f} GFLOP/s (wall), "
        f"load {row['load_average']:.1f}, {row['repeats']} timed"
        for name, row in result.items()
    )
    return markdown_table(header, rows) + f"\n\n{machines}."


SMOOTHING = 20
"""Log lines that a point of the smooth curves averages, at most a quarter of all."""


@entry
def training_steps(
    run: Run,
    only: tuple[str, ...] = tuple(CASES)[:3],
    views: int | None = None,
    targets: int | None = None,
    dtype: Literal["auto", "float32", "bfloat16"] = "auto",
    repeats: int = 3,
) -> None:
    """Time, arithmetic and memory of one step of training, in turns with plain matrix products, which give the floor.

    A synthetic person is made and read by the loader; all weights are random, also those of loss networks. Operations are counted
    from the traced step, loops included. The floor is the time that these operations take as plain products in the same turns.
    All
    cases: half an hour on 2 idle cores.

    Options:
    only: of "small 256", "published 256", "published 512", "tiny 32"
    views: input views, instead of the case's
    targets: target views, instead of the case's
    dtype: auto: float32 on a CPU
    repeats: timed iterations
    """
    if unknown := set(only) - set(CASES):
        raise ValueError(f"--only: {unknown.pop()} is none of {', '.join(CASES)}")
    cases = {}
    for name in only:
        preset, size, *counts = CASES[name]
        inputs, wanted = views or counts[0], targets or counts[1]
        make = functools.partial(Case, preset, size, inputs, wanted, dtype)
        cases[f"{name}, {inputs} + {wanted} views"] = lambda make=make: step_numbers(make(), repeats)
    rows = run.rows(cases, {"dtype": dtype, "repeats": repeats})
    run.show(steps_table(rows), rows)


def step_numbers(case: Case, repeats: int) -> dict[str, Any]:
    """Of the whole step."""
    jax.config.update("jax_enable_compilation_cache", False)
    with tempfile.TemporaryDirectory() as folder:
        case.prepare(Path(folder))
        program, compile_s, costs = case.compiled(compiler_options())
        product, product_flops = matmul_program(case.config.model.runtime.dtype)
        load = os.getloadavg()[0]
        times = medians({"matmul": product, "step": lambda: case.run(program)}, repeats)
    wall, cpu = map(float, times["step"])
    floor, model = costs.flops / product_flops * times["matmul"], case.config.model
    patches = (
        case.config.views.input_counts[0] * (model.conventions.image_size // model.architecture.encoder.patch_size) ** 2
    )
    return {
        "ms": wall,
        "cpu_ms": cpu,
        "samples_per_s": 1e3 * case.config.batch_size / wall,
        "flops": costs.flops,
        "unknown_trips": costs.unknown_trips,
        "matmul_gflops": product_flops / float(times["matmul"][0]) / 1e6,
        "share_of_floor": float(floor[0]) / wall,
        "share_of_floor_cpu": float(floor[1]) / max(cpu, 1e-9),
        "temporary_mb": temporary_mb(program),
        "peak_rss_mb": peak_rss_mb(),
        "compile_cpu_s": compile_s,
        "tokens": model.runtime.token_capacity if model.tokens == "foreground" else patches,
        "gaussians": len(case.body.template) * model.architecture.decoder.gaussians_per_vertex,
        "parameters": sum(x.size for x in jax.tree.leaves(case.state.params)),
        "losses": case.metrics,
        "dtype": model.runtime.dtype,
        "repeats": repeats,
        "load_average": load,
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


SMOOTHING = 20
"""Log lines that a point of the smooth curves averages, at most a quarter of all."""


@entry
def training_curve(run: Run, logs: tuple[Path, ...], out: Path = Path("training.png")) -> None:
    """Draws the curve of a training run from its log: loss, and PSNR of training views and of validation people.

    Options:
    logs: log.jsonl of a run, and of runs that continue it: their steps are added up
    out: picture to write
    """
    lines: list[dict[str, Any]] = []
    for path in logs:
        offset = max((line["step"] for line in lines), default=0)
        read = [json.loads(line) for line in path.read_text().splitlines()]
        lines += [line | {"step": line["step"] + offset} for line in read]
    trained = [line for line in lines if line.get("loss") is not None and "event" not in line]
    validated = [line for line in lines if "val_psnr" in line]
    steps, count = [line["step"] for line in trained], max(1, min(SMOOTHING, len(trained) // 4))
    with figure(out, 2, (9, 3.2)) as (left, right):
        for axis, name, color in ((left, "loss", "C0"), (right, "psnr", "0.6")):
            if all(name in line for line in trained):
                values = np.asarray([line[name] for line in trained], float)
                smooth = np.convolve(values, np.ones(count) / count, "valid")
                axis.plot(steps, values, ".", ms=2, color="0.8")
                axis.plot(steps[count - 1 :], smooth, color=color, label="training views")
        left.set(xlabel="step", ylabel="training loss", yscale="log")
        psnr = [line["val_psnr"] for line in validated]
        right.plot([line["step"] for line in validated], psnr, "o-", ms=4, color="C1", label="validation people")
        right.set(xlabel="step", ylabel="PSNR, dB")
        right.legend(loc="lower right")
    run.show(f"{out}: {len(trained)} points, {len(validated)} validations")
