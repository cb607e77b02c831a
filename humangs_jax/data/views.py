"""The photos of one subject with the body parameters of each photo. Also computes the network's
inputs from these.
"""

import dataclasses
import functools
import logging
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse

from humangs_jax.body.model import BodyModel, BodyPose, RestBody, pose_body, shape_body
from humangs_jax.body.motion import turned_upright
from humangs_jax.body.resolution import decimate_with_kept, split_long_edges
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import from_host, taken
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.loops import over
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.capture import Capture
from humangs_jax.data.masks import person_box
from humangs_jax.geometry.axes import nearest_axis, standing_axis, upright_matrix
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.arrays import checksum
from humangs_jax.io.images import resized
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import HumanGSInputs, subject_unit
from humangs_jax.rendering.mesh.rasterizer import (
    BACKGROUND,
    BACKGROUND_DEPTH,
    gouraud_position_map,
    plain_position_map,
    vertex_normals,
)

logger = logging.getLogger(__name__)


@pytree_dataclass
class SubjectViews:
    """Views of one subject. Each view has its pose, so that photos of different poses need no
    special case.
    """

    images: Float[Array, "v h w 3"]
    """The photos on white, (v, h, w, 3), in [0, 1]."""
    masks: Float[Array, "v h w"]
    """The coverage by the person, (v, h, w), in [0, 1]."""
    cameras: Camera
    """A batch of v cameras, metres."""
    rotations: Float[Array, "v j 3"]
    """Axis-angle rotations of the joints, (v, j, 3), radians."""
    translations: Float[Array, "v 3"]
    """Translations of the body, (v, 3), metres."""
    betas: Float[Array, " s"]
    """Shape coefficients, (s,)."""
    view_count: Int[Array, ""] | None = None
    """The number of views that are not padding. The views after these are padding, see `pad_views`.
    None: there is no padding.
    """
    depths: Float[Array, "v h w"] | None = None
    """The mean depth (z in the camera's axes) of the person in each pixel, (v, h, w), metres. It
    counts only where the mask is not 0. A depth of 0 means unknown. None: unknown everywhere.
    """
    displacement: Float[Array, "n 3"] | None = None
    """The displacement of the vertices of the shaped body in the T-pose, (n, 3), metres
    (`data.vertex_offsets`). None: there is none.
    """
    unknown: Bool[Array, "v h w"] | None = None
    """Where somebody or something may hide the person, (v, h, w); masks are 0 there. None:
    nowhere.
    """


def pad_views(views: SubjectViews, count: int) -> SubjectViews:
    """Returns `count` views: the given ones, then copies of the last one as padding. So subjects
    with different numbers of views can share a batch. `depths` and `unknown` stay as they are,
    without padding.

    Raises: ValueError if there are no views, or more than `count`.
    """
    own = len(views.images)
    if not 0 < own <= count:
        raise ValueError(f"{own} views cannot be padded to {count}")
    repeated = np.minimum(np.arange(count), own - 1)
    per_view = ("images", "masks", "cameras", "rotations", "translations")
    padded = {
        name: jax.tree.map(lambda x: taken(x, repeated), getattr(views, name)) for name in per_view
    }
    return replace(views, **padded, view_count=from_host(own, jnp.int32))


@checked_arguments
def gaussian_body(body: BodyModel, config: HumanGSConfig) -> BodyModel:
    """Returns the body whose vertices carry the Gaussians. It has the mesh that the weights need:
    the body is decimated, then long edges are split. It has a map of its surface if the network
    works on such a map.

    The result's `relative_vertex_spacing` is relative to the mesh that the weights were trained
    with. It is None, which stands for 1, unless `runtime.max_edge_length` asks for more vertices or
    `runtime.body_vertices` for fewer.

    The last four results are kept, because making one takes as long as running a small network on a
    CPU. A body that `has_mesh_of` accepts is returned as it is.

    Raises: ValueError if `runtime` has both `max_edge_length` and `body_vertices`, and as
    `decimate_with_kept` and `split_long_edges`.
    """
    asked = config.runtime
    if None not in (asked.body_vertices, asked.max_edge_length):
        raise ValueError(
            "runtime: body_vertices asks for fewer vertices, max_edge_length for more: expected one"
            " of them"
        )
    if has_mesh_of(body, config):
        return body
    return _remeshed(_ByContent(body), *remesh_key(config))[0]


def has_mesh_of(body: BodyModel, config: HumanGSConfig) -> bool:
    """Returns whether a body is the `gaussian_body` of this configuration; true for any body if the
    configuration asks for no other mesh.
    """
    key = remesh_key(config)
    return body.remesh_key == key or not any(key)


