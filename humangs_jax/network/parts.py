"""What an encoder, a reader and a decoder are, so that each can be exchanged.

    encoding = encoder(photos)        features = reader(encoding)        Gaussians = decoder(features)

A part is a frozen dataclass: its fields are its configuration, which weights files record, and its methods are pure functions.
A new part is a new file with such a class, and one line of a preset that names it. Variables of a part are {"params": ...,
"batch_stats": ...}, the latter only where it has running statistics, which only encoders update.

Weights files name a part by module and class: a part that moves leaves an alias at its old place.
"""

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.stages import StageCaller, call
from humangs_jax.rendering.gaussians import Gaussians

if TYPE_CHECKING:
    from humangs_jax.network.config import HumanGSConfig

Variables = dict[str, Any]


class Pass(NamedTuple):
    """How one pass of the network runs.

    train: batch norms use this subject's statistics and update the running ones. axis_name: vmap axes over which those are
    shared. stage: how named stages are called, see `network.stages`.
    """

    config: "HumanGSConfig"
    train: bool = False
    axis_name: str | tuple[str, ...] | None = None
    stage: StageCaller = call


class Encoding(NamedTuple):
    """What an encoder makes of the photos.

    maps: (v, h', w', d) features. global_token: (e,), or None. dropped_tokens: foreground patches for which the token
    capacity had no room.
    """

    maps: Float[Array, "v h w d"]
    global_token: Float[Array, " e"] | None
    dropped_tokens: Int[Array, ""]


@pytree_dataclass
class HumanGSOutputs:
    """Canonical Gaussians of one subject.

    gaussians: g = n * k of them, metric, vertex-major, k fastest. tight_offsets: (n, k_tight, 3) from the vertex, normalised
    units (for the tightness loss). shell_spread: (n, k) variance of the distances that a Gaussian mixes, normalised units; None
    without shells. skinning_offsets: (n * k, j) logits of the skinning head, or None (see
    `vertex_decoder.corrected_skinning_weights`). dropped_tokens: foreground patches for which the token capacity had no room.
    dropped_reads: vertices, summed over views, for which the vertex capacity had no room.
    """

    gaussians: Gaussians
    tight_offsets: Float[Array, "n t 3"]
    skinning_offsets: Float[Array, "g j"] | None
    dropped_tokens: Int[Array, ""]
    dropped_reads: Int[Array, ""]
    shell_spread: Float[Array, "n k"] | None = None


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
