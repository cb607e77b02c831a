"""Every knob of the splatting renderer, in one frozen (hashable, hence static) dataclass."""

import dataclasses

from humangs_jax.rendering import constants


@dataclasses.dataclass(frozen=True)
class SplatConfig:
    """What is drawn, in which buffers, on which schedule.

    What is drawn (see `constants` for reasons and for the numbers of other rasterizers):
        near: metres; nearer Gaussians are not drawn. dilation: pixels^2 added to the projected variances.
        alpha_min: alphas below are skipped. alpha_max: alphas are clamped to it.
        transmittance_stop: a pixel ends before its transmittance would fall to this.
        jacobian_margin: None for the exact Jacobian, 0.3 for the clamped one of INRIA and gsplat.

    Buffers: capacities for (splat, tile) pairs, `max_pairs`, and for (splat, row of tiles) pairs, `max_rows`.
        None: an eager call measures its need. A traced call (under jit, grad or vmap) cannot, and takes
        `splatting.default_pairs(g, width, height)`; what does not fit is counted in `Rendering.overflow`, and
        `splatting.fit_config` measures a capacity for such calls. `max_rows` None: as many as pairs, always enough in
        practice; smaller is a little faster.

    Schedule: changes the time, not the image.
        tile_size: pixels. block: tiles that are composited together. chunk, chunk_backward: splats of a list taken at
        once.
    """

    near: float = constants.NEAR
    dilation: float = constants.DILATION
    alpha_min: float = constants.ALPHA_MIN
    alpha_max: float = constants.ALPHA_MAX
    transmittance_stop: float = constants.TRANSMITTANCE_STOP
    jacobian_margin: float | None = None
    max_pairs: int | None = None
    max_rows: int | None = None
    tile_size: int = 8
    block: int = 32
    chunk: int = 8
    chunk_backward: int = 8

    def __post_init__(self):
        positive = ("alpha_min", "tile_size", "block", "chunk", "chunk_backward")
        if wrong := [name for name in positive if not getattr(self, name) > 0]:
            raise ValueError(f"SplatConfig: {', '.join(wrong)} must be positive")
        if not self.alpha_min < self.alpha_max < 1:
            raise ValueError(f"SplatConfig: need alpha_min < alpha_max < 1, got {self.alpha_min}, {self.alpha_max}")
        if not (self.near >= 0 and self.dilation >= 0 and 0 <= self.transmittance_stop < 1):
            raise ValueError("SplatConfig: near and dilation must not be negative, transmittance_stop in [0, 1)")
        if any(size is not None and size < 1 for size in (self.max_pairs, self.max_rows)):
            raise ValueError("SplatConfig: max_pairs and max_rows must be at least 1")


DEFAULT_CONFIG = SplatConfig()
