import importlib
import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import run
from motion_cases import FPS, UP, in_world, motions
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.model import RestBody, joint_transforms
from humangs_jax.body.motion import PELVIS, Motion, grounded
from humangs_jax.cli import animate
from humangs_jax.cli.options import PartOfMotion
from humangs_jax.data.formats import MOTIONS, MotionFormat
from humangs_jax.geometry import quaternion
from humangs_jax.motion import MotionError, Poses, load_motion, save_motion

FLOAT32 = 1e-5
"""Error of angles up to 3 rad and of metres, after a few float32 operations."""
FRAMES = 6


def random(shape, seed=0, scale=0.2):
    return np.random.default_rng(seed).normal(size=shape) * scale


def write(path, **arrays):
    np.savez(path, **arrays)
    return path


def upright_poses(columns):
    """Returns poses whose pelvis points along +y."""
    return random((FRAMES, columns), scale=0.1)


# Formats
# --------------------------------------------------------------------------------------------------


def test_our_own_format_round_trips(tmp_path):
    motion = Motion(
        jnp.asarray(random((FRAMES, 55, 3)), jnp.float32),
        jnp.asarray(random((FRAMES, 3)), jnp.float32),
        24.0,
    )
    save_motion(tmp_path / "a.npz", motion)
    back = load_motion(tmp_path / "a.npz")
    jax.tree.map(np.testing.assert_array_equal, motion, back)  # fps is part of the structure
    assert load_motion(tmp_path / "a.npz", fps=30).fps == 30.0
    np.testing.assert_array_equal(back.pose(3).rotations, motion.rotations[3])
    assert back.pose(3).translation.shape == (3,)


def smpl_params(**changes):
    parts = dict(
        global_orient=upright_poses(3),
        transl=random((FRAMES, 3)),
        body_pose=random((FRAMES, 63), 1),
        jaw_pose=random((FRAMES, 3), 2),
        left_hand_pose=random((FRAMES, 45), 3),
        right_hand_pose=random((FRAMES, 45), 4),
        betas=np.zeros((1, 10)),
        expression=np.zeros((FRAMES, 10)),
    )
    return {k: v for k, v in {**parts, **changes}.items() if v is not None}


def test_principal_coefficients_of_hands_are_left_flat_with_a_warning(tmp_path, caplog):
    parts = smpl_params(left_hand_pose=random((FRAMES, 12), 7))
    rotations = np.asarray(load_motion(write(tmp_path / "a.npz", **parts)).rotations)
    assert not rotations[:, 25:40].any() and rotations[:, 40:].any()
    assert (
        "left_hand_pose: hands of 12 numbers are principal coefficients of a model: left flat"
        in caplog.text
    )


def test_a_format_is_one_line_of_the_table(tmp_path, monkeypatch, capsys):
    """The command's help and `load_motion` know a new row; of two formats of a file, its content
    tells which one it is.
    """

    def standing(path, reading):
        return Poses(np.zeros((2, 55, 3)), np.zeros((2, 3)), float(path.read_text()))

    monkeypatch.setitem(
        MOTIONS,
        "toy",
        MotionFormat("made up", standing, (".toy", ".pkl"), lambda path: path.suffix == ".toy"),
    )
    monkeypatch.setattr(animate, "Animate", animate.Animate)  # reloading replaces it
    importlib.reload(animate)
    assert ".toy or .pkl: made up" in " ".join(
        run(monkeypatch, capsys, "animate", "--help")[1].replace("│", " ").split()
    )
    (tmp_path / "a.toy").write_text("25")
    assert load_motion(tmp_path / "a.toy").fps == 25.0
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(AIST))
    assert load_motion(tmp_path / "a.pkl").fps == 60.0


# The world's up
# --------------------------------------------------------------------------------------------------


def rotation_vector(matrix):
    return Rotation.from_matrix(matrix).as_rotvec()


TURNS = {
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    "-z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "-x": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
}
"""Rotations to our world from one in which another axis is up."""


