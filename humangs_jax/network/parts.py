"""Defines the exchangeable parts of a network: encoder, reader, decoder and driver, and what they
take and return.

    encoding = encoder(photos)
    features = reader(encoding)
    Gaussians = decoder(features)

A part is a Linen module. Its fields are its configuration, and weights files record them with the
name of the class. A part gets the result of the part before it, the inputs, and a record of how
this pass runs. It knows no other part. A new part is a new file with a class that derives from
`Encoder`, `Reader`, `Decoder` or `TargetDecoder` and has the decorator `core.configuration.part`,
and one line of a preset that names it: see `experiments/systems`.

A part that works on a map of the body's surface has this map in a field `surface_map`, with its
`shape` and a method `texels(body)`. `data.views.gaussian_body` calls the method, and the inputs
carry the texels. A driver for bodies with a fixed number of joints has that number in a field
`joints`.

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
    """Canonical position that each pixel shows, (v, h, w, 3), normalised units. Every coordinate is
    1 on background.
    """
    depth_maps: Float[Array, "v h w"]
    """Rasterized z of the body, (v, h, w), normalised units; -1 on background."""
    foreground: Bool[Array, "v h w"]
    """Pixels of the mask or of the body, (v, h, w), for "foreground" tokens and for shells. With
    `Conventions.pixels` "person", pixels of the mask alone, if the photo has one.
    """
    view_count: Int[Array, ""] | None = None
    """Number of real views, which come first. The others are padding and change nothing. None: all
    views are real.
    """
    posed_normals: Float[Array, "v n 3"] | None = None
    """Unit normals of the posed vertices, (v, n, 3), used with shells."""
    canonical_normals: Float[Array, "n 3"] | None = None
    """Unit normals of the canonical vertices, (n, 3), used where the decoder's frame is
    "normal".
    """
    relative_vertex_spacing: Float[Array, " n"] | None = None
    """Distance between neighbouring vertices, divided by their distance in the mesh with which the
    weights were trained, (n,). None: 1 everywhere.
    """
    skinning_weights: Float[Array, "n j"] | None = None
    """Skinning weights of the body, (n, j), for decoders whose Gaussians do not belong to one
    vertex each.
    """
    texels: Texels | None = None
    """The map of the body's surface, for parts that work on one, or None."""

    @property
    def present(self) -> Bool[Array, " v"]:
        """Whether each view is real and not padding, (v,)."""
        count = len(self.images) if self.view_count is None else self.view_count
        return jnp.arange(len(self.images)) < count


def subject_unit(canonical_vertices: Float[Array, "n 3"]) -> Scalar:
    """Returns s, metres per normalised unit: the canonical body's height over 1.8."""
    y = canonical_vertices[:, 1]
    return (jnp.max(y) - jnp.min(y)) / 1.8


class ForwardContext(NamedTuple):
    """How one pass of the network runs. A part knows nothing else besides its fields and inputs.
    See `HumanGSConfig.forward_context`.
    """

    conventions: Conventions
    """What the weights were trained with."""
    runtime: Runtime
    """How the network runs here."""
    train: bool = False
    """Whether batch norms use this subject's statistics and update the running ones."""
    axis_name: str | tuple[str, ...] | None = None
    """Axes of `vmap` over which the statistics of batch norms are shared."""

    @property
    def tokens(self) -> TokenSelection:
        """The selection of tokens that is used: `Runtime.tokens`, or `Conventions.tokens` if that
        is None.
        """
        return self.runtime.tokens or self.conventions.tokens


@pytree_dataclass
class Packing:
    """The patches that became tokens."""

    indices: Int[Array, " l"]
    """Index of the patch of each token, (l,), ascending. For tokens that are padding, it is the
    number of patches.
    """
    count: Int[Array, ""]
    """Number of real tokens, which come first. The others are padding."""


@pytree_dataclass
class Encoding:
    """The result of an encoder."""

    maps: Float[Array, "v h w d"]
    """Feature maps of the views, (v, h', w', d)."""
    global_token: Float[Array, " e"] | None
    """Features of the whole subject, (e,), or None."""
    dropped_tokens: Int[Array, ""]
    """Number of foreground patches for which the token capacity had no room."""
    packing: Packing | None = None
    """The patches that became tokens, if the maps have features of these patches only. None: the
    maps have features of all patches.
    """
    patch_size: int = static_field(default=1)
    """Side of a patch, pixels."""


@pytree_dataclass
class Shells:
    """The photos' colors and masks at the s points along the normal of each vertex.

    A view that does not contain a point is ignored.
    """

    distances: Float[Array, " s"]
    """Distances of the points from the surface, (s,), normalised units."""
    colors: Float[Array, "n s 3"]
    """Mean photo color of each point, (n, s, 3). A view counts if the point is visible and in the
    foreground there. Its weight is the cosine of the angle between the posed normal and the
    direction to the camera. Grey if no view counts.
    """
    seen: Float[Array, "n s"]
    """Sum of the weights in `colors`, divided by the number of real views, (n, s)."""
    inside: Float[Array, "n s"]
    """Mean mask at the point over the views that contain it, (n, s). It is 1 if no view contains
    the point.
    """
    hull: Float[Array, "n s"]
    """Smallest mask at the point over the views that contain it, (n, s). It is 0 outside of the
    visual hull, and 1 if no view contains the point.
    """


