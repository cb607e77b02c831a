"""Named tensors of a file, whichever of the formats it is in: safetensors, or either format of `torch.save`.

What a file is, its first bytes say; its name does not matter.
"""

import os
import struct
from pathlib import Path

import numpy as np

from humangs_jax.io.torch_file import Tensors, Wanted, everything, read_torch_file


def read_tensors(path: str | os.PathLike, wanted: Wanted = everything) -> tuple[Tensors, int]:
    """The tensors whose name is wanted, and how many others the file has. Nothing in the file is run.

    Raises: OSError; ValueError, naming the file, if it is none of these formats, is damaged, or asks for more than
    tensors.
    """
    return _read_safetensors(path, wanted) if is_safetensors(path) else read_torch_file(path, wanted)


def is_safetensors(path: str | os.PathLike) -> bool:
    """Whether a file begins as safetensors files do: with the length of a JSON object, and its brace."""
    with open(path, "rb") as file:
        start = file.read(9)
    return start[8:] == b"{" and struct.unpack("<Q", start[:8])[0] < 1 << 32


def safetensors_metadata(path: str | os.PathLike) -> dict[str, str]:
    """The strings in the header of a safetensors file. Raises: ValueError."""
    return _open(path, lambda file: file.metadata() or {})


def _read_safetensors(path, wanted: Wanted) -> tuple[Tensors, int]:
    def read(file):
        keys = list(file.keys())
        tensors = {key: np.asarray(file.get_tensor(key)) for key in keys if wanted(key)}
        return tensors, len(keys) - len(tensors)

    return _open(path, read)


def _open(path, use):
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(Path(path), framework="numpy") as file:
            return use(file)
    except (SafetensorError, TypeError) as error:
        raise ValueError(f"{path} is no readable safetensors file: {error}") from error
