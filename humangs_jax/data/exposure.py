"""Makes the exposure and the white balance of the photos of one person equal.

Cameras with automatic exposure show one skin in several colors. A gain for each photo and channel
makes the colors agree. A point of the body that two photos show should have the same color in both.
So for each pair of photos, the ratio of the two colors is found at all points that both show, and
the median of these ratios is taken. The gains bring the medians as near to 1 as possible. The
logarithms of the gains have the mean 0 over the photos. Gains of photos that share few points stay
near 1.

Photos of the front and of the back share no point of the body, nor do photos of the left and of the
right side. Groups of photos that are linked by shared points are compared by the parts of the body:
skin, hair and a garment have about one color in front and behind, left and right.

White balance is made equal first. The tint of a part, which is its color without its brightness,
hardly depends on how the light falls on the part. Parts that differ (an open coat in front, hair
over a neck) do not count, since the fit is robust. Brightness does depend on the light. It is made
equal only between photos of different moments, or if their white balances differ.

Gains are found once for the photos of a capture, which then records them (`Capture.gains`). If they
were found again from photos that are nearly equal, they would not be 1.
"""

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.sparse.csgraph import connected_components

from humangs_jax.body.model import BodyModel, BodyPose, RestBody, pose_body, shape_body
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.arrays import taken
from humangs_jax.core.compiled import compiled
from humangs_jax.core.processes import Call
from humangs_jax.data.body_and_masks import views_without_person
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import to_network_views
from humangs_jax.geometry.camera import Camera, project
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh, vertex_normals

EXPOSURE_SIZE = 256
"""Side of the squares around the person that are compared, pixels."""
FACING = 0.5
"""A photo shows a point only if the cosine of the angle between the point's normal and the
direction to the camera is more than this.
"""
THICKNESS = 0.02
"""A photo shows a point only if the point lies less than this behind the nearest surface, metres.
"""
INSIDE = 5
"""Side of the square around each point, pixels. A photo shows a point only if the square lies in
the mask, see `WHOLE`.
"""
WHOLE = 0.99
"""A square of side `INSIDE` lies in the mask if the mask is above this everywhere in the square."""
BLUR = 3
"""Side of the square over which colors are averaged, pixels."""
USABLE = (0.06, 0.95)
"""Range of the values of a color that tell a gain. Darker and brighter values are left out."""
LEAST_POINTS = 50
"""Least number of points that two photos must share to be compared."""
ALIKE = 50
"""Number of points that count as one independent measurement. The errors of neighbouring points are
nearly the same.
"""
NOISE = 0.03
"""Least standard deviation of the median of the log ratios of two photos, however many points they
share.
"""
EXPECTED = 0.15
"""Standard deviation that the logarithm of a gain has before photos are compared (the prior)."""
CLEAR = 1.0
"""Photos stay as they are if the medians of the log ratios, each divided by its standard error,
have a root mean square below this. Loose clothes and shadows make 0.3 to 0.9 in photos of equal
exposure (eight test people).
"""
NORMAL_MAD = 1.4826


def equalize_exposure(capture: Capture) -> Capture:
    """Returns the capture in equal exposure, with its gains recorded. Network and refinement read
    these photos. If the capture has gains already, it is returned as it is.

    Captures without masks are returned as they are, because nothing is known of their exposure.

    capture: photos on white; all masks show the person.
    """
    if capture.masks is None or capture.gains is not None:
        return capture
    gains = np.ones((capture.view_count, 3))
    if capture.view_count > 1:
        # by the points that views share, then by the parts of the body between views that do not
        colors, seen = points_of(capture)
        gains = gains_of(colors, seen)
        groups = linked_views(colors, seen)
        if groups.max() > 0:
            parts, frames = body_parts(capture.body), np.asarray(capture.frames)
            gains = gains * gains_between(colors * gains[:, None], seen, parts, groups, frames)
    images = capture.images
    if (gains != 1).any():
        images = apply_gain(images, capture.masks, gains)
    return dataclasses.replace(capture, images=images, gains=gains)


def exposure_gains(capture: Capture) -> Float[np.ndarray, "v 3"]:
    """Returns the factors by which the colors of a rendering are multiplied to get the exposure of
    each camera, (v, 3): one for each view and channel. If the capture has no gains yet, they are
    found here; views that do not show the person then have 1. All are 1 if there are no masks.
    """
    if capture.gains is not None:
        return 1 / capture.gains
    apart, found = views_without_person(capture), np.ones((capture.view_count, 3))
    usable = [i for i in range(capture.view_count) if i not in apart]
    if usable:
        gains = equalize_exposure(capture.select(usable)).gains
        if gains is not None:
            found[usable] = 1 / gains
    return found


