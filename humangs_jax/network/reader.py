"""The paper's reader: posed vertices projected into the photos, features read there, views pooled.

Vertices can also read the photos themselves, at the surface and at distances along their normals (`network.pixel_aligned`).
"""

import itertools
import math
from typing import cast

import jax
import jax.numpy as jnp

from humangs_jax.core.array_types import Array, Bool, Float, Int, Key
from humangs_jax.core.configuration import Spread, Width, part
from humangs_jax.network.bilinear import KERNEL, sample_bilinear, sample_neighborhoods, texel_indices
from humangs_jax.network.inputs import HumanGSInputs, subject_unit
from humangs_jax.network.parts import Encoding, Pass, Shells, Variables, VertexFeatures
from humangs_jax.network.pixel_aligned import (
    COUNT_EPSILON,
    dropped_reads,
    photo_colors,
    project_vertices,
    sample_shells,
    sum_over_views,
    visible_vertices,
)
from humangs_jax.network.upsampler import OutputConvolution


@part
class PixelAlignedReader:
    """What vertices read.

    output_width: features of a last 3x3 convolution, evaluated only where vertices read the maps; None: the maps are read as they
    are. sample_rgb: also read the photo color at each vertex, averaged over the views that see it, and their fraction.
    shells: ascending distances along the vertex normals, normalised units, at which the photos are read too; (): none.
    """

    output_width: Width | None = 768
    sample_rgb: bool = False
    shells: tuple[Spread, ...] = ()

    def __post_init__(self):
        """Raises ValueError for distances that are not ascending."""
        ascending = all(a < b for a, b in itertools.pairwise(self.shells))
        if not (ascending and all(0 <= x < math.inf for x in self.shells)):
            raise ValueError(f"shells {self.shells}: expected ascending distances, finite and at least 0")

    def init(self, key: Key, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Variables:
        """{"params"} of the output convolution; {} without one."""
        if self.output_width is None:
            return {}
        channels = encoding.maps.shape[-1]
        return cast(Variables, self.output(channels, run).init(key, jnp.zeros((1, KERNEL**2 * channels)), jnp.zeros(1)))

    def output(self, channels: int, run: Pass) -> OutputConvolution:
        """The last convolution, of maps with that many channels."""
        assert self.output_width is not None
        return OutputConvolution(self.output_width, channels, run.runtime.compute_dtype)

    def apply(self, variables: Variables, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> VertexFeatures:
        """Features of the n vertices. Raises ValueError for shells without posed normals."""
        conventions, capacity = run.conventions, run.runtime.vertex_capacity
        pixels, visible = project_and_test(inputs, run)
        weights = view_weights(visible, inputs, run).astype(pixels.dtype)
        size = (inputs.cameras.width, inputs.cameras.height)
        maps = encoding.maps
        indices = texel_indices(pixels, size, (maps.shape[2], maps.shape[1]), conventions.pixel_grid)
        read = sample_bilinear if self.output_width is None else sample_neighborhoods
        sums = sum_over_views(read, maps, indices, weights, capacity)
        counts = jnp.sum(weights, axis=0) + COUNT_EPSILON
        local = jax.tree.map(lambda x: jnp.einsum("n...,n->n...", x, 1 / counts), sums)
        if self.output_width is not None:
            local = self.output(maps.shape[-1], run).apply(variables, *local)
        colors = fraction = None
        if self.sample_rgb:
            colors = photo_colors(inputs.images, pixels, visible, conventions.pixel_grid)
            fraction = (jnp.sum(visible, axis=0) / jnp.sum(inputs.present)).astype(pixels.dtype)
        return VertexFeatures(
            cast(Array, local),
            encoding.global_token,
            photo_colors=colors,
            visible_fraction=fraction,
            shells=read_shells(inputs, self.shells, run) if self.shells else None,
            normals=inputs.canonical_normals,
            dropped_reads=dropped_reads(weights, capacity),
        )


def read_shells(inputs: HumanGSInputs, distances: tuple[float, ...], run: Pass) -> Shells:
    """The photos at points off the surface. Raises ValueError if the inputs have no posed normals."""
    if inputs.posed_normals is None:
        raise ValueError("reader.shells needs posed_normals of the inputs, see `prepare_inputs`")
    unit = subject_unit(inputs.canonical_vertices)
    return sample_shells(
        inputs.images,
        inputs.foreground,
        inputs.depth_maps,
        inputs.cameras.in_units(unit),
        inputs.posed_vertices / unit,
        inputs.posed_normals,
        distances,
        inputs.present,
        run.conventions.pixel_grid,
    )


def project_and_test(inputs: HumanGSInputs, run: Pass) -> tuple[Float[Array, "v n 2"], Bool[Array, "v n"]]:
    """Pixel positions of the posed vertices in every view, and which of them it sees; padding sees none."""
    unit = subject_unit(inputs.canonical_vertices)
    cameras, vertices = inputs.cameras.in_units(unit), inputs.posed_vertices / unit
    pixels, depths = jax.vmap(project_vertices)(cameras, vertices)
    size, grid = (cameras.width, cameras.height), run.conventions.pixel_grid
    see = lambda p, z, surface: visible_vertices(p, z, surface, size, grid)
    return pixels, jax.vmap(see)(pixels, depths, inputs.depth_maps) & inputs.present[:, None]


def view_weights(visible: Bool[Array, "v n"], inputs: HumanGSInputs, run: Pass) -> Bool[Array, "v n"]:
    """Which views are pooled at each vertex."""
    if run.conventions.pool == "visible":
        return visible
    return jnp.broadcast_to(inputs.present[:, None], visible.shape)


def needed_reads(inputs: HumanGSInputs, run: Pass) -> Int[Array, ""]:
    """The vertex capacity that these photos need: the most vertices for which any view is read."""
    counted = view_weights(project_and_test(inputs, run)[1], inputs, run)
    return jnp.max(jnp.sum(counted, axis=1, dtype=jnp.int32))
