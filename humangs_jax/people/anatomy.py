"""The shaped body for fitting clothes: template coordinates for cutting, limbs, silhouettes.

Cuts (hems, necklines, hairlines) and paint are given in TEMPLATE coordinates: the T-pose of the mean body in metres. A vertex
keeps them for every shape of the person, so one number fits all people. Draping uses the rest vertices of the person.
"""

import dataclasses
import functools

import numpy as np

from humangs_jax.people.kinematics import LEFT_ANKLE, LEFT_HIP, LEFT_KNEE, LEFT_SHOULDER, LEFT_WRIST
from humangs_jax.people.surfaces import Boundaries, Faces, Points, Surface, blurred, boundaries, vertex_normals

BODY_NAME, BODY_VERTICES = "makehuman", 13380
"""The body that the cuts below were measured on."""
WAIST, CROTCH, ANKLE, FLOOR = -0.2, -0.425, -1.159, -1.2285
ARM_HEIGHT, SHOULDER, WRIST = 0.096, 0.171, 0.651
"""Heights (y) of the trunk and legs, and distances from the middle (|x|) of the arms, in template coordinates."""
ARMHOLE = 0.185
"""Distance from the middle at which sleeves are sewn on."""
TRUNK_GIRTH, LEG_GIRTH, ARM_GIRTH = 0.16, 0.08, 0.06
"""Radii that turn angles around trunk, legs and arms into metres of cloth."""
SAME_GIRTH = 1e-4
"""Tolerance for comparing girths."""


