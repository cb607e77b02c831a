"""The body of an avatar as a textured mesh: for programs that know no Gaussians.

The texture has the colors that the Gaussians show to someone who looks at each point of the skin
along its normal. Gaussians near the line of sight are blended front to back, as a renderer blends
them. Clothes therefore end up on the skin, like a bodysuit, because the mesh is the body's. The
atlas is made from the mesh (`rendering.mesh.atlas`), so that any body has one.

    .glb    https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html#skins: mesh, skin and motion,
            as Blender, Unity, Unreal and three.js open it. The texture holds the photos' light, so
            the material is unlit (KHR_materials_unlit). Joints have our names; in T-pose none is
            turned. y is up, metres
    .obj    https://www.loc.gov/preservation/digital/formats/fdd/fdd000507.shtml, with .mtl and a
            texture in .png beside it
"""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.avatar.attach_face import faced
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import EXPORTS, Up, files_beside
from humangs_jax.avatar.export.gaussians import up_matrix, up_turn
from humangs_jax.body.model import (
    BodyPose,
    RestBody,
    blend_transforms,
    expressed,
    joint_transforms,
)
from humangs_jax.body.motion import Motion
from humangs_jax.core.array_types import Float, Int, UInt8
from humangs_jax.core.checks import BOUNDED, check_values
from humangs_jax.core.progress import bar, followed
from humangs_jax.geometry import quaternion, transform
from humangs_jax.io.atomic import check_ours, write_text
from humangs_jax.io.images import DRAWN, is_own_picture, png_bytes, write_png
from humangs_jax.io.mesh import INDICES, VERTICES, GlbWriter
from humangs_jax.io.reading import open_file
from humangs_jax.rendering.mesh.atlas import fill_gaps, texels, unwrap
from humangs_jax.rendering.mesh.rasterizer import vertex_normals

TEXTURE_SIZE = 1024
"""Number of texels along a side of the texture. A texel is about 2 mm wide on an adult. Gaussians
are 5 to 10 mm apart.
"""
NEIGHBOURS = 32
"""The number of Gaussians that color a point. They are the ones with the nearest means."""
CHUNK = 16384
"""Number of points that are colored at a time. This takes some 100 MB."""
SMALLEST_SCALE = 1e-4
"""The least standard deviation with which Gaussians are seen, metres. It gives flat Gaussians a
thickness.
"""
LEAST_WEIGHT = 1e-4
"""The least weight of the nearest Gaussian. It gives a color to points that no Gaussian covers."""
WEIGHTS = 4
"""The number of joints that a vertex follows in a file. All programs can read this many."""


