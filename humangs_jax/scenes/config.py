"""Settings of `fit_scene`: the number of Gaussians and of steps, the rate of each parameter, and
the loss.
"""

from typing import Annotated

from humangs_jax.core.configuration import Range, Seed, Share, Spread, Steps, Weight, configuration
from humangs_jax.rendering.splat_config import SplatConfig

SCENE_SPLAT = SplatConfig(jacobian_margin=0.3)
"""The renderer's settings, with the `jacobian_margin` of gsplat. With the exact Jacobian, Gaussians
beside a camera would cover whole images in scenes that surround the cameras.
"""
Capacity = Annotated[int, Range(1, 100_000_000)]
"""A number of Gaussians."""


@configuration
class SceneRates:
    """How far a step of Adam moves each parameter. The rates are the ones of Kheradmand et al.,
    except for colors and harmonics.
    """

    means: Spread = 1.6e-4
    """Rate of the means, in extents of the cameras (`extent_of`)."""
    quats: Spread = 1e-3
    """Rate of the quaternions, which may have any length."""
    log_scales: Spread = 5e-3
    """Rate of the natural logarithms of the scales."""
    opacity_logits: Spread = 5e-2
    """Rate of the logits of the opacities."""
    color_logits: Spread = 1e-2
    """Rate of the logits of the colors. A color changes by at most a quarter of its logit's
    change.
    """
    harmonics: Spread = 1e-3
    """Rate of the coefficients of the harmonics, which have the unit of colors."""


@configuration
class SceneConfig:
    """How `fit_scene` fits Gaussians to photos."""

    capacity: Capacity = 200_000
    """The number of slots, which is the largest number of Gaussians that a scene can have. Every
    step works on all slots.
    """
    steps: Steps = 7_000
    """The number of steps, of one photo each."""
    start: Capacity = 5_000
    """The number of Gaussians to begin with if no points are given."""
    degree: Annotated[int, Range(0, 3)] = 1
    """The degree of the harmonics, by which colors depend on the direction of sight. 0: no
    harmonics.
    """
    rates: SceneRates = SceneRates()
    """Learning rates."""
    final_share: Share = 0.01
    """Share of the rate of the means that is left at the end. The rate falls exponentially."""
    other_final_share: Share = 0.1
    """Share of the other rates that is left at the end. They fall exponentially."""
    structural: Share = 0.2
    """Share of 1 - SSIM in the loss. The rest is the absolute error."""
    opacity_penalty: Weight = 0.01
    """Weight of the mean opacity (`mcmc_penalty`)."""
    scale_penalty: Weight = 0.01
    """Weight of the mean scale, in extents of the cameras."""
    noise: Weight = 5e5
    """Weight of the noise of the means. The `rate` of `mcmc_noise` is this weight times the
    learning rate of the means, in metres, divided by the square of the extent of the cameras.
    """
    relocate_every: Steps = 100
    """Number of steps from one relocation to the next. A relocation moves dead Gaussians and uses
    more slots.
    """
    growth: Annotated[float, Range(1, 10)] = 1.2
    """Factor on the number of used slots at each relocation, up to the capacity. By the default,
    5,000 Gaussians become 200,000 in 2,100 steps. Scenes gain from an early growth
    (docs/benchmarks/quality.md). Kheradmand et al. use 1.05, and about four times as many steps.
    """
    relocate_until: Share = 0.85
    """Share of the steps after which no Gaussian is relocated any more."""
    splat: SplatConfig = SCENE_SPLAT
    """How images are drawn. The sizes of its buffers are ignored, because they are planned."""
    seed: Seed = 0
    """Seed of random points at the start, the order of photos, the noise and the relocations."""