@pytest.mark.parametrize("axis", TURNS)
def test_any_world_is_turned_upright(tmp_path, axis):
    """A motion in another world's coordinates has the same joints in space after reading."""
    poses, trans = upright_poses(165), random((FRAMES, 3))
    turn = np.asarray(TURNS[axis], float)
    turned = poses.copy()
    for i in range(FRAMES):
        root = np.asarray(
            quaternion.matrix_from_axis_angle(jnp.asarray(poses[i, :3], jnp.float32)), float
        )
        turned[i, :3] = rotation_vector(turn.T @ root)
    turned_trans = (trans + PELVIS) @ turn - PELVIS  # the pelvis moves with the world
    path = write(tmp_path / "a.npz", poses=turned, trans=turned_trans, mocap_framerate=30)
    motion = load_motion(path, up=axis)
    back = quaternion.matrix_from_axis_angle(motion.rotations)
    expected = quaternion.matrix_from_axis_angle(
        jnp.asarray(poses.reshape(FRAMES, 55, 3), jnp.float32)
    )
    np.testing.assert_allclose(back, expected, atol=FLOAT32)
    np.testing.assert_allclose(motion.translations, trans, atol=FLOAT32)
    untouched = load_motion(path, up="y")
    np.testing.assert_allclose(untouched.translations, turned_trans, atol=FLOAT32)


def amass(rotations, translations):
    return dict(
        poses=rotations.reshape(len(rotations), -1), trans=translations, mocap_framerate=FPS
    )


def parts(rotations, translations):
    flat = rotations.reshape(len(rotations), -1)
    return dict(global_orient=flat[:, :3], body_pose=flat[:, 3:66], transl=translations, fps=FPS)


@pytest.mark.parametrize("heading", [0, 215])
@pytest.mark.parametrize("kind", motions())
def test_people_on_the_floor_stay_there(tmp_path, caplog, kind, heading):
    """AMASS has z up and the others y, also for people who crawl, lie, or stand on their hands."""
    facing = Rotation.from_euler("y", heading, degrees=True)
    for up, arrays in (("z", amass), ("y", parts)):
        path = write(tmp_path / f"{up}.npz", **arrays(*in_world(*motions()[kind], UP[up] * facing)))
        motion, (rotations, translations) = load_motion(path), in_world(*motions()[kind], facing)
        matrices = lambda x: Rotation.from_rotvec(np.reshape(x, (-1, 3))).as_matrix()
        np.testing.assert_allclose(matrices(motion.rotations), matrices(rotations), atol=FLOAT32)
        np.testing.assert_allclose(motion.translations, translations, atol=2 * FLOAT32)
    assert not [line for line in caplog.messages if " is up, not " in line]


@pytest.mark.parametrize(("arrays", "usual"), [(amass, "z"), (parts, "y")])
@pytest.mark.parametrize("up", ["y", "z", "-y"])
def test_where_the_floor_agrees_another_axis_is_up_with_a_warning(
    tmp_path, caplog, arrays, usual, up
):
    expected, translations = motions()["walking"]
    motion = load_motion(
        write(tmp_path / "a.npz", **arrays(*in_world(expected, translations, UP[up])))
    )
    np.testing.assert_allclose(motion.translations, translations, atol=2 * FLOAT32)
    warning = f"{tmp_path / 'a.npz'}: {up} is up, not {usual}"
    assert [line.startswith(warning) for line in caplog.messages] == ([] if up == usual else [True])


def test_people_who_stand_still_may_lie_and_the_warning_says_so(tmp_path, caplog):
    still = np.zeros((4, 55, 3)), np.zeros((4, 3))
    motion = load_motion(write(tmp_path / "a.npz", **amass(*still)))
    assert motion.rotations[0, 0, 0] == pytest.approx(-np.pi / 2)
    (line,) = caplog.messages
    assert line.startswith(
        f"{tmp_path / 'a.npz'}: z is up, as usual in such files, and people lie along y; "
    )
    assert line.endswith("if they should stand: --motion-up=y (in Python up='y')")
    caplog.clear()
    beat = amass(*still) | {"expressions": np.zeros((4, 100))}  # BEAT2's has y up
    assert (
        not np.any(load_motion(write(tmp_path / "b.npz", **beat)).rotations) and not caplog.messages
    )
    camera = parts(*in_world(*still, UP["-y"]))  # estimators: y points down
    np.testing.assert_allclose(
        load_motion(write(tmp_path / "c.npz", **camera)).rotations, 0, atol=FLOAT32
    )
    assert "c.npz: -y is up, not y: people stand along it" in caplog.text


