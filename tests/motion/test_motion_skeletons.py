"""Skeletons of other programs: bones, feet and names, in files of CMU, Mixamo and LaFAN.

tests/viewer tests the page.
"""

import dataclasses
import functools
import logging

import numpy as np
import pytest
from bvh_files import (
    CMU,
    INDEX,
    LAFAN,
    MIXAMO,
    bone_directions,
    frames_along_bones,
    places_of,
    rest_frames,
    without_twist,
    write_bvh,
)
from glb_files import write_glb
from joint_names import NAMED
from motion_cases import UP, in_world, motions
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.io.mesh import GlbWriter, read_accessor
from humangs_jax.motion import MotionError, load_motion
from humangs_jax.motion.clips import read_bvh
from humangs_jax.motion.matching import _bends, matched
from humangs_jax.motion.rules import frame_times
from humangs_jax.motion.skeleton import retargeted, shipped_joints

EXACT = 1e-5
"""Error of radians and metres in float32 and with BVH's eight decimals."""


@functools.cache
def person():
    return shipped_joints()


def other_person():
    """Returns joints of a person of other proportions: longer shins, shorter thighs, wider hips."""
    rest, stretch = (
        person(),
        {"knee": 0.85, "ankle": 1.2, "hip": 1.3, "elbow": 1.1, "wrist": 0.9, "spine2": 1.2},
    )
    out = rest.copy()
    for j, parent in enumerate(PARENTS[1:], 1):
        out[j] = out[parent] + stretch.get(JOINT_NAMES[j].split("_")[-1], 1.0) * (
            rest[j] - rest[parent]
        )
    return out


def dance(frames=5, seed=0, names=MIXAMO, scale=0.5):
    poses = np.random.default_rng(seed).normal(size=(frames, 55, 3)) * scale
    poses[:, [i for i, name in enumerate(JOINT_NAMES) if name not in names]] = 0
    return poses


def loaded(tmp_path, text, **options):
    path = tmp_path / "dance.bvh"
    path.write_text(text)
    motion = load_motion(path, **options)
    return np.asarray(motion.rotations, float), np.asarray(motion.translations, float), motion


def matrices(rotations):
    return Rotation.from_rotvec(np.reshape(rotations, (-1, 3))).as_matrix()


SCHEMES = {
    "CMU": (CMU, {}, {"order": "ZYX"}),
    "CMU, A-pose": (CMU, {"arms_down": 48}, {"unit": 1 / 0.45 / 0.0254}),
    "Mixamo, turned": (MIXAMO, {"arms_down": 40, "turned": 90}, {}),
    "z up": (CMU, {}, {"up": Rotation.from_euler("x", 90, degrees=True)}),
}


@pytest.mark.parametrize("scheme", SCHEMES)
def test_bones_point_where_the_files_bones_point(tmp_path, scheme):
    names, frame, options = SCHEMES[scheme]
    rest, poses = person(), dance(names=names)
    moves = np.random.default_rng(1).normal(size=(5, 3))
    text = write_bvh(rest, poses, names, rest_frames(**frame), moves, **options)
    rotations, translations, motion = loaded(tmp_path, text, rest_joints=rest)
    assert rotations.shape == (5, 55, 3) and motion.fps == 120  # of 0.0083333 s
    theirs, ours = places_of(rest, poses, moves), places_of(rest, rotations, translations + rest[0])
    np.testing.assert_allclose(bone_directions(ours), bone_directions(theirs), atol=EXACT)
    if not frame:  # the same rest pose: the same rotations
        np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)
    # the same body: the pelvis goes where it went, up to the height of the floor
    np.testing.assert_allclose(np.ptp(translations + rest[0] - moves, axis=0), 0, atol=EXACT)
    np.testing.assert_allclose((translations + rest[0] - moves)[:, [0, 2]], 0, atol=EXACT)


TURNS = {
    "about x": Rotation.from_euler("x", [[90]] * 4, degrees=True),
    "half a turn": Rotation.from_euler("y", [[180]] * 4, degrees=True),
    "any": Rotation.random(4, random_state=3),
    "now and then": Rotation.from_rotvec([[0, 0, 0], [2, 1, 0], [0, 0, 0], [0, 0, 1.5]]),
}


