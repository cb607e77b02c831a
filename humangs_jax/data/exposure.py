"""Equal exposure and white balance of the photos of one person.

Cameras that meter for themselves show one skin in several colors; a gain for each channel makes
them agree. What two photos both show of the body should have one color in both. The gains are those
that bring the medians of the ratios nearest to 1; their logarithms have the mean 0 over the photos.
Where little is shared they stay near 1.

Gains are found once for the photos of a capture, which then records them (`Capture.gains`): found
again from photos that are nearly equal, they would not be ones.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.body.model import BodyModel, BodyPose, RestBody, pose_body, shape_body
from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.data.body_and_masks import unusable_views, usable_views
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import standardize
from humangs_jax.geometry.camera import Camera, project
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh, vertex_normals

EXPOSURE_SIZE = 256
"""Pixels a side of the crops around the person that are compared."""
FACING, THICKNESS = 0.5, 0.02
"""Of a point that a photo shows: least cosine between normal and ray; metres by which it may lie
behind the nearest surface.
"""
INSIDE, WHOLE, BLUR = 5, 0.99, 3
"""Side of the square of pixels around each point that lies in the mask, least value of the mask in
it; and side of the one over which colors are averaged."""
USABLE = (0.06, 0.95)
"""Darker and brighter values say nothing about a gain."""
LEAST_POINTS, ALIKE = 50, 50
"""Points that two photos share, at least; and how many neighbours err alike."""
NOISE, EXPECTED = 0.03, 0.15
"""Standard deviations of a median of log ratios, whatever the number of points, and of the
logarithm of a gain.
"""
CLEAR = 1.0
"""Root mean square of the medians over their standard errors, below which all photos stay as they
are: loose clothes and shadows make 0.3 to 0.9 in photos of equal exposure (eight test people)."""
NORMAL_MAD = 1.4826


def equal_exposure(capture: Capture) -> Capture:
    """The usable views of a capture in equal exposure, which is what network and refinement see,
    with the gains recorded; the same object where all views are usable and gains are recorded.

    Without masks nothing is known of the exposure, and nothing is recorded.

    Raises: CaptureError if no view shows the person.
    """
    capture = usable_views(capture)
    if capture.masks is None or capture.gains is not None:
        return capture
    gains = camera_gains(capture)
    images = capture.images
    if (gains != 1).any():
        images = multiplied(images, capture.masks, gains)
    return dataclasses.replace(capture, images=images, gains=gains)


def exposures(capture: Capture) -> Float[np.ndarray, "v 3"]:
    """By what to multiply the colors of an avatar of these photos, so that it is rendered as each
    camera exposed it.
    """
    if capture.gains is not None:
        return 1 / capture.gains
    apart, found = unusable_views(capture), np.ones((capture.view_count, 3))
    if usable := [i for i in range(capture.view_count) if i not in apart]:
        found[usable] = 1 / camera_gains(capture.select(usable))
    return found


def camera_gains(capture: Capture) -> Float[np.ndarray, "v 3"]:
    """By what to multiply the colors of each view, see `gains_of`; ones without masks, and for
    photos that have been made equal.

    capture: photos on white, all of which show the person.
    """
    if capture.masks is None or capture.gains is not None or capture.view_count < 2:
        return np.ones((capture.view_count, 3))
    views = standardize(capture, EXPOSURE_SIZE, crop=True)
    rest, per_view = (
        shape_body(capture.body, views.betas),
        (views.images, views.masks, views.cameras),
    )
    poses = jax.vmap(BodyPose)(views.rotations, views.translations)
    each = [
        seen_colors(capture.body, rest, *jax.tree.map(lambda x, i=i: x[i], (poses, *per_view)))
        for i in range(capture.view_count)
    ]
    colors, seen = (np.stack(x) for x in zip(*each, strict=True))
    return gains_of(colors, seen)


def gains_of(
    colors: Float[np.ndarray, "v n 3"], seen: Bool[np.ndarray, "v n"]
) -> Float[np.ndarray, "v 3"]:
    """Gains of views from the colors of common points; all 1 where there is hardly a difference, or
    nothing in common.

    colors: in [0, 1]. seen: which points a view shows.
    """
    count, logs = len(colors), np.log(np.maximum(colors, 1e-6))
    known = seen[..., None] & (colors > USABLE[0]) & (colors < USABLE[1])
    found, errors = np.zeros((count, 3)), []
    for channel in range(3):
        rows, values = list(np.eye(count) / EXPECTED), [0.0] * count
        for one, other in itertools.combinations(range(count), 2):
            both = known[one, :, channel] & known[other, :, channel]
            if (points := np.count_nonzero(both)) < LEAST_POINTS:
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


def multiplied(
    images: Float[np.ndarray, "v h w 3"],
    alpha: Float[np.ndarray, "v h w"],
    gains: Float[np.ndarray, "v 3"],
) -> Float[np.ndarray, "v h w 3"]:
    """Images over white with their colors multiplied.

    A rendering in the exposure of its camera: by 1 / gains.
    """
    white = 1 - alpha[..., None]
    return np.clip((images - white) * gains[:, None, None].astype(np.float32) + white, 0, 1)


@jax.jit
def seen_colors(
    body: BodyModel,
    rest: RestBody,
    pose: BodyPose,
    image: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    camera: Camera,
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """Of one photo the colors of the body's vertices, and which of them it shows."""
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