def test_a_person_who_stands_still_may_be_turned_by_hand(tmp_path):
    still = np.zeros((4, 55, 3)), np.zeros((4, 3))
    file = write(tmp_path / "a.npz", **amass(*still))
    np.testing.assert_allclose(PartOfMotion(motion_up="y").load(file).rotations, 0, atol=FLOAT32)
    assert PartOfMotion(motion_up="-z", person=1).options(file) == (
        "--motion",
        file,
        "--motion-up=-z",
        "--person",
        "1",
    )


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"poses": np.zeros((4, 165)), "trans": np.zeros((4, 3))},
            r"framerate: missing: .* --motion-fps \(in Python fps=",
        ),
        (
            {"header": "{}", "means": np.zeros((3, 3)), "skinning_weights": np.zeros((3, 2))},
            "motion: this is an avatar: expected",
        ),
        (
            {"points": np.zeros((1, 2)), "confidences": np.zeros(1), "set": "coco17"},
            "no motion: these are keypoints",
        ),
    ],
)
def test_what_is_missing_or_no_motion_names_what_to_do(arrays, message, tmp_path):
    with pytest.raises(MotionError, match=message):
        load_motion(write(tmp_path / "a.npz", **arrays))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.mp4", "a video: `humangs motion`"),
        ("a.MOV", "a video"),
        ("a.fbx", "open it in Blender"),
        ("a.gltf", "export it as .glb"),
    ],
)
def test_files_of_other_kinds_say_how_a_motion_comes_of_them(name, message, tmp_path):
    (tmp_path / name).write_bytes(b"something")
    with pytest.raises(
        MotionError, match=f"{name}: no motion: expected a file .*, got .*{message}"
    ):
        load_motion(tmp_path / name)


def test_a_tilt_is_no_other_axis(tmp_path):
    tilted = np.zeros((4, 55, 3))
    tilted[:, 0, 0] = 0.8  # radians: nearer to z than to y
    np.testing.assert_allclose(
        load_motion(write(tmp_path / "a.npz", **parts(tilted, np.zeros((4, 3))))).rotations, tilted
    )


def test_where_no_axis_is_clear_the_format_decides(tmp_path):
    poses = np.zeros((2, 165))
    poses[1, 0] = np.pi  # once upright, once upside down
    trans = np.array([[0.0, 0, 1], [0, 0, 1]]) - PELVIS
    amass = load_motion(write(tmp_path / "a.npz", poses=poses, trans=trans, mocap_framerate=30))
    np.testing.assert_allclose(
        amass.translations, np.array([[0.0, 1, 0]] * 2) - PELVIS, atol=FLOAT32
    )
    parts = dict(global_orient=poses[:, :3], body_pose=poses[:, 3:66], transl=trans)
    other = load_motion(write(tmp_path / "b.npz", **parts))
    np.testing.assert_allclose(other.translations, trans, atol=FLOAT32)


# Wrong files
# --------------------------------------------------------------------------------------------------

NAN = np.zeros((FRAMES, 165))
NAN[2, 7] = np.nan
AMASS = dict(poses=np.zeros((FRAMES, 165)), trans=np.zeros((FRAMES, 3)), mocap_framerate=30)
OURS = dict(rotations=np.zeros((FRAMES, 55, 3)), translations=np.zeros((FRAMES, 3)), fps=24)
AIST = dict(smpl_poses=np.zeros((FRAMES, 72)), smpl_trans=np.zeros((FRAMES, 3)))


def without(arrays, key):
    return {k: v for k, v in arrays.items() if k != key}


