"""Our own keypoint file: an npz of points (v, k, 2), confidences (v, k), the set's name, and the names of the v views.

Unlike in all other formats the centre of the first pixel is at (0.5, 0.5).
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.keypoints.detections import DetectedImage, Detections, floats
from humangs_jax.data.keypoints.keypoints import Keypoints
from humangs_jax.data.keypoints.sets import KEYPOINT_SETS
from humangs_jax.io.atomic import replace_file
from humangs_jax.io.npz import read_npz

_KEYS = ("points", "confidences", "set", "names")


def save_keypoints(path: str | Path, keypoints: Keypoints, names: Sequence[str]) -> None:
    """Write our own format (.npz). names: of the views, as in the capture. `read_keypoints` reads exactly these back.

    Raises: ValueError if the path does not end in .npz, or there is not one name per view.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{path}: expected a name ending in .npz")
    if len(names) != len(keypoints.points):
        raise ValueError(f"names: expected one for each of {len(keypoints.points)} views, got {len(names)}")

    def write(temporary: Path) -> None:
        np.savez_compressed(
            temporary,
            points=np.asarray(keypoints.points, np.float32),
            confidences=np.asarray(keypoints.confidences, np.float32),
            set=np.asarray(keypoints.set.name),
            names=np.asarray(list(names), np.str_),
        )

    replace_file(path, write)


def saved_detections(file: Path) -> Detections:
    """What `save_keypoints` wrote: one person in each image.

    Raises: CaptureError.
    """
    try:
        values, pickled = read_npz(file)
    except OSError as error:
        raise CaptureError(file, "", error.strerror or error) from error
    for key in _KEYS:
        if key not in values:
            raise CaptureError(file, key, "a pickled object, which is never read" if key in pickled else "missing")
    name = str(values["set"])
    if name not in KEYPOINT_SETS:
        raise CaptureError(file, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}")
    views, k = [str(view) for view in values["names"].reshape(-1)], len(KEYPOINT_SETS[name].names)
    points, confidences = (floats(values[key], file, key) for key in ("points", "confidences"))
    for key, array, shape in (("points", points, (len(views), k, 2)), ("confidences", confidences, (len(views), k))):
        if array.shape != shape:
            raise CaptureError(file, key, f"expected shape {shape}, views x points of {name}, got {array.shape}")
    people = np.concatenate([points, confidences[..., None]], axis=-1)
    images = tuple(DetectedImage(view, file, (person,)) for view, person in zip(views, people, strict=True))
    return Detections(KEYPOINT_SETS[name], images, offset=0.0)
