"""Motions in the files of estimators and data sets come back as written; also several people."""

import numpy as np
import pytest
from motion_files import (
    AWAY,
    FILES,
    FRAMES,
    MATRICES,
    OTHER,
    PLACES,
    ROTATIONS,
    SINGLE,
    all_of,
    array,
    down,
    easymocap,
    human3r,
    in_folder,
    kimodo,
    matrices,
    mdm,
    mhr,
    npz,
    objects,
    parts,
    phalp,
    saved,
    smpl,
    smplerx,
    texts,
    tram,
    wham,
)

from humangs_jax.body.joints import JOINT_NAMES
from humangs_jax.motion import MotionError, load_motion
from humangs_jax.motion.rules import joint_places
from humangs_jax.motion.skeleton import shipped_joints


@pytest.mark.parametrize("kind", FILES)
def test_what_was_written_is_read(kind, tmp_path):
    write, joints, options = FILES[kind]
    placed, frames = options.get("places", True), options.get("frames", FRAMES)
    motion = load_motion(
        write(tmp_path), **{k: v for k, v in options.items() if k not in ("places", "frames")}
    )
    expected = np.zeros((frames, 55, 3))
    expected[:, list(joints)] = ROTATIONS[:frames, list(joints)]
    np.testing.assert_allclose(matrices(motion.rotations), matrices(expected), atol=MATRICES)
    if placed:
        np.testing.assert_allclose(motion.translations, PLACES[:frames], atol=MATRICES)
    assert motion.fps == {
        "smplcodec": 24.0,
        "AIST++": 60.0,
        "MDM": 20.0,
    }.get(kind, 30.0)


NO_MOTIONS = {
    "features of HumanML3D": (
        array("a.npy", np.zeros((9, 263))),
        "263 features a frame of HumanML3D, not rotations",
    ),
    "joints of HumanML3D": (
        array("a.npy", np.zeros((9, 22, 3))),
        r"22 joints in space \(HumanML3D's new_joints\), or",
    ),
    "another array": (
        array("a.npy", np.zeros((9, 100))),
        r"an array of shape \(9, 100\): expected .* 322, 165, 156, 72, 66",
    ),
    "results of MDM": (
        objects(
            "results.npy",
            {"motion": np.zeros((2, 22, 3, 9)), "text": ["a", "b"], "lengths": np.asarray([9, 9])},
        ),
        "these are joints in space that MDM sampled: .*visualize.render_mesh",
    ),
    "MDM without its last axis": (
        objects("a.npy", mdm() | {"thetas": np.zeros((24, 6))}),
        r"thetas: expected shape \(24, 6, fr",
    ),
    "Kimodo's SOMA": (
        npz(**kimodo(77)),
        "local_rot_mats: .* 77 joints of SOMA: write a .bvh of them",
    ),
}


