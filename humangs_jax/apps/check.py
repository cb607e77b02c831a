"""Checks a capture before it is used, and checks a fit. Draws the posed body over each photo, and
computes numbers that show what is wrong.

Blue is the person's left side, red is the right side, and the green line is the boundary of the
body. Photo and body should coincide. A yellow line is the boundary of the displaced body that
`reconstruct` uses. The displacement is that of the capture. If the capture has none, and the body
does not fit the masks, `reconstruct` moves its vertices to the edges of the masks. It adds a skirt
if the masks show one. `apps.quick_check` names what is wrong with a view.

On the sheet of a fit a disc is a keypoint: blue for the person's left, red for the right, white for
the middle. A ring is a keypoint that is an outlier. A line leads from the keypoint to a cross,
which is the landmark of the body. Where the body fits, disc and cross coincide.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from humangs_jax.apps.crops import around_person
from humangs_jax.apps.quick_check import Faults, faults
from humangs_jax.avatar.attach_face import shipped_network
from humangs_jax.avatar.video import contact_sheet
from humangs_jax.body.joints import FINGERS
from humangs_jax.body.model import BodyModel, BodyPose, person_vertices, pose_body, shape_body
from humangs_jax.capture.fitting.camera_errors import find_camera_errors
from humangs_jax.capture.fitting.fit_capture import Examination
from humangs_jax.capture.keypoints.keypoints import Keypoints
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import Call
from humangs_jax.core.progress import text_table
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.prepared import PreparedCapture, prepare_capture
from humangs_jax.data.skirt import SKIRT_VERTICES
from humangs_jax.data.views import gaussian_body
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.images import to_uint8
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.rendering.mesh.rasterizer import (
    interpolate_attributes,
    rasterize_mesh,
    vertex_normals,
)

_LONGEST_SIDE = 512
"""Photos whose longer side exceeds this are reduced to it before they are drawn, pixels."""


@dataclasses.dataclass(frozen=True)
class _Tints:
    """Colors and opacity of the body on the sheet. Colors are red, green and blue in [0, 1], except
    `cross`, which is in 0 to 255.
    """

    left: tuple[float, float, float] = (0.15, 0.45, 1.0)
    """Color of the person's left side."""
    right: tuple[float, float, float] = (1.0, 0.35, 0.15)
    """Color of the person's right side."""
    middle: tuple[float, float, float] = (0.85, 0.85, 0.85)
    """Color of the person's middle."""
    boundary: tuple[float, float, float] = (0.1, 0.85, 0.2)
    """Color of the body's outline."""
    displaced: tuple[float, float, float] = (1.0, 0.85, 0.0)
    """Color of the displaced body's outline."""
    opacity: float = 0.55
    """Opacity of the body over the photo."""
    cross: tuple[int, int, int] = (255, 0, 230)
    """Color of the lines and crosses that show the body's landmarks, red, green and blue, 0 to 255.
    """


TINTS = _Tints()


_AMBIENT = 0.35
"""Share of ambient light, 0 to 1. The rest is light from the camera."""


@pytree_dataclass
class BodyImage:
    """The posed body as one camera sees it."""

    shaded: Float[Array, "h w 3"]
    """Colors of the body, (h, w, 3), 0 to 1, lit from the camera. Black where the body is not."""
    covered: Bool[Array, "h w"]
    """Whether a pixel shows the body, (h, w)."""


@dataclasses.dataclass(frozen=True)
class ViewCheck:
    """How well body and mask of one view agree."""

    name: str
    """Name of the view, as in the capture."""
    iou: float | None
    """Intersection over union of body and mask, 0 to 1; None without masks."""
    outside: float | None
    """Share of the body's pixels that are more than one pixel off the mask; None without masks.
    Photos with a side of more than 512 pixels are reduced to 512 before.
    """
    inside: float
    """Share of the body that is inside the image, 0 to 1."""
    warning: str | None = None
    """One line that says what looks wrong with the view; None if nothing does."""