@dataclasses.dataclass(frozen=True)
class BodyMesh:
    """A textured mesh of the body, in T-pose unless `posed` has made it. A vertex of the body
    occurs once for each chart of the texture that contains it.
    """

    vertices: Float[np.ndarray, "u 3"]
    """The vertices, (u, 3), metres."""
    normals: Float[np.ndarray, "u 3"]
    """Unit normals, (u, 3)."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex indices, (f, 3), counter-clockwise from outside."""
    uvs: Float[np.ndarray, "u 2"]
    """Texture coordinates, (u, 2), v up."""
    texture: UInt8[np.ndarray, "t t 3"]
    """Colors as bytes, (t, t, 3), row 0 on top (v = 1)."""
    weights: Float[np.ndarray, "u j"]
    """Skinning weights, (u, j); rows sum to 1."""
    source: Int[np.ndarray, " u"]
    """The vertex of the body that each vertex of the mesh stands for, (u,)."""

    def posed(self, avatar: Avatar, pose: BodyPose) -> "BodyMesh":
        """Returns the mesh in a pose of the avatar's joints. Normals are multiplied by the linear
        part of the blended transforms, and scaled to length 1.

        Raises: ValueError if the pose's expression does not fit the avatar's face.
        """
        rest = RestBody(avatar.rest_vertices, avatar.rest_joints)
        still = jnp.asarray(self.vertices)
        if pose.expression is not None and avatar.face is not None:
            rest, pose = expressed(avatar.face.expressions, rest, pose)
            still = rest.vertices[self.source]
        transforms = joint_transforms(rest.joints, avatar.parents, pose.rotations, pose.translation)
        blended = blend_transforms(jnp.asarray(self.weights), transforms)
        normals = np.einsum("uab,ub->ua", np.asarray(blended[:, :3, :3]), self.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        vertices = np.asarray(transform.apply(blended, still))
        return dataclasses.replace(self, vertices=vertices, normals=normals.astype(np.float32))


def body_mesh(avatar: Avatar, texture_size: int = TEXTURE_SIZE) -> BodyMesh:
    """Returns the body of an avatar in T-pose, with the colors of its Gaussians as a texture.

    Raises: ValueError for an avatar without faces or Gaussians, for numbers that files cannot hold,
    or for a texture size that is no multiple of 128.
    """
    vertices = np.asarray(avatar.rest_vertices, np.float32)
    faces = np.asarray(avatar.faces, np.int32)
    if len(faces) == 0 or len(avatar.gaussians.means) == 0:
        raise ValueError("a body mesh needs an avatar with faces and Gaussians")
    own = {
        name: (getattr(avatar, name), BOUNDED)
        for name in ("rest_vertices", "rest_joints", "skinning_weights")
    }
    check_values("export", own | {"gaussians.colors": (avatar.gaussians.colors, BOUNDED)})
    normals = np.asarray(vertex_normals(avatar.rest_vertices, avatar.faces))
    ones = np.ones(len(faces), np.float32)
    # a texture of the body, whose texels have the mean color of the Gaussians there
    atlas = unwrap(vertices, faces, np.zeros(len(faces), np.int64), texture_size, ones)
    ids, shares = texels(atlas)
    known = ids >= 0
    corners = faces[ids[known]]

    def mixed(values):
        return np.einsum("pc,pcd->pd", shares[known], values[corners])

    colors = np.zeros((*ids.shape, 3), np.float32)
    colors[known] = skin_colors(avatar, mixed(vertices), mixed(normals))
    texture = np.rint(255 * np.clip(fill_gaps(colors, known), 0, 1)).astype(np.uint8)
    # a vertex on a seam is there once for each of its charts
    at = atlas.vertices
    weights = vertex_weights(avatar)[at]
    faces = np.asarray(atlas.faces)
    return BodyMesh(vertices[at], normals[at], faces, atlas.uvs, texture, weights, np.asarray(at))


def vertex_weights(avatar: Avatar) -> Float[np.ndarray, "n j"]:
    """Returns the skinning weights of the body's vertices: for each vertex the mean over its
    Gaussians.

    If `Avatar.gaussians_per_vertex` is None, it is the mean over the four nearest Gaussians.
    """
    weights = np.asarray(avatar.skinning_weights, np.float32)
    each = avatar.gaussians_per_vertex
    if each is None:
        count = min(4, len(weights))
        nearest = KDTree(np.asarray(avatar.gaussians.means)).query(
            np.asarray(avatar.rest_vertices), k=count
        )[1]
        return weights[nearest.reshape(-1, count)].mean(axis=1)
    return weights.reshape(-1, each, weights.shape[1]).mean(axis=1)


def skin_colors(
    avatar: Avatar, points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "p 3"]:
    """Returns the colors that the Gaussians show at points of the skin to somebody who looks along
    the normals from outside.

    On the line x(t) = p + t n, a Gaussian of precision A and mean m is densest at t = n.A(m - p) /
    n.A n and there has the alpha o exp(-q / 2) with q = (m - p).A(m - p) - t n.A(m - p).
    """
    count = min(NEIGHBOURS, len(avatar.gaussians.means))
    g, tree = avatar.gaussians, KDTree(np.asarray(avatar.gaussians.means))
    axes = (
        np.asarray(quaternion.to_matrix(quaternion.normalize(g.quats)))
        / np.maximum(np.asarray(g.scales), SMALLEST_SCALE)[:, None, :]
    )
    means, opacities, colors = (np.asarray(x, np.float32) for x in (g.means, g.opacities, g.colors))
    out = np.empty((len(points), 3), np.float32)
    for start in bar(range(0, len(points), CHUNK), desc="texture", unit="part", shown=followed()):
        place, normal = points[start : start + CHUNK], normals[start : start + CHUNK]
        near = tree.query(place, k=count)[1].reshape(len(place), count)
        # in the Gaussians' own axes, over their scales: x.A y is a plain product there
        offset = np.einsum("pkab,pka->pkb", axes[near], means[near] - place[:, None])
        line = np.einsum("pkab,pa->pkb", axes[near], normal)
        along, across = (line * offset).sum(-1), np.maximum((line * line).sum(-1), 1e-12)
        distance = np.maximum((offset * offset).sum(-1) - along**2 / across, 0)
        alpha = np.clip(opacities[near] * np.exp(-distance / 2), 0, 0.999)
        order = np.argsort(-along / across, axis=1)  # the outermost first
        alpha = np.take_along_axis(alpha, order, axis=1)
        through = np.cumprod(1 - alpha, axis=1) / (1 - alpha)
        weight = alpha * through
        seen = np.take_along_axis(colors[near], order[..., None], axis=1)
        total = (weight[..., None] * seen).sum(axis=1) + LEAST_WEIGHT * colors[near[:, 0]]
        out[start : start + CHUNK] = total / (weight.sum(axis=1, keepdims=True) + LEAST_WEIGHT)
    return out


# glTF
# --------------------------------------------------------------------------------------------------


def write_animation(
    path: Path, files: Sequence[Path], avatar: Avatar, motion: Motion | None, up: Up, name: str
) -> None:
    """Write a whole motion into one `.glb`, see `write_mesh_glb`. Expressions are written if the
    avatar has a face or if its body is known. Raises: as `body_mesh`; OSError.
    """
    avatar = faced(avatar)
    write_mesh_glb(path, avatar, body_mesh(avatar), motion, name, up)


def write_mesh_glb(
    path: str | os.PathLike[str],
    avatar: Avatar,
    mesh: BodyMesh,
    motion: Motion | None = None,
    name: str = "motion",
    up: Up = "y",
) -> None:
    """Write mesh, skin and motion as a `.glb`. If writing fails, the path stays as it was.

    Arguments: motion: written as it is. Callers put it on the floor first, see
    `body.motion.grounded`. None: the person stands in T-pose, feet on 0. name: the name of the
    motion. up: the axis that points up in the file.

    Raises: ValueError for another `up`; OSError if the file cannot be written.
    """
    writer = GlbWriter()
    skeleton = len(avatar.parents) + 1  # nodes: the joints, then what they hang on, then the mesh
    document = {
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [skeleton - 1, skeleton]}],
        "nodes": [
            *joint_nodes(avatar, _floor(mesh)),
            _armature(avatar, up),
            {"name": "body", "mesh": 0, "skin": 0},
        ],
        "meshes": [_mesh(writer, avatar, _standing(mesh, up), up)],
        "skins": [_skin(writer, avatar, mesh, up)],
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
        "images": [
            {
                "name": "skin",
                "mimeType": "image/png",
                "bufferView": writer.bytes_(png_bytes(mesh.texture / 255)),
            }
        ],
    }
    if motion is not None:
        document["animations"] = [_animation(writer, avatar, motion, name, skeleton)]
    writer.write(path, document)