@pytest.mark.parametrize("kind", NO_MOTIONS)
def test_arrays_that_are_no_motion_say_what_they_are(kind, tmp_path):
    write, message = NO_MOTIONS[kind]
    path = write(tmp_path)
    with pytest.raises(MotionError, match=message) as error:
        load_motion(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def bones(rotations):
    places = joint_places(shipped_joints(), rotations, np.zeros((len(rotations), 3)))
    pairs = [
        (f"{s}_{a}", f"{s}_{b}")
        for s in ("left", "right")
        for a, b in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"))
    ]
    pairs += [
        ("left_hip", "right_hip"),
        ("neck", "head"),
        ("left_elbow", "left_wrist"),
        ("left_ankle", "left_foot"),
    ]
    a, b = (places[:, [JOINT_NAMES.index(pair[i]) for pair in pairs]] for i in (0, 1))
    return (b - a) / np.linalg.norm(b - a, axis=-1, keepdims=True)


@pytest.mark.parametrize("kind", ["arrays", "no rotations", "a file a frame", "one frame"])
def test_sam_3d_body_gives_the_directions_of_bones(kind, tmp_path):
    values = mhr(kind != "no rotations")
    rows = [{key: value[i] for key, value in values.items()} for i in range(FRAMES)]
    if kind == "a file a frame":
        path = all_of(*(npz(f"{i:06d}.npz", **row) for i, row in enumerate(rows)))(tmp_path)
    else:
        path = npz(**(rows[0] if kind == "one frame" else values))(tmp_path)
    motion = load_motion(path)
    count = 1 if kind == "one frame" else FRAMES
    assert len(motion.rotations) == count
    np.testing.assert_allclose(
        bones(np.asarray(motion.rotations, float)), bones(ROTATIONS[:count]), atol=1e-4
    )
    moved = np.asarray(motion.translations)[:, [0, 2]]
    np.testing.assert_allclose(moved, PLACES[:count, [0, 2]], atol=1e-4)


# Several people
# --------------------------------------------------------------------------------------------------

SEVERAL = {
    "WHAM": saved("a.pkl", {0: wham(), 7: wham(OTHER, AWAY, frame_ids=np.arange(4))}),
    "PHALP": saved("a.pkl", phalp(0)),
    "EasyMocap": texts(
        [f"{i:06d}.json" for i in range(FRAMES)],
        [
            [x, *([y] if y else [])]
            for x, y in zip(
                easymocap(), [*easymocap(OTHER, AWAY, number=7), None, None], strict=True
            )
        ],
    ),
    "SMPLer-X": all_of(*smplerx(), *smplerx(OTHER, AWAY, number=7)),
    "TRAM": lambda folder: all_of(
        *(in_folder("hps", objects(f"hps_track_{i}.npy", tram_values(i))) for i in (0, 7))
    )(folder),
    "Human3R": human3r(((0, ROTATIONS, PLACES), (7, ROTATIONS[::-1], PLACES))),
}


def tram_values(number):
    values = smpl(*down(*((OTHER, AWAY) if number else (ROTATIONS, PLACES))))
    turns = np.concatenate([values["global_orient"], values["body_pose"]], axis=1)
    return {
        "pred_rotmat": turns,
        "pred_trans": values["transl"][:, None],
        "frame": np.arange(len(turns)),
    }


@pytest.mark.parametrize("kind", SEVERAL)
def test_several_people_are_listed_with_their_frames_and_chosen_by_number(kind, tmp_path):
    path = SEVERAL[kind](tmp_path)
    with pytest.raises(MotionError) as caught:
        load_motion(path)
    other = {"PHALP": "4 (2 frames)", "Human3R": "7 (6 frames)"}.get(kind, "7 (4 frames)")
    assert (
        "2 people: " in str(caught.value)
        and other in str(caught.value)
        and "0 (6 frames)" in str(caught.value)
    )
    assert "--" not in str(caught.value)
    motion = load_motion(path, person=0)
    np.testing.assert_allclose(
        matrices(motion.rotations[:, :22]), matrices(ROTATIONS[:, :22]), atol=MATRICES
    )
    assert len(load_motion(path, person=int(other[0])).rotations) == int(other[3])
    with pytest.raises(MotionError, match="person 3: no such person: expected one of "):
        load_motion(path, person=3)


def test_half_frames_of_cameras_are_refused(tmp_path):
    tram()(tmp_path)
    file = tmp_path / "hps" / "hps_track_0.npy"
    values = np.load(file, allow_pickle=True).item()
    np.save(file, values | {"frame": values["frame"] + 0.5}, allow_pickle=True)
    with pytest.raises(MotionError, match=r"0\.npy: frame: expected whole numbers, got 0\.5 at"):
        load_motion(file, fps=30)


def test_frames_in_which_nobody_was_seen_are_filled(tmp_path, caplog):
    at = [0, 1, 4, 5]
    seen = np.asarray([10, 11, 14, 15])
    moves = np.arange(6.0)[:, None] * [0.1, 0, 0]
    path = saved("a.pkl", {0: wham(np.zeros((4, 55, 3)), moves[at], frame_ids=seen)})(tmp_path)
    motion = load_motion(path, fps=25)
    np.testing.assert_allclose(motion.translations, moves, atol=SINGLE)
    assert motion.fps == 25 and "lacks 2 of 6 frames: filled in between" in caplog.text
    every_second = saved("b.pkl", {0: wham(frame_ids=np.arange(0, 2 * FRAMES, 2))})(tmp_path)
    assert len(load_motion(every_second).rotations) == FRAMES


def test_a_person_who_leans_before_a_camera_is_not_turned_over(tmp_path, caplog):
    """Positions by this key are in the axes of a camera, whatever the person does."""
    leaning = np.zeros((FRAMES, 55, 3))
    leaning[:, 0] = [1.2, 0, 0]  # radians forward: nearer to z than to y
    values = smpl(*down(leaning, PLACES))
    path = npz(**{"pred_cam_t_full": values.pop("transl"), **values})(tmp_path)
    motion = load_motion(path, fps=30)
    np.testing.assert_allclose(
        matrices(motion.rotations[:, 0]), matrices(leaning[:, 0]), atol=MATRICES
    )
    np.testing.assert_allclose(motion.translations, PLACES, atol=SINGLE)
    assert "people lie along" in caplog.text  # somebody may lie, too


def test_depths_of_an_assumed_focal_length_become_those_of_a_usual_one(tmp_path, caplog):
    """4D-Humans assumes 5000 pixels where the longer side of the photo is 256."""
    far = np.asarray([[0.1, 0.2, 60 + 0.5 * i] for i in range(FRAMES)])
    values = smpl(*down(np.zeros((FRAMES, 55, 3)), np.zeros((FRAMES, 3))))
    values = {key: value for key, value in values.items() if key != "transl"}
    motion = load_motion(npz(camera=far, **values)(tmp_path), fps=30)
    steps = np.diff(np.asarray(motion.translations), axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.5 * 256 / 5000, atol=SINGLE)
    assert "camera is of a focal length that was assumed: people are taken to be 19.5" in (
        caplog.text
    )


def test_missing_parts_are_reported(tmp_path, caplog):
    load_motion(npz(**{k: v for k, v in parts().items() if k != "transl"})(tmp_path))
    assert (
        "no frames per second: taken for 30" in caplog.text
        and "no positions (trans, transl, cam_t)" in caplog.text
    )
    caplog.clear()
    (tmp_path / "tram").mkdir()
    load_motion(tram(camera=False)(tmp_path / "tram"), fps=30)
    assert "no camera.npy beside it: people move as the camera sees them" in caplog.text
    frames = phalp()
    del frames["_DEMO/000003.jpg"]["camera"]
    with pytest.raises(MotionError, match=r"b\.pkl: frame 3: camera: missing, but frame 0 has it"):
        load_motion(saved("b.pkl", frames)(tmp_path), person=3)
    with pytest.raises(MotionError, match="body_pose: expected rotation matrices"):
        load_motion(npz(**(smpl() | {"body_pose": np.ones((FRAMES, 23, 3, 3))}))(tmp_path))
