"""A pose for each photo of a person who moved a little between photos that one pose nearly
explains.

A person who turns before a camera moves head, arms and legs by centimetres. Such photos are neither
of one moment nor of separate moments. They have one shape and one set of cameras, and each photo
has a pose that starts at the shared pose and stays near it (`CONFIG`). Photos of a video follow
each other. Their deviations x_i from the shared pose, in standard deviations, are a process of
Ornstein and Uhlenbeck, where x_{i+1} - r x_i has the variance 1 - r^2, with r = exp(-t / MEMORY)
for photos that are t seconds apart.

More numbers always fit the keypoints better. So poses are fitted to the keypoints alone, and the
masks show whether the person moved. If nobody moved, these poses follow the detector's errors, and
the body fills the masks less than before.
"""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

from humangs_jax.capture.fitting.files import FitRecord
from humangs_jax.capture.fitting.silhouette_fit import (
    RefinedCapture,
    SilhouetteFit,
    moved_capture,
    posed_vertices,
    refine_capture,
    usual_config,
)
from humangs_jax.capture.fitting.state import StateStd
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture

CONFIG = dataclasses.replace(
    usual_config(fitted=True, fixed_cameras=True),
    # degrees and metres by which somebody who means to stand still moves; the shape hardly changes
    std=StateStd(body_pose=8.0, global_orient=3.0, transl=0.03, betas=0.1),
    # hands and heads turn most, the trunk least
    by_joint=(
        ("spine", 0.5),
        ("hip", 0.6),
        ("collar", 0.6),
        ("foot", 0.6),
        ("head", 1.2),
        ("wrist", 1.2),
    ),
)
"""Settings of poses that stay near the pose that the photos share."""
MEMORY = 2.0
"""Time after which the correlation of a swaying body's deviations has fallen to 1 / e, seconds."""
LEAST_GAIN = 0.002
"""Least rise of the silhouettes' IoU that shows a movement, if poses are fitted to keypoints alone.
Synthetic people whose photos are of one moment lose 0.012. If their joints are bent by 2 degrees,
they gain 0.005. A real man who turns before a camera gains 0.017.
"""


class Movement(NamedTuple):
    """How well masks agree with a shared pose and with a pose for each photo."""

    before: float
    """Mean IoU of the masks and the body in the shared pose. NaN without masks."""
    after: float
    """Mean IoU of the masks and the body in a pose for each photo, which was fitted to keypoints
    alone. NaN without masks.
    """

    @property
    def shown(self) -> bool:
        """Whether the masks show that the person moved."""
        return self.after > self.before + LEAST_GAIN


def find_movement(
    capture: Capture, keypoints: Keypoints, seconds: Float[np.ndarray, " v"] | None = None
) -> Movement:
    """Returns how well the body fills the masks in the shared pose, and in a pose for each photo
    that is fitted to keypoints alone.

    Arguments:
        capture: photos with masks, and a body in poses that they share.
        keypoints: keypoints of the capture's views, as a fit has stored them.
        seconds: times of a video's photos, (v,), rising. None: the photos have no order.
    """
    start = with_own_poses(capture)
    judge = SilhouetteFit.of(start, keypoints, CONFIG)
    unmasked = dataclasses.replace(start, masks=None)
    # three rounds: a fit to keypoints alone has nothing to match anew
    config = dataclasses.replace(CONFIG, iterations=3)
    blind = SilhouetteFit.of(unmasked, keypoints, config, _memory(seconds))
    tried = moved_capture(start, blind.origin, blind.run()[0])
    ious = [judge.score(each).iou for each in (start, tried)]
    return Movement(*(np.nan if iou is None else iou for iou in ious))


def fit_own_poses(
    capture: Capture, keypoints: Keypoints, seconds: Float[np.ndarray, " v"] | None = None
) -> RefinedCapture:
    """Returns the capture with a pose for each photo, fitted to masks and keypoints. The cameras
    stay, and the shape hardly changes. If the result is not clearly better, each photo has the
    shared pose.

    Arguments: see `find_movement`.
    """
    return refine_capture(
        with_own_poses(capture), keypoints=keypoints, config=CONFIG, memory=_memory(seconds)
    )


def _memory(seconds: Float[np.ndarray, " v"] | None) -> Float[np.ndarray, " n"] | None:
    """Returns the correlations of the deviations of successive photos, (v - 1,). None without
    times.
    """
    return None if seconds is None else np.exp(-np.diff(seconds) / MEMORY)


def with_own_poses(capture: Capture) -> Capture:
    """Returns the capture with a frame for each photo, in the pose of the frame that it had."""
    frames = np.asarray(capture.frames)
    poses = replace(
        capture.poses,
        rotations=from_host(np.asarray(capture.poses.rotations)[frames]),
        translation=from_host(np.asarray(capture.poses.translation)[frames]),
    )
    return dataclasses.replace(
        capture, frames=np.arange(capture.view_count, dtype=np.int32), poses=poses
    )


def record_of_photos(record: FitRecord, frames: Int[np.ndarray, " v"]) -> FitRecord:
    """Returns the record of a fit with a frame for each of the v photos.

    frames: the frame of the fit that each photo showed before, (v,).
    """
    rows = {name: getattr(record, name)[frames] for name in ("noise", "joint_std", "determined")}
    return dataclasses.replace(record, **rows)


def movement_line(capture: Capture) -> str:
    """Returns a line that says how far the person moved between photos that have a pose each.

    For each photo, it measures how far the skin is from its place in the mean of all poses. This is
    a mean over the skin, across the line of sight, because a photo does not show depths. The line
    has the largest number of all photos.
    """
    frames = np.asarray(capture.frames)
    poses = jax.tree.map(np.asarray, capture.poses)
    mean = replace(
        poses,
        rotations=poses.rotations.mean(axis=0, keepdims=True),
        translation=poses.translation.mean(axis=0, keepdims=True),
    )
    betas = from_host(capture.betas)
    own, shared = (np.asarray(posed_vertices(capture.body, betas, each)) for each in (poses, mean))
    moved = (own - shared)[frames]
    across = np.einsum("vab,vnb->vna", np.asarray(capture.cameras.cam_from_world)[:, :2, :3], moved)
    centimetres = 100 * float(np.linalg.norm(across, axis=-1).mean(axis=-1).max())
    return (
        f"the person moved by up to {max(1, round(centimetres))} cm between the photos: a pose for"
        " each"
    )
