"""Every reader of the package with a valid file for it, from which hostile files are made.

Files of other tools are those of `tests/data/files`, where their licence allows it.
"""

import functools
import importlib.util
import json
import pickle
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import bvh_files
import jax
import motion_files
import numpy as np
from data.datasets import dataset_files
from glb_files import write_glb
from network.torch_writer import plain_pickle, tensors, write_checkpoint
from PIL import Image
from safetensors.numpy import save_file
from small import random_gaussians, small_avatar, tetrahedron
from sog_files import write_sog

from humangs_jax.apps.settings import PRESETS, load_settings, save_settings
from humangs_jax.apps.start import inspect_folder
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import load_gaussians, save_gaussians
from humangs_jax.avatar.frames import FOLLOWING, smoothed_path, trim_and_resample
from humangs_jax.body.library import load_body, load_hands, load_smplx, save_body
from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.calibration.loaded import load_cameras
from humangs_jax.capture.fitting.files import read_fit_record
from humangs_jax.capture.keypoints.formats import save_keypoints
from humangs_jax.capture.keypoints.keypoints import COCO_17, Keypoints
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.core.configuration import config_to_json
from humangs_jax.data.cameras import read_calibration
from humangs_jax.data.capture import load_capture
from humangs_jax.data.datasets.scene_list import read_evaluation
from humangs_jax.data.datasets.subject import open_people
from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.loading.captures import read_summary
from humangs_jax.data.photos import load_photos
from humangs_jax.data.preprocess.run import PreprocessConfig, preprocess, scan_content
from humangs_jax.data.sets import SYNTHETIC, begin_set
from humangs_jax.io.arrays import read_npz
from humangs_jax.io.images import (
    check_image,
    cropped_from,
    focal_length,
    image_size,
    orientation,
    read_grey,
    read_image,
)
from humangs_jax.io.mesh import GlbWriter, read_obj
from humangs_jax.io.reading import read_json, reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle
from humangs_jax.io.tensors import read_tensors, read_values
from humangs_jax.motion import load_motion
from humangs_jax.motion.skeleton import shipped_joints
from humangs_jax.network.weights import expected_variables, load_weights, save_weights
from humangs_jax.synthetic.bank import load_bank
from humangs_jax.synthetic.subject import GENERATOR_VERSION
from humangs_jax.training.config import read_config, tiny
from humangs_jax.training.diagnose import first_failed_step
from tests.capture import calibration_files

REAL = Path(__file__).parents[1] / "data" / "files"
SIDE = 16
"""Side of the photos of data sets, pixels."""
BODY = tetrahedron(tuple("xyz"))


class Format(NamedTuple):
    """A reader and a valid file for it."""

    read: Callable[[Path], Any]
    make: Callable[[Path], Path]
    """Writes the file or folder into an empty folder; returns its path."""
    inside: str = ""
    """The file of a folder that is damaged: the one that is read first."""

    def damaged(self, path: Path) -> Path:
        return path / self.inside


# Readers
# --------------------------------------------------------------------------------------------------


def read_image_in_every_way(path):
    header = orientation(path), focal_length(path), cropped_from(path)
    return image_size(path), check_image(path), read_image(path), header


def read_pickled(path, values=read_pickle):
    with reading(path, "pickle"):
        found = values(path)
        if not isinstance(found, dict):
            raise ValueError("expected a dict")
        return {key: as_array(value) for key, value in found.items()}


def read_cameras(path):
    return read_calibration(path, lambda name: (64, 48))


def read_detections(*names, size=(640, 480)):
    return lambda path: read_keypoints(path, names, *size, person=0)


def read_data_set(folder):
    """Reads all parameters and photos of all people."""
    for person in open_people(folder, DATA_BODY, SIDE):
        subject = person.subject
        subject.parameters(range(subject.frame_count))
        subject.photos(range(len(subject)), SIDE)


def data_body():
    with tempfile.TemporaryDirectory() as folder:
        body = dataset_files.write_model(Path(folder))
        assert body.hands and body.arrays  # read while the file is there
    return body


DATA_BODY = data_body()