COLUMNS = "expected 165 (SMPL-X), 156 (SMPL-H), 72 (SMPL), 66 (the body) numbers a frame, got shape"
MATRICES = "expected rotation matrices"
BAD = {
    "no motion": (dict(vertices=np.zeros(3)), ": no motion: expected one of the keys rotations"),
    "columns": ({**AMASS, "poses": np.zeros((FRAMES, 100))}, f": poses: {COLUMNS} (6, 100)"),
    "NaN": ({**AMASS, "poses": NAN}, ": poses: expected finite numbers, got nan at index [2, 7]"),
    "counts": (
        {**AMASS, "trans": np.zeros((FRAMES + 1, 3))},
        ": trans: expected shape (6, 3), got (7, 3)",
    ),
    "no trans": (without(AMASS, "trans"), ": trans: missing"),
    "no rate": (without(AMASS, "mocap_framerate"), ": mocap_framerate: missing"),
    "pickled": ({**AMASS, "trans": np.array([None])}, ": trans: a pickled object"),
    "ours, counts": (
        {**OURS, "translations": np.zeros((1, 3))},
        ": translations: expected shape (6, 3)",
    ),
    "params, body": (
        smpl_params(body_pose=np.zeros((FRAMES, 60))),
        ": body_pose: expected shape (6, 63), or (6, 69) of SMPL, got (6, 60)",
    ),
    "params, mirrored": (
        smpl_params(global_orient=np.tile(-np.eye(3), (FRAMES, 1, 1))),
        f": global_orient: {MATRICES}",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_npz_is_one_line_with_file_and_key(tmp_path, case):
    arrays, expected = BAD[case]
    path = write(tmp_path / "a.npz", **arrays)
    with pytest.raises(MotionError) as caught:
        load_motion(path)
    assert str(caught.value).startswith(f"{path}{expected}") and "\n" not in str(caught.value)


def test_folders_that_are_no_motion_and_wrong_options_are_one_line(tmp_path):
    def message(path, **options):
        with pytest.raises(MotionError) as caught:
            load_motion(path, **options)
        assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)
        return str(caught.value)

    (tmp_path / "empty").mkdir()
    assert "no .json, .npz or other file of a motion" in message(tmp_path / "empty")
    frame = {"root_pose": [0.0] * 3, "body_pose": [[0.0] * 3] * 21, "trans": [0.0] * 3}
    (tmp_path / "some").mkdir()
    for name, each in (("8", frame), ("9", without(frame, "trans"))):
        (tmp_path / "some" / f"{name}.json").write_text(json.dumps(each))
    assert "9.json: trans: missing, but 8.json has it" in message(tmp_path / "some")
    assert "fps: expected a positive" in message(write(tmp_path / "ok.npz", **AMASS), fps=-1)
    with pytest.raises(ValueError, match="up: expected auto, y"):
        load_motion(tmp_path / "ok.npz", up="w")


# Using motions
# --------------------------------------------------------------------------------------------------


def rest_body():
    """Returns a body of joints alone, close to the shipped ones: enough to find the ground."""
    joints = np.array(random((55, 3), 1, 0.3), np.float32)
    joints[0] = PELVIS
    joints[7] = [0.1, -1.16, 0]
    vertices = np.concatenate([joints, [[0.1, -1.23, 0]]]).astype(np.float32)
    return RestBody(jnp.asarray(vertices), jnp.asarray(joints))


def test_grounded_stands_on_the_floor_at_the_origin():
    rest = rest_body()
    motion = Motion(
        jnp.asarray(random((FRAMES, 55, 3)), jnp.float32),
        jnp.asarray(random((FRAMES, 3), 3, 2.0), jnp.float32),
    )
    placed = grounded(motion, rest, PARENTS)
    shift = np.asarray(motion.translations - placed.translations)
    # by a constant
    np.testing.assert_allclose(shift, np.broadcast_to(shift[0], shift.shape), atol=FLOAT32)
    joints = []
    move = jax.jit(joint_transforms, static_argnums=1)
    for i in range(FRAMES):
        pose = placed.pose(i)
        transforms = np.asarray(move(rest.joints, PARENTS, pose.rotations, pose.translation))
        joints.append(
            np.einsum("jab,jb->ja", transforms[:, :3, :3], rest.joints) + transforms[:, :3, 3]
        )
    joints = np.stack(joints)
    np.testing.assert_allclose(joints[0, 0, [0, 2]], 0, atol=FLOAT32)
    sole = float(rest.joints[:, 1].min() - rest.vertices[:, 1].min())
    np.testing.assert_allclose(joints[..., 1].min(), sole, atol=FLOAT32)


def test_at_rate_keeps_frames_and_interpolates_between_them():
    motion = Motion(jnp.zeros((120, 2, 3)), jnp.arange(120.0)[:, None] * jnp.ones(3), 120.0)
    slow = motion.at_rate(30)
    assert slow.fps == 30.0 and list(np.asarray(slow.translations)[:, 0]) == list(range(0, 120, 4))
    fast = motion.at_rate(240.0)
    assert list(np.asarray(fast.translations)[:6, 0]) == [0, 0.5, 1, 1.5, 2, 2.5]
    assert len(fast.translations) == 240 and float(fast.translations[-1, 0]) == 119
    assert len(motion.at_rate(0.5).translations) == 1
    with pytest.raises(ValueError, match="fps: expected a positive"):
        motion.at_rate(0)


def test_at_rate_turns_at_an_even_speed():
    """From 30 to 60 frames a second: about a fixed axis, through half a turn, where rotation
    vectors jump, and between opposite vectors.
    """
    axis = np.asarray([0.6, 0.0, 0.8])
    angles = np.asarray([2.9, 3.1, 3.3, 3.5])
    vectors = (angles - 2 * np.pi * (angles > np.pi))[:, None, None] * axis
    motion = Motion(jnp.asarray(vectors, jnp.float32), jnp.zeros((4, 3)), 30.0)
    fast = motion.at_rate(60)
    np.testing.assert_array_equal(fast.rotations[::2], motion.rotations)
    wanted = quaternion.from_axis_angle(
        jnp.asarray(np.minimum(2.9 + 0.1 * np.arange(8), 3.5)[:, None] * axis, jnp.float32)
    )
    got = quaternion.from_axis_angle(fast.rotations[:, 0])
    np.testing.assert_allclose(np.abs(np.sum(got * wanted, axis=-1)), 1, atol=FLOAT32)


@pytest.mark.slow
def test_the_shipped_walk(tmp_path):
    """It touches the ground in every frame, loops smoothly, and has arms down and legs in turn."""
    from humangs_jax.body.library import load_body
    from humangs_jax.body.model import pose_body, shape_body

    motion, body = load_motion(), load_body()
    assert motion.rotations.shape == (48, 55, 3) and motion.fps == 24.0
    save_motion(tmp_path / "walk.npz", motion)
    assert (tmp_path / "walk.npz").stat().st_size < 100_000
    rest = shape_body(body, jnp.zeros(0))
    pose = jax.jit(lambda p: pose_body(body, rest, p))
    bodies = [pose(motion.pose(i)) for i in range(0, 48, 4)]
    lowest = np.array([b.vertices[:, 1].min() for b in bodies])
    np.testing.assert_allclose(lowest, 0, atol=1e-4)
    joints = {name: np.stack([b.joints[i] for b in bodies]) for i, name in enumerate(JOINT_NAMES)}
    assert (joints["left_wrist"][:, 1] < joints["left_elbow"][:, 1]).all()
    assert (joints["left_ankle"][:, 2] - joints["right_ankle"][:, 2]).max() > 0.3
    assert (joints["left_ankle"][:, 2] - joints["right_ankle"][:, 2]).min() < -0.3
    assert (joints["right_wrist"][:, 1] > joints["right_shoulder"][:, 1]).any()  # the wave
    step = np.diff(np.concatenate([motion.rotations, motion.rotations[:1]]), axis=0)
    steps = np.linalg.norm(step, axis=-1).max(axis=1)
    # the way back to the start is a step like the others
    assert steps[-1] <= steps[:-1].max() and steps.max() < 0.5
