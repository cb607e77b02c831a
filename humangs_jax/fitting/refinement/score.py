"""How well a body agrees with masks and keypoints: what decides whether a refinement is kept."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.landmarks import LandmarkModel, pose_landmarks
from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.geometry.camera import project


@dataclasses.dataclass(frozen=True, eq=False)
class Score:
    """ious: (v,) of silhouettes, NaN without a mask. iou: their mean; None without any mask. keypoints: pixels, median; None
    without.

    loss: what is compared, the less the better: the part of the silhouettes that does not overlap, and the keypoints' error
    as a share of the person's height in the picture.
    """

    ious: Float[np.ndarray, " v"]
    iou: float | None
    keypoints: float | None
    loss: float

    def named(self) -> dict[str, float]:
        """What is known, by name."""
        values = {"silhouette_iou": self.iou, "keypoint_error_px": self.keypoints, "loss": self.loss}
        return {name: value for name, value in values.items() if value is not None}


def score_of(ious: Float[np.ndarray, " v"], errors: Float[np.ndarray, " k"] | None, height: float) -> Score:
    """From the overlaps of views (NaN: no mask) and the errors of keypoints; height: of the person, pixels."""
    iou = None if np.isnan(ious).all() else float(np.nanmean(ious))
    keypoints = None if errors is None or not len(errors) else float(np.median(errors))
    loss = (0.0 if iou is None else 1 - iou) + (0.0 if keypoints is None else keypoints / height)
    return Score(ious, iou, keypoints, loss)


def overlap(covered: Bool[np.ndarray, "h w"], mask: Float[np.ndarray, "h w"]) -> float:
    """Intersection over union of a body and a mask; NaN for an empty mask."""
    person = mask > 0.5
    return float((covered & person).sum() / (covered | person).sum()) if person.any() else float("nan")


def keypoint_distances(capture: Capture, model: LandmarkModel, keypoints: Keypoints) -> Float[np.ndarray, " k"]:
    """Pixels between landmarks and keypoints of all views, of those that both have."""
    landmarks = np.asarray(_landmarks(model, jnp.asarray(capture.betas), capture.poses))
    known = np.asarray(model.known)
    seen = []
    for view, frame in enumerate(capture.frames):
        pixels, depths = (np.asarray(x) for x in project(capture.cameras[view], jnp.asarray(landmarks[int(frame)])))
        used = known & (keypoints.confidences[view] > 0)
        errors = np.linalg.norm(pixels - keypoints.points[view], axis=-1)
        seen.append(np.where(depths > 0, errors, np.inf)[used])
    return np.concatenate(seen)


@jax.jit
def _landmarks(model, betas, poses):
    return jax.vmap(lambda pose: pose_landmarks(model, betas, pose)[0])(poses)


@jax.jit
def posed_vertices(body: BodyModel, betas: Float[jax.Array, " s"], poses: BodyPose) -> Float[jax.Array, "m n 3"]:
    """Vertices of a person in a batch of m poses, metres."""
    rest = shape_body(body, betas)
    return jax.lax.map(lambda pose: pose_body(body, rest, pose).vertices, poses)
