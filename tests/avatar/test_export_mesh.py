"""The body as a mesh: colors, skin and motion, as trimesh, our reader and Khronos's validator see
them.
"""

import functools
import json
import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from humangs_jax import cli
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export import mesh as mesh_export
from humangs_jax.avatar.export.gaussians import up_matrix
from humangs_jax.avatar.export.mesh import (
    BodyMesh,
    body_mesh,
    skin_colors,
    strongest,
    vertex_weights,
    write_mesh_glb,
)
from humangs_jax.avatar.export.splats import write_glb
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.model import RestBody
from humangs_jax.body.motion import Motion, grounded
from humangs_jax.core.pytree import replace
from humangs_jax.io.mesh import parse_glb, read_accessor
from humangs_jax.motion import load_motion, save_motion
from humangs_jax.motion.skeleton import shipped_joints
from humangs_jax.rendering.gaussians import Gaussians

VALIDATOR = Path(os.environ.get("HUMANGS_NPM", ".")) / "node_modules" / "gltf-validator"
"""Folder of `npm install gltf-validator`, below the variable HUMANGS_NPM."""
BLENDER = os.environ.get("HUMANGS_BLENDER", "")
"""A Python with Blender's module (`pip install bpy`): the variable HUMANGS_BLENDER."""
TEXTURE = 256


def color_at(points):
    """Returns a color that varies smoothly in space."""
    return 0.5 + 0.4 * np.sin(3 * points + [0, 1, 2])


@functools.cache
def avatar():
    """Returns an egg-shaped person with our joints and two flat Gaussians on each vertex."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    f32 = lambda x: jnp.asarray(x, jnp.float32)
    vertices, joints = sphere.vertices * [0.4, 0.9, 0.3] + [0, -0.4, 0], shipped_joints()
    weights = np.exp(-20 * np.linalg.norm(vertices[:, None] - joints, axis=-1))
    rotations = Rotation.align_vectors
    normals = np.asarray(sphere.vertex_normals)
    turn = [rotations([n], [[0, 0, 1]])[0].as_quat()[[3, 0, 1, 2]] for n in normals]
    means = np.repeat(vertices, 2, axis=0)
    return Avatar(
        Gaussians(
            f32(means),
            f32(np.repeat(turn, 2, axis=0)),
            f32(np.tile([0.02, 0.02, 0.001], (len(means), 1))),
            jnp.full(len(means), 0.8),
            f32(color_at(means)),
        ),
        f32(np.repeat(weights / weights.sum(1, keepdims=True), 2, axis=0)),
        f32(vertices),
        f32(joints),
        jnp.asarray(sphere.faces, jnp.int32),
        parents=PARENTS,
        joint_names=JOINT_NAMES,
    )


@functools.cache
def textured():
    return body_mesh(avatar(), TEXTURE)


def mesh():
    """Returns the body's mesh with a texture of one color."""
    one = avatar()
    vertices, weights = np.asarray(one.rest_vertices), np.asarray(one.skinning_weights)[::2]
    normals = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    texture = np.full((4, 4, 3), 128, np.uint8)
    uvs, source = vertices[:, :2] * 0.5 + 0.5, np.arange(len(vertices))
    return BodyMesh(vertices, normals, np.asarray(one.faces), uvs, texture, weights, source)


def dance(frames=3):
    rng = np.random.default_rng(3)
    rotations, moves = 0.3 * rng.normal(size=(frames, 55, 3)), 0.2 * rng.normal(size=(frames, 3))
    return Motion(jnp.asarray(rotations, jnp.float32), jnp.asarray(moves, jnp.float32), 24.0)


