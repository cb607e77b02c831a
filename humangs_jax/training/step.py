"""One step of training: a pure function of state, batch and body."""

import functools
from typing import cast

import jax
import jax.numpy as jnp
import optax

from humangs_jax.array_types import Array, Float, Key, PyTree, Scalar
from humangs_jax.body.model import BodyModel
from humangs_jax.data.loader import Example
from humangs_jax.data.views import SubjectViews
from humangs_jax.models.humangs import HumanGSOutputs
from humangs_jax.objectives.losses import squared_error, tightness
from humangs_jax.objectives.metrics import psnr
from humangs_jax.objectives.ssim import multiscale_structural_dissimilarity
from humangs_jax.pytree import replace
from humangs_jax.rendering.splatting import Rendering
from humangs_jax.training.config import LossConfig, TrainConfig
from humangs_jax.training.forward import draw_targets, reconstruct_example
from humangs_jax.training.optimizer import GuardState, learning_rate, make_optimizer
from humangs_jax.training.state import TrainState

SUBJECTS = "subjects"
"""Name of the vmap axis over a batch, along which batch statistics are shared."""

Metrics = dict[str, Scalar]


def random_backgrounds(key: Key, count: int, share: float) -> Float[Array, "v 3"]:
    """One colour per target: random for about `share` of them, white for the rest."""
    color_key, choice_key = jax.random.split(key)
    colors = jax.random.uniform(color_key, (count, 3))
    return jnp.where(jax.random.bernoulli(choice_key, share, (count, 1)), colors, 1.0)


def change_background(targets: SubjectViews, backgrounds: Float[Array, "v 3"]) -> Float[Array, "v h w 3"]:
    """The target photographs, which are on white, as they would look on other colours."""
    uncovered = 1 - targets.masks[..., None]
    return targets.images + uncovered * (backgrounds[:, None, None, :] - 1)


def loss_terms(
    drawn: Rendering,
    outputs: HumanGSOutputs,
    images: Float[Array, "v h w 3"],
    targets: SubjectViews,
    config: LossConfig,
) -> Metrics:
    """The unweighted terms of `LossConfig` by name, for pictures drawn on the backgrounds of `images`."""
    dissimilarity = functools.partial(multiscale_structural_dissimilarity, scales=config.structural_scales)
    return {
        "squared": jnp.mean(squared_error(drawn.rgb, images)),
        "structural": jnp.mean(jax.vmap(dissimilarity)(drawn.rgb, images)),
        "silhouette": jnp.mean(squared_error(drawn.alpha, targets.masks)),
        "tightness": jnp.mean(tightness(outputs.tight_offsets)),
    }


def subject_loss(
    params: PyTree,
    batch_stats: PyTree,
    body: BodyModel,
    example: Example,
    key: Key,
    config: TrainConfig,
    axis_name: str | None = None,
) -> tuple[Scalar, tuple[PyTree, Metrics]]:
    """Loss of one subject, with the updated batch statistics and what is worth knowing."""
    variables = {"params": params, "batch_stats": batch_stats}
    outputs, batch_stats = reconstruct_example(variables, body, example.inputs, config, train=True, axis_name=axis_name)
    targets = example.targets
    backgrounds = random_backgrounds(key, len(targets.translations), config.loss.random_background)
    backgrounds = backgrounds.astype(targets.images.dtype)
    images = change_background(targets, backgrounds)
    drawn = draw_targets(outputs, body, targets, backgrounds, config)
    terms = loss_terms(drawn, outputs, images, targets, config.loss)
    loss = sum(getattr(config.loss, name) * term for name, term in terms.items())
    metrics = {
        **terms,
        "psnr": jnp.mean(jax.vmap(psnr)(drawn.rgb, images)),
        "dropped_tokens": outputs.dropped_tokens,
        "dropped_reads": outputs.dropped_reads,
        "overflow": jnp.sum(drawn.overflow),
    }
    return loss, (batch_stats, metrics)


def batch_gradients(
    state: TrainState, body: BodyModel, batch: Example, keys: Array, config: TrainConfig
) -> tuple[Scalar, PyTree, PyTree, Metrics]:
    """(loss, gradients, batch_stats, metrics) of a batch: means over its subjects, but sums of what was dropped.

    keys: one per subject.
    """
    if config.batching == "vmap":

        def batch_loss(params):
            def one(example, key):
                return subject_loss(params, state.batch_stats, body, example, key, config, SUBJECTS)

            losses, aux = jax.vmap(one, axis_name=SUBJECTS)(batch, keys)
            return jnp.mean(losses), aux

        (loss, (batch_stats, metrics)), gradients = jax.value_and_grad(batch_loss, has_aux=True)(state.params)
    else:
        value_and_gradient = jax.value_and_grad(subject_loss, has_aux=True)

        def accumulate(total, arguments):
            example, key = arguments
            (loss, aux), gradients = value_and_gradient(state.params, state.batch_stats, body, example, key, config)
            return jax.tree.map(lambda a, x: a + x / keys.shape[0], total, gradients), (loss, aux)

        zeros = jax.tree.map(jnp.zeros_like, state.params)
        gradients, (losses, (batch_stats, metrics)) = jax.lax.scan(accumulate, zeros, (batch, keys))
        loss = jnp.mean(losses)
    batch_stats = jax.tree.map(lambda x: jnp.mean(x, axis=0), batch_stats)
    counts = {name: jnp.sum(metrics.pop(name)) for name in ("dropped_tokens", "dropped_reads", "overflow")}
    return loss, gradients, batch_stats, {name: jnp.mean(x) for name, x in metrics.items()} | counts


@functools.partial(jax.jit, static_argnames="config", donate_argnames="state")
def train_step(state: TrainState, batch: Example, body: BodyModel, config: TrainConfig) -> tuple[TrainState, Metrics]:
    """The state after one more step, and metrics: loss and its terms, psnr, grad_norm, learning_rate, skipped (steps
    so far), dropped_tokens, dropped_reads and overflow (what did not fit its buffers in this step).

    Arguments: state is given away (donated). batch: an `Example` with a leading axis of subjects. body: decimated
    already. config: static.
    """
    key = jax.random.fold_in(jax.random.key(config.seed), state.step)
    keys = jax.random.split(key, batch.inputs.betas.shape[0])
    loss, gradients, batch_stats, metrics = batch_gradients(state, body, batch, keys, config)
    optimizer = make_optimizer(config.optimizer, config.steps)
    updates, opt_state = optimizer.update(gradients, state.opt_state, state.params, value=loss)
    opt_state = cast(GuardState, opt_state)
    good = opt_state.skipped == state.opt_state.skipped
    params = optax.apply_updates(state.params, updates)
    ema_params = state.ema_params
    if ema_params is not None:
        assert config.ema_decay is not None  # or there would be no average
        # the average starts short, so that it forgets the initial parameters
        decay = jnp.minimum(config.ema_decay, (1 + state.step) / (10 + state.step))
        ema_params = optax.incremental_update(params, ema_params, 1 - decay)
    rate = learning_rate(config.optimizer, config.steps)
    metrics |= {
        "loss": loss,
        "grad_norm": opt_state.norm,
        "learning_rate": jnp.asarray(rate(state.step - state.opt_state.skipped)),
        "skipped": opt_state.skipped,
    }
    return replace(
        state,
        step=state.step + 1,
        params=params,
        batch_stats=jax.tree.map(lambda new, old: jnp.where(good, new, old), batch_stats, state.batch_stats),
        opt_state=opt_state,
        ema_params=ema_params,
    ), metrics
