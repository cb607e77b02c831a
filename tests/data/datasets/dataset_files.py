"""Writes tiny data sets in every layout, of random numbers: valid files without a real person."""

import csv
import io
import json
import pickle
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from humangs_jax.body.joints import PARENTS
from humangs_jax.data.datasets.subject import FileBody

VERTICES, COLUMNS, FRAMES, CAMERAS = 80, 10, 3, 2
WIDTH, HEIGHT = 12, 16
HANDS = ("left", "right")
ANGLES = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}


def model_arrays(seed=0):
    """Returns the arrays of an SMPL-X model file of a few vertices."""
    rng = np.random.default_rng(seed)
    joints = len(PARENTS)
    template = rng.normal(size=(VERTICES, 3)) * [0.2, 0.5, 0.1]
    template[0], template[12] = (0, -0.3, 0), (0, 0.2, 0.05)  # pelvis and neck
    weights = rng.uniform(size=(VERTICES, joints)) ** 6
    weights[:40, 25:] = 0  # not of the hands
    return {
        "v_template": template,
        "f": rng.permutation(VERTICES)[:60].reshape(20, 3),
        "shapedirs": 0.03 * rng.normal(size=(VERTICES, 3, 2 * COLUMNS)),
        "posedirs": 0.01 * rng.normal(size=(VERTICES, 3, 9 * (joints - 1))),
        "J_regressor": np.eye(joints, VERTICES),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack(
            [np.where(np.asarray(PARENTS) < 0, 2**32 - 1, PARENTS), np.arange(joints)]
        ),
        "hands_meanl": 0.2 * rng.normal(size=45),
        "hands_meanr": 0.2 * rng.normal(size=45),
        "hands_componentsl": rng.normal(size=(45, 45)),
        "hands_componentsr": rng.normal(size=(45, 45)),
    }


def write_model(folder, seed=0):
    np.savez(folder / "SMPLX_TINY.npz", **model_arrays(seed))
    return FileBody.load(folder / "SMPLX_TINY.npz")


def oracle(arrays, betas, rotations, translation):
    """Returns (rest, vertices, joint transforms), from SMPL-X's equations in numpy."""
    rest = arrays["v_template"] + arrays["shapedirs"] @ betas
    joints = arrays["J_regressor"] @ rest
    local = Rotation.from_rotvec(rotations).as_matrix()
    shaped = rest + arrays["posedirs"] @ (local[1:] - np.eye(3)).reshape(-1)
    frames = []
    for j, parent in enumerate(PARENTS):
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = local[j], joints[j] - (joints[parent] if parent >= 0 else 0)
        frames.append(frame if parent < 0 else frames[parent] @ frame)
    transforms = np.stack(frames)
    transforms[:, :3, 3] += translation - np.einsum("jab,jb->ja", transforms[:, :3, :3], joints)
    blended = np.einsum("nj,jab->nab", arrays["weights"], transforms)
    return rest, np.einsum("nab,nb->na", blended[:, :3, :3], shaped) + blended[:, :3, 3], transforms


# THuman
# --------------------------------------------------------------------------------------------------


def fit_values(kind, seed=0):
    """Returns random values of a smplx_param.pkl of this kind."""
    rng = np.random.default_rng([seed, ord(kind)])
    values = {key: 0.3 * rng.normal(size=(1, size)) for key, size in ANGLES.items()}
    length = 12 if kind == "A" else 45
    values |= {f"{hand}_hand_pose": 0.3 * rng.normal(size=(1, length)) for hand in HANDS}
    values |= {"betas": rng.normal(size=(1, COLUMNS)), "expression": rng.normal(size=(1, COLUMNS))}
    values |= {"scale": np.asarray([0.7 + rng.random()])}
    values |= {"transl" if kind == "C" else "translation": rng.normal(size=(1, 3))}
    return {key: np.asarray(value, np.float32) for key, value in values.items()}


