"""People of the fitting seeds in photos whose cameras and poses are a little off: what refinement is measured on."""

import dataclasses
from typing import Any

import numpy as np

POSE_STREAM, CAMERA_STREAM, ERROR_STREAM, KEYPOINT_STREAM = 31, 32, 33, 34
SUPERSAMPLING = 2


@dataclasses.dataclass(frozen=True)
class Errors:
    """How far off a start is: share of the focal length, degrees of every camera about a random axis, degrees of every joint."""

    focal: float = 0.05
    turn: float = 2.0
    bend: float = 3.0


def true_captures(seed: int, body: Any, views: int, size: int = 512) -> tuple[Any, Any]:
    """The person of a seed in a random pose from cameras all around, with true parameters: (in clothes, the bare body)."""
    from humangs_jax.people.cameras import cameras_around, spread_azimuths
    from humangs_jax.people.poses import sample_rotations
    from humangs_jax.people.subject import make_subject
    from humangs_jax.people.writer import View, capture_views, stand

    subject = make_subject(seed, body)
    posed = stand(subject, sample_rotations(np.random.default_rng([seed, POSE_STREAM]), subject.build))
    rng = np.random.default_rng([seed, CAMERA_STREAM])
    cameras = cameras_around(rng, posed.vertices, spread_azimuths(rng, views), size)
    clothed = capture_views(subject, body, [posed], [View(0, f"{i:03d}", cameras[i]) for i in range(views)])
    return clothed, dataclasses.replace(clothed, masks=bare_masks(clothed))


def bare_masks(capture: Any) -> np.ndarray:
    """(v, h, w) coverage by the posed body, without clothes."""
    import jax.numpy as jnp

    from humangs_jax.fitting.refine_iterations import posed_vertices
    from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

    vertices = posed_vertices(capture.body, jnp.asarray(capture.betas), capture.poses)
    height, width = capture.images.shape[1:3]
    s, masks = SUPERSAMPLING, []
    for view, frame in enumerate(capture.frames):
        large = capture.cameras[view].resized(s * width, s * height)
        covered = np.asarray(rasterize_mesh(vertices[int(frame)], capture.body.faces, large).face_ids) >= 0
        masks.append(covered.astype(np.float32).reshape(height, s, width, s).mean(axis=(1, 3)))
    return np.stack(masks)


def augmented(capture: Any, seed: int, errors: Errors = Errors()) -> Any:
    """The capture with focal lengths (all longer or all shorter), cameras (about their own centres) and joints off by fixed
    amounts.
    """
    import jax.numpy as jnp

    from humangs_jax.core.pytree import replace
    from humangs_jax.geometry import quaternion, transform

    rng = np.random.default_rng([seed, ERROR_STREAM])
    about = lambda count, degrees: jnp.asarray(np.radians(degrees) * _directions(rng, count), jnp.float32)
    zoom = 1 + errors.focal * rng.choice([-1, 1])
    K = capture.cameras.K * jnp.asarray([[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]])
    turns = transform.make(quaternion.matrix_from_axis_angle(about(capture.view_count, errors.turn)), jnp.zeros(3))
    rotations = capture.poses.rotations
    bends = about(rotations.shape[0] * rotations.shape[1], errors.bend).reshape(rotations.shape)
    turned = quaternion.multiply(quaternion.from_axis_angle(rotations), quaternion.from_axis_angle(bends))
    return dataclasses.replace(
        capture,
        cameras=replace(capture.cameras, K=K, cam_from_world=turns @ capture.cameras.cam_from_world),
        poses=replace(capture.poses, rotations=quaternion.to_axis_angle(turned)),
    )


def noisy_keypoints(truth: Any, seed: int, noise_px: float) -> Any:
    """COCO's 17 keypoints of the true body in every view, with normal errors; none is missing."""
    import jax.numpy as jnp

    from humangs_jax.body.landmarks import landmark_model, pose_landmarks
    from humangs_jax.data.keypoints.keypoints import Keypoints
    from humangs_jax.data.keypoints.sets import COCO_17
    from humangs_jax.geometry.camera import project

    model, rng = landmark_model(truth.body, COCO_17.names), np.random.default_rng([seed, KEYPOINT_STREAM])
    points = []
    for view, frame in enumerate(truth.frames):
        landmarks, _ = pose_landmarks(model, jnp.asarray(truth.betas), truth.pose(int(frame)))
        pixels = np.asarray(project(truth.cameras[view], landmarks)[0])
        points.append(pixels + noise_px * rng.normal(size=pixels.shape))
    confidences = np.broadcast_to(np.asarray(model.known, np.float32), (truth.view_count, len(model.names)))
    return Keypoints(np.asarray(points, np.float32), confidences, COCO_17)


def mean_overlap(capture: Any, masks: Any) -> float:
    """Mean intersection over union of the posed body and masks (v, h, w) of the views."""
    from humangs_jax.fitting.refine_iterations import overlap

    covered = bare_masks(capture) > 0.5
    return float(np.mean([overlap(body, mask) for body, mask in zip(covered, masks, strict=True)]))


def joint_errors(capture: Any, truth: Any, joints: int = 22) -> tuple[float, float]:
    """Mean distance of the first joints (the body's) from the true ones, metres: in the world, and after the best rigid
    motion.
    """
    estimate, true = _joints(capture)[:, :joints].reshape(-1, 3), _joints(truth)[:, :joints].reshape(-1, 3)
    raw = np.linalg.norm(estimate - true, axis=-1).mean()
    a, b = estimate - estimate.mean(0), true - true.mean(0)
    u, _, vt = np.linalg.svd(b.T @ a)
    rotation = (u * [1, 1, np.linalg.det(u @ vt)]) @ vt
    return float(raw), float(np.linalg.norm(a @ rotation.T - b, axis=-1).mean())


def _joints(capture):
    import jax
    import jax.numpy as jnp

    from humangs_jax.body.model import pose_body, shape_body

    rest = shape_body(capture.body, jnp.asarray(capture.betas))
    return np.asarray(jax.jit(jax.vmap(lambda pose: pose_body(capture.body, rest, pose).joints))(capture.poses))


def _directions(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