@pytest.mark.parametrize("turns", TURNS)
@pytest.mark.parametrize(
    "names", [CMU, LAFAN, CMU | {"spine1": "Waist", "spine2": "Chest", "spine3": "Thorax"}]
)
def test_a_pelvis_with_a_rotation_of_its_own(tmp_path, names, turns):
    """The joints that carry hips and spine turn back, so that people are where they were."""
    rest, poses = person().copy(), dance(4, names=names)
    rest[INDEX["spine1"]] = rest[0]
    moves = np.random.default_rng(1).normal(size=(4, 3))
    text = write_bvh(rest, poses, names, moves=moves, pelvis=TURNS[turns])
    assert text.count("JOINT Carrier") == 2
    rotations, translations, _ = loaded(tmp_path, text, rest_joints=rest)
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)
    np.testing.assert_allclose((translations + rest[0] - moves)[:, [0, 2]], 0, atol=EXACT)


def test_hips_that_hang_on_a_turned_pelvis_itself(tmp_path):
    """Only the spine shows where the pelvis is."""
    rest = person().copy()
    rest[INDEX["spine1"]] = rest[0]
    (tmp_path / "a.bvh").write_text(
        write_bvh(rest, np.zeros((4, 55, 3)), CMU, pelvis=TURNS["about x"])
    )
    clip = read_bvh(tmp_path / "a.bvh")
    parents = tuple(
        0 if name.endswith("UpLeg") else p for name, p in zip(clip.names, clip.parents, strict=True)
    )
    rotations, _, _ = retargeted(dataclasses.replace(clip, parents=parents), rest)
    np.testing.assert_allclose(rotations, 0, atol=EXACT)


def test_joints_between_those_we_know_turn_bones_too(tmp_path):
    """A joint of no length above the elbow turns, as in some rigs; the forearm starts where the
    file has it.
    """
    rest, poses, bent = person(), dance(3, names=CMU), dance(3, names=CMU)
    arm, elbow = INDEX["left_shoulder"], INDEX["left_elbow"]
    bent[:, arm] = (
        Rotation.from_rotvec(poses[:, arm]) * Rotation.from_euler("ZYX", [40, 20, 0], degrees=True)
    ).as_rotvec()
    clips = []
    for each in (poses, bent):
        (tmp_path / "a.bvh").write_text(write_bvh(rest, each, CMU))
        clips.append(read_bvh(tmp_path / "a.bvh"))
    turns = clips[1].turns.copy()
    shoulder = clips[0].names.index("LeftArm")
    turns[:, shoulder] = clips[0].turns[:, shoulder]  # as if another joint below it had turned
    rotations, translations, _ = retargeted(dataclasses.replace(clips[1], turns=turns), rest)

    def direction(poses):
        return np.diff(places_of(rest, poses, translations + rest[0])[:, [arm, elbow]], axis=1)

    np.testing.assert_allclose(direction(rotations), direction(bent), atol=EXACT)


def test_a_rest_pose_in_which_nobody_stands_gets_its_twists_from_the_motion(tmp_path):
    rest = person().copy()
    for name in ("spine1", "spine2", "spine3"):  # a straight spine: as the file's is
        rest[INDEX[name], [0, 2]] = rest[0, [0, 2]]
    poses = without_twist(rest, dance(names=LAFAN, scale=0.4))
    text = write_bvh(rest, poses, LAFAN, frames_along_bones(rest))
    offset = text.split("JOINT LeftLeg")[1].split("OFFSET ")[1].splitlines()[0].split()
    assert float(offset[0]) > 30 and abs(float(offset[1])) < 1e-6  # as LaFAN's are: along x
    rotations, _, _ = loaded(tmp_path, text, rest_joints=rest)
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=1e-4)


