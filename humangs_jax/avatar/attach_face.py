"""Makes the face of an avatar whose body has expressions. It finds how the avatar's Gaussians
move, and adds Gaussians for what photos do not show.
"""

import functools
import logging
from collections.abc import Callable
from importlib import resources
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.face import BLINKS, Face
from humangs_jax.body.expressions import EYES, PARTS, Expressions, FaceParts, shipped_parts
from humangs_jax.body.joints import PARENTS
from humangs_jax.body.library import load_body
from humangs_jax.body.model import BodyModel
from humangs_jax.body.motion import Motion
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.arrays import from_host
from humangs_jax.core.configuration import config_from_json
from humangs_jax.core.pytree import replace
from humangs_jax.data.views import gaussian_body
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.mesh import mesh_edges, unit
from humangs_jax.io.tensors import read_safetensors
from humangs_jax.network.config import Conventions, HumanGSConfig
from humangs_jax.network.weights import SHIPPED
from humangs_jax.rendering.gaussians import Gaussians

logger = logging.getLogger(__name__)
COLORS = {
    "upper_teeth": (0.84, 0.80, 0.72),
    "lower_teeth": (0.78, 0.74, 0.66),
    "tongue": (0.66, 0.33, 0.32),
    "mouth": (0.27, 0.10, 0.10),
}
"""The RGB colors of parts that no photo shows. Lids have the color of the skin around the eye."""
CLOSING = 4.0
"""The shown share of a lid's opacity is this factor times the coefficient of its blink, up to 1."""
OPAQUE = 0.97
COVER = 0.6
"""Standard deviation of a hidden Gaussian along a side of its quadrangle, divided by the length of
the side. Neighbours overlap without gaps.
"""
THICKNESS = 0.25
"""Standard deviation of a hidden Gaussian along its normal, divided by the length of the shorter
side of its quadrangle.
"""
LID_LIFT = 0.003
"""The Gaussians of lids are moved out along their normals by this distance, metres, because the
Gaussians of the eye are about that thick.
"""
EYE = (0.0165, 0.0095, 0.005, 0.03)
"""Four lengths in metres: half of the width and half of the height of the opening between the lids,
then the range of distances in front of the eye's centre in which Gaussians show the eye.
"""
SOFT = 0.3
"""Width of the rim around the opening, as a share of the opening's radius. Across the rim, the
share by which Gaussians belong to the eye falls from 1 to 0.
"""
AROUND_EYE = (0.02, 0.045)
"""Range of distances from an eye's centre, metres. Skin within the range gives its color to the
lids.
"""
BESIDE = 8
"""The largest number of neighbours from which the stretch of a vertex is computed."""
RIDGE = 0.01
"""Weight of the ridge, relative to the sum of the squared lengths of the edges at a vertex. Edges
hardly extend along the normal of the skin. Without the ridge, skin would be stretched in this
direction.
"""
NEAR = {"mouth": 0.06, "lid": 0.04}
"""Radii around the middle of the mouth's parts and around the middle of a lid, metres. The parts
are moved by an affine map. It takes the vertices of the mean body within the radius to the same
vertices of the avatar.
"""
FEWEST = 12
"""The least number of vertices from which an affine map is computed. If fewer are within the
radius, the `FEWEST` nearest vertices are taken.
"""


# Bodies of avatars
# --------------------------------------------------------------------------------------------------


def shipped_network() -> HumanGSConfig:
    """Returns the default configuration with the conventions of the shipped weights, without
    reading their tensors. If no weights are shipped, the conventions are the default ones, too.
    """
    with resources.as_file(resources.files("humangs_jax") / SHIPPED) as file:
        metadata = {}
        if file.exists():
            metadata = read_safetensors(file, lambda key: False)[2]
    return HumanGSConfig(
        conventions=config_from_json(Conventions, metadata.get("conventions", "{}"))
    )


def body_of(avatar: Avatar) -> BodyModel | None:
    """Returns the shipped body if the avatar has the face of this body. Returns the body that
    `gaussian_body` makes of it if the avatar has the face of that body, and None if it has neither.

    Only triangles and the parents of joints are compared. The avatar's vertices may be displaced,
    and it may have a skirt.
    """
    if avatar.parents != PARENTS:
        return None
    whole = load_body()
    for body in (whole, gaussian_body(whole, shipped_network())):
        if _has_face(avatar, body):
            return body
    return None


