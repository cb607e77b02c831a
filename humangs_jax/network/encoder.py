"""The paper's encoder: photos -> patches -> tokens of all views -> transformer -> feature maps and
a global token.

Channel order of a pixel: 2 rgb - 1 (3), moment (3), direction (3), texture planes xy, xz, yz.
Channels run fastest inside a pixel, pixels row-major inside a patch, patches row-major inside a
view, views in their order.

The neural texture is three feature planes over the canonical body, read at canonical positions. The
first named axis of a plane is the horizontal texture coordinate. Positions in [-1, 1] span a plane
from the centre of its first texel to the centre of its last texel (`align_corners=True`). Outside
of the texels the features are 0.
"""

from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.compiled import compiled
from humangs_jax.core.configuration import Patch, Side, Width, configuration, knob, part
from humangs_jax.core.loops import one_after_the_other
from humangs_jax.geometry.camera import plucker_rays
from humangs_jax.network.maps import OUTSIDE, sample_bilinear
from humangs_jax.network.parts import (
    Encoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    Packing,
    subject_unit,
)
from humangs_jax.network.transformer import INIT_STD, Transformer, TransformerConfig
from humangs_jax.network.upsampler import Upsampler, UpsamplerConfig
from humangs_jax.rendering.mesh.rasterizer import BACKGROUND

TEXTURE_STD = 0.1
"""Standard deviation of the neural texture before training."""
NOWHERE = 3.0
"""Value of all channels of the pixels in slots that hold no patch. As a canonical position it lies
outside of the neural texture, so that such pixels add nothing to the texture's gradient.
"""


@configuration
class TriplaneConfig:
    """Size of the neural texture."""

    resolution: Side = 128
    """Texels along each side of a plane."""
    channels: Width = 16
    """Features per texel."""


def sample_triplane(
    texture: Float[Array, "3 r r c"], positions: Float[Array, "*p 3"]
) -> Float[Array, "*p 3*c"]:
    """Returns the features of the neural texture at canonical positions, (..., 3 c): the features
    of plane xy, then of xz, then of yz. positions: (..., 3), normalised units.
    """
    # indices from the middle have a third of the rounding of (positions + 1) * middle
    middle = (texture.shape[1] - 1) / 2
    indices = positions * middle
    # Nearly half of the pixels of photos show the background, and all of them read the last texel
    # of each plane. Its gradient is one sum here: an accelerator's additions to one place would
    # wait for each other. A CPU adds one after the other anyway.
    apart = not one_after_the_other()
    background = jnp.all(positions == BACKGROUND, axis=-1, keepdims=True)
    if apart:
        indices = jnp.where(background, OUTSIDE - middle, indices)
    planes = zip(texture, ([0, 1], [0, 2], [1, 2]), strict=True)
    read = jnp.concatenate(
        [sample_bilinear(plane, indices[..., axes], middle) for plane, axes in planes], axis=-1
    )
    if apart:
        read = jnp.where(background, texture[:, -1, -1].reshape(-1), read)
    return read


