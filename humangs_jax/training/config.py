"""Everything that a training run depends on, composed of the configurations beside what they configure."""

import dataclasses
from typing import Literal

from humangs_jax.data.loader import ViewSampling
from humangs_jax.models import presets
from humangs_jax.models.humangs import HumanGSConfig
from humangs_jax.rendering.mesh_rasterizer import RasterConfig
from humangs_jax.rendering.splatting import SplatConfig
from humangs_jax.training.optimizer import OptimizerConfig


@dataclasses.dataclass(frozen=True)
class LossConfig:
    """Weights of the terms, each a mean over pixels or vertices and over the targets.

    squared: error of the colours. structural: structural dissimilarity at `structural_scales` sizes. silhouette:
    squared error of the coverage. tightness: squared tight offsets, normalised units.
    random_background: share of the targets that are seen against one random colour instead of white, so that Gaussians
    as white as the background are told from none at all.
    """

    squared: float = 1.0
    structural: float = 0.2
    structural_scales: int = 3
    silhouette: float = 0.1
    tightness: float = 0.1
    random_background: float = 0.5


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One run. Photographs enter at `model.image_size` pixels, targets are learnt at `target_size`.

    steps: of the whole run, which the learning rate ends with. batch_size: subjects per step. batching: subjects of a
    batch one after the other ("loop", least memory, best on a CPU, statistics per subject) or all at once ("vmap",
    statistics shared). ema_decay: of the averaged parameters, None for none.
    log_every, validate_every, checkpoint_every: steps. keep_checkpoints: the newest so many, besides the best.
    """

    model: HumanGSConfig = dataclasses.field(default_factory=presets.small)
    views: ViewSampling = dataclasses.field(default_factory=ViewSampling)
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    splat: SplatConfig = dataclasses.field(default_factory=SplatConfig)
    raster: RasterConfig = dataclasses.field(default_factory=RasterConfig)
    target_size: int = 128
    steps: int = 20_000
    batch_size: int = 1
    batching: Literal["loop", "vmap"] = "loop"
    ema_decay: float | None = None
    seed: int = 0
    log_every: int = 20
    validate_every: int = 1000
    checkpoint_every: int = 1000
    keep_checkpoints: int = 2


def small() -> TrainConfig:
    """The shipped weights: some hours on a CPU of two cores."""
    return TrainConfig(
        views=ViewSampling(target_count=2, mixed_pose_share=0.2),
        optimizer=OptimizerConfig(warmup_steps=200),
        target_size=256,
        steps=8000,
        ema_decay=0.998,
        validate_every=500,
        checkpoint_every=500,
    )


def tiny() -> TrainConfig:
    """Seconds, for tests."""
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


PRESETS = {"small": small, "tiny": tiny}
