"""Every kind of damage to every layout: one error line that names the file and, where there is one, the key.

What can be done to any file (cut, other bytes, code in it, size) is done to these ones by `tests/hostile`.
"""

import functools
import json
import pickle
import shutil

import dataset_files as files
import numpy as np
import pytest
from changes import edit_bytes, edit_json, edit_npz, edit_pickle, edit_text
from PIL import Image

from humangs_jax.data.datasets.subject import open_people
from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.preprocess.run import Settings, preprocess, scan_content
from humangs_jax.io.reading import FileError

SIZE = 16


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    return files.write_model(tmp_path_factory.mktemp("body"))


def read_thuman(folder, body):
    """All that preprocessing reads and computes before it renders."""
    names, skipped = open_thuman(folder)
    for name in names:
        scan_content(folder, name, body, Settings("thuman", views=1))
    return skipped


def read_people(folder, body):
    """Everything that is there."""
    missing = {}
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
CASES = []


def case(layout, name, damage, *words):
    """damage(folder) changes an honest data set; words: all of them are in the error."""
    CASES.append(pytest.param(layout, damage, words, id=f"{layout}: {name}"))


thuman, scenes, dna, actorshq = (functools.partial(case, layout) for layout in ("thuman", "scenes", "dna", "actorshq"))


def damage_by(change):
    """A maker of damages: change(path, ...) is done to a path of the data set's folder."""
    return lambda path, *values, **changes: lambda folder: change(folder / path, *values, **changes)


bytes_of, jsn, npz, pkl, text = map(damage_by, (edit_bytes, edit_json, edit_npz, edit_pickle, edit_text))
written, removed = damage_by(lambda path, content: path.write_text(content)), damage_by(lambda path: path.unlink())
resized = damage_by(lambda path: Image.new("L", (5, 5)).save(path, "PNG"))


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
def swapped_npz(path, one, other):
    values = dict(np.load(path))
    np.savez(path, **(values | {one: values[other], other: values[one]}))


@damage_by
def swapped_pkl(path, one, other):
    content = pickle.loads(path.read_bytes())
    edit_pickle(path, **{one: content[other], other: content[one]})


def of_images(layout, photo, mask):
    case(layout, "a photo of another size", resized(photo), "size", "5 x 5")
    case(layout, "a mask of another size", resized(mask), "size", "5 x 5")
    huge = lambda data: b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\1\0\0\0\1\0\0\x08\2\0\0\0" + bytes(40)
    case(layout, "a photo of 65,536 pixels a side", bytes_of(photo, huge), photo.rsplit("/", 1)[-1])


# smpl_params.npz: of three layouts ------------------------------------------------------------------------------------

for layout in ("avatarrex", "thuman4", "actorshq"):
    this = functools.partial(case, layout)
    file = "smpl_params.npz"
    this("poses missing", removed(file), file, "no such file")
    for key in ("global_orient", "body_pose", "transl", "left_hand_pose", "betas"):
        this(f"{key} missing", npz(file, **{key: None}), file, key, "missing")
    this("a NaN", npz(file, body_pose=spoiled(np.nan, 5)), file, "body_pose", "finite", "[0, 5]")
    this("an infinity", npz(file, transl=spoiled(np.inf)), file, "transl", "finite")
    this("millimetres", npz(file, transl=lambda x: 1000 * x + 500), file, "transl", "another unit?")
    this("degrees", npz(file, body_pose=lambda x: np.rad2deg(x) + 90), file, "body_pose", "another unit?")
    this("poses of 66 numbers", npz(file, body_pose=lambda x: np.pad(x, ((0, 0), (0, 3)))), file, "(3, 63)", "(3, 66)")
    this("hands of 12 numbers", npz(file, left_hand_pose=lambda x: x[:, :12]), file, "left_hand_pose", "(3, 45)")
    this("fewer frames in one array", npz(file, transl=lambda x: x[:-1]), file, "transl", "(3, 3)", "(2, 3)")
    this("no frames", npz(file, global_orient=lambda x: x[:0]), file, "global_orient", "(0, 3)")
    this("text", npz(file, transl=lambda x: x.astype(str)), file, "transl", "real numbers")
    this("complex numbers", npz(file, transl=lambda x: x + 0j), file, "transl", "real numbers")
    this(
        "300 shape coefficients", npz(file, betas=lambda x: np.ones((3, 300))), file, "betas", "'shape_10' is no shape direction"
    )
    this("shape of other frames", npz(file, betas=lambda x: x[:2]), file, "betas", "(2, 10)")
    this("shape of 1,000", npz(file, betas=lambda x: x + 1000), file, "betas", "another unit?")

