"""An avatar and a motion in 16-bit arrays, for the page that draws them: one header (JSON) and one block of bytes.

=================  ===================  ========================================================================
array              type, shape          meaning
=================  ===================  ========================================================================
means              uint16 (g, 3)        from `low` to `high` of the header, per axis, metres
scales             uint16 (g, 3)        log of the standard deviations in metres, from `low` to `high`
quats              int16 (g, 4)         unit quaternions wxyz times 32767
opacities          uint16 (g,)          [0, 1]
colors             uint16 (g, 3)        from `low` to `high` ([0, 1] unless colors lie outside of it)
weights            uint16 (g, 8)        skinning weights, the largest first; every row sums to 65535
weight_joints      uint8 (g, 8)         their joints
light_normals      int8 (g, 3)          times 127
light_shading      uint16 (g,)          from `low` to `high` of the header
rest_joints        float32 (j, 3)       metres
rotations          int16 (m, j, 3)      motion: axis-angle, times `step` of the header, radians
translations       float32 (m, 3)       motion: metres
shape_directions   int16 (s, n, 3)      how vertices move per unit of a shape coefficient, times `step`, metres
shape_joints       float32 (s, j, 3)    how joints move per unit of a shape coefficient, metres
=================  ===================  ========================================================================

Little-endian; every array starts at a multiple of 4 bytes. Those of the light are there if the avatar has one, with its `light`
in the header; the last two if the body is known.
"""

import dataclasses
from typing import Any

import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.light import light_values
from humangs_jax.body.model import BodyModel
from humangs_jax.core.array_types import Float, Int
from humangs_jax.core.checks import FINITE, check_values
from humangs_jax.data.motion import Motion
from humangs_jax.rendering.gaussians import added_variance, gaussian_values
from humangs_jax.rendering.splat_config import SPLAT_PRESETS

VERSION = 1
WEIGHTS = 8
"""Skinning weights kept of each Gaussian. The shipped body has at most 7; leaving out the eighth costs nothing there."""
STEPS = 65535
SMALLEST_SCALE = 1e-7
"""Metres; keeps the logarithm finite for flat Gaussians. A thousandth of eps2d for a camera at any distance."""
SMALLEST_RANGE = 1e-6
"""Of quantized values: keeps the division finite where all are the same."""
SHAPE_STEP = 1e-4
"""Metres."""
SHAPE_TOLERANCE = 1e-3
"""Metres; a body explains an avatar if its vertices, in the shape that fits best, are this near (root mean square)."""
DRAWN_FIELDS = ("near", "alpha_min", "alpha_max", "jacobian_margin")


@dataclasses.dataclass
class Packed:
    """header: what JSON holds. data: the arrays, one after the other."""

    header: dict[str, Any]
    data: bytes


def pack(
    avatar: Avatar, motion: Motion | None = None, body: BodyModel | None = None, motion_name: str = "motion"
) -> Packed:
    """What the page holds of an avatar.

    Arguments: motion: of the avatar's joints. body: the model that the avatar's vertices are of, for sliders of its shape.

    Raises: ValueError, one line, for numbers that are not finite or out of range, a motion of other joints, or a body that
    does not explain the avatar's vertices.
    """
    check_values(
        "the page", gaussian_values(avatar.gaussians) | light_values(avatar.light) | _other_values(avatar, motion)
    )
    joints = len(avatar.parents)
    if joints > 256:
        raise ValueError(f"the page draws avatars of up to 256 joints, got {joints}")
    for what, count in (("Gaussians", len(avatar.gaussians.means)), ("vertices", len(avatar.rest_vertices))):
        if not count:
            raise ValueError(f"the page: the avatar has no {what}")
    if motion is not None and motion.rotations.shape[1] != joints:
        raise ValueError(f"the motion has {motion.rotations.shape[1]} joints, the avatar has {joints}")
    how = SPLAT_PRESETS[avatar.rendering]
    vertices = np.asarray(avatar.rest_vertices, np.float64)
    header: dict[str, Any] = {
        "version": VERSION,
        "count": len(avatar.gaussians.means),
        "parents": avatar.parents,
        "joint_names": avatar.joint_names,
        "skinning": avatar.skinning,
        "splatting": {name: getattr(how, name) for name in DRAWN_FIELDS}
        | {"eps2d": added_variance(avatar.gaussians, how.eps2d), "low_pass": _low_pass(avatar)},
        "rest_bounds": [vertices.min(0).tolist(), vertices.max(0).tolist()],
    }
    arrays: dict[str, np.ndarray] = {}
    _pack_gaussians(avatar, header, arrays)
    if motion is not None:
        rotations = np.asarray(motion.rotations, np.float64)
        step = max(float(np.abs(rotations).max()), SMALLEST_RANGE) / 32767
        arrays["rotations"] = np.rint(rotations / step).astype("<i2")
        arrays["translations"] = np.asarray(motion.translations, "<f4")
        header["motion"] = {"name": motion_name, "frames": len(rotations), "fps": float(motion.fps), "step": step}
    if body is not None:
        _pack_shape(avatar, body, header, arrays)
    return _joined(header, arrays)


def unpack(packed: Packed) -> dict[str, np.ndarray]:
    """The arrays by name, as the page reads them."""
    entries = packed.header["arrays"].items()
    read = lambda e: np.frombuffer(packed.data, e["type"], int(np.prod(e["shape"])), e["offset"]).reshape(e["shape"])
    return {name: read(entry) for name, entry in entries}