def _has_face(avatar: Avatar, body: BodyModel) -> bool:
    """Returns whether the avatar has all triangles of the body that expressions move."""
    if body.expressions is None or len(avatar.rest_vertices) < len(body.template):
        return False
    faces, own = np.asarray(body.faces), np.asarray(avatar.faces)
    faces = faces[np.isin(faces, np.asarray(body.expressions.vertices)).any(axis=1)]

    def number(corners):
        return np.dot(corners.astype(np.int64), (1 << 42, 1 << 21, 1))

    return bool(np.isin(number(faces), number(own)).all())


# Attaching
# --------------------------------------------------------------------------------------------------


def with_face(avatar: Avatar, body: BodyModel | None = None) -> Avatar:
    """Returns the avatar with a face, see `Avatar.with_face`. An avatar that has a face is returned
    as it is.

    Raises: ValueError if the body has no expressions, or if the avatar has fewer vertices than the
    body or lacks a triangle that expressions move. Positions of vertices are not compared.
    """
    if avatar.face is not None:
        return avatar
    found = body_of(avatar) if body is None else body
    if found is None or found.expressions is None or not _has_face(avatar, found):
        name = "the shipped body"
        if body is not None:
            name = f"the body '{body.name}'"
        raise ValueError(f"with_face: the avatar's vertices are not those of {name} with a face")
    expressions = found.expressions
    return replace(avatar, face=_face(avatar, found, "eyeBlinkLeft" in expressions.names))


def faced(avatar: Avatar) -> Avatar:
    """Returns the avatar with a face if `body_of` finds its body. Otherwise, or if it has a face
    already, returns it as it is.
    """
    found = None
    if avatar.face is None:
        found = body_of(avatar)
    if found is None:
        return avatar
    return with_face(avatar, found)


def with_face_for(avatar: Avatar, motion: Motion) -> Avatar:
    """Returns the avatar with a face if the motion has expressions, else the avatar as it is. If
    the avatar's body is not known, no face is added, and a warning is logged.
    """
    if motion.expressions is None or avatar.face is not None:
        return avatar
    try:
        return with_face(avatar)
    except ValueError as error:
        logger.warning("the expressions of the motion are left out: %s", error)
        return avatar


def _face(avatar: Avatar, body: BodyModel, of_arkit: bool) -> Face:
    expressions = body.expressions
    assert expressions is not None
    count, vertices = len(avatar.rest_vertices), np.asarray(expressions.vertices)
    row_of_vertex = np.full(count, len(vertices))
    row_of_vertex[vertices] = np.arange(len(vertices))
    row = row_of_vertex[_vertex_of_gaussians(avatar)]
    if of_arkit:
        eyes = _eyes(avatar)
    else:
        eyes = np.zeros((len(row), 2), np.float32)
    row[eyes.sum(axis=1) > 0.5] = len(vertices)  # what shows the eye does not go with the lids
    beside, stretching = _stretching(avatar, vertices, row_of_vertex)
    if of_arkit:
        hidden = _hidden(avatar, body, row < len(vertices))
    else:
        hidden = _nothing(expressions)
    return Face(
        row=from_host(row, jnp.int32),
        eyes=from_host(eyes),
        beside=from_host(beside, jnp.int32),
        stretching=from_host(stretching, jnp.float32),
        expressions=expressions,
        **hidden,
    )


def _stretching(
    avatar: Avatar, vertices: Int[np.ndarray, " m"], row: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, "m k"], Float[np.ndarray, "m k 3"]]:
    """Returns the neighbours of each vertex that moves, and their vectors w (see `avatar.face`).
    Neighbours are given as rows among the vertices that move, (m, BESIDE). vertices: indices of the
    vertices that move. row: for each vertex of the avatar, its row among these vertices, or m if it
    stays.
    """
    edges, _ = mesh_edges(np.asarray(avatar.faces))
    pairs = np.concatenate([edges, edges[:, ::-1]])
    pairs = pairs[row[pairs[:, 0]] < len(vertices)]
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    starts = np.searchsorted(pairs[:, 0], pairs[:, 0])
    rank = np.arange(len(pairs)) - starts
    pairs, rank = pairs[rank < BESIDE], rank[rank < BESIDE]
    own, other = row[pairs[:, 0]], pairs[:, 1]
    places = np.asarray(avatar.rest_vertices, np.float64)
    beside = np.full((len(vertices), BESIDE), len(vertices))
    apart = np.zeros((len(vertices), BESIDE, 3))
    beside[own, rank] = row[other]
    apart[own, rank] = places[other] - places[pairs[:, 0]]
    squares = np.einsum("mka,mkb->mab", apart, apart)
    ridge = RIDGE * np.trace(squares, axis1=1, axis2=2)[:, None, None] + 1e-12
    return beside, apart @ np.linalg.inv(squares + ridge * np.eye(3))


