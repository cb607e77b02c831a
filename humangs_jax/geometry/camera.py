"""Cameras in the OpenCV convention: x right, y down, z forward; pixel centres at +0.5.

A world point p is seen at K [R | t] p with (R | t) = `cam_from_world`; metres in, pixels out. What
`lens` and `distortion` do between [R | t] p and K is in `geometry.lens`. Gaussians are drawn
through every lens. Functions for bodies and photos of people need pinholes without distortion
(`require_pinhole`).
"""

import math
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from humangs_jax.core.array_types import Array, Float, Matrix3, Matrix4, Vector3
from humangs_jax.core.arrays import from_host, joined, on_host
from humangs_jax.core.checks import POSITIVE, checked_arguments
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace, static_field
from humangs_jax.core.records import Part
from humangs_jax.geometry import transform
from humangs_jax.geometry.lens import check_lens, distorted

RIGID_TOLERANCE = 1e-3
"""A camera is refused if an entry of R R^T differs from the identity by more than this, or if the
skew of K is larger than this times the focal length. Calibrations are stored with few digits.
"""
LARGEST_NUMBER = 1e7
"""Largest magnitude of a number in K, pixels, and in `cam_from_world`, metres. Larger numbers are
faults, and products of several of them overflow in float32.
"""


@pytree_dataclass
class Camera(Batchable):
    """A camera, or a batch of cameras of one image size and lens (leading axes on the arrays).

    A batch can be indexed and iterated over: `for camera in cameras`.

    Examples:
        >>> camera = hg.Camera.from_opencv(K, cam_from_world, width=512, height=512)
    """

    K: Annotated[Matrix3, Part("focal lengths", lambda K: K[..., [0, 1], [0, 1]], POSITIVE)]
    """Intrinsics, (3, 3), pixels."""
    cam_from_world: Matrix4
    """Rigid transform from the world to the camera, (4, 4), metres. Camera axes are OpenCV's: x
    right, y down, z forward.
    """
    width: int = static_field()
    """Width of the image, pixels."""
    height: int = static_field()
    """Height of the image, pixels."""
    distortion: Float[Array, " coefficients"] | None = None
    """Coefficients of OpenCV: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]], or k1 k2 k3 k4 of a
    fisheye. None for no distortion.
    """
    lens: str = static_field(default="pinhole")
    """The lens, "pinhole" by default.

    "fisheye": equidistant, fields of view below 180 degrees.

    "orthographic": K is in pixels a metre, rays are parallel.
    """

    @classmethod
    def from_opencv(
        cls,
        K: object,
        cam_from_world: object,
        width: int,
        height: int,
        distortion: object = None,
        lens: str = "pinhole",
    ) -> "Camera":
        """Makes a camera from array-likes, and checks them: K is (3, 3), `cam_from_world` is (4,
        4), and `distortion` is (n,) or None. Under `jit`, `vmap` and `grad`, the numbers in K,
        `cam_from_world` and `distortion` are not checked.

        The camera's arrays are float32. They are float64 if JAX's `jax_enable_x64` is on and K or
        `cam_from_world` is float64.

        Raises: ValueError if a shape is wrong, if a number is not finite, or if the magnitude of a
        number in K or `cam_from_world` is above 1e7. Also if K is not [[fx, 0, cx], [0, fy, cy],
        [0, 0, 1]] with positive focal lengths, if the rotation is not orthonormal and right-handed
        (to 1e-3), or if the last row of `cam_from_world` is not 0 0 0 1. Also if the sides of the
        image are not positive whole numbers, if the lens is unknown, or if the lens does not have
        this number of coefficients.
        """
        # arrays of the type that is kept: float64 only if JAX has it
        given = K, cam_from_world, distortion
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(given))
        array = jnp.asarray if traced else np.asarray
        K, cam_from_world = array(K), array(cam_from_world)
        kept = jnp.promote_types(jnp.result_type(K, cam_from_world), jnp.float32)

        # shapes, which are known under transformations, too
        if K.shape != (3, 3):
            raise ValueError(f"K: expected shape (3, 3), got {K.shape}")
        if cam_from_world.shape != (4, 4):
            raise ValueError(f"cam_from_world: expected shape (4, 4), got {cam_from_world.shape}")
        width, height = _pixels(width, height)
        coefficients = None
        if distortion is not None:
            coefficients = jnp.asarray(distortion, kept)
        count = None if coefficients is None else coefficients.size
        check_lens(lens, count)
        if coefficients is not None and coefficients.ndim != 1:
            raise ValueError(f"distortion: expected shape (n,), got {coefficients.shape}")
        if traced:
            arrays = jnp.asarray(K, kept), jnp.asarray(cam_from_world, kept)
            return cls(*arrays, width, height, coefficients, lens)

        # numbers
        if coefficients is not None and not np.isfinite(coefficients).all():
            raise ValueError("distortion must be finite numbers")
        K, cam_from_world = K.astype(np.float64), cam_from_world.astype(np.float64)
        for name, values in (("K", K), ("cam_from_world", cam_from_world)):
            if not np.abs(values).max() <= LARGEST_NUMBER:  # nor NaN
                raise ValueError(
                    f"{name} must be finite numbers, at most {LARGEST_NUMBER:g} in magnitude"
                )
        # K: upper triangular without skew, with positive focal lengths
        if not (K[0, 0] > 0 and K[1, 1] > 0):
            raise ValueError(
                f"K: focal lengths must be positive, got fx = {K[0, 0]}, fy = {K[1, 1]}"
            )
        skewed = abs(K[0, 1]) > RIGID_TOLERANCE * K[0, 0]
        if skewed or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1]):
            raise ValueError(f"K: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}")
        # [R | t]: a rotation and a translation
        rotation = cam_from_world[:3, :3]
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if off > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
            raise ValueError(
                "cam_from_world: the rotation is singular, mirrored or scaled (R R^T must be 1 and"
                " det R = 1)"
            )
        if not np.allclose(cam_from_world[3], [0, 0, 0, 1]):
            raise ValueError(
                f"cam_from_world: the last row must be 0 0 0 1, got {cam_from_world[3].tolist()}"
            )
        arrays = from_host(K, kept), from_host(cam_from_world, kept)
        return cls(*arrays, width, height, coefficients, lens)

    @property
    def is_plain(self) -> bool:
        """Whether the camera is a pinhole without distortion."""
        return self.lens == "pinhole" and self.distortion is None

    @property
    def world_from_cam(self) -> Float[Array, "*b 4 4"]:
        """Inverse of `cam_from_world`."""
        return transform.invert_rigid(self.cam_from_world)

    @property
    def center(self) -> Float[Array, "*b 3"]:
        """Camera centre in the world, metres."""
        return self.world_from_cam[..., :3, 3]

    def resized(self, width: int, height: int) -> "Camera":
        """Returns the camera for the same image at another size.

        Raises: ValueError for sides that are not positive whole numbers.
        """
        width, height = _pixels(width, height)
        scale = np.asarray([width / self.width, height / self.height, 1.0], self.K.dtype)
        K = np.asarray(self.K) if on_host(self.K) else self.K
        return replace(self, K=from_host(K * scale[:, None]), width=width, height=height)

    def in_units(self, unit: Float[Array, ""] | float) -> "Camera":
        """Returns the camera for the same world in another unit of length. unit: the length of the
        new unit, metres. All lengths are divided by it.
        """
        translation = self.cam_from_world[..., :3, 3] / unit
        moved = replace(self, cam_from_world=self.cam_from_world.at[..., :3, 3].set(translation))
        if self.lens != "orthographic":
            return moved
        scale = jnp.stack([jnp.asarray(unit, self.K.dtype)] * 2 + [jnp.ones((), self.K.dtype)])
        return replace(moved, K=self.K * scale)

    def moved(self, twist: Float[Array, "*b 6"]) -> "Camera":
        """Returns the camera with exp(twist) `cam_from_world` in place of `cam_from_world`. In the
        camera's frame, the world moves by exp(twist). In the world, the camera moves by the inverse
        motion.

        twist: a rotation vector in radians, then a velocity in metres (see `transform.from_twist`),
        both in the camera's axes. Twists can be optimized without constraints: a twist of zeros is
        no motion, and the result is a rigid transform for every twist.

        Examples:
            >>> drawn = lambda twist: hg.render(gaussians, camera.moved(twist), config).rgb
            >>> loss = lambda twist: jnp.mean((drawn(twist) - photo) ** 2)
            >>> gradient = jax.grad(loss)(jnp.zeros(6))
        """
        motion = transform.from_twist(twist)
        pose = jnp.matmul(motion, self.cam_from_world, precision=transform.EXACT)
        return replace(self, cam_from_world=pose)


