"""What a step of training costs on a mesh of many chips, counted from the traced program.

    python experiments/accelerator/training_cost.py --json OUT
    python experiments/accelerator/training_cost.py --json OUT --compile --libtpu SITE_PACKAGES

Counts what one chip does in one step, without the chips and without running anything: operations and what it sends, from
the step as it is written (XLA removes next to nothing of either). With `--compile`, also the memory of what XLA compiles for a
topology of TPUs; `--libtpu` is the folder into which `pip install --target` put the package libtpu, where it is not installed.
`--chips v5e:16x16 --fsdp 256` describes the mesh, `--sizes` the stages, `--per-chip` the subjects of each chip. Weights of
the loss networks are made up. Without `--compile` a minute each. Numbers and what follows from them: docs/scaling.md, made by
`--page`.
"""

import argparse
import dataclasses
import json
import math
import os
import sys
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import markdown_table, publish, write_json
from experiments.costs import costs_of, temporary_mb

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


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="published")
    parser.add_argument("--chips", default="v5e:16x16", help="TPU topology")
    parser.add_argument("--fsdp", type=int, help="chips that share one copy of the state; all if not given")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="of photos and targets, pixels")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--per-chip", type=int, default=1, help="subjects of a chip in a step")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--compile", action="store_true", help="also compile: many minutes each")
    parser.add_argument("--libtpu", type=Path, help="folder with the package libtpu")
    parser.add_argument("--json", type=Path, help="add the numbers to this file")
    parser.add_argument(
        "--page", type=Path, help="write the table into this page from the numbers in --json, compile nothing"
    )
    arguments = parser.parse_args()
    if arguments.page:
        numbers = json.loads(arguments.json.read_text())
        publish(arguments.page, "training_cost", table(numbers), numbers)
        return
    result = json.loads(arguments.json.read_text()) if arguments.json and arguments.json.exists() else {}
    if arguments.compile != (arguments.libtpu is not None):
        parser.error("--compile and --libtpu belong together")
    devices = topology(arguments.chips, arguments.libtpu)
    for size in arguments.sizes:
        for variant in arguments.variants:
            key = f"{arguments.preset} {size} {variant}, {arguments.per_chip} a chip, {arguments.chips}"
            result[key] = compilation(arguments, devices, size, variant)
            print(key, json.dumps(result[key]), flush=True)
            if arguments.json:
                write_json(arguments.json, result)
    print(table(result))


def topology(name: str, libtpu: Path | None) -> Any:
    """Descriptions of the chips of a TPU topology, to compile for; virtual devices, to count for, without `libtpu`."""
    chips = math.prod(int(side) for side in name.split(":")[-1].split("x"))
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={chips}"
    os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")  # nobody to ask about the machine: there is none
    os.environ.setdefault("TPU_LOG_DIR", "disabled")
    if libtpu is not None:
        sys.path.append(str(libtpu))
        os.environ.setdefault("TPU_LIBRARY_PATH", str(libtpu / "libtpu" / "libtpu.so"))
    import jax

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_compilation_cache", False)
    if libtpu is None:
        return jax.devices()
    from jax.experimental import topologies

    return topologies.get_topology_desc(name, "tpu").devices