@pytest.mark.parametrize("names", [CMU, LAFAN])
def test_feet_stay_on_the_ground_on_another_body(tmp_path, names):
    """One person's squats, with a jump in the middle, move a body of other proportions."""
    source, target, frames = other_person(), person(), 9
    bend = np.radians(np.linspace(0, 80, frames))
    poses, moves = np.zeros((frames, 55, 3)), np.zeros((frames, 3))
    for side in ("left", "right"):
        for joint, share in (("hip", -1), ("knee", 2), ("ankle", -1)):
            poses[:, INDEX[f"{side}_{joint}"], 0] = share * bend
    poses[4] = 0  # in the air, legs stretched
    ankle = INDEX["left_ankle"]
    moves[:, 1] = 0.1 - places_of(source, poses, moves)[:, ankle, 1]
    moves[4, 1] += 0.25
    frame = frames_along_bones(source) if names is LAFAN else None
    rotations, translations, _ = loaded(
        tmp_path, write_bvh(source, poses, names, frame, moves), rest_joints=target
    )
    ours = places_of(target, rotations, translations + target[0])

    def legs(rest):
        return sum(
            np.linalg.norm(rest[INDEX[f"left_{b}"]] - rest[INDEX[f"left_{a}"]])
            for a, b in (("hip", "knee"), ("knee", "ankle"))
        )

    expected = np.where(np.arange(frames) == 4, 0.25 * legs(target) / legs(source), 0)
    feet = ours[:, [ankle, INDEX["right_ankle"]], 1]
    np.testing.assert_allclose(feet - feet[0], np.stack([expected] * 2, 1), atol=1e-4)
    assert np.ptp(ours[:, 0, 1]) > 0.3  # they were squats


@pytest.mark.parametrize("scheme", NAMED)
def test_names_of_programs_and_the_tree_of_those_unknown(tmp_path, scheme):
    rest, poses = person(), dance(3, names=CMU, scale=0.2)
    rotations, _, _ = loaded(tmp_path, write_bvh(rest, poses, NAMED[scheme]), rest_joints=rest)
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)


FINGERS_OF = {
    "Rokoko": (
        "{Side}Finger{n}{bone}",
        ("Metacarpal Proximal Distal", *["Proximal Medial Distal"] * 4),
        range(1, 6),
    ),
    "Xsens": (
        "{Side}{n}{bone}",
        ("MC PP DP", *["PP MP DP"] * 4),
        ("First", "Second", "Third", "Fourth", "Fifth"),
    ),
    "Poser": ("{s}{n}{bone}", ["1 2 3"] * 5, ("Thumb", "Index", "Mid", "Ring", "Pinky")),
    "Biped": ("Bip01 {S} Finger{n}{bone}", ["  1 2"] * 5, range(5)),
    "MakeHuman": ("finger{n}-{bone}.{S}", ["1 2 3"] * 5, range(1, 6)),
    "MocapNET": ("finger{n}-{bone}.{s}", ["1 2 3"] * 5, range(1, 6)),
}
"""For each program the form of a finger's names, the words for the joints of each finger, from the
thumb on, and the words or numbers of the fingers.
"""


@pytest.mark.parametrize("scheme", FINGERS_OF)
def test_fingers_with_numbers_are_counted_as_each_program_counts_them(tmp_path, scheme):
    form, bones, words = FINGERS_OF[scheme]
    fingers, names = ("thumb", "index", "middle", "ring", "pinky"), dict(CMU)
    for side in ("left", "right"):
        for finger, bones_of_it, word in zip(fingers, bones, words, strict=True):
            for i, bone in enumerate(bones_of_it.split(" ")[-3:], 1):
                names[f"{side}_{finger}{i}"] = form.format(
                    Side=side.title(), S=side[0].upper(), s=side[0], n=word, bone=bone
                )
    if scheme == "MocapNET":
        names |= {"left_thumb1": "lthumb", "right_thumb1": "rthumb"}
    rest, poses = person(), dance(3, names=names, scale=0.2)
    rotations, _, _ = loaded(tmp_path, write_bvh(rest, poses, names), rest_joints=rest)
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)


def test_limbs_of_two_joints_each_are_as_long_as_both():
    """MakeHuman's rig has two joints in a thigh, a shin, an upper arm and a forearm."""
    names, parents, rest = (
        ["root", "spine", "neck01"],
        [-1, 0, 1],
        [[0, 0, 0], [0, 2, 0], [0, 5, 0]],
    )
    for side, x in (("L", 1.0), ("R", -1.0)):
        for begin, limb in ((0, LEG), (1, ARM)):
            for i, (name, along, down) in enumerate(limb):
                names.append(f"{name}.{side}")
                parents.append(begin if i == 0 else len(parents) - 1)
                rest.append([x * along, rest[begin][1] - down, 0])
    rest = np.asarray(rest, float)
    source = matched(names, parents, rest, rest)
    for ours, theirs in (
        *(("hip", "upperleg01"), ("knee", "lowerleg01"), ("ankle", "foot"), ("foot", "toe1-1")),
        *(("shoulder", "upperarm01"), ("elbow", "lowerarm01"), ("wrist", "wrist")),
    ):
        assert names[source[f"left_{ours}"]] == f"{theirs}.L"
        assert names[source[f"right_{ours}"]] == f"{theirs}.R"


