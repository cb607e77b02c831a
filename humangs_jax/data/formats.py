"""What is read: cameras, keypoints, motions and data sets. A row each; a new format is a file with its reader and a line here.

`--help`, `humangs start`, errors and the tables in the docs are made of these rows.
"""

import dataclasses
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, TypeVar

from humangs_jax.core.registry import FOLDER, Format, Formats, imported

# Cameras and keypoints --------------------------------------------------------------------------------------------------
# The module of a row has two functions; where several recognize a file, the first reads it, those of its suffix before others.
# Suffixes are for files that are neither JSON nor text.
#     recognizes(source) -> bool            whether the content of a file is of this format; not asked where `folder` is set
#     read(source, format) -> Calibration   or Detections; source: `calibration.Source`, `keypoints.keypoints.Source`

F = TypeVar("F", bound="SourceFormat")


@dataclasses.dataclass(frozen=True)
class SourceFormat(Format):
    """A format whose files have usual names, but are known by their content. Its code is "module:read"."""

    files: tuple[str, ...] = ()
    """Usual names in a folder, patterns of `Path.glob`."""
    content: str = ""
    """What is in them, for the docs: a line of Markdown."""
    folder: bool = False
    """Whether the files of one folder are read together."""

    def __str__(self) -> str:
        """As lists name it."""
        return self.about

    def fits(self, source: Any) -> bool:
        """Whether a source, a file, is of this format."""
        return not self.folder and imported(str(self.code).replace(":read", ":recognizes"))(source)

    @property
    def names(self) -> tuple[str, ...]:
        """Usual names of files, without folders."""
        return tuple(dict.fromkeys(Path(file).name for file in self.files))


@dataclasses.dataclass(frozen=True)
class CameraFormat(SourceFormat):
    """A format of calibrations."""

    up: str = "-y"
    """The axis that points up."""
    pixel_centers: Literal["integer", "half"] = "integer"
    """Where the centre of the first pixel is: at (0, 0) or at (0.5, 0.5)."""
    per_image: bool = False
    """Whether it has one camera for each image, not one for each camera."""

    def __str__(self) -> str:
        return f"{self.about} ({', '.join(self.names)})" if self.files else self.about


class SourceFormats(Formats[F]):
    """Formats that are known by the content of their files."""

    def found(self, folder: Path) -> tuple[F, Path] | None:
        """The first format of which a folder has files, and the first of these; None: none."""
        for each in self.values():
            for pattern in each.files:
                if (file := next(iter(sorted(folder.glob(pattern))), None)) is not None:
                    return each, file
        return None

    def of_name(self, file: Path) -> F | None:
        """The first format of several files that one is of by its name."""
        named = (each for each in self.values() if each.folder and any(fnmatch(file.name, name) for name in each.names))
        return next(named, None)

    def of_content(self, source: Any) -> F | None:
        """The first format that recognizes a source, a file; those of its suffix are asked before the others."""
        asked = sorted(self.values(), key=lambda each: source.path.suffix.lower() not in each.suffixes)
        return next((each for each in asked if each.fits(source)), None)

    def listed(self) -> str:
        """All in one line."""
        return "; ".join(map(str, self.values()))


