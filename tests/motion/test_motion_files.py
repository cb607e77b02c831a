"""Motions as estimators and data sets write them, read back as the motion that was written; files
of several people.
"""

import collections
import json
import pickle
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.motion import PELVIS
from humangs_jax.geometry.axes import UPRIGHT
from humangs_jax.motion import MotionError, load_motion
from humangs_jax.motion.arrays import RIG, RIG_JOINTS
from humangs_jax.motion.rules import joint_places
from humangs_jax.motion.skeleton import shipped_joints

sys.path.insert(0, str(Path(__file__).parents[1] / "network"))
from joblib_files import joblib
from torch_writer import FakeTensor, plain_pickle, write_checkpoint

FRAMES = 6
SINGLE, MATRICES = 1e-5, 2e-5
"""Radians and metres: float32; of matrices in float32."""
HEAD = JOINT_NAMES.index("head")


def person(seed=0, frames=FRAMES):
    """Somebody upright: rotations (m, 55, 3) and places of the pelvis less that at rest."""
    rng = np.random.default_rng(seed)
    rotations = rng.normal(0, 0.1, (frames, 55, 3))
    return rotations, np.asarray([0, 0.9, 0]) + rng.normal(0, 0.3, (frames, 3))


ROTATIONS, PLACES = person()
FLAT = ROTATIONS.reshape(FRAMES, 165)
OTHER, AWAY = person(1, 4)


def matrices(rotations):
    return (
        Rotation.from_rotvec(np.reshape(rotations, (-1, 3)))
        .as_matrix()
        .reshape(*np.shape(rotations), 3)
    )


