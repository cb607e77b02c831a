"""What is read: motions and data sets. A row each; a new format is a file with its reader and a line here."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from humangs_jax.core.registry import FOLDER, Format, Formats

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
