"""Validation: the same views of the same unseen people every time, with the running statistics, as numbers and as a sheet.

Several processes share the people; every process ends up with the means over all of them.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Array, Float
from humangs_jax.data.loading import Example, ViewSampling
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.losses.metrics import masked_psnr, psnr, semi_transparent, similarity_map
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.parts import Variables
from humangs_jax.training.config import TrainConfig, compiled_for
from humangs_jax.training.forward import predict
from humangs_jax.training.sources import MakeSource

METRICS = ("psnr", "psnr_fg", "ssim", "semi_transparent", "dropped_tokens", "overflow")


def validation_examples(make_source: MakeSource, config: TrainConfig, count: int) -> list[Example]:
    """This process's examples of the first `count` subjects: inputs evenly spaced and of one pose, as many as in the
    middle one of the training's counts; targets as large as the inputs.
    """
    counts = sorted(config.views.input_counts)
    views = ViewSampling(
        input_counts=(counts[len(counts) // 2],),
        target_count=config.views.target_count,
        jitter=0.0,
        scattered_share=0.0,
        mixed_pose_share=0.0,
    )
    without = dataclasses.replace(config.loss, depth=0.0)  # no loss is computed, so no depths are needed
    size = config.model.conventions.image_size
    source = make_source(dataclasses.replace(config, views=views, loss=without, target_size=size))
    own = range(jax.process_index(), min(count, len(source)), jax.process_count())
    return [jax.tree.map(jnp.asarray, source.example(0, i, views.input_counts[0])) for i in own]


@functools.partial(jax.jit, static_argnames="config")
def evaluate(
    variables: Variables, body: BodyModel, example: Example, config: TrainConfig, networks: LossNetworks = NO_NETWORKS
) -> tuple[Float[Array, "v h w 3"], dict[str, Float[Array, ""]]]:
    """The images of one example's targets and their mean psnr, psnr_fg (both dB), ssim, semi-transparent foreground, and lpips
    if its network is there. semi-transparent foreground is NaN where the network draws pixels: there is no alpha.
    """
    drawn, outputs = predict(variables, body, example, config)
    images, masks = example.targets.images, example.targets.masks
    shown = jnp.clip(drawn.rendering.rgb, 0, 1)
    metrics = {
        "psnr": jnp.mean(jax.vmap(psnr)(shown, images)),
        "psnr_fg": jnp.mean(jax.vmap(masked_psnr)(shown, images, masks)),
        "ssim": jnp.mean(jax.vmap(similarity_map)(shown, images)),
        "semi_transparent": jnp.full((), jnp.nan)
        if drawn.opacities is None
        else jnp.mean(jax.vmap(semi_transparent)(drawn.rendering.alpha, masks)),
        "dropped_tokens": outputs.dropped_tokens.astype(shown.dtype),
        "overflow": jnp.sum(drawn.rendering.overflow).astype(shown.dtype),
    }
    if networks.lpips is not None:
        compare = functools.partial(lpips, networks.lpips)
        metrics["lpips"] = jnp.mean(jax.lax.map(lambda pair: compare(*pair), (shown, images)))
    return shown, metrics


def validate(
    variables: Variables,
    body: BodyModel,
    examples: Sequence[Example],
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
) -> tuple[dict[str, float], list[np.ndarray]]:
    """Means over the examples of all processes, and the images of this process's. All arguments are local arrays."""
    # buffers of another size than in training: as many pairs as the larger images may need
    unlimited = dataclasses.replace(config.splat, max_pairs=None, max_rows=None)
    config = dataclasses.replace(compiled_for(config), splat=unlimited)
    images, rows = [], []
    for example in examples:
        shown, metrics = evaluate(variables, body, example, config, networks)
        images.append(np.asarray(shown))
        rows.append({name: float(value) for name, value in metrics.items()})
    names = METRICS if networks.lpips is None else (*METRICS, "lpips")
    return _means(names, rows), images


def _means(names: Sequence[str], rows: list[dict[str, float]]) -> dict[str, float]:
    """Over all processes, some of which may have no rows."""
    own = np.asarray([[row[name] for name in names] for row in rows]).reshape(-1, len(names))
    totals = np.append(own.sum(axis=0), len(own))
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        totals = multihost_utils.process_allgather(totals.astype(np.float32)).sum(axis=0)
    return {name: float(total / totals[-1]) for name, total in zip(names, totals[:-1], strict=True)}


def sheet(examples: Sequence[Example], images: Sequence[np.ndarray]) -> Float[np.ndarray, "h w 3"]:
    """A row per example: its inputs, then each target beside what the network shows of it."""
    rows = []
    for example, shown in zip(examples, images, strict=True):
        targets = np.asarray(example.targets.images)
        pairs = [image for pair in zip(targets, shown, strict=True) for image in pair]
        rows.append(np.concatenate([*np.asarray(example.inputs.images), *pairs], axis=1))
    return np.concatenate(rows)