# Calibrations -----------------------------------------------------------------------------------------------------------

for layout, file, camera in (("avatarrex", "calibration_full.json", "22010708"), ("thuman4", "calibration.json", "cam00")):
    this = functools.partial(case, layout)
    this("calibration missing", removed(file))
    set_to = lambda key, change, camera=camera, file=file: jsn(file, lambda c: c[camera].update({key: change(c[camera][key])}))
    for key in ("K", "R", "T"):
        this(f"no {key}", jsn(file, lambda c, key=key, camera=camera: c[camera].pop(key)), file, camera, key, "missing")
    this("no image size", jsn(file, lambda c, camera=camera: c[camera].pop("imgSize")), file, camera, "imgSize")
    this("K of 8 numbers", set_to("K", lambda x: x[:8]), file, camera, "K", "3 x 3")
    this("T of 2 numbers", set_to("T", lambda x: x[:2]), file, camera, "T")
    this("a NaN in R", set_to("R", lambda x: [float("nan"), *x[1:]]), file, camera, "R", "finite")
    this("a mirrored R", set_to("R", lambda x: [-v for v in x]), file, camera, "mirrored")
    this("a scaled R", set_to("R", lambda x: [2 * v for v in x]), file, camera, "scaled")
    this("T in millimetres", set_to("T", lambda x: [1000 * v for v in x]), file, camera, "expected metres")
    this("no focal length", set_to("K", lambda x: [0, *x[1:]]), file, camera, "focal")
    this("K and R exchanged", jsn(file, lambda c, n=camera: c[n].update(K=c[n]["R"], R=c[n]["K"])), file, camera)
    this("text in T", set_to("T", lambda x: ["1", "2", "3"]), file, camera, "T", "numbers")
    this("an image size of 0", set_to("imgSize", lambda x: [0, 16]), file, camera, "imgSize")
    this("an image size of 10^9", set_to("imgSize", lambda x: [10**9, 16]), file, camera, "imgSize")
    this("the sizes exchanged", set_to("imgSize", lambda x: x[::-1]), camera, "16 x 12")
    this("a camera that leads out", jsn(file, lambda c, n=camera: c.update({"../../x": c.pop(n)})), file, "../../x")
    this("a list", written(file, "[1, 2]"), file)
    this("nested 10,000 times", written(file, '{"a":' * 10000), file)
of_images("avatarrex", "22010708/00000001.jpg", "22010708/mask/pha/00000001.jpg")
of_images("thuman4", "images/cam00/00000001.jpg", "masks/cam00/00000001.jpg")
case(
    "thuman4",
    "a list of missing photos without frames",
    text("missing_img_files.txt", "00000001", "x"),
    "missing_img_files.txt",
    "line 1",
)

CSV = "4x/calibration.csv"
of_images("actorshq", "4x/rgbs/Cam001/Cam001_rgb000001.jpg", "4x/masks/Cam001/Cam001_mask000001.png")
actorshq("calibration missing", removed(CSV))
actorshq("a column missing", text(CSV, "name,w,h,rx", "name,w,h,ax"), CSV, "Cam001.rx")
actorshq("no names", text(CSV, "name,", "camera,"), CSV, "name")
actorshq("two cameras of one name", text(CSV, "Cam002", "Cam001"), CSV, "line 3", "Cam001")
actorshq("text for a number", text(CSV, "1.6666666666666667", "wide"), CSV, "Cam001.fx", "wide")
actorshq("focal lengths in pixels", text(CSV, "1.6666666666666667", "2400"), CSV, "Cam001.fx", "in pixels?")
actorshq("a NaN", text(CSV, "1.6666666666666667", "nan"), CSV, "Cam001", "finite")
actorshq("half a pixel", text(CSV, "Cam001,12,", "Cam001,12.5,"), CSV, "whole pixels")
actorshq("a centre in millimetres", text(CSV, ",3.0,1.6", ",3000.0,1.6"), CSV, "Cam001", "expected metres")
actorshq("a name that leads out", text(CSV, "Cam001", "../../x"), CSV, "name")

# THuman -----------------------------------------------------------------------------------------------------------------

