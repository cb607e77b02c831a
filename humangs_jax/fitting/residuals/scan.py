"""A scan as evidence: pairs of scan points and body vertices, and the residuals of a body against
fixed pairs.

Pairs are nearest points with like normals, searched from either side with k-d trees of positions
and normals: a difference of normals counts like some centimetres, so that a sleeve is not paired
with the waist behind it. Pairs that are far apart, or face different ways, have no weight; others
fade with distance.

Of a pair, d = n . (scan point - body vertex) is the distance by which the scan is outside of the
skin, n the normal of the surface that was searched. On a bare person d is noise on both sides.
Clothes are outside: d > 0 is usual and counts little; d < 0 means that the body pokes out of its
clothes, and counts in full. Hands are usually bare and count in full on both sides.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.body.joints import FINGERS
from humangs_jax.body.landmarks import LandmarkModel, landmark_model, landmarks_from, pose_joints
from humangs_jax.body.model import (
    BodyModel,
    BodyPose,
    SurfacePoints,
    pose_features,
    pose_points,
    surface_points,
)
from humangs_jax.body.resolution import decimate
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.fitting.scan_files import Scan
from humangs_jax.fitting.state import (
    FitState,
    Origin,
    PosePrior,
    betas_of,
    limit_residuals,
    pose_of,
    pose_prior,
    robust,
    scale_of,
    usual_origin,
)
from humangs_jax.fitting.triangulation import Similarity
from humangs_jax.geometry.transform import EXACT
from humangs_jax.rendering.mesh.rasterizer import vertex_normals

VERTICES = 7000
"""Evenly spread, nearly all visible from outside: 1.6 cm apart."""
JOINT_SCALE = 4.0
"""Robust scale of given joints, standard deviations."""
HEIGHT_STD = 0.01
"""Metres: how well people know their height."""
LIKE = 0.3
"""Least cosine between the normals of a pair."""


# The body
# --------------------------------------------------------------------------------------------------


@pytree_dataclass
class BodySurface:
    """n vertices of a body with j joints.

    points: the vertices. faces: (f, 3). order: (n,) vertices with a number below m are a mesh of m
    vertices, evenly spread.
    covered: (n,) 0 on hands, 1 where clothes may be. landmarks: of the same body, with its joints.
    """

    points: SurfacePoints
    faces: Int[Array, "f 3"]
    order: Int[Array, " n"]
    covered: Float[Array, " n"]
    landmarks: LandmarkModel


def body_surface(body: BodyModel, names: tuple[str, ...], vertices: int = VERTICES) -> BodySurface:
    """The surface of a body by `vertices` of its vertices (all, if it has fewer), with the
    landmarks of these names.

    Raises: ValueError if its joints have other names than SMPL-X's.
    """
    small = decimate(body, min(vertices, body.template.shape[0]))
    is_hand = lambda name: name.endswith("_wrist") or any(finger in name for finger in FINGERS)
    hands = [j for j, name in enumerate(small.joint_names) if is_hand(name)]
    bare = np.asarray(small.skinning_weights)[:, hands].sum(axis=1)
    return BodySurface(
        points=surface_points(small),
        faces=small.faces,
        order=jnp.asarray(np.argsort(np.argsort(np.asarray(small.collapse_order))), jnp.int32),
        covered=1 - jnp.asarray(bare, jnp.float32),
        landmarks=landmark_model(body, names),
    )


def pose_vertices(
    surface: BodySurface, rows: Int[Array, " r"], betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "r 3"], Float[Array, "k 3"], Float[Array, "j 3"]]:
    """Some vertices (r, 3), the landmarks (k, 3) and the joints (j, 3) of a person in a pose,
    metres.
    """
    model, count = surface.landmarks, rows.shape[0]
    transforms, joints = pose_joints(model, betas, pose)
    wanted = jax.tree.map(
        lambda own, marks: jnp.concatenate([own[rows], marks]), surface.points, model.points
    )
    posed = pose_points(wanted, betas, pose_features(pose.rotations), transforms)
    return posed[:count], landmarks_from(model, joints, posed[count:]), joints


@jax.jit
def pose_surface(
    surface: BodySurface, betas: Float[Array, " s_used"], pose: BodyPose
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """All vertices (n, 3), metres, and their unit normals (n, 3), outwards."""
    vertices, _, _ = pose_vertices(surface, jnp.arange(surface.points.rest.shape[0]), betas, pose)
    return vertices, vertex_normals(vertices, surface.faces)


# Residuals
# --------------------------------------------------------------------------------------------------


@pytree_dataclass
class ScanProblem:
    """What stays the same. surface: of the body. origin: of the state. ends: static, highest and
    lowest vertex at rest.
    """

    surface: BodySurface
    origin: Origin
    ends: tuple[int, int] = static_field(default=(0, 0))

    @property
    def prior(self) -> PosePrior:
        """The prior of the body's pose."""
        return pose_prior(self.surface.landmarks.joint_names)

    @jax.jit
    def body(self, state: FitState) -> tuple[Float[Array, " s"], BodyPose]:
        """Shape and pose in the scan's frame."""
        return betas_of(self.origin, state), pose_of(self.origin, state)


