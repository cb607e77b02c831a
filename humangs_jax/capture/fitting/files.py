"""Reads and writes the files of fits: fit.npz and fit.json beside the body.npz of a capture.

fit.npz has the input of a fit to keypoints, and the uncertainty of its result:

    set, names (v,), points (v, k, 2), confidences (v, k)    the keypoints, as
                                                             `humangs_jax.capture.keypoints` stores
                                                             them
    noise (m,)               std of the detections, pixels
    joint_std (m, j)         std of the joints' positions, metres
    determined (m, j)        share of each joint's rotation that the views determine
    shape_covariance (s, s)
    places (k, 3)            offsets of the set's landmarks that the fit found, metres
    certainty (k,)           weights of the set's landmarks that the fit found

fit.json is the report (`FitReport.to_json`).
"""

import dataclasses
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.body.landmarks import usual_certainty
from humangs_jax.capture.fitting.report import FitReport
from humangs_jax.capture.keypoints.keypoints import KEYPOINT_SETS, Keypoints
from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture import Capture, capture_parameters
from humangs_jax.data.capture_checks import CaptureError, few, numbers
from humangs_jax.data.photos import capture_folder, read_description
from humangs_jax.io.arrays import ArrayFile, write_npz
from humangs_jax.io.atomic import add_files, check_replaceable, check_writable, replace_folder
from humangs_jax.io.reading import reading, write_json

FIT_FILE = "fit.npz"
"""Name of the file with the input of a fit to keypoints and the uncertainty of its result."""
_FOUND = ("noise", "joint_std", "determined", "shape_covariance")
"""Keys of fit.npz that are fields of `FitRecord`."""
KEYS = ("set", "names", "points", "confidences", *_FOUND, "places", "certainty")
"""All keys of fit.npz."""


# fit.npz
# --------------------------------------------------------------------------------------------------


class UnknownViewError(ValueError):
    """The capture has views that its fit.npz does not have, for example because photos were added
    later.
    """


@dataclasses.dataclass(frozen=True, eq=False)
class FitRecord:
    """The contents of fit.npz: v views, m frames, j joints, s shape coefficients."""

    keypoints: Keypoints
    """Keypoints of the v views. Their set has the places and certainties that the fit found."""
    names: tuple[str, ...]
    """Names of the v views."""
    noise: Float[np.ndarray, " m"]
    """Standard deviation of the detections in each frame, (m,), pixels."""
    joint_std: Float[np.ndarray, "m j"]
    """Standard deviations of the joints' positions, (m, j), metres, see `Uncertainty.joint_std`."""
    determined: Float[np.ndarray, "m j"]
    """Share of each joint's rotation that the views determine, (m, j)."""
    shape_covariance: Float[np.ndarray, "s s"]
    """Covariance of the shape coefficients, (s, s)."""

    def of_views(self, names: Sequence[str]) -> Keypoints:
        """Returns the keypoints of the named views, in their order.

        Raises: UnknownViewError if the record does not have one of the names.
        """
        missing = [name for name in names if name not in self.names]
        if missing:
            raise UnknownViewError(f"the capture's fit knows no view {few(missing)}: fit it again")
        rows = [self.names.index(name) for name in names]
        return dataclasses.replace(
            self.keypoints,
            points=self.keypoints.points[rows],
            confidences=self.keypoints.confidences[rows],
        )


def _write_fit_record(path: str | Path, record: FitRecord) -> None:
    """Writes fit.npz. If writing fails, an old file at the path stays as it was."""
    kind = record.keypoints.set
    arrays = {
        "set": np.asarray(kind.name),
        "names": np.asarray(record.names),
        "points": record.keypoints.points.astype(np.float32),
        "confidences": record.keypoints.confidences.astype(np.float32),
        **{key: np.asarray(getattr(record, key), np.float32) for key in _FOUND},
        "places": kind.offsets.astype(np.float32),
        "certainty": np.asarray(kind.certainty or usual_certainty(kind.names), np.float32),
    }
    write_npz(path, arrays, compressed=False)


def read_fit_record(path: str | Path) -> FitRecord:
    """Reads fit.npz.

    Raises: CaptureError, which names the file, and the key if one is missing or has wrong values.
    """
    path = Path(path)
    with reading(path, "fit.npz", CaptureError):
        file = ArrayFile.open(path, CaptureError)
        missing = [key for key in KEYS if key not in file and key not in file.pickled]
        if missing:
            raise CaptureError(
                path, missing[0], "missing: expected a file that `humangs fit` wrote"
            )

        def own(key: str, shape: tuple[int | None, ...] | None = None) -> np.ndarray:
            """Returns the numbers under a key."""
            return numbers(file.array(key), path, key, shape)

        # the set says how many keypoints the arrays have to have
        name, names = str(file.array("set")), tuple(map(str, file.array("names")))
        if name not in KEYPOINT_SETS:
            raise CaptureError(
                path, "set", f"expected one of {', '.join(KEYPOINT_SETS)}, got {name!r}"
            )
        kind = KEYPOINT_SETS[name]
        v, k = len(names), len(kind.names)
        kind = kind.adapted(own("places", (k, 3)), own("certainty", (k,)))
        keypoints = Keypoints(own("points", (v, k, 2)), own("confidences", (v, k)), kind)
        # the number of frames is that of the noise; the other arrays have to agree
        noise = own("noise", (None,))
        joint_std = own("joint_std", (len(noise), None))
        return FitRecord(
            keypoints,
            names,
            noise,
            joint_std,
            own("determined", joint_std.shape),
            own("shape_covariance"),
        )


