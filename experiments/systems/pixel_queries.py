"""LVSM-style and HumanRAM-style: one transformer makes the pixels of a target from photos. No Gaussians, no 3D.

LVSM, decoder-only (Jin et al. 2024, https://arxiv.org/abs/2410.17242): patches of the photos (rgb and rays, 9 channels) and
of the target (rays, 6) are tokens with a linear map each; all attend to all; a linear map turns the target's tokens into
pixels. Trained with squared error and 0.5 VGG-19. It knows no body: it shows other views of the pose in the photos, CANNOT be
animated, and the pose of a target changes nothing. HumanRAM (Yu et al. 2025, https://arxiv.org/abs/2506.03118) adds a neural
texture of the body, read at the position maps of photos and of the target (57 and 54 channels): the target's pose enters
through its position map alone. A residual convolutional decoder fuses its target tokens of four depths. Trained with squared
error and 1.0 VGG.

Every target is a pass of its own through the whole transformer: photos attend to the target, so nothing of a person can be
kept from one target to the next, and a frame costs as much as the first one.

Our reading: the neural texture and blocks are those of this package. HumanRAM's code is not public: its decoder here adds the
four depths, from the last to the first, each followed by a residual block, and doubles the sides until a token has its
pixels.
"""

import dataclasses
from typing import Annotated, Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.configuration import Patch, Range, part
from humangs_jax.network.convolution import Convolution
from humangs_jax.network.encoder import TEXTURE_STD, TriplaneConfig, encoder_pixels, patchify, sample_triplane
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.parts import Encoding, HumanGSOutputs, Pass, Variables, scene_outputs
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import INIT_STD, Transformer, TransformerConfig
from humangs_jax.network.upsampler import KAIMING, SLOPE, UpConvolution

LEAST_WIDTH = 8
"""Of the maps of the convolutional decoder, whose width halves as their sides double."""


