"""Named configurations: `published` is for the released weights, `paper` is the network that the
paper describes, `small` is the shipped network, and `tiny` is for tests.
"""

from humangs_jax.core.configuration import Presets
from humangs_jax.network.config import Architecture, Conventions, HumanGSConfig, paper_parts
from humangs_jax.network.encoder import PatchTransformer, TriplaneConfig
from humangs_jax.network.reader import PixelAlignedReader
from humangs_jax.network.runtime import Runtime
from humangs_jax.network.transformer import TransformerConfig
from humangs_jax.network.upsampler import UpsamplerConfig
from humangs_jax.network.vertex_decoder import VertexDecoder

SHELLS = (0.0, 0.015, 0.03, 0.05, 0.08, 0.12, 0.18)
"""Distances of the shells, from the skin to the hems of the widest clothes, normalised units."""


def published() -> HumanGSConfig:
    """Returns the configuration of the authors' release: 99 M parameters, and conventions that only
    the release has. The network computes in bfloat16 (`Runtime.dtype`).
    """
    return HumanGSConfig(
        conventions=Conventions(
            position_map="gouraud",
            ray_origins="twice_normalized",
            pool="all",
            pixel_grid="mixed",
            skinning="rotation",
            rendering="inria",
        ),
        runtime=Runtime(dtype="bfloat16"),
    )


def paper() -> HumanGSConfig:
    """Returns the configuration of the paper's network. Visible views are pooled, and the position
    map is plain. The other conventions are ours.
    """
    return HumanGSConfig(runtime=Runtime(dtype="bfloat16"))


def small() -> HumanGSConfig:
    """Returns the configuration of the shipped network, which was trained on a CPU. Only patches of
    the foreground are tokens, and colors are read from the photos.

    The network has no upsampler, which would cost too much on a CPU (docs/training.md).
    """
    return HumanGSConfig(
        # sizes that a CPU trains in days, and all that reads the photos directly
        Architecture(
            PatchTransformer(
                texture=TriplaneConfig(resolution=64, channels=8),
                transformer=TransformerConfig(width=256, layers=6),
                upsampler=None,
            ),
            PixelAlignedReader(output_width=None, sample_rgb=True, shells=SHELLS),
            VertexDecoder(
                hidden=256,
                tight=1,
                free=2,
                offset_scale=0.25,
                initial_log_scale=-4.8,
                frame="normal",
                residual_color=True,
            ),
        ),
        # the data that it was trained on
        Conventions(
            image_size=256,
            tokens="foreground",
            pixels="person",
            leg_blend_distance=0.04,
            light=True,
            body_vertices=4000,
            max_edge_length=0.03,
        ),
        Runtime(token_capacity=1344),
    )


def tiny() -> HumanGSConfig:
    """Returns a configuration for tests. It has the published parts, reads from the photos what
    `small` reads, and has the smallest sizes.
    """
    decoder = paper_parts(small().architecture)[2]
    return HumanGSConfig(
        Architecture(
            PatchTransformer(
                texture=TriplaneConfig(resolution=8, channels=2),
                transformer=TransformerConfig(width=16, layers=4, head_width=8),
                upsampler=UpsamplerConfig(hidden=8),
            ),
            PixelAlignedReader(output_width=8, sample_rgb=True, shells=SHELLS),
            decoder.clone(hidden=16),
        ),
        Conventions(image_size=32, tokens="foreground"),
        Runtime(token_capacity=16),
    )


PRESETS = Presets({"published": published, "paper": paper, "small": small, "tiny": tiny})
