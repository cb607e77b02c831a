"""Arrays of avatars, bodies, motions, fits and banks: not finite, out of range, of other types and
shapes.
"""

import io
import json
import tempfile
from pathlib import Path

import dataset_files
import honest_files as honest
import numpy as np
from hostile_cases import capture_with, case, written
from readers import AMASS

from humangs_jax.body.library import save_body

# Avatars and other arrays
# ---------------------------------------------------------------------------------------------


def arrays_case(kind, reader, arrays, change, item=7, expect="refused"):
    def make(folder):
        content = arrays()
        change(content)
        np.savez(folder / "a.npz", **content)
        return folder / "a.npz"

    case(kind, reader, make, expect, item)


def put(name, value, index=(0,)):
    def change(arrays):
        arrays[name] = np.array(arrays[name])
        arrays[name][index] = value

    return change


def to(**values):
    return lambda arrays: arrays.update(values)


def full(name, value, dtype=None):
    return lambda arrays: arrays.update({name: np.full_like(arrays[name], value, dtype)})


def cast(name, dtype):
    return lambda arrays: arrays.update({name: np.asarray(arrays[name]).astype(dtype)})


def header(**changes):
    return to(header=json.dumps(honest.AVATAR_HEADER | changes))


AVATARS = {
    **{f"NaN in {name}": put(name, np.nan) for name in honest.avatar_arrays() if name != "faces"},
    **{f"inf in {name}": put(name, -np.inf) for name in honest.avatar_arrays() if name != "faces"},
    "opacity 9": put("opacities", 9.0),
    "opacity -1": put("opacities", -1.0),
    "a negative scale": put("scales", -0.1),
    "a skinning weight of -3": put("skinning_weights", -3.0),
    "a corner of 2^30": put("faces", 1 << 30),
    "a corner of -1": put("faces", -1),
    "corners of half": cast("faces", np.float32),
    **{
        f"complex {name}": cast(name, np.complex64)
        for name in ("means", "colors", "skinning_weights")
    },
    "words": cast("means", str),
    "bytes": cast("colors", "S4"),
    "too large for float32": to(means=np.full((6, 3), 1e300)),
    "a circle of parents": header(parents=[-1, 2, 1]),
    "a parent that is not there": header(parents=[-1, 7, 0]),
    "two roots": header(parents=[-1, -1, 0]),
    "parents of words": header(parents=["a", "b", "c"]),
    "10^6 parents": header(parents=[-1] + [0] * 10**6),
    "parents that are a number": header(parents=3),
    "names of numbers": header(joint_names=[1, 2, 3]),
    "too few names": header(joint_names=["a"]),
    "another skinning": header(skinning="exec"),
    "another rendering": header(rendering=["exact"]),
    "a list for a header": to(header="[]"),
    "a deep header": to(header="[" * 50_000),
    "an array for a header": to(header=np.zeros(5)),
    "a false checksum": header(checksum="0" * 64),
    "a checksum that is a number": header(checksum=7),
    "no points": to(means=np.float32(3)),
    "means of 3e38": put("means", 3e38),
    "colors of 3e38": put("colors", 3e38),
    "scales of 1e30": put("scales", 1e30),
    "quaternions of 1e30": put("quats", 1e30),
    "joints a light year away": put("rest_joints", 1e16),
    "weights of 0": full("skinning_weights", 0),
    "weights of 1 each": full("skinning_weights", 1),
    "no vertices": to(rest_vertices=np.zeros((0, 3), np.float32), faces=np.zeros((0, 3), np.int32)),
    "no joints": to(rest_joints=np.zeros((0, 3), np.float32)),
    "a title for a joint": header(joint_names=["a", "b", "\x1b]0;OWNED\x07"]),
    "a new line for a joint": header(joint_names=["a", "b", "a\nb"]),
    "half a surrogate for a joint": header(joint_names=["a", "b", "\ud800"]),
}
for kind, change in AVATARS.items():
    item = 3 if "checksum" in kind else 7
    arrays_case(kind, "avatar", honest.avatar_file, change, item)