def _vertex_of_gaussians(avatar: Avatar) -> Int[np.ndarray, " g"]:
    """Returns the index of the vertex that each Gaussian belongs to. If
    `Avatar.gaussians_per_vertex` is None, this is the vertex nearest to the Gaussian.
    """
    each, count = avatar.gaussians_per_vertex, len(avatar.rest_vertices)
    if each is not None:
        return np.repeat(np.arange(count), each)
    return KDTree(np.asarray(avatar.rest_vertices)).query(np.asarray(avatar.gaussians.means))[1]


def _eyes(avatar: Avatar) -> Float[np.ndarray, "g 2"]:
    """Returns the shares by which each Gaussian belongs to the left and to the right eye, in [0,
    1]. Gaussians between the lids of open eyes belong to an eye.
    """
    means = np.asarray(avatar.gaussians.means)
    shares = []
    for name in EYES:
        offset = means - np.asarray(avatar.rest_joints)[avatar.joint_names.index(name)]
        radius = np.linalg.norm(offset[:, :2] / EYE[:2], axis=1)
        inside = np.clip((1 + SOFT - radius) / SOFT, 0, 1)
        shares.append(inside * (offset[:, 2] > EYE[2]) * (offset[:, 2] < EYE[3]))
    return np.stack(shares, axis=1).astype(np.float32)


# What photos do not show
# --------------------------------------------------------------------------------------------------


def _nothing(expressions: Expressions) -> dict[str, Any]:
    """Returns the fields of `Face` about hidden Gaussians, by name, for a face without hidden
    Gaussians. Bodies such as SMPL-X have such a face, because their mesh has eyes and the inside of
    a mouth.
    """
    e = len(expressions.names)
    empty = Gaussians(*(from_host(np.zeros((0, *shape))) for shape in ((3,), (4,), (3,), (), (3,))))
    shapes = {
        "hidden_normals": (0, 3),
        "hidden_directions": (0, 3, e),
        "hidden_shown": (0, e),
        "in_mouth": (0,),
        "lips": (4, 3),
        "lip_directions": (4, 3, e),
    }
    return {"hidden": empty} | {name: from_host(np.zeros(shape)) for name, shape in shapes.items()}


@functools.cache
def _shipped_parts() -> FaceParts:
    return shipped_parts(np.asarray(load_body().template))


def _hidden(avatar: Avatar, body: BodyModel, follows: np.ndarray) -> dict[str, Any]:
    """Returns the fields of `Face` about hidden Gaussians, by name. follows: whether each Gaussian
    of the avatar moves with the face.
    """
    expressions = body.expressions
    assert expressions is not None
    parts, names = _shipped_parts(), expressions.names
    corners, colors = parts.corners.copy(), np.zeros((len(parts.parts), 3))
    shown = np.zeros((len(parts.parts), len(names)))
    # the vertices that expressions move, on the mean body and on this one
    moves = np.asarray(expressions.vertices)
    before, after = np.asarray(body.template)[moves], np.asarray(avatar.rest_vertices)[moves]

    # the mouth and the lids follow those vertices
    in_mouth = ~np.isin(parts.parts, [PARTS.index("left_lid"), PARTS.index("right_lid")])
    of_mouth = _map_around(corners[in_mouth], before, after, NEAR["mouth"])
    corners[in_mouth], lips = of_mouth(corners[in_mouth]), of_mouth(parts.lips)
    for name, color in COLORS.items():
        colors[parts.parts == PARTS.index(name)] = color

    # lids have the shape that they have when closed: they are folded when open
    drawn = corners.copy()
    for side, eye, blink in zip(("left", "right"), EYES, BLINKS, strict=True):
        lid, at = parts.parts == PARTS.index(f"{side}_lid"), names.index(blink)
        corners[lid] = _map_around(corners[lid], before, after, NEAR["lid"])(corners[lid])
        drawn[lid] = corners[lid] + parts.directions[lid, ..., at]
        colors[lid] = _skin_around(avatar, eye, follows)
        shown[lid, at] = CLOSING

    # a Gaussian for each of their faces
    hidden, normals = _gaussians_of(corners, drawn, colors, in_mouth)
    arrays = {
        "hidden_normals": normals,
        "hidden_directions": parts.directions.mean(axis=1),
        "hidden_shown": shown,
        "in_mouth": in_mouth,
        "lips": lips,
        "lip_directions": parts.lip_directions,
    }
    return {"hidden": hidden} | {name: from_host(x, jnp.float32) for name, x in arrays.items()}


