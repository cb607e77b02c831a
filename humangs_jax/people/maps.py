"""Depth and position maps of a dressed person, of the point in the middle of each pixel.

depth: along the optical axis, metres, 0 where nothing is hit. position: where that point is on the person in T-pose, metres;
on bare skin that is a point of the shaped body at rest, on cloth a point of the garment at rest.
"""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.exr import ExrView, write_exr
from humangs_jax.people.rendering import PosedSubject
from humangs_jax.rendering.mesh.rasterizer import interpolate_attributes, rasterize_mesh

DEPTH_UNIT = 1e-4
"""Metres per level of a depth file (16-bit PNG): up to 6.5 m, 0 where nothing is hit."""
VERTEX_STEP, FACE_STEP = 4096, 8192
"""Meshes are padded to multiples of these, so that few shapes are compiled."""


@dataclasses.dataclass(frozen=True)
class SurfaceMaps:
    """See the module."""

    depth: Float[np.ndarray, "h w"]
    position: Float[np.ndarray, "h w 3"]


def render_maps(posed: PosedSubject, camera: Camera) -> SurfaceMaps:
    """The maps of one camera."""
    surface = posed.subject.surface
    vertices, faces = padded(posed.vertices, surface.faces)
    fragments = rasterize_mesh(vertices, faces, camera)
    rest, _ = padded(surface.vertices, surface.faces)
    position = np.asarray(interpolate_attributes(fragments, faces, rest, jnp.zeros(3)))
    return SurfaceMaps(np.maximum(np.asarray(fragments.depth), 0), position)


def padded(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[Array, "n_padded 3"], Int[Array, "f_padded 3"]]:
    """A mesh with repeated vertices and faces without area up to the next step of sizes."""
    spare_vertices, spare_faces = -len(vertices) % VERTEX_STEP, -len(faces) % FACE_STEP
    vertices = np.concatenate([vertices, np.repeat(vertices[:1], spare_vertices, axis=0)]).astype(np.float32)
    return jnp.asarray(vertices), jnp.asarray(np.pad(faces, ((0, spare_faces), (0, 0))))


def write_depth(path: str | Path, depth: Float[np.ndarray, "h w"]) -> None:
    """A 16-bit PNG in steps of `DEPTH_UNIT`. Raises: ValueError if a depth does not fit."""
    from PIL import Image

    levels = np.rint(depth / DEPTH_UNIT)
    if not 0 <= levels.min() <= levels.max() <= 65535:
        raise ValueError(f"{path}: depths of {depth.min():.3g} to {depth.max():.3g} m do not fit into 16 bits")
    Image.fromarray(levels.astype(np.uint16)).save(path, format="PNG")


def read_depth(path: str | Path) -> Float[np.ndarray, "h w"]:
    """Metres, 0 where nothing is hit. Raises: OSError if the file cannot be read; ValueError if it is no 16-bit grey PNG."""
    from PIL import Image

    with Image.open(path) as image:
        if not image.mode.startswith("I"):
            raise ValueError(f"{path}: expected a 16-bit grey PNG, got mode {image.mode}")
        return (np.asarray(image).astype(np.float64) * DEPTH_UNIT).astype(np.float32)


def write_maps(
    path: str | Path,
    image: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"],
    maps: SurfaceMaps,
    camera: Camera,
) -> None:
    """An OpenEXR file: R, G, B premultiplied by A, depth Z, position.X/Y/Z, the camera in the header.

    image: as rendered on white.
    """
    rgba = np.concatenate([image - (1 - mask[..., None]), mask[..., None]], axis=-1)
    channels = {f"position.{axis}": maps.position[..., i] for i, axis in enumerate("XYZ")}
    K, cam_from_world = np.asarray(camera.K), np.asarray(camera.cam_from_world)
    write_exr(path, ExrView(rgba, maps.depth, K, cam_from_world, name=Path(path).stem, channels=channels))
