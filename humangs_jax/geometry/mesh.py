"""Computes areas, normals and edges of triangle meshes, and directions, on the host with numpy."""

import numpy as np

from humangs_jax.core.array_types import Bool, Float, Int


def face_crosses(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "f 3"]:
    """Returns the normals of the faces, (f, 3), each with twice the face's area as its length. They
    point outwards if corners go round counter-clockwise, seen from outside.
    """
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def face_areas(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " f"]:
    """Returns the areas of the faces, (f,), in the unit of the vertices squared."""
    return 0.5 * np.linalg.norm(face_crosses(vertices, faces), axis=-1)


def vertex_areas(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, " n"]:
    """Returns a third of the summed area of the faces around each vertex, (n,), in the unit of the
    vertices squared.
    """
    return np.bincount(faces.ravel(), np.repeat(face_areas(vertices, faces) / 3, 3), len(vertices))


def vertex_area_vectors(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "n 3"]:
    """Returns the sum of `face_crosses` of the faces around each vertex, (n, 3); 0 where there is
    no face. `unit` makes normals of these sums.
    """
    around = np.tile(face_crosses(vertices, faces), (3, 1))
    return np.stack(
        [np.bincount(faces.T.ravel(), around[:, i], len(vertices)) for i in range(3)], axis=-1
    )


def mesh_edges(
    faces: Int[np.ndarray, "f 3"],
) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, "f 3"]]:
    """Returns the undirected edges of a mesh, (e, 2), and for the three sides of each face the
    numbers of their edges, (f, 3). Side i goes from corner i to corner i + 1.
    """
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)
    edges, index = np.unique(np.sort(sides.reshape(-1, 2), axis=-1), axis=0, return_inverse=True)
    return edges, index.reshape(faces.shape)


def unit(vectors: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n d"]:
    """Returns vectors divided by their lengths, or by 1e-12 if they are shorter. Zero vectors stay
    zero.
    """
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)


def directions_around(count: int, turned: float = 0.5) -> Float[np.ndarray, "d 3"]:
    """Returns unit vectors spread evenly over the sphere (a Fibonacci lattice), (d, 3), from +y to
    -y. Their angle around y grows by the golden angle from each to the next.

    turned: the angle of the first one around y, in golden angles.
    """
    i = np.arange(count)
    y, turn = 1 - 2 * (i + 0.5) / count, np.pi * (3 - np.sqrt(5)) * (i + turned)
    radius = np.sqrt(1 - y * y)
    return np.stack([radius * np.cos(turn), y, radius * np.sin(turn)], axis=1)


def in_front(
    some: Float[np.ndarray, "q 3"],
    points: Float[np.ndarray, "p 3"],
    forward: Float[np.ndarray, "3"],
    cell: float,
    behind: float,
) -> Bool[np.ndarray, " q"]:
    """Says which of the points `some`, (q, 3), are the foremost ones, seen along `forward`.

    The plane perpendicular to `forward` is divided into square cells with sides of length `cell`. A
    point is compared with the nearest of `points`, (p, 3), in its cell, where near means a small
    coordinate along `forward`. The point is foremost if it is less than `behind` farther away, or
    if the cell has none of `points`. forward: a unit vector. All lengths are in one unit.
    """
    right = np.linalg.svd(forward[None])[2][1]
    frame = np.stack([right, np.cross(forward, right), forward])
    own, others = (frame @ vectors.T for vectors in (some, points))
    low = np.minimum(own[:2].min(axis=1), others[:2].min(axis=1))

    def cells(placed):
        return ((placed[:2] - low[:, None]) / cell).astype(int)

    (column, row), (columns, rows) = cells(own), cells(others)
    height = 1 + max(row.max(), rows.max())
    nearest = np.full((1 + max(column.max(), columns.max())) * height, np.inf)
    np.minimum.at(nearest, columns * height + rows, others[2])
    return own[2] < nearest[column * height + row] + behind


def smallest_turns(
    a: Float[np.ndarray, "*#n 3"], b: Float[np.ndarray, "*#n 3"], opposite: float = 1e-6
) -> Float[np.ndarray, "*n 3 3"]:
    """Returns the rotation matrices that turn unit vectors a into b by the smallest angle, (..., 3,
    3). Where a or b is zero, the matrix is the identity.

    Where 1 + a.b is less than `opposite`, the matrix is a half turn about an axis that is
    perpendicular to a.
    """
    from scipy.spatial.transform import Rotation

    a, b = np.broadcast_arrays(a, b)
    real = 0.5 * np.sum((a + b) ** 2, axis=-1, keepdims=True)  # 1 + a.b without cancellation
    real = np.where(
        (a == 0).all(axis=-1, keepdims=True) | (b == 0).all(axis=-1, keepdims=True), 1.0, real
    )
    side = unit(np.cross(a, np.where(np.abs(a[..., :1]) < 0.9, [1.0, 0, 0], [0, 1.0, 0])))
    half = np.concatenate([side, np.zeros_like(real)], axis=-1)
    turn = np.where(real < opposite, half, np.concatenate([np.cross(a, b), real], axis=-1))
    return Rotation.from_quat(turn.reshape(-1, 4)).as_matrix().reshape(*a.shape, 3)
