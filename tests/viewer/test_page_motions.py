"""The page's readers of motions against Python's, on the same files.

node runs the scripts as they are put into the page.
"""

import functools
import io
import json
import shutil
import subprocess

import numpy as np
import pytest
from bvh_files import CMU, INDEX, LAFAN, MIXAMO, frames_along_bones, rest_frames, write_bvh
from glb_files import write_glb
from motion_cases import FPS, UP, in_world, motions
from PIL import Image
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.data.formats import MOTIONS
from humangs_jax.io.images import is_own_picture, read_image, write_png
from humangs_jax.io.mesh import GlbWriter
from humangs_jax.motion import load_motion
from humangs_jax.motion.skeleton import shipped_joints
from humangs_jax.viewer.page import page_script

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="needs node (nodejs.org)")
EXACT = 1e-5
"""Error of rotation matrices and metres in float32 and with BVH's eight decimals."""
HOW_TO_CHANGE = ", which --motion-fps (in Python fps=) changes"
"""Text that only Python adds: the page has a field for it."""
PROGRAM = """
const given = JSON.parse(require("fs").readFileSync(0, "utf8")), { scene } = given;
scene.order = jointOrder(scene.parents);
(async () => {
  const found = [];
  for (const [name, content, rate, clip] of given.files) {
    const bytes = Buffer.from(content, "base64");
    const arrayBuffer = async () => new Uint8Array(bytes).buffer;
    const file = { name, size: bytes.length, arrayBuffer };
    found.push(await readMotionFile(file, scene, rate ?? null, clip ?? 0)
      .catch(({ message, asksRate }) => ({ error: message, asksRate })));
  }
  process.stdout.write(JSON.stringify(found));
})();
"""


def page_reads(files, names=JOINT_NAMES, parents=PARENTS, rest=None):
    """Returns the motions that the page reads from files [(name, bytes)], as JSON.

    Frames per second and the index of the clip may follow the bytes. An error is {"error": ...,
    "asksRate": ...}.
    """
    import base64

    rest = shipped_joints() if rest is None else rest
    scene = {"rest": np.asarray(rest).tolist(), "parents": list(parents), "names": list(names)}
    given = {
        "scene": scene,
        "files": [
            (name, base64.b64encode(content).decode(), *more) for name, content, *more in files
        ],
    }
    program = page_script("kinematics", "scene", "motion_files", "skeletons", "glb") + PROGRAM
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
    """Returns joints of another person: longer shins, shorter thighs, wider hips.

    The lowest joint of the spine lies in the pelvis.
    """
    rest, stretch = (
        shipped_joints(),
        {"knee": 0.85, "ankle": 1.2, "hip": 1.3, "elbow": 1.1, "spine1": 0.0},
    )
    out = rest.copy()
    for j, parent in enumerate(PARENTS[1:], 1):
        out[j] = out[parent] + stretch.get(JOINT_NAMES[j].split("_")[-1], 1.0) * (
            rest[j] - rest[parent]
        )
    return out


