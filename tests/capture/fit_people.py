"""People before known cameras for tests of fits, in many kinds of pose, without the generator.

There are a toy body, whose fit compiles quickly; chosen poses of the shipped body; random poses
with their keypoints; and detections in photos without a calibration.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.landmarks import LandmarkModel, landmark_model, pose_landmarks
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyPose, SurfacePoints
from humangs_jax.capture.fitting.person_moments import PersonViews
from humangs_jax.capture.fitting.residuals.keypoints import make_observations
from humangs_jax.capture.fitting.state import MIRROR, pose_prior
from humangs_jax.capture.keypoints.keypoints import (
    COCO_17,
    COCO_WHOLEBODY_133,
    SIDES,
    Keypoints,
    mirrored_name,
)
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.geometry.quaternion import matrix_from_axis_angle

# A body of four joints and eight landmarks
# -----------------------------------------------------------------------------

TOY_JOINTS = np.asarray([[0, 0, 0], [0, 0.5, 0], [0, 1.0, 0], [0.5, 1.0, 0]], np.float32)


def toy_model():
    """Returns a model of four joints and eight landmarks: the joints and a point beside each."""
    beside = TOY_JOINTS + np.asarray([0.05, 0.1, 0.15], np.float32)
    points = SurfacePoints(jnp.asarray(beside), jnp.zeros((4, 3, 1)), None, jnp.eye(4))
    names = tuple(f"joint{i}" for i in range(4))
    return LandmarkModel(
        joints=jnp.asarray(TOY_JOINTS),
        joint_directions=jnp.asarray(0.1 * TOY_JOINTS[..., None]),
        points=points,
        regressor=jnp.eye(8),
        certainty=jnp.ones(8),
        names=(*names, *(f"point{i}" for i in range(4))),
        known=(True,) * 8,
        parents=(-1, 0, 1, 2),
        joint_names=names,
        movers=(0, 1, 2, 3),
    )


TOY_MODEL = toy_model()


# Known poses
# --------------------------------------------------------------------------------------------------

SIZE = 512
VIEWS = 4

POSES = {
    "standing": {
        "left_shoulder": (0, 0, -1.2),
        "left_elbow": (0, -0.4, 0),
        "left_hip": (-0.3, 0, 0),
        "left_knee": (0.5, 0, 0),
    },
    "arms above head": {"left_shoulder": (0, -0.2, 1.3), "left_elbow": (0, -0.3, 0)},
    "crouching": {
        "left_hip": (-1.6, 0.2, 0.1),
        "left_knee": (1.9, 0, 0),
        "left_ankle": (-0.5, 0, 0),
        "spine1": (0.3, 0, 0),
    },
    "lying": {"pelvis": (-np.pi / 2, 0, 0), "left_shoulder": (0, 0, -1.0)},
    "facing away": {"pelvis": (0, 3.0, 0), "left_elbow": (0, -1.0, 0)},
}
"""Rotation vectors of the left side; those of the right side are mirrored."""


def rotations_of(pose):
    rotations = np.zeros((len(JOINT_NAMES), 3), np.float32)
    for name, vector in POSES[pose].items():
        rotations[JOINT_NAMES.index(name)] = vector
        if name.startswith("left_"):
            rotations[JOINT_NAMES.index(name.replace("left", "right"))] = MIRROR * np.asarray(
                vector
            )
    return rotations


@functools.cache
def default_body():
    return load_body()


@functools.cache
def model_of(names=COCO_WHOLEBODY_133.names):
    return landmark_model(default_body(), names)


def betas_of(seed):
    return (
        np.random.default_rng(seed)
        .normal(0, 0.7, default_body().shape_directions.shape[-1])
        .astype(np.float32)
    )


@functools.partial(jax.jit, static_argnames="views")
def _truth(model, betas, rotations, translations, turn, views):
    landmarks, joints = jax.vmap(lambda r, t: pose_landmarks(model, betas, BodyPose(r, t)))(
        rotations, translations
    )
    azimuths = turn + jnp.arange(views) * (2 * jnp.pi / views)
    K = intrinsics_from_fov(1.0, SIZE, SIZE)

    def place(center):
        return orbit(center, jnp.full(views, 3.4), azimuths, jnp.full(views, 0.15), K, SIZE, SIZE)

    return landmarks, joints, jax.vmap(place)(joints.mean(1))


def observe(poses, *, seed=0, views=VIEWS, noise=0.0, outliers=0.0, model=None):
    """Returns (true joints (m, j, 3), betas, observations) of one person in m poses.

    `noise` is in pixels; `outliers` is the share of landmarks that are far off.
    """
    model, rng = model_of() if model is None else model, np.random.default_rng(seed)
    rotations = np.stack([rotations_of(pose) for pose in poses])
    translations = rng.uniform(-0.5, 0.5, (len(poses), 3)).astype(np.float32)
    betas = betas_of(seed)
    landmarks, joints, cameras = _truth(
        model, betas, rotations, translations, rng.uniform(0, 6), views
    )
    K, pose = np.asarray(cameras.K), np.asarray(cameras.cam_from_world)
    seen = np.einsum("mcab,mkb->mcka", pose[..., :3, :3], landmarks) + pose[..., None, :3, 3]
    pixels = seen[..., :2] / seen[..., 2:] * K[..., None, [0, 1], [0, 1]] + K[..., None, :2, 2]
    pixels += rng.normal(0, 1, pixels.shape) * noise
    wild = rng.random(pixels.shape[:-1]) < outliers
    pixels += wild[..., None] * rng.uniform(-100, 100, pixels.shape)
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), pixels.shape[:-1]).copy()
    return np.asarray(joints), betas, make_observations(pixels, confidences, K, pose)


# Captures of random poses whose keypoints in some views are known
# ------------------------------------------------------

PHOTO_SIZE, NOISE = 256, 1.0


@functools.cache
def _landmarks(names):
    model = landmark_model(default_body(), names)
    return jax.jit(jax.vmap(lambda pose: pose_landmarks(model, jnp.zeros(4), pose)[0]))


def person(
    seed, frames, views, *, still=False, even=False, moving=False, outliers=0.0, kind=COCO_17
):
    """Returns a capture without photos and noisy keypoints of it.

    Views of a frame follow each other and are named m0v0, m0v1 and so on.

    Args:
        seed: of poses, cameras and noise.
        frames: number of moments.
        views: number of views of a moment.
        still: whether the cameras are the same in all frames.
        even: whether the cameras are evenly spaced around the person.
        moving: whether the person moves from one random pose to the next in 8 frames; else each
            frame has a random pose.
        outliers: share of the keypoints that are far from where they belong.
        kind: the set of keypoints.
    """
    rng = np.random.default_rng(seed)
    prior = pose_prior(default_body().joint_names)
    rotations = prior.mean + prior.std * rng.normal(0, 0.7, (frames, *prior.mean.shape))
    rotations = np.clip(rotations, prior.lower, prior.upper)
    # the whole body turns about the vertical only
    rotations[:, 0] = [[0, angle, 0] for angle in rng.uniform(-np.pi, np.pi, frames)]
    if moving:
        rotations[:, 0] = rotations[0, 0]
        # a smooth step between two of the random poses
        whole, share = np.divmod(np.arange(frames) / 8, 1)
        share = (1 - np.cos(np.pi * share[:, None, None])) / 2
        first = whole.astype(int)
        rotations = rotations[first] * (1 - share) + rotations[first + 1] * share
    poses = jax.vmap(BodyPose)(jnp.asarray(rotations, jnp.float32), jnp.zeros((frames, 3)))
    cameras = _cameras(rng, frames, views, still, even)
    landmarks = np.asarray(_landmarks(kind.names)(poses))
    frame_of = np.repeat(np.arange(frames), views)
    matrices = np.asarray(cameras.cam_from_world)
    # landmarks in pixels, with noise and some far away
    local = (
        np.einsum("vab,vkb->vka", matrices[:, :3, :3], landmarks[frame_of])
        + matrices[:, None, :3, 3]
    )
    points = local[..., :2] / local[..., 2:] * np.asarray(cameras.K)[0, 0, 0] + PHOTO_SIZE / 2
    points += rng.normal(0, NOISE, points.shape)
    wild = rng.random(points.shape[:2]) < outliers
    points[wild] += rng.uniform(-PHOTO_SIZE / 4, PHOTO_SIZE / 4, points[wild].shape)
    capture = Capture(
        images=np.ones((len(frame_of), PHOTO_SIZE, PHOTO_SIZE, 3), np.float32),
        masks=None,
        cameras=cameras,
        frames=frame_of.astype(np.int32),
        body=default_body(),
        betas=np.zeros(4, np.float32),
        poses=poses,
        names=tuple(f"m{m}v{v}" for m in range(frames) for v in range(views)),
    )
    return capture, Keypoints(
        points.astype(np.float32), np.ones(points.shape[:2], np.float32), kind
    )


def _cameras(rng, frames, views, still, even):
    K = intrinsics_from_fov(0.8, PHOTO_SIZE, PHOTO_SIZE)
    starts = np.full(frames, 0.3) if still else rng.uniform(0, 2 * np.pi, frames)
    uneven = 0 if even else rng.uniform(-0.3, 0.3, views)
    azimuths = (starts[:, None] + (np.arange(views) + uneven) * 2 * np.pi / views).ravel()
    return orbit(
        jnp.asarray([0.0, -0.3, 0.0]),
        2.8,
        jnp.asarray(azimuths, jnp.float32),
        0.1,
        K,
        PHOTO_SIZE,
        PHOTO_SIZE,
    )


# As a detector sees them: pixels, and 3D landmarks with the errors that it makes
# ---------------------------------------

PARTS = (
    "eye",
    "ear",
    "shoulder",
    "elbow",
    "wrist",
    "index_1",
    "hip",
    "knee",
    "ankle",
    "heel",
    "big_toe",
)
NAMES = ("nose", *(f"{side}_{part}" for part in PARTS for side in SIDES))
MIRRORED = [NAMES.index(mirrored_name(name)) for name in NAMES]
FOCAL, PHONE, DISTANCE = 1680.0, (1088, 1920), 3.6


def turned(vector):
    return np.asarray(matrix_from_axis_angle(jnp.asarray(vector, jnp.float32)), float)


def posed(pose="standing", seed=0, change=0.0):
    """Returns landmarks (k, 3) of the shipped body, metres.

    `change` is the standard deviation of random turns of all joints but the first, radians.
    """
    rng = np.random.default_rng(seed)
    rotations = rotations_of(pose) + change * rng.normal(size=rotations_of(pose).shape)
    pose = BodyPose(jnp.asarray(rotations, jnp.float32), jnp.zeros(3))
    return np.asarray(pose_landmarks(model_of(NAMES), jnp.asarray(betas_of(seed)), pose)[0], float)


def cameras_around(views, seed=0):
    """Returns cam_from_world (c, 4, 4), float64, of level cameras that see the whole person.

    They are nearly level, and somewhere around the origin.
    """
    rng = np.random.default_rng(seed)
    matrices = []
    for azimuth in 2 * np.pi * (np.arange(views) + rng.uniform(-0.25, 0.25, views)) / max(views, 3):
        pitch, roll = rng.normal(0.1, 0.1), rng.normal(0, 0.03)
        rotation = (
            turned([0, 0, roll])
            @ turned([pitch, 0, 0])
            @ turned([np.pi, 0, 0])
            @ turned([0, azimuth, 0])
        )
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        matrix[:3, 3] = [
            rng.uniform(-0.2, 0.2),
            rng.uniform(-0.1, 0.1),
            DISTANCE * rng.uniform(0.9, 1.2),
        ]
        matrices.append(matrix)
    return np.asarray(matrices)


def seen_by(landmarks, matrices, *, seed=0, pixels=0.0, world=0.0, turn=0.0, size=1.0, focal=FOCAL):
    """Returns what a detector finds in photos of a person.

    Args:
        landmarks: (k, 3), or (c, k, 3) for photos of several moments.
        matrices: cam_from_world of the photos.
        seed: of the noise.
        pixels: standard deviation of pixels.
        world: standard deviation of the 3D landmarks, metres.
        turn: standard deviation of the turn of a view's 3D landmarks, degrees.
        size: factor on the 3D landmarks.
        focal: focal length, pixels.
    """
    rng, views = np.random.default_rng(seed), len(matrices)
    landmarks = np.broadcast_to(landmarks, (views, *landmarks.shape[-2:]))
    local = np.einsum("cab,ckb->cka", matrices[:, :3, :3], landmarks) + matrices[:, None, :3, 3]
    points = (
        local[..., :2] / local[..., 2:] * FOCAL
        + np.asarray(PHONE) / 2
        + rng.normal(0, 1, (*local.shape[:2], 2)) * pixels
    )
    hips = local[:, [NAMES.index("left_hip"), NAMES.index("right_hip")]].mean(1)
    own = []
    for each, middle in zip(local, hips, strict=True):
        x, y, z = middle
        # z to the ray
        look = turned([0, np.arctan2(x, z), 0]) @ turned([-np.arctan2(y, np.hypot(x, z)), 0, 0])
        own.append((each - middle) @ look @ turned(np.deg2rad(turn) * rng.normal(0, 1, 3)))
    own = size * np.asarray(own) + world * rng.normal(0, 1, local.shape)
    return PersonViews(
        points=points,
        visibility=np.ones(local.shape[:2]),
        world=own,
        names=NAMES,
        sizes=(PHONE,) * views,
        focal=np.full(views, focal),
        photos=tuple(f"p{i}.jpg" for i in range(views)),
    )


def errors_of(found, matrices):
    """Returns (rotation errors (c,) in degrees, centre errors (c,) in metres, scale).

    They remain after the similarity that fits best; of a single camera the distance is compared.
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
