"""Encoder, reader, decoder and driver: what each of them takes and gives, so that it can be
exchanged.

    encoding = encoder(photos)
    features = reader(encoding)
    Gaussians = decoder(features)

A part is a Linen module: its fields are its configuration, which weights files record by the name
of the class. It gets what the part before it has made, the inputs, and how this pass runs; it knows
no other part. A new part is a new file with a class that derives from `Encoder`, `Reader`,
`Decoder` or `TargetDecoder` and has the decorator `core.configuration.part`, and one line of a
preset that names it: see `experiments/systems`.

A part that works on a map of the body's surface has it in a field `surface_map`: its `shape`, and
`texels(body)`, which `data.views.gaussian_body` asks for; the inputs carry them. A driver for
bodies of one number of joints says so in a field `joints`.

Lengths inside the network are normalised units: metres divided by s = (height of the canonical
body) / 1.8, so that every body is 1.8 high. Means and scales are multiplied by s at the end.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import flax.linen as nn
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyPose, Texels
from humangs_jax.core.array_types import Array, Bool, Float, Int, PyTree, Scalar
from humangs_jax.core.configuration import Part, Patch
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.runtime import Conventions, Runtime, TokenSelection
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.splatting import Rendering

T = TypeVar("T")
if TYPE_CHECKING:
    Parameters: TypeAlias = dict[str, "Array | Parameters"]
    Variables: TypeAlias = dict[str, Parameters]
else:
    Parameters = Variables = Mapping


@pytree_dataclass
class HumanGSInputs:
    """The photos of one subject, and the posed body in each of them."""

    images: Float[Array, "v h w 3"]
    """Photos, (v, h, w, 3), in [0, 1], on a white background."""
    cameras: Camera
    """A batch of v cameras, metres."""
    posed_vertices: Float[Array, "v n 3"]
    """The body in the pose of each photo, (v, n, 3), metres."""
    canonical_vertices: Float[Array, "n 3"]
    """The body in the T-pose, (n, 3), metres."""
    position_maps: Float[Array, "v h w 3"]
    """Canonical position that each pixel shows, (v, h, w, 3), normalised units; 1 on background."""
    depth_maps: Float[Array, "v h w"]
    """Rasterized z of the body, (v, h, w), normalised units; -1 on background."""
    foreground: Bool[Array, "v h w"]
    """Pixels of the person, (v, h, w), used where tokens are "foreground"."""
    view_count: Int[Array, ""] | None = None
    """Number of real views, which come first; the others are padding and change nothing. None: all
    are real.
    """
    posed_normals: Float[Array, "v n 3"] | None = None
    """Unit normals of the posed vertices, (v, n, 3), used with shells."""
    canonical_normals: Float[Array, "n 3"] | None = None
    """Unit normals of the canonical vertices, (n, 3), used where the decoder's frame is
    "normal".
    """
    relative_vertex_spacing: Float[Array, " n"] | None = None
    """Distance between vertices relative to the mesh that the weights were trained with, (n,);
    None: 1.
    """
    skinning_weights: Float[Array, "n j"] | None = None
    """Skinning weights of the body, (n, j), for decoders whose Gaussians are not those of
    vertices.
    """
    texels: Texels | None = None
    """The map of the body's surface, for parts that work on one."""

    @property
    def present(self) -> Bool[Array, " v"]:
        """Which views are not padding."""
        count = len(self.images) if self.view_count is None else self.view_count
        return jnp.arange(len(self.images)) < count


def subject_unit(canonical_vertices: Float[Array, "n 3"]) -> Scalar:
    """Returns s, metres per normalised unit: the canonical body's height over 1.8."""
    y = canonical_vertices[:, 1]
    return (jnp.max(y) - jnp.min(y)) / 1.8


