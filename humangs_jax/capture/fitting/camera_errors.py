"""Whether a calibration is right: a camera that is turned sees all landmarks beside where the other
cameras see them.

The rotations that would correct it come from linearised bundle adjustment, in which every landmark
of every moment is a free point (Triggs et al. 2000, "Bundle Adjustment"). A detector's landmarks
err too, but not together: a camera is only named where its rotation exceeds several times the
standard error that the scatter over landmarks gives (a sandwich estimate, clustered by landmark).
As few cameras are turned as explain the residuals, because turning all of them explains no more.
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
LEAST_DEGREES = 0.3
"""Degrees: smaller errors hardly matter, a third of a degree is 1.5 cm at 3 m."""
MOST_DEGREES = 8.0
"""Degrees: larger errors are no calibration that is a little off."""
CLEAR = 5.0
"""Standard errors from which on a rotation is no chance."""
LEAST_GAIN = 25.0
"""Fall of the cost from which on a rotation is no chance. A detector that errs alike in all
landmarks of a view imitates one: on five synthetic people in rooms with exact cameras the cost fell
by 5 to 16, on five photos of a man whose calibration is off by 32 to 121.
"""
PRIOR = np.radians(1.0)
"""Expected size of rotations, radians: holds what cameras and points together can do without a
residual.
"""
ALIKE = 0.9
"""Share of the cost from which on another camera explains as much."""
ITERATIONS = 8
"""Iterations that reweight the residuals."""
FRAMES = 24
"""Moments that are looked at, at most."""
CAMERAS = 64
"""Cameras up to which errors are looked for."""
ROBUST_SCALE = 3.0
"""Robust scale of residuals, standard deviations."""
PARTS = (
    "nose",
    "eye",
    "ear",
    "shoulder",
    "elbow",
    "wrist",
    "hip",
    "knee",
    "ankle",
    "heel",
    "big_toe",
    "foot_index",
)
"""Landmarks that err independently: those of a face or a hand err together."""


@dataclasses.dataclass(frozen=True)
class CameraError:
    """A camera that is turned."""

    views: tuple[int, ...]
    """Indices of its views."""
    names: tuple[str, ...]
    """Names of its first view, and of those of other cameras that would explain as much."""
    rotation: tuple[float, float, float]
    """Axis-angle in the camera's axes, radians, that turns it back."""

    @property
    def degrees(self) -> float:
        """How far it is turned."""
        return float(np.degrees(np.linalg.norm(self.rotation)))

    def __str__(self) -> str:
        """One line."""
        return f"camera {' or '.join(self.names)} is off by {self.degrees:.1f} degrees"


def find_camera_errors(photos: Photos | Capture, keypoints: Keypoints) -> tuple[CameraError, ...]:
    """The cameras that keypoints show to be turned, those that explain most first; none with fewer
    than three cameras.
    """
    camera_of = np.asarray(camera_origin(photos.cameras, photos.frames).camera)
    if not 3 <= camera_of.max() + 1 <= CAMERAS:
        return ()
    seen = _Seen.of(photos, keypoints, camera_of)
    if seen is None:
        return ()
    # the cameras that explain most are turned one after the other, as long as each is clear
    gradients, matrices = seen.equations()
    solved = functools.partial(_solved, gradients, matrices)
    chosen: list[int] = []
    gain = 0.0
    while len(chosen) < seen.count - 2:
        found = {c: solved([*chosen, c]) for c in range(seen.count) if c not in chosen}
        best = max(found, key=lambda c: found[c].gain)
        if found[best].clear < CLEAR or found[best].gain < gain + LEAST_GAIN:
            break
        chosen, gain = [*chosen, best], found[best].gain
    if not chosen:
        return ()
    rotations = solved(chosen).rotations
    # large rotations mean that the calibration is something else than a little off
    sizes = np.degrees(np.linalg.norm(rotations, axis=-1))
    if sizes.max() > MOST_DEGREES:
        return ()
    errors = []
    for camera, rotation, size in zip(chosen, rotations, sizes, strict=True):
        if size <= LEAST_DEGREES:
            continue
        # other cameras that would explain as much in its place are named with it
        without = [c for c in chosen if c != camera]
        rest = solved(without).gain if without else 0.0
        others = (c for c in range(seen.count) if c not in chosen)
        alike = [c for c in others if solved([*without, c]).gain - rest > ALIKE * (gain - rest)]
        views = [np.flatnonzero(camera_of == c).tolist() for c in (camera, *alike)]
        names = tuple(photos.names[own[0]] for own in views)
        errors.append(CameraError(tuple(views[0]), names, tuple(rotation.tolist())))
    return tuple(errors)


