"""Scans and their landmarks: from files, and by images of the scan for a keypoint detector.

Any mesh format that trimesh reads; parts of a scene are put together where the scene has them. A
fixed number of random points with outward normals is taken from the surface. Points that cannot be
seen from outside (inside of a mouth, skin under cloth, lining) are left out, as by a scanner.

render_scan_views("scan.obj", "views")          a capture folder without a body; run a detector on
                                                views/images
joints = joints_from_views("views", keypoints)  then fit_scan("scan.obj", joints=joints, ...)
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture_checks import expect, floats, required
from humangs_jax.data.keypoints.keypoints import FINGER_JOINTS, FINGERS, Keypoints
from humangs_jax.data.photos import load_photos, write_description
from humangs_jax.fitting.residuals.keypoints import group_by_frame
from humangs_jax.fitting.triangulation import Similarity, triangulate_robustly
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov, orbit
from humangs_jax.geometry.mesh import directions_around, face_crosses, in_front, unit
from humangs_jax.io.arrays import ArrayFile
from humangs_jax.io.atomic import check_replaceable, replace_folder
from humangs_jax.io.images import write_png
from humangs_jax.io.mesh import read_meshes
from humangs_jax.io.reading import Refused, read_json, reading, write_json
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh

VIEWS = 48
"""Directions from which points are looked at."""
PER_CELL = 20
"""Points per cell of the depth buffers, on average, so that hardly any cell is empty by chance."""
BEHIND = 1.0
"""A visible point lies at most this many cells behind the nearest point of its cell."""
OCCLUDERS = 5
"""Points that fill the cells, for each that is kept: with 30,000 points of a person, cells are 1.5
cm wide.
"""
LEAST_FACES = 50
"""A surface of a person has at least this many."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scan:
    """Points of a scan in the file's own coordinates, float64.

    points: (p, 3). normals: (p, 3) unit, outwards. turned: whether the file's faces were inside
    out. hidden: share of the surface that is left out because it cannot be seen.
    """

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    turned: bool
    hidden: float


def read_mesh(path: str | Path, colors: bool = False) -> Any:
    """A trimesh.Trimesh with all geometry of the file.

    Arguments: colors: give it colors of the vertices, see `read_meshes`.
    Raises: ValueError, naming the file, if it cannot be read, has no faces or corners that are not
    finite.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise ValueError(
            f"{path}: {'a folder' if path.is_dir() else 'no such file'}: expected a mesh (OBJ, PLY,"
            " GLB, ...)"
        )
    parts = read_meshes(path, colors=colors)
    faces = sum(len(part.faces) for part in parts)
    if faces < LEAST_FACES:
        raise ValueError(
            f"{path}: {faces} faces: expected the surface of a person, at least {LEAST_FACES}, no"
            " cloud of points"
        )
    mesh: Any = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts)
    if not (np.isfinite(mesh.vertices[np.unique(mesh.faces)]).all() and mesh.area > 0):
        raise ValueError(
            f"{path}: corners that are not finite numbers, or faces without area: expected a clean"
            " mesh"
        )
    return mesh


def read_scan(path: str | Path, count: int = 30_000) -> Scan:
    """About `count` points of the outside of a mesh file. Raises: see `read_mesh`."""
    mesh = read_mesh(path)
    return sample_scan(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), count)


def sample_scan(vertices: Float[np.ndarray, "n 3"], faces: np.ndarray, count: int = 30_000) -> Scan:
    """Random points of a surface, uniform over its area.

    Arguments: vertices (n, 3), faces (f, 3) counter-clockwise seen from outside; reversed faces are
    detected.
    Raises: ValueError if the surface has no area.
    """
    center = vertices[np.unique(faces)].mean(axis=0)
    corners = vertices[faces] - center
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    if not area.sum() > 0:
        raise ValueError("the faces have no area: expected a surface")
    rng = np.random.default_rng(0)
    ends = np.cumsum(area)
    total = OCCLUDERS * count
    face = np.minimum(
        np.searchsorted(ends, rng.random(total) * ends[-1], side="right"), len(faces) - 1
    )
    a, b = rng.random((2, total))
    swap = a + b > 1
    a, b = np.where(swap, 1 - a, a), np.where(swap, 1 - b, b)
    weights = np.stack([1 - a - b, a, b], axis=1)
    points = np.einsum("pc,pca->pa", weights, corners[face])
    turned = bool(np.einsum("fa,fa->", corners[:, 0], across) < 0)  # six times the volume
    cell = float(np.sqrt(PER_CELL * 0.5 * ends[-1] / total))
    some = points[:count]
    seen = [
        in_front(some, points, forward, cell, BEHIND * cell) for forward in directions_around(VIEWS)
    ]
    outside = np.flatnonzero(np.any(seen, axis=0))
    chosen = face[outside]
    normals = across[chosen] / area[chosen][:, None] * (-1 if turned else 1)
    return Scan(points[outside] + center, normals, turned, float(1 - len(outside) / count))


# Known landmarks
# --------------------------------------------------------------------------------------------------

SIDES = ("left", "right")
PARTS = (
    "eye",
    "ear",
    "shoulder",
    "elbow",
    "wrist",
    "hip",
    "knee",
    "ankle",
    "big_toe",
    "small_toe",
    "heel",
)
SCAN_LANDMARKS = (
    *("nose", "neck", "mid_hip"),
    *(f"{side}_{part}" for part in PARTS for side in SIDES),
    *(
        f"{side}_{finger}_{joint}"
        for side in SIDES
        for finger in FINGERS
        for joint in FINGER_JOINTS
    ),
)
"""Names that joints of a scan may have: the landmarks of `body/landmarks.py` without duplicates and
the face.
"""


def checked_joints(
    joints: Mapping[str, Any],
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Points (k, 3) in the order of `SCAN_LANDMARKS` and which of them are known (k,).

    Raises: ValueError for unknown names and points that are not three finite numbers.
    """
    if unknown := sorted(set(joints) - set(SCAN_LANDMARKS)):
        raise ValueError(
            f"joint '{unknown[0]}' is no landmark of ours: expected names such as"
            f" {', '.join(SCAN_LANDMARKS[:6])}"
        )
    points, known = np.zeros((len(SCAN_LANDMARKS), 3)), np.zeros(len(SCAN_LANDMARKS))
    for name, point in joints.items():
        values = np.asarray(point)
        if values.shape != (3,) or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise ValueError(f"joint '{name}': expected three finite numbers, got {point}")
        points[SCAN_LANDMARKS.index(name)], known[SCAN_LANDMARKS.index(name)] = values, 1
    return points, known


