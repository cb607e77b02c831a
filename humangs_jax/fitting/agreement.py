"""How well the views of a moment agree on where landmarks are, as given and with keypoints exchanged on trial.

A view agrees with a landmark by how near its keypoint is to the best of the points that pairs of views propose
(`triangulation.triangulate_robustly`), so that outliers count for little.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Array, Bool, Float, Int
from humangs_jax.core.pytree import pytree_dataclass, replace
from humangs_jax.fitting.observations import Observations
from humangs_jax.fitting.triangulation import MARGIN, reprojection_errors, triangulate_robustly


@dataclasses.dataclass(frozen=True, eq=False)
class Order:
    """Which keypoints the c cameras of m moments are given.

    source: (m, c) camera that they come from. mirrored: (m, c) by source, whether their left and right are exchanged.
    """

    source: Int[np.ndarray, "m c"]
    mirrored: Bool[np.ndarray, "m c"]

    @classmethod
    def given(cls, moments: int, views: int) -> "Order":
        """Every camera has its own keypoints."""
        return cls(np.tile(np.arange(views), (moments, 1)), np.zeros((moments, views), bool))

    def exchanged(self, moments: Int[np.ndarray, " e"], a: Int[np.ndarray, " e"], b: Int[np.ndarray, " e"]) -> "Order":
        """With the keypoints of cameras a and b exchanged in some moments."""
        source = self.source.copy()
        source[moments, a], source[moments, b] = self.source[moments, b], self.source[moments, a]
        return dataclasses.replace(self, source=source)

    def sides_exchanged(self, moments: Int[np.ndarray, " e"], a: Int[np.ndarray, " e"]) -> "Order":
        """With left and right exchanged of what camera a has in some moments."""
        mirrored = self.mirrored.copy()
        mirrored[moments, self.source[moments, a]] ^= True
        return dataclasses.replace(self, mirrored=mirrored)


def arranged(observations: Observations, mirror: Int[np.ndarray, " k"], order: Order) -> Observations:
    """The keypoints of m moments in an order. mirror: index of each keypoint's mirror image."""
    rows = np.arange(len(order.source))[:, None]
    columns = np.where(order.mirrored[rows, order.source, None], mirror, np.arange(len(mirror)))
    pick = lambda values: jnp.asarray(np.asarray(values)[rows[..., None], order.source[..., None], columns])
    return replace(observations, points=pick(observations.points), confidences=pick(observations.confidences))


@pytree_dataclass
class Agreement:
    """Of c views with the points that they agree on best: sums over the keypoints of confidences, less for what is off.

    own: (c,) as the keypoints are. Without triangulating anew, crossed: (c, c) were the second view's keypoints the first's;
    mirrored: (c,) with left and right exchanged.
    """

    own: Float[Array, " c"]
    crossed: Float[Array, "c c"]
    mirrored: Float[Array, " c"]


@jax.jit
def agreement(observations: Observations, mirror: Int[Array, " k"] | Int[np.ndarray, " k"]) -> Agreement:
    """How well the views of each moment agree, a batch of m. mirror: index of each keypoint's mirror image."""
    return jax.lax.map(lambda seen: _of_moment(seen, mirror), observations)


def _of_moment(seen, mirror):
    points, counts, weights = triangulate_robustly(seen)

    def near(keypoints, confidences):
        """Agreement (c,) of all views if these (k, 2) were the keypoints of each."""
        given = replace(
            seen,
            points=jnp.broadcast_to(keypoints, seen.points.shape),
            confidences=jnp.broadcast_to(confidences, seen.confidences.shape),
        )
        share = 1 - jnp.square(reprojection_errors(given, points) / (MARGIN * seen.noise))
        return jnp.sum((counts >= 2) * given.confidences * jnp.maximum(share, 0.0), axis=-1)

    crossed = jax.vmap(near, out_axes=1)(seen.points, seen.confidences)
    mirrored = jnp.diagonal(jax.vmap(near, out_axes=1)(seen.points[:, mirror], seen.confidences[:, mirror]))
    return Agreement(jnp.sum(weights, axis=-1), crossed, mirrored)


def attainable(
    confidences: Float[np.ndarray, "m c k"], of: Bool[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "m c"], Int[np.ndarray, "m c"]]:
    """Agreement (m, c) if every keypoint `of` these that another view sees too did agree, and how many keypoints these are."""
    seen = (confidences > 0) & of
    shared = seen & (seen.sum(axis=1, keepdims=True) > 1)
    return (confidences * shared).sum(-1), shared.sum(-1)
