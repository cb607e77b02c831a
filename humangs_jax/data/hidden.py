"""Finds things in front of the person that make a hole in a mask: a chair, a table, a bicycle.

A mask says where the person is seen. If a pixel shows the posed body but is not on the mask,
something is in front of the person, or the mask is wrong. The photo says nothing about the person
there. Holes of such pixels become unknown (`Capture.unknown`).

If the pose is a little wrong, the edge of the body also lies beside the mask. So holes count only
well inside of the silhouette, in parts that are thicker than an arm. If much of the mask lies
beside the body near a hole, the hole does not count: it comes from an arm or a leg in another pose.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.body_and_masks import (
    MASK_THRESHOLD,
    shaped,
    skinned,
    views_without_person,
)
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import few
from humangs_jax.data.vertex_offsets import silhouette
from humangs_jax.io.images import resized

LONGEST = 512
"""Largest length of the longer side of the photos in which silhouettes are compared, pixels. Larger
photos are reduced.
"""
INSIDE = 0.035
"""A hole is looked for where the silhouette's edge is farther away than this, metres. Fitted bodies
are off by less.
"""
THICK = 0.015
"""Half of the least thickness of a hole, metres. Only the part of the hole that is farther than
`INSIDE` from the silhouette's edge is measured. Arms, and the gap between arm and trunk, are too
thin for holes.
"""
AREA = 0.005
"""The least area of a hole, square metres. Only the part that is thick enough (`THICK`) is
measured.
"""
EDGE = 0.01
"""A hole is extended outwards until it is this near to the silhouette's edge, metres."""
RIM = 0.03
"""Distance by which a hole is enlarged, metres. The thing in front hides clothes outside of the
body, too, and its colors are seen along the edge of the mask.
"""
INTO_MASK = 0.008
"""Distance by which a hole is enlarged onto the mask, metres."""
LOOSE = 0.04
"""Distance outside of the silhouette up to which the mask may show clothes and hair, metres."""
NEARBY = 0.25
"""Distance from a hole within which the mask beside the body is measured, metres, see `BESIDE`."""
BESIDE = 0.35
"""Largest area of the mask beside the body near a hole, as a share of the hole's area (see `AREA`).
If the area is larger, nothing is in front: an arm or a leg of the person has another pose than the
body's.
"""
AGREES = 0.75
"""At least this share of the mask has to lie on the body's silhouette or within `LOOSE` of it. If
less does, the body is not where the person is, and no holes are looked for.
"""
SHOWN = 0.3
"""The mask has to cover more than this share of the body's silhouette, without unknown pixels. If
it covers less, most of the body would be a guess, and no holes are looked for.
"""


class _Photo(NamedTuple):
    """A photo whose longer side has at most `LONGEST` pixels, with the silhouette of the posed
    body. Its arrays are (h, w).

    mask: where the person is seen. known: the pixels that are not unknown already. body: the
    silhouette. beside: the part of the mask that is farther than `LOOSE` from the silhouette.
    per_metre: pixels per metre at the median depth of the body.
    """

    mask: np.ndarray
    known: np.ndarray
    body: np.ndarray
    beside: np.ndarray
    per_metre: float


def with_hidden_parts(capture: Capture) -> Capture:
    """Returns the capture with pixels made unknown where something is in front of the posed body.
    These pixels are white in the photos and 0 in the masks.

    Returns the same object if there are no such pixels, or no masks.
    """
    found = hidden_parts(capture)
    if found is None:
        return capture
    assert capture.masks is not None
    unknown = found
    if capture.unknown is not None:
        unknown = capture.unknown | found
    return dataclasses.replace(
        capture,
        images=np.where(unknown[..., None], np.float32(1), capture.images),
        masks=np.where(unknown, np.float32(0), capture.masks),
        unknown=unknown,
    )


def hidden_line(before: Capture, after: Capture) -> str | None:
    """Returns a line that names the photos in which `with_hidden_parts` has found something; None
    if there are none. before, after: the capture before and after that call.
    """
    if after.unknown is None:
        return None
    if before.unknown is None:
        known = np.zeros_like(after.unknown)
    else:
        known = before.unknown
    new = (after.unknown & ~known).any(axis=(1, 2))
    names = [name for name, hidden in zip(after.names, new, strict=True) if hidden]
    reason = "the mask has a hole where the body is: something is in front, and unknown there"
    return f"{few(names)}: {reason}" if names else None


def hidden_parts(capture: Capture) -> Bool[np.ndarray, "v h w"] | None:
    """Returns the pixels of each photo at which something is in front of the posed body, (v, h, w);
    None if there are none, or no masks. Holes are not looked for in pixels that are unknown
    already, but the rim around a hole may contain such pixels.
    """
    if capture.masks is None:
        return None
    body, poses = capture.body, capture.poses
    rest = shaped(body, capture.betas)
    joints = np.asarray(body.joint_regressor, float) @ rest
    weights, faces = np.asarray(body.skinning_weights, float), np.asarray(body.faces)
    found, posed = np.zeros(capture.masks.shape, bool), {}
    unusable = views_without_person(capture)
    for i, frame in enumerate(np.asarray(capture.frames).tolist()):
        if i in unusable:
            continue
        if frame not in posed:
            linear, offset = skinned(body, joints, poses, frame, weights, corrected=True)
            posed[frame] = np.einsum("nab,nb->na", linear, rest) + offset
        if np.isfinite(posed[frame]).all():
            found[i] = _hidden_part(capture, i, posed[frame], faces)
    return found if found.any() else None