def mended(photos: P, errors: tuple[CameraError, ...]) -> P:
    """The same photos with cameras turned about their centres as the errors say."""
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
    """Keypoints of m moments in c views, with k landmarks, as float64."""

    points: Float[np.ndarray, "m c k 2"]
    """Detections, (m, c, k, 2), pixels."""
    weights: Float[np.ndarray, "m c k"]
    """Confidences, (m, c, k); 0 where fewer than two views see a landmark."""
    K: Float[np.ndarray, "m c 3 3"]
    """Intrinsics, (m, c, 3, 3), pixels."""
    matrices: Float[np.ndarray, "m c 4 4"]
    """Camera poses, from the world to the camera, (m, c, 4, 4)."""
    camera: Int[np.ndarray, "m c"]
    """Number of each view's camera, below `count`, (m, c)."""
    count: int
    """Number of cameras."""

    @classmethod
    def of(
        cls,
        photos: Photos | Capture,
        keypoints: Keypoints,
        camera_of: Int[np.ndarray, " v"],
    ) -> "_Seen | None":
        """Gathers what the cameras see of the person; None if that is too little."""
        kinds = [
            name.removeprefix("left_").removeprefix("right_") in PARTS
            for name in keypoints.set.names
        ]
        observations, views = group_by_frame(photos, keypoints)
        some = np.unique(np.linspace(0, len(views) - 1, FRAMES).round().astype(int))

        def as_double(name: str) -> Float[np.ndarray, "..."]:
            """A field of the observations, of those moments."""
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

    def equations(self) -> tuple[Float[np.ndarray, "k u"], Float[np.ndarray, "k u u"]]:
        """Gradients (k, 3 n) of the cost by rotations of the n cameras from where they are, and
        Hessians (k, 3 n, 3 n), in standard deviations, landmark by landmark; the points are
        eliminated.
        """
        turned, points, weights = np.zeros((self.count, 3)), self._middle(), self.weights
        # Outliers are found with all cameras free to turn: else a turned camera's landmarks are.
        for _ in range(ITERATIONS):
            gradients, matrices, errors, points = self._linear(turned, points, weights)
            turned = turned - _solve(gradients.sum(0), matrices.sum(0)).reshape(-1, 3)
            lengths = np.linalg.norm(errors, axis=-1)
            noise = max(float(np.median(lengths[weights > 0])) / RAYLEIGH_MEDIAN, LEAST_NOISE)
            scale = (ROBUST_SCALE * noise) ** 2
            weights = self.weights * np.square(scale / (scale + lengths**2)) / noise**2
        # With these weights, the equations at the cameras as they are given.
        for _ in range(ITERATIONS):
            gradients, matrices, _, points = self._linear(np.zeros_like(turned), points, weights)
        return gradients, matrices

    def _middle(self) -> Float[np.ndarray, "m k 3"]:
        """(m, k, 3) the point nearest to the axes of all cameras, to begin with."""
        axes = self.matrices[..., 2, :3]
        centers = -np.einsum("mcba,mcb->mca", self.matrices[..., :3, :3], self.matrices[..., :3, 3])
        across = np.eye(3) - axes[..., :, None] * axes[..., None, :]
        total, right = across.sum((0, 1)), np.einsum("mcab,mcb->a", across, centers)
        middle = np.linalg.solve(total + 1e-6 * np.eye(3), right)
        return np.broadcast_to(middle, (len(axes), self.points.shape[2], 3))

    def _project(
        self, turned: Float[np.ndarray, "n 3"], points: Float[np.ndarray, "m k 3"]
    ) -> tuple[np.ndarray, ...]:
        """Rotations (m, c, 3, 3), points in the cameras (m, c, k, 3), depths, slopes, focal
        lengths, and errors (m, c, k, 2).
        """
        turn = Rotation.from_rotvec(turned).as_matrix()[self.camera]
        rotation = turn @ self.matrices[..., :3, :3]
        shift = np.einsum("mcab,mcb->mca", turn, self.matrices[..., :3, 3])
        local = np.einsum("mcab,mkb->mcka", rotation, points) + shift[:, :, None]
        depth = np.maximum(local[..., 2], 0.05)
        focal, slope = self.K[:, :, None, [0, 1], [0, 1]], local[..., :2] / depth[..., None]
        errors = slope * focal + self.K[:, :, None, :2, 2] - self.points
        return rotation, local, depth, slope, focal, errors

    def _linear(
        self,
        turned: Float[np.ndarray, "n 3"],
        points: Float[np.ndarray, "m k 3"],
        weights: Float[np.ndarray, "m c k"],
    ) -> tuple[
        Float[np.ndarray, "k u"],
        Float[np.ndarray, "k u u"],
        Float[np.ndarray, "m c k 2"],
        Float[np.ndarray, "m k 3"],
    ]:
        """Gradients and Hessians at rotations, the residuals, and the points after one more step of
        Gauss and Newton.
        """
        rotation, local, depth, slope, focal, errors = self._project(turned, points)
        # derivatives of the pixels by the point in the camera's axes, by the point in the world,
        # and by the camera's turn
        by_local = np.zeros((*depth.shape, 2, 3))
        by_local[..., [0, 1], [0, 1]] = focal / depth[..., None]
        by_local[..., 2] = -focal * slope / depth[..., None]
        by_point = np.einsum("mckia,mcab->mckib", by_local, rotation)
        by_turn = np.einsum(
            "mckia,mckab->mckib", by_local, np.cross(local[..., None, :], np.eye(3))
        )
        # a step of Gauss and Newton for each point, with the cameras held still
        own = np.einsum("mck,mckia,mckib->mkab", weights, by_point, by_point)
        ridge = 1e-9 + 1e-6 * np.trace(own, axis1=-2, axis2=-1)[..., None, None]
        inverse = np.linalg.inv(own + ridge * np.eye(3))
        step = np.einsum(
            "mkab,mck,mckib,mcki->mka", inverse, weights, by_point, errors, optimize=True
        )
        left = errors - np.einsum("mckib,mkb->mcki", by_point, step)
        # the Schur complement of the points: what is left are equations of the cameras, added up
        # where several views are of one camera
        mixed = np.einsum("mck,mckia,mckib->mckab", weights, by_turn, by_point)
        k, n = points.shape[1], self.count
        gradients, matrices = np.zeros((n, k, 3)), np.zeros((n, n, k, 3, 3))
        np.add.at(gradients, self.camera, np.einsum("mck,mckia,mcki->mcka", weights, by_turn, left))
        pairs = -np.einsum("mckap,mkpq,mdkbq->mcdkab", mixed, inverse, mixed, optimize=True)
        every = np.arange(pairs.shape[1])
        pairs[:, every, every] += np.einsum("mck,mckia,mckib->mckab", weights, by_turn, by_turn)
        np.add.at(matrices, (self.camera[:, :, None], self.camera[:, None]), pairs)
        flat = matrices.transpose(2, 0, 3, 1, 4).reshape(k, 3 * n, 3 * n)
        return gradients.transpose(1, 0, 2).reshape(k, 3 * n), flat, errors, points - step