@dataclasses.dataclass(frozen=True)
class Anatomy:
    """skin: the whole body at rest, with attributes `template` (n, 3), `normals` (n, 3), `cloth` (n, 4).

    joints: (j, 3) at rest. parents: of the joints. arm, leg: (n,) membership in [0, 1].
    trunk: silhouettes of trunk and thighs across y. legs, arms: silhouettes of the left and right limb, across y and across |x|.
    """

    skin: Surface
    joints: np.ndarray
    parents: tuple[int, ...]
    arm: np.ndarray
    leg: np.ndarray
    trunk: Boundaries
    hips_and_legs: Boundaries
    legs: tuple[Boundaries, Boundaries]
    arms: tuple[Boundaries, Boundaries]


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """0 at `low`, 1 at `high`, smooth between, constant beyond (either may be the larger one)."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def leg_membership(template: np.ndarray) -> np.ndarray:
    """(n,) 1 on the legs, 0 on the trunk, smooth across the hip."""
    return smoothstep(-CROTCH - 0.1, -CROTCH + 0.05, -template[:, 1])


def cloth_coordinates(template: np.ndarray) -> np.ndarray:
    """(n, 4) x, y, z around the axis of trunk or leg, and the girth radius that turns angles into metres.

    The angle atan2(x, z) is 0 in front. Arms go on as the trunk does; `sewn_coordinates` gives them their own.
    """
    x, y, z = template.T
    trunk = np.stack([x, y, z - 0.02, np.full_like(x, TRUNK_GIRTH)], -1)
    on_leg = leg_membership(template)[:, None]
    return (trunk * (1 - on_leg) + leg_coordinates(template) * on_leg).astype(np.float32)


def leg_coordinates(template: np.ndarray) -> np.ndarray:
    """(n, 4) cloth coordinates around the axis of the nearer leg, from the waist down: trousers, sewn along the middle."""
    x, y, z = template.T
    knee = np.interp(-y, [0.358, 0.764, 1.159], [0.101, 0.130, 0.137])
    leg = np.stack([x - np.where(x < 0, -1.0, 1.0) * knee, y, z + 0.01, np.full_like(x, LEG_GIRTH)], -1)
    return leg.astype(np.float32)


def sewn_coordinates(cloth: np.ndarray, template: np.ndarray) -> np.ndarray:
    """Cloth coordinates (n, 4) with those of arms and legs replaced by coordinates around the limb that the point is on.

    They are sharp at seams (armholes; the middle of trousers). Arms are turned down, so that y runs along every limb. Only cloth
    with the trunk's girth has sleeves, only cloth with the legs' girth has legs.
    """
    x, y, girth = template[:, 0], template[:, 1], cloth[:, 3]
    on_arm = (np.abs(x) > ARMHOLE) & (y > -0.15) & (np.abs(girth - TRUNK_GIRTH) < SAME_GIRTH)
    on_leg = (np.abs(girth - LEG_GIRTH) < SAME_GIRTH) & (y < -0.15) & (y > -1.3)
    result = np.array(cloth)
    result[on_leg] = leg_coordinates(template[on_leg])
    x, y, z = template[on_arm].T
    around = np.where(x < 0, -1.0, 1.0) * (y - ARM_HEIGHT)
    result[on_arm] = np.stack([around, ARM_HEIGHT - (np.abs(x) - SHOULDER), z, np.full_like(x, ARM_GIRTH)], -1)
    return result


@functools.lru_cache(maxsize=1)
def _fixed(template_bytes: bytes):
    template = np.frombuffer(template_bytes, np.float32).reshape(-1, 3)
    # 1 on the arms, 0 on the trunk, smooth across the shoulder seam
    arm = smoothstep(0.165, 0.23, np.abs(template[:, 0])) * smoothstep(-0.15, -0.05, template[:, 1])
    return template, cloth_coordinates(template), arm, leg_membership(template)


def measure(
    vertices: Points, joints: np.ndarray, template: Points, faces: Faces, weights: np.ndarray, parents: tuple
) -> Anatomy:
    """The `Anatomy` of a shaped body from its rest vertices (n, 3) and joints (j, 3)."""
    template, cloth, arm, leg = _fixed(np.ascontiguousarray(template, np.float32).tobytes())
    vertices = np.asarray(vertices, np.float32)
    attributes = {"template": template, "normals": vertex_normals(vertices, faces), "cloth": cloth}
    skin = Surface(vertices, faces, weights, attributes)
    levels, along = np.arange(-1.3, 0.5, 0.02), np.arange(0.05, 0.8, 0.02)
    body = (np.abs(template[:, 0]) < 0.19) & (template[:, 1] < 0.2)
    trunk_points = vertices[body & (template[:, 1] > -0.6)]
    spine = np.zeros((len(levels), 2))
    torso = boundaries(trunk_points[:, 1], trunk_points[:, [0, 2]], levels, spine, 0.025)
    lower = vertices[body & (template[:, 1] < WAIST + 0.03)]
    hips = boundaries(lower[:, 1], lower[:, [0, 2]], levels, spine, 0.025)
    legs, arms = [], []
    for offset, side in enumerate((1, -1)):
        line = joints[[LEFT_ANKLE + offset, LEFT_KNEE + offset, LEFT_HIP + offset]]
        centers = np.stack([np.interp(levels, line[:, 1], line[:, i]) for i in (0, 2)], -1)
        own = vertices[(template[:, 0] * side > 0.004) & (template[:, 1] < CROTCH + 0.1) & (template[:, 1] > -1.15)]
        legs.append(blurred(boundaries(own[:, 1], own[:, [0, 2]], levels, centers, 0.025)))
        line = joints[[LEFT_SHOULDER + offset, LEFT_WRIST + offset]]
        centers = np.stack([np.interp(along, np.abs(line[:, 0]), line[:, i]) for i in (1, 2)], -1)
        own = vertices[(template[:, 0] * side > 0.2) & (template[:, 1] > -0.05) & (np.abs(template[:, 0]) < 0.68)]
        arms.append(blurred(boundaries(np.abs(own[:, 0]), own[:, [1, 2]], along, centers, 0.025)))
    return Anatomy(skin, joints, parents, arm, leg, blurred(torso), blurred(hips), tuple(legs), tuple(arms))
