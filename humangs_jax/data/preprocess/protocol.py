"""The published protocol: alignment, cameras around a scan, splits, evaluation indices (numpy,
float64). Also draws photos of a scan.

Scans are aligned in two steps. First the middle of the raw scan's bounding box goes to the origin.
Then the smallest rotation takes the direction from pelvis to neck of the fitted body to +y. Videos
are aligned by the body of frame 0. First they are turned by the smallest rotation that does the
same to this body. Then the middle of the bounding box of the turned body goes to the origin.

Photos of a scan are drawn by our rasterizer, with several samples a pixel, and with a texture that
is shrunk to the size of the samples. Color = texture (ambient + headlight |n . v|), where n is the
smooth normal and v the direction to the camera. Both sides of the surface look alike. The published
protocol names an ambient light of 0.3 and one headlight, but not how strong the headlight is. Here
it is 0.7, so that a surface that faces the camera has the color of its texture.
"""

import dataclasses
import functools
import random
from collections.abc import Mapping, Sequence
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int, UInt8
from humangs_jax.data import cameras as calibration
from humangs_jax.data.datasets.thuman import Scan
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.mesh import face_areas, smallest_turns, unit, vertex_area_vectors
from humangs_jax.io.images import to_uint8
from humangs_jax.rendering.mesh.rasterizer import (
    interpolate_attributes,
    rasterize_mesh,
    sample_texture,
)

T = TypeVar("T")

PELVIS = 0
"""Index of the pelvis among the joints."""
NECK = 12
"""Index of the neck among the joints."""
VERTICAL_FOV = np.deg2rad(60.0)
ELEVATIONS = (-5.0, 15.0)
"""Range of the elevations of the cameras, degrees. They are drawn uniformly."""
FACTORS = (1.0, 1.75)
"""Range of the distances of the cameras from the origin, in bounding radii of the scan, as the
paper has it. They are drawn uniformly.

At a field of view of 60 degrees, distances below 1.7 cut heads and feet.
"""
NEAR_FACTORS = (2.0, 2.0)
"""Range of the distances in the paper's "near" test set, in bounding radii. The release uses it for
all sets.
"""
VIEWS = 60
"""Number of views of every scan."""
SIZE = 512
"""Side of the images, pixels."""
TRAIN = 2300
"""Number of scans to train with."""
TEST = 145
"""Number of scans to test with."""
SPLIT_SEED = 42
"""Seed of the split into train and test, as published."""
EVALUATION_SEED = 777
"""Seed of the views of an evaluation, as published."""
CAMERA_SEED = 2026
"""Seed of the cameras. It is ours, since the release does not say how it drew them."""
INPUT_COUNTS = (1, 2, 4, 6)
"""Numbers of input views that are evaluated."""
TARGETS = 4
"""Number of target views that are compared for each number of inputs."""
EVERY = 10
"""A frame of a video is taken if its number is a multiple of this."""


def smallest_rotation(
    start: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation by the smallest angle that takes the direction of `start` to the
    direction of `end`, (3, 3).

    Raises: ValueError if a vector is zero.
    """
    lengths = np.linalg.norm(start), np.linalg.norm(end)
    if not min(lengths) > 0:
        raise ValueError("the direction from pelvis to neck has no length")
    return smallest_turns(start / lengths[0], end / lengths[1], opposite=1e-24)


def _box_middle(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Returns the middle of the bounding box."""
    return 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64)