def points_of(
    capture: Capture,
) -> tuple[Float[np.ndarray, "v n 3"], Bool[np.ndarray, "v n"]]:
    """Returns the colors of the body's vertices in each photo, (v, n, 3) in [0, 1], and which
    vertices the photo shows, (v, n).

    capture: photos on white, with masks, all of which show the person.
    """
    each = [_seen_colors(*arguments) for arguments in _looks(capture)]
    colors, seen = (np.stack(x) for x in zip(*each, strict=True))
    return colors, seen


def _looks(capture: Capture) -> Iterator[tuple[Any, ...]]:
    """Yields the arguments of `_seen_colors` for each photo."""
    views = to_network_views(capture, EXPOSURE_SIZE, crop=True)
    rest = shape_body(capture.body, views.betas)
    per_view = views.images, views.masks, views.cameras
    poses = jax.vmap(BodyPose)(views.rotations, views.translations)
    for i in range(capture.view_count):
        photo = jax.tree.map(lambda x, i=i: taken(x, i), (poses, *per_view))
        yield capture.body, rest, *photo


def calls_of_exposure(capture: Capture) -> Iterator[Call]:
    """Yields one call of the jitted function that finds the body's colors in a photo, to compile it
    ahead. The compiled program does not depend on where the body is.
    """
    yield _seen_colors, next(_looks(capture))


def gains_of(
    colors: Float[np.ndarray, "v n 3"], seen: Bool[np.ndarray, "v n"]
) -> Float[np.ndarray, "v 3"]:
    """Returns the gains of views, (v, 3), found from the points that they share. All are 1 if the
    colors hardly differ (`CLEAR`), or if no two views share enough points.

    colors: in [0, 1]. seen: which points each view shows.
    """
    count, logs = len(colors), np.log(np.maximum(colors, 1e-6))
    known = _known(colors, seen)
    found, errors = np.zeros((count, 3)), []
    for channel in range(3):
        rows, values = list(np.eye(count) / EXPECTED), [0.0] * count
        for one, other in itertools.combinations(range(count), 2):
            both = known[one, :, channel] & known[other, :, channel]
            points = np.count_nonzero(both)
            if points < LEAST_POINTS:
                continue
            ratios = logs[other, both, channel] - logs[one, both, channel]
            middle = np.median(ratios)
            spread = NORMAL_MAD * np.median(np.abs(ratios - middle))
            error = np.hypot(NOISE, spread * np.sqrt(ALIKE / points))
            rows.append((np.eye(count)[one] - np.eye(count)[other]) / error)
            values.append(middle / error)
        errors += values[count:]
        found[:, channel] = np.linalg.lstsq(np.stack(rows), np.stack(values), rcond=None)[0]
    if not errors or np.sqrt(np.mean(np.square(errors))) < CLEAR:
        return np.ones((count, 3))
    return np.exp(found - found.mean(axis=0))


# Photos without a common point
# --------------------------------------------------------------------------------------------------

PARTS = (
    ("spine3", "collar"),
    ("spine1", "spine2"),
    ("pelvis",),
    ("hip",),
    ("knee",),
    ("ankle", "foot"),
    ("shoulder",),
    ("elbow",),
    ("wrist", "index", "middle", "pinky", "ring", "thumb"),
    ("neck",),
    ("head", "jaw", "eye"),
)
"""Words of the joint names of each part of the body. Left and right are one part."""
LEAST_OF_PART = 20
"""The least number of points that a group of photos must show of a part."""
TINT = 0.03
"""Standard deviation of the difference of a part's log tint between its front and its back, in one
light. 16 synthetic people without open coats have 0.02 to 0.04.
"""
BRIGHTNESS = 0.2
"""Standard deviation of the difference of a part's log brightness between its front and its back,
in one light. 16 synthetic people have 0.1 to 0.3.
"""
OFFSET = 0.01
"""Standard deviation of the stray light in a color, which is in [0, 1]. Stray light makes the tints
of dark parts uncertain.
"""
OTHER_LIGHT = 0.04
"""Photos of one moment count as balanced differently if the root mean square of their log white
balances is at least this. In one light at most 0.03 is found (16 synthetic people).
"""
OTHER_DAYS = 0.4
"""Standard deviation that the log gain of a group of photos has before the groups are compared (the
prior). The groups may be of different days.
"""
FITS = 16
"""Number of least-squares fits in `_robust_differences`. Each weights the rows by the residuals of
the fit before.
"""
REDESCENDING = 8
"""After each of this many fits, the last ones of `FITS`, the rows get Cauchy's weights. Parts that
differ then lose nearly all influence. With these weights after the first fits, too, the result
would depend on where the search starts.
"""


