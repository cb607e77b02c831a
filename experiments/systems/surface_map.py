"""Maps of the body's surface for networks that work on texels. A map has the point of the body that
each texel shows.

A part asks for a map by its field `surface_map`. `data.views.gaussian_body` makes the map once for
each body, and the inputs of the network have it in `HumanGSInputs.texels`. Texels name vertices, so
that one map serves every shape and pose of a body.
"""

import dataclasses
import functools
from typing import Literal

import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, Texels
from humangs_jax.core.configuration import Side, configuration
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.atlas import CELLS, Atlas, texels, unwrap
from humangs_jax.rendering.mesh.rasterizer import rasterize_mesh

MARGIN = 0.95
"""Share of the side of a front or back view that the body fills."""


@configuration
class SurfaceMap:
    """A map of the surface."""

    kind: Literal["atlas", "front_back"] = "atlas"
    """Kind of the map. "atlas" shows every point of the surface once, by the texture coordinates of
    the body, or by charts that are cut for it. "front_back" shows the T-pose by parallel rays, from
    the front, and beside it from the back, mirrored.
    """
    size: Side = 512
    """Texels a side. "front_back" is twice as wide."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in texels."""
        width = 2 * self.size if self.kind == "front_back" else self.size
        return self.size, width

    def texels(self, body: BodyModel) -> Texels:
        """Returns the map of a body, made on the host. Texels that show nothing have no weights.

        A map takes seconds, so equal bodies share it.
        """

        def plain(x, dtype):
            return None if x is None else np.asarray(x, dtype).tobytes()

        uvs = plain(body.uvs, np.float32), plain(body.uv_faces, np.int32)
        return _texels(plain(body.template, np.float32), plain(body.faces, np.int32), *uvs, self)


@functools.lru_cache(maxsize=8)
def _texels(template, faces, uvs, uv_faces, wanted):
    """Returns the map of a body whose arrays are given as bytes, which can be compared."""
    vertices = np.frombuffer(template, np.float32).reshape(-1, 3)
    faces = np.frombuffer(faces, np.int32).reshape(-1, 3)
    if wanted.kind == "atlas":
        ids, weights = _atlas(vertices, faces, uvs, uv_faces, wanted.size)
    else:
        ids, weights = _front_and_back(vertices, faces, wanted.size)
    corners = np.where(ids[..., None] >= 0, faces[np.maximum(ids, 0)], 0)
    return Texels(jnp.asarray(corners, jnp.int32), jnp.asarray(weights, jnp.float32))


def _atlas(vertices, faces, uvs, uv_faces, size):
    """Returns the face and the barycentric weights of each texel of an atlas."""
    if uvs is not None and uv_faces is not None:
        # the texels of an atlas do not need its charts and vertices
        nothing = np.zeros(0, np.int64)
        uvs = np.frombuffer(uvs, np.float32).reshape(-1, 2)
        uv_faces = np.frombuffer(uv_faces, np.int32).reshape(-1, 3)
        return texels(Atlas(uvs, uv_faces, nothing, nothing, size, 1.0))
    one = np.zeros(len(faces), np.int64)
    atlas = unwrap(vertices, faces, one, -(-size // CELLS) * CELLS, one + 1.0)
    return texels(dataclasses.replace(atlas, size=size))


def _front_and_back(vertices, faces, size):
    """Returns the face and the barycentric weights of each texel of the front and the back view.

    For parallel rays the points are placed at their pixel, at a depth of 2 to 3.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    right, up, front = ((vertices - (low + high) / 2) / (high - low)[:2].max()).T * MARGIN
    seen = []
    for side in (1, -1):
        depth = 2.5 - 0.5 * side * front / max(np.abs(front).max(), 1e-6)
        x, y = size * (0.5 + side * right), size * (0.5 - up)
        points = np.stack([x * depth, y * depth, depth], axis=-1)
        camera = Camera(jnp.eye(3), jnp.eye(4), size, size)
        seen.append(rasterize_mesh(jnp.asarray(points, jnp.float32), jnp.asarray(faces), camera))

    def beside(name):
        return np.concatenate([np.asarray(getattr(one, name)) for one in seen], axis=1)

    return beside("face_ids"), beside("barycentrics")
