"""Checks a calibration: finds cameras with a wrong rotation. In the photos of such a camera, all
landmarks are shifted from where they should be according to the other cameras.

The corrections come from linearised bundle adjustment, in which every landmark of every moment is a
free point (Triggs et al. 2000, "Bundle Adjustment").

A detector's landmarks have errors too, but these differ from landmark to landmark. So a camera is
only reported if its correction exceeds several standard errors and lowers the cost clearly. The
standard errors come from the scatter over landmarks (a sandwich estimate, clustered by landmark).
Cameras are turned one after the other, as long as each turn passes these tests.

Axes of arrays, also in `einsum`:

    m           moments
    c, d        views of a moment
    k           landmarks, which are free points
    i           x and y of a pixel
    a, b, p, q  coordinates in space, or components of a rotation vector
    n           cameras
    u           unknowns: the rotation vectors of cameras, one after the other
"""

import dataclasses
import functools
from typing import NamedTuple, TypeVar

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.capture.fitting.residuals.keypoints import (
    LEAST_NOISE,
    RAYLEIGH_MEDIAN,
    group_by_frame,
)
from humangs_jax.capture.fitting.state import camera_origin
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.photos import Photos
from humangs_jax.geometry import quaternion, transform

P = TypeVar("P", Photos, Capture)
_PRIOR = np.radians(1.0)
"""Prior standard deviation of the rotations, radians. Without it, movements of all cameras and
points together would be undetermined, because they change no residual.
"""
_ITERATIONS = 8
"""Number of iterations that turn the cameras, move the points and reweight the residuals. After
them, as many iterations move only the points, for the cameras as given and with the last weights.
"""


@dataclasses.dataclass(frozen=True)
class _Decision:
    """Limits that decide whether a camera counts as turned."""

    clear: float = 5.0
    """A rotation has to have at least this size to count, in standard errors."""
    least_gain: float = 25.0
    """A rotation has to lower the cost by at least this much to count.

    If a detector has the same error in all landmarks of a view, this looks like a rotation of the
    camera. For five synthetic people in rooms with exact cameras, rotations lowered the cost by 5
    to 16. For five photos of a man with a wrong calibration, rotations lowered it by 32 to 121.
    """
    least_degrees: float = 0.3
    """Rotations up to this angle are not reported, degrees. They hardly matter: 0.3 degrees move a
    point by 1.6 cm at a distance of 3 m.
    """
    most_degrees: float = 8.0
    """Nothing is reported if any rotation exceeds this angle, degrees. The calibration then has
    another error.
    """
    alike: float = 0.9
    """Another camera is also named as a possible cause if turning it, and not the reported camera,
    explains nearly as much. The cost then decreases by more than this share of the decrease that
    the reported rotation brings.
    """
    most_cameras: int = 64
    """Largest number of cameras. If there are more, no errors are looked for."""


_DECISION = _Decision()


@dataclasses.dataclass(frozen=True)
class CameraError:
    """A camera with a wrong rotation, and the rotation that corrects it."""

    views: tuple[int, ...]
    """Indices of the camera's views."""
    names: tuple[str, ...]
    """Names of the cameras that may be the cause: first this camera, then other cameras that would
    explain the residuals almost as well. The name of a camera is the name of its first view.
    """
    rotation: tuple[float, float, float]
    """Rotation that corrects the camera: a rotation vector in the camera's axes, radians."""

    @property
    def degrees(self) -> float:
        """Angle by which the camera is turned, degrees."""
        return float(np.degrees(np.linalg.norm(self.rotation)))

    def __str__(self) -> str:
        """Returns one line with the names of the possible cameras and the angle."""
        return f"camera {' or '.join(self.names)} is off by {self.degrees:.1f} degrees"


