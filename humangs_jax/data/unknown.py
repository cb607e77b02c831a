"""Describes in words, for errors, a file that no reader of calibrations knows."""

import re
from pathlib import Path

from humangs_jax.data.capture_checks import few
from humangs_jax.io.reading import open_file

BINARIES = {
    b"\x93NUMPY": "an array of NumPy, such as annots.npy of ZJU-MoCap",
    b"PK\x03\x04": "an archive (.npz, .zip)",
    b"\x89HDF": "an HDF5 file (.h5, .mat)",
    b"MATLAB 5": "a file of MATLAB",
    b"\x80": "a pickle",
}
"""First bytes of files that somebody may take for a calibration -> the kind of the file."""
HEAD = 4096
"""`binary_kind` reads this many bytes at the beginning of a file."""
INTRINSICS = (
    "camera_matrix",
    "cameraMatrix",
    "CameraMatrix",
    "camera matrix",
    "Camera_Matrix",
    "intrinsic_matrix",
)
"""Keys under which programs write the lens of a single camera."""
CONVERTED = {
    ("<document", "<chunk"): "cameras of Metashape (File > Export > Export Cameras > Colmap)",
    ("#name,x,y,alt",): "cameras of RealityScan (export the registration as COLMAP)",
    ("xcr:Position",): "cameras of RealityScan (export the registration as COLMAP)",
    ("<opencv_storage>",): "OpenCV's XML (write .yml or .json with cv2.FileStorage)",
    ('"shots"', '"cameras"'): "a model of OpenSfM (`opensfm export_colmap` converts it)",
    ('"poseId"', '"intrinsicId"'): "a model of Meshroom (`aliceVision_exportColmap` converts it)",
}
"""Words in calibrations that are not read -> the kind of the calibration, and how to convert it to
a format that is read.
"""
POSE = re.compile(r"extrinsics?|rotation|translation|[rt]vecs?|[RT]", re.IGNORECASE)
"""Matches the keys of the place and the rotation of a camera."""
PARTS = ("rows", "cols", "dt", "data")
"""Keys inside of OpenCV's matrices. They do not tell what kind of file it is."""
KEY = re.compile(r"""^[ \t]*["']?([A-Za-z_][\w .-]*?)["']?[ \t]*[:=]""", re.MULTILINE)
"""A key of JSON, YAML or TOML at the beginning of a line."""
KEYS_SHOWN = 6
"""Largest number of keys that an error names."""


def binary_kind(file: Path) -> str | None:
    """Returns the kind of a binary file in words; None for a file of text.

    Raises: as `io.reading.open_file`.
    """
    with open_file(file) as opened:
        head = opened.read(HEAD)
    known = (kind for start, kind in BINARIES.items() if head.startswith(start))
    wide = head.startswith((b"\xff\xfe", b"\xfe\xff"))
    return next(known, "a binary file" if b"\0" in head and not wide else None)


def described(text: str) -> str:
    """Returns in words what a text that is no calibration seems to be; "" for an empty text."""
    if not text.strip():
        return ""
    keys = KEY.findall(text.replace("{", "\n").replace(",", "\n"))
    if "T_cn_cnm1" in keys or ("distortion_model" in keys and "intrinsics" in keys):
        return (
            "a camchain of Kalibr: write R and T of each camera into calibration.json,"
            " docs/cameras.md"
        )
    if any(key in INTRINSICS for key in keys) and not any(map(POSE.fullmatch, keys)):
        return (
            "the lens of one camera, without where it stands: K, R and T of each camera are needed"
        )
    for words, advice in CONVERTED.items():
        if all(word in text for word in words):
            return advice
    names = list(dict.fromkeys(key for key in keys if key not in PARTS))
    if names:
        return f"it has the keys {few(names, KEYS_SHOWN)}"
    return f"a text that begins with {text.split()[0][:40]!r}"