PKL, OBJ = "smplx_param.pkl", "mesh_smplx.obj"
FIT, MESH, SCAN = "smplx/0001/smplx_param.pkl", "smplx/0001/mesh_smplx.obj", "model/0001/0001.obj"
thuman("a pickle of a list", lambda f: (f / FIT).write_bytes(pickle.dumps([1])), PKL, "dict")
for key in ("scale", "global_orient", "body_pose", "left_hand_pose", "betas", "expression"):
    case("thuman", f"{key} missing", pkl(FIT, **{key: None}), PKL, key, "missing")
thuman("neither transl nor translation", pkl(FIT, transl=None), PKL, "transl")
thuman("both of them", pkl(FIT, translation=np.zeros((1, 3))), PKL, "either transl")
thuman("a NaN", pkl(FIT, body_pose=spoiled(np.nan)), PKL, "body_pose", "finite")
thuman("a scale of 0", pkl(FIT, scale=lambda x: 0 * x), PKL, "scale", "positive")
thuman("a negative scale", pkl(FIT, scale=lambda x: -x), PKL, "scale", "positive")
thuman("two scales", pkl(FIT, scale=lambda x: np.ones(2)), PKL, "scale", "(2,)")
thuman("hands of 6 numbers", pkl(FIT, left_hand_pose=lambda x: x[:, :6]), "left_hand_pose", "45", "6")
thuman(
    "hands of two kinds",
    pkl("smplx/0000/smplx_param.pkl", right_hand_pose=np.zeros((1, 45), np.float32)),
    "right_hand_pose",
    "12 or 45",
)
thuman("no leading axis", pkl(FIT, body_pose=lambda x: x[0]), PKL, "body_pose", "(63,)")
thuman("degrees", pkl(FIT, global_orient=lambda x: np.rad2deg(x) + 90), "global_orient", "another unit?")
thuman("millimetres", pkl(FIT, transl=lambda x: 1000 * x + 500), "transl", "another unit?")
thuman("jaw and left eye exchanged with the root", swapped_pkl(FIT, "jaw_pose", "global_orient"), OBJ, "mm from this mesh")
thuman("left and right hands exchanged", swapped_pkl(FIT, "left_hand_pose", "right_hand_pose"), OBJ, "mm from this mesh")
thuman("no fitted mesh", removed(MESH), OBJ, "no such file")
thuman("a mesh of another model", text(MESH, "v ", "v 0 0 0\nv "), OBJ, "81 vertices")
thuman("a mesh in other units", scaled_obj(MESH, 1000), OBJ, "mm from this mesh")
thuman("text in a vertex", text(MESH, "v ", "v x y z\nv "), OBJ, "could not convert")
thuman("a NaN in a vertex", text(MESH, "v ", "v nan 0 0\nv "), OBJ, "finite")
thuman("a face of vertices that are not there", text(MESH, "f ", "f 1 2 900\nf "), OBJ, "f: expected integers in [0, 80)")
thuman("no texture", removed("model/0001/material0.jpeg"), "0001.obj", "texture")
thuman("no material", removed("model/0001/material0.mtl"), "0001.obj", "texture")
thuman(
    "a texture outside of the folder", text("model/0001/material0.mtl", "material0.jpeg", "../0000/material0.jpeg"), "0001.obj"
)
thuman("a scan with a NaN", text(SCAN, "v ", "v nan 0 0\nv "), "0001.obj")
thuman("no folder model", lambda f: (f / "model").rename(f / "models"), "model", "no such folder")


# Scene lists ------------------------------------------------------------------------------------------------------------

LIST, ARRAYS = "train.json", "smpl/0.npz"
frame = lambda change: jsn(LIST, lambda c: change(c[0]["frames"][1]))
for key in ("image_path", "w2c", "fxfycxcy", "smpl_path"):
    case("scenes", f"no {key}", frame(lambda f, key=key: f.pop(key)), LIST, "s0.frames[1]", key, "missing")
