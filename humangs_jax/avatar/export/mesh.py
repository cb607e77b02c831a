"""The body of an avatar as a textured mesh: for programs that know no Gaussians.

The texture is what the Gaussians show to someone who looks at each point of the skin along its normal: those near the line of
sight are blended front to back, as a renderer blends them. So clothes end up on the skin, as a bodysuit: the mesh is that of the
body. The atlas is our own (`rendering.mesh.atlas`), for any body.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.body.model import BodyPose
from humangs_jax.body.skinning import blend_transforms, joint_transforms
from humangs_jax.core.array_types import Float, Int, UInt8
from humangs_jax.core.checks import BOUNDED, check_values
from humangs_jax.geometry import quaternion, transform
from humangs_jax.rendering.mesh.atlas import fill_gaps, texels, unwrap
from humangs_jax.rendering.mesh.position_map import vertex_normals

TEXTURE_SIZE = 1024
"""Texels a side: some 2 mm on an adult. Gaussians are 5 to 10 mm apart."""
NEIGHBOURS = 32
"""Gaussians that are asked for the color of a point: those with the nearest means."""
CHUNK = 16384
"""Points at a time: some 100 MB."""
SMALLEST_SCALE = 1e-4
"""Metres; flat Gaussians are seen as if they were a tenth of a millimetre thick."""
LEAST_WEIGHT = 1e-4
"""Of the nearest Gaussian, so that points that no Gaussian covers have a color."""


@dataclasses.dataclass(frozen=True)
class BodyMesh:
    """A textured mesh in T-pose. A vertex of the body stands once for each chart of the texture that it is in.

    vertices: (u, 3) metres. normals: (u, 3). faces: (f, 3), counter-clockwise from outside. uvs: (u, 2), v up. texture: (t, t, 3)
    bytes, row 0 on top (v = 1). weights: (u, j) skinning weights, rows sum to 1.
    """

    vertices: Float[np.ndarray, "u 3"]
    normals: Float[np.ndarray, "u 3"]
    faces: Int[np.ndarray, "f 3"]
    uvs: Float[np.ndarray, "u 2"]
    texture: UInt8[np.ndarray, "t t 3"]
    weights: Float[np.ndarray, "u j"]

    def posed(self, avatar: Avatar, pose: BodyPose) -> "BodyMesh":
        """The mesh in a pose of the avatar's joints; normals by the rotations of blended transforms."""
        transforms = joint_transforms(avatar.rest_joints, avatar.parents, pose.rotations, pose.translation)
        blended = blend_transforms(jnp.asarray(self.weights), transforms)
        normals = np.einsum("uab,ub->ua", np.asarray(blended[:, :3, :3]), self.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        vertices = np.asarray(transform.apply(blended, jnp.asarray(self.vertices)))
        return dataclasses.replace(self, vertices=vertices, normals=normals.astype(np.float32))


def body_mesh(avatar: Avatar, texture_size: int = TEXTURE_SIZE) -> BodyMesh:
    """The body of an avatar in T-pose, with the colors of its Gaussians as a texture.

    Raises: ValueError for an avatar without faces or Gaussians, or with numbers that files cannot hold, or a size that is no
    multiple of 128.
    """
    vertices, faces = np.asarray(avatar.rest_vertices, np.float32), np.asarray(avatar.faces, np.int32)
    if len(faces) == 0 or len(avatar.gaussians.means) == 0:
        raise ValueError("a body mesh needs an avatar with faces and Gaussians")
    own = {name: (getattr(avatar, name), BOUNDED) for name in ("rest_vertices", "rest_joints", "skinning_weights")}
    check_values("export", own | {"gaussians.colors": (avatar.gaussians.colors, BOUNDED)})
    normals = np.asarray(vertex_normals(avatar.rest_vertices, avatar.faces))
    ones = np.ones(len(faces), np.float32)
    atlas = unwrap(vertices, faces, np.zeros(len(faces), np.int64), texture_size, ones)
    ids, shares = texels(atlas)
    known = ids >= 0
    corners = faces[ids[known]]
    mixed = lambda values: np.einsum("pc,pcd->pd", shares[known], values[corners])
    colors = np.zeros((*ids.shape, 3), np.float32)
    colors[known] = skin_colors(avatar, mixed(vertices), mixed(normals))
    texture = np.rint(255 * np.clip(fill_gaps(colors, known), 0, 1)).astype(np.uint8)
    at = atlas.vertices
    weights = vertex_weights(avatar)[at]
    return BodyMesh(vertices[at], normals[at], np.asarray(atlas.faces), atlas.uvs, texture, weights)


def vertex_weights(avatar: Avatar) -> Float[np.ndarray, "n j"]:
    """Skinning weights of the body's vertices: the mean of each one's own Gaussians.

    Where refinement has added Gaussians, these are the nearest ones.
    """
    weights = np.asarray(avatar.skinning_weights, np.float32)
    each = avatar.gaussians_per_vertex
    if each is None:
        count = min(4, len(weights))
        nearest = KDTree(np.asarray(avatar.gaussians.means)).query(np.asarray(avatar.rest_vertices), k=count)[1]
        return weights[nearest.reshape(-1, count)].mean(axis=1)
    return weights.reshape(-1, each, weights.shape[1]).mean(axis=1)


def skin_colors(
    avatar: Avatar, points: Float[np.ndarray, "p 3"], normals: Float[np.ndarray, "p 3"]
) -> Float[np.ndarray, "p 3"]:
    """What the Gaussians show at points of the skin to someone who looks along the normals, from outside.

    On the line x(t) = p + t n, a Gaussian of precision A and mean m is densest at t = n.A(m - p) / n.A n and there has the alpha
    o exp(-q / 2) with q = (m - p).A(m - p) - t n.A(m - p).
    """
    count = min(NEIGHBOURS, len(avatar.gaussians.means))
    g, tree = avatar.gaussians, KDTree(np.asarray(avatar.gaussians.means))
    axes = (
        np.asarray(quaternion.to_matrix(quaternion.normalize(g.quats)))
        / np.maximum(np.asarray(g.scales), SMALLEST_SCALE)[:, None, :]
    )
    means, opacities, colors = (np.asarray(x, np.float32) for x in (g.means, g.opacities, g.colors))
    out = np.empty((len(points), 3), np.float32)
    for start in range(0, len(points), CHUNK):
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
