"""Evaluates the same weights, people and photos on several bodies: the default one, a made-up one
in SMPL-X's format, and decimated ones.
"""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from experiments.harness import Run, entry, means
from experiments.quality import COLUMNS
from experiments.results import cells, markdown_table
from experiments.subjects import RING, TASKS, People, score_tasks
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.library import EXPRESSION_COLUMNS, SHAPE_COLUMNS, load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.body.resolution import decimate
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import gaussian_body
from humangs_jax.evaluation.cases import draw_painted_body, painted_body, predict_views
from humangs_jax.network.config import HumanGSConfig

SMPLX_SEED_VERTICES = 3493
"""Vertices of the decimated body that the made-up one grows from. Together with a vertex for each
of its faces they are about as many as SMPL-X's 10,475.
"""
FRACTIONS = {"1/4": 4, "1/16": 16}
POSE_FEATURES = 9 * (len(JOINT_NAMES) - 1)
PAINTED = "painted default body"


@entry
def evaluation_bodies(run: Run, people: People = People(8), views: int = 4) -> None:
    """Evaluates the same weights, people and photos on bodies of another topology, in SMPL-X's
    format, and on bodies with fewer vertices.

    "SMPL-X format" is a made-up body of another topology, written as an SMPL-X file and read by the
    loader of that format. The poses go to its joints by name. "1/4" and "1/16" have that share of
    the default body's vertices, unchanged and with long edges split as the weights want it. Takes
    about 10 s of CPU time a person, and some minutes of compiling.

    Options:
    views: photos that the network sees
    """
    if views < 1 or RING % views:
        raise ValueError(f"--views: expected a number that divides {RING}, got {views}")
    start = people.start()
    cases, config = body_cases(start.body, start.config), as_it_is(start.config)

    # every person on every body, and as the painted body alone
    def measure(seed: int) -> dict[str, Any]:
        subject = start.subject(seed, [views])
        truth, painted = subject.held_out, painted_body(subject.inputs(views))
        row = {PAINTED: score_tasks(draw_painted_body(painted, truth), truth, start.lpips)}
        for name, case in cases.items():
            other = subject.with_body(case.carrier)
            avatar = reconstruct(start.variables, config, other.inputs(views))
            row[name] = score_tasks(
                predict_views(avatar, other.held_out).images, truth, start.lpips
            )
        return row

    rows = start.rows(run, measure, {"views": views})

    # means over the people, with the sizes of the bodies
    def in_order(scores):
        return {task: scores[task] for task in TASKS if task in scores}

    bodies = means([{name: in_order(row[name]) for name in row} for row in rows])
    for name, case in cases.items():
        bodies[name] |= {
            "body_vertices": len(case.body.template),
            "vertices": len(case.carrier.template),
        }
    numbers = {"bodies": bodies, "settings": start.settings | {"views": views}, "people": len(rows)}
    run.show(f"{start.about()} {views} photos.\n\n{bodies_table(bodies)}", numbers)


def bodies_table(bodies: dict[str, Any]) -> str:
    """Formats a row for each body: its vertices, and its scores by task."""
    tasks = [task for task in TASKS if task in bodies[PAINTED]]
    keys = [
        key for key in ("psnr", "psnr_fg", "lpips") if bodies[PAINTED]["novel"].get(key) is not None
    ]
    columns = {key: COLUMNS[key] for key in keys}
    header = ["body", "vertices", "that carry Gaussians"]
    header += [f"{TASKS[task]}: {heading}" for task in tasks for heading, _ in columns.values()]

    def facts(body):
        return [body.get("body_vertices", "-"), body.get("vertices", "-")]

    def scores(body):
        return [number for task in tasks for number in cells(body[task], columns)]

    return markdown_table(
        header, [[name, *facts(body), *scores(body)] for name, body in bodies.items()]
    )


@dataclasses.dataclass(frozen=True, eq=False)
class BodyCase:
    """A body, and the body whose vertices carry the Gaussians."""

    body: BodyModel
    """The body as it is loaded."""
    carrier: BodyModel
    """The same body with the vertices that carry Gaussians."""


