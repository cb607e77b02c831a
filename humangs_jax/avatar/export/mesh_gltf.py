"""The body of an avatar as `.glb`: textured mesh, skin and motion, as Blender, Unity, Unreal and three.js open it.

https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#skins. The texture holds the photos' light, so the material is unlit
(KHR_materials_unlit). Joints have our names; in T-pose none is turned. y is up, metres.
"""

import io
import os

import numpy as np

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.mesh import BodyMesh
from humangs_jax.avatar.export.world import Up, up_turn
from humangs_jax.core.array_types import Float, Int
from humangs_jax.data.motion import Motion
from humangs_jax.geometry import quaternion
from humangs_jax.io.glb import INDICES, VERTICES, GlbWriter

WEIGHTS = 4
"""Joints of a vertex that all programs read."""


def write_mesh_glb(
    path: str | os.PathLike,
    avatar: Avatar,
    mesh: BodyMesh,
    motion: Motion | None = None,
    name: str = "motion",
    up: Up = "y",
) -> None:
    """Write mesh, skin and motion; the file appears whole or not at all.

    Arguments: motion: as it is to be played (`grounded`); without one the person stands in T-pose, feet on 0. name: the motion's.
    """
    writer = GlbWriter()
    skeleton = len(avatar.parents) + 1  # nodes: the joints, then what they hang on, then the mesh
    document = {
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [skeleton - 1, skeleton]}],
        "nodes": [*_joint_nodes(avatar, mesh), _armature(avatar, up), {"name": "body", "mesh": 0, "skin": 0}],
        "meshes": [{"name": "body", "primitives": [_primitive(writer, mesh)]}],
        "skins": [_skin(writer, avatar)],
        "materials": [
            {
                "name": "skin",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0.0,
                    "roughnessFactor": 1.0,
                },
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"source": 0, "sampler": 0}],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": [{"name": "skin", "mimeType": "image/png", "bufferView": writer.bytes_(_png(mesh.texture))}],
    }
    if motion is not None:
        document["animations"] = [_animation(writer, avatar, motion, name)]
    writer.write(path, document)


def strongest(weights: Float[np.ndarray, "n j"]) -> tuple[Int[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
    """The four joints of most weight of each row, strongest first, and their weights scaled to sum 1; joint 0 where that is 0."""
    weights = np.pad(weights, ((0, 0), (0, max(0, WEIGHTS - weights.shape[1]))))
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :WEIGHTS]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept = (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(kept > 0, joints, 0), kept


def _joint_nodes(avatar, mesh):
    """Every joint at its place relative to its parent's; the root so that T-pose stands on 0."""
    joints = np.asarray(avatar.rest_joints, np.float64)
    nodes = []
    for j, (name, parent) in enumerate(zip(avatar.joint_names, avatar.parents, strict=True)):
        place = joints[j] - (joints[parent] if parent >= 0 else [0, float(mesh.vertices[:, 1].min()), 0])
        node = {"name": name, "translation": place.tolist()}
        children = [i for i, p in enumerate(avatar.parents) if p == j]
        nodes.append(node | ({"children": children} if children else {}))
    return nodes


def _armature(avatar, up):
    w, *xyz = up_turn(up)
    return {"name": "armature", "rotation": [*xyz, w], "children": [avatar.parents.index(-1)]}


def _primitive(writer, mesh):
    joints, weights = strongest(mesh.weights)
    small = "u1" if mesh.weights.shape[1] <= 256 else "<u2"
    attributes = {
        "POSITION": writer.array("VEC3", mesh.vertices, VERTICES, bounds=True),
        "NORMAL": writer.array("VEC3", mesh.normals, VERTICES),
        "TEXCOORD_0": writer.array("VEC2", np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1), VERTICES),
        "JOINTS_0": writer.array("VEC4", joints.astype(small), VERTICES),
        "WEIGHTS_0": writer.array("VEC4", weights, VERTICES),
    }
    indices = writer.array("SCALAR", mesh.faces.reshape(-1).astype("<u4"), INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _skin(writer, avatar):
    matrices = np.tile(np.eye(4), (len(avatar.parents), 1, 1))
    matrices[:, 3, :3] = -np.asarray(avatar.rest_joints)  # column by column, as glTF has them
    inverse = writer.array("MAT4", matrices.reshape(-1, 16))
    return {
        "joints": list(range(len(avatar.parents))),
        "inverseBindMatrices": inverse,
        "skeleton": avatar.parents.index(-1),
    }


def _animation(writer, avatar, motion, name):
    """Every joint that turns, and where the root is."""
    times = writer.array("SCALAR", np.arange(len(motion.translations)) / motion.fps, bounds=True)
    rotations = np.asarray(motion.rotations)
    quats = _continuous(np.asarray(quaternion.from_axis_angle(motion.rotations)))
    root = avatar.parents.index(-1)
    tracks = [
        (j, "rotation", "VEC4", quats[:, j][:, [1, 2, 3, 0]])
        for j in range(rotations.shape[1])
        if rotations[:, j].any()
    ]
    tracks.append((root, "translation", "VEC3", np.asarray(motion.translations) + np.asarray(avatar.rest_joints)[root]))
    samplers = [
        {"input": times, "output": writer.array(kind, values), "interpolation": "LINEAR"} for *_, kind, values in tracks
    ]
    channels = [{"sampler": i, "target": {"node": node, "path": path}} for i, (node, path, *_) in enumerate(tracks)]
    return {"name": name, "channels": channels, "samplers": samplers}


def _continuous(quats):
    """Quaternions (m, j, 4) of unit length, each on the side of the one before: some players interpolate numbers."""
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    jumps = (quats[1:] * quats[:-1]).sum(axis=-1, keepdims=True) < 0
    signs = np.concatenate([np.ones_like(jumps[:1], float), np.where(jumps, -1.0, 1.0)])
    return quats * np.cumprod(signs, axis=0)


def _png(texture):
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(texture).save(stream, format="PNG")
    return stream.getvalue()
