"""Which views of a capture show the person; all that reads photos leaves the others out, by name.

A mask that is empty, or nowhere near the body, does not only say nothing: the network takes its white photo for the person, and
refinement makes the avatar transparent there.

The skin is sampled by numpy: in milliseconds, and nothing is compiled.
"""

import logging
from collections.abc import Sequence

import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float, Int
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry.mesh import face_areas

logger = logging.getLogger(__name__)

MASK_THRESHOLD = 0.5
"""A pixel belongs to the person when its mask is above this."""
LEAST_SHARE = 0.05
"""Of the body in the frame that lies on the mask. In the demo's photos the head alone has 6 to 7 %, an inverted mask 1.4 %."""
POINTS = 1000
"""On the skin."""


def usable_views(capture: Capture) -> Capture:
    """The capture with the views that show the person: all but those of `unusable_views`, which a warning names.

    The same object where these are all, and without masks. Raises: CaptureError, one line that names the views, if none is left.
    """
    found = unusable_views(capture)
    if not found:
        return capture
    told = "; ".join(
        f"{', '.join(capture.names[i] for i in found if found[i] == reason)}: {reason}"
        for reason in dict.fromkeys(found.values())
    )
    if len(found) == capture.view_count:
        raise CaptureError("capture", "masks", f"no view is left that shows the person: {told}")
    count = f"{len(found)} of {capture.view_count} views {'is' if len(found) == 1 else 'are'}"
    logger.warning("%s left out: %s", count, told)
    return capture.select([i for i in range(capture.view_count) if i not in found])


def unusable_views(capture: Capture) -> dict[int, str]:
    """The views whose mask is empty or hardly meets what of the posed body is in the frame, and which of the two.

    A body that is not finite is another fault, which whoever poses it names.
    """
    found = dict.fromkeys(empty_views(capture.masks), "the mask is empty")
    if capture.masks is None or len(found) == capture.view_count:
        return found
    rotations, translations = np.asarray(capture.poses.rotations), np.asarray(capture.poses.translation)
    frames = [int(frame) for frame in capture.frames]
    points = surface_points(capture.body, np.asarray(capture.betas), rotations, translations, frames, POINTS)
    K, cam_from_world = np.asarray(capture.cameras.K), np.asarray(capture.cameras.cam_from_world)
    for i, frame in enumerate(frames):
        mask = np.asarray(capture.masks[i])
        if i in found or not np.isfinite(points[frame]).all():
            continue
        x, y = points_in_image(points[frame], K[i], cam_from_world[i], *mask.shape[::-1]).astype(int).T
        if not len(x) or (mask[y, x] > MASK_THRESHOLD).mean() < LEAST_SHARE:
            found[i] = "mask and posed body hardly meet (`humangs check` draws both)"
    return dict(sorted(found.items()))


def empty_views(masks: Float[np.ndarray, "v h w"] | None) -> list[int]:
    """The views whose mask shows nobody."""
    return [i for i, mask in enumerate(() if masks is None else masks) if not (np.asarray(mask) > MASK_THRESHOLD).any()]


# Points on the skin ---------------------------------------------------------------------------------------------------


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
        moves = joint_moves(joints, body.parents, np.asarray(rotations[frame], float))
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


def _sampling(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], count: int
) -> tuple[Int[np.ndarray, "p 3"], Float[np.ndarray, "p 3"]]:
    areas = face_areas(vertices, faces)
    rng = np.random.default_rng(0)
    chosen = np.searchsorted(np.cumsum(areas), (np.arange(count) + 0.5) / count * areas.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return faces[np.minimum(chosen, len(faces) - 1)], np.stack([1 - u - v, u, v], axis=-1)


def joint_turns(rotations: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3 3"]:
    """Rotation matrices of axis-angles."""
    angles = np.linalg.norm(rotations, axis=-1)
    x, y, z = (rotations / np.maximum(angles, 1e-12)[:, None]).T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sine, cosine = np.sin(angles)[:, None, None], np.cos(angles)[:, None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * cross @ cross


def joint_moves(
    joints: Float[np.ndarray, "j 3"], parents: Sequence[int], rotations: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "j 3 4"]:
    """Rigid transforms from the rest pose to the pose."""
    local, moves = joint_turns(rotations), np.zeros((len(parents), 3, 4))
    for j, parent in enumerate(parents):  # parents come first
        turn = local[j] if parent < 0 else moves[parent, :, :3] @ local[j]
        place = joints[j] if parent < 0 else moves[parent, :, :3] @ joints[j] + moves[parent, :, 3]
        moves[j] = np.concatenate([turn, (place - turn @ joints[j])[:, None]], axis=1)
    return moves
