"""What refinement moves: cameras, focal lengths, shape and poses, as deviations from a start, each in standard deviations of
its prior.

The prior so is the square sum of the unknowns, and 0 is the start. It keeps the equations solvable: cameras and people that
move together look the same (a gauge), and pictures say little of twists of limbs.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np

from humangs_jax.body import skinning
from humangs_jax.body.model import BodyPose
from humangs_jax.core.array_types import Array, Float, Int
from humangs_jax.core.pytree import pytree_dataclass, replace, static_field
from humangs_jax.geometry import quaternion, transform
from humangs_jax.geometry.camera import Camera

SAME = 1e-4
"""Relative difference of focal lengths, and radians and metres of cameras, below which two are the same."""


@dataclasses.dataclass(frozen=True)
class Spreads:
    """How far the start is expected to be off, standard deviations.

    focal: share. turn, heading, bend: of cameras, of the root, and of each other joint, degrees, by axis. shift, place: of
    cameras and of the root, metres, by axis. shape: of coefficients. clothes: of the thickness of clothes and hair on each
    segment of the body, metres.
    """

    focal: float = 0.05
    turn: float = 2.0
    shift: float = 0.05
    heading: float = 3.0
    place: float = 0.05
    bend: float = 4.0
    shape: float = 0.3
    clothes: float = 0.03


@pytree_dataclass
class Unknowns:
    """Deviations of c cameras with g focal lengths, and of a person in m moments with a free joints; 0 is the start.

    turns, shifts: (c, 3). zooms: (g,). betas: (s,). headings, places: (m, 3). bends: (m, a, 3). clothes: (a + 1,) of the
    root and the free joints, see `thickness`.
    """

    turns: Float[Array, "c 3"]
    shifts: Float[Array, "c 3"]
    zooms: Float[Array, " g"]
    betas: Float[Array, " s"]
    headings: Float[Array, "m 3"]
    places: Float[Array, "m 3"]
    bends: Float[Array, "m a 3"]
    clothes: Float[Array, " b"]


@pytree_dataclass
class Start:
    """Where refinement starts. K, cam_from_world: of v views. camera, focal, frame: (v,) which camera, focal length and
    moment a view has. betas: (s,). poses: a batch of m. joints: (a,) the free ones besides the root. rest_joints: (j, 3) of
    the mean shape and joint_directions: (j, 3, s) their change, metres. segment: (j,) which number of `Unknowns.clothes`
    covers what a joint moves. parents: static.
    """

    K: Float[Array, "v 3 3"]
    cam_from_world: Float[Array, "v 4 4"]
    camera: Int[Array, " v"]
    focal: Int[Array, " v"]
    frame: Int[Array, " v"]
    betas: Float[Array, " s"]
    poses: BodyPose
    joints: Int[Array, " a"]
    rest_joints: Float[Array, "j 3"]
    joint_directions: Float[Array, "j 3 s"]
    segment: Int[Array, " j"]
    parents: tuple[int, ...] = static_field()


def same_cameras(cameras: Camera) -> Int[np.ndarray, " v"]:
    """(v,) the number of each view's camera: views whose K and cam_from_world are equal are of one camera that stood still."""
    K, matrices = np.asarray(cameras.K, float), np.asarray(cameras.cam_from_world, float)
    equal = lambda i, j: (
        np.allclose(K[i], K[j], rtol=SAME, atol=SAME) and np.allclose(matrices[i], matrices[j], rtol=0, atol=SAME)
    )
    return _numbered(len(K), equal)


def same_focals(cameras: Camera, camera: Int[np.ndarray, " v"], shared: bool) -> Int[np.ndarray, " v"]:
    """(v,) the number of each view's focal length: where they start equal they are one, if `shared`, else one a camera."""
    if not shared:
        return camera
    K = np.asarray(cameras.K, float)
    return _numbered(len(K), lambda i, j: np.allclose(K[i, [0, 1], [0, 1]], K[j, [0, 1], [0, 1]], rtol=SAME))


def _numbered(count, equal):
    """Numbers from 0 such that those that are equal to an earlier first one have its number."""
    firsts, numbers = [], []
    for i in range(count):
        found = next((k for k, first in enumerate(firsts) if equal(first, i)), len(firsts))
        firsts += [i] * (found == len(firsts))
        numbers.append(found)
    return np.asarray(numbers, np.int32)


