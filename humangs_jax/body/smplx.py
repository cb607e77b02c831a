"""SMPL-X model files and pose vectors.

A pose vector has 165 numbers: global_orient 3, body 63, jaw 3, left eye 3, right eye 3, left hand 45, right hand 45.
Two conventions for the hands differ between datasets; both are required keyword arguments: `use_pca` (the hand numbers are
coefficients of the model's principal components) and `flat_hand_mean` (True: zero means a flat hand; False: zero means
the model's mean hand, which is added).

The model's licence forbids redistribution: users bring the file.
"""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.checks import LARGEST
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.io.arrays import ArrayFile, check_row_sums
from humangs_jax.io.reading import FileError, reading

SHAPE_COLUMNS, EXPRESSION_COLUMNS = 300, 100
"""Columns of `shapedirs` in current files; older ones have 10 + 10."""
OLD_COLUMNS = 10
JOINTS = len(JOINT_NAMES)


@pytree_dataclass
class HandBasis:
    """The hand pose space of a model file, left hand first.

    means: (2, 45) axis-angle, radians. components: (2, 45, 45), rows are principal components.
    """

    means: Float[Array, "2 45"]
    components: Float[Array, "2 45 45"]


def load_smplx(path: str | Path, *, shape_count: int = 10, expression_count: int = 10) -> BodyModel:
    """Read an SMPL-X model file, `.npz` (no pickled object in it is touched) or `.pkl` (see `restricted_pickle`).

    Arguments: shape_count, expression_count: how many of the file's directions to keep; `shape_directions` holds the
    shape ones, then the expression ones. Numbers are float32, or float64 under `jax.enable_x64`.
    Raises: FileNotFoundError; ValueError, naming file and key, for whatever does not fit the format.
    """
    with reading(path, "body model file"):
        return _load_smplx(path, shape_count, expression_count)


def _load_smplx(path: str | Path, shape_count: int, expression_count: int) -> BodyModel:
    file = ArrayFile.open(path, wanted=lambda key: not key.startswith("hands_"))
    template = file.numbers("v_template", (None, 3), LARGEST)
    n = len(template)
    weights = file.numbers("weights", (n, JOINTS), LARGEST)
    check_row_sums("weights", weights)
    directions, names = _shape_directions(file, n, shape_count, expression_count)
    has_uvs = "vt" in file and "ft" in file
    uvs = file.numbers("vt", (None, 2)) if has_uvs else None
    number = lambda x: jnp.asarray(x, jnp.result_type(float))
    return BodyModel(
        template=number(template),
        shape_directions=number(directions),
        pose_directions=number(file.numbers("posedirs", (n, 3, 9 * (JOINTS - 1)), LARGEST)),
        joint_regressor=number(file.numbers("J_regressor", (JOINTS, n), LARGEST)),
        skinning_weights=number(weights),
        faces=jnp.asarray(file.indices("f", n), jnp.int32),
        uvs=None if uvs is None else number(uvs),
        uv_faces=None if uvs is None else jnp.asarray(file.indices("ft", len(uvs)), jnp.int32),
        parents=_parents(file),
        joint_names=JOINT_NAMES,
        shape_names=names,
        name=Path(path).stem,
    )


def _shape_directions(
    file: ArrayFile, n: int, shape_count: int, expression_count: int
) -> tuple[Float[np.ndarray, "n 3 s"], tuple[str, ...]]:
    stored = file.numbers("shapedirs", (n, 3, None), LARGEST)
    columns = stored.shape[-1]
    if columns >= SHAPE_COLUMNS + EXPRESSION_COLUMNS:
        available = SHAPE_COLUMNS, EXPRESSION_COLUMNS
    elif columns >= 2 * OLD_COLUMNS:
        available = OLD_COLUMNS, OLD_COLUMNS
    else:
        raise FileError(file.path, "shapedirs", f"expected 20 or 400 columns (shape, expression), got {columns}")
    for asked, limit, kind in zip((shape_count, expression_count), available, ("shape", "expression"), strict=True):
        if not 0 <= asked <= limit:
            raise FileError(file.path, "shapedirs", f"has {limit} {kind} directions, asked for {asked}")
    shape, expression = stored[..., :shape_count], stored[..., available[0] : available[0] + expression_count]
    names = (*(f"shape_{i}" for i in range(shape_count)), *(f"expression_{i}" for i in range(expression_count)))
    return np.concatenate([shape, expression], axis=-1), names


