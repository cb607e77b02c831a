"""Triangle surfaces on the host, convex silhouettes of body parts, and random functions.

Surfaces can be cut along a level set, smoothed, hemmed and joined, and tubes can be made. A
`Surface` carries the attributes of its vertices along: a garment that is cut out of the body keeps
its skinning weights, its cloth coordinates and the skin point below it. Lengths are in metres,
arrays are float32, and faces are counter-clockwise seen from outside.

`Boundaries` are the silhouettes of taut cloth around a part of the body. The part is cut across an
axis into slices. The silhouette of a slice is its radius around the slice's centre at `ANGLES`
angles. For slices across y, angle 0 is at +z and angles grow towards +x.

Random functions of position are sums of plane waves, which are cheap and band-limited, and lattice
noise, which is irregular.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.geometry.mesh import vertex_area_vectors
from humangs_jax.rendering.mesh.atlas import Faces, Points, edges_of, unit


def choice(rng: np.random.Generator, odds: Mapping[str, float | int]) -> str:
    """Draws one of the names, by their odds, which need not sum to 1."""
    shares = np.asarray(list(odds.values()), float)
    return str(rng.choice(list(odds), p=shares / shares.sum()))


class Ripples:
    """A random smooth function of points: a sum of plane waves whose wavelengths are near a given
    one, in metres.

    The values have a standard deviation of 0.7.
    """

    def __init__(self, rng: np.random.Generator, wavelength: float, waves: int = 6):
        direction = rng.normal(size=(3, waves))
        direction /= np.linalg.norm(direction, axis=0)
        scale = 2 * np.pi / wavelength * rng.uniform(0.6, 1.5, waves)
        self.k = (direction * scale).astype(np.float32)
        self.phase = rng.uniform(0, 2 * np.pi, waves).astype(np.float32)
        self.amplitude = np.float32(np.sqrt(2 / waves) * 0.7)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Returns the values (n,) at points (n, 3)."""
        return self.amplitude * np.sin(points.astype(np.float32) @ self.k + self.phase).sum(-1)


def ripples(rng: np.random.Generator, points: np.ndarray, wavelength: float) -> np.ndarray:
    """Draws new `Ripples` and returns their values (n,) at points (n, 3)."""
    return Ripples(rng, wavelength)(points)


