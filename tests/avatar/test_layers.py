"""Layers of views, on a person of two balls whose surface, normals and parts are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from avatar_cases import CENTRES, NAMES, RADIUS, SPLAT, two_balls
from exr_files import read_exr
from scipy.spatial.transform import Rotation

from humangs_jax.avatar import frames, layers
from humangs_jax.avatar.frame_settings import FrameSettings
from humangs_jax.body.model import BodyPose
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import project
from humangs_jax.io.images import read_image
from humangs_jax.io.reading import Limits, set_limits
from humangs_jax.rendering.splatting import Rendering

TURN, MOVE = np.asarray([0.0, 0.3, 0.5]), np.asarray([0.2, -0.1, 0.4])
ALL = ("rgba", "z", "position", "normal", "part")
SURFACE = 4 * SPLAT
"""Largest error of the surface, metres: a nearer splat covers those beside it, on steep surfaces
the more.
"""
NORMAL = 0.1
"""Largest error of a normal, 1 - cosine: a pixel sees splats of vertices some degrees apart."""


def turned_pose():
    """Returns a pose with the root turned and moved, and the upper ball turned about its centre.

    The second turn does not change the ball's normals.
    """
    rotations = np.stack([TURN, [0.4, 0.0, 0.0], np.zeros(3)]).astype(np.float32)
    return BodyPose(jnp.asarray(rotations), jnp.asarray(MOVE, jnp.float32))


def posed_centres():
    return Rotation.from_rotvec(TURN).apply(CENTRES - CENTRES[0]) + CENTRES[0] + MOVE


def test_normals_are_turned_with_the_body():
    avatar, pose = two_balls(2), turned_pose()
    n = len(avatar.rest_vertices) // 2
    means = np.asarray(frames.posed(avatar, pose).means)
    radial = (means - np.repeat(posed_centres(), n, axis=0)) / RADIUS
    # of 320 flat faces
    np.testing.assert_allclose(layers.gaussian_normals(avatar, pose), radial, atol=0.03)
    np.testing.assert_array_equal(layers.gaussian_parts(avatar), np.repeat([0, 1], n))


def test_positions_project_to_their_pixels():
    camera = frames.shot_cameras(
        FrameSettings(width=30, height=20, azimuth=35.0), CENTRES[None], np.zeros(1), None
    )[0]
    depth = np.random.default_rng(0).uniform(1, 5, (20, 30)).astype(np.float32)
    points = layers.unprojected(camera, depth)
    uv, z = project(camera, jnp.asarray(points))
    x, y = np.meshgrid(np.arange(30) + 0.5, np.arange(20) + 0.5)
    np.testing.assert_allclose(uv, np.stack([x, y], -1), atol=1e-3)
    np.testing.assert_allclose(z, depth, rtol=1e-5)


def test_what_does_not_fit_is_refused_before_anything_is_drawn(tmp_path):
    avatar = two_balls(1)
    poses, cameras = frames.turntable_views(
        avatar, frames.rest_pose_of(avatar), 2, FrameSettings(size=64)
    )
    set_limits(Limits(array_bytes=100_000))
    try:
        with pytest.raises(
            ValueError, match=r"views.exr: 2 views are 1.64e\+05 bytes, more than 1e\+05"
        ):
            layers.write_views(
                tmp_path, avatar, poses, cameras, FrameSettings(size=64), layers.ExrLayers()
            )
    finally:
        set_limits(None)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(
        ValueError, match="channels 'depth': expected some of rgba, z, position, normal, part"
    ):
        layers.ExrLayers(("rgba", "depth")).check()


def test_exr_colors_are_premultiplied(tmp_path, monkeypatch):
    """Compositing programs add (1 - alpha) times the background, which gives what was rendered."""
    avatar, shot = two_balls(1), FrameSettings(width=3, height=1, background="#336699")
    alpha = np.asarray([[0.0, 0.5, 1.0]], np.float32)
    rendering = Rendering(
        jnp.asarray(0.25 * alpha[..., None] * np.ones(3)),
        jnp.asarray(alpha),
        jnp.ones((1, 3)),
        jnp.int32(0),
    )
    monkeypatch.setattr(layers, "draw", lambda *arguments: iter([rendering]))
    poses, cameras = frames.turntable_views(avatar, frames.rest_pose_of(avatar), 1, shot)
    for name in ("view_000.png", "view_007.png", "mine.png"):  # the second is of an earlier call
        (tmp_path / name).write_bytes(b"old")
    layers.write_views(tmp_path, avatar, poses, cameras, shot, layers.ExrLayers(), progress=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "mine.png",
        "view_000.png",
        "views.exr",
    ]
    (view,) = read_exr(tmp_path / "views.exr")
    np.testing.assert_allclose(view.rgba[..., :3], 0.25 * alpha[..., None] * np.ones(3), atol=1e-6)
    np.testing.assert_array_equal(view.rgba[..., 3], alpha)
    layers.write_renderings_exr(tmp_path / "same.exr", cameras, [rendering])
    np.testing.assert_array_equal(read_exr(tmp_path / "same.exr")[0].rgba, view.rgba)
    over = 0.25 * alpha[..., None] + (1 - alpha[..., None]) * np.asarray([0.2, 0.4, 0.6])
    np.testing.assert_allclose(
        read_image(tmp_path / "view_000.png")[0], over, atol=0.5 / 255 + 1e-6
    )


@pytest.mark.slow
def test_layers_of_the_two_balls(tmp_path):
    """The ray through a pixel says which surface, normal and part the file must have there."""
    avatar, pose, shot = (
        two_balls(),
        turned_pose(),
        FrameSettings(width=72, height=96, azimuth=25.0),
    )
    still = frames.rest_pose_of(avatar)
    poses = jax.tree.map(lambda *leaves: jnp.stack(leaves), still, pose)
    points = frames.tracked_points(avatar, poses)
    cameras = frames.shot_cameras(shot, points, np.zeros(2), None)
    layers.write_views(
        tmp_path, avatar, poses, cameras, shot, layers.ExrLayers(ALL, half=True), progress=False
    )
    views = read_exr(tmp_path / "views.exr")
    for view, centres, camera in zip(views, (CENTRES, posed_centres()), cameras, strict=True):
        assert view.attributes["parts"].split(",") == list(NAMES)
        position, normal = (
            np.stack([view.channels[f"{kind}.{axis}"] for axis in "XYZ"], -1)
            for kind in ("position", "normal")
        )
        eye, rays = (
            np.asarray(camera.center),
            layers.unprojected(camera, np.ones((96, 72), np.float32)),
        )
        rays = rays - eye
        along = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        hit_depth, hit_ball, grazed = (
            np.full((96, 72), np.inf),
            np.zeros((96, 72), int),
            np.zeros((96, 72), bool),
        )
        for i, centre in enumerate(centres):  # the nearer root of |eye + t along - centre| = radius
            b = ((eye - centre) * along).sum(-1)
            inside = b**2 - ((eye - centre) ** 2).sum() + RADIUS**2
            steep = inside > (0.6 * RADIUS) ** 2
            # the pixel shows what lies behind, too
            grazed |= ~steep & (inside > RADIUS**2 - (RADIUS + 4 * SPLAT) ** 2)
            t = np.where(steep, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
            hit_ball = np.where(t < hit_depth, i + 1, hit_ball)
            hit_depth = np.minimum(t, hit_depth)
        hit = np.isfinite(hit_depth) & ~grazed
        assert hit.mean() > 0.1 and view.rgba[hit, 3].min() > 0.95
        surface = eye + hit_depth[hit][:, None] * along[hit]
        assert np.linalg.norm(position[hit] - surface, axis=-1).max() < SURFACE
        np.testing.assert_allclose(
            view.depth[hit], project(camera, jnp.asarray(position[hit]))[1], rtol=1e-5
        )
        radial = (surface - centres[hit_ball[hit] - 1]) / RADIUS
        assert ((normal[hit] * radial).sum(-1)).min() > 1 - NORMAL
        # half precision
        np.testing.assert_allclose(np.linalg.norm(normal[hit], axis=-1), 1, atol=2e-3)
        np.testing.assert_array_equal(view.channels["part"][hit], hit_ball[hit])
        nothing = view.rgba[..., 3] == 0
        assert nothing.any()
        for image in (*view.channels.values(), view.depth):
            assert not image[nothing].any()


@pytest.mark.slow
def test_what_no_frame_shows_can_be_left_out():
    """A ball inside another one is never seen; without it images differ by at most half an 8-bit
    level.
    """
    avatar = two_balls(3)
    n = len(avatar.rest_vertices) // 2
    inside = CENTRES[0] + 0.5 * (np.asarray(avatar.gaussians.means[n:]) - CENTRES[1])
    means = jnp.concatenate([avatar.gaussians.means[:n], jnp.asarray(inside, jnp.float32)])
    opaque = jnp.full(2 * n, 0.99)
    scales = jnp.repeat(jnp.asarray([0.06, 0.02]), n)[:, None] * jnp.ones(3)
    avatar = replace(
        avatar, gaussians=replace(avatar.gaussians, means=means, opacities=opaque, scales=scales)
    )
    shot = FrameSettings(size=64)
    poses, cameras = frames.turntable_views(avatar, frames.rest_pose_of(avatar), 6, shot)
    how = frames.splatting_of(shot, avatar)
    less = frames.without_unseen(avatar, poses, cameras, how)
    kept = len(less.gaussians.means)
    assert kept < 1.2 * n and less.skinning_weights.shape == (kept, 3)
    for whole, part in zip(
        frames.images(avatar, poses, cameras, shot),
        frames.images(less, poses, cameras, shot),
        strict=True,
    ):
        assert np.abs(whole - part).max() < 2 / 255