@dataclasses.dataclass(frozen=True)
class CheckReport:
    """How well body, photos and masks agree. `str(report)` is the table that the command line
    prints.
    """

    views: tuple[ViewCheck, ...]
    """One entry per view, in the order of the capture."""
    warnings: tuple[str, ...] = ()
    """What looks wrong with the capture as a whole, one line for each problem."""
    displaced: float = 0.0
    """Largest distance by which `reconstruct` moves a vertex of the body, metres. 0: no vertex is
    moved.
    """
    registered: bool = False
    """Whether the displacement comes with the capture. If not, `reconstruct` finds it from the
    masks.
    """
    skirt: bool = False
    """Whether `reconstruct` puts a skirt around the legs."""

    @property
    def ok(self) -> bool:
        """Whether there is no warning, neither for the capture nor for a view."""
        return not (self.warnings or any(view.warning for view in self.views))

    def __str__(self) -> str:
        """Returns a table with a row for each view, then notes and warnings."""
        # views with a warning end in an exclamation mark
        rows = [["view", "silhouette IoU", "body outside mask", "body in frame"]]
        for view in self.views:
            iou = "no mask"
            if view.iou is not None:
                iou = f"{view.iou:.3f}"
            outside = ""
            if view.outside is not None:
                outside = f"{view.outside:.1%}"
            rows.append(
                [view.name, iou, outside, f"{view.inside:.0%}", *("!" * bool(view.warning))]
            )
        lines = text_table(rows)
        # what the yellow lines of the sheet are
        if self.displaced:
            how = "as body.npz says" if self.registered else "to the masks"
            lines.append(
                f"reconstruct will move the body {how}, by up to {100 * self.displaced:.1f} cm"
                " (yellow)"
            )
        if self.skirt:
            lines.append(
                "reconstruct will put a skirt around the legs, as the masks show one (yellow)"
            )
        lines += [f"warning: {warning}" for warning in self.warnings]
        lines += [f"warning: {view.name}: {view.warning}" for view in self.views if view.warning]
        # silhouettes are nearly symmetric, so a silent check is no proof
        if self.ok:
            lines.append(
                "no warnings; look at the sheet all the same: silhouettes do not show whether left"
                " and right are exchanged"
            )
        return "\n".join(lines)


def check_capture(
    capture: Capture | PreparedCapture, out: str | Path, keypoints: Keypoints | None = None
) -> CheckReport:
    """Draws the posed body over every photo, writes the sheet as a PNG, and reports how well body,
    photos and masks agree.

    Arguments: capture: a plain capture is prepared for the network that comes with the package. A
    prepared capture stays as it is. keypoints: keypoints of the views, if they are known. They show
    whether cameras are wrong, which changes the advice in warnings.
    Raises: OSError if the sheet cannot be written.
    """
    if isinstance(capture, PreparedCapture):
        prepared, capture = capture, capture.given
    else:
        prepared = _prepared(capture)
    right = keypoints is not None and not find_camera_errors(capture, keypoints)
    # faults look at the photos as they are, the sheet at smaller ones
    found = faults(capture)
    whole, vertices = capture, _posed_frames(capture)
    if max(capture.images.shape[1:3]) > _LONGEST_SIDE:
        capture = capture.resized(_LONGEST_SIDE)
    shown, tints = _shown(whole, capture, vertices), side_tints(capture.body)
    # the body as `reconstruct` will use it, moved to the masks and with a skirt, is drawn in yellow
    body, moves = capture.body, None
    if prepared is not None and prepared.displacement is not None and prepared.displacement.any():
        assert prepared.body is not None
        body, moves = prepared.body, prepared.displacement
    displaced = None
    if moves is not None:
        displaced = _posed_frames(dataclasses.replace(capture, body=body), moves)
    moved_tints = side_tints(body)
    # compare each silhouette with its mask, and draw it; the sheet shows the person close, the
    # comparison is of the whole photo
    overlays, views = [], []
    for i, frame in enumerate(capture.frames.tolist()):
        drawn = body_image(vertices[frame], capture.body.faces, tints, capture.cameras[i])
        views.append(_compared(capture, i, np.asarray(drawn.covered), found, right))
        if shown is not capture:
            drawn = body_image(vertices[frame], capture.body.faces, tints, shown.cameras[i])
        overlays.append(overlay(shown.images[i], drawn))
        if displaced is not None:
            moved = body_image(displaced[frame], body.faces, moved_tints, shown.cameras[i])
            overlays[-1][_boundary(np.asarray(moved.covered))] = TINTS.displaced
    contact_sheet(np.stack(overlays), out, labels=[_label(view) for view in views])
    skirt = prepared is not None and prepared.skirt
    farthest = 0.0
    if moves is not None:
        # the vertices of a skirt follow those of the body, and do not count
        own = moves
        if skirt:
            own = moves[: len(moves) - SKIRT_VERTICES]
        farthest = float(np.linalg.norm(own, axis=1).max())
    registered = capture.displacement is not None
    return CheckReport(tuple(views), found.whole, farthest, registered, skirt)


