"""Defines the configuration of a network, in three parts: what its weights are, what they were
trained with, and how it runs.

Weights files record `Architecture` and `Conventions`. `Runtime` belongs to the user and the
machine.
"""

import dataclasses
from typing import Any

import jax

from humangs_jax.core.configuration import configuration
from humangs_jax.network.encoder import PatchTransformer
from humangs_jax.network.parts import Decoder, Encoder, ForwardContext, Reader, TargetDecoder
from humangs_jax.network.reader import PixelAlignedReader
from humangs_jax.network.runtime import Conventions, Runtime, TokenSelection
from humangs_jax.network.vertex_decoder import VertexDecoder


@configuration
class Architecture:
    """What the weights are: the parts of the network with their sizes.

    It fixes the shape of every tensor.
    """

    encoder: Encoder = PatchTransformer()
    """Makes features of the photos."""
    reader: Reader = PixelAlignedReader()
    """Reads the features at the body's vertices."""
    decoder: Decoder = VertexDecoder()
    """Makes Gaussians from the features."""
    driver: TargetDecoder | None = None
    """Runs again for every target and draws it. None: skinning alone moves the Gaussians."""

    def __post_init__(self):
        """Raises ValueError for parts that do not fit together."""
        reader, decoder = self.reader, self.decoder
        if isinstance(reader, PixelAlignedReader) and isinstance(decoder, VertexDecoder):
            if decoder.residual_color and not reader.sample_rgb:
                raise ValueError(
                    "decoder.residual_color needs reader.sample_rgb: there is no photo color to"
                    " correct"
                )
            if reader.shells and decoder.frame != "normal":
                raise ValueError(
                    'reader.shells lie along the normals: they need decoder.frame = "normal"'
                )
        maps = self._surface_maps
        if len(maps) > 1:
            raise ValueError(
                f"surface_map: expected one for all parts, got {sorted(map(str, maps))}"
            )

    @property
    def surface_map(self) -> Any:
        """The map of the body's surface that parts work on, see `network.parts`. None: no part
        works on a map.
        """
        return next(iter(self._surface_maps), None)

    @property
    def _surface_maps(self) -> set[Any]:
        parts = self.encoder, self.reader, self.decoder, self.driver
        return {getattr(part, "surface_map", None) for part in parts} - {None}


def paper_parts(
    architecture: Architecture,
) -> tuple[PatchTransformer, PixelAlignedReader, VertexDecoder]:
    """Returns the three parts of the paper's network.

    Raises: ValueError, which names the classes of all three, if a part has been exchanged.
    """
    encoder, reader, decoder = architecture.encoder, architecture.reader, architecture.decoder
    if (
        isinstance(encoder, PatchTransformer)
        and isinstance(reader, PixelAlignedReader)
        and isinstance(decoder, VertexDecoder)
    ):
        return encoder, reader, decoder
    names = ", ".join(type(part).__name__ for part in (encoder, reader, decoder))
    raise ValueError(f"expected the parts of the paper's network, got {names}")


@jax.tree_util.register_static
@configuration
class HumanGSConfig:
    """The configuration of a network, see `Architecture`, `Conventions`, `Runtime`, and
    `network.presets`.

    For JAX it is a pytree without leaves.
    """

    architecture: Architecture = dataclasses.field(default_factory=Architecture)
    """What the weights are."""
    conventions: Conventions = dataclasses.field(default_factory=Conventions)
    """What the weights were trained with."""
    runtime: Runtime = dataclasses.field(default_factory=Runtime)
    """How the network runs here."""

    def __post_init__(self):
        """Raises ValueError if an image size is no multiple of the encoder's patch size."""
        patch = self.architecture.encoder.patch_size
        for size in (self.conventions.image_size, self.image_size):
            if size % patch:
                raise ValueError(f"image_size {size} is not a multiple of patch_size {patch}")

    @property
    def tokens(self) -> TokenSelection:
        """The selection of tokens that is used: `Runtime.tokens`, or `Conventions.tokens` if that
        is None.
        """
        return self.forward_context().tokens

    def forward_context(self, train: bool = False, axis_name: Any = None) -> ForwardContext:
        """Returns the record of how one pass runs, which all parts get. train, axis_name: see
        `ForwardContext`.
        """
        return ForwardContext(self.conventions, self.runtime, train, axis_name)

    @property
    def image_size(self) -> int:
        """Side of the photos that is used, pixels: `Runtime.image_size`, or
        `Conventions.image_size` if that is None.
        """
        return self.runtime.image_size or self.conventions.image_size

    @property
    def trained(self) -> "HumanGSConfig":
        """This configuration with the default runtime. Weights files do not record the runtime."""
        return dataclasses.replace(self, runtime=Runtime())

    def with_runtime(self, **changes: Any) -> "HumanGSConfig":
        """Returns the configuration with other values of fields of its `Runtime`."""
        return dataclasses.replace(self, runtime=dataclasses.replace(self.runtime, **changes))

    def with_conventions(self, **changes: Any) -> "HumanGSConfig":
        """Returns the configuration with other values of fields of its `Conventions`."""
        return dataclasses.replace(
            self, conventions=dataclasses.replace(self.conventions, **changes)
        )

    def with_parts(self, **changes: Any) -> "HumanGSConfig":
        """Returns the configuration with some parts replaced by others."""
        return dataclasses.replace(
            self, architecture=dataclasses.replace(self.architecture, **changes)
        )