def _parents(file: ArrayFile) -> tuple[int, ...]:
    parents = file.numbers("kintree_table", (2, JOINTS))[0].astype(np.int64)
    found = (-1, *(int(p) for p in parents[1:]))  # the root's is stored as -1 or as 2^32 - 1
    if found != PARENTS:
        raise FileError(file.path, "kintree_table", f"expected SMPL-X's joint tree, got {found}")
    return found


def load_hands(path: str | Path) -> HandBasis:
    """Mean and principal components of the hand poses of an SMPL-X model file. Raises as `load_smplx`."""
    with reading(path, "body model file"):
        file = ArrayFile.open(path, wanted=lambda key: key.startswith("hands_"))
        number = lambda arrays: jnp.asarray(np.stack(arrays), jnp.result_type(float))
        return HandBasis(
            means=number([file.numbers(f"hands_mean{side}", (45,)) for side in "lr"]),
            components=number([file.numbers(f"hands_components{side}", (45, 45)) for side in "lr"]),
        )


def _part(name: str, values: Any, size: int, dtype: Any) -> Float[Array, " size"]:
    """Rotations of one body part, flat; zeros if missing."""
    if values is None:
        return jnp.zeros(size, dtype)
    values = jnp.asarray(values)
    if values.size != size or values.shape not in {(size,), (size // 3, 3)}:
        raise ValueError(f"{name}: expected shape ({size},) or ({size // 3}, 3), got {values.shape}")
    return values.reshape(size)


def _hand(
    side: int, values: Any, hands: HandBasis | None, use_pca: bool, flat_hand_mean: bool, dtype: Any
) -> Float[Array, "45"]:
    """Axis-angle numbers (45,) of one hand."""
    name = ("left_hand_pose", "right_hand_pose")[side]
    if hands is None and not (flat_hand_mean and (values is None or not use_pca)):
        raise ValueError(f"{name}: use_pca or flat_hand_mean=False need the model's hand basis (`load_hands`)")
    if values is not None and use_pca:
        assert hands is not None  # else it was refused above
        values = jnp.asarray(values)
        if values.ndim != 1 or values.shape[0] > 45:
            raise ValueError(f"{name}: expected at most 45 principal coefficients, got shape {values.shape}")
        rotations = jnp.matmul(values, hands.components[side, : values.shape[0]], precision="highest")
    else:
        rotations = _part(name, values, 45, dtype)
    if flat_hand_mean:
        return rotations
    assert hands is not None  # likewise
    return rotations + hands.means[side]


def assemble_pose(
    *,
    use_pca: bool,
    flat_hand_mean: bool,
    hands: HandBasis | None = None,
    global_orient: Any = None,
    body_pose: Any = None,
    jaw_pose: Any = None,
    leye_pose: Any = None,
    reye_pose: Any = None,
    left_hand_pose: Any = None,
    right_hand_pose: Any = None,
    transl: Any = None,
) -> BodyPose:
    """A full pose from named parts; missing ones are 0.

    Arguments: global_orient, jaw_pose, leye_pose, reye_pose (3,); body_pose (63,) or (21, 3); hand poses (45,) or (15,
    3) axis-angle, or with `use_pca` at most 45 coefficients; radians, and transl (3,) in metres.
    `flat_hand_mean=False` adds the mean hand.
    hands: from `load_hands`, needed for `use_pca` or `flat_hand_mean=False`.
    Raises: ValueError, naming the part, for a wrong shape or a missing hand basis.
    """
    dtype = jnp.result_type(float)
    part = lambda name, values, size: _part(name, values, size, dtype)
    rotations = jnp.concatenate(
        [
            part("global_orient", global_orient, 3),
            part("body_pose", body_pose, 63),
            part("jaw_pose", jaw_pose, 3),
            part("leye_pose", leye_pose, 3),
            part("reye_pose", reye_pose, 3),
            _hand(0, left_hand_pose, hands, use_pca, flat_hand_mean, dtype),
            _hand(1, right_hand_pose, hands, use_pca, flat_hand_mean, dtype),
        ]
    )
    return BodyPose(rotations.reshape(JOINTS, 3), part("transl", transl, 3))
