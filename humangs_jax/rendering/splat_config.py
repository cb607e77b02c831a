"""All settings of the splatting renderer in one frozen dataclass, and its presets. For JAX it is a
pytree without leaves.

Two rasterizers set the conventions: INRIA's diff-gaussian-rasterization
(https://github.com/graphdeco-inria/diff-gaussian-rasterization) and gsplat
(https://github.com/nerfstudio-project/gsplat). Where the two differ, this renderer does as gsplat.
In two points it differs from both. Alphas are clamped at `ALPHA_MAX`. Nothing is cut at three
standard deviations: a footprint ends where its alpha falls below `ALPHA_MIN`, so the image follows
from the formula and not from a bounding box.
"""

import dataclasses
from typing import Annotated

import jax

from humangs_jax.core.configuration import (
    Capacity,
    Chunk,
    Presets,
    Range,
    Share,
    Spread,
    configuration,
    knob,
)

NEAR = 0.01
"""Least z of a Gaussian's centre in the camera's frame, metres. Gaussians that are nearer, or
behind the camera, are not drawn. gsplat has 0.01, INRIA 0.2.
"""

EPS2D = 0.3
"""Variance that is added along both axes of the image, pixels^2. It is a low-pass of about one
pixel. Without it a Gaussian thinner than a pixel falls between pixel centres. INRIA and gsplat have
the same value. By default, opacity is not compensated for it (gsplat "classic").
"""

MIP_EPS2D = 0.1
"""Variance that is added instead of `EPS2D` if the scales already contain a low-pass
(`Gaussians.pixel_footprint`), pixels^2. It is about the footprint of a pixel. Images of all sizes
then show the Gaussians as wide as the images to which they were fitted (Mip-Splatting,
https://arxiv.org/abs/2311.16493).
"""

LEAST_DIMMING = 1e-4
"""Smallest factor by which the added variance dims opacities. It is too small to be seen, and keeps
gradients finite.
"""

ALPHA_MIN = 1 / 255
"""Smaller alphas are skipped, because they could not change an 8-bit image. INRIA and gsplat have
the same value.
"""

ALPHA_MAX = 0.999
"""Largest alpha. Larger alphas are clamped, so that no pixel is ever fully opaque (T > 0). gsplat
and INRIA have 0.99.
"""

TRANSMITTANCE_STOP = 1e-4
"""Least transmittance of a pixel. A pixel ends before the splat that would leave a transmittance T
of this or less. INRIA and gsplat have the same value.
"""

LARGEST_FOOTPRINT = 1e9
"""Largest absolute coordinate of the three axes of a projected Gaussian, pixels. The axes are one
standard deviation long. Gaussians with a larger coordinate are not drawn, because its fourth power
could overflow float32.
"""