class ForwardContext(NamedTuple):
    """How one pass of the network runs: all that a part knows besides its fields. See
    `HumanGSConfig.forward_context`.
    """

    conventions: Conventions
    """What the weights were trained with."""
    runtime: Runtime
    """How the network runs here."""
    train: bool = False
    """Whether batch norms use this subject's statistics and update the running ones."""
    axis_name: str | tuple[str, ...] | None = None
    """Axes of `vmap` over which those statistics are shared."""

    @property
    def tokens(self) -> TokenSelection:
        """The selection of tokens in force."""
        return self.runtime.tokens or self.conventions.tokens


@pytree_dataclass
class Packing:
    """Which patches became tokens."""

    indices: Int[Array, " l"]
    """Patch of each token, (l,), in the order of the patches; the number of patches itself where a
    token is padding.
    """
    count: Int[Array, ""]
    """Number of real tokens, which come first; the rest is padding."""


@pytree_dataclass
class Encoding:
    """What an encoder makes of the photos."""

    maps: Float[Array, "v h w d"]
    """Features, (v, h', w', d)."""
    global_token: Float[Array, " e"] | None
    """Features of the whole subject, (e,), or None."""
    dropped_tokens: Int[Array, ""]
    """Number of foreground patches for which the token capacity had no room."""
    packing: Packing | None = None
    """The patches of which the maps know something; None: all."""
    patch_size: int = static_field(default=1)
    """Side of a patch, pixels."""


@pytree_dataclass
class Shells:
    """What the photos show at the s points along the normal of each vertex.

    A view that does not contain a point is ignored.
    """

    distances: Float[Array, " s"]
    """Distances of the points from the surface, (s,), normalised units."""
    colors: Float[Array, "n s 3"]
    """Mean photo color over the views in which the point is visible and in the foreground, weighted
    by how much the posed normal faces them, (n, s, 3); grey without such a view.
    """
    seen: Float[Array, "n s"]
    """The sum of those weights over the number of views, (n, s)."""
    inside: Float[Array, "n s"]
    """Mean mask at the point over the views that contain it, (n, s); 1 if there is none."""
    hull: Float[Array, "n s"]
    """Least mask at the point over the same views, (n, s): 0 outside of the visual hull; 1 if there
    is none.
    """


@pytree_dataclass
class VertexFeatures:
    """What the photos show of each vertex."""

    local: Float[Array, "n d"]
    """Pooled feature of each vertex, (n, d)."""
    global_token: Float[Array, " e"] | None = None
    """Features of the whole subject, (e,), or None."""
    photo_colors: Float[Array, "n 3"] | None = None
    """Mean photo color over the views that see the vertex, (n, 3), or None."""
    visible_fraction: Float[Array, " n"] | None = None
    """Share of the views that see the vertex, (n,), or None."""
    shells: Shells | None = None
    """What the photos show off the surface, or None."""
    normals: Float[Array, "n 3"] | None = None
    """Unit normals of the canonical body, (n, 3), or None."""


@pytree_dataclass
class HumanGSOutputs:
    """Canonical Gaussians of one subject."""

    gaussians: Gaussians
    """The Gaussians, metres. Without `skinning_weights` there are g = n * k, vertex by vertex."""
    tight_offsets: Float[Array, "n t 3"] | None = None
    """Offsets of the tight Gaussians from the vertex, or of each Gaussian from where it belongs,
    (n, t, 3), normalised units, for the tightness loss, which is 0 for None.
    """
    skinning_offsets: Float[Array, "g j"] | None = None
    """Logits of the skinning head, (n * k, j), or None (see
    `vertex_decoder.corrected_skinning_weights`).
    """
    dropped_tokens: Int[Array, ""] = dataclasses.field(
        default_factory=lambda: jnp.zeros((), jnp.int32)
    )
    """Number of foreground patches for which the token capacity had no room."""
    skinning_weights: Float[Array, "g j"] | None = None
    """Rows of sum 1, (g, j), of Gaussians that do not belong to one vertex each; None: the body's
    weights.
    """
    scene: PyTree = None
    """What a driver works from for every target: the features, unless a decoder sets it."""

    @property
    def is_empty(self) -> bool:
        """Whether there is no Gaussian, as where a driver makes images without them."""
        return self.gaussians.opacities.shape[-1] == 0


