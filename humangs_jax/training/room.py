"""Room for (splat, tile) pairs in a step of training: by what its targets need.

A traced call would take room for the most demanding person, five times what the targets of the
shipped network need, and sort, gather and keep all of it. What does not fit is counted in every
step (`overflow`), reported by the loop, and gets twice the room from there on.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.reconstruct import completed_avatar
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Array, Int
from humangs_jax.core.progress import stage
from humangs_jax.data.loading import Example
from humangs_jax.network.parts import Variables
from humangs_jax.rendering.buffers import default_pairs, needed_by, round_up
from humangs_jax.training.config import TrainConfig, compiled_for
from humangs_jax.training.forward import reconstruct_example

MARGIN = 2.0
"""Room over the need that was measured: other people and poses need more, and Gaussians change
while they are trained.
"""
WORTH = 1 << 16
"""Pairs of a traced call from which on a program that measures the need is worth its compilation:
below, a step is over in milliseconds.
"""
MEASURED = 4
"""Subjects of a batch that are measured, one after the other."""


def usual_room(config: TrainConfig, body: BodyModel) -> int:
    """Pairs for which a step has room where nothing was measured; 0 where the driver draws pixels
    and no Gaussians. body: the one that carries the Gaussians.
    """
    parts = config.model.architecture
    if parts.driver is not None:
        return 0
    count = len(body.template) * getattr(parts.decoder, "gaussians_per_vertex", 1)
    return default_pairs(count, config.target_size, config.target_size, config.splat.tile_size)


def with_measured_room(
    config: TrainConfig, variables: Variables, body: BodyModel, batch: Example
) -> TrainConfig:
    """The configuration of a stage with room for `MARGIN` times what the targets of a batch need.

    It stays as it is where it says how much room there is, or where that saves nothing.
    """
    usual = usual_room(config, body)
    if config.splat.max_pairs is not None or usual < WORTH:
        return config
    some = jax.tree.map(lambda x: x[:MEASURED], batch)
    with stage("measuring the targets"):
        needed = needed_room(variables, body, some, compiled_for(config))
    rows, pairs = (round_up(int(MARGIN * most)) for most in needed)
    if pairs >= usual:
        return config
    return dataclasses.replace(
        config, splat=dataclasses.replace(config.splat, max_rows=rows, max_pairs=pairs)
    )


def with_twice_the_room(config: TrainConfig, body: BodyModel) -> TrainConfig:
    """The configuration of a stage after something did not fit; never more than is usual."""
    splat = config.splat
    pairs = 2 * (splat.max_pairs or 0)
    if pairs >= usual_room(config, body):
        return dataclasses.replace(
            config, splat=dataclasses.replace(splat, max_rows=None, max_pairs=None)
        )
    rows = 2 * (splat.max_rows or pairs)
    return dataclasses.replace(
        config, splat=dataclasses.replace(splat, max_rows=rows, max_pairs=pairs)
    )


@functools.partial(jax.jit, static_argnames="config")
def needed_room(
    variables: Variables, body: BodyModel, batch: Example, config: TrainConfig
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Most rows and most pairs that any target of a batch needs now."""
    size = jnp.asarray([config.target_size, config.target_size])

    def of(example: Example) -> tuple[Int[Array, " v"], Int[Array, " v"]]:
        inputs, targets = example.inputs, example.targets
        outputs, _ = reconstruct_example(variables, body, inputs, config)
        avatar = completed_avatar(outputs, body, inputs, config.model)

        def in_target(target):
            rotations, translation, camera = target
            posed = skin(avatar, BodyPose(rotations, translation))
            return needed_by(posed, camera, size, config.splat)

        return jax.lax.map(in_target, (targets.rotations, targets.translations, targets.cameras))

    rows, pairs = jax.lax.map(of, batch)
    return jnp.max(rows), jnp.max(pairs)
