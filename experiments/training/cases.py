"""What the benchmark and the cost page of training share: settings, abstract and real arguments of a training step."""

import dataclasses
from pathlib import Path
from typing import Any


def settings(preset: str, size: int, views: int, targets: int, batch: int = 1) -> Any:
    """The `TrainConfig` of a preset for photographs and targets of `size` pixels, numbers of views as given."""
    from humangs_jax.data.loader import ViewSampling
    from humangs_jax.training.config import PRESETS

    if preset not in PRESETS:
        raise SystemExit(f"unknown preset {preset}: expected one of {', '.join(PRESETS)}")
    config = PRESETS[preset]()
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, image_size=size),
        views=ViewSampling(input_counts=(views,), target_count=targets),
        target_size=size,
        batch_size=batch,
        stages=(),
    )


def with_model(config: Any, **fields: Any) -> Any:
    """With other fields of the network; `transformer` and `attention` take dictionaries of fields of theirs."""
    model = config.model
    transformer = dataclasses.replace(model.transformer, **fields.pop("transformer", {}))
    attention = dataclasses.replace(transformer.attention, **fields.pop("attention", {}))
    transformer = dataclasses.replace(transformer, attention=attention)
    return dataclasses.replace(config, model=dataclasses.replace(model, transformer=transformer, **fields))


def abstract_batch(config: Any, joints: int, betas: int) -> Any:
    """Shapes of an `Example` with a leading axis of `config.batch_size` subjects."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.data.loader import Example
    from humangs_jax.data.views import SubjectViews
    from humangs_jax.geometry.camera import Camera

    def views(count: int, size: int):
        camera = lambda K, pose: Camera(K, pose, size, size)
        return SubjectViews(
            images=jnp.zeros((count, size, size, 3)),
            masks=jnp.zeros((count, size, size)),
            cameras=jax.vmap(camera)(jnp.zeros((count, 3, 3)), jnp.zeros((count, 4, 4))),
            rotations=jnp.zeros((count, joints, 3)),
            translations=jnp.zeros((count, 3)),
            betas=jnp.zeros(betas),
        )

    def example(_):
        inputs = views(config.views.input_counts[0], config.model.image_size)
        return Example(inputs, views(config.views.target_count, config.target_size))

    return jax.eval_shape(jax.vmap(example), jax.ShapeDtypeStruct((config.batch_size,), jnp.int32))


def random_networks(config: Any) -> Any:
    """`LossNetworks` with made-up weights for the losses that need some: they cost what the real ones cost."""
    import jax

    from humangs_jax.objectives.backbones import random_weights
    from humangs_jax.objectives.loss_networks import LossNetworks
    from humangs_jax.objectives.lpips import BACKBONES, Lpips
    from humangs_jax.objectives.perceptual import VGG19, Vgg19

    key = jax.random.key(0)
    perceptual = Vgg19(random_weights(key, VGG19)) if config.loss.perceptual else None
    lpips = None
    if config.loss.lpips:
        from humangs_jax.objectives.backbones import channels

        slices = BACKBONES["vgg"]
        heads = [jax.numpy.full(count, 1.0 / count) for count in channels(slices)]
        lpips = Lpips(random_weights(key, slices), tuple(heads), "vgg")
    return LossNetworks(perceptual, lpips)


def written_subject(folder: Path, config: Any, body: Any, seed: int = 0) -> Path:
    """The capture folder of a synthetic person with as many views as an example takes; made if it is not there."""
    from humangs_jax.people import write_training_subject

    views = config.views.input_counts[0] + config.views.target_count
    path = folder / f"{config.model.image_size}_{views}"
    if not path.exists():
        write_training_subject(path, seed, body=body, image_size=config.model.image_size, poses=1, views=views)
    return path
