"""Damage to a data set is one line that names the file and, where there is one, the key.

Damage that any file can have (cut, other bytes, code, size) is in `tests/hostile`.
"""

import json
import pickle
import shutil

import dataset_files as files
import numpy as np
import pytest
from changes import edit_json, edit_npz, edit_pickle, edit_text
from PIL import Image

from humangs_jax.data.datasets.subject import open_people
from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.preprocess.run import PreprocessConfig, preprocess, scan_content
from humangs_jax.io.reading import FileError

SIZE = 16


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    return files.write_model(tmp_path_factory.mktemp("body"))


def read(layout, folder, body):
    """Reads everything; of scans what preprocessing reads and computes before it renders."""
    missing = {}
    if layout == "thuman":
        names, missing = open_thuman(folder)
        for name in names:
            scan_content(folder, name, body, PreprocessConfig("thuman", views=1))
        return missing
    for person in open_people(folder, body, SIZE):
        subject = person.subject
        subject.parameters(range(subject.frame_count))
        subject.photos(range(len(subject)), SIZE)
        missing |= subject.missing
    return missing


WRITE = {
    "thuman": lambda folder: files.write_thuman(folder, files.model_arrays(), "AC"),
    "avatarrex": files.write_avatarrex,
    "thuman4": files.write_thuman4,
    "actorshq": files.write_actorshq,
    "scenes": lambda folder: files.write_scenes(folder, files.model_arrays())[0].parent,
    "dna": lambda folder: files.h5py() and files.write_dna(folder),
}


def damage_by(change):
    """Returns a maker of damages that apply `change` to a path of the data set's folder."""
    return lambda path, *values, **changes: lambda folder: change(folder / path, *values, **changes)


jsn, npz, pkl, text = map(damage_by, (edit_json, edit_npz, edit_pickle, edit_text))
written, removed = (
    damage_by(lambda path, content: path.write_text(content)),
    damage_by(lambda path: path.unlink()),
)
resized = damage_by(lambda path: Image.new("L", (5, 5)).save(path, "PNG"))
huge = damage_by(
    lambda path: path.write_bytes(
        b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\1\0\0\0\1\0\0\x08\2\0\0\0" + bytes(40)
    )
)


def spoiled(value, at=0):
    def change(array):
        array = array.copy()
        array.reshape(-1)[at] = value
        return array

    return change


@damage_by
def scaled_obj(path, factor):
    lines = [line.split() for line in path.read_text().splitlines()]
    scaled = [[w[0], *(str(factor * float(x)) for x in w[1:])] if w[0] == "v" else w for w in lines]
    path.write_text("\n".join(" ".join(words) for words in scaled))


@damage_by
def swapped(path, one, other):
    if path.suffix == ".npz":
        values = dict(np.load(path))
        edit_npz(path, **{one: values[other], other: values[one]})
    else:
        values = pickle.loads(path.read_bytes())
        edit_pickle(path, **{one: values[other], other: values[one]})


# AvatarReX, whose readers THuman4.0 and, for poses and photos, ActorsHQ share
# -------------------------------------------

POSES, RIG, CAMERA = "smpl_params.npz", "calibration_full.json", "22010708"
NO_SIZE = {"file_path": "a", "camera_angle_x": 1.0, "transform_matrix": np.eye(4).tolist()}
PHOTO, MASK = "22010708/00000001.jpg", "22010708/mask/pha/00000001.jpg"


def rig(key, change):
    """Changes a value of a camera; a change of None removes it."""

    def change_camera(cameras):
        camera = cameras[CAMERA]
        if change is None:
            camera.pop(key)
        else:
            camera[key] = change(camera[key])

    return jsn(RIG, change_camera)