def require_pinhole(what: str, camera: Camera) -> None:
    """Checks that a camera is a pinhole without distortion. what: name of the function that needs
    such a camera.

    Raises: ValueError for another lens, and for a camera with distortion.
    """
    if not camera.is_plain:
        kind = "distortion"
        if camera.lens != "pinhole":
            kind = f"a lens that is {camera.lens}"
        raise ValueError(f"{what} is for pinhole cameras without distortion, got one with {kind}")


def _pixels(width: int | float, height: int | float) -> tuple[int, int]:
    """Returns the sides of an image as integers.

    Raises: ValueError for an empty image and for parts of pixels.
    """
    if not (width >= 1 and height >= 1):
        raise ValueError(f"width and height must be at least 1, got {width} x {height}")
    if width % 1 or height % 1 or math.inf in (width, height):
        raise ValueError(
            f"width and height: expected whole numbers of pixels, got {width} x {height}"
        )
    return int(width), int(height)


@checked_arguments
def stack_cameras(cameras: list[Camera]) -> Camera:
    """Returns a batch of cameras that have one image size and lens.

    Raises: ValueError if the list is empty, or if image sizes, lenses or numbers of coefficients
    differ.
    """
    if not cameras:
        raise ValueError("no cameras to stack")
    image_sizes = {(camera.width, camera.height) for camera in cameras}
    if len(image_sizes) > 1:
        raise ValueError(f"image sizes differ: {sorted(image_sizes)}")
    if len({(c.lens, getattr(c.distortion, "shape", None)) for c in cameras}) > 1:
        raise ValueError("lenses differ: expected one lens with one number of coefficients")
    return jax.tree.map(lambda *leaves: joined(leaves), *cameras)


