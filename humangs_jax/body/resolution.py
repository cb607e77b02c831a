"""Changes the resolution of bodies: long edges are split, or vertices are collapsed onto their
neighbours.

Modellers put few rings of vertices along arms and legs and many into faces and fingers. Gaussians
hang on the vertices, so they leave gaps where vertices are sparse. Midpoints of long edges fill
these gaps. A midpoint takes the mean of its two ends in everything that is linear (template, shape
and pose directions, skinning weights), so it stays on the mesh in every shape.

A half-edge collapse u -> v moves vertex u onto its neighbour v. The two triangles between them
vanish. What remains is a mesh on a subset of the vertices, which keep their positions, shape
directions and skinning weights. `collapse_sequence` orders all collapses once: `order[u]` is the
rank of u (0 stays longest), and `into[u]` is the vertex that u moves onto. Any size is then a table
look-up.

The cost of u -> v is |uv|^2 + FLATNESS q_u(v). Here q_u is the mean squared distance to the planes
that u has gathered (Garland and Heckbert, Surface Simplification Using Quadric Error Metrics). The
length spreads the vertices evenly over the skin, so that the crowded face and ears go before the
torso. The quadric keeps fingers round. Vertices that cannot be seen from outside go first.
"""

import heapq
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from scipy import sparse

from humangs_jax.body.expressions import Expressions
from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.mesh import (
    directions_around,
    face_crosses,
    in_front,
    mesh_edges,
    vertex_areas,
)

# Finer
# --------------------------------------------------------------------------------------------------


FINEST = 64
"""Edges are made at most this many times shorter. A smaller length would give billions of faces,
and is probably in another unit.
"""


def split_long_edges(body: BodyModel, longest: float) -> tuple[BodyModel, sparse.csr_array]:
    """Splits edges until all edges of the template are at most `longest` metres long.

    The original vertices stay first, in their order. Faces are cut into two, three or four along
    the midpoints of their long edges, consistently on both sides of an edge. Texture coordinates
    and decimation order are dropped, because they belong to the original mesh.
    `relative_vertex_spacing` is the square root of a ratio: the area around a vertex, divided by
    its original area. It is 1/2 where every edge has been halved.

    Returns: the finer body, and a matrix (finer, n). The matrix maps values at the n original
    vertices to the vertices of the finer body, for any quantity that is linear. A midpoint gets the
    mean of its ends.

    Raises: ValueError if `longest` is not positive, or less than 1/64 of the longest edge.
    """
    if not longest > 0:
        raise ValueError(f"longest edge: expected a positive length in metres, got {longest}")
    names = ("template", "shape_directions", "pose_directions", "skinning_weights")
    values = {name: getattr(body, name) for name in names}
    linear = {name: np.asarray(value) for name, value in values.items() if value is not None}
    faces = np.asarray(body.faces)
    moves = None
    if body.expressions is not None:
        moves = _Moves(body.expressions, len(body.template))
    linear["area"] = vertex_areas(linear["template"], faces)
    weights = sparse.eye_array(len(linear["template"]), format="csr")
    while True:
        edges, edge_of_side = mesh_edges(faces)
        lengths = np.linalg.norm(
            linear["template"][edges[:, 0]] - linear["template"][edges[:, 1]], axis=-1
        )
        if lengths.max() > FINEST * longest:
            raise ValueError(
                f"longest edge: {longest} m is less than 1/{FINEST} of this body's longest,"
                f" {lengths.max():.3g} m"
            )
        long = np.flatnonzero(lengths > longest)
        if len(long) == 0:
            break
        midpoint = np.full(len(edges), -1)
        midpoint[long] = len(linear["template"]) + np.arange(len(long))
        middle = {name: 0.5 * (x[edges[long, 0]] + x[edges[long, 1]]) for name, x in linear.items()}
        linear = {
            name: np.concatenate([x, middle[name].astype(x.dtype)]) for name, x in linear.items()
        }
        means = 0.5 * (weights[edges[long, 0]] + weights[edges[long, 1]])
        weights = sparse.vstack([weights, means], format="csr")
        faces = _cut(faces, midpoint[edge_of_side])
        if moves is not None:
            moves.split(edges[long])
    # vertices without faces have no area
    before = np.maximum(linear.pop("area"), 1e-12)
    spacing = np.sqrt(vertex_areas(linear["template"], faces) / before)
    added = len(linear["template"]) - len(body.template)
    # joints follow the original vertices
    regressor = from_host(np.pad(np.asarray(body.joint_regressor), ((0, 0), (0, added))))
    finer = replace(
        body,
        **{name: from_host(x) for name, x in linear.items()},
        faces=from_host(faces, body.faces.dtype),
        joint_regressor=regressor,
        relative_vertex_spacing=from_host(spacing, body.template.dtype),
        expressions=None if moves is None else moves.expressions(),
        uvs=None,
        uv_faces=None,
        collapse_order=None,
        collapse_into=None,
        remesh_key=None,
    )
    return finer, weights


