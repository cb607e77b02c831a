"""The face of an avatar: what its Gaussians do when a pose has an expression.

Before skinning, a Gaussian moves by the offset d_i of its vertex i. With affine skinning it is also
stretched like the skin around the vertex, by the linear map

    A_i = I + sum_k (d_k - d_i) w_ik^T,
    w_ik = (sum_k (p_k - p_i)(p_k - p_i)^T + ridge)^-1 (p_k - p_i).

Here k runs over the vertices beside i, and p_i is the place of vertex i at rest, metres.

Gaussians that show an eye turn with the joint of the eye instead, and fade when the lids close.
Photos hardly show teeth, tongue and closed lids. For these a face has further Gaussians, which are
drawn only while an expression shows them. `avatar.attach_face.with_face` makes a face.
"""

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.expressions import Expressions
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import Batchable, pytree_dataclass, replace
from humangs_jax.geometry.transform import EXACT
from humangs_jax.rendering.gaussians import Gaussians

BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
"""The expressions that close the left and the right eye."""
SMALLEST_OPENING = 0.001
"""Half of the distance between the lips at which the inside of the mouth begins to show, metres."""
RIM = 0.3
"""The inside of the mouth fades towards the lips over this share of the opening's radius, because
Gaussians are some millimetres wide.
"""
BEFORE_LIPS = 0.004
"""While the mouth is open, a point of the mouth, such as the tip of the tongue, is fully seen if it
is at least this far in front of the lips, metres.
"""


@pytree_dataclass
class Face(Batchable):
    """The expressions of an avatar of g Gaussians and j joints; m vertices move, and q Gaussians
    are hidden at rest.
    """

    row: Int[Array, " g"]
    """The row of `expressions.directions` that each Gaussian follows, (g,); m for Gaussians that
    stay.
    """
    eyes: Float[Array, "g 2"]
    """The shares by which each Gaussian belongs to the left and to the right eye, (g, 2), in [0,
    1].
    """
    beside: Int[Array, "m k"]
    """The rows of the vertices beside each vertex that moves, (m, k). A vertex that stays, or a
    missing neighbour, has the row m.
    """
    stretching: Float[Array, "m k 3"]
    """The vectors w_ik of these neighbours (see the module), (m, k, 3), 1 / metres; 0 for a missing
    neighbour.
    """
    hidden_normals: Float[Array, "q 3"]
    """Unit normals of the hidden Gaussians, (q, 3), for the light."""
    hidden_directions: Float[Array, "q 3 e"]
    """How the hidden Gaussians move, (q, 3, e), metres per unit of a coefficient."""
    hidden_shown: Float[Array, "q e"]
    """The share of each hidden Gaussian's opacity that a unit of each coefficient shows, (q, e).
    The sum over the coefficients is clipped to [0, 1]. Gaussians of the mouth do not use this
    field.
    """
    in_mouth: Float[Array, " q"]
    """1 for Gaussians of the mouth, which are seen through the open lips or in front of them, and 0
    for lids, (q,).
    """
    lips: Float[Array, "4 3"]
    """Four points of the lips, (4, 3), metres in the T-pose: the inner edge of the upper lip in the
    middle, the inner edge of the lower lip in the middle, the left corner and the right corner.
    """
    lip_directions: Float[Array, "4 3 e"]
    """How the four points of `lips` move, (4, 3, e), metres per unit of a coefficient."""
    hidden: Gaussians
    """Teeth, tongue, the inside of the mouth and closed lids in T-pose, with the opacities that
    they have when shown.
    """
    expressions: Expressions
    """The expressions, as moves of the avatar's rest vertices."""

    def select(self, index: Array | np.ndarray) -> "Face":
        """Returns the face for an avatar that keeps only the Gaussians at `index`."""
        return replace(self, row=self.row[index], eyes=self.eyes[index])

    def without_expression(self) -> Float[Array, " e"]:
        """Returns the coefficients of a face at rest, all 0."""
        return jnp.zeros(len(self.expressions.names), self.hidden_shown.dtype)


