"""A calibration as its file says it, whatever the format, and its cameras in the convention of captures.

Readers return a `Calibration`: OpenCV axes (x right, y down, z forward), but lengths, the world's up axis and the place of
pixel centres still those of the source. `in_capture_convention` makes metres, y up and pixel centres at +0.5 of them.
"""

import dataclasses
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float, Int

ROUNDED_ROTATION = 5e-3
"""R R^T of matrices written with three decimals (EasyMocap) is so far from 1; such are replaced by the nearest rotation."""
ROTATION_TO_Y_UP = {
    "+x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "+y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "+z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""For each axis that can be up in the source, the proper rotation that takes it to +y."""
OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""y down and z forward -> y up and z backwards; its own inverse."""
CAM_FROM_WORLD, WORLD_FROM_CAM = "cam_from_world, OpenCV axes", "world_from_cam, OpenCV axes"
CAM_FROM_WORLD_OPENGL, WORLD_FROM_CAM_OPENGL = "cam_from_world, OpenGL axes", "world_from_cam, OpenGL axes"
CONVENTIONS = {
    CAM_FROM_WORLD: lambda matrix: matrix,
    WORLD_FROM_CAM: np.linalg.inv,
    CAM_FROM_WORLD_OPENGL: lambda matrix: OPENGL_FROM_OPENCV @ matrix,
    WORLD_FROM_CAM_OPENGL: lambda matrix: OPENGL_FROM_OPENCV @ np.linalg.inv(matrix),
}
"""What a matrix in a file may mean, and the cam_from_world with OpenCV's axes that it then stands for. OpenCV: x right,
y down, z forward; OpenGL: x right, y up, z backwards."""
PIXEL_CENTERS = ("integer", "half")
"""Where the centre of the first pixel is: at (0, 0), as OpenCV has it, or at (0.5, 0.5)."""


@dataclasses.dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """One camera, or one image's camera where the format has one per image.

    name: of the camera, or the image's path as the file has it. K: (3, 3) pixels. cam_from_world: (4, 4), OpenCV axes.
    width, height: pixels, None where the format does not say. distortion: (5,) k1 k2 p1 p2 k3 of OpenCV, or None.
    """

    name: str
    K: Float[np.ndarray, "3 3"]
    cam_from_world: Float[np.ndarray, "4 4"]
    width: int | None = None
    height: int | None = None
    distortion: Float[np.ndarray, "5"] | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Observations:
    """Points that the calibration saw, one row for each time: the evidence that reprojection is checked against.

    points: (n, 3) in the world. cameras: (n,) which camera saw it. pixels: (n, 2) where, distortion included.
    """

    points: Float[np.ndarray, "n 3"]
    cameras: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """Everything that a calibration says.

    format: what it was read as. file: the one that errors name. cameras: at least one. per_image: one camera for each
    image, not one for each camera. pixel_centers, up: what the format means unless told otherwise.
    observations: None where the format has none. convention: what the matrices in the file mean, of `CONVENTIONS`.
    """

    format: str
    file: Path
    cameras: tuple[CalibratedCamera, ...]
    per_image: bool
    pixel_centers: str
    up: str
    observations: Observations | None = None
    convention: str = CAM_FROM_WORLD


def in_capture_convention(calibration: Calibration, scale: float, up: str, pixel_centers: str) -> Calibration:
    """The same cameras and points in metres, y up, pixel centres at +0.5, rotations orthonormal.

    Arguments:
        scale: metres per unit of the source. up: the source's axis that points up, a key of `ROTATION_TO_Y_UP`.
        pixel_centers: "integer" adds 0.5 to the principal point, "half" leaves it.
    """
    turn = np.asarray(ROTATION_TO_Y_UP[up], float)
    shift = 0.5 if pixel_centers == "integer" else 0.0
    observations = calibration.observations
    if observations is not None:
        observations = dataclasses.replace(
            observations, points=scale * observations.points @ turn.T, pixels=observations.pixels + shift
        )
    cameras = tuple(_convert(camera, scale, turn, shift) for camera in calibration.cameras)
    return dataclasses.replace(calibration, cameras=cameras, observations=observations, up="+y", pixel_centers="half")


def _convert(camera, scale, turn, shift):
    K, pose = camera.K.copy(), camera.cam_from_world.copy()
    K[:2, 2] += shift
    pose[:3, :3] = nearest_rotation(pose[:3, :3]) @ turn.T
    pose[:3, 3] *= scale
    return dataclasses.replace(camera, K=K, cam_from_world=pose)


def nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """The rotation nearest to a rounded one; a matrix that is further from one than rounding explains is left as it is."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > ROUNDED_ROTATION or np.linalg.det(matrix) < 0:
        return matrix
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt
