"""Reads the cameras of a file, and makes paths of cameras along which an avatar is seen.

The world is in metres and has y up. The person stands on its floor near x = z = 0, as in the files
of `export`. If a format has another axis up, `file_cameras` can turn its world.
"""

import logging
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.avatar.frames import rest_pose_of
from humangs_jax.body.model import BodyPose, RestBody
from humangs_jax.body.motion import Motion, grounded
from humangs_jax.core.arrays import from_host
from humangs_jax.core.pytree import replace
from humangs_jax.data.cameras import in_capture_convention, read_calibration
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.reading import check_limit, reading

logger = logging.getLogger(__name__)


def file_cameras(path: Path, shot: FrameSettings, upright: bool = False) -> dict[str, Camera]:
    """Returns the cameras of a calibration file by unique names, in the order of the file. Lens
    distortion is left out, and a warning is logged about it.

    The size of a camera's images is the size in the file, or the size of the shot if the file has
    none. If the shot has a width or a height, it replaces the width or height in the file.

    Arguments: upright: whether the world is turned so that the axis that is up in the format
    becomes y. If not, it stays as it is in the file.

    Raises: FileNotFoundError if there is no such file; FileError, one line that names the file, if
    it cannot be read or has too many cameras; ValueError if `Camera.from_opencv` refuses a camera.
    """
    with reading(path, "calibration"):
        found = read_calibration(path, lambda name: shot.resolution)
        check_limit("views", len(found.cameras), "cameras")
        found = in_capture_convention(
            found, 1.0, found.up if upright else "+y", found.pixel_centers
        )
    if any(camera.distortion is not None and np.any(camera.distortion) for camera in found.cameras):
        logger.warning("%s: images are drawn without the distortion of lenses", path)
    cameras: dict[str, Camera] = {}
    for each in found.cameras:
        size = each.width or shot.resolution[0], each.height or shot.resolution[1]
        camera = Camera.from_opencv(each.K, each.cam_from_world, *size)
        if shot.width or shot.height:
            camera = camera.resized(shot.width or size[0], shot.height or size[1])
        plain = stem = Path(each.name.replace("\\", "/")).stem.lstrip(".") or "view"
        while stem in cameras:
            stem = f"{plain}_{len(cameras)}"
        cameras[stem] = camera
    return cameras


def one_size(path: Path, cameras: Mapping[str, Camera]) -> Camera:
    """Returns the cameras of a file as one batch. path: the file, for the error.

    Raises: ValueError if the images of two cameras differ in size.
    """
    sizes = {(camera.width, camera.height): name for name, camera in cameras.items()}
    if len(sizes) > 1:
        shown = ", ".join(
            f"{name} has {width} x {height}" for (width, height), name in sorted(sizes.items())[:2]
        )
        raise ValueError(
            f"{path}: images of several sizes, {shown}: expected one size, or a width and a height"
        )
    return stack_cameras(list(cameras.values()))


def camera_path(cameras: Camera, frames: int) -> Camera:
    """Returns a camera for each of `frames` frames, from a batch of cameras. A single camera stands
    still; several are evenly spread over the frames.

    Between two cameras, centres and intrinsics follow a monotone cubic spline (Fritsch and Carlson
    1980), which goes through all cameras and does not overshoot. Rotations turn about one axis at
    constant speed.
    """
    count = len(cameras)
    if count in (1, frames):
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (frames, *x.shape[1:])), cameras)
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, Slerp

    places, times = np.arange(count), np.linspace(0, count - 1, frames)
    poses = np.asarray(cameras.cam_from_world, np.float64)
    rotations = Slerp(places, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
    centers = PchipInterpolator(places, np.asarray(cameras.center, np.float64))(times)
    between = np.tile(np.eye(4), (frames, 1, 1))
    between[:, :3, :3] = rotations
    between[:, :3, 3] = -np.einsum("vij,vj->vi", rotations, centers)
    K = PchipInterpolator(places, np.asarray(cameras.K, np.float64))(times)
    dtype = cameras.K.dtype
    return replace(cameras, K=from_host(K, dtype), cam_from_world=from_host(between, dtype))


def standing(avatar: Avatar, pose: BodyPose | None = None) -> BodyPose:
    """Returns a pose (default: the T-pose), moved so that the person stands on the floor, y = 0,
    with the root joint at x = z = 0.
    """
    if pose is None:
        pose = rest_pose_of(avatar)
    moment = Motion(pose.rotations[None], pose.translation[None], 1.0)
    return grounded(
        moment, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents
    ).pose(0)


def repeated(pose: BodyPose, views: int) -> BodyPose:
    """Returns a batch of `views` copies of a pose."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (views, *x.shape)), pose)
