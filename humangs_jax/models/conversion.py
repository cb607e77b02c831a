"""The authors' released checkpoint (torch, zip-format `.pt`) to our variables, without torch.

A checkpoint is a pickle that describes tensors, and one zip member per storage. The pickle is read by an unpickler that
knows the calls which rebuild the tensors of a state dict and refuses everything else by name, so no code of a file ever
runs; only the storages of `model` are read, not those of the optimizer.

Layouts: linear (out, in) -> (in, out); convolution (out, in, kh, kw) -> (kh, kw, in, out); transposed convolution
(in, out, kh, kw) -> (kh, kw, in, out), unflipped (see `upsampler.UpConvolution`).
"""

import collections
import dataclasses
import math
import os
import pickle
import zipfile

import numpy as np

from humangs_jax.models.attention import AttentionConfig
from humangs_jax.models.humangs import HumanGSConfig, Variables
from humangs_jax.models.presets import published
from humangs_jax.models.transformer import TransformerConfig
from humangs_jax.models.upsampler import UpsamplerConfig
from humangs_jax.models.vertex_decoder import VertexDecoderConfig
from humangs_jax.models.weights import variables_from_tensors
from humangs_jax.sampling.triplane import TriplaneConfig

STORAGE_DTYPES = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "BFloat16Storage": np.dtype("<u2"),  # widened after reading
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("i1"),
    "ByteStorage": np.dtype("u1"),
    "BoolStorage": np.dtype("?"),
}
LOSS_PREFIX = "loss_computer."
"""The release saves its frozen loss networks along; they are no part of the network."""
UNSUPPORTED = "target_pose_tokenizer.1.weight"
"""Marks a variant of the network (canonical target maps) that does not exist here."""


@dataclasses.dataclass(frozen=True)
class LazyTensor:
    """A tensor of a checkpoint that is not read yet: which storage, and the view of it (in elements)."""

    storage: str
    kind: str
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class _StorageType:
    """Stands for a `torch.*Storage` class."""

    name: str


@dataclasses.dataclass(frozen=True)
class Converted:
    """Variables and their configuration; skinning_weights: (n, j) of the body that the checkpoint carries, or None.

    skipped: how many tensors of the frozen loss networks were left out.
    """

    variables: Variables
    config: HumanGSConfig
    skinning_weights: np.ndarray | None
    skipped: int


def _rebuild_tensor(storage, offset, shape, strides, *_):
    kind, key = storage
    return LazyTensor(key, kind, offset, tuple(shape), tuple(strides))


def _rebuild_parameter(tensor, *_):
    return tensor


class _StateDictUnpickler(pickle.Unpickler):
    """Knows tensors, ordered dicts and storages."""

    ALLOWED = {  # noqa: RUF012 (a constant)
        ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
        ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
        ("collections", "OrderedDict"): collections.OrderedDict,
    }

    def find_class(self, module, name):
        if (module, name) in self.ALLOWED:
            return self.ALLOWED[module, name]
        if module == "torch" and name in STORAGE_DTYPES:
            return _StorageType(name)
        raise pickle.UnpicklingError(f"refused to load {module}.{name}: no part of a state dict")

    def persistent_load(self, pid):
        if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _StorageType)):
            raise pickle.UnpicklingError(f"refused to load the persistent object {pid!r}: no storage")
        return pid[1].name, str(pid[2])


