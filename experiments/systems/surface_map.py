"""Maps of the body's surface, for networks that work on texels: which point of the body each texel
shows.

A part asks for a map by its field `surface_map`. `data.views.gaussian_body` makes it, once per
body, and the inputs of the network carry it: `HumanGSInputs.texels`. Texels name vertices, so that
one map serves every shape and pose of a body.
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
"""Share of the side of a view from the front or back that the body takes."""


@configuration
class SurfaceMap:
    """A map of the surface."""

    kind: Literal["atlas", "front_back"] = "atlas"
    """The texture coordinates of the body, or charts cut for it, with every point of the surface
    once ("atlas"); or the T-pose seen from the front, and beside it, mirrored, from the back, by
    parallel rays ("front_back")."""
    size: Side = 512
    """Texels a side; "front_back" is twice as wide."""

    @property
    def shape(self) -> tuple[int, int]:
        return self.size, self.size * (2 if self.kind == "front_back" else 1)

    def texels(self, body: BodyModel) -> Texels:
        """Of a body, on the host; texels that show nothing have no weights.

        Equal bodies share them: they take seconds.
        """

        def plain(x, dtype):
            return None if x is None else np.asarray(x, dtype).tobytes()

        uvs = plain(body.uvs, np.float32), plain(body.uv_faces, np.int32)
        return _texels(plain(body.template, np.float32), plain(body.faces, np.int32), *uvs, self)


@functools.lru_cache(maxsize=8)
def _texels(template, faces, uvs, uv_faces, wanted):
    """Arrays as bytes, which can be compared."""
    vertices = np.frombuffer(template, np.float32).reshape(-1, 3)
    faces = np.frombuffer(faces, np.int32).reshape(-1, 3)
    if wanted.kind == "atlas":
        ids, weights = _atlas(vertices, faces, uvs, uv_faces, wanted.size)
    else:
        ids, weights = _front_and_back(vertices, faces, wanted.size)
    corners = np.where(ids[..., None] >= 0, faces[np.maximum(ids, 0)], 0)
    return Texels(jnp.asarray(corners, jnp.int32), jnp.asarray(weights, jnp.float32))


def _atlas(vertices, faces, uvs, uv_faces, size):
    if uvs is not None and uv_faces is not None:
        nothing = np.zeros(
            0, np.int64
        )  # charts and vertices of an atlas are not needed for its texels
        uvs, uv_faces = (
            np.frombuffer(uvs, np.float32).reshape(-1, 2),
            np.frombuffer(uv_faces, np.int32).reshape(-1, 3),
        )
        return texels(Atlas(uvs, uv_faces, nothing, nothing, size, 1.0))
    one = np.zeros(len(faces), np.int64)
    atlas = unwrap(vertices, faces, one, -(-size // CELLS) * CELLS, one + 1.0)
    return texels(dataclasses.replace(atlas, size=size))


def _front_and_back(vertices, faces, size):
    """Parallel rays: points are placed at their pixel, at a depth of 2 to 3."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    right, up, front = ((vertices - (low + high) / 2) / (high - low)[:2].max()).T * MARGIN
    seen = []
    for side in (1, -1):
        depth = 2.5 - 0.5 * side * front / max(np.abs(front).max(), 1e-6)
        points = np.stack(
            [size * (0.5 + side * right) * depth, size * (0.5 - up) * depth, depth], axis=-1
        )
        camera = Camera(jnp.eye(3), jnp.eye(4), size, size)
        seen.append(rasterize_mesh(jnp.asarray(points, jnp.float32), jnp.asarray(faces), camera))

    def beside(name):
        return np.concatenate([np.asarray(getattr(one, name)) for one in seen], axis=1)

    return beside("face_ids"), beside("barycentrics")
