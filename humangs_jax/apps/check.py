"""A look at a capture before its use: the posed body over each photo, and numbers that show what is wrong.

Blue is the person's left side, red the right, the green line the silhouette of the body; photo and body
should coincide. Most captures that fail have a wrong convention: a view whose body is not where the mask is, is tried again
with each usual mistake undone, and the mistake that explains it is named.
"""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation

from humangs_jax.apps.quick_check import (
    LEAST_INSIDE,
    LEAST_IOU,
    MISTAKES,
    SURELY_INSIDE,
    SURELY_IOU,
    whole_capture_mistakes,
)
from humangs_jax.avatar.sheets import contact_sheet
from humangs_jax.body.model import BodyModel, BodyPose, person_vertices
from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.fitting.camera_errors import find_camera_errors
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.position_map import vertex_normals
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh

LONGEST_SIDE = 512
"""Larger photos are shrunk to this for the check, pixels."""
MOST_OUTSIDE = 0.05
"""Share of the body's pixels: those outside of the mask take the background's color."""
WIDER = (
    "{:.0%} of the body is outside the mask: it is wider than the person, or the pose is off; "
    "`humangs fit CAPTURE --refine{}` fits {}shape and pose to the masks"
)
FIXED, FREE = (" --fixed-cameras", ""), ("", "cameras, ")
LEAST_HEIGHT = 0.05
"""Share of the image's height: a body smaller than this has its lengths in another unit."""
LEFT, RIGHT, MIDDLE = (0.15, 0.45, 1.0), (1.0, 0.35, 0.15), (0.85, 0.85, 0.85)
BOUNDARY = (0.1, 0.85, 0.2)
AMBIENT = 0.35
OPACITY = 0.55