def scan_vertices(arrays, values):
    """Returns (rest, vertices of mesh_smplx.obj, joint transforms) in units of the scan.

    They follow the table of docs/datasets.md.
    """
    hands = []
    for hand in HANDS:
        numbers = values[f"{hand}_hand_pose"][0].astype(float)
        if len(numbers) == 12:
            numbers = numbers @ arrays[f"hands_components{hand[0]}"][:12]
        hands.append(numbers + arrays[f"hands_mean{hand[0]}"])
    pose = (
        np.concatenate([*(values[key][0] for key in ANGLES), *hands]).reshape(-1, 3).astype(float)
    )
    betas = np.concatenate([values["betas"][0], values["expression"][0]]).astype(float)
    scale = float(values["scale"][0])
    rest, vertices, transforms = oracle(arrays, betas, pose, np.zeros(3))
    offset = scale * values["transl"][0] if "transl" in values else values["translation"][0]
    transforms[:, :3, 3] = scale * transforms[:, :3, 3] + offset
    return scale * rest, scale * vertices + offset, transforms


def write_obj(path, vertices, faces, uvs=None):
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in np.asarray(vertices, float).tolist()]
    corner = (lambda i: f"{i}/{i}") if uvs is not None else str
    if uvs is not None:
        lines = [
            "mtllib material0.mtl",
            *lines,
            *(f"vt {u:.7g} {v:.7g}" for u, v in uvs.tolist()),
            "usemtl material0",
        ]
    lines += [
        "f " + " ".join(corner(i) for i in face) for face in (np.asarray(faces, int) + 1).tolist()
    ]
    path.write_text("\n".join(lines) + "\n")


def write_fit(folder, values, mesh, faces):
    """Writes smplx_param.pkl and mesh_smplx.obj."""
    folder.mkdir(parents=True)
    (folder / "smplx_param.pkl").write_bytes(pickle.dumps(values))
    write_obj(folder / "mesh_smplx.obj", mesh, faces)


def write_scan(folder, vertices, faces, uvs, texture):
    """Writes NAME.obj, material0.mtl and material0.jpeg."""
    folder.mkdir(parents=True)
    write_obj(folder / f"{folder.name}.obj", vertices, faces, uvs)
    (folder / "material0.mtl").write_text("newmtl material0\nmap_Kd material0.jpeg\n")
    Image.fromarray(texture).save(folder / "material0.jpeg", quality=95)


def write_thuman(folder, arrays, kinds="ABC"):
    """Writes a scan for each kind of fit: a cube around the body."""
    for i, kind in enumerate(kinds):
        values, name = fit_values(kind, i), f"{i:04d}"
        _, mesh, _ = scan_vertices(arrays, values)
        write_fit(folder / "smplx" / name, values, mesh, arrays["f"])
        low, high = mesh.min(0), mesh.max(0)
        corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
        faces = np.asarray([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]])
        faces = np.concatenate(
            [faces, [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]]
        )
        places, texture = low + corners * (high - low), np.full((8, 8, 3), 90, np.uint8)
        write_scan(folder / "model" / name, places, faces, corners[:, :2].astype(float), texture)
    return folder


# Videos
# --------------------------------------------------------------------------------------------------


class Recording(NamedTuple):
    """A person seen by c cameras.

    All cameras have the intrinsics K (3, 3), with pixel centres at whole numbers; R (c, 3, 3) and T
    (c, 3) are OpenCV's. shot(c, f) gives photo and mask, 8 bits. `parameters` are arrays by the
    names of smpl_params.npz with a row for each frame.
    """

    K: np.ndarray
    R: np.ndarray
    T: np.ndarray
    size: tuple[int, int]
    frames: int
    shot: Callable
    parameters: dict


