"""What an encoder, a reader, a decoder and a driver are, so that each can be exchanged.

    encoding = encoder(photos)        features = reader(encoding)        Gaussians = decoder(features)

That is one pass per person. What runs again for every target is a driver, which corrects the canonical Gaussians for a pose
(`Driver`), or a decoder that makes images without Gaussians (`PixelDecoder`). Both are called in `network.humangs` alone.

A part is a class with the decorator `core.configuration.part`: its fields are its configuration, which weights files record by
the name of the class, and its methods are pure functions. A new part is a new file with such a class, and one line of a preset
that names it: see `experiments/systems`. Variables of a part are {"params": ...,
"batch_stats": ...}, the latter only where it has running statistics, which only encoders update.

A part that works on a map of the body's surface says which one in a field or property `surface_map`, see `network.surface_map`.
"""

import dataclasses
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax.numpy as jnp

from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.runtime import Conventions, Runtime, TokenSelection
from humangs_jax.network.stages import StageCaller, call
from humangs_jax.rendering.gaussians import Gaussians

Variables = dict[str, Any]


class Pass(NamedTuple):
    """How one pass of the network runs: all that a part knows besides its own fields. See `HumanGSConfig.run`.

    train: batch norms use this subject's statistics and update the running ones. axis_name: vmap axes over which those are
    shared. stage: how named stages are called, see `network.stages`.
    """

    conventions: Conventions
    runtime: Runtime
    train: bool = False
    axis_name: str | tuple[str, ...] | None = None
    stage: StageCaller = call

    @property
    def tokens(self) -> TokenSelection:
        """The selection of tokens in force."""
        return self.runtime.tokens or self.conventions.tokens


class Encoding(NamedTuple):
    """What an encoder makes of the photos.

    maps: (v, h', w', d) features. global_token: (e,), or None. dropped_tokens: foreground patches for which the token
    capacity had no room.
    """

    maps: Float[Array, "v h w d"]
    global_token: Float[Array, " e"] | None
    dropped_tokens: Int[Array, ""]


@pytree_dataclass
class Shells:
    """What the photos show at the s points along the normal of each vertex.

    distances: (s,). colors: (n, s, 3) mean photo color over the views in which the point is visible and on the person, weighted
    by how much the posed normal faces them; grey without such a view. seen: (n, s) the sum of those weights over the number of
    views. inside: (n, s) mean mask at the point over the views that contain it. hull: (n, s) the minimum of the same, 0
    outside of the visual hull. A view that does not contain the point is ignored; without any view both are 1.
    """

    distances: Float[Array, " s"]
    colors: Float[Array, "n s 3"]
    seen: Float[Array, "n s"]
    inside: Float[Array, "n s"]
    hull: Float[Array, "n s"]


@pytree_dataclass
class VertexFeatures:
    """What the photos show of each vertex.

    local: (n, d) pooled feature. global_token: (e,) or None. photo_colors: (n, 3) and visible_fraction: (n,), or None.
    shells: points off the surface, or None. normals: (n, 3) unit, of the canonical body, or None.
    dropped_reads: vertices, summed over views, for which the vertex capacity had no room.
    """

    local: Float[Array, "n d"]
    global_token: Float[Array, " e"] | None = None
    photo_colors: Float[Array, "n 3"] | None = None
    visible_fraction: Float[Array, " n"] | None = None
    shells: Shells | None = None
    normals: Float[Array, "n 3"] | None = None
    dropped_reads: Int[Array, ""] | None = None


