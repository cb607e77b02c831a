"""Compares the posed body with the masks, to find out which views show the person.

A mask that is empty, or nowhere near the body, does harm. The photo of this view is white where the
body is. The network takes this white for the person's color, and refinement makes the avatar
transparent there. So such views are left out wherever photos are used, and a warning names them.
All of this runs on the host, by numpy: nothing is compiled.
"""

import logging
from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.kinematics import bones_of, posed_tree
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Float, Int
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.geometry.mesh import face_areas

logger = logging.getLogger(__name__)

MASK_THRESHOLD = 0.5
"""A pixel belongs to the person when its mask is above this."""
LEAST_SHARE = 0.05
"""A view shows the person if at least this share of the body's points in the photo lies on the
mask.

In the demo's photos, the share is 6 to 7 % for a mask of the head alone, and 1.4 % for an inverted
mask.
"""
POINTS = 1000
"""The number of points on the skin that are compared with the masks."""


def report_left_out(names: Sequence[str], reasons: dict[int, str]) -> None:
    """Log a warning that names the views that are left out, with the reasons. reasons: what
    `views_without_person` returns.

    Raises: CaptureError, one line that names the views, if none is left.
    """
    if not reasons:
        return
    lines = []
    for reason in dict.fromkeys(reasons.values()):
        views = [names[view] for view in reasons if reasons[view] == reason]
        lines.append(f"{', '.join(views)}: {reason}")
    if len(reasons) == len(names):
        problem = f"no view is left that shows the person: {'; '.join(lines)}"
        raise CaptureError("capture", "masks", problem)
    verb = "is" if len(reasons) == 1 else "are"
    count = f"{len(reasons)} of {len(names)} views {verb}"
    logger.warning("%s left out: %s", count, "; ".join(lines))


def views_without_person(capture: Capture) -> dict[int, str]:
    """Returns the indices of the views that do not show the person, each with the reason. Either
    the mask is empty, or no point of the body is in the photo, or less than `LEAST_SHARE` of the
    points in the photo lies on the mask. Points on unknown pixels do not count, unless nearly all
    points are on such pixels. The result is empty if there are no masks.

    A view with a mask that is not empty is not in the result if its posed body has numbers that are
    not finite. The code that poses the body reports this fault.
    """
    found = dict.fromkeys(empty_views(capture.masks), "the mask is empty")
    if capture.masks is None or len(found) == capture.view_count:
        return found
    points = surface_points(capture.body, capture.betas, capture.poses, capture.frames, POINTS)
    K, cam_from_world = np.asarray(capture.cameras.K), np.asarray(capture.cameras.cam_from_world)
    for i, frame in enumerate(capture.frames.tolist()):
        mask = np.asarray(capture.masks[i])
        if i in found or not np.isfinite(points[frame]).all():
            continue
        x, y = (
            points_in_image(points[frame], K[i], cam_from_world[i], *mask.shape[::-1]).astype(int).T
        )
        on_mask = mask[y, x] > MASK_THRESHOLD
        if capture.unknown is not None:
            # what may be hidden says nothing, unless that is nearly all
            seen = ~capture.unknown[i][y, x]
            if seen.mean() > LEAST_SHARE:
                on_mask = on_mask[seen]
        if not len(on_mask) or on_mask.mean() < LEAST_SHARE:
            border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
            inverted = np.mean(border > MASK_THRESHOLD) > 0.5
            guess = ": is the mask inverted?" if inverted else ""
            found[i] = f"mask and posed body hardly meet{guess} (`humangs check` draws both)"
    return dict(sorted(found.items()))


def empty_views(masks: Float[np.ndarray, "v h w"] | None) -> list[int]:
    """Returns the indices of the views whose masks have no pixel above `MASK_THRESHOLD`. The list
    is empty if there are no masks.
    """
    if masks is None:
        return []
    return [i for i, mask in enumerate(masks) if not (np.asarray(mask) > MASK_THRESHOLD).any()]


# Points on the skin
# --------------------------------------------------------------------------------------------------


def surface_points(
    body: BodyModel,
    betas: Float[np.ndarray, " s"],
    poses: BodyPose,
    frames: Int[np.ndarray, " v"],
    count: int,
) -> dict[int, Float[np.ndarray, "count 3"]]:
    """Returns, for each frame that a view shows, points on the skin of the posed body, (count, 3),
    metres. They are spread evenly over the skin in the T-pose. Pose correctives are left out.
    """
    rest = shaped(body, betas)
    joints = np.asarray(body.joint_regressor) @ rest
    corners, weights = _sampling(rest, np.asarray(body.faces), count)
    used, corners = np.unique(corners, return_inverse=True)
    skinning, corners = np.asarray(body.skinning_weights)[used], corners.reshape(weights.shape)
    posed = {}
    for frame in set(frames.tolist()):
        linear, offset = skinned(body, joints, poses, frame, skinning)
        vertices = np.einsum("nrc,nc->nr", linear, rest[used]) + offset
        posed[frame] = np.einsum("pc,pcx->px", weights, vertices[corners])
    return posed


def shaped(body: BodyModel, betas: Float[np.ndarray, " s"]) -> Float[np.ndarray, "n 3"]:
    """Returns the vertices of the person's body in the T-pose, metres."""
    betas = np.asarray(betas, float)
    return (
        np.asarray(body.template, float)
        + np.asarray(body.shape_directions, float)[..., : len(betas)] @ betas
    )


def skinned(
    body: BodyModel,
    joints: Float[np.ndarray, "j 3"],
    poses: BodyPose,
    frame: int,
    weights: Float[np.ndarray, "n j"],
    corrected: bool = False,
) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
    """Returns the affine transforms of vertices from the rest pose to one frame: matrices, (n, 3,
    3), and offsets, (n, 3), metres.

    joints: the joints of the rest pose, (j, 3), metres. weights: the skinning weights of the
    vertices, (n, j). corrected: whether the body's pose correctives are added, if it has some. Then
    `weights` has to be the weights of all of the body's vertices, in their order.
    """
    turns = Rotation.from_rotvec(np.asarray(poses.rotations)[frame].astype(float)).as_matrix()
    world, places = posed_tree(turns, bones_of(joints, body.parents), body.parents)
    offsets = places - np.einsum("jab,jb->ja", world, joints)
    moves = np.concatenate([world, offsets[..., None]], axis=-1)
    blended = (weights @ moves.reshape(len(moves), -1)).reshape(-1, 3, 4)
    linear = blended[..., :3]
    offset = blended[..., 3] + np.asarray(poses.translation)[frame].astype(float)
    if corrected and body.pose_directions is not None:
        correction = np.asarray(body.pose_directions) @ (turns[1:] - np.eye(3)).ravel()
        offset = offset + np.einsum("nab,nb->na", linear, correction)
    return linear, offset


def points_in_image(
    points: Float[np.ndarray, "p 3"],
    K: Float[np.ndarray, "3 3"],
    cam_from_world: Float[np.ndarray, "4 4"],
    width: int,
    height: int,
) -> Float[np.ndarray, "q 2"]:
    """Returns the positions (x, y) of points in an image, pixels. Points behind the camera or
    outside of the image are left out.
    """
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
