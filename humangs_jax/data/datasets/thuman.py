"""THuman2.0 and 2.1: textured scans with SMPL-X fits (https://github.com/ytrock/THuman2.0-Dataset).
Static, not metric.

    model/<id>/<id>.obj with its .mtl and JPEG texture
    smplx/<id>/smplx_param.pkl and mesh_smplx.obj

Three kinds of fits exist; the keys and the length of the hand poses tell which one a file is:

    kind   keys                hands                              model     model vertex V in scan
    A      scale, translation  12 principal components            male      V scale + translation
    B      scale, translation  45 axis-angle                      male      V scale + translation
    C      scale, transl       45 axis-angle                      neutral   (V + transl) scale

In all of them hand poses are relative to the mean hand (flat_hand_mean False). mesh_smplx.obj is
the fitted body as the authors posed it. The distance of our body from this mesh shows whether fit,
kind and model file belong together.
"""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np

from humangs_jax.core.array_types import Float, Int, UInt8
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.datasets.subject import (
    FARTHEST,
    LARGEST_ANGLE,
    LARGEST_COEFFICIENT,
    BodyParameters,
    FileBody,
    PosedPerson,
    checked_numbers,
    coefficients,
    open_arrays,
)
from humangs_jax.io.arrays import check_array, check_indices
from humangs_jax.io.mesh import read_obj
from humangs_jax.io.reading import InvalidFileError, read_text, reading

Kind = Literal["A", "B", "C"]
PCA_NUMBERS = 12
"""How many principal components describe a hand pose."""
HAND_NUMBERS = 45
"""How many numbers a hand pose has as axis-angles: three for each of 15 joints."""
FIT = "smplx_param.pkl"
"""File of the body that was fitted to a scan."""
FIT_MESH = "mesh_smplx.obj"
"""File of the mesh of the fitted body."""
TOLERANCE = 2e-3
"""The largest mean distance of a fit's vertices from mesh_smplx.obj, metres of the body. Rounding
in OBJ files causes far less. The model of another gender moves vertices by centimetres, and a wrong
hand convention moves the fingers by centimetres.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """The body of a scan."""

    file: Path
    """The file of the fit."""
    kind: Kind
    """Which of the three kinds of fits it is, see the docstring of the module."""
    parameters: BodyParameters
    """The parameters of the one pose."""
    scale: float
    """Scan units per metre. A vertex V of the posed body in metres, translation included, lies at V
    times `scale` in the scan.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class Scan:
    """A textured triangle mesh."""

    vertices: Float[np.ndarray, "n 3"]
    """The vertices, (n, 3), scan units."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices, (f, 3)."""
    uvs: Float[np.ndarray, "n 2"]
    """Texture coordinates of the vertices, (n, 2), v up."""
    texture: UInt8[np.ndarray, "th tw 3"]
    """Colors as bytes, (th, tw, 3), row 0 on top."""


def find_thuman(folder: str | Path) -> tuple[Path, ...]:
    """Returns the folder, as a tuple of one, if it has the folders model/ and smplx/; else an empty
    tuple.
    """
    folder = Path(folder)
    if (folder / "model").is_dir() and (folder / "smplx").is_dir():
        return (folder,)
    return ()


def scan_files(folder: Path, name: str) -> tuple[Path, Path]:
    """Returns the files of the mesh and of the fit of a scan."""
    return folder / "model" / name / f"{name}.obj", folder / "smplx" / name / FIT


def open_thuman(folder: str | Path) -> tuple[list[str], dict[str, str]]:
    """Returns the sorted names of the scans that can be used in a folder that holds model/ and
    smplx/. Also returns, by name, why other scans cannot be used.

    Raises: CaptureError if no scan can be used.
    """
    folder = Path(folder)
    if not (folder / "model").is_dir():
        raise CaptureError(folder, "model", "no such folder: expected THuman's model/ and smplx/")
    names, skipped = [], {}
    for name in sorted(
        entry.name
        for entry in (folder / "model").iterdir()
        if entry.is_dir() and not entry.name.startswith(".")
    ):
        missing = [file for file in scan_files(folder, name) if not file.is_file()]
        if missing:
            skipped[name] = f"{missing[0]}: no such file"
        else:
            names.append(name)
    if not names:
        why = ""
        if skipped:
            why = f" ({next(iter(skipped.values()))})"
        raise CaptureError(
            folder, "", f"no scan with a fit{why}: expected model/ID/ID.obj and smplx/ID/{FIT}"
        )
    return names, skipped


# Fits
# --------------------------------------------------------------------------------------------------