def down(rotations, places, up="-y"):
    """The same in a world of which another axis points up: `turned_upright` the other way."""
    back = Rotation.from_quat(np.roll(UPRIGHT[up], -1)).inv()
    turned = rotations.copy()
    turned[:, 0] = (back * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    return turned, back.apply(places + PELVIS) - PELVIS


def npz(name="a.npz", **arrays):
    def write(folder):
        with open(folder / name, "wb") as file:
            np.savez(file, **arrays)
        return folder / name

    return write


def saved(name, content, dump=pickle.dumps):
    def write(folder):
        (folder / name).write_bytes(dump(content))
        return folder / name

    return write


def torch(write, content):
    return lambda folder: write(folder / "hmr4d_results.pt", as_tensors(content))


def as_tensors(content):
    if isinstance(content, dict):
        return {key: as_tensors(value) for key, value in content.items()}
    return FakeTensor(np.asarray(content, np.float32))


def objects(name, content):
    def write(folder):
        np.save(folder / name, content, allow_pickle=True)
        return folder / name

    return write


def all_of(*writes, at=""):
    def write(folder):
        for each in writes:
            each(folder)
        return folder / at

    return write


def in_folder(name, write):
    def within(folder):
        (folder / name).mkdir(exist_ok=True)
        return write(folder / name)

    return within


def texts(names, contents):
    def write(folder):
        for name, content in zip(names, contents, strict=True):
            (folder / name).write_text(json.dumps(content))
        return folder

    return write


def parts(rotations=ROTATIONS, places=PLACES, shape=lambda x: x.reshape(len(x), -1)):
    found = {
        "global_orient": rotations[:, :1],
        "body_pose": rotations[:, 1:22],
        "jaw_pose": rotations[:, 22:23],
    }
    found |= {"left_hand_pose": rotations[:, 25:40], "right_hand_pose": rotations[:, 40:]}
    return {key: shape(value) for key, value in found.items()} | {"transl": places}


def array(name, values):
    def write(folder):
        np.save(folder / name, values)
        return folder / name

    return write


def mdm(frames=FRAMES):
    """24 joints of SMPL by the first two rows of their matrices and the pelvis in space, the frames
    last.
    """
    turns = matrices(np.concatenate([ROTATIONS[:frames, :22], np.zeros((frames, 2, 3))], axis=1))
    thetas = turns[..., :2, :].reshape(frames, 24, 6).transpose(1, 2, 0).astype(np.float32)
    moves = (PLACES[:frames] + PELVIS).T
    motion = np.concatenate([thetas, np.pad(moves, ((0, 3), (0, 0)))[None]])
    named = {
        "thetas": thetas,
        "root_translation": moves,
        "motion": motion,
        "faces": np.zeros((4, 3), int),
    }
    return named | {
        "vertices": np.zeros((9, 3, frames)),
        "text": "a person walks",
        "length": frames,
    }


def motion_x(rotations=ROTATIONS, places=PLACES):
    flat, rows = rotations.reshape(FRAMES, 165), np.full((FRAMES, 322), 0.3)
    rows[:, :66], rows[:, 66:156], rows[:, 156:159] = flat[:, :66], flat[:, 75:], flat[:, 66:69]
    rows[:, 309:312] = places
    return rows


def kimodo(joints=22):
    """Local and global matrices, and where the pelvis is."""
    local = np.tile(np.eye(3), (FRAMES, joints, 1, 1))
    local[:, :22] = matrices(ROTATIONS[:, :22])
    named = {"local_rot_mats": local, "global_rot_mats": local, "root_positions": PLACES + PELVIS}
    return named | {
        "posed_joints": np.zeros((FRAMES, joints, 3)),
        "foot_contacts": np.zeros((FRAMES, 4), bool),
    }


def smpl(rotations=ROTATIONS, places=PLACES):
    """SMPL's 24 joints, rotation matrices as 4D-Humans has them."""
    hands = np.zeros((len(rotations), 2, 3))
    body = matrices(np.concatenate([rotations[:, 1:22], hands], axis=1))
    return {"global_orient": matrices(rotations[:, :1]), "body_pose": body, "transl": places}


def wham(rotations=ROTATIONS, places=PLACES, **more):
    """The world's pose, and the camera's, which is another."""
    pose = np.pad(rotations.reshape(len(rotations), 165)[:, :66], ((0, 0), (0, 6)))
    found = {
        "pose_world": pose,
        "trans_world": places,
        "pose": pose + 1,
        "trans": places + 1,
        "betas": np.zeros(10),
    }
    return found | {"frame_ids": np.arange(len(pose))} | more


def gvhmr():
    camera = parts(*down(ROTATIONS, PLACES + 1))
    body = lambda values: {
        key: value for key, value in values.items() if "hand" not in key and "jaw" not in key
    }
    return {
        "smpl_params_incam": body(camera),
        "smpl_params_global": body(parts()),
        "net_outputs": {"x": np.zeros((2, 2))},
    }


def prompthmr():
    world = {"pose": FLAT, "shape": np.zeros((FRAMES, 10)), "trans": PLACES}
    camera = {
        "rotmat": matrices(ROTATIONS) @ matrices([1.0, 0, 0]),
        "shape": world["shape"],
        "trans": PLACES + 3,
    }
    person = {"frames": np.arange(FRAMES), "smplx_cam": camera, "smplx_world": world}
    return {"people": {"1": person}, "camera_world": {"Rwc": np.tile(np.eye(3), (FRAMES, 1, 1))}}


def phalp(track=3):
    """Frames by image; lists of the tracks. Somebody else is there now and then."""
    camera = smpl(*down(ROTATIONS, PLACES))
    other = smpl(OTHER, AWAY)
    frames = {}
    for i in range(FRAMES):
        own = {
            "global_orient": camera["global_orient"][i],
            "body_pose": camera["body_pose"][i],
            "betas": np.zeros(10),
        }
        seen = [(track, own, camera["transl"][i])]
        if i < 2:
            two = {
                "global_orient": other["global_orient"][i],
                "body_pose": other["body_pose"][i],
                "betas": np.zeros(10),
            }
            seen.insert(0, (track + 4, two, AWAY[i]))
        tid, pose, place = map(list, zip(*seen, strict=True))
        frames[f"_DEMO/{i:06d}.jpg"] = {
            "time": i,
            "shot": 0,
            "tid": tid,
            "smpl": pose,
            "camera": place,
            "mask": [{"size": [2, 2]}],
        }
    return frames


def easymocap(rotations=ROTATIONS, places=PLACES, root=None, number=0):
    """x = R(Rh) x0 + Th about the origin."""
    turn = Rotation.from_rotvec(rotations[:, 0])
    poses = np.pad(rotations.reshape(len(rotations), -1)[:, 3:66], ((0, 0), (3, 6)))
    own = Rotation.from_rotvec(
        np.zeros((len(rotations), 3)) if root is None else np.tile(root, (len(rotations), 1))
    )
    poses[:, :3] = own.as_rotvec()
    turn = turn * own.inv()
    th = places + PELVIS - turn.apply(PELVIS)
    rows = zip(turn.as_rotvec(), th, poses, strict=True)
    return [
        {
            "id": number,
            "Rh": [r.tolist()],
            "Th": [t.tolist()],
            "poses": [p.tolist()],
            "shapes": [[0.0] * 10],
        }
        for r, t, p in rows
    ]


def human3r(people=((4, ROTATIONS, PLACES),)):
    """A file a frame, in the camera's axes; what is placed is the head."""
    files = []
    for i in range(FRAMES):
        turn, at = Rotation.from_rotvec([0, 0.1 * i, 0]), np.array([0.1 * i, 0, 0])
        rows = []
        for _, rotations, places in people:
            turned, moved = down(rotations[i : i + 1], places[i : i + 1])  # a world whose y is down
            head = joint_places(shipped_joints(), turned, moved)[:, HEAD]
            turned[:, 0] = (turn.inv() * Rotation.from_rotvec(turned[:, 0])).as_rotvec()
            order = [*range(22), *range(25, 55), 22]
            rows.append((turned[0, order], turn.inv().apply(head - at)[0]))
        camera = np.eye(4)
        camera[:3, :3], camera[:3, 3] = turn.as_matrix(), at
        rotvec, transl = map(np.stack, zip(*rows, strict=True))
        ids = np.asarray([number for number, _, _ in people])
        files.append(
            npz(
                f"{i:06d}.npz",
                rotvec=rotvec,
                transl=transl,
                smpl_id=ids,
                cam2world=camera,
                shape=np.zeros((len(people), 10)),
            )
        )
    return all_of(*(in_folder("smpl", file) for file in files))


def tram(camera=True):
    turns = Rotation.from_rotvec(np.linspace([0, 0, 0], [0.3, 0.2, 0], FRAMES))
    at = np.linspace([0, 0, 0], [1.0, 0, 1], FRAMES)
    world, places = down(ROTATIONS, PLACES)
    own = world.copy()
    own[:, 0] = (turns.inv() * Rotation.from_rotvec(world[:, 0])).as_rotvec()
    pelvis = turns.inv().apply(places + PELVIS - at)
    values = {
        "pred_rotmat": matrices(np.pad(own[:, :22], ((0, 0), (0, 2), (0, 0)))),
        "pred_shape": np.zeros((FRAMES, 10)),
    }
    values |= {"pred_trans": (pelvis - PELVIS)[:, None], "frame": np.arange(FRAMES)}
    cameras = {"pred_cam_R": turns.as_matrix(), "pred_cam_T": at, "img_focal": np.float64(900)}
    files = [in_folder("hps", objects("hps_track_0.npy", values)), objects("camera.npy", cameras)]
    return all_of(*files[: 1 + camera])


def smplerx(rotations=ROTATIONS, places=PLACES, number=0):
    turned, moved = down(rotations, places)
    rows = (
        parts(turned[i : i + 1], moved[i : i + 1], lambda x: x.reshape(-1, 3))
        for i in range(len(rotations))
    )
    return [
        npz(f"{i:05}_{number}.npz", **row, betas=np.zeros((1, 10))) for i, row in enumerate(rows)
    ]


def lhm():
    """A file a frame, whose numbers are no words: 8, 9, 10."""
    names = (
        "root_pose",
        "body_pose",
        "jaw_pose",
        "leye_pose",
        "reye_pose",
        "lhand_pose",
        "rhand_pose",
    )
    frames = []
    for rotations, place in zip(ROTATIONS, PLACES.tolist(), strict=True):
        parts = [each.tolist() for each in np.split(rotations, (1, 22, 23, 24, 25, 40))]
        frames.append(
            dict(zip(names, parts, strict=True)) | {"root_pose": parts[0][0], "trans": place}
        )
    return texts([f"{i + 8}.json" for i in range(FRAMES)], frames)


def slahmr(people):
    stacked = [
        np.stack(x)
        for x in zip(
            *((r[:, 0], r[:, 1:22].reshape(len(r), -1), p) for r, p in people), strict=True
        )
    ]
    return npz(
        "a_world_results.npz",
        root_orient=stacked[0],
        pose_body=stacked[1],
        trans=stacked[2],
        latent_pose=np.zeros((2, 9)),
    )


CODEC = {
    "codecVersion": 2,
    "smplVersion": 2,
    "frameRate": 24.0,
    "frameCount": FRAMES,
    "bodyTranslation": PLACES,
}
CODEC |= {
    "bodyPose": ROTATIONS[:, :22],
    "headPose": ROTATIONS[:, 22:25],
    "leftHandPose": ROTATIONS[:, 25:40],
}
AMASS = {"trans": PLACES, "mocap_framerate": 30.0}
WITH_FACE = [*range(22), 22]
EVERY, BODY, HANDS = range(55), range(22), [*range(22), *range(25, 55)]
FILES = {
    "AMASS": (npz(poses=FLAT, **AMASS), EVERY, {"up": "y"}),
    "AMASS, z up": (
        npz(poses=down(ROTATIONS, PLACES, "z")[0].reshape(FRAMES, -1), **AMASS),
        EVERY,
        {"places": False},
    ),
    "AMASS 156": (
        npz(
            poses=np.delete(FLAT, range(66, 75), 1),
            labels=np.array([{"pickled": 1}], object),
            **AMASS,
        ),
        HANDS,
        {"up": "y"},
    ),
    "SMPL, joints": (
        npz(poses=np.pad(ROTATIONS[:, :22], ((0, 0), (0, 2), (0, 0))), **AMASS),
        BODY,
        {"up": "y"},
    ),
    "SMPL, a pose": (
        saved("a.pkl", {"pose": np.pad(FLAT[:, :66], ((0, 0), (0, 6))), "transl": PLACES}),
        BODY,
        {"fps": 30},
    ),
    "SMPL-X, fullpose": (npz(fullpose=ROTATIONS, trans=PLACES), EVERY, {"fps": 30, "up": "y"}),
    "AIST++, scaled": (
        npz(smpl_poses=FLAT[:, :66], smpl_trans=93.77 * PLACES, smpl_scaling=np.array([93.77])),
        *(BODY, {"fps": 30}),
    ),
    "AMASS, matrices": (
        npz(poses=matrices(ROTATIONS).reshape(FRAMES, -1), **AMASS),
        EVERY,
        {"up": "y"},
    ),
    "AIST++": (
        saved(
            "a.pkl",
            {"smpl_poses": np.pad(FLAT[:, :66], ((0, 0), (0, 6))), "smpl_trans": 1000 * PLACES},
        ),
        BODY,
        {},
    ),
    "parts": (npz(**parts()), [*WITH_FACE, *range(25, 55)], {}),
    "parts of matrices": (npz(**parts(shape=matrices)), [*WITH_FACE, *range(25, 55)], {}),
    "4D-Humans, matrices": (npz(**smpl()), BODY, {}),
    "no positions": (
        npz(**{k: v for k, v in parts().items() if k != "transl"}),
        [*WITH_FACE, *range(25, 55)],
        {"places": False},
    ),
    "GVHMR": (torch(write_checkpoint, gvhmr()), BODY, {}),
    "GVHMR, pickled tensors": (saved("a.pkl", gvhmr(), plain_pickle), BODY, {}),
    "GVHMR, pickled": (saved("a.pkl", gvhmr()), BODY, {}),
    "GVHMR, the camera alone": (
        saved("a.pkl", {"smpl_params_incam": parts(*down(ROTATIONS, PLACES))}),
        [*WITH_FACE, *HANDS],
        {},
    ),
    "WHAM": (
        saved("wham_output.pkl", collections.defaultdict(dict, {0: wham()}), joblib),
        BODY,
        {},
    ),
    "WHAM, padded": (
        saved("wham_output.pkl", {np.int64(0): wham()}, lambda x: joblib(x, 16)),
        BODY,
        {},
    ),
    "WHAM, compressed": (
        saved("a.pkl", {0: wham()}, lambda x: zlib.compress(joblib(x, protocol=2))),
        BODY,
        {},
    ),
    "WHAM, one person": (saved("a.pkl", wham()), BODY, {}),
    "VIBE": (
        saved(
            "vibe_output.pkl",
            {
                1: {
                    "pose": wham()["pose_world"],
                    "orig_cam": np.ones((FRAMES, 4)),
                    "frame_ids": np.arange(FRAMES),
                }
            },
            joblib,
        ),
        *(BODY, {"places": False}),
    ),
    "PromptHMR": (saved("results.pkl", prompthmr(), joblib), EVERY, {}),
    "PHALP": (saved("demo.pkl", phalp(), lambda x: zlib.compress(joblib(x))), BODY, {"person": 3}),
    "EasyMocap": (
        texts([f"{i:06d}.json" for i in range(FRAMES)], [[x] for x in easymocap()]),
        BODY,
        {},
    ),
    "EasyMocap, in smpl/": (
        all_of(
            in_folder(
                "smpl",
                texts(
                    [f"{i:06d}.json" for i in range(FRAMES)], [{"annots": [x]} for x in easymocap()]
                ),
            )
        ),
        *(BODY, {}),
    ),
    "EasyMocap, own root": (
        texts([f"{i}.json" for i in range(FRAMES)], [[x] for x in easymocap(root=[0.4, 0.2, 0])]),
        BODY,
        {},
    ),
    "Human3R": (human3r(), [*WITH_FACE, *range(25, 55)], {"fps": 30}),
    "TRAM": (tram(), BODY, {}),
    "TRAM, one track": (lambda folder: tram()(folder) / "hps" / "hps_track_0.npy", BODY, {}),
    "SMPLer-X": (
        all_of(*(in_folder("smplx", each) for each in smplerx())),
        [*WITH_FACE, *range(25, 55)],
        {},
    ),
    "LHM": (lhm(), EVERY, {}),
    "smplcodec": (npz("subject-1.smpl", **CODEC), [*range(40)], {}),
    "HuMoR": (
        npz(root_orient=ROTATIONS[:, 0], pose_body=FLAT[:, 3:66], trans=PLACES, betas=np.zeros(16)),
        BODY,
        {},
    ),
    "AMASS, separate": (
        npz(
            root_orient=ROTATIONS[:, 0],
            pose_body=FLAT[:, 3:66],
            pose_hand=FLAT[:, 75:],
            pose_jaw=FLAT[:, 66:69],
            pose_eye=FLAT[:, 69:75],
            **AMASS,
        ),
        *(EVERY, {}),
    ),
    "MDM": (objects("sample00_rep00_smpl_params.npy", mdm()), BODY, {}),
    "MDM, three frames": (objects("a.npy", mdm(3)), BODY, {"frames": 3}),
    "Motion-X": (array("000001.npy", motion_x()), [*WITH_FACE[:23], *range(25, 55)], {}),
    "Motion-X, z up": (
        array("000001.npy", motion_x(*down(ROTATIONS, PLACES, "z"))),
        [*WITH_FACE[:23], *range(25, 55)],
        {},
    ),
    "rows of SMPL": (
        array("poses.npy", np.pad(FLAT[:, :66], ((0, 0), (0, 6)))),
        BODY,
        {"places": False},
    ),
    "rows of SMPL-X": (array("poses.npy", FLAT.astype(np.float32)), EVERY, {"places": False}),
    "rows of matrices": (
        array("poses.npy", np.asfortranarray(matrices(ROTATIONS[:, :22]))),
        BODY,
        {"places": False},
    ),
    "Kimodo": (npz(**kimodo()), BODY, {}),
    "SLAHMR": (
        slahmr([(OTHER, AWAY), (ROTATIONS[:4], PLACES[:4])]),
        BODY,
        {"person": 1, "frames": 4},
    ),
}
"""What writes a file, the joints that it has, and options; places: whether positions are in it;
frames: of it.
"""


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
        "MDM, three frames": 20.0,
    }.get(kind, 30.0)


