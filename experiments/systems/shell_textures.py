"""Parts of GHG-style systems: textures of shells of the body, copied from the photos, and a U-Net
that makes a Gaussian of every texel.

GHG (Kwon et al. 2024, https://arxiv.org/abs/2407.12777) has UV maps of 1024 x 1024 texels of the
surface of the body and of four shells around it, up to 4 cm off along the normals. A texel has the
color of the photo that sees it best. A network of gated convolutions fills the rest of the
innermost map, and the outer maps keep what was seen. A convolutional U-Net takes the colors and the
offsets of the shells and predicts rotation, scale (at most 1 cm) and opacity. Means and colors are
not predicted.

In our reading the best view is the one whose ray meets the posed normal most directly. Unseen
texels of the innermost shell are filled from their neighbours through coarser and coarser maps
(pull-push, Gortler et al. 1996), without a network. Texels of outer shells that no photo shows on
the person are transparent. GHG makes one pose. Here texels have the skinning weights of their
points, so that the person can be animated. The encoder `PlainPhotos` passes the photos on.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.surface_map import SurfaceMap
from experiments.systems.unet import UNet, check_scales, doubled, halved
from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.configuration import Patch, Spread, Width, part
from humangs_jax.core.numerics import safe_normalize
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry import quaternion
from humangs_jax.network.maps import sample_bilinear, sample_nearest, texel_indices
from humangs_jax.network.parts import (
    Decoder,
    Encoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    Reader,
    subject_unit,
)
from humangs_jax.network.reader import DEPTH_TOLERANCE, UNSEEN_COLOR, project_vertices
from humangs_jax.network.vertex_decoder import INITIAL_OPACITY
from humangs_jax.rendering.gaussians import Gaussians

DISTANCES = (0.0, 0.01, 0.02, 0.03, 0.04)
"""Distances of the shells from the surface in normalised units."""
CHANNELS = (4, 3, 1)
"""Numbers of a quaternion, a scale and an opacity."""


@pytree_dataclass
class ShellTextures:
    """What the photos show of every texel of s shells."""

    distances: Float[Array, " s"]
    """Distances of the shells from the surface in normalised units."""
    colors: Float[Array, "s h w 3"]
    """Colors of the texels. Where nothing was seen the innermost shell is filled, and others have
    `UNSEEN_COLOR`.
    """
    seen: Bool[Array, "s h w"]
    """Whether a photo shows the person at the texel."""


@part
class PlainPhotos(Encoder):
    """The encoder of systems whose other parts read the photos. Its maps are their colors."""

    patch_size: Patch = 1
    """Side of a patch in pixels."""

    def __call__(self, inputs: HumanGSInputs, ctx: ForwardContext) -> Encoding:
        """Returns the colors of the photos as maps."""
        return Encoding(inputs.images, None, jnp.zeros((), jnp.int32))


@part
class ShellTextureReader(Reader):
    """A reader that makes the textures of the shells."""

    surface_map: SurfaceMap = SurfaceMap("atlas", 1024)
    """The texels of a shell."""
    shells: tuple[Spread, ...] = DISTANCES
    """Distances from the surface in normalised units, ascending from 0."""

    def __post_init__(self):
        """Raises a ValueError unless the distances of the shells ascend from 0."""
        super().__post_init__()
        if not self.shells or self.shells[0] != 0 or list(self.shells) != sorted(set(self.shells)):
            raise ValueError(
                f"reader.shells {self.shells}: expected ascending distances, the first 0"
            )

    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> ShellTextures:
        """Returns the textures of the shells.

        Raises: ValueError if the inputs lack the map of the surface or posed normals.
        """
        if inputs.texels is None or inputs.posed_normals is None:
            raise ValueError(
                "shell textures need texels and posed_normals of the inputs, see `prepare_inputs`"
            )
        unit, texels = subject_unit(inputs.canonical_vertices), inputs.texels
        steps = jnp.asarray(self.shells, inputs.images.dtype)
        size, grid = (inputs.cameras.width, inputs.cameras.height), ctx.conventions.pixel_grid
        covered = texels.covered

        def look(best, view):
            """Takes colors from a view where it faces the surface more than the views before."""
            image, foreground, depth_map, camera, vertices, normals, present = view
            surface_normals = safe_normalize(texels.interpolate(normals), jnp.zeros(3))
            points = texels.interpolate(vertices) + steps[:, None, None, None] * surface_normals
            shape, points = points.shape[:-1], points.reshape(-1, 3)
            # a point is seen inside of the photo, on the person, not behind the surface
            pixels, depths = project_vertices(camera, points)
            indices = texel_indices(pixels, size, size, grid)
            surface = sample_nearest(depth_map, indices)
            person = sample_nearest(foreground, indices) > 0
            inside = (pixels > 0) & (pixels < jnp.asarray(size, pixels.dtype))
            framed = jnp.all(inside, axis=-1) & (depths > 0)
            in_front = (surface < 0) | (depths < surface + DEPTH_TOLERANCE)
            visible = framed & person & in_front & present
            towards = safe_normalize(camera.center - points, jnp.zeros(3)).reshape(*shape, 3)
            facing = jnp.sum(towards * surface_normals, axis=-1)
            facing = jnp.where(visible.reshape(shape) & covered, facing, 0.0)
            colors = sample_bilinear(image, indices).reshape(*shape, 3)
            best_facing, best_colors = best
            better = facing > best_facing
            best_facing = jnp.where(better, facing, best_facing)
            return (best_facing, jnp.where(better[..., None], colors, best_colors)), None

        # one view after the other; unseen texels of the skin take the colors of their neighbours
        shape = (len(self.shells), *covered.shape)
        nothing = jnp.zeros(shape), jnp.full((*shape, 3), UNSEEN_COLOR)
        views = (
            inputs.images,
            inputs.foreground.astype(inputs.images.dtype),
            inputs.depth_maps,
            inputs.cameras.in_units(unit),
            inputs.posed_vertices / unit,
            inputs.posed_normals,
            inputs.present,
        )
        (facing, colors), _ = jax.lax.scan(look, nothing, views)
        seen = facing > 0
        return ShellTextures(steps, colors.at[0].set(fill_unseen(colors[0], seen[0])), seen)


def fill_unseen(colors: Float[Array, "h w 3"], seen: Bool[Array, "h w"]) -> Float[Array, "h w 3"]:
    """Returns the colors with unseen texels filled from the finest coarser map in which something
    was seen there. All texels are grey if nothing was seen.
    """
    weights = seen[None, ..., None].astype(colors.dtype)
    return _filled(colors[None] * weights, weights)[0]


def _filled(sums, weights):
    """Returns weighted means where there are weights, and the colors of coarser maps elsewhere."""
    mean = sums / jnp.where(weights > 0, weights, 1)
    _, height, width, _ = sums.shape
    if height % 2 or width % 2:
        # a map that cannot be halved has one color
        total = jnp.sum(weights, axis=(1, 2), keepdims=True)
        whole_mean = jnp.sum(sums, axis=(1, 2), keepdims=True) / jnp.where(total > 0, total, 1)
        coarse = jnp.where(total > 0, whole_mean, UNSEEN_COLOR)
    else:
        coarse = doubled(_filled(halved(sums), halved(weights)))
    return jnp.where(weights > 0, mean, coarse)


@part
class ShellDecoder(Decoder):
    """A decoder that makes Gaussians of the textures by a U-Net."""

    widths: tuple[Width, ...] = (32, 48, 96)
    """Numbers of features of the U-Net, the finest scale first."""
    largest_scale: Spread = 0.01
    """Largest scale of a Gaussian in normalised units."""

    def __post_init__(self):
        """Raises a ValueError for widths that no U-Net has."""
        super().__post_init__()
        check_scales("decoder.widths", self.widths)

    @nn.compact
    def __call__(
        self, features: ShellTextures, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns a Gaussian for each texel of every shell.

        Gaussians are transparent where the texel shows no point of the body, and on outer shells
        where it was not seen.

        Raises: ValueError if the inputs lack the map of the surface, normals or skinning weights.
        """
        texels, normals, weights = inputs.texels, inputs.canonical_normals, inputs.skinning_weights
        if texels is None or normals is None or weights is None:
            raise ValueError(
                "shell textures need texels, canonical_normals and skinning_weights of the inputs"
            )
        unit, shells = subject_unit(inputs.canonical_vertices), len(features.distances)
        # the network reads colors and places of all shells
        covered = texels.covered
        surface = texels.interpolate(inputs.canonical_vertices / unit)
        offsets = features.distances[:, None, None, None] * safe_normalize(
            texels.interpolate(normals), jnp.zeros(3)
        )
        channels = jnp.concatenate([2 * features.colors - 1, offsets[1:]])
        entering = jnp.moveaxis(channels, 0, 2).reshape(1, *covered.shape, -1)
        network = UNet(self.widths, (sum(CHANNELS) * shells,))
        nn.share_scope(self, network)
        raw = network(entering)[0]
        raw = jnp.moveaxis(raw.reshape(*covered.shape, shells, -1), 2, 0)
        quats, scales, opacities = jnp.split(raw, (CHANNELS[0], CHANNELS[0] + CHANNELS[1]), axis=-1)
        # the skin is shown also where it was not seen, and outer shells only where they were seen
        shown = covered & features.seen.at[0].set(True)

        def flat(x):
            return x.reshape(-1, x.shape[-1])

        alpha = jax.nn.sigmoid(opacities[..., 0] + INITIAL_OPACITY)
        gaussians = Gaussians(
            means=flat(surface + offsets) * unit,
            quats=quaternion.normalize(flat(quats) + jnp.asarray(quaternion.IDENTITY, raw.dtype)),
            scales=flat(self.largest_scale * jax.nn.sigmoid(scales)) * unit,
            opacities=jnp.where(shown, alpha, 0.0).reshape(-1),
            colors=flat(features.colors),
        )
        # texels that show nothing move with the root
        rows = texels.interpolate(weights).at[..., 0].add(1.0 - covered)
        rows = jnp.tile(rows.reshape(-1, rows.shape[-1]), (shells, 1))
        return HumanGSOutputs(gaussians, skinning_weights=rows)