def strongest(
    weights: Float[np.ndarray, "n j"],
) -> tuple[Int[np.ndarray, "n 4"], Float[np.ndarray, "n 4"]]:
    """Returns the four joints with the largest weights of each row, strongest first, and their
    weights, scaled to sum to 1. Where a weight is 0, its joint is 0.
    """
    weights = np.pad(weights, ((0, 0), (0, max(0, WEIGHTS - weights.shape[1]))))
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :WEIGHTS]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept = (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32)
    return np.where(kept > 0, joints, 0), kept


def _standing(mesh: BodyMesh, up: Up) -> BodyMesh:
    """Returns the mesh in T-pose, turned to `up` and moved so that its lowest point is on 0. The
    file's skin leaves it there, so that readers that ignore skins show the same.
    """
    turn = up_matrix(up)
    vertices = (mesh.vertices - _floor(mesh)) @ turn.T
    return dataclasses.replace(mesh, vertices=vertices, normals=mesh.normals @ turn.T)


def _floor(mesh: BodyMesh) -> Float[np.ndarray, "3"]:
    """Returns (0, y, 0), where y is the height of the lowest vertex in T-pose, metres."""
    return np.asarray([0, mesh.vertices[:, 1].min(), 0], np.float32)


def joint_nodes(avatar: Avatar, floor: Float[np.ndarray, "3"]) -> list[dict[str, Any]]:
    """Returns a glTF node for every joint, placed relative to its parent. The root is placed so
    that the T-pose stands on 0.

    floor: the point of the T-pose that lies on 0, (3,), metres.
    """
    joints = np.asarray(avatar.rest_joints, np.float64)
    nodes = []
    for j, (name, parent) in enumerate(zip(avatar.joint_names, avatar.parents, strict=True)):
        origin = joints[parent] if parent >= 0 else floor
        node: dict[str, Any] = {"name": name, "translation": (joints[j] - origin).tolist()}
        children = [i for i, p in enumerate(avatar.parents) if p == j]
        if children:
            node["children"] = children
        nodes.append(node)
    return nodes


