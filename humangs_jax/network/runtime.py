"""How the network runs, which weights files do not record (`Runtime`), and what the weights were
trained with.
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
    """How the network runs. Raises: ValueError for values out of range."""

    tokens: TokenSelection | None = knob(
        None,
        cost="no background in the attention: exact only for weights that were trained so",
        gain="5 x in time at a foreground share of 0.2",
        measured="performance.md",
    )
    """Patches that become tokens: "all", those that the "foreground" touches, or None: as the
    weights were trained.
    """
    token_capacity: CapacityOrAuto = knob(
        0,
        cost="tokens beyond it are dropped and counted",
        gain="time and memory",
        measured="performance.md",
    )
    """Slots for foreground tokens over all views, 0: room for all patches. `reconstruct` and
    `stack_captures` fit it to the photos; in training it is for the largest number of photos, see
    `training.forward.token_share`."""
    dtype: Literal["float32", "bfloat16", "float16"] = knob(
        "float32",
        cost="bfloat16: 1e-2 of relative error; float16: 1e-3, not for training",
        gain="time on accelerators; none on CPUs",
        measured="stability.md",
    )
    """Type of the encoder's products; parameters, norms, softmax statistics and the decoder stay
    float32 at least.
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
    """Run the blocks as one compiled loop.

    Their parameters are copied side by side in every call (12 layers of 768: 340 MB).
    """
    remat: Literal["none", "full", "dots"] = knob(
        "none", cost="a third more arithmetic", gain="memory of training", measured="performance.md"
    )
    """What a block recomputes in the backward pass instead of keeping it: nothing, all ("full"), or
    all but the results of attention and of products with weights ("dots"). On a CPU only a `scan`
    recomputes: XLA merges what is computed twice outside of loops."""
    max_edge_length: Edge | None = knob(
        None,
        cost="three times the Gaussians at 0.017",
        gain="detail where photos have more than the vertices of the body",
        measured="refinement.md",
    )
    """Metres to which edges of the body are split beyond what the weights were trained with, None
    for no more.
    """
    body_vertices: Vertices | None = knob(
        None,
        cost="detail of the body",
        gain="Gaussians and the time of a frame in proportion",
        measured="tradeoff.md",
    )
    """Vertices to which the body is decimated, fewer than the weights were trained with, None for
    no fewer. Gaussians shrink or grow with the distance between vertices, so that they cover as
    much as before."""
    image_size: InputSide | None = knob(
        None,
        cost="detail of the photos",
        gain="tokens grow with its square",
        measured="tradeoff.md",
    )
    """Side of the photos in pixels, a multiple of the patch size; None: as the weights were
    trained.
    """
    crop: bool = knob(
        False,
        cost="0.15 dB in the foreground for one of four people",
        gain="pixels of the person in place of background: 0.3 dB in the foreground on average",
        measured="evaluation.md",
    )
    """Photos are cut to the square around the person's mask before they are brought to that size.
    """
    displacement: bool | None = knob(
        None,
        cost="half a second where the body does not fit the masks, 1.2 s for a skirt, else 0.1 s",
        gain="boundaries and hems of bodies that are a centimetre off, and skirts",
        measured="benchmarks/quality.md",
    )
    """The body is moved to the edges of the masks first (`data.vertex_offsets`), for weights that
    look at the pixels of the "person". None: where a part of it sticks out of the masks; True:
    always, which costs PSNR where the body is right. False: never; a capture's own displacement,
    which else comes first, and a skirt (`data.skirt`) are left out, too."""
    raster: RasterConfig = RasterConfig()
    """Buffers of the mesh rasterizer."""
    renamed_fields: ClassVar[dict[str, str]] = {"longest_edge": "max_edge_length"}

    @property
    def compute_dtype(self) -> Any:
        """The dtype of Linen modules; None promotes inputs and parameters, so that float64
        stays.
        """
        if self.dtype == "float32":
            return None
        return jnp.dtype(self.dtype)


@configuration
class Conventions:
    """What the weights were trained with.

    No tensor's shape depends on it; with other values the results are worse.
    """

    image_size: InputSide = knob(
        512,
        cost="detail of the photos",
        gain="tokens grow with its square, attention with its fourth power",
        measured="performance.md",
    )
    """Side of the photos, pixels (the network takes any multiple of the patch size)."""
    tokens: TokenSelection = "all"
    """Patches that became tokens."""
    pixels: Literal["all", "person"] = "all"
    """Pixels that count. For "person" only those of the masks do, where there are masks. No photo
    then sees the body where it covers the background, and Gaussians of vertices that lie off the
    person in all photos are dropped."""
    position_map: Literal["plain", "gouraud"] = "plain"
    """Shading of the position maps."""
    ray_origins: Literal["normalized", "twice_normalized"] = "normalized"
    """Unit of the rays' origins. The release divides camera centres by s, and the ray origins taken
    from them once more, so that the moments of its rays ("twice_normalized") fit no camera."""
    pool: Literal["visible", "all"] = "visible"
    """Views that are averaged for a vertex: those that see it (paper) or all (release)."""
    pixel_grid: PixelGrid = "half_pixel"
    """How pixels become positions on feature maps, see `network.maps`."""
    skinning: Literal["affine", "rotation"] = "affine"
    """How the Gaussians are posed."""
    rendering: Literal["exact", "inria"] = "exact"
    """How they are drawn."""
    leg_blend_distance: Length | None = None
    """Gaussians between the legs farther than this from their vertex, metres, move with both
    (`body.model.blend_leg_weights`);
    None: all with their vertex."""
    light: bool = False
    """Other poses are drawn in the light of the photos (`Avatar.light`)."""
    pixel_footprint: Length | None = None
    """Metres that a pixel of the training images shows of the person, if their low-pass is to be
    part of the scales (`Gaussians.pixel_footprint`); None: it stays with the renderer."""
    body_vertices: Vertices | None = knob(
        None,
        cost="detail of the body",
        gain="Gaussians, reads and decoding in proportion",
        measured="evaluation.md",
    )
    """Number of vertices to which bodies are decimated; None: they are not."""
    max_edge_length: Edge | None = knob(
        None,
        cost="Gaussians grow as it shrinks",
        gain="detail where the body is coarse",
        measured="evaluation.md",
    )
    """Metres to which their edges are split afterwards; None: they are not."""
    renamed_fields: ClassVar[dict[str, str]] = {
        "skinning_reach": "leg_blend_distance",
        "low_pass": "pixel_footprint",
        "longest_edge": "max_edge_length",
    }