def recording(frames=FRAMES):
    """Returns a recording of grey photos by cameras that look at the origin from 3 m."""
    turns = []
    for azimuth in np.arange(CAMERAS) * 2 * np.pi / CAMERAS:
        s, c = np.sin(azimuth), np.cos(azimuth)
        turns.append([[c, 0, -s], [0, -1, 0], [-s, 0, -c]])
    photo, person = np.full((HEIGHT, WIDTH, 3), 100, np.uint8), np.zeros((HEIGHT, WIDTH), np.uint8)
    person[4:12, 3:9] = 255
    K, T = np.asarray([[20.0, 0, 5.5], [0, 20, 7.5], [0, 0, 1]]), np.tile([0, 0, 3.0], (CAMERAS, 1))
    return Recording(
        K,
        np.asarray(turns),
        T,
        (WIDTH, HEIGHT),
        frames,
        lambda *_: (photo, person),
        parameter_arrays(frames=frames),
    )


def write_photo(photo, mask, pixels):
    for path, image in zip((photo, mask), pixels, strict=True):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path, quality=95)


def parameter_arrays(seed=0, frames=FRAMES):
    rng = np.random.default_rng(seed)
    sizes = {
        "global_orient": 3,
        "body_pose": 63,
        "jaw_pose": 3,
        "left_hand_pose": 45,
        "right_hand_pose": 45,
    }
    arrays = {key: 0.3 * rng.normal(size=(frames, size)) for key, size in sizes.items()}
    arrays |= {
        "transl": 0.1 * rng.normal(size=(frames, 3)),
        "betas": np.tile(rng.normal(size=COLUMNS), (frames, 1)),
    }
    return {
        key: x.astype(np.float32)
        for key, x in (arrays | {"expression": np.zeros((frames, COLUMNS))}).items()
    }


def calibration(names, made):
    flat = lambda x: np.asarray(x, float).reshape(-1).tolist()

    def camera_entry(R, T):
        return {
            "K": flat(made.K),
            "R": flat(R),
            "T": flat(T),
            "imgSize": list(made.size),
        }

    return {name: camera_entry(R, T) for name, R, T in zip(names, made.R, made.T, strict=True)}


def write_folders(folder, made, names, photos, masks, rig, every=1):
    """Writes a recording as photos in folders.

    `photos` and `masks` give the names for a camera. Photos show every n-th row of the parameters,
    where n is `every`.
    """
    for c, name in enumerate(names):
        for frame in range(made.frames):
            file = f"{every * frame:08d}.jpg"
            write_photo(
                folder / photos.format(name) / file,
                folder / masks.format(name) / file,
                made.shot(c, frame),
            )
    (folder / rig).write_text(json.dumps(calibration(names, made)))
    np.savez(
        folder / "smpl_params.npz",
        **{key: np.repeat(x, every, axis=0) for key, x in made.parameters.items()},
    )
    return folder


AVATARREX = "{}", "{}/mask/pha", "calibration_full.json"
THUMAN4 = "images/{}", "masks/{}", "calibration.json"


def write_avatarrex(folder, frames=FRAMES):
    return write_folders(folder, recording(frames), ["22010708", "22010710"], *AVATARREX)


def write_thuman4(folder, frames=FRAMES):
    write_folders(folder, recording(frames), ["cam00", "cam01"], *THUMAN4)
    (folder / "missing_img_files.txt").write_text("images\\cam01\\00000001.jpg\n")
    return folder


def write_actorshq(folder, frames=FRAMES):
    made, scale = recording(frames), folder / "4x"
    scale.mkdir(parents=True)
    with open(scale / "calibration.csv", "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(
            ["name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py"]
        )
        K = made.K
        inner = K[0, 0] / WIDTH, K[1, 1] / HEIGHT, (K[0, 2] + 0.5) / WIDTH, (K[1, 2] + 0.5) / HEIGHT
        for c, (R, T) in enumerate(zip(made.R, made.T, strict=True)):
            name = f"Cam{c + 1:03d}"
            table.writerow(
                [name, WIDTH, HEIGHT, *Rotation.from_matrix(R.T).as_rotvec(), *(-R.T @ T), *inner]
            )
            for frame in range(frames):
                photo = scale / "rgbs" / name / f"{name}_rgb{frame:06d}.jpg"
                write_photo(
                    photo,
                    scale / "masks" / name / f"{name}_mask{frame:06d}.png",
                    made.shot(c, frame),
                )
    np.savez(folder / "smpl_params.npz", **made.parameters)
    return folder


