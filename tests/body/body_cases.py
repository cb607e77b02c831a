"""Small made-up bodies, and a body model written independently of the package's."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.model import BodyModel

PARENTS = (-1, 0, 5, 0, 3, 0, 2)  # joint 2's parent has a higher index


def made_up_body(seed=0, n=25, s=4, pose_directions=True, dtype=None):
    """Returns a body of random numbers that has the invariants of a body, but no plausible shape.

    A dtype of None stands for that of `jax.enable_x64`.
    """
    rng = np.random.default_rng(seed)
    j = len(PARENTS)
    weights = rng.uniform(size=(n, j)) ** 3
    regressor = rng.uniform(size=(j, n)) ** 3
    number = lambda x: jnp.asarray(x, dtype)
    return BodyModel(
        template=number(rng.normal(size=(n, 3))),
        shape_directions=number(0.1 * rng.normal(size=(n, 3, s))),
        pose_directions=number(0.1 * rng.normal(size=(n, 3, 9 * (j - 1))))
        if pose_directions
        else None,
        joint_regressor=number(regressor / regressor.sum(1, keepdims=True)),
        skinning_weights=number(weights / weights.sum(1, keepdims=True)),
        faces=jnp.asarray(rng.integers(0, n, size=(10, 3)), jnp.int32),
        parents=PARENTS,
    )


def random_pose(seed, joints=len(PARENTS)):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(joints, 3)), rng.normal(size=3)


def world_frames(joints, parents, rotations):
    """Returns the 4x4 frame of each joint, multiplied up to the root one joint at a time."""
    frames = []
    for j in range(len(parents)):
        frame, joint = np.eye(4), j
        while joint >= 0:
            parent = parents[joint]
            local = np.eye(4)
            local[:3, :3] = Rotation.from_rotvec(rotations[joint]).as_matrix()
            local[:3, 3] = joints[joint] - (joints[parent] if parent >= 0 else 0)
            frame, joint = local @ frame, parent
        frames.append(frame)
    return frames


def oracle(body, betas, rotations, translation):
    """Returns vertices, joints and joint transforms in float64, computed one by one."""
    get = lambda name: np.asarray(getattr(body, name), np.float64)
    rest = get("template").copy()
    for i, beta in enumerate(betas):
        rest += beta * get("shape_directions")[:, :, i]
    joints = np.stack(
        [sum(w * v for w, v in zip(row, rest, strict=True)) for row in get("joint_regressor")]
    )
    if body.pose_directions is not None:
        feature = np.concatenate(
            [(Rotation.from_rotvec(r).as_matrix() - np.eye(3)).ravel() for r in rotations[1:]]
        )
        rest = rest + np.stack([d @ feature for d in get("pose_directions")])
    # from the rest pose to the world: the rest joint is moved to 0 first
    transforms = []
    for frame, joint in zip(world_frames(joints, body.parents, rotations), joints, strict=True):
        to_joint = np.eye(4)
        to_joint[:3, 3] = -joint
        moved = frame @ to_joint
        moved[:3, 3] += translation
        transforms.append(moved)
    vertices = []
    for weights, vertex in zip(get("skinning_weights"), rest, strict=True):
        vertices.append(
            sum(
                w * (g[:3, :3] @ vertex + g[:3, 3])
                for w, g in zip(weights, transforms, strict=True)
            )
        )
    posed_joints = [g[:3, :3] @ j + g[:3, 3] for g, j in zip(transforms, joints, strict=True)]
    return np.stack(vertices), np.stack(posed_joints), np.stack(transforms)


def edge_counts(faces):
    """Returns how often each directed edge occurs."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return {
        tuple(edge): count
        for edge, count in zip(*np.unique(edges, axis=0, return_counts=True), strict=True)
    }


def is_closed(faces):
    """Returns whether every directed edge occurs once, and so does its opposite.

    Such a surface is watertight and has one orientation.
    """
    counts = edge_counts(faces)
    return set(counts.values()) == {1} and all((int(b), int(a)) in counts for a, b in counts)


def signed_volume(vertices, faces):
    a, b, c = (np.asarray(vertices, np.float64)[np.asarray(faces)[:, i]] for i in range(3))
    return np.sum(a * np.cross(b, c)) / 6


def areas(vertices, faces):
    a, b, c = (np.asarray(vertices, np.float64)[np.asarray(faces)[:, i]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
