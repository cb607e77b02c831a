"""Loading a body: the CC0 body of the package, or a file."""

from importlib import resources
from pathlib import Path
from typing import Any

from humangs_jax.body import storage
from humangs_jax.body.model import BodyModel


def load_body(path: str | Path | None = None, **smplx_options: Any) -> BodyModel:
    """A body model.

    Arguments: path: None for the CC0 body shipped with the package (13,380 vertices, 55 joints in SMPL-X order, the
    person faces +z, pelvis at (0, -0.35, 0)); a file of `humangs_jax.body.storage`; or an SMPL-X model file (.npz or
    .pkl).
    smplx_options: for SMPL-X files only, see `humangs_jax.body.smplx.load_smplx`.
    Raises: FileNotFoundError; ValueError, naming file and key, for what cannot be read; TypeError for options of SMPL-X
    files given with another body.
    """
    if path is None:
        if smplx_options:
            raise TypeError(f"options of SMPL-X files do not apply to the shipped body: {sorted(smplx_options)}")
        with resources.as_file(resources.files("humangs_jax") / "assets" / "makehuman.npz") as file:
            return storage.read_body(file)
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such body model file")
    if storage.is_body_file(path):
        if smplx_options:
            raise TypeError(f"{path}: options of SMPL-X files do not apply to this file: {sorted(smplx_options)}")
        return storage.read_body(path)
    from humangs_jax.body.smplx import load_smplx

    return load_smplx(path, **smplx_options)