def find_camera_errors(photos: Photos | Capture, keypoints: Keypoints) -> tuple[CameraError, ...]:
    """Returns the cameras whose rotation is wrong according to the keypoints. The camera that
    explains most of the residuals comes first.

    The result is empty for fewer than three or more than `_Decision.most_cameras` cameras, or if
    too few landmarks are seen. It is also empty if a rotation exceeds `_Decision.most_degrees`.
    Cameras whose rotation is at most `_Decision.least_degrees` are left out.
    """
    camera_of = np.asarray(camera_origin(photos.cameras, photos.frames).camera)
    if not 3 <= camera_of.max() + 1 <= _DECISION.most_cameras:
        return ()
    seen = _Seen.of(photos, keypoints, camera_of)
    if seen is None:
        return ()
    # the cameras that explain most are turned one after the other, as long as each is clear
    solved = functools.partial(_solved, seen.equations())
    chosen: list[int] = []
    gain = 0.0
    while len(chosen) < seen.count - 2:
        found = {c: solved([*chosen, c]) for c in range(seen.count) if c not in chosen}
        best = max(found, key=lambda c: found[c].gain)
        if found[best].clear < _DECISION.clear or found[best].gain < gain + _DECISION.least_gain:
            break
        chosen, gain = [*chosen, best], found[best].gain
    if not chosen:
        return ()
    rotations = solved(chosen).rotations
    sizes = np.degrees(np.linalg.norm(rotations, axis=-1))
    if sizes.max() > _DECISION.most_degrees:
        return ()
    errors = []
    for camera, rotation, size in zip(chosen, rotations, sizes, strict=True):
        if size <= _DECISION.least_degrees:
            continue
        # other cameras that would explain as much in its place are named with it
        without = [c for c in chosen if c != camera]
        rest = solved(without).gain if without else 0.0
        others = (c for c in range(seen.count) if c not in chosen)
        enough = _DECISION.alike * (gain - rest)
        alike = [c for c in others if solved([*without, c]).gain - rest > enough]
        views = [np.flatnonzero(camera_of == c).tolist() for c in (camera, *alike)]
        names = tuple(photos.names[own[0]] for own in views)
        errors.append(CameraError(tuple(views[0]), names, tuple(rotation.tolist())))
    return tuple(errors)


def mended(photos: P, errors: tuple[CameraError, ...]) -> P:
    """Returns the photos with corrected cameras. The camera of each error is turned about its
    centre by the error's rotation.
    """
    rotations = np.zeros((len(photos.names), 3), np.float32)
    for error in errors:
        rotations[list(error.views)] = error.rotation
    turns = transform.make(
        quaternion.matrix_from_axis_angle(jnp.asarray(rotations)), jnp.zeros((len(rotations), 3))
    )
    matrices = jnp.matmul(turns, photos.cameras.cam_from_world, precision=transform.EXACT)
    return dataclasses.replace(photos, cameras=replace(photos.cameras, cam_from_world=matrices))


