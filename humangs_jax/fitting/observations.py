"""What the cameras saw of one person: keypoints by moment and view, of fixed shapes, so that moments and people are vmapped."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.photos import Photos


@pytree_dataclass
class Observations:
    """Keypoints of one moment in c views; views that do not exist have confidence 0.

    points: (c, k, 2) pixels, centres at +0.5. confidences: (c, k) in [0, 1]; 0: not seen. K: (c, 3, 3) pixels.
    cam_from_world: (c, 4, 4), metres. noise: () standard deviation that detections are expected to have, pixels.
    """

    points: Float[Array, "c k 2"]
    confidences: Float[Array, "c k"]
    K: Float[Array, "c 3 3"]
    cam_from_world: Float[Array, "c 4 4"]
    noise: Float[Array, ""]


NOISE = 0.005
"""Of the height of a person in the picture: what good detectors are off by (2 pixels of 400)."""
LEAST_NOISE = 0.3
"""Pixels: no detector is better."""
OUTER = (0.03, 0.97)
"""Quantiles of coordinates that tell a person's size: a few wild points do not."""


def group_by_moment(photographs: Photos, keypoints: Keypoints) -> tuple[Observations, np.ndarray]:
    """Observations with a leading axis of moments (m, c, ...), and the view (m, c) of each, -1 where there is none."""
    frames, count = np.asarray(photographs.frames), photographs.frame_count
    members = [np.flatnonzero(frames == frame) for frame in range(count)]
    widest = max(len(views) for views in members)
    views = np.full((count, widest), -1)
    for row, own in zip(views, members, strict=True):
        row[: len(own)] = own
    confidences = np.where(views[..., None] < 0, 0.0, keypoints.confidences[views])
    points = np.where(confidences[..., None] > 0, keypoints.points[views], 0.0)
    cameras = photographs.cameras
    batch = jax.vmap(Observations)(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(confidences, jnp.float32),
        jnp.asarray(cameras.K)[views],
        jnp.asarray(cameras.cam_from_world)[views],
        jnp.asarray(expected_noise(points, confidences)),
    )
    return batch, views


def expected_noise(
    points: Float[np.ndarray, "m c k 2"], confidences: Float[np.ndarray, "m c k"]
) -> Float[np.ndarray, " m"]:
    """Pixels, from the size that the person has in the views of a moment; 1 where nothing is seen."""
    return np.asarray([_moment_noise(p, seen) for p, seen in zip(points, confidences > 0, strict=True)], np.float32)


def _moment_noise(points, seen):
    sizes = [
        np.ptp(np.quantile(p[s], OUTER, axis=0), axis=0).max() for p, s in zip(points, seen, strict=True) if s.any()
    ]
    return max(NOISE * float(np.median(sizes)), LEAST_NOISE) if sizes else 1.0