def read_joints(path: str | Path) -> dict[str, Float[np.ndarray, "3"]]:
    """Landmarks by name in a scan's coordinates: JSON {"left_hip": [x, y, z], ...}, or npz with
    names (k,) and points (k, 3).

    Raises: ValueError, naming the file, if it is neither, or a name or a point is not one.
    """
    path = Path(path)
    with reading(path, "file of joints"):
        if path.suffix == ".npz":
            file = ArrayFile.open(path)
            names = file.array("names").astype(str).ravel().tolist()
            joints = dict(zip(names, file.numbers("points", (len(names), 3)), strict=True))
        else:
            joints = read_json(path)
        if not (isinstance(joints, dict) and joints):
            raise Refused('expected {"left_hip": [x, y, z], ...}, three at least')
        checked_joints(joints)
        return {name: np.asarray(point, np.float64) for name, point in joints.items()}


SCAN_FILE, PLACEMENT = "scan.json", "world_from_scan"
"""Beside capture.json, and its key: where the scan is in the world of the images."""
ROUNDING = 1e-3
"""How far a rotation may be off: people shorten numbers."""
HEIGHT = 1.7
"""Metres: the scan's longest side in that world (arbitrary)."""
DISTANCE, FIELD_OF_VIEW = 4.0, np.radians(36.0)
"""Distance of the cameras, metres, and their vertical field of view, radians."""
AXES = {
    f"{sign}{axis}": (s, i) for s, sign in ((1, "+"), (-1, "-")) for i, axis in enumerate("xyz")
}


def render_scan_views(
    mesh_path: str | Path, out: str | Path, views: int = 8, size: int = 512, up: str | None = None
) -> Path:
    """Write images of a scan from all around as a capture folder without a body.

    Arguments: up: which axis of the file is up for the person, "+y", "-z", ...; None: the positive
    one along which the scan is longest. Detectors expect standing people: look at the images.
    Raises: ValueError for a mesh that cannot be used (see `read_mesh`), an unknown axis, or a
    folder that is not empty or cannot be replaced (see `check_replaceable`).
    """
    out = Path(out)
    check_replaceable(out)
    if out.is_dir() and any(out.iterdir()):
        raise ValueError(f"{out}: the folder is not empty: expected a new one")
    mesh = read_mesh(mesh_path, colors=True)
    vertices = np.asarray(mesh.vertices, np.float64)
    align = _into_world(vertices[np.unique(mesh.faces)], up)
    angles = jnp.arange(views) * (2 * jnp.pi / views)
    K = intrinsics_from_fov(FIELD_OF_VIEW, size, size)
    cameras = orbit(jnp.zeros(3), DISTANCE, angles, 0.1, K, size, size)
    colors = np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    drawn = _draw(align(vertices), np.asarray(mesh.faces), colors, cameras)
    replace_folder(out, lambda folder: _write(folder, drawn, cameras, align), mark=SCAN_FILE)
    return out


