"""Poses on the device: between two poses of a person's own that are alike; skinning by a few joints per vertex."""

import jax.numpy as jnp

from humangs_jax.body.skinning import joint_transforms
from humangs_jax.core.array_types import Array, Float, Int, UInt8
from humangs_jax.geometry import quaternion
from humangs_jax.people.live_bank import PeopleBank

MIXING = 0.5
"""Farthest that a pose is moved towards the nearest one: everything between the two is then reached from one of them."""


def rotations_from(u: Float[Array, "2"], bank: PeopleBank, person: Int[Array, ""]) -> Float[Array, "j 3"]:
    """(j, 3) rotation vectors of a pose of a person; u in [0, 1) says which and how far on the way to the next."""
    pose = pick(u[0], bank.rotations.shape[1])
    other = bank.nearest[person, pose]
    return between(bank.rotations[person, pose], bank.rotations[person, other], MIXING * u[1])


def pick(u: Float[Array, "*b"], count: Int[Array, ""] | int) -> Int[Array, "*b"]:
    """One of the numbers 0 .. count - 1 for each u in [0, 1)."""
    return jnp.minimum((u * count).astype(jnp.int32), count - 1)


def between(a: Float[Array, "j 3"], b: Float[Array, "j 3"], amount: Float[Array, ""] | float) -> Float[Array, "j 3"]:
    """Rotation vectors on the shortest way from a (amount 0) to b (amount 1), joint by joint (slerp)."""
    p, q = quaternion.from_axis_angle(a), quaternion.from_axis_angle(b)
    cosine = jnp.sum(p * q, -1, keepdims=True)
    q = jnp.where(cosine < 0, -q, q)
    angle = jnp.arccos(jnp.clip(jnp.abs(cosine), 0, 1))
    near = angle < 1e-3
    sine = jnp.where(near, 1.0, jnp.sin(angle))
    mixed = (
        jnp.where(near, 1 - amount, jnp.sin((1 - amount) * angle) / sine) * p
        + jnp.where(near, amount, jnp.sin(amount * angle) / sine) * q
    )
    mixed = jnp.where(mixed[:, :1] < 0, -mixed, mixed)
    length = jnp.sqrt(jnp.sum(mixed[:, 1:] ** 2, -1, keepdims=True))
    turn = 2 * jnp.arctan2(length, mixed[:, :1])
    return mixed[:, 1:] * jnp.where(length < 1e-6, 2.0, turn / jnp.where(length < 1e-6, 1.0, length))


def pose_person(
    bank: PeopleBank, person: Int[Array, ""], rotations: Float[Array, "j 3"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"], Float[Array, "3"]]:
    """Vertices (n, 3) of a person who stands on y = 0 in a pose, unit normals (n, 3), and the translation (3,)."""
    nowhere = jnp.zeros(3, rotations.dtype)
    transforms = joint_transforms(bank.joints[person], bank.parents, rotations, nowhere)[:, :3].reshape(-1, 12)
    blended = _blend(transforms, bank.joint_ids[person], bank.joint_weights[person].astype(rotations.dtype))
    x, y, z = jnp.split(bank.vertices[person], 3, axis=-1)
    nx, ny, nz = jnp.split(bank.normals[person].astype(rotations.dtype), 3, axis=-1)
    # written out: matrix products are of low precision on GPU and TPU
    vertices = blended[:, 0::4] * x + blended[:, 1::4] * y + blended[:, 2::4] * z + blended[:, 3::4]
    normals = blended[:, 0::4] * nx + blended[:, 1::4] * ny + blended[:, 2::4] * nz
    translation = nowhere.at[1].set(-vertices[:, 1].min())
    return vertices + translation, normals / (jnp.linalg.norm(normals, axis=-1, keepdims=True) + 1e-9), translation


def _blend(transforms: Float[Array, "j 12"], ids: UInt8[Array, "n k"], weights: Float[Array, "n k"]):
    """(n, 12) rows of the vertices' blended transforms. Weights are stored in few bits: their sum is made 1 again."""
    weights = weights / weights.sum(-1, keepdims=True)
    return sum(weights[:, i : i + 1] * transforms[ids[:, i].astype(jnp.int32)] for i in range(ids.shape[1]))
