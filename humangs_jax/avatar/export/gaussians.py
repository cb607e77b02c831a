"""The parts of reading and writing Gaussians and avatars that all file formats share. `EXPORTS` has
a row for each format.

Our Gaussians are in metres with y up, the person faces +z, quaternions are wxyz, scales are linear,
and opacities and colors are in [0, 1]. glTF's world is the same. Viewers of `.ply` and `.splat`
take y for down: SuperSplat and PlayCanvas turn what they read by half a turn about z. The axes of
`.spz` point to the right, up and back, half a turn about y from ours. Other converters assume
these axes, too. `export` turns avatars into these worlds; `load_gaussians` and `save_gaussians` do
so with `y_up`.
"""

import logging
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.avatar.animate import animate
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import EXPORTS, OTHERS, READ_ONLY, ExportFormat, Up, chosen_format
from humangs_jax.body.model import RestBody
from humangs_jax.body.motion import Motion, grounded
from humangs_jax.core.array_types import Float
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import (
    BOUNDED,
    LARGEST,
    check_values,
    checked_arguments,
    require_concrete,
)
from humangs_jax.core.compiled import compiled
from humangs_jax.core.progress import printable
from humangs_jax.core.pytree import replace
from humangs_jax.core.records import record_values
from humangs_jax.core.registry import Formats, alternatives, imported
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT
from humangs_jax.io.arrays import check_array
from humangs_jax.io.reading import InvalidFileError, read_bytes, reading
from humangs_jax.rendering.gaussians import (
    Gaussians,
    factored,
    turned_harmonics,
    widened,
)

logger = logging.getLogger(__name__)
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic Y00 = 1 / (2 sqrt(pi))."""
SEEN = 0.5
"""Gaussians of at least this opacity are seen. The lowest of them stands on the floor."""
BACKWARDS = (0.0, 0.0, 1.0, 0.0)
"""The rotation (quaternion, wxyz) of half a turn about y."""
_HALF = float(np.sqrt(0.5))
_TURNS = {"y": (1.0, 0.0, 0.0, 0.0), "-y": (0.0, 0.0, 0.0, 1.0), "z": (_HALF, _HALF, 0.0, 0.0)}


# Worlds
# --------------------------------------------------------------------------------------------------


def up_turn(up: Up) -> tuple[float, float, float, float]:
    """Returns the rotation (quaternion, wxyz) that turns +y to the named axis. It is about z for
    -y, and about x for z.

    Raises: ValueError for another axis.
    """
    if up not in _TURNS:
        raise ValueError(f"up: expected {', '.join(get_args(Up))}, got {up!r}")
    return _TURNS[up]


def up_matrix(up: Up) -> Float[np.ndarray, "3 3"]:
    """Returns `up_turn` as a matrix, which turns points and normals."""
    return _matrix(up_turn(up))


def world_matrix(form: ExportFormat) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation from our world, with y up and people who face +z, to the world of a
    format.
    """
    matrix = up_matrix(form.up)
    if form.backwards:
        return matrix @ _matrix(BACKWARDS)
    return matrix


def turned(gaussians: Gaussians, up: Up) -> Gaussians:
    """Returns Gaussians turned from a world with y up to one with `up` up.

    -y: half a turn about z, (-x, -y, z). z: a quarter of a turn about x, (x, -z, y). Raises:
    ValueError for another axis.
    """
    return rotated(gaussians, up_turn(up))


def rotated(gaussians: Gaussians, turn: tuple[float, float, float, float]) -> Gaussians:
    """Returns Gaussians turned about the origin. turn: the rotation as a quaternion (wxyz), which
    must consist of quarter turns.
    """
    return _rotated(gaussians, turn)


@compiled(static=["turn"])
def _rotated(gaussians: Gaussians, turn: tuple[float, float, float, float]) -> Gaussians:
    gaussians, matrix = factored(gaussians), jnp.asarray(_matrix(turn), gaussians.means.dtype)
    means = jnp.matmul(gaussians.means, matrix.T, precision=EXACT)
    quats = quaternion.multiply(jnp.asarray(turn, gaussians.quats.dtype), gaussians.quats)
    harmonics = gaussians.harmonics
    if harmonics is not None:
        harmonics = turned_harmonics(harmonics, matrix[None])
    return replace(gaussians, means=means, quats=quats, harmonics=harmonics)


