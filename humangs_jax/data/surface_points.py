"""Points on the skin of a posed body, by numpy: in milliseconds, and nothing is compiled. For checks of captures."""

from collections.abc import Sequence

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float


def surface_points(
    body: BodyModel,
    betas: Float[np.ndarray, " s"],
    rotations: Float[np.ndarray, "m j 3"],
    translations: Float[np.ndarray, "m 3"],
    frames: Sequence[int],
    count: int,
) -> dict[int, Float[np.ndarray, "count 3"]]:
    """Points spread evenly over the skin, metres, by frame; without pose correctives."""
    rest = np.asarray(body.template) + np.asarray(body.shape_directions)[..., : len(betas)] @ np.asarray(betas)
    joints = np.asarray(body.joint_regressor) @ rest
    corners, weights = _sampling(rest, np.asarray(body.faces), count)
    used, corners = np.unique(corners, return_inverse=True)
    skinning, rest, corners = np.asarray(body.skinning_weights)[used], rest[used], corners.reshape(weights.shape)
    posed = {}
    for frame in sorted(set(frames)):
        moves = _joint_moves(joints, body.parents, np.asarray(rotations[frame], float))
        blended = (skinning @ moves.reshape(len(moves), -1)).reshape(-1, 3, 4)
        vertices = np.einsum("nrc,nc->nr", blended[..., :3], rest) + blended[..., 3] + translations[frame]
        posed[frame] = np.einsum("pc,pcx->px", weights, vertices[corners])
    return posed


def points_in_image(
    points: Float[np.ndarray, "p 3"],
    K: Float[np.ndarray, "3 3"],
    cam_from_world: Float[np.ndarray, "4 4"],
    width: int,
    height: int,
) -> Float[np.ndarray, "q 2"]:
    """Where a camera sees the points, pixels; those that it does not see are left out."""
    seen = points @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    seen = seen[seen[:, 2] > 1e-6]
    pixels = (K @ (seen / seen[:, 2:]).T)[:2].T
    return pixels[((pixels >= 0) & (pixels < (width, height))).all(axis=-1)]


def _sampling(vertices, faces, count):
    """Corners (p, 3) and weights (p, 3) of points that are spread evenly over a mesh."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=-1)
    rng = np.random.default_rng(0)
    chosen = np.searchsorted(np.cumsum(areas), (np.arange(count) + 0.5) / count * areas.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return faces[np.minimum(chosen, len(faces) - 1)], np.stack([1 - u - v, u, v], axis=-1)


def _joint_moves(joints, parents, rotations) -> Float[np.ndarray, "j 3 4"]:
    """Rigid transforms from the rest pose to the pose."""
    angles = np.linalg.norm(rotations, axis=-1)
    x, y, z = (rotations / np.maximum(angles, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    local = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross
    moves = np.zeros((len(parents), 3, 4))
    for j, parent in enumerate(parents):  # parents come first
        turn = local[j] if parent < 0 else moves[parent, :, :3] @ local[j]
        place = joints[j] if parent < 0 else moves[parent, :, :3] @ joints[j] + moves[parent, :, 3]
        moves[j] = np.concatenate([turn, (place - turn @ joints[j])[:, None]], axis=1)
    return moves