class _Moves:
    """The expressions of a mesh whose edges are being split.

    `row` holds the row of each vertex in `directions`. Most vertices do not move; their row is the
    last one, which is zero.
    """

    def __init__(self, expressions: Expressions, vertices: int) -> None:
        self.of_body = expressions
        directions = np.asarray(expressions.directions)
        self.directions = np.concatenate([directions, np.zeros_like(directions[:1])])
        self.row = np.full(vertices, len(directions))
        self.row[np.asarray(expressions.vertices)] = np.arange(len(directions))

    def split(self, edges: Int[np.ndarray, "e 2"]) -> None:
        """Adds the midpoints of these edges (e, 2) to the vertices."""
        still = len(self.directions) - 1
        moves = (self.row[edges] < still).any(axis=1)
        middles = self.directions[self.row[edges[moves]]].mean(axis=1)
        self.directions = np.concatenate(
            [self.directions[:-1], middles.astype(self.directions.dtype), self.directions[-1:]]
        )
        row = np.where(self.row == still, still + len(middles), self.row)
        added = np.full(len(edges), still + len(middles))
        added[moves] = still + np.arange(len(middles))
        self.row = np.concatenate([row, added])

    def expressions(self) -> Expressions:
        """Returns the expressions of the mesh after all splits so far."""
        vertices = np.flatnonzero(self.row < len(self.directions) - 1)
        return replace(
            self.of_body,
            vertices=from_host(vertices, jnp.int32),
            directions=from_host(self.directions[self.row[vertices]]),
        )


def _kept_moves(
    expressions: Expressions | None, renumber: Int[np.ndarray, " n"]
) -> Expressions | None:
    """Returns the expressions of the vertices that stay, or None if there are no expressions.

    renumber: new number of each vertex, (n,), -1 for a vertex that goes.
    """
    if expressions is None:
        return None
    vertices = renumber[np.asarray(expressions.vertices)]
    stay = vertices >= 0
    return replace(
        expressions,
        vertices=from_host(vertices[stay], jnp.int32),
        directions=from_host(np.asarray(expressions.directions)[stay]),
    )


def _cut(
    faces: Int[np.ndarray, "f 3"], middles: Int[np.ndarray, "f 3"]
) -> Int[np.ndarray, "finer 3"]:
    """Returns the faces (finer, 3) after a cut at the midpoints of their sides.

    middles (f, 3): the midpoint of the side from corner i to corner i + 1, as the number of a
    vertex; -1 for a side that is not cut.
    """
    count = (middles >= 0).sum(1)
    parts = [faces[count == 0]]
    # turn each face until the pattern of its midpoints is the one that is written out below
    for sides in (1, 2, 3):
        for turn in range(3):
            chosen = count == sides
            m = np.roll(middles[chosen], -turn, axis=1)
            first = m[:, 2] < 0 if sides == 2 else m[:, 0] >= 0
            a, b, c = np.roll(faces[chosen], -turn, axis=1)[first].T
            p, q, r = m[first].T
            if sides == 1:
                parts += [np.stack([a, p, c], 1), np.stack([p, b, c], 1)]
            elif sides == 2:
                parts += [np.stack([p, b, q], 1), np.stack([a, p, q], 1), np.stack([a, q, c], 1)]
            elif turn == 0:
                parts += [
                    np.stack(corners, 1) for corners in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))
                ]
    return np.concatenate(parts)


