"""Frames of an animation: cameras, numbers of frames, backgrounds, and sizes of buffers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from avatar_cases import CENTRES, RADIUS, two_balls

from humangs_jax.avatar import frames
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.body.model import BodyPose
from humangs_jax.body.motion import Motion
from humangs_jax.geometry.camera import Camera
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS
from humangs_jax.rendering.splatting import Rendering, render

ROUNDING = 1e-6
"""Rounding of float32 between programs with buffers of other sizes."""
PIXEL_ROUNDING = 2e-2
"""Pixels: rounding of float32 positions some metres away."""


def blobs(count=80):
    rng = np.random.default_rng(0)
    means = np.concatenate(
        [rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(3, 4, (count, 1))], axis=1
    )
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    arrays = (
        means,
        quats,
        np.full((count, 3), 0.02),
        np.full(count, 0.8),
        rng.uniform(size=(count, 3)),
    )
    return Gaussians(*(jnp.asarray(a, jnp.float32) for a in arrays))


@pytest.mark.slow
def test_a_frame_that_needs_more_room_gets_it(monkeypatch):
    plans, gaussians = [], blobs()

    def counted(plan):
        def call(*arguments):
            plans.append(plan)
            return plan(*arguments)

        return call

    for name in ("plan_near", "plan_buffers"):  # of the first frame, and of those without room
        monkeypatch.setattr(frames, name, counted(getattr(frames, name)))
    focal = [5.0, 5.2, 150.0, 6.0]  # the third one comes close
    cameras = [
        Camera(jnp.asarray([[f, 0, 36], [0, f, 36], [0, 0, 1]], jnp.float32), jnp.eye(4), 64, 64)
        for f in focal
    ]
    drawn = list(frames.draw_gaussians(iter([gaussians] * 4), iter(cameras)))
    assert len(plans) == 2
    for rendering, camera in zip(drawn, cameras, strict=True):
        np.testing.assert_allclose(rendering.rgb, render(gaussians, camera).rgb, atol=ROUNDING)
        assert rendering.overflow == 0 and rendering.alpha.max() > 0.5


@pytest.mark.parametrize("at_once", [1, 3])
def test_frames_are_those_of_their_poses_and_cameras(at_once):
    gaussians = [blobs(count) for count in (80, 60, 80, 60, 80)]
    camera = Camera(jnp.asarray([[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]), jnp.eye(4), 64, 64)
    cameras = [camera.resized(size, size) for size in (64, 48, 64, 64, 48)]
    drawn = frames.draw_gaussians(iter(gaussians), iter(cameras), at_once=at_once)
    for rendering, frame, camera in zip(drawn, gaussians, cameras, strict=True):
        np.testing.assert_allclose(rendering.rgb, render(frame, camera).rgb, atol=ROUNDING)
    with pytest.raises(ValueError, match="zip"):
        list(frames.draw_gaussians(iter(gaussians[:1]), iter(cameras)))
    assert list(frames.draw_gaussians(iter([]), iter([]))) == []


def test_large_frames_are_drawn_one_at_a_time(monkeypatch):
    monkeypatch.setattr(frames, "usable_cores", lambda: 64)
    camera = Camera(jnp.eye(3), jnp.eye(4), 512, 512)
    at_once = [frames._frames_at_once(camera.resized(side, side)) for side in (512, 1448, 4096)]
    assert at_once == [4, 2, 1]


def test_each_camera_has_its_exposure():
    avatar = two_balls(1)
    pose, how = frames.rest_pose_of(avatar), SPLAT_PRESETS["exact"]
    camera = frames.shot_cameras(FrameSettings(size=64), CENTRES[None], np.zeros(1), None)[0]
    gains = np.asarray([[1.0, 1, 1], [0.5, 0.7, 0.9]])
    plain, darker = frames.draw(avatar, [pose] * 2, [camera] * 2, jnp.zeros(3), how, gains)
    np.testing.assert_allclose(darker.rgb, plain.rgb * gains[1], atol=ROUNDING)
    assert plain.rgb.max() > 0.1


# Cameras
# --------------------------------------------------------------------------------------------------


def pixels(cameras, points):
    """Returns pixels (v, p, 2) at which each camera sees the points of its frame."""
    K, world = np.asarray(cameras.K, float), np.asarray(cameras.cam_from_world, float)
    seen = np.einsum("vij,vpj->vpi", world[:, :3, :3], points) + world[:, None, :3, 3]
    assert (seen[..., 2] > 0).all()
    projected = np.einsum("vij,vpj->vpi", K, seen)
    return projected[..., :2] / projected[..., 2:]


def walker(metres=3.0, frames_per_second=30, seconds=3.0):
    """Returns points (m, 8, 3) of a box 1.7 m high that walks along x and sways with its steps."""
    count = int(seconds * frames_per_second)
    time = np.arange(count) / frames_per_second
    path = np.stack(
        [metres * time / seconds, 0.03 * np.sin(4 * np.pi * time), 0.05 * np.sin(2 * np.pi * time)],
        axis=-1,
    )
    box = np.stack(np.meshgrid([-0.3, 0.3], [0, 1.7], [-0.2, 0.2]), axis=-1).reshape(-1, 3)
    return path[:, None] + box


SHOTS = {
    "square": FrameSettings(),
    "portrait from above": FrameSettings(width=90, height=160, azimuth=40.0, elevation=50.0),
    "landscape, wide angle, from behind": FrameSettings(
        width=640, height=200, azimuth=200.0, fov=90.0, elevation=-20.0
    ),
}


@pytest.mark.parametrize("name", SHOTS)
@pytest.mark.parametrize("smoothing", [15.0, None])
def test_the_camera_is_as_near_as_everything_fits(name, smoothing):
    shot, points = SHOTS[name], walker()
    cameras = frames.shot_cameras(shot, points, np.linspace(0, 50, len(points)), smoothing)
    size = np.asarray(shot.resolution)
    assert (cameras.width, cameras.height) == shot.resolution and len(cameras) == len(points)
    from_middle = np.abs(pixels(cameras, points) - size / 2) / (size / 2)
    np.testing.assert_allclose(
        from_middle.max(), 1 / frames.MARGIN, atol=PIXEL_ROUNDING / size.min() * 2
    )


def test_the_camera_goes_along_and_does_not_bob():
    points, shot = walker(), FrameSettings(size=100)
    cameras = frames.shot_cameras(shot, points, np.zeros(len(points)), 0.5 * 30)
    seen = pixels(cameras, points)
    heights = np.ptp(seen[..., 1], axis=1)
    assert heights.min() > 80  # standing still, it leaves the person less than half of the image:
    still = frames.shot_cameras(shot, points, np.zeros(len(points)), None)
    assert np.ptp(pixels(still, points)[..., 1], axis=1).max() < 50
    middle = 0.5 * (seen.min(axis=1) + seen.max(axis=1))
    # in the middle of the image, at the ends of the walk, too
    assert np.abs(middle[:, 0] - 50).max() < 3
    eyes = np.asarray(cameras.center)
    np.testing.assert_allclose(np.diff(eyes[:, 0]), 3.0 / 90, rtol=1e-2)
    # the head moves by 0.06; at the ends the path is mirrored at a point of that
    assert np.ptp(eyes[:, 1]) < 0.25 * 0.06


def test_distance_and_angles_are_those_that_are_asked_for():
    points = walker()[:1]
    shot = FrameSettings(distance=2.5, azimuth=90.0, elevation=30.0, fov=40.0, width=80, height=60)
    camera = frames.shot_cameras(shot, points, np.zeros(1), None)[0]
    middle = 0.5 * (points[0].min(0) + points[0].max(0))
    towards = np.asarray([np.cos(np.radians(30)), 0.5, 0])  # azimuth 90 is +x, the left side
    np.testing.assert_allclose(camera.center, middle + 2.5 * towards, atol=1e-5)
    np.testing.assert_allclose(camera.K[1, 1], 30 / np.tan(np.radians(20)), rtol=1e-5)
    np.testing.assert_allclose(camera.K[0, 0], camera.K[1, 1], rtol=1e-6)


def test_smoothing_keeps_straight_paths_and_short_ones():
    line = np.arange(20)[:, None] * [1.0, 0.5, -2.0]
    np.testing.assert_allclose(frames.smoothed_path(line, 7.0), line, atol=1e-9)
    np.testing.assert_allclose(frames.smoothed_path(line[:2], 30.0), line[:2], atol=1e-9)
    assert frames.smoothed_path(line[:1], 5.0).shape == (1, 3)
    wave = np.sin(np.arange(200))[:, None] * [1.0, 1.0, 1.0]
    assert np.abs(frames.smoothed_path(wave, 6.0)[30:-30]).max() < 1e-3
    np.testing.assert_allclose(
        frames.smoothed_path(wave, 1e12), frames.smoothed_path(wave, 500.0), atol=1e-6
    )


def test_a_turntable_shows_the_person_from_all_sides():
    avatar = two_balls(2)
    poses, cameras = frames.turntable_views(
        avatar, frames.rest_pose_of(avatar), 4, FrameSettings(elevation=0.0)
    )
    assert len(poses) == len(cameras) == 4
    middle = CENTRES.mean(axis=0)
    directions = np.asarray(cameras.center) - middle
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(
        directions, [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]], atol=0.02
    )
    with pytest.raises(ValueError, match="views 0: expected at least 1"):
        frames.turntable_views(avatar, frames.rest_pose_of(avatar), 0, FrameSettings())


def test_what_is_tracked_moves_with_the_joints():
    avatar = two_balls(2)
    rotations = np.zeros((2, 3, 3), np.float32)
    rotations[1, 0] = [0, 0, np.pi / 2]  # about the lower ball's centre: the upper one goes to -x
    poses = jax.vmap(BodyPose)(
        jnp.asarray(rotations), jnp.asarray([[0, 0, 0], [0, 0, 2.0]], jnp.float32)
    )
    points = frames.tracked_points(avatar, poses)
    still, turned = (0.5 * (frame.min(axis=0) + frame.max(axis=0)) for frame in points)
    np.testing.assert_allclose(still, CENTRES.mean(axis=0), atol=0.02)
    np.testing.assert_allclose(turned, [-0.4, 0.5, 2.0], atol=0.02)
    assert np.ptp(points[1, :, 0]) == pytest.approx(0.8 + 2 * RADIUS, abs=0.02)


def test_the_a_pose_lowers_the_arms():
    avatar = two_balls(1)
    rotations = np.asarray(frames.a_pose_of(avatar).rotations)
    np.testing.assert_allclose(rotations[1:, 2], np.radians([-48, 48]), rtol=1e-6)
    assert not rotations[0].any() and not rotations[:, :2].any()
    from humangs_jax.core.pytree import replace

    with pytest.raises(ValueError, match="no joint left_shoulder"):
        frames.a_pose_of(replace(avatar, joint_names=("pelvis", "a", "right_shoulder")))


# Frames and colors
# --------------------------------------------------------------------------------------------------


def walk(count=24, fps=24.0):
    path = np.stack(
        [np.zeros(count), 1 + 0.1 * np.sin(np.arange(count)), 0.05 * np.arange(count)], axis=-1
    )
    turns = np.random.default_rng(0).normal(size=(count, 3, 3))
    return Motion(jnp.asarray(turns, jnp.float32), jnp.asarray(path, jnp.float32), fps)


def test_an_excerpt_is_a_part_of_the_motion():
    motion = walk()
    part = frames.trim_and_resample(motion, 0.25, 0.75)
    np.testing.assert_array_equal(part.translations, motion.translations[6:18])
    np.testing.assert_array_equal(part.rotations, motion.rotations[6:18])
    assert frames.trim_and_resample(motion).translations.shape == (24, 3)
    faster = frames.trim_and_resample(motion, 0.0, 0.5, fps=48.0)
    assert faster.fps == 48 and len(faster.translations) == 24
    assert len(frames.trim_and_resample(motion, 0.99).translations) == 1


def test_a_loop_goes_on_where_it_was():
    motion = walk()
    twice = frames.trim_and_resample(motion, loop=3)
    path = np.asarray(twice.translations)
    # no step back, no step of another length
    np.testing.assert_allclose(np.diff(path[:, 2]), 0.05, atol=1e-5)
    np.testing.assert_allclose(path[24:48, 1], path[:24, 1], atol=1e-6)
    np.testing.assert_array_equal(twice.rotations[24:48], motion.rotations)


@pytest.mark.parametrize(
    "times", [(-0.1, None), (0.5, 0.5), (0.5, 0.2), (0.0, 1.2), (1.0, None), (float("nan"), None)]
)
def test_times_outside_of_the_motion_are_named(times):
    with pytest.raises(ValueError, match=r"start .*stop .*expected 0 <= start < stop <= 1,"):
        frames.trim_and_resample(walk(), *times)
    with pytest.raises(ValueError, match="loop 0"):
        frames.trim_and_resample(walk(), loop=0)


def test_what_is_behind_the_person():
    """A background color shows through. Without one the image has straight alpha, which gives the
    same over that color.
    """
    rng = np.random.default_rng(0)
    alpha = np.concatenate([[0.0, 1.0], rng.random(10)]).reshape(3, 4).astype(np.float32)
    own = rng.random((3, 4, 3)).astype(np.float32)
    rendering = Rendering(
        jnp.asarray(own * alpha[..., None]), jnp.asarray(alpha), jnp.zeros((3, 4)), jnp.int32(0)
    )
    color = (0.1, 0.5, 0.9)
    opaque, clear = frames.composite_over(rendering, color), frames.composite_over(rendering, None)
    np.testing.assert_allclose(
        opaque, own * alpha[..., None] + (1 - alpha[..., None]) * color, atol=ROUNDING
    )
    assert clear.shape == (3, 4, 4) and np.isfinite(clear).all() and not clear[0, 0].any()
    over = clear[..., :3] * clear[..., 3:] + (1 - clear[..., 3:]) * np.asarray(color)
    np.testing.assert_allclose(over, opaque, atol=ROUNDING)


def test_presets_keep_the_conventions_of_the_weights():
    from humangs_jax.core.pytree import replace

    ours = two_balls(1)
    theirs = replace(ours, rendering="inria")
    assert frames.splatting_of(FrameSettings(), ours) == SPLAT_PRESETS["exact"]
    assert frames.splatting_of(FrameSettings(), theirs) == SPLAT_PRESETS["inria"]
    assert frames.splatting_of(FrameSettings(splat="fast"), ours) == SPLAT_PRESETS["fast"]
    assert frames.splatting_of(FrameSettings(splat="exact"), theirs) == SPLAT_PRESETS["exact"]
    fast = frames.splatting_of(FrameSettings(splat="fast"), theirs)
    assert fast.square and fast.transmittance_stop == SPLAT_PRESETS["fast"].transmittance_stop


BAD_SHOTS = {
    "size 0": dict(size=0),
    "width 100000": dict(width=100000),
    "azimuth nan": dict(azimuth=float("nan")),
    "elevation 90": dict(elevation=90.0),
    "fov 180": dict(fov=180.0),
    "distance -1": dict(distance=-1.0),
    "background 'greenish'": dict(background="greenish"),
    "background '#11223344'": dict(background="#11223344"),
}


@pytest.mark.parametrize("message", BAD_SHOTS)
def test_a_shot_that_cannot_be_taken_is_named(message):
    with pytest.raises(ValueError) as error:
        FrameSettings(**BAD_SHOTS[message]).check()
    assert str(error.value).startswith(message) and "expected" in str(error.value)


def test_colors_have_names_and_numbers():
    assert (
        FrameSettings().color()
        == (1, 1, 1)
        == FrameSettings(background="#ffffff").color()
        == FrameSettings(background="rgb(255,255,255)").color()
    )
    assert FrameSettings(background=" Transparent ").color() is None
    assert FrameSettings(background="#336699").color() == (0.2, 0.4, 0.6)
    assert FrameSettings(width=20).resolution == (20, 512) and FrameSettings(
        size=9, height=5
    ).resolution == (9, 5)
