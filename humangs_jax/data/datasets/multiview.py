"""Videos of synchronised cameras: THuman4.0, AvatarReX, ActorsHQ and DNA-Rendering.

    THuman4.0   3 subjects, 24 cameras of 1330 x 1150 (https://github.com/ZhengZerong/THUman4.0-Dataset)
                subject0x/images/camNN/%08d.jpg    masks/camNN/%08d.jpg    calibration.json
    AvatarReX   4 subjects, 16 cameras of 1500 x 2048 (https://github.com/ZhengZerong/AvatarReX)
                avatarrex_*/SERIAL/%08d.jpg    SERIAL/mask/pha/%08d.jpg    calibration_full.json
    both        smpl_params.npz    missing_img_files.txt (not always)
    ActorsHQ    8 actors, 160 cameras (https://actors-hq.com), calibration as in HumanRF's reader
                ActorNN/SequenceN/{1x,2x,4x}/calibration.csv
                rgbs/CamNNN/CamNNN_rgb%06d.jpg (background removed)
                masks/CamNNN/CamNNN_mask%06d.png
                ActorNN/SequenceN/smpl_params.npz, of some sequences, by the authors of
                Animatable Gaussians
    DNA-Rendering   60 cameras, in HDF5 (https://dna-rendering.github.io), as the official
                SMCReader has it
                main/NAME.smc    encoded photos: Camera_5mp/0..47/color/FRAME and
                                 Camera_12mp/48..59/color/FRAME
                annotations/NAME_annots.smc    Camera_Parameter/CC/{K,D,RT}, Mask/C/mask/FRAME,
                SMPLx/{betas,expression,fullpose,transl}

Photos are numbered by frame, and a frame's number is the row of its pose. Masks are above 128 on
the person. smpl_params.npz: global_orient, transl (m, 3), body_pose (m, 63), jaw_pose (m, 3),
left/right_hand_pose (m, 45), betas and expression (1 or m, 10): SMPL-X, neutral, no principal
components, flat_hand_mean TRUE (unlike THuman2.1), no poses of the eyes.

ActorsHQ's csv has name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py: rotation vector and centre of
world_from_cam in metres with OpenCV's axes, focal lengths and principal point as shares of width
and height. Each scale has a csv. Images in portrait and landscape format are mixed.

DNA-Rendering: CC has two digits, C and FRAME have no leading zeros. RT is world_from_cam. D is k1
k2 p1 p2 k3, by which photos and masks are undistorted. The mask is the greatest channel. fullpose
is 55 x 3, with hands relative to the mean hand (flat_hand_mean False), for the gendered model.
`scale` and color calibration are unused; the readers of others do not use them either. Needs the
package h5py.
"""

import csv
import functools
import importlib
import io
import os
import re
from collections.abc import Callable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from humangs_jax.core.array_types import Bool, Float
from humangs_jax.data.cameras import (
    CalibratedCamera,
    Calibration,
    brown_conrady,
    image_size,
    in_capture_convention,
    intrinsics,
    pose_matrix,
    read_calibration,
    rotation,
    undistort_person,
)
from humangs_jax.data.capture_checks import CaptureError, checked_camera, checked_text
from humangs_jax.data.datasets.subject import (
    FARTHEST,
    LARGEST_ANGLE,
    LARGEST_COEFFICIENT,
    BodyParameters,
    FileBody,
    Subject,
    checked_numbers,
    coefficients,
    open_arrays,
)
from humangs_jax.data.photos import read_checked
from humangs_jax.io.images import PHOTO_SUFFIXES, image_in, read_grey, read_image
from humangs_jax.io.reading import (
    InvalidFileError,
    check_limit,
    limits,
    open_file,
    read_text,
    reading,
    visible,
)

PARAMETERS = "smpl_params.npz"
"""File with the poses of a subject."""
MISSING = "missing_img_files.txt"
"""File in which the authors list images that are missing."""
ON_PERSON = 128.5 / 255
"""A pixel is on the person if its mask value, in [0, 1], is above this. As bytes, these are the
values above 128.
"""
PHOTO = re.compile(r"(?:[\w-]+_(?:rgb|mask))?(\d+)\.\w+")
"""Pattern of the file names of photos and masks, also in ActorsHQ. Its group is the number of the
frame.
"""
T = TypeVar("T")
Photo = tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]
"""Image on white and mask, both in [0, 1]."""
_ANGLES = {
    "global_orient": 3,
    "body_pose": 63,
    "jaw_pose": 3,
    "left_hand_pose": 45,
    "right_hand_pose": 45,
}


