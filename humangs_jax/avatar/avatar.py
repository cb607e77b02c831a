"""The avatar: canonical Gaussians, their skinning weights and the body that they hang on, as one pytree and one file."""

import json
import os
from pathlib import Path
from typing import Literal

import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass, static_field
from humangs_jax.io.npz import write_npz
from humangs_jax.rendering.gaussians import Gaussians

FORMAT = "humangs-avatar"
VERSION = 1
_ARRAYS = (
    "means",
    "quats",
    "scales",
    "opacities",
    "colors",
    "skinning_weights",
    "rest_vertices",
    "rest_joints",
    "faces",
)


@pytree_dataclass
class Avatar:
    """A person who can be animated: Gaussians in the T-pose (theta = 0), vertex-major, the k Gaussians of a vertex together.

    gaussians: canonical, metres. skinning_weights: (g, j), rows sum to 1. rest_vertices: (n, 3) and rest_joints: (j, 3), the
    shaped body in the T-pose. faces: (f, 3). parents: joint tree, root -1. skinning: "affine" or "rotation". rendering: the
    splatting that the Gaussians were trained for, a name in `SPLAT_PRESETS`.
    """

    gaussians: Gaussians
    skinning_weights: Float[Array, "g j"]
    rest_vertices: Float[Array, "n 3"]
    rest_joints: Float[Array, "j 3"]
    faces: Int[Array, "f 3"]
    parents: tuple[int, ...] = static_field()
    joint_names: tuple[str, ...] = static_field()
    skinning: Literal["affine", "rotation"] = static_field(default="affine")
    rendering: Literal["exact", "inria"] = static_field(default="exact")

    def save(self, path: str | os.PathLike) -> None:
        """Write one compressed `.npz` (no pickle); it appears whole or not at all."""
        header = {
            "format": FORMAT,
            "version": VERSION,
            "parents": self.parents,
            "joint_names": self.joint_names,
            "skinning": self.skinning,
            "rendering": self.rendering,
        }
        values = {name: getattr(self.gaussians, name) for name in _ARRAYS[:5]}
        values |= {name: getattr(self, name) for name in _ARRAYS[5:]}
        write_npz(Path(path), {"header": json.dumps(header)} | values)

    @classmethod
    def load(cls, path: str | os.PathLike) -> "Avatar":
        """Read what `save` wrote.

        Raises: FileNotFoundError if there is no such file; ValueError, naming file and key, if it is no avatar of this
        version, a key is missing, or shapes do not fit each other.
        """
        try:
            archive = np.load(path, allow_pickle=False)
            header = json.loads(str(archive["header"]))
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such file") from None
        except (KeyError, ValueError, OSError, TypeError, IndexError) as error:
            raise ValueError(f"{path}: not an avatar file written by humangs ({error})") from None
        if header.get("format") != FORMAT or header.get("version") != VERSION:
            raise ValueError(
                f"{path}: expected {FORMAT} version {VERSION}, got {header.get('format')} version {header.get('version')}"
            )
        if missing := [name for name in _ARRAYS if name not in archive]:
            raise ValueError(f"{path}: missing keys {missing}")
        arrays = {name: archive[name] for name in _ARRAYS}
        g, j, n = len(arrays["means"]), len(header["parents"]), len(arrays["rest_vertices"])
        f = len(arrays["faces"])
        shapes = {
            "means": (g, 3),
            "quats": (g, 4),
            "scales": (g, 3),
            "opacities": (g,),
            "colors": (g, 3),
            "skinning_weights": (g, j),
            "rest_vertices": (n, 3),
            "rest_joints": (j, 3),
            "faces": (f, 3),
        }
        for name, shape in shapes.items():
            if arrays[name].shape != shape:
                raise ValueError(f"{path}: {name}: expected shape {shape}, got {arrays[name].shape}")
        loaded = {name: jnp.asarray(value) for name, value in arrays.items()}
        return cls(
            Gaussians(*(loaded[name] for name in _ARRAYS[:5])),
            *(loaded[name] for name in _ARRAYS[5:]),
            parents=tuple(header["parents"]),
            joint_names=tuple(header["joint_names"]),
            skinning=header["skinning"],
            rendering=header.get("rendering", "exact"),  # the first files do not say
        )
