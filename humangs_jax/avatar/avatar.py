"""The avatar: canonical Gaussians, their skinning weights and the body that they belong to, as
one pytree and one file.
"""

import json
import os
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.face import Face
from humangs_jax.body.library import expression_arrays, read_expressions
from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.arrays import from_host, taken
from humangs_jax.core.checks import FINITE, LARGEST, ROUNDING, SIGNED_UNIT, UNIT, require_concrete
from humangs_jax.core.numerics import at_least_float32
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace, shape_fault, static_field
from humangs_jax.core.records import array_fields
from humangs_jax.geometry.transform import EXACT, along_curve
from humangs_jax.io.arrays import (
    check_array,
    check_checksum,
    check_indices,
    check_joints,
    check_row_sums,
    checksum,
    read_npz,
    write_npz,
)
from humangs_jax.io.reading import FileError, InvalidFileError, is_unread, parse_json, reading
from humangs_jax.rendering.gaussians import Gaussians, check_count
from humangs_jax.rendering.mesh.rasterizer import vertex_normals

# The light of the photos: colors contain it, so they are corrected (`relit`) for parts that turn in
# another pose.
#  The log of the brightness is a polynomial of second order in the surface's unit normal, the same
# for all colors. A Lambertian surface in distant light has a brightness of that order (Ramamoorthi
# and Hanrahan 2001, https://doi.org/10.1145/383259.383317). Its coefficients come from the colors
# of the avatar: vertices near each other mostly have the same albedo, so that light is the cause
# where normals and brightness differ (Retinex: Land and McCann 1971,
# https://doi.org/10.1364/JOSA.61.000001). Prints and the edges of clothes are outliers.

TERMS = 8
LIMIT = 0.7
"""From the photos to another pose, the log of a Gaussian's brightness changes by at most this. The
brightness changes by a factor of at most about 2.
"""
STEPS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233)
"""A curve runs through all vertices. Each vertex is compared with the vertices that are these
numbers of vertices away along the curve.
"""
CURVE_REACH = 1.5
"""Half of the side of the cube that holds the curve, metres. Its centre is the middle of the body.
"""
REACH = 0.25
"""Vertices that are farther apart than this are not compared, metres."""
DARKEST = 0.02
"""Brightness below which differences of the log are noise. Darker colors are raised to this."""
ROBUST = 0.03
"""Residuals of the log brightness above this count by their size, smaller ones by their square."""
RIDGE = 0.003
"""Weight of the squared coefficients in the fit. It keeps the light of a body without contrast at
zero.
"""
ITERATIONS = 10
TINY = 1e-24
"""Least squared length of a normal. Before a normal is divided by its length, the squared length is
raised to this, so that the gradient is finite where the normal vanishes.
"""


@pytree_dataclass
class Light:
    """The light of the photos, which other poses are drawn in."""

    coefficients: Float[Array, "8"]
    """Weights of `light_terms`, (8,). The weighted sum of the terms is the log of the
    brightness.
    """
    normals: Float[Array, "g 3"]
    """Unit normals of the body's surface in the T-pose at each Gaussian, (g, 3)."""
    shading: Float[Array, " g"]
    """Log of the brightness of each Gaussian in the photos, (g,). The colors of the Gaussians
    contain this brightness.
    """


def light_terms(normals: Float[Array, "g 3"]) -> Float[Array, "g 8"]:
    """Returns the spherical harmonics of degree 1 and 2 of unit normals, up to constant factors."""
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    return jnp.stack([x, y, z, x * y, y * z, z * x, z**2 - x**2, 3 * y**2 - 1], axis=-1)


def log_brightness(
    terms: Float[Array, "*n 8"], coefficients: Float[Array, "8"]
) -> Float[Array, "*n"]:
    """Returns the log of the brightness that surfaces have in a light. terms: what `light_terms`
    returns.
    """
    return jnp.sum(terms * coefficients, axis=-1)


