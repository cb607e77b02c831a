"""Convolutions of a network in MatConvNet's `.mat` files, such as imagenet-vgg-verydeep-19.mat.

Such a file has a cell array `layers` of structures with a `type`; a convolution ("conv") keeps its numbers under `weights`
(filters and biases) or, in older files, under `filters` and `biases`. Filters are (rows, columns, in, out). The layers
are numbered as in torchvision's `features`. Fully connected layers are convolutions there too, and not used.
"""

import os

import numpy as np

START = b"MATLAB "


def is_matlab_file(path: str | os.PathLike) -> bool:
    """Whether a file begins like MATLAB's."""
    with open(path, "rb") as file:
        return file.read(len(START)) == START


def read_matconvnet(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """{"0.weight": (out, in, rows, columns), "0.bias": (out,), "2.weight": ...}, the layout of torch.

    Raises: OSError; ValueError, naming the file, if it is no such network.
    """
    from scipy.io import loadmat

    with open(path, "rb") as file:
        try:
            return _tensors(loadmat(file, variable_names=["layers"])["layers"])
        except NotImplementedError as error:
            raise ValueError(f"{path}: MATLAB files of version 7.3 are not supported: {error}") from error
        except Exception as error:  # a damaged file, or another one, raises nearly anything
            raise ValueError(f"{path} is no network of MatConvNet: {error!r}") from error


def _tensors(cells: np.ndarray) -> dict[str, np.ndarray]:
    tensors = {}
    for index, layer in enumerate(cell.ravel()[0] for cell in cells.ravel()):
        if layer["type"].item() != "conv":
            continue
        new = "weights" in layer.dtype.names
        kernel, bias = layer["weights"].ravel() if new else (layer["filters"], layer["biases"])
        tensors[f"{index}.weight"], tensors[f"{index}.bias"] = kernel.transpose(3, 2, 0, 1), bias.ravel()
    return tensors