# Coarser
# --------------------------------------------------------------------------------------------------


FLATNESS = 100.0
"""Weight of the squared distance to the surface: 1 mm off the surface costs as much as 1 cm of
edge.
"""
HIDDEN = 0.01
"""Factor on the cost of collapsing a vertex that cannot be seen from outside. With 0.01, its edges
count as if they were ten times shorter.
"""
RIM = 2
"""Hidden vertices in this number of rings around visible vertices are treated as visible, because
they hold lips and eyelids in place.
"""
VIEWS = 40
CELL = 0.004
"""Size of a depth-buffer cell, metres, for a body of a person's size. It decides how narrow a gap
may be through which vertices are still seen.
"""
RIDGE = 1e-13
"""Regularization of the normal equations, relative to their trace. Without it they are singular
where a shape direction moves nothing.
"""


def _surface_points(vertices: np.ndarray, faces: np.ndarray, spacing: float) -> np.ndarray:
    """Returns points on the faces, corners included, (p, 3). They are about `spacing` metres apart,
    or farther on faces whose longest side is over 40 times as long.
    """
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    # parts of a side, at most 40
    steps = np.clip(np.ceil(longest / spacing), 1, 40).astype(int)
    points = []
    for n in np.unique(steps):
        grid = np.array([(a, b, n - a - b) for a in range(n + 1) for b in range(n + 1 - a)]) / n
        points.append((grid @ corners[steps == n]).reshape(-1, 3))
    return np.concatenate(points)