def read_parameters(file: Path, body: FileBody) -> BodyParameters:
    """Returns the shape and all poses of a smpl_params.npz.

    A person has one shape. If shape or expression differ between frames, the values of the first
    frame are taken. Raises: CaptureError naming the file, and the key if a value is wrong.
    """
    values = open_arrays(file)
    count = len(values.numbers("global_orient", (None, 3), LARGEST_ANGLE))
    angles = {
        key: values.numbers(key, (count, size), LARGEST_ANGLE) for key, size in _ANGLES.items()
    }
    translations = values.numbers("transl", (count, 3), FARTHEST)
    eyes = np.zeros((count, 6))
    parts = [angles[key] for key in ("global_orient", "body_pose", "jaw_pose")]
    rotations = np.concatenate(
        [*parts, eyes, angles["left_hand_pose"], angles["right_hand_pose"]], axis=1
    )
    shape = []
    for key in ("betas", "expression"):
        rows = np.atleast_2d(values.numbers(key, None, LARGEST_COEFFICIENT))
        if rows.ndim != 2 or len(rows) not in (1, count):
            raise CaptureError(
                file, key, f"expected shape (1, any) or ({count}, any), got {rows.shape}"
            )
        shape.append(rows[0])
    betas = coefficients(body.model, shape[0], shape[1], file)
    return BodyParameters(betas, rotations.reshape(count, -1, 3), translations)


def read_cameras(file: Path) -> tuple[CalibratedCamera, ...]:
    """Read the cameras of a calibration file, with pixel centres at +0.5. The world's axes are
    kept.

    Raises: CaptureError naming the file, and the camera if one is wrong.
    """

    def no_size(name: str) -> tuple[int, int]:
        raise CaptureError(file, f"{name}.imgSize", "missing")

    calibration = read_calibration(file, no_size)
    return _checked_cameras(in_capture_convention(calibration, 1.0, "+y", "integer"))


def _checked_cameras(calibration: Calibration) -> tuple[CalibratedCamera, ...]:
    """Returns the cameras after checking that each has a size, valid matrices, a name that can be
    the name of a folder, and a distance of at most `FARTHEST` from the origin.

    Raises: CaptureError naming the camera.
    """
    for camera in calibration.cameras:
        if not re.fullmatch(r"[\w-][\w.-]*", camera.name):
            problem = (
                "expected a name of letters, digits, '.', '_' and '-', since photos lie in a folder"
                " of that name"
            )
            raise CaptureError(calibration.file, camera.name, problem)
        if camera.width is None or camera.height is None:
            raise CaptureError(calibration.file, f"{camera.name}.imgSize", "missing")
        checked_camera(
            camera.K,
            camera.cam_from_world,
            camera.width,
            camera.height,
            calibration.file,
            camera.name,
        )
        away = float(np.linalg.norm(camera.cam_from_world[:3, 3]))
        if away > FARTHEST:
            problem = (
                f"the camera stands {away:.4g} m from the origin: expected metres and at most"
                f" {FARTHEST:g}"
            )
            raise CaptureError(calibration.file, f"{camera.name}.T", problem)
    return calibration.cameras


def numbered(folder: Path) -> dict[int, Path]:
    """Returns the paths of the photos in a folder, by frame. The name of a photo is the number of
    its frame, perhaps after NAME_rgb or NAME_mask. The result is empty if the folder does not
    exist.
    """
    listed = ()
    if folder.is_dir():
        listed = os.listdir(folder)
    names = [name for name in listed if name.lower().endswith(PHOTO_SUFFIXES)]
    matches = {name: PHOTO.fullmatch(name) for name in names}
    return {int(found[1]): folder / name for name, found in matches.items() if found}


