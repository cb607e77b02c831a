"""People in random poses whose keypoints in some views are known, for the tests of what looks at fits."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from fit_people import default_body as body

from humangs_jax.body.landmarks import landmark_model, pose_landmarks
from humangs_jax.body.model import BodyPose
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.fitting.state import pose_prior
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

SIZE, NOISE = 256, 1.0


@functools.cache
def _landmarks(names):
    model = landmark_model(body(), names)
    return jax.jit(jax.vmap(lambda pose: pose_landmarks(model, jnp.zeros(4), pose)[0]))


def person(seed, frames, views, *, still=False, even=False, moving=False, outliers=0.0, kind=COCO_17):
    """A capture and noisy keypoints of it, views of a frame one after the other, named m0v0, m0v1, ...

    still: cameras are the same for all frames. even: evenly spaced around the person. moving: from one pose to another in 8
    frames, and not at random.
    """
    rng = np.random.default_rng(seed)
    prior = pose_prior(body().joint_names)
    rotations = prior.mean + prior.std * rng.normal(0, 0.7, (frames, *prior.mean.shape))
    rotations = np.clip(rotations, prior.lower, prior.upper)
    rotations[:, 0] = [[0, angle, 0] for angle in rng.uniform(-np.pi, np.pi, frames)]
    if moving:
        rotations[:, 0] = rotations[0, 0]
        whole, share = np.divmod(np.arange(frames) / 8, 1)
        share = (1 - np.cos(np.pi * share[:, None, None])) / 2
        rotations = rotations[whole.astype(int)] * (1 - share) + rotations[whole.astype(int) + 1] * share
    poses = jax.vmap(BodyPose)(jnp.asarray(rotations, jnp.float32), jnp.zeros((frames, 3)))
    cameras = _cameras(rng, frames, views, still, even)
    landmarks = np.asarray(_landmarks(kind.names)(poses))
    frame_of = np.repeat(np.arange(frames), views)
    matrices = np.asarray(cameras.cam_from_world)
    local = np.einsum("vab,vkb->vka", matrices[:, :3, :3], landmarks[frame_of]) + matrices[:, None, :3, 3]
    points = local[..., :2] / local[..., 2:] * np.asarray(cameras.K)[0, 0, 0] + SIZE / 2
    points += rng.normal(0, NOISE, points.shape)
    wild = rng.random(points.shape[:2]) < outliers
    points[wild] += rng.uniform(-SIZE / 4, SIZE / 4, points[wild].shape)
    capture = Capture(
        images=np.ones((len(frame_of), SIZE, SIZE, 3), np.float32),
        masks=None,
        cameras=cameras,
        frames=frame_of.astype(np.int32),
        body=body(),
        betas=np.zeros(4, np.float32),
        poses=poses,
        names=tuple(f"m{m}v{v}" for m in range(frames) for v in range(views)),
    )
    return capture, Keypoints(points.astype(np.float32), np.ones(points.shape[:2], np.float32), kind)


def _cameras(rng, frames, views, still, even):
    K = intrinsics_from_fov(0.8, SIZE, SIZE)
    starts = np.full(frames, 0.3) if still else rng.uniform(0, 2 * np.pi, frames)
    uneven = 0 if even else rng.uniform(-0.3, 0.3, views)
    azimuths = (starts[:, None] + (np.arange(views) + uneven) * 2 * np.pi / views).ravel()
    return orbit(jnp.asarray([0.0, -0.3, 0.0]), 2.8, jnp.asarray(azimuths, jnp.float32), 0.1, K, SIZE, SIZE)