@part
class NoReader:
    """The reader of systems whose decoders read the inputs themselves: its features are the encoding."""

    def init(self, key: Key, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{}: nothing is learned."""
        return {}

    def apply(self, variables: Variables, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Encoding:
        """The encoding."""
        return encoding


class Photos(NamedTuple):
    """pixels: (v, h, w, 12) rgb, ray, canonical position. view_count: as in `HumanGSInputs`."""

    pixels: Float[Array, "v h w 12"]
    view_count: Int[Array, ""] | None


@part
class QueryDecoder:
    """A `PixelDecoder`. transformer: without a class token. texture: the neural texture (HumanRAM), None: the body is unknown
    (LVSM). fusion: width of the convolutional decoder, which needs a patch size that is a power of 2; None: the linear map.
    patch_size: of photos and targets.
    """

    transformer: TransformerConfig = dataclasses.field(default_factory=lambda: lvsm_transformer(24))
    texture: TriplaneConfig | None = None
    fusion: Annotated[int, Range(2, 16_384)] | None = None
    patch_size: Patch = 8

    def __post_init__(self):
        """Raises ValueError for a class token, or too few layers to fuse four depths."""
        if self.transformer.class_token:
            raise ValueError("decoder.transformer.class_token: expected false, there is no global token here")
        if self.fusion is not None and self.transformer.layers < 4:
            raise ValueError(f"decoder.fusion needs at least 4 layers, got {self.transformer.layers}")

    def init(self, key: Key, features: Any, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params"} of `QueryModule`."""
        photos = jnp.zeros((*inputs.images.shape[:-1], 12))
        return cast(Variables, self._module(run).init(key, photos, photos[0, ..., :9]))

    def apply(self, variables: Variables, features: Any, inputs: HumanGSInputs, run: Pass) -> HumanGSOutputs:
        """No Gaussians; what `draw` needs of the photos."""
        pixels = run.stage("pixels", lambda: encoder_pixels(inputs, run))
        return scene_outputs(Photos(pixels, inputs.view_count))

    def draw(
        self, variables: Variables, scene: Photos, queries: Float[Array, "v h w 9"], run: Pass
    ) -> Float[Array, "v h w 3"]:
        """Images of the targets, a pass each."""

        @jax.checkpoint
        def one(query):
            return self._module(run).apply(variables, scene.pixels, query, scene.view_count)

        return jax.lax.map(one, queries)

    def _module(self, run):
        return QueryModule(self, self.patch_size, run.runtime)


def lvsm_transformer(layers: int) -> TransformerConfig:
    """LVSM's blocks: width 768, heads of 64 with normalised queries and keys."""
    return TransformerConfig(width=768, layers=layers, class_token=False)


class QueryModule(nn.Module):
    """Photos (v, h, w, 12: rgb, ray, position) and pixels of one target (i, j, 9: ray, position) -> its colors (i, j, 3)."""

    config: QueryDecoder
    patch: int
    runtime: Runtime

    @nn.compact
    def __call__(
        self,
        photos: Float[Array, "v h w 12"],
        query: Float[Array, "i j 9"],
        view_count: Int[Array, ""] | None = None,
    ) -> Float[Array, "i j 3"]:
        config, patch, dtype = self.config, self.patch, self.runtime.compute_dtype
        width, rays = config.transformer.width, (photos[..., 3:9], query[..., :6])
        seen, asked = rays
        if config.texture is not None:
            shape = (3, config.texture.resolution, config.texture.resolution, config.texture.channels)
            texture = self.param("texture", nn.initializers.normal(TEXTURE_STD), shape)
            positions = (photos[..., 9:], query[..., 6:])
            seen, asked = (
                jnp.concatenate([ray, sample_triplane(texture, at)], axis=-1)
                for ray, at in zip(rays, positions, strict=True)
            )

        def linear(features, name):
            init = nn.initializers.normal(INIT_STD)
            return nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=init, name=name)

        def tokens_of(maps, name):
            patches = patchify(maps, patch)
            return linear(width, name)(patches.reshape(len(patches), -1))

        seen = tokens_of(jnp.concatenate([2 * photos[..., :3] - 1, seen], axis=-1), "photo_tokens")
        asked = tokens_of(asked[None], "target_tokens")
        targets = len(asked)
        # the target comes first: photos that are padding are the last tokens
        count = None if view_count is None else targets + view_count * (len(seen) // len(photos))
        depths = Transformer(config.transformer, self.runtime, name="transformer")(
            jnp.concatenate([asked, seen]), count
        )
        rows, columns = query.shape[0] // patch, query.shape[1] // patch
        maps = [x[:targets].reshape(1, rows, columns, width) for x in depths]
        if config.fusion is not None:
            return jax.nn.sigmoid(FusionHead(config.fusion, patch, dtype, name="fusion")(maps)[0])
        pixels = linear(3 * patch**2, "rgb")(maps[-1]).reshape(rows, columns, patch, patch, 3)
        return jax.nn.sigmoid(jnp.swapaxes(pixels, 1, 2).reshape(*query.shape[:2], 3))


class FusionHead(nn.Module):
    """Token maps of four depths, each (1, h, w, d) -> (1, patch h, patch w, 3), before the sigmoid."""

    hidden: int
    patch: int
    dtype: Any = None

    @nn.compact
    def __call__(self, maps: list[Float[Array, "v h w d"]]) -> Float[Array, "v i j 3"]:
        if self.patch & (self.patch - 1):
            raise ValueError(f"decoder.fusion: patch_size {self.patch}: expected a power of 2")
        activate = lambda x: jax.nn.leaky_relu(x, SLOPE)
        convolution = lambda features, name: Convolution(features, KAIMING, self.dtype, name=name)

        def residual(x, name):
            inner = convolution(x.shape[-1], f"{name}_0")(activate(x))
            return x + convolution(x.shape[-1], f"{name}_1")(activate(inner))

        project = lambda i: nn.Dense(self.hidden, dtype=self.dtype, name=f"project_{i}")(maps[i])
        last = len(maps) - 1
        x = residual(project(last), f"fuse_{last}")
        for i in reversed(range(last)):
            x = residual(x + project(i), f"fuse_{i}")
        for i in range(self.patch.bit_length() - 1):
            width = max(LEAST_WIDTH, self.hidden >> (i + 1))
            x = activate(UpConvolution(width, self.dtype, name=f"up_{i}")(x))
        return Convolution(3, nn.initializers.normal(INIT_STD), self.dtype, name="rgb")(x)
