"""The numbers of Gaussian splatting, why they are what they are, and what the public rasterizers use instead.

Two rasterizers set the conventions: INRIA's diff-gaussian-rasterization
(https://github.com/graphdeco-inria/diff-gaussian-rasterization) and gsplat (https://github.com/nerfstudio-project/gsplat).
Ours follow gsplat where they differ, except that nothing is cut at three standard deviations: a footprint ends where its
alpha falls below `ALPHA_MIN`, so the image follows from the formula and not from a bounding box.
"""

NEAR = 0.01
"""Metres; Gaussians whose centre is nearer (or behind) are not drawn. gsplat 0.01; INRIA `INRIA_NEAR`."""

INRIA_NEAR = 0.2

EPS2D = 0.3
"""Pixels^2 added to both variances of the image: a low-pass of about one pixel, without which a Gaussian thinner than a
pixel falls between pixel centres. The same in INRIA and gsplat; opacity is not compensated for it (gsplat
"classic")."""

MIP_EPS2D = 0.1
"""Pixels^2, for Gaussians whose scales contain the low-pass of the images that they were fitted to: about the footprint of a
pixel, so that images of other sizes show them as wide as those did (Mip-Splatting, https://arxiv.org/abs/2311.16493)."""

LEAST_DIMMING = 1e-4
"""Of opacities, by the variance that is added: a factor too small to be seen, which keeps gradients finite."""

ALPHA_MIN = 1 / 255
"""A smaller alpha is skipped: it could not change an 8-bit image by itself. The same everywhere."""

ALPHA_MAX = 0.999
"""Alpha is clamped here, so that no pixel is ever fully opaque (T > 0). gsplat 0.999; INRIA `INRIA_ALPHA_MAX`."""

INRIA_ALPHA_MAX = 0.99

TRANSMITTANCE_STOP = 1e-4
"""A pixel ends before the splat that would leave a transmittance T <= this. The same everywhere."""

INRIA_JACOBIAN_MARGIN = 0.3
"""INRIA and gsplat evaluate the projection's Jacobian no farther out than this fraction of the half field of view
beyond the image's border: it bounds the footprints of Gaussians beside a near camera, at the price of a wrong shape
there."""

INRIA_RADIUS_SIGMA = 3.0
"""Standard deviations after which INRIA cuts a square around a splat (gsplat: 3.33); visible for opaque splats."""

LARGEST_FOOTPRINT = 1e9
"""Pixels; a Gaussian with a longer projected axis is not drawn. Its square's square would overflow float32."""

INRIA_TILE_SIZE = 16
"""Pixels. It matters where a square cuts splats off: they are drawn on whole tiles."""