def read_scans(folder):
    """Reads and computes what preprocessing needs before it renders."""
    for name in open_thuman(folder)[0]:
        scan_content(folder, name, DATA_BODY, PreprocessConfig("thuman", views=1))


def go_on_preprocessing(folder):
    """Continues a set whose only readable subject is finished."""
    settings = PreprocessConfig("avatarrex", size=SIDE)
    preprocess(folder / "raw", folder / "out", folder / "SMPLX_TINY.npz", settings, progress=False)


def go_on_with_synthetic_people(path):
    keys = ("generator_version", "split", "settings")
    begin_set(path.parent, SYNTHETIC, {key: MANIFEST[key] for key in keys})


def film(path):
    """Computes frames of a motion's video and the path of its camera."""
    with reading(path, "motion"):
        motion = trim_and_resample(load_motion(path), fps=30.0)
        return smoothed_path(np.asarray(motion.translations), FOLLOWING * motion.fps)


# Valid files
# --------------------------------------------------------------------------------------------------


def saved(name, write):
    """Returns a maker of a file that write(path) writes."""

    def make(folder):
        write(folder / name)
        return folder / name

    return make


def written(name, data):
    """Returns a maker of a file of bytes, text or JSON, or of what a function returns."""

    def write(path):
        content = data() if callable(data) else data
        if isinstance(content, dict | list):
            content = json.dumps(content)
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return saved(name, write)


def npz(name, arrays):
    return saved(name, lambda path: np.savez_compressed(path, **arrays))


def real(name):
    """Returns a maker of a copy of another tool's file or folder."""

    def make(folder):
        source, copy = REAL / name, folder / Path(name).name
        return Path(shutil.copytree(source, copy) if source.is_dir() else shutil.copy(source, copy))

    return make


def real_colmap(suffix):
    return lambda folder: Path(
        shutil.copytree(
            REAL / "colmap", folder / "model", ignore=lambda _, names: _of_others(names, suffix)
        )
    )


def _of_others(names, suffix):
    return [name for name in names if not name.endswith(suffix)]


def data_set(write, *arguments, **options):
    """Returns a maker of a data set's folder."""

    def make(folder):
        write(folder, *arguments, **options)
        return folder

    return make


def pixels(*shape):
    return np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8)


def picture(name, *shape):
    return saved(name, Image.fromarray(pixels(*shape)).save)


VIEWS = ("000", "001")
CAMERA = {
    "K": [[60.0, 0, 5], [0, 60, 6], [0, 0, 1]],
    "cam_from_world": [[1.0, 0, 0, 0], [0, -1, 0, 0.9], [0, 0, -1, 2.6], [0, 0, 0, 1]],
}
CAPTURE = {"format": "humangs-capture", "version": 1, "body": "body.npz"} | {
    "views": [
        {"image": f"images/{n}.png", "mask": f"masks/{n}.png", "frame": i} | CAMERA
        for i, n in enumerate(VIEWS)
    ]
}
PARAMETERS = {
    "body": np.asarray("makehuman"),
    "betas": np.zeros(3, np.float32),
    "rotations": np.zeros((2, 5, 3), np.float32),
    "translations": np.zeros((2, 3), np.float32),
    "displacement": np.zeros((4, 3), np.float32),
}


def write_capture(folder, **changes):
    for kind, shape in (("images", (12, 10, 3)), ("masks", (12, 10))):
        (folder / kind).mkdir(parents=True)
        for name in VIEWS:
            picture(f"{name}.png", *shape)(folder / kind)
    (folder / "capture.json").write_text(json.dumps(CAPTURE | changes))
    np.savez_compressed(folder / "body.npz", **PARAMETERS)
    return folder


TRANSFORMS = {"fl_x": 60, "cx": 5, "cy": 6, "w": 10, "h": 12} | {
    "frames": [
        {"file_path": f"photos/{name}.png", "transform_matrix": CAMERA["cam_from_world"]}
        for name in VIEWS
    ]
}


CAMERAS_OF_SPLATS = [
    {
        "img_name": name,
        "width": 12,
        "height": 10,
        "position": [0.0, 0.0, -2.0],
        "rotation": np.eye(3).tolist(),
        "fx": 9.0,
        "fy": 9.0,
    }
    for name in VIEWS
]