@functools.cache
def skeletons():
    source, moves = other_person(), np.random.default_rng(2).normal(size=(4, 3))
    poses = lambda names: dance(names=names)
    files = {
        "A-pose": write_bvh(
            source, poses(CMU), CMU, rest_frames(arms_down=48), moves, unit=1 / 0.45 / 0.0254
        ),
        "turned": write_bvh(
            source, poses(MIXAMO), MIXAMO, rest_frames(arms_down=40, turned=90), moves
        ),
        "z up": write_bvh(source, poses(CMU), CMU, moves=moves, up=UP["z"]),
        "no standing": write_bvh(source, poses(LAFAN), LAFAN, frames_along_bones(source), moves),
    }
    # joints that turn and are turned back, and names in other spellings
    for seed in range(3):
        turns = Rotation.random(4, random_state=seed)
        files[f"turned pelvis {seed}"] = write_bvh(
            source, poses(CMU), CMU, moves=moves, pelvis=turns
        )
    spaced = {
        ours: f"Bip 01 \t {theirs.replace('Left', 'L  ').replace('Right', 'R ')}"
        for ours, theirs in CMU.items()
    }
    files["spaces"] = write_bvh(source, poses(CMU), spaced, moves=moves)
    files["spaces, braces, lines of Windows"] = (
        files["spaces"].replace("\n\t", " \n").replace("\r", "").replace("\n", "\r\n")
    )
    unity = {
        "UpLeg": "UpperLeg",
        "Leg": "LowerLeg",
        "ForeArm": "LowerArm",
        "Arm": "UpperArm",
        "ToeBase": "Toes",
        "Hips": "J_Hips",
    }
    for kind, names in {
        "Unity": (
            {ours: unity.get(theirs, theirs) for ours, theirs in CMU.items()}
            | {
                ours: theirs[: -len(w)] + unity[w]
                for w in unity
                for ours, theirs in CMU.items()
                if theirs in ("Left" + w, "Right" + w)
            }
        ),
        "unknown": {ours: f"part {i}" for i, ours in enumerate(CMU)},
        "Rigify": CMU | {"pelvis": "spine", "neck": "spine.004", "head": "spine.006"},
        "no toes": {ours: theirs for ours, theirs in CMU.items() if not ours.endswith("_foot")},
    }.items():
        files[kind] = write_bvh(source, poses(names), names, moves=moves)
    short = {ours: theirs for ours, theirs in LAFAN.items() if not ours.endswith("_foot")}
    files["no toes, no standing"] = write_bvh(
        source, poses(short), short, frames_along_bones(source), moves
    )
    files["odd names"] = (
        files["A-pose"]
        .replace("JOINT Head", "JOINT constructor")
        .replace("JOINT Neck", "JOINT __proto__")
    )
    # people on the floor, in worlds with another up
    for kind in ("walking", "crawling", "lying on the back", "handstand"):
        rotations, translations = motions()[kind]
        body = rotations * np.isin(JOINT_NAMES, list(CMU))[:, None]
        moved = translations + shipped_joints()[0]
        files[f"{kind}, z up"] = write_bvh(shipped_joints(), body, CMU, moves=moved, up=UP["z"])
        turned, moved = in_world(body, translations, UP["z"])
        files[f"{kind} along z"] = write_bvh(
            shipped_joints(), turned, CMU, moves=moved + shipped_joints()[0]
        )
    return files


