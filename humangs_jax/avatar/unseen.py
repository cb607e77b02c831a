"""Guesses the parts of a person that no photo shows from the parts that photos show.

Without a photo of the back, the network paints it grey, because it does not know what the person
wears there. Here the Gaussians of a vertex that no photo shows take their colors, opacities and
heights above the skin from vertices that photos show. These vertices are near it on the surface, in
front of it or behind it, or on the other side of the body. The guess for a vertex u is an attention
over the vertices v that are shown, and over their mirror images:

    guess(u) = sum_v softmax_v(log sure(v) - |f(u) - f(v)|^2 / (2 SPREAD^2)) value(v)

The features f of a vertex are its position in the T-pose, metres, and its skinning weights. Depths
from front to back count less than other distances. The weights are there because a sleeve is not
like the trunk behind it. On the head and the hands the position alone is the feature. On the head
only hair is a source, so that the back of a head gets hair and not a second face. The face stays as
the network made it. Heads take guesses from heads alone, and hands from hands alone.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.pytree import replace
from humangs_jax.data.body_and_masks import MASK_THRESHOLD, shaped, skinned
from humangs_jax.data.capture import Capture
from humangs_jax.geometry.mesh import unit, vertex_area_vectors, vertex_areas
from humangs_jax.geometry.transform import EXACT
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.network.parts import HumanGSInputs, HumanGSOutputs, subject_unit
from humangs_jax.network.reader import project_and_test
from humangs_jax.rendering.gaussians import Gaussians

UNSEEN = 0.15
"""Nothing is known of a vertex if in every photo the cosine between its normal and the direction to
the camera is below this.
"""
SEEN = 0.45
"""Nothing is guessed for a vertex if the cosine (see `UNSEEN`) is at least this in one of the
photos. Between `UNSEEN` and `SEEN` guesses are mixed in.
"""
SPREAD = 0.015
"""The weight of a source falls with its distance in the space of the features, as a Gaussian with
this standard deviation, metres.
"""
LEAST_HIDDEN = 1 / 3
"""Something is guessed only if photos hide more than this share of the vertices. If photos show a
person from all around, only folds and the insides of hands are left, which the network knows
better.
"""
DEPTH = 0.5
"""Factor on distances from front to back in the features, because the back of a trunk is more like
its front than like its sides.
"""
PART = 0.6
"""Distance in the features, metres, that stands for a change of the square root of a skinning
weight by 1.
"""
MIRRORED = 0.05
"""The square of this distance, metres, is added to the squared distance of a source's mirror image.
"""
FARTHEST = 0.5
"""A vertex gets a guess only if a source is within this distance in the space of the features,
metres.
"""
APART = 10.0
"""Distance of the head, and of the hands, from the rest of the body in the space of the features,
metres.
"""
CROWN = 0.93
"""Share of the head's height above which the crown begins."""
FACE = 0.5
"""The face is the part of the head in front of this share of the head's depth, except the crown. It
keeps its colors.
"""
NAPE = (0.35, 0.55)
"""Shares of the head's depth, from behind, and of its height. Vertices of the head behind the first
share and above the second count as hair, as the crown does.
"""
GLANCE = (0.03, 0.25)
"""These replace `UNSEEN` and `SEEN` where hair is a source, because photos of a face show the crown
at a glancing angle.
"""
HEAD_JOINTS = ("head", "jaw", "eye")
BLOCK = 256
"""Number of vertices whose guesses are computed at a time. It bounds the memory."""
TINY = 1e-6
"""The least squared distance, length, depth, weight and area, so that quotients and logarithms are
finite.
"""


def with_guesses(
    outputs: HumanGSOutputs, inputs: HumanGSInputs, body: BodyModel, config: HumanGSConfig
) -> HumanGSOutputs:
    """Returns the outputs with guesses for what no photo shows. Nothing is guessed if photos hide
    at most the share `LEAST_HIDDEN` of the vertices.

    Outputs are returned unchanged for networks that read whole photos and not only the person, and
    for networks whose Gaussians are not on vertices. Gradients do not pass through the choice of
    sources.
    """
    on_vertices = not outputs.is_empty and outputs.skinning_weights is None
    rest, normals = inputs.canonical_vertices, inputs.canonical_normals
    if config.conventions.pixels != "person" or not on_vertices or normals is None:
        return outputs
    shown = jnp.max(_shown_by_view(inputs, config), axis=0)
    chosen = lax.stop_gradient((shown, body_regions(body, rest)))
    new = guessed(outputs.gaussians, rest, normals, *chosen)
    return replace(outputs, gaussians=new)