def remesh_key(config: HumanGSConfig) -> tuple[Any, ...]:
    """Returns all settings of a configuration that `gaussian_body` depends on."""
    trained, asked = config.conventions, config.runtime
    return (
        trained.body_vertices,
        trained.max_edge_length,
        asked.body_vertices,
        asked.max_edge_length,
        config.architecture.surface_map,
    )


class _ByContent:
    """A cache key of a body. Bodies with equal contents have equal keys, even if they were read
    twice.
    """

    def __init__(self, body: BodyModel) -> None:
        leaves, structure = jax.tree.flatten(body)
        self.body = body
        self.checksum = checksum({str(i): leaf for i, leaf in enumerate(leaves)}, str(structure))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByContent) and self.checksum == other.checksum

    def __hash__(self) -> int:
        return hash(self.checksum)


@functools.lru_cache(maxsize=4)
def _remeshed(
    key: _ByContent,
    vertices: int | None,
    edge: float | int | None,
    fewer: int | None,
    longest: float | int | None,
    wanted: Any,
) -> tuple[BodyModel, sparse.csr_array]:
    """Returns the body that carries the Gaussians, and a matrix (m, n). The matrix takes values at
    the n vertices of the given body, such as displacements, to the m vertices of the result.
    Midpoints of edges get the mean of the ends.
    """
    body = key.body
    weights = sparse.eye_array(len(body.template), format="csr")
    if vertices is not None and vertices < len(body.template):
        body, kept = decimate_with_kept(body, vertices)
        weights = weights[kept]
    whole, of_whole = body, weights
    if edge is not None:
        body, split = split_long_edges(body, edge)
        body, weights = replace(body, relative_vertex_spacing=None), split @ weights
    if fewer is not None and fewer < len(whole.template):
        coarse, kept = decimate_with_kept(whole, fewer)
        of_coarse = of_whole[kept]
        if edge is not None:  # edges as much longer as the body has fewer vertices on the same area
            longer = edge * np.sqrt(len(whole.template) / fewer)
            coarse, split = split_long_edges(coarse, longer)
            of_coarse = split @ of_coarse
        wider = np.sqrt(len(body.template) / len(coarse.template))
        spacing = from_host(np.full(len(coarse.template), wider), body.template.dtype)
        body, weights = replace(coarse, relative_vertex_spacing=spacing), of_coarse
    if longest is not None:
        body, split = split_long_edges(body, longest)
        weights = split @ weights
    if wanted is not None:
        body = replace(body, texels=wanted.texels(body))
    return replace(body, remesh_key=(vertices, edge, fewer, longest, wanted)), weights


def on_gaussian_body(
    displacement: Float[np.ndarray, "n 3"], body: BodyModel, config: HumanGSConfig
) -> Float[Array, "m 3"]:
    """Returns the displacement of the vertices of a body's `gaussian_body`, (m, 3), metres.
    displacement: that of the body's own vertices, (n, 3), metres. Midpoints of edges move by the
    mean of the ends.
    """
    if has_mesh_of(body, config):
        return from_host(displacement)
    weights = _remeshed(_ByContent(body), *remesh_key(config))[1]
    return from_host(weights @ np.asarray(displacement, np.float64), body.template.dtype)


def subject_rest(
    body: BodyModel, betas: Float[Array, " s"], displacement: Float[Array, "n 3"] | None
) -> RestBody:
    """Returns the person's body in the T-pose, with displaced vertices. Joints are not moved.
    displacement: (n, 3), metres; None: there is none.
    """
    rest = shape_body(body, betas)
    if displacement is None:
        return rest
    return replace(rest, vertices=rest.vertices + displacement)