_CAMERAS, _KEYPOINTS = "humangs_jax.data.calibration.", "humangs_jax.data.keypoints."
_MODELS = ("", "sparse/0/", "sparse/")
CAMERAS = SourceFormats(
    colmap=CameraFormat(
        "COLMAP text model",
        _CAMERAS + "colmap:read",
        files=tuple(place + name for place in _MODELS for name in ("images.txt", "cameras.txt", "images.bin")),
        content="SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV; a binary model has to be converted first",
        folder=True,
        pixel_centers="half",
        per_image=True,
    ),
    easymocap=CameraFormat(
        "EasyMocap",
        _CAMERAS + "easymocap:read",
        files=("intri.yml", "extri.yml"),
        content="`names`, `K_NAME`, `dist_NAME`, `Rot_NAME` or `R_NAME`, `T_NAME`",
        folder=True,
        up="+z",
    ),
    transforms=CameraFormat(
        "NeRF, instant-ngp, nerfstudio or VHAP",
        _CAMERAS + "transforms:read",
        files=("transforms.json",),
        content="JSON with `frames`: `transform_matrix` is camera-to-world with OpenGL's axes",
        up="+z",
        pixel_centers="half",
        per_image=True,
    ),
    opencv=CameraFormat(
        "OpenCV, AvatarReX or THuman4.0",
        _CAMERAS + "opencv:read",
        files=("calibration_full.json", "calibration.json"),
        content="YAML or JSON: `K`, `R`, `T` in a map of each camera, or `K_NAME`, `R_NAME`, `T_NAME`; lens as `dist...` or "
        "`D`, size as `imgSize`, `image_size` or `width`, `height`",
    ),
)
"""Calibrations."""
KEYPOINTS = SourceFormats(
    humangs=SourceFormat(
        "humangs detect",
        _KEYPOINTS + "own:read",
        suffixes=(".npz",),
        files=("keypoints.json", "keypoints.npz"),
        content="33 points of BlazePose; `save_keypoints` (.npz): any set",
    ),
    openpose=SourceFormat(
        "OpenPose",
        _KEYPOINTS + "openpose:read",
        files=("openpose",),
        content="`--write_json`, a file an image: BODY_25, hands",
    ),
    coco=SourceFormat(
        "COCO, COCO-WholeBody or AlphaPose",
        _KEYPOINTS + "coco:read",
        files=("alphapose-results.json", "alphapose.json"),
        content="results, or images and annotations: 17, 26 or 133 points",
    ),
    mmpose=SourceFormat(
        "MMPose",
        _KEYPOINTS + "mmpose:read",
        files=("rtmpose", "mmpose", "predictions"),
        content="inferencer or demo scripts, a file an image or a video: 17, 26 or 133 points",
    ),
)
"""Keypoints of detectors; files may be folders."""


# Motions ----------------------------------------------------------------------------------------------------------------

DEFAULT_FPS = 30.0
ARRAYS = "humangs_jax.data.motion.arrays:read_arrays"
_MOVES = ("trans", "transl")
_AMASS_RATES = ("mocap_framerate", "mocap_frame_rate", "fps")
_FACE = ("jaw_pose", "leye_pose", "reye_pose")


@dataclasses.dataclass(frozen=True)
class ArrayKeys:
    """What the arrays of a motion are called, and what they mean."""

    kind: str
    """ours, whole (all joints under one key), scaled (whole, translations in other units) or parts."""
    keys: tuple[str, ...]
    """A file that has all of them is of this format."""
    poses: tuple[str, ...]
    """Of a whole pose; of parts the root, the body, three of the face, two of the hands."""
    moves: tuple[str, ...] = _MOVES
    """Positions: the first that is there."""
    rates: tuple[str, ...] = _AMASS_RATES
    """Frames per second: the first that is there."""
    fps: float | None = None
    """Frames per second without any; None: there must be one."""
    up: str = "y"
    """The axis that is up in files of this format."""
    fixed: bool = False
    """It is, whatever the poses look like."""
    also: tuple[str, ...] = ()
    """Other axes that are up in some of them, see `rules.up_axis`."""
    scaling: str | None = None
    """The key of what translations are divided by, 1000 without it."""


@dataclasses.dataclass(frozen=True)
class MotionFormat(Format):
    """Files of motions. code: called as code(path, `motion.Reading`), returns `motion.Poses` or a `skeleton.Clip`."""

    arrays: ArrayKeys | None = None
    """Of files of arrays by key; the first that fits a file is used, whatever its suffix."""


