"""The network: photos with poses in, canonical 3D Gaussians out, in one forward pass.

    encode   photos -> feature maps and a global token
    read     feature maps -> features of every body vertex
    decode   features -> K Gaussians per vertex of the canonical body

Other networks may run a part again for every target: `drive_outputs`, `draw_pixels`.

Each is a part that the configuration chooses (`network.parts`); the pass itself is written here and nowhere else. Everything is
written for ONE subject; batch with `jax.vmap` over `inputs` (variables unbatched). Callers jit, with `config` static.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from humangs_jax.body.model import BodyPose, Texels
from humangs_jax.core.array_types import Array, Float, Int, Key
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.pytree import replace
from humangs_jax.geometry.camera import Camera
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.encoder import touched_patches
from humangs_jax.network.inputs import HumanGSInputs
from humangs_jax.network.parts import Encoding, HumanGSOutputs, PixelDecoder, Variables
from humangs_jax.network.stages import StageCaller, call

PARTS = ("encoder", "reader", "decoder", "driver")


@checked_arguments
def apply_humangs(
    variables: Variables,
    inputs: HumanGSInputs,
    config: HumanGSConfig,
    train: bool = False,
    axis_name: str | tuple[str, ...] | None = None,
    stage: StageCaller = call,
) -> tuple[HumanGSOutputs, Variables]:
    """The whole network for one subject: outputs and batch statistics.

    train: normalise by this subject's statistics and return updated running ones. Under a vmap over subjects give the
    vmap's `axis_name` to share the statistics over the batch; without it each subject has its own, to be averaged.
    stage: how named stages are called, see `network.stages`.

    Raises: ValueError if images and cameras differ in size, the patch size does not divide it, or inputs lack normals that the
    configuration needs.
    """
    run, parts = config.run(train, axis_name, stage), config.architecture
    of = lambda name: part_variables(variables, name)
    encoding, statistics = stage("encoding", lambda: parts.encoder.apply(of("encoder"), inputs, run))
    features = stage("vertex features", lambda e: parts.reader.apply(of("reader"), e, inputs, run), encoding)
    outputs = parts.decoder.apply(of("decoder"), features, inputs, run)
    if parts.driver is not None and outputs.scene is None:
        outputs = replace(outputs, scene=features)
    kept = variables.get("batch_stats", {})
    return replace(outputs, dropped_tokens=encoding.dropped_tokens), kept | (
        {"encoder": statistics} if statistics else {}
    )


@jax.jit
@checked_arguments
def init_humangs(key: Key, config: HumanGSConfig) -> Variables:
    """Fresh variables {"params": {"encoder", "reader", "decoder", "driver"}, "batch_stats": {"encoder"}}, float32.

    A part without parameters or running statistics is absent.
    """
    run, parts = config.run(), config.architecture
    encoder_key, decoder_key = jax.random.split(key)
    inputs = _example_inputs(config)
    encoder = parts.encoder.init(encoder_key, inputs, run)
    encoding, _ = jax.eval_shape(lambda v: parts.encoder.apply(v, inputs, run), encoder)
    encoding = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), encoding)
    reader = parts.reader.init(jax.random.fold_in(key, 2), encoding, inputs, run)
    features = jax.eval_shape(lambda v: parts.reader.apply(v, encoding, inputs, run), reader)
    features = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), features)
    decoder = parts.decoder.init(decoder_key, features, inputs, run)
    made = {"encoder": encoder, "reader": reader, "decoder": decoder}
    if parts.driver is not None:
        made["driver"] = parts.driver.init(jax.random.fold_in(key, 3), features, inputs, run)
    collect = lambda kind: {name: own[kind] for name, own in made.items() if kind in own}
    return {"params": collect("params"), "batch_stats": collect("batch_stats")}


@functools.partial(jax.jit, static_argnames="config")
def encode(variables: Variables, inputs: HumanGSInputs, config: HumanGSConfig) -> Encoding:
    """The first part of `apply_humangs`, with the running batch statistics. Raises: as it."""
    return config.architecture.encoder.apply(part_variables(variables, "encoder"), inputs, config.run())[0]


@functools.partial(jax.jit, static_argnames="config")
def read(variables: Variables, encoding: Encoding, inputs: HumanGSInputs, config: HumanGSConfig) -> Any:
    """The second part of `apply_humangs`: features of the body. Raises: as it."""
    return config.architecture.reader.apply(part_variables(variables, "reader"), encoding, inputs, config.run())


@functools.partial(jax.jit, static_argnames="config")
def decode(variables: Variables, features: Any, inputs: HumanGSInputs, config: HumanGSConfig) -> HumanGSOutputs:
    """The third part of `apply_humangs`: canonical Gaussians, metric; `dropped_tokens` is 0 (it belongs to the encoding)."""
    return config.architecture.decoder.apply(part_variables(variables, "decoder"), features, inputs, config.run())


def drive_outputs(
    variables: Variables, outputs: HumanGSOutputs, pose: BodyPose, posed: Float[Array, "n 3"], config: HumanGSConfig
) -> HumanGSOutputs:
    """The outputs corrected by the driver for one frame; the outputs themselves where there is none. See `parts.Driver`."""
    driver = config.architecture.driver
    if driver is None:
        return outputs
    return driver.apply(part_variables(variables, "driver"), outputs, pose, posed, config.run())


def draw_pixels(
    variables: Variables, outputs: HumanGSOutputs, queries: Float[Array, "v h w 9"], config: HumanGSConfig
) -> Float[Array, "v h w 3"]:
    """The images of a `parts.PixelDecoder`. Raises: ValueError if the decoder is none."""
    decoder = config.architecture.decoder
    if not isinstance(decoder, PixelDecoder):
        raise ValueError(f"{type(decoder).__name__} makes Gaussians: expected a decoder that draws pixels")
    return decoder.draw(part_variables(variables, "decoder"), outputs.scene, queries, config.run())


def part_variables(variables: Variables, part: str) -> Variables:
    """{"params": ..., "batch_stats": ...} of one part; what it does not have is absent."""
    return {kind: tree[part] for kind, tree in variables.items() if part in tree}


def needed_tokens(inputs: HumanGSInputs, config: HumanGSConfig) -> Int[Array, ""]:
    """The token capacity that these photos need: patches that the foreground touches, over all views."""
    return jnp.sum(touched_patches(inputs, config.architecture.encoder.patch_size), dtype=jnp.int32)


def _example_inputs(config):
    """One view of two by two patches with one vertex: enough to find shapes."""
    side = 2 * config.architecture.encoder.patch_size
    camera = Camera(jnp.eye(3), jnp.eye(4), side, side)
    grid, vertex, wanted = jnp.zeros((1, side, side)), jnp.zeros((1, 1, 3)), config.architecture.surface_map
    return HumanGSInputs(
        images=jnp.zeros((1, side, side, 3)),
        cameras=jax.tree.map(lambda x: x[None], camera),
        posed_vertices=vertex,
        canonical_vertices=vertex[0],
        position_maps=jnp.zeros((1, side, side, 3)),
        depth_maps=grid,
        foreground=grid > 0,
        posed_normals=vertex,
        canonical_normals=vertex[0],
        skinning_weights=jnp.ones((1, 1)),
        texels=None
        if wanted is None
        else Texels(jnp.zeros((*wanted.shape, 3), jnp.int32), jnp.zeros((*wanted.shape, 3))),
    )