@jax.tree_util.register_static
@configuration
class SplatConfig:
    """Settings that decide what is drawn, where footprints end, what is computed, how large buffers
    are, and in which schedule the work is done. docs/knobs.md has the cost and the gain of each.
    """

    near: Annotated[float, Range(0, 1e6)] = NEAR
    """Least z in the camera's frame, metres. Gaussians whose centre is nearer are not drawn."""
    eps2d: Annotated[float, Range(0, 1e6)] = EPS2D
    """Variance that is added to projected variances, pixels^2."""
    antialiased: bool = False
    """Whether opacities are dimmed because the added variance enlarges the footprint. The total
    weight of a Gaussian then stays the same (gsplat's "antialiased"; Mip-Splatting's 2D filter).
    Gaussians with a `pixel_footprint` are always dimmed, but only where a pixel of the image covers
    more than `pixel_footprint` metres at their depth.
    """
    alpha_min: Annotated[float, Range(1e-12, 1)] = ALPHA_MIN
    """Smaller alphas are skipped."""
    alpha_max: Share = ALPHA_MAX
    """Larger alphas are clamped to this."""
    transmittance_stop: Share = knob(
        TRANSMITTANCE_STOP,
        cost="55 dB at 0.001, 40 dB at 0.01",
        gain="6 % of the time with gradients at 0.001, 10 % at 0.01",
        measured="performance.md",
    )
    """A pixel ends before its transmittance would fall to this."""
    jacobian_margin: Spread | None = None
    """None: the Jacobian of the projection is exact. A number: the width of a margin around the
    image, as a fraction of half the image's width (or height). For a centre beyond the margin, the
    Jacobian is evaluated at the nearest point of the margin's outer edge. INRIA and gsplat have
    0.3. It applies to pinhole cameras without distortion.
    """
    normalize_quats: bool = True
    """Whether quaternions are normalised. INRIA's rasterizer does not."""
    radius_sigma: Annotated[float, Range(1e-6, 100)] | None = knob(
        None,
        cost="61 dB at 2.5, 52 dB at 2, 46 dB at 1.5; splats are cut at tile borders",
        gain="14 %, 27 %, 35 % of the time",
        measured="performance.md",
    )
    """Number of standard deviations at which footprints end, unless alpha falls below alpha_min
    before. None: footprints end where alpha falls below alpha_min, so that nothing is lost. Smaller
    values draw faster. A splat is drawn on all tiles that its footprint meets, so with a number the
    image depends on tile_size.
    """
    square: bool = False
    """Whether footprints are INRIA's: squares around the splats, on the tiles that INRIA's
    rasterizer counts for them. Half a side is `radius_sigma` times the larger standard deviation,
    rounded up to pixels. `radius_sigma` must not be None.
    """
    visibility: bool = knob(
        False,
        cost="memory of one number a Gaussian",
        gain=(
            "`visible_gaussians(threshold=0.03)` with radius_sigma 2.5 and transmittance_stop"
            " 0.001: 0.75 of the time at 53.9 dB"
        ),
        measured="performance.md",
    )
    """Whether `Rendering.visibility` is computed."""
    means2d: bool = False
    """Whether `Rendering.means2d`, the centres on the image, is returned."""
    radii: bool = False
    """Whether `Rendering.radii`, half the width and height of each footprint, is computed."""
    depth_sum: bool = False
    """Whether `Rendering.depth_sum`, gsplat's "D", is computed."""
    depth_median: bool = False
    """Whether `Rendering.depth_median` is computed."""
    distortion: bool = False
    """Whether `Rendering.distortion`, the loss of 2DGS for each pixel, is computed."""
    max_pairs: Capacity | None = knob(
        None,
        cost="pairs beyond it are not drawn, counted and reported",
        gain="memory, one compilation",
        measured="performance.md",
    )
    """Room for (splat, tile) pairs. None: an eager call measures how many it needs. A traced call
    (under jit, grad or vmap) cannot measure, and takes `buffers.default_pairs(g, width, height)`.
    Pairs that do not fit are counted in `Rendering.overflow`. `plan_buffers` measures the capacity
    for traced calls.
    """
    max_rows: Capacity | None = knob(
        None, cost="as max_pairs", gain="a little time", measured="performance.md"
    )
    """Room for (splat, row of tiles) pairs. None: as many as `max_pairs`, which is enough in
    practice. An eager call that measures the pairs also measures the rows.
    """
    warn_overflow: bool = False
    """Whether traced calls log a warning when something did not fit. It adds a callback to the
    program.
    """
    tile_size: Annotated[int, Range(1, 4096)] = knob(
        8,
        cost="none",
        gain="8 is best on CPUs: 4 takes 2.3 x, 16 takes 1.3 x the time",
        measured="performance.md",
    )
    """Side of a tile, pixels. `tile_size`, `block` and `chunk` make the schedule. They change the
    time that drawing takes, and the image only by rounding. With a radius_sigma, tile_size also
    decides where splats are cut off.
    """
    block: Chunk = 32
    """Number of tiles that are composited together, on CPUs only. Between 16 and 64, it changes the
    time by 4 %.
    """
    chunk: Chunk = 8
    """Number of splats of a list that are taken at once, on CPUs only. Between 4 and 16, it changes
    the time by 6 %.
    """

    def __post_init__(self):
        if not self.alpha_min < self.alpha_max < 1:
            raise ValueError(
                f"SplatConfig: need alpha_min < alpha_max < 1, got {self.alpha_min},"
                f" {self.alpha_max}"
            )
        if not self.transmittance_stop < 1:
            raise ValueError(
                f"SplatConfig.transmittance_stop {self.transmittance_stop:g}: expected less than 1"
            )
        if self.square and self.radius_sigma is None:
            raise ValueError("SplatConfig: a square footprint needs a radius_sigma")


DEFAULT_CONFIG = SplatConfig()

SPLAT_PRESETS: Presets[SplatConfig] = Presets(
    {
        "exact": DEFAULT_CONFIG,
        "near_exact": SplatConfig(radius_sigma=2.5, transmittance_stop=1e-3),
        "fast": SplatConfig(radius_sigma=1.75, transmittance_stop=3e-3),
        "inria": SplatConfig(
            near=0.2,
            alpha_max=0.99,
            # the Jacobian is evaluated no farther out than this fraction of the half field of view
            # beyond the border: it bounds the footprints of Gaussians beside a near camera, at the
            # price of a wrong shape there
            jacobian_margin=0.3,
            normalize_quats=False,
            radius_sigma=3.0,  # gsplat: 3.33; visible for opaque splats
            square=True,
            tile_size=16,  # matters where a square cuts splats off: they are drawn on whole tiles
        ),
    },
    '; "as_trained" of Settings and FrameSettings is SPLAT_PRESETS[avatar.rendering]',
)
"""Presets by name. exact: draws every alpha of 1/255 and more, in float32. near_exact and fast: see
docs/performance.md for their errors and gains. inria: the conventions of
diff-gaussian-rasterization, with which the published weights were trained.
"""


def splat_config(config: SplatConfig | str) -> SplatConfig:
    """Returns the preset with a name. A configuration is returned unchanged.

    Raises: ValueError for an unknown name.
    """
    if not isinstance(config, str):
        return config
    try:
        return SPLAT_PRESETS[config]
    except KeyError as error:
        raise ValueError(f"config: {error.args[0]}") from None


def drawn_as(config: SplatConfig, rendering: str) -> SplatConfig:
    """Returns the configuration with the conventions of a preset, "exact" or "inria". rendering:
    the preset's name, which weights record.

    All fields in which the two presets differ take the values of the preset `rendering`. Other
    fields stay as the user has set them. The configuration is returned unchanged if its
    `jacobian_margin`, `normalize_quats` and `square` all differ from those of the preset that is
    not `rendering`.
    """
    wanted, other = SPLAT_PRESETS["inria"], SPLAT_PRESETS["exact"]
    if rendering == "exact":
        wanted, other = other, wanted
    conventions = ("jacobian_margin", "normalize_quats", "square")
    if all(getattr(config, name) != getattr(other, name) for name in conventions):
        return config
    names = [field.name for field in dataclasses.fields(config)]
    differing = [name for name in names if getattr(wanted, name) != getattr(other, name)]
    return dataclasses.replace(config, **{name: getattr(wanted, name) for name in differing})