def _compared(
    capture: Capture,
    view: int,
    covered: Bool[np.ndarray, "h w"],
    found: Faults,
    cameras_are_right: bool,
) -> ViewCheck:
    """Compares the pixels that the body covers with the mask of a view. cameras_are_right: whether
    keypoints have shown that no camera is wrong. Then the advice is to keep cameras fixed.
    """
    name, warning, inside = capture.names[view], found.views[view], found.inside[view]
    if capture.masks is None:
        return ViewCheck(name, None, None, inside, warning)
    if capture.unknown is not None:
        covered = covered & ~capture.unknown[view]
    iou, outside = _agreement(covered, capture.masks[view] > MASK_THRESHOLD)
    # pixels of the body outside of the mask take the background's color
    if warning is None and outside > 0.05:
        remedy = "`humangs fit CAPTURE --to-masks` fits cameras, shape and pose to the masks"
        if cameras_are_right:
            option = "--to-masks --fixed-cameras"
            remedy = f"`humangs fit CAPTURE {option}` fits shape and pose to the masks"
        wide = "it is wider than the person, or the pose is off"
        warning = f"{outside:.0%} of the body is outside the mask: {wide}; {remedy}"
    return ViewCheck(name, iou, outside, inside, warning)


def calls_of_check(capture: Capture, config: HumanGSConfig) -> Iterator[Call]:
    """Yields the calls that draw the body over photos, for background compilation. One is for the
    body of the capture, and one for the body that the network of `config` uses.
    """
    small = capture.select([0]).resized(min(_LONGEST_SIDE, max(capture.images.shape[1:3])))
    for body in (capture.body, gaussian_body(capture.body, config)):
        vertices = np.zeros(body.template.shape, np.float32)
        yield body_image, (vertices, body.faces, vertices, small.cameras[0])


def _prepared(capture: Capture) -> PreparedCapture | None:
    """Prepares the capture for the network of the package, as `reconstruct` does. Returns None if
    no view shows the person.
    """
    try:
        return prepare_capture(capture, shipped_network())
    except CaptureError:
        return None  # the sheet shows what is wrong


def _shown(whole: Capture, small: Capture, vertices: dict[int, Float[Array, "n 3"]]) -> Capture:
    """Returns the capture that the sheet shows. Its photos are cut to the person, and have at most
    512 pixels a side. If no photo shows the person, or if the cut photos would be nearly as large
    as the whole ones, the result is `small`. whole: the capture. small: the same capture with
    reduced photos. vertices: vertices of the posed body, by frame, (n, 3), metres.
    """
    close, _ = around_person(whole, vertices)
    if close is whole:
        return small
    if max(close.images.shape[1:3]) > _LONGEST_SIDE:
        return close.resized(_LONGEST_SIDE)
    return close


def draw_body(
    body: BodyModel,
    betas: Float[Array, " s"],
    pose: BodyPose,
    camera: Camera,
    photo: Float[np.ndarray, "h w 3"],
) -> tuple[Float[np.ndarray, "h w 3"], BodyImage]:
    """Draws the posed body over the photo of one camera. Returns the picture, (h, w, 3), 0 to 1,
    and the image of the body alone.
    """
    drawn = body_image(
        jax.jit(person_vertices)(body, betas, pose), body.faces, side_tints(body), camera
    )
    return overlay(photo, drawn), drawn


