"""Measures the paper's central claim: the cost of vertices that are projected into the photos,
against that of vertices that attend to all tokens.
"""

import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.costs import costs_of, temporary_mb
from experiments.harness import Run, entry, figure
from experiments.paper.rows import ANIMATION, FASTER_MODELLING, OURS
from experiments.results import REPOSITORY, markdown_table, significant
from experiments.systems import SYSTEMS, back_projection
from experiments.systems.cross_attention import CrossAttentionReader
from experiments.timing import medians
from humangs_jax.body.library import load_body
from humangs_jax.data.views import gaussian_body
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.network.humangs import apply_humangs
from humangs_jax.network.parts import Encoding, HumanGSInputs
from humangs_jax.network.weights import expected_variables

PATCH, READ_OPERATIONS = 8, 8
"""Side of a patch in pixels, and operations of one bilinear read and its sum over views for each
feature: four products and four additions.
"""
AXES = {"views": (1, 2, 4, 8, 16), "vertices": (1000, 3000, 10000, 40000), "size": (128, 256, 512)}
"""Values of each quantity that is varied; `size` is the side of the photos in pixels."""
MIDDLE = {"views": 4, "vertices": 10000, "size": 256}
"""Values of the quantities that are not varied."""
READERS = {"back-projection": "#1f6f8b", "cross-attention": "#c0392b"}
"""{reader: its color in the figure}."""
NETWORKS = {"humangs": 4, "back_projection": 4, "cross_attention": 4, "gst": 1}
"""{system that is counted in its published size: its number of photos}."""
JOINT = {"lhm": 1, "lhm_views": 4, "lhm_plus": 4}
"""{system of which the joint attention is counted: its number of photos}."""
POINTS, TOKENS = 40000, 4096 + 1024
"""Points of the body in LHM, and tokens of the photos of the body and of the head.

The numbers of LHM++ differ, and are not known to us.
"""


@entry
def paper_cost(
    run: Run,
    width: int = 128,
    repeats: int = 3,
    networks: bool = False,
    quick: bool = False,
    image: Path | None = None,
) -> None:
    """Measures the paper's central claim: what vertices cost that are projected into the photos,
    against vertices that attend to all tokens.

    The two readers of `experiments.systems` run alone on maps of the same width. Forward passes
    over views, vertices and image sizes are timed in turns. The operations of attention are
    products of matrices. Back-projection has none: its weighted sums of four neighbours count as 8
    for each vertex, view and feature. All patches are tokens, as in the paper. The operations of
    whole networks in published sizes are counted in programs that are not run. Of LHM and similar
    systems only the joint attention of points and tokens is counted, without the decoder and
    without the two pretrained networks that make the tokens. Takes 4 CPU minutes.

    Options:
    width: features of maps, vertices and attention
    repeats: timed iterations
    networks: count only the networks, and take the readers from docs/results
    quick: only the smallest sizes, and no whole networks
    image: figure to write (.png)
    """
    if networks:
        record = json.loads((REPOSITORY / "docs" / "results" / f"{run.table}.json").read_text())
        measured_then = {key: record[key] for key in ("date", "machine", "versions")}
        result = {"readers": measured_then} | record["numbers"] | {"networks": all_networks()}
    else:
        # both readers, with one quantity varied at a time
        middle = {"views": 1, "vertices": 1000, "size": 64} if quick else MIDDLE
        axes = {name: AXES[name][:2] for name in ("views", "vertices")} if quick else AXES
        cases = [middle | {axis: value} for axis, values in axes.items() for value in values]
        each = {
            " ".join(map(str, case.values())): functools.partial(compare, width, repeats, **case)
            for case in cases
        }
        found = run.rows(each, {"width": width, "repeats": repeats})
        rows = [
            dict(zip(middle, map(int, name.split()), strict=True)) | row
            for name, row in found.items()
        ]
        result = {
            "rows": rows,
            "middle": middle,
            "width": width,
            "networks": {} if quick else all_networks(),
        }
    run.show(text_of(result), result)
    if image:
        plot(image, result)