scenes("no frames", jsn(LIST, lambda c: c[0].pop("frames")), LIST, "s0.frames")
scenes("no views", jsn(LIST, lambda c: c[0].update(frames=[])), LIST, "s0.frames")
scenes("no name", jsn(LIST, lambda c: c[0].pop("scene_name")), LIST, "scene_name")
scenes("two scenes of one name", jsn(LIST, lambda c: c.append(c[0])), LIST, "[1].scene_name")
scenes("a number for a path", frame(lambda f: f.update(image_path=3)), LIST, "image_path", "name or path")
scenes("a path that leads out", frame(lambda f: f.update(image_path="../../x.png")), LIST, "outside")
scenes("arrays that lead out", frame(lambda f: f.update(smpl_path="/etc/hostname")), LIST, "outside")
scenes("w2c of 3 rows", frame(lambda f: f.update(w2c=f["w2c"][:3])), LIST, "w2c", "(3, 4)")
scenes("ragged w2c", frame(lambda f: f["w2c"][1].pop()), LIST, "w2c", "numbers")
scenes("a NaN in w2c", frame(lambda f: f["w2c"][0].__setitem__(0, float("nan"))), LIST, "w2c", "finite")
scenes(
    "a mirrored w2c",
    frame(lambda f: f["w2c"][0].__setitem__(slice(0, 3), [-v for v in f["w2c"][0][:3]])),
    LIST,
    "frames[1]",
    "mirrored",
)
scenes("c2w with OpenGL's last row", frame(lambda f: f["w2c"].__setitem__(3, [0, 0, 0, 2])), LIST, "last row")
scenes("three intrinsics", frame(lambda f: f.update(fxfycxcy=f["fxfycxcy"][:3])), LIST, "fxfycxcy", "(3,)")
scenes("a negative focal length", frame(lambda f: f["fxfycxcy"].__setitem__(0, -20)), LIST, "focal")
scenes("text for intrinsics", frame(lambda f: f.update(fxfycxcy=["a"] * 4)), LIST, "fxfycxcy", "numbers")
scenes("an object, no list", written(LIST, "{}"), LIST, "list of scenes")
scenes("a scene that is text", written(LIST, '["a"]'), LIST, "[0]")
scenes("no v_cano", npz(ARRAYS, v_cano=None), "0.npz", "v_cano", "missing")
scenes("no joint_transforms", npz(ARRAYS, joint_transforms=None), "0.npz", "joint_transforms", "missing")
scenes("v_cano of another model", npz(ARRAYS, v_cano=lambda x: x[:-1]), "0.npz", "v_cano", "79 vertices")
scenes("v_cano of somebody else", npz(ARRAYS, v_cano=lambda x: x[::-1]), "0.npz", "v_cano", "mm from body")
scenes("v_posed for v_cano", swapped_npz(ARRAYS, "v_cano", "v_posed"), "0.npz", "v_cano", "mm from body")
scenes("a NaN in v_cano", npz(ARRAYS, v_cano=spoiled(np.nan)), "0.npz", "v_cano", "finite")
scenes(
    "joints that are no rotation",
    npz(ARRAYS, joint_transforms=lambda x: 2 * x),
    "0.npz",
    "joint_transforms",
    "expected rotations",
)
scenes("54 joints", npz(ARRAYS, joint_transforms=lambda x: x[1:]), "0.npz", "joint_transforms", "(54, 4, 4)")


# DNA-Rendering ----------------------------------------------------------------------------------------------------------

TRANSL, POSES = "SMPLx/transl", "SMPLx/fullpose"
MAIN, NOTES = "main/0001_01.smc", "annotations/0001_01_annots.smc"


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


dna("no annotations", removed(NOTES), "0001_01_annots.smc")
dna("no cameras", h5(MAIN, lambda f: f.__delitem__("Camera_5mp")), "0001_01.smc", "Camera_5mp")
for key in (POSES, TRANSL, "SMPLx/betas", "Camera_Parameter/01/K", "Camera_Parameter/01/RT", "Camera_Parameter/01/D"):
    case("dna", f"no {key}", h5(NOTES, lambda f, key=key: f.__delitem__(key)), "annots.smc", key, "missing")
