"""Every reader of the package, and an honest file for each: what the hostile ones are made from.

`READERS[name]` is a function of a path; `SEEDS[name]` writes an honest file or folder into an empty folder and returns its path.
"""

import functools
import importlib.util
import io
import json
import pickle
import struct
import tempfile
from pathlib import Path

import bvh_files
import dataset_files
import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from safetensors.numpy import save_file
from torch_writer import tensors, write_checkpoint, write_stream

from humangs_jax.apps.settings import PRESETS, load_settings, save_settings
from humangs_jax.apps.start import look
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.frames import FOLLOWING, excerpt, smoothed_path
from humangs_jax.body.joints import JOINT_NAMES, PARENTS
from humangs_jax.body.library import load_body, save_body
from humangs_jax.body.model import BodyModel
from humangs_jax.body.smplx import load_hands, load_smplx
from humangs_jax.core.configuration import config_to_json
from humangs_jax.data.calibration.calibration import read_calibration
from humangs_jax.data.calibration.importing import import_cameras
from humangs_jax.data.capture import load_capture
from humangs_jax.data.datasets.scene_list import read_evaluation
from humangs_jax.data.datasets.subject import open_people
from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.keypoints.reading import read_keypoints
from humangs_jax.data.keypoints.sets import COCO_17
from humangs_jax.data.loading.captures import read_boundary
from humangs_jax.data.motion import load_motion
from humangs_jax.data.motion.skeleton import shipped_joints
from humangs_jax.data.photos import load_photos
from humangs_jax.data.preprocess.run import Settings, preprocess, scan_content
from humangs_jax.data.sets import SYNTHETIC, begin_set
from humangs_jax.fitting.files import KEYS, read_fit_record
from humangs_jax.fitting.scan_reading import read_joints, read_mesh
from humangs_jax.fitting.scan_views import read_placement
from humangs_jax.io.images import check_image, image_size, read_grey, read_image
from humangs_jax.io.mesh import GlbWriter
from humangs_jax.io.npz import read_npz
from humangs_jax.io.reading import read_json, reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle
from humangs_jax.io.tensors import read_tensors
from humangs_jax.losses.loss_networks import load_vgg19
from humangs_jax.network.conversion import load_checkpoint
from humangs_jax.network.weights import expected_variables, load_weights, save_weights
from humangs_jax.people.bank import load_bank
from humangs_jax.people.seeds import GENERATOR_VERSION
from humangs_jax.training.config import read_config, tiny
from humangs_jax.training.diagnose import first_failed_step

K = [[60.0, 0, 5], [0, 60, 6], [0, 0, 1]]
POSE = [[1.0, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, -1, 2.6], [0, 0, 0, 1]]
VIEWS = ("000", "001")


