"""Refinement by the photographs' colours: an avatar of the current estimate is drawn, and cameras and poses moved until it
fits.

The avatar comes from the network, at once and from all views, so that it is where the views agree; drawing it is
differentiable in poses and cameras. The renderer has a backward rule only, and pictures have many more pixels than there are
unknowns, which is why this is L-BFGS on one number: a matrix of derivatives would take a backward pass for every residual.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.body.skinning import EXACT, blend_transforms, joint_transforms
from humangs_jax.core.array_types import PyTree
from humangs_jax.core.pytree import replace
from humangs_jax.data.capture import Capture
from humangs_jax.data.views import MASK_THRESHOLD, SubjectViews, standardize
from humangs_jax.fitting.objective import robust
from humangs_jax.fitting.refinement.rounds import DEVIATION, RoundConfig, moved_capture, start_of
from humangs_jax.fitting.refinement.unknowns import moved_cameras, moved_poses, nothing_moved, root_turns
from humangs_jax.fitting.solvers import Outcome, minimise
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.objectives.metrics import decibels
from humangs_jax.rendering.gaussians import Gaussians, skin_gaussians
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.rendering.splatting import plan_buffers, render

MOVING = ("turns", "shifts", "zooms", "headings", "places", "bends")
"""Unknowns that photographs move; the avatar's shape is its own."""
LEAST_NOISE = 0.02
"""Of colours in [0, 1]: avatars are no better."""
CUT = 3.0
"""Standard deviations of a colour at which it is an outlier."""
ROOM = 1.5
"""Buffers of the renderer, as multiples of what the first pictures need: people move little."""


@dataclasses.dataclass(frozen=True)
class PhotometricConfig:
    """Static settings. steps: of L-BFGS. independent: colours that all pixels of a view count for, since neighbours err
    together.
    """

    steps: int = 15
    independent: float = 100.0


@dataclasses.dataclass(frozen=True, eq=False)
class Likeness:
    """An avatar of a capture, the views that it is compared with, at the network's size, and how like them it is.

    psnr: dB, of all views. noise: standard deviation of its colours where the person is, in [0, 1]. splatting: how it is
    drawn, with buffers that have room.
    """

    avatar: Avatar
    views: SubjectViews
    psnr: float
    noise: float
    splatting: SplatConfig


def likeness(variables: PyTree, network: HumanGSConfig, capture: Capture) -> Likeness:
    """Reconstruct the person of a capture and compare with its photographs."""
    avatar = reconstruct(variables, network, capture)
    views = standardize(capture, network.conventions.image_size)
    splatting = _roomy(avatar, views)
    off = np.asarray(_draw(avatar, views.rotations, views.translations, views.cameras, splatting) - views.images)
    person = np.asarray(views.masks) > MASK_THRESHOLD
    noise = DEVIATION * float(np.median(np.abs(off[person]))) if person.any() else 1.0
    return Likeness(avatar, views, float(decibels(jnp.mean(jnp.square(off)))), max(noise, LEAST_NOISE), splatting)


def by_colors(
    likeness: Likeness, capture: Capture, config: PhotometricConfig, rounds: RoundConfig
) -> tuple[Capture, Outcome]:
    """A capture with cameras and poses moved so that its avatar is more like the photographs, and what the solver did."""
    start = start_of(capture, likeness.views.cameras, rounds)
    still = nothing_moved(start)
    noise = jnp.asarray(likeness.noise)
    moving, outcome = _polish(
        likeness.avatar, likeness.views, start, still, noise, rounds.spreads, config, likeness.splatting
    )
    return moved_capture(capture, start, rounds.spreads, replace(still, **moving)), outcome


def _roomy(avatar, views):
    """Buffers for the most demanding view, and for what people may move."""
    needs = [
        plan_buffers(
            _skinned(avatar, rotations, translation), views.cameras[i], SPLAT_PRESETS[avatar.rendering], margin=ROOM
        )
        for i, (rotations, translation) in enumerate(zip(views.rotations, views.translations, strict=True))
    ]
    most = lambda name: max(getattr(config, name) for config in needs)
    return dataclasses.replace(needs[0], max_pairs=most("max_pairs"), max_rows=most("max_rows"))


@jax.jit
def _skinned(avatar, rotations, translation) -> Gaussians:
    transforms = joint_transforms(avatar.rest_joints, avatar.parents, rotations, translation)
    return skin_gaussians(avatar.gaussians, blend_transforms(avatar.skinning_weights, transforms), avatar.skinning)


@functools.partial(jax.jit, static_argnames="splatting")
def _draw(avatar, rotations, translations, cameras, splatting):
    """(v, h, w, 3) pictures, one after the other: all at once would hold the buffers of all."""

    def one(view):
        own_rotations, translation, camera = view
        return render(_skinned(avatar, own_rotations, translation), camera, splatting).rgb

    return jax.lax.map(one, (rotations, translations, cameras))


@functools.partial(jax.jit, static_argnames=("spreads", "config", "splatting"))
def _polish(avatar, views, start, still, noise, spreads, config, splatting):
    """The unknowns in `MOVING`, and what the solver did."""
    share = config.independent / (jnp.sum(views.masks, axis=(1, 2)) + 1)

    def residuals(moving):
        unknowns = replace(still, **moving)
        K, cam_from_world = moved_cameras(start, spreads, unknowns)
        poses = moved_poses(start, spreads, unknowns)
        turns, _ = root_turns(start, spreads, unknowns, start.betas, poses)
        # a person who turns looks like cameras that turn about them
        matrices = jnp.matmul(cam_from_world, turns[start.frame], precision=EXACT)
        cameras = replace(views.cameras, K=K, cam_from_world=matrices)
        drawn = _draw(avatar, poses.rotations[start.frame], poses.translation[start.frame], cameras, splatting)
        off = robust((drawn - views.images) / noise, CUT)
        return {"colors": jnp.sqrt(share)[:, None, None, None] * off, "prior": moving}

    return minimise(residuals, {name: getattr(still, name) for name in MOVING}, config.steps)
