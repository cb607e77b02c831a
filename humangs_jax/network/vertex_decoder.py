"""The paper's decoder, which makes K Gaussians from the features of each body vertex.

The input of a vertex is its pooled local feature, the global token, and a positional encoding of
the canonical position. Optional inputs are its photo color, the fraction of views that see it, and
the photos' colors and masks at distances along its normal. A loss keeps the offsets of the first
`tight` Gaussians of a vertex small.
"""

from typing import Annotated, Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.configuration import Bias, Count, Range, Spread, Width, knob, part
from humangs_jax.core.numerics import inverse_sigmoid
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT
from humangs_jax.network.parts import (
    Decoder,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    VertexFeatures,
    subject_unit,
)
from humangs_jax.network.reader import on_the_person
from humangs_jax.rendering.gaussians import Gaussians

INIT_STD = 0.02
LAST_STD = 0.001
INITIAL_OPACITY = -1.0
"""Initial opacity, before the sigmoid."""
COLOR_MARGIN = 0.01
"""Distance from 0 and 1 to which photo colors are clamped before the inverse sigmoid, so that white
can still be corrected.
"""
WEIGHT_EPSILON = 1e-9
"""Number added to skinning weights before their logarithm, as published."""
THINNER = 1.2
"""Number that is subtracted from the initial bias of the scale along the normal. Gaussians then
start with a third of the thickness, so that silhouettes are sharp.
"""
OBLIQUE = (0.36, 0.48, 0.8)
"""A unit vector that is parallel to no axis of a body. Where normals point opposite to it, frames
change quickly between neighbouring vertices.
"""