def scan_problem(surface: BodySurface, names: tuple[str, ...], coefficients: int) -> ScanProblem:
    """The problem with the joints of these names free, and at most `coefficients` of the shape."""
    model, available = surface.landmarks, surface.points.directions.shape[-1]
    joints = tuple(j for j, name in enumerate(model.joint_names) if j > 0 and name in names)
    origin = usual_origin(pose_prior(model.joint_names), joints, min(available, coefficients))
    height = np.asarray(surface.points.rest)[:, 1]
    return ScanProblem(surface, origin, (int(height.argmax()), int(height.argmin())))


@pytree_dataclass
class ScanMatches:
    """r pairs. rows: (r,) vertices of the body. points, normals: (r, 3) in the scan's frame.
    outside: (r,) std of positive distances. weights: (r,), 0: no pair.
    """

    rows: Int[Array, " r"]
    points: Float[Array, "r 3"]
    normals: Float[Array, "r 3"]
    outside: Float[Array, " r"]
    weights: Float[Array, " r"]

    @classmethod
    def none(cls) -> "ScanMatches":
        """One pair without weight."""
        return cls(
            jnp.zeros(1, jnp.int32), jnp.zeros((1, 3)), jnp.zeros((1, 3)), jnp.ones(1), jnp.zeros(1)
        )


@pytree_dataclass
class Given:
    """Known landmarks and height. points: (k, 3) in the scan's frame. weights: (k,) 0: not known.
    std: () metres. height: () metres, and height_weight: () 1 if it is known, else 0.
    """

    points: Float[Array, "k 3"]
    weights: Float[Array, " k"]
    std: Float[Array, ""]
    height: Float[Array, ""]
    height_weight: Float[Array, ""]


@pytree_dataclass
class Tolerances:
    """Each (). inside, outside: std of d on either side, in units of the frame, about metres;
    outside holds where the skin is usually covered. prior: weight of the pose prior.
    """

    inside: Float[Array, ""]
    outside: Float[Array, ""]
    prior: Float[Array, ""]


def scan_residuals(
    problem: ScanProblem,
    matches: ScanMatches,
    given: Given,
    tolerances: Tolerances,
    state: FitState,
) -> dict[str, Float[Array, "..."]]:
    """All residuals by kind, in standard deviations."""
    betas, pose = problem.body(state)
    vertices, landmarks, _ = pose_vertices(problem.surface, matches.rows, betas, pose)
    # in the scan's frame: in metres, a smaller scan would be nearer
    apart = matches.points - vertices / scale_of(state)
    # term by term: XLA's CPU compiler (jaxlib 0.10.2) makes wrong Jacobians of `jnp.sum(normals *
    # apart, axis=-1)` under jacfwd
    along = matches.normals * apart
    away = along[:, 0] + along[:, 1] + along[:, 2]
    off = (landmarks / scale_of(state) - given.points) / given.std
    return {
        "surface": jnp.sqrt(matches.weights) * one_sided(away, matches.outside, tolerances.inside),
        "joints": jnp.sqrt(given.weights)[:, None] * robust(off, JOINT_SCALE),
        "pose": tolerances.prior * state.body_pose,
        "limits": limit_residuals(problem.prior, problem.origin.joints, pose.rotations),
        "shape": state.betas,
        "height": given.height_weight * (_height(problem, betas) - given.height) / HEIGHT_STD,
    }


