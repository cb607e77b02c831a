"""From photos with cameras and keypoints to a capture with a body."""

import dataclasses
import functools

import numpy as np

from humangs_jax.body.landmarks import LandmarkModel, landmark_model
from humangs_jax.body.model import BodyModel, without_expression
from humangs_jax.data.capture import DEFAULT_BODY, Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.photos import Photos
from humangs_jax.fitting.camera_errors import CameraError, find_camera_errors, mended
from humangs_jax.fitting.examination import examine
from humangs_jax.fitting.files import FitRecord
from humangs_jax.fitting.landmark_fit import (
    FEW,
    MOTION_SCALE,
    STAGES,
    FitConfig,
    LandmarkFit,
    accelerations,
    fit_landmarks,
)
from humangs_jax.fitting.report import FitReport, Stage
from humangs_jax.fitting.residuals.keypoints import Observations, group_by_frame
from humangs_jax.fitting.swaps import find_mirrored
from humangs_jax.fitting.uncertainty import fit_uncertainty

FAR = 4.0
"""A frame is far from its neighbours if its distance from their midpoint exceeds this multiple of half their distance."""


@dataclasses.dataclass(frozen=True, eq=False)
class FittedCapture:
    """A fit in memory: the capture with its body, the record that is stored beside it, and what the solver did.

    camera_errors: turns of cameras, which the capture's are without.
    """

    capture: Capture
    record: FitRecord
    fit: LandmarkFit
    model: LandmarkModel
    observations: Observations
    config: FitConfig
    camera_errors: tuple[CameraError, ...] = ()

    @functools.cached_property
    def report(self) -> FitReport:
        """How good it is. Made when asked for: it fits the mirrored keypoints and tries exchanges of views."""
        record, fit, kind = self.record, self.fit, self.record.keypoints.set
        known = {name: getattr(record, name) for name in ("joint_std", "determined", "noise")}
        mirrored = find_mirrored(self.model, self.observations, kind, fit, self.config)
        report = examine(self.capture, record.keypoints, mirrored=mirrored, **known).report
        seen = np.asarray(self.observations.confidences) * np.asarray(self.model.known) > 0
        smooth = "motion" in fit.outcomes
        names = (name for name in (*STAGES, "person", "motion") if name in fit.outcomes)
        stages = tuple(Stage.of(stage, fit.outcomes[stage]) for stage in names)
        warnings = (*report.warnings, *_blind_frames(seen, smooth), *_motion_warnings(fit, self.config.smoothness))
        turned = (f"{error}: turned back" for error in self.camera_errors)
        return dataclasses.replace(report, stages=stages, notes=(*report.notes, *turned), warnings=warnings)


def fit_photos(
    photos: Photos,
    keypoints: Keypoints,
    body: BodyModel,
    *,
    body_file: str = DEFAULT_BODY,
    config: FitConfig | None = None,
    fixed_cameras: bool = False,
) -> FittedCapture:
    """Find shape and poses of the person in photos, and turn cameras back that the keypoints show to be turned.

    Arguments: keypoints: of each view, in the order of the photos. body_file: where the body comes from, see `Capture`.
    fixed_cameras: they stay as they are.
    Raises: ValueError if the numbers of views differ, no view has a keypoint that the body has, or the body's root is not its
    first joint.
    """
    config = config or FitConfig()
    if len(keypoints.points) != len(photos.names):
        raise ValueError(f"keypoints of {len(keypoints.points)} views, but there are {len(photos.names)} photos")
    if body.parents.index(-1) != 0:
        raise ValueError(
            f"body '{body.name}': expected the root to be its first joint, got joint {body.parents.index(-1)}"
        )
    errors = () if fixed_cameras else tuple(e for e in find_camera_errors(photos, keypoints) if not e.late)
    photos = mended(photos, errors) if errors else photos
    model = landmark_model(without_expression(body), keypoints.set.names, keypoints.set.places)
    observations, _ = group_by_frame(photos, keypoints)
    if not (np.asarray(observations.confidences) * np.asarray(model.known) > 0).any():
        raise ValueError("no view has a keypoint that the body has: nothing to fit")
    fit = fit_landmarks(model, observations, config)
    found = fit_uncertainty(model, observations, fit, config)
    capture = Capture(**vars(photos), body=body, betas=np.asarray(fit.betas), poses=fit.poses, body_file=body_file)
    known = (np.asarray(fit.noise), found.joint_std, found.determined, found.shape_covariance)
    record = FitRecord(keypoints, photos.names, *known)
    return FittedCapture(capture, record, fit, model, observations, config, errors)


def _blind_frames(seen, smooth):
    """Warnings about frames (m, c, k) with few keypoints or a single view. smooth: whether the motion is."""
    taken = "interpolated between its neighbours" if smooth else "the prior's, not the photos'"
    for frame, views in enumerate(seen):
        points, cameras = int(views.any(0).sum()), int(views.any(1).sum())
        if points < FEW:
            yield f"frame {frame}: {points} keypoints are seen: its pose is {taken}"
        elif cameras == 1:
            yield f"frame {frame}: seen by one view: distance and height are hardly determined"


def _motion_warnings(fit, smoothness):
    """Warnings about motion that was to be smooth."""
    if not smoothness:
        return
    if len(fit.noise) < 3:
        yield f"smoothness: {len(fit.noise)} frames have no acceleration: it changes nothing"
        return
    held, joints = float(fit.smoothness), np.asarray(fit.joints, float)
    if not held:
        yield "smoothness: the keypoints contradict a smooth motion: frames are fitted one by one"
    elif held > 1.5 * smoothness:
        yield f"smoothness {smoothness:g}: the keypoints contradict it: accelerations are held to {held:g} instead"
    off = np.linalg.norm(accelerations(joints), axis=-1).mean(-1) / 2
    around = np.linalg.norm(joints[2:] - joints[:-2], axis=-1).mean(-1)
    for frame in 1 + np.flatnonzero(off > FAR * around / 2 + MOTION_SCALE * smoothness):
        yield f"frame {frame}: {off[frame - 1]:.2f} m from where the frames beside it would have it: is it somebody else?"