@functools.cache
def tiny_body():
    template = jnp.asarray([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    return BodyModel(
        template=template,
        shape_directions=jnp.ones((4, 3, 3)),
        pose_directions=None,
        joint_regressor=jnp.full((5, 4), 0.25),
        skinning_weights=jnp.full((4, 5), 0.2),
        faces=jnp.asarray([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        parents=(-1, 0, 1, 2, 3),
        joint_names=tuple("abcde"),
        shape_names=tuple("xyz"),
        name="tiny",
    )


def read_image_in_every_way(path):
    return image_size(path), check_image(path), read_image(path)


def read_whole_pickle(path):
    with reading(path, "pickle"):
        return {key: as_array(value) for key, value in read_pickle(path).items()}


def read_keypoints_of_two_views(path):
    return read_keypoints(path, VIEWS, 640, 480)


def read_capture(path):
    return load_capture(path, body=tiny_body())


def read_cameras(path):
    return read_calibration(path, lambda name: (64, 48))


def import_into(path):
    """Photos beside the calibration; the capture goes into a folder of its own."""
    return import_cameras(path, path.parent / "photos", path.parent / "imported", overwrite=True)


@functools.cache
def data_body():
    """The body of the data sets below; nothing is read of its file any more."""
    with tempfile.TemporaryDirectory() as folder:
        body = dataset_files.write_model(Path(folder))
        assert body.hands and body.arrays
    return body


def read_data_set(folder):
    """All people of a data set, with all that there is of them."""
    for person in open_people(folder, data_body(), SIDE):
        subject = person.subject
        subject.parameters(range(subject.frame_count))
        subject.photos(range(len(subject)), SIDE)


def read_scans(folder):
    """What preprocessing reads and computes of scans before it renders them."""
    thuman = open_thuman(folder)
    for name in thuman.names:
        scan_content(name, thuman, data_body(), Settings("thuman", views=1))


def continue_preprocessing(folder):
    """Of a set whose only subject is finished."""
    body = folder / "SMPLX_TINY.npz"
    preprocess(folder / "raw", folder / "out", body, PREPROCESSED, progress=False)


def continue_synthetic_set(path):
    """What `synth` does before it makes anybody."""
    begin_set(path.parent, SYNTHETIC, {key: MANIFEST[key] for key in ("generator_version", "split", "settings")})


def film(path):
    """The frames of a video of a motion, and the path of its camera."""
    with reading(path, "motion"):
        motion = excerpt(load_motion(path), fps=30.0)
        return smoothed_path(np.asarray(motion.translations), FOLLOWING * motion.fps)


SIDE = 16
PREPROCESSED = Settings("avatarrex", size=SIDE)
READERS = {
    "npz": read_npz,
    "json": read_json,
    "image": read_image_in_every_way,
    "mask": read_grey,
    "pickle": read_whole_pickle,
    "torch zip": read_tensors,
    "torch stream": read_tensors,
    "released checkpoint": load_checkpoint,
    "safetensors": read_tensors,
    "vgg": load_vgg19,
    "smplx npz": load_smplx,
    "smplx pkl": load_smplx,
    "hands": load_hands,
    "body": load_body,
    "avatar": Avatar.load,
    "weights": load_weights,
    "configuration": read_config,
    "settings": load_settings,
    "capture": read_capture,
    "photos": load_photos,
    "boundary": lambda path: read_boundary(path, tiny_body()),
    "transforms": read_cameras,
    "opencv yaml": read_cameras,
    "opencv json": read_cameras,
    "easymocap": read_cameras,
    "colmap": read_cameras,
    "import": import_into,
    "openpose": read_keypoints_of_two_views,
    "coco": read_keypoints_of_two_views,
    "coco annotations": read_keypoints_of_two_views,
    "mmpose": read_keypoints_of_two_views,
    "keypoints npz": read_keypoints_of_two_views,
    "motion npz": load_motion,
    "amass": load_motion,
    "aist": load_motion,
    "thuman": load_motion,
    "lhm": load_motion,
    "bvh": load_motion,
    "glb motion": load_motion,
    "obj": lambda path: read_mesh(path, colors=True),
    "ply": lambda path: read_mesh(path, colors=True),
    "glb": lambda path: read_mesh(path, colors=True),
    "stl": read_mesh,
    "off": read_mesh,
    "joints json": read_joints,
    "joints npz": read_joints,
    "fit record": read_fit_record,
    "bank": load_bank,
    "manifest": continue_synthetic_set,
    "log": first_failed_step,
    "filmed": film,
    "scan views": read_placement,
    "start": look,
    "avatarrex": read_data_set,
    "video poses": read_data_set,
    "missing photos": read_data_set,
    "actorshq": read_data_set,
    "dna photos": read_data_set,
    "dna notes": read_data_set,
    "scene list": read_data_set,
    "scene arrays": read_data_set,
    "evaluation": read_evaluation,
    "thuman fit": read_scans,
    "thuman mesh": read_scans,
    "thuman scan": read_scans,
    "preprocessed set": continue_preprocessing,
    "preprocessed scene": continue_preprocessing,
    "skipped subject": continue_preprocessing,
}


# Honest files ---------------------------------------------------------------------------------------------------------


def saved(name, write):
    """A seed: calls write(path)."""

    def seed(folder):
        write(folder / name)
        return folder / name

    return seed


def npz(name, arrays):
    return saved(name, lambda path: np.savez_compressed(path, **arrays()))


def text(name, content):
    return saved(name, lambda path: path.write_text(content() if callable(content) else content))


def pixels(*shape, dtype=np.uint8):
    return np.random.default_rng(1).integers(0, 256, shape).astype(dtype)


def smplx_arrays(n=9):
    random = np.random.default_rng(0)
    weights, regressor = random.uniform(size=(n, 55)), random.uniform(size=(55, n))
    return {
        "v_template": random.normal(size=(n, 3)),
        "f": random.integers(0, n, size=(4, 3)).astype(np.uint32),
        "shapedirs": random.normal(size=(n, 3, 20)).astype(np.float32),
        "posedirs": np.zeros((n, 3, 486), np.float32),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack([np.asarray(PARENTS), np.arange(55)]),
        **{f"hands_mean{side}": np.zeros(45) for side in "lr"},
        **{f"hands_components{side}": np.eye(45, dtype=np.float32) for side in "lr"},
    }


def avatar_arrays(g=6, n=4, j=3):
    random = np.random.default_rng(0)
    return {
        "means": random.normal(size=(g, 3)).astype(np.float32),
        "quats": np.tile(np.float32([1, 0, 0, 0]), (g, 1)),
        "scales": np.full((g, 3), 0.01, np.float32),
        "opacities": np.full(g, 0.5, np.float32),
        "colors": random.random((g, 3)).astype(np.float32),
        "skinning_weights": np.full((g, j), 1 / j, np.float32),
        "rest_vertices": random.normal(size=(n, 3)).astype(np.float32),
        "rest_joints": random.normal(size=(j, 3)).astype(np.float32),
        "faces": np.int32([[0, 1, 2], [1, 2, 3]]),
    }


AVATAR_HEADER = {
    **{"format": "humangs-avatar", "version": 1, "parents": [-1, 0, 1], "joint_names": ["a", "b", "c"]},
    **{"skinning": "affine", "rendering": "exact"},
}


def avatar_file():
    return {"header": json.dumps(AVATAR_HEADER)} | avatar_arrays()


def write_weights(path):
    config = tiny().model
    shapes = expected_variables(config)
    save_weights(path, jax.tree.map(lambda x: np.zeros(x.shape, np.float32), shapes), config, "float16")


def capture_description(**changes):
    views = [
        {"image": f"images/{name}.png", "mask": f"masks/{name}.png", "frame": i, "K": K, "cam_from_world": POSE}
        for i, name in enumerate(VIEWS)
    ]
    return {"format": "humangs-capture", "version": 1, "body": "body.npz", "views": views} | changes


def body_parameters():
    return {
        "body": np.asarray("makehuman"),
        "betas": np.zeros(3, np.float32),
        "rotations": np.zeros((2, 5, 3), np.float32),
        "translations": np.zeros((2, 3), np.float32),
    }


def write_capture(folder):
    for kind, shape in (("images", (12, 10, 3)), ("masks", (12, 10))):
        (folder / kind).mkdir()
        for name in VIEWS:
            Image.fromarray(pixels(*shape)).save(folder / kind / f"{name}.png")
    (folder / "capture.json").write_text(json.dumps(capture_description()))
    np.savez_compressed(folder / "body.npz", **body_parameters())
    return folder


def transforms(**changes):
    frames = [{"file_path": f"photos/{name}.png", "transform_matrix": POSE} for name in VIEWS]
    return {"fl_x": 60, "cx": 5, "cy": 6, "w": 10, "h": 12, "frames": frames} | changes


def opencv_yaml():
    matrix = lambda name, rows, cols, data: (
        f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {data}\n"
    )
    parts = [
        matrix(f"K_{i}", 3, 3, [60.0, 0, 5, 0, 60, 6, 0, 0, 1])
        + matrix(f"R_{i}", 3, 3, [1.0, 0, 0, 0, -1, 0, 0, 0, -1])
        + matrix(f"T_{i}", 3, 1, [0.0, 0.9, 2.6])
        for i in ("a", "b")
    ]
    return "%YAML:1.0\n---\n" + "".join(parts)


def write_easymocap(folder):
    text = opencv_yaml()
    (folder / "intri.yml").write_text(text)
    (folder / "extri.yml").write_text(text.replace("R_", "Rot_"))
    return folder


def write_colmap(folder):
    (folder / "cameras.txt").write_text("# cameras\n1 PINHOLE 10 12 60 60 5 6\n")
    images = [f"{i} 0 1 0 0 0 0.9 2.6 1 photos/{name}.png\n5.0 6.0 {i}\n" for i, name in enumerate(VIEWS, 1)]
    (folder / "images.txt").write_text("# images\n" + "".join(images))
    (folder / "points3D.txt").write_text("# points\n1 0 0.9 0 9 9 9 0.1 1 0\n2 0.1 0.9 0 9 9 9 0.1 2 0\n")
    return folder


def write_import(folder):
    (folder / "photos").mkdir()
    for name in VIEWS:
        Image.fromarray(pixels(12, 10, 3)).save(folder / "photos" / f"{name}.png")
    (folder / "transforms.json").write_text(json.dumps(transforms()))
    return folder / "transforms.json"


def write_import_folder(folder):
    write_import(folder)
    return folder


def motion_arrays(**changes):
    return {"rotations": np.zeros((3, 55, 3)), "translations": np.zeros((3, 3)), "fps": 30.0} | changes


def person(count, numbers=3):
    return np.random.default_rng(2).uniform(10, 400, (count, numbers))


def openpose():
    values = person(25)
    values[:, 2] = 0.9
    return json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": values.ravel().tolist()}]})


def coco():
    values = person(17)
    values[:, 2] = 0.9
    entries = [{"file_name": f"{n}.png", "category_id": 1, "keypoints": values.ravel().tolist()} for n in VIEWS]
    return json.dumps(entries)


def coco_annotations():
    values = person(17)
    values[:, 2] = 2
    images = [{"id": i, "file_name": f"{n}.png", "width": 640, "height": 480} for i, n in enumerate(VIEWS)]
    annotations = [{"id": i, "image_id": i, "keypoints": values.ravel().tolist()} for i in range(len(VIEWS))]
    return json.dumps({"images": images, "annotations": annotations})


def mmpose():
    frames = [
        {"frame_id": i, "instances": [{"keypoints": person(17, 2).tolist(), "keypoint_scores": [0.9] * 17}]}
        for i in range(len(VIEWS))
    ]
    return json.dumps({"meta_info": {}, "instance_info": frames})


def keypoint_arrays():
    points = np.stack([person(17, 2)] * 2).astype(np.float32)
    return {
        **{"set": np.asarray(COCO_17.name), "names": np.asarray(VIEWS), "points": points},
        "confidences": np.full((2, 17), 0.9, np.float32),
    }


def fit_arrays():
    arrays = keypoint_arrays() | {
        **{"noise": np.ones(2, np.float32), "joint_std": np.ones((2, 5), np.float32)},
        **{"determined": np.ones((2, 5), np.float32), "shape_covariance": np.eye(3, dtype=np.float32)},
    }
    assert set(arrays) == set(KEYS)
    return arrays


def lhm():
    parts = {"root_pose": (3,), "body_pose": (21, 3), "trans": (3,), "jaw_pose": (3,)}
    return json.dumps({key: np.zeros(shape).tolist() for key, shape in parts.items()})


def write_glb_motion(path):
    """A skeleton of CMU's names whose hips turn in two frames."""
    rest, names, writer = shipped_joints(), bvh_files.CMU, GlbWriter()
    joints = [name for name in JOINT_NAMES if name in names]
    above = {name: JOINT_NAMES[PARENTS[JOINT_NAMES.index(name)]] for name in joints[1:]}
    place = lambda name: rest[JOINT_NAMES.index(name)]
    nodes = [
        {"name": names[n], "translation": (place(n) - (place(above[n]) if n in above else 0)).tolist()} for n in joints
    ]
    for name, node in zip(joints, nodes, strict=True):
        if children := [joints.index(other) for other in joints if above.get(other) == name]:
            node["children"] = children
    matrices = np.tile(np.eye(4), (len(joints), 1, 1))
    matrices[:, 3, :3] = [-place(name) for name in joints]  # column by column, as glTF has them
    inverse = writer.array("MAT4", matrices.reshape(-1, 16))
    times, turns = writer.array("SCALAR", np.arange(2.0)), writer.array("VEC4", np.tile([0.0, 0, 0, 1], (2, 1)))
    channel = {"sampler": 0, "target": {"node": 0, "path": "rotation"}}
    animation = {"channels": [channel], "samplers": [{"input": times, "output": turns}]}
    skin = {"joints": list(range(len(joints))), "inverseBindMatrices": inverse}
    writer.write(path, {"nodes": nodes, "skins": [skin], "animations": [animation]})


def sphere():
    import trimesh

    return trimesh.creation.icosphere(subdivisions=2, radius=0.5)


def write_mesh(path):
    path.write_bytes(b"" if (data := sphere().export(file_type=path.suffix[1:])) is None else as_bytes(data))


def as_bytes(data):
    return data.encode() if isinstance(data, str) else data


def photo_bytes():
    stream = io.BytesIO()
    Image.fromarray(pixels(64, 64, 3)).save(stream, format="PNG")
    return stream.getvalue()


def textured_glb(image=None, images=None, change=lambda content: None):
    """A GLB of a sphere with one texture in it, or with the JSON changed."""
    import trimesh

    mesh = sphere()
    picture = Image.fromarray(pixels(4, 4, 3)) if image is None else image
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture)
    mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.vertices[:, :2] + 0.5, material=material)
    data = mesh.export(file_type="glb")
    length = struct.unpack_from("<I", data, 12)[0]
    content, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    if images is not None:  # other bytes in place of the texture
        view = content["bufferViews"][content["images"][0]["bufferView"]]
        view["byteOffset"], view["byteLength"] = len(binary), len(images)
        binary += images + bytes(-len(images) % 4)
        content["buffers"][0]["byteLength"] = len(binary)
    change(content)
    header = json.dumps(content).encode()
    header += b" " * (-len(header) % 4)
    total = 28 + len(header) + len(binary)
    chunk = lambda kind, body: struct.pack("<II", len(body), kind) + body
    return struct.pack("<III", 0x46546C67, 2, total) + chunk(0x4E4F534A, header) + chunk(0x004E4942, binary)


def textured_obj(folder, texture="texture.png", material="scan.mtl"):
    (folder / "scan.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {texture}\n")
    mesh = sphere()
    lines = [f"mtllib {material}", "usemtl skin", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
    lines += [f"vt {x + 0.5} {y + 0.5}" for x, y, _ in mesh.vertices]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in mesh.faces]
    (folder / "scan.obj").write_text("\n".join(lines))
    return folder / "scan.obj"


def write_obj(folder):
    Image.fromarray(pixels(4, 4, 3)).save(folder / "texture.png")
    return textured_obj(folder)


def bank_arrays():
    p, n, f, q, j, k = 2, 8, 4, 2, 5, 4
    return {
        **{"format": np.asarray("humangs-people"), "version": np.asarray(1), "split": np.asarray("train")},
        **{"generator": np.asarray(1), "parents": np.asarray([-1, 0, 1, 2, 3]), "mirrored_joints": np.arange(j)},
        **{"seeds": np.asarray([0, 1], np.int32), "betas": np.zeros((p, 3), np.float32)},
        **{"joints": np.zeros((p, j, 3), np.float32), "vertex_counts": np.full(p, n, np.int32)},
        **{"vertices": np.zeros((p, n, 3), np.float32), "normals": np.zeros((p, n, 3), np.float16)},
        **{"joint_ids": np.zeros((p, n, k), np.uint8), "joint_weights": np.full((p, n, k), 0.25, np.float16)},
        **{"faces": np.zeros((p, f, 3), np.uint16), "uvs": np.zeros((p, f, 3, 2), np.uint16)},
        **{"face_pieces": np.zeros((p, f), np.uint8), "sheen": np.zeros((p, 32), np.float32)},
        **{"groups": np.zeros((p, 32), np.uint8), "dyeable": np.zeros((p, 32), np.float32)},
        **{"texture": np.zeros((p, 8, 8, 6), np.uint8), "rotations": np.zeros((p, q, j, 3), np.float32)},
        "nearest": np.zeros((p, q), np.int32),
    }


def data_set(write, *arguments, **options):
    """A seed: the folder of a data set."""

    def seed(folder):
        write(folder, *arguments, **options)
        return folder

    return seed


def write_dna(folder):
    import h5py

    return dataset_files.write_dna(folder, h5py, frames=1)


def write_preprocessed(folder):
    """One subject that is finished, and another one that was skipped."""
    for name in ("a", "b"):
        dataset_files.write_avatarrex(folder / "raw" / name, frames=1)
    (folder / "raw" / "b" / "smpl_params.npz").unlink()
    dataset_files.write_model(folder)
    continue_preprocessing(folder)
    return folder


STATE = {"a.weight": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.asarray([1, 2], np.int64)}
MODEL = dataset_files.model_arrays()
MANIFEST = {"generator_version": GENERATOR_VERSION} | {
    "format": "humangs-synthetic",
    "version": 2,
    "split": "train",
    "settings": {},
}

SEEDS = {
    "npz": npz("a.npz", lambda: {"x": np.arange(40.0).reshape(5, 8), "s": np.asarray("word")}),
    "json": text("a.json", json.dumps({"a": [1, 2.5, None, "x"], "b": {"c": True}})),
    "image": saved("a.png", lambda path: Image.fromarray(pixels(12, 10, 3)).save(path)),
    "mask": saved("a.jpg", lambda path: Image.fromarray(pixels(12, 10)).save(path)),
    "pickle": saved("a.pkl", lambda path: path.write_bytes(pickle.dumps({"x": np.eye(3), "n": 2}, protocol=2))),
    "torch zip": saved("a.pt", lambda path: write_checkpoint(path, {"model": tensors(STATE)})),
    "torch stream": saved("a.pth", lambda path: write_stream(path, {"model": tensors(STATE)})),
    "released checkpoint": None,  # too large a file to be made here; the readers below it have theirs
    "safetensors": saved("a.safetensors", lambda path: save_file(STATE, path, {"note": "x"})),
    "vgg": None,
    "smplx npz": npz("SMPLX.npz", smplx_arrays),
    "smplx pkl": saved("SMPLX.pkl", lambda path: path.write_bytes(pickle.dumps(smplx_arrays(), protocol=2))),
    "hands": npz("SMPLX.npz", smplx_arrays),
    "body": saved("body.npz", lambda path: save_body(path, tiny_body())),
    "avatar": npz("me.npz", avatar_file),
    "weights": saved("w.safetensors", write_weights),
    "configuration": text("config.json", lambda: config_to_json(tiny(), indent=1)),
    "settings": saved("settings.json", lambda path: save_settings(path, PRESETS["best"])),
    "capture": write_capture,
    "photos": write_capture,
    "boundary": write_capture,
    "transforms": text("transforms.json", lambda: json.dumps(transforms())),
    "opencv yaml": text("cameras.yml", opencv_yaml),
    "opencv json": text(
        "calibration_full.json",
        lambda: json.dumps(
            {n: {"K": K, "R": np.diag([1, -1, -1]).tolist(), "T": [0, 1, 3], "imgSize": [9, 9]} for n in "ab"}
        ),
    ),
    "easymocap": write_easymocap,
    "colmap": write_colmap,
    "import": write_import,
    "openpose": text("000_keypoints.json", openpose),
    "coco": text("results.json", coco),
    "coco annotations": text("annotations.json", coco_annotations),
    "mmpose": text("walk.json", mmpose),
    "keypoints npz": npz("k.npz", keypoint_arrays),
    "motion npz": npz("m.npz", motion_arrays),
    "amass": npz("m.npz", lambda: {"poses": np.zeros((3, 156)), "trans": np.zeros((3, 3)), "mocap_framerate": 120.0}),
    "aist": saved(
        "m.pkl",
        lambda path: path.write_bytes(
            pickle.dumps({"smpl_poses": np.zeros((3, 72)), "smpl_trans": np.zeros((3, 3)), "smpl_scaling": np.ones(1)})
        ),
    ),
    "thuman": npz(
        "m.npz", lambda: {"global_orient": np.zeros((3, 3)), "body_pose": np.zeros((3, 63)), "transl": np.zeros((3, 3))}
    ),
    "lhm": text("m.json", lhm),
    "bvh": text("m.bvh", lambda: bvh_files.write_bvh(shipped_joints(), np.zeros((2, 55, 3)), bvh_files.CMU)),
    "glb motion": saved("m.glb", write_glb_motion),
    "obj": write_obj,
    "ply": saved("scan.ply", write_mesh),
    "glb": saved("scan.glb", lambda path: path.write_bytes(textured_glb())),
    "stl": saved("scan.stl", write_mesh),
    "off": saved("scan.off", write_mesh),
    "joints json": text("j.json", json.dumps({"left_hip": [0, 1, 0], "right_hip": [0.2, 1, 0], "neck": [0.1, 1.5, 0]})),
    "joints npz": npz("j.npz", lambda: {"names": np.asarray(["left_hip", "neck"]), "points": np.zeros((2, 3))}),
    "fit record": npz("fit.npz", fit_arrays),
    "bank": npz("bank.npz", bank_arrays),
    "manifest": text("manifest.json", json.dumps(MANIFEST)),
    "filmed": npz("m.npz", motion_arrays),
    "scan views": text("scan.json", json.dumps({"world_from_scan": (np.eye(4) * [2.0, 2, 2, 1]).tolist()})),
    "start": write_import_folder,
    "log": text("log.jsonl", '{"step": 1, "loss": 2.0}\n{"step": 2, "event": "skipped"}\n'),
    **dict.fromkeys(("avatarrex", "video poses"), data_set(dataset_files.write_avatarrex, frames=2)),
    "missing photos": data_set(dataset_files.write_thuman4, frames=2),
    "actorshq": data_set(dataset_files.write_actorshq, frames=1),
    **dict.fromkeys(("dna photos", "dna notes"), write_dna if importlib.util.find_spec("h5py") else None),
    **dict.fromkeys(("scene list", "scene arrays"), data_set(dataset_files.write_scenes, MODEL, views=2)),
    "evaluation": text("evaluation_2.json", json.dumps({"s0": {"context": [0, 3], "target": [1]}})),
    **dict.fromkeys(
        ("thuman fit", "thuman mesh", "thuman scan"), data_set(dataset_files.write_thuman, MODEL, kinds="C")
    ),
    **dict.fromkeys(("preprocessed set", "preprocessed scene", "skipped subject"), write_preprocessed),
}


def damaged_file(name: str, path: Path) -> Path:
    """The file of a seed that damage goes into: of a folder, the one that is read first."""
    inside = {
        **{"easymocap": "intri.yml", "colmap": "images.txt", "avatarrex": "calibration_full.json"},
        **{"video poses": "smpl_params.npz", "missing photos": "missing_img_files.txt"},
        **{"actorshq": "4x/calibration.csv", "scene list": "train.json", "scene arrays": "smpl/0.npz"},
        **{"dna photos": "main/0001_01.smc", "dna notes": "annotations/0001_01_annots.smc"},
        **{"thuman fit": "smplx/0000/smplx_param.pkl", "thuman mesh": "smplx/0000/mesh_smplx.obj"},
        **{"thuman scan": "model/0000/0000.obj", "preprocessed set": "out/manifest.json"},
        "start": "photos/000.png",
        **{"preprocessed scene": "out/a/scene.json", "skipped subject": "out/skipped/b.json"},
    }
    return path / inside.get(name, "capture.json") if path.is_dir() else path


assert JOINT_NAMES and set(SEEDS) == set(READERS)