arrays_case("without a checksum", "avatar", honest.avatar_file, lambda arrays: None, 3, "read")


def body_file():
    with tempfile.TemporaryDirectory() as folder:
        save_body(Path(folder) / "b.npz", honest.tiny_body())
        with np.load(Path(folder) / "b.npz") as archive:
            return dict(archive)


BODIES = {
    "corners outside": put("faces", 99),
    "joints outside": put("weight_joints", 99),
    "vertices outside": put("regressor_vertices", 99),
    "NaN in the template": put("template", np.nan),
    "NaN in the regressor": put("regressor_values", np.nan),
    "weights of 0": full("weight_values", 0),
    "a circle of parents": put("parents", 1),
    "10^6 parents": to(parents=np.zeros(10**6, np.int16)),
    "directions of another size": to(shape_directions=np.zeros((3, 9, 3), np.int16)),
    "a number for the template": to(template=np.float32(1)),
    "a template of 1e38": put("template", 1e38),
    "directions of 1e38": to(shape_directions=np.full((3, 4, 3), 1e38, np.float32)),
    "a regressor of 1e38": put("regressor_values", 1e38),
}
for kind, change in BODIES.items():
    arrays_case(kind, "body", body_file, change, 7)
SMPLX = {
    "corners outside": put("f", 99),
    "NaN": put("v_template", np.nan),
    "objects": full("v_template", None, object),
    "another tree": put("kintree_table", 9, (0, 3)),
    "words": cast("weights", str),
    "no vertices": to(v_template=np.zeros((0, 3))),
    "a template of 1e38": put("v_template", 1e38),
    "directions of 1e300": full("shapedirs", 1e300, float),
    "weights of 0": full("weights", 0),
    "weights of 1e38": put("weights", 1e38),
    "a regressor of 1e38": put("J_regressor", 1e38),
}
for kind, change in SMPLX.items():
    arrays_case(kind, "smplx npz", dataset_files.model_arrays, change, 7)
MOTION = {
    "NaN": put("poses", np.nan),
    "a rate of 0": to(mocap_framerate=0.0),
    "a rate of NaN": to(mocap_framerate=np.nan),
    "a rate of words": to(mocap_framerate=np.asarray("fast")),
    "no frames": to(poses=np.zeros((0, 156)), trans=np.zeros((0, 3))),
    "complex numbers": cast("poses", complex),
    "another number of frames": to(trans=np.zeros((9, 3))),
}
for kind, change in MOTION.items():
    arrays_case(kind, "amass", AMASS.copy, change, 6)
FITS = {
    "another set": to(set=np.asarray("mine")),
    "NaN": put("points", np.nan),
    "names of numbers": to(names=np.zeros(2)),
    "a shape that does not fit": to(points=np.zeros((2, 3, 2))),
    "one name": to(names=np.asarray("x")),
}
for kind, change in FITS.items():
    for reader, arrays in (
        ("fit record", honest.fit_arrays),
        ("keypoints npz", honest.keypoint_arrays),
    ):
        arrays_case(
            kind,
            reader,
            arrays,
            change,
            6,
            "either" if kind in ("NaN", "names of numbers") else "refused",
        )
BANKS = {
    "a seed of another split": put("seeds", 10**9),
    "seeds below 0": put("seeds", -5),
    "another version": to(version=np.asarray(99)),
    "a version of words": to(version=np.asarray("x")),
    "no seeds": to(seeds=np.asarray("x")),
    "NaN": put("vertices", np.nan),
    "corners outside": put("faces", 60_000),
    "another number of people": to(betas=np.zeros((9, 3), np.float32)),
    "complex numbers": cast("texture", complex),
}
for kind, change in BANKS.items():
    arrays_case(kind, "bank", honest.bank_arrays, change, 7)