def _matrix(turn: tuple[float, float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation matrix of a quaternion (wxyz) that consists of quarter turns. Its
    elements are exactly 0, 1 or -1.
    """
    w, x, y, z = turn
    return Rotation.from_quat([x, y, z, w]).as_matrix().astype(np.float32).round()


def grounded_gaussians(gaussians: Gaussians) -> Gaussians:
    """Returns Gaussians moved along y so that the lowest centre of a seen Gaussian lies on y = 0. A
    Gaussian is seen if its opacity is at least `SEEN`. If no opacity is that large, the Gaussians
    with the largest opacity are seen.
    """
    means, opacities = np.asarray(gaussians.means), np.asarray(gaussians.opacities)
    seen = opacities >= min(SEEN, opacities.max(initial=0.0))
    lowest = means[seen, 1].min(initial=np.inf)
    shift = np.asarray([0.0, lowest if np.isfinite(lowest) else 0.0, 0.0], means.dtype)
    return replace(gaussians, means=from_host(means - shift))


def plain_arrays(gaussians: Gaussians) -> Sequence[Float[np.ndarray, "g ..."]]:
    """Returns means, unit quaternions (wxyz), scales, opacities, colors and harmonics as float64
    arrays, without deformations and low-pass. Harmonics have k = 0 if there are none.

    Viewers add `EPS2D` pixels^2 to projected variances, as 3DGS does. Our renderer adds less if the
    scales contain a low-pass (`Gaussians.pixel_footprint`). The low-pass is therefore taken out of
    the scales, so that viewers draw the same images, at the size that the Gaussians were fitted to.

    Raises: ValueError for numbers that files cannot hold, because they are not finite or larger
    than `checks.LARGEST`. Also for negative scales and for opacities outside of [0, 1].
    """
    names = ("means", "quats", "scales", "colors", "harmonics")
    check_values("export", record_values(gaussians, "gaussians"))
    check_values(
        "export", {f"gaussians.{name}": (getattr(gaussians, name), BOUNDED) for name in names}
    )
    g = _plain(gaussians)
    if g.harmonics is None:
        harmonics = np.zeros((len(g.means), 0, 3))
    else:
        harmonics = g.harmonics
    arrays = (g.means, g.quats, g.scales, g.opacities, g.colors, harmonics)
    means, quats, scales, opacities, colors, harmonics = (np.asarray(x, np.float64) for x in arrays)
    return means, unit_quats(quats), scales, opacities, colors, harmonics


@compiled()
def _plain(gaussians: Gaussians) -> Gaussians:
    """Returns the Gaussians without deformations and without low-pass."""
    scales = widened(gaussians.scales, gaussians.pixel_footprint, -1)
    return factored(replace(gaussians, scales=scales, pixel_footprint=None))


def sh_of(colors: Float[np.ndarray, "*g 3"]) -> Float[np.ndarray, "*g 3"]:
    """Returns the coefficients f of the constant spherical harmonic, as files of Gaussians hold
    them: rgb = 1/2 + Y00 f.
    """
    return (colors - 0.5) / SH_C0


def linear_of(colors: Float[np.ndarray, "*g 3"]) -> Float[np.ndarray, "*g 3"]:
    """Returns sRGB-encoded colors as linear colors in [0, 1] (IEC 61966-2-1)."""
    encoded = np.clip(colors, 0, 1)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


# Files
# --------------------------------------------------------------------------------------------------


@checked_arguments
def load_gaussians(path: str | os.PathLike[str], *, y_up: bool = False) -> Gaussians:
    """Read the Gaussians of a file of another program: `.ply` (3DGS, and the compressed one of
    PlayCanvas), `.splat`, `.spz`, `.glb`, `.sog` (PlayCanvas) and `.pt` (checkpoints of gsplat).

    Args:
        path: The file. Its first bytes decide the format. For the formats without typical first
            bytes (`.splat`, `.sog`, `.pt`) its suffix decides.
        y_up: Whether the Gaussians are turned from the world that viewers of the format expect (y
            down in `.ply`, `.splat`, `.sog` and `.pt`) to one with y up, as `orbit` has it. False:
            the numbers stay as they are in the file, so that the scene's own cameras fit them.

    Returns:
        Gaussians in float32 with unit quaternions (wxyz), linear scales, opacities in [0, 1],
        colors 1/2 + Y00 f_dc, and harmonics (g, 3, 3), (g, 8, 3) or (g, 15, 3) if the file has
        them. Gaussians with numbers that are not finite are left out. A warning says so, and lists
        what else in the file is not used.

    Raises:
        FileNotFoundError: There is no such file.
        FileError: The file cannot be read, is larger than the limits allow, or has invalid numbers.
            The message names file and property.

    Examples:
        >>> scene = hg.load_gaussians("garden.ply", y_up=True)
        >>> image = hg.render(scene, camera, "inria")
    """
    with reading(path, "file of Gaussians"):
        suffix = os.path.splitext(path)[1].lower()
        data = read_bytes(path, "array_bytes")
        # what a file begins with says more than its name
        begun = (each for each in EXPORTS.values() if data.startswith(each.magic))
        read_only = (each for each in READ_ONLY.values() if suffix in each.suffixes)
        form = next(begun, None) or next(read_only, None) or chosen_format(suffix)
        if form is None or not form.reader:
            known = alternatives((*_written().suffixes, *READ_ONLY.suffixes))
            raise InvalidFileError(
                OTHERS.get(suffix, f"not known: expected a file ending in {known}")
            )
        # what the file holds and is not used is notes in one line
        notes: list[str] = []
        gaussians = imported(form.reader)(data, notes)
        if notes:
            logger.warning("%s: %s", path, printable("; ".join(dict.fromkeys(notes))))
        if y_up:
            return _between_worlds(gaussians, form)
        return gaussians


@checked_arguments
def save_gaussians(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    y_up: bool = False,
    version: int | None = None,
) -> None:
    """Write Gaussians into a file for other programs. If writing fails, the path stays as it was.

    Deformations become quaternions and scales. A low-pass is taken out of the scales.

    Args:
        path: Ends in `.ply` (3DGS), `.splat` (8-bit colors, the largest Gaussians first), `.spz`
            (8-bit colors, scales in steps of 6 %, harmonics from -1 to 1) or `.glb`
            (KHR_gaussian_splatting).
        gaussians: With or without harmonics, which `.splat` does not hold (`hg.replace(gaussians,
            harmonics=None)`).
        y_up: Whether the Gaussians have y up, and are turned to the world that viewers of the
            format expect: y down in `.ply` and `.splat`, up in `.spz` and `.glb`. False: the
            numbers stay as they are.
        version: Of a `.spz`: 3, which more programs read, or 4. None: 3.

    Raises:
        ValueError: Another suffix or version, numbers that files cannot hold, harmonics that the
            format does not hold, or no Gaussians for a `.glb`.
        OSError: The file cannot be written.
        TypeError: The call is inside of a JAX transformation.

    Examples:
        >>> hg.save_gaussians("garden.spz", hg.load_gaussians("garden.ply", y_up=True), y_up=True)
    """
    require_concrete("save_gaussians", "writes a file", gaussians)
    form = chosen_format(os.path.splitext(path)[1])
    if form is None or form.mesh:
        suffixes = alternatives(_written().suffixes)
        raise ValueError(f"{path}: expected a name ending in {suffixes}")
    _check_version(path, form, version)
    form(path, _between_worlds(gaussians, form) if y_up else gaussians, **_versioned(version))


def _check_version(path: object, form: ExportFormat, version: int | None) -> None:
    """Check that a version of a format can be written.

    Raises: ValueError if not.
    """
    if version is None or version in form.versions:
        return
    if not form.versions:
        holding = EXPORTS.where(lambda each: bool(each.versions)).suffixes
        raise ValueError(
            f"{path}: has no versions: expected a name ending in {alternatives(holding)}"
        )
    raise ValueError(f"version: expected {' or '.join(map(str, form.versions))}, got {version}")


def _versioned(version: int | None) -> dict[str, int]:
    if version is None:
        return {}
    return {"version": version}


def _between_worlds(gaussians: Gaussians, form: ExportFormat) -> Gaussians:
    """Returns Gaussians turned from a world with y up to the world that viewers of a format expect,
    or back. One function serves both directions, since half turns are their own inverse.
    """
    if form.backwards:
        gaussians = rotated(gaussians, BACKWARDS)
    return turned(gaussians, form.up)


def _written() -> Formats[ExportFormat]:
    return EXPORTS.where(lambda each: not each.mesh)


def loaded(arrays: Mapping[str, Float[np.ndarray, "g ..."]], notes: list[str]) -> Gaussians:
    """Returns Gaussians made of the arrays of a file. The arrays are means, quaternions (wxyz),
    scales, opacities, colors and perhaps harmonics, in this order. Their keys are the names in the
    file, which errors show.

    Gaussians with a number that is not finite are left out, and a line with their count is appended
    to `notes`.

    Raises: InvalidFileError if no Gaussian is left, or for numbers out of range.
    """
    arrays = _finite(arrays, notes)
    count = len(next(iter(arrays.values())))
    fields = ("means", "quats", "scales", "opacities", "colors", "harmonics")
    shapes = ((3,), (4,), (3,), (), (3,), (None, 3))
    ranges = {"scales": (0.0, LARGEST), "opacities": (0.0, 1.0)}
    for field, shape, (name, array) in zip(fields, shapes, arrays.items(), strict=False):
        check_array(name, array, (count, *shape), *ranges.get(field, (-LARGEST, LARGEST)))
    values = dict(zip(fields, arrays.values(), strict=False))
    values["quats"] = unit_quats(values["quats"])
    return Gaussians(**{name: from_host(array, jnp.float32) for name, array in values.items()})


def _finite(arrays: Mapping[str, np.ndarray], notes: list[str]) -> Mapping[str, np.ndarray]:
    """Returns the arrays without the Gaussians (rows) that have a number that is not finite, also
    after rounding to float32. A line with the count of these Gaussians is appended to `notes`.
    If an array has no floats, or another length than the first one, all arrays are returned as they
    are. Raises: InvalidFileError if no Gaussian is left.
    """
    count = len(next(iter(arrays.values())))
    keep = np.ones(count, bool)
    bad = []
    for name, array in arrays.items():
        if len(array) != count or array.dtype.kind != "f":
            return arrays  # refused by its shape
        with np.errstate(over="ignore"):
            finite = np.isfinite(array.astype(np.float32))
        rows = finite.all(axis=tuple(range(1, array.ndim)))
        keep &= rows
        if not rows.all():
            bad.append(name)
    if not bad:
        return arrays
    if not keep.any():
        raise InvalidFileError(f"{', '.join(bad)}: none of {count:,} Gaussians has finite numbers")
    left_out = count - int(keep.sum())
    notes.append(f"{left_out:,} of {count:,} Gaussians are left out: {', '.join(bad)}: not finite")
    return {name: array[keep] for name, array in arrays.items()}


def with_largest(three: Float[np.ndarray, "g 3"], places: np.ndarray) -> Float[np.ndarray, "g 4"]:
    """Returns unit quaternions, each from three of its components, in their order. The fourth
    component follows from the length of 1, and is not negative. places: the place (0 to 3) of the
    fourth component in each quaternion.
    """
    rest = np.sqrt(np.maximum(1 - np.square(three).sum(axis=1), 0))
    quats = np.empty((len(three), 4))
    for i in range(4):
        quats[places == i] = np.insert(three, i, rest, axis=1)[places == i]
    return quats


def colors_of(coefficients: Float[np.ndarray, "g 3"]) -> Float[np.ndarray, "g 3"]:
    """Returns colors from the coefficients of the constant spherical harmonic. This is the inverse
    of `sh_of`.
    """
    return 0.5 + SH_C0 * coefficients


def unit_quats(quats: Float[np.ndarray, "g 4"]) -> Float[np.ndarray, "g 4"]:
    """Returns the quaternions scaled to length 1. Quaternions of length 0 become the identity."""
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    return np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0])


# An avatar to a file, or a motion to a sequence of files
# -------------------------------------------------------------


DIGITS = 4
"""Digits of the frame numbers in the file names of a sequence."""


def frame_range(text: str, count: int) -> range:
    """Returns the frames that "a:b:step" selects of `count` frames, as Python slices do. Each part
    may be missing.

    Raises: ValueError if the text is of another form or selects no frame.
    """
    parts = text.split(":")
    if not 2 <= len(parts) <= 3 or not all(
        re.fullmatch(r"\s*(-?\d{1,9})?\s*", part) for part in parts
    ):
        raise ValueError(f"{text!r}: expected frames as a:b:step, such as 0:100:5 or : for all")
    numbers = [int(part) if part.strip() else None for part in parts]
    if len(numbers) > 2 and numbers[2] is not None and numbers[2] < 1:
        raise ValueError(f"{text!r}: expected a step of 1 or more")
    frames = range(count)[slice(*numbers)]
    if not frames:
        raise ValueError(f"{text!r}: none of the {count} frames, which are counted from 0")
    return frames


@checked_arguments
def export(
    path: str | os.PathLike[str],
    avatar: Avatar,
    motion: Motion | None = None,
    numbers: Sequence[int] | None = None,
    *,
    mesh: bool = False,
    up: Up | None = None,
    rest_fields: bool = False,
    version: int | None = None,
    name: str = "motion",
) -> list[Path]:
    """Write an avatar in T-pose, in one pose, or in the poses of a motion. Each file appears when
    it is complete.

    Args:
        path: with a suffix of `EXPORTS`.
        avatar: one person.
        motion: None for the T-pose. A `.glb` of the mesh holds all of it as animation.
        numbers: for each frame of the motion the number in the name of its file: "x.ply" becomes
            "x_0007.ply". All frames have one floor, so that a person who jumps is above it. None:
            the motion has one frame, and the feet are on 0. A format that holds a whole motion does
            not use the numbers.
        mesh: whether a mesh is written if the suffix also has a format of Gaussians (`.glb`).
        up: the axis that points up; None for the format's own.
        rest_fields: see `write_ply`.
        version: see `save_gaussians`.
        name: the name of the animation in the file.

    Returns:
        The paths of the files. Files that a format puts beside them (`.mtl` and `.png` of an
        `.obj`) are not included.

    Raises:
        ValueError: for another suffix, for a format that cannot hold what is asked for, for numbers
            that files cannot hold, if `numbers` has not one number for each frame, or if `animate`
            refuses a pose of the motion. Also if the `.mtl` or `.png` of an `.obj` would replace a
            file that humangs did not write.
        OSError: if a file cannot be written.
        TypeError: inside of JAX transformations.

    Examples:
        >>> hg.export("person.glb", avatar, hg.load_motion("dance.bvh"), mesh=True)
    """
    require_concrete("export", "writes a file", avatar, motion)
    path = Path(path)
    # whether the format holds what is asked for
    form = chosen_format(path.suffix, mesh)
    if form is None:
        known = EXPORTS.where(lambda each: each.mesh >= mesh).suffixes
        purpose = " for a mesh" if mesh else ""
        raise ValueError(f"{path}: expected a name ending in {alternatives(known)}{purpose}")
    if rest_fields and not form.rest_fields:
        holding = EXPORTS.where(lambda each: each.rest_fields).suffixes
        raise ValueError(
            f"{path}: has no rest fields: expected a name ending in {alternatives(holding)}"
        )
    _check_version(path, form, version)
    # one file for each frame, unless one holds a whole motion
    frames = 1
    if motion is not None:
        frames = len(motion.translations)
    if not form.animated and frames != (1 if numbers is None else len(numbers)):
        given = "no numbers"
        if numbers is not None:
            given = f"{len(numbers)} numbers"
        raise ValueError(f"numbers: expected one for each of the {frames} frames, got {given}")
    if motion is not None and (form.mesh or numbers is not None):
        motion = grounded(
            motion, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents
        )
    one = form.animated or numbers is None
    if one:
        files = [path]
    else:
        files = [path.with_stem(f"{path.stem}_{number:0{DIGITS}d}") for number in numbers or ()]
    # meshes take the motion, Gaussians are posed frame after frame
    if form.mesh:
        form(path, files, avatar, motion, up or form.up, name)
        return files
    for i, file in enumerate(files):
        pose = None
        if motion is not None:
            pose = motion.pose(i, avatar.expression_names)
        gaussians = avatar.gaussians
        if pose is not None:
            gaussians = animate(avatar, pose)
        if numbers is None:
            gaussians = grounded_gaussians(gaussians)
        if form.backwards:  # before up is elsewhere: the half turn is about the vertical axis
            gaussians = rotated(gaussians, BACKWARDS)
        gaussians = turned(gaussians, up or form.up)
        options = {}
        if rest_fields:
            options = {"rest_fields": True}
        form(file, gaussians, **options, **_versioned(version))
    return files
