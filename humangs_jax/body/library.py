"""Loads and saves bodies: the CC0 body of the package, a body file of the package's format, or an
SMPL-X model.

The package's body file is one small npz without pickles. Shape directions are multiples of 10
micrometres in int16 if all of them fit. Skinning weights are the entries of each vertex that are
not 0, in uint16. Indices are uint16 where they fit. `read_body` returns float32 weights whose rows
sum to 1. SMPL-X's licence forbids redistribution, so users bring that file.
"""

from importlib import resources
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.expressions import Expressions, shipped_expressions
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import LARGEST, checked_arguments
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.io.arrays import (
    ArrayFile,
    check_array,
    check_indices,
    check_joints,
    check_row_sums,
    read_npz,
    write_npz,
)
from humangs_jax.io.reading import FileError, InvalidFileError, check_limit, open_file, reading

FORMAT = "humangs-body-1"
DIRECTION_STEP = 1e-5
"""Step of the stored shape directions, metres. int16 then spans +-0.33 m per unit of a shape
coefficient. If one of the directions is larger, all are stored as float64.
"""
UV_STEPS = 65535
KEYS = {
    *(
        "format",
        "name",
        "template",
        "shape_directions",
        "faces",
        "parents",
        "joint_names",
        "shape_names",
    ),
    *("regressor_vertices", "regressor_values", "weight_joints", "weight_values"),
}
"""Keys that every body file has. Some files also have texture coordinates, an order of collapses
and expressions.
"""


@checked_arguments
def load_body(path: str | Path | None = None, **smplx_options: Any) -> BodyModel:
    """Loads a body model: the CC0 body that comes with the package, or the body in a file.

    Args:
        path: None for the shipped body (13,380 vertices, 55 joints in SMPL-X order, facing +z,
            pelvis at (0, -0.35, 0)); a file of `save_body`; or an SMPL-X model file (.npz or .pkl).
        **smplx_options: for SMPL-X files only, see `load_smplx`.

    Returns:
        The model.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file cannot be read. The message names the file and, for a wrong array,
            the key.
        TypeError: for an unknown option, and for options of SMPL-X files given with another body.

    Examples:
        >>> body = hg.load_body("SMPLX_NEUTRAL.npz")
    """
    with resources.as_file(resources.files("humangs_jax") / "assets" / "makehuman.npz") as shipped:
        file = shipped if path is None else Path(path)
        with reading(file, "body model file"), open_file(file) as content:
            own = (
                content.read(2) == b"PK"
                and "format" in read_npz(file, lambda name: name == "format")[0]
            )
        # options say how much of an SMPL-X file is kept
        if not own:
            return load_smplx(file, **smplx_options)
        if smplx_options:
            which = "the shipped body"
            if path is not None:
                which = f"the file {path}"
            raise TypeError(
                f"options of SMPL-X files do not apply to {which}: {sorted(smplx_options)}"
            )
        # the shipped body has its expressions in another file
        body = read_body(file)
        if path:
            return body
        return replace(body, expressions=shipped_expressions(len(body.template)))


def _indices(array: np.ndarray) -> np.ndarray:
    """Returns non-negative integers as uint16 if they fit, else as int32."""
    return array.astype(np.uint16 if array.max(initial=0) < 2**16 else np.int32)