@pytree_dataclass
class HumanGSOutputs:
    """Canonical Gaussians of one subject.

    gaussians: metric. Without `skinning_weights` g = n * k of them, vertex-major, k fastest. tight_offsets: (n, k_tight, 3) from
    the vertex, or of each Gaussian from where it belongs, normalised units (for the tightness loss, which is 0 for None).
    shell_spread: (n, k) variance of the distances that a Gaussian mixes, normalised units; None without shells. skinning_offsets:
    (n * k, j) logits of the skinning head, or None (see `vertex_decoder.corrected_skinning_weights`). dropped_tokens: foreground
    patches for which the token capacity had no room. dropped_reads: vertices, summed over views, for which the vertex capacity
    had no room. skinning_weights: (g, j), rows of sum 1, of Gaussians that do not belong to one vertex each; None: the body's.
    scene: what a driver or a `PixelDecoder` works from for every target; a decoder may set it, else the pass sets the features
    where there is a driver.
    """

    gaussians: Gaussians
    tight_offsets: Float[Array, "n t 3"] | None = None
    skinning_offsets: Float[Array, "g j"] | None = None
    dropped_tokens: Int[Array, ""] = dataclasses.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    dropped_reads: Int[Array, ""] = dataclasses.field(default_factory=lambda: jnp.zeros((), jnp.int32))
    shell_spread: Float[Array, "n k"] | None = None
    skinning_weights: Float[Array, "g j"] | None = None
    scene: Any = None

    @property
    def is_empty(self) -> bool:
        """Whether there is no Gaussian, as a `PixelDecoder` leaves it."""
        return self.gaussians.opacities.shape[-1] == 0


@runtime_checkable
class Encoder(Protocol):
    """Photos -> `Encoding`."""

    @property
    def patch_size(self) -> int:
        """Side of a token's patch, pixels: the side of photos is a multiple of it. 1 where any side will do."""
        ...

    def init(self, key: Key, inputs: HumanGSInputs, run: Pass) -> Variables:
        """Fresh variables; only shapes of `inputs` matter."""
        ...

    def apply(self, variables: Variables, inputs: HumanGSInputs, run: Pass) -> tuple[Encoding, Variables]:
        """The encoding, and the batch statistics: updated ones where `run.train`."""
        ...


@runtime_checkable
class Reader(Protocol):
    """`Encoding` -> features of the body, in whatever form the decoder takes."""

    def init(self, key: Key, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Variables:
        """Fresh variables; {} for a reader that learns nothing."""
        ...

    def apply(self, variables: Variables, encoding: Encoding, inputs: HumanGSInputs, run: Pass) -> Any:
        """Features."""
        ...


@runtime_checkable
class Decoder(Protocol):
    """Features of the body -> canonical Gaussians."""

    def init(self, key: Key, features: Any, inputs: HumanGSInputs, run: Pass) -> Variables:
        """Fresh variables."""
        ...

    def apply(self, variables: Variables, features: Any, inputs: HumanGSInputs, run: Pass) -> HumanGSOutputs:
        """Gaussians; `dropped_tokens` is set by the pass."""
        ...


@runtime_checkable
class Driver(Protocol):
    """Canonical Gaussians -> canonical Gaussians of one driving frame, by a network that runs again for every frame."""

    def init(self, key: Key, features: Any, inputs: HumanGSInputs, run: Pass) -> Variables:
        """Fresh variables; `features` are those of the reader."""
        ...

    def apply(
        self, variables: Variables, outputs: HumanGSOutputs, pose: BodyPose, posed: Float[Array, "n 3"], run: Pass
    ) -> HumanGSOutputs:
        """The outputs with the Gaussians of one pose, before skinning; `posed`: the body's vertices in that pose, metres."""
        ...


@runtime_checkable
class PixelDecoder(Decoder, Protocol):
    """A decoder that makes images of targets without Gaussians. `apply` gives `scene_outputs`: nothing that could be animated.

    Images are on white: the background is not known to it, and there is no alpha.
    """

    def draw(
        self, variables: Variables, scene: Any, queries: Float[Array, "v h w 9"], run: Pass
    ) -> Float[Array, "v h w 3"]:
        """Images in [0, 1]. queries: of every target pixel the ray (moment, direction) and the canonical position of the body in
        the target's pose (1 on background), normalised units; sides are multiples of the encoder's patch size.
        """
        ...


def scene_outputs(scene: Any) -> HumanGSOutputs:
    """Outputs without Gaussians, of a `PixelDecoder`."""
    empty = lambda *shape: jnp.zeros((0, *shape))
    return HumanGSOutputs(Gaussians(empty(3), empty(4), empty(3), empty(), empty(3)), scene=scene)