def _hidden_part(
    capture: Capture, view: int, vertices: Float[np.ndarray, "n 3"], faces: np.ndarray
) -> Bool[np.ndarray, "h w"]:
    """Returns `hidden_parts` of one photo. vertices: those of the posed body, (n, 3), metres."""
    assert capture.masks is not None
    height, width = capture.masks.shape[1:]
    nowhere = np.zeros((height, width), bool)
    photo = _reduced_photo(capture, view, vertices, faces)
    if photo is None or not _shows_body(photo):
        return nowhere
    hole = _holes(photo)
    if not hole.any():
        return nowhere
    return resized(_with_rim(hole, photo).astype(np.float32), width, height) > MASK_THRESHOLD


def _reduced_photo(
    capture: Capture, view: int, vertices: Float[np.ndarray, "n 3"], faces: np.ndarray
) -> _Photo | None:
    """Returns a photo with the silhouette of the posed body; None if a part of the body is not in
    front of the camera, or if no part is in the photo. vertices: see `_hidden_part`.
    """
    assert capture.masks is not None
    # the photo is reduced to `LONGEST`, and its camera with it
    height, width = capture.masks.shape[1:]
    scale = min(1.0, LONGEST / max(height, width))
    columns, rows = max(1, round(scale * width)), max(1, round(scale * height))
    mask = resized(capture.masks[view], columns, rows) >= MASK_THRESHOLD
    known = np.ones_like(mask)
    if capture.unknown is not None:
        known = resized(capture.unknown[view].astype(np.float32), columns, rows) == 0
    K = np.asarray(capture.cameras.K, float)[view] * [[columns / width], [rows / height], [1]]

    # the silhouette of the body
    cam_from_world = np.asarray(capture.cameras.cam_from_world, float)[view]
    seen = vertices @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    depths = seen[:, 2:]
    if depths.min() <= 0:
        return None
    pixels = (seen / depths @ K.T)[:, :2]
    body = silhouette(pixels, faces, mask.shape) > 0
    if not body.any():
        return None

    per_metre = float(np.sqrt(K[0, 0] * K[1, 1]) / np.median(depths))
    outside = ndimage.distance_transform_edt(~body)
    beside = mask & (outside > LOOSE * per_metre)
    return _Photo(mask, known, body, beside, per_metre)


def _shows_body(photo: _Photo) -> bool:
    """Returns whether the mask agrees with the body (`AGREES`) and shows enough of it (`SHOWN`)."""
    if photo.beside.sum() > (1 - AGREES) * photo.mask.sum():
        return False
    shown = photo.mask & photo.body
    could_be_shown = photo.body & photo.known
    return bool(shown.sum() > SHOWN * could_be_shown.sum())


def _holes(photo: _Photo) -> Bool[np.ndarray, "h w"]:
    """Returns the pixels of holes in the mask that are thick, large and well inside of the body.
    Holes extend to `EDGE` from the silhouette's edge.
    """
    per_metre = photo.per_metre
    # the border of the photo is not an edge of the body
    inside = ndimage.distance_transform_edt(np.pad(photo.body, 1, mode="edge"))[1:-1, 1:-1]
    missing = ~photo.mask & photo.known
    core = _opened(missing & (inside > INSIDE * per_metre), THICK * per_metre)
    labels, count = ndimage.label(missing & (inside > EDGE * per_metre))

    hole = np.zeros_like(photo.mask)
    for label in range(1, count + 1):
        part = labels == label
        area = int((part & core).sum())
        if area < AREA * per_metre**2:
            continue
        # a limb of the person that the body has elsewhere would be seen beside the body
        nearby = ndimage.distance_transform_edt(~part) < NEARBY * per_metre
        if (photo.beside & nearby).sum() <= BESIDE * area:
            hole |= part
    return hole


def _with_rim(hole: Bool[np.ndarray, "h w"], photo: _Photo) -> Bool[np.ndarray, "h w"]:
    """Returns the holes enlarged by `RIM` outside of the mask, and by `INTO_MASK` on the mask."""
    away = ndimage.distance_transform_edt(~hole)
    in_rim = away < RIM * photo.per_metre
    at_hole = away < INTO_MASK * photo.per_metre
    return in_rim & (~photo.mask | at_hole)


def _opened(where: Bool[np.ndarray, "h w"], radius: float) -> Bool[np.ndarray, "h w"]:
    """Returns the union of all discs of this radius, pixels, that fit into the True pixels."""
    inner = ndimage.distance_transform_edt(where) > radius
    if not inner.any():
        return inner
    return ndimage.distance_transform_edt(~inner) <= radius
