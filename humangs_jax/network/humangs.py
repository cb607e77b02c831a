"""The network: photographs with poses in, canonical 3D Gaussians out, in one forward pass.

    encode          photos -> tokens -> transformer -> feature maps and a global token
    sample_vertices feature maps -> features of every posed body vertex, pooled over views (the upsampler's last
                    convolution is evaluated here, where it is read)
    decode          features -> K Gaussians per vertex of the canonical body

Everything is written for ONE subject; batch with `jax.vmap` over `inputs` (variables unbatched). Callers jit, with
`config` static. Lengths inside are normalised units: metres divided by s = (height of the canonical body) / 1.8, so
that every body is 1.8 high; means and scales are multiplied by s at the end, and what goes in is metric except where
said otherwise.
"""

import dataclasses
import functools
from typing import Any, Literal, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int, Key, Scalar
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.geometry.rays import plucker_rays
from humangs_jax.network.bilinear import sample_bilinear, texel_indices
from humangs_jax.network.neighborhoods import KERNEL, sample_neighborhoods
from humangs_jax.network.pixel_aligned import (
    COUNT_EPSILON,
    PixelAlignedConfig,
    dropped_reads,
    photo_colors,
    project_vertices,
    sum_over_views,
    visible_vertices,
)
from humangs_jax.network.shells import Shells, sample_shells
from humangs_jax.network.tokenizer import Packing, Tokenizer, TokenSelection, pack_patches, patchify, unpack_tokens
from humangs_jax.network.transformer import INIT_STD, Transformer, TransformerConfig
from humangs_jax.network.triplane import TriplaneConfig
from humangs_jax.network.upsampler import Readout, Upsampler, UpsamplerConfig
from humangs_jax.network.vertex_decoder import (
    SHELL_WIDTH,
    RawGaussians,
    VertexDecoder,
    VertexDecoderConfig,
    VertexFeatures,
    activate,
    decoder_input,
)
from humangs_jax.rendering.gaussians import Gaussians

TARGET_HEIGHT = 1.8
"""Height of every canonical body in normalised units."""
ENCODED_POSITION = 39
"""Width of the positional encoding of a vertex."""

