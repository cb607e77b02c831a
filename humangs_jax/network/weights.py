"""Writes and reads weights files. A weights file is a safetensors file. The name of a tensor is its
path in the variables, and the header describes the network.

Names are "params/encoder/..." and "batch_stats/encoder/..."; the header's metadata holds {"format":
"humangs-weights", "version": "2", "architecture": JSON, "conventions": JSON, "checksum": SHA-256}.
The oldest files have no checksum. float16 halves the size of the file, and rounds to 11 bits.
Loading gives float32.
"""

import os
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from humangs_jax.core.array_types import PyTree
from humangs_jax.core.arrays import from_host
from humangs_jax.core.checks import checked_arguments
from humangs_jax.core.configuration import config_from_json, config_to_json
from humangs_jax.io.arrays import check_checksum, checksum, file_checksum
from humangs_jax.io.atomic import write_bytes
from humangs_jax.io.reading import reading
from humangs_jax.io.tensors import read_safetensors
from humangs_jax.network.config import Architecture, Conventions, HumanGSConfig
from humangs_jax.network.humangs import init_humangs
from humangs_jax.network.parts import Variables

FORMAT = "humangs-weights"
VERSION = "2"
SHIPPED = "assets/weights.safetensors"


def expected_variables(config: HumanGSConfig) -> Variables:
    """Returns the shapes and dtypes of a configuration's variables, without computing anything."""
    return init_humangs.eval_shape(jax.random.key(0), config)


def flatten_variables(variables: PyTree) -> dict[str, Any]:
    """Returns the variables by path, {"params/encoder/...": leaf}."""
    leaves = jax.tree_util.tree_leaves_with_path(variables)
    return {"/".join(str(entry.key) for entry in path): leaf for path, leaf in leaves}


@checked_arguments
def save_weights(
    path: str | os.PathLike[str],
    variables: Variables,
    config: HumanGSConfig,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Writes variables and configuration to a weights file. If writing fails, the path stays as it
    was.

    Args:
        path: the .safetensors file to write or replace.
        variables: variables of the network.
        config: configuration of the network. Its `Runtime` is not written.
        dtype: type of the stored numbers. float16 halves the file.

    Raises:
        ValueError: which names the tensor, if a tensor is missing or unknown, does not fit the
            configuration, is not finite, or overflows float16.
        OSError: if the file cannot be written.

    Examples:
        >>> hg.save_weights("mine.safetensors", variables, config, "float16")
    """
    from safetensors.numpy import save

    tensors = _check(flatten_variables(variables), expected_variables(config), str(path))
    if dtype == "float16":
        for key, tensor in tensors.items():
            if np.abs(tensor).max(initial=0) > np.finfo(np.float16).max:
                raise ValueError(f"{key}: overflows float16; store it as float32")
    recorded = {
        name: config_to_json(getattr(config, name)) for name in ("architecture", "conventions")
    }
    stored = {key: np.ascontiguousarray(x, np.dtype(dtype)) for key, x in tensors.items()}
    metadata = {"format": FORMAT, "version": VERSION, **recorded}
    write_bytes(path, save(stored, metadata | {"checksum": checksum(stored, *recorded.values())}))


def shipped_checksum() -> str:
    """Returns the SHA-256 of the shipped weights file, in hexadecimal, or "none" if the file is not
    installed.
    """
    with resources.as_file(resources.files("humangs_jax").joinpath(SHIPPED)) as shipped:
        if shipped.exists():
            return file_checksum(shipped)
        return "none"


@checked_arguments
def load_weights(path: str | os.PathLike[str] | None = None) -> tuple[Variables, HumanGSConfig]:
    """Returns the variables, float32, and the configuration of a weights file, with the default
    `Runtime`.

    Args:
        path: a .safetensors file of this package. None: the shipped weights.

    Returns:
        The variables, as `reconstruct` takes them, and the network's configuration.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: which names the file, if it is no weights file of this package, or if its
            contents do not fit its checksum. Also if a tensor is missing, unknown, of the wrong
            shape or not finite; this error names the tensor, too.

    Examples:
        >>> variables, config = hg.load_weights()
    """
    if path is None:
        with resources.as_file(resources.files("humangs_jax").joinpath(SHIPPED)) as shipped:
            if not shipped.exists():
                raise FileNotFoundError(
                    "this installation ships no weights: give the path of a weights file"
                )
            return load_weights(shipped)
    if not Path(path).is_file():
        raise FileNotFoundError(f"no weights file {path}")
    with reading(path, "weights file"):
        return _load_weights(path)


def _load_weights(path: str | os.PathLike[str]) -> tuple[Variables, HumanGSConfig]:
    tensors, _, metadata = read_safetensors(path)
    if metadata.get("format") != FORMAT or metadata.get("version") != VERSION:
        found = f"format {metadata.get('format')!r}, version {metadata.get('version')!r}"
        raise ValueError(
            f"{path}: expected header format {FORMAT!r}, version {VERSION!r}; found {found}"
        )
    try:
        config = HumanGSConfig(
            config_from_json(Architecture, metadata.get("architecture", "")),
            config_from_json(Conventions, metadata.get("conventions", "")),
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    variables = variables_from_tensors(tensors, config, str(path))
    recorded = (metadata.get(name, "") for name in ("architecture", "conventions"))
    check_checksum(metadata.get("checksum"), checksum(tensors, *recorded))
    return variables, config


def variables_from_tensors(
    tensors: dict[str, np.ndarray], config: HumanGSConfig, where: str
) -> Variables:
    """Returns float32 variables made from tensors by path. where: name of the file, for errors.

    Raises: ValueError, which names the tensor, unless the tensors have exactly the names and shapes
    that the configuration needs, and are finite.
    """
    expected = expected_variables(config)
    arrays = _check(tensors, expected, where)
    return jax.tree.unflatten(
        jax.tree.structure(expected), [from_host(x, np.float32) for x in arrays.values()]
    )


def _check(tensors: dict[str, Any], variables: Variables, where: str) -> dict[str, np.ndarray]:
    """Returns the tensors as numpy arrays, in the order of the leaves of `variables`. They are
    checked first: names and shapes must be exactly as in `variables`, and all numbers finite.

    Raises: ValueError, which names the tensor.
    """
    expected = flatten_variables(variables)
    missing = sorted(set(expected) - set(tensors))
    if missing:
        raise ValueError(f"{where}: tensor {missing[0]!r} is missing ({len(missing)} in all)")
    unknown = sorted(set(tensors) - set(expected))
    if unknown:
        raise ValueError(
            f"{where}: tensor {unknown[0]!r} is unknown to this configuration ({len(unknown)} in"
            " all)"
        )
    arrays = {}
    for key, leaf in expected.items():
        array = np.asarray(tensors[key])
        if array.shape != leaf.shape:
            raise ValueError(
                f"{where}: tensor {key!r} has shape {array.shape}, the configuration wants"
                f" {leaf.shape}"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{where}: tensor {key!r} holds numbers that are not finite")
        arrays[key] = array
    return arrays