def write_import(folder):
    """Writes photos and a calibration beside them."""
    (folder / "photos").mkdir()
    for name in VIEWS:
        picture(f"{name}.png", 12, 10, 3)(folder / "photos")
    return written("transforms.json", TRANSFORMS)(folder)


def import_beside(path):
    return import_cameras(path, path.parent / "photos", path.parent / "imported", overwrite=True)


def rig(writer, name):
    """Returns a maker of a calibration of four cameras, by a writer of `calibration_files`."""

    def make(folder):
        writer(folder / name, *calibration_files.scene(), calibration_files.NAMES)
        return folder / name

    return make


def points(count, confidence=0.9):
    values = np.random.default_rng(2).uniform(10, 400, (count, 3))
    values[:, 2] = confidence
    return values


ANNOTS = {"filename": "000.jpg", "annots": [{"personID": 0, "keypoints": points(25).tolist()}]}
COCO = [
    {"file_name": f"{n}.png", "category_id": 1, "keypoints": points(17).ravel().tolist()}
    for n in VIEWS
]
MMPOSE = {
    "meta_info": {},
    "instance_info": [
        {
            "frame_id": i,
            "instances": [{"keypoints": points(17)[:, :2].tolist(), "keypoint_scores": [0.9] * 17}],
        }
        for i in range(2)
    ],
}
KEYPOINTS = Keypoints(
    np.float32([points(17)[:, :2]] * 2), np.full((2, 17), 0.9, np.float32), COCO_17
)
FIT = {
    **{"set": np.asarray(COCO_17.name), "names": np.asarray(VIEWS), "points": KEYPOINTS.points},
    **{"confidences": KEYPOINTS.confidences, "noise": np.ones(2, np.float32)},
    **{key: np.ones((2, 5), np.float32) for key in ("joint_std", "determined")},
    **{"shape_covariance": np.eye(3, dtype=np.float32), "places": np.zeros((17, 3), np.float32)},
    "certainty": np.ones(17, np.float32),
}
MOTION = {"rotations": np.zeros((3, 55, 3)), "translations": np.zeros((3, 3)), "fps": 30.0}
AMASS = {"poses": np.zeros((3, 156)), "trans": np.zeros((3, 3)), "mocap_framerate": 120.0}
SHAPES = ("jawOpen", "mouthSmileLeft", "mouthSmileRight", "eyeBlinkLeft", "eyeBlinkRight", "odd")
SCORES = [{"index": i, "score": 0.5, "categoryName": name} for i, name in enumerate(SHAPES)]
MANIFEST = {"generator_version": GENERATOR_VERSION, "format": "humangs-synthetic"} | {
    **{"version": 2, "split": "train", "settings": {}},
}
STATE = {"a.weight": np.ones((2, 3), np.float32), "b": np.asarray([1, 2], np.int64)}
SPLATS = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}
MODEL = dataset_files.model_arrays()


def write_glb_motion(path):
    poses = np.zeros((2, 55, 3))
    write_glb(path, shipped_joints(), poses, np.zeros((2, 3)), bvh_files.CMU)


def write_glb_face(path):
    """Writes the weights of a mesh's shapes in two frames."""
    writer = GlbWriter()
    times = writer.array("SCALAR", np.arange(2.0))
    output = writer.array("SCALAR", np.linspace(0, 1, 2 * len(SHAPES)))
    channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
    animation = {"channels": [channel], "samplers": [{"input": times, "output": output}]}
    mesh = {"primitives": [], "extras": {"targetNames": list(SHAPES)}}
    writer.write(path, {"nodes": [{"mesh": 0}], "meshes": [mesh], "animations": [animation]})


def write_weights(path):
    config = tiny().model
    zeros = jax.tree.map(lambda x: np.zeros(x.shape, np.float32), expected_variables(config))
    save_weights(path, zeros, config, "float16")


def ply(form, elements, body):
    """Returns a PLY file; `elements` are {"vertex 4": {"float": names}}."""
    lines = ["ply", f"format {form} 1.0"]
    for element, properties in elements.items():
        lines.append(f"element {element}")
        lines += [f"property {kind} {name}" for kind, names in properties.items() for name in names]
    return "\n".join([*lines, "end_header\n"]).encode() + body


