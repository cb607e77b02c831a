"""What a fit to a scan found."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.body.model import BodyModel, BodyPose, pose_body, shape_body
from humangs_jax.core.array_types import Array, Float
from humangs_jax.fitting.scans.similarity import Similarity

LITTLE = 0.6
"""Of the scan: if less is near the body, the fit is in doubt. Wide skirts and long hair leave 0.7."""


@dataclasses.dataclass(frozen=True, eq=False)
class ScanFit:
    """A body in a scan.

    body; betas: (s,). pose: in our world: metres, y up, facing +z, the lowest point of the scan at y = 0. world_from_scan:
    from the file's coordinates to there. distances: (r,) metres by which the scan is outside of the skin at sampled points,
    negative inside; points without a partner nearby are left out. covered: share of the points that have one. turned, hidden:
    see `Scan`. start: "landmarks" or "search". up: what was taken for up. converged: whether the solver did.
    """

    body: BodyModel
    betas: Float[np.ndarray, " s"]
    pose: BodyPose
    world_from_scan: Similarity
    distances: Float[np.ndarray, " r"]
    covered: float
    turned: bool
    hidden: float
    start: str
    up: str
    converged: bool

    @property
    def quantiles_mm(self) -> tuple[float, float, float]:
        """5, 50 and 95 % of the distances are below these, millimetres; NaN if nothing is near the body."""
        if not len(self.distances):
            return float("nan"), float("nan"), float("nan")
        low, middle, high = 1000 * np.quantile(self.distances, (0.05, 0.5, 0.95))
        return float(low), float(middle), float(high)

    def __str__(self) -> str:
        """The report."""
        low, middle, high = self.quantiles_mm
        found = (
            "given joints" if self.start == "landmarks" else "a search, without joints: look at it before you use it"
        )
        lines = [
            f"start: {found}",
            f"scale: {self.world_from_scan.scale:.5g} metres per unit of the scan; up: {self.up}",
            f"scan outside of the skin: {middle:.1f} mm in the middle, {low:.1f} to {high:.1f} mm for 90 % of it",
            f"{100 * self.covered:.0f} % of the scan are near the body",
        ]
        if self.covered < LITTLE:
            lines.append("warning: much of the scan is not this body: does it hold a floor, or other things?")
        if self.turned:
            lines.append("the faces of the file were inside out; that was undone")
        if not self.converged:
            lines.append("the solver was still moving when its rounds were over")
        return "\n".join(lines)


@jax.jit
def _vertices(body: BodyModel, betas: Float[Array, " s"], pose: BodyPose) -> Float[Array, "n 3"]:
    return pose_body(body, shape_body(body, betas), pose).vertices


def body_in_scan(fit: ScanFit) -> Float[np.ndarray, "n 3"]:
    """The body's vertices (n, 3) in the scan's coordinates."""
    vertices = _vertices(fit.body, jnp.asarray(fit.betas), fit.pose)
    return fit.world_from_scan.inverse()(np.asarray(vertices, np.float64))