def linked_views(
    colors: Float[np.ndarray, "v n 3"], seen: Bool[np.ndarray, "v n"]
) -> Int[np.ndarray, " v"]:
    """Returns the index of each view's group, (v,). Two views are in one group if they share enough
    points to compare their gains. Views that are linked through other views are in one group, too.
    """
    known = np.all(_known(colors, seen), axis=-1)
    shared = np.einsum("an,bn->ab", known, known, dtype=int) >= LEAST_POINTS
    return connected_components(shared, directed=False)[1].astype(int)


def _known(
    colors: Float[np.ndarray, "v n 3"], seen: Bool[np.ndarray, "v n"]
) -> Bool[np.ndarray, "v n 3"]:
    return seen[..., None] & (colors > USABLE[0]) & (colors < USABLE[1])


def body_parts(body: BodyModel) -> Int[np.ndarray, " n"]:
    """Returns the part of the body that each vertex belongs to, as an index into `PARTS`, (n,). It
    is the part of the joint with the vertex's largest skinning weight. -1: none of these parts.
    """
    of_joint = [
        next((i for i, words in enumerate(PARTS) if any(word in name for word in words)), -1)
        for name in body.joint_names
    ]
    return np.asarray(of_joint)[np.asarray(body.skinning_weights).argmax(axis=1)]


def gains_between(
    colors: Float[np.ndarray, "v n 3"],
    seen: Bool[np.ndarray, "v n"],
    parts: Int[np.ndarray, " n"],
    groups: Int[np.ndarray, " v"],
    frames: Int[np.ndarray, " v"],
) -> Float[np.ndarray, "v 3"]:
    """Returns gains that make groups of views equal, (v, 3): a row for each view. All views of a
    group have the same gains. Views of different groups share too few points, so the groups are
    compared by the colors of the body's parts.

    If two groups share a frame, all photos count as taken in one light. Gains are then 1 if the
    white balances hardly differ, see `OTHER_LIGHT`. Gains are also 1 if no two groups show the same
    part.

    Arguments:
        colors: in [0, 1], in equal exposure within each group.
        seen: which points each view shows.
        parts: the part of each point, see `body_parts`.
        groups: the group of each view, see `linked_views`.
        frames: the frame of each view.
    """
    count = int(groups.max()) + 1
    medians = part_colors(colors, seen, parts, groups)

    # a row for each part that two groups show: the logarithm of one color over the other
    pairs, ratios, errors = [], [], []
    for one, other in itertools.combinations(range(count), 2):
        for first, second in zip(medians[one], medians[other], strict=True):
            if first is None or second is None:
                continue
            darkest = np.exp(min(first.color.min(), second.color.min()))
            pairs.append((one, other))
            ratios.append(second.color - first.color)
            errors.append(
                np.sqrt(TINT**2 + (OFFSET / darkest) ** 2 + first.error**2 + second.error**2)
            )
    if not pairs:
        return np.ones((len(groups), 3))
    ends, ratios, errors = np.asarray(pairs), np.asarray(ratios), np.asarray(errors)

    # white balance, then brightness
    brightness = ratios.mean(axis=1, keepdims=True)
    balance = _robust_differences(ends, ratios - brightness, errors, count)[groups]
    balance -= balance.mean(axis=0)
    one_light = len(set(frames)) < len(set(zip(groups, frames, strict=True)))
    if one_light and np.sqrt(np.mean(balance**2)) < OTHER_LIGHT:
        return np.ones((len(groups), 3))
    exposure = _robust_differences(ends, brightness, np.full(len(ends), BRIGHTNESS), count)[groups]
    return np.exp(balance + exposure - exposure.mean(axis=0))


class PartColor(NamedTuple):
    """The color of a part of the body in a group of views."""

    color: Float[np.ndarray, "3"]
    """The median of the logarithms of the colors, (3,)."""
    error: float
    """The standard error of the part's tint (its log color minus the mean over the channels)."""