@pytree_dataclass
class BodyImage:
    """The posed body as one camera sees it.

    shaded: (h, w, 3) lit from the camera, black outside. covered: (h, w). inside, before: shares of the vertices that fall
    into the image, and that lie before the camera. height: of the body in the image, share of the image's.
    """

    shaded: Float[Array, "h w 3"]
    covered: Bool[Array, "h w"]
    inside: Float[Array, ""]
    before: Float[Array, ""]
    height: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class ViewCheck:
    """One view. iou: of body and mask, outside: share of the body's pixels more than one pixel off the mask; None without masks.
    inside: share of the vertices in the image.
    """

    name: str
    iou: float | None
    outside: float | None
    inside: float
    warnings: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class CheckReport:
    """One row per view; `str(report)` is the table that the command line prints. warnings: about the capture as a whole."""

    views: tuple[ViewCheck, ...]
    warnings: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether there is no warning."""
        return not (self.warnings or any(view.warnings for view in self.views))

    def __str__(self) -> str:
        """A table, then the warnings."""
        width = max(4, *(len(view.name) for view in self.views))
        lines = [f"{'view':<{width}}  silhouette IoU  body outside mask  body in frame"]
        for view in self.views:
            iou = "no mask" if view.iou is None else f"{view.iou:.3f}"
            outside = "" if view.outside is None else f"{view.outside:.1%}"
            mark = "  !" if view.warnings else ""
            lines.append(f"{view.name:<{width}}  {iou:>14}  {outside:>17}  {view.inside:>12.0%}{mark}")
        lines += [f"warning: {warning}" for warning in self.warnings]
        lines += [f"warning: {view.name}: {warning}" for view in self.views for warning in view.warnings]
        if self.ok:
            lines.append(
                "no warnings; look at the sheet all the same: silhouettes do not show whether left and right are exchanged"
            )
        return "\n".join(lines)


def check_capture(capture: Capture, out: str | Path, keypoints: Keypoints | None = None) -> CheckReport:
    """Draw the posed body over every photo, write the sheet as a PNG, and report how well they agree.

    Arguments: keypoints: of the views, if they are known: whether the cameras may be at fault.
    Raises: OSError if the sheet cannot be written.
    """
    right = keypoints is not None and not find_camera_errors(capture, keypoints)
    if max(capture.images.shape[1:3]) > LONGEST_SIDE:
        capture = capture.resized(LONGEST_SIDE)
    vertices = _posed_frames(capture)
    tints = side_tints(capture.body)
    overlays, views = [], []
    for i, name in enumerate(capture.names):
        posed = vertices[int(capture.frames[i])]
        drawn = _body_image(posed, capture.body.faces, tints, capture.cameras[i])
        mask = None if capture.masks is None else capture.masks[i] > 0.5
        view = _judge(name, drawn, mask)
        if view.warnings:
            translation = np.asarray(capture.poses.translation[int(capture.frames[i])], float)
            draw = functools.partial(_body_image, posed, capture.body.faces, tints)
            cause = _mistake_in_image(drawn, mask) or _mistake_in_space(draw, capture.cameras[i], translation, mask)
            explained = f"it would fit if {cause}"
            view = dataclasses.replace(view, warnings=view.warnings + ((explained,) if cause else ()))
        elif view.outside is not None and view.outside > MOST_OUTSIDE:
            view = dataclasses.replace(view, warnings=(WIDER.format(view.outside, *(FIXED if right else FREE)),))
        overlays.append(overlay(capture.images[i], drawn))
        views.append(view)
    contact_sheet(np.stack(overlays), out, labels=[_label(view) for view in views])
    off = any(view.warnings for view in views)
    return CheckReport(tuple(views), whole_capture_mistakes(capture) if off else ())


def draw_body(
    body: BodyModel, betas: Float[Array, " s"], pose: BodyPose, camera: Camera, photo: Float[np.ndarray, "h w 3"]
) -> tuple[Float[np.ndarray, "h w 3"], BodyImage]:
    """The posed body over a photo of one camera, and the body alone."""
    drawn = _body_image(jax.jit(person_vertices)(body, betas, pose), body.faces, side_tints(body), camera)
    return overlay(photo, drawn), drawn


def overlay(photo: Float[np.ndarray, "h w 3"], drawn: BodyImage) -> Float[np.ndarray, "h w 3"]:
    """Half-transparent body over a photo, with its silhouette."""
    covered = np.asarray(drawn.covered)
    blended = photo + OPACITY * covered[..., None] * (np.asarray(drawn.shaded) - photo)
    return np.where(_boundary(covered)[..., None], np.asarray(BOUNDARY), blended)


def side_tints(body: BodyModel) -> Float[np.ndarray, "n 3"]:
    """Colors of the vertices: left, right, or between, by the names of the joints that move them, else by x in T-pose."""
    weights = np.asarray(body.skinning_weights)
    left, right = (
        weights @ np.array([name.startswith(side) for name in body.joint_names]) for side in ("left", "right")
    )
    if not (left.any() and right.any()):
        left, right = (np.asarray(body.template)[:, 0] * sign > 0 for sign in (1, -1))
    left, right = left.astype(np.float32)[:, None], right.astype(np.float32)[:, None]
    colors = np.asarray([LEFT, RIGHT, MIDDLE], np.float32)
    tints = left * colors[0] + right * colors[1] + (1 - left - right) * colors[2]
    return tints.astype(np.float32)


@jax.jit
def _body_image(vertices, faces, tints, camera) -> BodyImage:
    points = transform.apply(camera.cam_from_world, vertices)
    before = points[:, 2] > 0
    xy = points[:, :2] / jnp.where(before, points[:, 2], 1.0)[:, None] * jnp.diagonal(camera.K)[:2] + camera.K[:2, 2]
    inside = before & (xy >= 0).all(-1) & (xy[:, 0] < camera.width) & (xy[:, 1] < camera.height)
    y = jnp.where(before, xy[:, 1], 0.0)
    rays = points / jnp.linalg.norm(points, axis=-1, keepdims=True)
    rotation = camera.cam_from_world[:3, :3]
    normals = jnp.matmul(vertex_normals(vertices, faces), rotation.T, precision=transform.EXACT)
    light = AMBIENT + (1 - AMBIENT) * jnp.abs(jnp.sum(normals * rays, axis=-1, keepdims=True))
    fragments = rasterize_mesh(vertices, faces, camera)
    return BodyImage(
        shaded=interpolate_attributes(fragments, faces, tints * light, jnp.zeros(3)),
        covered=fragments.face_ids >= 0,
        inside=inside.mean(dtype=jnp.float32),
        before=before.mean(dtype=jnp.float32),
        height=(y.max() - y.min()) / camera.height,
    )


def _posed_frames(capture):
    """Vertices of the frames that views show, by frame."""
    pose = jax.jit(person_vertices)
    shown = sorted({int(frame) for frame in capture.frames})
    return {frame: pose(capture.body, jnp.asarray(capture.betas), capture.pose(frame)) for frame in shown}


def _iou(drawn, mask):
    covered = np.asarray(drawn.covered)
    union = (covered | mask).sum()
    return float((covered & mask).sum() / union) if union else 0.0


def _outside(drawn, mask):
    covered, near = np.asarray(drawn.covered), binary_dilation(mask)
    return float((covered & ~near).sum() / max(covered.sum(), 1))


def _judge(name, drawn, mask) -> ViewCheck:
    inside, before, height = float(drawn.inside), float(drawn.before), float(drawn.height)
    iou = None if mask is None else _iou(drawn, mask)
    outside = None if mask is None else _outside(drawn, mask)
    warnings = []
    if before == 0:
        warnings.append("the body is behind the camera")
    elif before < 1:
        warnings.append(f"{1 - before:.0%} of the body is behind the camera")
    elif inside < LEAST_INSIDE:
        warnings.append(f"{1 - inside:.0%} of the body is outside the frame")
    elif height < LEAST_HEIGHT:
        warnings.append(f"the body is {height:.1%} of the image's height: are all lengths in metres?")
    if mask is not None and not mask.any():
        warnings.append("the mask is empty")
    elif iou is not None and iou < LEAST_IOU:
        warnings.append(f"body and mask do not agree (IoU {iou:.2f})")
    return ViewCheck(name, iou, outside, inside, tuple(warnings))


def _mistake_in_image(drawn, mask):
    """An inverted mask, or a mirrored photo."""
    if mask is None or not mask.any():
        return None
    covered = np.asarray(drawn.covered)
    tried = {"the mask is inverted": (covered, ~mask), "the photo is mirrored": (covered[:, ::-1], mask)}
    shares = {mistake: (a & b).sum() / max((a | b).sum(), 1) for mistake, (a, b) in tried.items()}
    best = max(shares, key=lambda mistake: shares[mistake])
    return best if shares[best] > SURELY_IOU else None


def _mistake_in_space(draw, camera, translation, mask):
    """The usual mistake that, undone, puts the body where the mask is; without a mask the only one that puts it in frame."""
    fitting: dict[str, float] = {}
    for mistake, undo in MISTAKES.items():
        matrix = jnp.asarray(undo(np.asarray(camera.cam_from_world, float), translation), camera.K.dtype)
        view = _judge("", draw(replace(camera, cam_from_world=matrix)), mask)
        if not view.warnings and view.inside > SURELY_INSIDE:
            fitting[mistake] = view.iou or 0.0
    if mask is None:
        return next(iter(fitting)) if len(fitting) == 1 else None
    return max(fitting, key=lambda mistake: fitting[mistake]) if fitting else None


def _boundary(covered):
    """Pixels of the body beside pixels outside it."""
    padded = np.pad(covered, 1, mode="edge")
    neighbours = (padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:])
    return covered & ~np.logical_and.reduce(neighbours)


def _label(view: ViewCheck) -> str:
    iou = "" if view.iou is None else f"  IoU {view.iou:.2f}"
    return f"{'! ' if view.warnings else ''}{view.name}{iou}"