def _arrays(about: str, arrays: ArrayKeys, suffixes: tuple[str, ...] = (".npz", ".pkl", ".pickle")) -> MotionFormat:
    return MotionFormat(about, ARRAYS, suffixes, arrays=arrays)


def _whole(about: str, key: str, up: str, also: tuple[str, ...] = (), with_key: tuple[str, ...] = ()) -> MotionFormat:
    return _arrays(about, ArrayKeys("whole", (key, *with_key), (key,), up=up, also=also))


MOTIONS = Formats(
    humangs=_arrays(
        "ours", ArrayKeys("ours", ("rotations",), ("rotations",), ("translations",), ("fps",), None, fixed=True)
    ),
    aist=_arrays(
        "AIST++",
        ArrayKeys(
            *("scaled", ("smpl_poses",), ("smpl_poses",), ("smpl_trans",), ("fps",), 60.0),
            **{"fixed": True, "scaling": "smpl_scaling"},
        ),
    ),
    beat=_whole("BEAT2", "poses", "y", with_key=("expressions",)),
    amass=_whole("AMASS", "poses", "z"),
    lhm=_arrays(
        "LHM, a pose a file",
        ArrayKeys(
            *("parts", ("root_pose",), ("root_pose", "body_pose", *_FACE, "lhand_pose", "rhand_pose")),
            *(("trans",), (), DEFAULT_FPS, "y", False, ("-y",)),
        ),
        (".json", FOLDER),
    ),
    parts=_arrays(  # estimators write it in the coordinates of a camera, whose y points down
        "THuman4.0, AvatarReX",
        ArrayKeys(
            *("parts", ("body_pose",), ("global_orient", "body_pose", *_FACE, "left_hand_pose", "right_hand_pose")),
            *(("transl",), ("fps", *_AMASS_RATES), DEFAULT_FPS, "y", False, ("-y",)),
        ),
    ),
    smplx=_whole("SMPL-X (fullpose)", "fullpose", "z"),
    smpl=_whole("SMPL (pose)", "pose", "z", also=("y", "-y")),
    bvh=MotionFormat("skeletons of CMU, Mixamo, LaFAN and others", "humangs_jax.data.motion.bvh:read_bvh", (".bvh",)),
    glb=MotionFormat("skeletons of the same names", "humangs_jax.data.motion.gltf:read_animation", (".glb",)),
)
"""By name, in the order in which keys and files are asked."""

# Data sets --------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class DataSetFormat(Format):
    """A data set of captured people. code: opens one subject, code(its path, body) -> `subject.Subject`."""

    find: str | Callable[[Path], tuple[Path, ...]] = ""
    """Paths of the subjects in a folder, sorted, or the folder itself; empty if it has another layout."""
    lists: bool = False
    """A file lists many: code(path, body, size) -> tuple of `subject.Person`."""
    scans: bool = False
    """Textured scans: there are no photos before `humangs preprocess` has rendered some. code: see `preprocess.run`."""


def _data_set(about: str, place: str, **options: bool) -> DataSetFormat:
    """place: module and ending of its functions."""
    code, find = (f"humangs_jax.data.datasets.{place.replace(':', f':{do}_')}" for do in ("open", "find"))
    return DataSetFormat(about, code, find=find, lists=options.get("lists", False), scans=options.get("scans", False))


DATASETS: Formats[DataSetFormat] = Formats(
    {
        "scenes": _data_set("scene list", "scene_list:scene_list", lists=True),
        "thuman": _data_set("THuman2.0 and 2.1", "thuman:thuman", scans=True),
        "thuman4": _data_set("THuman4.0", "multiview:thuman4"),
        "avatarrex": _data_set("AvatarReX", "multiview:avatarrex"),
        "actorshq": _data_set("ActorsHQ", "actorshq:actorshq"),
        "dna-rendering": _data_set("DNA-Rendering", "dna_rendering:dna_rendering"),
    }
)
"""By name, in the order in which a folder is compared with them."""
