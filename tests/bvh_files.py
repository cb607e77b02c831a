"""Writes poses of our skeleton as BVH files in the conventions of several programs."""

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import FINGERS, JOINT_NAMES, PARENTS

INDEX = {name: i for i, name in enumerate(JOINT_NAMES)}
_LIMBS = {
    **{"collar": "Shoulder", "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand"},
    **{"hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase"},
}
CMU = {
    **{
        "pelvis": "Hips",
        "spine1": "LowerBack",
        "spine2": "Spine",
        "spine3": "Spine1",
        "neck": "Neck",
        "head": "Head",
    },
    **{
        f"{s}_{ours}": s.title() + theirs
        for s in ("left", "right")
        for ours, theirs in _LIMBS.items()
    },
}
_SPINE = {"spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2"}
LAFAN = CMU | _SPINE | {f"{s}_foot": f"{s.title()}Toe" for s in ("left", "right")}
MIXAMO = {ours: f"mixamorig:{theirs}" for ours, theirs in (CMU | _SPINE).items()}
MIXAMO |= {
    f"{s}_{finger}{i}": f"mixamorig:{s.title()}Hand{finger.title()}{i}"
    for s in ("left", "right")
    for finger in FINGERS
    for i in (1, 2, 3)
}
MIXAMO |= {"left_eye": "mixamorig:LeftEye", "right_eye": "mixamorig:RightEye"}
BONES = [
    *(
        ("pelvis", "spine1"),
        ("spine1", "spine2"),
        ("spine2", "spine3"),
        ("spine3", "neck"),
        ("neck", "head"),
    ),
    *(
        (f"{s}_{a}", f"{s}_{b}")
        for s in ("left", "right")
        for a, b in (
            *(("collar", "shoulder"), ("shoulder", "elbow"), ("elbow", "wrist")),
            *(("hip", "knee"), ("knee", "ankle"), ("ankle", "foot")),
        )
    ),
]


def rest_frames(arms_down=0.0, turned=0.0):
    """Returns the rotation from our rest axes to the file's, for each joint.

    Arms are lowered by `arms_down` and the world is turned about y by `turned`, degrees.
    """
    around, frames = Rotation.from_euler("y", turned, degrees=True), {}
    for name in JOINT_NAMES:
        arm = any(part in name for part in ("shoulder", "elbow", "wrist", *FINGERS))
        side = 1 if name.startswith("left") else -1
        frames[name] = around * Rotation.from_euler("z", -side * arms_down * arm, degrees=True)
    return frames


def frames_along_bones(rest, seed=0):
    """Returns LaFAN's rest axes: each bone lies along +x of its joint, with a random twist.

    Joints without a bone have the axes of their parent.
    """
    rng, frames = np.random.default_rng(seed), {}
    children = dict(BONES)
    for name in JOINT_NAMES:
        child, parent = children.get(name), PARENTS[INDEX[name]]
        if name == "pelvis":  # the spine along x, the hips along z
            up = rest[INDEX["spine3"]] - rest[0]
            left = rest[INDEX["left_hip"]] - rest[INDEX["right_hip"]]
            frames[name] = Rotation.align_vectors(
                [[1, 0, 0], [0, 0, 1]], [up, left], weights=[1e6, 1]
            )[0]
        elif child is None:
            frames[name] = frames[JOINT_NAMES[parent]]
        else:
            bone = rest[INDEX[child]] - rest[INDEX[name]]
            onto = Rotation.align_vectors([[1, 0, 0]], [bone])[0]
            frames[name] = Rotation.from_euler("x", rng.uniform(-180, 180), degrees=True) * onto
    return frames


def without_twist(rest, poses):
    """Returns poses (m, 55, 3) without the rotations of bones about their own axis."""
    poses = poses.copy()
    for a, b in BONES[1:]:
        bone = rest[INDEX[b]] - rest[INDEX[a]]
        bone /= np.linalg.norm(bone)
        poses[:, INDEX[a]] -= (poses[:, INDEX[a]] @ bone)[:, None] * bone
    return poses


def places_of(rest, poses, moves):
    """Returns places (m, 55, 3) of the joints; `moves` (m, 3) are those of the pelvis."""
    world, places = {}, {}
    for j, parent in enumerate(PARENTS):
        own = Rotation.from_rotvec(poses[:, j])
        world[j] = own if parent < 0 else world[parent] * own
        places[j] = (
            moves if parent < 0 else places[parent] + world[parent].apply(rest[j] - rest[parent])
        )
    return np.stack([places[j] for j in range(len(PARENTS))], axis=1)