def part_colors(
    colors: Float[np.ndarray, "v n 3"],
    seen: Bool[np.ndarray, "v n"],
    parts: Int[np.ndarray, " n"],
    groups: Int[np.ndarray, " v"],
) -> list[list[PartColor | None]]:
    """Returns the color of each of `PARTS` in each group of views; None where the group shows too
    little of the part.

    Arguments: see `gains_between`.
    """
    known = np.all(_known(colors, seen), axis=-1)
    logs = np.log(np.maximum(colors, 1e-6))
    found = []
    for group in range(int(groups.max()) + 1):
        own = groups == group
        of_parts = [known[own] & (parts == part) for part in range(len(PARTS))]
        found.append([_part_color(logs[own][inside]) for inside in of_parts])
    return found


def _part_color(logs: Float[np.ndarray, "n 3"]) -> PartColor | None:
    """Returns the color of a part from the logarithms of its points' colors; None for fewer than
    `LEAST_OF_PART` points.
    """
    if len(logs) < LEAST_OF_PART:
        return None
    tints = logs - logs.mean(axis=1, keepdims=True)
    away = np.abs(tints - np.median(tints, axis=0)).max(axis=1)
    spread = NORMAL_MAD * np.median(away)
    return PartColor(np.median(logs, axis=0), spread * np.sqrt(ALIKE / len(logs)))


def _robust_differences(
    ends: Int[np.ndarray, "r 2"],
    values: Float[np.ndarray, "r c"],
    errors: Float[np.ndarray, " r"],
    count: int,
) -> Float[np.ndarray, "count c"]:
    """Returns `count` numbers x for each of c columns, (count, c). Each row asks that x[one] -
    x[other] equals the value of the row. Most rows are nearly met. Rows that contradict most others
    count little. x is near 0 where the rows do not determine it.

    The fit is weighted least squares, repeated `FITS` times: first with Huber's weights, then with
    Cauchy's.

    ends: the indices (one, other) of each row, (r, 2). values: the value of each row, (r, c).
    errors: the standard error of each row, (r,).
    """
    differences = np.eye(count)[ends[:, 0]] - np.eye(count)[ends[:, 1]]
    prior = np.eye(count) / OTHER_DAYS
    target = np.concatenate([values / errors[:, None], np.zeros((count, values.shape[1]))])
    weights = np.ones(len(ends))
    for step in range(FITS):
        scales = np.concatenate([np.sqrt(weights), np.ones(count)])[:, None]
        rows = np.concatenate([differences / errors[:, None], prior])
        found = np.linalg.lstsq(scales * rows, scales * target, rcond=None)[0]
        left = np.linalg.norm(differences @ found - values, axis=1) / errors
        robust = step >= FITS - REDESCENDING
        if robust:
            weights = 1 / (1 + left**2)
        else:
            weights = 1 / np.maximum(left, 1)
    return found


# Colors of points
# --------------------------------------------------------------------------------------------------


def apply_gain(
    images: Float[np.ndarray, "v h w 3"],
    alpha: Float[np.ndarray, "v h w"],
    gains: Float[np.ndarray, "v 3"],
) -> Float[np.ndarray, "v h w 3"]:
    """Returns images over white with their colors multiplied by the gains of their views.

    Gains of 1 / `Capture.gains` give a rendering the exposure of its camera.
    """
    white = 1 - alpha[..., None]
    return np.clip((images - white) * gains[:, None, None].astype(np.float32) + white, 0, 1)


@compiled()
def _seen_colors(
    body: BodyModel,
    rest: RestBody,
    pose: BodyPose,
    image: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    camera: Camera,
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """Returns the colors of the body's vertices in one photo, (n, 3), and whether the photo shows
    each vertex, (n,).
    """
    vertices = pose_body(body, rest, pose).vertices
    towards = camera.center - vertices
    normals = vertex_normals(vertices, body.faces)
    cosine = jnp.sum(normals * towards, axis=-1) / jnp.linalg.norm(towards, axis=-1)
    pixels, depths = project(camera, vertices)
    size = jnp.asarray([camera.width, camera.height])
    inside = jnp.all((pixels >= 0) & (pixels < size), axis=-1) & (depths > 0)
    x, y = jnp.clip(jnp.where(inside[:, None], pixels, 0).astype(int), 0, size - 1).T
    nearest = rasterize_mesh(vertices, body.faces, camera).depth[y, x]
    deep = lax.reduce_window(mask, jnp.inf, lax.min, (INSIDE, INSIDE), (1, 1), "SAME")[y, x] > WHOLE
    mean = lax.reduce_window(image, 0.0, lax.add, (BLUR, BLUR, 1), (1, 1, 1), "SAME") / BLUR**2
    seen = inside & deep & (cosine > FACING) & (nearest > 0) & (depths < nearest + THICKNESS)
    return mean[y, x], seen