AVATARREX = {
    "poses missing": (removed(POSES), POSES, "no such file"),
    "body_pose missing": (npz(POSES, body_pose=None), POSES, "body_pose", "missing"),
    "a NaN": (npz(POSES, body_pose=spoiled(np.nan, 5)), POSES, "body_pose", "finite", "[0, 5]"),
    "millimetres": (npz(POSES, transl=lambda x: 1000 * x + 500), POSES, "transl", "another unit?"),
    "degrees": (
        npz(POSES, body_pose=lambda x: np.rad2deg(x) + 90),
        POSES,
        "body_pose",
        "another unit?",
    ),
    "hands of 12 numbers": (
        npz(POSES, left_hand_pose=lambda x: x[:, :12]),
        POSES,
        "left_hand_pose",
        "(3, 45)",
    ),
    "fewer frames in one array": (
        npz(POSES, transl=lambda x: x[:-1]),
        POSES,
        "transl",
        "(3, 3)",
        "(2, 3)",
    ),
    "calibration missing": (removed(RIG),),
    "no K": (rig("K", None), RIG, CAMERA, "K", "missing"),
    "a mirrored R": (rig("R", lambda x: [-v for v in x]), RIG, CAMERA, "mirrored"),
    "T in millimetres": (rig("T", lambda x: [1000 * v for v in x]), RIG, CAMERA, "expected metres"),
    "the sizes exchanged": (rig("imgSize", lambda x: x[::-1]), CAMERA, "16 x 12"),
    "a camera that leads out": (
        jsn(RIG, lambda c: c.update({"../../x": c.pop(CAMERA)})),
        RIG,
        "../../x",
    ),
    "a photo of another size": (resized(PHOTO), "size", "5 x 5"),
    "a mask of another size": (resized(MASK), "size", "5 x 5"),
}
MISSING = "missing_img_files.txt"
THUMAN4 = {"missing photos without frames": (text(MISSING, "00000001", "x"), MISSING, "line 1")}

CSV, FOCAL = "4x/calibration.csv", "1.6666666666666667"
ACTORSHQ = {
    "a column missing": (text(CSV, "name,w,h,rx", "name,w,h,ax"), CSV, "Cam001.rx"),
    "two cameras of one name": (text(CSV, "Cam002", "Cam001"), CSV, "line 3", "Cam001"),
    "focal lengths in pixels": (text(CSV, FOCAL, "2400"), CSV, "Cam001.fx", "in pixels?"),
    "a NaN": (text(CSV, FOCAL, "nan"), CSV, "Cam001", "finite"),
    "a centre in millimetres": (
        text(CSV, ",3.0,1.6", ",3000.0,1.6"),
        CSV,
        "Cam001",
        "expected metres",
    ),
    "a name that leads out": (text(CSV, "Cam001", "../../x"), CSV, "name"),
}

# THuman
# --------------------------------------------------------------------------------------------------

PKL, OBJ = "smplx_param.pkl", "mesh_smplx.obj"
FIT, MESH, SCAN = "smplx/0001/smplx_param.pkl", "smplx/0001/mesh_smplx.obj", "model/0001/0001.obj"
OTHER_FIT, TEXTURE = "smplx/0000/smplx_param.pkl", "model/0001/material0.mtl"
THUMAN = {
    "body_pose missing": (pkl(FIT, body_pose=None), PKL, "body_pose", "missing"),
    "both of them": (pkl(FIT, translation=np.zeros((1, 3))), PKL, "either transl"),
    "a scale of 0": (pkl(FIT, scale=lambda x: 0 * x), PKL, "scale", "positive"),
    "hands of 6 numbers": (
        pkl(FIT, left_hand_pose=lambda x: x[:, :6]),
        "left_hand_pose",
        "45",
        "6",
    ),
    "hands of two kinds": (
        pkl(OTHER_FIT, right_hand_pose=np.zeros((1, 45), np.float32)),
        "right_hand_pose",
        "12 or 45",
    ),
    "degrees": (
        pkl(FIT, global_orient=lambda x: np.rad2deg(x) + 90),
        "global_orient",
        "another unit?",
    ),
    "jaw exchanged with the root": (
        swapped(FIT, "jaw_pose", "global_orient"),
        OBJ,
        "mm from this mesh",
    ),
    "no fitted mesh": (removed(MESH), OBJ, "no such file"),
    "a mesh of another model": (text(MESH, "v ", "v 0 0 0\nv "), OBJ, "81 vertices"),
    "a mesh in other units": (scaled_obj(MESH, 1000), OBJ, "mm from this mesh"),
    "a quad": (
        text(MESH, "f ", "f 1 2 3 4\nf "),
        OBJ,
        "line 81: expected three corners of a triangle, got 4",
    ),
    "no texture": (removed("model/0001/material0.jpeg"), "0001.obj", "texture"),
    "a texture outside": (text(TEXTURE, "material0.jpeg", "../0000/material0.jpeg"), "0001.obj"),
}

