"""Named tensors of a file, whichever of the formats it is in: safetensors, either format of `torch.save`, or MatConvNet's.

The first bytes of a file decide; its name does not matter.
"""

import os
import struct
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.io.matlab import read_matlab
from humangs_jax.io.reading import check_limit, open_file, reading
from humangs_jax.io.torch_file import Tensors, Wanted, everything, read_torch_file

MATLAB_START = b"MATLAB "


def read_tensors(path: str | os.PathLike, wanted: Wanted = everything) -> tuple[Tensors, int]:
    """The tensors whose name is wanted, and how many others the file has. Nothing in the file is run.

    Raises: FileNotFoundError; FileError if it is none of these formats, is damaged, or asks for more than tensors.
    """
    return read_safetensors(path, wanted)[:2] if is_safetensors(path) else read_torch_file(path, wanted)


def is_safetensors(path: str | os.PathLike) -> bool:
    """Whether a file begins as safetensors files do: with the length of a JSON object, and its brace."""
    with reading(path, "file of tensors"), open_file(path) as file:
        start = file.read(9)
    return start[8:] == b"{" and struct.unpack("<Q", start[:8])[0] < 1 << 32


def read_safetensors(path: str | os.PathLike, wanted: Wanted = everything) -> tuple[Tensors, int, dict[str, str]]:
    """The tensors whose name is wanted, how many others the file has, and the strings in its header.

    Raises: FileNotFoundError; FileError.
    """
    from safetensors import safe_open

    with reading(path, "safetensors file"):
        with open_file(path) as start:
            check_limit("slow_text_bytes", int.from_bytes(start.read(8), "little"), "bytes of a header")
        with safe_open(Path(path), framework="numpy") as file:
            keys = list(file.keys())
            tensors = {key: np.asarray(file.get_tensor(key)) for key in keys if wanted(key)}
            return tensors, len(keys) - len(tensors), file.metadata() or {}


def is_matlab_file(path: str | os.PathLike) -> bool:
    """Whether a file begins like MATLAB's."""
    with reading(path, "file of tensors"), open_file(path) as file:
        return file.read(len(MATLAB_START)) == MATLAB_START


def read_matconvnet(path: str | os.PathLike) -> Tensors:
    """Convolutions of a network in MatConvNet's `.mat` files, such as imagenet-vgg-verydeep-19.mat, in the layout of torch.

    {"0.weight": (out, in, rows, columns), "0.bias": (out,), "2.weight": ...}, numbered as in torchvision's `features`. Fully
    connected layers are convolutions there too, and not used.

    Raises: FileNotFoundError; FileError if it is no such network.
    """
    with reading(path, "network of MatConvNet"):
        return _convolutions(read_matlab(path, "layers"))


def _convolutions(layers: Any) -> Tensors:
    """From structures with a `type`. A "conv" has its filters (rows, columns, in, out) and biases under `weights`, or in older
    files under `filters` and `biases`.
    """
    tensors = {}
    for index, (layer, *_) in enumerate(layers.values):
        if layer["type"] != "conv":
            continue
        kernel, bias = layer["weights"].values if "weights" in layer else (layer["filters"], layer["biases"])
        kernel = kernel.reshape(kernel.shape + (1,) * (4 - kernel.ndim))  # MATLAB drops last axes of one
        tensors[f"{index}.weight"], tensors[f"{index}.bias"] = kernel.transpose(3, 2, 0, 1), bias.ravel()
    return tensors
