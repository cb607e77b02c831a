"""Synthetic people whose keypoints are known: plausible poses, cameras all around, detections with errors."""

import dataclasses

import numpy as np

POSE_STREAM, CAMERA_STREAM, ERROR_STREAM = 21, 22, 23


@dataclasses.dataclass(frozen=True)
class FitCase:
    """One person in m frames seen by c cameras. betas (s,), rotations (m, j, 3), translations (m, 3), joints (m, j, 3),
    landmarks (m, k, 3) are true; K (m, c, 3, 3) and cam_from_world (m, c, 4, 4).
    """

    betas: np.ndarray
    rotations: np.ndarray
    translations: np.ndarray
    joints: np.ndarray
    landmarks: np.ndarray
    K: np.ndarray
    cam_from_world: np.ndarray


def make_case(seed, body, model, frames, views, size=512) -> FitCase:
    """The person of a seed in random poses, each with cameras of its own, as of the published protocol."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.body.landmarks import pose_landmarks
    from humangs_jax.body.model import BodyPose
    from humangs_jax.people.cameras import cameras_around, spread_azimuths
    from humangs_jax.people.poses import sample_rotations
    from humangs_jax.people.subject import make_subject

    subject = make_subject(seed, body)
    rotations, translations, extrinsics, intrinsics = [], [], [], []
    for frame in range(frames):
        rng = np.random.default_rng([seed, POSE_STREAM, frame])
        pose = sample_rotations(rng, subject.build)
        pose[0] = [0, rng.uniform(-np.pi, np.pi), 0]
        vertices = subject.posed_vertices(pose, np.zeros(3))
        shift = rng.uniform([-1, 0, -1], [1, 0, 1]) - [0, vertices[:, 1].min(), 0]
        rng = np.random.default_rng([seed, CAMERA_STREAM, frame])
        cameras = cameras_around(rng, vertices + shift, spread_azimuths(rng, views), size)
        rotations.append(pose)
        translations.append(shift)
        extrinsics.append(np.asarray(cameras.cam_from_world))
        intrinsics.append(np.asarray(cameras.K))
    rotations, translations = np.asarray(rotations, np.float32), np.asarray(translations, np.float32)
    pose_all = jax.jit(jax.vmap(lambda r, t: pose_landmarks(model, jnp.asarray(subject.betas), BodyPose(r, t))))
    landmarks, joints = pose_all(rotations, translations)
    return FitCase(
        subject.betas,
        rotations,
        translations,
        np.asarray(joints),
        np.asarray(landmarks),
        np.stack(intrinsics),
        np.stack(extrinsics),
    )


def walking(seeds, kind, frames, views, size=512):
    """The landmark model of a keypoint set, and people of these seeds in the first frames of the shipped walk.

    Cameras stand still all around.
    """
    import jax
    import jax.numpy as jnp

    from humangs_jax.body.landmarks import landmark_model, pose_landmarks
    from humangs_jax.body.library import load_body
    from humangs_jax.body.model import BodyPose
    from humangs_jax.data.keypoints.sets import KEYPOINT_SETS
    from humangs_jax.data.motion import load_motion
    from humangs_jax.geometry.camera import intrinsics_from_fov, orbit

    body, motion = load_body(), load_motion()
    model = landmark_model(body, KEYPOINT_SETS[kind].names)
    rotations, translations = (np.asarray(x)[:frames] for x in (motion.rotations, motion.translations))
    pose_all = jax.jit(jax.vmap(lambda betas, r, t: pose_landmarks(model, betas, BodyPose(r, t)), (None, 0, 0)))
    K = intrinsics_from_fov(1.0, size, size)
    people = []
    for seed in seeds:
        rng = np.random.default_rng([seed, POSE_STREAM])
        betas = rng.normal(0, 0.7, model.joint_directions.shape[-1]).astype(np.float32)
        landmarks, joints = (np.asarray(x) for x in pose_all(betas, rotations, translations))
        azimuths = rng.uniform(0, 2 * np.pi) + np.arange(views) * (2 * np.pi / views)
        cameras = orbit(jnp.asarray(joints.mean((0, 1))), 3.4, jnp.asarray(azimuths, jnp.float32), 0.15, K, size, size)
        still = lambda array: np.broadcast_to(np.asarray(array), (frames, *array.shape))
        matrices = still(cameras.K), still(cameras.cam_from_world)
        people.append(FitCase(betas, rotations, translations, joints, landmarks, *matrices))
    return model, people


def detect(case, seed, noise_px, outliers, outlier_px=100.0):
    """Keypoints (m, c, k, 2) as a detector with errors would give them: noise everywhere, a share displaced by up to so far."""
    rng = np.random.default_rng([seed, ERROR_STREAM])
    seen = (
        np.einsum("mcab,mkb->mcka", case.cam_from_world[..., :3, :3], case.landmarks)
        + case.cam_from_world[..., None, :3, 3]
    )
    pixels = seen[..., :2] / seen[..., 2:] * case.K[..., None, [0, 1], [0, 1]] + case.K[..., None, :2, 2]
    pixels = pixels + rng.normal(0, 1, pixels.shape) * noise_px
    wild = rng.random(pixels.shape[:-1]) < outliers
    angle, radius = rng.uniform(0, 2 * np.pi, wild.shape), outlier_px * np.sqrt(rng.random(wild.shape))
    return pixels + (wild * radius)[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)


def observe(people, seed, noise_px, outliers, model):
    """Observations (people, m, c, ...) of cases, with the errors of a detector."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.fitting.residuals.keypoints import Observations, expected_noise

    points = np.stack([detect(case, seed + i, noise_px, outliers) for i, case in enumerate(people)])
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), points.shape[:-1])
    noise = np.stack([expected_noise(p, c) for p, c in zip(points, confidences, strict=True)])
    K, cam_from_world = (np.stack([getattr(case, name) for case in people]) for name in ("K", "cam_from_world"))
    arrays = (points, confidences, K, cam_from_world, noise)
    return jax.vmap(jax.vmap(Observations))(*(jnp.asarray(x, jnp.float32) for x in arrays))