def _read_missing(file: Path) -> set[tuple[str, int]]:
    """Read the (camera, frame) pairs of the photos that the authors list as missing. Paths may have
    slashes or backslashes.

    Returns an empty set if there is no such file. Raises: CaptureError naming the line; FileError
    if the file cannot be read.
    """
    if not file.is_file():
        return set()
    found = set()
    for number, line in enumerate(read_text(file).splitlines(), 1):
        if line.strip():
            named = re.search(r"([^\\/]+)[\\/]+([0-9]{1,18})(?:\.[^\\/]*)?$", line.strip())
            if named is None:
                raise CaptureError(
                    file, f"line {number}", f"expected CAMERA/FRAME.jpg, got {line.strip()[:60]!r}"
                )
            found.add((named[1], int(named[2])))
    return found


def _video_subject(
    name: Path,
    cameras: Sequence[CalibratedCamera],
    photos: Sequence[Mapping[int, T]],
    masks: Sequence[Mapping[int, T]],
    read: Callable[[T, T], Photo],
    parameters: BodyParameters,
    listed: Set[tuple[str, int]] = frozenset(),
    digits: int = 8,
) -> Subject:
    """Returns a subject with the photos that have both a mask and a pose and are not in `listed`,
    ordered by frame, then by camera.

    photos, masks: for each camera a mapping from frame to photo or mask, in the form that `read`
    takes. read: called with a photo and its mask; returns the image on white and the mask as 0 and
    1. listed: the (camera, frame) pairs that the authors list as missing. digits: the number of
    digits of the frame in the name of a view.
    Raises: CaptureError if no photo is left.
    """
    count = len(parameters.translations)
    missing = {"listed as missing": 0, "no photo": 0, "no mask": 0, "no pose": 0}
    shown = []
    # which frames each camera shows, and why others are left out
    for number, (camera, there, masked) in enumerate(zip(cameras, photos, masks, strict=True)):
        known = {frame for owner, frame in listed if owner == camera.name}
        usable = {frame for frame in there if frame not in known and 0 <= frame < count}
        missing["listed as missing"] += len(known)
        missing["no photo"] += sum(
            frame not in there and frame not in known for frame in range(count)
        )
        missing["no pose"] += len(set(there) - known - usable)
        missing["no mask"] += len(usable - set(masked))
        shown += [(frame, number) for frame in usable & set(masked)]
    missing = {reason: number for reason, number in missing.items() if number}
    if not shown:
        reasons = ", ".join(f"{reason}: {number}" for reason, number in missing.items())
        raise CaptureError(name, "", f"no photo with a mask and a pose ({reasons or 'no cameras'})")
    # frame after frame, so that the poses are read in their order
    frames, owners = np.asarray(sorted(shown), np.int32).T

    def read_view(view: int) -> Photo:
        frame, owner = int(frames[view]), int(owners[view])
        image, person = read(photos[owner][frame], masks[owner][frame])
        K, lens = cameras[owner].K, cameras[owner].distortion
        if lens is None:
            return image, person
        return undistort_person(image, person, K, lens)

    return Subject(
        name=str(name),
        K=np.stack([camera.K for camera in cameras])[owners],
        cam_from_world=np.stack([camera.cam_from_world for camera in cameras])[owners],
        sizes=np.asarray([(camera.width, camera.height) for camera in cameras])[owners],
        frames=frames,
        frame_count=count,
        view_name=lambda view: f"{cameras[owners[view]].name}_{frames[view]:0{digits}d}",
        read=read_view,
        parameters=parameters.poses,
        missing=missing,
    )


def _folder_subject(
    name: Path,
    cameras: Sequence[CalibratedCamera],
    folders: Sequence[tuple[Path, Path]],
    parameters: BodyParameters,
    listed: Set[tuple[str, int]] = frozenset(),
) -> Subject:
    """Returns `_video_subject` of image files. folders: for each camera the folder of its photos
    and the folder of its masks.
    """
    photos, masks = ([numbered(folder) for folder in part] for part in zip(*folders, strict=True))
    return _video_subject(name, cameras, photos, masks, on_white, parameters, listed)


