"""Images of an avatar: along a motion, from a circle of cameras, or as a capture's cameras saw the
person.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.body.model import BodyPose, RestBody, blend_transforms, joint_transforms
from humangs_jax.body.motion import Motion, grounded
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.arrays import from_host, taken
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.processes import in_threads, usable_cores
from humangs_jax.core.progress import COMPILING, bar
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import turned_world, world_up
from humangs_jax.geometry import transform
from humangs_jax.geometry.camera import Camera, intrinsics_from_fov
from humangs_jax.io.reading import check_limit
from humangs_jax.rendering.buffers import BufferOverflowError, plan_buffers, plan_near
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import (
    ALPHA_MIN,
    SPLAT_PRESETS,
    SplatConfig,
    drawn_as,
)
from humangs_jax.rendering.splatting import Background, Rendering, render

MARGIN = 1.12
"""Factor on the room that a person takes in the frame. The extent is measured at the centres of
Gaussians, and Gaussians reach beyond.
"""
FOLLOWING = 0.5
"""Standard deviation of the Gaussian kernel that smooths the path of the camera, seconds. The
camera follows a walk, but not the swing of steps and arms, which takes about a second.
"""
WIDEST = 2
"""The largest standard deviation of this kernel, as a multiple of the number of frames. The path is
then a straight line, because less than the share 1e-8 of any deviation from it is left.
"""
TRACKED = 1024
"""Number of Gaussians, evenly spread, on which a person's extent is measured."""
TRACKED_OPACITY = 0.5
"""Least opacity of a Gaussian that the extent is measured on."""
MOST_TRACKED = 1 << 25
"""The largest number of points on which the extent is measured, in all frames together. They take
400 MB. A motion of more than 32,768 frames is measured on fewer Gaussians.
"""
MOST_FRAMES = 4
"""The largest number of frames that are drawn at the same time on a CPU."""
PIXELS_AT_ONCE = 1 << 22
"""The largest number of pixels in the frames that are drawn at the same time. A frame with more
pixels is drawn alone. Drawing needs some 100 bytes a pixel.
"""
A_POSE = 48.0
"""Degrees by which the arms hang down in the A-pose, as in the viewer's page."""

posed = compiled()(skin)


def draw(
    avatar: Avatar,
    poses: Iterable[BodyPose],
    cameras: Iterable[Camera],
    background: Background = None,
    how: SplatConfig | None = None,
    exposure_gains: Float[np.ndarray, "v 3"] | None = None,
    at_once: int | None = None,
) -> Iterator[Rendering]:
    """Yields one rendering for each pose and its camera. how: how to splat. None: the preset
    `avatar.rendering`, for which the avatar was trained. exposure_gains: factors on the colors in
    each image, (v, 3), see `data.exposure`. at_once: as for `draw_gaussians`.

    Raises: as `skin` and `draw_gaussians`.
    """
    if how is None:
        how = SPLAT_PRESETS[avatar.rendering]
    gaussians = (posed(avatar, pose) for pose in poses)
    if exposure_gains is not None:

        def lit(g, e):
            return replace(
                g, **jax.tree.map(lambda x: x * e, {"colors": g.colors, "harmonics": g.harmonics})
            )

        gaussians = (lit(g, e) for g, e in zip(gaussians, exposure_gains, strict=True))
    return draw_gaussians(gaussians, cameras, background, how, at_once)


def draw_gaussians(
    gaussians: Iterable[Gaussians],
    cameras: Iterable[Camera],
    background: Background = None,
    how: SplatConfig = SPLAT_PRESETS["exact"],
    at_once: int | None = None,
) -> Iterator[Rendering]:
    """Yields one rendering for each frame of Gaussians and its camera. at_once: the number of
    frames that are drawn at the same time. None: on a CPU as many as cores, `MOST_FRAMES` and
    `PIXELS_AT_ONCE` allow, elsewhere one.

    Buffers are planned for the first frame, with room to spare. Programs are compiled once per
    image size, and again only if a frame needs more room than that.

    Raises: ValueError, at the end, if there are not as many cameras as frames.
    """
    frames = zip(gaussians, cameras, strict=True)
    first = next(frames, None)
    if first is None:
        return
    plans = [plan_near(*first, how)]  # the last one is that of the next frame

    def drawn(frame: Gaussians, camera: Camera) -> Rendering:
        try:
            return render(frame, camera, plans[-1], background)
        except BufferOverflowError:
            larger = plan_buffers(frame, camera, how)
            plans.append(larger)
            return render(frame, camera, larger, background)

    yield drawn(*first)  # alone, so that its program is compiled once
    if at_once is None:
        at_once = _frames_at_once(first[1])
    yield from in_threads(drawn, frames, at_once)


