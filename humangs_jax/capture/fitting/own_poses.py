"""Fits a separate pose for each photo. This is for photos that one pose nearly explains, although
the person moved a little from photo to photo.

A person who turns in front of a camera moves head, arms and legs by centimetres. Such photos do not
show one moment, but their moments are not independent either. They share one shape and one set of
cameras. Each photo has a pose that starts at the shared pose and stays near it (`CONFIG`).

Photos of a video follow each other in time. Their deviations x_i from the shared pose, in standard
deviations, are an Ornstein-Uhlenbeck process: x_{i+1} - r x_i has the variance 1 - r^2, with r =
exp(-t / MEMORY) for photos that are t seconds apart.

More unknowns always fit the keypoints better. So the poses are first fitted to the keypoints alone,
and then the masks decide whether the person moved. If the person did not move, these poses follow
the detector's errors, and the body agrees with the masks less than before.
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
"""Settings of a fit in which each photo has a pose that stays near the shared pose."""
MEMORY = 2.0
"""Time after which the correlation between a person's deviations from the shared pose has fallen to
1 / e, seconds.
"""
LEAST_GAIN = 0.002
"""The person has moved if the mean IoU with the masks rises by more than this when poses are fitted
to keypoints alone.

For synthetic people whose photos show one moment, the IoU falls by 0.012. If their joints are bent
by 2 degrees between photos, it rises by 0.005. For a real man who turns in front of a camera it
rises by 0.017.
"""


class Movement(NamedTuple):
    """How well the masks agree with one shared pose, and with a pose for each photo."""

    before: float
    """Mean IoU between the masks and the body in the shared pose. NaN without masks."""
    after: float
    """Mean IoU between the masks and the body if each photo has a pose that was fitted to keypoints
    alone. NaN without masks.
    """

    @property
    def shown(self) -> bool:
        """Whether the masks show that the person moved."""
        return self.after > self.before + LEAST_GAIN


def find_movement(
    capture: Capture, keypoints: Keypoints, seconds: Float[np.ndarray, " v"] | None = None
) -> Movement:
    """Returns how well the body agrees with the masks in the shared pose, and with a separate pose
    for each photo. These poses are fitted to keypoints alone.

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

    Arguments: see `find_movement`. Raises: as `refine_capture`.
    """
    return refine_capture(
        with_own_poses(capture), keypoints=keypoints, config=CONFIG, memory=_memory(seconds)
    )


def _memory(seconds: Float[np.ndarray, " v"] | None) -> Float[np.ndarray, " n"] | None:
    """Returns the correlation between the deviations of each photo and the next, (v - 1,). None if
    there are no times.
    """
    return None if seconds is None else np.exp(-np.diff(seconds) / MEMORY)


def with_own_poses(capture: Capture) -> Capture:
    """Returns the capture with a separate frame for each photo. The frame's pose is a copy of the
    pose that the photo had.
    """
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
    """Returns the record of a fit with a separate frame for each of the v photos.

    frames: the frame in `record` that each photo shows, (v,).
    """
    rows = {name: getattr(record, name)[frames] for name in ("noise", "joint_std", "determined")}
    return dataclasses.replace(record, **rows)


def movement_line(capture: Capture) -> str:
    """Returns a line that says how far the person moved between the photos of a capture with a
    separate pose for each photo.

    In each photo the skin is compared with the skin in the mean of all poses. The movement is the
    mean distance between the two, without the component along the camera's z axis, because a photo
    does not show depths. The line states the largest movement of all photos, in whole centimetres,
    at least 1.
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