def nothing_moved(start: Start) -> Unknowns:
    """The unknowns of the start."""
    m, a, cameras = len(start.poses.translation), len(start.joints), int(start.camera.max()) + 1
    return Unknowns(
        turns=jnp.zeros((cameras, 3)),
        shifts=jnp.zeros((cameras, 3)),
        zooms=jnp.zeros(int(start.focal.max()) + 1),
        betas=jnp.zeros(len(start.betas)),
        headings=jnp.zeros((m, 3)),
        places=jnp.zeros((m, 3)),
        bends=jnp.zeros((m, a, 3)),
        clothes=jnp.zeros(a + 1),
    )


def moved_cameras(
    start: Start, spreads: Spreads, unknowns: Unknowns
) -> tuple[Float[Array, "v 3 3"], Float[Array, "v 4 4"]]:
    """K and cam_from_world of every view: a camera turns about its own centre, in its own axes, and the centre moves."""
    turn = quaternion.matrix_from_axis_angle(jnp.radians(spreads.turn) * unknowns.turns[start.camera])
    center = transform.invert_rigid(start.cam_from_world)[:, :3, 3] + spreads.shift * unknowns.shifts[start.camera]
    rotation = jnp.matmul(turn, start.cam_from_world[:, :3, :3], precision=skinning.EXACT)
    translation = -jnp.einsum("vab,vb->va", rotation, center, precision=skinning.EXACT)
    zoom = jnp.exp(spreads.focal * unknowns.zooms)[start.focal]
    factors = jnp.stack([zoom, zoom, jnp.ones_like(zoom)], axis=-1)
    diagonal = jnp.eye(3) * factors[:, None]
    K = start.K * (diagonal + (1 - jnp.eye(3)))
    return K, transform.make(rotation, translation)


def moved_shape(start: Start, spreads: Spreads, unknowns: Unknowns) -> Float[Array, " s"]:
    """Shape coefficients."""
    return start.betas + spreads.shape * unknowns.betas


def segments(parents: tuple[int, ...], joints: Int[np.ndarray, " a"]) -> Int[np.ndarray, " j"]:
    """(j,) 0 for the root, 1 + i for joint `joints[i]`, and for others the number of the nearest of these above them."""
    number = {int(joint): i + 1 for i, joint in enumerate(joints)} | {parents.index(-1): 0}

    def of(joint):
        return number[joint] if joint in number else of(parents[joint])

    return np.asarray([of(j) for j in range(len(parents))], np.int32)


def thickness(start: Start, spreads: Spreads, unknowns: Unknowns, weights: Float[Array, "*p j"]) -> Float[Array, "*p"]:
    """Metres by which masks reach beyond the body, at points with these skinning weights."""
    return spreads.clothes * jnp.matmul(weights, unknowns.clothes[start.segment])


def moved_poses(start: Start, spreads: Spreads, unknowns: Unknowns) -> BodyPose:
    """The poses, a batch of m, but for the turns of the root: see `root_turns`."""
    bends = jnp.radians(spreads.bend) * unknowns.bends
    rotations = start.poses.rotations.at[:, start.joints].add(bends)
    return replace(
        start.poses, rotations=rotations, translation=start.poses.translation + spreads.place * unknowns.places
    )


def root_turns(
    start: Start, spreads: Spreads, unknowns: Unknowns, betas: Float[Array, " s"], poses: BodyPose
) -> tuple[Float[Array, "m 4 4"], Float[Array, "j 3"]]:
    """Rigid transforms that turn posed bodies about their pelvis, and the joints at rest.

    Kept apart from the poses, because a rotation vector near half a turn, as those of roots often are, is no measure of small
    turns.
    """
    rest = start.rest_joints + jnp.einsum("jas,s->ja", start.joint_directions, betas, precision=skinning.EXACT)
    turns = quaternion.matrix_from_axis_angle(jnp.radians(spreads.heading) * unknowns.headings)
    pelvis = rest[start.parents.index(-1)] + poses.translation
    moved = transform.make(turns, pelvis - jnp.einsum("mab,mb->ma", turns, pelvis, precision=skinning.EXACT))
    return moved, rest


def body_poses(start: Start, spreads: Spreads, unknowns: Unknowns) -> BodyPose:
    """The poses with the turns of the root in them, as bodies take them; not meant to be differentiated."""
    poses = moved_poses(start, spreads, unknowns)
    turns = quaternion.from_axis_angle(jnp.radians(spreads.heading) * unknowns.headings)
    root = quaternion.multiply(turns, quaternion.from_axis_angle(poses.rotations[:, 0]))
    return replace(poses, rotations=poses.rotations.at[:, 0].set(quaternion.to_axis_angle(root)))
