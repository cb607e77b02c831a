"""The configuration of a training run, composed of the configurations of its parts."""

import dataclasses
import itertools
import logging
from pathlib import Path
from typing import Annotated, Literal

from humangs_jax.core.configuration import (
    CapacityOrAuto,
    Count,
    InputSide,
    Presets,
    Range,
    Seed,
    Share,
    Side,
    Spread,
    Steps,
    configuration,
    knob,
    vary,
)
from humangs_jax.data.loading import ViewSampling
from humangs_jax.io.reading import read_configuration
from humangs_jax.losses.loss_networks import LossNetworks
from humangs_jax.losses.losses import LossConfig
from humangs_jax.network import presets
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.rendering.splat_config import SPLAT_PRESETS, SplatConfig
from humangs_jax.training.augmentation import Augmentation

logger = logging.getLogger(__name__)
Decay = Annotated[float, Range(0, 0.999_999)]
"""Decay of a running mean. With a decay of 1 the mean would never change."""
HOST_SETTINGS = {
    "seed": 0,
    "log_every": 1,
    "validate_every": 1,
    "checkpoint_every": 1,
    "keep_checkpoints": 1,
}
"""Settings of a run that no compiled program depends on, each with the value that programs are
compiled for.
"""


@configuration
class OptimizerConfig:
    """The optimizer, see `state.make_optimizer`."""

    name: Literal["adamw", "nadamw", "lamb", "lion"] = "adamw"
    """The name of the optimizer in `optax`."""
    learning_rate: Spread = 4e-4
    """Peak of the learning rate. The rate rises from 0 to the peak in `warmup_steps`, then falls by
    a cosine to 0 at the end of the run.
    """
    warmup_steps: Annotated[int, Range(0, 100_000_000)] = 3000
    """Steps over which the learning rate rises from 0 to its peak."""
    betas: tuple[Decay, Decay] = (0.9, 0.95)
    """The first two arguments of the optimizer in `optax` after the learning rate. For "adamw",
    "nadamw" and "lamb" they are the decays of the running means of gradients and of their squares.
    """
    weight_decay: Spread = 0.05
    """Weight decay of parameters with two or more axes (matrices, textures, the class token)."""
    clip_norm: Annotated[float, Range(0, 1e12)] = 1.0
    """Gradients whose norm is larger than this are scaled down to this norm."""
    skip_norm: Annotated[float, Range(0, 1e12)] = 100.0
    """Steps whose gradient has a larger norm than this are skipped."""


@configuration
class Phase:
    """A stage of a run: the settings that change at step `start`.

    A setting holds until a later stage changes it. None: this stage does not change the setting.
    """

    start: Steps
    """The step at which the stage begins."""
    image_size: InputSide | None = None
    """Side of the input photos, pixels."""
    token_capacity: CapacityOrAuto | None = None
    """Number of tokens that the network has room for; 0 for as many as may be needed."""
    target_size: Side | None = None
    """Side of the targets, pixels."""
    batch_size: Count | None = None
    """Subjects per step."""


STAGED = {
    "image_size": "model.conventions.image_size",
    "token_capacity": "model.runtime.token_capacity",
    "target_size": "target_size",
    "batch_size": "batch_size",
}
"""For each field of a stage, the path of the setting in a `TrainConfig` that it changes."""