@checked_arguments
def prepare_inputs(body: BodyModel, views: SubjectViews, config: HumanGSConfig) -> HumanGSInputs:
    """Returns the network's inputs: the body is posed for every view and rasterized into position
    maps and depth maps, and the foreground of the photos is found.

    Pure and jittable; nothing here is differentiated with respect to the body.
    """
    rest = subject_rest(body, views.betas, views.displacement)

    def pose_view(
        rotations: Float[Array, "j 3"], translation: Float[Array, "3"]
    ) -> Float[Array, "n 3"]:
        return pose_body(body, rest, BodyPose(rotations, translation)).vertices

    # the body in the pose of each view, and all lengths in units of the body
    posed = jax.vmap(pose_view)(views.rotations, views.translations)
    unit = subject_unit(rest.vertices)
    canonical, cameras = rest.vertices / unit, views.cameras.in_units(unit)
    draw = {"plain": plain_position_map, "gouraud": gouraud_position_map}[
        config.conventions.position_map
    ]

    # views that are padding show nothing: a body of no extent has no pixel to draw
    shown = posed
    if views.view_count is not None:
        present = jnp.arange(len(posed)) < views.view_count
        shown = jnp.where(present[:, None, None], posed, posed[:, :1])

    def rasterize_view(arguments):
        vertices, camera = arguments
        return draw(vertices / unit, canonical, body.faces, camera, config.runtime.raster)

    def normals(vertices):
        return vertex_normals(vertices, body.faces)

    # on a CPU one view after the other: side by side, every view would pay for the fullest one
    pixels = cameras.width * cameras.height
    position_maps, depth_maps = over(rasterize_view, (shown, cameras), pixels)
    # what the network looks at: the mask and the body, or the mask alone where there is one
    foreground = (views.masks > MASK_THRESHOLD) | (depth_maps >= 0)
    if config.conventions.pixels == "person":
        masked = jnp.any(views.masks > MASK_THRESHOLD, axis=(1, 2), keepdims=True)
        foreground &= (views.masks > MASK_THRESHOLD) | ~masked
        depth_maps = jnp.where(foreground, depth_maps, BACKGROUND_DEPTH)
        position_maps = jnp.where(foreground[..., None], position_maps, BACKGROUND)
    return HumanGSInputs(
        images=views.images,
        cameras=views.cameras,
        posed_vertices=posed,
        canonical_vertices=rest.vertices,
        position_maps=position_maps,
        depth_maps=depth_maps,
        foreground=foreground,
        view_count=views.view_count,
        posed_normals=jax.vmap(normals)(posed),
        canonical_normals=normals(rest.vertices),
        relative_vertex_spacing=body.relative_vertex_spacing,
        skinning_weights=body.skinning_weights,
        texels=body.texels,
    )


CROP_MARGIN = 0.04
"""The room on each side of the person, as a share of the crop's side."""


