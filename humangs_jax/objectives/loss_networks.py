"""The frozen networks that losses may use, read from files that the user has: none ships with the package.

Files may hold torchvision's or lpips' state dicts, alone or inside larger ones, in either format of `torch.save` or as
safetensors; VGG-19 may also be MatConvNet's `.mat`. Names that are understood: `layer_names`.
"""

import contextlib
import os
from collections.abc import Generator

import jax.numpy as jnp

from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.io.tensor_file import is_matlab_file, read_matconvnet, read_tensors
from humangs_jax.network.conversion import LOSS_PREFIX
from humangs_jax.objectives.backbones import Convolution, Weights, convolutions
from humangs_jax.objectives.layer_names import (
    LPIPS_NETWORKS,
    NETWORKS,
    Tensors,
    find_heads,
    find_layers,
    is_head,
    is_layer,
)
from humangs_jax.objectives.lpips import Lpips
from humangs_jax.objectives.perceptual import Vgg19

PERCEPTUAL_MODULE = "perceptual_loss_module."
LPIPS_MODULE = "lpips_loss_module."
"""Where the released checkpoint keeps its loss networks, under `LOSS_PREFIX`."""

Path = str | os.PathLike


@pytree_dataclass
class LossNetworks:
    """The networks that are available, None for the others; a pytree, to be passed to a training step."""

    perceptual: Vgg19 | None = None
    lpips: Lpips | None = None


@contextlib.contextmanager
def _named(path: Path) -> Generator[None]:
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _weights(tensors: Tensors, network: str) -> Weights:
    found = find_layers(tensors, network)

    def convolution(name: str) -> Convolution:
        kernel = found[f"{name}.weight"].transpose(2, 3, 1, 0)
        return Convolution(jnp.asarray(kernel, jnp.float32), jnp.asarray(found[f"{name}.bias"], jnp.float32))

    return {layer.name: convolution(layer.name) for layer in convolutions(NETWORKS[network])}


def load_vgg19(path: Path) -> Vgg19:
    """The VGG-19 of the perceptual loss from a file, in float32.

    Raises: OSError; ValueError naming file and tensor if the file cannot be read, or if a tensor is missing, of another
    shape or not finite.
    """
    tensors = read_matconvnet(path) if is_matlab_file(path) else read_tensors(path, is_layer)[0]
    with _named(path):
        return Vgg19(_weights(tensors, "VGG-19"))


def load_lpips(net: str, backbone: Path, heads: Path | None = None) -> Lpips:
    """LPIPS "vgg", "alex" or "squeeze" from its backbone and its heads, in float32.

    heads: file of the heads (the lpips package ships them); default: the same file as the backbone.
    Raises: as `load_vgg19`; ValueError for an unknown net.
    """
    if net not in LPIPS_NETWORKS:
        raise ValueError(f"LPIPS has no net {net!r}, only {', '.join(LPIPS_NETWORKS)}")
    layers = read_tensors(backbone, is_layer)[0]
    with _named(backbone):
        weights = _weights(layers, LPIPS_NETWORKS[net])
    heads = backbone if heads is None else heads
    tensors = read_tensors(heads, is_head)[0]
    with _named(heads):
        found = find_heads(tensors, net)
    return Lpips(weights, tuple(jnp.asarray(head[0, :, 0, 0], jnp.float32) for head in found), net)


def load_loss_networks(
    vgg19: Path | None = None,
    lpips_backbone: Path | None = None,
    lpips_heads: Path | None = None,
    lpips_net: str = "vgg",
) -> LossNetworks:
    """The networks whose files are given.

    Raises: as `load_vgg19` and `load_lpips`; ValueError for heads of LPIPS without a backbone.
    """
    if lpips_heads is not None and lpips_backbone is None:
        raise ValueError(f"{lpips_heads}: heads of LPIPS, but no file for its backbone")
    return LossNetworks(
        None if vgg19 is None else load_vgg19(vgg19),
        None if lpips_backbone is None else load_lpips(lpips_net, lpips_backbone, lpips_heads),
    )


def collect_loss_networks(checkpoint: Path) -> tuple[Tensors, list[str]]:
    """The loss networks in a released checkpoint, under names that the loaders read; and which networks they are.

    Raises: OSError; ValueError naming file and tensor if the checkpoint has none, or a part of one.
    """
    tensors, _ = read_tensors(checkpoint, lambda key: key.startswith(LOSS_PREFIX) and (is_layer(key) or is_head(key)))
    part = lambda module: {key: x for key, x in tensors.items() if key.startswith(LOSS_PREFIX + module)}
    perceptual, lpips, found, names = part(PERCEPTUAL_MODULE), part(LPIPS_MODULE), {}, []
    with _named(checkpoint):
        if not perceptual and not lpips:
            raise ValueError(f"no loss networks ({LOSS_PREFIX}{PERCEPTUAL_MODULE}* or {LOSS_PREFIX}{LPIPS_MODULE}*)")
        if perceptual:
            found |= {f"vgg19.features.{key}": x for key, x in find_layers(perceptual, "VGG-19").items()}
            names.append("VGG-19")
        if lpips:
            net = _which_net(lpips)
            found |= {f"lpips.net.{key}": x for key, x in find_layers(lpips, LPIPS_NETWORKS[net]).items()}
            found |= {f"lpips.lin{i}.model.1.weight": head for i, head in enumerate(find_heads(lpips, net))}
            names.append(f"LPIPS {net}")
    return found, names


def _which_net(tensors: Tensors) -> str:
    """The network that the heads fit."""
    for net in LPIPS_NETWORKS:
        with contextlib.suppress(ValueError):
            find_heads(tensors, net)
            return net
    return "vgg"  # its errors then name what is wrong