def _shown_by_view(inputs: HumanGSInputs, config: HumanGSConfig) -> Float[Array, "v n"]:
    """Returns how well each photo shows each vertex: the cosine between the vertex's normal and the
    direction to the camera. It is 0 if the vertex is hidden or beyond the frame or the mask, and in
    views that are padding.
    """
    assert inputs.posed_normals is not None  # `prepare_inputs` computes them
    unit_length = subject_unit(inputs.canonical_vertices)
    cameras, vertices = inputs.cameras.in_units(unit_length), inputs.posed_vertices / unit_length
    grid = config.conventions.pixel_grid
    _, visible = project_and_test(cameras, vertices, inputs.depth_maps, inputs.present, grid)
    sight = cameras.center[:, None] - vertices
    distance = jnp.sqrt(jnp.maximum(jnp.sum(sight**2, axis=-1), TINY))
    facing = jnp.sum(sight * inputs.posed_normals, axis=-1) / distance
    return jnp.where(visible, jnp.maximum(facing, 0), 0)


class Regions(NamedTuple):
    """Which vertices of a body take guesses and which give them, and the features of all
    vertices.
    """

    head: Bool[Array, " n"]
    """Which vertices belong to the head, (n,)."""
    free: Bool[Array, " n"]
    """Which vertices take guesses, (n,): all except the face's."""
    sources: Bool[Array, " n"]
    """Which vertices give guesses, (n,): the vertices of hair, and all that are not on the head."""
    features: Float[Array, "n f"]
    """The features of the vertices, (n, f), metres."""
    mirrored: Float[Array, "n f"]
    """The features of the vertices' mirror images, (n, f), metres."""


def body_regions(body: BodyModel, rest: Float[Array, "n 3"]) -> Regions:
    """Returns the regions of a body. rest: its vertices in the T-pose, metres."""
    weights = body.skinning_weights
    head = _share_of(body, HEAD_JOINTS) > 0.5
    hands = _share_of(body, ("wrist", "index", "middle", "pinky", "ring", "thumb")) > 0.5

    # Shares of the head's box: 0 at the chin and at the back of the head, 1 at the crown and at the
    # nose.
    low = jnp.min(jnp.where(head[:, None], rest, jnp.inf), axis=0)
    high = jnp.max(jnp.where(head[:, None], rest, -jnp.inf), axis=0)
    _, height, front = jnp.moveaxis((rest - low) / jnp.maximum(high - low, TINY), 1, 0)
    crown = head & (height > CROWN)
    face = head & (front > FACE) & ~crown
    hair = crown | (head & (front < NAPE[0]) & (height > NAPE[1]))

    # Where a vertex and its mirror image lie. Heads and hands are far from all else.
    names = body.joint_names
    twins = [_mirrored(name) if _mirrored(name) in names else name for name in names]
    others = np.asarray([names.index(twin) for twin in twins])
    flip = jnp.asarray([-1.0, 1.0, 1.0])
    group = jnp.where(head, APART, jnp.where(hands, -APART, 0.0))
    features = _features(rest, weights, group)
    mirrored = _features(rest * flip, weights[:, others], group)
    return Regions(head, ~face, hair | ~head, features, mirrored)


def _features(
    positions: Float[Array, "n 3"], weights: Float[Array, "n j"], group: Float[Array, " n"]
) -> Float[Array, "n f"]:
    plain = group != 0
    depths = jnp.where(plain, 1.0, DEPTH) * positions[:, 2]
    parts = PART * jnp.sqrt(jnp.maximum(weights, 0)) * ~plain[:, None]
    return jnp.concatenate([positions[:, :2], depths[:, None], parts, group[:, None]], axis=1)


def _share_of(body: BodyModel, joints: tuple[str, ...]) -> Float[Array, " n"]:
    """Returns for each vertex the sum of the skinning weights of the joints whose names contain one
    of the words in `joints`.
    """
    chosen = [any(word in name for word in joints) for name in body.joint_names]
    return jnp.sum(body.skinning_weights * jnp.asarray(chosen, float), axis=1)