def _sparse_rows(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the columns and the values, (rows, k) each, of a matrix's entries that are not 0. k
    is the largest number of such entries in a row; shorter rows are padded with values of 0.
    """
    count = max(1, int((matrix != 0).sum(1).max()))
    columns = np.argsort(-np.abs(matrix), axis=1, kind="stable")[:, :count]
    return columns, np.take_along_axis(matrix, columns, axis=1)


def _dense_rows(
    arrays: dict[str, np.ndarray], rows: str, columns: str, count: int, width: int
) -> np.ndarray:
    """Returns the matrix (count, width) that `_sparse_rows` stored, scaled so that each row sums to
    1.

    rows: beginning of the key of the values. columns: key of the columns. Raises: InvalidFileError
    if the arrays do not describe such a matrix.
    """
    check_limit("plain_bytes", 8 * count * width, "bytes of a matrix")
    check_indices(columns, arrays[columns], (count, None), width)
    check_array(
        f"{rows}_values", arrays[f"{rows}_values"], arrays[columns].shape, -LARGEST, LARGEST
    )
    matrix = np.zeros((count, width), np.float64)
    np.add.at(
        matrix,
        (np.arange(count)[:, None], arrays[columns].astype(np.int64)),
        arrays[f"{rows}_values"],
    )
    sums = matrix.sum(1, keepdims=True)
    if not (sums > 0).all():
        raise InvalidFileError(f"{rows}_values: expected rows with a sum above 0")
    return (matrix / sums).astype(np.float32)


def save_body(path: str | Path, body: BodyModel) -> None:
    """Writes a body model to a file, without pickles. `texels`, `relative_vertex_spacing` and
    `remesh_key` are not written.

    Raises: ValueError for a body with pose directions, which this format does not hold; OSError.
    """
    if body.pose_directions is not None:
        raise ValueError(
            f"body '{body.name}' has pose directions: this format is for bodies without them"
        )
    # small numbers as integers, matrices by the entries that are not 0
    directions = np.asarray(body.shape_directions, np.float64)
    if np.abs(directions).max(initial=0) < DIRECTION_STEP * 32767:
        directions = np.rint(directions / DIRECTION_STEP).astype(np.int16)
    regressor_columns, regressor_values = _sparse_rows(np.asarray(body.joint_regressor, np.float64))
    weight_columns, weight_values = _sparse_rows(np.asarray(body.skinning_weights, np.float64))
    arrays = {
        "format": np.asarray(FORMAT),
        "name": np.asarray(body.name),
        "template": np.asarray(body.template, np.float32),
        # compresses better by direction
        "shape_directions": np.ascontiguousarray(np.moveaxis(directions, -1, 0)),
        "regressor_vertices": _indices(regressor_columns),
        "regressor_values": regressor_values.astype(np.float32),
        "weight_joints": _indices(weight_columns),
        "weight_values": np.rint(weight_values * 65535).astype(np.uint16),
        "faces": _indices(np.asarray(body.faces)),
        "parents": np.asarray(body.parents, np.int16),
        "joint_names": np.asarray(body.joint_names),
        "shape_names": np.asarray(body.shape_names),
    }
    # parts that a body may lack
    if body.uvs is not None:
        uvs = np.asarray(body.uvs, np.float64)
        inside = uvs.min() >= 0 and uvs.max() <= 1
        if inside:
            arrays["uvs"] = np.rint(uvs * UV_STEPS).astype(np.uint16)
        else:
            arrays["uvs"] = uvs.astype(np.float32)
        arrays["uv_faces"] = _indices(np.asarray(body.uv_faces))
    if body.collapse_order is not None:
        arrays["collapse_order"] = _indices(np.asarray(body.collapse_order))
        arrays["collapse_into"] = _indices(np.asarray(body.collapse_into))
    if body.expressions is not None:
        arrays |= expression_arrays(body.expressions)
    write_npz(path, arrays)


def read_body(path: str | Path) -> BodyModel:
    """Returns the body model that `save_body` wrote.

    Raises: FileNotFoundError; ValueError, which names the file, if the file is no body file or is
    damaged. If an array is missing or wrong, it also names the key, unless the array is a single
    number.
    """
    with reading(path, "body file"):
        arrays, pickled = read_npz(path)
        if str(arrays.get("format")) != FORMAT:
            raise ValueError(f"{path}: not a '{FORMAT}' file (its keys: {sorted(arrays)})")
        if pickled:
            raise ValueError(f"{path}: key '{pickled[0]}' cannot be read without pickles")
        missing = sorted(KEYS - set(arrays))
        if missing:
            raise InvalidFileError(f"key '{missing[0]}' is missing")
        # the parts that every body has
        parents = arrays["parents"].tolist()
        joint_names = [str(name) for name in arrays["joint_names"]]
        check_joints(parents, joint_names)
        joints, vertices, shapes = len(parents), len(arrays["template"]), len(arrays["shape_names"])
        check_array("template", arrays["template"], (vertices, 3), -LARGEST, LARGEST)
        check_array(
            "shape_directions", arrays["shape_directions"], (shapes, vertices, 3), -LARGEST, LARGEST
        )
        check_indices("faces", arrays["faces"], (None, 3), vertices)
        # small numbers are stored as integers
        directions = np.moveaxis(arrays["shape_directions"], 0, -1)
        if directions.dtype == np.int16:
            directions = directions * DIRECTION_STEP
        uvs = arrays.get("uvs")
        if uvs is not None:
            check_array("uvs", uvs, (None, 2))
            check_indices("uv_faces", arrays["uv_faces"], (len(arrays["faces"]), 3), len(uvs))
            if uvs.dtype == np.uint16:
                uvs = uvs / UV_STEPS
        # parts that a body may lack
        for name in {"collapse_order", "collapse_into"} & set(arrays):
            check_indices(name, arrays[name], (vertices,), vertices)
        expressions = read_expressions(arrays, vertices, joints)

        def index(key):
            if key in arrays:
                return from_host(arrays[key], jnp.int32)
            return None

        return BodyModel(
            template=from_host(arrays["template"], jnp.float32),
            shape_directions=from_host(directions, jnp.float32),
            pose_directions=None,
            joint_regressor=from_host(
                _dense_rows(arrays, "regressor", "regressor_vertices", joints, vertices)
            ),
            skinning_weights=from_host(
                _dense_rows(arrays, "weight", "weight_joints", vertices, joints)
            ),
            faces=from_host(arrays["faces"], jnp.int32),
            uvs=None if uvs is None else from_host(uvs, jnp.float32),
            uv_faces=index("uv_faces"),
            collapse_order=index("collapse_order"),
            collapse_into=index("collapse_into"),
            expressions=expressions,
            parents=tuple(parents),
            joint_names=tuple(joint_names),
            shape_names=tuple(str(name) for name in arrays["shape_names"]),
            name=str(arrays["name"]),
        )


EXPRESSION = "expression_"
"""Beginning of the keys of expressions in files of bodies and avatars."""
EXPRESSION_FIELDS = ("vertices", "directions", "joint_directions", "joint_turns", "names")


def expression_arrays(expressions: Expressions) -> dict[str, np.ndarray]:
    """Returns the arrays of expressions by their keys in files."""
    found = {name: getattr(expressions, name) for name in EXPRESSION_FIELDS}
    return {
        f"{EXPRESSION}{name}": np.asarray(value)
        for name, value in found.items()
        if value is not None
    }


def read_expressions(
    arrays: dict[str, np.ndarray], vertices: int, joints: int
) -> Expressions | None:
    """Returns the expressions in a file's arrays, for a body or avatar with this number of vertices
    and joints. None if the file has no expressions.

    Raises: InvalidFileError, which names the key.
    """
    found = {
        name: arrays[f"{EXPRESSION}{name}"]
        for name in EXPRESSION_FIELDS
        if f"{EXPRESSION}{name}" in arrays
    }
    if not found:
        return None
    missing = [name for name in ("vertices", "directions", "names") if name not in found]
    if missing:
        raise InvalidFileError(f"key '{EXPRESSION}{missing[0]}' is missing")
    # sizes of everything follow from the vertices and the names
    count, moved = len(np.atleast_1d(found["names"])), len(np.atleast_1d(found["vertices"]))
    shapes = {
        "directions": (moved, 3, count),
        "joint_directions": (joints, 3, count),
        "joint_turns": (joints, 3, count),
    }
    check_indices(f"{EXPRESSION}vertices", found["vertices"], (moved,), vertices)
    for name in found.keys() & shapes.keys():
        check_array(f"{EXPRESSION}{name}", found[name], shapes[name], -LARGEST, LARGEST)

    def number(name):
        if name in found:
            return from_host(found[name], jnp.float32)
        return None

    return Expressions(
        vertices=from_host(found["vertices"], jnp.int32),
        directions=from_host(found["directions"], jnp.float32),
        joint_directions=number("joint_directions"),
        joint_turns=number("joint_turns"),
        names=tuple(str(name) for name in np.atleast_1d(found["names"])),
    )


# SMPL-X
# --------------------------------------------------------------------------------------------------


SHAPE_COLUMNS = 300
"""Number of shape directions in `shapedirs` of current files. They come first."""
EXPRESSION_COLUMNS = 100
"""Number of expression directions in `shapedirs` of current files. They follow the shape
directions.
"""
OLD_COLUMNS = 10
"""Number of directions of each kind in older files."""
JOINTS = len(JOINT_NAMES)


@pytree_dataclass
class HandBasis:
    """The hand pose space of a model file, left hand first."""

    means: Float[Array, "2 45"]
    """Mean poses, (2, 45), axis-angle, radians."""
    components: Float[Array, "2 45 45"]
    """Principal components in rows, (2, 45, 45)."""


def load_smplx(path: str | Path, *, shape_count: int = 10, expression_count: int = 10) -> BodyModel:
    """Reads an SMPL-X model file, `.npz` (pickled objects in it are never read) or `.pkl` (see
    `restricted_pickle`).

    Arguments: shape_count, expression_count: how many of the file's directions to keep.
    `shape_directions` holds the shape directions, then the expression directions. Numbers are
    float32, or float64 under `jax.enable_x64`.
    Raises: FileNotFoundError; ValueError if the file cannot be read, if anything in it does not fit
    the format, or if it has fewer directions than asked for. The message names the file, and the
    key if the fault is in one.
    """
    with reading(path, "body model file"):
        file = ArrayFile.open(path, wanted=lambda key: not key.startswith("hands_"))
        # what the file must have
        template = file.numbers("v_template", (None, 3), LARGEST)
        n = len(template)
        weights = file.numbers("weights", (n, JOINTS), LARGEST)
        check_row_sums("weights", weights)
        directions, names = _shape_directions(file, n, shape_count, expression_count)
        has_uvs = "vt" in file and "ft" in file
        uvs = None
        if has_uvs:
            uvs = file.numbers("vt", (None, 2))

        def number(x):
            return from_host(x, jnp.result_type(float))

        # the expressions of the face, also as a change of the joints
        regressor = number(file.numbers("J_regressor", (JOINTS, n), LARGEST))
        components = number(directions[..., shape_count:])
        expressions = Expressions(
            vertices=jnp.arange(n, dtype=jnp.int32),
            directions=components,
            joint_directions=jnp.einsum("jn,nae->jae", regressor, components, precision="highest"),
            names=names[shape_count:],
        )
        return BodyModel(
            template=number(template),
            shape_directions=number(directions),
            pose_directions=number(file.numbers("posedirs", (n, 3, 9 * (JOINTS - 1)), LARGEST)),
            joint_regressor=regressor,
            skinning_weights=number(weights),
            faces=from_host(file.indices("f", n), jnp.int32),
            uvs=None if uvs is None else number(uvs),
            uv_faces=None if uvs is None else from_host(file.indices("ft", len(uvs)), jnp.int32),
            expressions=expressions if expression_count else None,
            parents=_parents(file),
            joint_names=JOINT_NAMES,
            shape_names=names,
            name=Path(path).stem,
        )


def _shape_directions(
    file: ArrayFile, n: int, shape_count: int, expression_count: int
) -> tuple[Float[np.ndarray, "n 3 s"], tuple[str, ...]]:
    # how many columns of each kind the file has
    stored = file.numbers("shapedirs", (n, 3, None), LARGEST)
    columns = stored.shape[-1]
    if columns >= SHAPE_COLUMNS + EXPRESSION_COLUMNS:
        available = SHAPE_COLUMNS, EXPRESSION_COLUMNS
    elif columns >= 2 * OLD_COLUMNS:
        available = OLD_COLUMNS, OLD_COLUMNS
    else:
        raise FileError(
            file.path, "shapedirs", f"expected 20 or 400 columns (shape, expression), got {columns}"
        )
    for asked, limit, kind in zip(
        (shape_count, expression_count), available, ("shape", "expression"), strict=True
    ):
        if not 0 <= asked <= limit:
            raise FileError(
                file.path, "shapedirs", f"has {limit} {kind} directions, asked for {asked}"
            )
    # the first columns of each kind
    shape = stored[..., :shape_count]
    expression = stored[..., available[0] : available[0] + expression_count]
    names = (
        *(f"shape_{i}" for i in range(shape_count)),
        *(f"expression_{i}" for i in range(expression_count)),
    )
    return np.concatenate([shape, expression], axis=-1), names


def _parents(file: ArrayFile) -> tuple[int, ...]:
    parents = file.integers("kintree_table", (2, JOINTS))[0]
    found = (-1, *(int(p) for p in parents[1:]))  # the root's is stored as -1 or as 2^32 - 1
    if found != PARENTS:
        raise FileError(file.path, "kintree_table", f"expected SMPL-X's joint tree, got {found}")
    return found


def load_hands(path: str | Path) -> HandBasis:
    """Returns the mean and the principal components of the hand poses in an SMPL-X model file.

    Raises: as `load_smplx`.
    """
    with reading(path, "body model file"):
        file = ArrayFile.open(path, wanted=lambda key: key.startswith("hands_"))

        def number(arrays):
            return from_host(np.stack(arrays), jnp.result_type(float))

        return HandBasis(
            means=number([file.numbers(f"hands_mean{side}", (45,)) for side in "lr"]),
            components=number([file.numbers(f"hands_components{side}", (45, 45)) for side in "lr"]),
        )