class Folds:
    """A random function of points that describes creases of cloth.

    It has ridges in `directions` directions, each direction in patches at other places. All random
    numbers are drawn when the object is made. wavelength: about twice the distance between ridges,
    metres. upright: whether all ridges run roughly along y.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        wavelength: float = 0.09,
        directions: int = 6,
        upright: bool = False,
    ):
        low, high = (1.25, 1.57) if upright else (0.5, 1.5)
        tilt = rng.uniform(low, high, directions)
        turn = rng.uniform(0, 2 * np.pi, directions)
        k = np.stack([np.sin(tilt) * np.cos(turn), np.cos(tilt), np.sin(tilt) * np.sin(turn)], -1)
        self.directions = k.astype(np.float32)
        self.k = (k * (2 * np.pi / wavelength * rng.uniform(0.6, 1.4, (directions, 1)))).astype(
            np.float32
        )
        self.phase = rng.uniform(0, 2 * np.pi, directions).astype(np.float32)
        self.warp = Ripples(rng, 3 * wavelength)
        self.patches = [Ripples(rng, 4 * wavelength) for _ in range(directions)]

    def slope(self, points: np.ndarray) -> np.ndarray:
        """Returns slopes (n, 3) at points (n, 3): mostly below 1, and 0 between patches."""
        points = points.astype(np.float32)
        total, warp = np.zeros_like(points), 3.0 * self.warp(points)
        for k, direction, phase, patch in zip(
            self.k, self.directions, self.phase, self.patches, strict=True
        ):
            angle = points @ k + phase + warp
            crest = np.sin(angle)
            # of a ridge |sin| with a rounded top
            flank = np.cos(angle) * crest / np.sqrt(crest * crest + 0.15)
            total += (np.clip(patch(points) - 0.3, 0, 1) * flank)[:, None] * direction
        return total


def lattice(points: np.ndarray, seed: int) -> np.ndarray:
    """Returns value noise (n,) in [0, 1] at points (n, d), where d is 1, 2 or 3.

    Points of the integer lattice have random values, which are blended smoothly between them.
    """
    base = np.floor(points)
    t = (points - base).astype(np.float32)
    t = t * t * (3 - 2 * t)
    cell = base.astype(np.int64)
    total = np.zeros(len(points), np.float32)
    for corner in range(1 << points.shape[1]):
        bits = [(corner >> axis) & 1 for axis in range(points.shape[1])]
        weight = np.float32(1)
        for axis, bit in enumerate(bits):
            weight = weight * (t[:, axis] if bit else 1 - t[:, axis])
        total += weight * hashed(cell + np.asarray(bits), seed)
    return total


def hashed(cells: np.ndarray, seed: int) -> np.ndarray:
    """Returns a number in [0, 1) for each integer cell: cells (n, d) -> (n,).

    The numbers look uniformly random. Cell and seed decide them.
    """
    primes = np.asarray([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint64)[: cells.shape[1]]
    mixed = (cells.astype(np.uint64) * primes).sum(-1, dtype=np.uint64) + np.uint64(
        seed * 0x27D4EB2F & 0xFFFFFFFF
    )
    mixed = (mixed ^ (mixed >> np.uint64(15))) * np.uint64(0x2C1B3C6D) & np.uint64(0xFFFFFFFF)
    mixed = (mixed ^ (mixed >> np.uint64(12))) * np.uint64(0x297A2D39) & np.uint64(0xFFFFFFFF)
    return ((mixed ^ (mixed >> np.uint64(15))) & np.uint64(0xFFFFFF)).astype(
        np.float32
    ) / np.float32(1 << 24)


# Surfaces
# --------------------------------------------------------------------------------------------------


Field = Float[np.ndarray, " n"]
_Values = Float[np.ndarray, "n c"]


@dataclasses.dataclass(frozen=True)
class Surface:
    """A skinned mesh at rest, with values at its vertices."""

    vertices: Points
    """Vertices at rest, (n, 3), metres."""
    faces: Faces
    """Triangles, (f, 3)."""
    weights: Float[np.ndarray, "n j"]
    """Skinning weights, (n, j); rows sum to 1."""
    attributes: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)
    """Further values of the vertices, name -> (n, ...)."""

    @property
    def template(self) -> Points:
        """The template coordinates of the vertices (n, 3), see `anatomy`."""
        return self.attributes["template"]

    def moved(self, vertices: Points) -> "Surface":
        """Returns the surface with other positions of its vertices (n, 3)."""
        return dataclasses.replace(self, vertices=np.asarray(vertices, np.float32))

    def mapped(self, function: Callable[[np.ndarray], np.ndarray], faces: np.ndarray) -> "Surface":
        """Returns a surface with other faces. Its vertices, weights and attributes are those of
        this surface after `function` was applied to each array.
        """
        attributes = {name: function(value) for name, value in self.attributes.items()}
        return Surface(
            function(self.vertices), faces.astype(np.int32), function(self.weights), attributes
        )

    def with_attributes(self, **attributes: np.ndarray) -> "Surface":
        """Returns the surface with these attributes added, or replaced where the names exist."""
        return dataclasses.replace(self, attributes={**self.attributes, **attributes})

    def painted(self, template: Points, cloth: Points, girth: float) -> "Surface":
        """Returns the surface with the attributes `template`, (n, 3), and `cloth`, (n, 4).

        template, cloth: coordinates of the vertices, (n, 3) each. girth: the radius, metres, by
        which materials turn an angle around the part's axis into a length of cloth. It is appended
        to `cloth` as a fourth column, the same for all vertices.
        """
        cloth = np.concatenate([cloth, np.full((len(cloth), 1), girth)], 1).astype(np.float32)
        return self.with_attributes(template=np.asarray(template, np.float32), cloth=cloth)


def rigid(vertices: Points, faces: Faces, joint: int, joints: int) -> Surface:
    """Makes a surface whose vertices all follow one joint. joints: number of all joints."""
    weights = np.zeros((len(vertices), joints), np.float32)
    weights[:, joint] = 1
    return Surface(np.asarray(vertices, np.float32), faces, weights)


def vertex_normals(vertices: Points, faces: Faces) -> Points:
    """Returns the unit normals of vertices (n, 3): means of the normals of their faces, weighted by
    area.
    """
    return unit(vertex_area_vectors(vertices, faces).astype(np.float32))


def boundary_edges(faces: Faces) -> Int[np.ndarray, "e 2"]:
    """Returns the directed edges (e, 2) that only one face has. These edges are the hems."""
    edges = edges_of(faces).astype(np.int64)
    count = int(faces.max()) + 1
    keys = np.minimum(edges[:, 0], edges[:, 1]) * count + np.maximum(edges[:, 0], edges[:, 1])
    _, inverse, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return edges[uses[inverse] == 1].astype(np.int32)


def smooth(values: _Values, faces: Faces, iterations: int, keep_hems: bool = False) -> _Values:
    """Returns smoothed values of vertices (n, c). Each iteration moves a value halfway to the mean
    of its neighbours.

    keep_hems: whether vertices on the boundary only follow neighbours on the boundary, so that hems
    stay crisp.
    """
    count = len(values)
    edges = edges_of(faces)
    source = np.concatenate([edges[:, 0], edges[:, 1]])
    target = np.concatenate([edges[:, 1], edges[:, 0]])
    if keep_hems:
        hems = boundary_edges(faces)
        inner = ~np.isin(target, hems)
        source = np.concatenate([source[inner], hems[:, 0], hems[:, 1]])
        target = np.concatenate([target[inner], hems[:, 1], hems[:, 0]])
    neighbours = np.bincount(target, minlength=count)
    lonely = neighbours == 0
    neighbours = np.maximum(neighbours, 1).astype(np.float32)[:, None]
    for _ in range(iterations):
        # sums of the neighbours, one column after the other
        sums = [np.bincount(target, weights=column, minlength=count) for column in values[source].T]
        mean = np.stack(sums, axis=1).astype(np.float32) / neighbours
        mean[lonely] = values[lonely]
        values = values + 0.5 * (mean - values)
    return values.astype(np.float32)


def compact(surface: Surface, face_mask: Bool[np.ndarray, " f"]) -> Surface:
    """Returns the surface with only the faces for which a mask (f,) is true, and only the vertices
    of these faces.
    """
    faces = surface.faces[face_mask]
    used = np.zeros(len(surface.vertices), bool)
    used[faces] = True
    return surface.mapped(lambda values: values[used], (np.cumsum(used) - 1)[faces])


def cut(surface: Surface, field: Field) -> Surface:
    """Returns the part of a surface where a field is positive, cut exactly along its zero line.

    field: one number for each vertex (n,), linear between vertices.
    """
    field = np.where(np.abs(field) < 1e-6, 1e-6, field).astype(np.float32)
    inside = field > 0
    count = inside[surface.faces].sum(1)
    whole, mixed = surface.faces[count == 3], surface.faces[(count == 1) | (count == 2)]
    if len(mixed) == 0:
        return compact(surface, count == 3)
    # turn each mixed face so that its odd corner (alone on its side) comes first
    sides = inside[mixed]
    base = sides.sum(1) != 1
    odd = np.argmax(sides != base[:, None], axis=1)
    a, b, c = mixed[np.arange(len(mixed))[:, None], (odd[:, None] + np.arange(3)) % 3].T
    cuts = np.sort(np.concatenate([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=1)
    pairs, inverse = np.unique(cuts, axis=0, return_inverse=True)
    on_ab, on_ac = np.split((inverse.reshape(-1) + len(surface.vertices)).astype(np.int32), 2)
    kept_tip = np.stack([a, on_ab, on_ac], 1)[~base]
    kept_base = np.concatenate(
        [np.stack([on_ab, b, c], 1)[base], np.stack([on_ab, c, on_ac], 1)[base]]
    )
    f0, f1 = field[pairs[:, 0]], field[pairs[:, 1]]
    t = (f0 / (f0 - f1)).astype(np.float32)

    def extended(values):
        at = t.reshape(-1, *([1] * (values.ndim - 1)))
        between = values[pairs[:, 0]] * (1 - at) + values[pairs[:, 1]] * at
        return np.concatenate([values, between.astype(values.dtype)])

    grown = surface.mapped(extended, np.concatenate([whole, kept_tip, kept_base]))
    return compact(grown, np.ones(len(grown.faces), bool))


def join(surfaces: list[Surface]) -> Surface:
    """Joins surfaces into one. Only attributes that all surfaces have are kept."""
    offsets = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    names = set.intersection(*(set(s.attributes) for s in surfaces))
    return Surface(
        np.concatenate([s.vertices for s in surfaces]),
        np.concatenate(
            [s.faces + offset for s, offset in zip(surfaces, offsets, strict=True)]
        ).astype(np.int32),
        np.concatenate([s.weights for s in surfaces]),
        {name: np.concatenate([s.attributes[name] for s in surfaces]) for name in names},
    )


def turn_in_hems(surface: Surface, depth: float) -> Surface:
    """Returns the surface with a strip along every boundary. The strip is folded inwards, so that
    cloth looks thick.

    depth: metres by which the strip goes against the normal.
    """
    hems = boundary_edges(surface.faces)
    if len(hems) == 0:
        return surface
    rim, local = np.unique(hems, return_inverse=True)
    local = local.reshape(-1, 2) + len(surface.vertices)
    inner = surface.vertices[rim] - depth * vertex_normals(surface.vertices, surface.faces)[rim]
    (a, b), (c, d) = hems.T, local.T
    faces = np.concatenate([surface.faces, np.stack([b, a, c], 1), np.stack([b, c, d], 1)])
    grown = surface.mapped(lambda values: np.concatenate([values, values[rim]]), faces)
    return grown.moved(np.concatenate([surface.vertices, inner]))


def grid_faces(rows: int, columns: int, closed: bool) -> Faces:
    """Returns the triangles of a grid of vertices, which are numbered row by row.

    Triangles are counter-clockwise seen from where columns run to the right and rows run down.
    closed: whether the last column is joined to the first.
    """
    gaps = columns if closed else columns - 1
    row, column = np.meshgrid(np.arange(rows - 1), np.arange(gaps), indexing="ij")
    right = (column + 1) % columns
    a, b = row * columns + column, row * columns + right
    c, d = (row + 1) * columns + column, (row + 1) * columns + right
    return (
        np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
        .reshape(-1, 3)
        .astype(np.int32)
    )


def ball(rows: int, columns: int) -> tuple[Points, Faces]:
    """Makes the vertices and faces of a unit ball.

    Vertices lie on a grid of polar angles from +y (rows) and azimuths from +z (columns).
    """
    down, azimuth, faces = tube(
        np.linspace(0, np.pi, rows), np.arange(columns) * 2 * np.pi / columns
    )
    return around(np.sin(down), azimuth, np.cos(down)), faces


def tube(
    levels: Float[np.ndarray, " r"], angles: Float[np.ndarray, " c"]
) -> tuple[Field, Field, Faces]:
    """Makes a tube. Returns the level (n,) and the angle (n,) of each vertex, row by row, and the
    faces.
    """
    faces = grid_faces(len(levels), len(angles), closed=True)
    return np.repeat(levels, len(angles)), np.tile(angles, len(levels)), faces


def sweep(
    path: np.ndarray,
    across: np.ndarray,
    widths: np.ndarray | float,
    columns: int = 10,
    closed: bool = False,
) -> tuple[Points, Faces]:
    """Makes a tube of elliptic sections along a path (m, 3).

    across: direction of the first half axis of a section, (3,) or (m, 3); it is made normal to the
    path. widths: half axes in metres: one number, or (m, 1) or (m, 2). columns: number of vertices
    of a section. closed: whether the path's end joins its start; otherwise both ends are open.
    Widths that shrink to 0 close an end.

    Returns: vertices (m columns, 3) and faces.
    """
    if closed:
        along = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    else:
        along = np.gradient(path, axis=0)
    tangent = unit(along)
    first = unit(across - np.sum(across * tangent, -1, keepdims=True) * tangent)
    second, widths = np.cross(tangent, first), np.broadcast_to(widths, (len(path), 2))
    c, s = np.cos(circle(columns))[None, :, None], np.sin(circle(columns))[None, :, None]
    ring = c * (widths[:, :1] * first)[:, None] + s * (widths[:, 1:] * second)[:, None]
    vertices = (path[:, None] + ring).reshape(-1, 3).astype(np.float32)
    rows = len(path) + closed
    faces = grid_faces(rows, columns, closed=True) % len(vertices)
    return vertices, np.ascontiguousarray(faces[:, ::-1])


def circle(count: int) -> Field:
    """Returns evenly spaced angles all around, from 0 on, (count,), radians."""
    return np.arange(count) * (2 * np.pi / count)


def around(
    radius: Field | float | int, angle: Field, height: Field, center: np.ndarray | tuple = (0, 0)
) -> Points:
    """Returns points (n, 3) around the vertical axis through center (x, z).

    radius: distances from the axis, one or (n,). angle: from +z towards +x, radians, (n,). height:
    y of the points (n,).
    """
    return np.stack(
        [center[0] + radius * np.sin(angle), height, center[1] + radius * np.cos(angle)], -1
    )


ANGLES = 48
"""Number of directions of a silhouette."""
_EMPTY = 1e-3
"""Radius of a slice without points, metres."""
_GRID = circle(ANGLES)
_TURN = np.cos(_GRID[:, None] - _GRID[None, :])
_INVERSE = np.where(_TURN > 0.1, 1 / np.maximum(_TURN, 0.1), np.inf)
"""1 / cos(a - b) for each pair of the angles a and b of a silhouette, (ANGLES, ANGLES); infinite
where the cosine is at most 0.1. Let support(b) be the largest extent of the points in direction b.
The radius of a convex silhouette at a is then the least support(b) / cos(a - b) over all b.
"""


@dataclasses.dataclass(frozen=True)
class Boundaries:
    """Silhouettes of a part of the body, in slices along an axis. All lengths are in metres."""

    levels: np.ndarray
    """Positions of the slices along the axis, (l,), increasing."""
    centers: np.ndarray
    """Centres of the slices, across the axis, (l, 2)."""
    radii: np.ndarray
    """Distance of each silhouette from its centre in each direction, (l, ANGLES)."""

    def center(self, level: np.ndarray) -> np.ndarray:
        """Returns the centres (n, 2) of slices at positions along the axis (n,), interpolated."""
        return np.stack(
            [np.interp(level, self.levels, self.centers[:, i]) for i in range(2)], -1
        ).astype(np.float32)

    def radius(self, level: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Returns radii (n,) at positions along the axis (n,) and angles around it (n,), radians.
        They are interpolated.
        """
        t = np.clip(
            np.interp(level, self.levels, np.arange(len(self.levels))), 0, len(self.levels) - 1.001
        )
        a = (angle / (2 * np.pi) * ANGLES) % ANGLES
        i, k = t.astype(int), a.astype(int) % ANGLES
        u, w, k1 = t - i, a - np.floor(a), (k + 1) % ANGLES
        low, high = (self.radii[row, k] * (1 - w) + self.radii[row, k1] * w for row in (i, i + 1))
        return (low * (1 - u) + high * u).astype(np.float32)