def read_state_dict(path: str | os.PathLike, skip_prefix: str = LOSS_PREFIX) -> tuple[dict[str, np.ndarray], int]:
    """Tensors under the key `model` of a checkpoint, without those whose name begins with `skip_prefix`; how many those
    are.

    Raises: ValueError if the file is no zip-format checkpoint, its pickle asks for anything but tensors, or a storage
    is missing or too short, naming it.
    """
    try:
        archive = zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{path} is no zip-format checkpoint (torch.save since 1.6 writes those)") from error
    with archive:
        pickles = [name for name in archive.namelist() if name.count("/") == 1 and name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise ValueError(f"{path}: expected one <name>/data.pkl inside, found {pickles}")
        root = pickles[0].removesuffix("data.pkl")
        if f"{root}byteorder" in archive.namelist() and archive.read(f"{root}byteorder").strip() != b"little":
            raise ValueError(f"{path}: only little-endian checkpoints are supported")
        try:
            with archive.open(pickles[0]) as file:
                content = _StateDictUnpickler(file).load()
        except Exception as error:  # a broken pickle raises nearly anything
            raise ValueError(f"{path}: {error}") from error
        if not isinstance(content, dict) or not isinstance(content.get("model"), dict):
            raise ValueError(f"{path}: expected a dict with a state dict under 'model'")
        model = content["model"]
        wanted = {key: value for key, value in model.items() if not str(key).startswith(skip_prefix)}
        for key, value in wanted.items():
            if not isinstance(value, LazyTensor):
                raise ValueError(f"{path}: model[{key!r}] is no tensor but {type(value).__name__}")
        return {key: _read(archive, root, key, value) for key, value in wanted.items()}, len(model) - len(wanted)


def _read(archive: zipfile.ZipFile, root: str, key: str, tensor: LazyTensor) -> np.ndarray:
    """The numbers of one tensor, bounds checked."""
    dtype = STORAGE_DTYPES[tensor.kind]
    try:
        data = np.frombuffer(archive.read(f"{root}data/{tensor.storage}"), dtype)
    except (KeyError, zipfile.BadZipFile, ValueError) as error:
        raise ValueError(f"{key}: storage {tensor.storage} is missing or damaged: {error}") from error
    sizes = (tensor.offset, *tensor.shape, *tensor.strides)
    last = tensor.offset + sum((n - 1) * stride for n, stride in zip(tensor.shape, tensor.strides, strict=True))
    count = math.prod(tensor.shape)  # views of parameters never repeat numbers: a larger one is a bomb
    if any(not isinstance(x, int) or x < 0 for x in sizes) or count > len(data) or (count and last >= len(data)):
        raise ValueError(f"{key}: shape {tensor.shape} does not fit storage {tensor.storage} of {len(data)} numbers")
    view = np.lib.stride_tricks.as_strided(
        data[tensor.offset :],
        tensor.shape,
        tuple(stride * dtype.itemsize for stride in tensor.strides),
        writeable=False,
    )
    array = np.ascontiguousarray(view).reshape(tensor.shape)
    return (array.astype(np.uint32) << 16).view(np.float32) if tensor.kind == "BFloat16Storage" else array


def infer_config(state: dict[str, np.ndarray]) -> HumanGSConfig:
    """The configuration whose sizes are those of the tensors; what shapes do not tell is taken from
    `presets.published`.

    Raises: ValueError for a variant that is not supported, or if a tensor that tells a size is missing.
    """
    if UNSUPPORTED in state:
        raise ValueError(f"the checkpoint has {UNSUPPORTED!r}: the variant with canonical target maps is not supported")

    def shape(key):
        if key not in state:
            raise ValueError(f"the checkpoint has no tensor {key!r}")
        return state[key].shape

    base = published()
    _, resolution, _, channels = shape("neural_texture")
    width, patch_numbers = shape("image_tokenizer.1.weight")
    pixels = patch_numbers / (9 + 3 * channels)
    patch = round(pixels**0.5)
    if patch * patch != pixels:
        channels_in = 9 + 3 * channels
        raise ValueError(
            f"image_tokenizer.1.weight: {patch_numbers} inputs are no square patch of {channels_in} channels"
        )
    layers = len({key.split(".")[1] for key in state if key.startswith("transformer_blocks.")})
    attention = "transformer_blocks.0.attn"
    qk_norm = f"{attention}.q_norm.weight" in state
    head_width = shape(f"{attention}.q_norm.weight")[0] if qk_norm else base.transformer.attention.head_width
    upsampler = dataclasses.replace(base.upsampler, enabled=False)
    if "upsampler.fuse.0.weight" in state:
        upsampler = UpsamplerConfig(hidden=shape("upsampler.proj.0.weight")[0], out=shape("upsampler.up2.3.weight")[0])
    gaussians = shape("vertex_decoder.geo_head.2.weight")[0] // 10
    joints = None
    if "vertex_decoder.lbs_head.2.weight" in state:
        joints = shape("vertex_decoder.lbs_head.2.weight")[0] // gaussians
    return dataclasses.replace(
        base,
        patch_size=patch,
        texture=TriplaneConfig(resolution, channels),
        transformer=TransformerConfig(
            width=width,
            layers=layers,
            mlp_ratio=shape("transformer_blocks.0.mlp.mlp.0.weight")[0] // width,
            class_token="cls_token" in state,
            attention=AttentionConfig(head_width=head_width, qk_norm=qk_norm),
        ),
        upsampler=upsampler,
        decoder=VertexDecoderConfig(
            hidden=shape("vertex_decoder.trunk.0.weight")[0], tight=1, free=gaussians - 1, skinning_joints=joints
        ),
    )


Layout = tuple[int, ...] | None
LINEAR: Layout = (1, 0)
CONVOLUTION: Layout = (2, 3, 1, 0)
TRANSPOSED_CONVOLUTION: Layout = (2, 3, 0, 1)
NORM: Layout = None
"""What becomes of a module's weight: a kernel with its axes in this order, or the scale of a norm as it is."""

MODULES: dict[str, tuple[str, Layout]] = {
    "image_tokenizer.1": ("encoder/tokenizer/linear", LINEAR),
    "transformer_input_layernorm": ("encoder/transformer/input_norm", NORM),
    "norm": ("encoder/transformer/norm", NORM),
    "upsampler.fuse.0": ("encoder/upsampler/fuse", CONVOLUTION),
    "upsampler.fuse.1": ("encoder/upsampler/fuse_norm", NORM),
    "upsampler.up1.0": ("encoder/upsampler/up1", TRANSPOSED_CONVOLUTION),
    "upsampler.up1.1": ("encoder/upsampler/up1_norm", NORM),
    "upsampler.up1.3": ("encoder/upsampler/conv1", CONVOLUTION),
    "upsampler.up1.4": ("encoder/upsampler/conv1_norm", NORM),
    "upsampler.up2.0": ("encoder/upsampler/up2", TRANSPOSED_CONVOLUTION),
    "upsampler.up2.1": ("encoder/upsampler/up2_norm", NORM),
    "upsampler.up2.3": ("encoder/upsampler/conv2", CONVOLUTION),
    "vertex_decoder.trunk.0": ("decoder/trunk_0", LINEAR),
    "vertex_decoder.trunk.2": ("decoder/trunk_1", LINEAR),
    "vertex_decoder.geo_head.0": ("decoder/geometry_hidden", LINEAR),
    "vertex_decoder.geo_head.2": ("decoder/geometry_out", LINEAR),
    "vertex_decoder.app_head.0": ("decoder/appearance_hidden", LINEAR),
    "vertex_decoder.app_head.2": ("decoder/appearance_out", LINEAR),
    "vertex_decoder.lbs_head.0": ("decoder/skinning_hidden", LINEAR),
    "vertex_decoder.lbs_head.2": ("decoder/skinning_out", LINEAR),
    **{f"upsampler.proj.{i}": (f"encoder/upsampler/project_{i}", CONVOLUTION) for i in range(4)},
}
BLOCK_MODULES: dict[str, tuple[str, Layout]] = {
    "norm1": ("norm1", NORM),
    "attn.to_qkv": ("attention/qkv", LINEAR),
    "attn.q_norm": ("attention/q_norm", NORM),
    "attn.k_norm": ("attention/k_norm", NORM),
    "attn.fc": ("attention/out", LINEAR),
    "norm2": ("norm2", NORM),
    "mlp.mlp.0": ("mlp_in", LINEAR),
    "mlp.mlp.2": ("mlp_out", LINEAR),
}


def _module(name: str) -> tuple[str, Layout]:
    """Our path and the layout of a module of the release. Raises KeyError if it has none of that name."""
    if name.startswith("transformer_blocks."):
        _, index, inner = name.split(".", 2)
        path, layout = BLOCK_MODULES[inner]
        return f"encoder/transformer/block_{int(index)}/{path}", layout
    return MODULES[name]


def map_tensor(key: str, value: np.ndarray) -> tuple[str, np.ndarray] | None:
    """Our path and layout of one tensor of the network; None for counters that mean nothing here.

    Raises: ValueError for a name that the release does not have, or a tensor with another number of axes.
    """
    if key == "neural_texture":
        return "params/encoder/tokenizer/texture", value
    if key == "cls_token":
        return "params/encoder/class_token", value.reshape(-1, value.shape[-1])
    name, _, field = key.rpartition(".")
    try:
        path, layout = _module(name)
    except (KeyError, ValueError):
        raise ValueError(f"the checkpoint has a tensor {key!r} that is no part of the published network") from None
    if field == "num_batches_tracked":
        return None
    if field in ("running_mean", "running_var"):
        return f"batch_stats/{path}/{field.removeprefix('running_')}", value
    if field == "bias":
        return f"params/{path}/bias", value
    if layout is None:
        return f"params/{path}/scale", value
    if value.ndim != len(layout):
        raise ValueError(f"{key}: expected {len(layout)} axes, got shape {value.shape}")
    value = value.transpose(layout)
    if ".proj." in key:  # a 1x1 convolution is a linear map
        value = value.reshape(value.shape[-2:])
    return f"params/{path}/kernel", value


def load_checkpoint(path: str | os.PathLike) -> Converted:
    """A released checkpoint as variables, with the configuration that its shapes tell.

    Raises: ValueError naming file and tensor: see `read_state_dict`, `infer_config`, `map_tensor`; and if a tensor of
    the network is missing, unknown or of the wrong shape.
    """
    state, skipped = read_state_dict(path)
    skinning_weights = state.pop("tpose_lbs_weights", None)
    config = infer_config(state)
    tensors = dict(filter(None, (map_tensor(key, value) for key, value in state.items())))
    return Converted(variables_from_tensors(tensors, config, str(path)), config, skinning_weights, skipped)
