"""Expressions of a face: named directions in which vertices move, such as the 52 shapes of ARKit or
the components of SMPL-X.

A pose may carry one coefficient for each expression (`BodyPose.expression`). Vertices move in the
T-pose, before skinning:

    rest'(e) = rest + directions e,
    joints'(e) = joints + joint_directions e,
    rotations'(e) = rotations + joint_turns e.

`assets/face.npz` has the shapes of the shipped body. It also has what photos hardly show: teeth,
tongue, the inside of the mouth and the skin of closed lids (`FaceParts`).
"""

import functools
from importlib import resources
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import LARGEST
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.io.arrays import check_array, check_indices, read_npz
from humangs_jax.io.reading import InvalidFileError, check_limit, reading

FORMAT = "humangs-face-1"
STEP = 1e-5
"""Step of offsets in files, metres. int16 then spans +-0.33 m."""
EYES = ("left_eye", "right_eye")
"""Names of the joints that turn the eyes."""
PARTS = ("upper_teeth", "lower_teeth", "tongue", "left_lid", "right_lid", "mouth")
"""Names of the parts that `FaceParts.parts` numbers; "mouth" is the skin inside of the mouth."""
KEYS = (
    *("format", "names", "counts", "vertices", "offsets", "eye_turns"),
    *("lips", "inside_vertices", "part_faces", "parts"),
)
"""Keys of the arrays that every face file has. `assets/face.npz` is such a file."""


@pytree_dataclass
class Expressions:
    """The expressions of a body: e directions, in which m of its vertices move. Its j joints may
    move and turn, too.
    """

    vertices: Int[Array, " m"]
    """Indices of the vertices that move, increasing."""
    directions: Float[Array, "m 3 e"]
    """Change of these vertices per unit of a coefficient, (m, 3, e), metres, in the T-pose."""
    joint_directions: Float[Array, "j 3 e"] | None = None
    """Change of the joints per unit of a coefficient, (j, 3, e), metres. None: joints do not
    move.
    """
    joint_turns: Float[Array, "j 3 e"] | None = None
    """Axis-angle per unit of a coefficient, (j, 3, e), radians, added to the rotations of the pose.
    None: no joint turns.
    """
    names: tuple[str, ...] = static_field(default=())
    """Names of the e directions."""


@pytree_dataclass
class FaceParts:
    """Parts of the shipped face that photos hardly show, as quadrilaterals. Their corners move with
    the expression, too.
    """

    corners: Float[np.ndarray, "q 4 3"]
    """Corners of the quadrilaterals on the mean body in T-pose, (q, 4, 3), metres."""
    directions: Float[np.ndarray, "q 4 3 e"]
    """Change of each corner per unit of a coefficient, (q, 4, 3, e), metres."""
    parts: Int[np.ndarray, " q"]
    """Part of each quadrilateral, (q,), as an index into `PARTS`."""
    lips: Float[np.ndarray, "4 3"]
    """Four points, (4, 3), metres: the inner edges of the upper and the lower lip in the middle,
    and the left and the right corner of the mouth.
    """
    lip_directions: Float[np.ndarray, "4 3 e"]
    """Change of these points per unit of a coefficient, (4, 3, e), metres."""


@functools.cache
def _shipped() -> dict[str, np.ndarray]:
    """Returns the arrays of the face that comes with the package."""
    with resources.as_file(resources.files("humangs_jax") / "assets" / "face.npz") as file:
        return _read_face(file)


