"""The simplest baseline to compare an avatar with: the body, painted with the photos."""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyPose, pose_body, shape_body
from humangs_jax.core.array_types import Array, Float
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.pixel_aligned import (
    photo_colors,
    project_vertices,
    visible_vertices,
)
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh


def painted_body(inputs: Capture) -> Float[Array, "n 3"]:
    """A color for each vertex of the body: the mean photo color over the views that see it, grey where none does."""
    body = inputs.body
    rest = shape_body(body, jnp.asarray(inputs.betas))
    size = (inputs.cameras.width, inputs.cameras.height)

    def view(frame, camera):
        vertices = _posed_vertices(inputs, rest, frame)
        pixels, depths = project_vertices(camera, vertices)
        depth_map = rasterize_mesh(vertices, body.faces, camera).depth
        return pixels, visible_vertices(pixels, depths, depth_map, size, "half_pixel")

    seen = [view(int(frame), inputs.cameras[i]) for i, frame in enumerate(inputs.frames)]
    pixels, visible = (jnp.stack(x) for x in zip(*seen, strict=True))
    return photo_colors(jnp.asarray(inputs.images), pixels, visible, "half_pixel")


def draw_painted_body(colors: Float[Array, "n 3"], views: Capture) -> Float[np.ndarray, "v h w 3"]:
    """The painted body mesh on white, in the poses and from the cameras of a capture."""
    body = views.body
    rest = shape_body(body, jnp.asarray(views.betas))

    def draw(frame: int, camera: Camera):
        fragments = rasterize_mesh(_posed_vertices(views, rest, frame), body.faces, camera)
        return np.asarray(interpolate_attributes(fragments, body.faces, colors, jnp.ones(3)))

    return np.stack([draw(int(frame), views.cameras[i]) for i, frame in enumerate(views.frames)])


def _posed_vertices(capture, rest, frame):
    return _pose(capture.body, rest, capture.pose(frame))


@jax.jit
def _pose(body, rest, pose: BodyPose):
    return pose_body(body, rest, pose).vertices