@configuration
class TrainConfig:
    """The configuration of one run. Photos enter at `model.conventions.image_size` pixels.

    Raises: ValueError if `model.runtime.dtype` is float16, if stages are not in order or begin
    after the run's last step, or if the sizes of a stage do not fit together.
    """

    model: HumanGSConfig = dataclasses.field(default_factory=presets.small)
    """The network."""
    views: ViewSampling = ViewSampling()
    """How the views of an example are chosen."""
    loss: LossConfig = LossConfig()
    """The weights of the terms of the loss."""
    augmentation: Augmentation = Augmentation()
    """How examples are changed at random."""
    optimizer: OptimizerConfig = OptimizerConfig()
    """The optimizer and its learning rate."""
    splat: SplatConfig = SplatConfig()
    """How targets are drawn. If `max_pairs` is None, a run on one device may measure how many pairs
    the first targets of a stage need, and make room for twice that number. `training.room` says
    when.
    """
    target_size: Side = 128
    """Side of the targets, pixels."""
    steps: Steps = 20_000
    """Number of steps of the whole run. The learning rate falls to 0 at the last of them."""
    batch_size: Count = 1
    """Subjects per step."""
    microbatch_size: Count = knob(
        1,
        cost="memory in proportion",
        gain="fewer, larger steps on accelerators",
        measured="performance.md",
    )
    """Number of subjects that a device computes at once. Gradients accumulate over the rest of its
    subjects. 1 needs least memory and suits CPUs. The upsampler's batch statistics are of the
    subjects that all devices compute at once.
    """
    stages: tuple[Phase, ...] = ()
    """The stages in the order of their starts, for instance one of larger photos for the last
    steps. Before the first stage the other fields of this configuration hold.
    """
    ema_decay: Share | None = None
    """The decay of the averaged parameters. None: no averaged parameters."""
    seed: Seed = 0
    """The seed of the first parameters, the order of the people and all other random numbers."""
    log_every: Steps = 20
    """Steps between two lines of the log."""
    validate_every: Steps = 1000
    """Steps between two validations."""
    checkpoint_every: Steps = 1000
    """Steps between two checkpoints."""
    keep_checkpoints: Steps = 2
    """Number of newest checkpoints to keep, besides the best one."""

    def __post_init__(self):
        if self.model.runtime.dtype == "float16":
            raise ValueError(
                "model.runtime.dtype float16: gradients underflow; expected float32 or bfloat16 for"
                " training"
            )
        starts = [stage.start for stage in self.stages]
        if starts != sorted(set(starts)) or (starts and starts[-1] >= self.steps):
            raise ValueError(
                f"stages start at {starts}: expected ascending steps between 1 and {self.steps - 1}"
            )
        for start in starts:
            self.at(start)

    def at(self, step: int) -> "TrainConfig":
        """Returns the configuration in force at a step, without stages.

        Raises: ValueError if its sizes do not fit together.
        """
        config = dataclasses.replace(self, stages=())
        for stage in self.stages:
            if stage.start <= step:
                changes = {path: getattr(stage, name) for name, path in STAGED.items()}
                config = vary(
                    config, {path: value for path, value in changes.items() if value is not None}
                )
        return config

    def spans(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Returns the ranges (first, end) of steps in which the configuration stays the same, in
        order.

        A range contains `first`, but not `end`. Together the ranges contain all steps from `start`
        to `stop` - 1.
        """
        inner = [stage.start for stage in self.stages if start < stage.start < stop]
        if start < stop:
            return list(itertools.pairwise([start, *inner, stop]))
        return []

    def examples_before(self, step: int) -> int:
        """Returns the number of subjects that all steps before this one have taken."""
        return sum((end - first) * self.at(first).batch_size for first, end in self.spans(0, step))


def compiled_for(config: TrainConfig) -> TrainConfig:
    """Returns the configuration with the values of `HOST_SETTINGS`. Runs that differ only in these
    settings share their compiled programs.
    """
    return dataclasses.replace(config, **HOST_SETTINGS)


def small() -> TrainConfig:
    """Returns the configuration for the shipped network. A run takes some hours on a CPU of two
    cores.

    The shipped weights were trained with other losses (assets/weights.md).
    """
    return TrainConfig(
        views=ViewSampling(input_counts=(1, 2, 4, 4, 4, 6), target_count=3, mixed_pose_share=0.2),
        loss=LossConfig(
            squared=0.5,
            absolute=0.15,
            silhouette=0.0,
            boundary=0.1,
            depth=0.3,
            distortion=1.0,
            opaque=0.001,
        ),
        augmentation=Augmentation(share=0.4),
        optimizer=OptimizerConfig(learning_rate=5e-4, warmup_steps=100),
        target_size=256,
        steps=20_000,
        ema_decay=0.998,
        validate_every=500,
        checkpoint_every=500,
    )


def published() -> TrainConfig:
    """Returns the configuration of the release: 100,000 steps at 512 pixels, 4 input and 4 target
    views. Its losses need VGG-19 and LPIPS, see `LossConfig`.

    The release has 2 subjects per device and does not say how many devices. Four are assumed here.
    """
    return TrainConfig(
        model=presets.published(),
        splat=SPLAT_PRESETS["inria"],
        views=ViewSampling(target_count=4, rule="window"),
        loss=LossConfig(
            structural=0.0, silhouette=0.0, perceptual=1.0, lpips=0.1, random_background=0.0
        ),
        target_size=512,
        steps=100_000,
        batch_size=8,
    )


def paper() -> TrainConfig:
    """Returns the configuration of the paper: 60,000 steps at 256 pixels with 8 subjects, then
    10,000 at 512 pixels with 4. Its losses need VGG-19.
    """
    return dataclasses.replace(
        published(),
        model=presets.paper().with_conventions(image_size=256),
        splat=SplatConfig(),
        loss=dataclasses.replace(published().loss, lpips=0.0),
        target_size=256,
        steps=70_000,
        stages=(Phase(start=60_000, image_size=512, target_size=512, batch_size=4),),
    )


def tiny() -> TrainConfig:
    """Returns a configuration for tests, which trains in seconds."""
    return TrainConfig(
        model=presets.tiny(),
        views=ViewSampling(input_counts=(2,), target_count=2),
        loss=LossConfig(structural_scales=1),
        optimizer=OptimizerConfig(learning_rate=8e-3, warmup_steps=0),
        target_size=16,
        steps=60,
        log_every=1,
        validate_every=2,
        checkpoint_every=2,
    )


PRESETS = Presets({"published": published, "paper": paper, "small": small, "tiny": tiny})


def read_config(preset_or_path: str | Path) -> TrainConfig:
    """Returns the configuration of a preset, or of a JSON file such as the config.json of a run.

    Raises: FileNotFoundError if there is neither a preset nor a file of that name; ValueError,
    which names the file, if it holds no such configuration. If a field is wrong, the error names
    the field, too.
    """
    if str(preset_or_path) in PRESETS:
        return PRESETS[str(preset_or_path)]()
    path = Path(preset_or_path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{path}: neither a file nor one of the presets {', '.join(PRESETS)}"
        )
    return read_configuration(TrainConfig, path)


def missing_networks(config: TrainConfig, networks: LossNetworks) -> list[str]:
    """Returns the names of the losses whose weight is not 0 and whose network is missing."""
    needing = ("perceptual", "vgg16", "lpips")
    return [
        name for name in needing if getattr(config.loss, name) and getattr(networks, name) is None
    ]


def fitting_losses(config: TrainConfig, networks: LossNetworks) -> TrainConfig:
    """Returns the configuration without the losses whose networks are missing. A warning names
    them.

    Structural dissimilarity replaces them. Its weight is raised to the default of `LossConfig`,
    unless the weight is larger already.
    """
    missing = missing_networks(config, networks)
    if not missing:
        return config
    structural = max(config.loss.structural, LossConfig().structural)
    replaced = (
        "no network is given for the loss %s, so it is replaced by structural dissimilarity"
        " (weight %g)"
    )
    logger.warning(replaced, " and ".join(missing), structural)
    loss = dataclasses.replace(config.loss, **dict.fromkeys(missing, 0.0), structural=structural)
    return dataclasses.replace(config, loss=loss)
