"""Refinement: the Gaussians of an avatar are fitted to its photos, by iterations of a learned update, then by Adam.

The learned update moves what no photo shows, too; Adam leaves it where it is. `refine` is the whole job on the host: it crops the
photos and leaves the rest to a `Run`, which decides by what no step saw how much of all that is kept.
`refine_views` is Adam's part as one pure function of a fixed number of steps, for `jax.jit` and `jax.vmap`.
"""

import dataclasses
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.low_pass import with_low_pass, with_low_pass_of, without_low_pass
from humangs_jax.core.array_types import Array, Float, Int, Scalar
from humangs_jax.core.checks import checked_arguments
from humangs_jax.data.capture import Capture
from humangs_jax.data.exposure import equal_exposure
from humangs_jax.data.views import SubjectViews
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.crops import crop_to_person
from humangs_jax.refinement.objective import (
    Photos,
    avatar_of,
    compare_photos,
    photos_gradient,
    photos_of,
)
from humangs_jax.refinement.operations import planned
from humangs_jax.refinement.parameters import RefineState, init_state, parameters_of, update
from humangs_jax.refinement.report import Refinement
from humangs_jax.refinement.run import Run
from humangs_jax.rendering.splat_config import SplatConfig

jax.tree_util.register_static(RefineConfig)  # here: its own module is imported by the command line, without JAX


@checked_arguments
def refine(
    avatar: Avatar,
    capture: Capture,
    config: RefineConfig | None = None,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    mesh: Mesh | None = None,
    progress: bool = False,
    watch: Callable[[Avatar], None] | None = None,
) -> Avatar:
    """The avatar, fitted to the photos of a capture, or the avatar itself where that makes it no better.

    Arguments and errors as of `refine_with_report`.
    """
    report = refine_with_report(
        avatar, capture, config, seconds=seconds, steps=steps, mesh=mesh, progress=progress, watch=watch
    )
    return report.avatar


@checked_arguments
def refine_with_report(
    avatar: Avatar,
    capture: Capture,
    config: RefineConfig | None = None,
    *,
    seconds: float | None = None,
    steps: int | None = None,
    mesh: Mesh | None = None,
    progress: bool = False,
    watch: Callable[[Avatar], None] | None = None,
) -> Refinement:
    """`refine`, with the number of steps, the seconds and the gain.

    Arguments:
        avatar: of the person in the photos, on the body of the capture. capture: photos with masks, in any poses. seconds, steps:
            the limits, instead of those of the configuration. A number of steps repeats a run exactly on the same machine;
            `Refinement.planned` is that of a run that was limited by its seconds. mesh: of one axis, whose devices share the
            `views_per_step` photos of a step. progress: show a bar. watch: gets the avatar so far after the iterations and at
            each of the `checks`, also in the trial; its time counts.

    Ctrl-C ends the run; the best state until then is returned.

    Views whose mask does not show the person are left out, and exposure is made equal as in `reconstruct`.

    Raises: ValueError if the capture has no view or no masks or no view that shows the person, its poses have another number of
    joints than the avatar, or the devices of the mesh do not divide `views_per_step`.
    """
    config = config or RefineConfig()
    if seconds is not None or steps is not None:
        config = dataclasses.replace(config, seconds=seconds, steps=steps)
    _check(avatar, capture, config, mesh)
    capture = equal_exposure(capture)
    views = crop_to_person(capture, config.image_size)
    start = with_low_pass_of(avatar, views)
    fresh = with_low_pass(without_low_pass(avatar), cast(Array, start.gaussians.low_pass))
    report = Run(start, views, config, mesh, planned(start, views), fresh).go(progress, watch, capture.names)
    return report if report.kept else dataclasses.replace(report, avatar=avatar)


@checked_arguments
def refine_views(
    avatar: Avatar, views: SubjectViews, config: RefineConfig, splat: SplatConfig, steps: int
) -> tuple[Avatar, Int[Array, ""]]:
    """The pure function behind `refine`: `steps` steps of one photo each, in turns, on all their pixels.

    Static: config (its limits, iterations, `full_steps` and held-out pixels are not used), splat (with `max_pairs`, see
    `plan_buffers`), steps. Returns the avatar and the (splat, tile) pairs that did not fit. Batch over people whose arrays have
    the same shapes with `jax.vmap(..., in_axes=(0, 0, None, None, None))`.
    """
    avatar, photos = with_low_pass_of(avatar, views), photos_of(views, jnp.ones(views.masks.shape, bool))
    state = start(avatar, photos, config, splat)

    def one(carry, i):
        state, overflow = carry
        photo = jax.tree.map(lambda x: x[i % len(views.images)][None], photos)
        state, _, missing = refine_step(state, avatar, photo, i / steps, config, splat)
        return (state, overflow + missing), None

    (state, overflow), _ = jax.lax.scan(one, (state, jnp.zeros((), jnp.int32)), jnp.arange(steps))
    return avatar_of(state.parameters, avatar), overflow


def start(avatar: Avatar, photos: Photos, config: RefineConfig, splat: SplatConfig) -> RefineState:
    """The state before the first step. Gaussians that no photo shows get no trust."""
    parameters = parameters_of(avatar.gaussians, len(photos.images), len(avatar.parents))
    return init_state(parameters, compare_photos(parameters, avatar, photos, config, splat).visibility, config)


def refine_step(
    state: RefineState,
    avatar: Avatar,
    photos: Photos,
    progress: Float[Array, ""] | float,
    config: RefineConfig,
    splat: SplatConfig,
) -> tuple[RefineState, Scalar, Int[Array, ""]]:
    """One step on some photos: state, loss before it, overflow. progress: how much of the run is over, in [0, 1]."""
    gradient, loss, overflow = photos_gradient(state.parameters, avatar, photos, config, splat)
    return update(state, gradient, progress, config), loss, overflow


def _check(avatar, capture, config, mesh):
    if capture.view_count == 0:
        raise ValueError("refine: the capture has 0 views; at least one photo is needed")
    if capture.masks is None:
        raise ValueError("refine: the capture has no masks; without them the background would be fitted, too")
    joints = capture.poses.rotations.shape[1]
    if joints != len(avatar.parents):
        raise ValueError(f"refine: the capture's poses have {joints} joints, the avatar has {len(avatar.parents)}")
    if mesh is not None and (len(mesh.axis_names) != 1 or config.views_per_step % mesh.size):
        raise ValueError(
            f"refine: views_per_step {config.views_per_step} cannot be divided among a mesh of {dict(mesh.shape)}"
        )