def _map_around(
    points: Float[np.ndarray, "*p 3"],
    before: Float[np.ndarray, "m 3"],
    after: Float[np.ndarray, "m 3"],
    reach: float,
) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function that maps places, metres, by an affine map. The map is the least-squares
    fit that takes the vertices `before` near `points` to the vertices `after`. A vertex is near if
    it is within `reach` of the middle of the points. If fewer than `FEWEST` vertices are near, the
    `FEWEST` nearest ones are taken. If there are fewer vertices in all, the map is a shift. All
    lengths are in metres.
    """
    middle = points.reshape(-1, 3).mean(axis=0)
    distance = np.linalg.norm(before - middle, axis=1)
    near = distance <= max(reach, np.sort(distance)[min(FEWEST, len(distance)) - 1])
    shift, centre = (after - before)[near].mean(axis=0), before[near].mean(axis=0)
    linear = np.zeros((3, 3))
    if near.sum() >= FEWEST:
        moved = (after - before)[near] - shift
        linear = np.linalg.lstsq(before[near] - centre, moved, rcond=None)[0]
    return lambda places: places + shift + (places - centre) @ linear


def _skin_around(avatar: Avatar, eye: str, follows: np.ndarray) -> Float[np.ndarray, "3"]:
    """Returns the median color of the skin around and below an eye, or of all Gaussians if there is
    no skin there. eye: the name of the eye's joint. follows: whether each Gaussian moves with the
    face.
    """
    offset = (
        np.asarray(avatar.gaussians.means)
        - np.asarray(avatar.rest_joints)[avatar.joint_names.index(eye)]
    )
    distance = np.linalg.norm(offset, axis=1)
    near = (distance > AROUND_EYE[0]) & (distance < AROUND_EYE[1])
    near &= follows & (offset[:, 2] > 0) & (offset[:, 1] < 0)
    if not near.any():
        near = np.ones(len(offset), bool)
    return np.median(np.asarray(avatar.gaussians.colors)[near], axis=0)


def _gaussians_of(
    corners: Float[np.ndarray, "q 4 3"],
    drawn: Float[np.ndarray, "q 4 3"],
    colors: Float[np.ndarray, "q 3"],
    in_mouth: np.ndarray,
) -> tuple[Gaussians, Float[np.ndarray, "q 3"]]:
    """Returns a flat Gaussian for each quadrangle, and the unit normals of the quadrangles.
    corners: the corners at rest, metres. drawn: the corners when the Gaussian is seen, metres.
    """
    first = (drawn[:, 1] + drawn[:, 2] - drawn[:, 0] - drawn[:, 3]) / 2
    second = (drawn[:, 2] + drawn[:, 3] - drawn[:, 0] - drawn[:, 1]) / 2
    normals = unit(np.cross(first, second))
    sides = np.stack([np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)], axis=1)
    scales = np.concatenate([COVER * sides, THICKNESS * sides.min(axis=1, keepdims=True)], axis=1)
    axes = np.stack([unit(first), np.cross(normals, unit(first)), normals], axis=-1)
    means = corners.mean(axis=1) + np.where(in_mouth, 0, LID_LIFT)[:, None] * normals

    def number(x):
        return from_host(x, jnp.float32)

    quats, opacities = _from_matrices(number(axes)), np.full(len(means), OPAQUE)
    return (
        Gaussians(number(means), quats, number(scales), number(opacities), number(colors)),
        normals,
    )


_from_matrices = jax.jit(quaternion.from_matrix)
