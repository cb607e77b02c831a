"""Settings of how the network runs (`Runtime`), which weights files do not record, and of how its
weights were trained (`Conventions`).
"""

from typing import Any, ClassVar, Literal

import jax.numpy as jnp

from humangs_jax.core.configuration import (
    CapacityOrAuto,
    Edge,
    InputSide,
    Length,
    Vertices,
    configuration,
    knob,
)
from humangs_jax.network.maps import PixelGrid
from humangs_jax.rendering.mesh.rasterizer import RasterConfig

TokenSelection = Literal["all", "foreground"]
AttentionKernel = Literal["xla", "cudnn", "chunked"]


@configuration
class Runtime:
    """How the network runs.

    Raises: ValueError for values out of range.
    """

    tokens: TokenSelection | None = knob(
        None,
        cost="no background in the attention: exact only for weights that were trained so",
        gain="5 x in time at a foreground share of 0.2",
        measured="performance.md",
    )
    """Patches that become tokens: all of them ("all"), or those that the person touches
    ("foreground"). None: as the weights were trained.
    """
    token_capacity: CapacityOrAuto = knob(
        0,
        cost="tokens beyond it are dropped and counted",
        gain="time and memory",
        measured="performance.md",
    )
    """Number of slots for foreground tokens, over all views. 0: room for all patches. `reconstruct`
    and `stack_captures` fit it to the photos. In training it is for the largest number of photos,
    see `training.forward.token_share`.
    """
    dtype: Literal["float32", "bfloat16", "float16"] = knob(
        "float32",
        cost="bfloat16: 1e-2 of relative error; float16: 1e-3, not for training",
        gain="time on accelerators; none on CPUs",
        measured="stability.md",
    )
    """Number type of the products of the encoder and of the reader's convolution. Parameters, the
    statistics of norms and softmax, and the decoder are float32 or wider.
    """
    attention: Literal["auto"] | AttentionKernel = knob(
        "auto",
        cost="none",
        gain="chunked: a third of the time on CPUs, memory linear in tokens",
        measured="performance.md",
    )
    """Implementation of the attention, see `network.transformer`."""
    scan: bool = knob(
        False,
        cost="a copy of the blocks' parameters",
        gain="compile time on TPU and GPU",
        measured="performance.md",
    )
    """Whether the blocks run as one compiled loop. Then their parameters are copied side by side in
    every call (12 layers of 768: 340 MB).
    """
    remat: Literal["none", "full", "dots"] = knob(
        "none", cost="a third more arithmetic", gain="memory of training", measured="performance.md"
    )
    """What a block recomputes in the backward pass, instead of keeping it: nothing ("none") or
    everything ("full"). With "dots" it keeps the results of attention and of products with weights,
    and recomputes the rest. On a CPU this works only with `scan`, because outside of loops XLA
    merges what is computed twice.
    """
    max_edge_length: Edge | None = knob(
        None,
        cost="three times the Gaussians at 0.017",
        gain="detail where photos have more than the vertices of the body",
        measured="refinement.md",
    )
    """Largest length of the body's edges, metres. Longer edges are split, in addition to the
    splitting that the weights were trained with. None: no further splitting.
    """
    body_vertices: Vertices | None = knob(
        None,
        cost="detail of the body",
        gain="Gaussians and the time of a frame in proportion",
        measured="tradeoff.md",
    )
    """Number of vertices to which the body is decimated, fewer than the weights were trained with.
    None: no further decimation. Gaussians are scaled as the distance between vertices changes, so
    that they cover as much as before.
    """
    image_size: InputSide | None = knob(
        None,
        cost="detail of the photos",
        gain="tokens grow with its square",
        measured="tradeoff.md",
    )
    """Side of the photos, pixels, a multiple of the patch size. None: the side with which the
    weights were trained.
    """
    crop: bool = knob(
        False,
        cost="0.15 dB in the foreground for one of four people",
        gain="pixels of the person in place of background: 0.3 dB in the foreground on average",
        measured="evaluation.md",
    )
    """Whether photos are cut to the square around the person's mask before they are resized to
    `image_size`.
    """
    displacement: bool | None = knob(
        None,
        cost="half a second where the body does not fit the masks, 1.2 s for a skirt, else 0.1 s",
        gain="boundaries and hems of bodies that are a centimetre off, and skirts",
        measured="benchmarks/quality.md",
    )
    """Whether the body is first moved to the edges of the masks (`data.vertex_offsets`), for
    weights whose `pixels` are "person". None: it is moved if it does not fit the masks. True: it is
    always moved, which costs PSNR where the body is right. False: it is never moved, and has no
    skirt (`data.skirt`). With None or True, a displacement of the capture is used instead if there
    is one.
    """
    raster: RasterConfig = RasterConfig()
    """Settings of the mesh rasterizer."""
    renamed_fields: ClassVar[dict[str, str]] = {"longest_edge": "max_edge_length"}

    @property
    def compute_dtype(self) -> Any:
        """The dtype of Linen modules. None for float32: modules then promote inputs and parameters,
        so that float64 stays.
        """
        if self.dtype == "float32":
            return None
        return jnp.dtype(self.dtype)