for value in (1e38, 1e300, 1e9):
    for key in ("rotations", "translations"):
        arrays_case(f"{key} of {value:g}", "motion npz", honest.motion_arrays, put(key, value))
    for key in ("poses", "trans"):
        arrays_case(f"{key} of {value:g}", "amass", AMASS.copy, put(key, value))


def written_array(name, value):
    stream = io.BytesIO()
    np.save(stream, value, allow_pickle=True)
    return written(name, stream.getvalue())


ROWS = {
    "no axes": np.asarray(1.0),
    "no rows of 322": np.zeros((0, 322)),
    "no columns": np.zeros((9, 0)),
    "seven axes": np.zeros((1,) * 7),
    "matrices of NaN": np.full((3, 22, 3, 3), np.nan),
    "infinite rows": np.full((3, 322), np.inf),
    "rows of words": np.full((3, 72), "x"),
    "complex rows": np.ones((3, 72), complex),
    "rows of 10^300": np.full((3, 322), 1e300),
    "joints of no frames": np.zeros((0, 22, 3)),
    "300,000 rows": np.zeros((300_000, 72), np.float32),
}
for kind, rows in ROWS.items():
    case(kind, "motion x", written_array("m.npy", rows), item=5 if "," in kind else 6)
SIX = {
    "one axis": {"thetas": np.zeros(6)},
    "no joints": {"thetas": np.zeros((0, 6, 3))},
    "no frames": {"thetas": np.zeros((24, 6, 0))},
    "words for rotations": {"thetas": np.full((24, 6, 3), "x")},
    "first rows that are parallel": {"thetas": np.ones((24, 6, 3))},
    "places of another shape": {"root_translation": np.zeros((2, 2, 2))},
    "a word for a place": {"root_translation": "x"},
    "a dict for rotations": {"thetas": {}},
}
for kind, change in SIX.items():
    case(kind, "mdm", written_array("m.npy", honest.MDM | change), item=6)
TURNS = {
    "zeros for matrices": {"local_rot_mats": np.zeros((3, 22, 3, 3))},
    "23 joints": {"local_rot_mats": np.tile(np.eye(3), (3, 23, 1, 1))},
    "matrices of four rows": {"local_rot_mats": np.zeros((3, 22, 4, 4))},
    "one place": {"root_positions": np.zeros(3)},
}
for kind, change in TURNS.items():
    arrays_case(
        kind, "kimodo", lambda change=change: honest.KIMODO | change, lambda arrays: None, 6
    )


def body_of(key, value):
    arrays = honest.body_parameters()
    arrays[key] = np.full(arrays[key].shape, value)
    return capture_with(prepare=lambda folder: np.savez(folder / "body.npz", **arrays))


for value in (1e38, 1e300, -1e20, 1e6):
    for key in ("betas", "rotations", "translations", "displacement"):
        case(f"{key} of {value:g}", "capture", body_of(key, value))

RATES = {"10^9": 1e9, "10^-9": 1e-9, "10^300": 1e300, "10^-300": 1e-300, "1,001": 1001.0}
for kind, rate in RATES.items():
    for reader in ("filmed", "motion npz"):
        arrays_case(f"a rate of {kind}", reader, honest.motion_arrays, to(fps=np.asarray(rate)), 5)
MANY = {
    "300,000 frames": {
        "rotations": np.zeros((300_000, 55, 3), np.float32),
        "translations": np.zeros((300_000, 3), np.float32),
    },
    "9,000 frames of 100 seconds each": {
        "rotations": np.zeros((9000, 55, 3)),
        "translations": np.zeros((9000, 3)),
        "fps": 0.01,
    },
}
for kind, changes in MANY.items():
    arrays_case(
        kind,
        "filmed",
        lambda changes=changes: honest.motion_arrays(**changes),
        lambda arrays: None,
        5,
    )
