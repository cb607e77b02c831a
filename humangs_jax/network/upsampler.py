"""Fuses token maps of several depths, and makes the result four times as high and wide.

With hidden width H, each map goes through a 1x1 convolution to H channels. All are concatenated,
and a 3x3 convolution to 2H, norm and LeakyReLU follow. Then a 4x4 transposed convolution of stride
2 is applied twice, from 2H to H and from H to H/2, each with norm and LeakyReLU. The first is
followed by a 3x3 convolution to H with norm and LeakyReLU, the second by a 3x3 convolution to the
output, without norm and LeakyReLU. Maps are (v, h, w, c).

The last convolution takes half of the arithmetic, and only body vertices read its output, at
positions between its pixels. So it is not in this module. The reader applies it to values of its
input that the vertices have read.
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
"""Momentum of the running statistics, which is 0.1 in torch's notation. torch takes the unbiased
variance, which is larger by one part in v * h * w.
"""
KAIMING = nn.initializers.variance_scaling(2.0, "fan_out", "normal")


@configuration
class UpsamplerConfig:
    """Sizes of the upsampler."""

    hidden: Annotated[int, Range(2, 16_384)] = 256
    """Width H of the hidden layers."""
    features: Literal["intermediate", "final"] = "intermediate"
    """Whether the maps of all four depths are fused ("intermediate"), or only the last map is
    upsampled ("final", an ablation).
    """


class UpConvolution(nn.Module):
    """A 4x4 transposed convolution with stride 2 and padding 1, from (v, h, w, c) to (v, 2h, 2w,
    features).

    Output row 2i needs input rows i - 1 and i, under kernel rows 3 and 1. Output row 2i + 1 needs
    input rows i and i + 1, under kernel rows 2 and 0. The same holds for columns. So one matrix
    product takes each 2x2 neighbourhood to 4 * features channels, which are then interleaved. If
    this were written as a dilated or a 2x2 convolution, the backward pass on a CPU would take
    twenty times as long.

    The kernel (4, 4, c, features) is stored unflipped: input pixel (i, j) adds kernel[a, b] to
    output pixel (2i + a - 1, 2j + b - 1).
    """

    features: int
    """Number of output channels."""
    dtype: Any = None
    """Type of the arithmetic; None: the type of input and parameters."""

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
    """Upsamples token maps, each (v, h, w, d), to (v, 4h, 4w, hidden / 2). The result is the input
    of the last convolution.
    """

    config: UpsamplerConfig
    """Sizes of the upsampler."""
    dtype: Any = None
    """Type of the arithmetic; None: the type of input and parameters."""
    axis_name: str | tuple[str, ...] | None = None
    """Axes of `vmap` over which batch statistics are shared."""

    @nn.compact
    def __call__(
        self,
        maps: list[Float[Array, "v h w d"]],
        train: bool = False,
        present: Bool[Array, " v"] | None = None,
    ) -> Float[Array, "v 4*h 4*w c"]:
        """Returns the fused and upsampled maps, (v, 4h, 4w, hidden / 2).

        train: whether norms use the statistics of the batch. present: views that count in these
        statistics, (v,); None: all.
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
