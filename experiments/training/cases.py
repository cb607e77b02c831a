"""What the benchmark and the cost page of training share: settings, arguments of a training step, and the step's program."""

import dataclasses
import time
from pathlib import Path
from typing import Any

from experiments.costs import costs_of


def settings(preset: str, size: int, views: int, targets: int, batch: int = 1) -> Any:
    """The `TrainConfig` of a preset for photos and targets of `size` pixels, numbers of views as given."""
    from humangs_jax.data.loader import ViewSampling
    from humangs_jax.training.config import PRESETS

    if preset not in PRESETS:
        raise SystemExit(f"unknown preset {preset}: expected one of {', '.join(PRESETS)}")
    config = PRESETS[preset]()
    return dataclasses.replace(
        config,
        model=config.model.with_conventions(image_size=size),
        views=ViewSampling(input_counts=(views,), target_count=targets),
        target_size=size,
        batch_size=batch,
        stages=(),
    )


def with_model(config: Any, upsampler: Any = None, **runtime: Any) -> Any:
    """With other fields of the network's `Runtime`, or with an upsampler in proportion to the network."""
    model = config.model.with_runtime(**runtime)
    if upsampler is not None:
        encoder, reader = model.architecture.encoder, model.architecture.reader
        model = model.with_parts(
            encoder=dataclasses.replace(encoder, upsampler=upsampler),
            reader=dataclasses.replace(reader, output_width=encoder.transformer.width),
        )
    return dataclasses.replace(config, model=model)


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
        inputs = views(config.views.input_counts[0], config.model.conventions.image_size)
        return Example(inputs, views(config.views.target_count, config.target_size))

    return jax.eval_shape(jax.vmap(example), jax.ShapeDtypeStruct((config.batch_size,), jnp.int32))


def random_weights(key: Any, slices: Any) -> Any:
    """Random weights of a network of `losses.perceptual`."""
    import jax
    import jax.numpy as jnp

    from humangs_jax.losses.perceptual import Convolution, convolutions

    def draw(layer, key):
        shape = (layer.size, layer.size, layer.inputs, layer.outputs)
        scale = (2 / (layer.size**2 * layer.inputs)) ** 0.5
        return Convolution(scale * jax.random.normal(key, shape), jnp.zeros(layer.outputs))

    layers = list(convolutions(slices))
    return {layer.name: draw(layer, key) for layer, key in zip(layers, jax.random.split(key, len(layers)), strict=True)}


def random_networks(config: Any) -> Any:
    """`LossNetworks` with made-up weights for the losses that need some: they cost what the real ones cost."""
    import jax

    from humangs_jax.losses.loss_networks import LossNetworks
    from humangs_jax.losses.perceptual import BACKBONES, VGG19, Lpips, Vgg19, channels

    key = jax.random.key(0)
    perceptual = Vgg19(random_weights(key, VGG19)) if config.loss.perceptual else None
    lpips = None
    if config.loss.lpips:
        slices = BACKBONES["vgg"]
        heads = [jax.numpy.full(count, 1.0 / count) for count in channels(slices)]
        lpips = Lpips(random_weights(key, slices), tuple(heads), "vgg")
    return LossNetworks(perceptual, lpips)


def written_subject(folder: Path, config: Any, body: Any, seed: int = 0) -> Path:
    """The capture folder of a synthetic person with as many views as an example takes; made if it is not there."""
    from humangs_jax.people.writer import Layout, write_person

    views = config.views.input_counts[0] + config.views.target_count
    path = folder / f"{config.model.conventions.image_size}_{views}"
    if not path.exists():
        write_person(path, seed, body, Layout(config.model.conventions.image_size, views=views))
    return path


CASES = {
    "small 256": ("small", 256, 4, 2),
    "published 256": ("published", 256, 4, 4),
    "published 512": ("published", 512, 4, 4),
    "tiny 32": ("tiny", 32, 2, 2),
}
"""Preset, size of photos and targets, input views, targets. The last one is for tests."""


class Case:
    """Everything that a step of one configuration needs; `state` is what the last step gave."""

    def __init__(self, preset: str, size: int, views: int, targets: int, dtype: str, batch: int = 1):
        import jax

        from humangs_jax.body.library import load_body

        if dtype == "auto":
            dtype = "float32" if jax.default_backend() == "cpu" else "bfloat16"
        self.config = with_model(settings(preset, size, views, targets, batch), dtype=dtype)
        self.program: Any = None
        self.full_body = load_body()
        self.networks = random_networks(self.config)

    def prepare(self, folder: Path) -> "Case":
        """Makes the person, reads the batch, draws the weights."""
        import jax

        from humangs_jax.data.loader import Loader
        from humangs_jax.data.views import gaussian_body

        config = self.config
        self.capture = written_subject(folder, config, self.full_body)
        self.loader = Loader(self.source(), config.batch_size)
        self.body = gaussian_body(self.full_body, config.model)
        self.batch = jax.block_until_ready(self.loader.batch_at(0))
        self.fit()
        self.state = fresh_state(config)
        return self

    def source(self) -> Any:
        """Examples of the person; nothing is read yet."""
        from humangs_jax.data.loader import CaptureCache, CaptureSource

        cache = CaptureCache([self.capture], self.full_body)
        return CaptureSource(
            cache, self.config.views, self.config.model.conventions.image_size, self.config.target_size
        )

    def fit(self) -> None:
        """Room for the foreground tokens of this person, as a run would have."""
        import jax

        from humangs_jax.data.views import prepare_inputs

        if self.config.model.tokens == "foreground":
            from experiments.reconstruction.cases import foreground

            inputs = jax.jit(prepare_inputs, static_argnames="config")(
                self.body, first(self.batch).inputs, self.config.model
            )
            self.config = with_model(
                self.config, token_capacity=foreground(inputs, self.config.model)[0].runtime.token_capacity
            )

    def compiled(self, options: dict[str, Any] | None) -> tuple[Any, float, Any]:
        """(the step as a program, CPU seconds that it took to trace and compile, its `Costs`)."""
        import jax

        from humangs_jax.training.step import jitted_train_step

        step = jax.jit(
            jitted_train_step().__wrapped__,
            static_argnames=("config", "mesh"),
            donate_argnames="state",
            compiler_options=options,
        )
        start = time.process_time()
        arguments = self.state, self.batch, self.body, self.networks
        traced = step.trace(*arguments, config=self.config, mesh=None)
        program = traced.lower().compile()
        return program, time.process_time() - start, costs_of(traced)

    def run(self, program: Any) -> None:
        """One step."""
        import jax

        self.state, metrics = program(self.state, self.batch, self.body, self.networks)
        self.metrics = {name: float(value) for name, value in jax.device_get(metrics).items()}


def fresh_state(config: Any) -> Any:
    """A training state of random weights."""
    from experiments.reconstruction.cases import random_variables
    from humangs_jax.training.state import init_state

    return init_state(config, random_variables(config.model))


def first(batch: Any) -> Any:
    """Its first subject."""
    import jax

    return jax.tree.map(lambda x: x[0], batch)