class Target(NamedTuple):
    """What a driver knows of a target."""

    pose: BodyPose
    """The pose of the target."""
    vertices: Float[Array, "n 3"]
    """Vertices of the posed body, (n, 3), metres."""
    pixels: Float[Array, "h w 9"] | None = None
    """The ray of every pixel (moment, direction) and the canonical position of the body there (1 on
    background), (h, w, 9), normalised units, for drivers that make images; else None.
    """


class Drawn(NamedTuple):
    """Images of the v targets of one subject, and what losses compare besides."""

    rendering: Rendering
    """The images of all targets; `distortion` is None unless its loss has a weight."""
    opacities: Float[Array, " g"] | None = None
    """Opacities of the Gaussians that were drawn, (g,). None: there were none, and no alpha or
    depth either.
    """
    tight_offsets: Float[Array, "n t 3"] | None = None
    """Tight offsets of the Gaussians that were drawn, (n, t, 3), normalised units, or None."""


class Encoder(Part, nn.Module):
    """Photos -> `Encoding`. Alone among parts it may have running statistics, in the collection
    "batch_stats".
    """

    patch_size: Patch = 1
    """The side of photos is a multiple of it, pixels."""

    def __call__(self, inputs: HumanGSInputs, ctx: ForwardContext) -> Encoding:
        """Returns the encoding."""
        raise NotImplementedError


class Reader(Part, nn.Module):
    """`Encoding` -> features of the body, in whatever form the decoder takes."""

    def __call__(self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext) -> PyTree:
        """Returns features."""
        raise NotImplementedError


class Decoder(Part, nn.Module):
    """Features of the body -> canonical Gaussians."""

    def __call__(
        self, features: PyTree, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns Gaussians; `dropped_tokens` is set by the pass."""
        raise NotImplementedError


class TargetDecoder(Part, nn.Module):
    """A part that runs again for every target and draws it; without one, canonical Gaussians move
    by skinning alone.
    """

    has_alpha = True
    """Whether its images can be put on any background; else they are on white."""

    def __call__(self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext) -> PyTree:
        """Returns the outputs corrected for a target, or its image."""
        raise NotImplementedError

    @nn.nowrap
    def draw(
        self,
        variables: Variables,
        outputs: HumanGSOutputs,
        body: PyTree,
        photos: PyTree,
        targets: PyTree,
        backgrounds: Float[Array, "v 3"],
        config: PyTree,
    ) -> Drawn:
        """Draws the targets (`SubjectViews`) of one subject as a `TrainConfig` has them;
        `training.forward.draw_targets` draws others.
        """
        raise NotImplementedError

    @nn.nowrap
    def show(
        self,
        variables: Variables,
        config: PyTree,
        inputs: PyTree,
        targets: PyTree,
        background: float,
    ) -> tuple[Float[np.ndarray, "v h w 3"], Float[np.ndarray, "v h w"] | None]:
        """Returns images and alpha of the person of one capture in the views of another, for
        evaluations. variables, config: the network's.
        """
        raise NotImplementedError


class Tap(nn.Module):
    """The module behind `tap`, which interceptors of Linen see."""

    apart: bool = False
    """Whether each entry of the dict that the function returns is a stage by itself."""

    def __call__(self, function: Callable[..., T], *learned: Any) -> T:
        """Returns function(*learned)."""
        return function(*learned)


def tap(name: str, function: Callable[..., T], *learned: Any, apart: bool = False) -> T:
    """Returns function(*learned), as a step beside the network: Linen's interceptors see it as they
    see the network's modules.

    learned: the arguments that depend on parameters.
    """
    return Tap(apart, parent=None, name=name)(function, *learned)