def exposure(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the share of `VIEWS` parallel projections in which each vertex is visible, (n,), in
    [0, 1].
    """
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    cell = CELL * size / 2.5  # written for a person, whose T-pose has a diagonal of about 2.5 m
    points = _surface_points(vertices, faces, cell)
    directions = directions_around(VIEWS, turned=0.0)
    return np.mean(
        [in_front(vertices, points, forward, cell, 2 * cell) for forward in directions], axis=0
    )


class _Mesh:
    """A mesh while vertices collapse: the faces and neighbours of each vertex, and the sum of the
    plane quadrics that it has gathered.
    """

    def __init__(self, vertices, faces, uv_faces, importance):
        self.positions = vertices.tolist()
        self.faces = faces.tolist()
        if uv_faces is None:
            self.uv_faces = faces.tolist()
        else:
            self.uv_faces = uv_faces.tolist()
        self.importance = importance.tolist()
        self.around = [set() for _ in self.positions]
        self.beside = [set() for _ in self.positions]
        for index, face in enumerate(self.faces):
            for corner in face:
                self.around[corner].add(index)
                self.beside[corner].update(face)
        for vertex, ring in enumerate(self.beside):
            ring.discard(vertex)
        self.quadrics = _vertex_quadrics(vertices, faces).tolist()
        self.blocked = {}
        self.stamp = [0] * len(self.positions)

    def cost(self, u: int, v: int) -> float:
        (x, y, z), (a, b, c) = self.positions[v], self.positions[u]
        xx, xy, xz, xd, yy, yz, yd, zz, zd, dd, area = self.quadrics[u]
        squared = x * x * xx + y * y * yy + z * z * zz + dd
        squared += 2 * (x * y * xy + x * z * xz + y * z * yz + x * xd + y * yd + z * zd)
        length = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
        return self.importance[u] * (length + FLATNESS * max(squared, 0.0) / max(area, 1e-12))

    def between(self, u: int, v: int) -> list[int]:
        return [f for f in self.around[u] if v in self.faces[f]]

    def uv_moves(self, u: int, shared: list[int], v: int) -> dict[int, int] | None:
        """Returns, for each texture vertex of u, the texture vertex of v in the same chart. None if
        a chart at u does not reach v.

        shared: the faces between u and v.
        """
        moves = {self.uv_at(f, u): self.uv_at(f, v) for f in shared}
        if all(self.uv_at(f, u) in moves for f in self.around[u]):
            return moves
        return None

    def uv_at(self, face: int, vertex: int) -> int:
        return self.uv_faces[face][self.faces[face].index(vertex)]

    def allowed(self, u: int, v: int) -> bool:
        """Says whether the collapse u -> v keeps the topology and the texture charts, folds no
        face, and makes no face a needle.
        """
        # the topology: u and v share the corners of the faces between them and no others
        shared = self.between(u, v)
        common = self.beside[u] & self.beside[v]
        if len(common) != len(shared) or not 1 <= len(shared) <= 2:
            return False
        on_a_rim = len(self.around[u]) != len(self.beside[u])
        if on_a_rim and len(shared) != 1:  # it moves along the rim only
            return False
        if self.uv_moves(u, shared, v) is None:
            return False
        # each face that stays: it is no copy of another one, turns by at most acos(0.3) = 73
        # degrees, and its quality (1 is equilateral) falls below 0.08 only if it was worse
        around_v = {frozenset(self.faces[f]) for f in self.around[v]}
        for f in self.around[u]:
            if f in shared:
                continue
            a, b, c = (self.positions[i] for i in self.faces[f])
            after = [v if i == u else i for i in self.faces[f]]
            if frozenset(after) in around_v:
                return False
            p, q, r = (self.positions[i] for i in after)
            old, new = _normal(a, b, c), _normal(p, q, r)
            lengths = (_squared(old) * _squared(new)) ** 0.5
            if old[0] * new[0] + old[1] * new[1] + old[2] * new[2] <= 0.3 * lengths:
                return False
            if _quality(new, p, q, r) < min(0.08, _quality(old, a, b, c)):
                return False
        return True

    def collapse(self, u: int, v: int) -> None:
        shared = self.between(u, v)
        moves = self.uv_moves(u, shared, v)
        assert moves is not None  # `allowed` asks
        for f in shared:
            for corner in self.faces[f]:
                if corner != u:
                    self.around[corner].discard(f)
        for f in self.around[u].difference(shared):
            slot = self.faces[f].index(u)
            self.uv_faces[f][slot] = moves[self.uv_faces[f][slot]]
            self.faces[f][slot] = v
            self.around[v].add(f)
        for n in self.beside[u]:
            self.beside[n].discard(u)
            if n != v:
                self.beside[n].add(v)
                self.beside[v].add(n)
        self.around[u], self.beside[u] = set(), set()
        self.quadrics[v] = [a + b for a, b in zip(self.quadrics[u], self.quadrics[v], strict=True)]
        self.stamp[v] += 1


def _normal(
    a: Sequence[float], b: Sequence[float], c: Sequence[float]
) -> tuple[float, float, float]:
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return (uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx)


def _squared(x: Sequence[float]) -> float:
    return x[0] * x[0] + x[1] * x[1] + x[2] * x[2]


def _quality(
    normal: Sequence[float], a: Sequence[float], b: Sequence[float], c: Sequence[float]
) -> float:
    """Returns 4 sqrt(3) area / (sum of squared edges): 1 for an equilateral triangle."""
    lengths = sum((p[i] - q[i]) ** 2 for p, q in ((a, b), (b, c), (c, a)) for i in range(3))
    return 2 * 3**0.5 * _squared(normal) ** 0.5 / max(lengths, 1e-30)


def _vertex_quadrics(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "n 11"]:
    """Returns the quadrics of the vertices, (n, 11).

    Each is a sum over the faces of a vertex, weighted by twice the area. It holds the ten different
    entries of the outer product of the plane (normal, d) with itself, and the sum of the weights.
    """
    normal = face_crosses(vertices, faces)
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.maximum(area, 1e-30)
    plane = np.concatenate(
        [normal, -np.sum(normal * vertices[faces[:, 0]], axis=1, keepdims=True)], axis=1
    )
    rows, columns = np.triu_indices(4)
    terms = np.concatenate([plane[:, rows] * plane[:, columns], np.ones_like(area)], axis=1) * area
    quadrics = np.zeros((len(vertices), 11))
    for i in range(3):
        np.add.at(quadrics, faces[:, i], terms)
    return quadrics


def collapse_sequence(
    vertices: np.ndarray, faces: np.ndarray, uv_faces: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the rank of each vertex in the progressive decimation of a triangle mesh, and the
    vertex that each one moves onto.

    Arguments: vertices (n, 3) in metres; faces (f, 3); uv_faces (f, 3): texture vertices at the
    corners of the faces. Seams of the texture are kept closed. None: no texture.
    Returns: order, (n,), the rank of each vertex. 0 stays longest, n - 1 collapses first. into,
    (n,), the vertex that each vertex moves onto. A vertex that can never collapse has its own
    number.
    """
    # what is hidden costs less, but for a few rings beside what is seen
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    hidden = exposure(vertices, faces) == 0
    for _ in range(RIM):
        hidden[faces[~hidden[faces].all(axis=1)]] = False
    if uv_faces is not None:
        uv_faces = np.asarray(uv_faces)
    mesh = _Mesh(vertices, faces, uv_faces, np.where(hidden, HIDDEN, 1.0))
    # the cheapest collapse that is allowed; entries of a heap whose vertex has changed are skipped
    heap = [(mesh.cost(u, v), u, v, 0) for u, ring in enumerate(mesh.beside) for v in ring]
    heapq.heapify(heap)
    removed, into = [], np.arange(len(vertices))
    while heap:
        _, u, v, stamp = heapq.heappop(heap)
        if stamp != mesh.stamp[u] or v not in mesh.beside[u]:
            continue
        if not mesh.allowed(u, v):
            mesh.blocked.setdefault(u, set()).add(v)
            continue
        # the costs around v are others now
        ring = mesh.beside[u] - mesh.beside[v] - {v}
        mesh.collapse(u, v)
        removed.append(u)
        into[u] = v
        again = {(v, n) for n in mesh.beside[v]} | {(n, v) for n in ring}
        for n in mesh.beside[v]:  # what was forbidden here may be allowed now
            again.update((n, t) for t in mesh.blocked.pop(n, ()) if t in mesh.beside[n])
        for a, b in again:
            heapq.heappush(heap, (mesh.cost(a, b), a, b, mesh.stamp[a]))
    # the first that is removed comes last; those that never can be come first
    order = np.zeros(len(vertices), np.int64)
    order[removed] = len(vertices) - 1 - np.arange(len(removed))
    kept = np.setdiff1d(np.arange(len(vertices)), removed)
    order[kept] = np.arange(len(kept))
    return order, into


def _refit_regressor(body: BodyModel, target: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Returns a joint regressor (j, kept) for the kept vertices that gives the joints of the full
    body in every shape.

    The weights of a removed vertex move to the vertex that it ends on (`target`). Then the smallest
    change of the weights near a joint removes the remaining error. kept: numbers of the kept
    vertices.
    """
    regressor = np.asarray(body.joint_regressor, np.float64)
    moved = np.zeros_like(regressor)
    np.add.at(moved.T, target, regressor.T)
    moved = moved[:, kept]
    template = np.asarray(body.template, np.float64)
    directions = np.asarray(body.shape_directions, np.float64)
    # what a row of the regressor must reproduce: the template, every direction, and 1.
    full = np.concatenate(
        [template, directions.reshape(len(template), -1), np.ones((len(template), 1))], axis=1
    )
    error = regressor @ full - moved @ full[kept]
    joints = regressor @ template
    # vertices near a joint that share the correction: 200, or three per equation
    local = min(max(200, 3 * full.shape[1]), len(kept))
    for j in range(len(moved)):
        near = np.argpartition(np.linalg.norm(template[kept] - joints[j], axis=1), local - 1)[
            :local
        ]
        rows = full[kept[near]]
        gram = rows.T @ rows
        gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram)
        moved[j, near] += rows @ np.linalg.solve(gram, error[j])
    return moved


def _carry_uvs(
    body: BodyModel,
    faces: Int[np.ndarray, "f 3"],
    target: Int[np.ndarray, " n"],
    kept_faces: Bool[np.ndarray, " f"],
) -> tuple[Float[Array, "u 2"], Int[Array, "kept 3"]]:
    """Returns texture coordinates (u, 2) and texture faces (kept, 3) for the faces that remain.

    A corner whose vertex stays keeps its texture vertex. A corner that moved onto another vertex
    takes one of the texture vertices there, the nearest in the texture.
    """
    uvs, uv_faces = np.asarray(body.uvs), np.asarray(body.uv_faces)
    # (vertex, texture vertex)
    pairs = np.unique(faces.ravel().astype(np.int64) * len(uvs) + uv_faces.ravel())
    start = np.searchsorted(pairs, np.arange(len(target) + 1) * len(uvs))
    corners, corner_uvs = faces[kept_faces].ravel(), uv_faces[kept_faces].ravel()
    ends = target[corners]
    best, best_distance = corner_uvs.copy(), np.where(ends == corners, 0.0, np.inf)
    for i in range(int(np.diff(start).max())):
        valid = start[ends] + i < start[ends + 1]
        candidate = pairs[np.minimum(start[ends] + i, len(pairs) - 1)] % len(uvs)
        distance = np.where(valid, np.linalg.norm(uvs[candidate] - uvs[corner_uvs], axis=1), np.inf)
        nearer = distance < best_distance
        best, best_distance = np.where(nearer, candidate, best), np.minimum(distance, best_distance)
    used, renumbered = np.unique(best, return_inverse=True)
    return from_host(uvs[used]), from_host(renumbered.reshape(-1, 3), jnp.int32)


@checked_arguments
def decimate(body: BodyModel, vertex_count: int) -> BodyModel:
    """Returns a body with `vertex_count` of the body's vertices and the same joints in every shape.

    This runs in numpy on the host. It takes about 0.1 s if the body holds its collapse order (the
    shipped one does), and seconds to find the order otherwise. The result holds its collapse order.

    Raises: ValueError if `vertex_count` is not positive, or larger than the body's number of
    vertices, or so small that no allowed collapses lead to it.
    """
    return decimate_with_kept(body, vertex_count)[0]


def decimate_with_kept(
    body: BodyModel, vertex_count: int
) -> tuple[BodyModel, Int[np.ndarray, " kept"]]:
    """Returns the body of `decimate` and the numbers of the kept vertices in the full body,
    ascending.

    Raises: ValueError, as `decimate`.
    """
    # the collapses, which the body may carry
    total = body.template.shape[0]
    if not 0 < vertex_count <= total:
        raise ValueError(f"vertex_count {vertex_count}: body '{body.name}' has {total} vertices")
    if body.collapse_order is None or body.collapse_into is None:
        seams = None if body.uvs is None else np.asarray(body.uv_faces)
        template, faces = np.asarray(body.template), np.asarray(body.faces)
        order, into = collapse_sequence(template, faces, seams)
    else:
        order, into = np.asarray(body.collapse_order), np.asarray(body.collapse_into)
    smallest = int(np.sum(into == np.arange(total)))
    if vertex_count < smallest:
        raise ValueError(
            f"vertex_count {vertex_count}: body '{body.name}' can be reduced to {smallest} vertices"
            " at least"
        )
    stays = order < vertex_count
    kept = np.flatnonzero(stays)
    # for each vertex the kept one that it ends on
    target = np.where(stays, np.arange(total), into)
    while not stays[target].all():
        target = target[target]
    # faces whose corners are still three vertices
    renumber = np.full(total, -1)
    renumber[kept] = np.arange(vertex_count)
    faces = np.asarray(body.faces)
    ends = target[faces]
    solid = (ends != np.roll(ends, 1, axis=1)).all(axis=1)
    uvs, uv_faces = None, None
    if body.uvs is not None:
        uvs, uv_faces = _carry_uvs(body, faces, target, solid)
    dtype = body.template.dtype

    def rows(array):
        return from_host(np.asarray(array)[kept])  # by numpy: no compilation for each size

    coarse = replace(
        body,
        template=rows(body.template),
        shape_directions=rows(body.shape_directions),
        pose_directions=None if body.pose_directions is None else rows(body.pose_directions),
        joint_regressor=from_host(_refit_regressor(body, target, kept), dtype),
        skinning_weights=rows(body.skinning_weights),
        faces=from_host(renumber[ends[solid]], jnp.int32),
        expressions=_kept_moves(body.expressions, renumber),
        uvs=uvs,
        uv_faces=uv_faces,
        # of other vertices
        relative_vertex_spacing=None,
        texels=None,
        remesh_key=None,
        collapse_order=from_host(order[kept], jnp.int32),
        collapse_into=from_host(renumber[into[kept]], jnp.int32),
    )
    return coarse, kept