def bone_directions(places):
    bones = np.stack([places[:, INDEX[b]] - places[:, INDEX[a]] for a, b in BONES], axis=1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def write_bvh(
    rest, poses, names, frames_of=None, moves=None, order="ZYX", unit=100.0, up=None, pelvis=None
):
    """The text of a BVH file of a body with the joints `rest` (55, 3) in T-pose, in centimetres.

    Args:
        rest: joints (55, 3), metres.
        poses: axis-angle rotations (m, 55, 3).
        names: the file's name for each of our joints; joints without a name are left out.
        frames_of: the rotation of each joint's axes at rest, by default of `rest_frames`.
        moves: places (m, 3) of the pelvis, metres.
        order: the axes of the Euler angles.
        unit: lengths of the file in a metre.
        up: a rotation of the whole world.
        pelvis: m further turns of the pelvis's joint. They are undone by its children that lie at
            its place, and for the other children by a joint in between, `Carrier` and a number.
    """
    frames_of = frames_of or rest_frames()
    moves = np.tile([0.1, 0.9, -0.2], (len(poses), 1)) if moves is None else moves
    up = up or Rotation.identity()
    body = [name for name in JOINT_NAMES if name in names]
    above = {name: JOINT_NAMES[PARENTS[INDEX[name]]] for name in body[1:]}
    children = {name: [other for other in body[1:] if above[other] == name] for name in body}
    written: list = []
    carried: set = set()

    def lines(name, depth):
        written.append(name)
        tab = "\t" * depth
        offset = np.zeros(3)
        if name in above:
            offset = (up * frames_of[above[name]]).apply(
                rest[INDEX[name]] - rest[INDEX[above[name]]]
            )
        move = "3" if name in above else "6 Xposition Yposition Zposition"
        yield f"{tab}{'JOINT' if name in above else 'ROOT'} {names[name]}"
        yield f"{tab}{{"
        yield f"{tab}\tOFFSET {' '.join(f'{unit * x:.8f}' for x in offset)}"
        yield f"{tab}\tCHANNELS {move} {' '.join(f'{axis}rotation' for axis in order)}"
        for child in children[name]:
            # a child elsewhere than the pelvis hangs on a joint that undoes the turn
            if (
                name not in above
                and pelvis is not None
                and np.any(rest[INDEX[child]] != rest[INDEX[name]])
            ):
                carried.add(child)
                written.append(None)
                yield f"{tab}\tJOINT Carrier{len(written)}\n{tab}\t{{\n{tab}\tOFFSET 0 0 0"
                yield f"{tab}\tCHANNELS 3 {' '.join(f'{axis}rotation' for axis in order)}"
                yield from lines(child, depth + 2)
                yield f"{tab}\t}}"
            else:
                yield from lines(child, depth + 1)
        if not children[name]:
            yield f"{tab}\tEnd Site\n{tab}\t{{\n{tab}\t\tOFFSET 0 1 0\n{tab}\t}}"
        yield f"{tab}}}"

    text = [
        "HIERARCHY",
        *lines("pelvis", 0),
        "MOTION",
        f"Frames: {len(poses)}",
        "Frame Time: 0.0083333",
    ]
    # numbers of a frame in the order of the joints above
    for frame, (pose, move) in enumerate(zip(poses, moves, strict=True)):
        world, numbers = {}, list(unit * up.apply(move))
        for name in written:
            if name is None:
                numbers += list(pelvis[frame].inv().as_euler(order, degrees=True))
                continue
            own = Rotation.from_rotvec(pose[INDEX[name]])
            world[name] = own if name not in above else world[above[name]] * own
            # the joint's turn from the file's rest frame, then from its parent's
            theirs = up * world[name] * (up * frames_of[name]).inv()
            if name in above:
                holder = up * world[above[name]] * (up * frames_of[above[name]]).inv()
                if pelvis is not None and above[name] not in above and name not in carried:
                    holder = holder * pelvis[frame]
                theirs = holder.inv() * theirs
            elif pelvis is not None:
                theirs = theirs * pelvis[frame]
            numbers += list(theirs.as_euler(order, degrees=True))
        text.append(" ".join(f"{x:.8f}" for x in numbers))
    return "\n".join(text) + "\n"
