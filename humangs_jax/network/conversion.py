"""Converts the authors' released checkpoint to our variables and back. This concerns names,
layouts, and the configuration that follows from the shapes.

`io.tensors` reads the files, without torch. From the release to this package, layouts change as
follows: linear (out, in) -> (in, out); convolution (out, in, kh, kw) -> (kh, kw, in, out); 1x1
convolution (out, in, 1, 1) -> (in, out); transposed convolution (in, out, kh, kw) -> (kh, kw, in,
out), unflipped (see `upsampler.UpConvolution`).
"""

import dataclasses
import functools
import os
import statistics
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from humangs_jax.io.reading import reading
from humangs_jax.io.tensors import is_safetensors, read_safetensors, read_tensors
from humangs_jax.network.config import Architecture, HumanGSConfig, paper_parts
from humangs_jax.network.encoder import PatchTransformer, TriplaneConfig
from humangs_jax.network.parts import Variables
from humangs_jax.network.presets import published
from humangs_jax.network.reader import PixelAlignedReader
from humangs_jax.network.transformer import TransformerConfig
from humangs_jax.network.upsampler import UpsamplerConfig
from humangs_jax.network.vertex_decoder import VertexDecoder
from humangs_jax.network.weights import (
    FORMAT,
    expected_variables,
    flatten_variables,
    variables_from_tensors,
)

LOSS_PREFIX = "loss_computer."
"""Prefix of the frozen loss networks in the release, which are not part of the network."""
SKINNING_WEIGHTS = "tpose_lbs_weights"
"""Name of the skinning weights (n, j) of the body that the network was trained with. They are kept
in `Converted`; the network does not use them.
"""
UNSUPPORTED = "target_pose_tokenizer.1.weight"
"""Name of a tensor of a network variant that this package does not have (canonical target maps)."""

StateDict = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Converted:
    """The content of a released checkpoint, in the forms of this package."""

    variables: Variables
    """Parameters and running statistics of the network."""
    config: HumanGSConfig
    """The configuration of the network with these variables."""
    skinning_weights: np.ndarray
    """Skinning weights of the body that the checkpoint was made for, (n, j)."""
    skipped: int
    """Number of tensors of the frozen loss networks, which were left out."""


class Layout(NamedTuple):
    """A conversion of a tensor from the release's layout to ours, and its inverse."""

    from_release: Callable[[np.ndarray], np.ndarray]
    """Takes an array in the release's layout, and returns it in our layout."""
    to_release: Callable[[np.ndarray], np.ndarray]
    """Takes an array in our layout, and returns it in the release's layout."""


SAME = Layout(lambda x: x, lambda x: x)
LINEAR = Layout(lambda x: x.T, lambda x: x.T)
CONVOLUTION = Layout(lambda x: x.transpose(2, 3, 1, 0), lambda x: x.transpose(3, 2, 0, 1))
POINTWISE = Layout(lambda x: x[:, :, 0, 0].T, lambda x: x.T[:, :, None, None])
TRANSPOSED_CONVOLUTION = Layout(
    lambda x: x.transpose(2, 3, 0, 1), lambda x: x.transpose(2, 3, 0, 1)
)
CLASS_TOKEN = Layout(lambda x: x[0], lambda x: x[None])

