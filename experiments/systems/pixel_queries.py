"""Parts of LVSM-style and HumanRAM-style systems, in which one transformer makes the pixels of a
target from photos, without Gaussians or other 3D.

In the decoder-only LVSM (Jin et al. 2024, https://arxiv.org/abs/2410.17242) patches of the photos
(rgb and rays, 9 channels) and of the target (rays, 6 channels) become tokens by a linear map each.
All tokens attend to all. A linear map turns the target's tokens into pixels. It is trained with
squared error and 0.5 VGG-19. In LVSM's encoder-decoder photos and learned latent tokens attend to
each other, then target and latents (12 + 12 layers, 3,072 latents). LVSM knows no body. It shows
other views of the pose in the photos and CANNOT be animated: the pose of a target changes nothing.

HumanRAM (Yu et al. 2025, https://arxiv.org/abs/2506.03118) adds a neural texture of the body, which
is read at the position maps of photos and of the target (57 and 54 channels). The target's pose
enters only through its position map. A residual convolutional decoder fuses the target tokens of
four depths. It is trained with squared error and 1.0 VGG.

Every target needs a pass through the whole transformer. Photos attend to the target, so nothing of
a person can be kept from one target to the next, and a frame costs as much as the first one. (The
encoder-decoder's latents could be kept; here they are made again.)

In our reading the neural texture and the blocks are those of this package. HumanRAM's code is not
public. Its decoder here adds the four depths from the last to the first, each followed by a
residual block, and doubles the sides until a token has its pixels.
"""

from typing import Annotated, Any, NamedTuple, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from experiments.systems.targets import PixelDriver
from humangs_jax.core.array_types import Array, Float, Int, PyTree
from humangs_jax.core.configuration import Patch, Range, Vertices, part
from humangs_jax.network.encoder import (
    TEXTURE_STD,
    TriplaneConfig,
    encoder_pixels,
    patchify,
    sample_triplane,
)
from humangs_jax.network.maps import Convolution
from humangs_jax.network.parts import (
    Decoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    Reader,
    Target,
)
from humangs_jax.network.transformer import INIT_STD, Transformer, TransformerConfig
from humangs_jax.network.upsampler import KAIMING, SLOPE, UpConvolution
from humangs_jax.rendering.gaussians import Gaussians

LEAST_WIDTH = 8
"""Least number of features of the convolutional decoder's maps, which halves as their sides
double.
"""


@part
class NoReader(Reader):
    """The reader of systems whose decoders read the inputs. Its features are the encoding."""

    def __call__(self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext) -> Encoding:
        """Returns the encoding."""
        return encoding


class Photos(NamedTuple):
    """The photos as a `QueryDriver` reads them."""

    pixels: Float[Array, "v h w 12"]
    """rgb (3), ray (6) and canonical position (3) of each pixel."""
    view_count: Int[Array, ""] | None
    """Number of views that are no padding, as in `HumanGSInputs`."""


