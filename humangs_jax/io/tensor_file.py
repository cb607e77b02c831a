"""Named tensors of a file, whichever of the formats it is in: safetensors, or either format of `torch.save`.

The first bytes of a file decide; its name does not matter.
"""

import os
import struct
from pathlib import Path

import numpy as np

from humangs_jax.io.reading import check_limit, open_file, reading
from humangs_jax.io.torch_file import Tensors, Wanted, everything, read_torch_file


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