TEXT_PLY = [*"xyz", *(f"{k}_{i}" for k in ("f_dc", "scale") for i in range(3)), "opacity"]
TEXT_PLY += [f"rot_{i}" for i in range(4)]
SIDES = [
    f"{end}_{k}" for end in ("min", "max") for k in (*"xyz", *(f"scale_{axis}" for axis in "xyz"))
]
PACKED = {
    "chunk 1": {"float": SIDES},
    "vertex 4": {"uint": [f"packed_{k}" for k in ("position", "rotation", "scale", "color")]},
}
PACKED_BODY = np.repeat(np.float32([-1, 1]), 6).tobytes() + np.arange(16, dtype="<u4").tobytes()


def write_obj(folder, texture="texture.png"):
    """Writes a textured square."""
    picture("texture.png", 4, 4, 3)(folder)
    (folder / "scan.mtl").write_text(f"newmtl skin\nKd 1 1 1\nmap_Kd {texture}\n")
    corners = "".join(f"v {x} {y} 0\nvt {x} {y}\n" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    return written("scan.obj", f"mtllib scan.mtl\nusemtl skin\n{corners}{faces}")(folder)


def bank_arrays():
    p, n, f, q, j, k = 2, 8, 4, 2, 5, 4
    shapes = {
        "f4": {"betas": (p, 3), "joints": (p, j, 3), "vertices": (p, n, 3), "sheen": (p, 32)}
        | {"dyeable": (p, 32), "rotations": (p, q, j, 3)},
        "f2": {"normals": (p, n, 3), "joint_weights": (p, n, k), "displacements": (p, 0, 3)},
        "u1": {"joint_ids": (p, n, k), "face_pieces": (p, f), "groups": (p, 32)}
        | {"texture": (p, 8, 8, 6)},
        "u2": {"faces": (p, f, 3), "uvs": (p, f, 3, 2)},
        "i4": {"nearest": (p, q)},
    }
    arrays = {
        name: np.zeros(shape, kind) for kind, own in shapes.items() for name, shape in own.items()
    }
    arrays["joint_weights"] += np.float16(0.25)
    return arrays | {
        **{"format": np.asarray("humangs-people"), "version": np.asarray(2)},
        **{"split": np.asarray("train"), "generator": np.asarray(1)},
        **{"parents": np.arange(-1, j - 1), "mirrored_joints": np.arange(j)},
        **{"seeds": np.arange(p, dtype=np.int32), "vertex_counts": np.full(p, n, np.int32)},
    }


def write_preprocessed(folder):
    """Writes a preprocessed set: one subject is finished and another one was skipped."""
    for name in "ab":
        dataset_files.write_avatarrex(folder / "raw" / name, frames=1)
    (folder / "raw" / "b" / "smpl_params.npz").unlink()
    dataset_files.write_model(folder)
    go_on_preprocessing(folder)
    return folder


def gaussians(name, harmonics=0, **options):
    """Returns a maker of a file of Gaussians that the package writes."""
    return saved(
        name, lambda path: save_gaussians(path, random_gaussians(harmonics=harmonics), **options)
    )


def of_motion(kind, inside=""):
    return load_motion, motion_files.FILES[kind][0], inside


avatarrex = data_set(dataset_files.write_avatarrex, frames=2)
scenes = data_set(dataset_files.write_scenes, MODEL, views=2)
scans = data_set(dataset_files.write_thuman, MODEL, kinds="C")
IMAGES, OUT = "images.txt", "out/manifest.json"
ROWS = {
    "npz": (read_npz, npz("a.npz", {"x": np.arange(40.0).reshape(5, 8), "s": "word"})),
    "json": (read_json, written("a.json", {"a": [1, 2.5, None, "x"], "b": {"c": True}})),
    "image": (read_image_in_every_way, picture("a.png", 12, 10, 3)),
    "mask": (read_grey, picture("a.jpg", 12, 10)),
    "pickle": (read_pickled, written("a.pkl", pickle.dumps({"x": np.eye(3), "n": 2}, protocol=2))),
    "pickled tensors": (
        functools.partial(read_pickled, values=read_values),
        written("a.pkl", lambda: plain_pickle({"w": np.ones((2, 3), np.float32)})),
    ),
    "torch": (
        read_tensors,
        saved("a.pt", lambda path: write_checkpoint(path, {"model": tensors(STATE)})),
    ),
    "safetensors": (
        read_tensors,
        saved("a.safetensors", lambda path: save_file(STATE, path, {"note": "x"})),
    ),
    "smplx npz": (load_smplx, npz("SMPLX.npz", MODEL)),
    "smplx pkl": (load_smplx, written("SMPLX.pkl", lambda: pickle.dumps(MODEL, protocol=2))),
    "hands": (load_hands, npz("SMPLX.npz", MODEL)),
    "body": (load_body, saved("body.npz", lambda path: save_body(path, BODY))),
    "avatar": (Avatar.load, saved("me.npz", lambda path: small_avatar().save(path))),
    "weights": (load_weights, saved("w.safetensors", write_weights)),
    "configuration": (read_config, written("c.json", lambda: config_to_json(tiny(), indent=1))),
    "settings": (load_settings, saved("s.json", lambda path: save_settings(path, PRESETS["best"]))),
    "capture": (lambda path: load_capture(path, body=BODY), write_capture, "capture.json"),
    "photos": (load_photos, write_capture, "capture.json"),
    "summary": (lambda path: read_summary(path, BODY), write_capture, "capture.json"),
    "transforms": (read_cameras, real("nerfstudio/transforms_train.json")),
    "cameras of splats": (read_cameras, written("cameras.json", CAMERAS_OF_SPLATS)),
    "colmap": (read_cameras, real_colmap(".txt"), IMAGES),
    "colmap binary": (read_cameras, real_colmap(".bin"), "images.bin"),
    "cameras with lenses": (load_cameras, real_colmap(".txt"), IMAGES),
    "toml": (read_cameras, real("caliscope/camera_array.toml")),
    "qualisys": (read_cameras, real("pose2sim/Calib.qca.txt")),
    "shelf": (read_cameras, real("mmpose/calibration_shelf.json")),
    "panoptic": (read_cameras, written("calibration_1.json", calibration_files.panoptic)),
    "opencv yaml": (read_cameras, rig(calibration_files.write_opencv_yaml, "cameras.yml")),
    "opencv json": (
        read_cameras,
        rig(calibration_files.write_calibration_full, "calibration_full.json"),
    ),
    "easymocap": (read_cameras, rig(calibration_files.write_easymocap, "cams"), "intri.yml"),
    "import": (import_beside, write_import),
    "openpose": (
        read_detections("cam03.0050", size=(1088, 1920)),
        real("pose2sim/pose/cam03.0050.json"),
    ),
    "coco annotations": (
        read_detections("000000000785", size=(640, 425)),
        real("coco/test_coco.json"),
    ),
    "coco": (read_detections(*VIEWS), written("results.json", COCO)),
    "mmpose": (read_detections(*VIEWS), written("walk.json", MMPOSE)),
    "easymocap annots": (read_detections(*VIEWS), written("000.json", ANNOTS)),
    "keypoints npz": (
        read_detections(*VIEWS),
        saved("k.npz", lambda path: save_keypoints(path, KEYPOINTS, VIEWS)),
    ),
    "motion npz": (load_motion, npz("m.npz", MOTION)),
    "amass": (load_motion, npz("m.npz", AMASS)),
    **{
        kind: of_motion(kind)
        for kind in ("AIST++", "parts", "WHAM", "GVHMR", "MDM", "Motion-X", "Kimodo")
    },
    "PHALP": (functools.partial(load_motion, person=3), motion_files.FILES["PHALP"][0]),
    "smplcodec": of_motion("smplcodec"),
    "EasyMocap": of_motion("EasyMocap", "000000.json"),
    "Human3R": of_motion("Human3R", "smpl/000000.npz"),
    "TRAM": of_motion("TRAM", "hps/hps_track_0.npy"),
    "LHM": of_motion("LHM", "8.json"),
    "sam 3d": (load_motion, npz("m.npz", motion_files.mhr())),
    "bvh": (
        load_motion,
        written(
            "m.bvh",
            lambda: bvh_files.write_bvh(shipped_joints(), np.zeros((2, 55, 3)), bvh_files.CMU),
        ),
    ),
    "glb motion": (load_motion, saved("m.glb", write_glb_motion)),
    "glb face": (load_motion, saved("m.glb", write_glb_face)),
    "vrma": (load_motion, real("three-vrm/test.vrma")),
    "face table": (load_motion, real("livelinkface/alex_rom_3.csv")),
    "face scores": (
        load_motion,
        written(
            "f.json", {"fps": 25, "frames": [{"faceBlendshapes": [{"categories": SCORES}]}, {}]}
        ),
    ),
    "filmed": (film, npz("m.npz", MOTION)),
    "3dgs": (load_gaussians, gaussians("a.ply", 3)),
    "3dgs text": (
        load_gaussians,
        written(
            "a.ply",
            ply("ascii", {"vertex 2": {"float": TEXT_PLY}}, b"0.5 " * 13 + b"0.5\n" + b"1 " * 14),
        ),
    ),
    "3dgs compressed": (
        load_gaussians,
        written("a.ply", ply("binary_little_endian", PACKED, PACKED_BODY)),
    ),
    "splat": (load_gaussians, gaussians("a.splat")),
    "spz": (load_gaussians, gaussians("a.spz", 15)),
    "spz 4": (load_gaussians, gaussians("a.spz", 3, version=4)),
    "glb splats": (load_gaussians, gaussians("a.glb", 8)),
    "sog": (
        load_gaussians,
        saved("a.sog", lambda path: write_sog(path, random_gaussians(harmonics=3))),
    ),
    "gsplat": (
        load_gaussians,
        saved(
            "a.pt",
            lambda path: write_checkpoint(
                path,
                {"splats": tensors({k: np.ones((4, *s), np.float32) for k, s in SPLATS.items()})},
            ),
        ),
    ),
    "obj": (read_obj, write_obj),
    "fit record": (read_fit_record, npz("fit.npz", FIT)),
    "bank": (load_bank, npz("bank.npz", bank_arrays())),
    "manifest": (go_on_with_synthetic_people, written("manifest.json", MANIFEST)),
    "log": (
        first_failed_step,
        written("log.jsonl", '{"step": 1, "loss": 2.0}\n{"step": 2, "event": "skipped"}\n'),
    ),
    "start": (inspect_folder, lambda folder: write_import(folder).parent, "photos/000.png"),
    "avatarrex": (read_data_set, avatarrex, "calibration_full.json"),
    "video poses": (read_data_set, avatarrex, "smpl_params.npz"),
    "missing photos": (
        read_data_set,
        data_set(dataset_files.write_thuman4, frames=2),
        "missing_img_files.txt",
    ),
    "actorshq": (
        read_data_set,
        data_set(dataset_files.write_actorshq, frames=1),
        "4x/calibration.csv",
    ),
    "scene list": (read_data_set, scenes, "train.json"),
    "scene arrays": (read_data_set, scenes, "smpl/0.npz"),
    "evaluation": (
        read_evaluation,
        written("evaluation_2.json", {"s0": {"context": [0, 3], "target": [1]}}),
    ),
    "thuman fit": (read_scans, scans, "smplx/0000/smplx_param.pkl"),
    "thuman mesh": (read_scans, scans, "smplx/0000/mesh_smplx.obj"),
    "thuman scan": (read_scans, scans, "model/0000/0000.obj"),
    "preprocessed set": (go_on_preprocessing, write_preprocessed, OUT),
    "preprocessed scene": (go_on_preprocessing, write_preprocessed, "out/a/scene.json"),
    "skipped subject": (go_on_preprocessing, write_preprocessed, "out/skipped/b.json"),
}
if importlib.util.find_spec("h5py"):
    dna = data_set(dataset_files.write_dna, frames=1)
    ROWS |= {
        "dna photos": (read_data_set, dna, "main/0001_01.smc"),
        "dna notes": (read_data_set, dna, "annotations/0001_01_annots.smc"),
    }
FORMATS = {name: Format(*row) for name, row in ROWS.items()}
