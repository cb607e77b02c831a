"""Faces in files: tables, MediaPipe's scores, weights and expressions in animations.

Written faces come back as well.
"""

import json

import jax.numpy as jnp
import numpy as np
import pytest
from small import f32

from humangs_jax.avatar.attach_face import faced
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import export
from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.body.library import load_body
from humangs_jax.body.model import shape_body
from humangs_jax.body.motion import Motion
from humangs_jax.core.pytree import replace
from humangs_jax.io.mesh import GlbWriter
from humangs_jax.motion import MotionError, load_motion
from humangs_jax.motion.face_files import has_scores
from humangs_jax.motion.face_tracks import ARKIT, arkit_name, of_preset
from humangs_jax.rendering.gaussians import Gaussians


def coefficients(motion, name):
    return np.asarray(motion.expressions_of((name,))[:, 0])


def table(path, names, rows, codes):
    lines = [",".join(["Timecode", "BlendShapeCount", *names])]
    lines += [",".join([code, "61", *map(str, row)]) for code, row in zip(codes, rows, strict=True)]
    path.write_text("\n".join(lines))
    return path


def test_names_are_compared_without_case_in_both_spellings():
    for name in ("EyeBlinkLeft", "eyeBlinkLeft", "eyeBlink_L", "EYEBLINK_L", "face.eyeBlinkLeft"):
        assert arkit_name(name) == "eyeBlinkLeft"
    assert arkit_name("eyeBlink_R") == "eyeBlinkRight" and arkit_name("_neutral") is None
    assert of_preset("Blink") == {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0}
    assert all(name in ARKIT for shapes in map(of_preset, ("happy", "aa", "ou")) for name in shapes)


@pytest.mark.parametrize("spelling", ["lower", "reversed"])
def test_a_table_of_live_link_face_is_read_in_any_order(tmp_path, spelling):
    names = [name[0].upper() + name[1:] for name in ARKIT] + ["HeadYaw", "HeadPitch", "HeadRoll"]
    names = [name[0].lower() + name[1:] for name in names] if spelling == "lower" else names
    names = names[::-1] if spelling == "reversed" else names
    values = dict(zip(names, np.linspace(0, 0.9, len(names)), strict=True))
    yaw = next(name for name in names if name.lower() == "headyaw")
    values |= {name: 0.0 for name in names if name.lower() in ("headpitch", "headroll")}
    values[yaw] = 0.3
    rows = [[values[name] * (i + 1) / 3 for name in names] for i in range(3)]
    codes = [f"10:20:30:{i:02}.125" for i in (0, 1, 2)]
    motion = load_motion(table(tmp_path / "take.csv", names, rows, codes))
    assert motion.fps == 60 and motion.expression_names == ARKIT
    jaw = next(name for name in names if name.lower() == "jawopen")
    np.testing.assert_allclose(
        coefficients(motion, "jawOpen"), values[jaw] * np.arange(1, 4) / 3, atol=1e-6
    )
    head = np.asarray(motion.rotations[2, JOINT_NAMES.index("head")])
    np.testing.assert_allclose(head, [0, 0.3, 0], atol=1e-6)
    # the arms hang: nobody talks in a T-pose
    assert motion.rotations[0, JOINT_NAMES.index("left_shoulder"), 2] < -1


def test_a_line_may_end_before_its_timecode(tmp_path):
    lines = [[*ARKIT, "Timecode"], [0.5] * len(ARKIT), [*[0.5] * len(ARKIT), "10:20:30:01"]]
    path = tmp_path / "take.csv"
    path.write_text("\n".join(",".join(map(str, line)) for line in lines))
    assert np.allclose(coefficients(load_motion(path), "jawOpen"), 0.5)


def test_frames_that_a_table_leaves_out_are_filled_in(tmp_path):
    names = ["JawOpen", "EyeBlinkLeft", "EyeBlinkRight", "MouthFunnel", "TongueOut"]
    rows = [[value] * 5 for value in (0.0, 0.1, 0.4)]
    codes = ["10:20:30:58", "10:20:30:59", "10:20:31:02"]
    motion = load_motion(table(tmp_path / "take.csv", names, rows, codes))
    np.testing.assert_allclose(coefficients(motion, "jawOpen"), [0, 0.1, 0.2, 0.3, 0.4], atol=1e-6)