# Equations
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class _Seen:
    """Keypoints of k landmarks in m moments and c views, in float64."""

    points: Float[np.ndarray, "m c k 2"]
    """Detections, (m, c, k, 2), pixels."""
    weights: Float[np.ndarray, "m c k"]
    """Confidences, (m, c, k). 0 for landmarks that fewer than two views see at the moment."""
    K: Float[np.ndarray, "m c 3 3"]
    """Intrinsics, (m, c, 3, 3), pixels."""
    matrices: Float[np.ndarray, "m c 4 4"]
    """Camera poses from the world to the camera, (m, c, 4, 4), metres."""
    camera: Int[np.ndarray, "m c"]
    """Index of each view's camera, (m, c), from 0 to `count` - 1."""
    count: int
    """Number of cameras."""

    @classmethod
    def of(
        cls,
        photos: Photos | Capture,
        keypoints: Keypoints,
        camera_of: Int[np.ndarray, " v"],
    ) -> "_Seen | None":
        """Returns the keypoints of at most 24 moments, evenly chosen. Only the main landmarks of
        the body are taken, with nose, eyes and ears. Other landmarks of a face or a hand are left
        out, because their errors are alike.

        A landmark counts if at least two views see it at the same moment. The result is None if
        fewer than 8 landmarks count. camera_of: index of each view's camera, (v,).
        """
        # landmarks that err independently: those of a face or a hand err together
        parts = (
            *("nose", "eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle"),
            *("heel", "big_toe", "foot_index"),
        )
        kinds = [
            name.removeprefix("left_").removeprefix("right_") in parts
            for name in keypoints.set.names
        ]
        # 24 moments at most, evenly chosen
        observations, views = group_by_frame(photos, keypoints)
        some = np.unique(np.linspace(0, len(views) - 1, 24).round().astype(int))

        def as_double(name: str) -> Float[np.ndarray, "..."]:
            """Returns a field of the observations at the chosen moments, in float64."""
            return np.asarray(getattr(observations, name), np.float64)[some]

        weights = as_double("confidences")[..., kinds]
        weights = weights * ((weights > 0).sum(1, keepdims=True) >= 2)
        if (weights > 0).any((0, 1)).sum() < 8:
            return None
        return cls(
            points=as_double("points")[:, :, kinds],
            weights=weights,
            K=as_double("K"),
            matrices=as_double("cam_from_world"),
            camera=camera_of[views[some]],
            count=int(camera_of.max()) + 1,
        )

    def equations(self) -> "_Equations":
        """Returns the least squares equations for small rotations of the cameras, linearised at the
        given cameras. Keypoints that are outliers have small weights.
        """
        turned, points, weights = np.zeros((self.count, 3)), self._middle(), self.weights
        # outliers are found with all cameras free to turn: else a turned camera's landmarks are
        for _ in range(_ITERATIONS):
            step = self._linearized(turned, points, weights)
            gradient, matrix = step.equations.gradients.sum(0), step.equations.matrices.sum(0)
            turned, points = turned - _solve(gradient, matrix).reshape(-1, 3), step.points
            lengths = np.linalg.norm(step.errors, axis=-1)
            noise = max(float(np.median(lengths[weights > 0])) / RAYLEIGH_MEDIAN, LEAST_NOISE)
            scale = (3.0 * noise) ** 2  # robust scale: three standard deviations
            weights = self.weights * np.square(scale / (scale + lengths**2)) / noise**2
        # with these weights, the points settle for the cameras as they are given
        for _ in range(_ITERATIONS):
            step = self._linearized(np.zeros_like(turned), points, weights)
            points = step.points
        return step.equations

    def _middle(self) -> Float[np.ndarray, "m k 3"]:
        """Returns the positions at which the points start, (m, k, 3), metres. All points start at
        the same position, which is nearest to the optical axes of all cameras.
        """
        axes = self.matrices[..., 2, :3]
        centers = -np.einsum("mcba,mcb->mca", self.matrices[..., :3, :3], self.matrices[..., :3, 3])
        across = np.eye(3) - axes[..., :, None] * axes[..., None, :]
        total, right = across.sum((0, 1)), np.einsum("mcab,mcb->a", across, centers)
        middle = np.linalg.solve(total + 1e-6 * np.eye(3), right)
        return np.broadcast_to(middle, (len(axes), self.points.shape[2], 3))

    def _projected(
        self, turned: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m k 3"]
    ) -> "_Projected":
        """Returns the points as the turned cameras see them. turned: rotation of each camera, (n,
        3), axis-angle in radians. points: (m, k, 3), metres.
        """
        turn = Rotation.from_rotvec(turned).as_matrix()[self.camera]
        rotation = turn @ self.matrices[..., :3, :3]
        shift = np.einsum("mcab,mcb->mca", turn, self.matrices[..., :3, 3])
        local = np.einsum("mcab,mkb->mcka", rotation, points) + shift[:, :, None]
        depth = np.maximum(local[..., 2], 0.05)
        focal = self.K[:, :, None, [0, 1], [0, 1]]
        slope = local[..., :2] / depth[..., None]
        errors = slope * focal + self.K[:, :, None, :2, 2] - self.points
        return _Projected(rotation, local, depth, slope, focal, errors)

    def _linearized(
        self,
        turned: Float[np.ndarray, "n 3"],
        points: Float[np.ndarray, "m k 3"],
        weights: Float[np.ndarray, "m c k"],
    ) -> "_Linearized":
        """Returns the equations for the rotations of the cameras, linearised at `turned` and
        `points`. The points are eliminated by the Schur complement.

        The cost of one landmark at one moment is 1/2 sum_c w_c |e_c + P_c x + T_c t_c|^2. Here w
        are the weights, e the errors, x the step of the point, t the rotations of the views, and P
        and T the derivatives of the pixels by both. Eliminating x leaves, at t = 0:

            step      x = -H^-1 sum_c w_c P_c^T e_c            H = sum_c w_c P_c^T P_c
            gradient  w_c T_c^T r_c                            r_c = e_c + P_c x
            Hessian   -M_c H^-1 M_d^T, for c = d plus          M_c = w_c T_c^T P_c
                      w_c T_c^T T_c
        """
        seen = self._projected(turned, points)
        by_point, by_turn = seen.derivatives()
        # the Gauss-Newton step of each point, -x, with the cameras held still
        point_hessians = np.einsum("mck,mckia,mckib->mkab", weights, by_point, by_point)
        ridge = 1e-9 + 1e-6 * np.trace(point_hessians, axis1=-2, axis2=-1)[..., None, None]
        inverse = np.linalg.inv(point_hessians + ridge * np.eye(3))
        step = np.einsum(
            "mkab,mck,mckib,mcki->mka", inverse, weights, by_point, seen.errors, optimize=True
        )
        # gradients by the rotation of each view
        remaining = seen.errors - np.einsum("mckib,mkb->mcki", by_point, step)
        gradients = np.einsum("mck,mckia,mcki->mcka", weights, by_turn, remaining)
        # Hessians by the rotations of each pair of views
        mixed = np.einsum("mck,mckia,mckib->mckab", weights, by_turn, by_point)
        pair_hessians = -np.einsum("mckap,mkpq,mdkbq->mcdkab", mixed, inverse, mixed, optimize=True)
        views = np.arange(pair_hessians.shape[1])
        pair_hessians[:, views, views] += np.einsum(
            "mck,mckia,mckib->mckab", weights, by_turn, by_turn
        )
        return _Linearized(self._by_camera(gradients, pair_hessians), seen.errors, points - step)

    def _by_camera(
        self,
        gradients: Float[np.ndarray, "m c k 3"],
        pair_hessians: Float[np.ndarray, "m c c k 3 3"],
    ) -> "_Equations":
        """Returns the equations for the cameras. Gradients of views and Hessians of pairs of views
        are summed over the moments and over the views of each camera.
        """
        k, n = gradients.shape[2], self.count
        of_cameras, of_camera_pairs = np.zeros((n, k, 3)), np.zeros((n, n, k, 3, 3))
        # `np.add.at` adds all views of a camera, where += would keep one
        np.add.at(of_cameras, self.camera, gradients)
        camera_pairs = (self.camera[:, :, None], self.camera[:, None])
        np.add.at(of_camera_pairs, camera_pairs, pair_hessians)
        # the axes (n, 3) of cameras and rotation vectors become the axis u
        return _Equations(
            gradients=of_cameras.transpose(1, 0, 2).reshape(k, 3 * n),
            matrices=of_camera_pairs.transpose(2, 0, 3, 1, 4).reshape(k, 3 * n, 3 * n),
        )