def turned_normals(
    normals: Float[Array, "g 3"], linear: Float[Array, "g 3 3"]
) -> Float[Array, "g 3"]:
    """Returns the unit normals of surfaces after linear maps. A normal is 0 where the map takes the
    surface to a line or a point.
    """
    # the inverse transpose, up to a positive factor: rows of cofactors
    rows = [jnp.cross(linear[:, (i + 1) % 3], linear[:, (i + 2) % 3]) for i in range(3)]
    turned = jnp.einsum("gij,gj->gi", jnp.stack(rows, axis=1), normals, precision=EXACT)
    return turned * jax.lax.rsqrt(jnp.maximum(jnp.sum(turned**2, axis=-1, keepdims=True), TINY))


def relit(
    colors: Float[Array, "g 3"], light: Light, linear: Float[Array, "g 3 3"]
) -> Float[Array, "g 3"]:
    """Returns the colors of Gaussians after their surfaces were turned by the linear maps `linear`.

    Colors do not exceed 1, except those that did before.
    """
    terms = light_terms(turned_normals(light.normals, linear))
    change = jnp.clip(log_brightness(terms, light.coefficients) - light.shading, -LIMIT, LIMIT)
    return jnp.minimum(colors * jnp.exp(change)[:, None], jnp.maximum(colors, 1.0))


def light_coefficients(
    vertices: Float[Array, "n 3"],
    colors: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    terms: Float[Array, "n 8"],
) -> Float[Array, "8"]:
    """Returns the coefficients of the light that best explains how the log of the brightness
    differs between vertices that are near each other.

    Absolute residuals of these differences are minimised by iteratively reweighted least squares;
    below `ROBUST` they count by their square.

    Arguments: vertices: in the T-pose, metres. colors, weights: of the vertices. Vertices of weight
    0 do not count. terms: the `light_terms` of the vertices in the photos.
    """
    middle = (jnp.min(vertices, axis=0) + jnp.max(vertices, axis=0)) / 2
    order = jnp.argsort(along_curve(vertices - middle, CURVE_REACH))
    brightness = jnp.mean(jnp.log(jnp.maximum(colors, DARKEST)), axis=-1)
    numbers = jnp.concatenate([vertices, brightness[:, None], weights[:, None], terms], axis=-1)[
        order
    ]
    others = jnp.stack([jnp.roll(numbers, step, axis=0) for step in STEPS])
    apart = jnp.broadcast_to(numbers, others.shape) - others
    near = jnp.sum(apart[..., :3] ** 2, axis=-1) < REACH**2
    counted = (near * jnp.minimum(numbers[:, 4], others[..., 4])).reshape(-1)
    change, turn = apart[..., 3].reshape(-1), apart[..., 5:].reshape(-1, TERMS)

    def step(_, coefficients):
        weight = counted / jnp.maximum(jnp.abs(change - log_brightness(turn, coefficients)), ROBUST)
        weighted = (turn * (weight / jnp.maximum(jnp.sum(counted), 1e-6))[:, None]).T
        squares, target = (
            jnp.matmul(weighted, values, precision=EXACT) for values in (turn, change)
        )
        return jnp.linalg.solve(squares + RIDGE * jnp.eye(TERMS), target)

    return jax.lax.fori_loop(0, ITERATIONS, step, jnp.zeros(TERMS))


def surface_normals(
    vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"], points: Float[Array, "g 3"]
) -> Float[Array, "g 3"]:
    """Returns the unit normal of a mesh at the vertex nearest to each point. Runs on the host."""
    from scipy.spatial import KDTree

    return vertex_normals(vertices, faces)[
        KDTree(np.asarray(vertices)).query(np.asarray(points))[1]
    ]


# The avatar
# --------------------------------------------------------------------------------------------------

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
"""Gaussians belong to one vertex if their skinning weights differ by less than this."""
_LIGHT = ("coefficients", "normals", "shading")
_OPTIONAL = {"low_pass": "pixel_footprint", "harmonics": "harmonics"}
"""The optional arrays of a file: key -> field of `Gaussians`."""


