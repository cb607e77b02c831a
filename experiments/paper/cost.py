"""The paper's central claim, measured: vertices that are projected into the photos against vertices that attend to all tokens.

    python experiments/paper/cost.py --page docs/paper.md --image docs/images/paper_cost.png

The two readers of `experiments.systems` "back_projection" and "cross_attention", alone, on maps of the same width: forward passes
over views, vertices and image sizes, in turns. Time is CPU time of all threads. Operations of attention are products of matrices,
counted in the compiled program; back-projection has none: its weighted sums of four neighbours count as 8 a vertex, view and
feature. Memory is what the program needs besides arguments and results. All patches are tokens, as in the paper.

Then the operations of whole networks in published sizes, counted in programs that are not run. Of LHM and its kin the joint
attention of points and tokens alone is counted, with the 40,000 points and 4,096 + 1,024 tokens a photo of the paper: the two
pretrained networks that make the tokens, and the decoder, come on top. 4 CPU minutes. --networks counts these again and keeps the
readers of the page. Expected: attention grows with vertices times tokens, back-projection with vertices times views, not with the
size of the photos.
"""

import argparse
import functools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from experiments.common.results import REPOSITORY, add_outputs, markdown_table, significant, write_outputs
from experiments.costs import costs_of, temporary_mb
from experiments.paper.bench import ANIMATION, FASTER_MODELLING, OURS
from experiments.timing import medians, prepare_process