def test_a_bone_without_length_is_no_bone_of_a_limb():
    assert _bends([0, 1, 2], np.asarray([9.0, 1, 0])) is None
    assert _bends([0, 1, 2], np.asarray([9.0, 0, 1])) is None
    assert _bends([0, 1, 2, 3], np.asarray([9.0, 0, 1, 1])) == [1, 2, 3]


LEG = (
    *(("upperleg01", 1, 0), ("upperleg02", 1, 2), ("lowerleg01", 1, 4), ("lowerleg02", 1, 6)),
    *(("foot", 1, 8), ("toe1-1", 1, 8.5)),
)
ARM = (
    *(("clavicle", 0.5, -2), ("upperarm01", 2, -2), ("upperarm02", 3, -2)),
    *(("lowerarm01", 4, -2), ("lowerarm02", 5, -2), ("wrist", 6, -2)),
)
"""Name, place to the side, and height below the joint that carries the limb."""


def test_a_joint_that_only_carries_another_is_not_taken_for_it(tmp_path):
    """MakeHuman writes "__Jaw", which never turns, above "Jaw"."""
    names = CMU | {"spine3": "__Neck", "left_collar": "__LeftArm"}
    rest, poses = person(), dance(3, names=CMU, scale=0.2)
    rotations, _, _ = loaded(tmp_path, write_bvh(rest, poses, names), rest_joints=rest)
    neck, arm = INDEX["neck"], INDEX["left_shoulder"]
    np.testing.assert_allclose(matrices(rotations[:, neck]), matrices(poses[:, neck]), atol=EXACT)
    theirs = places_of(rest, poses, np.zeros((3, 3)))
    ours = places_of(rest, rotations, np.zeros((3, 3)))
    elbow = INDEX["left_elbow"]
    np.testing.assert_allclose(
        ours[:, elbow] - ours[:, arm], theirs[:, elbow] - theirs[:, arm], atol=EXACT
    )


def test_a_foot_without_toes_does_not_follow_the_shin(tmp_path):
    """If bones lie along one axis at rest, the file does not tell where the foot points: as in
    T-pose on average.
    """
    rest, short = (
        person(),
        {ours: theirs for ours, theirs in LAFAN.items() if not ours.endswith("_foot")},
    )
    poses = without_twist(rest, dance(names=short, scale=0.2))
    ankles = [INDEX[f"{side}_ankle"] for side in ("left", "right")]
    poses[:, ankles] = 0
    rotations, _, _ = loaded(
        tmp_path, write_bvh(rest, poses, short, frames_along_bones(rest)), rest_joints=rest
    )
    np.testing.assert_allclose(rotations[:, ankles], 0, atol=1e-4)


@pytest.mark.parametrize("gap", ["   ", " \t "])
@pytest.mark.parametrize("brace", ["\n{", "{", " {"])
def test_names_with_spaces(tmp_path, gap, brace):
    """Biped and Rocketbox have them: a name ends with its line or before a brace."""
    names = {ours: theirs.replace(" ", gap) for ours, theirs in NAMED["Rocketbox"].items()}
    rest, poses = person(), dance(3, names=CMU)
    text = "\n".join(
        line.strip(" \t") for line in write_bvh(rest, poses, names).splitlines()
    ).replace("\n{", brace)
    for ending in ("\n", "\r\n"):
        rotations, _, _ = loaded(tmp_path, text.replace("\n", ending), rest_joints=rest)
        np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)


@pytest.mark.parametrize("said", [1, 7])
def test_a_file_that_miscounts_its_frames_is_read_with_a_warning(tmp_path, caplog, said):
    rest, poses = person(), dance(3, names=CMU, scale=0.2)
    text = write_bvh(rest, poses, CMU).replace("Frames: 3", f"Frames: {said}")
    rotations, _, _ = loaded(tmp_path, text, rest_joints=rest)
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)
    assert f"the file says {said} frames, but has 3: these are taken" in caplog.text