def with_values(values, **changes):
    return npz(**{**values, **changes})


NO_MOTIONS = {
    "features of HumanML3D": (
        array("a.npy", np.zeros((9, 263))),
        "263 features a frame of HumanML3D, not rotations",
    ),
    "features of KIT": (array("a.npy", np.zeros((9, 251))), "251 features a frame of KIT-ML"),
    "joints of HumanML3D": (
        array("a.npy", np.zeros((9, 22, 3))),
        r"22 joints in space \(HumanML3D's new_joints\), or",
    ),
    "points": (
        array("a.npy", np.zeros((9, 24, 3))),
        "24 joints in space, or axis-angles in three axes: expected a row",
    ),
    "another array": (
        array("a.npy", np.zeros((9, 100))),
        r"an array of shape \(9, 100\): expected .* 322, 165, 156, 72, 66",
    ),
    "a number": (array("a.npy", np.asarray(3.0)), r"an array of shape \(\)"),
    "text": (array("a.npy", np.asarray(["a"] * 72)[None]), "expected real numbers"),
    "matrices that are none": (
        array("a.npy", np.ones((9, 22, 3, 3))),
        "expected rotation matrices",
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
    "MDM of zeros": (objects("a.npy", mdm() | {"thetas": np.zeros((24, 6, 6))}), "thetas"),
    "MDM of fewer places": (
        objects("a.npy", mdm() | {"root_translation": np.zeros((3, 5))}),
        r"root_translation: expected",
    ),
    "Kimodo's SOMA": (
        npz(**kimodo(77)),
        "local_rot_mats: .* 77 joints of SOMA: write a .bvh of them",
    ),
    "Kimodo without places": (
        with_values(kimodo(), root_positions=np.zeros((5, 3))),
        r"root_positions: expected shape \(6, 3\)",
    ),
}


@pytest.mark.parametrize("kind", NO_MOTIONS)
def test_arrays_that_are_no_motion_say_what_they_are(kind, tmp_path):
    write, message = NO_MOTIONS[kind]
    path = write(tmp_path)
    with pytest.raises(MotionError, match=message) as error:
        load_motion(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def mhr(rots=True, frames=FRAMES):
    """SAM 3D Body's joints of the shipped body, with bones that are turned at rest."""
    places = joint_places(shipped_joints(), ROTATIONS, PLACES) * [1, -1, -1]
    world = Rotation.from_rotvec(ROTATIONS.reshape(-1, 3)).as_matrix().reshape(FRAMES, 55, 3, 3)
    points, turns = (
        np.zeros((FRAMES, RIG_JOINTS, 3)),
        np.tile(np.eye(3), (FRAMES, RIG_JOINTS, 1, 1)),
    )
    own = Rotation.random(RIG_JOINTS, random_state=2).as_matrix()
    at = np.array([0, 1.0, 4])
    for j, p in enumerate(PARENTS):
        world[:, j] = world[:, j] if p < 0 else world[:, p] @ world[:, j]
    for joint, (name, _) in RIG.items():
        j = JOINT_NAMES.index(name if name != "spine0" else "pelvis")
        points[:, joint], turns[:, joint] = places[:, j] - at, world[:, j] @ own[joint]
    found = {
        "pred_joint_coords": points,
        "pred_cam_t": np.tile(at, (FRAMES, 1)),
        "pred_vertices": np.zeros((FRAMES, 4, 3)),
    }
    return found | ({"pred_global_rots": turns} if rots else {})


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


def test_frames_in_which_nobody_was_seen_are_filled(tmp_path, caplog):
    at = [0, 1, 4, 5]
    seen = np.asarray([10, 11, 14, 15])
    moves = np.arange(6.0)[:, None] * [0.1, 0, 0]
    path = saved("a.pkl", {0: wham(np.zeros((4, 55, 3)), moves[at], frame_ids=seen)})(tmp_path)
    motion = load_motion(path, fps=25)
    np.testing.assert_allclose(motion.translations, moves, atol=SINGLE)
    assert motion.fps == 25 and "nobody in 2 of 6 frames: filled in between" in caplog.text
    every_second = saved("b.pkl", {0: wham(frame_ids=np.arange(0, 2 * FRAMES, 2))})(tmp_path)
    assert len(load_motion(every_second).rotations) == FRAMES


def test_what_is_missing_is_said(tmp_path, caplog):
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