def plot(path: Path, result: dict[str, Any]) -> None:
    """Draws CPU time against views, vertices and the side of the photos."""
    with figure(path, len(AXES), (11, 3.6)) as all_axes:
        for axes, axis in zip(all_axes, AXES, strict=True):
            others = {key: value for key, value in result["middle"].items() if key != axis}
            same = [
                row
                for row in result["rows"]
                if all(row[key] == value for key, value in others.items())
            ]
            rows = sorted(same, key=lambda row: row[axis])
            values = [row[axis] for row in rows]
            for name, color in READERS.items():
                axes.loglog(
                    values, [row[name]["cpu_ms"] for row in rows], "o-", color=color, label=name
                )
            axes.set_xticks(values, [str(value) for value in values])
            axes.minorticks_off()
            units = {"size": "px"}
            title = ", ".join(f"{value} {units.get(key, key)}" for key, value in others.items())
            axes.set(xlabel={"size": "side of the photos, pixels"}.get(axis, axis))
            axes.set_title(title, fontsize=9)
        all_axes[0].set_ylabel("CPU ms")
        all_axes[0].legend(fontsize=8)


def all_networks() -> dict[str, dict[str, float]]:
    """Returns {system: what it costs} of whole networks and of joint attentions."""
    whole = {name: network_flops(name, photos) for name, photos in NETWORKS.items()}
    return whole | {name: joint_flops(name, photos) for name, photos in JOINT.items()}


def compare(
    width: int, repeats: int, views: int, vertices: int, size: int
) -> dict[str, dict[str, float]]:
    """Returns the CPU ms, operations and temporary MiB of both readers on the same maps."""
    # a program for each reader, with weights that are all the same
    inputs, encoding = subject(width, views, vertices, size)
    runs, found = {}, {}
    for name, config in configurations(width, size).items():
        reader, ctx = config.architecture.reader, config.forward_context()
        shapes = jax.eval_shape(
            lambda reader=reader, ctx=ctx: reader.init(jax.random.key(0), encoding, inputs, ctx)
        )
        variables = jax.tree.map(lambda x: np.full(x.shape, 0.02, x.dtype), shapes)

        def read(v, e, x, reader=reader, ctx=ctx):
            return reader.apply(v, e, x, ctx).local

        traced = jax.jit(read).trace(variables, encoding, inputs)
        program = traced.lower().compile()
        sums = READ_OPERATIONS * views * vertices * width if name == "back-projection" else 0
        found[name] = {
            "operations": costs_of(traced).flops + sums,
            "temporary_mb": temporary_mb(program),
        }

        def timed(program=program, variables=variables):
            return jax.block_until_ready(program(variables, encoding, inputs))

        runs[name] = timed
    for name, (wall, cpu) in medians(runs, repeats).items():
        found[name] |= {"ms": float(wall), "cpu_ms": float(cpu)}
    return found


def configurations(width: int, size: int) -> dict[str, Any]:
    """Returns {reader: configuration of a network that has it}."""
    config = back_projection("bench").with_conventions(image_size=size, tokens="all")
    reader = CrossAttentionReader(width, layers=1, head_width=32)
    return {"back-projection": config, "cross-attention": config.with_parts(reader=reader)}