@pytest.mark.parametrize("added", [False, True])
def test_positions_of_all_joints_are_offsets_or_added_to_them(tmp_path, added):
    """MakeHuman adds them; Perception Neuron and others repeat the offsets."""
    rest, poses = person(), dance(3, names=CMU, scale=0.2)
    text, _, numbers = write_bvh(rest, poses, CMU).partition("Frame Time: 0.0083333\n")
    offsets = [line.split()[1:] for line in text.splitlines() if "OFFSET" in line]
    text = text.replace("CHANNELS 3", "CHANNELS 6 Xposition Yposition Zposition")
    ends = [i for i, line in enumerate(text.split("OFFSET")[:-1]) if "End Site" in line[-60:]]
    offsets = [offset for i, offset in enumerate(offsets) if i not in ends][1:]
    rows = []
    for line in numbers.splitlines():
        turns = line.split()
        row = turns[:6]
        for i, offset in enumerate(offsets, 2):
            row += (["0"] * 3 if added else offset) + turns[3 * i : 3 * i + 3]
        rows.append(" ".join(row))
    text += "Frame Time: 0.0083333\n" + "\n".join(rows)
    rotations, _, _ = loaded(tmp_path, text, rest_joints=rest)
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)


HEAD = (
    "HIERARCHY\nROOT Hips\n{\nOFFSET 0 0 0\nCHANNELS 3 Zrotation Yrotation Xrotation\nEnd"
    " Site\n{\nOFFSET 0 0 0\n}\n}\n"
)
BAD = {
    "words": ("hello", "not a BVH file: expected HIERARCHY first"),
    "no motion": (HEAD, "expected MOTION, Frames: and Frame Time:"),
    "strange": (
        HEAD + "MOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0\n",
        "expected the names of CMU, Mixamo, Unity",
    ),
    "few": (
        HEAD + "MOTION\nFrames: 2\nFrame Time: 0.1\n0 0 0 0\n",
        "expected 2 frames of 3 numbers, got 4 numbers: cut short?",
    ),
    "many": (
        HEAD + "MOTION\nFrames: 1\nFrame Time: 0.1\n0 0 0 0\n",
        "expected 1 frames of 3 numbers, got 4 numbers",
    ),
    "time": (
        HEAD + "MOTION\nFrames: 1\nFrame Time: 0\n0 0 0\n",
        "a positive Frame Time, got 1 and 0",
    ),
    "channels": (HEAD.replace("Zrot", "Wrot"), "expected up to 6 channels"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_files_are_one_line(tmp_path, case):
    text, expected = BAD[case]
    with pytest.raises(MotionError) as caught:
        loaded(tmp_path, text)
    message = str(caught.value)
    assert str(tmp_path / "dance.bvh") in message and expected in message and "\n" not in message


def test_a_body_of_other_joints_is_refused_by_name(tmp_path):
    with pytest.raises(MotionError, match="bodies of 55 joints, this one has 3"):
        loaded(tmp_path, write_bvh(person(), dance(2), CMU), rest_joints=np.zeros((3, 3)))
    np.savez(
        tmp_path / "ten.npz", rotations=np.zeros((4, 10, 3)), translations=np.zeros((4, 3)), fps=30
    )
    with pytest.raises(MotionError, match=r"ten\.npz: rotations: expected 55 joints, got 10"):
        load_motion(tmp_path / "ten.npz", rest_joints=person())
    np.savez(
        tmp_path / "far.npz",
        rotations=np.zeros((4, 55, 3)),
        translations=np.full((4, 3), 1e6),
        fps=30,
    )
    with pytest.raises(
        MotionError, match="expected metres, at most 10000 from the origin, got 1e\\+06"
    ):
        load_motion(tmp_path / "far.npz")
    (tmp_path / "walk.fbx").write_text("Kaydara")
    with pytest.raises(
        MotionError,
        match=r"expected a file .npz, .pkl, .pickle, .*, .bvh, .glb, .vrma, .csv or a folder, "
        r"got .fbx",
    ):
        load_motion(tmp_path / "walk.fbx")


# GLB
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("interpolation", ["LINEAR", "CUBICSPLINE", "STEP"])
def test_the_skeleton_of_a_glb(tmp_path, interpolation):
    rest, poses = person(), dance(4)
    moves = np.random.default_rng(1).normal(size=(4, 3))
    write_glb(tmp_path / "a.glb", rest, poses, moves, MIXAMO, interpolation=interpolation)
    motion = load_motion(tmp_path / "a.glb", rest_joints=rest)
    assert motion.fps == 24
    np.testing.assert_allclose(matrices(motion.rotations), matrices(poses), atol=EXACT)
    np.testing.assert_allclose((motion.translations + rest[0] - moves)[:, [0, 2]], 0, atol=EXACT)


def test_keys_that_an_optimizer_left_out_do_not_lower_the_rate():
    """Left out are those that lie on a line between others."""
    every = np.arange(11) / 24
    for keys in ([every], [every, every[[0, 10]]], [every.astype(np.float32)]):
        times, fps = frame_times(keys)
        np.testing.assert_allclose(times, every, atol=1e-6)
        assert fps == pytest.approx(24, rel=1e-6)
    times, fps = frame_times([every[[0, 1, 5, 6, 10]], every[[0, 10]]])
    np.testing.assert_allclose(times, every)
    assert fps == 24.0
    # a single late key of a track that is even otherwise
    times, fps = frame_times([np.append(np.arange(31) / 30, 1.005)])
    assert fps == pytest.approx(31 / 1.005) and len(times) == 32
    # two keys in a thousandth of a second: no more than 16 frames for each key
    times, fps = frame_times([np.asarray([0, 1e-3, 1.0])])
    assert len(times) == 33 and fps == 32
    assert frame_times([np.arange(3) / 24, np.asarray([0, 100.0])]) is None


def test_compressed_numbers_are_refused_by_the_name_of_the_compression():
    """The views of gltfpack's files name a buffer that is not there."""
    content = {
        "bufferViews": [
            {"buffer": 1, "byteLength": 8, "extensions": {"EXT_meshopt_compression": {}}}
        ],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 2, "type": "SCALAR"}],
    }
    with pytest.raises(ValueError, match=r"compressed \(EXT_meshopt_compression\): export"):
        read_accessor(content, b"", 0)