def overlay(photo: Float[np.ndarray, "h w 3"], drawn: BodyImage) -> Float[np.ndarray, "h w 3"]:
    """Blends the body over a photo, half-transparent and with its outline. Returns (h, w, 3), in
    [0, 1].
    """
    covered = np.asarray(drawn.covered)
    blended = photo + TINTS.opacity * covered[..., None] * (np.asarray(drawn.shaded) - photo)
    return np.where(_boundary(covered)[..., None], np.asarray(TINTS.boundary), blended)


def side_tints(body: BodyModel) -> Float[np.ndarray, "n 3"]:
    """Returns colors of the body's vertices, (n, 3), by their side: left, right, or between. Names
    of the joints that move a vertex decide the side; without such names the sign of x in T-pose
    does.
    """
    weights = np.asarray(body.skinning_weights)
    left, right = (
        weights @ np.array([name.startswith(side) for name in body.joint_names])
        for side in ("left", "right")
    )
    if not (left.any() and right.any()):
        left, right = (np.asarray(body.template)[:, 0] * sign > 0 for sign in (1, -1))
    left, right = left.astype(np.float32)[:, None], right.astype(np.float32)[:, None]
    colors = np.asarray([TINTS.left, TINTS.right, TINTS.middle], np.float32)
    tints = left * colors[0] + right * colors[1] + (1 - left - right) * colors[2]
    return tints.astype(np.float32)


@compiled()
def body_image(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    tints: Float[Array, "n 3"],
    camera: Camera,
) -> BodyImage:
    points = transform.apply(camera.cam_from_world, vertices)
    rays = points / jnp.linalg.norm(points, axis=-1, keepdims=True)
    rotation = camera.cam_from_world[:3, :3]
    normals = jnp.matmul(vertex_normals(vertices, faces), rotation.T, precision=transform.EXACT)
    light = _AMBIENT + (1 - _AMBIENT) * jnp.abs(jnp.sum(normals * rays, axis=-1, keepdims=True))
    fragments = rasterize_mesh(vertices, faces, camera)
    shaded = interpolate_attributes(fragments, faces, tints * light, jnp.zeros(3))
    return BodyImage(shaded, fragments.face_ids >= 0)


def _posed_frames(
    capture: Capture, moves: Float[np.ndarray, "n 3"] | None = None
) -> dict[int, Float[Array, "n 3"]]:
    """Returns the posed vertices of the frames that views show, by frame, (n, 3), metres. moves:
    displacements of the shaped body before it is posed, metres; None: none.
    """
    rest = shape_body(capture.body, jnp.asarray(capture.betas))
    if moves is not None:
        rest = replace(rest, vertices=rest.vertices + moves)
    shown, pose = sorted({int(frame) for frame in capture.frames}), jax.jit(pose_body)
    return {frame: pose(capture.body, rest, capture.pose(frame)).vertices for frame in shown}


