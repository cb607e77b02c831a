"""3x3 convolutions whose gradients are fast inside of loops, too.

XLA's CPU backend turns the two convolutions of a convolution's gradient into ones that its library knows, but looks for
them outside of loops only. In a loop, as over the subjects of a batch, they ran thirty times slower. Here they are
written as the library wants them: batch, two axes of space, channels.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.linen.dtypes import promote_dtype
from jax import lax

from humangs_jax.core.array_types import Array, Float

LAYOUT = ("NHWC", "HWIO", "NHWC")
KERNEL = 3


def convolve(x: Float[Array, "v h w c"], kernel: Float[Array, "k k c d"]) -> Float[Array, "v h w d"]:
    """Every pixel's 3x3 neighbourhood, zeros outside of the map, times the kernel."""
    return lax.platform_dependent(x, kernel, cpu=_convolve_on_cpu, default=_convolve)


def _convolve(x, kernel):
    return lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=LAYOUT)


@jax.custom_vjp
def _convolve_on_cpu(x, kernel):
    return _convolve(x, kernel)


def _forward(x, kernel):
    return _convolve(x, kernel), (x, kernel)


def _backward(residuals, cotangent):
    x, kernel = residuals
    x_gradient = _convolve(cotangent, jnp.swapaxes(kernel[::-1, ::-1], 2, 3))
    # channels of x are the batch, views are what is contracted, the cotangent's pixels are the window
    maps, window = jnp.transpose(x, (3, 1, 2, 0)), jnp.transpose(cotangent, (1, 2, 0, 3))
    kernel_gradient = lax.conv_general_dilated(maps, window, (1, 1), [(1, 1), (1, 1)], dimension_numbers=LAYOUT)
    return x_gradient, jnp.transpose(kernel_gradient, (1, 2, 0, 3))


_convolve_on_cpu.defvjp(_forward, _backward)


class Convolution(nn.Module):
    """3x3 convolution with a bias: (v, h, w, c) -> (v, h, w, features); the parameters are those of `nn.Conv`."""

    features: int
    kernel_init: nn.initializers.Initializer
    dtype: Any = None

    @nn.compact
    def __call__(self, x: Float[Array, "v h w c"]) -> Float[Array, "v h w d"]:
        kernel = self.param("kernel", self.kernel_init, (KERNEL, KERNEL, x.shape[-1], self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        x, kernel, bias = promote_dtype(x, kernel, bias, dtype=self.dtype)
        return convolve(x, kernel) + bias