def test_the_outermost_gaussians_give_the_skin_its_color():
    """A red sheet lies over a blue one over the skin. Where there is none, the nearest Gaussian
    counts.
    """
    one = avatar()
    sheets = Gaussians(
        jnp.asarray([[0, 0, 0.01], [0, 0, 0.02], [1, 0, 0]], jnp.float32),
        jnp.tile(jnp.asarray([1.0, 0, 0, 0]), (3, 1)),
        jnp.tile(jnp.asarray([0.1, 0.1, 0.001]), (3, 1)),
        jnp.asarray([0.9, 0.75, 0.9]),
        jnp.asarray([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    )
    points = np.asarray([[0, 0, 0], [1, 0, 0], [9, 0, 0]], np.float32)
    seen = skin_colors(
        replace(one, gaussians=sheets), points, np.tile(np.float32([0, 0, 1]), (3, 1))
    )
    np.testing.assert_allclose(seen[0], [0.75 / 0.975, 0, 0.225 / 0.975], atol=1e-3)
    np.testing.assert_allclose(seen[1:], [[0, 1, 0], [0, 1, 0]], atol=1e-3)
    behind = skin_colors(replace(one, gaussians=sheets), points[:1], np.float32([[0, 0, -1]]))
    np.testing.assert_allclose(behind[0], [0.1 * 0.75 / 0.975, 0, 0.9 / 0.975], atol=1e-3)


def test_vertices_have_the_weights_of_their_gaussians_also_after_refinement():
    one = avatar()
    own = vertex_weights(one)
    np.testing.assert_allclose(own, one.skinning_weights[::2], atol=1e-6)
    added = replace(
        one,
        gaussians=replace(
            one.gaussians,
            **{
                k: jnp.concatenate([v, v[:1]])
                for k, v in vars(one.gaussians).items()
                if v is not None
            },
        ),
        skinning_weights=jnp.concatenate([one.skinning_weights, one.skinning_weights[:1]]),
    )
    assert np.abs(vertex_weights(added) - own).max() < 0.35 and np.allclose(
        vertex_weights(added).sum(1), 1, atol=1e-5
    )
    joints, kept = strongest(np.asarray([[0.1, 0.0, 0.4, 0.2, 0.2, 0.1], [0, 1.0, 0, 0, 0, 0]]))
    assert joints.tolist()[1] == [1, 0, 0, 0] and set(joints[0][:3]) == {2, 3, 4}
    np.testing.assert_allclose(kept.sum(1), 1)


@pytest.mark.slow
def test_the_texture_is_what_was_on_the_body(tmp_path):
    """trimesh's colors at the vertices are those of their places; the mesh stands at height 0."""
    write_mesh_glb(tmp_path / "a.glb", avatar(), textured())
    read = trimesh.load(tmp_path / "a.glb", process=False).geometry["body"]
    places = textured().vertices
    standing = places - [0, places[:, 1].min(), 0]
    np.testing.assert_allclose(read.vertices, standing, atol=1e-6)
    np.testing.assert_array_equal(read.faces, textured().faces)
    seen = read.visual.to_color().vertex_colors[:, :3] / 255
    off = np.abs(seen - color_at(np.asarray(places)))
    assert off.max() < 0.06 and off.mean() < 0.01
    assert read.visual.material.baseColorTexture.size == (TEXTURE, TEXTURE)


def skinned(path, frame):
    """Returns the vertices of a frame, computed from the file by the formula of glTF's skins.

    A vertex is the sum over joints of weight, joint matrix and inverse bind matrix.
    """
    content, binary = parse_glb(path.read_bytes())
    get = lambda index: read_accessor(content, binary, index)
    nodes = content["nodes"]
    local = []
    values: dict = {}
    for channel in content.get("animations", [{"channels": []}])[0]["channels"]:
        sampler = content["animations"][0]["samplers"][channel["sampler"]]
        values[channel["target"]["node"], channel["target"]["path"]] = get(sampler["output"])[frame]
    # the local transform of each node, with the values of the animation where it has some
    for i, node in enumerate(nodes):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(
            values.get((i, "rotation"), node.get("rotation", [0, 0, 0, 1]))
        ).as_matrix()
        matrix[:3, 3] = values.get((i, "translation"), node.get("translation", [0, 0, 0]))
        local.append(matrix)
    # transforms along the hierarchy, then the blend of the joints for each vertex
    above = {child: i for i, node in enumerate(nodes) for child in node.get("children", [])}
    world = lambda i: local[i] if i not in above else world(above[i]) @ local[i]
    skin, part = content["skins"][0], content["meshes"][0]["primitives"][0]["attributes"]
    bind = get(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2)
    matrices = np.stack([world(j) @ b for j, b in zip(skin["joints"], bind, strict=True)])
    joints, weights, points = (
        get(part["JOINTS_0"]).astype(int),
        get(part["WEIGHTS_0"]),
        get(part["POSITION"]),
    )
    blended = np.einsum("uk,ukab->uab", weights, matrices[joints])
    return np.einsum("uab,ub->ua", blended[:, :3, :3], points) + blended[:, :3, 3]


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_skin_moves_the_mesh_as_we_do(tmp_path, up):
    one, shape = avatar(), mesh()
    joints, kept = strongest(shape.weights)
    four = np.zeros_like(shape.weights)
    # ours with the weights that the file has room for
    np.put_along_axis(four, joints, kept, axis=1)
    motion = grounded(dance(), RestBody(one.rest_vertices, one.rest_joints), PARENTS)
    write_mesh_glb(tmp_path / "a.glb", one, shape, motion, up=up)
    turn = np.asarray({"y": np.eye(3), "z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]]}[up], float)
    for frame in range(3):
        moved = (
            type(shape)(**{**vars(shape), "weights": four}).posed(one, motion.pose(frame)).vertices
        )
        np.testing.assert_allclose(skinned(tmp_path / "a.glb", frame), moved @ turn.T, atol=2e-5)
    write_mesh_glb(tmp_path / "b.glb", one, shape)
    still = skinned(tmp_path / "b.glb", 0)
    np.testing.assert_allclose(
        still, shape.vertices - [0, shape.vertices[:, 1].min(), 0], atol=2e-5
    )


@pytest.mark.parametrize("up", ["y", "-y", "z"])
def test_readers_that_know_no_skins_see_the_same_person_with_the_feet_on_0(tmp_path, up):
    write_mesh_glb(tmp_path / "a.glb", avatar(), mesh(), up=up)
    content, binary = parse_glb((tmp_path / "a.glb").read_bytes())
    attributes = content["meshes"][0]["primitives"][0]["attributes"]
    points = read_accessor(content, binary, attributes["POSITION"])
    np.testing.assert_allclose(skinned(tmp_path / "a.glb", 0), points, atol=2e-5)
    heights = points @ {"y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1]}[up]
    assert heights.min() == pytest.approx(0, abs=1e-6)
    normals = read_accessor(content, binary, attributes["NORMAL"])
    turned = mesh().normals @ np.asarray(up_matrix(up)).T
    np.testing.assert_allclose(normals, turned, atol=1e-6)


def matrices(motion):
    """Returns the rotation matrices (m, 55, 3, 3) of a motion."""
    vectors = np.asarray(motion.rotations)
    return Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3)


def test_a_motion_that_was_exported_is_read_again(tmp_path):
    one, motion = avatar(), dance(4)
    write_mesh_glb(tmp_path / "a.glb", one, mesh(), motion)
    back = load_motion(tmp_path / "a.glb", rest_joints=one.rest_joints)

    np.testing.assert_allclose(matrices(back), matrices(motion), atol=1e-4)
    moved = np.asarray(back.translations - motion.translations)
    np.testing.assert_allclose(moved - moved[0], 0, atol=1e-4)
    assert back.fps == pytest.approx(24)


def test_numbers_of_turns_never_jump_between_frames(tmp_path):
    """Some players interpolate the numbers: two whole turns, each wrapped at half a turn, so that
    the sign flips twice.
    """
    angles = (np.linspace(0, 4 * np.pi, 25) + np.pi) % (2 * np.pi) - np.pi
    rotations = np.zeros((25, 55, 3))
    rotations[:, 0, 1], rotations[:, 3, 0] = angles, -angles
    write_mesh_glb(
        tmp_path / "a.glb",
        avatar(),
        mesh(),
        Motion(jnp.asarray(rotations, jnp.float32), jnp.zeros((25, 3))),
    )
    content, binary = parse_glb((tmp_path / "a.glb").read_bytes())
    tracks = [x for x in content["animations"][0]["channels"] if x["target"]["path"] == "rotation"]
    assert len(tracks) == 2
    for track in tracks:
        quats = read_accessor(
            content, binary, content["animations"][0]["samplers"][track["sampler"]]["output"]
        )
        assert np.abs(np.diff(quats, axis=0)).max() < 0.3  # a twelfth of a turn


def test_bodies_without_faces_and_textures_of_other_sizes_are_refused():
    for size in (64, 1000):
        with pytest.raises(
            ValueError, match=f"texture of {size} texels a side: expected a multiple of 128"
        ):
            body_mesh(avatar(), size)
    with pytest.raises(ValueError, match="faces and Gaussians"):
        body_mesh(replace(avatar(), faces=avatar().faces[:0]))


@pytest.mark.slow
def test_trimesh_reads_our_obj(tmp_path, monkeypatch, capsys):
    one = avatar()
    monkeypatch.setattr(mesh_export, "body_mesh", lambda _: textured())
    one.save(tmp_path / "me.npz")
    save_motion(tmp_path / "dance.npz", dance())
    export = ["humangs", "export", str(tmp_path / "me.npz"), "--out", str(tmp_path / "x.obj")]
    monkeypatch.setattr(sys, "argv", export)
    cli.main()
    assert "1,280 triangles, feet on 0; x.mtl and x.png belong to it" in capsys.readouterr().out
    assert {path.name for path in tmp_path.glob("x*")} == {"x.obj", "x.mtl", "x.png"}
    read = trimesh.load(tmp_path / "x.obj", process=False)
    # the file stands on its feet; colors are compared at the places of the avatar
    low = float(np.asarray(one.rest_vertices)[:, 1].min())
    assert len(read.faces) == 1280 and read.bounds[0, 1] == pytest.approx(0, abs=1e-5)
    seen = read.visual.to_color().vertex_colors[:, :3] / 255
    placed = np.asarray(read.vertices) + np.asarray([0, low, 0])
    np.testing.assert_allclose(seen, color_at(placed), atol=0.06)
    assert (np.asarray(read.vertex_normals) * (read.vertices - read.vertices.mean(0))).sum(
        1
    ).min() > 0
    monkeypatch.setattr(
        sys,
        "argv",
        [*export, "--motion", str(tmp_path / "dance.npz"), "--frames", "::2", "--up", "z"],
    )
    cli.main()
    names = {path.name for path in tmp_path.glob("x*")}
    assert names == {"x.obj", "x_0000.obj", "x_0002.obj", "x.mtl", "x.png"}
    assert "mtllib x.mtl" in (tmp_path / "x_0002.obj").read_text()[:200]
    # a frame of the motion, with z up
    placed = grounded(dance(), RestBody(one.rest_vertices, one.rest_joints), PARENTS)
    expected = textured().posed(one, placed.pose(2)).vertices
    frame = trimesh.load(tmp_path / "x_0002.obj", process=False)
    np.testing.assert_allclose(
        frame.vertices, expected @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-5
    )


@pytest.mark.skipif(
    not VALIDATOR.exists(), reason="needs npm's gltf-validator (HUMANGS_NPM: its folder)"
)
@pytest.mark.slow
def test_khronos_validator_finds_nothing(tmp_path):
    """It has no issue with the mesh; of the Gaussians it only says that it lacks the extension."""
    write_mesh_glb(tmp_path / "mesh.glb", avatar(), mesh(), dance(), "dance", "z")
    write_glb(tmp_path / "gaussians.glb", avatar().gaussians)
    found = {}
    for name in ("mesh", "gaussians"):
        file = json.dumps(str(tmp_path / f"{name}.glb"))
        program = f"""const validator = require({json.dumps(str(VALIDATOR.resolve()))});
        const data = new Uint8Array(require("fs").readFileSync({file}));
        validator.validateBytes(data)
          .then((report) => console.log(JSON.stringify(report.issues.messages)));"""
        done = subprocess.run(["node", "-e", program], capture_output=True, text=True, check=True)
        found[name] = json.loads(done.stdout)
    assert found["mesh"] == []
    codes = {issue["code"] for issue in found["gaussians"]}
    assert codes == {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    assert all(
        "KHR_gaussian_splatting" in issue["pointer"] + issue["message"]
        for issue in found["gaussians"]
    )


THROUGH_BLENDER = """
import sys
import bpy
from numpy import array, save
folder = sys.argv[1]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = 24
bpy.ops.import_scene.gltf(filepath=f"{folder}/ours.glb")
scene.frame_start, scene.frame_end = 0, 3
armature = next(part for part in bpy.data.objects if part.type == "ARMATURE")
body = next(part for part in bpy.data.objects if part.type == "MESH" and part.vertex_groups)
scene.frame_set(2)
shown = body.evaluated_get(bpy.context.evaluated_depsgraph_get())
vertices = shown.to_mesh().vertices
save(f"{folder}/frame.npy", array([shown.matrix_world @ vertex.co for vertex in vertices]))
bpy.ops.export_scene.gltf(filepath=f"{folder}/theirs.glb", export_format="GLB")
for part in bpy.data.objects:
    part.select_set(part is armature)
bpy.context.view_layer.objects.active = armature
bpy.ops.export_anim.bvh(
    filepath=f"{folder}/theirs.bvh", frame_start=0, frame_end=3, rotate_mode="NATIVE"
)
"""


@pytest.mark.skipif(
    not BLENDER, reason="needs a Python with Blender's module bpy (HUMANGS_BLENDER: its path)"
)
@pytest.mark.slow
def test_blender_shows_our_frames_and_we_read_its_files(tmp_path):
    """Blender shows our vertices with z up; its .glb and .bvh files hold our motion."""
    one = avatar()
    rest = RestBody(one.rest_vertices, one.rest_joints)
    motion = grounded(dance(4), rest, PARENTS)
    write_mesh_glb(tmp_path / "ours.glb", one, mesh(), motion)
    done = subprocess.run(
        [BLENDER, "-c", THROUGH_BLENDER, tmp_path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    shown = np.load(tmp_path / "frame.npy") @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # z up to y up
    np.testing.assert_allclose(shown, skinned(tmp_path / "ours.glb", 2), atol=1e-4)

    for name in ("theirs.glb", "theirs.bvh"):
        back = grounded(load_motion(tmp_path / name, rest_joints=one.rest_joints), rest, PARENTS)
        np.testing.assert_allclose(matrices(back), matrices(motion), atol=1e-3, err_msg=name)
        np.testing.assert_allclose(back.translations, motion.translations, atol=1e-3, err_msg=name)
        assert back.fps == pytest.approx(24, rel=1e-4)