def _solve(
    gradient: Float[np.ndarray, " u"], matrix: Float[np.ndarray, "u u"]
) -> Float[np.ndarray, " u"]:
    return np.linalg.solve(matrix + np.eye(len(matrix)) / PRIOR**2, gradient)


class _Solved(NamedTuple):
    """What turning some cameras achieves."""

    rotations: Float[np.ndarray, "s 3"]
    """Rotations of the cameras, axis-angle, (s, 3), radians."""
    gain: float
    """How much the cost falls."""
    clear: float
    """Size of the last camera's rotation in standard errors."""


def _solved(
    gradients: Float[np.ndarray, "k u"], matrices: Float[np.ndarray, "k u u"], cameras: list[int]
) -> _Solved:
    at = (3 * np.asarray(cameras)[:, None] + np.arange(3)).ravel()
    own, curved = gradients[:, at], matrices[:, at[:, None], at]
    total = curved.sum(0)
    found = -_solve(own.sum(0), total)
    inverse = np.linalg.inv(total + np.eye(len(at)) / PRIOR**2)
    used = int((np.abs(own).max(1) > 0).sum())
    scatter = own + curved @ found
    covariance = inverse @ (scatter.T @ scatter) @ inverse * used / max(used - len(at), 1)
    last = found[-3:]
    clear = np.sqrt(max(last @ np.linalg.pinv(covariance[-3:, -3:]) @ last, 0.0) / 3)
    return _Solved(found.reshape(-1, 3), float(-0.5 * own.sum(0) @ found), float(clear))