@pytree_dataclass
class VertexFeatures:
    """The features of each vertex, read from the photos."""

    local: Float[Array, "n d"]
    """Pooled feature of each vertex, (n, d)."""
    global_token: Float[Array, " e"] | None = None
    """Features of the whole subject, (e,), or None."""
    photo_colors: Float[Array, "n 3"] | None = None
    """Mean photo color over the views that see the vertex, (n, 3), or None."""
    visible_fraction: Float[Array, " n"] | None = None
    """Share of the views that see the vertex, (n,), or None."""
    shells: Shells | None = None
    """The photos' colors and masks off the surface, or None."""
    normals: Float[Array, "n 3"] | None = None
    """Unit normals of the canonical body, (n, 3), or None."""


@pytree_dataclass
class HumanGSOutputs:
    """Canonical Gaussians of one subject."""

    gaussians: Gaussians
    """The Gaussians, metres. Without `skinning_weights` they are g = n * k, ordered by vertex."""
    tight_offsets: Float[Array, "n t 3"] | None = None
    """Offsets that the tightness loss keeps small, (n, t, 3), normalised units. They are the
    offsets of the tight Gaussians from their vertex. In decoders without vertices they are the
    offsets of all Gaussians from their places. None: the loss is 0.
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
    """Skinning weights of the Gaussians, (g, j), rows of sum 1, if Gaussians do not belong to one
    vertex each. None: the body's weights.
    """
    scene: PyTree = None
    """The data from which a driver draws every target. If there is a driver, and the decoder sets
    nothing here, these are the features that the decoder took.
    """

    @property
    def is_empty(self) -> bool:
        """Whether there are no Gaussians, because a driver makes images without them."""
        return self.gaussians.opacities.shape[-1] == 0


class Target(NamedTuple):
    """One target, as a driver gets it."""

    pose: BodyPose
    """The pose of the target."""
    vertices: Float[Array, "n 3"]
    """Vertices of the posed body, (n, 3), metres."""
    pixels: Float[Array, "h w 9"] | None = None
    """The ray of every pixel (moment, direction) and the canonical position of the body there (1 on
    background), (h, w, 9), normalised units. None unless the driver makes images.
    """


class Drawn(NamedTuple):
    """Images of the v targets of one subject, and other arrays that losses compare."""

    rendering: Rendering
    """The images of all targets; `distortion` is None unless its loss has a weight."""
    opacities: Float[Array, " g"] | None = None
    """Opacities of the Gaussians that were drawn, (g,). None: no Gaussians were drawn, and there is
    no alpha or depth either.
    """
    tight_offsets: Float[Array, "n t 3"] | None = None
    """Tight offsets of the Gaussians that were drawn, (n, t, 3), normalised units, or None."""


class Encoder(Part, nn.Module):
    """A part that makes an `Encoding` from photos. It is the only part that may have running
    statistics, in the collection "batch_stats".
    """

    patch_size: Patch = 1
    """Side of a patch, pixels. The side of photos must be a multiple of it."""

    def __call__(self, inputs: HumanGSInputs, ctx: ForwardContext) -> Encoding:
        """Returns the encoding of the photos."""
        raise NotImplementedError


class Reader(Part, nn.Module):
    """A part that makes features of the body from an `Encoding`, in the form that the decoder
    takes.
    """

    def __call__(self, encoding: Encoding, inputs: HumanGSInputs, ctx: ForwardContext) -> PyTree:
        """Returns the features."""
        raise NotImplementedError


class Decoder(Part, nn.Module):
    """A part that makes canonical Gaussians from features of the body."""

    def __call__(
        self, features: PyTree, inputs: HumanGSInputs, ctx: ForwardContext
    ) -> HumanGSOutputs:
        """Returns the Gaussians. `HumanGS` sets `dropped_tokens` afterwards."""
        raise NotImplementedError


class TargetDecoder(Part, nn.Module):
    """A part that runs again for every target and draws it. Without such a part, canonical
    Gaussians move by skinning alone.
    """

    has_alpha = True
    """Whether the part's images have alpha and can be put on any background. Otherwise they are on
    white.
    """

    def __call__(self, outputs: HumanGSOutputs, target: Target, ctx: ForwardContext) -> PyTree:
        """Returns the outputs, corrected for a target, or the image of the target."""
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
        """Draws the targets of one subject as a `TrainConfig` asks for them, and returns the
        images. photos and targets: `SubjectViews`. `training.forward.draw_targets` calls it, and
        draws targets itself where there is no driver.
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
        """Returns the images of a person in the target views, (v, h, w, 3), and their alpha, (v, h,
        w), or None if the part makes no alpha. Evaluations call it. variables, config: of the
        network. inputs: the photos of the person. background: grey level of the background, in [0,
        1].
        """
        raise NotImplementedError


class Tap(nn.Module):
    """The module that `tap` calls. It makes a step visible to interceptors of Linen."""

    apart: bool = False
    """Whether each entry of the dict that the function returns is a separate stage."""

    def __call__(self, function: Callable[..., T], *learned: Any) -> T:
        """Returns function(*learned)."""
        return function(*learned)


def tap(name: str, function: Callable[..., T], *learned: Any, apart: bool = False) -> T:
    """Returns function(*learned). Interceptors of Linen see the call as they see the network's
    modules.

    learned: the arguments that depend on parameters.
    """
    return Tap(apart, parent=None, name=name)(function, *learned)