Variables = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class HumanGSConfig:
    """Everything that a set of weights depends on; see `network.presets`.

    image_size: side of the photographs, pixels (recorded: the network takes any multiple of the patch size).
    patch_size: side of a token's patch, pixels. tokens: "all" patches, or those that the "foreground" touches, packed
    into `token_capacity` slots over all views (in training: over the most that a step may show, see
    `training.forward.token_share`), 0 for room for all patches. position_map, skinning, rendering: how the
    position map that comes in was shaded, and how the Gaussians are to be skinned and drawn (recorded). body_vertices,
    longest_edge: vertex count to decimate bodies to, and metres to split their edges to afterwards, None for neither
    (recorded). ray_origins: the release divides camera centres by s and the ray origins taken from them once more, so
    that the moments of its rays ("twice_normalized") fit no camera; needed to run its weights. dtype: of the encoder's
    products; parameters, norms, softmax statistics and the decoder stay float32 at least.
    """

    image_size: int = 512
    patch_size: int = 8
    tokens: TokenSelection = "all"
    token_capacity: int = 0
    position_map: Literal["plain", "gouraud"] = "plain"
    skinning: Literal["affine", "rotation"] = "affine"
    rendering: Literal["exact", "inria"] = "exact"
    body_vertices: int | None = None
    longest_edge: float | None = None
    ray_origins: Literal["normalized", "twice_normalized"] = "normalized"
    dtype: Literal["float32", "bfloat16"] = "float32"
    texture: TriplaneConfig = dataclasses.field(default_factory=TriplaneConfig)
    transformer: TransformerConfig = dataclasses.field(default_factory=TransformerConfig)
    upsampler: UpsamplerConfig = dataclasses.field(default_factory=UpsamplerConfig)
    sampling: PixelAlignedConfig = dataclasses.field(default_factory=PixelAlignedConfig)
    decoder: VertexDecoderConfig = dataclasses.field(default_factory=VertexDecoderConfig)

    def __post_init__(self):
        """Raises ValueError for sizes that do not fit together."""
        transformer, decoder = self.transformer, self.decoder
        if self.image_size % self.patch_size:
            raise ValueError(f"image_size {self.image_size} is no multiple of patch_size {self.patch_size}")
        if transformer.width % transformer.attention.head_width:
            raise ValueError(
                f"width {transformer.width} is no multiple of head_width {transformer.attention.head_width}"
            )
        quarters = self.upsampler.enabled and self.upsampler.features == "intermediate"
        if transformer.layers < 1 or (quarters and (transformer.layers < 4 or transformer.layers % 2)):
            raise ValueError(f"layers must be even and at least 4, to have quarters; got {transformer.layers}")
        if decoder.residual_color and not self.sampling.sample_rgb:
            raise ValueError("decoder.residual_color needs sampling.sample_rgb: there is no photo colour to correct")
        if self.sampling.shells and decoder.frame != "normal":
            raise ValueError('network.shells lie along the normals: they need decoder.frame = "normal"')
        if decoder.gaussians_per_vertex < 1:
            raise ValueError("decoder: tight + free must be at least 1")

    @property
    def compute_dtype(self) -> Any:
        """For Linen modules; None promotes inputs and parameters, so that float64 stays float64."""
        return jnp.bfloat16 if self.dtype == "bfloat16" else None

    @property
    def readout(self) -> Readout:
        """The upsampler's last convolution."""
        return Readout(self.upsampler.out, self.upsampler.hidden // 2, self.compute_dtype)

    @property
    def decoder_width(self) -> int:
        """Numbers that enter the decoder per vertex."""
        width = self.transformer.width
        local = self.upsampler.out if self.upsampler.enabled else width
        return (
            local
            + width * self.transformer.class_token
            + ENCODED_POSITION
            + 4 * self.sampling.sample_rgb
            + SHELL_WIDTH * len(self.sampling.shells)
            + 3 * (self.decoder.frame == "normal")
        )


@pytree_dataclass
class HumanGSInputs:
    """What the network is told of one subject.

    images: (v, h, w, 3) in [0, 1], white background. cameras: a batch of v, metric. posed_vertices: (v, n, 3) metric,
    the body in the pose of each photo. canonical_vertices: (n, 3) metric, T-pose. position_maps: (v, h, w, 3) canonical
    position of each pixel, normalised units, 1 on background. depth_maps: (v, h, w) rasterized z, normalised units, -1
    on background. foreground: (v, h, w) pixels of the person (used by `tokens = "foreground"`). view_count: views beyond
    the first so many are padding, whatever they show, and change nothing; None: none is. posed_normals: (v, n, 3)
    unit, used with `network.shells`. canonical_normals: (n, 3) unit, used with `decoder.frame = "normal"`.
    """

    images: Float[Array, "v h w 3"]
    cameras: Camera
    posed_vertices: Float[Array, "v n 3"]
    canonical_vertices: Float[Array, "n 3"]
    position_maps: Float[Array, "v h w 3"]
    depth_maps: Float[Array, "v h w"]
    foreground: Bool[Array, "v h w"]
    view_count: Int[Array, ""] | None = None
    posed_normals: Float[Array, "v n 3"] | None = None
    canonical_normals: Float[Array, "n 3"] | None = None

    @property
    def present(self) -> Bool[Array, " v"]:
        """Which views are no padding."""
        views = jnp.arange(len(self.images))
        return views < (len(self.images) if self.view_count is None else self.view_count)


class Encoding(NamedTuple):
    """What the encoder makes of the photographs: maps, global_token = encode(variables, inputs, config).

    maps: (v, h', w', d) maps, read by vertices through `Readout` where there is an upsampler. global_token: (d',) or None
    without a class token.
    """

    maps: Float[Array, "v h w d"]
    global_token: Float[Array, " e"] | None


@pytree_dataclass
class HumanGSOutputs:
    """Canonical Gaussians of one subject.

    gaussians: g = n * k of them, metric, vertex-major, k fastest. tight_offsets: (n, k_tight, 3) from the vertex,
    normalised units (for the tightness loss). skinning_offsets: (n * k, j) logits of the skinning head, or None (see
    `vertex_decoder.corrected_skinning_weights`). dropped_tokens: foreground
    patches that the token capacity had no room for. dropped_reads: vertices, summed over views, that
    `sampling.vertex_capacity` had no room for.
    """

    gaussians: Gaussians
    tight_offsets: Float[Array, "n t 3"]
    skinning_offsets: Float[Array, "g j"] | None
    dropped_tokens: Int[Array, ""]
    dropped_reads: Int[Array, ""]


class Encoder(nn.Module):
    """Pixels of all views (v, h, w, 12: rgb, rays, canonical position) -> maps (v, h', w', d), global token."""

    config: HumanGSConfig
    axis_name: str | tuple[str, ...] | None = None

    @nn.compact
    def __call__(
        self,
        pixels: Float[Array, "v h w 12"],
        packing: Packing | None = None,
        view_count: Int[Array, ""] | None = None,
        train: bool = False,
    ) -> tuple[Float[Array, "v i j d"], Float[Array, " e"] | None]:
        config, dtype = self.config, self.config.compute_dtype
        width = config.transformer.width
        patches = patchify(pixels, config.patch_size)
        patch_count = len(patches)
        grid = (pixels.shape[0], pixels.shape[1] // config.patch_size, pixels.shape[2] // config.patch_size)
        if packing is not None:
            patches = patches.at[packing.indices].get(mode="fill", fill_value=0)
        tokens = Tokenizer(width, config.texture, dtype, name="tokenizer")(patches)
        count = None if view_count is None else view_count * (grid[1] * grid[2])
        if packing is not None:
            count = packing.count
        if config.transformer.class_token:
            class_token = self.param("class_token", nn.initializers.truncated_normal(INIT_STD), (1, width))
            tokens = jnp.concatenate([class_token.astype(tokens.dtype), tokens])
            count = None if count is None else count + 1

        depths = Transformer(config.transformer, dtype, name="transformer")(tokens, count)
        global_token = depths[-1][0] if config.transformer.class_token else None
        if config.transformer.class_token:
            depths = [x[1:] for x in depths]
        if not config.upsampler.enabled or config.upsampler.features == "final":
            depths = depths[-1:]
        if packing is not None:
            depths = [unpack_tokens(x, packing, patch_count) for x in depths]
        maps = [x.reshape(*grid, width) for x in depths]
        if not config.upsampler.enabled:
            return maps[0], global_token
        present = None if view_count is None else jnp.arange(grid[0]) < view_count
        return Upsampler(config.upsampler, dtype, self.axis_name, name="upsampler")(maps, train, present), global_token


def subject_unit(canonical_vertices: Float[Array, "n 3"]) -> Scalar:
    """s, metres per normalised unit: the canonical body's height over 1.8."""
    y = canonical_vertices[:, 1]
    return (jnp.max(y) - jnp.min(y)) / TARGET_HEIGHT


@functools.partial(jax.jit, static_argnames="config")
def init_humangs(key: Key, config: HumanGSConfig) -> Variables:
    """Fresh variables {"params": {"encoder", "decoder", "readout"}, "batch_stats": {"encoder"}}, float32.

    Without an upsampler there is neither "readout" nor anything in "batch_stats".
    """
    encoder_key, decoder_key = jax.random.split(key)
    pixels = jnp.zeros((1, 2 * config.patch_size, 2 * config.patch_size, 12))
    encoder = Encoder(config).init(encoder_key, pixels)
    decoder = VertexDecoder(config.decoder, len(config.sampling.shells)).init(
        decoder_key, jnp.zeros((1, config.decoder_width))
    )
    params = {"encoder": encoder["params"], "decoder": decoder["params"]}
    if config.upsampler.enabled:
        neighborhoods = jnp.zeros((1, KERNEL**2 * config.readout.channels))
        params["readout"] = config.readout.init(jax.random.fold_in(key, 2), neighborhoods, jnp.zeros(1))["params"]
    batch_stats = {"encoder": encoder["batch_stats"]} if "batch_stats" in encoder else {}
    return {"params": params, "batch_stats": batch_stats}


def touched_patches(inputs: HumanGSInputs, config: HumanGSConfig) -> Int[Array, ""]:
    """How many patches the foreground touches, over all views: the token capacity that these photographs need."""
    return jnp.sum(_touched(inputs, config), dtype=jnp.int32)


def dropped_tokens(inputs: HumanGSInputs, config: HumanGSConfig) -> Int[Array, ""]:
    """How many foreground patches the token capacity has no room for."""
    packing = select_tokens(inputs, config)
    return jnp.zeros((), jnp.int32) if packing is None else touched_patches(inputs, config) - packing.count


def select_tokens(inputs: HumanGSInputs, config: HumanGSConfig) -> Packing | None:
    """Which patches become tokens; None for all of them."""
    if config.tokens == "all":
        return None
    touched = _touched(inputs, config)
    return pack_patches(touched, min(config.token_capacity or len(touched), len(touched)))


def _touched(inputs, config):
    foreground = inputs.foreground & inputs.present[:, None, None]
    return jnp.any(patchify(foreground[..., None].astype(jnp.float32), config.patch_size) > 0, axis=(1, 2))


def encoder_pixels(inputs: HumanGSInputs, config: HumanGSConfig) -> Float[Array, "v h w 12"]:
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
    ray_cameras = cameras.in_units(unit) if config.ray_origins == "twice_normalized" else cameras
    rays = jax.vmap(plucker_rays)(ray_cameras).astype(inputs.images.dtype)
    return jnp.concatenate([inputs.images, rays, inputs.position_maps], axis=-1)


def encode_with_statistics(
    variables: Variables,
    inputs: HumanGSInputs,
    config: HumanGSConfig,
    train: bool = False,
    axis_name: str | tuple[str, ...] | None = None,
) -> tuple[Encoding, Variables]:
    """`encode`, and the running batch statistics: updated ones if `train`, the given ones otherwise."""
    pixels = encoder_pixels(inputs, config)
    packing = select_tokens(inputs, config)

    batch_stats = variables["batch_stats"]
    own = {"params": variables["params"]["encoder"]}
    if batch_stats:
        own["batch_stats"] = batch_stats["encoder"]
    update = train and bool(batch_stats)
    mutable = ["batch_stats"] if update else False
    result = Encoder(config, axis_name).apply(own, pixels, packing, inputs.view_count, train, mutable=mutable)
    if update:
        result, updated = cast(tuple[Any, Variables], result)
        batch_stats = {"encoder": updated["batch_stats"]}
    maps, global_token = cast(tuple[Array, Array | None], result)
    return Encoding(maps, global_token), batch_stats


@functools.partial(jax.jit, static_argnames="config")
def encode(variables: Variables, inputs: HumanGSInputs, config: HumanGSConfig) -> Encoding:
    """Photographs -> feature maps and global token, with the running batch statistics.

    Raises ValueError if images and cameras differ in size, or the patch size does not divide it.
    """
    return encode_with_statistics(variables, inputs, config)[0]


@functools.partial(jax.jit, static_argnames="config")
def sample_vertices(
    variables: Variables, encoding: Encoding, inputs: HumanGSInputs, config: HumanGSConfig
) -> VertexFeatures:
    """Feature maps (and photographs, if configured) at the projections of the posed vertices, pooled over views.

    Raises: ValueError if the configuration needs normals that the inputs lack.
    """
    sampling = config.sampling
    if config.decoder.frame == "normal" and inputs.canonical_normals is None:
        raise ValueError('decoder.frame "normal" needs canonical_normals of the inputs, see `prepare_inputs`')
    pixels, visible = project_and_test(inputs, config)
    weights = _view_weights(visible, inputs, config).astype(pixels.dtype)
    size = (inputs.cameras.width, inputs.cameras.height)
    indices = texel_indices(pixels, size, (encoding.maps.shape[2], encoding.maps.shape[1]), sampling.convention)
    read = sample_neighborhoods if config.upsampler.enabled else sample_bilinear
    sums = sum_over_views(read, encoding.maps, indices, weights, sampling.vertex_capacity)
    local = jax.tree.map(lambda x: jnp.einsum("n...,n->n...", x, 1 / (jnp.sum(weights, axis=0) + COUNT_EPSILON)), sums)
    if config.upsampler.enabled:
        local = config.readout.apply({"params": variables["params"]["readout"]}, *local)
    features = VertexFeatures(
        cast(Array, local),
        encoding.global_token,
        normals=inputs.canonical_normals if config.decoder.frame == "normal" else None,
        dropped_reads=dropped_reads(weights, sampling.vertex_capacity),
    )
    if sampling.shells:
        features = replace(features, shells=read_shells(inputs, config))
    if not sampling.sample_rgb:
        return features
    fraction = jnp.sum(visible, axis=0) / jnp.sum(inputs.present)
    colors = photo_colors(inputs.images, pixels, visible, sampling.convention)
    return replace(features, photo_colors=colors, visible_fraction=fraction.astype(pixels.dtype))


def read_shells(inputs: HumanGSInputs, config: HumanGSConfig) -> Shells:
    """The photographs at points off the surface. Raises ValueError if the inputs have no normals."""
    if inputs.posed_normals is None:
        raise ValueError("network.shells needs posed_normals of the inputs, see `prepare_inputs`")
    unit = subject_unit(inputs.canonical_vertices)
    return sample_shells(
        inputs.images,
        inputs.foreground,
        inputs.depth_maps,
        inputs.cameras.in_units(unit),
        inputs.posed_vertices / unit,
        inputs.posed_normals,
        config.sampling.shells,
        inputs.present,
        config.sampling.convention,
    )


def project_and_test(inputs: HumanGSInputs, config: HumanGSConfig) -> tuple[Float[Array, "v n 2"], Bool[Array, "v n"]]:
    """Pixel positions of the posed vertices in every view, and which of them it sees; padding sees none."""
    unit = subject_unit(inputs.canonical_vertices)
    cameras, vertices = inputs.cameras.in_units(unit), inputs.posed_vertices / unit
    pixels, depths = jax.vmap(project_vertices)(cameras, vertices)
    size = (cameras.width, cameras.height)
    see = lambda p, z, surface: visible_vertices(p, z, surface, size, config.sampling.convention)
    return pixels, jax.vmap(see)(pixels, depths, inputs.depth_maps) & inputs.present[:, None]


def _view_weights(visible, inputs, config):
    return visible if config.sampling.pool == "visible" else jnp.broadcast_to(inputs.present[:, None], visible.shape)


def read_vertices(inputs: HumanGSInputs, config: HumanGSConfig) -> Int[Array, ""]:
    """The most vertices that any view is read for: the `sampling.vertex_capacity` that these photographs need."""
    counted = _view_weights(project_and_test(inputs, config)[1], inputs, config)
    return jnp.max(jnp.sum(counted, axis=1, dtype=jnp.int32))


@functools.partial(jax.jit, static_argnames="config")
def decode(
    variables: Variables, features: VertexFeatures, canonical_vertices: Float[Array, "n 3"], config: HumanGSConfig
) -> HumanGSOutputs:
    """Features of vertices -> canonical Gaussians, metric; `dropped_tokens` is 0 (the encoder's business)."""
    raw = decode_heads(variables, features, canonical_vertices, config)
    return assemble(raw, features, canonical_vertices, config)


def decode_heads(
    variables: Variables, features: VertexFeatures, canonical_vertices: Float[Array, "n 3"], config: HumanGSConfig
) -> RawGaussians:
    """The first half of `decode`: heads before their activations."""
    entering = decoder_input(features, canonical_vertices / subject_unit(canonical_vertices))
    own = {"params": variables["params"]["decoder"]}
    return cast(RawGaussians, VertexDecoder(config.decoder, len(config.sampling.shells)).apply(own, entering))


def assemble(
    raw: RawGaussians, features: VertexFeatures, canonical_vertices: Float[Array, "n 3"], config: HumanGSConfig
) -> HumanGSOutputs:
    """The second half of `decode`: activations, and lengths in metres."""
    unit = subject_unit(canonical_vertices)
    canonical = canonical_vertices / unit
    at_vertices = activate(raw, config.decoder, features)
    flat = lambda x: x.reshape(-1, *x.shape[2:])
    gaussians = Gaussians(
        means=flat(canonical[:, None] + at_vertices.offsets) * unit,
        quats=flat(at_vertices.quats),
        scales=flat(at_vertices.scales) * unit,
        opacities=flat(at_vertices.opacities),
        colors=flat(at_vertices.colors),
    )
    return HumanGSOutputs(
        gaussians=gaussians,
        tight_offsets=at_vertices.offsets[:, : config.decoder.tight],
        skinning_offsets=None if raw.skinning is None else flat(raw.skinning),
        dropped_tokens=jnp.zeros((), jnp.int32),
        dropped_reads=jnp.zeros((), jnp.int32) if features.dropped_reads is None else features.dropped_reads,
    )


def apply_humangs(
    variables: Variables,
    inputs: HumanGSInputs,
    config: HumanGSConfig,
    train: bool = False,
    axis_name: str | tuple[str, ...] | None = None,
) -> tuple[HumanGSOutputs, Variables]:
    """The whole network for one subject: outputs and batch statistics.

    train: normalise by this subject's statistics and return updated running ones. Under a vmap over subjects give the
    vmap's `axis_name` to share the statistics over the batch; without it each subject has its own, to be averaged.
    Raises: see `encode` and `sample_vertices`.
    """
    encoding, batch_stats = encode_with_statistics(variables, inputs, config, train, axis_name)
    features = sample_vertices(variables, encoding, inputs, config)
    outputs = decode(variables, features, inputs.canonical_vertices, config)
    return replace(outputs, dropped_tokens=dropped_tokens(inputs, config)), batch_stats
