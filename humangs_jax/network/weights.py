"""Weights on disk: one safetensors file, tensors under their path in the variables, the configuration in its header.

Keys are "params/encoder/..." and "batch_stats/encoder/..."; the header's metadata holds {"format": "humangs-weights",
"version": "1", "config": JSON of the configuration}. float16 halves the file (and rounds to 11 bits); loading gives
float32.
"""

import os
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.configuration import config_from_json, config_to_json
from humangs_jax.network.humangs import HumanGSConfig, Variables, init_humangs

FORMAT = "humangs-weights"
VERSION = "1"
SHIPPED = "assets/weights.safetensors"
HEADS = "params/decoder/"


def expected_variables(config: HumanGSConfig) -> Variables:
    """Shapes and dtypes of the variables of a configuration, without computing anything."""
    return jax.eval_shape(lambda key: init_humangs(key, config), jax.random.key(0))


def flatten_variables(variables: Variables) -> dict[str, Any]:
    """{"params/encoder/...": leaf}."""
    leaves = jax.tree_util.tree_leaves_with_path(variables)
    return {"/".join(str(entry.key) for entry in path): leaf for path, leaf in leaves}


def save_weights(
    path: str | os.PathLike,
    variables: Variables,
    config: HumanGSConfig,
    dtype: Literal["float32", "float16"] = "float32",
) -> None:
    """Write the variables; the file appears whole or not at all.

    Raises: ValueError if a tensor does not fit the configuration, is not finite, or overflows float16, naming its key.
    """
    from safetensors.numpy import save

    tensors = _check(flatten_variables(variables), expected_variables(config), str(path))
    if dtype == "float16":
        for key, tensor in tensors.items():
            if np.abs(tensor).max(initial=0) > np.finfo(np.float16).max:
                raise ValueError(f"{key}: overflows float16; store it as float32")
    metadata = {"format": FORMAT, "version": VERSION, "config": config_to_json(config)}
    data = save({key: np.ascontiguousarray(x, np.dtype(dtype)) for key, x in tensors.items()}, metadata)
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def load_weights(path: str | os.PathLike | None = None) -> tuple[Variables, HumanGSConfig]:
    """Variables (float32) and configuration of a file; None loads the weights that come with the package.

    Raises: FileNotFoundError; ValueError if the file is no weights file of ours, or a tensor is missing, unknown, of
    the wrong shape or not finite, naming file and key.
    """
    if path is None:
        with resources.as_file(resources.files("humangs_jax").joinpath(SHIPPED)) as shipped:
            if not shipped.exists():
                raise FileNotFoundError("this installation ships no weights: give the path of a weights file")
            return load_weights(shipped)
    from safetensors import SafetensorError, safe_open

    if not Path(path).is_file():
        raise FileNotFoundError(f"no weights file {path}")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, TypeError) as error:
        raise ValueError(f"{path} is no readable safetensors file: {error}") from error
    if metadata.get("format") != FORMAT or metadata.get("version") != VERSION:
        found = f"format {metadata.get('format')!r}, version {metadata.get('version')!r}"
        raise ValueError(f"{path}: expected header format {FORMAT!r}, version {VERSION!r}; found {found}")
    try:
        config = config_from_json(HumanGSConfig, metadata.get("config", ""))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return variables_from_tensors(tensors, config, str(path)), config


def fit_variables(variables: Variables, old: HumanGSConfig, new: HumanGSConfig) -> Variables:
    """Variables of the network `old` for the network `new`, to train on.

    `new` may have shells where `old` has none, another number of free Gaussians and other settings without tensors. What is
    new starts as initialised, but unheard where it enters a layer (0). With another `decoder.frame` offsets and rotations
    start anew: theirs are of other axes. Raises: ValueError naming the setting or the tensor if more differs.
    """
    for part, name in (("sampling", "sample_rgb"), ("decoder", "tight")):  # either shifts what tensors hold
        was, wanted = (getattr(getattr(config, part), name) for config in (old, new))
        if was != wanted:
            raise ValueError(f"{part}.{name} {was}: that of trained weights cannot become {wanted}")
    if old.sampling.shells not in ((), new.sampling.shells):
        raise ValueError(f"shells {old.sampling.shells}: those of trained weights cannot become {new.sampling.shells}")
    ours = flatten_variables(variables)
    fresh = flatten_variables(init_humangs(jax.random.key(0), new))
    anew = {f"{HEADS}shells_{name}/{kind}" for name in ("hidden", "out") for kind in ("kernel", "bias")} - set(ours)
    if unknown := sorted((set(ours) - set(fresh)) | (set(fresh) - set(ours) - anew)):
        raise ValueError(f"tensor {unknown[0]!r} is in one of the two networks alone")
    if old.decoder.frame != new.decoder.frame:
        anew |= {key for key in ours if key.startswith(f"{HEADS}geometry_out")}

    def fit(key, leaf):
        if key in anew:
            return leaf
        if key == f"{HEADS}trunk_0/kernel" and old.decoder_width <= new.decoder_width:
            rows = len(ours[key])  # shells and normals enter last
            leaf = leaf.at[rows:].set(0).at[:rows].set(ours[key])
        elif key.startswith(HEADS) and key.split("/")[-2].endswith("_out"):
            both = min(leaf.shape[-1], ours[key].shape[-1])  # Gaussians come one after the other
            leaf = leaf.at[..., :both].set(ours[key][..., :both])
        elif leaf.shape != ours[key].shape:
            raise ValueError(f"tensor {key!r} has shape {ours[key].shape}, the other network wants {leaf.shape}")
        else:
            leaf = ours[key]
        return leaf

    structure = jax.tree.structure(expected_variables(new))
    return jax.tree.unflatten(structure, [fit(key, leaf) for key, leaf in fresh.items()])


def variables_from_tensors(tensors: dict[str, np.ndarray], config: HumanGSConfig, where: str) -> Variables:
    """Float32 variables from flat tensors keyed by path; ValueError naming the key unless they are exactly those."""
    expected = expected_variables(config)
    arrays = _check(tensors, expected, where)
    return jax.tree.unflatten(jax.tree.structure(expected), [jnp.asarray(x, jnp.float32) for x in arrays.values()])


def _check(tensors: dict[str, Any], variables: Variables, where: str) -> dict[str, np.ndarray]:
    """The tensors as numpy arrays, in the order of the variables' leaves, if they are exactly those."""
    expected = flatten_variables(variables)
    if missing := sorted(set(expected) - set(tensors)):
        raise ValueError(f"{where}: tensor {missing[0]!r} is missing ({len(missing)} in all)")
    if unknown := sorted(set(tensors) - set(expected)):
        raise ValueError(f"{where}: tensor {unknown[0]!r} is unknown to this configuration ({len(unknown)} in all)")
    arrays = {}
    for key, leaf in expected.items():
        array = np.asarray(tensors[key])
        if array.shape != leaf.shape:
            raise ValueError(f"{where}: tensor {key!r} has shape {array.shape}, the configuration wants {leaf.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{where}: tensor {key!r} holds numbers that are not finite")
        arrays[key] = array
    return arrays