# Captures
# --------------------------------------------------------------------------------------------------


def check_place(
    source: str | Path,
    out: str | Path | None,
    overwrite: bool,
    inputs: Iterable[str | Path | None] = (),
) -> Path:
    """Returns the folder to which a fit of the capture `source` will be written. Checks that the
    fit can be written there.

    Arguments: out: the folder. None: the capture folder itself, in which body and cameras are
    replaced. overwrite: whether an existing fit may be replaced. inputs: further files and folders
    that the fit reads. Entries of None are ignored. If `out` is another folder, the capture, its
    photos and the inputs must not lie in it.
    Raises: CaptureError if the capture.json of `source` cannot be read or is invalid. ArgumentError
    if the fit is written into the capture folder, a body is there, and `overwrite` is False. For
    another folder, ValueError as in `check_replaceable`. OSError if the place cannot be written to.
    """
    source = capture_folder(source)
    target = source if out is None else Path(out)
    description = read_description(source / "capture.json")
    body = target / description["body"]
    if target.resolve() != source.resolve():
        photos = (source / file for file in _photo_files(description))
        check_replaceable(target, overwrite, "capture.json", (source, *inputs, *photos))
    elif body.exists() and not overwrite:
        raise ArgumentError("overwrite", f"is needed: {body} exists; or another folder for the fit")
    check_writable(target)
    return target


def _photo_files(description: dict[str, Any]) -> list[str]:
    """Returns the names of a capture's images, masks and files of unknown pixels, sorted. They are
    as in the description, which is the content of capture.json.
    """
    kinds = ("image", "mask", "unknown")
    return sorted({view[key] for view in description["views"] for key in kinds if key in view})


def write_fitted(
    source: str | Path,
    target: str | Path,
    capture: Capture,
    report: FitReport,
    record: FitRecord | None = None,
) -> None:
    """Writes cameras, body and report of a capture. If `target` is the capture folder `source`,
    the files are written into it. If not, the folder `target` is replaced, and also gets copies of
    the images, masks and files of unknown pixels.

    Arguments: record: record of a fit to keypoints. If it is None, the target has no fit.npz
    afterwards, because an old fit.npz belongs to other cameras.
    Raises: CaptureError if the capture.json of `source` cannot be read or is invalid, or if a photo
    would be copied to a place outside of `target`. ValueError if another folder cannot be replaced,
    see `check_replaceable`. OSError if writing fails.
    """
    source, target = capture_folder(source), Path(target)
    description = read_description(source / "capture.json")
    contents = {"capture.json": _with_cameras(description, capture), "fit.json": report.to_json()}
    name, arrays = description["body"], capture_parameters(target, capture)

    def write_fit(folder: Path):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_npz(folder / name, arrays, compressed=False)
        for file, content in contents.items():
            write_json(folder / file, content)
        if record is not None:
            _write_fit_record(folder / FIT_FILE, record)

    def write(folder: Path):
        folder.mkdir()
        for file in _photo_files(description):
            _copy(source, folder, file)
        write_fit(folder)

    if target.resolve() == source.resolve():
        # without a record, the one that is there is of other cameras; the body comes last, because
        # `humangs start` asks for it
        invalid = () if record is not None else (FIT_FILE,)
        add_files(target, write_fit, invalid=invalid, last=name)
    else:
        check_place(source, target, overwrite=True)
        replace_folder(target, write, mark="capture.json")


def _with_cameras(description: dict[str, Any], capture: Capture) -> dict[str, Any]:
    """Returns the contents of capture.json, with the cameras and frames of `capture`. Matrices that
    have not changed are copied from `description`, so that they keep all digits.
    """
    views = []
    for i, view in enumerate(description["views"]):
        new = {
            name: np.asarray(getattr(capture.cameras, name), float)[i]
            for name in ("K", "cam_from_world")
        }
        same = {
            name: np.array_equal(np.asarray(view[name], np.float32), value)
            for name, value in new.items()
        }
        changed = {name: value.tolist() for name, value in new.items() if not same[name]}
        frame = int(capture.frames[i])
        if view.get("frame", 0) != frame:
            changed["frame"] = frame
        views.append(view | changed)
    return description | {"views": views}


def _copy(source: Path, folder: Path, file: str) -> None:
    target = folder / file
    if not target.resolve().is_relative_to(folder.resolve()):
        raise CaptureError(
            source / "capture.json", file, "lies outside of the capture folder: fit it in place"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source / file, target)
