"""Every reader of the package, with an honest file for each: what the hostile ones are made
from.
"""

import functools
import importlib.util
import json
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import bvh_files
import calibration_files
import dataset_files
import honest_files as honest
import numpy as np
from honest_files import data_set, npz, saved, written
from joblib_files import joblib
from PIL import Image
from safetensors.numpy import save_file
from small import random_gaussians
from sog_files import write_sog
from torch_writer import plain_pickle, tensors, write_checkpoint

from humangs_jax.apps.settings import PRESETS, load_settings, save_settings
from humangs_jax.apps.start import inspect_folder
from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.export.gaussians import load_gaussians, save_gaussians
from humangs_jax.avatar.frames import FOLLOWING, smoothed_path, trim_and_resample
from humangs_jax.body.library import load_body, load_hands, load_smplx, save_body
from humangs_jax.capture.calibration.importing import import_cameras
from humangs_jax.capture.calibration.loaded import load_cameras
from humangs_jax.capture.fitting.files import read_fit_record
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
from humangs_jax.io.mesh import read_obj
from humangs_jax.io.reading import read_json, reading
from humangs_jax.io.restricted_pickle import as_array, read_pickle
from humangs_jax.io.tensors import read_tensors, read_values
from humangs_jax.losses.loss_networks import load_vgg19
from humangs_jax.motion import load_motion
from humangs_jax.motion.skeleton import shipped_joints
from humangs_jax.network.conversion import load_checkpoint
from humangs_jax.network.weights import load_weights
from humangs_jax.synthetic.bank import load_bank
from humangs_jax.training.config import read_config, tiny
from humangs_jax.training.diagnose import first_failed_step


class Format(NamedTuple):
    """read: a function of a path. make: writes an honest file or folder into an empty folder and
    returns its path; None where it is too large, the readers below have theirs. inside: the file of
    a folder that damage goes into, the one that is read first.
    """

    read: Callable[[Path], Any]
    make: Callable[[Path], Path] | None
    inside: str = "capture.json"

    def damaged(self, path: Path) -> Path:
        return path / self.inside if path.is_dir() else path


def read_image_in_every_way(path):
    said = orientation(path), focal_length(path), cropped_from(path)
    return image_size(path), check_image(path), read_image(path), said


def read_whole_pickle(path):
    with reading(path, "pickle"):
        return {key: as_array(value) for key, value in read_pickle(path).items()}


def read_pickled_tensors(path):
    with reading(path, "pickle"):
        values = read_values(path)
        if not isinstance(values, dict):
            raise ValueError("expected a dict")
        return {key: as_array(value) for key, value in values.items()}


def read_detections(path):
    """Of two views."""
    return read_keypoints(path, honest.VIEWS, 640, 480)


def read_capture(path):
    return load_capture(path, body=honest.tiny_body())


def read_cameras(path):
    return read_calibration(path, lambda name: (64, 48))


def import_into(path):
    """Photos beside the calibration; the capture goes into another folder."""
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
    for name in open_thuman(folder)[0]:
        scan_content(folder, name, data_body(), PreprocessConfig("thuman", views=1))


def continue_preprocessing(folder):
    """Of a set whose only subject is finished."""
    body = folder / "SMPLX_TINY.npz"
    preprocess(folder / "raw", folder / "out", body, PREPROCESSED, progress=False)


def continue_synthetic_set(path):
    """What `synth` does before it makes anybody."""
    begin_set(
        path.parent,
        SYNTHETIC,
        {key: honest.MANIFEST[key] for key in ("generator_version", "split", "settings")},
    )


def film(path):
    """The frames of a video of a motion, and the path of its camera."""
    with reading(path, "motion"):
        motion = trim_and_resample(load_motion(path), fps=30.0)
        return smoothed_path(np.asarray(motion.translations), FOLLOWING * motion.fps)


SIDE = 16
PREPROCESSED = PreprocessConfig("avatarrex", size=SIDE)


def write_preprocessed(folder):
    """One subject that is finished, and another one that was skipped."""
    for name in ("a", "b"):
        dataset_files.write_avatarrex(folder / "raw" / name, frames=1)
    (folder / "raw" / "b" / "smpl_params.npz").unlink()
    dataset_files.write_model(folder)
    continue_preprocessing(folder)
    return folder


def zeros(**shapes):
    return {name: np.zeros(shape) for name, shape in shapes.items()}


def as_json(value):
    return lambda: json.dumps(value() if callable(value) else value)


def pickled(content):
    return lambda: pickle.dumps(content(), protocol=2)