SINGLE_TENSORS = {
    "params/encoder/tokenizer/texture": ("neural_texture", SAME),
    "params/encoder/class_token": ("cls_token", CLASS_TOKEN),
}
MODULES = {  # our module: the release's, and the layout of its weight
    "encoder/tokenizer/linear": ("image_tokenizer.1", LINEAR),
    "encoder/transformer/input_norm": ("transformer_input_layernorm", SAME),
    "encoder/transformer/norm": ("norm", SAME),
    **{f"encoder/upsampler/project_{i}": (f"upsampler.proj.{i}", POINTWISE) for i in range(4)},
    "encoder/upsampler/fuse": ("upsampler.fuse.0", CONVOLUTION),
    "encoder/upsampler/fuse_norm": ("upsampler.fuse.1", SAME),
    "encoder/upsampler/up1": ("upsampler.up1.0", TRANSPOSED_CONVOLUTION),
    "encoder/upsampler/up1_norm": ("upsampler.up1.1", SAME),
    "encoder/upsampler/conv1": ("upsampler.up1.3", CONVOLUTION),
    "encoder/upsampler/conv1_norm": ("upsampler.up1.4", SAME),
    "encoder/upsampler/up2": ("upsampler.up2.0", TRANSPOSED_CONVOLUTION),
    "encoder/upsampler/up2_norm": ("upsampler.up2.1", SAME),
    "reader": ("upsampler.up2.3", CONVOLUTION),
    "decoder/trunk_0": ("vertex_decoder.trunk.0", LINEAR),
    "decoder/trunk_1": ("vertex_decoder.trunk.2", LINEAR),
    "decoder/geometry_hidden": ("vertex_decoder.geo_head.0", LINEAR),
    "decoder/geometry_out": ("vertex_decoder.geo_head.2", LINEAR),
    "decoder/appearance_hidden": ("vertex_decoder.app_head.0", LINEAR),
    "decoder/appearance_out": ("vertex_decoder.app_head.2", LINEAR),
    "decoder/skinning_hidden": ("vertex_decoder.lbs_head.0", LINEAR),
    "decoder/skinning_out": ("vertex_decoder.lbs_head.2", LINEAR),
}
BLOCKS = "encoder/transformer/block_"
BLOCK_MODULES = {
    "norm1": ("norm1", SAME),
    "attention/qkv": ("attn.to_qkv", LINEAR),
    "attention/q_norm": ("attn.q_norm", SAME),
    "attention/k_norm": ("attn.k_norm", SAME),
    "attention/out": ("attn.fc", LINEAR),
    "norm2": ("norm2", SAME),
    "mlp_in": ("mlp.mlp.0", LINEAR),
    "mlp_out": ("mlp.mlp.2", LINEAR),
}
FIELDS = {
    "kernel": "weight",
    "scale": "weight",
    "bias": "bias",
    "mean": "running_mean",
    "var": "running_var",
}


def _release_name(path: str) -> tuple[str, Layout]:
    """Returns the release's name of the variable at a path ("params/encoder/..."), and its layout.

    Raises: KeyError if the release has no such variable.
    """
    if path in SINGLE_TENSORS:
        return SINGLE_TENSORS[path]
    module, _, field = path.partition("/")[2].rpartition("/")
    if module.startswith(BLOCKS):
        index, _, inner = module.removeprefix(BLOCKS).partition("/")
        name, layout = BLOCK_MODULES[inner]
        name = f"transformer_blocks.{index}.{name}"
    else:
        name, layout = MODULES[module]
    if field != "kernel":
        layout = SAME
    return f"{name}.{FIELDS[field]}", layout


def to_release(variables: Variables) -> StateDict:
    """Returns variables as a state dict of the release, without the body's skinning weights. The
    counters of torch's batch norms are 0.

    Raises: KeyError for a part of a network that the release does not have.
    """
    state = {}
    for path, value in flatten_variables(variables).items():
        key, layout = _release_name(path)
        state[key] = layout.to_release(np.asarray(value))
        if key.endswith("running_var"):  # torch keeps a counter in every batch norm
            counter = f"{key.removesuffix('running_var')}num_batches_tracked"
            state[counter] = np.zeros((), np.int64)
    return state


