"""Where the cameras of the real capture truly stand: all frames refined together by careful masks, one shape, one set of cameras.

The published calibration is off by a degree. These cameras are what found ones are compared with.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from experiments.real_capture import CAMERAS, FRAMES, SIZE, RealFrame, body_ious, prepare
from humangs_jax.body.library import load_body
from humangs_jax.core.array_types import Float
from humangs_jax.data.photos import Photos
from humangs_jax.detection.blazepose import bilinear
from humangs_jax.fitting.fit_capture import fit_photos
from humangs_jax.fitting.refine_iterations import CaptureRefineConfig, Scene, moved_capture
from humangs_jax.fitting.similarity import Similarity
from humangs_jax.fitting.state import StateStd
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.npz import write_npz

STD = StateStd(
    focal=0.005, camera_rotation=1.5, camera_center=0.03, body_pose=10.0, global_orient=6.0, betas=1.0, clothing=0.001
)
CONFIG = CaptureRefineConfig(std=STD, coefficients=22, robust_scales=(1.0, 1.0), independent=100.0)
"""A body that fills the masks: for cameras, not for avatars."""
TIMES = 4
"""Refinements one after the other: with this number of unknowns one does not converge."""


class Reference(NamedTuple):
    """The cameras of the videos, without distortion. K: (v, 3, 3). cam_from_world: (v, 4, 4)."""

    K: Float[np.ndarray, "v 3 3"]
    cam_from_world: Float[np.ndarray, "v 4 4"]

    def of(self, frame: RealFrame) -> Camera:
        """A batch of the cameras of a frame's photos."""
        pairs = zip(frame.crop @ self.K, self.cam_from_world, strict=True)
        return stack_cameras([Camera.from_opencv(K, matrix, SIZE, SIZE) for K, matrix in pairs])


def reference_cameras(folder: Path, frames: Sequence[int] = FRAMES) -> Reference:
    """Found once, then read from `folder`/prepared/cameras.npz."""
    file = folder / "prepared" / "cameras.npz"
    if not file.exists():
        write_npz(file, _found(list(prepare(folder, frames).values()))._asdict())
    with np.load(file) as stored:
        return Reference(stored["K"], stored["cam_from_world"])


def _found(frames):
    """From all frames, each camera in one square that holds its squares of all: equal cameras count as one."""
    views, back = range(len(CAMERAS)), np.linalg.inv(np.stack([frame.crop for frame in frames]))
    corners = np.einsum("fvab,kb->fvka", back, [[0, 0, 1], [SIZE, SIZE, 1]])[..., :2]
    least, most = corners[:, :, 0].min(0), corners[:, :, 1].max(0)
    common = np.stack([_square(*each) for each in zip(least, most, strict=True)])
    masks, points, cameras, numbers = [], [], [], []
    for number, frame in enumerate(frames):
        for view in views:
            matrix = frame.crop[view] @ np.linalg.inv(common[view])
            steps = np.arange(SIZE) + 0.5
            grid = np.stack(np.meshgrid(steps, steps), axis=-1) * matrix[0, 0] + matrix[:2, 2]
            masks.append(bilinear(frame.careful[view], grid - 0.5, 0.0))
            points.append((frame.keypoints.points[view] - matrix[:2, 2]) / matrix[0, 0])
            K = np.linalg.inv(matrix) @ np.asarray(frame.cameras.K[view], float)
            if number:
                K = cameras[view].K  # of equal cameras, exactly
            cameras.append(Camera.from_opencv(K, frame.cameras.cam_from_world[view], SIZE, SIZE))
            numbers.append(number)
    keypoints = dataclasses.replace(
        frames[0].keypoints,
        points=np.asarray(points, np.float32),
        confidences=np.concatenate([frame.keypoints.confidences for frame in frames]),
    )
    names, white = tuple(name for frame in frames for name in frame.names), np.ones((SIZE, SIZE, 3), np.float32)
    images = np.broadcast_to(white, (len(masks), *white.shape))
    photos = Photos(images, np.stack(masks), stack_cameras(cameras), np.asarray(numbers, np.int32), names)
    found = fit_photos(photos, keypoints, load_body()).capture
    for _ in range(TIMES):
        scene = Scene(found, keypoints, CONFIG)
        found = moved_capture(found, scene.origin, scene.run()[0])
    print("silhouettes with the cameras of all frames:", np.round(body_ious(found, np.stack(masks)), 3))
    first = [np.asarray(each[: len(CAMERAS)], float) for each in (found.cameras.K, found.cameras.cam_from_world)]
    return Reference(np.linalg.inv(common) @ first[0], first[1])


def _square(least, most):
    side = float((most - least).max())
    return np.diag([SIZE / side, SIZE / side, 1.0]) @ [[1, 0, -least[0]], [0, 1, -least[1]], [0, 0, 1]]


def to_reference(own: Camera, reference: Camera) -> Similarity:
    """From the world of cameras (a batch) to that of the same cameras elsewhere: by their axes, then by their places."""
    (rotations, centers), (targets, places) = (_axes(each) for each in (own, reference))
    u, _, vt = np.linalg.svd(np.einsum("vba,vbc->ac", targets, rotations))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    x, y = centers - centers.mean(0), places - places.mean(0)
    scale = float((y * (x @ rotation.T)).sum() / (x * x).sum())
    return Similarity(scale, rotation, places.mean(0) - scale * rotation @ centers.mean(0))


def camera_errors(own: Camera, reference: Camera) -> tuple[Float[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Degrees, and centimetres of the reference's world, after one similarity."""
    move = to_reference(own, reference)
    (rotations, centers), (targets, places) = (_axes(each) for each in (own, reference))
    turns = targets @ move.rotation @ np.swapaxes(rotations, 1, 2)
    cosines = (np.trace(turns, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))), 100 * np.linalg.norm(move(centers) - places, axis=1)


def seen_from(own: Camera, used: Sequence[int], reference: Camera, view: int) -> Camera:
    """A camera of the reference, a batch of one, in the world of own cameras, which are those of the used views."""
    at = np.asarray(used)
    move = to_reference(own, jax.tree.map(lambda leaf: leaf[at], reference))
    matrix = np.asarray(reference.cam_from_world[view], float) @ move.matrix()
    matrix[:3] /= move.scale
    return stack_cameras([Camera.from_opencv(reference.K[view], matrix, SIZE, SIZE)])


def _axes(cameras):
    matrices = np.asarray(cameras.cam_from_world, float)
    return matrices[:, :3, :3], np.linalg.inv(matrices)[:, :3, 3]