dna("a NaN", h5_set(POSES, spoiled(np.nan)), POSES, "finite")
dna("24 joints", h5_set(POSES, lambda x: x[:, :24]), POSES, "(3, 24, 3)")
dna("degrees", h5_set(POSES, lambda x: np.rad2deg(x) + 90), POSES, "another unit?")
dna("millimetres", h5_set(TRANSL, lambda x: 1000 * x + 500), TRANSL, "another unit?")
dna("fewer translations", h5_set(TRANSL, lambda x: x[:2]), TRANSL, "(2, 3)")
dna("text", h5_set(TRANSL, lambda x: b"text"), TRANSL, "numbers")
dna("a group for numbers", h5(NOTES, lambda f: (f.__delitem__(TRANSL), f.create_group(TRANSL))), TRANSL, "numbers")
dna("a link into another file", h5(NOTES, h5_link), TRANSL, "refused a link")
dna(
    "numbers of 10^15 bytes",
    h5(NOTES, lambda f: (f.__delitem__(TRANSL), f.create_dataset(TRANSL, (10**14,), "f8", chunks=(1000,)))),
    TRANSL,
    "array_bytes",
)
dna("K of 2 rows", h5_set("Camera_Parameter/00/K", lambda x: x[:2]), "Camera_Parameter/00/K", "(2, 3)")
dna("a scaled RT", h5_set("Camera_Parameter/00/RT", lambda x: 2 * x), "annots.smc: 00", "scaled")
dna("a mirrored RT", h5_set("Camera_Parameter/00/RT", lambda x: x @ np.diag([1, 1, -1, 1])), "annots.smc: 00", "mirrored")
dna(
    "RT in millimetres",
    h5_set("Camera_Parameter/00/RT", lambda x: np.block([[x[:, :3], 1000 * x[:, 3:] - [[0], [0], [0], [999]]]])),
    "00",
    "expected metres",
)
dna("three lens coefficients", h5_set("Camera_Parameter/00/D", lambda x: x[:3]), "Camera_Parameter/00/D", "3 numbers")
PHOTO, MASK = "Camera_5mp/0/color/1", "Mask/0/mask/1"
dna("a photo cut off", h5_set(PHOTO, lambda x: x[: len(x) // 2], MAIN), PHOTO, "image")
dna("a photo of other bytes", h5_set(PHOTO, lambda x: x[::-1], MAIN), PHOTO, "image")
dna("a photo of floats", h5_set(PHOTO, lambda x: x.astype(float), MAIN), PHOTO, "encoded bytes")
dna("a mask cut off", h5_set(MASK, lambda x: x[: len(x) // 2]), MASK, "image")
dna("an empty photo", h5_set(PHOTO, lambda x: x[:0], MAIN), PHOTO, "image")
dna("no photo at all", h5(MAIN, lambda f: [f[f"Camera_5mp/{c}/color"].clear() for c in (0, 1)]), "0001_01.smc", "no photo")


@pytest.fixture(scope="module")
def honest(tmp_path_factory):
    """An honest data set of each layout, written once."""
    written = {}

    def folder(layout):
        if layout not in written:
            written[layout] = WRITE[layout](tmp_path_factory.mktemp(layout))
        return written[layout]

    return folder


@pytest.mark.parametrize(("layout", "damage", "words"), CASES)
def test_damage_is_one_line_that_names_file_and_key(layout, damage, words, honest, body, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(honest(layout), folder)
    damage(folder)
    read = read_thuman if layout == "thuman" else read_people
    with pytest.raises((FileError, FileNotFoundError)) as caught:
        read(folder, body)
    line = str(caught.value)
    assert "\n" not in line and str(folder) in line
    assert all(word in line for word in words), f"{words} in {line}"


@pytest.mark.parametrize("layout", WRITE)
def test_honest_sets_are_read(layout, honest, body):
    read = read_thuman if layout == "thuman" else read_people
    assert read(honest(layout), body) == ({"listed as missing": 1} if layout == "thuman4" else {})


@pytest.mark.parametrize("layout", ["avatarrex", "thuman4"])
def test_preprocessing_names_all_damage_and_makes_the_rest(layout, honest, body, tmp_path):
    """All of a layout's damage at once: each case is a subject of its own, beside an honest one."""
    cases = [case.values for case in CASES if case.values[0] == layout]
    shutil.copytree(honest(layout), tmp_path / "in" / "honest")
    for i, (_, damage, _) in enumerate(cases):
        shutil.copytree(honest(layout), tmp_path / "in" / f"damaged{i:03d}")
        damage(tmp_path / "in" / f"damaged{i:03d}")
    report = preprocess(tmp_path / "in", tmp_path / "out", body.file, Settings(layout, size=SIZE), progress=False)
    scenes = json.loads((tmp_path / "out" / "manifest.json").read_text())["scenes"]
    assert not scenes["honest"]["unreadable"]
    for i, (_, _, words) in enumerate(cases):
        name = f"damaged{i:03d}"
        if name in report.skipped:
            told = report.skipped[name]
        elif name in scenes:  # one photo of a frame that is not among every tenth, or that cannot be read
            continue
        else:  # without a calibration it is no subject
            assert not (tmp_path / "in" / name / "calibration.json").is_file()
            assert not (tmp_path / "in" / name / "calibration_full.json").is_file()
            continue
        assert name in told and all(word in told for word in words), told
    assert len(report.skipped) >= 20
