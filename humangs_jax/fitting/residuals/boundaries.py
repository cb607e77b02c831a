"""Silhouettes in images: of a posed body, by the edges at which its surface turns away from the camera, and of a mask.

A body's silhouette is exact to rounding. It consists of mesh edges between a face that looks at the camera and one that looks
away (Sander et al. 2000, "Silhouette clipping"), as far as the image shows no body outside of them. Its points lie on edges, so
they are known functions of the pose. A mask's silhouette is where its coverage crosses one half.

NumPy on the host: silhouettes are held fixed while a solver moves the body.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.position_map import vertex_normals
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

PROBE = 1.5
"""Pixels outside of a silhouette at which there must be no body."""
NEAREST_EDGE = 0.05
"""Metres: edges of faces nearer to the camera than this, or behind it, are no silhouette."""
BORDER = 1.0
"""Pixels from the image border within which nothing is a silhouette: the image ends there, not the person."""
SPECK = 0.03
"""Contours shorter than this share of a mask's longest are noise."""
SMOOTHING = 1.5
"""Pixels: standard deviation of the blur whose gradient is a mask's normal."""


@dataclasses.dataclass(frozen=True, eq=False)
class MeshEdges:
    """Edges of a triangle mesh. ends: (e, 2) vertices. faces: (e, 2) on both sides, -1: none."""

    ends: Int[np.ndarray, "e 2"]
    faces: Int[np.ndarray, "e 2"]


@dataclasses.dataclass(frozen=True, eq=False)
class BodyView:
    """A posed body as a camera sees it. pixels: (n, 2) and depths: (n,) of its vertices. normals: (n, 2) of the surface at the
    vertices as unit directions in the image. covered: (h, w).
    """

    pixels: Float[np.ndarray, "n 2"]
    depths: Float[np.ndarray, " n"]
    normals: Float[np.ndarray, "n 2"]
    covered: Bool[np.ndarray, "h w"]


@dataclasses.dataclass(frozen=True, eq=False)
class Boundary:
    """Points of a silhouette, evenly spread over it. positions: (p, 2) pixels. normals: (p, 2) unit, outwards.

    ends: (p, 2), shares: (p,): for a body, the vertices of each point's edge and its position between them in [0, 1].
    A silhouette may be empty.
    """

    positions: Float[np.ndarray, "p 2"]
    normals: Float[np.ndarray, "p 2"]
    ends: Int[np.ndarray, "p 2"] | None = None
    shares: Float[np.ndarray, " p"] | None = None


def mesh_edges(faces: Int[np.ndarray, "f 3"]) -> MeshEdges:
    """All edges of a mesh; of more than two faces that share an edge, two are kept."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    ends, edge = np.unique(sides, axis=0, return_inverse=True)
    edge, owner = edge.reshape(-1), np.repeat(np.arange(len(faces)), 3)
    beside = np.full((len(ends), 2), -1)
    beside[edge, 0] = owner  # the last of an edge's faces; then the first
    beside[edge[::-1], 1] = owner[::-1]
    beside[beside[:, 0] == beside[:, 1], 1] = -1
    return MeshEdges(ends, beside)


def view_body(vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"], camera: Camera) -> BodyView:
    """Project and rasterize a posed body."""
    return BodyView(*(np.asarray(x) for x in _look(vertices, faces, camera)))


@jax.jit
def _look(vertices, faces, camera):
    rotation, focal = camera.cam_from_world[:3, :3], jnp.stack([camera.K[0, 0], camera.K[1, 1]])
    seen = transform.apply(camera.cam_from_world, vertices)
    depths = seen[:, 2]
    pixels = seen[:, :2] / jnp.where(depths > NEAREST_EDGE, depths, 1.0)[:, None] * focal + camera.K[:2, 2]
    # a plane through the camera with normal n is the line n . (x / fx, y / fy, 1) = 0 of the image
    normals = jnp.matmul(vertex_normals(vertices, faces), rotation.T, precision=transform.EXACT)[:, :2] / focal
    normals = normals / jnp.maximum(jnp.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return pixels, depths, normals, rasterize_mesh(vertices, faces, camera).face_ids >= 0


def body_boundary(view: BodyView, faces: Int[np.ndarray, "f 3"], edges: MeshEdges, count: int) -> Boundary:
    """`count` points of the body's silhouette, or none if the image shows none."""
    corners = view.pixels[faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    towards = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] > 0
    before = (view.depths > NEAREST_EDGE)[faces].all(axis=1)
    first, second = edges.faces.T
    turns = (towards[first] != towards[second]) | (second < 0)
    chosen = np.flatnonzero(turns & before[first] & (before[second] | (second < 0)))
    ends = edges.ends[chosen]
    normals = _unit(view.normals[ends].sum(axis=1))
    middles = view.pixels[ends].mean(axis=1)
    outside = ~_covered(view.covered, middles + PROBE * normals) & inside_image(middles, view.covered.shape)
    ends, normals = ends[outside], normals[outside]
    lengths = np.linalg.norm(view.pixels[ends[:, 1]] - view.pixels[ends[:, 0]], axis=1)
    edge, shares = _spread(lengths, count)
    ends, shares = ends[edge], shares.astype(np.float32)
    positions = view.pixels[ends[:, 0]] * (1 - shares[:, None]) + view.pixels[ends[:, 1]] * shares[:, None]
    return Boundary(positions, normals[edge], ends, shares)


def mask_boundary(mask: Float[np.ndarray, "h w"], count: int) -> Boundary:
    """`count` points where coverage crosses one half, or none. The image border is no silhouette."""
    from skimage.filters import gaussian
    from skimage.measure import find_contours

    contours = [contour[:, ::-1] + 0.5 for contour in find_contours(mask, 0.5)]  # rows, columns of centres -> pixels
    steps = [np.linalg.norm(np.diff(contour, axis=0), axis=1) for contour in contours]
    longest = max((step.sum() for step in steps), default=0.0)
    kept = [i for i, step in enumerate(steps) if step.sum() >= SPECK * longest]
    none = np.zeros((0, 2))
    starts = np.concatenate([none, *(contours[i][:-1] for i in kept)])
    ends = np.concatenate([none, *(contours[i][1:] for i in kept)])
    lengths = np.linalg.norm(ends - starts, axis=1) * inside_image(starts, mask.shape) * inside_image(ends, mask.shape)
    segment, shares = _spread(lengths, count)
    positions = starts[segment] + shares[:, None] * (ends - starts)[segment]
    down, right = np.gradient(gaussian(mask, SMOOTHING, mode="nearest"))
    column, row = np.floor(positions).astype(int).T
    return Boundary(positions.astype(np.float32), _unit(-np.stack([right[row, column], down[row, column]], axis=-1)))


def inside_image(positions: Float[np.ndarray, "*p 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "*p"]:
    """Which positions are further than `BORDER` inside of an image of (height, width)."""
    size = np.asarray([shape[1], shape[0]])
    return np.all((positions > BORDER) & (positions < size - BORDER), axis=-1)


def _covered(covered, positions):
    column, row = np.floor(positions).astype(int).T
    height, width = covered.shape
    return covered[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]


def _spread(lengths, count):
    """Points evenly along pieces of a line: (count,) the piece of each and its position there in [0, 1]; none without length."""
    ends = np.cumsum(lengths)
    if len(ends) == 0 or ends[-1] <= 0:
        return np.zeros(0, int), np.zeros(0)
    places = (np.arange(count) + 0.5) / count * ends[-1]
    piece = np.searchsorted(ends, places)
    return piece, 1 - (ends[piece] - places) / lengths[piece]


def _unit(vectors):
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
