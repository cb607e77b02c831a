"""DNA-Rendering: videos of people, 60 cameras, in HDF5 (https://dna-rendering.github.io; as the official SMCReader has it).

    main/NAME.smc                 Camera_5mp/0..47/color/FRAME, Camera_12mp/48..59/color/FRAME: encoded photos
    annotations/NAME_annots.smc   Camera_Parameter/CC/{K,D,RT}, Mask/C/mask/FRAME, SMPLx/{betas,expression,fullpose,transl}

CC has two digits, C and FRAME have no zeros before. RT is world_from_cam, D is k1 k2 p1 p2 k3: photos and masks are undistorted.
The mask is the greatest channel. fullpose: 55 x 3, hands relative to the mean hand (flat_hand_mean False), gendered model.
`scale` and color calibration are unused, as in the readers of others. Needs the package h5py.
"""

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import CalibratedCamera, Calibration, brown_conrady, in_capture_convention
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.datasets.bodies import (
    FARTHEST,
    LARGEST_ANGLE,
    LARGEST_COEFFICIENT,
    BodyParameters,
    FileBody,
    checked_numbers,
    coefficients,
)
from humangs_jax.data.datasets.multiview import ON_PERSON, Photo, checked_cameras, video_subject
from humangs_jax.data.datasets.subject import Subject
from humangs_jax.io.images import image_in
from humangs_jax.io.reading import Refused, check_limit, open_file, reading

GROUPS = ("Camera_5mp", "Camera_12mp")


def find_dna_rendering(folder: str | Path) -> tuple[Path, ...]:
    """The main files of a folder with main/ and annotations/, sorted; empty if there are none."""
    return tuple(sorted(Path(folder).glob("main/*.smc")))


class Smc:
    """An HDF5 file whose every value is checked for its size before it is read. Raises: CaptureError naming file and key."""

    def __init__(self, path: Path):
        self.path = path
        try:
            h5py: Any = importlib.import_module("h5py")  # optional
        except ImportError:
            raise CaptureError(path, "", "HDF5 files need the package h5py: pip install humangs_jax[hdf5]") from None
        with reading(path, "HDF5 file", CaptureError):
            open_file(path).close()  # devices, pipes, folders
            self.file = h5py.File(path, "r")

    def _at(self, key: str) -> Any:
        """What is under a key, or None. Links, which can lead into other files, are refused."""
        found = self.file
        for part in key.split("/"):
            if not hasattr(found, "keys") or part not in found:
                return None
            if type(found.get(part, getlink=True)).__name__ != "HardLink":
                raise Refused("refused a link")
            found = found[part]
        return found

    def names(self, group: str) -> list[str]:
        """Names in a group; none if there is no such group."""
        with reading(f"{self.path}: {group}", "group", CaptureError):
            found = self._at(group)
            return [] if found is None else list(found.keys())

    def array(self, key: str, limit: str = "array_bytes") -> np.ndarray:
        """The numbers of a data set."""
        with reading(f"{self.path}: {key}", "data set", CaptureError):
            data = self._at(key)
            if data is None:
                raise Refused("missing")
            if not hasattr(data, "dtype") or data.dtype.kind not in "fiu":
                raise Refused("expected numbers")
            if data.is_virtual or data.external:
                raise Refused("refused numbers that lie in other files")
            check_limit(limit, int(np.prod(data.shape, dtype=np.float64)) * data.dtype.itemsize, "bytes")
            return np.asarray(data[()])

    def numbers(self, key: str, shape: tuple[int | None, ...], largest: float = np.inf) -> Float[np.ndarray, "..."]:
        """Finite float64 numbers of a shape."""
        return checked_numbers(self.array(key), self.path, key, shape, largest=largest)

    def image(self, key: str) -> Float[np.ndarray, "h w c"]:
        """An encoded photo in [0, 1]."""
        data = self.array(key, "image_bytes")
        with reading(f"{self.path}: {key}", "image", CaptureError):
            if data.dtype != np.uint8 or data.ndim != 1:
                raise Refused(f"expected encoded bytes, got {data.dtype} of shape {data.shape}")
            with image_in(data.tobytes()) as image:
                return np.asarray(image.convert("RGB"), np.float32) / np.float32(255)


def open_dna_rendering(main: str | Path, body: FileBody) -> Subject:
    """One sequence of its main file. Raises: CaptureError naming file and key."""
    main = Path(main)
    photos, notes = Smc(main), Smc(main.parent.parent / "annotations" / f"{main.stem}_annots.smc")
    places = {int(name): group for group in GROUPS for name in photos.names(group) if name.isdecimal()}
    if not places:
        raise CaptureError(main, "", f"no camera: expected the groups {' and '.join(GROUPS)}")
    parameters = _parameters(notes, body)
    cameras, shown, masks = [], [], []
    for number, group in sorted(places.items()):
        there, masked = f"{group}/{number}/color", f"Mask/{number}/mask"
        shown.append({int(name): f"{there}/{name}" for name in photos.names(there) if name.isdecimal()})
        masks.append({int(name): f"{masked}/{name}" for name in notes.names(masked) if name.isdecimal()})
        cameras.append(_camera(notes, number, photos, shown[-1][min(shown[-1])] if shown[-1] else None))

    def read(photo: str, mask: str) -> Photo:
        image = photos.image(photo)
        person = (notes.image(mask).max(axis=-1) > ON_PERSON).astype(np.float32)
        if person.shape != image.shape[:2]:
            raise CaptureError(notes.path, mask, f"{person.shape}, its photo {image.shape[:2]}")
        return np.where(person[..., None] > 0, image, np.float32(1)), person

    calibration = Calibration("DNA-Rendering", notes.path, tuple(cameras), False, "integer", "+y")
    cameras = checked_cameras(in_capture_convention(calibration, 1.0, "+y", "integer"))
    return video_subject(main, cameras, shown, masks, read, parameters, digits=6)


def _parameters(notes: Smc, body: FileBody) -> BodyParameters:
    poses = notes.numbers("SMPLx/fullpose", (None, len(body.model.parents), 3), LARGEST_ANGLE)
    translations = notes.numbers("SMPLx/transl", (len(poses), 3), FARTHEST)
    rotations = poses.copy()
    rotations[:, 25:] += np.asarray(body.hands.means, np.float64).reshape(30, 3)
    shape = [notes.numbers(f"SMPLx/{key}", (None, None), LARGEST_COEFFICIENT)[0] for key in ("betas", "expression")]
    return BodyParameters(coefficients(body.model, shape[0], shape[1], notes.path), rotations, translations)


def _camera(notes: Smc, number: int, photos: Smc, first: str | None) -> CalibratedCamera:
    at = f"Camera_Parameter/{number:02d}"
    K, pose = notes.numbers(f"{at}/K", (3, 3)), notes.numbers(f"{at}/RT", (4, 4))
    R = pose[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 5e-3 or np.linalg.det(R) < 0:
        raise CaptureError(notes.path, f"{at}/RT", "the rotation is singular, mirrored or scaled")
    lens = brown_conrady(notes.array(f"{at}/D").reshape(-1), notes.path, f"{at}/D")
    width = height = None
    if first is not None:
        width, height = _size(photos, first)
    return CalibratedCamera(f"{number:02d}", K, np.linalg.inv(pose), width or 1, height or 1, lens)


def _size(photos: Smc, key: str) -> tuple[int, int]:
    data = photos.array(key, "image_bytes")
    with reading(f"{photos.path}: {key}", "image", CaptureError), image_in(data.astype(np.uint8).tobytes()) as image:
        return image.size