def expected_shapes(config: HumanGSConfig) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of the tensors in the release's state dict for a configuration, by name,
    without the body's skinning weights.
    """
    empty = jax.tree.map(
        lambda leaf: np.broadcast_to(np.float32(0), leaf.shape), expected_variables(config)
    )
    return {key: tensor.shape for key, tensor in to_release(empty).items()}


def read_state_dict(path: str | os.PathLike[str]) -> tuple[StateDict, int]:
    """Returns the tensors of a checkpoint in any format of `io.tensors`, and the number of skipped
    tensors of loss networks.

    Raises: FileNotFoundError; ValueError if the file cannot be read, if it is no checkpoint but a
    weights file of this package, or if its state dict holds anything but tensors.
    """
    if is_safetensors(path) and read_safetensors(path, lambda _: False)[2].get("format") == FORMAT:
        raise ValueError(f"{path} is a weights file already: nothing to convert")
    return read_tensors(path, lambda key: not key.startswith(LOSS_PREFIX))


def infer_config(state: StateDict, head_width: int | None = None) -> HumanGSConfig:
    """Returns the configuration of a network with tensors of these shapes. Settings that shapes do
    not show are taken from `presets.published`. Each vertex is taken to have one tight Gaussian.

    head_width: width of an attention head. It is needed if queries and keys are not normalised,
    because no shape shows it then. Raises: ValueError for a variant that is not supported, if a
    tensor that determines a size is missing, empty or of another number of axes, if no square patch
    fits, if `head_width` is missing or wrong, or if the configuration refuses a size.
    """
    if UNSUPPORTED in state:
        raise ValueError(
            f"tensor {UNSUPPORTED!r}: the variant with canonical target maps is not supported"
        )

    shape = functools.partial(_shape, state)

    def has(prefix):
        return any(key.startswith(prefix) for key in state)

    base = published()
    # sizes of the texture, the tokens and their patches
    resolution, channels = shape("neural_texture", 4)[2:]
    token_width, patch_numbers = shape("image_tokenizer.1.weight", 2)
    width = statistics.mode(
        [token_width, *shape("transformer_input_layernorm.weight", 1), *shape("norm.weight", 1)]
    )
    per_pixel = 9 + 3 * channels  # rgb and ray, then the neural texture
    patch = max(1, round((patch_numbers / per_pixel) ** 0.5))
    if patch * patch * per_pixel != patch_numbers:
        raise ValueError(
            f"tensor 'image_tokenizer.1.weight' has {patch_numbers} inputs: no square patch of"
            f" {per_pixel} channels"
        )
    # optional parts are there if their tensors are
    upsampler, output_width = None, None
    if has("upsampler."):
        upsampler = UpsamplerConfig(hidden=shape("upsampler.proj.0.weight", 4)[0])
        output_width = shape("upsampler.up2.3.weight", 4)[0]
    gaussians = max(1, shape("vertex_decoder.geo_head.2.weight", 2)[0] // 10)
    joints = None
    if has("vertex_decoder.lbs_head."):
        joints = shape("vertex_decoder.lbs_head.2.weight", 2)[0] // gaussians
    # the parts of these sizes; photos of whole patches
    encoder = PatchTransformer(
        patch_size=patch,
        texture=TriplaneConfig(resolution, channels),
        transformer=TransformerConfig(
            width=width,
            layers=_count_layers(state),
            mlp_ratio=max(1, shape("transformer_blocks.0.mlp.mlp.0.weight", 2)[0] // width),
            class_token="cls_token" in state,
            **_infer_heads(state, head_width),
        ),
        upsampler=upsampler,
    )
    decoder = VertexDecoder(
        hidden=shape("vertex_decoder.trunk.0.weight", 2)[0],
        tight=1,
        free=gaussians - 1,
        skinning_joints=joints,
    )
    size = patch * max(1, base.conventions.image_size // patch)
    conventions = dataclasses.replace(base.conventions, image_size=size)
    architecture = Architecture(encoder, PixelAlignedReader(output_width=output_width), decoder)
    return HumanGSConfig(architecture, conventions, base.runtime)


def _shape(state: StateDict, key: str, axes: int) -> tuple[int, ...]:
    """Returns the shape of a tensor. Raises: ValueError if it is missing, empty, or has another
    number of axes.
    """
    if key not in state:
        raise ValueError(f"tensor {key!r} is missing")
    if state[key].ndim != axes or 0 in state[key].shape:
        raise ValueError(f"tensor {key!r} has shape {state[key].shape}, expected {axes} axes")
    return state[key].shape


def _count_layers(state: StateDict) -> int:
    """Returns the number of blocks of the transformer. Raises: ValueError if one is missing."""
    indices = {key.split(".")[1] for key in state if key.startswith("transformer_blocks.")}
    for index in range(len(indices)):
        if str(index) not in indices:
            raise ValueError(f"tensor 'transformer_blocks.{index}.norm1.weight' is missing")
    return len(indices)


def _infer_heads(state: StateDict, head_width: int | None) -> dict[str, Any]:
    """Returns two arguments of `TransformerConfig` by name: the width of a head, and whether
    queries and keys have norms. The width is taken from the shape of the norms, or from
    `head_width` if there are no norms.

    Raises: ValueError if there are no norms and `head_width` is None or below 1, or if the norms
    have another width than `head_width`.
    """
    if not any(key.endswith((".attn.q_norm.weight", ".attn.k_norm.weight")) for key in state):
        if head_width is None:
            raise ValueError(
                "no tensor 'transformer_blocks.0.attn.q_norm.weight' tells the width of a head:"
                " give it"
            )
        if head_width < 1:
            raise ValueError(f"the width of a head must be at least 1, got {head_width}")
        return {"head_width": head_width, "qk_norm": False}
    (found,) = _shape(state, "transformer_blocks.0.attn.q_norm.weight", 1)
    if head_width not in (None, found):
        raise ValueError(
            f"tensor 'transformer_blocks.0.attn.q_norm.weight' says heads of {found}, not"
            f" {head_width}"
        )
    return {"head_width": found, "qk_norm": True}


def _check(state: StateDict, expected: dict[str, tuple[int, ...]]) -> None:
    """Checks that the tensors are exactly the expected ones, and finite.

    Raises: ValueError, which names the tensor as in the release.
    """
    missing = sorted(set(expected) - set(state))
    if missing:
        raise ValueError(f"tensor {missing[0]!r} is missing ({len(missing)} in all)")
    unknown = sorted(set(state) - set(expected))
    if unknown:
        raise ValueError(
            f"tensor {unknown[0]!r} is not part of the published network ({len(unknown)} such"
            " tensors)"
        )
    wrong = [key for key, shape in expected.items() if state[key].shape != shape]
    if wrong:
        found, wanted = state[wrong[0]].shape, expected[wrong[0]]
        raise ValueError(
            f"tensor {wrong[0]!r} has shape {found}; to fit the others it should have {wanted}"
            f" ({len(wrong)} such tensors)"
        )
    bad = [key for key, value in state.items() if not np.isfinite(value.astype(np.float64)).all()]
    if bad:
        raise ValueError(
            f"tensor {bad[0]!r} holds numbers that are not finite ({len(bad)} such tensors)"
        )


def load_checkpoint(path: str | os.PathLike[str], head_width: int | None = None) -> Converted:
    """Returns a released checkpoint as float32 variables, with the configuration that its shapes
    show.

    head_width: see `infer_config`.

    Raises: FileNotFoundError; ValueError, which names the file, and the tensor if the fault is in
    one. ValueError is raised if the file cannot be read or is no released checkpoint, if its state
    dict holds anything but tensors, if `infer_config` refuses it, or if a tensor of the network is
    missing, unknown, of the wrong shape or not finite.
    """
    with reading(path, "checkpoint of the published network"):
        return _load_checkpoint(path, head_width)


def _load_checkpoint(path: str | os.PathLike[str], head_width: int | None) -> Converted:
    state, skipped = read_state_dict(path)
    try:
        config = infer_config(state, head_width)
        vertices, joints = _shape(state, SKINNING_WEIGHTS, 2)
        skinning_shape = (vertices, paper_parts(config.architecture)[2].skinning_joints or joints)
        _check(state, expected_shapes(config) | {SKINNING_WEIGHTS: skinning_shape})
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    tensors = {}
    for ours in flatten_variables(expected_variables(config)):
        key, layout = _release_name(ours)
        tensors[ours] = layout.from_release(state[key])
    return Converted(
        variables_from_tensors(tensors, config, str(path)), config, state[SKINNING_WEIGHTS], skipped
    )


def describe(converted: Converted) -> str:
    """Returns a description of the network in one line."""
    config, leaves = converted.config, flatten_variables(converted.variables["params"]).values()
    encoder, _, decoder = paper_parts(config.architecture)
    transformer = encoder.transformer
    parts = [
        f"{sum(x.size for x in leaves):,} parameters",
        f"width {transformer.width}",
        f"{transformer.layers} layers of {transformer.width // transformer.head_width} heads",
        f"patches of {encoder.patch_size}",
        f"texture {encoder.texture.resolution} x {encoder.texture.channels}",
        f"{decoder.gaussians_per_vertex} Gaussians a vertex",
    ]
    optional = {
        "class token": transformer.class_token,
        "normalised queries and keys": transformer.qk_norm,
        "upsampler": encoder.upsampler is not None,
        "skinning head": decoder.skinning_joints is not None,
    }
    return ", ".join(parts + [name if there else f"no {name}" for name, there in optional.items()])