def _read_face(path: str | Path) -> dict[str, np.ndarray]:
    """Returns the arrays of a face file by key. The key `rows` is added: for each offset the
    numbers of its vertex and of its blend shape, (offsets, 2).

    Raises: FileNotFoundError; FileError, which names the file, and the key if an array is missing
    or wrong.
    """
    with reading(path, "face file"):
        arrays, _ = read_npz(path)
        if str(arrays.get("format")) != FORMAT:
            raise InvalidFileError(f"expected a file of the format {FORMAT}")
        missing = sorted(set(KEYS) - set(arrays))
        if missing:
            raise InvalidFileError(f"key '{missing[0]}' is missing")
        # the offsets of all shapes, one shape after the other
        names = arrays["names"]
        if names.ndim != 1 or names.dtype.kind != "U":
            raise InvalidFileError("names: expected a list of texts")
        check_indices("vertices", arrays["vertices"], (None,), 1 << 16)
        count = len(arrays["vertices"])
        check_indices("counts", arrays["counts"], (len(names),), count + 1)
        check_array("offsets", arrays["offsets"], (3, count), -LARGEST, LARGEST)
        check_array("eye_turns", arrays["eye_turns"], (len(names), 2, 3), -LARGEST, LARGEST)
        check_array("inside_vertices", arrays["inside_vertices"], (None, 3), -LARGEST, LARGEST)
        ends = np.cumsum(arrays["counts"].astype(np.int64))
        if not len(names) or ends[-1] != count:
            raise InvalidFileError(f"counts: expected a sum of {count}, the number of offsets")
        # vertices are stored as steps from the one before, anew for each shape
        steps = arrays["vertices"].astype(np.int64)
        sums = np.cumsum(steps)
        before = np.concatenate([[0], sums[ends[:-1] - 1]])
        shape = np.repeat(np.arange(len(names)), np.diff(ends, prepend=0))
        rows = np.stack([sums - before[shape], shape], axis=1)
        check_indices("vertices", rows[:, 0], (count,), 1 << 16)
        # parts that photos hardly show
        check_indices("part_faces", arrays["part_faces"], (None, 4), 1 << 16)
        check_indices("lips", arrays["lips"], (4,), 1 << 16)
        check_indices("parts", arrays["parts"], (len(arrays["part_faces"]),), len(PARTS))
        check_limit("plain_bytes", 12 * len(names) * (1 << 16), "bytes of expressions")
        return arrays | {"rows": rows}


def _dense(arrays: dict[str, np.ndarray], count: int) -> Float[np.ndarray, "count 3 e"]:
    """Returns the offsets of `count` vertices for each shape, (count, 3, e), metres. Vertices
    inside of the mouth are last.
    """
    dense = np.zeros((count, 3, len(arrays["names"])), np.float32)
    vertices, shapes = arrays["rows"].T
    dense[vertices, :, shapes] = arrays["offsets"].T * np.float32(STEP)
    return dense


@functools.cache
def shipped_expressions(body_vertices: int) -> Expressions:
    """Returns the 52 shapes of ARKit on the shipped body. The eyeLook shapes turn the eyes' joints.
    body_vertices: number of vertices of that body.
    """
    arrays = _shipped()
    names = tuple(str(name) for name in arrays["names"])
    dense = _dense(arrays, body_vertices + len(arrays["inside_vertices"]))[:body_vertices]
    moved = np.flatnonzero(dense.any(axis=(1, 2)))
    turns = np.zeros((len(JOINT_NAMES), 3, len(names)), np.float32)
    for side, eye in enumerate(EYES):
        turns[JOINT_NAMES.index(eye)] = arrays["eye_turns"][:, side].T
    return Expressions(
        vertices=from_host(moved, jnp.int32),
        directions=from_host(dense[moved]),
        joint_turns=from_host(turns),
        names=names,
    )


def shipped_parts(template: Float[np.ndarray, "n 3"]) -> FaceParts:
    """Returns teeth, tongue, lids and the inside of the mouth of the shipped face. template:
    vertices of the shipped body in T-pose, (n, 3), metres.
    """
    arrays = _shipped()
    places = np.concatenate([template, arrays["inside_vertices"]]).astype(np.float32)
    faces = arrays["part_faces"].astype(np.int64)
    directions, lips = _dense(arrays, len(places)), arrays["lips"].astype(np.int64)
    return FaceParts(
        corners=places[faces],
        directions=directions[faces],
        parts=arrays["parts"].astype(np.int64),
        lips=places[lips],
        lip_directions=directions[lips],
    )