avatarrex = data_set(dataset_files.write_avatarrex, frames=2)
scenes = data_set(dataset_files.write_scenes, honest.MODEL, views=2)
scans = data_set(dataset_files.write_thuman, honest.MODEL, kinds="C")
dna = data_set(dataset_files.write_dna, frames=1) if importlib.util.find_spec("h5py") else None
AIST = {"smpl_poses": np.zeros((3, 72)), "smpl_trans": np.zeros((3, 3)), "smpl_scaling": np.ones(1)}
AMASS = zeros(poses=(3, 156), trans=(3, 3)) | {"mocap_framerate": 120.0}
PARTS = zeros(global_orient=(3, 3), body_pose=(3, 63), transl=(3, 3))
WHAM = zeros(pose_world=(3, 72), trans_world=(3, 3), frame_ids=(3,)) | {"frame_ids": np.arange(3)}
RIG = {
    n: {"K": honest.K, "R": np.diag([1, -1, -1]).tolist(), "T": [0, 1, 3], "imgSize": [9, 9]}
    for n in "ab"
}
STATE, BVH = (
    honest.STATE,
    functools.partial(bvh_files.write_bvh, shipped_joints(), np.zeros((2, 55, 3)), bvh_files.CMU),
)
ROWS = {
    "npz": (
        read_npz,
        npz("a.npz", lambda: {"x": np.arange(40.0).reshape(5, 8), "s": np.asarray("word")}),
    ),
    "json": (read_json, written("a.json", as_json({"a": [1, 2.5, None, "x"], "b": {"c": True}}))),
    "image": (
        read_image_in_every_way,
        saved("a.png", Image.fromarray(honest.pixels(12, 10, 3)).save),
    ),
    "mask": (read_grey, saved("a.jpg", Image.fromarray(honest.pixels(12, 10)).save)),
    "pickle": (read_whole_pickle, written("a.pkl", pickled(lambda: {"x": np.eye(3), "n": 2}))),
    "torch zip": (
        read_tensors,
        saved("a.pt", lambda path: write_checkpoint(path, {"model": tensors(STATE)})),
    ),
    "pickled tensors": (
        read_pickled_tensors,
        written("a.pkl", lambda: plain_pickle({"w": np.ones((2, 3), np.float32)})),
    ),
    "released checkpoint": (load_checkpoint, None),
    "safetensors": (
        read_tensors,
        saved("a.safetensors", lambda path: save_file(STATE, path, {"note": "x"})),
    ),
    "vgg": (load_vgg19, None),
    "smplx npz": (load_smplx, npz("SMPLX.npz", dataset_files.model_arrays)),
    "smplx pkl": (load_smplx, written("SMPLX.pkl", pickled(dataset_files.model_arrays))),
    "hands": (load_hands, npz("SMPLX.npz", dataset_files.model_arrays)),
    "body": (load_body, saved("body.npz", lambda path: save_body(path, honest.tiny_body()))),
    "avatar": (Avatar.load, npz("me.npz", honest.avatar_file)),
    "weights": (load_weights, saved("w.safetensors", honest.write_weights)),
    "configuration": (
        read_config,
        written("config.json", lambda: config_to_json(tiny(), indent=1)),
    ),
    "settings": (
        load_settings,
        saved("settings.json", lambda path: save_settings(path, PRESETS["best"])),
    ),
    "capture": (read_capture, honest.write_capture),
    "photos": (load_photos, honest.write_capture),
    "boundary": (lambda path: read_summary(path, honest.tiny_body()), honest.write_capture),
    "transforms": (read_cameras, written("transforms.json", as_json(honest.transforms))),
    "opencv yaml": (read_cameras, written("cameras.yml", honest.opencv_yaml)),
    "opencv json": (read_cameras, written("calibration_full.json", as_json(RIG))),
    "easymocap": (read_cameras, honest.write_easymocap, "intri.yml"),
    "colmap": (read_cameras, honest.write_colmap, "images.txt"),
    "colmap binary": (read_cameras, honest.write_colmap_binary, "images.bin"),
    "toml": (read_cameras, written("calib.toml", lambda: calibration_files.tables("cam_{}", "{}"))),
    "panoptic": (read_cameras, written("calibration_1.json", as_json(calibration_files.panoptic))),
    "shelf": (read_cameras, written("calibration_shelf.json", as_json(calibration_files.shelf))),
    "qualisys": (read_cameras, written("rig.qca.txt", calibration_files.qualisys)),
    "import": (import_into, honest.write_import),
    "openpose": (read_detections, written("000_keypoints.json", honest.openpose)),
    "easymocap annots": (read_detections, written("000.json", honest.annots)),
    "coco": (read_detections, written("results.json", honest.coco)),
    "coco annotations": (read_detections, written("annotations.json", honest.coco_annotations)),
    "mmpose": (read_detections, written("walk.json", honest.mmpose)),
    "keypoints npz": (read_detections, npz("k.npz", honest.keypoint_arrays)),
    "motion npz": (load_motion, npz("m.npz", honest.motion_arrays)),
    "amass": (load_motion, npz("m.npz", lambda: AMASS)),
    "aist": (load_motion, written("m.pkl", pickled(lambda: AIST))),
    "thuman": (load_motion, npz("m.npz", lambda: PARTS)),
    "lhm": (load_motion, written("m.json", honest.lhm)),
    "wham": (load_motion, written("m.pkl", lambda: joblib({0: WHAM}))),
    "phalp": (load_motion, written("m.pkl", pickled(honest.phalp))),
    "gvhmr": (
        load_motion,
        saved("m.pt", lambda path: write_checkpoint(path, {"smpl_params_global": tensors(PARTS)})),
    ),
    "tram": (
        load_motion,
        saved("m.npy", lambda path: np.save(path, honest.TRAM, allow_pickle=True)),
    ),
    "human3r": (
        load_motion,
        npz(
            "m.npz",
            lambda: (
                zeros(rotvec=(1, 53, 3), transl=(1, 3), smpl_id=(1,)) | {"cam2world": np.eye(4)}
            ),
        ),
    ),
    "mdm": (load_motion, saved("m.npy", lambda path: np.save(path, honest.MDM, allow_pickle=True))),
    "motion x": (load_motion, saved("m.npy", lambda path: np.save(path, np.zeros((3, 322))))),
    "kimodo": (load_motion, npz("m.npz", lambda: honest.KIMODO)),
    "smplcodec": (
        load_motion,
        saved("m.npz", lambda path: np.savez(path, bodyPose=np.zeros((3, 22, 3)), frameRate=24.0)),
    ),
    "sam 3d": (load_motion, npz("m.npz", honest.mhr)),
    "easymocap motion": (load_motion, honest.write_easymocap_motion, "000000.json"),
    "bvh": (load_motion, written("m.bvh", BVH)),
    "glb motion": (load_motion, saved("m.glb", honest.write_glb_motion)),
    "glb face": (load_motion, saved("m.glb", honest.write_glb_face)),
    "vrma face": (
        load_motion,
        saved("m.vrma", functools.partial(honest.write_glb_face, vrm=True)),
    ),
    "face table": (load_motion, written("face.csv", honest.face_table)),
    "face scores": (load_motion, written("face.json", as_json(honest.face_scores))),
    "3dgs": (
        load_gaussians,
        saved("a.ply", lambda path: save_gaussians(path, random_gaussians(harmonics=3))),
    ),
    "3dgs text": (load_gaussians, written("a.ply", honest.text_ply)),
    "3dgs compressed": (load_gaussians, written("a.ply", honest.compressed_ply)),
    "splat": (
        load_gaussians,
        saved("a.splat", lambda path: save_gaussians(path, random_gaussians())),
    ),
    "spz": (
        load_gaussians,
        saved("a.spz", lambda path: save_gaussians(path, random_gaussians(harmonics=15))),
    ),
    "spz 4": (
        load_gaussians,
        saved("a.spz", lambda path: save_gaussians(path, random_gaussians(harmonics=3), version=4)),
    ),
    "glb splats": (
        load_gaussians,
        saved("a.glb", lambda path: save_gaussians(path, random_gaussians(harmonics=8))),
    ),
    "sog": (
        load_gaussians,
        saved("a.sog", lambda path: write_sog(path, random_gaussians(harmonics=3))),
    ),
    "gsplat": (
        load_gaussians,
        saved("a.pt", lambda path: write_checkpoint(path, {"splats": tensors(honest.splats())})),
    ),
    "cameras with lenses": (load_cameras, honest.write_colmap, "images.txt"),
    "obj": (read_obj, honest.write_obj),
    "fit record": (read_fit_record, npz("fit.npz", honest.fit_arrays)),
    "bank": (load_bank, npz("bank.npz", honest.bank_arrays)),
    "manifest": (continue_synthetic_set, written("manifest.json", as_json(honest.MANIFEST))),
    "log": (
        first_failed_step,
        written("log.jsonl", '{"step": 1, "loss": 2.0}\n{"step": 2, "event": "skipped"}\n'),
    ),
    "filmed": (film, npz("m.npz", honest.motion_arrays)),
    "start": (inspect_folder, honest.write_import_folder, "photos/000.png"),
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
    "dna photos": (read_data_set, dna, "main/0001_01.smc"),
    "dna notes": (read_data_set, dna, "annotations/0001_01_annots.smc"),
    "scene list": (read_data_set, scenes, "train.json"),
    "scene arrays": (read_data_set, scenes, "smpl/0.npz"),
    "evaluation": (
        read_evaluation,
        written("evaluation_2.json", as_json({"s0": {"context": [0, 3], "target": [1]}})),
    ),
    "thuman fit": (read_scans, scans, "smplx/0000/smplx_param.pkl"),
    "thuman mesh": (read_scans, scans, "smplx/0000/mesh_smplx.obj"),
    "thuman scan": (read_scans, scans, "model/0000/0000.obj"),
    "preprocessed set": (continue_preprocessing, write_preprocessed, "out/manifest.json"),
    "preprocessed scene": (continue_preprocessing, write_preprocessed, "out/a/scene.json"),
    "skipped subject": (continue_preprocessing, write_preprocessed, "out/skipped/b.json"),
}
FORMATS = {name: Format(*row) for name, row in ROWS.items()}