def on_white(
    photo: Path, mask: Path
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Returns a photo and its mask as 0 and 1. The mask is 1 where its file has more than 128.
    Elsewhere the photo becomes white.

    Raises: CaptureError naming the file.
    """
    return _cut_out(
        read_checked(read_image, photo)[0], read_checked(read_grey, mask) > ON_PERSON, mask, "size"
    )


def _cut_out(
    image: Float[np.ndarray, "h w 3"], person: Bool[np.ndarray, "mh mw"], file: Path, field: str
) -> Photo:
    if person.shape != image.shape[:2]:
        got = (
            f"{person.shape[1]} x {person.shape[0]}, but its photo has {image.shape[1]} x"
            f" {image.shape[0]}"
        )
        raise CaptureError(file, field, f"{got}: expected the same")
    return np.where(person[..., None], image, np.float32(1)), person.astype(np.float32)


class _FolderLayout(NamedTuple):
    """Where the files of a data set are, relative to its folder."""

    calibration: str
    """The path of the calibration."""
    photos: str
    """The folder of one camera's photos, with NAME in place of the camera's name."""
    masks: str
    """The folder of one camera's masks, with NAME in place of the camera's name."""


THUMAN4 = _FolderLayout("calibration.json", "images/NAME", "masks/NAME")
AVATARREX = _FolderLayout("calibration_full.json", "NAME", "NAME/mask/pha")


def _find_subjects(layout: _FolderLayout, folder: str | Path) -> tuple[Path, ...]:
    """Returns the folder itself if it is a subject, else the subjects directly in it, sorted."""
    above = layout.photos.removesuffix("NAME")
    return _subfolders(
        folder, lambda path: (path / layout.calibration).is_file() and (path / above).is_dir()
    )


def _subfolders(
    folder: str | Path, is_one: Callable[[Path], bool], depth: int = 1
) -> tuple[Path, ...]:
    """Returns the folder itself if `is_one` accepts it, else the accepted folders up to `depth`
    levels below, sorted.
    """
    folder = Path(folder)
    below = (path for level in range(depth) for path in visible(folder.glob("*/" * (level + 1))))
    if is_one(folder):
        return (folder,)
    return tuple(sorted(path for path in below if is_one(path)))


def _open_subject(layout: _FolderLayout, folder: str | Path, body: FileBody) -> Subject:
    """Open one subject. Only calibration, poses and file names are read.

    Raises: CaptureError naming the file, and the key or the camera if one is wrong.
    """
    folder = Path(folder)
    cameras = read_cameras(folder / layout.calibration)

    def place(part, camera):
        return folder / part.replace("NAME", camera.name)

    places = [(place(layout.photos, camera), place(layout.masks, camera)) for camera in cameras]
    return _folder_subject(
        folder,
        cameras,
        places,
        read_parameters(folder / PARAMETERS, body),
        _read_missing(folder / MISSING),
    )


find_thuman4, open_thuman4 = (
    functools.partial(do, THUMAN4) for do in (_find_subjects, _open_subject)
)
find_avatarrex, open_avatarrex = (
    functools.partial(do, AVATARREX) for do in (_find_subjects, _open_subject)
)


# ActorsHQ
# --------------------------------------------------------------------------------------------------

CALIBRATION = "calibration.csv"
"""File with the cameras, in the folder of each size of the images."""
SCALES = ("4x", "2x", "1x")
"""The names of folders, one for each size of the images, smallest images first."""
COLUMNS = ["w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py"]


def find_actorshq(folder: str | Path) -> tuple[Path, ...]:
    """Returns the sequences in a folder of one actor or of several actors, sorted. If the folder is
    a sequence, it is the only result. If there are no sequences, the result is empty.
    """
    return _subfolders(
        folder,
        lambda path: any((path / scale / CALIBRATION).is_file() for scale in SCALES),
        depth=2,
    )


def open_actorshq(folder: str | Path, body: FileBody) -> Subject:
    """Open one sequence with the smallest images that its folder has.

    Raises: CaptureError naming the file, and the key or the camera if one is wrong.
    """
    folder = Path(folder)
    scale = next((s for s in SCALES if (folder / s / CALIBRATION).is_file()), SCALES[0])
    cameras = _read_csv_cameras(folder / scale / CALIBRATION)
    places = [
        (folder / scale / "rgbs" / camera.name, folder / scale / "masks" / camera.name)
        for camera in cameras
    ]
    return _folder_subject(folder, cameras, places, read_parameters(folder / PARAMETERS, body))


def _read_csv_cameras(file: Path) -> tuple[CalibratedCamera, ...]:
    """Read the cameras of a calibration.csv.

    Raises: CaptureError naming the file, and the camera, the column or the line that is wrong.
    """
    with reading(file, "csv file", CaptureError):
        rows = list(csv.DictReader(io.StringIO(checked_text(file))))
    cameras = []
    for number, row in enumerate(rows, 2):
        # names are also those of folders, so each is plain and unique
        name = row.get("name")
        if (
            not name
            or not re.fullmatch(r"[\w-]+", name)
            or any(camera.name == name for camera in cameras)
        ):
            raise CaptureError(
                file,
                f"line {number}: name",
                f"expected a name that no other camera has, got {name!r}",
            )
        numbers = []
        for key in COLUMNS:
            try:
                numbers.append(float(row[key]))
            except (KeyError, TypeError, ValueError):
                raise CaptureError(
                    file, f"{name}.{key}", f"expected a number, got {row.get(key)!r}"
                ) from None
        values = checked_numbers(numbers, file, name, (len(COLUMNS),), largest=float(limits().side))
        width, height = image_size(values[:2], file, f"{name}.w")
        # the file has where the camera is; lengths on the image are shares of its sides
        turn, center, (fx, fy, px, py) = (
            rotation(values[2:5], file, name).T,
            values[5:8],
            values[8:].tolist(),
        )
        if max(fx, fy) > 100:
            raise CaptureError(
                file, f"{name}.fx", f"expected a share of the width, got {fx:g}: in pixels?"
            )
        K = intrinsics(fx * width, fy * height, px * width, py * height)
        cameras.append(CalibratedCamera(name, K, pose_matrix(turn, -turn @ center), width, height))
    if not cameras:
        raise CaptureError(file, "", f"no camera: expected the columns name,{','.join(COLUMNS)}")
    return _checked_cameras(Calibration("ActorsHQ", file, tuple(cameras), False, "half", "+y"))


# DNA-Rendering
# --------------------------------------------------------------------------------------------------

GROUPS = ("Camera_5mp", "Camera_12mp")


def find_dna_rendering(folder: str | Path) -> tuple[Path, ...]:
    """Returns the .smc files in the folder main/ of a folder, sorted; empty if there are none."""
    return tuple(sorted(visible(Path(folder).glob("main/*.smc"))))


class _Smc:
    """An HDF5 file. The size of each value is checked before it is read.

    Raises: CaptureError naming the file, and the key if a value is wrong. Also without the package
    h5py.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            h5py: Any = importlib.import_module("h5py")  # optional
        except ImportError:
            raise CaptureError(
                path, "", "HDF5 files need the package h5py: pip install humangs_jax[hdf5]"
            ) from None
        with reading(path, "HDF5 file", CaptureError):
            open_file(path).close()  # devices, pipes, folders
            self.file = h5py.File(path, "r")

    def _at(self, key: str) -> Any:
        """Returns the HDF5 group or data set under a key, or None if there is none. Links are
        refused, since they can lead into other files.
        """
        found = self.file
        for part in key.split("/"):
            if not hasattr(found, "keys") or part not in found:
                return None
            if type(found.get(part, getlink=True)).__name__ != "HardLink":
                raise InvalidFileError("refused a link")
            found = found[part]
        return found

    def names(self, group: str) -> list[str]:
        """Returns the names in a group; an empty list if there is no such group."""
        with reading(f"{self.path}: {group}", "group", CaptureError):
            found = self._at(group)
            return [] if found is None else list(found.keys())

    def array(self, key: str, limit: str = "array_bytes") -> np.ndarray:
        """Returns the numbers of an HDF5 data set. limit: the field of `Limits` that bounds their
        bytes.
        """
        with reading(f"{self.path}: {key}", "data set", CaptureError):
            data = self._at(key)
            if data is None:
                raise InvalidFileError("missing")
            if not hasattr(data, "dtype") or data.dtype.kind not in "fiu":
                raise InvalidFileError("expected numbers")
            if data.is_virtual or data.external:
                raise InvalidFileError("refused numbers that lie in other files")
            check_limit(
                limit, int(np.prod(data.shape, dtype=np.float64)) * data.dtype.itemsize, "bytes"
            )
            return np.asarray(data[()])

    def numbers(
        self, key: str, shape: tuple[int | None, ...], largest: float = np.inf
    ) -> Float[np.ndarray, "..."]:
        """Returns finite float64 numbers of this shape. largest: see `checked_numbers`."""
        return checked_numbers(self.array(key), self.path, key, shape, largest=largest)

    def image(self, key: str, made_of: Callable[[Any], T]) -> T:
        """Decodes a photo, and returns what `made_of` makes of the PIL image."""
        data = self.array(key, "image_bytes")
        with reading(f"{self.path}: {key}", "image", CaptureError):
            if data.dtype != np.uint8 or data.ndim != 1:
                raise InvalidFileError(
                    f"expected encoded bytes, got {data.dtype} of shape {data.shape}"
                )
            with image_in(data.tobytes()) as image:
                return made_of(image)


def open_dna_rendering(main: str | Path, body: FileBody) -> Subject:
    """Open one sequence by its main file.

    Raises: CaptureError naming the file, and the key or the camera if one is wrong.
    """
    main = Path(main)
    photos, notes = _Smc(main), _Smc(main.parent.parent / "annotations" / f"{main.stem}_annots.smc")
    # cameras are spread over groups of two kinds
    places = {
        int(name): group for group in GROUPS for name in photos.names(group) if name.isdecimal()
    }
    if not places:
        raise CaptureError(main, "", f"no camera: expected the groups {' and '.join(GROUPS)}")
    parameters = _parameters(notes, body)
    # photos and masks of each camera by frame; masks are in the other file
    cameras, shown, masks = [], [], []
    for number, group in sorted(places.items()):
        there, masked = f"{group}/{number}/color", f"Mask/{number}/mask"
        shown.append(
            {int(name): f"{there}/{name}" for name in photos.names(there) if name.isdecimal()}
        )
        masks.append(
            {int(name): f"{masked}/{name}" for name in notes.names(masked) if name.isdecimal()}
        )
        first = None
        if shown[-1]:
            first = shown[-1][min(shown[-1])]
        cameras.append(_camera(notes, number, photos, first))

    def read(photo: str, mask: str) -> Photo:
        image, person = (file.image(key, _colors) for file, key in ((photos, photo), (notes, mask)))
        return _cut_out(image, person.max(axis=-1) > ON_PERSON, notes.path, mask)

    # annotated cameras in the convention of captures
    calibration = Calibration("DNA-Rendering", notes.path, tuple(cameras), False, "integer", "+y")
    cameras = _checked_cameras(in_capture_convention(calibration, 1.0, "+y", "integer"))
    return _video_subject(main, cameras, shown, masks, read, parameters, digits=6)


def _colors(image: Any) -> Float[np.ndarray, "h w 3"]:
    return np.asarray(image.convert("RGB"), np.float32) / np.float32(255)


def _parameters(notes: _Smc, body: FileBody) -> BodyParameters:
    poses = notes.numbers("SMPLx/fullpose", (None, len(body.model.parents), 3), LARGEST_ANGLE)
    translations = notes.numbers("SMPLx/transl", (len(poses), 3), FARTHEST)
    rotations = poses.copy()
    rotations[:, 25:] += np.asarray(body.hands.means, np.float64).reshape(30, 3)
    shape = [
        notes.numbers(f"SMPLx/{key}", (None, None), LARGEST_COEFFICIENT)[0]
        for key in ("betas", "expression")
    ]
    return BodyParameters(
        coefficients(body.model, shape[0], shape[1], notes.path), rotations, translations
    )


def _camera(notes: _Smc, number: int, photos: _Smc, first: str | None) -> CalibratedCamera:
    at = f"Camera_Parameter/{number:02d}"
    K, pose = notes.numbers(f"{at}/K", (3, 3)), notes.numbers(f"{at}/RT", (4, 4))
    lens = brown_conrady(notes.array(f"{at}/D").reshape(-1), notes.path, f"{at}/D")
    if first is None:
        width, height = 1, 1
    else:
        width, height = photos.image(first, lambda image: image.size)
    with reading(f"{notes.path}: {at}/RT", "pose", CaptureError):
        return CalibratedCamera(f"{number:02d}", K, np.linalg.inv(pose), width, height, lens)
