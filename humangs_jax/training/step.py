"""One step of training, as a pure function of state, batch and body, on one device or on a mesh of
devices.
"""

import functools
from collections.abc import Callable
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh, PartitionSpec

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Array, Float, Int, Key, PyTree, Scalar, Shaped
from humangs_jax.core.draws import uniform_by_name
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import inexact_leaves, replace
from humangs_jax.data.loading import Example
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.losses.losses import loss_terms, psnr
from humangs_jax.network.parts import tap
from humangs_jax.training import sharding
from humangs_jax.training.augmentation import augment
from humangs_jax.training.config import TrainConfig, compiled_for
from humangs_jax.training.forward import draw_targets, reconstruct_example
from humangs_jax.training.state import GuardState, TrainState, learning_rate, make_optimizer

SUBJECTS = "subjects"
"""Name of the vmap axis over the subjects that a device computes at once. Batch statistics are
shared along this axis.
"""
COUNTS = ("dropped_tokens", "overflow")
"""Metrics that are sums over a batch; all others are means."""
AUGMENTED = 1
"""Number that `jax.random.fold_in` adds to a subject's key, to make the key of its augmentation."""

Seed = Shaped[Array, " n"] | Shaped[np.ndarray, " n"]
"""The numbers that `seed_numbers` returns."""
Metrics = dict[str, Shaped[Array, ""]]
Gradients = tuple[Scalar, PyTree, PyTree, Metrics]
"""Loss, gradients, updated batch statistics, metrics."""


def random_backgrounds(key: Key, count: int, share: float) -> Float[Array, "v 3"]:
    """Returns one color per target, (v, 3): random for about `share` of the targets, white for the
    rest.
    """
    numbers = uniform_by_name(key, {"colors": (count, 3), "choices": (count, 1)})
    return jnp.where(numbers["choices"] < share, numbers["colors"], 1.0)


def change_background(
    images: Float[Array, "v h w 3"], masks: Float[Array, "v h w"], backgrounds: Float[Array, "v 3"]
) -> Float[Array, "v h w 3"]:
    """Returns photos with a white background as they would look on backgrounds of other colors."""
    return images + (1 - masks[..., None]) * (backgrounds[:, None, None, :] - 1)


@functools.cache
def seed_numbers(seed: int) -> Shaped[np.ndarray, " n"]:
    """Returns the key of a run as numbers on the host. They are an argument of a step's program, so
    that runs of all seeds share the program.
    """
    with jax.ensure_compile_time_eval():  # may be asked while a step is traced
        return np.asarray(jax.random.key_data(jax.random.key(seed)))


def subject_keys(seed: Seed, step: Int[Array, ""], count: int) -> Array:
    """Returns one key per subject of a step. seed: from `seed_numbers`."""
    return jax.random.split(
        jax.random.fold_in(jax.random.wrap_key_data(jnp.asarray(seed)), step), count
    )


def subject_loss(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    example: Example,
    key: Key,
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
    axis_name: str | tuple[str, ...] | None = None,
) -> tuple[Scalar, tuple[PyTree, Metrics]]:
    """Returns the loss of one subject, its updated batch statistics, and metrics."""
    # the avatar of the inputs, in training mode
    if config.augmentation.share:
        example = augment(jax.random.fold_in(key, AUGMENTED), example, body, config.augmentation)
    variables, targets = {"params": params, "batch_stats": batch_stats}, example.targets
    outputs, batch_stats = reconstruct_example(
        variables, body, example.inputs, config, True, axis_name
    )
    # targets on random backgrounds, so that coverage is learned; drivers without it stay on white
    driver = config.model.architecture.driver
    colored = 0.0
    if driver is None or driver.has_alpha:
        colored = config.loss.random_background
    backgrounds = random_backgrounds(key, len(targets.translations), colored)
    backgrounds = backgrounds.astype(targets.images.dtype)
    images = change_background(targets.images, targets.masks, backgrounds)
    drawn = draw_targets(variables, outputs, body, example.inputs, targets, backgrounds, config)

    def compare(drawn):
        return loss_terms(drawn, images, targets.masks, targets.depths, config.loss, networks)

    # the terms of the loss, and what the log shows
    terms = tap("loss", compare, drawn, apart=True)
    metrics = {
        **terms,
        "psnr": jnp.mean(jax.vmap(psnr)(drawn.rendering.rgb, images)),
        "dropped_tokens": outputs.dropped_tokens,
        "overflow": jnp.sum(drawn.rendering.overflow),
    }
    return sum(getattr(config.loss, name) * term for name, term in terms.items()), (
        batch_stats,
        metrics,
    )


