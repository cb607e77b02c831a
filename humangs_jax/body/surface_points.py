"""Some points of a body's surface, posed without the rest of it, as fits do thousands of times."""

import jax.numpy as jnp

from humangs_jax.body import skinning
from humangs_jax.core.array_types import Array, Float
from humangs_jax.core.pytree import pytree_dataclass
from humangs_jax.geometry import transform


@pytree_dataclass
class SurfacePoints:
    """p points of a body with j joints; batches and concatenations of them are again such points.

    rest: (p, 3) of the mean shape in T-pose, metres. directions: (p, 3, s) metres per unit of a shape coefficient.
    corrections: (p, 3, q) of the pose's features, see `pose_features`, or None. weights: (p, j) of the skinning.
    """

    rest: Float[Array, "p 3"]
    directions: Float[Array, "p 3 s"]
    corrections: Float[Array, "p 3 q"] | None
    weights: Float[Array, "p j"]


def shaped(
    mean: Float[Array, "p 3"], directions: Float[Array, "p 3 s"], betas: Float[Array, " s_used"]
) -> Float[Array, "p 3"]:
    """Points or joints of a person in T-pose, metres; missing coefficients are 0."""
    return mean + jnp.einsum("pas,s->pa", directions[..., : betas.shape[0]], betas, precision=skinning.EXACT)


def pose_points(
    points: SurfacePoints,
    betas: Float[Array, " s_used"],
    features: Float[Array, " q"] | None,
    transforms: Float[Array, "j 4 4"],
) -> Float[Array, "p 3"]:
    """Where the points of a person are, metres. features: of the pose; ignored by bodies without correctives."""
    rest = shaped(points.rest, points.directions, betas)
    if points.corrections is not None:
        rest = rest + jnp.einsum("paq,q->pa", points.corrections, features, precision=skinning.EXACT)
    return transform.apply(skinning.blend_transforms(points.weights, transforms), rest)
