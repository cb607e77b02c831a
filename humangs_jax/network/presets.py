"""Named configurations: `published` runs the released weights, `paper` is as described, `small` is what we ship."""

import dataclasses

from humangs_jax.network.attention import AttentionConfig
from humangs_jax.network.humangs import HumanGSConfig
from humangs_jax.network.pixel_aligned import PixelAlignedConfig
from humangs_jax.network.transformer import TransformerConfig
from humangs_jax.network.triplane import TriplaneConfig
from humangs_jax.network.upsampler import UpsamplerConfig
from humangs_jax.network.vertex_decoder import VertexDecoderConfig

SHELLS = (0.0, 0.015, 0.03, 0.05, 0.08, 0.12, 0.18)
"""From the skin to the hems of the widest clothes, normalised units."""


def published() -> HumanGSConfig:
    """The authors' release, 99 M parameters, with its quirks."""
    return HumanGSConfig(
        position_map="gouraud",
        skinning="rotation",
        rendering="inria",
        ray_origins="twice_normalized",
        dtype="bfloat16",
        sampling=PixelAlignedConfig(pool="all", convention="mixed"),
    )


def paper() -> HumanGSConfig:
    """The paper: visible views pooled, a plain position map; conventions otherwise ours."""
    return HumanGSConfig(dtype="bfloat16")


def small() -> HumanGSConfig:
    """Trained on a CPU and shipped: tokens of the foreground only, colour read off the photographs."""
    return HumanGSConfig(
        image_size=256,
        tokens="foreground",
        token_capacity=1344,
        body_vertices=4000,
        longest_edge=0.03,
        texture=TriplaneConfig(resolution=64, channels=8),
        transformer=TransformerConfig(width=256, layers=6),
        upsampler=UpsamplerConfig(enabled=False),  # left out for its cost on a CPU, see docs/training.md
        sampling=PixelAlignedConfig(pool="visible", convention="half_pixel", sample_rgb=True, shells=SHELLS),
        decoder=VertexDecoderConfig(
            hidden=256,
            tight=1,
            free=2,
            offset_scale=0.25,
            initial_log_scale=-4.8,
            frame="normal",
            residual_color=True,
        ),
    )


def tiny() -> HumanGSConfig:
    """`small` in everything but size, for tests."""
    config = small()
    return dataclasses.replace(
        config,
        image_size=32,
        token_capacity=16,
        body_vertices=None,
        longest_edge=None,
        texture=TriplaneConfig(resolution=8, channels=2),
        transformer=TransformerConfig(width=16, layers=4, attention=AttentionConfig(head_width=8)),
        upsampler=UpsamplerConfig(hidden=8, out=8),
        decoder=dataclasses.replace(config.decoder, hidden=16),
    )


PRESETS = {"published": published, "paper": paper, "small": small, "tiny": tiny}
