"""What a step of training costs on a mesh of many chips, counted from the program that XLA compiles for them.

    python experiments/training_cost.py --libtpu SITE_PACKAGES --json OUT

Compiles the divided training step for a topology of TPUs, without the chips and without running anything, and counts
what one chip does in one step: operations, memory traffic, memory, what it sends to others. `--libtpu` is the folder into
which `pip install --target` put the package libtpu, where it is not installed. `--chips v5e:16x16 --fsdp 256` describes the
mesh, `--sizes 256 512` the stages, `--per-chip` the subjects of each chip. Weights of the loss networks are made up.
Each program compiles for minutes. Numbers and what follows from them: docs/scaling.md, made by `--page`.
"""

import argparse
import dataclasses
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from compiled_costs import compiled_costs
from hlo_collectives import collectives
from report_tables import markdown_table, write_json, write_section

VARIANTS = {
    "kept": {},
    "recomputed": {"transformer": {"scan": True, "remat": True}},
    "foreground": {"tokens": "foreground"},
    "foreground, recomputed": {"tokens": "foreground", "transformer": {"scan": True, "remat": True}},
}
"""What the backward pass finds of the blocks, and which patches become tokens."""
FOREGROUND_SHARE = 0.22
"""Room for foreground tokens: a person by the published protocol touches a fifth (docs/performance_reconstruction.md)."""
XLA_TOKENS = 8192


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="published")
    parser.add_argument("--chips", default="v5e:16x16", help="TPU topology")
    parser.add_argument("--fsdp", type=int, help="chips that share one copy of the state; all if not given")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 512], help="of photographs and targets, pixels")
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--targets", type=int, default=4)
    parser.add_argument("--per-chip", type=int, default=1, help="subjects of a chip in a step")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=["recomputed"])
    parser.add_argument("--libtpu", type=Path, help="folder with the package libtpu")
    parser.add_argument("--json", type=Path, help="add the numbers to this file")
    parser.add_argument(
        "--page", type=Path, help="write the table into this page from the numbers in --json, compile nothing"
    )
    arguments = parser.parse_args()
    if arguments.page:
        write_section(arguments.page, "cost", table(json.loads(arguments.json.read_text())))
        return
    result = json.loads(arguments.json.read_text()) if arguments.json and arguments.json.exists() else {}
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
    """Descriptions of the chips of a TPU topology."""
    os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")  # nobody to ask about the machine: there is none
    os.environ.setdefault("TPU_LOG_DIR", "disabled")
    if libtpu is not None:
        sys.path.append(str(libtpu))
        os.environ.setdefault("TPU_LIBRARY_PATH", str(libtpu / "libtpu" / "libtpu.so"))
    import jax

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_compilation_cache", False)
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
    lowered = step.lower(state, batch, everywhere(body), everywhere(networks), config=config, mesh=mesh)
    traced = time.perf_counter()
    facts = {
        "chips": mesh.size,
        "subjects": config.batch_size,
        "parameters": sum(x.size for x in jax.tree.leaves(state.params)),
        "state_bytes": sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state)),
        "batch_bytes": sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(batch)),
        "trace_s": traced - start,
    }
    try:
        program = lowered.compile()
    except jax.errors.JaxRuntimeError as error:
        return facts | {"refused": str(error).splitlines()[0][:300]}
    costs, text = compiled_costs(program), program.as_text() or ""
    sent = collectives(text, mesh.size)
    return facts | {
        "compile_s": time.perf_counter() - traced,
        "flops": costs.matrix_flops,
        "bytes": costs.bytes_accessed,
        "temporary_bytes": costs.temporary_bytes,
        "argument_bytes": costs.argument_bytes,
        "unknown_trips": costs.unknown_trips,
        "uncounted": list(costs.uncounted),
        "collectives": dataclasses.asdict(sent),
        "jax": jax.__version__,
    }


def configured(arguments: argparse.Namespace, size: int, variant: str, chips: int) -> Any:
    """The settings of a stage."""
    from training_cases import settings, with_model

    batch = arguments.per_chip * chips
    config = settings(arguments.preset, size, arguments.views, arguments.targets, batch)
    fields = dict(VARIANTS[variant])
    patches = arguments.views * (size // config.model.patch_size) ** 2
    tokens = patches
    if fields.get("tokens") == "foreground":
        tokens = fields["token_capacity"] = int(FOREGROUND_SHARE * patches)
    # what "auto" would choose there: it asks for the devices at hand
    fields["attention"] = {"implementation": "xla" if tokens < XLA_TOKENS else "chunked"}
    config = with_model(config, **fields)
    return dataclasses.replace(config, microbatch_size=1)


def abstract_arguments(config: Any) -> tuple[Any, Any, Any, Any]:
    """Shapes of state, batch, body and loss networks."""
    import jax
    from training_cases import abstract_batch, random_networks

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
    header = [
        "one chip, one step",
        "compile s",
        "TFLOP",
        "GB memory traffic",
        "MiB temporaries",
        "MiB arguments",
        "MB sent",
    ]
    rows = []
    for name, row in result.items():
        if "refused" in row:
            rows.append([name, "refused", *["-"] * 5])
            continue
        sent = sum(row["collectives"]["sent_bytes"].values())
        cells = [row["flops"] / 1e12, row["bytes"] / 1e9, row["temporary_bytes"] / 2**20, row["argument_bytes"] / 2**20]
        rows.append([name, f"{row['compile_s']:.0f}", *(f"{x:.1f}" for x in cells), f"{sent / 1e6:.0f}"])
    return markdown_table(header, rows)


if __name__ == "__main__":
    main()