class _Projected(NamedTuple):
    """Points of m moments in the pixels of c views."""

    rotation: Float[np.ndarray, "m c 3 3"]
    """Rotations from the world to the turned cameras, (m, c, 3, 3)."""
    local: Float[np.ndarray, "m c k 3"]
    """Points in the axes of the cameras, (m, c, k, 3), metres."""
    depth: Float[np.ndarray, "m c k"]
    """Depths of the points, at least 5 cm, (m, c, k), metres."""
    slope: Float[np.ndarray, "m c k 2"]
    """x / depth and y / depth of the points, (m, c, k, 2)."""
    focal: Float[np.ndarray, "m c 1 2"]
    """Focal lengths, (m, c, 1, 2), pixels."""
    errors: Float[np.ndarray, "m c k 2"]
    """Projected points minus detections, (m, c, k, 2), pixels."""

    def derivatives(
        self,
    ) -> tuple[Float[np.ndarray, "m c k 2 3"], Float[np.ndarray, "m c k 2 3"]]:
        """Returns two derivatives of the projected pixels, each (m, c, k, 2, 3): by the points in
        the world (pixels per metre), and by small rotations of the cameras (pixels per radian).
        """
        by_local = np.zeros((*self.depth.shape, 2, 3))
        by_local[..., [0, 1], [0, 1]] = self.focal / self.depth[..., None]
        by_local[..., 2] = -self.focal * self.slope / self.depth[..., None]
        by_point = np.einsum("mckia,mcab->mckib", by_local, self.rotation)
        # a turn t moves a point p of the camera by t x p: row a is the cross product with axis a
        moved = np.cross(self.local[..., None, :], np.eye(3))
        return by_point, np.einsum("mckia,mckab->mckib", by_local, moved)