def test_a_glb_in_centimetres_below_a_turned_node(tmp_path):
    """Blender writes rigs with z up so: an armature of scale 0.01 with a quarter turn."""
    rest, poses = person(), dance(3)
    matrix = np.eye(4)
    matrix[:3, :3] = 0.01 * Rotation.from_euler("x", -90, degrees=True).as_matrix()
    inner = Rotation.from_euler("x", 90, degrees=True)  # bones lie in z-up centimetres
    turned = 100 * inner.apply(rest)
    local = np.stack([inner.apply(p) for p in poses])
    moves = np.random.default_rng(1).normal(size=(3, 3))
    above = {"name": "Armature", "matrix": matrix.T.reshape(-1).tolist()}
    write_glb(tmp_path / "a.glb", turned, local, 100 * inner.apply(moves), MIXAMO, above=above)
    motion = load_motion(tmp_path / "a.glb", rest_joints=rest)
    np.testing.assert_allclose(matrices(motion.rotations), matrices(poses), atol=EXACT)
    np.testing.assert_allclose((motion.translations + rest[0] - moves)[:, [0, 2]], 0, atol=EXACT)


def test_a_clip_of_several_is_chosen_by_name_or_number(tmp_path, caplog):
    rest, names = person(), ("Idle", "Run", "Walk")
    clips = [dance(2, seed) for seed in range(3)]
    write_glb(
        tmp_path / "a.vrma", rest, clips[0], np.zeros((2, 3)), MIXAMO, more=clips[1:], titles=names
    )
    for chosen, poses in ((None, clips[0]), ("run", clips[1]), (2, clips[2])):
        motion = load_motion(tmp_path / "a.vrma", rest_joints=rest, clip=chosen)
        np.testing.assert_allclose(matrices(motion.rotations), matrices(poses), atol=EXACT)
    assert caplog.text.count("3 animations (Idle, Run, Walk): the first is taken") == 1
    with pytest.raises(MotionError, match=r"a\.vrma: clip Jump: expected one of Idle, Run, Walk"):
        load_motion(tmp_path / "a.vrma", rest_joints=rest, clip="Jump")


