"""Colours as evidence: an avatar of the current estimate is rendered and compared with the photos.

The avatar comes from the network, at once and from all views, so that it is where the views agree. Rendering it is
differentiable in poses and cameras. The renderer has a backward rule only, and images have many more pixels than there are
unknowns, so this is solved by L-BFGS: a Jacobian would take a backward pass for every residual.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, PyTree
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import equal_exposure
from humangs_jax.data.views import MASK_THRESHOLD, SubjectViews, standardize
from humangs_jax.fitting.solve import NORMAL_MAD, robust
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.humangs import HumanGSConfig
from humangs_jax.objectives.metrics import decibels
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import plan_buffers, render

LEAST_NOISE = 0.02
"""Least std of colours in [0, 1]: avatars are no better."""
ROBUST_SCALE = 3.0
"""Robust scale of colours, standard deviations."""
MARGIN = 1.5
"""Buffers of the renderer, as multiples of what the first images need: people move little."""


@dataclasses.dataclass(frozen=True, eq=False)
class Likeness:
    """An avatar of a capture, the views that it is compared with, at the network's size, and how like them it is.

    psnr: dB, of all views. noise: std of its colours where the person is, in [0, 1]. splatting: how it is rendered, with margin
    in the buffers.
    """

    avatar: Avatar
    views: SubjectViews
    psnr: float
    noise: float
    splatting: SplatConfig


def likeness(variables: PyTree, network: HumanGSConfig, capture: Capture) -> Likeness:
    """Reconstruct the person of a capture and compare with its photos."""
    capture = equal_exposure(capture)
    avatar = reconstruct(variables, network, capture)
    views = standardize(capture, network.image_size, network.execution.crop)
    poses = jax.vmap(BodyPose)(views.rotations, views.translations)
    splatting = _with_margin(avatar, poses, views.cameras)
    off = np.asarray(draw(avatar, poses, views.cameras, splatting) - views.images)
    person = np.asarray(views.masks) > MASK_THRESHOLD
    noise = NORMAL_MAD * float(np.median(np.abs(off[person]))) if person.any() else 1.0
    return Likeness(avatar, views, float(decibels(jnp.mean(jnp.square(off)))), max(noise, LEAST_NOISE), splatting)


def _with_margin(avatar, poses, cameras):
    """Buffers for the most demanding view, and for small moves."""
    needs, skin_once = [], jax.jit(skin)
    for i in range(len(poses.translation)):
        posed = skin_once(avatar, jax.tree.map(lambda leaf, i=i: leaf[i], poses))
        needs.append(plan_buffers(posed, cameras[i], SPLAT_PRESETS[avatar.rendering], margin=MARGIN))
    most = lambda name: max(getattr(config, name) for config in needs)
    return dataclasses.replace(needs[0], max_pairs=most("max_pairs"), max_rows=most("max_rows"))


@functools.partial(jax.jit, static_argnames="splatting")
def draw(avatar: Avatar, poses: BodyPose, cameras: Camera, splatting: SplatConfig) -> Float[Array, "v h w 3"]:
    """Images of v poses by v cameras, one after the other: all at once would hold the buffers of all."""
    return jax.lax.map(lambda view: render(skin(avatar, view[0]), view[1], splatting).rgb, (poses, cameras))


def color_residuals(
    avatar: Avatar,
    views: SubjectViews,
    poses: BodyPose,
    cameras: Camera,
    splatting: SplatConfig,
    noise,
    independent: float,
) -> Float[Array, "v h w 3"]:
    """Differences of colours in standard deviations.

    noise: () std of colours. independent: number of independent colours that all pixels of a view count for, because neighbours
    err together.
    """
    share = independent / (jnp.sum(views.masks, axis=(1, 2)) + 1)
    off = robust((draw(avatar, poses, cameras, splatting) - views.images) / noise, ROBUST_SCALE)
    return jnp.sqrt(share)[:, None, None, None] * off
