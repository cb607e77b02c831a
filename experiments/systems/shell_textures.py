"""GHG-style: textures of shells of the body, copied from the photos, and a U-Net that makes a
Gaussian of every texel.

Theirs (Kwon et al. 2024, https://arxiv.org/abs/2407.12777): UV maps of 1024 x 1024 texels of the
surface of the body and of four shells around it, up to 4 cm off along the normals. A texel has the
color of the photo that sees it best; a network of gated convolutions fills the rest of the
innermost one, the outer ones keep what was seen. A convolutional U-Net takes the colors and the
offsets of the shells and gives rotation, scale (at most 1 cm) and opacity. Means and colors are not
predicted.

Our reading: the best view is the one whose ray meets the posed normal most directly; unseen texels
of the innermost shell are filled from their neighbours through coarser and coarser maps (pull-push,
Gortler et al. 1996), without a network; texels of outer shells that no photo shows on the person
are transparent. Theirs is of one pose; here texels have the skinning weights of their points, so
that the person can be animated. The encoder is `PlainPhotos`: none.
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
CHANNELS = (4, 3, 1)
"""Of a quaternion, a scale and an opacity."""


@pytree_dataclass
class ShellTextures:
    """What the photos show of every texel of s shells.

    distances: (s,) from the surface, normalised units. colors: (s, h, w, 3), the innermost filled,
    others `UNSEEN_COLOR` where nothing was seen. seen: (s, h, w) whether a photo shows the person
    there.
    """

    distances: Float[Array, " s"]
    colors: Float[Array, "s h w 3"]
    seen: Bool[Array, "s h w"]


@part
class PlainPhotos(Encoder):
    """The encoder of systems that read the photos themselves: its maps are their colors."""

    patch_size: Patch = 1

    def __call__(self, inputs: HumanGSInputs, ctx: ForwardContext) -> Encoding:
        return Encoding(inputs.images, None, jnp.zeros((), jnp.int32))


@part
class ShellTextureReader(Reader):
    """The textures."""

    surface_map: SurfaceMap = SurfaceMap("atlas", 1024)
    shells: tuple[Spread, ...] = DISTANCES
    """Ascending distances from the surface, normalised units, the first 0."""

    def __post_init__(self):
        """Raises ValueError unless the shells begin at the surface and ascend."""
        super().__post_init__()
        if not self.shells or self.shells[0] != 0 or list(self.shells) != sorted(set(self.shells)):
            raise ValueError(
                f"reader.shells {self.shells}: expected ascending distances, the first 0"
            )

    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> ShellTextures:
        """Textures of the shells.

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
            """Take colors from a view where it faces the surface more than those before."""
            image, foreground, depth_map, camera, vertices, normals, present = view
            surface_normals = safe_normalize(texels.interpolate(normals), jnp.zeros(3))
            points = texels.interpolate(vertices) + steps[:, None, None, None] * surface_normals
            shape, points = points.shape[:-1], points.reshape(-1, 3)
            # a point is seen inside of the photo, on the person, not behind the surface
            pixels, depths = project_vertices(camera, points)
            indices = texel_indices(pixels, size, size, grid)
            surface, person = (
                sample_nearest(depth_map, indices),
                sample_nearest(foreground, indices) > 0,
            )
            framed = jnp.all((pixels > 0) & (pixels < jnp.asarray(size, pixels.dtype)), axis=-1) & (
                depths > 0
            )
            visible = (
                framed & person & ((surface < 0) | (depths < surface + DEPTH_TOLERANCE)) & present
            )
            towards = safe_normalize(camera.center - points, jnp.zeros(3)).reshape(*shape, 3)
            facing = jnp.sum(towards * surface_normals, axis=-1)
            facing = jnp.where(visible.reshape(shape) & covered, facing, 0.0)
            colors = sample_bilinear(image, indices).reshape(*shape, 3)
            better = facing > best[0]
            return (
                jnp.where(better, facing, best[0]),
                jnp.where(better[..., None], colors, best[1]),
            ), None

        # one view after the other; what none has seen on the skin takes colors of its neighbours
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
    """Seen texels as they are, others from the finest coarser map that has seen something; grey if
    nothing was seen at all.
    """
    weights = seen[None, ..., None].astype(colors.dtype)
    return _filled(colors[None] * weights, weights)[0]


def _filled(sums, weights):
    """Means where there are weights, and what coarser maps have elsewhere."""
    mean = sums / jnp.where(weights > 0, weights, 1)
    _, height, width, _ = sums.shape
    if height % 2 or width % 2:
        total = jnp.sum(weights, axis=(1, 2), keepdims=True)
        coarse = jnp.where(
            total > 0,
            jnp.sum(sums, axis=(1, 2), keepdims=True) / jnp.where(total > 0, total, 1),
            UNSEEN_COLOR,
        )
    else:
        coarse = doubled(_filled(halved(sums), halved(weights)))
    return jnp.where(weights > 0, mean, coarse)


@part
class ShellDecoder(Decoder):
    """The U-Net."""

    widths: tuple[Width, ...] = (32, 48, 96)
    """Its features, the finest scale first."""
    largest_scale: Spread = 0.01
    """Of a Gaussian, normalised units."""

    def __post_init__(self):
        """Raises ValueError for widths that no U-Net has."""
        super().__post_init__()
        check_scales("decoder.widths", self.widths)

    @nn.compact
    def __call__(
        self, features: ShellTextures, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """A Gaussian a texel of every shell; those that show no point of the body, or were not
        seen, are transparent.

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
        # the skin is there where it was not seen, too; other shells are not
        shown = covered & features.seen.at[0].set(True)

        def flat(x):
            return x.reshape(-1, x.shape[-1])

        gaussians = Gaussians(
            means=flat(surface + offsets) * unit,
            quats=quaternion.normalize(flat(quats) + jnp.asarray(quaternion.IDENTITY, raw.dtype)),
            scales=flat(self.largest_scale * jax.nn.sigmoid(scales)) * unit,
            opacities=jnp.where(
                shown, jax.nn.sigmoid(opacities[..., 0] + INITIAL_OPACITY), 0.0
            ).reshape(-1),
            colors=flat(features.colors),
        )
        # what shows nothing stays at the root
        rows = texels.interpolate(weights).at[..., 0].add(1.0 - covered)
        rows = jnp.tile(rows.reshape(-1, rows.shape[-1]), (shells, 1))
        return HumanGSOutputs(gaussians, skinning_weights=rows)
