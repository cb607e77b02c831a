"""What a step of training costs on a mesh of many chips, counted from the traced program."""

import dataclasses
import functools
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax
from jax.experimental import topologies

from experiments.costs import costs_of, temporary_mb
from experiments.harness import Run, entry
from experiments.results import markdown_table
from experiments.training import abstract_batch, random_networks, settings, with_model
from humangs_jax.body.library import load_body
from humangs_jax.data.views import gaussian_body
from humangs_jax.training import sharding
from humangs_jax.training.state import init_state
from humangs_jax.training.step import seed_numbers, update

VARIANTS = {
    "kept": {},
    "recomputed": {"scan": True, "remat": "full"},
    "foreground": {"tokens": "foreground"},
    "foreground, recomputed": {"tokens": "foreground", "scan": True, "remat": "full"},
}
"""What the backward pass finds of the blocks, and which patches become tokens."""
FOREGROUND_SHARE = 0.22
"""Room for foreground tokens: a person by the published protocol touches a fifth (docs/performance.md)."""
XLA_TOKENS = 8192


@entry
def training_cost(
    run: Run,
    preset: str = "published",
    chips: str = "v5e:16x16",
    fsdp: int | None = None,
    sizes: tuple[int, ...] = (256, 512),
    views: int = 4,
    targets: int = 4,
    per_chip: int = 1,
    variants: tuple[str, ...] = tuple(VARIANTS),
    libtpu: Path | None = None,
) -> None:
    """What a step of training costs on a mesh of many chips, counted from the traced program.

    Counts what one chip does in one step, without the chips and without running anything: operations and what it sends, from the
    step as it is written (XLA removes next to nothing of either). With --libtpu, also the memory of what XLA compiles for a
    topology of TPUs: many minutes each; without it a minute each. Weights of the loss networks are made up.

    Options:
    chips: TPU topology
    fsdp: chips that share one copy of the state; all if not given
    sizes: of photos and targets, pixels
    per_chip: subjects of a chip in a step
    variants: of "kept", "recomputed", "foreground", "foreground, recomputed"
    libtpu: folder into which `pip install --target` put the package libtpu
    """
    devices = topology(chips, libtpu)

    def measure(size, variant):
        mesh = sharding.training_mesh(fsdp, devices)
        config = settings(preset, size, views, targets, per_chip * mesh.size)
        return step_cost(as_variant(config, variant), mesh, libtpu is not None)

    name = lambda size, variant: f"{preset} {size} {variant}, {per_chip} a chip, {chips}"
    cases = {name(size, v): functools.partial(measure, size, v) for size in sizes for v in variants}
    rows = run.rows(cases, {"fsdp": fsdp, "views": views, "targets": targets, "compiled": libtpu is not None})
    header = ["one chip, one step", "TFLOP", "of them convolutions", "messages", "MB sent", "state, MB", "batch, MB"]
    header += ["compile, CPU s", "MiB needed"] if libtpu else []
    table = []
    for what, row in rows.items():
        sizes_of = [row[key] / row["chips"] / 1e6 for key in ("state_bytes", "batch_bytes")]
        mega = [f"{x:.1f}" for x in (sum(row["sent_bytes"].values()) / 1e6, *sizes_of)]
        share = row["convolution_flops"] / row["flops"]
        cells = [what, f"{row['flops'] / 1e12:.2f}", f"{share:.0%}", sum(row["messages"].values()), *mega]
        if "temporary_mb" in row:
            cells += [f"{row['compile_cpu_s']:.0f}", f"{row['temporary_mb'] + row['argument_mb']:.0f}"]
        table.append([*cells, *["refused"] * (len(header) - len(cells))])
    run.show(markdown_table(header, table), rows)


def topology(name: str, libtpu: Path | None) -> Any:
    """Descriptions of the chips of a TPU topology, to compile for; virtual devices, to count for, without `libtpu`."""
    chips = math.prod(int(side) for side in name.split(":")[-1].split("x"))
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={chips}"
    os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")  # nobody to ask about the machine: there is none
    os.environ.setdefault("TPU_LOG_DIR", "disabled")
    if libtpu is not None:
        sys.path.append(str(libtpu))
        os.environ.setdefault("TPU_LIBRARY_PATH", str(libtpu / "libtpu" / "libtpu.so"))
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_compilation_cache", False)
    if libtpu is None:
        return jax.devices()
    return topologies.get_topology_desc(name, "tpu").devices


def step_cost(config: Any, mesh: Any, compile_it: bool) -> dict[str, Any]:
    """Of one step of a chip."""
    state, batch, body, networks = abstract_arguments(config)
    placed = lambda tree, shardings: jax.tree.map(
        lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), tree, shardings
    )
    everywhere = lambda tree: placed(tree, jax.tree.map(lambda _: sharding.replicated(mesh), tree))
    state = placed(state, sharding.state_shardings(state, mesh))
    batch = placed(batch, jax.tree.map(lambda _: sharding.batch_sharding(mesh), batch))
    # without the compiler options of the CPU that this runs on
    step = jax.jit(update, static_argnames=("config", "mesh"), donate_argnames="state")
    start = time.perf_counter()
    given = state, batch, everywhere(body), everywhere(networks), seed_numbers(config.seed)
    traced = step.trace(*given, config=config, mesh=mesh)
    costs, size = costs_of(traced), lambda tree: sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))
    facts = {
        "chips": mesh.size,
        "subjects": config.batch_size,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
        "state_bytes": size(state),
        "batch_bytes": size(batch),
        "trace_s": time.perf_counter() - start,
        "flops": costs.flops,
        "convolution_flops": costs.convolutions,
        "unknown_trips": costs.unknown_trips,
        "messages": dict(costs.messages),
        "sent_bytes": dict(costs.sent),
    }
    return facts | (compiled(traced.lower(lowering_platforms=("tpu",))) if compile_it else {})


def as_variant(config: Any, variant: str) -> Any:
    """The settings of a stage with one of `VARIANTS`."""
    fields: dict[str, Any] = dict(VARIANTS[variant])
    model = config.model
    side = model.conventions.image_size // model.architecture.encoder.patch_size
    tokens = config.views.input_counts[0] * side**2
    if fields.get("tokens") == "foreground":
        tokens = fields["token_capacity"] = int(FOREGROUND_SHARE * tokens)
    # what "auto" would choose there: it asks for the devices at hand
    fields["attention"] = "xla" if tokens < XLA_TOKENS else "chunked"
    return dataclasses.replace(with_model(config, **fields), microbatch_size=1)


def compiled(lowered: Any) -> dict[str, Any]:
    """Of the program that XLA makes; or why it refuses, for instance for want of memory."""
    start = time.perf_counter(), time.process_time()
    try:
        program = lowered.compile()
    except jax.errors.JaxRuntimeError as error:
        return {"refused": str(error).splitlines()[0][:300]}
    memory = program.memory_analysis()
    return {
        "compile_s": time.perf_counter() - start[0],
        "compile_cpu_s": time.process_time() - start[1],
        "temporary_mb": temporary_mb(program),
        "argument_mb": memory.argument_size_in_bytes / 2**20,
        "jax": jax.__version__,
    }


def abstract_arguments(config: Any) -> tuple[Any, Any, Any, Any]:
    """Shapes of state, batch, body and loss networks."""
    body = gaussian_body(load_body(), config.model)
    shapes = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
    batch = abstract_batch(config, len(body.parents), body.shape_directions.shape[-1])
    state = jax.eval_shape(lambda: init_state(config))
    return state, batch, shapes(body), jax.eval_shape(lambda: random_networks(config))