def _low_pass(avatar):
    """Metres; one for all Gaussians, whose photos were taken from similar distances. 0: none."""
    return 0.0 if avatar.gaussians.low_pass is None else float(np.median(avatar.gaussians.low_pass))


def largest_weights(weights: Float[np.ndarray, "g j"]) -> tuple[Int[np.ndarray, "g 8"], Int[np.ndarray, "g 8"]]:
    """Joints and weights of the 8 largest of each row, largest first; 65535 is a weight of 1, and rows sum to it.

    What is left out is given to the others in proportion; what rounding leaves, to the largest.
    """
    weights = np.pad(np.asarray(weights, np.float64), ((0, 0), (0, max(0, WEIGHTS - weights.shape[1]))))
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :WEIGHTS]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept /= kept.sum(1, keepdims=True)
    whole = np.rint(kept * STEPS).astype(np.int64)
    whole[:, 0] += STEPS - whole.sum(1)
    joints[whole == 0] = 0  # columns beyond the last joint among them
    return joints, whole


def fitted_shape(avatar: Avatar, body: BodyModel) -> Float[np.ndarray, " s"] | None:
    """The shape coefficients of `body` with which it has the avatar's vertices; None if it cannot have them."""
    target = np.asarray(avatar.rest_vertices, np.float64)
    if body.template.shape != target.shape or len(body.parents) != len(avatar.parents):
        return None
    directions = np.asarray(body.shape_directions, np.float64).reshape(target.size, -1)
    offsets = (target - np.asarray(body.template, np.float64)).reshape(-1)
    betas = np.linalg.lstsq(directions, offsets, rcond=None)[0]
    error = np.sqrt(np.mean(np.square(directions @ betas - offsets)))
    return betas if error < SHAPE_TOLERANCE else None


def _other_values(avatar, motion):
    values = {name: (getattr(avatar, name), FINITE) for name in ("skinning_weights", "rest_vertices", "rest_joints")}
    if motion is not None:
        values |= {f"motion.{name}": (getattr(motion, name), FINITE) for name in ("rotations", "translations")}
    return values


def _pack_gaussians(avatar, header, arrays):
    g = avatar.gaussians
    means, quats, scales, opacities, colors = (
        np.asarray(x, np.float64) for x in (g.means, g.quats, g.scales, g.opacities, g.colors)
    )
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    quats = np.where(norms > 0, quats / np.where(norms > 0, norms, 1), [1.0, 0, 0, 0])
    logs = np.log(np.maximum(scales, SMALLEST_SCALE))
    header["means"], arrays["means"] = _quantized(means, means.min(0), means.max(0))
    header["scales"], arrays["scales"] = _quantized(logs, logs.min(), logs.max())
    header["colors"], arrays["colors"] = _quantized(colors, min(colors.min(), 0.0), max(colors.max(), 1.0))
    arrays["quats"] = np.rint(quats * 32767).astype("<i2")
    arrays["opacities"] = np.rint(opacities * STEPS).astype("<u2")
    joints, weights = largest_weights(np.asarray(avatar.skinning_weights))
    arrays["weights"], arrays["weight_joints"] = weights.astype("<u2"), joints.astype("u1")
    arrays["rest_joints"] = np.asarray(avatar.rest_joints, "<f4")
    if avatar.light is not None:
        header["light"] = np.asarray(avatar.light.coefficients, np.float64).tolist()
        arrays["light_normals"] = np.rint(127 * np.asarray(avatar.light.normals)).astype("i1")
        shading = np.asarray(avatar.light.shading, np.float64)
        header["light_shading"], arrays["light_shading"] = _quantized(shading, shading.min(), shading.max())


def _pack_shape(avatar, body, header, arrays):
    """Of every direction its offsets of the vertices; the Gaussians of a vertex move with it (they are vertex-major)."""
    betas = fitted_shape(avatar, body)
    vertices = len(avatar.rest_vertices)
    if betas is None or len(avatar.gaussians.means) % vertices:
        raise ValueError(f"the body '{body.name}' does not explain the avatar's vertices")
    directions = np.moveaxis(np.asarray(body.shape_directions, np.float64), -1, 0)
    step = max(SHAPE_STEP, float(np.abs(directions).max()) / 32767)
    arrays["shape_directions"] = np.rint(directions / step).astype("<i2")
    arrays["shape_joints"] = np.einsum("jn,sna->sja", np.asarray(body.joint_regressor, np.float64), directions).astype(
        "<f4"
    )
    names = body.shape_names or tuple(f"shape {i + 1}" for i in range(len(directions)))
    header["shape"] = {"names": names, "betas": betas.tolist(), "step": step}


def _quantized(values, low, high):
    low, high = np.asarray(low), np.maximum(high, np.asarray(low) + SMALLEST_RANGE)
    whole = np.rint((values - low) / (high - low) * STEPS).astype("<u2")
    return {"low": low.tolist(), "high": high.tolist()}, whole


def _joined(header, arrays) -> Packed:
    header["arrays"], parts, offset = {}, [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        data += bytes(-len(data) % 4)
        header["arrays"][name] = {"type": array.dtype.str, "shape": list(array.shape), "offset": offset}
        parts.append(data)
        offset += len(data)
    return Packed(header, b"".join(parts))
