"""A tiny body and captures of it, for tests that compare images."""

import jax.numpy as jnp
import numpy as np
from small import small_body

from humangs_jax.data.capture import Capture, capture_from_arrays
from humangs_jax.losses.perceptual import BACKBONES, Convolution, Lpips, channels, convolutions


def random_lpips(net) -> Lpips:
    """Returns random weights, drawn by numpy: JAX would compile a program for each shape."""
    rng = np.random.default_rng(0)
    weights = {}
    for layer in convolutions(BACKBONES[net]):
        shape = (layer.size, layer.size, layer.inputs, layer.outputs)
        kernel = rng.standard_normal(shape, np.float32) * np.sqrt(
            2 / np.prod(shape[:3]), dtype=np.float32
        )
        weights[layer.name] = Convolution(jnp.asarray(kernel), jnp.zeros(layer.outputs))
    return Lpips(weights, tuple(jnp.ones(count) for count in channels(BACKBONES[net])), net)


def ellipse(height, width, tall=0.35, wide=0.2, soft=True):
    """Returns an elliptic mask, by default with a soft silhouette."""
    y, x = np.mgrid[:height, :width] + 0.5
    distance = np.hypot((y / height - 0.5) / tall, (x / width - 0.5) / wide)
    return (np.clip((1 - distance) * 12, 0, 1) if soft else (distance < 1)).astype(np.float32)


def capture_from(images, masks=None, frames=None, names=None) -> Capture:
    """Returns a capture of these photos on white, with cameras around the origin."""
    count, height, width = images.shape[:3]
    angles = 2 * np.pi * np.arange(count) / count
    cam_from_world = np.tile(np.eye(4), (count, 1, 1))
    cam_from_world[:, 0, 0] = cam_from_world[:, 2, 2] = np.cos(angles)
    cam_from_world[:, 0, 2], cam_from_world[:, 2, 0] = np.sin(angles), -np.sin(angles)
    cam_from_world[:, 2, 3] = 3
    frames = np.zeros(count, int) if frames is None else np.asarray(frames)
    K = np.asarray([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], float)
    poses = np.zeros((frames.max() + 1, 3, 3))
    poses[:, 1, 0] = 0.1 * np.arange(len(poses))
    return capture_from_arrays(
        images,
        K,
        cam_from_world,
        poses,
        np.zeros((len(poses), 3)),
        masks=masks,
        frames=frames,
        names=names,
        background="white",
        body=small_body(),
    )


def random_views(seed, count, height=96, width=80):
    """Returns (predicted, truth, masks) of a person of blocks on white.

    The prediction has noise and is shifted by a pixel.
    """
    rng = np.random.default_rng(seed)
    mask = ellipse(height, width)
    blocks = np.kron(rng.random((count, height // 8, width // 8, 3)), np.ones((8, 8, 1)))
    truth = blocks * mask[..., None] + 1 - mask[..., None]
    predicted = np.clip(np.roll(truth, 1, axis=2) + 0.1 * rng.standard_normal(truth.shape), 0, 1)
    return predicted.astype(np.float32), truth.astype(np.float32), np.tile(mask, (count, 1, 1))
