"""Runs the network, which makes canonical 3D Gaussians from photos with poses in one forward pass.

    encode   photos -> feature maps and a global token
    read     feature maps -> features of every body vertex
    decode   features -> K Gaussians per vertex of the canonical body

Each step is a part that the configuration chooses (`network.parts`). The pass itself is written
only here. All functions take ONE subject. For a batch, use `jax.vmap` over `inputs`, with variables
unbatched. `apply_humangs` is not compiled; compile it with `config` static.
"""

import functools
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp

from humangs_jax.body.model import BodyPose, Texels
from humangs_jax.core.array_types import Key, PyTree
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.compiled import compiled
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.config import Architecture, HumanGSConfig
from humangs_jax.network.parts import (
    Decoder,
    Encoder,
    Encoding,
    ForwardContext,
    HumanGSInputs,
    HumanGSOutputs,
    Parameters,
    Reader,
    Target,
    Variables,
)


class HumanGS(nn.Module):
    """The encoder, reader and decoder as one module. The variables of each have the name of its
    field.

    Linen's tools that look inside a module, such as interceptors, work on it. The driver is not
    included.
    """

    encoder: Encoder
    """Makes features of the photos."""
    reader: Reader
    """Reads the features at the vertices."""
    decoder: Decoder
    """Makes Gaussians from the features."""
    keeps_features: bool = False
    """Whether the outputs keep the features in `scene`, for a driver."""

    def __call__(self, inputs: HumanGSInputs, ctx: ForwardContext) -> HumanGSOutputs:
        """Returns the outputs for one subject."""
        encoding = self.encoder(inputs, ctx)
        features = self.reader(encoding, inputs, ctx)
        outputs = self.decoder(features, inputs, ctx)
        if self.keeps_features and outputs.scene is None:
            outputs = replace(outputs, scene=features)
        return replace(outputs, dropped_tokens=encoding.dropped_tokens)


def network(architecture: Architecture) -> HumanGS:
    """Returns the module of an architecture."""
    parts = architecture.encoder, architecture.reader, architecture.decoder
    return HumanGS(*parts, keeps_features=architecture.driver is not None, parent=None)


@checked_arguments
def apply_humangs(
    variables: Variables,
    inputs: HumanGSInputs,
    config: HumanGSConfig,
    train: bool = False,
    axis_name: str | tuple[str, ...] | None = None,
) -> tuple[HumanGSOutputs, Parameters]:
    """Returns the outputs of encoder, reader and decoder for one subject, and the running batch
    statistics.

    train: whether to normalise by this subject's statistics, and to return updated running
    statistics. Otherwise the running statistics are used, and returned unchanged. Under a vmap over
    subjects, give the vmap's `axis_name` to share the statistics over the batch. Without it each
    subject has separate statistics, which the caller has to average.

    Raises: TypeError for arguments of other classes. ValueError if images and cameras differ in
    size, cameras have distortion or a lens other than a pinhole, the sides of images are no
    multiples of the patch size, or inputs lack normals that the configuration needs.
    """
    statistics, ctx = variables.get("batch_stats", {}), config.forward_context(train, axis_name)
    if not (train and statistics):
        return cast(
            HumanGSOutputs, network(config.architecture).apply(variables, inputs, ctx)
        ), statistics
    outputs, updated = network(config.architecture).apply(
        variables, inputs, ctx, mutable=["batch_stats"]
    )
    return cast(HumanGSOutputs, outputs), cast(Variables, updated)["batch_stats"]


def intermediates(
    variables: Variables, inputs: HumanGSInputs, config: HumanGSConfig
) -> dict[str, Any]:
    """Returns the result of every module of the network by the path of the module, such as
    "encoder.transformer.block_0", in the order in which the modules finish. The path of the whole
    network is "". Raises: as `apply_humangs`.
    """
    found = {}

    def keep(run, arguments, named, context):
        result = run(*arguments, **named)
        if context.method_name == "__call__":
            found[".".join(context.module.path)] = result
        return result

    with nn.intercept_methods(keep):
        apply_humangs(variables, inputs, config.with_runtime(scan=False, remat="none"))
    return found


