"""Splitting the long edges of a body, so that its vertices lie no further apart than a given length.

Modellers put few rings of vertices along arms and legs and many into faces and fingers. Gaussians hang on the vertices, and
where those are sparse they leave gaps; midpoints of long edges fill them. A midpoint takes the mean of its two ends in
everything that is linear (template, shape and pose directions, skinning weights), so it stays on the mesh in every shape.
"""

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.pytree import replace

SMALLEST_AREA = 1e-12
"""Metres^2: vertices without faces have no area."""
FINEST = 64
"""Edges are made at most this many times shorter: finer asks for billions of faces, and is a length in another unit."""


def split_long_edges(body: BodyModel, longest: float) -> BodyModel:
    """The body with edges of its template at most `longest` metres; the original vertices stay first, in their order.

    Faces are cut into two, three or four along the midpoints of their long edges, consistently on both sides. Texture
    coordinates and decimation order are dropped: they belong to the original mesh. `spacing` is the root of the area around a
    vertex over what it was: 1/2 where every edge has been halved.

    Raises: ValueError if `longest` is not positive, or less than 1/64 of the longest edge.
    """
    if not longest > 0:
        raise ValueError(f"longest edge: expected a positive length in metres, got {longest}")
    names = ("template", "shape_directions", "pose_directions", "skinning_weights")
    linear = {name: np.asarray(value) for name in names if (value := getattr(body, name)) is not None}
    faces = np.asarray(body.faces)
    linear["area"] = vertex_areas(linear["template"], faces)
    while True:
        edges, edge_of_side = _edges(faces)
        lengths = np.linalg.norm(linear["template"][edges[:, 0]] - linear["template"][edges[:, 1]], axis=-1)
        if lengths.max() > FINEST * longest:
            raise ValueError(
                f"longest edge: {longest} m is less than 1/{FINEST} of this body's longest, {lengths.max():.3g} m"
            )
        long = np.flatnonzero(lengths > longest)
        if len(long) == 0:
            break
        midpoint = np.full(len(edges), -1)
        midpoint[long] = len(linear["template"]) + np.arange(len(long))
        middle = {name: 0.5 * (x[edges[long, 0]] + x[edges[long, 1]]) for name, x in linear.items()}
        linear = {name: np.concatenate([x, middle[name].astype(x.dtype)]) for name, x in linear.items()}
        faces = _cut(faces, midpoint[edge_of_side])
    spacing = np.sqrt(vertex_areas(linear["template"], faces) / np.maximum(linear.pop("area"), SMALLEST_AREA))
    added = len(linear["template"]) - len(body.template)
    regressor = jnp.pad(body.joint_regressor, ((0, 0), (0, added)))  # joints follow the original vertices
    return replace(
        body,
        **{name: jnp.asarray(x) for name, x in linear.items()},
        faces=jnp.asarray(faces, body.faces.dtype),
        joint_regressor=regressor,
        spacing=jnp.asarray(spacing, body.template.dtype),
        uvs=None,
        uv_faces=None,
        collapse_order=None,
        collapse_into=None,
        made_for=None,
    )


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """A third of the area of the faces around each vertex (n, 3), metres^2."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    return np.bincount(faces.ravel(), np.repeat(areas / 3, 3), len(vertices))


def _edges(faces):
    """Undirected edges (e, 2), and which of them each side (corner i to i + 1) of each face is (f, 3)."""
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1)
    edges, index = np.unique(np.sort(sides.reshape(-1, 2), axis=-1), axis=0, return_inverse=True)
    return edges, index.reshape(faces.shape)


def _cut(faces, middles):
    """Faces cut at the midpoints of their sides; middles (f, 3): the vertex on side i to i + 1, -1 for none."""
    count = (middles >= 0).sum(1)
    parts = [faces[count == 0]]
    # turn each face until the pattern of its midpoints is the one that is written out below
    for sides, first in ((1, lambda m: m[:, 0] >= 0), (2, lambda m: m[:, 2] < 0), (3, lambda m: m[:, 0] >= 0)):
        for turn in range(3):
            chosen = count == sides
            m = np.roll(middles[chosen], -turn, axis=1)
            a, b, c = np.roll(faces[chosen], -turn, axis=1)[first(m)].T
            p, q, r = m[first(m)].T
            if sides == 1:
                parts += [np.stack([a, p, c], 1), np.stack([p, b, c], 1)]
            elif sides == 2:
                parts += [np.stack([p, b, q], 1), np.stack([a, p, q], 1), np.stack([a, q, c], 1)]
            elif turn == 0:
                parts += [np.stack(corners, 1) for corners in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    return np.concatenate(parts)