def _agreement(
    covered: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> tuple[float, float]:
    """Returns the intersection over union of body and mask, and the share of the body's pixels that
    are more than one pixel off the mask, both 0 to 1.
    """
    union = max((covered | mask).sum(), 1)
    return float((covered & mask).sum() / union), float(
        (covered & ~binary_dilation(mask)).sum() / max(covered.sum(), 1)
    )


def _boundary(covered: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Returns which pixels of the body have one of their four neighbours outside of it, (h, w)."""
    return covered & ~binary_erosion(covered, border_value=1)


def _label(view: ViewCheck) -> str:
    iou = ""
    if view.iou is not None:
        iou = f"  IoU {view.iou:.2f}"
    return f"{'! ' if view.warning else ''}{view.name}{iou}"


# Fits
# --------------------------------------------------------------------------------------------------

VIEWS = 24
"""Largest number of views on the sheet of a fit."""
_FINE = 2
"""Factor by which a sheet is drawn too large and then shrunk, so that lines are smooth."""


def fit_sheet(
    capture: Capture, keypoints: Keypoints, examination: Examination, out: str | Path
) -> None:
    """Writes a sheet of up to 24 views, evenly chosen, as a PNG. Each shows the fitted body and the
    keypoints.

    Arguments: examination: how far this capture's landmarks are from these keypoints.
    Raises: OSError if the image cannot be written.
    """
    count = capture.view_count
    chosen = np.unique(np.linspace(0, count - 1, min(count, VIEWS)).round().astype(int)).tolist()
    compared = [examination.compared[view] for view in range(count)]
    marks = [keypoints.points[view][compared[view]] for view in range(count)]
    close, corners = around_person(capture, _posed_frames(capture), marks)
    drawn = [
        _with_keypoints(_overlay(close, view), close, corners[view], keypoints, examination, view)
        for view in chosen
    ]
    contact_sheet(np.stack(drawn), out, labels=[_fit_label(examination, view) for view in chosen])


def _overlay(capture: Capture, view: int) -> Float[np.ndarray, "h w 3"]:
    shown = capture.select([view]).resized(_LONGEST_SIDE)
    pose = capture.pose(int(capture.frames[view]))
    return draw_body(
        capture.body, jnp.asarray(capture.betas), pose, shown.cameras[0], shown.images[0]
    )[0]


def _with_keypoints(
    image: Float[np.ndarray, "h w 3"],
    capture: Capture,
    corner: Int[np.ndarray, "2"],
    keypoints: Keypoints,
    examination: Examination,
    view: int,
) -> Float[np.ndarray, "h w 3"]:
    """Draws the keypoints of a view, and the landmarks of the body, over its image. Returns
    (h, w, 3), 0 to 1.

    Arguments: capture: the capture whose photos are cut to the person. corner: upper left corner
    (x, y) of the cut photo in the photo that keypoints refer to, pixels.
    """
    from PIL import Image, ImageDraw

    height, width = image.shape[:2]
    # drawn larger and shrunk at the end, for smooth lines
    canvas = Image.fromarray(to_uint8(image)).resize(
        (_FINE * width, _FINE * height), Image.Resampling.BILINEAR
    )
    pen = ImageDraw.Draw(canvas)
    scale = _FINE * np.asarray([width / capture.images.shape[2], height / capture.images.shape[1]])

    def within(points):
        return np.clip((points - corner) * scale, -_FINE * width, 2 * _FINE * width)

    discs, crosses = within(keypoints.points[view]), within(examination.landmarks[view])
    shown = np.flatnonzero(examination.compared[view])
    # pixels of a tile: hands and face have small discs
    radii = [_FINE * (2 if _is_small(name) else 4) for name in keypoints.set.names]
    # lines and crosses first, so that discs lie over them
    for k in shown:
        (x, y), arm = crosses[k], 1.5 * radii[k]
        for line in (
            [tuple(discs[k]), (x, y)],
            [(x - arm, y - arm), (x + arm, y + arm)],
            [(x - arm, y + arm), (x + arm, y - arm)],
        ):
            pen.line(line, fill=TINTS.cross, width=_FINE)
    for k in shown:
        # outliers are hollow: body and photo disagree there
        color, outlier = _color(keypoints.set.names[k]), examination.outliers[view, k]
        pen.circle(
            tuple(discs[k]),
            radii[k] + _FINE,
            fill=None if outlier else color,
            outline=(0, 0, 0),
            width=_FINE,
        )
        if outlier:
            pen.circle(tuple(discs[k]), radii[k], outline=color, width=_FINE)
    return np.asarray(canvas.resize((width, height), Image.Resampling.BOX)) / 255


def _is_small(name: str) -> bool:
    return name.startswith("face_") or any(
        part in name for part in ("hand_root", *(f"_{finger}_" for finger in FINGERS))
    )


def _color(name: str) -> tuple[int, ...]:
    side = {"left": TINTS.left, "right": TINTS.right}.get(name.split("_")[0])
    if side is None:
        return (255, 255, 255)
    return tuple(to_uint8(np.asarray(side)).tolist())


def _fit_label(examination: Examination, view: int) -> str:
    fit = examination.report.views[view]
    return f"{fit.name}  {f'{fit.median:.1f} px' if fit.keypoints else 'no keypoints'}"
