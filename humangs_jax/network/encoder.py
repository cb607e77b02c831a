"""Photos -> patches -> tokens of all views -> transformer -> feature maps and a global token.

Channel order of a pixel: 2 rgb - 1 (3), moment (3), direction (3), texture planes xy, xz, yz. Channels run fastest
inside a pixel, pixels row-major inside a patch, patches row-major inside a view, views in their order.

The neural texture is three feature planes over the canonical body, read at canonical positions. The first named axis of a plane
is the horizontal texture coordinate. Positions in [-1, 1] span a plane from the centre of its first texel to the centre of its
last one (`align_corners=True`); outside are zeros.
"""

import dataclasses
from typing import Any, Literal, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int, Key
from humangs_jax.core.configuration import Patch, Side, Width, configuration, knob, part
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry.camera import plucker_rays
from humangs_jax.network.bilinear import sample_bilinear
from humangs_jax.network.inputs import HumanGSInputs, subject_unit
from humangs_jax.network.parts import Encoding, Pass, Variables
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import INIT_STD, Transformer, TransformerConfig
from humangs_jax.network.upsampler import Upsampler, UpsamplerConfig

TEXTURE_STD = 0.1
PLANES = ((0, 1), (0, 2), (1, 2))


@configuration
class TriplaneConfig:
    """Size of the neural texture. resolution: texels along each side of a plane. channels: features per texel."""

    resolution: Side = 128
    channels: Width = 16


def sample_triplane(texture: Float[Array, "3 r r c"], positions: Float[Array, "*p 3"]) -> Float[Array, "*p 3*c"]:
    """Features of canonical positions (normalised units): those of plane xy, then xz, then yz."""
    middle = (texture.shape[1] - 1) / 2
    indices = positions * middle  # from the middle: a third of the rounding of (positions + 1) * middle
    planes = zip(texture, map(list, PLANES), strict=True)
    return jnp.concatenate([sample_bilinear(plane, indices[..., axes], middle) for plane, axes in planes], axis=-1)


@pytree_dataclass
class Packing:
    """Which patches became tokens.

    indices: (l,) of the kept patches, in their order; the number of patches itself where a token is padding.
    count: number of real tokens, which come first; the rest is padding.
    """

    indices: Int[Array, " l"]
    count: Int[Array, ""]