class _Equations(NamedTuple):
    """Least squares equations for the rotations of n cameras. There is one system for each
    landmark. The residuals are in standard deviations.
    """

    gradients: Float[np.ndarray, "k u"]
    """Gradient of the cost of each landmark, (k, 3 n)."""
    matrices: Float[np.ndarray, "k u u"]
    """Gauss-Newton Hessian of the cost of each landmark, (k, 3 n, 3 n)."""


class _Linearized(NamedTuple):
    """Result of one Gauss-Newton iteration of the bundle adjustment."""

    equations: _Equations
    """Equations for the rotations of the cameras."""
    errors: Float[np.ndarray, "m c k 2"]
    """Projected points minus detections, before the step, (m, c, k, 2), pixels."""
    points: Float[np.ndarray, "m k 3"]
    """Points after the step, (m, k, 3), metres."""


def _solve(
    gradient: Float[np.ndarray, " u"], matrix: Float[np.ndarray, "u u"]
) -> Float[np.ndarray, " u"]:
    return np.linalg.solve(matrix + np.eye(len(matrix)) / _PRIOR**2, gradient)


class _Solved(NamedTuple):
    """The best rotations of some cameras, with all other cameras fixed."""

    rotations: Float[np.ndarray, "s 3"]
    """Rotations of the cameras, axis-angle, (s, 3), radians."""
    gain: float
    """By how much these rotations lower the cost."""
    clear: float
    """Size of the last camera's rotation in standard errors, a root mean square over three axes."""


def _solved(equations: _Equations, cameras: list[int]) -> _Solved:
    """Returns the best rotations of these cameras, with all other cameras fixed."""
    at = (3 * np.asarray(cameras)[:, None] + np.arange(3)).ravel()
    own, curved = equations.gradients[:, at], equations.matrices[:, at[:, None], at]
    total = curved.sum(0)
    found = -_solve(own.sum(0), total)
    # sandwich estimate of the covariance, clustered by landmark
    inverse = np.linalg.inv(total + np.eye(len(at)) / _PRIOR**2)
    used = int((np.abs(own).max(1) > 0).sum())
    scatter = own + curved @ found
    covariance = inverse @ (scatter.T @ scatter) @ inverse * used / max(used - len(at), 1)
    last = found[-3:]
    clear = np.sqrt(max(last @ np.linalg.pinv(covariance[-3:, -3:]) @ last, 0.0) / 3)
    return _Solved(found.reshape(-1, 3), float(-0.5 * own.sum(0) @ found), float(clear))