def patchify(maps: Float[Array, "v h w c"], patch: int) -> Float[Array, "p pixels c"]:
    """Returns square patches of maps, (p, pixels, c). Raises: ValueError unless the patch size
    divides both sides.
    """
    views, height, width, channels = maps.shape
    if height % patch or width % patch:
        raise ValueError(
            f"images of {width} x {height} cannot be cut into patches of {patch} x {patch} pixels"
        )
    x = maps.reshape(views, height // patch, patch, width // patch, patch, channels)
    return jnp.swapaxes(x, 2, 3).reshape(-1, patch * patch, channels)


def pack_patches(foreground: Bool[Array, " p"], capacity: int) -> Packing:
    """Returns the foreground patches in their order, one for each of `capacity` slots. Patches
    beyond the capacity are left out.
    """
    indices = jnp.nonzero(foreground, size=capacity, fill_value=foreground.shape[0])[0]
    return Packing(indices, jnp.minimum(jnp.sum(foreground), capacity))


def _unpack_tokens(
    tokens: Float[Array, "l d"], packing: Packing, patches: int
) -> Float[Array, "p d"]:
    """Returns the tokens at their patches, (p, d), and zeros at patches without a token."""
    return (
        jnp.zeros((patches, tokens.shape[1]), tokens.dtype)
        .at[packing.indices]
        .set(tokens, mode="drop")
    )


class Tokenizer(nn.Module):
    """Makes tokens (l, d) from patches of pixels (l, pixels, 12: rgb, rays, canonical position). It
    holds the neural texture.
    """

    width: int
    """Features of a token, d."""
    texture: TriplaneConfig
    """Size of the neural texture."""
    dtype: Any = None
    """Type of the matrix product; None: the type of the parameters."""

    @nn.compact
    def __call__(self, patches: Float[Array, "l pixels 12"]) -> Float[Array, "l d"]:
        shape = (3, self.texture.resolution, self.texture.resolution, self.texture.channels)
        texture = self.param("texture", nn.initializers.normal(TEXTURE_STD), shape)
        rgb, rays, positions = jnp.split(patches, (3, 9), axis=-1)
        pixels = jnp.concatenate([2 * rgb - 1, rays, sample_triplane(texture, positions)], axis=-1)
        init = nn.initializers.normal(INIT_STD)
        dense = nn.Dense(
            self.width, use_bias=False, dtype=self.dtype, kernel_init=init, name="linear"
        )
        return dense(pixels.reshape(pixels.shape[0], -1))


@part
class PatchTransformer(Encoder):
    """The paper's encoder: one token per patch of every view (or per patch in the foreground),
    attention over all tokens, and an upsampler.
    """

    patch_size: Patch = 8
    """Side of a token's patch, pixels."""
    geometry: Literal["rays_and_positions", "place"] = "rays_and_positions"
    """What the encoder knows of a pixel besides its color. "rays_and_positions": its ray, and the
    canonical position that it shows. "place": only its place in the photo, for systems whose photos
    have neither cameras nor poses.
    """
    texture: TriplaneConfig = TriplaneConfig()
    """Size of the neural texture that every pixel looks up."""
    transformer: TransformerConfig = TransformerConfig()
    """Sizes of the transformer over the tokens of all views."""
    upsampler: UpsamplerConfig | None = knob(
        UpsamplerConfig(),
        cost="vertices read maps of one feature vector per patch",
        gain="440 GFLOP of the published network at 512",
        measured="performance.md",
    )
    """Sizes of the upsampler. None: there is no upsampler, and the maps are the tokens of the last
    layer.
    """

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        super().__post_init__()
        layers = self.transformer.layers
        quarters = self.upsampler is not None and self.upsampler.features == "intermediate"
        if quarters and (layers < 4 or layers % 2):
            raise ValueError(f"layers must be even and at least 4, to have quarters; got {layers}")

    @nn.compact
    def __call__(self, inputs: HumanGSInputs, ctx: ForwardContext) -> Encoding:
        """Returns feature maps and a global token of the photos, see `parts.Encoding`.

        Raises: ValueError if images are not made of whole patches. If the encoder looks at rays,
        also as `encoder_pixels`.
        """
        dtype, patch_size = ctx.runtime.compute_dtype, self.patch_size
        views = len(inputs.images)
        height, width = (side // patch_size for side in inputs.images.shape[1:3])

        # the patches that become tokens: those of all views, or those in the foreground
        see = _photo_pixels
        if self.geometry == "rays_and_positions":
            see = encoder_pixels
        patches = patchify(see(inputs, ctx), patch_size)
        if ctx.tokens == "foreground":
            chosen = _foreground_patches(patches, inputs, ctx, patch_size)
        else:
            chosen = _all_patches(patches, inputs.view_count, height, width)

        # their tokens, behind the one of the whole subject
        features, class_token = self.transformer.width, self.transformer.class_token
        tokens = Tokenizer(features, self.texture, dtype, name="tokenizer")(chosen.patches)
        count = chosen.count
        if class_token:
            first = self.param(
                "class_token", nn.initializers.truncated_normal(INIT_STD), (1, features)
            )
            tokens = jnp.concatenate([first.astype(tokens.dtype), tokens])
            if count is not None:
                count = count + 1

        # the layers that are read, without the token of the whole subject
        depths = Transformer(self.transformer, ctx.runtime, name="transformer")(tokens, count)
        global_token = None
        if class_token:
            global_token = depths[-1][0]
            depths = [x[1:] for x in depths]
        if self.upsampler is None or self.upsampler.features == "final":
            depths = depths[-1:]

        # their maps; patches without a token are 0
        if chosen.packing is not None:
            depths = [_unpack_tokens(x, chosen.packing, views * height * width) for x in depths]
        maps = [x.reshape(views, height, width, features) for x in depths]
        if self.upsampler is None:
            result = maps[0]
        else:
            real_views = None
            if inputs.view_count is not None:
                real_views = jnp.arange(views) < inputs.view_count
            upsampler = Upsampler(self.upsampler, dtype, ctx.axis_name, name="upsampler")
            result = upsampler(maps, ctx.train, real_views)
        return Encoding(result, global_token, chosen.dropped, chosen.packing, patch_size)


class _ChosenPatches(NamedTuple):
    """The patches that become tokens."""

    patches: Float[Array, "l pixels 12"]
    """Pixels of the patches, (l, pixels, 12)."""
    count: Int[Array, ""] | None
    """Number of real patches, which come first. The others are padding. None: all are real."""
    dropped: Int[Array, ""]
    """Number of foreground patches for which the token capacity had no room."""
    packing: Packing | None
    """Which patches they are. None: all patches of all views."""


def _all_patches(
    patches: Float[Array, "p pixels 12"], view_count: Int[Array, ""] | None, height: int, width: int
) -> _ChosenPatches:
    """Returns all patches of all views. Views beyond `view_count` are padding, and so are their
    patches. height, width: number of patches along the sides of a view.
    """
    count = None
    if view_count is not None:
        count = view_count * height * width
    return _ChosenPatches(patches, count, dropped=jnp.zeros((), jnp.int32), packing=None)


def _foreground_patches(
    patches: Float[Array, "p pixels 12"],
    inputs: HumanGSInputs,
    ctx: ForwardContext,
    patch_size: int,
) -> _ChosenPatches:
    """Returns the patches that the foreground touches, packed to the front of the token capacity.
    The slots behind them are padding.
    """
    touched = touched_patches(inputs.foreground, inputs.view_count, patch_size)
    capacity = min(ctx.runtime.token_capacity or len(touched), len(touched))
    packing = pack_patches(touched, capacity)
    dropped = jnp.sum(touched, dtype=jnp.int32) - packing.count
    packed = patches.at[packing.indices].get(mode="fill", fill_value=NOWHERE)
    return _ChosenPatches(packed, packing.count, dropped, packing)


def encoder_pixels(inputs: HumanGSInputs, ctx: ForwardContext) -> Float[Array, "v h w 12"]:
    """Returns the encoder's input at every pixel, (v, h, w, 12): rgb, ray (moment, direction),
    canonical position.

    Raises: ValueError if images and cameras differ in size, or if cameras have distortion or a lens
    other than a pinhole.
    """
    height, width = inputs.images.shape[1:3]
    if (inputs.cameras.width, inputs.cameras.height) != (width, height):
        raise ValueError(
            f"images are {width} x {height} but their cameras say {inputs.cameras.width} x"
            f" {inputs.cameras.height}"
        )
    unit = subject_unit(inputs.canonical_vertices)
    cameras = inputs.cameras.in_units(unit)
    if ctx.conventions.ray_origins == "twice_normalized":
        cameras = cameras.in_units(unit)
    rays = jax.vmap(plucker_rays)(cameras).astype(inputs.images.dtype)
    return jnp.concatenate([inputs.images, rays, inputs.position_maps], axis=-1)


def _photo_pixels(inputs: HumanGSInputs, ctx: ForwardContext) -> Float[Array, "v h w 12"]:
    """Returns the input of an encoder without cameras and poses at every pixel, (v, h, w, 12).

    Three channels are rgb. Six replace the ray: the place (x, y) of the pixel in the photo, in [-1,
    1], sin(pi x), sin(pi y), cos(pi x) and cos(pi y). Three zeros replace the canonical position.
    """
    height, width = inputs.images.shape[1:3]

    def at(size):
        return (jnp.arange(size, dtype=inputs.images.dtype) + 0.5) * (2 / size) - 1

    place = jnp.stack(jnp.meshgrid(at(width), at(height)), axis=-1)
    waves = jnp.concatenate([place, jnp.sin(jnp.pi * place), jnp.cos(jnp.pi * place)], axis=-1)
    waves = jnp.broadcast_to(waves, (*inputs.images.shape[:3], waves.shape[-1]))
    return jnp.concatenate([inputs.images, waves, jnp.zeros_like(inputs.images)], axis=-1)


def touched_patches(
    foreground: Bool[Array, "v h w"], view_count: Int[Array, ""] | None, patch_size: int
) -> Bool[Array, " p"]:
    """Returns which patches of all views the foreground touches, (p,). Views beyond `view_count`
    are padding, and their patches count as untouched.
    """
    if view_count is not None:
        foreground = foreground & (jnp.arange(len(foreground)) < view_count)[:, None, None]
    return jnp.any(patchify(foreground[..., None].astype(jnp.float32), patch_size) > 0, axis=(1, 2))


@compiled(static=["patch_size"])
def needed_tokens(
    foreground: Bool[Array, "*b v h w"], view_count: Int[Array, "*b"] | None, patch_size: int
) -> Int[Array, ""]:
    """Returns the number of patches that the foreground of one subject's photos touches. It is the
    token capacity that these photos need. For a batch of subjects, returns the largest number.
    """

    def count(*subject):
        return jnp.sum(touched_patches(*subject, patch_size), dtype=jnp.int32)

    batched = foreground.ndim == 4
    if batched:
        return jnp.max(jax.vmap(count)(foreground, view_count))
    return count(foreground, view_count)