def _armature(avatar: Avatar, up: Up) -> dict[str, Any]:
    w, *xyz = up_turn(up)
    return {"name": "armature", "rotation": [*xyz, w], "children": [avatar.parents.index(-1)]}


def _mesh(writer: GlbWriter, avatar: Avatar, mesh: BodyMesh, up: Up) -> dict[str, Any]:
    """Returns the glTF mesh. The expressions of an avatar with a face are morph targets, whose
    names are in `extras`, where all programs read them.
    """
    primitive = _primitive(writer, mesh)
    if avatar.face is None:
        return {"name": "body", "primitives": [primitive]}
    expressions = avatar.face.expressions
    offsets = np.zeros((len(avatar.rest_vertices), 3, len(expressions.names)), np.float32)
    turned = np.einsum("ab,mbe->mae", up_matrix(up), np.asarray(expressions.directions))
    offsets[np.asarray(expressions.vertices)] = turned
    targets = [
        {"POSITION": writer.sparse(each[mesh.source])} for each in np.moveaxis(offsets, -1, 0)
    ]
    return {
        "name": "body",
        "primitives": [primitive | {"targets": targets}],
        "weights": [0.0] * len(targets),
        "extras": {"targetNames": list(expressions.names)},
    }


def _primitive(writer: GlbWriter, mesh: BodyMesh) -> dict[str, Any]:
    joints, weights = strongest(mesh.weights)
    small = "u1" if mesh.weights.shape[1] <= 256 else "<u2"
    attributes = {
        "POSITION": writer.array("VEC3", mesh.vertices, VERTICES, bounds=True),
        "NORMAL": writer.array("VEC3", mesh.normals, VERTICES),
        "TEXCOORD_0": writer.array(
            "VEC2", np.stack([mesh.uvs[:, 0], 1 - mesh.uvs[:, 1]], axis=1), VERTICES
        ),
        "JOINTS_0": writer.array("VEC4", joints.astype(small), VERTICES),
        "WEIGHTS_0": writer.array("VEC4", weights, VERTICES),
    }
    indices = writer.array("SCALAR", mesh.faces.reshape(-1).astype("<u4"), INDICES)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _skin(writer: GlbWriter, avatar: Avatar, mesh: BodyMesh, up: Up) -> dict[str, Any]:
    """Returns the glTF skin. Its matrices take the mesh as it is written, with `up` up, to the rest
    frame of each joint.
    """
    matrices = np.tile(np.eye(4), (len(avatar.parents), 1, 1))
    matrices[:, :3, :3] = up_matrix(up)  # column by column, as glTF has them: the turn back
    matrices[:, 3, :3] = _floor(mesh) - np.asarray(avatar.rest_joints)
    inverse = writer.array("MAT4", matrices.reshape(-1, 16))
    return {
        "joints": list(range(len(avatar.parents))),
        "inverseBindMatrices": inverse,
        "skeleton": avatar.parents.index(-1),
    }


def _animation(
    writer: GlbWriter, avatar: Avatar, motion: Motion, name: str, mesh_node: int
) -> dict[str, Any]:
    """Returns the glTF animation of a motion. It has the rotations of every joint that turns and
    the translation of the root. It has expressions if the motion has at least one expression of the
    avatar's face.
    """
    times = writer.array("SCALAR", np.arange(len(motion.translations)) / motion.fps, bounds=True)
    rotations = np.asarray(motion.rotations)
    quats = continuous(np.asarray(quaternion.from_axis_angle(motion.rotations)))
    root = avatar.parents.index(-1)
    tracks = [
        (j, "rotation", "VEC4", quats[:, j][:, [1, 2, 3, 0]])
        for j in range(rotations.shape[1])
        if rotations[:, j].any()
    ]
    places = np.asarray(motion.translations) + np.asarray(avatar.rest_joints)[root]
    tracks.append((root, "translation", "VEC3", places))
    names = () if avatar.face is None else avatar.face.expressions.names
    face = motion.expressions_of(names)
    if face is not None:  # the weights of a frame one after the other
        tracks.append((mesh_node, "weights", "SCALAR", np.asarray(face).reshape(-1)))
    return tracks_of(writer, times, tracks, name)