def test_bones_of_a_vrm_are_those_that_it_says(tmp_path):
    rest, poses = person(), dance(3, names=CMU)
    ours = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
    words = dict(
        zip(
            ours,
            ["Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes"],
            strict=True,
        )
    )
    middle = {"pelvis": "hips", "spine1": "spine", "spine2": "chest", "spine3": "upperChest"}
    bones = {
        o: o.split("_")[0] + words[o.split("_")[1]] if "_" in o else middle.get(o, o) for o in CMU
    }
    joints = [name for name in JOINT_NAMES if name in CMU]
    human = {bones[name]: {"node": i} for i, name in enumerate(joints)}
    scrambled = {name: f"L_thing {i * 37 % 101}" for i, name in enumerate(joints)}
    extensions = {"VRMC_vrm_animation": {"humanoid": {"humanBones": human}}}
    write_glb(tmp_path / "a.vrma", rest, poses, np.zeros((3, 3)), scrambled, extensions=extensions)
    motion = load_motion(tmp_path / "a.vrma", rest_joints=rest)
    np.testing.assert_allclose(matrices(motion.rotations), matrices(poses), atol=EXACT)


def test_glb_files_that_are_no_motion(tmp_path):
    writer = GlbWriter()
    times, turns = writer.array("SCALAR", np.arange(2.0)), writer.array("VEC4", np.ones((2, 4)))
    channel = {"sampler": 0, "target": {"node": 0, "path": "rotation"}}

    def track(output=turns, channels=(channel,)):
        return {
            "animations": [
                {"channels": list(channels), "samplers": [{"input": times, "output": output}]}
            ]
        }

    for document, problem in (
        ({}, "without an animation"),
        ({"nodes": [{"children": [1]}, {"children": [0]}]} | track(), "below itself"),
        ({"nodes": [{}]} | track(output=times), "one rotation for each of increasing times"),
        ({"nodes": [{"name": "a"}]} | track(), "expected the names of CMU"),
        ({"nodes": [{}]} | track(channels=()), "turns no joint"),
        (
            {"nodes": [{}]} | track(channels=(channel, channel)),
            "two tracks for the rotation of node 0",
        ),
    ):
        writer.write(tmp_path / "a.glb", document)
        with pytest.raises(MotionError, match=problem) as caught:
            load_motion(tmp_path / "a.glb")
        assert str(tmp_path / "a.glb") in str(caught.value) and "\n" not in str(caught.value)
    (tmp_path / "a.glb").write_text("hello")
    with pytest.raises(MotionError, match="no GLB file"):
        load_motion(tmp_path / "a.glb")


def test_the_text_of_a_glb_may_be_as_long_as_other_json(tmp_path):
    """Characters of many clips have a megabyte of text; scans, which trimesh loads, may not."""
    for name, more in (("a.glb", {}), ("b.glb", {"extras": ["clip"] * 150_000})):
        write_glb(tmp_path / name, person(), dance(2), np.zeros((2, 3)), MIXAMO, **more)
    assert (tmp_path / "b.glb").stat().st_size > 1_000_000
    one, other = (load_motion(tmp_path / name) for name in ("a.glb", "b.glb"))
    np.testing.assert_array_equal(one.rotations, other.rotations)


# The world's up
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("kind", motions())
def test_people_on_the_floor_stay_there(tmp_path, caplog, kind, up):
    """The rest pose tells which way is up, whatever people do."""
    poses, translations = motions()[kind]
    poses = poses.copy()
    poses[:, [i for i, name in enumerate(JOINT_NAMES) if name not in CMU]] = 0
    text = write_bvh(person(), poses, CMU, moves=translations + person()[0], up=UP[up])
    rotations, _, _ = loaded(tmp_path, text, rest_joints=person())
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)
    assert not [line for line in caplog.messages if " is up, not " in line]


def test_people_who_walk_along_another_axis_than_the_rest_pose_are_turned_with_a_warning(
    tmp_path, caplog
):
    poses, translations = motions()["walking"]
    turned, moved = in_world(poses, translations, UP["z"])
    with caplog.at_level(logging.WARNING):
        rotations, _, _ = loaded(
            tmp_path,
            write_bvh(person(), turned, CMU, moves=moved + person()[0]),
            rest_joints=person(),
        )
    np.testing.assert_allclose(matrices(rotations), matrices(poses), atol=EXACT)
    assert "dance.bvh: z is up, not y as usual" in caplog.text
