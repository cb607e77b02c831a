"""What the network takes of one subject, in metres, and the unit that it works in.

Lengths inside the network are normalised units: metres divided by s = (height of the canonical body) / 1.8, so that every body is
1.8 high. Means and scales are multiplied by s at the end.
"""

import jax.numpy as jnp

from humangs_jax.body.model import Texels
from humangs_jax.core.array_types import Array, Bool, Float, Int, Scalar
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry.camera import Camera

TARGET_HEIGHT = 1.8
"""Height of every canonical body in normalised units."""


@pytree_dataclass
class HumanGSInputs:
    """The photos of one subject, and the posed body in each of them.

    images: (v, h, w, 3) in [0, 1], white background. cameras: a batch of v, metric. posed_vertices: (v, n, 3) metric,
    the body in the pose of each photo. canonical_vertices: (n, 3) metric, T-pose. position_maps: (v, h, w, 3) canonical
    position of each pixel, normalised units, 1 on background. depth_maps: (v, h, w) rasterized z, normalised units, -1
    on background. foreground: (v, h, w) pixels of the person (used where tokens are "foreground"). view_count: the number of
    real views, which come first; the others are padding and change nothing. None: all are real. posed_normals: (v, n, 3)
    unit, used with shells. canonical_normals: (n, 3) unit, used where the decoder's frame is "normal". spacing: (n,) distance
    between vertices relative to the mesh that the weights were trained with; None: 1. skinning_weights: (n, j) of the body, and
    texels: the map of its surface (`network.surface_map`), for decoders whose Gaussians are not those of vertices.
    """

    images: Float[Array, "v h w 3"]
    cameras: Camera
    posed_vertices: Float[Array, "v n 3"]
    canonical_vertices: Float[Array, "n 3"]
    position_maps: Float[Array, "v h w 3"]
    depth_maps: Float[Array, "v h w"]
    foreground: Bool[Array, "v h w"]
    view_count: Int[Array, ""] | None = None
    posed_normals: Float[Array, "v n 3"] | None = None
    canonical_normals: Float[Array, "n 3"] | None = None
    spacing: Float[Array, " n"] | None = None
    skinning_weights: Float[Array, "n j"] | None = None
    texels: Texels | None = None

    @property
    def present(self) -> Bool[Array, " v"]:
        """Which views are not padding."""
        views = jnp.arange(len(self.images))
        return views < (len(self.images) if self.view_count is None else self.view_count)


def subject_unit(canonical_vertices: Float[Array, "n 3"]) -> Scalar:
    """s, metres per normalised unit: the canonical body's height over 1.8."""
    y = canonical_vertices[:, 1]
    return (jnp.max(y) - jnp.min(y)) / TARGET_HEIGHT