def subject(width: int, views: int, vertices: int, size: int) -> tuple[Any, Any]:
    """Returns the inputs and the encoding of a subject: points on a cylinder of the size of a
    person, cameras around it, and maps of noise.
    """
    rng = np.random.default_rng(0)
    angles, heights = rng.uniform(-np.pi, np.pi, vertices), rng.uniform(-0.9, 0.9, vertices)
    normals = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    points = jnp.asarray(0.25 * normals + heights[:, None] * [0, 1, 0], jnp.float32)
    normals = jnp.asarray(normals, jnp.float32)

    def all_views(x):
        return jnp.broadcast_to(x, (views, *x.shape))

    azimuths, K = jnp.arange(views) * (2 * np.pi / views), intrinsics_from_fov(0.8, size, size)
    inputs = HumanGSInputs(
        images=jnp.zeros((views, size, size, 3)),
        cameras=orbit(jnp.zeros(3), 3.0, azimuths, 0.1, K, size, size),
        posed_vertices=all_views(points),
        canonical_vertices=points,
        position_maps=jnp.zeros((views, size, size, 3)),
        depth_maps=jnp.full((views, size, size), 3.0),  # the half that faces a camera is seen
        foreground=jnp.ones((views, size, size), bool),
        posed_normals=all_views(normals),
        canonical_normals=normals,
    )
    maps = rng.standard_normal((views, size // PATCH, size // PATCH, width), np.float32)
    return inputs, Encoding(jnp.asarray(maps), None, jnp.zeros((), jnp.int32), patch_size=PATCH)


def network_flops(name: str, photos: int) -> dict[str, float]:
    """Returns what a whole network costs in its published size, counted before its program is
    compiled.
    """
    config = SYSTEMS[name]("published").with_conventions(tokens="all").with_runtime(dtype="float32")
    vertices = len(gaussian_body(load_body(), config).template)
    inputs = jax.eval_shape(lambda: subject(1, photos, vertices, config.conventions.image_size)[0])

    def forward(v, x):
        return apply_humangs(v, x, config)[0].gaussians

    return counted(photos, vertices, forward, expected_variables(config), inputs)


def joint_flops(name: str, photos: int) -> dict[str, float]:
    """Returns what the joint attention of a system like LHM costs in its published size, with LHM's
    points and tokens.
    """
    config = SYSTEMS[name]("published")
    reader, grid = config.architecture.reader, jnp.zeros((photos, TOKENS, 1))
    camera = jax.vmap(lambda K, pose: Camera(K, pose, 1, TOKENS))(
        jnp.zeros((photos, 3, 3)), jnp.zeros((photos, 4, 4))
    )

    def arguments(points: Any, tokens: Any) -> tuple[Any, ...]:
        """Returns the reader's arguments, with photos whose pixels are the tokens."""
        colors = jnp.zeros((*grid.shape, 3))
        posed = jnp.broadcast_to(points, (photos, *points.shape))
        inputs = HumanGSInputs(colors, camera, posed, points, colors, grid, grid > 0)
        return Encoding(tokens, None, jnp.zeros((), jnp.int32)), inputs, config.forward_context()

    def forward(v, *given):
        return reader.apply(v, *arguments(*given))

    width = getattr(reader, "width")  # noqa: B009 (of a TwoStreamReader)
    tokens = jax.ShapeDtypeStruct((*grid.shape, width), jnp.float32)
    points = jax.ShapeDtypeStruct((POINTS, 3), jnp.float32)

    def make(*given):
        return reader.init(jax.random.key(0), *arguments(*given))

    variables = jax.eval_shape(make, jax.ShapeDtypeStruct((8, 3), jnp.float32), tokens)
    return counted(photos, POINTS, forward, variables, points, tokens)


def counted(
    photos: int, vertices: int, forward: Any, variables: Any, *given: Any
) -> dict[str, float]:
    """Returns what a program costs, which is traced and not run."""
    parameters = sum(x.size for x in jax.tree.leaves(variables["params"]))
    operations = costs_of(jax.jit(forward).trace(variables, *given)).flops
    return {
        "photos": photos,
        "vertices": vertices,
        "parameters": parameters,
        "operations": operations,
    }


def text_of(result: dict[str, Any]) -> str:
    """Formats the tables of the readers and of the networks."""
    a, b = READERS
    header = ["views", "vertices", "photo", f"{a}, CPU ms", f"{b}, CPU ms", "ratio"]
    header += [f"{a}, M operations", f"{b}, M operations", "ratio", f"{a}, MiB", f"{b}, MiB"]
    rows = []
    for row in result["rows"]:
        times, operations, memory = (
            [row[name][key] for name in READERS] for key in ("cpu_ms", "operations", "temporary_mb")
        )
        cells = [significant(x) for x in (*times, times[1] / times[0])]
        cells += [f"{x / 1e6:.0f}" for x in operations] + [f"{operations[1] / operations[0]:.0f}"]
        rows.append([row["views"], row["vertices"], row["size"], *cells, *map(significant, memory)])
    texts = [
        f"Readers of width {result['width']}.",
        markdown_table(header, rows, "r" * len(header)),
    ]
    if result["networks"]:
        texts += [
            (
                "Networks in published sizes, all patches tokens: operations counted, not run."
                f" LHM-style: {POINTS:,} points and {TOKENS:,} tokens a photo, without the two"
                " networks that make the tokens. The last rows are the paper's modelling times,"
                f" its {FASTER_MODELLING} x."
            ),
            networks_table(result["networks"]),
        ]
    return "\n\n".join(texts)


def networks_table(networks: dict[str, dict[str, float]]) -> str:
    """Formats a row for each network, and rows of the seconds that the paper prints."""
    ours = networks["humangs"]["operations"]
    lines = []
    for name, x in networks.items():
        title = f"{name}, joint attention alone" if name in JOINT else name
        cells = [
            f"{x['parameters'] / 1e6:.0f}",
            f"{x['operations'] / 1e12:.2f}",
            significant(x["operations"] / ours),
        ]
        lines.append([title, x["photos"], x["vertices"], *cells])
    printed = {name: ANIMATION[name][3] or 0.0 for name in (OURS, "LHM (single view)")}
    for name, x in printed.items():
        shown = [significant(x), significant(x / printed[OURS])]
        lines.append([f"{name}, printed seconds", "", "", "", *shown])
    header = ["network", "photos", "vertices or points", "M parameters", "TFLOP", "over HumanGS"]
    return markdown_table(header, lines)