def _frames_at_once(camera: Camera) -> int:
    """Returns the number of frames that are drawn at the same time. Each needs its own memory."""
    if jax.default_backend() != "cpu":
        return 1
    pixels = camera.width * camera.height
    return max(1, min(usable_cores(), MOST_FRAMES, PIXELS_AT_ONCE // pixels))


def splatting_of(shot: FrameSettings, avatar: Avatar) -> SplatConfig:
    """Returns the configuration by which a shot is drawn. The presets near_exact and fast keep the
    conventions that the avatar's weights were trained with.
    """
    if shot.splat == "as_trained":
        return SPLAT_PRESETS[avatar.rendering]
    config = SPLAT_PRESETS[shot.splat]
    if shot.splat in ("exact", "inria"):
        return config
    return drawn_as(config, avatar.rendering)


def composite_over(
    rendering: Rendering, color: tuple[float, float, float] | None
) -> Float[np.ndarray, "h w 3"] | Float[np.ndarray, "h w 4"]:
    """Returns an image in [0, 1], made of a rendering onto black. color: the background. The image
    then has the shape (h, w, 3). None: the image has straight alpha, as PNG and WebM have it, and
    the shape (h, w, 4).
    """
    rgb, alpha = np.asarray(rendering.rgb), np.asarray(rendering.alpha)[..., None]
    if color is not None:
        return np.clip(rgb + (1 - alpha) * np.asarray(color, rgb.dtype), 0, 1)
    straight = np.divide(rgb, alpha, out=np.zeros_like(rgb), where=alpha > 0)
    return np.clip(np.concatenate([straight, alpha], axis=-1), 0, 1)


def rest_pose_of(avatar: Avatar) -> BodyPose:
    """Returns the T-pose without a translation, as the avatar's body is modelled."""
    return BodyPose(from_host(np.zeros((len(avatar.parents), 3))), from_host(np.zeros(3)))


def a_pose_of(avatar: Avatar) -> BodyPose:
    """Returns the A-pose: the T-pose with the arms down by `A_POSE` degrees.

    Raises: ValueError for a body without the joints left_shoulder and right_shoulder.
    """
    names, angle = avatar.joint_names, np.radians(A_POSE)
    missing = {"left_shoulder", "right_shoulder"} - set(names)
    if missing:
        raise ValueError(f"A-pose: the avatar's body has no joint {' and '.join(sorted(missing))}")
    rotations = np.zeros((len(names), 3), np.float32)
    rotations[names.index("left_shoulder"), 2] = -angle  # the left side is at +x, y is up
    rotations[names.index("right_shoulder"), 2] = angle
    return BodyPose(from_host(rotations), from_host(np.zeros(3)))


# Cameras
# --------------------------------------------------------------------------------------------------


def tracked_points(avatar: Avatar, poses: BodyPose) -> Float[np.ndarray, "m p 3"]:
    """Returns the positions of some opaque Gaussians of the avatar in each pose of a batch, metres.
    From these points `shot_cameras` finds the middle of the person and the distance of the cameras.
    """
    opacities = np.asarray(avatar.gaussians.opacities)
    opaque = np.flatnonzero(opacities >= min(TRACKED_OPACITY, opacities.max()))
    count = min(TRACKED, len(opaque), max(MOST_TRACKED // len(poses.translation), 1))
    chosen = opaque[np.linspace(0, len(opaque) - 1, count).astype(int)]
    means, weights = taken(avatar.gaussians.means, chosen), taken(avatar.skinning_weights, chosen)
    return np.asarray(_paths(means, weights, avatar.rest_joints, avatar.parents, poses))


def shot_cameras(
    shot: FrameSettings,
    points: Float[np.ndarray, "m p 3"],
    azimuths: Float[np.ndarray, " v"],
    smoothing: float | None,
) -> Camera:
    """Returns a batch of cameras, one for each azimuth. All look at the middle of the person from
    the same distance.

    Arguments: points: points of the person in each frame, metres. If there is a single frame, it is
    used for all cameras. azimuths: degrees, added to the azimuth of the shot. smoothing: the camera
    follows the middle of the points, smoothed with this standard deviation, frames. None: the
    camera looks at the middle of the points of all frames.

    If `shot.distance` is None, the distance is the smallest for which all points of each frame lie
    in the middle of its image, within 1 / MARGIN of its width and height.

    Raises: ValueError for a shot that is out of range.
    """
    shot.check()
    low, high = points.min(axis=1), points.max(axis=1)
    if smoothing is None:
        targets = np.broadcast_to(0.5 * (low.min(axis=0) + high.max(axis=0)), (len(points), 3))
    else:
        targets = smoothed_path(0.5 * (low + high), smoothing)
    turns, lift = np.radians(shot.azimuth + np.asarray(azimuths)), np.radians(shot.elevation)
    right = np.stack([np.cos(turns), 0 * turns, -np.sin(turns)], axis=-1)
    back = np.cos(lift) * np.stack([np.sin(turns), 0 * turns, np.cos(turns)], axis=-1)
    back[:, 1] = np.sin(lift)
    # of the cameras in the world: right, down, forward
    axes = np.stack([right, np.cross(right, back), -back], axis=1)
    targets = np.broadcast_to(targets, back.shape)
    if shot.distance is None:
        distance = _fitting_distance(shot, points, targets, axes)
    else:
        distance = shot.distance
    width, height = shot.resolution
    views = np.zeros((len(turns), 4, 4), np.float32)
    views[:, :3, :3], views[:, 3, 3] = axes, 1
    views[:, :3, 3] = -np.einsum("vij,vj->vi", axes, targets + distance * back)
    K = np.asarray(intrinsics_from_fov(np.radians(shot.fov), width, height))
    each = from_host(np.broadcast_to(K, (len(turns), 3, 3)))
    one = Camera(from_host(K), from_host(np.eye(4)), width, height)
    return replace(one, K=each, cam_from_world=from_host(views))


def smoothed_path(path: Float[np.ndarray, "m 3"], frames: float) -> Float[np.ndarray, "m 3"]:
    """Returns a path smoothed by a Gaussian kernel with a standard deviation of `frames` frames.
    First the path is extended beyond both ends, by its reflection in the end point.
    """
    frames = min(frames, WIDEST * len(path))
    reach = int(np.ceil(3 * frames))
    if reach == 0 or len(path) == 1:
        return path
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / frames) ** 2)
    longer = np.pad(path, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
    return np.stack(
        [np.convolve(column, kernel / kernel.sum(), mode="valid") for column in longer.T], axis=-1
    )


def _fitting_distance(
    shot: FrameSettings, points: np.ndarray, targets: np.ndarray, axes: np.ndarray
) -> float:
    """Returns the least distance d with MARGIN |x| <= tangent (d + z) for all points, metres. Here
    x is the coordinate of a point across or down the image, and z is its depth behind the target,
    both in metres.
    """
    needed = 0.0
    for i, target in enumerate(targets):
        x, y, z = axes[i] @ (points[i % len(points)] - target).T
        for across, tangent in zip((x, y), shot.tangents, strict=True):
            needed = max(needed, float((np.abs(across) * MARGIN / tangent - z).max()))
    return needed


@compiled(static=["parents"])
def _paths(
    means: Array, weights: Array, rest_joints: Array, parents: tuple[int, ...], poses: BodyPose
) -> Array:
    """Returns the positions of Gaussians in each pose, (m, p, 3), metres. Poses are computed one at
    a time.
    """

    def one(pose):
        transforms = joint_transforms(rest_joints, parents, pose.rotations, pose.translation)
        return transform.apply(blend_transforms(weights, transforms), means)

    return jax.lax.map(one, poses)


# Sequences
# --------------------------------------------------------------------------------------------------


def trim_and_resample(
    motion: Motion,
    start: float = 0.0,
    stop: float | None = None,
    fps: float | None = None,
    loop: int = 1,
) -> Motion:
    """Returns a motion from `start` to `stop` (seconds), resampled to another frame rate and
    repeated `loop` times.

    On the ground, every repetition starts one step beyond the place where the one before has ended.
    The step is the mean movement from frame to frame. Heights are repeated as they are.

    Raises: ValueError if `start`, `stop`, `fps` or `loop` is out of range, or if there would be
    more frames than the limit `frames`.
    """
    count = len(motion.translations)
    length = count / motion.fps
    if stop is None:
        stop = length
    if not 0 <= start < stop <= length + 0.5 / motion.fps:
        raise ArgumentError(
            "start",
            f"{start:g}, stop {stop:g}: expected 0 <= start < stop <= {length:g}, the motion's"
            " seconds",
        )
    if loop < 1:
        raise ArgumentError("loop", f"{loop}: expected at least 1")
    # the limit holds for the frames that come out, not for those that are read
    rate = motion.fps if fps is None else fps
    check_limit(
        "frames", loop * (stop - start) * rate, f"frames in {loop * (stop - start):g} seconds"
    )
    first = min(int(start * motion.fps), count - 1)
    last = max(first + 1, min(round(stop * motion.fps), count))
    part = motion.part(slice(first, last))
    if fps is not None:
        part = part.at_rate(fps)
    if loop == 1:
        return part
    # repetitions go on along the ground
    path = np.asarray(part.translations)
    period = len(path) / max(len(path) - 1, 1)  # the last frame is a step before the end
    travelled = period * (path[-1] - path[0]) * [1, 0, 1]
    moved = np.concatenate([path + i * travelled for i in range(loop)])
    turned = jnp.tile(part.rotations, (loop, 1, 1))
    faces = None
    if part.expressions is not None:
        faces = jnp.tile(part.expressions, (loop, 1))
    return replace(
        part,
        rotations=turned,
        translations=from_host(moved, jnp.float32),
        expressions=faces,
    )


def motion_poses(avatar: Avatar, motion: Motion) -> BodyPose:
    """Puts a motion on the floor, and returns a pose for each of its frames. Poses have the
    motion's expressions if the avatar has a face.

    Raises: ValueError if the motion has another number of joints than the avatar.
    """
    joints = motion.rotations.shape[1]
    if joints != len(avatar.parents):
        raise ValueError(f"the motion has {joints} joints, the avatar has {len(avatar.parents)}")
    motion = grounded(motion, RestBody(avatar.rest_vertices, avatar.rest_joints), avatar.parents)
    poses = jax.vmap(BodyPose)(motion.rotations, motion.translations)
    return replace(poses, expression=motion.expressions_of(avatar.expression_names))


def motion_views(
    avatar: Avatar, motion: Motion, shot: FrameSettings, turn: float = 0.0, follow: bool = True
) -> tuple[BodyPose, Camera]:
    """Puts a motion on the floor, and returns a pose and a camera for each of its frames.

    Arguments: turn: degrees by which the camera goes around the person during the motion. follow:
    whether the camera goes along with the person. If not, it looks at one point. Unless the shot
    has a distance, the camera is far enough away to keep the person in the image.

    Raises: ValueError if the motion has another number of joints than the avatar, or the shot is
    out of range.
    """
    poses, count = motion_poses(avatar, motion), len(motion.translations)
    azimuths = turn * np.arange(count) / count
    smoothing = FOLLOWING * motion.fps if follow else None
    return poses, shot_cameras(shot, tracked_points(avatar, poses), azimuths, smoothing)


def turntable_views(
    avatar: Avatar, pose: BodyPose, views: int, shot: FrameSettings
) -> tuple[BodyPose, Camera]:
    """Returns a batch of copies of a pose, one for each view, and cameras on a circle that starts
    at the azimuth of the shot.

    Raises: ValueError if `views` is less than 1 or beyond the limit `frames`, or if the shot is out
    of range.
    """
    if views < 1:
        raise ValueError(f"views {views}: expected at least 1")
    check_limit("frames", views, "views")
    points = tracked_points(avatar, jax.tree.map(lambda x: x[None], pose))
    cameras = shot_cameras(shot, points, np.linspace(0, 360, views, endpoint=False), None)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (views, *x.shape)), pose), cameras


def capture_views(avatar: Avatar, capture: Capture) -> tuple[BodyPose, Camera]:
    """Returns the pose and the camera of each view of a capture, turned to a world with y up,
    because the light of an avatar is that of a world with y up.

    Raises: ValueError if the capture's body has another number of joints than the avatar.
    """
    joints = capture.poses.rotations.shape[1]
    if joints != len(avatar.parents):
        raise ValueError(
            f"the capture's poses have {joints} joints, the avatar has {len(avatar.parents)}"
        )
    poses, cameras = capture.poses[np.asarray(capture.frames)], capture.cameras
    up = world_up(np.asarray(poses.rotations)[:, 0], cameras)
    if up == "y":
        return poses, cameras
    pelvis = np.asarray(avatar.rest_joints)[avatar.parents.index(-1)]
    return turned_world(poses, cameras, up, pelvis)


def capture_renderings(
    avatar: Avatar, capture: Capture, background: Background = None, how: SplatConfig | None = None
) -> tuple[Camera, list[Rendering]]:
    """Returns the cameras of a capture, and the avatar drawn in its poses and from these cameras.
    how: as for `draw`.

    Raises: as `capture_views`.
    """
    poses, cameras = capture_views(avatar, capture)
    return cameras, list(draw(avatar, poses, cameras, background, how))


def images(
    avatar: Avatar,
    poses: BodyPose,
    cameras: Camera,
    shot: FrameSettings,
    progress: str | None = None,
) -> Iterator[Float[np.ndarray, "h w c"]]:
    """Yields one image for each pose and its camera, (h, w, 3), or (h, w, 4) with alpha, see
    `composite_over`. Frames are drawn when they are asked for. On a CPU a few are drawn ahead.

    progress: the label of a progress bar; None: no bar.
    """
    drawn = draw(avatar, poses, cameras, from_host(np.zeros(3)), splatting_of(shot, avatar))
    shown = bar(
        drawn,
        total=len(poses),
        desc=progress,
        unit="frame",
        first=COMPILING,
        shown=progress is not None,
    )
    return (composite_over(rendering, shot.color()) for rendering in shown)


@checked_arguments
def motion_frames(
    avatar: Avatar,
    motion: Motion,
    shot: FrameSettings | None = None,
    *,
    turn: float = 0.0,
    progress: bool = True,
) -> Iterator[Float[np.ndarray, "h w c"]]:
    """Yields the frames of a moving avatar, which the camera follows. See `motion_views` and
    `images`. progress: whether to show a progress bar.

    Raises: as `motion_views`.
    """
    if shot is None:
        shot = FrameSettings()
    poses, cameras = motion_views(avatar, motion, shot, turn)
    return images(avatar, poses, cameras, shot, "animate" if progress else None)


def without_unseen(
    avatar: Avatar, poses: BodyPose, cameras: Camera, how: SplatConfig, progress: str | None = None
) -> Avatar:
    """Returns the avatar without the Gaussians whose blending weight is less than `ALPHA_MIN` on
    every pixel of every image. There is one image for each pose and its camera.

    All images are drawn once to find these Gaussians. This pays only if the same images are drawn
    several times afterwards.
    """
    most = np.zeros(len(avatar.gaussians.means), np.float32)
    drawn = draw(avatar, poses, cameras, how=dataclasses.replace(how, visibility=True))
    for rendering in bar(
        drawn,
        total=len(poses),
        desc=progress,
        unit="frame",
        first=COMPILING,
        shown=progress is not None,
    ):
        most = np.maximum(most, rendering.visibility)
    return avatar.select(np.flatnonzero(most >= ALPHA_MIN))
