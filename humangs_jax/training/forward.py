"""Runs the network on an example, and validates it.

The network makes canonical Gaussians from the input photos. The Gaussians are posed and drawn for
each target. A validation draws the same views of the same unseen people every time, and batch norms
use the running statistics. It gives metrics, and images for a sheet. Several processes divide the
people among them, and every process gets the means over all people.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.reconstruct import completed_avatar
from humangs_jax.body.model import BodyModel, BodyPose
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.loops import over
from humangs_jax.core.pytree import replace
from humangs_jax.data.loading import Example, Source, ViewSampling
from humangs_jax.data.views import SubjectViews, prepare_inputs
from humangs_jax.losses.loss_networks import NO_NETWORKS, LossNetworks
from humangs_jax.losses.losses import (
    masked_psnr,
    psnr,
    semi_transparent,
    similarity_map,
)
from humangs_jax.losses.perceptual import lpips
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.humangs import apply_humangs, part_variables
from humangs_jax.network.parts import Drawn, HumanGSOutputs, Parameters, Variables, tap
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import render
from humangs_jax.training.config import TrainConfig, compiled_for
from humangs_jax.training.sources import SourceFactory

RASTERIZED = ("posed_vertices", "canonical_vertices", "position_maps", "depth_maps")
"""Fields of the inputs that a diagnosis watches as the stage "position maps". `prepare_inputs`
computes them from the body.
"""


def reconstruct_example(
    variables: Variables,
    body: BodyModel,
    inputs: SubjectViews,
    config: TrainConfig,
    train: bool = False,
    axis_name: str | tuple[str, ...] | None = None,
) -> tuple[HumanGSOutputs, Parameters]:
    """Returns the canonical Gaussians of one subject and the batch statistics, see
    `apply_humangs`.
    """
    model = token_share(config, len(inputs.images))
    prepared = jax.lax.stop_gradient(prepare_inputs(body, inputs, model))
    computed = tap("position maps", lambda: {name: getattr(prepared, name) for name in RASTERIZED})
    return apply_humangs(variables, replace(prepared, **computed), model, train, axis_name)


def token_share(config: TrainConfig, views: int) -> HumanGSConfig:
    """Returns the network's configuration with the token capacity for a step of `views` photos.

    The configured capacity is for m photos, the largest of `views.input_counts`. For n < m photos
    it is multiplied by (n + 1) / (m + 1), not by n / m, because one photo may show more of a person
    than the others. For n > m photos it is multiplied by n / m.
    """
    most, capacity = max(config.views.input_counts), config.model.runtime.token_capacity
    if views == most:
        return config.model
    if views < most:
        share = (views + 1) / (most + 1)
    else:
        share = views / most
    return config.model.with_runtime(token_capacity=math.ceil(capacity * share))


def draw_targets(
    variables: Variables,
    outputs: HumanGSOutputs,
    body: BodyModel,
    inputs: SubjectViews,
    targets: SubjectViews,
    backgrounds: Float[Array, "v 3"],
    config: TrainConfig,
) -> Drawn:
    """Returns images of the Gaussians, in the pose and from the camera of every target.

    inputs: the photos from which the Gaussians were made.
    """
    driver = config.model.architecture.driver
    if driver is not None:
        own = part_variables(variables, "driver")
        given = body, inputs, targets, backgrounds, config
        return tap("driver", lambda outputs: driver.draw(own, outputs, *given), outputs)

    def pose(outputs):
        avatar = completed_avatar(outputs, body, inputs, config.model)
        return over(
            lambda pose: skin(avatar, BodyPose(*pose)), (targets.rotations, targets.translations)
        )

    posed = tap("posed Gaussians", pose, outputs)
    drawn = draw_posed(posed, targets, backgrounds, config)
    return drawn._replace(
        opacities=outputs.gaussians.opacities, tight_offsets=outputs.tight_offsets
    )


def draw_posed(
    posed: Gaussians, targets: SubjectViews, backgrounds: Float[Array, "v 3"], config: TrainConfig
) -> Drawn:
    """Returns images of Gaussians, one for each target, from the target's camera.
    posed: the Gaussians in the pose of each target, with a leading axis v.
    """
    splat = dataclasses.replace(config.splat, distortion=bool(config.loss.distortion))

    def draw(posed):
        def one(target):
            posed, camera, background = target
            return render(posed, camera, splat, background)

        pixels = targets.cameras.width * targets.cameras.height
        return Drawn(over(one, (posed, targets.cameras, backgrounds), pixels))

    return tap("images", draw, posed)


def white_backgrounds(targets: SubjectViews) -> Float[Array, "v 3"]:
    """Returns a white background for each target, (v, 3)."""
    return jnp.ones((*targets.translations.shape[:-1], 3), targets.images.dtype)


def predict(
    variables: Variables, body: BodyModel, example: Example, config: TrainConfig
) -> tuple[Drawn, HumanGSOutputs]:
    """Returns the trained network's images of an example's targets, on white, and its Gaussians."""
    outputs, _ = reconstruct_example(variables, body, example.inputs, config)
    white = white_backgrounds(example.targets)
    return draw_targets(
        variables, outputs, body, example.inputs, example.targets, white, config
    ), outputs


# Validation
# --------------------------------------------------------------------------------------------------


METRICS = ("psnr", "psnr_fg", "ssim", "semi_transparent", "dropped_tokens", "overflow")


def validation_examples(
    make_source: SourceFactory, config: TrainConfig, count: int
) -> list[Example]:
    """Returns this process's examples of the first `count` subjects, with the views of
    `as_validated`.
    """
    source = make_source(as_validated(config))
    own = range(jax.process_index(), min(count, len(source)), jax.process_count())
    return [jax.tree.map(jnp.asarray, source.example(0, i, source.input_counts[0])) for i in own]


def as_validated(config: TrainConfig) -> TrainConfig:
    """Returns the configuration with the views of validations.

    Inputs stand evenly around the subject and show one pose. Their number is the middle one of the
    sorted `views.input_counts`. Targets are as large as the inputs.
    """
    counts = sorted(config.views.input_counts)
    views = ViewSampling(
        input_counts=(counts[len(counts) // 2],),
        target_count=config.views.target_count,
        jitter=0.0,
        scattered_share=0.0,
        mixed_pose_share=0.0,
    )
    # no loss is computed, so no depths are needed
    without = dataclasses.replace(config.loss, depth=0.0)
    return dataclasses.replace(
        config, views=views, loss=without, target_size=config.model.conventions.image_size
    )


def compared_as(base: TrainConfig, make_source: SourceFactory) -> SourceFactory:
    """Returns a function that makes a source of the people of `make_source`, for validations of
    variants of the run `base`.

    All variants get the photos and targets that `base` is validated on. Only the size of the input
    photos follows the variant's configuration.
    """
    own = as_validated(base.at(base.steps - 1))

    def make(config: TrainConfig) -> Source:
        return make_source(
            dataclasses.replace(config, views=own.views, target_size=own.target_size)
        )

    return make


@functools.partial(jax.jit, static_argnames="config")
def evaluate(
    variables: Variables,
    body: BodyModel,
    example: Example,
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
) -> tuple[Float[Array, "v h w 3"], dict[str, Float[Array, ""]]]:
    """Returns the images of one example's targets, and their metrics.

    Means over the targets are psnr and psnr_fg (both dB), ssim, semi_transparent, and lpips if its
    network is there. Counts are dropped_tokens, and overflow of all targets. semi_transparent is
    NaN if the network draws pixels instead of Gaussians, because there is no alpha then.
    """
    drawn, outputs = predict(variables, body, example, config)
    images, masks = example.targets.images, example.targets.masks
    shown = jnp.clip(drawn.rendering.rgb, 0, 1)
    if drawn.opacities is None:
        fog = jnp.full((), jnp.nan)
    else:
        fog = jnp.mean(jax.vmap(semi_transparent)(drawn.rendering.alpha, masks))
    metrics = {
        "psnr": jnp.mean(jax.vmap(psnr)(shown, images)),
        "psnr_fg": jnp.mean(jax.vmap(masked_psnr)(shown, images, masks)),
        "ssim": jnp.mean(jax.vmap(similarity_map)(shown, images)),
        "semi_transparent": fog,
        "dropped_tokens": outputs.dropped_tokens.astype(shown.dtype),
        "overflow": jnp.sum(drawn.rendering.overflow).astype(shown.dtype),
    }
    if networks.lpips is not None:
        compare = functools.partial(lpips, networks.lpips)
        pixels = images.shape[1] * images.shape[2]
        each = over(lambda pair: compare(*pair), (shown, images), pixels)
        metrics["lpips"] = jnp.mean(each)
    return shown, metrics


def validate(
    variables: Variables,
    body: BodyModel,
    examples: Sequence[Example],
    config: TrainConfig,
    networks: LossNetworks = NO_NETWORKS,
) -> tuple[dict[str, float], list[np.ndarray]]:
    """Returns the means of the metrics over the examples of all processes, and the images of this
    process's examples.

    All arguments are local arrays.
    """
    # buffers of another size than in training: as many pairs as the larger images may need
    unlimited = dataclasses.replace(config.splat, max_pairs=None, max_rows=None)
    config = dataclasses.replace(compiled_for(config), splat=unlimited)
    images, rows = [], []
    for example in examples:
        shown, metrics = evaluate(variables, body, example, config, networks)
        images.append(np.asarray(shown))
        rows.append({name: float(value) for name, value in metrics.items()})
    names = METRICS
    if networks.lpips is not None:
        names = *METRICS, "lpips"
    return _means(names, rows), images


def _means(names: Sequence[str], rows: list[dict[str, float]]) -> dict[str, float]:
    """Returns the means of the metrics over the rows of all processes. Some processes may have no
    rows. If no process has any, the means are NaN.
    """
    own = np.asarray([[row[name] for name in names] for row in rows]).reshape(-1, len(names))
    totals = np.append(own.sum(axis=0), len(own))
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        totals = multihost_utils.process_allgather(totals.astype(np.float32)).sum(axis=0)
    return {name: float(total / totals[-1]) for name, total in zip(names, totals[:-1], strict=True)}


def sheet(examples: Sequence[Example], images: Sequence[np.ndarray]) -> Float[np.ndarray, "h w 3"]:
    """Returns an image with a row per example: its inputs, then each target beside the network's
    image of it.
    """
    rows = []
    for example, shown in zip(examples, images, strict=True):
        targets = np.asarray(example.targets.images)
        pairs = [image for pair in zip(targets, shown, strict=True) for image in pair]
        rows.append(np.concatenate([*np.asarray(example.inputs.images), *pairs], axis=1))
    return np.concatenate(rows)
