"""A toy person: a body with one Gaussian on each vertex, and photos in other colors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import capture_renderings
from humangs_jax.body.model import shape_body
from humangs_jax.data.capture import capture_from_arrays
from humangs_jax.geometry.camera import intrinsics_from_fov, orbit
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splat_config import SplatConfig

WIDTH, HEIGHT = 48, 64
STEPS = RefineConfig(iterations=0, steps=12, seconds=None, held_out=0.0)

SAME = SplatConfig(max_pairs=1 << 14, max_rows=1 << 13, visibility=True)
"""Sizes of buffers of all fast tests."""


def toy_avatar(body, shade):
    rest = shape_body(body, jnp.zeros(2))
    n = len(rest.vertices)
    colors = jnp.clip(0.5 + 0.4 * jnp.sin(9 * rest.vertices) + shade, 0.05, 0.95)
    gaussians = Gaussians(
        rest.vertices,
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (n, 1)),
        jnp.full((n, 3), 0.03),
        jnp.full(n, 0.8),
        colors,
    )
    return Avatar(
        gaussians,
        body.skinning_weights,
        rest.vertices,
        rest.joints,
        body.faces,
        body.parents,
        body.joint_names,
    )


def toy_capture(body, avatar, views=3, moving=False, distance=3.6):
    """Returns photos of an avatar, each in another pose if `moving`.

    `distance` is that of each camera, metres.
    """
    cameras = orbit(
        jnp.asarray([0.0, 0.9, 0.0]),
        distance,
        jnp.arange(float(views)),
        0.1,
        intrinsics_from_fov(np.pi / 6, WIDTH, HEIGHT),
        WIDTH,
        HEIGHT,
    )
    rng = np.random.default_rng(0)
    rotations = 0.2 * rng.normal(size=(views, 55, 3)) * moving
    arrays = dict(
        rotations=rotations, translations=np.zeros((views, 3)), frames=np.arange(views), body=body
    )
    blank = np.ones((views, HEIGHT, WIDTH, 3))
    capture = capture_from_arrays(
        blank, cameras.K, cameras.cam_from_world, masks=blank[..., 0], **arrays
    )
    drawn = capture_renderings(avatar, capture)[1]
    images = np.stack([np.clip(np.asarray(r.rgb), 0, 1) for r in drawn])
    return dataclasses.replace(
        capture, images=images, masks=np.stack([np.asarray(r.alpha) for r in drawn])
    )


def squared_error(avatar, capture):
    """Returns the mean squared error of the drawn avatar in the photos."""
    drawn = [np.asarray(r.rgb) for r in capture_renderings(avatar, capture)[1]]
    return float(np.mean(np.square(np.clip(drawn, 0, 1) - capture.images)))


FEW = 0.03
"""Largest share of numbers that differ: Adam makes whole steps of gradients that are rounding."""


def assert_nearly_all_close(got, expected, atol):
    """Compares two pytrees of one structure, but for the share `FEW` of each leaf."""
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        differ = np.abs(np.asarray(a) - np.asarray(b)) > atol
        assert differ.mean() < FEW, (
            f"{differ.sum()} of {differ.size} numbers differ by more than {atol}"
        )
