"""Parts of GIGA-style and Animatable-Gaussians-style systems: U-Nets that run for every pose make a
Gaussian for every texel of a map of the body.

GIGA (Zubekhin et al. 2025, https://arxiv.org/abs/2504.07144) projects photos of the CURRENT frame
onto a texture of 512 x 512 texels. Visible views are weighted by the softmax of 5 times the cosine
at which they see a texel. There are encoders for textures and for canonical positions (64 x 1, 2,
4, 8 channels), whose coarsest maps attend to an MLP of the pose (162 numbers, width 1024). Decoders
of 3, 3 and 8 channels predict color, offset and the rest of a Gaussian for each texel, which
skinning poses. The loss has SSIM 0.5, L1 0.5, alpha 0.2, perceptual 0.5 and penalties of offsets,
opacities and scales.

In our reading GIGA has encoders of 3 + 1 channels (color, whether seen) and 3 channels (position),
whose scales are joined, and three decoders. GIGA also has a static texture of other frames, which
half of its training steps drop. It is left out, because the photos here show one pose; GIGA would
use it for a target in another pose. The pose is that of the target.

Animatable Gaussians (Li et al. 2023, https://arxiv.org/abs/2311.16096) is fitted to ONE person. It
has maps of the front and the back of the T-pose, of 1024 x 1024 texels each, and a Gaussian for
every texel that shows the body. Three StyleUNets turn a map of posed positions into colors, offsets
(times 0.05) and the rest. It is trained with L1 + 0.1 LPIPS + 0.005 of squared offsets, by Adam
with 5e-4, for 800,000 steps of one person. It reads no photo: the weights contain the person, and
fit nobody else. In our reading there are plain U-Nets on maps of one size, colors that do not
depend on the view, no PCA of novel poses, and positions relative to the middle and the root's
rotation.

Both start from the same flat Gaussians on the surface. Without corrections they show the body.
Texels that show nothing are transparent.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.correction import CHANNELS, apply_corrections, pose_vector
from experiments.systems.surface_map import SurfaceMap
from experiments.systems.targets import GaussianDriver
from experiments.systems.unet import UNet, check_scales
from humangs_jax.body.model import Texels
from humangs_jax.core.array_types import Array, Float, PyTree
from humangs_jax.core.configuration import Count, Spread, Weight, Width, part
from humangs_jax.core.numerics import safe_divide, safe_normalize
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT
from humangs_jax.network.maps import sample_bilinear, texel_indices
from humangs_jax.network.parts import (
    Decoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    Reader,
    Target,
    subject_unit,
)
from humangs_jax.network.reader import UNSEEN_COLOR, project_vertices, visible_vertices
from humangs_jax.network.vertex_decoder import normal_frames
from humangs_jax.rendering.gaussians import Gaussians

AREA = 1.9
"""Surface of a body that is 1.8 m tall, square metres."""
COVERAGE, THICKNESS = 0.7, 0.2
"""Standard deviation of a Gaussian along the surface as a share of the distance between texels, and
across the surface as a share of that along it.
"""
OPACITY = 0.9
"""Opacity of Gaussians before corrections."""
NETS = {"offsets": 3, "shapes": 8, "colors": 3}
"""{network or decoder: number of its outputs}, in the order of `correction.CHANNELS`."""


@pytree_dataclass
class SurfaceTexture:
    """A texture of the body, copied from photos."""

    colors: Float[Array, "h w 3"]
    """Colors of the texels, grey where no photo shows them."""
    seen: Float[Array, "h w"]
    """1 where a photo shows the texel, 0 elsewhere."""


@pytree_dataclass
class Surface:
    """What drivers work from."""

    texture: SurfaceTexture | None
    """The texture, None for systems that read no photo."""
    positions: Float[Array, "h w 3"]
    """Canonical positions of the texels in normalised units."""
    texels: Texels
    """The map of the surface."""


@part
class TextureReader(Reader):
    """A reader that copies the photos to the texture of the body."""

    surface_map: SurfaceMap = SurfaceMap()
    """The texels."""
    sharpness: Weight = 5.0
    """Factor of the cosines in the softmax over visible views. A large one takes the best view."""

    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> SurfaceTexture:
        """Returns the texture.

        Raises: ValueError if the inputs lack the map of the surface or posed normals.
        """
        texels = _texels(inputs)
        if inputs.posed_normals is None:
            raise ValueError(
                "a TextureReader needs posed_normals of the inputs, see `prepare_inputs`"
            )
        unit, covered = subject_unit(inputs.canonical_vertices), texels.covered.reshape(-1)
        size, grid = (inputs.cameras.width, inputs.cameras.height), ctx.conventions.pixel_grid

        def view(image, depth_map, camera, vertices, normals, present):
            """Returns the colors of the texels in a view, and weights by how much they face it."""
            points = texels.interpolate(vertices).reshape(-1, 3)
            pixels, depths = project_vertices(camera, points)
            visible = visible_vertices(pixels, depths, depth_map, size, grid) & covered & present

            def unit_vectors(x):
                return safe_normalize(x, jnp.zeros(3))

            away = unit_vectors(texels.interpolate(normals).reshape(-1, 3))
            cosines = jnp.sum(away * unit_vectors(camera.center - points), axis=-1)
            weights = jnp.exp(self.sharpness * (cosines - 1))
            weights = jnp.where(visible & (cosines > 0), weights, 0.0)
            return sample_bilinear(image, texel_indices(pixels, size, size, grid)), weights

        arguments = (
            inputs.images,
            inputs.depth_maps,
            inputs.cameras.in_units(unit),
            inputs.posed_vertices / unit,
        )
        colors, weights = jax.vmap(view)(*arguments, inputs.posed_normals, inputs.present)
        # the mean of the views that see a texel; grey where none does
        total = jnp.sum(weights, axis=0)
        mean = jnp.einsum("vtc,vt->tc", colors, safe_divide(weights, total), precision=EXACT)
        seen, shape = total > 0, texels.covered.shape
        colors = jnp.where(seen[:, None], mean, UNSEEN_COLOR)
        return SurfaceTexture(colors.reshape(*shape, 3), seen.reshape(shape).astype(colors.dtype))


@part
class SurfaceDecoder(Decoder):
    """A decoder that makes a flat Gaussian on the surface for every texel, which drivers correct.

    Gaussians are in row-major order and have the texture's colors. They are grey if the features
    are no texture. Nothing is learned.
    """

    surface_map: SurfaceMap = SurfaceMap()
    """The texels."""

    def __call__(
        self, features: PyTree, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """See `parts.Decoder`.

        Raises: ValueError if the inputs lack the map, the normals or the weights of the body.
        """
        texels = _texels(inputs)
        if inputs.canonical_normals is None or inputs.skinning_weights is None:
            raise ValueError(
                "a SurfaceDecoder needs canonical_normals and skinning_weights, see"
                " `prepare_inputs`"
            )
        texture = features if isinstance(features, SurfaceTexture) else None
        unit, covered = subject_unit(inputs.canonical_vertices), texels.covered.reshape(-1)

        def flat(values):
            return texels.interpolate(values).reshape(len(covered), -1)

        # flat Gaussians that cover the surface between them, in the axes of its normals
        up = jnp.asarray([0.0, 0.0, 1.0])
        along = COVERAGE * jnp.sqrt(AREA / jnp.maximum(jnp.sum(covered), 1)) * unit
        root = jnp.zeros(inputs.skinning_weights.shape[1]).at[0].set(1.0)
        colors = jnp.full((len(covered), 3), UNSEEN_COLOR)
        if texture is not None:
            colors = texture.colors.reshape(-1, 3)
        gaussians = Gaussians(
            means=flat(inputs.canonical_vertices),
            quats=normal_frames(safe_normalize(flat(inputs.canonical_normals), up)),
            scales=jnp.broadcast_to(along * jnp.asarray([1.0, 1.0, THICKNESS]), (len(covered), 3)),
            opacities=jnp.where(covered, OPACITY, 0.0),
            colors=colors,
        )
        weights = jnp.where(covered[:, None], flat(inputs.skinning_weights), root)
        positions = texels.interpolate(inputs.canonical_vertices) / unit
        return HumanGSOutputs(
            gaussians, skinning_weights=weights, scene=Surface(texture, positions, texels)
        )


def _texels(inputs: HumanGSInputs) -> Texels:
    """Returns the map of the surface. Raises a ValueError if the inputs lack it."""
    if inputs.texels is None:
        raise ValueError(
            "this network works on a map of the surface: use `gaussian_body` and `prepare_inputs`"
        )
    return inputs.texels


@part
class TextureDriver(GaussianDriver):
    """The driver of GIGA-style systems: a U-Net with encoders of the texture and of positions,
    whose coarsest maps attend to the pose.
    """

    widths: tuple[Width, ...] = (64, 128, 256, 512)
    """Numbers of features of the U-Net, the finest scale first."""
    pose_width: Width = 1024
    """Width of the MLP of the pose."""
    pose_tokens: Count = 16
    """Number of tokens that the MLP makes of the pose."""
    joints: Count = 55
    """Number of joints of the body."""
    offset_scale: Spread = 0.1
    """Bound of the offsets in metres."""

    def __post_init__(self):
        """Raises a ValueError for widths that no U-Net has."""
        super().__post_init__()
        check_scales("driver.widths", self.widths)

    @nn.compact
    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """See `parts.TargetDecoder`.

        Raises: ValueError for a decoder without a texture; see `correction.pose_vector`.
        """
        surface: Surface = outputs.scene
        if surface.texture is None:
            raise ValueError("a TextureDriver needs a TextureReader")
        texture = surface.texture
        attention = PoseAttention(self.pose_width, self.pose_tokens, parent=None)
        seen = jnp.concatenate([2 * texture.colors - 1, texture.seen[..., None]], axis=-1)
        network = UNet(self.widths, tuple(NETS.values()), attention)
        nn.share_scope(self, network)
        context = pose_vector(target.pose, self.joints)
        raw = network(seen[None], surface.positions[None], context=context)
        return _driven(outputs, raw[0], self.offset_scale)


@part
class PoseMapDriver(GaussianDriver):
    """The driver of Animatable-Gaussians-style systems: three U-Nets on the map of posed positions,
    for offsets, shapes and colors.
    """

    widths: tuple[Width, ...] = (64, 128, 256, 512)
    """Numbers of features of each U-Net, the finest scale first."""
    offset_scale: Spread = 0.05
    """Bound of the offsets in metres."""

    def __post_init__(self):
        """Raises a ValueError for widths that no U-Net has."""
        super().__post_init__()
        check_scales("driver.widths", self.widths)

    @nn.compact
    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """See `parts.TargetDecoder`."""
        surface: Surface = outputs.scene
        upright = quaternion.matrix_from_axis_angle(target.pose.rotations[0])
        middle = jnp.mean(target.vertices, axis=0)
        # rows times R are R^T p: the root's rotation is taken back
        relative = jnp.matmul(target.vertices - middle, upright, precision=EXACT)
        maps = surface.texels.interpolate(relative)[None]
        raw = [UNet(self.widths, (n,), name=name)(maps) for name, n in NETS.items()]
        return _driven(outputs, jnp.concatenate(raw, axis=-1)[0], self.offset_scale)


def _driven(
    outputs: HumanGSOutputs, raw: Float[Array, "h w 14"], offset_scale: float
) -> HumanGSOutputs:
    """Returns the outputs with Gaussians corrected by a map of raw corrections."""
    gaussians, offsets = apply_corrections(
        outputs.gaussians, raw.reshape(-1, CHANNELS), offset_scale
    )
    return replace(outputs, gaussians=gaussians, tight_offsets=offsets[:, None])


class PoseAttention(nn.Module):
    """The bottleneck of a U-Net, in which every texel of the coarsest maps attends to tokens that
    an MLP makes of the pose.
    """

    width: int
    """Width of the MLP."""
    tokens: int
    """Number of tokens."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w d"], pose: Float[Array, " q"]
    ) -> Float[Array, "v h w d"]:
        """Returns the maps after the attention."""
        features = x.shape[-1]
        hidden = jax.nn.silu(nn.Dense(self.width, name="pose_0")(pose))
        context = nn.Dense(self.tokens * features, name="pose_1")(hidden)
        context = context.reshape(self.tokens, features)

        def dense(name):
            return nn.Dense(features, use_bias=False, name=name)

        queries, keys, values = dense("query")(x), dense("key")(context), dense("value")(context)
        attention = jax.nn.softmax(queries @ keys.T * features**-0.5, axis=-1)
        return x + dense("out")(attention @ values)