@pytree_dataclass
class Avatar(Batchable):
    """A person who can be animated: Gaussians in the T-pose (theta = 0).

    An avatar may also be a batch of people, with leading axes on every array. A batch can be
    indexed and iterated over, and functions are mapped over it with `jax.vmap`.

    Examples:
        >>> avatar = hg.Avatar.load("avatar.npz")
        >>> image = hg.render(hg.animate(avatar, pose), camera).rgb

        `faces` are integers, which `jax.grad` refuses. Differentiate a part of an avatar, or all
        but the integers:

        >>> of_gaussians = lambda part: loss(hg.replace(avatar, gaussians=part))
        >>> gradient = jax.grad(of_gaussians)(avatar.gaussians)
        >>> floats, rest = equinox.partition(avatar, equinox.is_inexact_array)
        >>> gradient = jax.grad(lambda floats: loss(equinox.combine(floats, rest)))(floats)
    """

    gaussians: Gaussians
    """The Gaussians in the T-pose, metres. Most networks make k Gaussians for each vertex. These
    are ordered by vertex, with the k Gaussians of a vertex next to each other.
    """
    skinning_weights: Float[Array, "g j"]
    """The weights of the joints for each Gaussian, (g, j); rows sum to 1."""
    rest_vertices: Float[Array, "n 3"]
    """The vertices of the shaped body in the T-pose, (n, 3), metres."""
    rest_joints: Float[Array, "j 3"]
    """The joints of the shaped body in the T-pose, (j, 3), metres."""
    faces: Int[Array, "f 3"]
    """Vertex indices, (f, 3), counter-clockwise seen from outside."""
    parents: tuple[int, ...] = static_field()
    """The parent of each joint, -1 for the root."""
    joint_names: tuple[str, ...] = static_field()
    """The name of each joint, in their order."""
    skinning: Literal["affine", "rotation"] = static_field(default="affine")
    """What the linear part of the blended transform acts on. "affine": the whole covariance of a
    Gaussian. "rotation": its quaternion alone, see `skin_gaussians`.
    """
    rendering: Literal["exact", "inria"] = static_field(default="exact")
    """How the Gaussians are splatted: the preset that they were trained for, a name in
    `SPLAT_PRESETS`.
    """
    light: Light | None = None
    """The light of the photos, in which other poses are drawn. None: it was not estimated."""
    face: Face | None = None
    """The face, which poses with an expression need (see `with_face`). None: no pose can have an
    expression.
    """
    one_at_a_time: ClassVar[bool] = True
    """Functions that take one avatar refuse a batch of avatars, see `core.checks`."""

    @property
    def gaussians_per_vertex(self) -> int | None:
        """The number of Gaussians of each vertex. None if the Gaussians are not ordered by vertex
        with an equal number for each, for example after `select`. Skinning weights show the order.
        """
        weights, vertices = np.asarray(self.skinning_weights), len(self.rest_vertices)
        if len(weights) % vertices:
            return None
        own = weights.reshape(vertices, -1, weights.shape[1])
        # those between the legs may have other weights (`body.model.blend_leg_weights`): most
        # of a vertex's agree
        alike = np.isclose(own, own[:, :1], atol=ALIKE).all(axis=(1, 2))
        return own.shape[1] if alike.mean() > 0.5 else None

    @property
    def expression_names(self) -> tuple[str, ...]:
        """The names of the coefficients of a pose's expression. Empty if there is no face."""
        if self.face is None:
            return ()
        return self.face.expressions.names

    def with_face(self, body: BodyModel | None = None) -> "Avatar":
        """Returns the avatar with a face, so that poses may have an expression. Poses without an
        expression are drawn as before. An avatar that has a face is returned as it is.

        Args:
            body: the body model that the avatar's vertices belong to. It must have expressions.
                None: the shipped body, or what `gaussian_body` makes of it.

        Raises:
            ValueError: if the body has no expressions, or if the avatar has fewer vertices than the
                body or lacks a triangle that expressions move. Positions are not compared.

        Examples:
            >>> avatar = hg.Avatar.load("avatar.npz").with_face()
            >>> names = avatar.expression_names
            >>> smile = jnp.asarray(["mouthSmile" in name for name in names], float)
            >>> gaussians = hg.animate(avatar, hg.replace(pose, expression=smile))
        """
        from humangs_jax.avatar.attach_face import with_face

        return with_face(self, body)

    def select(self, index: Array | np.ndarray) -> "Avatar":
        """Returns the avatar with only the Gaussians at `index`."""
        light = self.light
        if light is not None:
            light = replace(
                light, normals=taken(light.normals, index), shading=taken(light.shading, index)
            )
        gaussians = jax.tree.map(lambda x: taken(x, index), self.gaussians)
        return replace(
            self,
            gaussians=gaussians,
            skinning_weights=taken(self.skinning_weights, index),
            light=light,
            face=None if self.face is None else self.face.select(index),
        )

    def save(self, path: str | os.PathLike[str], *, made_from: str | None = None) -> None:
        """Write one compressed `.npz` (no pickle). If writing fails, the path stays as it was.

        Arguments: made_from: a checksum of what the avatar was made from, for `recorded_source`.

        Raises: ValueError for a batch of avatars, for arrays that do not fit each other, and for
        Gaussians with deformations, because an avatar in T-pose has none; FileError if `load` would
        refuse the joints or an array, for example for numbers that are not finite; OSError;
        TypeError inside of JAX transformations.
        """
        require_concrete("Avatar.save", "writes a file", self)
        # a file holds one avatar in the T-pose
        if self.batch_shape:
            raise ValueError(
                f"expected one avatar, got a batch {self.batch_shape}: save each,"
                " avatars[0].save(path)"
            )
        fault = shape_fault(self)
        if fault:
            raise ValueError(f"avatar{fault}")
        if self.gaussians.deformations is not None:
            raise ValueError(
                "gaussians.deformations: expected an avatar in the T-pose, which has none"
            )
        # names and settings as JSON, numbers as arrays
        header = {
            "format": FORMAT,
            "version": VERSION,
            "parents": self.parents,
            "joint_names": self.joint_names,
            "skinning": self.skinning,
            "rendering": self.rendering,
        }
        if made_from is not None:
            header["made_from"] = made_from
        values = {name: getattr(self.gaussians, name) for name in _ARRAYS[:5]}
        values |= {name: getattr(self, name) for name in _ARRAYS[5:]}
        # what only some avatars have
        if self.light is not None:
            values |= {f"light_{name}": getattr(self.light, name) for name in _LIGHT}
        optional = {name: getattr(self.gaussians, field) for name, field in _OPTIONAL.items()}
        values |= {name: x for name, x in optional.items() if x is not None}
        values = {
            name: np.asarray(x if name == "faces" else at_least_float32(x))
            for name, x in values.items()
        }
        of_face = {} if self.face is None else _face_arrays(self.face)
        # files that `load` would refuse are not written
        with reading(path, "avatar"):
            check_joints(self.parents, self.joint_names)
            _check_arrays(values, len(self.parents))
            _read_face(of_face, values)
        values |= of_face
        write_npz(path, {"header": json.dumps(header | {"checksum": checksum(values)})} | values)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Avatar":
        """Read what `save` wrote.

        Raises: FileNotFoundError if there is no such file; FileError, which names the file, if it
        is no avatar of this version, a key is missing, shapes do not fit each other, numbers are
        not finite or out of range, indices do not exist, or the arrays do not have the checksum in
        the header. The error names the key if one array is wrong. The first files have no checksum,
        and are read without this check.
        """
        with reading(path, "avatar file"):
            return _load(cls, path)