# Scene lists
# --------------------------------------------------------------------------------------------------

LIST, ARRAYS = "train.json", "smpl/0.npz"
frame = lambda change: jsn(LIST, lambda c: change(c[0]["frames"][1]))
mirrored = lambda f: f["w2c"][0].__setitem__(slice(0, 3), [-v for v in f["w2c"][0][:3]])
SCENES = {
    "no image_path": (
        frame(lambda f: f.pop("image_path")),
        LIST,
        "s0.frames[1]",
        "image_path",
        "missing",
    ),
    "two scenes of one name": (jsn(LIST, lambda c: c.append(c[0])), LIST, "[1].scene_name"),
    "a path that leads out": (frame(lambda f: f.update(image_path="../../x.png")), LIST, "outside"),
    "w2c of 3 rows": (frame(lambda f: f.update(w2c=f["w2c"][:3])), LIST, "w2c", "(3, 4)"),
    "a mirrored w2c": (frame(mirrored), LIST, "frames[1]", "mirrored"),
    "a negative focal length": (frame(lambda f: f["fxfycxcy"].__setitem__(0, -20)), LIST, "focal"),
    "no v_cano": (npz(ARRAYS, v_cano=None), "0.npz", "v_cano", "missing"),
    "v_cano of another model": (
        npz(ARRAYS, v_cano=lambda x: x[:-1]),
        "0.npz",
        "v_cano",
        "79 vertices",
    ),
    "v_cano of somebody else": (
        npz(ARRAYS, v_cano=lambda x: x[::-1]),
        "0.npz",
        "v_cano",
        "mm from body",
    ),
    "v_posed for v_cano": (swapped(ARRAYS, "v_cano", "v_posed"), "0.npz", "v_cano", "mm from body"),
    "joints that are no rotation": (
        npz(ARRAYS, joint_transforms=lambda x: 2 * x),
        "joint_transforms",
        "expected rotations",
    ),
}

# DNA-Rendering
# --------------------------------------------------------------------------------------------------

TRANSL, FULL = "SMPLx/transl", "SMPLx/fullpose"
MAIN, NOTES = "main/0001_01.smc", "annotations/0001_01_annots.smc"
K, RT, LENS = (f"Camera_Parameter/00/{key}" for key in ("K", "RT", "D"))
SHOWN, COVER = "Camera_5mp/0/color/1", "Mask/0/mask/1"


def h5(path, change):
    def damage(folder):
        with files.h5py().File(folder / path, "a") as file:
            change(file)

    return damage


def h5_set(key, change, path=NOTES):
    def replace(file):
        value = np.asarray(file[key])
        del file[key]
        file[key] = change(value)

    return h5(path, replace)


def h5_link(file):
    del file[TRANSL]
    file[TRANSL] = files.h5py().ExternalLink("elsewhere.h5", "/x")


def h5_endless(file):
    del file[TRANSL]
    file.create_dataset(TRANSL, (10**14,), "f8", chunks=(1000,))


