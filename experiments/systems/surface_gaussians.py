"""GIGA-style and Animatable-Gaussians-style: a Gaussian for every texel of a map of the body, by
U-Nets that run for every pose.

GIGA (Zubekhin et al. 2025, https://arxiv.org/abs/2504.07144): photos of the CURRENT frame are
projected onto a texture of 512 x 512 texels, the visible views weighted by the softmax of 5 times
the cosine at which they see a texel. Encoders for textures and for canonical positions (64 x 1, 2,
4, 8 channels), whose coarsest maps attend to an MLP of the pose (162 numbers, width 1024), and
decoders of 3, 3 and 8 channels give color, offset and the rest of a Gaussian a texel, which
skinning poses. SSIM 0.5, L1 0.5, alpha 0.2, perceptual 0.5 and penalties of offsets, opacities and
scales. Our reading: encoders of 3 + 1 channels (color, whether seen) and 3 (position), whose scales
are joined, and three decoders; no second, static texture of other frames, which half of their steps
drop: the photos here show one pose, and for a target in another pose theirs is the static texture;
the pose is that of the target.

Animatable Gaussians (Li et al. 2023, https://arxiv.org/abs/2311.16096) is fitted to ONE person:
maps of the front and the back of the T-pose, 1024 x 1024 texels each, a Gaussian for every texel
that shows the body; three StyleUNets turn a map of posed positions into colors, offsets (times
0.05) and the rest. L1 + 0.1 LPIPS + 0.005 of squared offsets, Adam 5e-4, 800,000 steps of one
person. It reads no photo: the weights contain the person, and fit nobody else. Our reading: plain
U-Nets on maps of one size, colors that do not depend on the view, no PCA of novel poses, positions
relative to the middle and the root's rotation.

Both start from the same Gaussians, flat ones on the surface: with zero corrections the body itself.
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
"""Surface of a body of height 1.8, square metres."""
COVERAGE, THICKNESS = 0.7, 0.2
"""Standard deviations of a Gaussian along the surface over the distance between texels, and across
over along it.
"""
OPACITY = 0.9
"""Of Gaussians before corrections."""
NETS = {"offsets": 3, "shapes": 8, "colors": 3}
"""Outputs of each network or decoder, in the order of `correction.CHANNELS`."""


@pytree_dataclass
class SurfaceTexture:
    """colors: (h, w, 3), grey where unseen.

    seen: (h, w) 1 where a photo shows the texel, else 0.
    """

    colors: Float[Array, "h w 3"]
    seen: Float[Array, "h w"]


@pytree_dataclass
class Surface:
    """What drivers work from. texture: or None. positions: (h, w, 3) canonical, normalised units.

    texels: the map.
    """

    texture: SurfaceTexture | None
    positions: Float[Array, "h w 3"]
    texels: Texels


@part
class TextureReader(Reader):
    """Photos -> the texture of the body."""

    surface_map: SurfaceMap = SurfaceMap()
    sharpness: Weight = 5.0
    """Of the softmax over the cosines of visible views; larger: the best view."""

    def __call__(
        self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> SurfaceTexture:
        """The texture. Raises: ValueError if the inputs lack the map of the surface or posed
        normals.
        """
        texels = _texels(inputs)
        if inputs.posed_normals is None:
            raise ValueError(
                "a TextureReader needs posed_normals of the inputs, see `prepare_inputs`"
            )
        unit, covered = subject_unit(inputs.canonical_vertices), texels.covered.reshape(-1)
        size, grid = (inputs.cameras.width, inputs.cameras.height), ctx.conventions.pixel_grid

        def view(image, depth_map, camera, vertices, normals, present):
            """Colors of the texels in a view, and their weights: by how much they face it."""
            points = texels.interpolate(vertices).reshape(-1, 3)
            pixels, depths = project_vertices(camera, points)
            visible = visible_vertices(pixels, depths, depth_map, size, grid) & covered & present

            def away(x):
                return safe_normalize(x, jnp.zeros(3))

            cosines = jnp.sum(
                away(texels.interpolate(normals).reshape(-1, 3)) * away(camera.center - points),
                axis=-1,
            )
            weights = jnp.where(
                visible & (cosines > 0), jnp.exp(self.sharpness * (cosines - 1)), 0.0
            )
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
    """A flat Gaussian on the surface for every texel, row-major, with the texture's color: what
    drivers correct.

    Nothing is learned. Without a texture, features of any other kind, colors are grey.
    """

    surface_map: SurfaceMap = SurfaceMap()

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
    if inputs.texels is None:
        raise ValueError(
            "this network works on a map of the surface: use `gaussian_body` and `prepare_inputs`"
        )
    return inputs.texels


@part
class TextureDriver(GaussianDriver):
    """GIGA-style: encoders of the texture, seen or not, and of positions; their coarsest maps
    attend to the pose.
    """

    widths: tuple[Width, ...] = (64, 128, 256, 512)
    """Of the U-Net."""
    pose_width: Width = 1024
    """Of the MLP of the pose, as `pose_tokens`."""
    pose_tokens: Count = 16
    joints: Count = 55
    """Of the body."""
    offset_scale: Spread = 0.1
    """Metres, bound of the offsets."""

    def __post_init__(self):
        """Raises ValueError for a number of scales that no map has."""
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
        texture, attention = (
            surface.texture,
            PoseAttention(self.pose_width, self.pose_tokens, parent=None),
        )
        seen = jnp.concatenate([2 * texture.colors - 1, texture.seen[..., None]], axis=-1)
        network = UNet(self.widths, tuple(NETS.values()), attention)
        nn.share_scope(self, network)
        raw = network(
            seen[None], surface.positions[None], context=pose_vector(target.pose, self.joints)
        )
        return _driven(outputs, raw[0], self.offset_scale)


@part
class PoseMapDriver(GaussianDriver):
    """Animatable-Gaussians-style: three U-Nets on the map of posed positions, for offsets, shapes
    and colors.
    """

    widths: tuple[Width, ...] = (64, 128, 256, 512)
    """Of each U-Net."""
    offset_scale: Spread = 0.05
    """Metres, bound of the offsets."""

    def __post_init__(self):
        """Raises ValueError for a number of scales that no map has."""
        super().__post_init__()
        check_scales("driver.widths", self.widths)

    @nn.compact
    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> HumanGSOutputs:
        surface: Surface = outputs.scene
        upright = quaternion.matrix_from_axis_angle(target.pose.rotations[0])
        middle = jnp.mean(target.vertices, axis=0)
        relative = jnp.matmul(
            target.vertices - middle, upright, precision=EXACT
        )  # rows times R: R^T p
        maps = surface.texels.interpolate(relative)[None]
        raw = jnp.concatenate(
            [UNet(self.widths, (n,), name=name)(maps) for name, n in NETS.items()], axis=-1
        )
        return _driven(outputs, raw[0], self.offset_scale)


def _driven(
    outputs: HumanGSOutputs, raw: Float[Array, "h w 14"], offset_scale: float
) -> HumanGSOutputs:
    gaussians, offsets = apply_corrections(
        outputs.gaussians, raw.reshape(-1, CHANNELS), offset_scale
    )
    return replace(outputs, gaussians=gaussians, tight_offsets=offsets[:, None])


class PoseAttention(nn.Module):
    """The bottleneck of a U-Net: every texel of its maps (1, h, w, d) attends to tokens that an MLP
    makes of the pose (q,).
    """

    width: int
    tokens: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "v h w d"], pose: Float[Array, " q"]
    ) -> Float[Array, "v h w d"]:
        features = x.shape[-1]
        hidden = jax.nn.silu(nn.Dense(self.width, name="pose_0")(pose))
        context = nn.Dense(self.tokens * features, name="pose_1")(hidden).reshape(
            self.tokens, features
        )

        def dense(name):
            return nn.Dense(features, use_bias=False, name=name)

        queries, keys, values = dense("query")(x), dense("key")(context), dense("value")(context)
        attention = jax.nn.softmax(queries @ keys.T * features**-0.5, axis=-1)
        return x + dense("out")(attention @ values)
