"""Validation: the same views of the same unseen people every time, with the running statistics, in numbers and a picture."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.array_types import Array, Float
from humangs_jax.body.model import BodyModel
from humangs_jax.data.images import write_png
from humangs_jax.data.loader import CaptureCache, Example, ExampleSource, ViewSampling
from humangs_jax.models.humangs import Variables
from humangs_jax.objectives.metrics import masked_psnr, psnr
from humangs_jax.objectives.ssim import similarity_map
from humangs_jax.training.config import TrainConfig
from humangs_jax.training.forward import predict


def validation_examples(cache: CaptureCache, config: TrainConfig, count: int) -> list[Example]:
    """Examples of the first `count` subjects: inputs evenly spaced and of one pose, targets as large as the inputs."""
    views = ViewSampling(
        input_counts=config.views.input_counts[:1],
        target_count=config.views.target_count,
        jitter=0.0,
        scattered_share=0.0,
        mixed_pose_share=0.0,
    )
    source = ExampleSource(cache, views, config.model.image_size, config.model.image_size, seed=0)
    return [source.example_at(i, views.input_counts[0]) for i in range(min(count, len(cache)))]


@functools.partial(jax.jit, static_argnames="config")
def evaluate(
    variables: Variables, body: BodyModel, example: Example, config: TrainConfig
) -> tuple[Float[Array, "v h w 3"], dict[str, Float[Array, ""]]]:
    """The pictures of one example's targets and their mean psnr, psnr_mask (both dB) and ssim."""
    drawn, outputs = predict(variables, body, example, config)
    images, masks = example.targets.images, example.targets.masks
    shown = jnp.clip(drawn.rgb, 0, 1)
    return shown, {
        "psnr": jnp.mean(jax.vmap(psnr)(shown, images)),
        "psnr_mask": jnp.mean(jax.vmap(masked_psnr)(shown, images, masks)),
        "ssim": jnp.mean(jax.vmap(similarity_map)(shown, images)),
        "dropped_tokens": outputs.dropped_tokens.astype(shown.dtype),
        "dropped_reads": outputs.dropped_reads.astype(shown.dtype),
        "overflow": jnp.sum(drawn.overflow).astype(shown.dtype),
    }


def validate(
    variables: Variables, body: BodyModel, examples: Sequence[Example], config: TrainConfig
) -> tuple[dict[str, float], list[np.ndarray]]:
    """Means over the examples, and the pictures of each."""
    # buffers of another size than in training: as many pairs as the larger pictures may need
    config = dataclasses.replace(config, splat=dataclasses.replace(config.splat, max_pairs=None, max_rows=None))
    pictures, rows = [], []
    for example in examples:
        shown, metrics = evaluate(variables, body, example, config)
        pictures.append(np.asarray(shown))
        rows.append({name: float(value) for name, value in metrics.items()})
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}, pictures


def write_sheet(path: str | Path, examples: Sequence[Example], pictures: Sequence[np.ndarray]) -> None:
    """A PNG with a row per example: its inputs, then each target beside what the network shows of it."""
    rows = []
    for example, shown in zip(examples, pictures, strict=True):
        targets = np.asarray(example.targets.images)
        pairs = [picture for pair in zip(targets, shown, strict=True) for picture in pair]
        rows.append(np.concatenate([*np.asarray(example.inputs.images), *pairs], axis=1))
    write_png(Path(path), np.concatenate(rows))
