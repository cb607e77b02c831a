"""Writes a known motion of one person as estimators and data sets do."""

import collections
import json
import pickle
import zlib

import numpy as np
from joblib_files import joblib
from network.torch_writer import FakeTensor, plain_pickle, write_checkpoint
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.motion import PELVIS
from humangs_jax.geometry.axes import UPRIGHT
from humangs_jax.motion.arrays import RIG, RIG_JOINTS
from humangs_jax.motion.rules import joint_places
from humangs_jax.motion.skeleton import shipped_joints

FRAMES = 6
SINGLE, MATRICES = 1e-5, 2e-5
"""Errors of radians and metres in float32, and of matrices in float32."""
HEAD = JOINT_NAMES.index("head")


def person(seed=0, frames=FRAMES):
    """Returns (rotations (m, 55, 3), places (m, 3)) of an upright person.

    Places are those of the pelvis, less its place at rest.
    """
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
    """Returns the motion in a world in which another axis points up.

    This is the inverse of `turned_upright`.
    """
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
    """Returns MDM's arrays: first two rows of 24 matrices and the pelvis in space, frames last."""
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
    """Returns Kimodo's local and global matrices and the place of the pelvis."""
    local = np.tile(np.eye(3), (FRAMES, joints, 1, 1))
    local[:, :22] = matrices(ROTATIONS[:, :22])
    named = {"local_rot_mats": local, "global_rot_mats": local, "root_positions": PLACES + PELVIS}
    return named | {
        "posed_joints": np.zeros((FRAMES, joints, 3)),
        "foot_contacts": np.zeros((FRAMES, 4), bool),
    }


def smpl(rotations=ROTATIONS, places=PLACES):
    """Returns rotation matrices of SMPL's 24 joints as 4D-Humans stores them."""
    hands = np.zeros((len(rotations), 2, 3))
    body = matrices(np.concatenate([rotations[:, 1:22], hands], axis=1))
    return {"global_orient": matrices(rotations[:, :1]), "body_pose": body, "transl": places}


def wham(rotations=ROTATIONS, places=PLACES, **more):
    """Returns WHAM's poses in the world and in the camera, which differ."""
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

    def body(values):
        return {
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
    """Returns PHALP's frames by image, with lists of the tracks; another person is seen in some."""
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
    """Returns EasyMocap's frames, where x = R(Rh) x0 + Th turns about the origin."""
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
    """Returns a writer of one file for each frame, in the camera's axes.

    The place is that of the head.
    """
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
    """Returns a writer of one file for each frame, whose names are numbers: 8, 9, 10."""
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
    "4D-Humans, matrices": (npz(**smpl()), BODY, {}),
    "no positions": (
        npz(**{k: v for k, v in parts().items() if k != "transl"}),
        [*WITH_FACE, *range(25, 55)],
        {"places": False},
    ),
    "GVHMR": (torch(write_checkpoint, gvhmr()), BODY, {}),
    "GVHMR, pickled tensors": (saved("a.pkl", gvhmr(), plain_pickle), BODY, {}),
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
    "EasyMocap, own root": (
        texts([f"{i}.json" for i in range(FRAMES)], [[x] for x in easymocap(root=[0.4, 0.2, 0])]),
        BODY,
        {},
    ),
    "Human3R": (human3r(), [*WITH_FACE, *range(25, 55)], {"fps": 30}),
    "TRAM": (tram(), BODY, {}),
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
    "Motion-X": (array("000001.npy", motion_x()), [*WITH_FACE[:23], *range(25, 55)], {}),
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
"""Formats: a writer, the joints that it has, and options.

Of the options, `places` says whether the file has positions, and `frames` how many frames.
"""


def mhr(rots=True, frames=FRAMES):
    """Returns SAM 3D Body's joints of the shipped body, whose bones are turned at rest."""
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