def polar(across: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the angles (n,), radians, and radii (n,) of points around centres.

    across: (x, z) of the points, (n, 2). center: (n, 2).
    """
    d = across - center
    return np.arctan2(d[:, 0], d[:, 1]), np.sqrt(np.sum(d * d, -1))


def boundaries(
    along: Field, across: np.ndarray, levels: np.ndarray, centers: np.ndarray | None, window: float
) -> Boundaries:
    """Measures the convex silhouettes of points in slices along an axis.

    along: positions of the points on the axis (n,). across: the points' other two coordinates (n,
    2). levels: positions of the slices, increasing (l,). centers: of the slices (l, 2). None: the
    middle of each slice. window: half of the thickness of a slice, metres.
    """
    directions = np.stack([np.sin(_GRID), np.cos(_GRID)])
    support = np.full((len(levels), ANGLES), _EMPTY)
    if centers is None:
        found = np.zeros((len(levels), 2))
    else:
        found = np.asarray(centers, float)
    order = np.argsort(along, kind="stable")
    along, across = along[order], across[order]
    starts, ends = np.searchsorted(along, levels - window), np.searchsorted(along, levels + window)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        if end <= start:
            if centers is None and i:
                found[i] = found[i - 1]
            continue
        points = across[start:end]
        if centers is None:
            found[i] = 0.5 * (points.min(0) + points.max(0))
        support[i] = np.maximum(((points - found[i]) @ directions).max(0), _EMPTY)
    radii = np.min(support[:, None, :] * _INVERSE[None], axis=-1)
    return Boundaries(levels, found, radii)


def blurred(shape: Boundaries, times: int = 1) -> Boundaries:
    """Returns silhouettes whose radii are averaged over neighbouring slices and angles. times: how
    often they are averaged.
    """
    radii = shape.radii
    for _ in range(times):
        padded = np.concatenate([radii[:1], radii, radii[-1:]])
        radii = 0.25 * padded[:-2] + 0.5 * padded[1:-1] + 0.25 * padded[2:]
        radii = 0.25 * np.roll(radii, 1, 1) + 0.5 * radii + 0.25 * np.roll(radii, -1, 1)
    return dataclasses.replace(shape, radii=radii)


def hanging(shape: Boundaries, slope: float) -> Boundaries:
    """Returns silhouettes of cloth that hangs from the wider slices above.

    Downwards a radius shrinks by at most `slope` metres per metre.
    """
    radii = shape.radii.copy()
    for i in range(len(radii) - 2, -1, -1):
        radii[i] = np.maximum(
            radii[i], radii[i + 1] - slope * abs(shape.levels[i] - shape.levels[i + 1])
        )
    return dataclasses.replace(shape, radii=radii)