def tracks_of(
    writer: GlbWriter, times: int, tracks: Sequence[tuple[int, str, str, np.ndarray]], name: str
) -> dict[str, Any]:
    """Returns a glTF animation. tracks: for each track the node, the animated property (glTF's
    `path`), the type of the values, such as "VEC4", and the values. times: index of the accessor
    with the times of all tracks.
    """
    samplers = [
        {"input": times, "output": writer.array(kind, values), "interpolation": "LINEAR"}
        for *_, kind, values in tracks
    ]
    channels = [
        {"sampler": i, "target": {"node": node, "path": path}}
        for i, (node, path, *_) in enumerate(tracks)
    ]
    return {"name": name, "channels": channels, "samplers": samplers}


def continuous(quats: Float[np.ndarray, "m j 4"]) -> Float[np.ndarray, "m j 4"]:
    """Returns the quaternions of m frames with length 1 and with signs such that neighbouring
    frames have a dot product of at least 0. Some players interpolate the components.
    """
    quats = quats / np.linalg.norm(quats, axis=-1, keepdims=True)
    jumps = (quats[1:] * quats[:-1]).sum(axis=-1, keepdims=True) < 0
    signs = np.concatenate([np.ones_like(jumps[:1], float), np.where(jumps, -1.0, 1.0)])
    return quats * np.cumprod(signs, axis=0)


# OBJ
# --------------------------------------------------------------------------------------------------


WRITTEN = "# written by humangs_jax"
"""The first words of an `.obj` and of its `.mtl`."""


def _is_ours(file: Path) -> bool:
    """Returns whether a texture or a material was written by this package."""
    if file.suffix == ".png":
        return is_own_picture(file)
    with open_file(file) as opened:
        return opened.read(len(WRITTEN)) == WRITTEN.encode()


def check_beside(path: Path) -> None:
    """Check that the texture and the material of an `.obj` replace no files that others wrote.

    Raises: ValueError.
    """
    advice = (
        "it would become the texture or material: choose another name for the .obj, or move it away"
    )
    check_ours(files_beside(path, EXPORTS["obj"]), _is_ours, advice)


def write_poses(
    path: Path, files: Sequence[Path], avatar: Avatar, motion: Motion | None, up: Up, name: str
) -> None:
    """Write an `.obj` for each pose of a motion, or a single one in T-pose with its feet on 0. All
    of them use the material and the texture beside `path`. files: the paths of the `.obj` files.

    Raises: as `check_beside` and `body_mesh`; OSError if a file cannot be written.
    """
    check_beside(path)
    mesh = body_mesh(avatar)
    material = write_material(path, mesh)
    floor = _floor(mesh)
    for i, file in enumerate(files):
        still = dataclasses.replace(mesh, vertices=mesh.vertices - floor)
        shown = still
        if motion is not None:
            shown = mesh.posed(avatar, motion.pose(i, avatar.expression_names))
        write_obj(file, shown, material, up)


def write_material(path: Path, mesh: BodyMesh) -> Path:
    """Write the `.mtl` and the `.png` for the `.obj` at this path. Several poses share them.

    Returns the path of the `.mtl`. Raises: OSError.
    """
    material, texture = files_beside(path, EXPORTS["obj"])
    write_png(texture, mesh.texture.astype(np.float32) / 255, mark=DRAWN)
    write_text(
        material,
        f"{WRITTEN}\nnewmtl skin\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {texture.name}\n",
    )
    return material


def write_obj(path: Path, mesh: BodyMesh, material: Path, up: Up) -> None:
    """Write a mesh as an `.obj`. material: path of the `.mtl` in the same folder, as
    `write_material` returns it. up: the axis that points up in the file. Raises: OSError.
    """
    turn = up_matrix(up)

    def rows(key, values):
        return [f"{key} " + " ".join(f"{x:.6g}" for x in row) for row in values.tolist()]

    corners = [" ".join(f"{i}/{i}/{i}" for i in face) for face in (mesh.faces + 1).tolist()]
    lines = [
        f"{WRITTEN}: metres, {up} up",
        f"mtllib {material.name}",
        "o body",
        *rows("v", mesh.vertices @ turn.T),
        *rows("vt", mesh.uvs),
        *rows("vn", mesh.normals @ turn.T),
        "usemtl skin",
        *(f"f {corner}" for corner in corners),
    ]
    write_text(path, "\n".join(lines) + "\n")
