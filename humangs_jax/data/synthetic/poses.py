"""A pose prior: plausible standing, walking and reaching people, within joint limits.

Joints in SMPL-X order, T-pose at rest, the person faces +z with the left side at +x. Angles in radians, about the axes of the
parent joint at rest. Legs are drawn from a few gaits. Each arm draws many candidates within its limits and keeps the one
whose wrist comes nearest to a goal (hanging, on the hip, waving, ...) among those that stay clear of the body.
"""

import dataclasses

import numpy as np

from humangs_jax.array_types import Float

PELVIS, LEFT_HIP, RIGHT_HIP, SPINE1, LEFT_KNEE, RIGHT_KNEE, SPINE2, LEFT_ANKLE, RIGHT_ANKLE, SPINE3 = range(10)
LEFT_FOOT, RIGHT_FOOT, NECK, LEFT_COLLAR, RIGHT_COLLAR, HEAD = range(10, 16)
LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW, RIGHT_ELBOW, LEFT_WRIST, RIGHT_WRIST = range(16, 22)
LEFT_HAND, RIGHT_HAND, JOINTS = 25, 40, 55

LIMITS = {
    PELVIS: 1.0,
    LEFT_HIP: 1.4,
    RIGHT_HIP: 1.4,
    SPINE1: 0.35,
    SPINE2: 0.35,
    SPINE3: 0.35,
    LEFT_KNEE: 1.6,
    RIGHT_KNEE: 1.6,
    LEFT_ANKLE: 0.7,
    RIGHT_ANKLE: 0.7,
    LEFT_FOOT: 0.6,
    RIGHT_FOOT: 0.6,
    NECK: 0.5,
    HEAD: 0.5,
    LEFT_COLLAR: 0.35,
    RIGHT_COLLAR: 0.35,
    LEFT_SHOULDER: 2.3,
    RIGHT_SHOULDER: 2.3,
    LEFT_ELBOW: 2.4,
    RIGHT_ELBOW: 2.4,
    LEFT_WRIST: 0.6,
    RIGHT_WRIST: 0.6,
}
"""Largest rotation angle of a joint that the prior may draw; fingers: FINGER_LIMIT; jaw and eyes stay at rest."""

FINGER_LIMIT = 1.2
ARM_CANDIDATES = 400
MIRROR = np.asarray([1.0, -1.0, -1.0])
"""The rotation vector of the mirrored rotation (left and right exchanged)."""

GOALS = {
    "hang": (0.42, (0.28, -1.0, 0.1)),
    "away": (0.2, (0.6, -0.85, 0.08)),
    "hip": (0.1, (0.35, -0.82, 0.12)),
    "front": (0.1, (0.2, -0.3, 0.8)),
    "chest": (0.05, (-0.2, -0.4, 0.45)),
    "wave": (0.06, (0.55, 0.45, 0.25)),
    "side": (0.04, (1.0, -0.1, 0.1)),
    "up": (0.03, (0.25, 1.0, 0.1)),
}
"""Arm goals: probability, and where the wrist should be relative to the shoulder in arm lengths (left arm)."""


RAISE = {"hang": (-1.5, -1.05), "away": (-1.3, -0.7), "wave": (-1.45, 1.25), "up": (-0.5, 1.25), "side": (-0.4, 0.4)}
"""Range of the upper arm's elevation for some goals (0: horizontal)."""


@dataclasses.dataclass(frozen=True)
class Build:
    """What the prior must know of a body: rest joints (j, 3), parents, and radii in metres of its clothed parts."""

    joints: Float[np.ndarray, "j 3"]
    parents: tuple[int, ...]
    torso_radius: float
    thigh_radius: float
    shin_radius: float
    arm_radius: float


