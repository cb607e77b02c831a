"""A person in known poses before known cameras, without the generator: quick to make, and of every kind of pose."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose
from humangs_jax.data.keypoints.keypoints import COCO_WHOLEBODY_133
from humangs_jax.fitting.residuals.keypoints import make_observations
from humangs_jax.fitting.state import MIRROR
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

SIZE = 512
VIEWS = 4

POSES = {
    "standing": {"left_shoulder": (0, 0, -1.2), "left_elbow": (0, -0.4, 0), "left_hip": (-0.3, 0, 0), "left_knee": (0.5, 0, 0)},
    "arms above head": {"left_shoulder": (0, -0.2, 1.3), "left_elbow": (0, -0.3, 0)},
    "crouching": {"left_hip": (-1.6, 0.2, 0.1), "left_knee": (1.9, 0, 0), "left_ankle": (-0.5, 0, 0), "spine1": (0.3, 0, 0)},
    "lying": {"pelvis": (-np.pi / 2, 0, 0), "left_shoulder": (0, 0, -1.0)},
    "facing away": {"pelvis": (0, 3.0, 0), "left_elbow": (0, -1.0, 0)},
}
"""Rotation vectors of the left side; the right side mirrors them."""
NAMES_WITHIN_LIMITS = tuple(POSES)


def rotations_of(pose):
    rotations = np.zeros((len(JOINT_NAMES), 3), np.float32)
    for name, vector in POSES[pose].items():
        rotations[JOINT_NAMES.index(name)] = vector
        if name.startswith("left_"):
            rotations[JOINT_NAMES.index(name.replace("left", "right"))] = MIRROR * np.asarray(vector)
    return rotations


@functools.cache
def default_body():
    return load_body()


@functools.cache
def model_of(names=COCO_WHOLEBODY_133.names):
    return landmark_model(default_body(), names)


def betas_of(seed):
    return np.random.default_rng(seed).normal(0, 0.7, default_body().shape_directions.shape[-1]).astype(np.float32)


@functools.partial(jax.jit, static_argnames="views")
def _truth(model, betas, rotations, translations, turn, views):
    landmarks, joints = jax.vmap(lambda r, t: pose_landmarks(model, betas, BodyPose(r, t)))(rotations, translations)
    azimuths = turn + jnp.arange(views) * (2 * jnp.pi / views)
    K = intrinsics_from_fov(1.0, SIZE, SIZE)
    place = lambda center: orbit(center, jnp.full(views, 3.4), azimuths, jnp.full(views, 0.15), K, SIZE, SIZE)
    return landmarks, joints, jax.vmap(place)(joints.mean(1))


def observe(poses, *, seed=0, views=VIEWS, noise=0.0, outliers=0.0, model=None):
    """True joints (m, j, 3), betas, and observations of one person in poses (m), with noise and outliers in pixels."""
    model, rng = model_of() if model is None else model, np.random.default_rng(seed)
    rotations = np.stack([rotations_of(pose) for pose in poses])
    translations = rng.uniform(-0.5, 0.5, (len(poses), 3)).astype(np.float32)
    betas = betas_of(seed)
    landmarks, joints, cameras = _truth(model, betas, rotations, translations, rng.uniform(0, 6), views)
    K, pose = np.asarray(cameras.K), np.asarray(cameras.cam_from_world)
    seen = np.einsum("mcab,mkb->mcka", pose[..., :3, :3], landmarks) + pose[..., None, :3, 3]
    pixels = seen[..., :2] / seen[..., 2:] * K[..., None, [0, 1], [0, 1]] + K[..., None, :2, 2]
    pixels += rng.normal(0, 1, pixels.shape) * noise
    wild = rng.random(pixels.shape[:-1]) < outliers
    pixels += wild[..., None] * rng.uniform(-100, 100, pixels.shape)
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), pixels.shape[:-1]).copy()
    return np.asarray(joints), betas, make_observations(pixels, confidences, K, pose)