def h5py():
    """Returns the module h5py, or skips the test."""
    import pytest

    return pytest.importorskip("h5py", exc_type=ImportError)


def write_dna(folder, frames=FRAMES):
    """Writes a recording as DNA-Rendering does: photos in one HDF5 file, the rest in another."""
    import h5py

    made = recording(frames)
    for part in ("main", "annotations"):
        (folder / part).mkdir(parents=True)

    def encode(pixels):
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "PNG")
        return np.frombuffer(stream.getvalue(), np.uint8)

    values = made.parameters
    with (
        h5py.File(folder / "main" / "0001_01.smc", "w") as main,
        h5py.File(folder / "annotations" / "0001_01_annots.smc", "w") as notes,
    ):
        for c, (R, T) in enumerate(zip(made.R, made.T, strict=True)):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = R, T
            # cameras to the world, no distortion
            at = f"Camera_Parameter/{c:02d}"
            notes[f"{at}/K"] = made.K
            notes[f"{at}/D"] = np.zeros(5)
            notes[f"{at}/RT"] = np.linalg.inv(pose)
            for frame in range(frames):
                photo, mask = made.shot(c, frame)
                main[f"Camera_5mp/{c}/color/{frame}"] = encode(photo)
                notes[f"Mask/{c}/mask/{frame}"] = encode(mask)
        # poses of all joints in SMPL-X's order; the eyes are at rest
        names = ("global_orient", "body_pose", "jaw_pose")
        full = [*(values[name] for name in names), np.zeros((frames, 6))]
        full = np.concatenate([*full, values["left_hand_pose"], values["right_hand_pose"]], 1)
        notes["SMPLx/fullpose"] = full.reshape(frames, 55, 3)
        notes["SMPLx/transl"] = values["transl"]
        for key in ("betas", "expression"):
            notes[f"SMPLx/{key}"] = values[key]
    return folder


# Scene list
# --------------------------------------------------------------------------------------------------


def write_scenes(folder, arrays, scale=1.3, views=3):
    """Writes one scene of two frames in unusual units.

    Returns (list of scenes, betas, what the arrays were made from).
    """
    rng = np.random.default_rng(5)
    made = recording()
    betas = 0.5 * rng.normal(size=2 * COLUMNS)
    known = []
    frames = []
    for i in range(2):
        rotations, translation = 0.3 * rng.normal(size=(55, 3)), 0.1 * rng.normal(size=3)
        rest, vertices, transforms = oracle(arrays, betas, rotations, translation)
        transforms[:, :3, 3] *= scale
        (folder / "smpl").mkdir(parents=True, exist_ok=True)
        numbers = {
            "v_posed": scale * vertices,
            "v_cano": scale * rest,
            "joint_transforms": transforms,
        }
        numbers = {key: x.astype(np.float32) for key, x in numbers.items()}
        np.savez(folder / "smpl" / f"{i}.npz", faces=arrays["f"], **numbers)
        known.append((rotations, translation))
        for view in range(views):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = made.R[view % CAMERAS], scale * made.T[view % CAMERAS]
            path = f"images/{i}_{view}.png"
            image = np.full((HEIGHT, HEIGHT, 3), 255, np.uint8)
            image[4:12, 3:9] = 100
            image[6:8, 5:7] = 255  # a white spot on the clothes
            (folder / "images").mkdir(exist_ok=True)
            Image.fromarray(image).save(folder / path)
            inner = [made.K[0, 0], made.K[1, 1], HEIGHT / 2, HEIGHT / 2]
            frames.append(
                {
                    "image_path": path,
                    "w2c": pose.tolist(),
                    "fxfycxcy": inner,
                    "smpl_path": f"smpl/{i}.npz",
                }
            )
    content = [{"scene_name": "s0", "mesh_transform": np.eye(4).tolist(), "frames": frames}]
    (folder / "train.json").write_text(json.dumps(content))
    return folder / "train.json", betas, known