def one_sided(
    away: Float[Array, " r"], outside: Float[Array, " r"], inside: Float[Array, ""]
) -> Float[Array, " r"]:
    """Distances (r,), positive outside, in standard deviations of either side."""
    return away / jnp.where(away > 0, outside, inside)


def _height(problem: ScanProblem, betas: Float[Array, " s"]) -> Float[Array, ""]:
    points = problem.surface.points
    height = lambda i: (
        points.rest[i, 1]
        + jnp.dot(points.directions[i, 1, : betas.shape[0]], betas, precision=EXACT)
    )
    top, bottom = (height(i) for i in problem.ends)
    return top - bottom


# Pairs
# --------------------------------------------------------------------------------------------------


class Target:
    """A scan in a frame about as large as a person in metres, ready to be searched.

    Arguments: align: to the frame. count: how many points, and body vertices, look for partners.
    effective: weight of all pairs together. normal: metres that a difference of 1 between normals
    counts like.
    """

    def __init__(
        self, scan: Scan, align: Similarity, count: int, effective: float, normal: float
    ) -> None:
        self.points, self.normals = align(scan.points), scan.normals @ align.rotation.T
        self.count, self.effective = min(count, len(self.points)), effective
        self.normal = normal
        self.tree = KDTree(_with_normals(self.points, normal * self.normals))

    def matches(
        self,
        problem: ScanProblem,
        state: FitState,
        gate: float,
        robust_scale: float,
        tolerances: Tolerances,
    ) -> ScanMatches:
        """The pairs of a body in a state: first those that scan points found, `count` of them, then
        those that vertices found.

        Arguments: gate: pairs that are farther apart, in units of the frame, have no weight.
        robust_scale: distance along the normal at which weights have fallen to a quarter.
        """
        rows, points, facing, away, good = self._pairs(problem, state, gate)
        fading = np.square(
            1 / (1 + np.square(away / robust_scale))
        )  # Geman and McClure's loss, as weights
        inside, outside = float(tolerances.inside), float(tolerances.outside)
        covered = np.asarray(problem.surface.covered)[rows]
        number = lambda x: jnp.asarray(x, jnp.float32)
        return ScanMatches(
            rows=jnp.asarray(rows, jnp.int32),
            points=number(points),
            normals=number(facing),
            outside=number(inside + (outside - inside) * covered),
            weights=number(good * fading * (self.effective / len(rows))),
        )

    def distances(
        self, problem: ScanProblem, state: FitState, gate: float
    ) -> tuple[Float[np.ndarray, " r"], float]:
        """How far scan points are outside of the skin (r,), in units of the frame; the share of
        them that has a partner.
        """
        away, good = (x[: self.count] for x in self._pairs(problem, state, gate)[3:])
        return away[good], float(good.mean())

    def _pairs(self, problem: ScanProblem, state: FitState, gate: float) -> tuple[np.ndarray, ...]:
        """Vertices (r,), points (r, 3), normals (r, 3), distances (r,), and which pairs are near
        and alike (r,).
        """
        vertices, normals = (
            np.asarray(x, np.float64) for x in pose_surface(problem.surface, *problem.body(state))
        )
        vertices = vertices / float(scale_of(state))
        looking = np.flatnonzero(np.asarray(problem.surface.order) < self.count)
        of_body = self.tree.query(_with_normals(vertices[looking], self.normal * normals[looking]))[
            1
        ]
        some, like = self.points[: self.count], self.normals[: self.count]
        tree = KDTree(_with_normals(vertices, self.normal * normals))
        of_scan = tree.query(_with_normals(some, self.normal * like))[1]
        rows = np.concatenate([of_scan, looking])
        points = np.concatenate([some, self.points[of_body]])
        facing = np.concatenate([normals[of_scan], self.normals[of_body]])
        other = np.concatenate([like, normals[looking]])
        apart = points - vertices[rows]
        good = (np.einsum("ra,ra->r", facing, other) > LIKE) & (
            np.linalg.norm(apart, axis=1) < gate
        )
        return rows, points, facing, np.einsum("ra,ra->r", facing, apart), good


def _with_normals(
    points: Float[np.ndarray, "r 3"], normals: Float[np.ndarray, "r 3"]
) -> Float[np.ndarray, "r 6"]:
    return np.concatenate([points, normals], axis=1)
