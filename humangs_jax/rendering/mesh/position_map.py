"""Position maps: for every pixel, where the seen surface point is on the body in its canonical pose.

The network looks its neural texture up at these positions, so that a pixel knows which part of the body it shows. All
lengths are in the network's normalised units: the caller divides vertices and camera centre by the subject's scale.
Pixels beside the body have the position (1, 1, 1) and depth -1.

`plain_position_map` is the paper's: canonical positions, interpolated. `gouraud_position_map` is what the released
network was trained on, and needed to run its weights: positions as colors, through a Gouraud shader with a point
light.
"""

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.mesh.rasterizer import DEFAULT_CONFIG, RasterConfig, interpolate_attributes, rasterize_mesh

BACKGROUND = 1.0
BACKGROUND_DEPTH = -1.0
LIGHT = (0.0, 1.0, 0.0)
"""Place of the point light, normalised units; the default of PyTorch3D, whose shader the release used."""
AMBIENT, DIFFUSE, SPECULAR, SHININESS = 0.5, 0.3, 0.2, 64


def plain_position_map(
    posed_vertices: Float[Array, "n 3"],
    canonical_vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    """Position map and depth map of one view; everything in normalised units."""
    return _map(posed_vertices, canonical_vertices, faces, camera, config)


def gouraud_position_map(
    posed_vertices: Float[Array, "n 3"],
    canonical_vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    camera: Camera,
    config: RasterConfig = DEFAULT_CONFIG,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    """The release's position map (lit; see the module) and depth map of one view; everything in normalised units."""
    albedo = (canonical_vertices + 1) / 2
    colors = _light(albedo, posed_vertices, vertex_normals(posed_vertices, faces), camera.center)
    return _map(posed_vertices, 2 * colors - 1, faces, camera, config)


@jax.jit
def vertex_normals(vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]) -> Float[Array, "n 3"]:
    """Unit normals: the sum of (v1 - v0) x (v2 - v0) over the faces at a vertex, as wound; 0 where that vanishes."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    normals = jnp.cross(b - a, c - a)
    total = jnp.zeros_like(vertices).at[faces.reshape(-1)].add(jnp.repeat(normals, 3, axis=0))
    return safe_normalize(total, jnp.zeros(3))


@jax.jit
def _light(albedo: Array, points: Array, normals: Array, eye: Array) -> Array:
    """Phong's light at the vertices: ambient and diffuse times the albedo, and a white highlight."""
    dot = lambda a, b: jnp.sum(a * b, axis=-1, keepdims=True)
    nowhere = jnp.zeros(3)
    to_light = safe_normalize(jnp.asarray(LIGHT, points.dtype) - points, nowhere)
    to_eye = safe_normalize(eye - points, nowhere)
    facing = dot(normals, to_light)
    reflected = 2 * facing * normals - to_light
    highlight = jnp.where(facing > 0, jnp.maximum(dot(reflected, to_eye), 0), 0) ** SHININESS
    return albedo * (AMBIENT + DIFFUSE * jnp.maximum(facing, 0)) + SPECULAR * highlight


def _map(vertices: Array, values: Array, faces: Array, camera: Camera, config: RasterConfig) -> tuple[Array, Array]:
    fragments = rasterize_mesh(vertices, faces, camera, config)
    return interpolate_attributes(fragments, faces, values, jnp.full(3, BACKGROUND, values.dtype)), fragments.depth
