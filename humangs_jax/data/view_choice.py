"""Chooses from many photos those that together show the body best."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.body.resolution import decimate, vertex_areas
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.compiled import compiled
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import SubjectViews, prepare_inputs, to_network_views
from humangs_jax.network import presets
from humangs_jax.network.parts import subject_unit
from humangs_jax.network.reader import project_vertices, visible_vertices

SELECTION_SIZE = 128
"""Side of the images and depth maps by which photos are compared, pixels. This size suffices to
tell which side of the body a photo shows.
"""
SELECTION_VERTICES = 2000
"""Largest number of vertices of the body on which photos are compared."""
LEAST_GAIN = 0.03
"""Least gain of a further photo, as a share of the sum that the chosen photos reach (see
`best_views`).

It is used only if no number of photos is given.
"""


def best_views(capture: Capture, count: int | None) -> list[int]:
    """Returns the indices of the `count` photos that together show the body best, in ascending
    order. If there are at most `count` photos, all are returned.

    The choice is greedy: each further photo is the one that adds most to a sum over the vertices.
    The term of a vertex is its area times the best `view_quality` among the chosen photos. The sum
    is submodular, so the choice reaches at least 63 % of the largest possible sum (Nemhauser,
    Wolsey, Fisher 1978, https://doi.org/10.1007/BF01588971). What a photo shows outside its mask
    does not count.

    Arguments:
        capture: photos that all show the person.
        count: the number of photos. None: photos are chosen until the best further photo raises the
            sum by less than the share `LEAST_GAIN`.

    Raises: ValueError for a count below 1.
    """
    if count is not None and count < 1:
        raise ValueError(f"views: expected at least 1 photo, got {count}")
    if count is not None and capture.view_count <= count:
        return list(range(capture.view_count))
    body = capture.body
    if len(body.template) > SELECTION_VERTICES:
        body = decimate(body, SELECTION_VERTICES)
    quality = np.asarray(view_quality(body, to_network_views(capture, SELECTION_SIZE)))
    area = vertex_areas(np.asarray(body.template), np.asarray(body.faces))
    least = LEAST_GAIN if count is None else 0.0
    most = capture.view_count if count is None else count
    return sorted(greedy_cover(quality * area, most, least))


def greedy_cover(quality: Float[np.ndarray, "v n"], count: int, least: float = 0.0) -> list[int]:
    """Returns the indices of at most `count` rows of a matrix, in the order of their choice. Each
    further row is the one that raises the sum of the columns' maxima most. The choice stops when
    the next row would raise the sum by less than `least` times the sum that is reached already.
    """
    chosen, best = list[int](), np.zeros(quality.shape[1])
    for _ in range(min(count, len(quality))):
        sums = np.maximum(quality, best).sum(axis=1)
        sums[chosen] = -np.inf
        if chosen and sums.max() < (1 + least) * best.sum():
            break
        chosen.append(int(np.argmax(sums)))
        best = np.maximum(best, quality[chosen[-1]])
    return chosen


@compiled()
def view_quality(body: BodyModel, views: SubjectViews) -> Float[Array, "v n"]:
    """Returns how well every view shows every vertex, in [0, 1].

    The quality is a product, divided by its largest value over all views and vertices. The product
    is the cosine of the angle between the normal and the direction to the camera, times the focal
    length over the depth. It is 0 if the vertex is hidden, faces away from the camera, or lies
    outside of the photo or of the mask.
    """
    config = presets.small().with_conventions(pixels="person")
    inputs = prepare_inputs(body, views, config)
    unit = subject_unit(inputs.canonical_vertices)
    assert inputs.posed_normals is not None  # `prepare_inputs` computes them

    def quality(camera, vertices, normals, depth_map):
        pixels, depths = project_vertices(camera, vertices)
        seen = visible_vertices(
            pixels, depths, depth_map, (camera.width, camera.height), "half_pixel"
        )
        towards = camera.center - vertices
        facing = jnp.sum(towards * normals, -1) / jnp.maximum(
            jnp.linalg.norm(towards, axis=-1), 1e-6
        )
        return jnp.where(
            seen, jnp.maximum(facing, 0) * camera.K[0, 0] / jnp.maximum(depths, 1e-6), 0
        )

    cameras = views.cameras.in_units(unit)
    shown = jax.vmap(quality)(
        cameras, inputs.posed_vertices / unit, inputs.posed_normals, inputs.depth_maps
    )
    return shown / jnp.maximum(jnp.max(shown), 1e-6)
