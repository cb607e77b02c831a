"""ActorsHQ: videos of 8 actors, 160 cameras (https://actors-hq.com; calibration as HumanRF's reader has it).

    ActorNN/SequenceN/{1x,2x,4x}/calibration.csv
                                 rgbs/CamNNN/CamNNN_rgb%06d.jpg (background removed)    masks/CamNNN/CamNNN_mask%06d.png
    ActorNN/SequenceN/smpl_params.npz

The csv has name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py: rotation vector and centre of world_from_cam in metres with OpenCV's axes,
focal lengths and principal point as shares of width and height. Each scale has its own csv. Portrait and landscape are mixed.
The data set has no bodies; the authors of Animatable Gaussians offer smpl_params.npz of some sequences.
"""

import csv
import io
import re
from pathlib import Path

import numpy as np

from humangs_jax.data.calibration.calibration import CalibratedCamera, Calibration, pose_matrix
from humangs_jax.data.capture_checks import CaptureError, checked_text
from humangs_jax.data.datasets.bodies import FileBody, checked_numbers
from humangs_jax.data.datasets.multiview import PARAMETERS, checked_cameras, folder_subject, read_parameters, subfolders
from humangs_jax.data.datasets.subject import Subject
from humangs_jax.io.reading import limits, reading

CALIBRATION, SCALES = "calibration.csv", ("4x", "2x", "1x")
COLUMNS = ["w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py"]


def find_actorshq(folder: str | Path) -> tuple[Path, ...]:
    """The sequences in a folder (of one actor or of several), sorted, or the folder itself; empty if there are none."""
    return subfolders(folder, lambda path: any((path / scale / CALIBRATION).is_file() for scale in SCALES), depth=2)


def open_actorshq(folder: str | Path, body: FileBody) -> Subject:
    """One sequence, in the smallest images that are there.

    Raises: CaptureError naming file and key.
    """
    folder = Path(folder)
    scale = next((s for s in SCALES if (folder / s / CALIBRATION).is_file()), SCALES[0])
    cameras = read_csv_cameras(folder / scale / CALIBRATION)
    places = [(folder / scale / "rgbs" / camera.name, folder / scale / "masks" / camera.name) for camera in cameras]
    named = re.compile(r"[\w-]+_(?:rgb|mask)(\d+)")
    frame_of = lambda stem: int(found[1]) if (found := named.fullmatch(stem)) else None
    return folder_subject(folder, cameras, places, read_parameters(folder / PARAMETERS, body), frame_of=frame_of)


def read_csv_cameras(file: Path) -> tuple[CalibratedCamera, ...]:
    """The cameras of a csv. Raises: CaptureError naming file, camera and column."""
    from scipy.spatial.transform import Rotation

    with reading(file, "csv file", CaptureError):
        rows = list(csv.DictReader(io.StringIO(checked_text(file))))
    cameras = []
    for number, row in enumerate(rows, 2):
        name = row.get("name")
        if not name or not re.fullmatch(r"[\w-]+", name) or any(camera.name == name for camera in cameras):
            raise CaptureError(file, f"line {number}: name", f"expected the name of a camera of its own, got {name!r}")
        values = {}
        for key in COLUMNS:
            try:
                values[key] = float(row[key])
            except (KeyError, TypeError, ValueError):
                raise CaptureError(file, f"{name}.{key}", f"expected a number, got {row.get(key)!r}") from None
        checked_numbers(list(values.values()), file, name, (len(COLUMNS),), largest=float(limits().side))
        width, height = values["w"], values["h"]
        if width % 1 or height % 1 or min(width, height) <= 0:
            raise CaptureError(file, f"{name}.w", f"expected whole pixels, got {width:g} x {height:g}")
        if max(values["fx"], values["fy"]) > 100:
            raise CaptureError(file, f"{name}.fx", f"expected a share of the width, got {values['fx']:g}: in pixels?")
        K = np.diag([values["fx"] * width, values["fy"] * height, 1.0])
        K[:2, 2] = values["px"] * width, values["py"] * height
        turn = Rotation.from_rotvec([values[key] for key in ("rx", "ry", "rz")]).as_matrix().T
        center = np.asarray([values[key] for key in ("tx", "ty", "tz")])
        cameras.append(CalibratedCamera(name, K, pose_matrix(turn, -turn @ center), int(width), int(height)))
    if not cameras:
        raise CaptureError(file, "", f"no camera: expected the columns name,{','.join(COLUMNS)}")
    return checked_cameras(Calibration("ActorsHQ", file, tuple(cameras), False, "half", "+y"))
