"""Photos of a textured scan: our rasterizer, several samples a pixel, a texture shrunk to the samples, soft light.

Color = texture (ambient + headlight |n . v|), n the smooth normal and v the direction to the camera, both sides alike. The
published protocol names an ambient light of 0.3 and one headlight, and no strength of the latter: with 0.7 a surface that faces
the camera has the color of its texture.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int, UInt8
from humangs_jax.data.datasets.thuman import Scan
from humangs_jax.data.preprocess.protocol import VERTICAL_FOV, intrinsics
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.mesh import face_areas, unit, vertex_crosses
from humangs_jax.io.images import to_uint8
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh, sample_texture

AMBIENT, HEADLIGHT = 0.3, 0.7
STEP = 1 << 15
"""Vertices and faces are padded to a multiple of this: few shapes are compiled for many scans."""


@dataclasses.dataclass(frozen=True, eq=False)
class ScanRenderer:
    """A scan on the device, aligned, with a texture for each view's distance.

    vertices, normals: (n, 3), faces: (f, 3), padded. uvs: (n, 2). scan: where the texture comes from. texel: scan units a texel.
    """

    vertices: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    faces: Int[Array, "f 3"]
    uvs: Float[Array, "n 2"]
    scan: Scan
    texel: float

    @classmethod
    def of(cls, scan: Scan, vertices: Float[np.ndarray, "n 3"]) -> "ScanRenderer":
        """A scan with its vertices moved."""
        spare, spare_faces = -len(vertices) % STEP, -len(scan.faces) % STEP
        pad = lambda x: jnp.asarray(np.pad(x, ((0, spare), (0, 0)), mode="edge"), jnp.float32)
        faces = jnp.asarray(np.pad(scan.faces, ((0, spare_faces), (0, 0))), jnp.int32)
        surface = face_areas(vertices, scan.faces).sum()
        flat = face_areas(np.pad(scan.uvs.astype(np.float64), ((0, 0), (0, 1))), scan.faces).sum()
        height, width = scan.texture.shape[:2]
        texel = float(np.sqrt(surface / max(flat, 1e-12) / (height * width)))
        return cls(pad(vertices), pad(smooth_normals(vertices, scan.faces)), faces, pad(scan.uvs), scan, texel)

    def render(
        self, cam_from_world: Float[np.ndarray, "4 4"], size: int, supersample: int
    ) -> tuple[UInt8[np.ndarray, "size size 3"], UInt8[np.ndarray, "size size"]]:
        """Image on white and coverage."""
        sample = 2 * np.tan(0.5 * VERTICAL_FOV) * cam_from_world[2, 3] / (size * supersample)
        level = max(0, int(np.floor(np.log2(max(sample / self.texel, 1e-9)))))
        K, pose = (jnp.asarray(x, jnp.float32) for x in (intrinsics(size), cam_from_world))
        camera = Camera(K, pose, size, size)
        mesh = self.vertices, self.normals, self.faces, self.uvs
        image, mask = _render(*mesh, self.texture(level), camera, supersample)
        return to_uint8(np.asarray(image)), to_uint8(np.asarray(mask))

    def texture(self, level: int) -> Float[Array, "th tw 3"]:
        """The texture halved `level` times, in [0, 1]."""
        return self._levels(min(level, int(np.log2(min(self.scan.texture.shape[:2])))))

    @functools.cached_property
    def _levels(self) -> Callable[[int], Float[Array, "th tw 3"]]:
        @functools.lru_cache(maxsize=2)
        def halved(level: int) -> Float[Array, "th tw 3"]:
            step = 1 << level
            height, width = (side // step * step for side in self.scan.texture.shape[:2])
            blocks = self.scan.texture[:height, :width].reshape(height // step, step, width // step, step, 3)
            return jnp.asarray(blocks.mean(axis=(1, 3), dtype=np.float32) / 255)

        return halved


def smooth_normals(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit normals; vertices at one place, which texture seams double, share theirs. Zero where there is no face."""
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    place = place.reshape(-1)
    return unit(vertex_crosses(places, place[faces]))[place]


@functools.partial(jax.jit, static_argnames="supersample")
def _render(
    vertices: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    uvs: Float[Array, "n 2"],
    texture: Float[Array, "th tw 3"],
    camera: Camera,
    supersample: int,
) -> tuple[Float[Array, "h w 3"], Float[Array, "h w"]]:
    fine = camera.resized(camera.width * supersample, camera.height * supersample)
    fragments = rasterize_mesh(vertices, faces, fine)
    # position, normal and texture coordinate of every sample
    values = jnp.concatenate([vertices, normals, uvs], axis=-1)
    seen = interpolate_attributes(fragments, faces, values, jnp.zeros(8, values.dtype))
    covered = (fragments.face_ids >= 0)[..., None]
    towards = camera.center - seen[..., :3]
    cosine = jnp.abs(jnp.sum(towards * seen[..., 3:6], -1, keepdims=True))
    lengths = jnp.linalg.norm(towards, axis=-1, keepdims=True) * jnp.linalg.norm(seen[..., 3:6], axis=-1, keepdims=True)
    light = AMBIENT + HEADLIGHT * cosine / jnp.maximum(lengths, 1e-12)
    color = jnp.where(covered, sample_texture(texture, seen[..., 6:]) * light, 1.0)
    mean = lambda x: x.reshape(camera.height, supersample, camera.width, supersample, -1).mean(axis=(1, 3))
    return mean(color), mean(covered.astype(color.dtype))[..., 0]