def test_tables_without_faces_name_what_was_expected(tmp_path):
    (tmp_path / "a.csv").write_text("time,speed\n1,2\n")
    with pytest.raises(MotionError, match=r"a\.csv: expected a line with names of ARKit's shapes"):
        load_motion(tmp_path / "a.csv")
    names = ["JawOpen", "EyeBlinkLeft", "EyeBlinkRight", "MouthFunnel", "TongueOut"]
    bad = table(tmp_path / "b.csv", names, [[0, 0, "x", 0, 0]], ["00:00:00:00"])
    with pytest.raises(MotionError, match="line 2: EyeBlinkRight: expected a number, got 'x'"):
        load_motion(bad)


@pytest.mark.parametrize("layout", ["categories", "objects", "snake"])
def test_scores_of_mediapipe_are_read(tmp_path, layout):
    scores = {name: 0.01 * i for i, name in enumerate(ARKIT[:-1])} | {"_neutral": 0.9}
    if layout == "objects":
        frame = scores
    else:
        key = "categoryName" if layout == "categories" else "category_name"
        frame = {
            "faceBlendshapes": [{"categories": [{key: n, "score": s} for n, s in scores.items()]}]
        }
    content = {"fps": 25, "frames": [frame, {}, frame]}
    (tmp_path / "scores.json").write_text(json.dumps(content))
    motion = load_motion(tmp_path / "scores.json")
    assert motion.fps == 25 and len(motion.translations) == 3  # the face is missed in one
    for name in ("jawOpen", "noseSneerRight"):
        np.testing.assert_allclose(coefficients(motion, name), scores[name], atol=1e-6)
    assert not coefficients(motion, "tongueOut").any()


def test_a_score_that_is_no_number_is_named_by_the_reader_and_not_by_the_recognizer(tmp_path):
    file = tmp_path / "scores.json"
    scores = dict.fromkeys(ARKIT[:6], 0.5)
    for bad in ("high", None, True, [0.5]):
        file.write_text(json.dumps([scores | {ARKIT[2]: bad}]))
        assert has_scores(file)
        with pytest.raises(MotionError, match=f"scores.json: {ARKIT[2]}: expected a number, got"):
            load_motion(file)


def test_a_motion_beside_texts_by_the_names_of_shapes_is_a_motion(tmp_path):
    file = tmp_path / "motion.json"
    texts = dict.fromkeys(ARKIT[:6], "a mesh")
    content = {"poses": [0.0] * 165, "trans": [0.0] * 3, "mocap_framerate": 30.0}
    file.write_text(json.dumps(content | {"shapes": [texts]}))
    assert not has_scores(file)
    motion = load_motion(file)
    assert len(motion.translations) == 1 and motion.expressions is None


def test_expressions_of_smplx_keep_their_numbers(tmp_path):
    arrays = {
        "poses": np.zeros((4, 165)),
        "trans": np.zeros((4, 3)),
        "mocap_framerate": 30.0,
        "expressions": np.random.default_rng(0).normal(size=(4, 100)),
    }
    np.savez(tmp_path / "beat.npz", **arrays)
    motion = load_motion(tmp_path / "beat.npz")
    np.testing.assert_allclose(
        coefficients(motion, "expression_3"), arrays["expressions"][:, 3], rtol=1e-6
    )
    assert motion.expressions_of(ARKIT) is None  # they are none of ARKit's
    np.savez(tmp_path / "short.npz", **arrays | {"expressions": np.zeros((3, 100))})
    assert load_motion(tmp_path / "short.npz").expressions is None


def person():
    body = load_body()
    rest = shape_body(body, jnp.zeros(0))
    g = len(body.template)
    gaussians = Gaussians(
        means=rest.vertices,
        quats=jnp.tile(f32([1, 0, 0, 0]), (g, 1)),
        scales=jnp.full((g, 3), 0.004),
        opacities=jnp.full(g, 0.9),
        colors=jnp.full((g, 3), 0.5),
    )
    return Avatar(
        gaussians, body.skinning_weights, rest.vertices, rest.joints, body.faces, body.parents,
        body.joint_names,
    )  # fmt: skip


@pytest.fixture(scope="module")
def talking():
    """Returns a motion whose mouth opens; it is not yet that of an avatar."""
    rng = np.random.default_rng(1)
    faces = np.zeros((5, 52), np.float32)
    faces[:, ARKIT.index("jawOpen")] = np.linspace(0, 1, 5)
    faces[:, ARKIT.index("eyeBlinkLeft")] = 0.25
    turns = f32(0.1 * rng.normal(size=(5, 55, 3)))
    return Motion(turns, jnp.zeros((5, 3)), 25.0, jnp.asarray(faces), ARKIT)