def rotation_matrix(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Rodrigues' formula for rotation vectors (..., 3)."""
    angle = np.sqrt(np.sum(vectors * vectors, axis=-1))[..., None, None]
    x, y, z = np.moveaxis(vectors / np.maximum(angle[..., 0], 1e-9), -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def rotation_vector(matrix: Float[np.ndarray, "*n 3 3"]) -> Float[np.ndarray, "*n 3"]:
    """The rotation vector of (..., 3, 3) rotations by less than pi."""
    angle = np.arccos(np.clip((np.trace(matrix, axis1=-2, axis2=-1) - 1) / 2, -1, 1))[..., None]
    pairs = [(2, 1), (0, 2), (1, 0)]
    axis = np.stack([matrix[..., i, j] - matrix[..., j, i] for i, j in pairs], -1)
    return axis * np.where(angle < 1e-4, 0.5, angle / np.maximum(2 * np.sin(angle), 1e-9))


def joint_positions(
    build: Build, rotations: Float[np.ndarray, "j 3"]
) -> tuple[Float[np.ndarray, "j 3 3"], Float[np.ndarray, "j 3"]]:
    """World rotations (j, 3, 3) and positions (j, 3) of all joints for rotation vectors (j, 3)."""
    local = rotation_matrix(rotations)
    world, positions = np.empty_like(local), np.empty_like(build.joints, dtype=np.float64)
    for j, parent in enumerate(build.parents):
        if parent < 0:
            world[j], positions[j] = local[j], build.joints[j]
        else:
            world[j] = world[parent] @ local[j]
            positions[j] = positions[parent] + world[parent] @ (build.joints[j] - build.joints[parent])
    return world, positions


def sample_rotations(rng: np.random.Generator, build: Build) -> Float[np.ndarray, "j 3"]:
    """(j, 3) rotation vectors of a random plausible pose."""
    rotations = np.zeros((JOINTS, 3))
    rotations[PELVIS] = [rng.normal(0, 0.03), rng.uniform(-0.7, 0.7), 0.0]
    _bend_legs(rng, rotations)
    _bend_trunk(rng, rotations)
    both = rng.random() < 0.45
    goal = _draw_goal(rng)
    for side in (1, -1):
        _bend_arm(rng, build, rotations, goal if both else _draw_goal(rng), side)
        _curl_fingers(rng, rotations, side)
    return limited(rotations)


def limited(rotations: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "j 3"]:
    """Rotation vectors (j, 3) shortened to the limits of their joints."""
    limit = np.zeros(JOINTS)
    limit[list(LIMITS)] = list(LIMITS.values())
    limit[LEFT_HAND:] = FINGER_LIMIT
    angle = np.linalg.norm(rotations, axis=1)
    return rotations * np.minimum(1, limit / np.maximum(angle, 1e-9))[:, None]


def _bend_legs(rng, rotations):
    gait = rng.choice(["stand", "contrapposto", "walk", "wide", "squat", "lunge"], p=[0.34, 0.2, 0.24, 0.1, 0.06, 0.06])
    spread = rng.uniform(-0.035, 0.06)
    flexion, knee = np.zeros(2), np.zeros(2)  # left, right: thigh forward, shin backward
    if gait == "contrapposto":
        relaxed = rng.integers(2)
        flexion[relaxed], knee[relaxed] = rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.5)
    elif gait == "walk":
        stride, phase = rng.uniform(0.15, 0.5), rng.choice([-1, 1])
        flexion = stride * np.asarray([phase, -phase]) * rng.uniform(0.7, 1.0, 2)
        knee = np.where(flexion < 0, rng.uniform(0.1, 0.6, 2), rng.uniform(0.0, 0.25, 2))
    elif gait == "wide":
        spread = rng.uniform(0.14, 0.28)
    elif gait == "squat":
        depth = rng.uniform(0.2, 0.6)
        flexion, knee, spread = np.full(2, depth), np.full(2, 1.8 * depth), rng.uniform(0.1, 0.2)
    elif gait == "lunge":
        phase = rng.permutation([1.0, -1.0])
        flexion = np.where(phase > 0, rng.uniform(0.6, 0.9), -rng.uniform(0.2, 0.45))
        knee = np.where(phase > 0, rng.uniform(0.6, 0.9), rng.uniform(0.2, 0.5))
    flexion, knee = flexion + np.abs(rng.normal(0, 0.03, 2)), knee + np.abs(rng.normal(0, 0.05, 2))
    for side, hip, shin, ankle in ((1, LEFT_HIP, LEFT_KNEE, LEFT_ANKLE), (-1, RIGHT_HIP, RIGHT_KNEE, RIGHT_ANKLE)):
        i = 0 if side > 0 else 1
        turn_out = rng.uniform(-0.02, 0.22) * side
        thigh = rotation_matrix(np.asarray([0, 0, side * spread])) @ rotation_matrix(np.asarray([-flexion[i], 0, 0]))
        rotations[hip] = rotation_vector(thigh @ rotation_matrix(np.asarray([0, turn_out, 0])))
        rotations[shin] = [knee[i], 0, 0]
        pitch = flexion[i] - knee[i]  # what keeps the sole level
        rotations[ankle] = [np.clip(pitch, -0.5, 0.5), 0, -side * 0.6 * spread]
        if pitch < -0.35:
            rotations[ankle + 3] = [np.clip(0.5 * (pitch + 0.35), -0.5, 0), 0, 0]  # toes bend on the ground


def _bend_trunk(rng, rotations):
    lean, side, turn = rng.normal(0.03, 0.08), rng.normal(0, 0.05), rng.normal(0, 0.12)
    for joint, share in ((SPINE1, 0.3), (SPINE2, 0.35), (SPINE3, 0.35)):
        rotations[joint] = np.asarray([lean, turn, side]) * share
    look = rng.normal(0, 1, 3) * [0.1, 0.25, 0.06]
    rotations[NECK], rotations[HEAD] = 0.45 * look - [0.4 * lean, 0, 0], 0.55 * look


def _draw_goal(rng):
    names = list(GOALS)
    return names[rng.choice(len(names), p=[GOALS[name][0] for name in names])]


def _bend_arm(rng, build, rotations, goal, side):
    """Sets collar, shoulder, elbow and wrist of one side (1 left, -1 right)."""
    collar, shoulder, elbow, wrist = (LEFT_COLLAR, LEFT_SHOULDER, LEFT_ELBOW, LEFT_WRIST) if side > 0 else (
        RIGHT_COLLAR, RIGHT_SHOULDER, RIGHT_ELBOW, RIGHT_WRIST)  # fmt: skip
    mirror = np.ones(3) if side > 0 else MIRROR
    n = ARM_CANDIDATES
    raised = {"wave": 0.15, "up": 0.3, "side": 0.05}.get(goal, -0.08)
    rotations[collar] = np.asarray([0, rng.normal(-0.03, 0.03), raised + rng.normal(0, 0.03)]) * mirror
    down = np.zeros((n, 3))
    down[:, 2] = rng.uniform(*RAISE.get(goal, (-1.45, -0.1)), n)
    forward, twist, flex = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    forward[:, 1] = -rng.uniform(-0.5, 1.4, n) if goal != "hang" else -rng.uniform(-0.25, 0.35, n)
    twist[:, 0] = rng.uniform(-1.0, 0.8, n)
    flex[:, 1] = -rng.uniform(0.05, 2.2, n) if goal not in ("hang", "away") else -rng.uniform(0.05, 0.6, n)
    swing = rotation_matrix(forward) @ rotation_matrix(down) if goal != "hang" else rotation_matrix(
        np.stack([forward[:, 1], down[:, 1], down[:, 2]], 1))  # fmt: skip
    upper = rotation_vector(swing @ rotation_matrix(twist)) * mirror
    lower = flex * mirror
    world, positions = joint_positions(build, rotations)
    rest = build.joints
    upper_world = world[collar] @ rotation_matrix(upper)
    elbows = positions[shoulder] + upper_world @ (rest[elbow] - rest[shoulder])
    lower_world = upper_world @ rotation_matrix(lower)
    wrists = elbows + lower_world @ (rest[wrist] - rest[elbow])
    tips = elbows + lower_world @ ((rest[wrist] - rest[elbow]) * 1.6)
    reach = np.linalg.norm(rest[elbow] - rest[shoulder]) + np.linalg.norm(rest[wrist] - rest[elbow])
    offset = np.asarray(GOALS[goal][1]) * [side, 1, 1] + rng.normal(0, 0.08, 3)
    target = positions[shoulder] + reach * world[SPINE3] @ offset
    clearance = np.min([_clearance(build, positions, world, points) for points in _along(elbows, wrists, tips)], axis=0)
    excess = np.maximum(np.linalg.norm(upper, axis=1) - LIMITS[shoulder], 0)
    cost = np.linalg.norm(wrists - target, axis=1) + 20 * np.maximum(0.015 - clearance, 0) + 5 * excess
    best = int(np.argmin(cost))
    rotations[shoulder], rotations[elbow] = upper[best], lower[best]
    rotations[wrist] = rng.normal(0, 0.12, 3)


def _along(elbows, wrists, tips):
    """Points of the forearm and the hand that must not touch the body."""
    return [elbows, 0.5 * (elbows + wrists), wrists, 0.5 * (wrists + tips), tips]


def _clearance(build, positions, world, points):
    """Distance of points (n, 3) from the trunk, the head and the legs, less the radii (metres)."""
    sideways = 0.25 * (positions[LEFT_HIP] - positions[RIGHT_HIP])
    top = positions[NECK] + world[SPINE3] @ np.asarray([0, -0.06, 0])
    head = positions[HEAD] + world[HEAD] @ np.asarray([0, 0.09, 0.03])
    capsules = [
        (positions[PELVIS] + s * sideways, top + s * 0.8 * sideways, build.torso_radius) for s in (-1.0, 0.0, 1.0)
    ] + [
        (positions[LEFT_HIP], positions[LEFT_KNEE], build.thigh_radius),
        (positions[RIGHT_HIP], positions[RIGHT_KNEE], build.thigh_radius),
        (positions[LEFT_KNEE], positions[LEFT_ANKLE], build.shin_radius),
        (positions[RIGHT_KNEE], positions[RIGHT_ANKLE], build.shin_radius),
        (head, head, 0.14),
    ]
    distances = []
    for a, b, radius in capsules:
        axis = b - a
        t = np.clip((points - a) @ axis / max(axis @ axis, 1e-9), 0, 1)
        distances.append(np.linalg.norm(points - a - t[:, None] * axis, axis=1) - radius)
    return np.min(distances, axis=0) - build.arm_radius


def _curl_fingers(rng, rotations, side):
    first = LEFT_HAND if side > 0 else RIGHT_HAND
    mirror = np.ones(3) if side > 0 else MIRROR
    curl = rng.uniform(0.05, 0.55)
    for finger in range(4):  # index, middle, pinky, ring
        for bone in range(3):
            bend = curl * rng.uniform(0.8, 1.2) * (0.8, 1.0, 0.8)[bone]
            rotations[first + 3 * finger + bone] = np.asarray([0, 0, -bend]) * mirror
    rotations[first + 12] = np.asarray([0.1, -0.25 * curl, -0.15]) * mirror