def joints_from_views(
    folder: str | Path, keypoints: Keypoints
) -> dict[str, Float[np.ndarray, "3"]]:
    """Landmarks by name, in the scan's coordinates, on which at least two views agree.

    Arguments: keypoints: of the images that `render_scan_views` wrote to the folder.
    Raises: ValueError if the folder is not one of these, or fewer than three landmarks are found.
    """
    folder = Path(folder)
    align = read_placement(folder / SCAN_FILE)
    observations, _ = group_by_frame(load_photos(folder), keypoints)
    points, counts, _ = triangulate_robustly(jax.tree.map(lambda leaf: leaf[0], observations))
    points = align.inverse()(np.asarray(points, np.float64))
    names = keypoints.set.names
    found = {
        name: points[i] for i, name in enumerate(names) if counts[i] >= 2 and name in SCAN_LANDMARKS
    }
    if len(found) < 3:
        raise ValueError(
            f"{folder}: views agree on {len(found)} landmarks: expected at least three"
        )
    return found


def read_placement(file: Path) -> Similarity:
    """The similarity from a scan to the world of its images. Raises: FileError unless it is one."""
    with reading(file, "file of render_scan_views"):
        content = expect(read_json(file), dict, file, "")
        matrix = floats(required(content, PLACEMENT, file), file, PLACEMENT, (4, 4))
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
        rigid = (
            scale > 0
            and np.abs(matrix[:3, :3] @ matrix[:3, :3].T / scale**2 - np.eye(3)).max() < ROUNDING
        )
        if not rigid or (matrix[3] != (0, 0, 0, 1)).any():
            raise Refused(
                f"{PLACEMENT}: expected a rotation times a scale above 0, a translation, and 0"
                " 0 0 1"
            )
        return Similarity(scale, matrix[:3, :3] / scale, matrix[:3, 3])


def _into_world(vertices: Float[np.ndarray, "n 3"], up: str | None) -> Similarity:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if up is not None and up not in AXES:
        raise ArgumentError("up", f"{up}: expected one of {', '.join(AXES)}")
    sign, axis = AXES[up] if up else (1, int((high - low).argmax()))
    above = sign * np.eye(3)[axis]
    forward = np.eye(3)[2 if axis == 1 else (0 if axis == 2 else 1)]
    rotation = np.stack([np.cross(above, forward), above, forward])
    scale = HEIGHT / float((high - low).max())
    return Similarity(scale, rotation, -scale * rotation @ (low + high) / 2)


def _draw(
    vertices: Float[np.ndarray, "n 3"],
    faces: Int[np.ndarray, "f 3"],
    colors: Float[np.ndarray, "n 3"],
    cameras: Camera,
) -> Iterator[tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]]:
    """Images with their masks."""
    normals, corners = unit(face_crosses(vertices, faces)), jnp.asarray(faces, jnp.int32)
    number = lambda x: jnp.asarray(x, jnp.float32)
    for camera in cameras:
        fragments = rasterize_mesh(number(vertices), corners, camera)
        painted = np.asarray(
            interpolate_attributes(fragments, corners, number(colors), jnp.ones(3))
        )
        face = np.asarray(fragments.face_ids)
        facing = np.abs(normals @ np.asarray(camera.cam_from_world)[2, :3])
        shade = np.where(face >= 0, 0.45 + 0.55 * facing[np.maximum(face, 0)], 1.0)
        yield painted * shade[..., None], (face >= 0).astype(np.float32)


def _write(
    folder: Path, drawn: Iterable[tuple[np.ndarray, np.ndarray]], cameras: Camera, align: Similarity
) -> None:
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    listed = []
    for view, (image, mask) in enumerate(drawn):
        files = {kind: f"{kind}s/{view:03d}.png" for kind in ("image", "mask")}
        write_png(folder / files["image"], image)
        write_png(folder / files["mask"], mask)
        matrices = {
            key: np.asarray(getattr(cameras, key)[view], np.float64).tolist()
            for key in ("K", "cam_from_world")
        }
        listed.append({**files, "frame": 0, **matrices})
    write_description(folder, listed, "white")
    write_json(folder / SCAN_FILE, {PLACEMENT: align.matrix().tolist()}, indent=None)
