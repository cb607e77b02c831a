"""Finds the loss networks among the tensors of a file, by the names that are in use for them.

Layers have torchvision's numbers, with any prefix: `features.0.weight`, `vgg.features.0.weight`,
`net.slice1.0.weight`, `module.0.weight`. Heads of LPIPS are `lin0.model.1.weight`, or `lins.0.` for `lin0.`. Classifiers
are left out.
"""

import collections
import re

import numpy as np

from humangs_jax.objectives.backbones import Slices, channels, convolutions
from humangs_jax.objectives.lpips import BACKBONES
from humangs_jax.objectives.perceptual import VGG19

NETWORKS: dict[str, Slices] = {
    "VGG-19": VGG19,
    "VGG-16": BACKBONES["vgg"],
    "AlexNet": BACKBONES["alex"],
    "SqueezeNet 1.1": BACKBONES["squeeze"],
}
LPIPS_NETWORKS = {"vgg": "VGG-16", "alex": "AlexNet", "squeeze": "SqueezeNet 1.1"}
LAYER = re.compile(
    r"(?P<before>(?:.*?\.)??)(?:slices?\.?\d+\.)?"
    r"(?P<layer>\d+(?:\.(?:squeeze|expand1x1|expand3x3))?\.(?:weight|bias))"
)
HEAD = re.compile(r"(?:.*\.)?lins?\.?(?P<index>\d+)\.(?:model\.)?\d+\.weight")

Tensors = dict[str, np.ndarray]


def is_layer(key: str) -> bool:
    """Whether a tensor's name fits a layer of a backbone."""
    return LAYER.fullmatch(key) is not None and "classifier" not in key


def is_head(key: str) -> bool:
    """Whether a tensor's name fits a head of LPIPS."""
    return HEAD.fullmatch(key) is not None


def expected_tensors(network: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the torch tensors of one of `NETWORKS` that are needed here.

    {"0.weight": (out, in, rows, columns), "0.bias": (out,), ...}
    """
    shapes = {}
    for layer in convolutions(NETWORKS[network]):
        shapes[f"{layer.name}.weight"] = layer.outputs, layer.inputs, layer.size, layer.size
        shapes[f"{layer.name}.bias"] = (layer.outputs,)
    return shapes


def find_layers(tensors: Tensors, network: str) -> Tensors:
    """One of `NETWORKS` among other tensors, by the names of `expected_tensors`.

    Raises: ValueError naming the tensor if one is missing, of another shape or not finite, or if there are two such
    networks that differ.
    """
    expected = expected_tensors(network)
    groups = collections.defaultdict(dict)  # by prefix
    for key in filter(is_layer, tensors):
        if match := LAYER.fullmatch(key):
            groups[match["before"]][match["layer"]] = key
    if not groups:
        raise ValueError(f"no tensor has a name like 'features.0.weight': no {network} in it")
    before, found = max(groups.items(), key=lambda group: len(expected.keys() & group[1].keys()))
    if missing := [name for name in expected if name not in found]:
        like = [other for other in NETWORKS if expected_tensors(other).keys() <= found.keys()]
        hint = f"; it looks like {like[0]}" if like else ""
        raise ValueError(
            f"tensor '{before}{missing[0]}' of {network} is missing ({len(missing)} of {len(expected)}){hint}"
        )
    for other, names in groups.items():
        if names is found or not expected.keys() <= names.keys():
            continue
        if not all(np.array_equal(tensors[names[name]], tensors[found[name]]) for name in expected):
            raise ValueError(f"two networks that may be {network} in it, under {before!r} and {other!r}")
    return {name: _check(tensors, found[name], shape, network) for name, shape in expected.items()}


def find_heads(tensors: Tensors, net: str) -> list[np.ndarray]:
    """The heads of LPIPS "vgg", "alex" or "squeeze", (1, c, 1, 1) each. Raises: ValueError, naming the tensor."""
    found = {int(match["index"]): key for key in tensors if (match := HEAD.fullmatch(key))}
    expected = channels(BACKBONES[net])
    if not found:
        raise ValueError("no tensor has a name like 'lin0.model.1.weight': no heads of LPIPS in it")
    if sorted(found) != list(range(len(expected))):
        raise ValueError(f"it has the heads {sorted(found)} of LPIPS; {net} has {len(expected)}, from 0")
    return [_check(tensors, found[i], (1, count, 1, 1), f"LPIPS {net}") for i, count in enumerate(expected)]


def _check(tensors: Tensors, key: str, shape: tuple[int, ...], network: str) -> np.ndarray:
    if (tensor := tensors[key]).shape != shape:
        raise ValueError(f"tensor {key!r} has shape {tensor.shape}, {network} has {shape}")
    if not np.isfinite(tensor.astype(np.float32)).all():
        raise ValueError(f"tensor {key!r} holds numbers that are not finite")
    return tensor