def compilation(arguments: argparse.Namespace, devices: Any, size: int, variant: str) -> dict[str, Any]:
    """Of one step of a chip."""
    import jax

    from humangs_jax.training import sharding
    from humangs_jax.training.step import jitted_train_step

    mesh = sharding.training_mesh(arguments.fsdp, devices)
    config = configured(arguments, size, variant, mesh.size)
    state, batch, body, networks = abstract_arguments(config)
    placed = lambda tree, shardings: jax.tree.map(
        lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), tree, shardings
    )
    everywhere = lambda tree: placed(tree, jax.tree.map(lambda _: sharding.replicated(mesh), tree))
    state = placed(state, sharding.state_shardings(state, mesh))
    batch = placed(batch, jax.tree.map(lambda _: sharding.batch_sharding(mesh), batch))
    # without the compiler options of the CPU that this runs on
    step = jax.jit(jitted_train_step().__wrapped__, static_argnames=("config", "mesh"), donate_argnames="state")
    start = time.perf_counter()
    traced = step.trace(state, batch, everywhere(body), everywhere(networks), config=config, mesh=mesh)
    facts = {
        "chips": mesh.size,
        "subjects": config.batch_size,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
        "state_bytes": sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)),
        "batch_bytes": sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(batch)),
        "trace_s": time.perf_counter() - start,
    } | counted(traced)
    return facts | (compiled(traced.lower(lowering_platforms=("tpu",))) if arguments.compile else {})


def counted(traced: Any) -> dict[str, Any]:
    """Of the program before XLA's optimisations."""
    costs = costs_of(traced)
    return {
        "flops": costs.flops,
        "convolution_flops": costs.convolutions,
        "unknown_trips": costs.unknown_trips,
        "messages": dict(costs.messages),
        "sent_bytes": dict(costs.sent),
    }


def compiled(lowered: Any) -> dict[str, Any]:
    """Of the program that XLA makes; or why it refuses, for instance for want of memory."""
    import jax

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


def configured(arguments: argparse.Namespace, size: int, variant: str, chips: int) -> Any:
    """The settings of a stage."""
    from experiments.training.cases import settings, with_model

    batch = arguments.per_chip * chips
    config = settings(arguments.preset, size, arguments.views, arguments.targets, batch)
    fields = dict(VARIANTS[variant])
    patches = arguments.views * (size // config.model.architecture.encoder.patch_size) ** 2
    tokens = patches
    if fields.get("tokens") == "foreground":
        tokens = fields["token_capacity"] = int(FOREGROUND_SHARE * patches)
    # what "auto" would choose there: it asks for the devices at hand
    fields["attention"] = "xla" if tokens < XLA_TOKENS else "chunked"
    config = with_model(config, **fields)
    return dataclasses.replace(config, microbatch_size=1)


def abstract_arguments(config: Any) -> tuple[Any, Any, Any, Any]:
    """Shapes of state, batch, body and loss networks."""
    import jax

    from experiments.training.cases import abstract_batch, random_networks
    from humangs_jax.body.library import load_body
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.training.state import init_state

    body = gaussian_body(load_body(), config.model)
    shapes = lambda tree: jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
    batch = abstract_batch(config, len(body.parents), body.shape_directions.shape[-1])
    state = jax.eval_shape(lambda: init_state(config))
    return state, batch, shapes(body), jax.eval_shape(lambda: random_networks(config))


def table(result: dict[str, Any]) -> str:
    """One line per program."""
    header = ["one chip, one step", "TFLOP", "of them convolutions", "messages", "MB sent", "state, MB", "batch, MB"]
    if any("temporary_mb" in row or "refused" in row for row in result.values()):
        header += ["compile, CPU s", "MiB needed"]
    rows = []
    for name, row in result.items():
        messages = sum(row["messages"].values())
        sent = sum(row["sent_bytes"].values())
        mega = [sent / 1e6, row["state_bytes"] / row["chips"] / 1e6, row["batch_bytes"] / row["chips"] / 1e6]
        share = row["convolution_flops"] / row["flops"]
        cells = [name, f"{row['flops'] / 1e12:.2f}", f"{share:.0%}", messages, *(f"{x:.1f}" for x in mega)]
        if "temporary_mb" in row:
            needed = row["temporary_mb"] + row["argument_mb"]
            cells += [f"{row['compile_cpu_s']:.0f}", f"{needed:.0f}"]
        rows.append([*cells, *["refused" if "refused" in row else "-"] * (len(header) - len(cells))])
    return markdown_table(header, rows)


if __name__ == "__main__":
    main()