def local_gradients(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    batch: Example,
    keys: Array,
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
    axes: tuple[str, ...] = (),
) -> Gradients:
    """Returns loss, gradients, batch statistics and metrics of one device's subjects. They are
    means over the subjects, except for the sums `COUNTS`.

    `config.microbatch_size` subjects are computed at once, and gradients accumulate over the rest.
    keys: one per subject. axes: axes of the mesh, along which batch statistics are shared, too.
    Raises: ValueError if the number of subjects is no multiple of the microbatch.
    """
    count, size = len(keys), config.microbatch_size
    if count % size:
        raise ValueError(
            f"{count} subjects per device cannot be divided into microbatches of {size}"
        )

    def microbatch_loss(params, batch, keys):
        names = (SUBJECTS, *axes) if size > 1 else axes

        def one(example, key):
            return subject_loss(
                params, batch_stats, body, example, key, config, networks, names or None
            )

        if size == 1:  # without vmap: a CPU runs the loops of a single subject faster

            def first(tree):
                return jax.tree.map(lambda x: x[0], tree)

            loss, aux = one(first(batch), keys[0])
            return loss, jax.tree.map(lambda x: x[None], (loss, aux))
        losses, aux = jax.vmap(one, axis_name=SUBJECTS)(batch, keys)
        return jnp.mean(losses), (losses, aux)

    def accumulate(total, microbatch):
        (_, aux), gradients = jax.value_and_grad(microbatch_loss, has_aux=True)(params, *microbatch)
        return jax.tree.map(lambda a, x: a + x * (size / count), total, gradients), aux

    # one microbatch after the other, with gradients in one place
    microbatches = jax.tree.map(lambda x: x.reshape(-1, size, *x.shape[1:]), (batch, keys))
    zeros = jax.tree.map(jnp.zeros_like, params)
    gradients, (losses, (updated, metrics)) = jax.lax.scan(accumulate, zeros, microbatches)

    def average(x):
        return jnp.mean(x, axis=(0, 1))

    totals = {name: jnp.sum(metrics.pop(name)) for name in COUNTS}
    metrics = {name: average(x) for name, x in metrics.items()} | totals
    return average(losses), gradients, jax.tree.map(average, updated), metrics


def batch_gradients(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    batch: Example,
    keys: Array,
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
    mesh: Mesh | None = None,
) -> Gradients:
    """Returns the `local_gradients` of a whole batch. Each device of a mesh takes its share of the
    subjects, and gets its part of the gradients, see `sharding.partition`.
    """
    if mesh is None:
        return local_gradients(params, batch_stats, body, batch, keys, config, networks)
    specs = sharding.partition(params, mesh)
    everywhere, divided = PartitionSpec(), PartitionSpec(sharding.AXES)

    def one_device(params, batch_stats, body, batch, keys, networks):
        params = sharding.gather(params, specs)
        loss, gradients, updated, metrics = local_gradients(
            params, batch_stats, body, batch, keys, config, networks, sharding.AXES
        )
        reduce = {name: jax.lax.psum if name in COUNTS else jax.lax.pmean for name in metrics}
        metrics = {name: reduce[name](x, sharding.AXES) for name, x in metrics.items()}
        loss, updated = jax.lax.pmean((loss, updated), sharding.AXES)
        return loss, sharding.mean_parts(gradients, specs, mesh), updated, metrics

    return jax.shard_map(
        one_device,
        mesh=mesh,
        in_specs=(specs, everywhere, everywhere, divided, divided, everywhere),
        out_specs=(everywhere, specs, everywhere, everywhere),
        # the renderer's loops start from constants, which the check would want marked as differing
        # between devices
        check_vma=False,
    )(params, batch_stats, body, batch, keys, networks)


