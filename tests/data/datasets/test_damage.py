"""Some thirty kinds of damage to every layout: one error line that names the file and, where there is one, the key.

No code of a file runs, nothing becomes large, nothing takes long. `EVERY` is done to files of all layouts.
"""

import json
import pickle
import shutil
import time
import tracemalloc
import zipfile

import dataset_files as files
import h5_or_skip
import numpy as np
import pytest

from humangs_jax.data.datasets.bodies import BodyParameters, posed_people
from humangs_jax.data.datasets.subject import open_people
from humangs_jax.data.datasets.thuman import open_thuman
from humangs_jax.data.preprocess.run import Settings, preprocess, scan_content
from humangs_jax.io.reading import FileError

MOST_BYTES, MOST_SECONDS = 300 << 20, 10.0
"""What a damaged file may cost; the limit plain_bytes is 256 MiB."""
LARGE = ("bomb", "memory", "10^", "65,536")
"""In names of cases whose memory is measured."""
SIZE = 16


@pytest.fixture(scope="module")
def body(tmp_path_factory):
    body = files.write_model(tmp_path_factory.mktemp("body"))
    rest = BodyParameters(np.zeros(20), np.zeros((1, 55, 3)), np.zeros((1, 3)))
    next(posed_people(body.model, rest))  # compiled before anything is timed
    return body


def read_thuman(folder, body):
    """All that preprocessing reads and computes before it renders."""
    thuman = open_thuman(folder)
    for name in thuman.names:
        scan_content(name, thuman, body, Settings("thuman", views=1))
    return thuman.skipped


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
    "dna": lambda folder: files.write_dna(folder, h5_or_skip.h5py()),
}
CASES = []


def case(layout, name, damage, *words):
    """damage(folder) changes an honest data set; words: all of them are in the error."""
    CASES.append(pytest.param(layout, damage, words, id=f"{layout}: {name}"))


# Ways to damage a file -----------------------------------------------------------------------------------------------


def bytes_of(path, change):
    return lambda folder: (folder / path).write_bytes(change((folder / path).read_bytes()))


def removed(path):
    return lambda folder: (folder / path).unlink()


def a_folder(path):
    def damage(folder):
        (folder / path).unlink()
        (folder / path).mkdir()

    return damage


def text(path, old, new):
    def damage(folder):
        content = (folder / path).read_text()
        assert old in content
        (folder / path).write_text(content.replace(old, new, 1))

    return damage


def npz(path, **changes):
    """Entries replaced by a function of them; None removes one."""

    def damage(folder):
        values = dict(np.load(folder / path))
        values |= {key: change(values[key]) for key, change in changes.items() if change}
        kept = {key: x for key, x in values.items() if key not in changes or changes[key]}
        np.savez(folder / path, **kept)

    return damage


def pkl(path, **changes):
    def damage(folder):
        values = pickle.loads((folder / path).read_bytes())
        values |= {key: change(values[key]) for key, change in changes.items() if change}
        kept = {key: x for key, x in values.items() if key not in changes or changes[key]}
        (folder / path).write_bytes(pickle.dumps(kept))

    return damage


def jsn(path, change):
    def damage(folder):
        content = json.loads((folder / path).read_text())
        change(content)
        (folder / path).write_text(json.dumps(content))

    return damage


def spoiled(value, at=0):
    def change(array):
        array = array.copy()
        array.reshape(-1)[at] = value
        return array

    return change


class Evil:
    def __reduce__(self):
        import os

        return os.system, ("touch OWNED",)


def evil_pickle(folder_path):
    return lambda folder: (folder / folder_path).write_bytes(pickle.dumps({"betas": Evil()}))


def object_npz(path, key):
    def damage(folder):
        values = dict(np.load(folder / path))
        values[key] = np.asarray([Evil()], object)
        np.savez(folder / path, **values)

    return damage