@part
class VertexDecoder(Decoder):
    """The paper's decoder: a light MLP from the features of a vertex to its Gaussians.

    It computes in float32 at least, which costs little: it has a thousandth of the published
    network's arithmetic. In bfloat16 it would double the error of the Gaussians.
    """

    hidden: Width = 256
    """Width of the hidden layers."""
    tight: Annotated[int, Range(0, 256)] = 1
    """Number of tight Gaussians per vertex. A loss keeps their offsets small. K = tight + free."""
    free: Annotated[int, Range(0, 256)] = knob(
        4,
        cost="detail: K = tight + free",
        gain="drawing in proportion to K",
        measured="evaluation.md",
    )
    """Number of Gaussians per vertex whose offsets no loss keeps small."""
    skinning_joints: Count | None = None
    """Number of joints whose skinning weights a head of the network corrects. None: there is no
    such head.
    """
    offset_scale: Spread | None = None
    """Bound of each coordinate of an offset, normalised units. It is applied by tanh, before the
    distance of the shells is added. None: offsets are unbounded, as published.
    """
    initial_log_scale: Bias = -3.0
    """Initial bias of the scales, before the softplus."""
    frame: Literal["canonical", "normal"] = "canonical"
    """Axes of offsets and rotations: the axes of the canonical body ("canonical", as published), or
    axes whose z is the vertex's normal ("normal"). Along the normal Gaussians start thinner
    (`THINNER`).
    """
    residual_color: bool = False
    """Whether colors are predicted relative to the photo color."""

    def __post_init__(self):
        """Raises ValueError without a Gaussian."""
        super().__post_init__()
        if self.gaussians_per_vertex < 1:
            raise ValueError("decoder: tight + free must be at least 1")

    @property
    def gaussians_per_vertex(self) -> int:
        """K, the number of Gaussians of a vertex."""
        return self.tight + self.free

    @nn.compact
    def __call__(
        self, features: VertexFeatures, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns the Gaussians of the n vertices, ordered by vertex, metres.

        Raises ValueError for features that lack the normals or the photo colors that the
        configuration needs.
        """
        if self.frame == "normal" and features.normals is None:
            raise ValueError(
                'decoder.frame "normal" needs canonical_normals of the inputs, see `prepare_inputs`'
            )
        # the heads, from what is known of each vertex; normals only where they are the frame
        unit, shells = subject_unit(inputs.canonical_vertices), features.shells
        canonical = inputs.canonical_vertices / unit
        entering = features
        if self.frame != "normal":
            entering = replace(features, normals=None)
        count = 0 if shells is None else len(shells.distances)
        raw = self._heads(decoder_input(entering, canonical), count)
        made = activate(raw, self, features)
        if ctx.conventions.pixels == "person" and shells is not None:
            # where the body is wider than the person, all photos show the background
            kept = on_the_person(shells)[:, None]
            made = replace(made, opacities=jnp.where(kept, made.opacities, 0.0))
        if inputs.relative_vertex_spacing is not None:
            made = replace(made, scales=made.scales * inputs.relative_vertex_spacing[:, None, None])

        def flat(x):
            return x.reshape(-1, *x.shape[2:])

        gaussians = Gaussians(
            means=flat(canonical[:, None] + made.offsets) * unit,
            quats=flat(made.quats),
            scales=flat(made.scales) * unit,
            opacities=flat(made.opacities),
            colors=flat(made.colors),
        )
        return HumanGSOutputs(
            gaussians,
            tight_offsets=made.offsets[:, : self.tight],
            skinning_offsets=None if raw.skinning is None else flat(raw.skinning),
        )

    def _heads(self, x: Float[Array, "n c"], shells: int) -> "RawGaussians":
        """Returns the outputs of the MLP for the inputs x of each vertex. It has a trunk and a head
        for each kind of output. shells: number of shells.
        """
        k = self.gaussians_per_vertex

        def hidden_layer(x, name):
            return jax.nn.relu(
                nn.Dense(self.hidden, kernel_init=nn.initializers.normal(INIT_STD), name=name)(x)
            )

        def head(x, name, bias, kernel_init):
            def bias_init(key, shape, dtype=jnp.float32):
                return jnp.tile(jnp.asarray(bias, dtype), k)

            last = nn.Dense(
                k * len(bias), kernel_init=kernel_init, bias_init=bias_init, name=f"{name}_out"
            )
            return last(hidden_layer(x, f"{name}_hidden")).reshape(x.shape[0], k, len(bias))

        # a trunk that all heads share
        x = hidden_layer(hidden_layer(x, "trunk_0"), "trunk_1")
        # what the heads give before training: small kernels, and biases that mean something
        small = nn.initializers.normal(LAST_STD)
        thin = THINNER if self.frame == "normal" else 0.0
        scales = [self.initial_log_scale] * 2 + [self.initial_log_scale - thin]
        joints, chosen = None, None
        if self.skinning_joints is not None:
            joints = head(x, "skinning", [0.0] * self.skinning_joints, nn.initializers.zeros)
        if shells:
            # the nearest shell has the larger logit: Gaussians start near the surface
            chosen = head(x, "shells", [4.0] + [0.0] * (shells - 1), small)
        geometry = head(x, "geometry", [0.0] * 3 + list(quaternion.IDENTITY) + scales, small)
        return RawGaussians(
            geometry, head(x, "appearance", [0.0] * 3 + [INITIAL_OPACITY], small), joints, chosen
        )


@pytree_dataclass
class RawGaussians:
    """The outputs of the heads before their activations, for n vertices and k Gaussians of each."""

    geometry: Float[Array, "n k 10"]
    """Offset, quaternion and scale, (n, k, 10)."""
    appearance: Float[Array, "n k 4"]
    """Color and opacity, (n, k, 4)."""
    skinning: Float[Array, "n k j"] | None
    """Logits of the joints, (n, k, j), or None."""
    shells: Float[Array, "n k s"] | None = None
    """Logits of the points along the normal, (n, k, s), or None."""


@pytree_dataclass
class VertexGaussians:
    """K Gaussians of every vertex, lengths in normalised units."""

    offsets: Float[Array, "n k 3"]
    """Offsets from the vertex, (n, k, 3)."""
    quats: Float[Array, "n k 4"]
    """Rotations, (n, k, 4), unit quaternions wxyz."""
    scales: Float[Array, "n k 3"]
    """Standard deviations, (n, k, 3)."""
    opacities: Float[Array, "n k"]
    """Opacities, (n, k), in [0, 1]."""
    colors: Float[Array, "n k 3"]
    """RGB, (n, k, 3), in [0, 1]."""


def positional_encoding(x: Float[Array, "n 3"]) -> Float[Array, "n 39"]:
    """Returns x, then sin(f pi x) and cos(f pi x) for f = 1, 2, 4, 8, 16, 32, (n, 39)."""
    waves = [wave(f * np.pi * x) for f in (1, 2, 4, 8, 16, 32) for wave in (jnp.sin, jnp.cos)]
    return jnp.concatenate([x, *waves], axis=-1)


def decoder_input(features: VertexFeatures, canonical: Float[Array, "n 3"]) -> Float[Array, "n c"]:
    """Returns the inputs of the decoder, (n, c): local feature, global token, encoded position,
    photo color as 2 rgb - 1, visible fraction, normal and shells, in this order. Missing inputs are
    left out.
    """
    vertices = canonical.shape[0]
    parts = [features.local]
    if features.global_token is not None:
        parts.append(
            jnp.broadcast_to(features.global_token, (vertices, features.global_token.shape[0]))
        )
    parts.append(positional_encoding(canonical))
    if features.photo_colors is not None:
        assert features.visible_fraction is not None  # it comes with the colors
        parts += [2 * features.photo_colors - 1, features.visible_fraction[:, None]]
    if features.normals is not None:
        parts.append(features.normals)
    shells = features.shells
    if shells is not None:
        parts += [
            (2 * shells.colors - 1).reshape(vertices, -1),
            shells.seen,
            shells.inside,
            shells.hull,
        ]
    return jnp.concatenate(parts, axis=-1)


def normal_frames(normals: Float[Array, "n 3"]) -> Float[Array, "n 4"]:
    """Returns rotations (n, 4) that take z to each normal. They are smooth in the normal except
    near the direction opposite to `OBLIQUE`.
    """
    oblique = jnp.asarray(OBLIQUE, normals.dtype)
    upright = quaternion.between(jnp.asarray([0.0, 0.0, 1.0], normals.dtype), oblique)
    return quaternion.multiply(quaternion.between(oblique, normals), upright)


def activate(
    raw: RawGaussians, config: VertexDecoder, features: VertexFeatures | None = None
) -> VertexGaussians:
    """Returns the Gaussians that the heads' outputs stand for. Quaternions are normalised, scales
    go through a softplus, colors and opacities through a sigmoid. Offsets are bounded if
    `VertexDecoder.offset_scale` is not None. Offsets and rotations are turned to the axes of the
    canonical body.

    With shells, each Gaussian has weights of the shells that sum to 1. Its offset is added to the
    weighted mean of the distances along the normal. With `VertexDecoder.residual_color`, its color
    is relative to the weighted mean of the shells' photo colors, or without shells to the vertex's
    photo color.

    Raises: ValueError if the configuration needs photo colors and there are none.
    """
    # shape
    offsets, quats, scales = jnp.split(raw.geometry, (3, 7), axis=-1)
    quats = quaternion.normalize(quats)
    if config.offset_scale is not None:
        offsets = config.offset_scale * jnp.tanh(offsets / config.offset_scale)
    # what the photos show at the vertex, or on its shells
    colors, opacities = raw.appearance[..., :3], raw.appearance[..., 3]
    seen = None
    if features is not None and features.photo_colors is not None:
        seen = features.photo_colors[:, None]
    if raw.shells is not None:
        assert features is not None and features.shells is not None  # where the logits come from
        shells, chosen = features.shells, jax.nn.softmax(raw.shells, axis=-1)
        offsets = offsets.at[..., 2].add(_mean(chosen, shells.distances))
        seen = jnp.einsum("nks,nsc->nkc", chosen, shells.colors, precision=EXACT)
    # offsets and rotations are those of the frame of the normal
    if config.frame == "normal":
        assert features is not None and features.normals is not None  # such a network is given them
        frames = normal_frames(features.normals)[:, None]
        offsets = jnp.einsum(
            "nkij,nkj->nki", quaternion.to_matrix(frames), offsets, precision=EXACT
        )
        quats = quaternion.multiply(frames, quats)
    if config.residual_color:
        if seen is None:
            raise ValueError("decoder.residual_color needs a reader that gives photo_colors")
        colors = colors + inverse_sigmoid(seen, COLOR_MARGIN)
    return VertexGaussians(
        offsets, quats, jax.nn.softplus(scales), jax.nn.sigmoid(opacities), jax.nn.sigmoid(colors)
    )


def _mean(weights: Float[Array, "n k s"], values: Float[Array, " s"]) -> Float[Array, "n k"]:
    """Returns the sums of the values (s,), weighted with `weights`, (n, k). The product has full
    precision, because values are lengths, which must not be rounded to bfloat16.
    """
    return jnp.matmul(weights, values, precision=EXACT)


def corrected_skinning_weights(
    weights: Float[Array, "n j"], offsets: Float[Array, "g j"] | None, gaussians_per_vertex: int
) -> Float[Array, "g j"]:
    """Returns the skinning weights of every Gaussian, (g, j): the weights w of its vertex, or
    softmax(log(w + 1e-9) + offsets) with the offsets of a skinning head.
    """
    weights = jnp.repeat(weights, gaussians_per_vertex, axis=0)
    if offsets is None:
        return weights
    return jax.nn.softmax(jnp.log(weights + WEIGHT_EPSILON) + offsets, axis=-1)