def array_files():
    """Returns arrays of every format that the page knows, by name.

    They include people on the floor in worlds with y, z and -y up.
    """
    rng = np.random.default_rng(0)
    poses, trans = rng.normal(0, 0.3, (4, 165)), rng.normal(0, 0.2, (4, 3))
    # random poses by the names of every data set
    hands = {
        "left_hand_pose": poses[:, 75:120],
        "right_hand_pose": poses[:, 120:],
        "jaw_pose": poses[:, 66:69],
    }
    parts = {"global_orient": poses[:, :3] * 0.2, "body_pose": poses[:, 3:66], "transl": trans}
    files = {
        "ours": {
            "rotations": poses.reshape(4, 55, 3).astype("f4"),
            "translations": trans,
            "fps": 24.0,
        },
        "AMASS": {"poses": poses, "trans": trans, "mocap_framerate": 120},
        "AMASS 156": {
            "poses": np.asfortranarray(poses[:, :156]),
            "trans": trans,
            "mocap_frame_rate": 60,
        },
        "72": {"pose": poses[:, :72].reshape(4, 24, 3), "transl": trans, "fps": np.asarray([30])},
        "66": {"fullpose": poses[:, :66], "trans": trans.astype("f4"), "fps": 30},
        "BEAT2": {
            "poses": poses,
            "trans": trans,
            "mocap_frame_rate": 30,
            "expressions": np.zeros((4, 100)),
        },
        "AIST++": {"smpl_poses": poses[:, :72], "smpl_trans": 1000 * trans},
        "AIST++ scaled": {
            "smpl_poses": poses[:, :72],
            "smpl_trans": 93 * trans,
            "smpl_scaling": np.asarray([93.0]),
        },
        "parts": parts | hands,
        "parts of SMPL": parts | {"body_pose": np.pad(parts["body_pose"], ((0, 0), (0, 6)))},
        "matrices": (
            {key: matrices(x).reshape(4, -1, 3, 3) for key, x in parts.items() if key != "transl"}
            | {"transl": trans}
        ),
        "no places": {key: x for key, x in parts.items() if key != "transl"},
        "smplcodec": {
            "bodyPose": poses[:, :66].reshape(4, 22, 3),
            "headPose": poses[:, 66:75].reshape(4, 3, 3),
            "bodyTranslation": trans,
            "frameRate": 24.0,
        },
        "HuMoR": {
            "root_orient": poses[:, :3],
            "pose_body": poses[:, 3:66],
            "pose_hand": poses[:, 75:],
            "trans": trans,
        },
        "LHM": {
            "root_pose": poses[:, :3],
            "body_pose": poses[:, 3:66].reshape(4, 21, 3),
            "trans": trans,
        },
    }
    # people on the floor: which axis is up is found by the poses
    for kind, (rotations, translations) in motions().items():
        for up, turn in UP.items():
            for heading in (90,):
                turned, moved = in_world(
                    rotations, translations, turn * Rotation.from_euler("y", heading, degrees=True)
                )
                flat = turned.reshape(len(turned), -1)
                name = f"{kind}, {up} up, heading {heading}"
                files[f"AMASS: {name}"] = {"poses": flat, "trans": moved, "mocap_framerate": FPS}
                files[f"parts: {name}"] = {
                    "global_orient": flat[:, :3],
                    "body_pose": flat[:, 3:66],
                    "transl": moved,
                    "fps": FPS,
                }
    return files


def glb_files(folder):
    """Yields (name, file) of skeletons as programs write them.

    Among them are a turned node in centimetres, keys of all kinds, and VRM's names.
    """
    rest, moves = other_person(), np.random.default_rng(2).normal(size=(5, 3))
    quarter = Rotation.from_euler("x", 90, degrees=True)
    matrix = np.eye(4)
    matrix[:3, :3] = 0.01 * quarter.inv().as_matrix()
    # z is up below this node, and a unit is a centimetre
    above = {"name": "Armature", "matrix": matrix.T.reshape(-1).tolist()}
    turned = [quarter.apply(pose) for pose in dance(5)]
    bones = {f"{side} {i}": {"node": i} for i, side in enumerate(CMU)}
    human = [
        {"bone": theirs, "node": node["node"]}
        for theirs, node in zip(CMU.values(), bones.values(), strict=True)
    ]
    scrambled = {ours: f"thing {i}" for i, ours in enumerate(CMU)}
    made = {
        "linear": (rest, dance(5), moves, MIXAMO, {"fps": 30.0}),
        "splines": (rest, dance(5), moves, CMU, {"interpolation": "CUBICSPLINE"}),
        "steps": (rest, dance(5), moves, MIXAMO, {"interpolation": "STEP", "fps": 12.5}),
        "one frame": (rest, dance(1), moves[:1], MIXAMO, {}),
        "centimetres": (
            100 * quarter.apply(rest),
            np.stack(turned),
            100 * quarter.apply(moves),
            MIXAMO,
            {"above": above},
        ),
        "names of VRM": (
            rest,
            dance(5, CMU),
            moves,
            scrambled,
            {"extensions": {"VRM": {"humanoid": {"humanBones": human}}}},
        ),
        "two clips": (
            rest,
            dance(5),
            moves,
            MIXAMO,
            {"more": [dance(5, seed=1)], "titles": ("walk", "run")},
        ),
    }
    for case, (*skeleton, options) in made.items():
        write_glb(folder / "made.glb", *skeleton, **options)
        yield case, ("dance.glb", (folder / "made.glb").read_bytes())