def read_fit(file: str | Path, body: FileBody) -> Fit:
    """Read smplx_param.pkl, without running anything in it.

    Raises: CaptureError naming the file, and the key if a value is wrong; as `FileBody.hands`.
    """
    values = open_arrays(file)
    file = values.path
    # which of the three kinds the fit is
    if ("transl" in values) == ("translation" in values):
        raise CaptureError(
            file,
            "transl",
            "expected either transl (THuman2.1, fixed fits) or translation (older fits)",
        )
    of_kind = "transl" if "transl" in values else "translation"
    keys = ("left_hand_pose", "right_hand_pose")
    hands = [values.numbers(key, (1, None), LARGEST_ANGLE)[0] for key in keys]
    length = len(hands[0])
    if of_kind == "transl":
        lengths = (HAND_NUMBERS,)
    else:
        lengths = PCA_NUMBERS, HAND_NUMBERS
    for key, hand in zip(keys, hands, strict=True):
        if len(hand) not in lengths or len(hand) != length:
            raise CaptureError(
                file,
                key,
                f"expected {' or '.join(map(str, lengths))} numbers beside {of_kind}, got"
                f" {len(hand)}",
            )
    kind: Kind = "A" if length == PCA_NUMBERS else "B"
    if of_kind == "transl":
        kind = "C"
    # place and size; translations in scan units become metres
    scale = values.number("scale")
    if not scale > 0:
        raise CaptureError(file, "scale", f"expected a positive number, got {scale:g}")
    offset = values.numbers(of_kind, (1, 3))
    if kind != "C":
        offset = offset / scale
    translation = checked_numbers(offset, file, of_kind, largest=FARTHEST)
    # poses: hands of principal components become angles, and the mean hand is added
    parts = [values.numbers(key, (1, size), LARGEST_ANGLE)[0] for key, size in _ANGLES.items()]
    if kind == "A":
        components = np.asarray(body.hands.components, np.float64)
        hands = [hand @ components[side, :length] for side, hand in enumerate(hands)]
    means = np.asarray(body.hands.means, np.float64)
    rotations = np.concatenate(
        [*parts, *(hand + means[side] for side, hand in enumerate(hands))]
    ).reshape(1, -1, 3)
    # shape
    shape = [
        values.numbers(key, (1, None), LARGEST_COEFFICIENT)[0] for key in ("betas", "expression")
    ]
    betas = coefficients(body.model, shape[0], shape[1], file)
    return Fit(file, kind, BodyParameters(betas, rotations, translation), scale)


_ANGLES = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}


def fit_error(fitted: PosedPerson, mesh: Float[np.ndarray, "n 3"], fit: Fit) -> tuple[float, float]:
    """Returns the mean and the largest distance between the vertices of the fitted body and
    mesh_smplx.obj, metres of the body.

    Raises: CaptureError if the numbers of vertices differ, or if the mean is above `TOLERANCE`; it
    then names both distances.
    """
    file = fit.file.with_name(FIT_MESH)
    if len(mesh) != len(fitted.vertices):
        problem = (
            f"{len(mesh)} vertices, but the body model has {len(fitted.vertices)}: expected the"
            " model of the fit"
        )
        raise CaptureError(file, "", problem)
    apart = np.linalg.norm(mesh - fitted.vertices, axis=1) / fit.scale
    mean, largest = float(apart.mean()), float(apart.max())
    if mean > TOLERANCE:
        gender = "neutral" if fit.kind == "C" else "male"
        problem = (
            f"the fit (kind {fit.kind}) is {1e3 * mean:.3g} mm from this mesh on average,"
            f" {1e3 * largest:.3g} mm at most: expected below {1e3 * TOLERANCE:g} mm on average;"
            f" fits of this kind need the {gender} model"
        )
        raise CaptureError(file, "", problem)
    return mean, largest


def read_fit_mesh(file: str | Path) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, "f 3"]]:
    """Returns the vertices and triangles of an OBJ file. Every vertex occurs once, in the order of
    the file.

    Raises: CaptureError.
    """
    with reading(file, "mesh", CaptureError):
        vertices, faces = [], []
        for number, line in enumerate(read_text(file).splitlines(), 1):
            kind, *words = line.split() or [""]
            if (kind == "v" and len(words) < 3) or (kind == "f" and len(words) != 3):
                expected = "three corners of a triangle"
                if kind == "v":
                    expected = "three coordinates of a vertex"
                raise InvalidFileError(f"line {number}: expected {expected}, got {len(words)}")
            if kind == "v":
                vertices.append(words[:3])
            elif kind == "f":
                faces.append([corner.partition("/")[0] for corner in words])
        points, corners = np.asarray(vertices, float), np.asarray(faces, int) - 1
        check_array("v", points, (None, 3))
        check_indices("f", corners, (None, 3), len(points))
        return points, corners


# Scans
# --------------------------------------------------------------------------------------------------


def read_scan(file: str | Path) -> Scan:
    """Read the mesh of a scan and its texture.

    Raises: CaptureError naming the file.
    """
    with reading(file, "scan", CaptureError):
        meshes = read_obj(file)
        if len(meshes) != 1:
            raise InvalidFileError(f"{len(meshes)} meshes: expected one mesh with one texture")
        mesh = meshes[0]
        uvs = getattr(mesh.visual, "uv", None)
        image = getattr(getattr(mesh.visual, "material", None), "image", None)
        if uvs is None:
            raise InvalidFileError("no texture coordinates: expected a textured scan")
        # trimesh leaves out what it cannot read, or puts a placeholder there
        if image is None or max(image.size) <= 2:
            raise InvalidFileError(
                "no texture image: expected a material (.mtl) beside the scan that names a PNG or"
                " JPEG file"
            )
        vertices, uvs = np.asarray(mesh.vertices, np.float64), np.asarray(uvs, np.float32)
        check_array("vertices", vertices, (None, 3))
        check_array("texture coordinates", uvs, (len(vertices), 2))
        return Scan(
            vertices, np.asarray(mesh.faces, np.int32), uvs, np.asarray(image.convert("RGB"))
        )