@compiled()
@checked_arguments
def init_humangs(key: Key, config: HumanGSConfig) -> Variables:
    """Returns fresh variables of a network, float32.

    Args:
        key: random key of JAX.
        config: configuration of the network.

    Returns:
        {"params": {"encoder", "reader", "decoder", "driver"}, "batch_stats": {"encoder"}}. A part
        without parameters or running statistics is absent there.

    Examples:
        >>> variables = hg.init_humangs(jax.random.key(0), config)
    """
    ctx, parts = config.forward_context(), config.architecture
    encoder_key, decoder_key = jax.random.split(key)
    inputs = _example_inputs(parts)

    def zeros(tree):
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), tree)

    def after(part, variables, *given):
        return zeros(jax.eval_shape(lambda v: part.apply(v, *given, ctx), variables))

    # each part is initialized on the shapes of what the part before it gives
    made = {"encoder": parts.encoder.init(encoder_key, inputs, ctx)}
    encoding = after(parts.encoder, made["encoder"], inputs)
    made["reader"] = parts.reader.init(jax.random.fold_in(key, 2), encoding, inputs, ctx)
    features = after(parts.reader, made["reader"], encoding, inputs)
    made["decoder"] = parts.decoder.init(decoder_key, features, inputs, ctx)
    if parts.driver is not None:
        outputs = after(parts.decoder, made["decoder"], features, inputs)
        if outputs.scene is None:
            outputs = replace(outputs, scene=features)
        pose = BodyPose(jnp.zeros((getattr(parts.driver, "joints", 1), 3)), jnp.zeros(3))
        pixels = inputs.images[0, ..., :1]
        target = Target(pose, inputs.canonical_vertices, jnp.repeat(pixels, 9, axis=-1))
        made["driver"] = parts.driver.init(jax.random.fold_in(key, 3), outputs, target, ctx)

    # variables by their kind, then by the name of the part
    def collect(kind):
        return {name: own[kind] for name, own in made.items() if kind in own}

    return {"params": collect("params"), "batch_stats": collect("batch_stats")}


@functools.partial(jax.jit, static_argnames="config")
def encode(variables: Variables, inputs: HumanGSInputs, config: HumanGSConfig) -> Encoding:
    """Runs the first step of `apply_humangs`: returns the encoding of photos. Norms use the running
    batch statistics. Raises: as `apply_humangs`.
    """
    return cast(
        Encoding,
        config.architecture.encoder.apply(
            part_variables(variables, "encoder"), inputs, config.forward_context()
        ),
    )


@functools.partial(jax.jit, static_argnames="config")
def read(
    variables: Variables, encoding: Encoding, inputs: HumanGSInputs, config: HumanGSConfig
) -> PyTree:
    """Runs the second step of `apply_humangs`: returns the features of the body. Raises: as
    `apply_humangs`.
    """
    return config.architecture.reader.apply(
        part_variables(variables, "reader"), encoding, inputs, config.forward_context()
    )


@functools.partial(jax.jit, static_argnames="config")
def decode(
    variables: Variables, features: PyTree, inputs: HumanGSInputs, config: HumanGSConfig
) -> HumanGSOutputs:
    """Runs the third step of `apply_humangs`: returns the outputs with canonical Gaussians, metres.
    Their `dropped_tokens` is 0, because this number belongs to the encoding. Raises: as
    `apply_humangs`.
    """
    own = part_variables(variables, "decoder")
    return cast(
        HumanGSOutputs,
        config.architecture.decoder.apply(own, features, inputs, config.forward_context()),
    )


def part_variables(variables: Variables, part: str) -> Variables:
    """Returns the variables {"params": ..., "batch_stats": ...} of one part. A kind of variables
    that the part does not have is absent.
    """
    return {kind: cast(Parameters, tree[part]) for kind, tree in variables.items() if part in tree}


def _example_inputs(parts: Architecture) -> HumanGSInputs:
    """Returns the smallest inputs that show the shapes of a network's variables: one view of 2 x 2
    patches, and a body of one vertex.
    """
    side, wanted = 2 * parts.encoder.patch_size, parts.surface_map
    grid, vertex = jnp.zeros((1, side, side)), jnp.zeros((1, 1, 3))
    texels = None
    if wanted is not None:
        texels = Texels(jnp.zeros((*wanted.shape, 3), jnp.int32), jnp.zeros((*wanted.shape, 3)))
    return HumanGSInputs(
        images=jnp.zeros((1, side, side, 3)),
        cameras=jax.tree.map(lambda x: x[None], Camera(jnp.eye(3), jnp.eye(4), side, side)),
        posed_vertices=vertex,
        canonical_vertices=vertex[0],
        position_maps=jnp.zeros((1, side, side, 3)),
        depth_maps=grid,
        foreground=grid > 0,
        posed_normals=vertex,
        canonical_normals=vertex[0],
        skinning_weights=jnp.ones((1, 1)),
        texels=texels,
    )