def moved_hidden(face: Face, expression: Float[Array, " e"]) -> Gaussians:
    """Returns the hidden Gaussians in T-pose, moved by an expression. Their opacities are
    multiplied by how much the expression shows them, from 0 to 1.
    """
    moves = jnp.einsum("qae,e->qa", face.hidden_directions, expression, precision=EXACT)
    shown = jnp.clip(jnp.einsum("qe,e->q", face.hidden_shown, expression, precision=EXACT), 0, 1)
    means = face.hidden.means + moves
    lips = face.lips + jnp.einsum("lae,e->la", face.lip_directions, expression, precision=EXACT)
    seen = jnp.where(face.in_mouth > 0, between_lips(means, lips), shown)
    return replace(face.hidden, means=means, opacities=face.hidden.opacities * seen)


def between_lips(points: Float[Array, "q 3"], lips: Float[Array, "4 3"]) -> Float[Array, " q"]:
    """Returns how much of each point is seen through the opening of the mouth, in [0, 1]. The
    opening is an ellipse. While the mouth is open, points well in front of the lips are fully seen.
    """
    upper, lower, left, right = lips
    center = (upper + lower) / 2
    height = jnp.maximum((upper[1] - lower[1]) / 2, 0)
    width = jnp.maximum((left[0] - right[0]) / 2, SMALLEST_OPENING)
    apart = (points - center)[:, :2] / jnp.stack([width, height + SMALLEST_OPENING])
    radius = jnp.sqrt(jnp.sum(jnp.square(apart), axis=-1) + SMALLEST_OPENING**2)
    inside = jnp.clip((1 - radius) / RIM, 0, 1)
    before = jnp.clip((points[:, 2] - center[2]) / BEFORE_LIPS, 0, 1)
    opened = jnp.clip((height - SMALLEST_OPENING) / SMALLEST_OPENING, 0, 1)
    return opened * jnp.maximum(inside, before)


def moved_gaussians(
    face: Face, gaussians: Gaussians, expression: Float[Array, " e"], stretched: bool
) -> Gaussians:
    """Returns the Gaussians of an avatar in T-pose, moved by an expression. Gaussians of an eye
    fade as its lids close, if the face has the expressions `BLINKS`. stretched: whether the
    Gaussians also get `deformations`.
    """
    moves = jnp.einsum("mae,e->ma", face.expressions.directions, expression, precision=EXACT)
    moves = jnp.concatenate([moves, jnp.zeros_like(moves[:1])])
    opacities, names = gaussians.opacities, face.expressions.names
    if all(name in names for name in BLINKS):
        closed = jnp.stack([expression[names.index(name)] for name in BLINKS])
        opacities = opacities * (1 - jnp.sum(face.eyes * jnp.clip(closed, 0, 1), axis=-1))
    moved = replace(gaussians, means=gaussians.means + moves[face.row], opacities=opacities)
    if not stretched:
        return moved
    apart = moves[face.beside] - moves[:-1, None]
    stretch = jnp.einsum("mka,mkb->mab", apart, face.stretching, precision=EXACT)
    stretch = jnp.concatenate([stretch, jnp.zeros_like(stretch[:1])]) + jnp.eye(3)
    return replace(moved, deformations=stretch[face.row])


def with_hidden(gaussians: Gaussians, hidden: Gaussians) -> Gaussians:
    """Returns the Gaussians, followed by the hidden ones. `hidden` has neither harmonics nor
    `pixel_footprint` nor deformations. For each of these that `gaussians` has, the hidden Gaussians
    get values: harmonics of 0, the median `pixel_footprint`, the identity as deformation.
    """
    fields = {}
    if gaussians.harmonics is not None:
        shape = (len(hidden.means), *gaussians.harmonics.shape[1:])
        fields["harmonics"] = jnp.zeros(shape, gaussians.harmonics.dtype)
    if gaussians.pixel_footprint is not None:
        fields["pixel_footprint"] = jnp.full(
            len(hidden.means), jnp.median(gaussians.pixel_footprint)
        )
    if gaussians.deformations is not None:
        fields["deformations"] = jnp.broadcast_to(jnp.eye(3), (len(hidden.means), 3, 3))
    hidden = replace(hidden, **fields)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b]), gaussians, hidden)
