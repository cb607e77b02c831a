"""What the network computes on its way, for comparison with another implementation.

The forward pass is the one of `network.humangs`; what its modules return is recorded by Linen, so that the pass itself
knows nothing of being watched.
"""

import dataclasses
from typing import Any, cast

from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.network.humangs import (
    Encoder,
    Encoding,
    HumanGSConfig,
    HumanGSInputs,
    HumanGSOutputs,
    Variables,
    assemble,
    decode_heads,
    encoder_pixels,
    sample_vertices,
    select_tokens,
)
from humangs_jax.network.tokenizer import Tokenizer
from humangs_jax.network.transformer import Block, Transformer
from humangs_jax.network.triplane import sample_triplane
from humangs_jax.network.vertex_decoder import RawGaussians, VertexFeatures


@pytree_dataclass
class Stages:
    """Every stage of one subject's pass, p patches, l tokens (those and the class token, which comes first).

    rays: (v, h, w, 6) moment, direction. pose_features: (v, h, w, c) of the neural texture. tokens: (p, d). first_block,
    encoded: (l, d) after the first block, and after the final norm. maps: (v, h', w', d) with the last convolution evaluated
    everywhere, for looking at. features: of the vertices.
    raw: heads before their activations. outputs: canonical Gaussians.
    """

    rays: Float[Array, "v h w 6"]
    pose_features: Float[Array, "v h w c"]
    tokens: Float[Array, "p d"]
    first_block: Float[Array, "l d"]
    encoded: Float[Array, "l d"]
    maps: Float[Array, "v i j e"]
    features: VertexFeatures
    raw: RawGaussians
    outputs: HumanGSOutputs


def network_stages(variables: Variables, inputs: HumanGSInputs, config: HumanGSConfig) -> Stages:
    """The evaluating pass of `apply_humangs`, and all that it computes on its way. Raises: see `encode`."""
    config = dataclasses.replace(config, transformer=dataclasses.replace(config.transformer, scan=False))
    pixels = encoder_pixels(inputs, config)
    own = {kind: tree["encoder"] for kind, tree in variables.items() if tree}
    result, recorded = Encoder(config).apply(
        own,
        pixels,
        select_tokens(inputs, config),
        inputs.view_count,
        capture_intermediates=lambda module, _: isinstance(module, Tokenizer | Transformer | Block),
        mutable=["intermediates"],
    )
    maps, global_token = cast(tuple[Array, Array | None], result)
    seen = cast(dict[str, Any], recorded)["intermediates"]
    output = lambda module: module["__call__"][0]
    features = sample_vertices(variables, Encoding(maps, global_token), inputs, config)
    if config.upsampler.enabled:
        readout = {"params": variables["params"]["readout"]}
        maps = cast(Array, config.readout.apply(readout, maps, method="everywhere"))
    raw = decode_heads(variables, features, inputs.canonical_vertices, config)
    return Stages(
        rays=pixels[..., 3:9],
        pose_features=sample_triplane(variables["params"]["encoder"]["tokenizer"]["texture"], pixels[..., 9:]),
        tokens=output(seen["tokenizer"]),
        first_block=output(seen["transformer"]["block_0"]),
        encoded=output(seen["transformer"])[-1],
        maps=maps,
        features=features,
        raw=raw,
        outputs=assemble(raw, features, inputs.canonical_vertices, config),
    )