def bomb(path):
    """An archive of some 100 kB that unpacks to 2 GiB."""

    def damage(folder):
        header = (
            b"\x93NUMPY\x01\x00\x76\x00"
            + b"{'descr': '|u1', 'fortran_order': False, 'shape': (2147483648,), }".ljust(117)
            + b"\n"
        )
        packed = zipfile.ZipFile(folder / path, "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        with packed as archive, archive.open("betas.npy", "w", force_zip64=True) as member:
            member.write(header)
            for _ in range(32):
                member.write(bytes(1 << 20))
        data = (folder / path).read_bytes()
        # the directory says more than there is: nothing has to be unpacked to refuse it
        size = (len(header) + (32 << 20)).to_bytes(4, "little")
        (folder / path).write_bytes(data.replace(size, (2147483648).to_bytes(4, "little")))

    return damage


def every(layout, path, kind, whole=False, cut=2):
    """What can be done to any file. kind: in the error of bytes that are none of the format.

    whole: a folder in its place is as good as no file: what that does is said elsewhere. cut: the part of the file that is left.
    """
    name = path.rsplit("/", 1)[-1]
    case(layout, f"{name} empty", bytes_of(path, lambda data: b""), name)
    case(layout, f"{name} cut off", bytes_of(path, lambda data: data[: len(data) // cut]), name)
    case(layout, f"{name} of other bytes", bytes_of(path, lambda data: bytes(range(256)) * 8), name, kind)
    if not whole:
        case(layout, f"{name} a folder", a_folder(path), name, "folder")


def of_images(layout, photo, mask, small=(5, 5)):
    from PIL import Image

    every(layout, photo, "image")
    every(layout, mask, "image")
    resize = lambda path: lambda folder: Image.new("L", small).save(folder / path, "PNG")
    case(layout, "a photo of another size", resize(photo), "size", "5 x 5")
    case(layout, "a mask of another size", resize(mask), "size", "5 x 5")
    huge = lambda data: b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\1\0\0\0\1\0\0\x08\2\0\0\0" + bytes(40)
    case(layout, "a photo of 65,536 pixels a side", bytes_of(photo, huge), photo.rsplit("/", 1)[-1])


# smpl_params.npz: of three layouts ------------------------------------------------------------------------------------

for layout in ("avatarrex", "thuman4", "actorshq"):
    file = "smpl_params.npz"
    every(layout, file, "npz archive")
    case(layout, "poses missing", removed(file), file, "no such file")
    for key in ("global_orient", "body_pose", "transl", "left_hand_pose", "betas"):
        case(layout, f"{key} missing", npz(file, **{key: None}), file, key, "missing")
    case(layout, "a NaN", npz(file, body_pose=spoiled(np.nan, 5)), file, "body_pose", "finite", "[0, 5]")
    case(layout, "an infinity", npz(file, transl=spoiled(np.inf)), file, "transl", "finite")
    case(layout, "millimetres", npz(file, transl=lambda x: 1000 * x + 500), file, "transl", "another unit?")
    case(layout, "degrees", npz(file, body_pose=lambda x: np.rad2deg(x) + 90), file, "body_pose", "another unit?")
    case(
        layout,
        "poses of 66 numbers",
        npz(file, body_pose=lambda x: np.pad(x, ((0, 0), (0, 3)))),
        file,
        "(3, 63)",
        "(3, 66)",
    )
    case(
        layout, "hands of 12 numbers", npz(file, left_hand_pose=lambda x: x[:, :12]), file, "left_hand_pose", "(3, 45)"
    )
    case(layout, "fewer frames in one array", npz(file, transl=lambda x: x[:-1]), file, "transl", "(3, 3)", "(2, 3)")
    case(layout, "no frames", npz(file, global_orient=lambda x: x[:0]), file, "global_orient", "(0, 3)")
    case(layout, "text", npz(file, transl=lambda x: x.astype(str)), file, "transl", "real numbers")
    case(layout, "complex numbers", npz(file, transl=lambda x: x + 0j), file, "transl", "real numbers")
    case(
        layout,
        "300 shape coefficients",
        npz(file, betas=lambda x: np.ones((3, 300))),
        file,
        "betas",
        "10 such directions",
    )
    case(layout, "shape of other frames", npz(file, betas=lambda x: x[:2]), file, "betas", "(2, 10)")
    case(layout, "shape of 1,000", npz(file, betas=lambda x: x + 1000), file, "betas", "another unit?")
    case(layout, "an object that runs code", object_npz(file, "transl"), file, "transl", "pickled")
    case(layout, "a bomb", bomb(file), file, "limit")

# Calibrations -----------------------------------------------------------------------------------------------------------

for layout, file, camera in (
    ("avatarrex", "calibration_full.json", "22010708"),
    ("thuman4", "calibration.json", "cam00"),
):
    every(layout, file, "", whole=True)
    case(layout, "calibration missing", removed(file))
    set_to = lambda key, change, camera=camera, file=file: jsn(
        file, lambda c: c[camera].update({key: change(c[camera][key])})
    )
    for key in ("K", "R", "T"):
        case(
            layout,
            f"no {key}",
            jsn(file, lambda c, key=key, camera=camera: c[camera].pop(key)),
            file,
            camera,
            key,
            "missing",
        )
    case(layout, "no image size", jsn(file, lambda c, camera=camera: c[camera].pop("imgSize")), file, camera, "imgSize")
    case(layout, "K of 8 numbers", set_to("K", lambda x: x[:8]), file, camera, "K", "3 x 3")
    case(layout, "T of 2 numbers", set_to("T", lambda x: x[:2]), file, camera, "T")
    case(layout, "a NaN in R", set_to("R", lambda x: [float("nan"), *x[1:]]), file, camera, "R", "finite")
    case(layout, "a mirrored R", set_to("R", lambda x: [-v for v in x]), file, camera, "mirrored")
    case(layout, "a scaled R", set_to("R", lambda x: [2 * v for v in x]), file, camera, "scaled")
    case(layout, "T in millimetres", set_to("T", lambda x: [1000 * v for v in x]), file, camera, "expected metres")
    case(layout, "no focal length", set_to("K", lambda x: [0, *x[1:]]), file, camera, "focal")
    case(
        layout, "K and R exchanged", jsn(file, lambda c, n=camera: c[n].update(K=c[n]["R"], R=c[n]["K"])), file, camera
    )
    case(layout, "text in T", set_to("T", lambda x: ["1", "2", "3"]), file, camera, "T", "numbers")
    case(layout, "an image size of 0", set_to("imgSize", lambda x: [0, 16]), file, camera, "imgSize")
    case(layout, "an image size of 10^9", set_to("imgSize", lambda x: [10**9, 16]), file, camera, "imgSize")
    case(layout, "the sizes exchanged", set_to("imgSize", lambda x: x[::-1]), camera, "16 x 12")
    case(
        layout,
        "a camera that leads out",
        jsn(file, lambda c, n=camera: c.update({"../../x": c.pop(n)})),
        file,
        "../../x",
    )
    case(layout, "a list", lambda folder, file=file: (folder / file).write_text("[1, 2]"), file)
    case(layout, "nested 10,000 times", lambda folder, file=file: (folder / file).write_text('{"a":' * 10000), file)
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
every("actorshq", CSV, "UTF-8", whole=True, cut=3)
of_images("actorshq", "4x/rgbs/Cam001/Cam001_rgb000001.jpg", "4x/masks/Cam001/Cam001_mask000001.png")
case("actorshq", "calibration missing", removed(CSV))
case("actorshq", "a column missing", text(CSV, "name,w,h,rx", "name,w,h,ax"), CSV, "Cam001.rx")
case("actorshq", "no names", text(CSV, "name,", "camera,"), CSV, "name")
case("actorshq", "two cameras of one name", text(CSV, "Cam002", "Cam001"), CSV, "line 3", "Cam001")
case("actorshq", "text for a number", text(CSV, "1.6666666666666667", "wide"), CSV, "Cam001.fx", "wide")
case("actorshq", "focal lengths in pixels", text(CSV, "1.6666666666666667", "2400"), CSV, "Cam001.fx", "in pixels?")
case("actorshq", "a NaN", text(CSV, "1.6666666666666667", "nan"), CSV, "Cam001", "finite")
case("actorshq", "half a pixel", text(CSV, "Cam001,12,", "Cam001,12.5,"), CSV, "whole pixels")
case("actorshq", "a centre in millimetres", text(CSV, ",3.0,1.6", ",3000.0,1.6"), CSV, "Cam001", "expected metres")
case("actorshq", "a name that leads out", text(CSV, "Cam001", "../../x"), CSV, "name")

# THuman -----------------------------------------------------------------------------------------------------------------

FIT, MESH, SCAN = "smplx/0001/smplx_param.pkl", "smplx/0001/mesh_smplx.obj", "model/0001/0001.obj"
every("thuman", FIT, "pickle", whole=True)
case("thuman", "a pickle that runs code", evil_pickle(FIT), "smplx_param.pkl", "refused")
case(
    "thuman",
    "a pickle that fills the memory",
    lambda f: (f / FIT).write_bytes(b"\x80\x04]" + b"2" * 0 + b"(" + b"\x8e" + (1 << 60).to_bytes(8, "little")),
    "smplx_param.pkl",
)
case("thuman", "a pickle of a list", lambda f: (f / FIT).write_bytes(pickle.dumps([1])), "smplx_param.pkl", "dict")
for key in ("scale", "global_orient", "body_pose", "left_hand_pose", "betas", "expression"):
    case("thuman", f"{key} missing", pkl(FIT, **{key: None}), "smplx_param.pkl", key, "missing")
case("thuman", "neither transl nor translation", pkl(FIT, transl=None), "smplx_param.pkl", "transl")
case("thuman", "both of them", lambda f: pkl_add(f, translation=np.zeros((1, 3))), "smplx_param.pkl", "either transl")
case("thuman", "a NaN", pkl(FIT, body_pose=spoiled(np.nan)), "smplx_param.pkl", "body_pose", "finite")
case("thuman", "a scale of 0", pkl(FIT, scale=lambda x: 0 * x), "smplx_param.pkl", "scale", "positive")
case("thuman", "a negative scale", pkl(FIT, scale=lambda x: -x), "smplx_param.pkl", "scale", "positive")
case("thuman", "two scales", pkl(FIT, scale=lambda x: np.ones(2)), "smplx_param.pkl", "scale", "(2,)")
case("thuman", "hands of 6 numbers", pkl(FIT, left_hand_pose=lambda x: x[:, :6]), "left_hand_pose", "45", "6")
case(
    "thuman",
    "hands of two kinds",
    lambda f: pkl_at(f, "smplx/0000/smplx_param.pkl", right_hand_pose=np.zeros((1, 45), np.float32)),
    "right_hand_pose",
    "12 or 45",
)
case("thuman", "no leading axis", pkl(FIT, body_pose=lambda x: x[0]), "smplx_param.pkl", "body_pose", "(63,)")
case("thuman", "degrees", pkl(FIT, global_orient=lambda x: np.rad2deg(x) + 90), "global_orient", "another unit?")
case("thuman", "millimetres", pkl(FIT, transl=lambda x: 1000 * x + 500), "transl", "another unit?")
case(
    "thuman",
    "jaw and left eye exchanged with the root",
    lambda f: pkl_swap(f, "jaw_pose", "global_orient"),
    "mesh_smplx.obj",
    "mm from this mesh",
)
case(
    "thuman",
    "left and right hands exchanged",
    lambda f: pkl_swap(f, "left_hand_pose", "right_hand_pose"),
    "mesh_smplx.obj",
    "mm from this mesh",
)
every("thuman", MESH, "")
case("thuman", "no fitted mesh", removed(MESH), "mesh_smplx.obj", "no such file")
case("thuman", "a mesh of another model", text(MESH, "v ", "v 0 0 0\nv "), "mesh_smplx.obj", "81 vertices")
case("thuman", "a mesh in other units", lambda f: scale_obj(f / MESH, 1000), "mesh_smplx.obj", "mm from this mesh")
case("thuman", "text in a vertex", text(MESH, "v ", "v x y z\nv "), "mesh_smplx.obj", "line 1")
case("thuman", "a NaN in a vertex", text(MESH, "v ", "v nan 0 0\nv "), "mesh_smplx.obj", "finite")
case("thuman", "a face of vertices that are not there", text(MESH, "f ", "f 1 2 900\nf "), "mesh_smplx.obj", "900")
every("thuman", SCAN, "", whole=True)
every("thuman", "model/0001/material0.jpeg", "image")
case("thuman", "no texture", removed("model/0001/material0.jpeg"), "0001.obj", "texture")
case("thuman", "no material", removed("model/0001/material0.mtl"), "0001.obj", "texture")
case(
    "thuman",
    "a texture outside of the folder",
    text("model/0001/material0.mtl", "material0.jpeg", "../0000/material0.jpeg"),
    "0001.obj",
)
case("thuman", "a scan with a NaN", text(SCAN, "v ", "v nan 0 0\nv "), "0001.obj")
case("thuman", "no folder model", lambda f: (f / "model").rename(f / "models"), "model", "no such folder")


def pkl_at(folder, path, **values):
    content = pickle.loads((folder / path).read_bytes())
    (folder / path).write_bytes(pickle.dumps(content | values))


def pkl_add(folder, **values):
    pkl_at(folder, FIT, **values)


def pkl_swap(folder, one, other):
    content = pickle.loads((folder / FIT).read_bytes())
    pkl_at(folder, FIT, **{one: content[other], other: content[one]})


def scale_obj(path, factor):
    lines = [line.split() for line in path.read_text().splitlines()]
    scaled = [[w[0], *(str(factor * float(x)) for x in w[1:])] if w[0] == "v" else w for w in lines]
    path.write_text("\n".join(" ".join(words) for words in scaled))


# Scene lists ------------------------------------------------------------------------------------------------------------

LIST, ARRAYS = "train.json", "smpl/0.npz"
every("scenes", LIST, "", whole=True)
every("scenes", ARRAYS, "npz archive", whole=True)
every("scenes", "images/0_1.png", "image", whole=True)
frame = lambda change: jsn(LIST, lambda c: change(c[0]["frames"][1]))
for key in ("image_path", "w2c", "fxfycxcy", "smpl_path"):
    case("scenes", f"no {key}", frame(lambda f, key=key: f.pop(key)), LIST, "s0.frames[1]", key, "missing")
case("scenes", "no frames", jsn(LIST, lambda c: c[0].pop("frames")), LIST, "s0.frames")
case("scenes", "no views", jsn(LIST, lambda c: c[0].update(frames=[])), LIST, "s0.frames")
case("scenes", "no name", jsn(LIST, lambda c: c[0].pop("scene_name")), LIST, "scene_name")
case("scenes", "two scenes of one name", jsn(LIST, lambda c: c.append(c[0])), LIST, "[1].scene_name")
case("scenes", "a number for a path", frame(lambda f: f.update(image_path=3)), LIST, "image_path", "path of a file")
case("scenes", "a path that leads out", frame(lambda f: f.update(image_path="../../x.png")), LIST, "outside")
case("scenes", "arrays that lead out", frame(lambda f: f.update(smpl_path="/etc/hostname")), LIST, "outside")
case("scenes", "w2c of 3 rows", frame(lambda f: f.update(w2c=f["w2c"][:3])), LIST, "w2c", "(3, 4)")
case("scenes", "ragged w2c", frame(lambda f: f["w2c"][1].pop()), LIST, "w2c", "rows")
case("scenes", "a NaN in w2c", frame(lambda f: f["w2c"][0].__setitem__(0, float("nan"))), LIST, "w2c", "finite")
case(
    "scenes",
    "a mirrored w2c",
    frame(lambda f: f["w2c"][0].__setitem__(slice(0, 3), [-v for v in f["w2c"][0][:3]])),
    LIST,
    "frames[1]",
    "mirrored",
)
case("scenes", "c2w with OpenGL's last row", frame(lambda f: f["w2c"].__setitem__(3, [0, 0, 0, 2])), LIST, "last row")
case("scenes", "three intrinsics", frame(lambda f: f.update(fxfycxcy=f["fxfycxcy"][:3])), LIST, "fxfycxcy", "(3,)")
case("scenes", "a negative focal length", frame(lambda f: f["fxfycxcy"].__setitem__(0, -20)), LIST, "focal")
case("scenes", "text for intrinsics", frame(lambda f: f.update(fxfycxcy=["a"] * 4)), LIST, "fxfycxcy", "numbers")
case("scenes", "an object, no list", lambda f: (f / LIST).write_text("{}"), LIST, "list of scenes")
case("scenes", "a scene that is text", lambda f: (f / LIST).write_text('["a"]'), LIST, "[0]")
case("scenes", "no v_cano", npz(ARRAYS, v_cano=None), "0.npz", "v_cano", "missing")
case("scenes", "no joint_transforms", npz(ARRAYS, joint_transforms=None), "0.npz", "joint_transforms", "missing")
case("scenes", "v_cano of another model", npz(ARRAYS, v_cano=lambda x: x[:-1]), "0.npz", "v_cano", "79 vertices")
case("scenes", "v_cano of somebody else", npz(ARRAYS, v_cano=lambda x: x[::-1]), "0.npz", "v_cano", "mm from body")
case(
    "scenes",
    "v_posed for v_cano",
    lambda f: swap_npz(f / ARRAYS, "v_cano", "v_posed"),
    "0.npz",
    "v_cano",
    "mm from body",
)
case("scenes", "a NaN in v_cano", npz(ARRAYS, v_cano=spoiled(np.nan)), "0.npz", "v_cano", "finite")
case(
    "scenes",
    "joints that are no rotation",
    npz(ARRAYS, joint_transforms=lambda x: 2 * x),
    "0.npz",
    "joint_transforms",
    "no rotation",
)
case("scenes", "54 joints", npz(ARRAYS, joint_transforms=lambda x: x[1:]), "0.npz", "joint_transforms", "(54, 4, 4)")
case("scenes", "an object that runs code", object_npz(ARRAYS, "v_cano"), "0.npz", "v_cano", "pickled")
case("scenes", "a bomb", bomb(ARRAYS), "0.npz", "limit")


def swap_npz(path, one, other):
    values = dict(np.load(path))
    np.savez(path, **(values | {one: values[other], other: values[one]}))


# DNA-Rendering ----------------------------------------------------------------------------------------------------------

MAIN, NOTES = "main/0001_01.smc", "annotations/0001_01_annots.smc"


def h5(path, change):
    def damage(folder):
        with h5_or_skip.h5py().File(folder / path, "a") as file:
            change(file)

    return damage


def h5_set(key, change, path=NOTES):
    def replace(file):
        value = np.asarray(file[key])
        del file[key]
        file[key] = change(value)

    return h5(path, replace)


def h5_link(file):
    del file["SMPLx/transl"]
    file["SMPLx/transl"] = h5_or_skip.h5py().ExternalLink("elsewhere.h5", "/x")


for path in (MAIN, NOTES):
    every("dna", path, "HDF5")
case("dna", "no annotations", removed(NOTES), "0001_01_annots.smc")
case("dna", "no cameras", h5(MAIN, lambda f: f.__delitem__("Camera_5mp")), "0001_01.smc", "Camera_5mp")
for key in (
    "SMPLx/fullpose",
    "SMPLx/transl",
    "SMPLx/betas",
    "Camera_Parameter/01/K",
    "Camera_Parameter/01/RT",
    "Camera_Parameter/01/D",
):
    case("dna", f"no {key}", h5(NOTES, lambda f, key=key: f.__delitem__(key)), "annots.smc", key, "missing")
case("dna", "a NaN", h5_set("SMPLx/fullpose", spoiled(np.nan)), "SMPLx/fullpose", "finite")
case("dna", "24 joints", h5_set("SMPLx/fullpose", lambda x: x[:, :24]), "SMPLx/fullpose", "(3, 24, 3)")
case("dna", "degrees", h5_set("SMPLx/fullpose", lambda x: np.rad2deg(x) + 90), "SMPLx/fullpose", "another unit?")
case("dna", "millimetres", h5_set("SMPLx/transl", lambda x: 1000 * x + 500), "SMPLx/transl", "another unit?")
case("dna", "fewer translations", h5_set("SMPLx/transl", lambda x: x[:2]), "SMPLx/transl", "(2, 3)")
case("dna", "text", h5_set("SMPLx/transl", lambda x: b"text"), "SMPLx/transl", "numbers")
case(
    "dna",
    "a group for numbers",
    h5(NOTES, lambda f: (f.__delitem__("SMPLx/transl"), f.create_group("SMPLx/transl"))),
    "SMPLx/transl",
    "numbers",
)
case("dna", "a link into another file", h5(NOTES, h5_link), "SMPLx/transl", "refused a link")
case(
    "dna",
    "numbers of 10^15 bytes",
    h5(
        NOTES,
        lambda f: (f.__delitem__("SMPLx/transl"), f.create_dataset("SMPLx/transl", (10**14,), "f8", chunks=(1000,))),
    ),
    "SMPLx/transl",
    "array_bytes",
)
case("dna", "K of 2 rows", h5_set("Camera_Parameter/00/K", lambda x: x[:2]), "Camera_Parameter/00/K", "(2, 3)")
case("dna", "a scaled RT", h5_set("Camera_Parameter/00/RT", lambda x: 2 * x), "Camera_Parameter/00/RT", "scaled")
case("dna", "a mirrored RT", h5_set("Camera_Parameter/00/RT", lambda x: -x), "Camera_Parameter/00/RT", "mirrored")
case(
    "dna",
    "RT in millimetres",
    h5_set("Camera_Parameter/00/RT", lambda x: np.block([[x[:, :3], 1000 * x[:, 3:] - [[0], [0], [0], [999]]]])),
    "00",
    "expected metres",
)
case(
    "dna",
    "three lens coefficients",
    h5_set("Camera_Parameter/00/D", lambda x: x[:3]),
    "Camera_Parameter/00/D",
    "3 numbers",
)
PHOTO, MASK = "Camera_5mp/0/color/1", "Mask/0/mask/1"
case("dna", "a photo cut off", h5_set(PHOTO, lambda x: x[: len(x) // 2], MAIN), PHOTO, "image")
case("dna", "a photo of other bytes", h5_set(PHOTO, lambda x: x[::-1], MAIN), PHOTO, "image")
case("dna", "a photo of floats", h5_set(PHOTO, lambda x: x.astype(float), MAIN), PHOTO, "encoded bytes")
case("dna", "a mask cut off", h5_set(MASK, lambda x: x[: len(x) // 2]), MASK, "image")
case("dna", "an empty photo", h5_set(PHOTO, lambda x: x[:0], MAIN), PHOTO, "image")
case(
    "dna",
    "no photo at all",
    h5(MAIN, lambda f: [f[f"Camera_5mp/{c}/color"].clear() for c in (0, 1)]),
    "0001_01.smc",
    "no photo",
)


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
def test_damage_is_one_line_that_names_file_and_key(
    layout, damage, words, honest, body, tmp_path, monkeypatch, request
):
    folder = tmp_path / "set"
    shutil.copytree(honest(layout), folder)
    damage(folder)
    monkeypatch.chdir(tmp_path)
    read = read_thuman if layout == "thuman" else read_people
    large = any(word in request.node.name for word in LARGE)
    if large:  # tracing takes several times as long
        tracemalloc.start()
    began = time.process_time()
    try:
        with pytest.raises((FileError, FileNotFoundError)) as caught:
            read(folder, body)
        spent, (_, most) = time.process_time() - began, tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    line = str(caught.value)
    assert "\n" not in line and str(folder) in line
    assert all(word in line for word in words), f"{words} in {line}"
    assert most < MOST_BYTES and spent < MOST_SECONDS
    assert not list(tmp_path.rglob("OWNED"))


@pytest.mark.parametrize("layout", WRITE)
def test_honest_sets_are_read(layout, honest, body):
    read = read_thuman if layout == "thuman" else read_people
    assert read(honest(layout), body) == ({"listed as missing": 1} if layout == "thuman4" else {})


def test_there_are_thirty_kinds_of_damage_to_each_layout():
    counts = {layout: sum(case.values[0] == layout for case in CASES) for layout in WRITE}
    assert min(counts.values()) >= 30, counts


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
    assert len(report.skipped) >= 25