TABLE = "paper_cost"
PATCH, READ_OPERATIONS = 8, 8
"""Operations of one bilinear read and its sum over views, per feature: four products, four additions."""
AXES = {"views": (1, 2, 4, 8, 16), "vertices": (1000, 3000, 10000, 40000), "size": (128, 256, 512)}
MIDDLE = {"views": 4, "vertices": 10000, "size": 256}
READERS = {"back-projection": "#1f6f8b", "cross-attention": "#c0392b"}
NETWORKS = {"humangs": 4, "back_projection": 4, "cross_attention": 4, "gst": 1}
"""Systems that are counted in their published size, and their photos."""
JOINT = {"lhm": 1, "lhm_views": 4, "lhm_plus": 4}
"""Systems of which the joint attention is counted, and their photos."""
POINTS, TOKENS = 40000, 4096 + 1024
"""Of LHM: points of the body, tokens of the body's photo and of the head's. LHM++ has its own, which we do not know."""


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=128, help="features of maps, vertices and attention")
    parser.add_argument("--repeats", type=int, default=3, help="timed iterations")
    parser.add_argument(
        "--networks", action="store_true", help="count the networks alone; readers: as docs/results has them"
    )
    parser.add_argument("--quick", action="store_true", help="the smallest sizes alone, no whole networks: for tests")
    add_outputs(parser, TABLE)
    parser.add_argument("--image", type=Path, help="draw them here (.png)")
    arguments = parser.parse_args()
    prepare_process()
    if arguments.networks:
        record = json.loads((REPOSITORY / "docs" / "results" / f"{TABLE}.json").read_text())
        measured_then = {key: record[key] for key in ("date", "machine", "versions")}
        result = {"readers": measured_then} | record["numbers"] | {"networks": all_networks()}
    else:
        result = measure(arguments)
    write_outputs(arguments, TABLE, text_of(result), result)
    if arguments.image:
        draw(result, arguments.image)


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Everything that the JSON holds."""
    import jax

    middle = {"views": 1, "vertices": 1000, "size": 64} if arguments.quick else MIDDLE
    axes = {name: values[:2] if arguments.quick else values for name, values in AXES.items()}
    cases = [
        middle | {axis: value}
        for axis, values in axes.items()
        if not (arguments.quick and axis == "size")
        for value in values
    ]
    rows = []
    for case in (case for i, case in enumerate(cases) if case not in cases[:i]):
        rows.append({**case, **compare(arguments.width, arguments.repeats, **case)})
        print(" ".join(f"{key} {value}" for key, value in case.items()), rows[-1], flush=True)
        jax.clear_caches()
    return {
        "rows": rows,
        "middle": middle,
        "width": arguments.width,
        "networks": {} if arguments.quick else all_networks(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
    }


def all_networks() -> dict[str, dict[str, float]]:
    """Operations by name."""
    whole = {name: network_flops(name, photos) for name, photos in NETWORKS.items()}
    return whole | {name: joint_flops(name, photos) for name, photos in JOINT.items()}


def compare(width: int, repeats: int, views: int, vertices: int, size: int) -> dict[str, dict[str, float]]:
    """CPU ms, operations and temporary MiB of both readers on the same maps."""
    import jax

    inputs, encoding = subject(width, views, vertices, size)
    runs, found = {}, {}
    for name, config in configurations(width, size).items():
        reader, run = config.architecture.reader, config.run()
        shapes = jax.eval_shape(lambda reader=reader, run=run: reader.init(jax.random.key(0), encoding, inputs, run))
        variables = jax.tree.map(lambda x: np.full(x.shape, 0.02, x.dtype), shapes)
        read = lambda v, e, x, reader=reader, run=run: reader.apply(v, e, x, run).local
        traced = jax.jit(read).trace(variables, encoding, inputs)
        program = traced.lower().compile()
        sums = READ_OPERATIONS * views * vertices * width if name == "back-projection" else 0
        found[name] = {
            "operations": costs_of(traced).flops + sums,
            "temporary_mb": temporary_mb(program),
        }
        runs[name] = functools.partial(wait, program, variables, encoding, inputs)
    for name, (wall, cpu) in medians(runs, repeats).items():
        found[name] |= {"ms": float(wall), "cpu_ms": float(cpu)}
    return found


def wait(program: Any, *arguments: Any) -> None:
    """Run it to the end."""
    import jax

    jax.block_until_ready(program(*arguments))


def configurations(width: int, size: int) -> dict[str, Any]:
    """The networks whose readers are compared."""
    from experiments.systems import back_projection
    from experiments.systems.cross_attention import CrossAttentionReader

    config = back_projection("bench").with_conventions(image_size=size, tokens="all")
    reader = CrossAttentionReader(width, layers=1, head_width=32)
    return {"back-projection": config, "cross-attention": config.with_parts(reader=reader)}


def subject(width: int, views: int, vertices: int, size: int) -> tuple[Any, Any]:
    """(inputs, encoding): points on a cylinder of the size of a person, cameras around it, maps of noise."""
    import jax.numpy as jnp

    from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
    from humangs_jax.network.inputs import HumanGSInputs
    from humangs_jax.network.parts import Encoding

    rng = np.random.default_rng(0)
    angles, heights = rng.uniform(-np.pi, np.pi, vertices), rng.uniform(-0.9, 0.9, vertices)
    normals = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    points = jnp.asarray(0.25 * normals + heights[:, None] * [0, 1, 0], jnp.float32)
    normals = jnp.asarray(normals, jnp.float32)
    all_views = lambda x: jnp.broadcast_to(x, (views, *x.shape))
    inputs = HumanGSInputs(
        images=jnp.zeros((views, size, size, 3)),
        cameras=orbit(
            jnp.zeros(3),
            3.0,
            jnp.arange(views) * (2 * np.pi / views),
            0.1,
            intrinsics_from_fov(0.8, size, size),
            size,
            size,
        ),
        posed_vertices=all_views(points),
        canonical_vertices=points,
        position_maps=jnp.zeros((views, size, size, 3)),
        depth_maps=jnp.full((views, size, size), 3.0),  # the half that faces a camera is seen
        foreground=jnp.ones((views, size, size), bool),
        posed_normals=all_views(normals),
        canonical_normals=normals,
    )
    maps = rng.standard_normal((views, size // PATCH, size // PATCH, width), np.float32)
    return inputs, Encoding(jnp.asarray(maps), None, jnp.zeros((), jnp.int32))


def network_flops(name: str, photos: int) -> dict[str, float]:
    """Operations of a whole network in its published size, counted in the program before its compilation."""
    import jax

    from experiments.systems import SYSTEMS
    from humangs_jax.body.library import load_body
    from humangs_jax.data.views import gaussian_body
    from humangs_jax.network.humangs import apply_humangs
    from humangs_jax.network.weights import expected_variables

    config = SYSTEMS[name]("published").with_conventions(tokens="all").with_runtime(dtype="float32")
    vertices = len(gaussian_body(load_body(), config).template)
    inputs = jax.eval_shape(lambda: subject(1, photos, vertices, config.conventions.image_size)[0])
    forward = lambda v, x: apply_humangs(v, x, config)[0].gaussians
    variables = expected_variables(config)
    return {
        "photos": photos,
        "vertices": vertices,
        "parameters": sum(x.size for x in jax.tree.leaves(variables["params"])),
        "operations": costs_of(jax.jit(forward).trace(variables, inputs)).flops,
    }


def joint_flops(name: str, photos: int) -> dict[str, float]:
    """Operations of the attention of an LHM-style system in its published size, with LHM's points and tokens."""
    import jax
    import jax.numpy as jnp

    from experiments.systems import SYSTEMS
    from experiments.systems.two_stream import TwoStreamReader, TwoStreams
    from humangs_jax.network.runtime import Runtime

    reader = SYSTEMS[name]("published").architecture.reader
    assert isinstance(reader, TwoStreamReader)
    streams = TwoStreams(reader, Runtime())
    points = jax.ShapeDtypeStruct((POINTS, 3), jnp.float32)
    tokens = jax.ShapeDtypeStruct((photos * TOKENS, reader.width), jnp.float32)
    few = jnp.zeros((8, 3)), jnp.zeros((8, reader.width))
    variables = jax.eval_shape(lambda: streams.init(jax.random.key(0), *few, None))
    forward = lambda v, p, t: streams.apply(v, p, t, None)
    return {
        "photos": photos,
        "vertices": POINTS,
        "parameters": sum(x.size for x in jax.tree.leaves(variables["params"])),
        "operations": costs_of(jax.jit(forward).trace(variables, points, tokens)).flops,
    }


