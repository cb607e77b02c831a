"""People as a detector sees them in photos without a calibration: pixels, and 3D landmarks with the errors that it makes."""

import jax.numpy as jnp
import numpy as np
from fit_people import betas_of, model_of, rotations_of

from humangs_jax.body.landmarks import pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.data.keypoints.keypoints import SIDES, mirrored_name
from humangs_jax.fitting.person_cameras import PersonViews
from humangs_jax.geometry.quaternion import matrix_from_axis_angle

PARTS = ("eye", "ear", "shoulder", "elbow", "wrist", "index_1", "hip", "knee", "ankle", "heel", "big_toe")
NAMES = ("nose", *(f"{side}_{part}" for part in PARTS for side in SIDES))
MIRROR = [NAMES.index(mirrored_name(name)) for name in NAMES]
FOCAL, SIZE, DISTANCE = 1680.0, (1088, 1920), 3.6


def turned(vector):
    return np.asarray(matrix_from_axis_angle(jnp.asarray(vector, jnp.float32)), float)


def posed(pose="standing", seed=0, change=0.0):
    """Landmarks (k, 3) of the shipped body, metres. change: std of random turns of all joints but the first, radians."""
    rng = np.random.default_rng(seed)
    rotations = rotations_of(pose) + change * rng.normal(size=rotations_of(pose).shape)
    pose = BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros(3))
    return np.asarray(pose_landmarks(model_of(NAMES), jnp.asarray(betas_of(seed)), pose)[0], float)


def cameras_around(views, seed=0):
    """cam_from_world (c, 4, 4) in float64 of cameras somewhere around the origin, nearly level, that see the person whole."""
    rng = np.random.default_rng(seed)
    matrices = []
    for azimuth in 2 * np.pi * (np.arange(views) + rng.uniform(-0.25, 0.25, views)) / max(views, 3):
        pitch, roll = rng.normal(0.1, 0.1), rng.normal(0, 0.03)
        rotation = turned([0, 0, roll]) @ turned([pitch, 0, 0]) @ turned([np.pi, 0, 0]) @ turned([0, azimuth, 0])
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = [rng.uniform(-0.2, 0.2), rng.uniform(-0.1, 0.1), DISTANCE * rng.uniform(0.9, 1.2)]
        matrices.append(matrix)
    return np.asarray(matrices)


def seen_by(landmarks, matrices, *, seed=0, pixels=0.0, world=0.0, turn=0.0, size=1.0, focal=FOCAL):
    """What a detector sees. landmarks: (k, 3), or (c, k, 3) of photos of several moments. pixels, world: std of its noise, pixels
    and metres; turn: std of the turn of a view's 3D landmarks, degrees; size: factor on them.
    """
    rng, views = np.random.default_rng(seed), len(matrices)
    landmarks = np.broadcast_to(landmarks, (views, *landmarks.shape[-2:]))
    local = np.einsum("cab,ckb->cka", matrices[:, :3, :3], landmarks) + matrices[:, None, :3, 3]
    points = local[..., :2] / local[..., 2:] * FOCAL + np.asarray(SIZE) / 2 + rng.normal(0, 1, (*local.shape[:2], 2)) * pixels
    hips = local[:, [NAMES.index("left_hip"), NAMES.index("right_hip")]].mean(1)
    own = []
    for each, middle in zip(local, hips, strict=True):
        x, y, z = middle
        look = turned([0, np.arctan2(x, z), 0]) @ turned([-np.arctan2(y, np.hypot(x, z)), 0, 0])  # z to the ray
        own.append((each - middle) @ look @ turned(np.deg2rad(turn) * rng.normal(0, 1, 3)))
    own = size * np.asarray(own) + world * rng.normal(0, 1, local.shape)
    return PersonViews(
        points=points,
        visibility=np.ones(local.shape[:2]),
        world=own,
        names=NAMES,
        sizes=(SIZE,) * views,
        focal=np.full(views, focal),
        photos=tuple(f"p{i}.jpg" for i in range(views)),
    )


def errors_of(found, matrices):
    """Rotations (c,) in degrees and centres (c,) in metres against the truth, after the similarity that fits best; one camera:
    its distance.
    """

    mine = np.asarray([camera.cam_from_world for camera in found.cameras], float)
    u, _, vt = np.linalg.svd(np.einsum("cba,cbd->ad", mine[:, :3, :3], matrices[:, :3, :3]))
    world = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt  # mine from true
    relative = np.einsum("cab,bd,ced->cae", mine[:, :3, :3], world, matrices[:, :3, :3])
    angles = np.rad2deg(np.arccos(np.clip((np.trace(relative, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    center = lambda m: -np.einsum("cba,cb->ca", m[:, :3, :3], m[:, :3, 3])
    a, b = center(mine) @ world, center(matrices)
    a, b = a - a.mean(0), b - b.mean(0)
    scale = (a * b).sum() / max((a * a).sum(), 1e-12)
    return angles, np.linalg.norm(scale * a - b, axis=1), scale
