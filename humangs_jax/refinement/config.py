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
each iteration gains.
"""

HEAD = ("head", "jaw", "eye")
"""Words in the names of the head's joints."""
HEAD_STEPS = 500
"""Default number of steps on the head. They take 4 s of one core, for photos of 512 pixels."""


@configuration
class LearningRates:
    """How far a step of Adam moves each parameter, in the space in which the parameter is
    optimised. `refine` lowers all rates by a cosine during a run. In a long run that follows
    iterations, all rates are also multiplied by a factor below 1 (`RefineConfig.full_steps`).
    """

    means: Spread = 2e-4
    """The rate of the Gaussians' centres in the T-pose, metres."""
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

    0: only the iterations and the steps on the head are made, and `seconds` does not limit them.
    """
    seconds: Annotated[float, Range(1e-6, 1e6)] | None = knob(
        5.0, cost="blur at few", gain="time", measured=MEASURED
    )
    """Limit of the run's seconds, without compilation. With `steps`, the lower limit counts. None:
    no limit. A few steps are timed first, to turn the seconds into a number of steps. With this
    number (`Refinement.planned`) as `steps`, `refine` repeats the run.
    """
    head_steps: RefineSteps = knob(
        HEAD_STEPS,
        cost="time in proportion",
        gain="detail of faces",
        measured="benchmarks/quality.md",
    )
    """Number of steps on the head alone, after all others. They compare crops of the photos around
    the head, move only its Gaussians, and penalise alpha beyond the masks (see `head.py`). They are
    made under three conditions. The longer side of the photos has 512 pixels or more, also after
    they are reduced to `image_size`. Cameras are calibrated, or there are several photos and each
    has its pose. `seconds` is None or `steps` is 0.
    """
    region: tuple[str, ...] = HEAD
    """Words in the names of the joints whose Gaussians the `head_steps` move. `("left_wrist",
    "left_index")` is a hand.
    """
    image_size: PhotoSide | None = knob(
        None, cost="detail of the photos", gain="time of a step", measured=MEASURED
    )
    """Largest longer side of the photos, pixels. Larger photos are reduced to it. None: photos keep
    their size. For `head_steps` the photos have another size, which depends on how large the heads
    are.
    """
    structural: Weight = 0.2
    """Weight of the structural dissimilarity beside the L1 distance of colors."""
    silhouette: Weight = 0.1
    """Weight of |alpha - mask| beside the L1 distance of colors."""
    optimizer: Literal["adam", "adabelief", "lion", "rmsprop", "sgd"] = "adam"
    """Name of the method of optax that scales the gradients. The rates suit the steps of Adam."""
    rates: LearningRates = dataclasses.field(default_factory=LearningRates)
    """How far a step moves each parameter."""
    full_steps: Steps = 100
    """Largest number of steps at the full learning rates, after iterations. A longer run has its
    rates multiplied by this number divided by its number of steps. Otherwise Gaussians would move
    further and overfit to the photos.
    """
    visible: Annotated[float, Range(1e-9, 1e6)] = 0.02
    """A Gaussian moves at the full rate if its largest weight on any pixel of the photos is at
    least this. If the weight is smaller, the rate is lower in proportion. Gaussians that no photo
    shows stay.
    """
    held_out: Share = 0.05
    """With fewer photos than `search.HELD_OUT_PHOTOS`: share of the pixels, in square blocks, that
    no iteration and no step sees. The state with the highest PSNR on these pixels is kept.

    With that many photos or more, any share above 0 has the same effect. Each trial leaves out one
    whole photo, and all trials together take a third of the steps. The PSNR on that photo decides
    whether the iterations are kept, and how many of the steps. Then the photos are fitted, without
    one that contradicts the others. 0: nothing is held out. Iterations are kept if they lower the
    loss, and the last of the steps is kept.
    """
    checks: Count = 5
    """How many times the PSNR is measured during a run of steps."""
    seed: Seed = 0
    """The seed of the order of the photos and of the blocks."""

    def __post_init__(self):
        """Checks that the settings fit together.

        Raises: ValueError, which names the settings that do not.
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
"""The default refinement of new avatars: iterations on photos whose longer side is reduced to 512
pixels, and steps on the head where `head_steps` allows them. It takes some seconds.
"""