def recorded_source(path: str | os.PathLike[str]) -> str | None:
    """Returns the checksum of what an avatar was made from, as `Avatar.save` has written it into
    the file. None if the file has no such checksum.

    Raises: FileNotFoundError if there is no such file; FileError if it is no avatar of this
    version.
    """
    with reading(path, "avatar file"):
        _, header = _read(path, lambda name: name == "header")
        found = header.get("made_from")
        return found if isinstance(found, str) else None


def _read(
    path: Any, wanted: Callable[[str], bool] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns the arrays of an avatar file by key, and its header. The arrays are not checked.

    wanted: function that returns whether the array of a key is read. None: all are read.

    Raises: FileError, InvalidFileError.
    """
    try:
        arrays, _ = read_npz(path, wanted)
        header = parse_json(str(arrays["header"]))
    except (FileError, KeyError) as error:
        if is_unread(error):
            raise
        raise FileError(path, "", f"not an avatar file written by humangs ({error})") from error
    if (
        not isinstance(header, dict)
        or header.get("format") != FORMAT
        or header.get("version") != VERSION
    ):
        found = header if isinstance(header, dict) else {}
        raise InvalidFileError(
            f"expected {FORMAT} version {VERSION}, got {found.get('format')} version"
            f" {found.get('version')}"
        )
    return arrays, header


def _load(cls: type[Avatar], path: Any) -> Avatar:
    arrays, header = _read(path)
    # which arrays the file must have
    with_light = any(f"light_{name}" in arrays for name in _LIGHT)
    wanted = _ARRAYS + tuple(f"light_{name}" for name in _LIGHT if with_light)
    wanted += tuple(name for name in _OPTIONAL if name in arrays)
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise InvalidFileError(f"missing keys {missing}")
    check_joints(header["parents"], header["joint_names"])
    # the first files do not say
    skinning, rendering = header["skinning"], header.get("rendering", "exact")
    if skinning not in ("affine", "rotation") or rendering not in ("exact", "inria"):
        raise InvalidFileError(
            f"skinning {skinning!r}, rendering {rendering!r}: expected 'affine' or 'rotation',"
            " 'exact' or 'inria'"
        )
    # shapes and ranges are checked before the checksum, since their errors say more
    of_face = {
        name: array for name, array in arrays.items() if name.startswith(("face_", "expression_"))
    }
    arrays = {name: arrays[name] for name in wanted} | of_face
    _check_arrays(arrays, len(header["parents"]))
    face = _read_face(of_face, arrays)
    check_checksum(header.get("checksum"), checksum(arrays))
    arrays = {name: arrays[name] for name in wanted}
    loaded = {name: from_host(value) for name, value in arrays.items()}
    return cls(
        Gaussians(
            *(loaded[name] for name in _ARRAYS[:5]),
            **{field: loaded.get(name) for name, field in _OPTIONAL.items()},
        ),
        *(loaded[name] for name in _ARRAYS[5:]),
        parents=tuple(header["parents"]),
        joint_names=tuple(header["joint_names"]),
        skinning=skinning,
        rendering=rendering,
        light=Light(*(loaded[f"light_{name}"] for name in _LIGHT)) if with_light else None,
        face=face,
    )


_FACE = (
    *("row", "eyes", "beside", "stretching"),
    *("hidden_normals", "hidden_directions", "hidden_shown", "in_mouth", "lips", "lip_directions"),
)
"""Names of the arrays of a face. Their keys in files begin with `face_`. The arrays of the hidden
Gaussians have further keys, which begin with `face_hidden_`.
"""


def _face_arrays(face: Face) -> dict[str, np.ndarray]:
    """Returns the arrays of a face by their keys in a file."""
    arrays = {f"face_{name}": np.asarray(getattr(face, name)) for name in _FACE}
    hidden = {f"face_hidden_{name}": np.asarray(getattr(face.hidden, name)) for name in _ARRAYS[:5]}
    return arrays | hidden | expression_arrays(face.expressions)


def _read_face(of_face: dict[str, np.ndarray], arrays: Mapping[str, np.ndarray]) -> Face | None:
    """Returns the face in an avatar file; None if the file has none.

    Raises: InvalidFileError, naming the key.
    """
    expressions = read_expressions(
        of_face, len(arrays["rest_vertices"]), len(arrays["rest_joints"])
    )
    if expressions is None:
        return None
    # a face is there whole or not at all
    keys = [f"face_{name}" for name in _FACE] + [f"face_hidden_{name}" for name in _ARRAYS[:5]]
    missing = [key for key in keys if key not in of_face]
    if missing:
        raise InvalidFileError(f"missing keys {missing}")
    # sizes: g Gaussians, q hidden ones, m vertices that expressions move
    g, e = len(arrays["means"]), len(expressions.names)
    q, m = len(np.atleast_1d(of_face["face_hidden_means"])), len(expressions.vertices)
    check_indices("face_row", of_face["face_row"], (g,), m + 1)
    check_indices("face_beside", of_face["face_beside"], (m, None), m + 1)
    unit, lengths, any_number = (-ROUNDING, 1 + ROUNDING), (0.0, LARGEST), (-LARGEST, LARGEST)
    # the shape of each array and the range of its numbers
    expected = {
        "eyes": ((g, 2), unit),
        "stretching": ((m, of_face["face_beside"].shape[1], 3), any_number),
        "hidden_normals": ((q, 3), any_number),
        "hidden_directions": ((q, 3, e), any_number),
        "hidden_shown": ((q, e), any_number),
        "in_mouth": ((q,), unit),
        "lips": ((4, 3), any_number),
        "lip_directions": ((4, 3, e), any_number),
        "hidden_means": ((q, 3), any_number),
        "hidden_quats": ((q, 4), any_number),
        "hidden_scales": ((q, 3), lengths),
        "hidden_opacities": ((q,), unit),
        "hidden_colors": ((q, 3), any_number),
    }
    for name, (shape, ends) in expected.items():
        check_array(f"face_{name}", of_face[f"face_{name}"], shape, *ends)
    loaded = {name: from_host(of_face[f"face_{name}"], jnp.float32) for name in expected}
    # teeth, tongue and lids are Gaussians that are hidden at rest
    hidden = Gaussians(*(loaded.pop(f"hidden_{name}") for name in _ARRAYS[:5]))
    loaded |= {name: from_host(of_face[f"face_{name}"], jnp.int32) for name in ("row", "beside")}
    return Face(hidden=hidden, expressions=expressions, **loaded)


_RANGES = {"skinning_weights": UNIT, "light_normals": SIGNED_UNIT}
"""Ranges of arrays in files, by key, for arrays whose annotations have a wider range or none."""


def _check_arrays(arrays: Mapping[str, np.ndarray], j: int) -> None:
    """Check the arrays of an avatar of j joints, as its file holds them.

    Raises: InvalidFileError.
    """
    g, n = (len(arrays[name]) for name in ("means", "rest_vertices"))
    if not g or not n:
        raise InvalidFileError(
            f"{'rest_vertices' if g else 'means'}: expected at least one"
            f" {'vertex' if g else 'Gaussian'}"
        )
    # shapes by the annotations of the records that the arrays are of, and numbers of some size
    sizes = {"g": g, "n": n, "j": j}
    keys = {field: key for key, field in _OPTIONAL.items()}
    for record, prefix in ((Gaussians, ""), (Avatar, ""), (Light, "light_")):
        for field, annotated in array_fields(record).items():
            key = keys.get(field, prefix + field)
            array = arrays.get(key)
            if array is None or field == "faces":
                continue
            values = _RANGES.get(key, annotated.values or FINITE)
            shape = annotated.shape(array, sizes)
            least, most = max(values.low, -LARGEST), min(values.high, LARGEST)
            check_array(key, array, shape, least, most)
    if "harmonics" in arrays:
        check_count(arrays["harmonics"].shape[1])
    # what shapes and ranges do not say
    check_indices("faces", arrays["faces"], (None, 3), n)
    check_row_sums("skinning_weights", arrays["skinning_weights"])