def test_the_page_reads_animations_as_python_does(tmp_path, caplog):
    compare(tmp_path, caplog, dict(glb_files(tmp_path)))


def test_any_of_the_animations_in_a_file_can_be_had(tmp_path):
    clips = [dance(3, seed=seed) for seed in range(3)]
    options = {"more": clips[1:], "titles": ("walk", "run", "jump")}
    write_glb(tmp_path / "a.glb", shipped_joints(), clips[0], np.zeros((3, 3)), MIXAMO, **options)
    content = (tmp_path / "a.glb").read_bytes()
    for poses, page in zip(
        clips, page_reads([("a.glb", content, None, i) for i in range(3)]), strict=True
    ):
        assert page["clips"] == ["walk", "run", "jump"]
        theirs = Rotation.from_quat(np.reshape(page["quats"], (-1, 4))[:, [1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(theirs, matrices(poses), atol=EXACT)


def animation_file(folder, times=None, turns=None, wrong=None, **document):
    """Returns a GLB file of one node that turns, or of a similar one with a fault.

    `wrong` changes what the writer's views state.
    """
    writer = GlbWriter()
    times = writer.array("SCALAR", np.arange(2.0) if times is None else np.asarray(times, float))
    turns = writer.array(
        "VEC4", np.tile([0.0, 0, 0, 1], (2, 1)) if turns is None else np.asarray(turns, float)
    )
    channels = [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}]
    animation = {"channels": channels, "samplers": [{"input": times, "output": turns}]}
    for view in writer.views:
        view.update(wrong or {})
    writer.write(
        folder / "a.glb", {"nodes": [{"name": "Hips"}], "animations": [animation]} | document
    )
    return (folder / "a.glb").read_bytes()


def test_a_glb_that_is_no_motion_gets_one_line(tmp_path):
    compression = {
        "extensions": {"EXT_meshopt_compression": {"buffer": 1, "count": 2, "byteStride": 4}}
    }
    whole = animation_file(tmp_path)
    # damaged files first, then documents that no reader can follow
    cases = {
        "nothing": (b"", "not a GLB file, or cut short"),
        "text": (b"hello, this is no file of numbers", "not a GLB file"),
        "cut short": (whole[:-8], "cut short"),
        "still": (
            animation_file(tmp_path, animations=[]),
            "without an animation: expected a skeleton in motion",
        ),
        "names": (whole, "expected the names of"),
        "compressed": (
            animation_file(tmp_path, wrong=compression),
            "compressed (EXT_meshopt_compression)",
        ),
        "outside": (animation_file(tmp_path, wrong={"buffer": 1}), "numbers in another file"),
        "too far": (animation_file(tmp_path, wrong={"byteOffset": 10**6}), "but there are"),
        "order": (
            animation_file(tmp_path, times=[1, 0]),
            "one rotation for each of increasing times",
        ),
        "few": (
            animation_file(tmp_path, turns=[[0, 0, 0, 1]]),
            "one rotation for each of increasing times",
        ),
        "infinite": (
            animation_file(tmp_path, turns=[[0, 0, 0, np.inf]] * 2),
            "rotation: expected finite numbers",
        ),
        "circle": (
            animation_file(tmp_path, nodes=[{"children": [1]}, {"children": [0]}]),
            "below itself",
        ),
        "two parents": (
            animation_file(tmp_path, nodes=[{"children": [1, 1]}, {}]),
            "has two parents",
        ),
        "no node": (animation_file(tmp_path, nodes=[{"children": ["constructor"]}]), "is no node"),
        "skin": (animation_file(tmp_path, skins=[{"joints": [7]}]), "a joint that is no node"),
        "missing": (
            animation_file(tmp_path, skins=[{"joints": [0], "inverseBindMatrices": 9}]),
            "a damaged GLB file",
        ),
    }
    found = page_reads([("a.glb", content) for content, _ in cases.values()])
    for (case, (_, expected)), page in zip(cases.items(), found, strict=True):
        message = page.get("error", "")
        assert message.startswith("a.glb: ") and expected in message and "\n" not in message, (
            case,
            page,
        )
        assert not page["asksRate"], case


def compare(tmp_path, caplog, files):
    """Compares motions of the page and of Python; `files` are {what: (name, bytes)}."""
    for (case, (name, content)), page in zip(
        files.items(), page_reads(files.values()), strict=True
    ):
        (tmp_path / name).write_bytes(content)
        caplog.clear()
        motion = load_motion(tmp_path / name, rest_joints=shipped_joints())
        assert "error" not in page, (case, page)
        theirs = Rotation.from_quat(np.reshape(page["quats"], (-1, 4))[:, [1, 2, 3, 0]]).as_matrix()
        np.testing.assert_allclose(theirs, matrices(motion.rotations), atol=EXACT, err_msg=case)
        np.testing.assert_allclose(
            page["translations"], motion.translations, atol=EXACT, err_msg=case
        )
        assert page["fps"] == pytest.approx(motion.fps, rel=1e-6), case
        warnings = " ".join(caplog.messages).replace(HOW_TO_CHANGE, "")
        assert bool(page["note"]) == bool(warnings) and page["note"] in warnings, (
            case,
            page["note"],
            warnings,
        )


@pytest.mark.slow
def test_the_page_reads_skeletons_as_python_does(tmp_path, caplog):
    compare(
        tmp_path, caplog, {case: ("dance.bvh", text.encode()) for case, text in skeletons().items()}
    )


def test_the_page_reads_arrays_as_python_does(tmp_path, caplog):
    files = array_files()
    known = {each.arrays.keys for each in MOTIONS.values() if each.arrays and each.arrays.page}
    assert {
        keys for keys in known if any(set(keys) <= set(arrays) for arrays in files.values())
    } == known
    compare(
        tmp_path, caplog, {case: ("dance.npz", npz(**arrays)) for case, arrays in files.items()}
    )


POSES = {"poses": np.zeros((2, 66)), "trans": np.zeros((2, 3))}
HEAD = (
    "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\nEnd"
    " Site\n{\nOFFSET 0 0 0\n}\n}\n"
)
MOVED = b"MOTION\nFrames: 1\nFrame Time: 1\n0 0 0"
BAD = {
    "rate": (
        "a.npz",
        npz(**POSES, fps=np.inf),
        "expected a positive number of frames per second, got Infinity",
    ),
    "no rate": ("a.npz", npz(**POSES), "key mocap_framerate: missing"),
    "slow": ("a.npz", npz(**POSES, fps=5e-324), "expected a positive number of frames per second"),
    "negative": (
        "a.npz",
        npz(**POSES, fps=-1),
        "expected a positive number of frames per second, got -1",
    ),
    "far": (
        "a.npz",
        npz(**(POSES | {"trans": np.full((2, 3), 1e6)}), fps=30),
        "expected metres, at most 10000",
    ),
    "scaling": (
        "a.npz",
        npz(smpl_poses=np.zeros((2, 72)), smpl_trans=np.zeros((2, 3)), smpl_scaling=0),
        "a positive number",
    ),
    "huge": (
        "a.npz",
        npz(**(POSES | {"poses": np.full((2, 66), 1e300)}), fps=30),
        "key poses: expected finite numbers",
    ),
    "keys": (
        "a.npz",
        npz(constructor=np.zeros((2, 3)), __proto__=np.zeros(2)),
        "expected one of the keys rotations, ",
    ),
    "odd type": (
        "a.npz",
        npz(poses=np.zeros((2, 66), "c16"), trans=np.zeros((2, 3)), fps=30),
        "expected one of the keys",
    ),
    "odd channel": (
        "a.bvh",
        HEAD.replace("Zrotation", "constructor").encode(),
        "expected up to 6 channels",
    ),
    "odd joint": ("a.bvh", HEAD.replace("Hips", "__proto__").encode() + MOVED, "no joint"),
    "instant": (
        "a.bvh",
        (HEAD + "MOTION\nFrames: 1\nFrame Time: 5e-324\n0 0 0").encode(),
        "a positive Frame Time",
    ),
    "brace": ("a.bvh", b"HIERARCHY {", "unknown word {"),
    "open": ("a.bvh", b"HIERARCHY ROOT Hips { OFFSET 0 0 0", "a brace of the joints is open"),
    "cut": ("a.bvh", b"HIERARCHY ROOT Hips { OFFSET 0 0", "cut short"),
    "truncated": ("a.npz", npz(**POSES, fps=30)[:-60], "not an npz archive, or cut short"),
    "width": (
        "a.npz",
        npz(poses=np.zeros((2, 30)), trans=np.zeros((2, 3)), fps=30),
        "poses: expected frames of 165 or ",
    ),
    "words": ("a.bvh", b"hello", "not a BVH file"),
    "strange": (
        "a.bvh",
        HEAD.replace("Hips", "Tail").encode() + MOVED,
        "expected the names of",
    ),
}


def test_files_without_a_rate_are_read_at_the_one_that_is_asked_for():
    """Without a rate the error says that one is needed, and only then."""
    asks = {"rate", "no rate", "slow", "negative", "instant"}
    files = {case: (name, content) for case, (name, content, _) in BAD.items()}
    for case, page in zip(files, page_reads(files.values()), strict=True):
        assert page["asksRate"] == (case in asks), case
    answered = [(*files[case], 12.5) for case in asks - {"instant"}]
    for page in page_reads([*answered, ("dance.npz", npz(**POSES, fps=30), 60)]):
        assert page["fps"] in (12.5, 60) and len(page["quats"]) == 2
    timeless = skeletons()["A-pose"].replace("Frame Time: 0.0083333", "Frame Time: 0")
    (page,) = page_reads([("dance.bvh", timeless.encode(), 25)])
    assert page["fps"] == 25


def test_the_page_refuses_what_it_cannot_draw():
    found = page_reads([(name, content) for name, content, _ in BAD.values()])
    for (case, (name, _, expected)), page in zip(BAD.items(), found, strict=True):
        message = page.get("error", "")
        assert message.startswith(f"{name}: ") and expected in message and "\n" not in message, (
            case,
            page,
        )


@pytest.mark.parametrize("name", ["constructor", "__proto__", "toString"])
def test_an_avatar_may_have_joints_of_any_name(name):
    rest = np.concatenate([shipped_joints(), [[0, 0.5, 0.1]]])
    (page,) = page_reads(
        [("dance.bvh", skeletons()["A-pose"].encode())],
        (*JOINT_NAMES, name),
        (*PARENTS, INDEX["head"]),
        rest,
    )
    (usual,) = page_reads([("dance.bvh", skeletons()["A-pose"].encode())])
    np.testing.assert_allclose(np.asarray(page["quats"])[:, :55], usual["quats"], atol=EXACT)
    # as its parent
    np.testing.assert_allclose(np.abs(np.asarray(page["quats"])[:, 55, 0]), 1, atol=EXACT)


def test_pictures_of_the_page_are_marked_as_ours(tmp_path):
    """Commands then do not take them for photos, and outputs may replace them."""
    write_png(tmp_path / "page.png", np.linspace(0, 1, 60).reshape(4, 5, 3))
    assert not is_own_picture(tmp_path / "page.png")
    program = f"""{page_script("saving")}
    const fs = require("fs"), file = process.argv[1];
    marked(new Blob([fs.readFileSync(file)])).then(async (blob) =>
      fs.writeFileSync(file, Buffer.from(await blob.arrayBuffer())));"""
    before = read_image(tmp_path / "page.png")[0]
    command = [str(NODE), "--input-type=commonjs", "-e", program, str(tmp_path / "page.png")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert is_own_picture(tmp_path / "page.png")
    with Image.open(tmp_path / "page.png") as image:
        image.verify()  # the checksums of its chunks
    np.testing.assert_array_equal(read_image(tmp_path / "page.png")[0], before)
