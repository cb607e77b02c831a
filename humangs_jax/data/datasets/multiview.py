"""What THuman4.0, AvatarReX and ActorsHQ have in common: videos of synchronised cameras, and smpl_params.npz.

Photos are numbered by frame, and a frame's number is the row of its pose. Masks are above 128 on the person.
smpl_params.npz: global_orient, transl (m, 3), body_pose (m, 63), jaw_pose (m, 3), left/right_hand_pose (m, 45), betas and
expression (1 or m, 10): SMPL-X, neutral, no principal components, flat_hand_mean TRUE (unlike THuman2.1), no poses of the eyes.
"""

import dataclasses
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.data.calibration.calibration import (
    CalibratedCamera,
    Calibration,
    in_capture_convention,
    undistort_person,
)
from humangs_jax.data.calibration.formats import read_calibration
from humangs_jax.data.capture_checks import CaptureError, checked_camera
from humangs_jax.data.datasets.bodies import BodyParameters, FileBody, coefficients
from humangs_jax.data.datasets.subject import Subject
from humangs_jax.data.datasets.values import FARTHEST, LARGEST_ANGLE, LARGEST_COEFFICIENT, open_arrays
from humangs_jax.data.photos import read_checked
from humangs_jax.io.images import read_grey, read_image
from humangs_jax.io.reading import read_text

PARAMETERS, MISSING = "smpl_params.npz", "missing_img_files.txt"
ON_PERSON = 128.5 / 255
"""Least value of a mask on the person: above 128."""
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")
_ANGLES = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "left_hand_pose": 45, "right_hand_pose": 45}


def read_parameters(file: Path, body: FileBody) -> BodyParameters:
    """Shape and all poses of smpl_params.npz. Raises: CaptureError naming file and key.

    Where shape or expression differ between frames, those of the first are taken: one person has one shape.
    """
    values = open_arrays(file)
    count = len(values.numbers("global_orient", (None, 3), LARGEST_ANGLE))
    angles = {key: values.numbers(key, (count, size), LARGEST_ANGLE) for key, size in _ANGLES.items()}
    translations = values.numbers("transl", (count, 3), FARTHEST)
    eyes = np.zeros((count, 6))
    parts = [angles[key] for key in ("global_orient", "body_pose", "jaw_pose")]
    rotations = np.concatenate([*parts, eyes, angles["left_hand_pose"], angles["right_hand_pose"]], axis=1)
    shape = [_first_row(values, key, count) for key in ("betas", "expression")]
    betas = coefficients(body.model, shape[0], shape[1], file)
    return BodyParameters(betas, rotations.reshape(count, -1, 3), translations)


def _first_row(values, key, count):
    array = values.numbers(key, (None,) * values.array(key).ndim, LARGEST_COEFFICIENT)
    if array.ndim == 1:
        return array
    if array.ndim != 2 or len(array) not in (1, count):
        raise CaptureError(values.path, key, f"expected shape (1, any) or ({count}, any), got {array.shape}")
    return array[0]


def read_cameras(file: Path) -> tuple[CalibratedCamera, ...]:
    """Cameras of {"NAME": {"K": [9], "R": [9], "T": [3], "imgSize": [W, H]}}, pixel centres at +0.5.

    The world's axes stay as they are. Raises: CaptureError naming file and camera.
    """

    def no_size(name: str) -> tuple[int, int]:
        raise CaptureError(file, f"{name}.imgSize", "missing")

    calibration = read_calibration(file, no_size)
    return checked_cameras(in_capture_convention(calibration, 1.0, "+y", "integer"))


def checked_cameras(calibration: Calibration) -> tuple[CalibratedCamera, ...]:
    """Cameras of known sizes, rigid, no farther than `FARTHEST` from the origin, with names that can be those of folders.

    Raises: CaptureError naming the camera.
    """
    for camera in calibration.cameras:
        if not re.fullmatch(r"[\w-][\w.-]*", camera.name):
            problem = "expected a name of letters, digits, '.', '_' and '-', since photos lie in a folder of that name"
            raise CaptureError(calibration.file, camera.name, problem)
        if camera.width is None or camera.height is None:
            raise CaptureError(calibration.file, f"{camera.name}.imgSize", "missing")
        checked_camera(camera.K, camera.cam_from_world, camera.width, camera.height, calibration.file, camera.name)
        if (away := float(np.linalg.norm(camera.cam_from_world[:3, 3]))) > FARTHEST:
            problem = f"the camera stands {away:.4g} m from the origin: expected metres and at most {FARTHEST:g}"
            raise CaptureError(calibration.file, f"{camera.name}.T", problem)
    return calibration.cameras


