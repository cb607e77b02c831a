"""How the network runs, which weights files do not record (`Runtime`), and what the weights were trained with."""

import dataclasses
from typing import Any, Literal

import jax.numpy as jnp

from humangs_jax.core.configuration import Chunk, Edge, InputSide, Length, Presets, Room, Vertices, configuration, knob
from humangs_jax.network.bilinear import PixelGrid
from humangs_jax.rendering.mesh.rasterizer import RasterConfig

MEASURED, TRADE, EVALUATION = "performance.md", "tradeoff.md", "evaluation.md"

TokenSelection = Literal["all", "foreground"]
AttentionKernel = Literal["xla", "cudnn", "chunked"]
ComputeType = Literal["float32", "bfloat16", "float16"]


@configuration
class Runtime:
    """How the network runs.

    tokens: patches that become tokens: "all", those that the "foreground" touches, or None: as the weights were trained.
    token_capacity: slots for foreground tokens over all views, 0: room for all patches (`reconstruct` and `stack_captures` fit
    it to the photos; in training it is for the largest number of photos, see `training.forward.token_share`).
    dtype: of the encoder's products; parameters, norms, softmax statistics and the decoder stay float32 at least.
    attention: see `network.transformer`. attention_chunk: queries per block of the chunked kernel.
    scan: run the blocks as one compiled loop. Their parameters are copied side by side in every call (12 layers of 768: 340 MB).
    remat: what a block recomputes in the backward pass instead of keeping it: nothing, all ("full"), or all but the results of
    attention and of products with weights ("dots"). On a CPU only a `scan` recomputes: XLA merges what is computed twice
    outside of loops.
    vertex_capacity: vertices for which a view is read at most, None: all.
    longest_edge: metres to which edges of the body are split beyond what the weights were trained with, None for no more.
    body_vertices: vertices to which the body is decimated, fewer than the weights were trained with, None for no fewer.
    Gaussians shrink or grow with the distance between vertices, so that they cover as much as before.
    image_size: side of the photos in pixels, a multiple of the patch size; None: as the weights were trained.
    crop: photos are cut to the square around the person's mask before they are brought to that size.
    raster: buffers of the mesh rasterizer.

    Raises: ValueError for another dtype.
    """

    tokens: TokenSelection | None = knob(
        None,
        cost="no background in the attention: exact only for weights that were trained so",
        gain="5 x in time at a foreground share of 0.2",
        measured=MEASURED,
    )
    token_capacity: Room = knob(
        0, cost="tokens beyond it are dropped and counted", gain="time and memory", measured=MEASURED
    )
    dtype: ComputeType = knob(
        "float32",
        cost="bfloat16: 1e-2 of relative error; float16: 1e-3, not for training",
        gain="time on accelerators; none on CPUs",
        measured="stability.md",
    )
    attention: Literal["auto"] | AttentionKernel = knob(
        "auto", cost="none", gain="chunked: a third of the time on CPUs, memory linear in tokens", measured=MEASURED
    )
    attention_chunk: Chunk = knob(1024, cost="none", gain="memory", measured=MEASURED)
    scan: bool = knob(
        False, cost="a copy of the blocks' parameters", gain="compile time on TPU and GPU", measured=MEASURED
    )
    remat: Literal["none", "full", "dots"] = knob(
        "none", cost="a third more arithmetic", gain="memory of training", measured=MEASURED
    )
    vertex_capacity: Vertices | None = knob(
        None, cost="vertices beyond it are dropped and counted", gain="no gain measured", measured=MEASURED
    )
    longest_edge: Edge | None = knob(
        None,
        cost="three times the Gaussians at 0.017",
        gain="detail where photos have more than the vertices of the body",
        measured="refinement.md",
    )
    body_vertices: Vertices | None = knob(
        None, cost="detail of the body", gain="Gaussians and the time of a frame in proportion", measured=TRADE
    )
    image_size: InputSide | None = knob(
        None, cost="detail of the photos", gain="tokens grow with its square", measured=TRADE
    )
    crop: bool = knob(
        False,
        cost="0.15 dB in the foreground for one of four people",
        gain="pixels of the person in place of background: 0.3 dB in the foreground on average",
        measured=EVALUATION,
    )
    raster: RasterConfig = dataclasses.field(default_factory=RasterConfig)

    @staticmethod
    def preset(name: str) -> "Runtime":
        """How the network runs in a preset of `apps.settings`: realtime, balanced, quality or best. Raises: ValueError."""
        if name not in RUNTIMES:
            raise ValueError(f"Runtime.preset: expected one of {', '.join(RUNTIMES)}, got {name!r}")
        return RUNTIMES[name]

    @property
    def compute_dtype(self) -> Any:
        """For Linen modules; None promotes inputs and parameters, so that float64 stays float64."""
        return None if self.dtype == "float32" else jnp.dtype(self.dtype)


@configuration
class Conventions:
    """What the weights were trained with. No tensor's shape depends on it; with other values the results are worse.

    image_size: side of the photos, pixels (the network takes any multiple of the patch size). tokens: patches that became
    tokens. pixels: "person": where there are masks, only their pixels count. No photo then sees the body where it covers the
    background, and Gaussians of vertices that lie off the person in all photos are dropped. position_map: its shading.
    ray_origins: the release divides camera centres by s, and the ray origins taken from them once more, so that the moments
    of its rays ("twice_normalized") fit no camera. pool: average over the views that see a vertex (paper) or over all
    (release). pixel_grid: see `network.bilinear`. skinning, rendering: how the Gaussians are posed and drawn. skinning_reach:
    Gaussians between the legs farther than this from their vertex, metres, move with both (`body.skinning.spread_weights`);
    None: all with their vertex. light: other poses are drawn in the light of the photos (`avatar.light`). low_pass: metres
    that a pixel of the training images shows of the person, if their low-pass is to be part of the scales
    (`avatar.animate`); None: it stays with the renderer. body_vertices, longest_edge: number of vertices to which bodies are
    decimated, and metres to which their edges are split afterwards; None for neither.
    """

    image_size: InputSide = knob(
        512,
        cost="detail of the photos",
        gain="tokens grow with its square, attention with its fourth power",
        measured=MEASURED,
    )
    tokens: TokenSelection = "all"
    pixels: Literal["all", "person"] = "all"
    position_map: Literal["plain", "gouraud"] = "plain"
    ray_origins: Literal["normalized", "twice_normalized"] = "normalized"
    pool: Literal["visible", "all"] = "visible"
    pixel_grid: PixelGrid = "half_pixel"
    skinning: Literal["affine", "rotation"] = "affine"
    rendering: Literal["exact", "inria"] = "exact"
    skinning_reach: Length | None = None
    light: bool = False
    low_pass: Length | None = None
    body_vertices: Vertices | None = knob(
        None, cost="detail of the body", gain="Gaussians, reads and decoding in proportion", measured=EVALUATION
    )
    longest_edge: Edge | None = knob(
        None, cost="Gaussians grow as it shrinks", gain="detail where the body is coarse", measured=EVALUATION
    )


RUNTIMES = Presets(
    {
        "realtime": Runtime(crop=True, body_vertices=1000),
        "balanced": Runtime(crop=True, body_vertices=2000),
        "quality": Runtime(crop=True),
        "best": Runtime(crop=True),
    }
)
"""The network's part of `apps.settings.PRESETS`, measured in docs/tradeoff.md."""