def _mirrored(name: str) -> str:
    """Returns the name of the joint on the other side. A joint in the middle keeps its name."""
    side, _, part = name.partition("_")
    other = {"left": "right", "right": "left"}
    if side in other:
        return f"{other[side]}_{part}"
    return name


def guessed(
    gaussians: Gaussians,
    rest: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    shown: Float[Array, " n"],
    regions: Regions,
) -> Gaussians:
    """Returns the Gaussians of the n vertices, with guesses where photos do not show the vertices.

    rest, normals: the body in the T-pose, metres, and its unit normals. shown: the cosine in the
    photo that shows each vertex best, see `_shown_by_view`.
    """
    count = len(rest)
    sure = jnp.clip((shown - UNSEEN) / (SEEN - UNSEEN), 0, 1)
    one_sided = jnp.mean(shown < UNSEEN) > LEAST_HIDDEN
    need = jnp.where(regions.free & one_sided, 1 - sure, 0)
    glance = jnp.clip((shown - GLANCE[0]) / (GLANCE[1] - GLANCE[0]), 0, 1)
    given = jnp.where(regions.sources, jnp.where(regions.head, glance, sure), 0)

    # What is guessed, a row for each vertex: colors, opacities, and heights above the skin.
    offsets = gaussians.means.reshape(count, -1, 3) - rest[:, None]
    heights = jnp.einsum("nka,na->nk", offsets, normals, precision=EXACT)
    colors, opacities = gaussians.colors.reshape(count, -1), gaussians.opacities.reshape(count, -1)
    columns = (colors.shape[1], colors.shape[1] + opacities.shape[1])
    values = jnp.concatenate([colors, opacities, heights], axis=1)
    new = attended(values, need, given, regions)
    new_colors, new_opacities, new_heights = jnp.split(new, columns, axis=1)

    means = rest[:, None] + offsets + (new_heights - heights)[..., None] * normals[:, None]
    changed = jnp.repeat(jnp.any(new != values, axis=1), gaussians.means.shape[0] // count)
    return replace(
        gaussians,
        means=jnp.where(changed[:, None], means.reshape(-1, 3), gaussians.means),
        colors=new_colors.reshape(-1, 3),
        opacities=new_opacities.reshape(-1),
    )


def attended(
    values: Float[Array, "n c"],
    need: Float[Array, " n"],
    sure: Float[Array, " n"],
    regions: Regions,
) -> Float[Array, "n c"]:
    """Returns the values, each mixed with its guess.

    need: the share of the guess for each vertex, in [0, 1]. 0: the value stays. sure: how much a
    vertex counts as a source, in [0, 1]. 0: it is no source. Vertices that have no source within
    `FARTHEST` keep their values. The time grows with the number of vertices with a need.
    """
    count = len(need)
    order = jnp.argsort(-need)  # so that blocks without need are skipped
    order = jnp.pad(order, (0, -count % BLOCK), constant_values=count)  # beyond the end: dropped
    keys = jnp.concatenate([regions.features, regions.mirrored])
    farther = jnp.concatenate([jnp.zeros(count), jnp.full(count, MIRRORED**2)])
    weight = jnp.where(sure > 0, jnp.log(jnp.maximum(sure, TINY)), -jnp.inf)
    weight = jnp.concatenate([weight, weight])
    lengths = jnp.sum(keys**2, axis=1)

    @jax.checkpoint  # the shares are computed again for gradients: they are larger than all else
    def guess(rows: Int[Array, " r"]) -> Float[Array, "r c"]:
        query, own = regions.features[rows], values[rows]
        products = jnp.matmul(query, keys.T, precision=EXACT)
        squares = jnp.sum(query**2, axis=1)[:, None] + lengths - 2 * products + farther
        near = jnp.any((squares < FARTHEST**2) & (weight > -jnp.inf), axis=1)
        scores = weight - squares / (2 * SPREAD**2)
        shares = jax.nn.softmax(jnp.where(near[:, None], scores, 0.0), axis=1)
        shares = shares[:, :count] + shares[:, count:]
        mixed = jnp.where(near, need[rows], 0)[:, None]
        found = own + mixed * (jnp.matmul(shares, values, precision=EXACT) - own)
        return jnp.where(mixed > 0, found, own).astype(values.dtype)

    def block(rows: Int[Array, " r"]) -> Float[Array, "r c"]:
        return lax.cond(jnp.any(need[rows] > 0), guess, lambda rows: values[rows], rows)

    found = lax.map(block, order.reshape(-1, BLOCK)).reshape(-1, values.shape[1])
    return jnp.zeros_like(values).at[order].set(found, mode="drop")


# The line about guesses
# ------------------------------------------------------------------------------------------------

CLEARLY = 0.5
"""A photo shows clearly what a surface looks like if the cosine between the surface's normal and
the direction to the camera is larger than this.
"""
LEAST_SHOWN = 0.5
"""A side is a guess if photos show less than this share of its area clearly. A part of the body is
a guess if less than this share of its area lies in photos.
"""
SIDES = {
    "front": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
    "left side": (1.0, 0.0, 0.0),
    "right side": (-1.0, 0.0, 0.0),
}
"""The directions of the sides in the T-pose. A surface belongs to a side if the angle between its
normal and the side's direction is less than 60 degrees.
"""
PARTS = {"head": HEAD_JOINTS, "lower legs": ("knee",), "feet": ("ankle", "foot")}
"""Words in joint names, by part. A vertex belongs to a part if the name of its main joint has one
of the words.
"""


def guess_line(capture: Capture) -> str | None:
    """Returns one line that names the sides and parts of the person that are guesses, see
    `unseen_sides`. None if photos show all of them.
    """
    names = [f"the {name}" for name in unseen_sides(capture)]
    if not names:
        return None
    several = len(names) > 1 or names[0].endswith("s")
    listed = " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))
    if several:
        return f"{listed} are guesses: no photo shows them"
    return f"{listed} is a guess: no photo shows it"


def unseen_sides(capture: Capture) -> list[str]:
    """Returns the names of the `SIDES` and `PARTS` that are guesses, see `LEAST_SHOWN`.

    This runs on the host, and does not consider that other limbs may be in front.
    """
    body, rest = capture.body, shaped(capture.body, capture.betas)
    faces, weights = np.asarray(body.faces), np.asarray(body.skinning_weights)
    normals, areas = unit(vertex_area_vectors(rest, faces)), vertex_areas(rest, faces)
    joints = np.asarray(body.joint_regressor, float) @ rest

    # A vertex is shown where it faces the camera and lies in the frame and in the mask.
    framed, shown = np.zeros((2, len(rest)), bool)
    cameras = jax.tree.map(np.asarray, capture.cameras)
    for i, frame in enumerate(np.asarray(capture.frames).tolist()):
        linear, offset = skinned(body, joints, capture.poses, frame, weights)
        vertices = np.einsum("nab,nb->na", linear, rest) + offset
        rotation, translation = cameras.cam_from_world[i, :3, :3], cameras.cam_from_world[i, :3, 3]
        seen = vertices @ rotation.T + translation
        facing = np.einsum("nab,nb->na", linear, normals) @ rotation.T
        cosine = -np.sum(facing * seen, axis=1) / np.linalg.norm(seen, axis=1)
        depth = np.maximum(seen[:, 2:], TINY)
        pixels = np.floor((seen @ cameras.K[i].T)[:, :2] / depth).astype(int)
        size = np.asarray([capture.images.shape[2], capture.images.shape[1]])
        within = (seen[:, 2] > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)
        column, row = np.where(within[:, None], pixels, 0).T
        if capture.masks is not None:
            within &= np.asarray(capture.masks[i])[row, column] > MASK_THRESHOLD
        framed |= within
        shown |= within & (cosine > CLEARLY)

    def share(found: Bool[np.ndarray, " n"], chosen: Bool[np.ndarray, " n"]) -> float:
        return float(np.sum(areas * chosen * found) / max(np.sum(areas * chosen), TINY))

    # Sides are by the direction of the surface, parts by the joint that moves it most.
    dominant = np.asarray(body.joint_names)[np.argmax(weights, axis=1)]
    sides = {name: normals @ along > 0.5 for name, along in SIDES.items()}
    parts = {
        name: np.asarray([any(word in joint for word in words) for joint in dominant])
        for name, words in PARTS.items()
    }
    hidden = [name for name, chosen in sides.items() if share(shown, chosen) < LEAST_SHOWN]
    return hidden + [name for name, chosen in parts.items() if share(framed, chosen) < LEAST_SHOWN]
