"""Settings of refinement: its length, its loss, the rate of each parameter, and what holds changes
back.
"""

import dataclasses
from typing import Annotated, Literal

from humangs_jax.core.configuration import (
    Count,
    Iterations,
    PhotoSide,
    Range,
    RefineSteps,
    Seed,
    Share,
    Spread,
    Steps,
    Weight,
    configuration,
    knob,
)

MEASURED = "refinement.md"
ITERATIONS = 4
"""The number of iterations with which the learned update was trained. docs/tradeoff.md says what
each gains.
"""

HEAD = ("head", "jaw", "eye")
"""Parts of the names of the head's joints."""
HEAD_STEPS = 500
"""Default number of steps on the head. They take 4 s of one core, for photos of 512 pixels."""


@configuration
class LearningRates:
    """Change of each parameter in a step of Adam, in the space in which it is optimised; `refine`
    lowers all by a cosine and, after iterations, in long runs (`RefineConfig.full_steps`).
    """

    means: Spread = 2e-4
    """The rate of the places in the T-pose, metres."""
    quats: Spread = 2e-3
    """The rate of quaternions that start at unit length."""
    log_scales: Spread = 1e-2
    """The rate of the logarithms of the scales."""
    opacity_logits: Spread = 3e-2
    """The rate of the logits of the opacities."""
    color_logits: Spread = 4e-2
    """The rate of the logits of the colors."""


@configuration
class RefineConfig:
    """How `refine` fits an avatar to its photos."""

    iterations: Iterations = knob(
        ITERATIONS,
        cost="blur without them",
        gain="0.25 to 0.5 s each with 4 photos",
        measured=MEASURED,
    )
    """Iterations of the learned update (see `learned.py`), before the first step. 0: none."""
    steps: RefineSteps | None = knob(
        None, cost="blur at few", gain="time in proportion", measured=MEASURED
    )
    """Limit of the optimizer's steps. None: no limit.

    0: iterations alone, which are always finished.
    """
    seconds: Annotated[float, Range(1e-6, 1e6)] | None = knob(
        5.0, cost="blur at few", gain="time", measured=MEASURED
    )
    """Limit of the run without compilation; with `steps`, what ends earlier counts. None: no limit.
    It becomes a number of steps before the first step, by the time that a few take; that number,
    `Refinement.planned`, repeats the run exactly."""
    head_steps: RefineSteps = knob(
        HEAD_STEPS,
        cost="time in proportion",
        gain="detail of faces",
        measured="benchmarks/quality.md",
    )
    """Steps on the head alone afterwards, where photos have 512 pixels or more, and calibrated
    cameras or a pose each, and `seconds` is None or `steps` 0; 0: none. They move the Gaussians of
    the head by crops of the photos around it, and hold back what grows beyond the masks (see
    `head.py`)."""
    region: tuple[str, ...] = HEAD
    """The region of interest of `head_steps`: parts of the names of its joints; `("left_wrist",
    "left_index")` is a hand.
    """
    image_size: PhotoSide | None = knob(
        None, cost="detail of the photos", gain="time of a step", measured=MEASURED
    )
    """Photos whose longer side is larger are reduced to it, pixels. None: photos as they are."""
    structural: Weight = 0.2
    """Weight of the structural dissimilarity beside the L1 distance of colors."""
    silhouette: Weight = 0.1
    """Weight of |alpha - mask| beside the L1 distance of colors."""
    optimizer: Literal["adam", "adabelief", "lion", "rmsprop", "sgd"] = "adam"
    """What scales the gradients, by its name in optax. The rates suit the steps of Adam."""
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)
    """How far a step moves each parameter."""
    full_steps: Steps = 100
    """After iterations, a run of more steps than this takes smaller ones in proportion: Gaussians
    that move further overfit to the photos."""
    visible: Annotated[float, Range(1e-9, 1e6)] = 0.02
    """A Gaussian whose largest weight on a pixel of the photos is at least this moves at the full
    rate, others more slowly; what no photo shows stays."""
    held_out: Share = 0.05
    """With fewer photos than `search.HELD_OUT_PHOTOS` the share of the pixels, in square blocks,
    that no iteration and no step sees: the state with the highest PSNR on them is returned. With as
    many or more, any share above 0 holds one whole photo out of a trial, a third of the steps,
    which decides by its PSNR whether the iterations and how many of the steps are kept; then all
    photos are fitted. 0: nothing is held out, and the last state is returned."""
    checks: Count = 5
    """How often the PSNR is measured."""
    seed: Seed = 0
    """The seed of the order of the photos and of the blocks."""

    def __post_init__(self):
        """Check that the settings fit together.

        Raises: ValueError naming the settings that do not.
        """
        if self.steps is None and self.seconds is None:
            raise ValueError(
                "RefineConfig: expected steps, seconds or both; without either a run would not end"
            )
        if self.iterations == self.steps == self.head_steps == 0:
            raise ValueError(
                "RefineConfig: iterations 0, steps 0, head_steps 0: expected one of them above 0"
            )
        if not self.held_out < 1:
            raise ValueError(f"RefineConfig.held_out {self.held_out:g}: expected less than 1")


ITERATIONS_ALONE = RefineConfig(steps=0, seconds=None, image_size=512)
"""Refinement where nothing is asked for: some seconds, however large the photos."""
