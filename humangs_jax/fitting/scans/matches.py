"""Pairs of scan points and body vertices: nearest ones with like normals, looked for from either side.

By k-d trees of positions and normals: a difference between normals counts like some centimetres, so that a sleeve is not paired
with the waist behind it. Pairs that are far apart, or do not look the same way, have no weight; others fade with distance.
"""

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.fitting.scans.body_surface import pose_surface
from humangs_jax.fitting.scans.objective import Matches, ScanProblem, ScanState, Tolerances, scale_of
from humangs_jax.fitting.scans.reading import Scan
from humangs_jax.fitting.scans.similarity import Similarity

LIKE = 0.3
"""Cosine between normals below which two points are no pair."""


class Target:
    """A scan in a frame about as large as a person in metres, ready to be searched.

    align: to the frame. count: how many points, and body vertices, look for partners. effective: weight of all of them together.
    normal: metres that a difference of 1 between normals counts like.
    """

    def __init__(self, scan: Scan, align: Similarity, count: int, effective: float, normal: float) -> None:
        self.points, self.normals = align(scan.points), scan.normals @ align.rotation.T
        self.count, self.effective = min(count, len(self.points)), effective
        self.normal = normal
        self.tree = _tree(self.points, normal * self.normals)

    def matches(
        self, problem: ScanProblem, state: ScanState, gate: float, cut: float, tolerances: Tolerances
    ) -> Matches:
        """The pairs of a body as it is: first those that scan points found, `count` of them, then those that vertices found.

        Arguments: gate: pairs that are farther apart, in units of the frame, have no weight. cut: distance along the normal at
        which weights have fallen to a quarter.
        """
        vertices, normals = self._posed(problem, state)
        looking = np.flatnonzero(np.asarray(problem.surface.order) < self.count)
        of_body = _nearest(self.tree, vertices[looking], self.normal * normals[looking])
        some, like = self.points[: self.count], self.normals[: self.count]
        of_scan = _nearest(_tree(vertices, self.normal * normals), some, self.normal * like)
        rows = np.concatenate([of_scan, looking])
        points = np.concatenate([some, self.points[of_body]])
        facing = np.concatenate([normals[of_scan], self.normals[of_body]])
        other = np.concatenate([like, normals[looking]])
        apart = points - vertices[rows]
        good = (np.einsum("ra,ra->r", facing, other) > LIKE) & (np.linalg.norm(apart, axis=1) < gate)
        away = np.einsum("ra,ra->r", facing, apart)
        robust = np.square(1 / (1 + np.square(away / cut)))  # Geman and McClure's loss, as weights
        inside, outside = float(tolerances.inside), float(tolerances.outside)
        covered = np.asarray(problem.surface.covered)[rows]
        number = lambda x: jnp.asarray(x, jnp.float32)
        return Matches(
            rows=jnp.asarray(rows, jnp.int32),
            points=number(points),
            normals=number(facing),
            outside=number(inside + (outside - inside) * covered),
            weights=number(good * robust * (self.effective / len(rows))),
        )

    def distances(self, problem: ScanProblem, state: ScanState, gate: float) -> tuple[Float[np.ndarray, " r"], float]:
        """By how much scan points are outside of the skin (r,), in units of the frame; the share of them that has a partner."""
        one = jnp.float32(1.0)
        matches = self.matches(problem, state, gate, np.inf, Tolerances(one, one, one))
        vertices, _ = self._posed(problem, state)
        rows, points, normals, weights = (
            np.asarray(x)[: self.count] for x in (matches.rows, matches.points, matches.normals, matches.weights)
        )
        away = np.einsum("ra,ra->r", normals, points - vertices[rows])
        return away[weights > 0], float((weights > 0).mean())

    def _posed(self, problem, state):
        """Vertices (n, 3) in units of the frame and normals (n, 3)."""
        vertices, normals = pose_surface(problem.surface, state.body.betas, problem.pose(state))
        return np.asarray(vertices, np.float64) / float(scale_of(state)), np.asarray(normals, np.float64)


def _tree(points, normals):
    from scipy.spatial import KDTree

    return KDTree(np.concatenate([points, normals], axis=1))


def _nearest(tree, points, normals):
    return tree.query(np.concatenate([points, normals], axis=1))[1]
