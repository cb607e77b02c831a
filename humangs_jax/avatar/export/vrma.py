"""Writes motions as VRM animations (.vrma): humanoid bones and expressions, no mesh. Programs for
VRM characters play them on any character.

https://github.com/vrm-c/vrm-specification/tree/master/specification/VRMC_vrm_animation-1.0: a glTF
file whose nodes are the bones of a person in T-pose. Each expression is a further node, and its
weight is how far this node is moved along x. All are custom expressions under our names, as
programs for ARKit's shapes expect them.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import Up
from humangs_jax.avatar.export.mesh import continuous, joint_nodes, tracks_of
from humangs_jax.body.joints import FINGERS, JOINT_NAMES
from humangs_jax.body.motion import Motion
from humangs_jax.geometry import quaternion
from humangs_jax.io.mesh import GlbWriter

BONES = {
    "pelvis": "hips", "spine1": "spine", "spine2": "chest", "spine3": "upperChest",
    "neck": "neck", "head": "head", "left_hip": "leftUpperLeg", "left_knee": "leftLowerLeg",
    "left_ankle": "leftFoot", "left_foot": "leftToes", "right_hip": "rightUpperLeg",
    "right_knee": "rightLowerLeg", "right_ankle": "rightFoot", "right_foot": "rightToes",
    "left_collar": "leftShoulder", "left_shoulder": "leftUpperArm", "left_elbow": "leftLowerArm",
    "left_wrist": "leftHand", "right_collar": "rightShoulder", "right_shoulder": "rightUpperArm",
    "right_elbow": "rightLowerArm", "right_wrist": "rightHand",
}  # fmt: skip
"""VRM's names of our joints. Animations have no jaw and no eyes."""
VRM_FINGERS = {"pinky": "Little"}
"""VRM's names of the fingers that have another name there."""


def _bone_names() -> dict[str, str]:
    """Returns VRM's name of each of our joints that VRM has."""
    names = dict(BONES)
    for side in ("left", "right"):
        for finger in FINGERS:
            segments = ("Proximal", "Intermediate", "Distal")
            if finger == "thumb":
                segments = ("Metacarpal", "Proximal", "Distal")
            for i, segment in enumerate(segments, start=1):
                called = VRM_FINGERS.get(finger, finger.capitalize())
                names[f"{side}_{finger}{i}"] = f"{side}{called}{segment}"
    return names


def write_vrma(
    path: Path, files: Sequence[Path], avatar: Avatar, motion: Motion | None, up: Up, name: str
) -> None:
    """Write a motion on the joints of an avatar as a `.vrma`. If writing fails, the path stays as
    it was. name: the name of the animation. files and up are not used.

    Raises: ValueError if there is no motion, or if the joints are not those of SMPL-X.
    """
    if motion is None:
        raise ValueError(f"{path}: a VRM animation holds a motion and no avatar: expected a motion")
    if avatar.joint_names != JOINT_NAMES:
        raise ValueError(
            f"{path}: VRM has the joints of people: expected a body of SMPL-X's joints"
        )
    writer = GlbWriter()
    joints = np.asarray(avatar.rest_joints, np.float64)
    # the skeleton at rest stands on the ground
    sole = np.asarray([0, float(np.asarray(avatar.rest_vertices)[:, 1].min()), 0])
    nodes = joint_nodes(avatar, sole)

    times = writer.array("SCALAR", np.arange(len(motion.translations)) / motion.fps, bounds=True)
    rotations, names = np.asarray(motion.rotations), _bone_names()
    quats = continuous(np.asarray(quaternion.from_axis_angle(motion.rotations)))
    root = avatar.parents.index(-1)
    # joints that never move need no track, except the root
    tracks = [
        (j, "rotation", "VEC4", quats[:, j][:, [1, 2, 3, 0]])
        for j in range(rotations.shape[1])
        if j == root or rotations[:, j].any()
    ]
    tracks.append((root, "translation", "VEC3", np.asarray(motion.translations) + joints[root]))

    # an expression is a node whose x is its weight
    custom = {}
    if motion.expressions is None:
        values = np.zeros((len(rotations), 0))
    else:
        values = motion.expressions
    for shape, weights in zip(motion.expression_names, np.asarray(values).T, strict=True):
        custom[shape] = {"node": len(nodes)}
        tracks.append((len(nodes), "translation", "VEC3", weights[:, None] * (1.0, 0, 0)))
        nodes.append({"name": shape})

    # which node each bone of VRM is
    bones = {names[x]: {"node": j} for j, x in enumerate(avatar.joint_names) if x in names}
    extension: dict[str, Any] = {"specVersion": "1.0", "humanoid": {"humanBones": bones}}
    if custom:
        extension["expressions"] = {"custom": custom}
    document = {
        "extensionsUsed": ["VRMC_vrm_animation"],
        "extensions": {"VRMC_vrm_animation": extension},
        "scene": 0,
        "scenes": [{"nodes": [root, *(entry["node"] for entry in custom.values())]}],
        "nodes": nodes,
        "animations": [tracks_of(writer, times, tracks, name)],
    }
    writer.write(path, document)