def _crop_boxes(masks: Float[np.ndarray, "v h w"] | None) -> list[tuple[int, int, int]] | None:
    """Returns the square (left, top, side) around the person in each mask, pixels.

    Returns None if there are no masks, if a mask is empty, or if no square is smaller than the
    photos' longer side.
    """
    if masks is None:
        return None
    boxes = []
    for mask in masks > MASK_THRESHOLD:
        low, high = person_box(mask)[::-1].T
        if not high.any():
            return None
        side = int(np.ceil((high - low).max() / (1 - 2 * CROP_MARGIN)))
        boxes.append((*((low + high - side) // 2).tolist(), side))
    if min(side for *_, side in boxes) >= max(masks.shape[1:]):
        return None
    return boxes


def cropped(capture: Capture, size: int) -> Capture:
    """Returns the capture with each photo cut to a square around the person in its mask, and
    resized to `size` pixels. Returns the capture as it is if there are no masks, if a mask is
    empty, or if no square would be smaller than the photos' longer side.

    Pixels of a square beyond its photo become unknown if the person touches the edge of any photo,
    or if the capture has unknown pixels.
    """
    boxes = _crop_boxes(capture.masks)
    if boxes is None or capture.masks is None:
        return capture
    images, masks, cameras = _squares(capture.images, capture.masks, capture.cameras, boxes, size)

    # nobody knows what is beyond the edge of a photo, whose border may cut the person off
    person, unknown = capture.masks > MASK_THRESHOLD, capture.unknown
    ends = (person[:, 0], person[:, -1], person[:, :, 0], person[:, :, -1])
    if unknown is None and any(end.any() for end in ends):
        unknown = np.zeros(capture.masks.shape, bool)
    if unknown is not None:
        shares = unknown.astype(np.float32)
        hidden = [_window(x, *box, 1.0) for x, box in zip(shares, boxes, strict=True)]
        unknown = np.stack([resized(x, size, size) for x in hidden]) > 0
    return dataclasses.replace(
        capture, images=images, masks=masks, cameras=cameras, unknown=unknown
    )


def _squares(
    images: Float[np.ndarray, "v h w 3"],
    masks: Float[np.ndarray, "v h w"] | None,
    cameras: Camera,
    boxes: Sequence[tuple[int, int, int]],
    size: int,
) -> tuple[Float[np.ndarray, "v size size 3"], Float[np.ndarray, "v size size"] | None, Camera]:
    """Returns photos, masks and cameras, each cut to its square (left, top, side) in `boxes` and
    resized to `size` pixels. Beyond the photo a square is white, and 0 in the mask.
    """

    def cut(array, fill):
        return np.stack(
            [
                resized(_window(x, *box, fill), size, size)
                for x, box in zip(array, boxes, strict=True)
            ]
        )

    left, top, sides = np.asarray(boxes, np.float32).T
    shift = np.zeros((len(boxes), 3, 3), np.float32)
    shift[:, 0, 2], shift[:, 1, 2] = left, top
    scale = np.stack([size / sides, size / sides, np.ones_like(sides)], axis=-1)
    K = from_host((np.asarray(cameras.K) - shift) * scale[:, :, None])
    cameras = replace(cameras, K=K, width=size, height=size)
    return cut(images, 1.0), None if masks is None else cut(masks, 0.0), cameras


def _window(
    image: Float[np.ndarray, "h w *c"], left: int, top: int, side: int, fill: float
) -> Float[np.ndarray, "side side *c"]:
    """Returns a square of an image, float32. Pixels beyond the image get the value `fill`. left,
    top, side: the place and the side of the square, pixels.
    """
    height, width = image.shape[:2]
    window = np.full((side, side, *image.shape[2:]), fill, np.float32)
    rows = slice(max(top, 0), min(top + side, height))
    columns = slice(max(left, 0), min(left + side, width))
    window[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = image[
        rows, columns
    ]
    return window


def world_up(roots: Float[np.ndarray, "v 3"], cameras: Camera) -> str:
    """Returns the axis that points up in the world of some views, such as "x" or "-z"; "y" if the
    axis is not certain.

    Captures should have y up: the network was trained in such worlds, and the light of an avatar
    needs such a world. Another axis counts as up only if both the person and the cameras stand
    along it, because the person may be lying down.

    roots: the rotation of the person's root joint in each view, axis-angle, radians.
    """
    up = standing_axis(roots)
    if up in (None, "y"):
        return "y"
    camera_up = -np.asarray(cameras.cam_from_world)[:, 1, :3].mean(axis=0)
    if nearest_axis(camera_up)[0] == up:
        return up
    return "y"


def turned_world(
    poses: BodyPose, cameras: Camera, up: str, pelvis: Float[np.ndarray, "3"]
) -> tuple[BodyPose, Camera]:
    """Returns poses and cameras in a world turned so that the axis `up` becomes +y. A warning
    reports the turn.

    pelvis: the root joint in T-pose, metres.
    """
    logger.warning(
        "the world of these views has %s up, person and cameras say: expected y up, it is turned",
        up,
    )
    rotations, translations = np.asarray(poses.rotations), np.asarray(poses.translation)
    rotations, translations = turned_upright(rotations, translations, up, pelvis)
    back = np.eye(4)
    back[:3, :3] = upright_matrix(up).T
    matrices = from_host(np.asarray(cameras.cam_from_world) @ back, jnp.float32)
    turned = jax.vmap(BodyPose)(
        from_host(rotations, jnp.float32), from_host(translations, jnp.float32)
    )
    return turned, replace(cameras, cam_from_world=matrices)


def to_network_views(
    capture: Capture,
    size: int,
    crop: bool = False,
    displacement: Float[np.ndarray, "n 3"] | None = None,
) -> SubjectViews:
    """Returns a capture's photos in the form that the network takes: padded with white to a centred
    square, or cropped, and resized to `size` pixels. The cameras fit the new photos. Unknown pixels
    are not passed on.

    If the capture has no masks, all masks in the result are 0. Only what the posed body covers then
    counts as foreground.

    crop: whether photos are cut to squares around the person. This is not done where `_crop_boxes`
    returns None. displacement: the displacement of the body that carries the Gaussians, see
    `SubjectViews`.
    """
    boxes = None
    if crop:
        boxes = _crop_boxes(capture.masks)
    if boxes is None:
        height, width = capture.images.shape[1:3]
        side = max(height, width)
        boxes = [(-((side - width) // 2), -((side - height) // 2), side)] * capture.view_count
    images, masks, cameras = _squares(capture.images, capture.masks, capture.cameras, boxes, size)
    if masks is None:
        masks = np.zeros(images.shape[:3], np.float32)
    frames = np.asarray(capture.frames)
    return SubjectViews(
        images=from_host(images, jnp.float32),
        masks=from_host(masks, jnp.float32),
        cameras=cameras,
        rotations=from_host(np.asarray(capture.poses.rotations)[frames]),
        translations=from_host(np.asarray(capture.poses.translation)[frames]),
        betas=from_host(capture.betas),
        displacement=None if displacement is None else from_host(displacement),
    )