def patchify(maps: Float[Array, "v h w c"], patch: int) -> Float[Array, "p pixels c"]:
    """Cut maps into square patches. Raises ValueError unless the patch size divides both sides."""
    views, height, width, channels = maps.shape
    if height % patch or width % patch:
        raise ValueError(f"images of {width} x {height} cannot be cut into patches of {patch} x {patch} pixels")
    x = maps.reshape(views, height // patch, patch, width // patch, patch, channels)
    return jnp.swapaxes(x, 2, 3).reshape(-1, patch * patch, channels)


def pack_patches(foreground: Bool[Array, " p"], capacity: int) -> Packing:
    """Indices of the foreground patches in a static number of slots; those beyond the capacity are left out."""
    indices = jnp.nonzero(foreground, size=capacity, fill_value=foreground.shape[0])[0]
    return Packing(indices, jnp.minimum(jnp.sum(foreground), capacity))


def unpack_tokens(tokens: Float[Array, "l d"], packing: Packing, patches: int) -> Float[Array, "p d"]:
    """Tokens back at their patches, zeros elsewhere."""
    return jnp.zeros((patches, tokens.shape[1]), tokens.dtype).at[packing.indices].set(tokens, mode="drop")


class Tokenizer(nn.Module):
    """Patches of pixels (l, pixels, 12: rgb, rays, canonical position) -> tokens (l, d); owns the neural texture."""

    stage_name = "tokens"
    learned_input = False
    width: int
    texture: TriplaneConfig
    dtype: Any = None

    @nn.compact
    def __call__(self, patches: Float[Array, "l pixels 12"]) -> Float[Array, "l d"]:
        shape = (3, self.texture.resolution, self.texture.resolution, self.texture.channels)
        texture = self.param("texture", nn.initializers.normal(TEXTURE_STD), shape)
        rgb, rays, positions = jnp.split(patches, (3, 9), axis=-1)
        pixels = jnp.concatenate([2 * rgb - 1, rays, sample_triplane(texture, positions)], axis=-1)
        dense = nn.Dense(
            self.width, use_bias=False, dtype=self.dtype, kernel_init=nn.initializers.normal(INIT_STD), name="linear"
        )
        return dense(pixels.reshape(pixels.shape[0], -1))


@part
class PatchTransformer:
    """The paper's encoder: one token per patch of every view, attention over all of them, an upsampler.

    patch_size: side of a token's patch, pixels. texture: the neural texture. upsampler: None: the maps are those of the last
    layer (ablation). geometry: what a pixel knows besides its color: its ray and the canonical position seen there, or only its
    place in the photo, for systems whose photos have neither cameras nor poses.
    """

    patch_size: Patch = 8
    geometry: Literal["rays_and_positions", "place"] = "rays_and_positions"
    texture: TriplaneConfig = dataclasses.field(default_factory=TriplaneConfig)
    transformer: TransformerConfig = dataclasses.field(default_factory=TransformerConfig)
    upsampler: UpsamplerConfig | None = knob(
        UpsamplerConfig(),
        cost="vertices read maps of one feature vector per patch",
        gain="440 GFLOP of the published network at 512",
        measured="performance.md",
    )

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        layers = self.transformer.layers
        quarters = self.upsampler is not None and self.upsampler.features == "intermediate"
        if quarters and (layers < 4 or layers % 2):
            raise ValueError(f"layers must be even and at least 4, to have quarters; got {layers}")

    def init(self, key: Key, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params", "batch_stats"} of `EncoderModule`; the latter only with an upsampler."""
        pixels = jnp.zeros((1, 2 * self.patch_size, 2 * self.patch_size, 12))
        return cast(Variables, EncoderModule(self, run.runtime).init(key, pixels))

    def apply(self, variables: Variables, inputs: HumanGSInputs, run: Pass) -> tuple[Encoding, Variables]:
        """See `parts.Encoder`. Raises: ValueError if images and cameras differ in size, or are not made of whole patches."""
        see = encoder_pixels if self.geometry == "rays_and_positions" else photo_pixels
        pixels = run.stage("pixels", lambda: see(inputs, run))
        packing, dropped = None, jnp.zeros((), jnp.int32)
        if run.tokens == "foreground":
            touched = touched_patches(inputs, self.patch_size)
            packing = pack_patches(touched, min(run.runtime.token_capacity or len(touched), len(touched)))
            dropped = jnp.sum(touched, dtype=jnp.int32) - packing.count

        statistics = variables.get("batch_stats", {})
        module = EncoderModule(self, run.runtime, run.axis_name)
        update = run.train and bool(statistics)
        result = module.apply(
            variables, pixels, packing, inputs.view_count, run.train, mutable=["batch_stats"] if update else False
        )
        if update:
            result, updated = cast(tuple[Any, Variables], result)
            statistics = updated["batch_stats"]
        maps, global_token = cast(tuple[Array, Array | None], result)
        return Encoding(maps, global_token, dropped), statistics


def encoder_pixels(inputs: HumanGSInputs, run: Pass) -> Float[Array, "v h w 12"]:
    """What the encoder sees of every pixel: rgb, ray (moment, direction), canonical position.

    Raises ValueError if images and cameras differ in size.
    """
    height, width = inputs.images.shape[1:3]
    if (inputs.cameras.width, inputs.cameras.height) != (width, height):
        raise ValueError(
            f"images are {width} x {height} but their cameras say {inputs.cameras.width} x {inputs.cameras.height}"
        )
    unit = subject_unit(inputs.canonical_vertices)
    cameras = inputs.cameras.in_units(unit)
    twice = run.conventions.ray_origins == "twice_normalized"
    rays = jax.vmap(plucker_rays)(cameras.in_units(unit) if twice else cameras).astype(inputs.images.dtype)
    return jnp.concatenate([inputs.images, rays, inputs.position_maps], axis=-1)


def photo_pixels(inputs: HumanGSInputs, run: Pass) -> Float[Array, "v h w 12"]:
    """What an encoder without cameras and poses sees of every pixel: rgb, then its place (x, y) in [-1, 1] and waves of it where
    rays would be, and zeros for the canonical position.
    """
    height, width = inputs.images.shape[1:3]
    at = lambda size: (jnp.arange(size, dtype=inputs.images.dtype) + 0.5) * (2 / size) - 1
    place = jnp.stack(jnp.meshgrid(at(width), at(height)), axis=-1)
    waves = jnp.concatenate([place, jnp.sin(jnp.pi * place), jnp.cos(jnp.pi * place)], axis=-1)
    waves = jnp.broadcast_to(waves, (*inputs.images.shape[:3], waves.shape[-1]))
    return jnp.concatenate([inputs.images, waves, jnp.zeros_like(inputs.images)], axis=-1)


def touched_patches(inputs: HumanGSInputs, patch_size: int) -> Bool[Array, " p"]:
    """Which patches of all views the foreground touches."""
    foreground = inputs.foreground & inputs.present[:, None, None]
    return jnp.any(patchify(foreground[..., None].astype(jnp.float32), patch_size) > 0, axis=(1, 2))


class EncoderModule(nn.Module):
    """Pixels of all views (v, h, w, 12: rgb, rays, canonical position) -> maps (v, h', w', d), global token."""

    config: PatchTransformer
    runtime: Runtime
    axis_name: str | tuple[str, ...] | None = None

    @nn.compact
    def __call__(
        self,
        pixels: Float[Array, "v h w 12"],
        packing: Packing | None = None,
        view_count: Int[Array, ""] | None = None,
        train: bool = False,
    ) -> tuple[Float[Array, "v i j d"], Float[Array, " e"] | None]:
        config, dtype = self.config, self.runtime.compute_dtype
        width, class_token = config.transformer.width, config.transformer.class_token
        patches = patchify(pixels, config.patch_size)
        patch_count = len(patches)
        grid = (pixels.shape[0], pixels.shape[1] // config.patch_size, pixels.shape[2] // config.patch_size)
        if packing is not None:
            patches = patches.at[packing.indices].get(mode="fill", fill_value=0)
        tokens = Tokenizer(width, config.texture, dtype, name="tokenizer")(patches)
        count = None if view_count is None else view_count * (grid[1] * grid[2])
        if packing is not None:
            count = packing.count
        if class_token:
            first = self.param("class_token", nn.initializers.truncated_normal(INIT_STD), (1, width))
            tokens = jnp.concatenate([first.astype(tokens.dtype), tokens])
            count = None if count is None else count + 1

        depths = Transformer(config.transformer, self.runtime, name="transformer")(tokens, count)
        global_token = depths[-1][0] if class_token else None
        if class_token:
            depths = [x[1:] for x in depths]
        if config.upsampler is None or config.upsampler.features == "final":
            depths = depths[-1:]
        if packing is not None:
            depths = [unpack_tokens(x, packing, patch_count) for x in depths]
        maps = [x.reshape(*grid, width) for x in depths]
        if config.upsampler is None:
            return maps[0], global_token
        present = None if view_count is None else jnp.arange(grid[0]) < view_count
        return Upsampler(config.upsampler, dtype, self.axis_name, name="upsampler")(maps, train, present), global_token
