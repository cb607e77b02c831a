"""Feature aggregation: token maps of several depths fused and upsampled four times.

With hidden width H: each map 1x1 -> H, concatenated, 3x3 -> 2H, norm, LeakyReLU; then twice a 4x4
transposed convolution of stride 2 (2H -> H, H -> H/2), norm, LeakyReLU, and a 3x3 convolution (->
H, norm, LeakyReLU; -> out, bare). Maps are (v, h, w, c).

The last convolution is half of that arithmetic, and only body vertices read what it computes, from
positions between its pixels. So the reader applies it to what the vertices have read of its input.
"""

from typing import Annotated, Any, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen.dtypes import promote_dtype

from humangs_jax.core.array_types import Array, Bool, Float
from humangs_jax.core.configuration import Range, configuration
from humangs_jax.network.maps import Convolution

SLOPE = 0.2
MOMENTUM = 0.9
"""Momentum of the running statistics; torch calls it 0.1, and takes the unbiased variance: larger
by one part in v * h * w.
"""
KAIMING = nn.initializers.variance_scaling(2.0, "fan_out", "normal")


@configuration
class UpsamplerConfig:
    """Sizes of the upsampler."""

    hidden: Annotated[int, Range(2, 16_384)] = 256
    """H, the hidden width."""
    features: Literal["intermediate", "final"] = "intermediate"
    """All four depths are aggregated ("intermediate"), or the last is upsampled alone ("final", an
    ablation).
    """


class UpConvolution(nn.Module):
    """4x4 transposed convolution, stride 2, padding 1: (v, h, w, c) -> (v, 2h, 2w, features).

    An output row 2i needs input rows i - 1, i under kernel rows 3, 1, and row 2i + 1 needs rows i,
    i + 1 under 2, 0; the same for columns. So one matrix product of all 2x2 neighbourhoods to 4 *
    features channels, interleaved, does it: as a dilated convolution (or a 2x2 one) its backward
    pass on a CPU is twenty times slower. The kernel (4, 4, c, features) is stored unflipped: input
    pixel (i, j) adds kernel[a, b] to output pixel (2i + a - 1, 2j + b - 1).
    """

    features: int
    """Number of output channels."""
    dtype: Any = None
    """Type of the arithmetic; None: that of input and parameters."""

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v 2*h 2*w features"]:
        views, height, width, channels = x.shape
        # torch counts the fan-out of a transposed convolution over its input channels
        init = nn.initializers.variance_scaling(2.0, "fan_in", "normal")
        kernel = self.param("kernel", init, (4, 4, channels, self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        x, kernel, bias = promote_dtype(x, kernel, bias, dtype=self.dtype)
        order = jnp.asarray([3, 1, 2, 0])  # phase, then tap
        kernel = kernel[order][:, order].reshape(2, 2, 2, 2, channels, self.features)
        kernel = jnp.transpose(kernel, (1, 3, 4, 0, 2, 5)).reshape(4 * channels, 4 * self.features)
        x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        neighbours = [x[:, a : a + height + 1, b : b + width + 1] for a in (0, 1) for b in (0, 1)]
        y = jnp.concatenate(neighbours, axis=-1) @ kernel
        y = y.reshape(views, height + 1, width + 1, 2, 2, self.features)
        y = jnp.stack([y[:, :-1, :, 0], y[:, 1:, :, 1]], axis=2)
        y = jnp.stack([y[:, :, :, :-1, 0], y[:, :, :, 1:, 1]], axis=4)
        return y.reshape(views, 2 * height, 2 * width, self.features) + bias


class Upsampler(nn.Module):
    """Token maps, each (v, h, w, d) -> (v, 4h, 4w, hidden / 2), input of the last convolution."""

    config: UpsamplerConfig
    """Sizes of the upsampler."""
    dtype: Any = None
    """Type of the arithmetic; None: that of input and parameters."""
    axis_name: str | tuple[str, ...] | None = None
    """Axes of `vmap` over which batch statistics are shared."""

    @nn.compact
    def __call__(
        self,
        maps: list[Float[Array, "v h w d"]],
        train: bool = False,
        present: Bool[Array, " v"] | None = None,
    ) -> Float[Array, "v 4*h 4*w c"]:
        """Fuses and upsamples the maps.

        present: views that count in the batch statistics; None: all.
        """
        hidden = self.config.hidden
        mask = None
        if present is not None:
            mask = present[:, None, None, None]

        def norm_relu(x, name):
            norm = nn.BatchNorm(
                use_running_average=not train,
                momentum=MOMENTUM,
                use_fast_variance=False,
                dtype=self.dtype,
                # it accepts several names; its annotation says one
                axis_name=self.axis_name if train else None,  # ty: ignore[invalid-argument-type]
                name=name,
            )
            return jax.nn.leaky_relu(norm(x, mask=mask), SLOPE)

        def convolution(features, name):
            return Convolution(features, KAIMING, self.dtype, name=name)

        projected = [
            nn.Dense(hidden, dtype=self.dtype, kernel_init=KAIMING, name=f"project_{i}")(x)
            for i, x in enumerate(maps)
        ]
        x = norm_relu(
            convolution(2 * hidden, "fuse")(jnp.concatenate(projected, axis=-1)), "fuse_norm"
        )
        x = norm_relu(UpConvolution(hidden, self.dtype, name="up1")(x), "up1_norm")
        x = norm_relu(convolution(hidden, "conv1")(x), "conv1_norm")
        return norm_relu(UpConvolution(hidden // 2, self.dtype, name="up2")(x), "up2_norm")
