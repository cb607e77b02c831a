"""Similarities x -> scale R x + translation, in float64 on the host, and the best one between given points."""

import dataclasses

import numpy as np

from humangs_jax.core.array_types import Float

ITERATIONS = 10
"""Rounds of reweighting by the distances."""


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity:
    """x -> scale rotation x + translation. rotation: (3, 3), proper. translation: (3,)."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def __call__(self, points: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def after(self, first: "Similarity") -> "Similarity":
        """The composition: first `first`, then this one."""
        return Similarity(
            self.scale * first.scale, self.rotation @ first.rotation, self(np.asarray(first.translation, np.float64))
        )

    def inverse(self) -> "Similarity":
        back = self.rotation.T
        return Similarity(1 / self.scale, back, -(back @ self.translation) / self.scale)

    def matrix(self) -> Float[np.ndarray, "4 4"]:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix


def align_points(
    source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"]
) -> Similarity:
    """The similarity from source to target whose weighted square distances are least (Umeyama 1991, eq. 40 to 43).

    Raises: ValueError if fewer than three points have a weight, or they lie on a line.
    """
    share = weights / max(weights.sum(), 1e-30)
    mean_source, mean_target = share @ source, share @ target
    x, y = source - mean_source, target - mean_target
    extent = np.linalg.svd(np.sqrt(share)[:, None] * x, compute_uv=False)
    if (weights > 0).sum() < 3 or extent[1] < 1e-6 * extent[0]:
        raise ValueError("expected at least three points that are not on one line")
    u, values, vt = np.linalg.svd(y.T @ (share[:, None] * x))
    signs = np.asarray([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * signs) @ vt
    scale = float((values * signs).sum() / (share @ (x * x).sum(axis=1)))
    return Similarity(scale, rotation, mean_target - scale * rotation @ mean_source)


def align_robustly(
    source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"], weights: Float[np.ndarray, " k"], std: float
) -> Similarity:
    """The same with Cauchy weights: points farther off than `std`, in units of the target, count less.

    Raises: see `align_points`.
    """
    found = align_points(source, target, weights)
    for _ in range(ITERATIONS):
        away = np.linalg.norm(found(source) - target, axis=1) / std
        found = align_points(source, target, weights / (1 + away * away))
    return found