@configuration
class Conventions:
    """How the weights were trained.

    No shape of a tensor depends on it, but with other values the results are worse.
    """

    image_size: InputSide = knob(
        512,
        cost="detail of the photos",
        gain="tokens grow with its square, attention with its fourth power",
        measured="performance.md",
    )
    """Side of the photos, pixels. The network takes any multiple of the patch size."""
    tokens: TokenSelection = "all"
    """Patches that became tokens: all of them ("all"), or those that the person touches
    ("foreground").
    """
    pixels: Literal["all", "person"] = "all"
    """Pixels that count. "person": if a photo has a mask, only the pixels of the mask count. Parts
    of the body that cover background in a photo are then unseen there. With shells, Gaussians get
    opacity 0 if no photo shows the person at any of the shells of their vertex.
    """
    position_map: Literal["plain", "gouraud"] = "plain"
    """How position maps are drawn: canonical positions that are interpolated ("plain"), or lit by a
    point light as in the release ("gouraud").
    """
    ray_origins: Literal["normalized", "twice_normalized"] = "normalized"
    """How often ray origins are divided by the unit of the subject: once ("normalized") or twice
    ("twice_normalized"). The release divides twice, so that the moments of its rays fit no camera.
    """
    pool: Literal["visible", "all"] = "visible"
    """Views that are averaged for a vertex: those that see the vertex ("visible", as in the paper),
    or all views ("all", as in the release).
    """
    pixel_grid: PixelGrid = "half_pixel"
    """How pixels become positions on feature maps, see `network.maps`."""
    skinning: Literal["affine", "rotation"] = "affine"
    """How Gaussians are posed, see `rendering.gaussians.skin_gaussians`."""
    rendering: Literal["exact", "inria"] = "exact"
    """Conventions with which Gaussians are drawn, a name of
    `rendering.splat_config.SPLAT_PRESETS`.
    """
    leg_blend_distance: Length | None = None
    """Distance from the vertex, metres. Gaussians between the legs move with both legs if they are
    farther from their vertex. From 3/4 to 5/4 of this distance the effect grows from none to full
    (`body.model.blend_leg_weights`). None: all move with their vertex.
    """
    light: bool = False
    """Whether other poses are drawn in the light of the photos (`Avatar.light`)."""
    pixel_footprint: Length | None = None
    """Side of a pixel of the training images, measured on the person, metres. With a number, the
    blur of such a pixel is part of the Gaussians' scales (`Gaussians.pixel_footprint`). None: only
    the renderer applies a low-pass.
    """
    body_vertices: Vertices | None = knob(
        None,
        cost="detail of the body",
        gain="Gaussians, reads and decoding in proportion",
        measured="evaluation.md",
    )
    """Number of vertices to which bodies are decimated. None: no decimation."""
    max_edge_length: Edge | None = knob(
        None,
        cost="Gaussians grow as it shrinks",
        gain="detail where the body is coarse",
        measured="evaluation.md",
    )
    """Largest length of the edges of bodies, metres. Longer edges are split, after decimation.
    None: no splitting.
    """
    renamed_fields: ClassVar[dict[str, str]] = {
        "skinning_reach": "leg_blend_distance",
        "low_pass": "pixel_footprint",
        "longest_edge": "max_edge_length",
    }