def project(
    camera: Camera, points: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 2"], Float[Array, "*b"]]:
    """Returns the pixel positions (..., 2) of world points (..., 3), metres, in one camera, and
    their depths z (...), metres.

    z = 0 is not guarded against: see `rendering.projection`.
    """
    p = transform.apply(camera.cam_from_world, points)
    depth = p[..., 2]
    if not camera.is_plain:
        slopes = p[..., :2]
        if camera.lens != "orthographic":
            slopes = slopes / depth[..., None]
            x, y = distorted(camera.lens, camera.distortion, slopes[..., 0], slopes[..., 1])
            slopes = jnp.stack([x, y], axis=-1)
        focal = jnp.stack([camera.K[0, 0], camera.K[1, 1]])
        return slopes * focal + camera.K[:2, 2], depth
    uv = (
        p[..., :2] / depth[..., None] * jnp.stack([camera.K[0, 0], camera.K[1, 1]])
        + camera.K[:2, 2]
    )
    return uv, depth


def intrinsics_from_fov(vertical_fov: float | Float[Array, ""], width: int, height: int) -> Matrix3:
    """Returns the K of a pinhole camera with square pixels and a centred axis. vertical_fov:
    radians. width, height: pixels.

    Raises: ValueError for an angle that is not between 0 and pi.
    """
    if not isinstance(vertical_fov, Tracer) and not 0 < float(vertical_fov) < np.pi:
        raise ValueError(
            f"intrinsics_from_fov: vertical_fov {float(vertical_fov):.6g}: expected radians between"
            f" 0 and pi; {float(vertical_fov):.6g} degrees are"
            f" np.deg2rad({float(vertical_fov):.6g})"
        )
    tan = jnp.tan if isinstance(vertical_fov, Tracer) else np.tan
    focal = 0.5 * height / tan(0.5 * vertical_fov)
    K = [[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]]
    if isinstance(focal, jax.Array):
        return jnp.asarray(K)
    return from_host(K)


@checked_arguments
def look_at(
    eye: Vector3, target: Vector3, up: Vector3, K: Matrix3, width: int, height: int
) -> Camera:
    """Returns a camera that looks at a point.

    Args:
        eye: (3,) the camera's centre, metres.
        target: (3,) the point that the camera looks at, metres.
        up: (3,) the direction that is up in the image; not parallel to the camera's axis.
        K: (3, 3) intrinsics, pixels.
        width: pixels.
        height: pixels.

    Returns:
        One camera.

    Examples:
        >>> eye, target = jnp.array([0.0, 1.0, 3.0]), jnp.array([0.0, 0.9, 0.0])
        >>> camera = hg.look_at(eye, target, jnp.array([0.0, 1.0, 0.0]), K, 512, 512)
    """
    forward = safe_normalize(target - eye, jnp.asarray([0.0, 0.0, 1.0]))
    right = safe_normalize(jnp.cross(forward, up), jnp.asarray([1.0, 0.0, 0.0]))
    down = jnp.cross(forward, right)
    rotation = jnp.stack([right, down, forward])
    return Camera(
        K,
        transform.make(rotation, -jnp.matmul(rotation, eye, precision=transform.EXACT)),
        width,
        height,
    )


@checked_arguments
def orbit(
    target: Vector3,
    distance: Float[Array, " v"] | float,
    azimuths: Float[Array, " v"],
    elevations: Float[Array, " v"] | float,
    K: Matrix3,
    width: int,
    height: int,
) -> Camera:
    """Returns cameras on circles around a point, with y up. Azimuth 0 is at +z.

    Args:
        target: (3,) the point that the cameras look at, metres.
        distance: of the cameras from the point, metres; one for all or (v,).
        azimuths: (v,) radians.
        elevations: radians above the horizon; one for all or (v,).
        K: (3, 3) intrinsics, pixels.
        width: pixels.
        height: pixels.

    Returns:
        A batch of v cameras.

    Raises:
        ValueError: for elevations beyond a right angle, and for distances or elevations whose shape
            does not fit `azimuths`.

    Examples:
        >>> target, azimuths = jnp.array([0.0, 0.9, 0.0]), jnp.linspace(0, 2 * jnp.pi, 8)
        >>> cameras = hg.orbit(target, 3.0, azimuths, 0.1, K, 512, 512)
    """
    azimuths = jnp.asarray(azimuths)
    # integers, too, are radians
    azimuths = azimuths.astype(jnp.promote_types(azimuths.dtype, jnp.float32))
    right_angle = np.pi / 2 + 1e-6  # with the rounding of float32
    if not isinstance(elevations, Tracer) and np.any(np.abs(elevations) > right_angle):
        raise ValueError(f"orbit: elevations {elevations}: expected radians between -pi/2 and pi/2")
    distance, elevations = (
        jnp.broadcast_to(jnp.asarray(x, azimuths.dtype), azimuths.shape)
        for x in (distance, elevations)
    )

    def one(r, azimuth, elevation):
        horizontal = jnp.cos(elevation)
        direction = jnp.stack(
            [horizontal * jnp.sin(azimuth), jnp.sin(elevation), horizontal * jnp.cos(azimuth)]
        )
        return look_at(
            target + r * direction, target, jnp.asarray([0.0, 1.0, 0.0]), K, width, height
        )

    return jax.vmap(one)(distance, azimuths, elevations)


def pixel_rays(camera: Camera) -> tuple[Float[Array, "3"], Float[Array, "h w 3"]]:
    """Returns the centre of one pinhole camera in the world, (3,), metres, and the unit directions
    of the rays through its pixel centres (x + 0.5, y + 0.5) in the world, (h, w, 3).

    Raises: ValueError for another lens, and for a camera with distortion.
    """
    require_pinhole("pixel_rays", camera)
    x = (jnp.arange(camera.width) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (jnp.arange(camera.height) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    x, y = jnp.meshgrid(x, y)
    in_camera = jnp.stack([x, y, jnp.ones_like(x)], axis=-1)
    # z = 1: the norm is at least 1
    in_camera = in_camera / jnp.linalg.norm(in_camera, axis=-1, keepdims=True)
    return camera.center, jnp.matmul(
        in_camera, camera.cam_from_world[:3, :3], precision=transform.EXACT
    )


def plucker_rays(camera: Camera) -> Float[Array, "h w 6"]:
    """Returns the Plücker coordinates of the ray through each pixel centre in the world, (h, w, 6).
    The first three are the moment, the cross product of the camera's centre (metres) and the
    direction. The last three are the unit direction.

    Reference: HumanGS, after Sitzmann et al., Light Field Networks. Raises: as `pixel_rays`.
    """
    origin, directions = pixel_rays(camera)
    moments = jnp.cross(jnp.broadcast_to(origin, directions.shape), directions)
    return jnp.concatenate([moments, directions], axis=-1)