def test_a_written_vrm_animation_reads_as_the_same_motion(tmp_path, talking):
    avatar = person()
    export(tmp_path / "talk.vrma", avatar, talking)
    read = load_motion(tmp_path / "talk.vrma", rest_joints=avatar.rest_joints)
    assert read.fps == 25
    for name in ("jawOpen", "eyeBlinkLeft"):
        np.testing.assert_allclose(coefficients(read, name), coefficients(talking, name), atol=1e-6)
    elbow = JOINT_NAMES.index("left_elbow")
    np.testing.assert_allclose(read.rotations[:, elbow], talking.rotations[:, elbow], atol=1e-4)


def test_a_vrm_animation_needs_a_motion(tmp_path):
    with pytest.raises(ValueError, match="expected a motion"):
        export(tmp_path / "x.vrma", person())
    assert not list(tmp_path.iterdir())


def test_an_exported_body_has_the_shapes_as_morph_targets(tmp_path, talking, monkeypatch):
    from humangs_jax.avatar.export import mesh

    avatar = faced(person())
    vertices, n = np.asarray(avatar.rest_vertices), len(avatar.rest_vertices)
    flat = mesh.BodyMesh(
        vertices, np.tile(np.float32([0, 0, 1]), (n, 1)), np.asarray(avatar.faces),
        np.zeros((n, 2), np.float32), np.zeros((4, 4, 3), np.uint8),
        np.asarray(avatar.skinning_weights), np.arange(n),
    )  # fmt: skip
    mesh.write_mesh_glb(tmp_path / "talk.glb", avatar, flat, talking)
    data = (tmp_path / "talk.glb").read_bytes()
    content = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert content["meshes"][0]["extras"]["targetNames"] == list(ARKIT)
    jaw = content["meshes"][0]["primitives"][0]["targets"][ARKIT.index("jawOpen")]["POSITION"]
    assert content["accessors"][jaw]["sparse"]["count"] == 2249
    assert min(content["accessors"][jaw]["min"]) == pytest.approx(-0.0343, abs=1e-3)
    read = load_motion(tmp_path / "talk.glb", rest_joints=avatar.rest_joints)
    np.testing.assert_allclose(
        coefficients(read, "jawOpen"), coefficients(talking, "jawOpen"), atol=1e-6
    )
    posed = flat.posed(avatar, talking.pose(4, avatar.expression_names))
    still = flat.posed(avatar, talking.pose(4))
    assert np.linalg.norm(posed.vertices - still.vertices, axis=1).max() > 0.035


def test_weights_of_meshes_are_read_by_name_and_others_left_out(tmp_path, caplog):
    writer = GlbWriter()
    times = writer.array("SCALAR", np.arange(3) / 30.0)
    weights = np.stack([[0.0, 0.5, 1.0], [0.1, 0.1, 0.1], [1, 1, 1]], axis=1)
    output = writer.array("SCALAR", weights.reshape(-1))
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    animation = {"channels": [channel], "samplers": [{"input": times, "output": output}]}
    mesh = {"primitives": [], "extras": {"targetNames": ["Jaw_Open", "eyeBlink_R", "ears"]}}
    content = {"nodes": [{"mesh": 0}], "meshes": [mesh], "animations": [animation]}
    writer.write(tmp_path / "face.glb", content)
    motion = load_motion(tmp_path / "face.glb")
    np.testing.assert_allclose(coefficients(motion, "jawOpen"), [0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(coefficients(motion, "eyeBlinkRight"), 0.1, atol=1e-6)
    assert motion.fps == pytest.approx(30, rel=1e-5) and "left out (ears)" in caplog.text


def test_a_face_whose_keys_are_not_evenly_spaced_keeps_its_time(tmp_path):
    writer = GlbWriter()
    times = writer.array("SCALAR", np.asarray([0, 1, 5]) / 30)
    output = writer.array("SCALAR", np.asarray([0, 0.2, 1.0]))
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    animation = {"channels": [channel], "samplers": [{"input": times, "output": output}]}
    mesh = {"primitives": [], "extras": {"targetNames": ["jawOpen"]}}
    content = {"nodes": [{"mesh": 0}], "meshes": [mesh], "animations": [animation]}
    writer.write(tmp_path / "face.glb", content)
    motion = load_motion(tmp_path / "face.glb")
    assert motion.fps == pytest.approx(30, rel=1e-5)
    np.testing.assert_allclose(
        coefficients(motion, "jawOpen"), [0, 0.2, 0.4, 0.6, 0.8, 1], atol=1e-6
    )


def test_parts_and_rates_of_a_motion_keep_its_face(talking):
    part = talking.part(slice(1, 4))
    np.testing.assert_array_equal(part.expressions, talking.expressions[1:4])
    slow = replace(talking, fps=10.0).at_rate(20.0)
    assert slow.expressions.shape == (10, 52)
