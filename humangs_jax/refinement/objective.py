"""Defines the parameters that refinement moves, and the loss that it minimises. The parameters are
unconstrained Gaussians. The loss is the difference of their renderings from the photos.

The Gaussians are skinned to the pose of each photo, so the photos may show different poses. All
functions are pure and take one photo. Together they are few programs: a run on the host compiles
one renderer and its transpose for steps, iterations and comparisons.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.animate import skin
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Int, Scalar
from humangs_jax.core.compiled import compiled
from humangs_jax.core.numerics import safe_divide
from humangs_jax.core.processes import compiler_options
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.losses.losses import decibels, structural_dissimilarity
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.photos import Photo
from humangs_jax.rendering.gaussians import (
    Gaussians,
    UnconstrainedGaussians,
    constrain,
    unconstrain,
    widened,
)
from humangs_jax.rendering.splat_config import SplatConfig
from humangs_jax.rendering.splatting import Rendering, render

Image = tuple[Float[Array, "h w 3"], Float[Array, "h w"]]
"""Colors and alpha."""
FASTER_COMPILATION = {"xla_backend_optimization_level": 1}
"""Options of the compiler on a CPU. Compared with optimization level 3, programs compile in 0.8 to
0.9 of the time and run as fast. At level 0 they would run eight times as long.
"""

# here: its own module is imported by the command line, without JAX
jax.tree_util.register_static(RefineConfig)


def _options() -> dict[str, Any] | None:
    """Returns the options of XLA for the programs of refinement, see `compiler_options`."""
    options = compiler_options()
    return options and options | FASTER_COMPILATION


compiled_part = compiled(static=("config", "splat"), options=_options)
"""Decorator of a part of refinement. If it is called with arrays, the part runs as a compiled
program. Inside of a transformation it becomes a part of the transformed program. Parameters named
config and splat are static.
"""


# Parameters
# --------------------------------------------------------------------------------------------------


PullBack = Callable[[Image], tuple[UnconstrainedGaussians, Float[Array, " g"]]]
"""A function that takes the gradient with respect to an image. It returns the gradients with
respect to the parameters and to the brightness of each Gaussian.
"""


def parameters_of(gaussians: Gaussians) -> UnconstrainedGaussians:
    """Returns the parameters of Gaussians that refinement moves. The low-pass is removed from the
    scales. `gaussians_of` makes the Gaussians again, within the limits of `unconstrain`.

    Raises: ValueError for harmonics or deformations.
    """
    if gaussians.harmonics is not None:
        raise ValueError(
            "refine: gaussians.harmonics: expected none: colors that depend on the view are not"
            " refined"
        )
    return unconstrain(
        replace(gaussians, scales=widened(gaussians.scales, gaussians.pixel_footprint, -1))
    )


@compiled_part
def gaussians_of(
    parameters: UnconstrainedGaussians, pixel_footprint: Float[Array, " g"] | None
) -> Gaussians:
    """Returns the Gaussians of some parameters, with a low-pass added to their scales.
    pixel_footprint: the side of a pixel at each Gaussian, (g,), metres. None: no low-pass is added.
    """
    gaussians = constrain(parameters)
    return replace(
        gaussians,
        scales=widened(gaussians.scales, pixel_footprint),
        pixel_footprint=pixel_footprint,
    )


def avatar_of(parameters: UnconstrainedGaussians, avatar: Avatar) -> Avatar:
    """Returns the avatar with the Gaussians of some parameters."""
    return replace(avatar, gaussians=gaussians_of(parameters, avatar.gaussians.pixel_footprint))


# Images and their difference from the photos
# -----------------------------------------------------------------------------


def posed_gaussians(parameters: UnconstrainedGaussians, avatar: Avatar, photo: Photo) -> Gaussians:
    """Returns the Gaussians of some parameters in the pose of a photo."""
    return skin(avatar_of(parameters, avatar), BodyPose(photo.rotations, photo.translation))


@compiled_part
def drawn_photo(
    parameters: UnconstrainedGaussians, avatar: Avatar, photo: Photo, splat: SplatConfig
) -> tuple[Image, PullBack, Rendering]:
    """Draws the avatar as a photo shows it. Returns the image, the pull-back of its gradients, and
    the whole rendering.
    """

    def draw(parameters, brightness):
        gaussians = posed_gaussians(parameters, avatar, photo)
        rendering = render(
            replace(gaussians, colors=gaussians.colors + brightness[:, None]), photo.camera, splat
        )
        return (rendering.rgb, rendering.alpha), rendering

    return jax.vjp(draw, parameters, jnp.zeros_like(avatar.gaussians.opacities), has_aux=True)


@compiled_part
def pulled(pull_back: PullBack, image: Image) -> tuple[UnconstrainedGaussians, Float[Array, " g"]]:
    """Returns `pull_back(image)`, as a compiled program."""
    return pull_back(image)


def image_loss(image: Image, photo: Photo, config: RefineConfig) -> Scalar:
    """Returns the loss of an image against a photo: the weighted sum of the L1 distance of colors,
    the structural dissimilarity and the L1 distance of coverage. Each is a mean over the crop.

    The image takes the photo's values in pixels that do not count, so they add nothing to the loss.
    """
    rgb = jnp.where(photo.counted[..., None], image[0], photo.image)
    alpha = jnp.where(photo.counted, image[1], photo.mask)
    return (
        jnp.mean(jnp.abs(rgb - photo.image))
        + config.structural * jnp.mean(structural_dissimilarity(rgb, photo.image))
        + config.silhouette * jnp.mean(jnp.abs(alpha - photo.mask))
    )


@compiled_part
def loss_gradient(image: Image, photo: Photo, config: RefineConfig) -> Image:
    """Returns the gradient of `image_loss` with respect to the image."""
    return jax.grad(image_loss)(image, photo, config)


@pytree_dataclass
class Comparison:
    """The comparison of an avatar with a photo, or with each of several photos (leading axis v)."""

    loss: Float[Array | np.ndarray, "*v"]
    """The loss, see `image_loss`."""
    squared: Float[Array | np.ndarray, "*v"]
    """The sum of the squared errors over the pixels that count. The squared error of a pixel is the
    mean over its three colors.
    """
    pixels: Float[Array | np.ndarray, "*v"]
    """The number of pixels that count."""
    visibility: Float[Array | np.ndarray, "*v g"]
    """The largest weight of each Gaussian on any pixel of the rendering, (g,)."""
    overflow: Int[Array | np.ndarray, "*v"]
    """The number of (splat, tile) pairs that the buffers had no room for."""

    def together(self) -> "Comparison":
        """Returns one comparison with all photos. It has the mean loss, the largest visibility, and
        the sums of the other fields.
        """
        xp: Any = np if isinstance(self.loss, np.ndarray) else jnp
        sums = [xp.sum(x) for x in (self.squared, self.pixels)]
        most = xp.max(self.visibility, axis=0)
        numbers = (xp.mean(self.loss), *sums, most, xp.sum(self.overflow))
        return Comparison(*map(xp.asarray, numbers))

    @property
    def psnr(self) -> Float[Array, "*v"]:
        """The PSNR over the pixels that count, dB."""
        return _psnr(self.squared, self.pixels)


@compiled()
def _psnr(squared: Float[Array, "*v"], pixels: Float[Array, "*v"]) -> Float[Array, "*v"]:
    return decibels(safe_divide(squared, pixels))


def compare(
    parameters: UnconstrainedGaussians,
    avatar: Avatar,
    photo: Photo,
    config: RefineConfig,
    splat: SplatConfig,
) -> Comparison:
    """Returns the comparison of Gaussians with a photo."""
    splat = dataclasses.replace(splat, visibility=True)
    image, _, rendering = drawn_photo(parameters, avatar, photo, splat)
    return compared(image, rendering, photo, config)


@compiled_part
def compared(image: Image, rendering: Rendering, photo: Photo, config: RefineConfig) -> Comparison:
    """Returns the comparison of an image with a photo. rendering: the rendering that `image` is
    part of, with visibility.
    """
    squared = jnp.mean(jnp.square(jnp.clip(image[0], 0, 1) - photo.image), axis=-1)
    assert rendering.visibility is not None
    errors = image_loss(image, photo, config), jnp.sum(squared * photo.counted)
    return Comparison(
        *errors,
        jnp.sum(photo.counted, dtype=squared.dtype),
        rendering.visibility,
        rendering.overflow,
    )