def plain_number(stem: str) -> int | None:
    """The frame of "00000120"; None for other names."""
    return int(stem) if stem.isdecimal() else None


@dataclasses.dataclass(frozen=True, eq=False)
class Folders:
    """Where the photos and masks of a camera are, and what turns a file's name (without suffix) into its frame."""

    photos: Path
    masks: Path
    frame_of: Callable[[str], int | None] = plain_number


def numbered(folder: Path, frame_of: Callable[[str], int | None]) -> dict[int, str]:
    """Frame -> name of its file, of the photos in a folder; empty if it does not exist."""
    found = {}
    if folder.is_dir():
        with os.scandir(folder) as entries:
            for entry in entries:
                stem, suffix = os.path.splitext(entry.name)
                frame = frame_of(stem) if suffix.lower() in PHOTO_SUFFIXES else None
                if frame is not None:
                    found[frame] = entry.name
    return found


def read_missing(file: Path) -> set[tuple[str, int]]:
    """(camera, frame) of the photos that the authors list as missing; both kinds of slashes. Empty without the file."""
    if not file.is_file():
        return set()
    found = set()
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if not line.strip():
            continue
        parts = [part for part in re.split(r"[\\/]+", line.strip()) if part]
        frame = parts[-1].partition(".")[0] if parts else ""
        if len(parts) < 2 or not re.fullmatch(r"[0-9]{1,18}", frame):
            raise CaptureError(file, f"line {number}", f"expected CAMERA/FRAME.jpg, got {line.strip()[:60]!r}")
        found.add((parts[-2], int(frame)))
    return found


def video_subject(
    name: Path,
    cameras: Sequence[CalibratedCamera],
    folders: Mapping[str, Folders],
    parameters: BodyParameters,
    listed: set[tuple[str, int]] = frozenset(),  # ty: ignore[invalid-parameter-default]
) -> Subject:
    """The photos of some cameras that have a mask and a pose, frame after frame and camera after camera.

    folders: by the name of the camera. listed: (camera, frame) that are known to be missing.
    Raises: CaptureError if there is no photo.
    """
    count, missing = len(parameters.translations), {"listed as missing": 0, "no photo": 0, "no mask": 0, "no pose": 0}
    shown, files = [], []
    for number, camera in enumerate(cameras):
        folder = folders[camera.name]
        photos, masks = numbered(folder.photos, folder.frame_of), numbered(folder.masks, folder.frame_of)
        known = {frame for owner, frame in listed if owner == camera.name}
        missing["listed as missing"] += len(known)
        missing["no photo"] += sum(frame not in photos and frame not in known for frame in range(count))
        for frame, photo in photos.items():
            if frame in known:
                continue
            if not 0 <= frame < count:
                missing["no pose"] += 1
            elif frame not in masks:
                missing["no mask"] += 1
            else:
                shown.append((frame, number))
                files.append((photo, masks[frame]))
    if not shown:
        told = ", ".join(f"{reason}: {number}" for reason, number in missing.items() if number)
        raise CaptureError(name, "", f"no photo with a mask and a pose ({told or 'no cameras'})")
    order = sorted(range(len(shown)), key=shown.__getitem__)
    frames, owners = np.asarray(shown, np.int32)[order].T
    files = [files[i] for i in order]

    def read(view: int):
        folder = folders[cameras[owners[view]].name]
        photo, mask = files[view]
        camera = cameras[owners[view]]
        image, person = on_white(folder.photos / photo, folder.masks / mask)
        if camera.distortion is None:
            return image, person
        return undistort_person(image, person, camera.K, camera.distortion)

    return Subject(
        name=str(name),
        K=np.stack([camera.K for camera in cameras])[owners],
        cam_from_world=np.stack([camera.cam_from_world for camera in cameras])[owners],
        sizes=np.asarray([(camera.width, camera.height) for camera in cameras])[owners],
        frames=frames,
        cameras=owners,
        frame_count=count,
        view_name=lambda view: f"{cameras[owners[view]].name}_{frames[view]:08d}",
        read=read,
        parameters=parameters.poses,
        missing={reason: number for reason, number in missing.items() if number},
    )


def on_white(photo: Path, mask: Path) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """A photo on white where its mask is at most 128, and the mask as 0 and 1. Raises: CaptureError naming the file."""
    image, _ = read_checked(read_image, photo)
    person = read_checked(read_grey, mask) > ON_PERSON
    if person.shape != image.shape[:2]:
        got = f"{person.shape[1]} x {person.shape[0]}, but its photo has {image.shape[1]} x {image.shape[0]}"
        raise CaptureError(mask, "size", f"{got}: expected the same")
    return np.where(person[..., None], image, np.float32(1)), person.astype(np.float32)