def moved(
    matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Returns points moved by a rigid transform. matrix: the transform, (4, 4)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def scan_alignment(
    scan: Float[np.ndarray, "n 3"], pelvis: Float[np.ndarray, "3"], neck: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Returns the `mesh_transform` R @ T of a scan: first the middle of its bounding box goes to
    the origin, then the scan is turned upright.
    """
    R = smallest_rotation(neck - pelvis, np.asarray([0.0, 1.0, 0.0]))
    return calibration.pose_matrix(R, -R @ _box_middle(scan))


def video_alignment(
    body: Float[np.ndarray, "n 3"], pelvis: Float[np.ndarray, "3"], neck: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """Returns the `mesh_transform` T @ R of a video: first the body is turned upright, then the
    middle of its bounding box in frame 0 goes to the origin.
    """
    R = smallest_rotation(neck - pelvis, np.asarray([0.0, 1.0, 0.0]))
    return calibration.pose_matrix(R, -_box_middle(body @ R.T))


def intrinsics(size: int) -> Float[np.ndarray, "3 3"]:
    """Returns the camera matrix of square images with the field of view `VERTICAL_FOV`."""
    focal = 0.5 * size / np.tan(0.5 * VERTICAL_FOV)
    return calibration.intrinsics(focal, focal, 0.5 * size, 0.5 * size)


def scan_cameras(
    number: int, radius: float, views: int, factors: tuple[float, float]
) -> Float[np.ndarray, "v 4 4"]:
    """Returns cam_from_world of cameras that look at the origin, with y up. Azimuth, elevation and
    distance are drawn uniformly.

    number: the number of the scan; its cameras depend on no other scan. factors: the range of the
    distances, in units of `radius`.
    """
    rng = np.random.default_rng([CAMERA_SEED, number])
    azimuths = np.deg2rad(rng.uniform(0, 360, views))
    elevations = np.deg2rad(rng.uniform(*ELEVATIONS, views))
    distances = radius * rng.uniform(*factors, views)
    flat = np.cos(elevations)
    towards = np.stack(
        [flat * np.sin(azimuths), np.sin(elevations), flat * np.cos(azimuths)], axis=-1
    )
    cameras = np.tile(np.eye(4), (views, 1, 1))
    right = np.stack([np.cos(azimuths), np.zeros(views), -np.sin(azimuths)], axis=-1)
    cameras[:, 0, :3] = right
    cameras[:, 1, :3] = np.cross(-towards, right)  # image rows go down
    cameras[:, 2, :3] = -towards
    cameras[:, 2, 3] = distances
    return cameras


def split_ids(names: Sequence[T], train: int = TRAIN, test: int = TEST) -> tuple[list[T], list[T]]:
    """Returns the names to train with and the names to test with. All names are sorted and shuffled
    by numpy with seed 42. The first `train` names and the next `test` names are taken.
    """
    order = sorted(names)  # ty: ignore[invalid-argument-type]  strings
    np.random.RandomState(SPLIT_SEED).shuffle(order)  # the published one
    return order[:train], order[train : train + test]


def evaluation_indices(counts: Mapping[str, int], inputs: int) -> dict[str, dict[str, list[int]]]:
    """Returns {scene: {"context": [...], "target": [...]}}, where the lists hold numbers of views
    in ascending order. counts: the number of views of each scene, in the order of the test list.

    One generator of Python, with seed 777, draws for each scene in turn `inputs` views, then
    `TARGETS` of the others. Raises: ValueError for a scene with too few views.
    """
    generator, found = random.Random(EVALUATION_SEED), {}
    for name, count in counts.items():
        if count < inputs + TARGETS:
            raise ValueError(
                f"{name}: {count} views, but {inputs} inputs and {TARGETS} targets are asked for"
            )
        context = sorted(generator.sample(range(count), inputs))
        rest = [view for view in range(count) if view not in set(context)]
        found[name] = {"context": context, "target": sorted(generator.sample(rest, TARGETS))}
    return found


# Photos of a scan
# --------------------------------------------------------------------------------------------------


AMBIENT = 0.3
"""Share of the light that comes from everywhere."""
HEADLIGHT = 0.7
"""Share of the light that comes from the camera."""
STEP = 1 << 15
"""Vertices and faces are padded to a multiple of this number, so that few shapes are compiled for
many scans.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class ScanRenderer:
    """Draws an aligned scan on the device. The texture is halved more often for views from farther
    away.
    """

    vertices: Float[Array, "n 3"]
    """The aligned vertices, (n, 3), padded."""
    normals: Float[Array, "n 3"]
    """The unit normals of the vertices, (n, 3), padded."""
    faces: Int[Array, "f 3"]
    """Vertex indices, (f, 3), padded."""
    uvs: Float[Array, "n 2"]
    """Texture coordinates, (n, 2), padded."""
    scan: Scan
    """The scan that the texture comes from."""
    texel: float
    """The side of a texel on the surface, scan units."""
    textures: dict[int, Float[Array, "th tw 3"]] = dataclasses.field(default_factory=dict)
    """The textures by the number of times they were halved. Each is made when it is first used."""

    @classmethod
    def of(cls, scan: Scan, vertices: Float[np.ndarray, "n 3"]) -> "ScanRenderer":
        """Returns the renderer of a scan. vertices: the aligned vertices of the scan."""
        spare, spare_faces = -len(vertices) % STEP, -len(scan.faces) % STEP

        def pad(x):
            return jnp.asarray(np.pad(x, ((0, spare), (0, 0)), mode="edge"), jnp.float32)

        faces = jnp.asarray(np.pad(scan.faces, ((0, spare_faces), (0, 0))), jnp.int32)
        surface = face_areas(vertices, scan.faces).sum()
        flat = face_areas(np.pad(scan.uvs.astype(np.float64), ((0, 0), (0, 1))), scan.faces).sum()
        height, width = scan.texture.shape[:2]
        texel = float(np.sqrt(surface / max(flat, 1e-12) / (height * width)))
        return cls(
            pad(vertices),
            pad(smooth_normals(vertices, scan.faces)),
            faces,
            pad(scan.uvs),
            scan,
            texel,
        )

    def render(
        self, cam_from_world: Float[np.ndarray, "4 4"], size: int, supersample: int
    ) -> tuple[UInt8[np.ndarray, "size size 3"], UInt8[np.ndarray, "size size"]]:
        """Returns the image on white and the coverage, as bytes. supersample: samples along each
        side of a pixel.
        """
        sample = 2 * np.tan(0.5 * VERTICAL_FOV) * cam_from_world[2, 3] / (size * supersample)
        level = max(0, int(np.floor(np.log2(max(sample / self.texel, 1e-9)))))
        K, pose = (jnp.asarray(x, jnp.float32) for x in (intrinsics(size), cam_from_world))
        camera = Camera(K, pose, size, size)
        mesh = self.vertices, self.normals, self.faces, self.uvs
        image, mask = _render(*mesh, self.texture(level), camera, supersample)
        return to_uint8(np.asarray(image)), to_uint8(np.asarray(mask))

    def texture(self, level: int) -> Float[Array, "th tw 3"]:
        """Returns the texture halved `level` times, in [0, 1]. It is not halved further when its
        shorter side has one texel.
        """
        level = min(level, min(self.scan.texture.shape[:2]).bit_length() - 1)
        if level not in self.textures:
            step = 1 << level
            height, width = (side // step * step for side in self.scan.texture.shape[:2])
            blocks = self.scan.texture[:height, :width].reshape(
                height // step, step, width // step, step, 3
            )
            self.textures[level] = jnp.asarray(blocks.mean(axis=(1, 3), dtype=np.float32) / 255)
        return self.textures[level]


def smooth_normals(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "n 3"]:
    """Returns unit normals. Vertices at one place, which texture seams double, share their normal.

    Zero where there is no face.
    """
    places, place = np.unique(vertices, axis=0, return_inverse=True)
    place = place.reshape(-1)
    return unit(vertex_area_vectors(places, place[faces]))[place]


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
    lengths = jnp.linalg.norm(towards, axis=-1, keepdims=True) * jnp.linalg.norm(
        seen[..., 3:6], axis=-1, keepdims=True
    )
    light = AMBIENT + HEADLIGHT * cosine / jnp.maximum(lengths, 1e-12)
    color = jnp.where(covered, sample_texture(texture, seen[..., 6:]) * light, 1.0)

    def mean(x):
        return x.reshape(camera.height, supersample, camera.width, supersample, -1).mean(
            axis=(1, 3)
        )

    return mean(color), mean(covered.astype(color.dtype))[..., 0]
