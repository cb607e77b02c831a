"""A scan from a file: points of its outside, spread evenly, with the direction that is outwards at each.

Any format that trimesh reads; parts of a scene are put together where the scene has them. Of millions of faces a fixed number of
random points is used. Points that cannot be seen from outside (the inside of a mouth, skin under cloth,
lining) are left out, as a scanner would leave them out, whatever the mesh contains.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Bool, Float

VIEWS = 48
"""Directions that a point may be seen from."""
PER_CELL = 20
"""Points of the surface in a cell of the depth buffers, on average: then hardly any cell is empty by chance."""
BEHIND = 1.0
"""Cells that a point may lie behind the nearest one of its cell."""
OCCLUDERS = 5
"""As many points, for each that is kept, fill the cells: with 30,000 of a person, cells are a centimetre and a half wide."""
LEAST_FACES = 50
"""No surface of a person has fewer."""


@dataclasses.dataclass(frozen=True, eq=False)
class Scan:
    """Points of a scan in the file's own coordinates, float64.

    points: (p, 3). normals: (p, 3) unit, outwards. turned: whether the file's faces were inside out. hidden: share of the
    surface that was left out since nobody sees it.
    """

    points: Float[np.ndarray, "p 3"]
    normals: Float[np.ndarray, "p 3"]
    turned: bool
    hidden: float


def read_mesh(path: str | Path) -> Any:
    """A trimesh.Trimesh with all geometry of the file.

    Raises: ValueError, naming the file, if it cannot be read, has no faces or corners that are not finite.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: no such file: expected a mesh (OBJ, PLY, GLB, ...)")
    try:
        scene = trimesh.load_scene(path, process=False)  # processing would drop what is not finite in silence
    except Exception as error:  # every reader of trimesh has its own errors
        raise ValueError(f"{path}: not a mesh that can be read: {' '.join(str(error).split())}") from error
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise ValueError(f"{path}: no faces: expected a triangle mesh (a point cloud has to be meshed before)")
    mesh: Any = parts[0] if len(parts) == 1 else trimesh.util.concatenate(parts)
    bad = int((~np.isfinite(mesh.vertices[np.unique(mesh.faces)])).any(axis=1).sum())
    if bad:
        raise ValueError(f"{path}: {bad} corners of faces are not finite numbers: expected a clean mesh")
    if len(mesh.faces) < LEAST_FACES:
        raise ValueError(f"{path}: {len(mesh.faces)} faces: expected the surface of a person, at least {LEAST_FACES}")
    return mesh


def read_scan(path: str | Path, count: int = 30_000, seed: int = 0) -> Scan:
    """About `count` points of the outside of a mesh file. Raises: see `read_mesh`; ValueError if the surface has no area."""
    mesh = read_mesh(path)
    try:
        return sample_scan(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), count, seed)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def sample_scan(vertices: Float[np.ndarray, "n 3"], faces: np.ndarray, count: int = 30_000, seed: int = 0) -> Scan:
    """Random points of a surface, as many per area everywhere.

    Arguments: vertices (n, 3), faces (f, 3) counter-clockwise seen from outside; if all of them are clockwise this is noticed.
    Raises: ValueError if the surface has no area.
    """
    center = vertices[np.unique(faces)].mean(axis=0)
    corners = vertices[faces] - center
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    if not area.sum() > 0:
        raise ValueError("the faces have no area: expected a surface")
    rng = np.random.default_rng(seed)
    ends = np.cumsum(area)
    total = OCCLUDERS * count
    face = np.minimum(np.searchsorted(ends, rng.random(total) * ends[-1], side="right"), len(faces) - 1)
    a, b = rng.random((2, total))
    swap = a + b > 1
    a, b = np.where(swap, 1 - a, a), np.where(swap, 1 - b, b)
    weights = np.stack([1 - a - b, a, b], axis=1)
    points = np.einsum("pc,pca->pa", weights, corners[face])
    turned = bool(np.einsum("fa,fa->", corners[:, 0], across) < 0)  # six times the volume
    outside = np.flatnonzero(seen_from_outside(points, float(np.sqrt(PER_CELL * 0.5 * ends[-1] / total)))[:count])
    chosen = face[outside]
    normals = across[chosen] / area[chosen][:, None] * (-1 if turned else 1)
    return Scan(points[outside] + center, normals, turned, float(1 - len(outside) / count))


def seen_from_outside(points: Float[np.ndarray, "p 3"], cell: float) -> Bool[np.ndarray, " p"]:
    """Which of the points (p, 3) of a surface are the nearest ones from one of many directions, on a grid of cells."""
    seen = np.zeros(len(points), bool)
    for forward in directions_around(VIEWS):
        right = np.linalg.svd(forward[None])[2][1]
        x, y, depth = np.stack([right, np.cross(forward, right), forward]) @ points.T
        column, row = ((v - v.min()) / cell for v in (x, y))
        index = column.astype(int) * (int(row.max()) + 1) + row.astype(int)
        nearest = np.full(index.max() + 1, np.inf)
        np.minimum.at(nearest, index, depth)
        seen |= depth < nearest[index] + BEHIND * cell
    return seen


def directions_around(count: int) -> Float[np.ndarray, "d 3"]:
    """(d, 3) unit vectors, evenly spread over the sphere (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    y, turn = 1 - 2 * i / count, np.pi * (3 - np.sqrt(5)) * i
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=1)
