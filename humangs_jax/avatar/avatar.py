"""The avatar: canonical Gaussians, their skinning weights and the body that they belong to, as one pytree and one file."""

import json
import os
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.light import TERMS, Light
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.checks import LARGEST, ROUNDING
from humangs_jax.core.numerics import at_least_float32
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace, shape_fault, static_field
from humangs_jax.io.arrays import check_array, check_checksum, check_indices, check_joints, check_row_sums, checksum
from humangs_jax.io.npz import read_npz, write_npz
from humangs_jax.io.reading import FileError, Refused, parse_json, reading
from humangs_jax.rendering.gaussians import Gaussians
from humangs_jax.rendering.harmonics import check_count

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
ALIKE = 1e-3
"""Skinning weights that differ by less are those of one vertex."""
_LIGHT = ("coefficients", "normals", "shading")
_OPTIONAL = ("low_pass", "harmonics")
"""Of the Gaussians."""


@pytree_dataclass
class Avatar(Batchable):
    """A person who can be animated: Gaussians in the T-pose (theta = 0).

    Or a batch of people, leading axes on every array: it can be indexed and iterated over, and functions are mapped over it with
    `jax.vmap`.

    Examples:
        >>> avatar = hg.Avatar.load("avatar.npz")
        >>> image = hg.render(hg.animate(avatar, pose), camera).rgb
    """

    gaussians: Gaussians
    """Canonical, metres; vertex-major, the k Gaussians of a vertex together, unless refinement has added some."""
    skinning_weights: Float[Array, "g j"]
    """Rows sum to 1."""
    rest_vertices: Float[Array, "n 3"]
    """The shaped body in the T-pose, metres."""
    rest_joints: Float[Array, "j 3"]
    """Its joints, metres."""
    faces: Int[Array, "f 3"]
    """Vertex indices, counter-clockwise seen from outside."""
    parents: tuple[int, ...] = static_field()
    """Parent of each joint, -1 for the root."""
    joint_names: tuple[str, ...] = static_field()
    skinning: Literal["affine", "rotation"] = static_field(default="affine")
    """Whether Gaussians take the full linear part of the blended transform, or its rotation."""
    rendering: Literal["exact", "inria"] = static_field(default="exact")
    """The splatting that the Gaussians were trained for, a name in `SPLAT_PRESETS`."""
    light: Light | None = None
    """Of the photos, where it has been estimated; other poses are drawn in it."""
    one_at_a_time: ClassVar[bool] = True

    @property
    def gaussians_per_vertex(self) -> int | None:
        """k, or None where refinement has added Gaussians, which do not stand with those of a vertex."""
        weights, vertices = np.asarray(self.skinning_weights), len(self.rest_vertices)
        if len(weights) % vertices:
            return None
        own = weights.reshape(vertices, -1, weights.shape[1])
        # those between the legs may have weights of their own (`skinning.spread_weights`): most of a vertex's agree
        alike = np.isclose(own, own[:, :1], atol=ALIKE).all(axis=(1, 2))
        return own.shape[1] if alike.mean() > 0.5 else None

    def select(self, index: Array | np.ndarray) -> "Avatar":
        """The avatar with these of its Gaussians."""
        light = self.light
        if light is not None:
            light = replace(light, normals=light.normals[index], shading=light.shading[index])
        gaussians = jax.tree.map(lambda x: x[index], self.gaussians)
        return replace(self, gaussians=gaussians, skinning_weights=self.skinning_weights[index], light=light)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one compressed `.npz` (no pickle); it appears whole or not at all.

        Raises: ValueError for a batch of avatars, for arrays that do not fit each other, and if the Gaussians are deformed, as
        those of a pose are: avatars are in the T-pose; FileError if
        `load` would refuse the file, as it does numbers that are not finite.
        """
        if self.batch_shape:
            raise ValueError(f"expected one avatar, got a batch {self.batch_shape}: save each, avatars[0].save(path)")
        if fault := shape_fault(self):
            raise ValueError(f"avatar{fault}")
        if self.gaussians.deformations is not None:
            raise ValueError("gaussians.deformations: expected an avatar in the T-pose, which has none")
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
        if self.light is not None:
            values |= {f"light_{name}": getattr(self.light, name) for name in _LIGHT}
        values |= {name: x for name in _OPTIONAL if (x := getattr(self.gaussians, name)) is not None}
        values = {name: np.asarray(x if name == "faces" else at_least_float32(x)) for name, x in values.items()}
        with reading(path, "avatar"):
            _check_arrays(values, len(self.parents))
        write_npz(path, {"header": json.dumps(header | {"checksum": checksum(values)})} | values)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Avatar":
        """Read what `save` wrote.

        Raises: FileNotFoundError if there is no such file; FileError, naming file and key, if it is no avatar of this
        version, a key is missing, shapes do not fit each other, numbers are not finite or out of range, indices do not
        exist, or the contents are not those of the checksum in the header (which the first files do not have).
        """
        with reading(path, "avatar file"):
            return _load(cls, path)


def _load(cls: type[Avatar], path: Any) -> Avatar:
    try:
        arrays, _ = read_npz(path)
        header = parse_json(str(arrays["header"]))
    except (FileError, KeyError) as error:
        raise FileError(path, "", f"not an avatar file written by humangs ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT or header.get("version") != VERSION:
        found = header if isinstance(header, dict) else {}
        raise Refused(f"expected {FORMAT} version {VERSION}, got {found.get('format')} version {found.get('version')}")
    with_light = any(f"light_{name}" in arrays for name in _LIGHT)
    wanted = _ARRAYS + tuple(f"light_{name}" for name in _LIGHT if with_light)
    wanted += tuple(name for name in _OPTIONAL if name in arrays)
    if missing := [name for name in wanted if name not in arrays]:
        raise Refused(f"missing keys {missing}")
    check_joints(header["parents"], header["joint_names"])
    skinning, rendering = header["skinning"], header.get("rendering", "exact")  # the first files do not say
    if skinning not in ("affine", "rotation") or rendering not in ("exact", "inria"):
        raise Refused(f"skinning {skinning!r}, rendering {rendering!r}: expected 'affine' or 'rotation', 'exact' or 'inria'")
    arrays = {name: arrays[name] for name in wanted}
    _check_arrays(arrays, len(header["parents"]))
    check_checksum(header.get("checksum"), checksum(arrays))
    loaded = {name: jnp.asarray(value) for name, value in arrays.items()}
    return cls(
        Gaussians(*(loaded[name] for name in _ARRAYS[:5]), **{name: loaded.get(name) for name in _OPTIONAL}),
        *(loaded[name] for name in _ARRAYS[5:]),
        parents=tuple(header["parents"]),
        joint_names=tuple(header["joint_names"]),
        skinning=skinning,
        rendering=rendering,
        light=Light(*(loaded[f"light_{name}"] for name in _LIGHT)) if with_light else None,
    )


def _check_arrays(arrays: Mapping[str, np.ndarray], j: int) -> None:
    """Of an avatar of j joints, as its file holds them. Raises: Refused."""
    g, n = (len(arrays[name]) for name in ("means", "rest_vertices"))
    if not g or not n:
        raise Refused(f"{'rest_vertices' if g else 'means'}: expected at least one {'vertex' if g else 'Gaussian'}")
    unit, lengths = (-ROUNDING, 1 + ROUNDING), (0.0, LARGEST)
    ranges = {"scales": lengths, "low_pass": lengths, "opacities": unit, "skinning_weights": unit}
    ranges["light_normals"] = (-1 - ROUNDING, 1 + ROUNDING)
    shapes = {
        "means": (g, 3),
        "quats": (g, 4),
        "scales": (g, 3),
        "opacities": (g,),
        "colors": (g, 3),
        "skinning_weights": (g, j),
        "rest_vertices": (n, 3),
        "rest_joints": (j, 3),
    }
    shapes |= {"light_coefficients": (TERMS,), "light_normals": (g, 3), "light_shading": (g,), "low_pass": (g,)}
    if "harmonics" in arrays:
        check_array("harmonics", arrays["harmonics"], (g, None, 3), -LARGEST, LARGEST)
        check_count(arrays["harmonics"].shape[1])
    for name in arrays:
        if name in shapes:
            check_array(name, arrays[name], shapes[name], *ranges.get(name, (-LARGEST, LARGEST)))
    check_indices("faces", arrays["faces"], (None, 3), n)
    check_row_sums("skinning_weights", arrays["skinning_weights"])
