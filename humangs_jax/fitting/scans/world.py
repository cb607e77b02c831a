"""Our world for a person in a scan: y up, facing +z, the scan standing on y = 0 with the pelvis over the origin."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose, shape_body
from humangs_jax.core.array_types import Array, Float
from humangs_jax.fitting.scans.reading import Scan
from humangs_jax.fitting.scans.similarity import Similarity
from humangs_jax.geometry import quaternion

UPRIGHT = np.cos(np.radians(25.0))
"""Cosine: an axis of the scan so near to the person's is up."""


@dataclasses.dataclass(frozen=True, eq=False)
class Placement:
    """pose: in the world. world_from_scan: from the file's coordinates. up: what of the scan is up, in words."""

    pose: BodyPose
    world_from_scan: Similarity
    up: str


def place_upright(
    body: BodyModel, scan: Scan, betas: Float[Array, " s"], pose: BodyPose, align: Similarity, size: float
) -> Placement:
    """Turn a fit upright.

    Arguments: betas (s,), pose: of the body in metres, in a frame where the scan is `size * align(points)`.
    """
    frame_from_scan = Similarity(size, np.eye(3), np.zeros(3)).after(align)
    root = np.asarray(quaternion.matrix_from_axis_angle(pose.rotations[0]), np.float64)
    axis, up = _up_axis(root[:, 1], frame_from_scan.rotation)
    forward = root[:, 2] - (root[:, 2] @ axis) * axis
    if np.linalg.norm(forward) < 0.1:  # somebody who lies faces up or down
        forward = root[:, 1] - (root[:, 1] @ axis) * axis
    forward = forward / np.linalg.norm(forward)
    turn = np.stack([np.cross(axis, forward), axis, forward])
    pelvis = np.asarray(shape_body(body, betas).joints[0], np.float64)
    center = turn @ (pelvis + np.asarray(pose.translation, np.float64))
    lowest = (frame_from_scan(scan.points) @ turn.T)[:, 1].min()
    move = -np.asarray([center[0], lowest, center[2]])
    number = lambda x: jnp.asarray(x, jnp.float32)
    rotations = pose.rotations.at[0].set(quaternion.to_axis_angle(quaternion.from_matrix(number(turn @ root))))
    world_from_frame = Similarity(1.0, turn, move)
    return Placement(BodyPose(rotations, number(center + move - pelvis)), world_from_frame.after(frame_from_scan), up)


def _up_axis(own, rotation):
    """Up in the frame, and its name: an axis of the scan near to the person's own, or that."""
    along = own @ rotation
    best = int(np.abs(along).argmax())
    if abs(along[best]) < UPRIGHT:
        return own, "the person's own axis (no axis of the scan is near)"
    sign = np.sign(along[best])
    return sign * rotation[:, best], f"{'+' if sign > 0 else '-'}{'xyz'[best]} of the scan"
