"""Our world and those of other programs: the one conversion of conventions that all exporters share.

Ours are metres with y up, the person faces +z, quaternions wxyz, linear scales, opacities and colors in [0, 1]. glTF's world is
the same. Viewers of `.ply` and `.splat` take y for down: SuperSplat and PlayCanvas turn what they read by half a turn about z.
`.spz` has axes to the right, up and back, half a turn about y from ours. So converters make the same of all of them.
`grounded_gaussians`, `turned` and `rotated` bring a person into these worlds; `plain_arrays` and `sh_of` are the numbers that
files hold.
"""

from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.core.checks import BOUNDED, check_values
from humangs_jax.core.pytree import replace
from humangs_jax.geometry import quaternion
from humangs_jax.geometry.transform import EXACT
from humangs_jax.rendering.gaussians import Gaussians, factored, gaussian_values, widened

Up = Literal["y", "-y", "z"]
"""The axis that points up in a file."""
SH_C0 = 0.28209479177387814
"""The constant spherical harmonic Y00 = 1 / (2 sqrt(pi))."""
SEEN = 0.5
"""Gaussians of at least this opacity have feet to stand on."""
BACKWARDS = (0.0, 0.0, 1.0, 0.0)
"""The rotation (quaternion, wxyz) of half a turn about y."""
_HALF = float(np.sqrt(0.5))
_TURNS = {"y": (1.0, 0.0, 0.0, 0.0), "-y": (0.0, 0.0, 0.0, 1.0), "z": (_HALF, _HALF, 0.0, 0.0)}


def up_turn(up: Up) -> tuple[float, float, float, float]:
    """The rotation (quaternion, wxyz) that turns +y to the named axis: -y about z, z about x. Raises: ValueError."""
    if up not in _TURNS:
        raise ValueError(f"up: expected {', '.join(get_args(Up))}, got {up!r}")
    return _TURNS[up]


def up_matrix(up: Up) -> Float[np.ndarray, "3 3"]:
    """`up_turn` as a matrix: of points and normals."""
    return _matrix(up_turn(up))


def turned(gaussians: Gaussians, up: Up) -> Gaussians:
    """Gaussians of a world with y up in one where `up` is. Raises: ValueError for another axis.

    -y: half a turn about z, (-x, -y, z). z: a quarter about x, (x, -z, y).
    """
    return rotated(gaussians, up_turn(up))


def rotated(gaussians: Gaussians, turn: tuple[float, float, float, float]) -> Gaussians:
    """Gaussians turned about the origin by a quaternion (wxyz) of quarters of a turn."""
    if gaussians.deformations is not None:
        gaussians = factored(gaussians)
    matrix = jnp.asarray(_matrix(turn), gaussians.means.dtype)
    means = jnp.matmul(gaussians.means, matrix.T, precision=EXACT)
    quats = quaternion.multiply(jnp.asarray(turn, gaussians.quats.dtype), gaussians.quats)
    return replace(gaussians, means=means, quats=quats)


def _matrix(turn):
    """Of 0 and +-1."""
    with jax.ensure_compile_time_eval():  # the turn is known inside of transformations, too
        return np.asarray(quaternion.to_matrix(jnp.asarray(turn)), np.float32).round()


def grounded_gaussians(gaussians: Gaussians) -> Gaussians:
    """Moved along y so that the lowest centre of a Gaussian that is seen (opacity 0.5 and more) lies on y = 0."""
    means, opacities = np.asarray(gaussians.means), np.asarray(gaussians.opacities)
    seen = opacities >= min(SEEN, opacities.max(initial=0.0))
    lowest = means[seen, 1].min(initial=np.inf)
    shift = np.asarray([0.0, lowest if np.isfinite(lowest) else 0.0, 0.0], means.dtype)
    return replace(gaussians, means=gaussians.means - shift)


def plain_arrays(
    gaussians: Gaussians,
) -> tuple[
    Float[np.ndarray, "g 3"],
    Float[np.ndarray, "g 4"],
    Float[np.ndarray, "g 3"],
    Float[np.ndarray, " g"],
    Float[np.ndarray, "g 3"],
]:
    """Means, unit quaternions (wxyz), scales, opacities and colors in float64, without deformations and without low-pass.

    Viewers add `EPS2D` pixels^2, as 3DGS does, where our renderer adds less to scales that contain a low-pass
    (`Gaussians.low_pass`). It is taken out, so that both draw the same in images of the size that the Gaussians were fitted to.

    Raises: ValueError for numbers that files cannot hold: not finite, or of more than `checks.LARGEST`.
    """
    bounded = {
        f"gaussians.{name}": (getattr(gaussians, name), BOUNDED) for name in ("means", "quats", "scales", "colors")
    }
    check_values("export", gaussian_values(gaussians))
    check_values("export", bounded)
    gaussians = replace(gaussians, scales=widened(gaussians.scales, gaussians.low_pass, -1), low_pass=None)
    if gaussians.deformations is not None:
        gaussians = factored(gaussians)
    means, quats, scales, opacities, colors = (
        np.asarray(x, np.float64)
        for x in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.colors)
    )
    norms = np.linalg.norm(quats, axis=-1, keepdims=True)
    unit = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0])
    return means, unit, scales, opacities, colors


def sh_of(colors: Float[np.ndarray, "*g 3"]) -> Float[np.ndarray, "*g 3"]:
    """Coefficients of the constant spherical harmonic: files of Gaussians hold rgb = 1/2 + Y00 f."""
    return (colors - 0.5) / SH_C0


def linear_of(colors: Float[np.ndarray, "*g 3"]) -> Float[np.ndarray, "*g 3"]:
    """Linear colors in [0, 1] of sRGB-encoded ones (IEC 61966-2-1)."""
    encoded = np.clip(colors, 0, 1)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
