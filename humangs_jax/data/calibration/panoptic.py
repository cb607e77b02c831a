"""CMU Panoptic's calibrations: a list `cameras` of K, distCoef, R, t (centimetres) and resolution."""

from humangs_jax.data.calibration.calibration import Calibration, Source
from humangs_jax.data.calibration.opencv import one_camera
from humangs_jax.data.capture_checks import expect
from humangs_jax.data.formats import CameraFormat

KEYS = {"K": "K", "distCoef": "dist", "R": "R", "t": "T", "T": "T", "resolution": "imgSize"}


def recognizes(source: Source) -> bool:
    """Whether a file has a list of cameras."""
    return isinstance(source.json, dict) and isinstance(source.json.get("cameras"), list) and "frames" not in source.json


def read(source: Source, format: CameraFormat) -> Calibration:
    """The cameras of the list. Raises: CaptureError naming the key."""
    cameras, file = [], source.path
    for i, entry in enumerate(source.json["cameras"]):
        expect(entry, dict, file, f"cameras[{i}]")
        values = {ours: entry[theirs] for theirs, ours in KEYS.items() if theirs in entry}
        field = lambda name, i=i: f"cameras[{i}].{ {'T': 't', 'dist': 'distCoef', 'imgSize': 'resolution'}.get(name, name) }"
        cameras.append(one_camera(str(entry.get("name", i)), values, values, (file, file), field))
    return source.calibration(format, cameras)
