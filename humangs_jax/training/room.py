"""Measures the room for (splat, tile) pairs that a step of training needs for its targets.

By default a traced call takes room for the most demanding person. This is five times what the
targets of the shipped network need, and all of it would be sorted, gathered and kept. Pairs that do
not fit are counted in every step (`overflow`). The loop then logs it, and doubles the room if it
was measured.
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
"""Factor by which the room exceeds the measured need. Other people and poses need more, and
Gaussians change while they are trained.
"""
WORTH = 1 << 16
"""The need is measured if a traced call would have room for at least this many pairs. With fewer
pairs a step takes milliseconds, and compiling a program that measures is not worth it.
"""
MEASURED = 4
"""Number of subjects of a batch that are measured, one after the other."""


def usual_room(config: TrainConfig, body: BodyModel) -> int:
    """Returns the number of pairs that each target of a step has room for if nothing was measured
    and `max_pairs` is None. Returns 0 if the network has a driver. body: the body that carries the
    Gaussians.
    """
    parts = config.model.architecture
    if parts.driver is not None:
        return 0
    count = len(body.template) * getattr(parts.decoder, "gaussians_per_vertex", 1)
    return default_pairs(count, config.target_size, config.target_size, config.splat.tile_size)


def with_measured_room(
    config: TrainConfig, variables: Variables, body: BodyModel, batch: Example
) -> TrainConfig:
    """Returns the configuration of a stage with room for `MARGIN` times what the most demanding
    target of the first `MEASURED` subjects of a batch needs.

    The configuration is returned unchanged if it sets `max_pairs`, if `usual_room` is below
    `WORTH`, or if the measured room is no smaller than `usual_room`.
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
    """Returns the configuration of a stage with twice the room. If that is `usual_room` or more,
    `max_pairs` and `max_rows` become None.
    """
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
    """Returns the numbers of (splat, row of tiles) pairs and of (splat, tile) pairs that the most
    demanding target of a batch needs with these variables. Each number is the maximum over all
    targets.
    """
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