def body_cases(body: BodyModel, config: HumanGSConfig) -> dict[str, BodyCase]:
    """Returns by name the body, the made-up one in SMPL-X's format, and the body with fractions of
    its vertices.

    Decimated bodies are included unchanged and, if the weights want long edges split, also with
    split edges.
    """
    wanted = {"default": body, "SMPL-X format": smplx_body(body)}
    cases = {name: BodyCase(model, gaussian_body(model, config)) for name, model in wanted.items()}
    for name, divisor in FRACTIONS.items():
        small = decimate(body, len(body.template) // divisor)
        cases[name] = BodyCase(small, small)
    if config.conventions.max_edge_length is not None:
        for name in FRACTIONS:
            small = cases[name].body
            cases[f"{name}, edges split"] = BodyCase(small, gaussian_body(small, config))
    return cases


def as_it_is(config: HumanGSConfig) -> HumanGSConfig:
    """Returns the configuration for a body whose own vertices carry the Gaussians."""
    return config.with_conventions(body_vertices=None, max_edge_length=None)


def smplx_body(body: BodyModel) -> BodyModel:
    """Returns the body on another mesh, written as an SMPL-X model file and read from it."""
    made = turned_subdivision(decimate(body, min(SMPLX_SEED_VERTICES, len(body.template))))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "SMPLX_MADE_UP.npz"
        write_smplx(file, made)
        return load_body(file, shape_count=body.shape_directions.shape[-1], expression_count=0)


def turned_subdivision(body: BodyModel) -> BodyModel:
    """Returns the body on another mesh, with a vertex in the middle of each face, and each edge
    turned to join two of these vertices.

    This is a step of sqrt(3)-subdivision (Kobbelt, 2000) without its smoothing. No inner edge of
    the old mesh is left, and the old vertices keep their numbers. The joints of every shape still
    come from the old vertices. Texture coordinates are dropped.
    """
    # the twin of a half-edge is the one between the same vertices in the other direction
    faces = np.asarray(body.faces, np.int64)
    n = len(body.template)
    tails, heads = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    middles = n + np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(tails * n + heads)
    opposite = heads * n + tails
    place = np.minimum(np.searchsorted((tails * n + heads)[order], opposite), len(order) - 1)
    twin = order[place]
    inner = (tails * n + heads)[twin] == opposite
    across = np.where(inner, middles[twin], heads)  # at a rim the face keeps its edge
    # each half-edge makes the triangle at its tail, and its twin the one at the other end
    turned = np.stack([tails, across, middles], axis=-1)

    # what is linear in the vertices is averaged over the corners of a face
    names = ("template", "shape_directions", "pose_directions", "skinning_weights")
    linear = {name: getattr(body, name) for name in names if getattr(body, name) is not None}
    linear = {name: np.asarray(value) for name, value in linear.items()}
    grown = {name: np.concatenate([x, x[faces].mean(axis=1)]) for name, x in linear.items()}
    return replace(
        body,
        **{name: jnp.asarray(x) for name, x in grown.items()},
        faces=jnp.asarray(turned, body.faces.dtype),
        joint_regressor=jnp.pad(body.joint_regressor, ((0, 0), (0, len(faces)))),
        uvs=None,
        uv_faces=None,
        collapse_order=None,
        collapse_into=None,
    )


def write_smplx(
    path: Path, body: BodyModel, directions: np.ndarray | None = None, **more: np.ndarray
) -> dict[str, np.ndarray]:
    """Writes a body with SMPL-X's joints as an SMPL-X model file, and returns the file's arrays.

    The pose correctives are 0 if the body has none.

    Args:
        path: file to write
        body: the body
        directions: (n, 3, columns) directions of shapes and expressions; default: those of the
            body, and no expressions
        more: further arrays of the file

    Raises: ValueError if the body has other joints, or more shape directions than the format
        holds.
    """
    count, n = body.shape_directions.shape[-1], len(body.template)
    if body.joint_names != JOINT_NAMES:
        raise ValueError(f"body '{body.name}' has other joints than SMPL-X")
    if directions is None:
        if count > SHAPE_COLUMNS:
            raise ValueError(
                f"body '{body.name}' has {count} shape directions, SMPL-X's format holds"
                f" {SHAPE_COLUMNS}"
            )
        directions = np.zeros((n, 3, SHAPE_COLUMNS + EXPRESSION_COLUMNS), np.float32)
        directions[..., :count] = body.shape_directions
    correctives = body.pose_directions
    if correctives is None:
        correctives = np.zeros((n, 3, POSE_FEATURES), np.float32)
    # the format stores the root's parent, -1, as an unsigned number
    parents = np.asarray(body.parents, np.int64) % 2**32
    stored = {
        "v_template": body.template,
        "f": np.asarray(body.faces, np.uint32),
        "shapedirs": directions,
        "posedirs": correctives,
        "J_regressor": body.joint_regressor,
        "weights": body.skinning_weights,
        "kintree_table": np.stack([parents, np.arange(len(parents))]).astype(np.uint32),
    }
    arrays = {key: np.asarray(x) for key, x in (stored | more).items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    # no array is called allow_pickle, the stub's only other keyword
    np.savez_compressed(path, **arrays)  # ty: ignore[invalid-argument-type]
    return arrays