def train_step(
    state: TrainState,
    batch: Example,
    body: BodyModel,
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
    mesh: Mesh | None = None,
) -> tuple[TrainState, Metrics]:
    """Returns the state after one more step, and metrics. It calls `update`, compiled. The given
    state is donated, so it cannot be used afterwards. Raises: as `update`.
    """
    return compiled_update()(
        state, batch, body, networks, seed_numbers(config.seed), compiled_for(config), mesh
    )


@functools.cache
def compiled_update() -> Callable[
    [TrainState, Example, BodyModel, LossNetworks, Seed, TrainConfig, Mesh | None],
    tuple[TrainState, Metrics],
]:
    """Returns `update`, compiled for the default backend. All runs whose configurations differ only
    in `HOST_SETTINGS` share one program.
    """
    static, options = ("config", "mesh"), compiler_options()
    return jax.jit(
        update, static_argnames=static, donate_argnames="state", compiler_options=options
    )


def update(
    state: TrainState,
    batch: Example,
    body: BodyModel,
    networks: LossNetworks,
    seed: Seed,
    config: TrainConfig,
    mesh: Mesh | None = None,
) -> tuple[TrainState, Metrics]:
    """Returns the state after one more step, and metrics.

    Metrics are the loss and its terms, psnr, grad_norm and learning_rate. skipped counts the steps
    so far that were skipped, nonfinite those whose loss or gradient was not finite. dropped_tokens
    and overflow count the patches and the (splat, tile) pairs without room in this step.

    Arguments: batch: an `Example` with a leading axis of subjects. body: the body that carries the
    Gaussians. networks: networks of the losses that need one. seed: from `seed_numbers`. config:
    static, of one stage. mesh: static; with a mesh, state, batch, body and networks lie on it, see
    `sharding`. Raises: ValueError if parameters have fewer than 32 bits, if the subjects of a
    device cannot be divided into microbatches, or if the network of a loss is missing.
    """
    for name, leaf in inexact_leaves(state.params):
        if jnp.finfo(leaf.dtype).bits < 32:
            raise ValueError(
                f"train_step: params.{name}: expected float32, got {leaf.dtype}: small updates"
                " would be rounded away; to compute in bfloat16, keep the parameters and set"
                ' model.runtime.dtype to "bfloat16"'
            )
    # the gradient of the batch
    keys = subject_keys(seed, state.step, batch.inputs.betas.shape[0])
    loss, gradients, batch_stats, metrics = batch_gradients(
        state.params, state.batch_stats, body, batch, keys, config, networks, mesh
    )
    # the step of the optimizer; one that is skipped leaves parameters and statistics as they are
    optimizer = make_optimizer(config.optimizer, config.steps, divided=mesh is not None)
    updates, opt_state = optimizer.update(gradients, state.opt_state, state.params, value=loss)
    opt_state = cast(GuardState, opt_state)
    good = opt_state.skipped == state.opt_state.skipped
    params, ema_params = optax.apply_updates(state.params, updates), state.ema_params
    if ema_params is not None and config.ema_decay is not None:
        # the average starts short, so that it forgets the initial parameters
        decay = jnp.minimum(config.ema_decay, (1 + state.step) / (10 + state.step))
        ema_params = optax.incremental_update(params, ema_params, 1 - decay)
    rate = learning_rate(config.optimizer, config.steps)
    metrics |= {
        "loss": loss,
        "grad_norm": opt_state.norm,
        "learning_rate": jnp.asarray(rate(state.step - state.opt_state.skipped)),
        "skipped": opt_state.skipped,
        "nonfinite": opt_state.nonfinite,
    }
    state = replace(
        state,
        step=state.step + 1,
        params=params,
        batch_stats=jax.tree.map(
            lambda new, old: jnp.where(good, new, old), batch_stats, state.batch_stats
        ),
        opt_state=opt_state,
        ema_params=ema_params,
    )
    if mesh is not None:
        state = jax.lax.with_sharding_constraint(state, sharding.state_shardings(state, mesh))
    return state, metrics
