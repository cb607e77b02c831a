"""The page's own readers of motions against Python's, on the same files: node runs the scripts as they are put into the page."""

import functools
import io
import json
import shutil
import subprocess

import numpy as np
import pytest
from bvh_files import CMU, INDEX, LAFAN, MIXAMO, frames_along_bones, rest_frames, write_bvh
from motion_cases import FPS, UP, in_world, motions
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.data.formats import MOTIONS
from humangs_jax.data.motion import load_motion
from humangs_jax.data.motion.skeleton import shipped_joints
from humangs_jax.viewer.page import page_script

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="needs node (nodejs.org)")
EXACT = 1e-5
"""Entries of rotation matrices and metres: float32, and BVH's eight decimals."""
PROGRAM = """
const given = JSON.parse(require("fs").readFileSync(0, "utf8")), { scene } = given;
scene.order = jointOrder(scene.parents);
(async () => {
  const found = [];
  for (const [name, content] of given.files) {
    const bytes = Buffer.from(content, "base64");
    const file = { name, size: bytes.length, arrayBuffer: async () => new Uint8Array(bytes).buffer };
    found.push(await readMotionFile(file, scene).catch((error) => ({ error: error.message })));
  }
  process.stdout.write(JSON.stringify(found));
})();
"""


def page_reads(files, names=JOINT_NAMES, parents=PARENTS, rest=None):
    """What the page makes of files, [(name, bytes)]: motions as JSON, or {"error": ...}."""
    import base64

    rest = shipped_joints() if rest is None else rest
    scene = {"rest": np.asarray(rest).tolist(), "parents": list(parents), "names": list(names)}
    given = {"scene": scene, "files": [(name, base64.b64encode(content).decode()) for name, content in files]}
    program = page_script("kinematics", "scene", "motion_files", "skeletons") + PROGRAM
    done = subprocess.run(
        [str(NODE), "--input-type=commonjs", "-e", program],
        **{"input": json.dumps(given), "capture_output": True, "text": True, "check": False},
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def npz(**arrays):
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def matrices(rotations):
    return Rotation.from_rotvec(np.reshape(rotations, (-1, 3))).as_matrix()


def dance(frames=4, names=MIXAMO, seed=0):
    poses = np.random.default_rng(seed).normal(size=(frames, 55, 3)) * 0.5
    poses[:, [i for i, name in enumerate(JOINT_NAMES) if name not in names]] = 0
    return poses


def other_person():
    """Longer shins, shorter thighs, wider hips; the lowest joint of the spine lies in the pelvis."""
    rest, stretch = shipped_joints(), {"knee": 0.85, "ankle": 1.2, "hip": 1.3, "elbow": 1.1, "spine1": 0.0}
    out = rest.copy()
    for j, parent in enumerate(PARENTS[1:], 1):
        out[j] = out[parent] + stretch.get(JOINT_NAMES[j].split("_")[-1], 1.0) * (rest[j] - rest[parent])
    return out


@functools.cache
def skeletons():
    source, moves = other_person(), np.random.default_rng(2).normal(size=(4, 3))
    poses = lambda names: dance(names=names)
    files = {
        "A-pose": write_bvh(source, poses(CMU), CMU, rest_frames(arms_down=48), moves, unit=1 / 0.45 / 0.0254),
        "turned": write_bvh(source, poses(MIXAMO), MIXAMO, rest_frames(arms_down=40, turned=90), moves),
        "z up": write_bvh(source, poses(CMU), CMU, moves=moves, up=UP["z"]),
        "no standing": write_bvh(source, poses(LAFAN), LAFAN, frames_along_bones(source), moves),
    }
    for seed in range(3):
        turns = Rotation.random(4, random_state=seed)
        files[f"turned pelvis {seed}"] = write_bvh(source, poses(CMU), CMU, moves=moves, pelvis=turns)
    spaced = {ours: f"Bip 01 \t {theirs.replace('Left', 'L  ').replace('Right', 'R ')}" for ours, theirs in CMU.items()}
    files["spaces"] = write_bvh(source, poses(CMU), spaced, moves=moves)
    files["spaces, braces, lines of Windows"] = files["spaces"].replace("\n\t", " \n").replace("\r", "").replace("\n", "\r\n")
    unity = {
        "UpLeg": "UpperLeg",
        "Leg": "LowerLeg",
        "ForeArm": "LowerArm",
        "Arm": "UpperArm",
        "ToeBase": "Toes",
        "Hips": "J_Hips",
    }
    for kind, names in {
        "Unity": {ours: unity.get(theirs, theirs) for ours, theirs in CMU.items()}
        | {
            ours: theirs[: -len(w)] + unity[w]
            for w in unity
            for ours, theirs in CMU.items()
            if theirs in ("Left" + w, "Right" + w)
        },
        "unknown": {ours: f"part {i}" for i, ours in enumerate(CMU)},
        "Rigify": CMU | {"pelvis": "spine", "neck": "spine.004", "head": "spine.006"},
        "no toes": {ours: theirs for ours, theirs in CMU.items() if not ours.endswith("_foot")},
    }.items():
        files[kind] = write_bvh(source, poses(names), names, moves=moves)
    short = {ours: theirs for ours, theirs in LAFAN.items() if not ours.endswith("_foot")}
    files["no toes, no standing"] = write_bvh(source, poses(short), short, frames_along_bones(source), moves)
    files["odd names"] = files["A-pose"].replace("JOINT Head", "JOINT constructor").replace("JOINT Neck", "JOINT __proto__")
    for kind in ("walking", "crawling", "lying on the back", "handstand"):
        rotations, translations = motions()[kind]
        body = rotations * np.isin(JOINT_NAMES, list(CMU))[:, None]
        moved = translations + shipped_joints()[0]
        files[f"{kind}, z up"] = write_bvh(shipped_joints(), body, CMU, moves=moved, up=UP["z"])
        turned, moved = in_world(body, translations, UP["z"])
        files[f"{kind} along z"] = write_bvh(shipped_joints(), turned, CMU, moves=moved + shipped_joints()[0])
    return files


def array_files():
    """Every format that the page knows, and people on the floor in worlds with y, z and -y up."""
    rng = np.random.default_rng(0)
    poses, trans = rng.normal(0, 0.3, (4, 165)), rng.normal(0, 0.2, (4, 3))
    hands = {"left_hand_pose": poses[:, 75:120], "right_hand_pose": poses[:, 120:], "jaw_pose": poses[:, 66:69]}
    parts = {"global_orient": poses[:, :3] * 0.2, "body_pose": poses[:, 3:66], "transl": trans}
    files = {
        "ours": {"rotations": poses.reshape(4, 55, 3).astype("f4"), "translations": trans, "fps": 24.0},
        "AMASS": {"poses": poses, "trans": trans, "mocap_framerate": 120},
        "AMASS 156": {"poses": np.asfortranarray(poses[:, :156]), "trans": trans, "mocap_frame_rate": 60},
        "72": {"pose": poses[:, :72].reshape(4, 24, 3), "transl": trans, "fps": np.asarray([30])},
        "66": {"fullpose": poses[:, :66], "trans": trans.astype("f4"), "fps": 30},
        "BEAT2": {"poses": poses, "trans": trans, "mocap_frame_rate": 30, "expressions": np.zeros((4, 100))},
        "AIST++": {"smpl_poses": poses[:, :72], "smpl_trans": 1000 * trans},
        "AIST++ scaled": {"smpl_poses": poses[:, :72], "smpl_trans": 93 * trans, "smpl_scaling": np.asarray([93.0])},
        "parts": parts | hands,
        "parts of SMPL": parts | {"body_pose": np.pad(parts["body_pose"], ((0, 0), (0, 6)))},
        "matrices": {key: matrices(x).reshape(4, -1, 3, 3) for key, x in parts.items() if key != "transl"} | {"transl": trans},
        "no places": {key: x for key, x in parts.items() if key != "transl"},
        "smplcodec": {
            "bodyPose": poses[:, :66].reshape(4, 22, 3),
            "headPose": poses[:, 66:75].reshape(4, 3, 3),
            "bodyTranslation": trans,
            "frameRate": 24.0,
        },
        "HuMoR": {"root_orient": poses[:, :3], "pose_body": poses[:, 3:66], "pose_hand": poses[:, 75:], "trans": trans},
        "LHM": {"root_pose": poses[:, :3], "body_pose": poses[:, 3:66].reshape(4, 21, 3), "trans": trans},
    }
    for kind, (rotations, translations) in motions().items():
        for up, turn in UP.items():
            for heading in (90,):
                turned, moved = in_world(rotations, translations, turn * Rotation.from_euler("y", heading, degrees=True))
                flat = turned.reshape(len(turned), -1)
                name = f"{kind}, {up} up, heading {heading}"
                files[f"AMASS: {name}"] = {"poses": flat, "trans": moved, "mocap_framerate": FPS}
                files[f"parts: {name}"] = {"global_orient": flat[:, :3], "body_pose": flat[:, 3:66], "transl": moved, "fps": FPS}
    return files


def compare(tmp_path, caplog, files):
    """files: (name, bytes) by what they are."""
    for (case, (name, content)), page in zip(files.items(), page_reads(files.values()), strict=True):
        (tmp_path / name).write_bytes(content)
        caplog.clear()
        motion = load_motion(tmp_path / name, rest_joints=shipped_joints())
        assert "error" not in page, (case, page)
        theirs = Rotation.from_quat(np.reshape(page["quats"], (-1, 4))[:, [1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(theirs, matrices(motion.rotations), atol=EXACT, err_msg=case)
        np.testing.assert_allclose(page["translations"], motion.translations, atol=EXACT, err_msg=case)
        assert page["fps"] == pytest.approx(motion.fps, rel=1e-6), case
        said = " ".join(caplog.messages)
        assert bool(page["said"]) == bool(said) and page["said"] in said, (case, page["said"], said)


def test_the_page_reads_skeletons_as_python_does(tmp_path, caplog):
    compare(tmp_path, caplog, {case: ("dance.bvh", text.encode()) for case, text in skeletons().items()})


def test_the_page_reads_arrays_as_python_does(tmp_path, caplog):
    files = array_files()
    known = {each.arrays.keys for each in MOTIONS.values() if each.arrays and each.arrays.page}
    assert {keys for keys in known if any(set(keys) <= set(arrays) for arrays in files.values())} == known
    compare(tmp_path, caplog, {case: ("dance.npz", npz(**arrays)) for case, arrays in files.items()})


POSES = {"poses": np.zeros((2, 66)), "trans": np.zeros((2, 3))}
HEAD = "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\nEnd Site\n{\nOFFSET 0 0 0\n}\n}\n"
MOVED = b"MOTION\nFrames: 1\nFrame Time: 1\n0 0 0"
BAD = {
    "rate": ("a.npz", npz(**POSES, fps=np.inf), "expected a positive number of frames per second, got Infinity"),
    "no rate": ("a.npz", npz(**POSES), "key mocap_framerate: missing"),
    "slow": ("a.npz", npz(**POSES, fps=5e-324), "expected a positive number of frames per second"),
    "negative": ("a.npz", npz(**POSES, fps=-1), "expected a positive number of frames per second, got -1"),
    "far": ("a.npz", npz(**(POSES | {"trans": np.full((2, 3), 1e6)}), fps=30), "expected metres, at most 10000"),
    "scaling": ("a.npz", npz(smpl_poses=np.zeros((2, 72)), smpl_trans=np.zeros((2, 3)), smpl_scaling=0), "a positive number"),
    "huge": ("a.npz", npz(**(POSES | {"poses": np.full((2, 66), 1e300)}), fps=30), "key poses: expected finite numbers"),
    "keys": ("a.npz", npz(constructor=np.zeros((2, 3)), __proto__=np.zeros(2)), "expected one of the keys rotations, "),
    "odd type": ("a.npz", npz(poses=np.zeros((2, 66), "c16"), trans=np.zeros((2, 3)), fps=30), "expected one of the keys"),
    "odd channel": ("a.bvh", HEAD.replace("Zrotation", "constructor").encode(), "expected up to 6 channels"),
    "odd joint": ("a.bvh", HEAD.replace("Hips", "__proto__").encode() + MOVED, "no joint"),
    "instant": ("a.bvh", (HEAD + "MOTION\nFrames: 1\nFrame Time: 5e-324\n0 0 0").encode(), "a positive Frame Time"),
    "brace": ("a.bvh", b"HIERARCHY {", "unknown word {"),
    "open": ("a.bvh", b"HIERARCHY ROOT Hips { OFFSET 0 0 0", "a brace of the joints is open"),
    "cut": ("a.bvh", b"HIERARCHY ROOT Hips { OFFSET 0 0", "cut short"),
    "truncated": ("a.npz", npz(**POSES, fps=30)[:-60], "not an npz archive, or cut short"),
    "width": ("a.npz", npz(poses=np.zeros((2, 30)), trans=np.zeros((2, 3)), fps=30), "poses: expected frames of 165 or "),
    "words": ("a.bvh", b"hello", "not a BVH file"),
    "strange": (
        "a.bvh",
        HEAD.replace("Hips", "Tail").encode() + MOVED,
        "expected the names of",
    ),
}


def test_the_page_refuses_what_it_cannot_draw():
    found = page_reads([(name, content) for name, content, _ in BAD.values()])
    for (case, (name, _, expected)), page in zip(BAD.items(), found, strict=True):
        message = page.get("error", "")
        assert message.startswith(f"{name}: ") and expected in message and "\n" not in message, (case, page)


@pytest.mark.parametrize("name", ["constructor", "__proto__", "toString"])
def test_an_avatar_may_have_joints_of_any_name(name):
    rest = np.concatenate([shipped_joints(), [[0, 0.5, 0.1]]])
    (page,) = page_reads([("dance.bvh", skeletons()["A-pose"].encode())], (*JOINT_NAMES, name), (*PARENTS, INDEX["head"]), rest)
    (usual,) = page_reads([("dance.bvh", skeletons()["A-pose"].encode())])
    np.testing.assert_allclose(np.asarray(page["quats"])[:, :55], usual["quats"], atol=EXACT)
    np.testing.assert_allclose(np.abs(np.asarray(page["quats"])[:, 55, 0]), 1, atol=EXACT)  # as its parent


def test_the_page_has_no_tables_of_its_own():
    from humangs_jax.viewer.page import read_part

    own = "".join(read_part(f"{name}.js") for name in ("motion_files", "skeletons"))
    for word in ("upleg", "toebase", "mocap", "smpl_", "body_pose", "clavicle", "0.35"):
        assert word not in own, word