def text_of(result: dict[str, Any]) -> str:
    """The rows, and the networks, as text."""
    a, b = READERS
    header = ["views", "vertices", "photo", f"{a}, CPU ms", f"{b}, CPU ms", "ratio", f"{a}, M operations"]
    header += [f"{b}, M operations", "ratio", f"{a}, MiB", f"{b}, MiB"]
    rows = []
    for row in result["rows"]:
        cheap, dear = row[a], row[b]
        rows.append(
            [
                row["views"],
                row["vertices"],
                row["size"],
                significant(cheap["cpu_ms"]),
                significant(dear["cpu_ms"]),
                significant(dear["cpu_ms"] / cheap["cpu_ms"]),
                f"{cheap['operations'] / 1e6:.0f}",
                f"{dear['operations'] / 1e6:.0f}",
                f"{dear['operations'] / cheap['operations']:.0f}",
                significant(cheap["temporary_mb"]),
                significant(dear["temporary_mb"]),
            ]
        )
    texts = [
        f"Readers of width {result['width']}.",
        markdown_table(header, rows, "r" * len(header)),
    ]
    if networks := result["networks"]:
        ours = networks["humangs"]["operations"]
        lines = [
            [
                f"{name}, joint attention alone" if name in JOINT else name,
                x["photos"],
                x["vertices"],
                f"{x['parameters'] / 1e6:.0f}",
                f"{x['operations'] / 1e12:.2f}",
                significant(x["operations"] / ours),
            ]
            for name, x in networks.items()
        ]
        printed = {name: ANIMATION[name][3] or 0.0 for name in (OURS, "LHM (single view)")}
        lines += [
            [f"{name}, printed seconds", "", "", "", significant(x), significant(x / printed[OURS])]
            for name, x in printed.items()
        ]
        texts += [
            f"Networks in published sizes, all patches tokens: operations counted, not run. LHM-style: {POINTS:,} points and "
            f"{TOKENS:,} tokens a photo, without the two networks that make the tokens. The last rows are the paper's modelling "
            f"times, its {FASTER_MODELLING} x.",
            markdown_table(["network", "photos", "vertices or points", "M parameters", "TFLOP", "over HumanGS"], lines),
        ]
    return "\n\n".join(texts)


def draw(result: dict[str, Any], path: Path) -> None:
    """CPU time against views, vertices and the side of the photos."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, all_axes = plt.subplots(1, len(AXES), figsize=(11, 3.6), layout="constrained")
    for axes, axis in zip(all_axes, AXES, strict=True):
        others = {key: value for key, value in result["middle"].items() if key != axis}
        rows = sorted(
            (row for row in result["rows"] if all(row[key] == value for key, value in others.items())),
            key=lambda row: row[axis],
        )
        for name, color in READERS.items():
            axes.loglog(
                [row[axis] for row in rows], [row[name]["cpu_ms"] for row in rows], "o-", color=color, label=name
            )
        values = [row[axis] for row in rows]
        axes.set_xticks(values, [str(value) for value in values])
        axes.minorticks_off()
        axes.set_xlabel({"size": "side of the photos, pixels"}.get(axis, axis))
        axes.set_title(
            ", ".join(f"{value} {key}" if key != "size" else f"{value} px" for key, value in others.items()), fontsize=9
        )
        axes.grid(alpha=0.3)
    all_axes[0].set_ylabel("CPU ms")
    all_axes[0].legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