in_millimetres = lambda x: np.block([[x[:, :3], 1000 * x[:, 3:] - [[0], [0], [0], [999]]]])
DNA = {
    "no cameras": (h5(MAIN, lambda f: f.__delitem__("Camera_5mp")), "0001_01.smc", "Camera_5mp"),
    "no poses": (h5(NOTES, lambda f: f.__delitem__(FULL)), "annots.smc", FULL, "missing"),
    "24 joints": (h5_set(FULL, lambda x: x[:, :24]), FULL, "(3, 24, 3)"),
    "degrees": (h5_set(FULL, lambda x: np.rad2deg(x) + 90), FULL, "another unit?"),
    "a link into another file": (h5(NOTES, h5_link), TRANSL, "refused a link"),
    "numbers of 10^15 bytes": (h5(NOTES, h5_endless), TRANSL, "array_bytes"),
    "a scaled RT": (h5_set(RT, lambda x: 2 * x), "annots.smc: 00", "scaled"),
    "RT in millimetres": (h5_set(RT, in_millimetres), "00", "expected metres"),
    "three lens coefficients": (h5_set(LENS, lambda x: x[:3]), LENS, "3 numbers"),
    "a photo cut off": (h5_set(SHOWN, lambda x: x[: len(x) // 2], MAIN), SHOWN, "image"),
    "no photo": (
        h5(MAIN, lambda f: [f[f"Camera_5mp/{c}/color"].clear() for c in (0, 1)]),
        "0001_01.smc",
        "no photo",
    ),
}
CASES = {
    "avatarrex": AVATARREX,
    "thuman4": THUMAN4,
    "actorshq": ACTORSHQ,
    "thuman": THUMAN,
    "scenes": SCENES,
    "dna": DNA,
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """Returns a function that gives the folder of a valid data set, which is written once."""
    written = {}

    def folder(layout):
        if layout not in written:
            written[layout] = WRITE[layout](tmp_path_factory.mktemp(layout))
        return written[layout]

    return folder


OF_CAPTURE = ("avatarrex", "thuman4")
"""Layouts whose calibration is read by a module of capture/."""


def marks(layout):
    return [pytest.mark.wings] if layout in OF_CAPTURE else []


@pytest.mark.parametrize(
    ("layout", "name"),
    [
        pytest.param(layout, name, marks=marks(layout))
        for layout, cases in CASES.items()
        for name in cases
    ],
)
def test_damage_is_one_line_that_names_file_and_key(layout, name, honest, body, tmp_path):
    damage, *words = CASES[layout][name]
    folder = tmp_path / "set"
    shutil.copytree(honest(layout), folder)
    damage(folder)
    with pytest.raises((FileError, FileNotFoundError)) as caught:
        read(layout, folder, body)
    line = str(caught.value)
    assert "\n" not in line and str(folder) in line
    assert all(word in line for word in words), f"{words} in {line}"


@pytest.mark.parametrize("layout", [pytest.param(layout, marks=marks(layout)) for layout in WRITE])
def test_honest_sets_are_read(layout, honest, body):
    assert read(layout, honest(layout), body) == (
        {"listed as missing": 1} if layout == "thuman4" else {}
    )


@pytest.mark.wings
def test_preprocessing_names_all_damage_and_makes_the_rest(honest, body, tmp_path):
    """Each damage is a subject's, and one subject is valid."""
    shutil.copytree(honest("avatarrex"), tmp_path / "in" / "honest")
    for name, (damage, *_) in AVATARREX.items():
        shutil.copytree(honest("avatarrex"), tmp_path / "in" / name)
        damage(tmp_path / "in" / name)
    report = preprocess(
        tmp_path / "in",
        tmp_path / "out",
        body.file,
        PreprocessConfig("avatarrex", size=SIZE),
        progress=False,
    )
    scenes = json.loads((tmp_path / "out" / "manifest.json").read_text())["scenes"]
    assert not scenes["honest"]["unreadable"]
    of_photos = {
        "a mask of another size",
        "a photo of another size",
        "the sizes exchanged",
    }
    # without one it is no subject
    assert set(report.skipped) == set(AVATARREX) - of_photos - {"calibration missing"}
    for name, line in report.skipped.items():
        assert name in line and all(word in line for word in AVATARREX[name][1:])
