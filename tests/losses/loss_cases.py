"""Made-up loss networks and images in numpy, the same on every machine."""

import functools

import numpy as np


def fire(i, inputs, squeezed, expanded):
    return [
        (f"{i}.squeeze", inputs, squeezed, 1),
        (f"{i}.expand1x1", squeezed, expanded, 1),
        (f"{i}.expand3x3", squeezed, expanded, 3),
    ]


def three(numbers, widths):
    return [(str(i), a, b, 3) for i, a, b in zip(numbers, (3, *widths), widths, strict=False)]


BACKBONES = {  # name, in, out, size of the convolutions that are looked at, as torchvision has them
    "vgg19": three(
        (0, 2, 5, 7, 10, 12, 14, 16, 19, 21, 23, 25, 28, 30),
        (64, 64, 128, 128, *[256] * 4, *[512] * 6),
    ),
    "vgg": three(
        (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28), (64, 64, 128, 128, *[256] * 3, *[512] * 6)
    ),
    "alex": [
        ("0", 3, 64, 11),
        ("3", 64, 192, 5),
        ("6", 192, 384, 3),
        ("8", 384, 256, 3),
        ("10", 256, 256, 3),
    ],
    "squeeze": [
        ("0", 3, 64, 3),
        *fire(3, 64, 16, 64),
        *fire(4, 128, 16, 64),
        *fire(6, 128, 32, 128),
        *fire(7, 256, 32, 128),
        *fire(9, 256, 48, 192),
        *fire(10, 384, 48, 192),
        *fire(11, 384, 64, 256),
        *fire(12, 512, 64, 256),
    ],
}
HEADS = {
    "vgg": (64, 128, 256, 512, 512),
    "alex": (64, 192, 384, 256, 256),
    "squeeze": (64, 128, 256, 384, 384, 512, 512),
}
SEED = 2026


@functools.cache
def made_up_state(name):
    """Returns {"0.weight": (out, in, size, size), "0.bias": (out,), ...} in float64.

    For vgg19 these are the weights of the project's golden perceptual_a.
    """
    generator, state = np.random.default_rng(SEED), {}
    for layer, inputs, outputs, size in BACKBONES[name]:
        scale = np.sqrt(2 / (size * size * inputs))
        state[f"{layer}.weight"] = generator.normal(size=(outputs, inputs, size, size)) * scale
        state[f"{layer}.bias"] = generator.normal(size=outputs) * 0.1
    return state


def made_up_heads(net):
    """Returns (1, c, 1, 1) float64 each, not negative, like the trained heads."""
    generator = np.random.default_rng(SEED + 1)
    return [generator.random((1, count, 1, 1)) for count in HEADS[net]]


def image_pair(height, width, seed=0):
    """Returns two images (h, w, 3) in [0, 1], float64: noise on a slope, and it with other noise.

    No area is plain: among maxima that only rounding tells apart, any may get the gradient.
    """
    generator = np.random.default_rng(seed)
    target = (
        generator.random((height, width, 3)) * 0.5 + 0.5 * np.linspace(0, 1, width)[None, :, None]
    )
    return np.clip(target + 0.2 * generator.standard_normal(target.shape), 0, 1), target


def convolutions_of(name, dtype):
    """Returns `made_up_state` as (kernel (y, x, in, out), bias) by layer."""
    state = made_up_state(name)
    kernel = lambda layer: state[f"{layer}.weight"].transpose(2, 3, 1, 0).astype(dtype)
    return {
        layer: (kernel(layer), state[f"{layer}.bias"].astype(dtype))
        for layer, *_ in BACKBONES[name]
    }