@part
class PhotoDecoder(Decoder):
    """A decoder that makes no Gaussians and passes the photos to a `QueryDriver`."""

    def __call__(
        self, features: PyTree, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns the photos as the scene."""
        photos = Photos(encoder_pixels(inputs, ctx), inputs.view_count)
        return HumanGSOutputs(no_gaussians(), scene=photos)


def no_gaussians() -> Gaussians:
    """Returns 0 Gaussians."""
    return Gaussians(*(jnp.zeros((0, *shape)) for shape in ((3,), (4,), (3,), (), (3,))))


@part
class QueryDriver(PixelDriver):
    """A driver that makes the pixels of a target from the photos."""

    transformer: TransformerConfig = TransformerConfig(layers=24, class_token=False)
    """The transformer, which has no class token."""
    texture: TriplaneConfig | None = None
    """The neural texture (HumanRAM). None: the body is unknown (LVSM)."""
    fusion: Annotated[int, Range(2, 16_384)] | None = None
    """Width of the convolutional decoder, which needs a patch size that is a power of 2. None:
    pixels come from a linear map.
    """
    patch_size: Patch = 8
    """Side of a patch of photos and targets in pixels."""
    latents: Vertices | None = None
    """Number of learned tokens of LVSM's encoder-decoder, which has two transformers. None: photos
    and target attend to each other.
    """

    @property
    def moves(self) -> bool:
        """Whether it can show a pose that no photo shows. Without the texture it knows no body."""
        return self.texture is not None

    def __post_init__(self):
        """Raises a ValueError for a class token, or for too few layers to fuse four depths."""
        super().__post_init__()
        if self.transformer.class_token:
            raise ValueError(
                "driver.transformer.class_token: expected false, there is no global token here"
            )
        if self.fusion is not None and self.transformer.layers < 4:
            raise ValueError(
                f"driver.fusion needs at least 4 layers, got {self.transformer.layers}"
            )

    @nn.compact
    def __call__(
        self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext
    ) -> Float[Array, "i j 3"]:
        """Returns the image of a target in [0, 1] on white. Its sides are multiples of the patch
        size.
        """
        # what tokens are made of: rays, and positions or what the texture has there
        photos: Photos = outputs.scene
        patch, dtype, width = self.patch_size, ctx.runtime.compute_dtype, self.transformer.width
        query = cast(Array, target.pixels)
        seen, asked = photos.pixels[..., 3:9], query[..., :6]
        if self.texture is not None:
            shape = (3, self.texture.resolution, self.texture.resolution, self.texture.channels)
            texture = self.param("texture", nn.initializers.normal(TEXTURE_STD), shape)

            def features(ray, at):
                return jnp.concatenate([ray, sample_triplane(texture, at)], axis=-1)

            seen, asked = features(seen, photos.pixels[..., 9:]), features(asked, query[..., 6:])

        def linear(features, name):
            init = nn.initializers.normal(INIT_STD)
            return nn.Dense(features, use_bias=False, dtype=dtype, kernel_init=init, name=name)

        def tokens_of(maps, name):
            patches = patchify(maps, patch)
            return linear(width, name)(patches.reshape(len(patches), -1))

        colored = jnp.concatenate([2 * photos.pixels[..., :3] - 1, seen], axis=-1)
        seen = tokens_of(colored, "photo_tokens")
        asked = tokens_of(asked[None], "target_tokens")
        targets = len(asked)

        # number of photo tokens that are no padding, which come first; None: all of them
        real = photos.view_count
        if real is not None:
            real = real * (len(seen) // len(photos.pixels))
        if self.latents is not None:
            learned = self.param("latents", nn.initializers.normal(INIT_STD), (self.latents, width))
            encoder = Transformer(self.transformer, ctx.runtime, name="encoder")
            encoder_count = None if real is None else self.latents + real
            encoded = encoder(jnp.concatenate([learned, seen]), encoder_count)[-1]
            seen, real = encoded[: self.latents], None
        # the target comes before the photos, so that padding is last
        count = None if real is None else targets + real
        transformer = Transformer(self.transformer, ctx.runtime, name="transformer")
        depths = transformer(jnp.concatenate([asked, seen]), count)
        rows, columns = query.shape[0] // patch, query.shape[1] // patch
        maps = [x[:targets].reshape(1, rows, columns, width) for x in depths]
        if self.fusion is not None:
            return jax.nn.sigmoid(FusionHead(self.fusion, patch, dtype, name="fusion")(maps)[0])
        pixels = linear(3 * patch**2, "rgb")(maps[-1]).reshape(rows, columns, patch, patch, 3)
        return jax.nn.sigmoid(jnp.swapaxes(pixels, 1, 2).reshape(*query.shape[:2], 3))


class FusionHead(nn.Module):
    """Turns token maps of four depths, each (v, h, w, d), into colors (v, patch h, patch w, 3)
    before the sigmoid.
    """

    hidden: int
    """Number of features of the coarsest maps."""
    patch: int
    """Side of a patch in pixels."""
    dtype: Any = None
    """Number type of the products."""

    @nn.compact
    def __call__(self, maps: list[Float[Array, "v h w d"]]) -> Float[Array, "v i j 3"]:
        """Returns colors before the sigmoid.

        Raises: ValueError if the side of a patch is no power of 2.
        """
        if self.patch & (self.patch - 1):
            raise ValueError(f"driver.fusion: patch_size {self.patch}: expected a power of 2")

        def activate(x):
            return jax.nn.leaky_relu(x, SLOPE)

        def convolution(features, name):
            return Convolution(features, KAIMING, self.dtype, name=name)

        def residual(x, name):
            inner = convolution(x.shape[-1], f"{name}_0")(activate(x))
            return x + convolution(x.shape[-1], f"{name}_1")(activate(inner))

        def project(i):
            return nn.Dense(self.hidden, dtype=self.dtype, name=f"project_{i}")(maps[i])

        last = len(maps) - 1
        x = residual(project(last), f"fuse_{last}")
        for i in reversed(range(last)):
            x = residual(x + project(i), f"fuse_{i}")
        for i in range(self.patch.bit_length() - 1):
            width = max(LEAST_WIDTH, self.hidden >> (i + 1))
            x = activate(UpConvolution(width, self.dtype, name=f"up_{i}")(x))
        return Convolution(3, nn.initializers.normal(INIT_STD), self.dtype, name="rgb")(x)
