"""The tables of file formats that are read: cameras, keypoints, motions and data sets. Each format
is a row; a new format needs a reader and a row here.

`--help`, `humangs start`, errors and the tables in the docs are made of these rows.
"""

import dataclasses
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Literal, TypeVar

from humangs_jax.body.joints import DEFAULT_FPS
from humangs_jax.core.registry import FOLDER, Format, Formats, imported
from humangs_jax.io.reading import visible

START_MARK = "start.json"
"""The file that `humangs start` leaves in a capture folder that it made."""

# Cameras and keypoints
# --------------------------------------------------------------------------------------------------
# The module of a row has two functions; where several recognize a file, the first reads it, those
# of its suffix before others. Suffixes are for files that are neither JSON nor text.
# recognizes_NAME(source) -> bool            whether the content of a file is of this format; not
# asked where `folder` is set
# read_NAME(source, format) -> Calibration   or Detections; source: `cameras.CalibrationFile`,
# `keypoints.keypoints.KeypointFile`

F = TypeVar("F", bound="SourceFormat")


@dataclasses.dataclass(frozen=True)
class SourceFormat(Format):
    """A format whose files usually have certain names. A file belongs to the format if its content
    fits. Files of a format with `folder` are known by their names instead.

    Its code is "module:read_NAME".
    """

    files: tuple[str, ...] = ()
    """Usual names in a folder, patterns of `Path.glob`."""
    content: str = ""
    """What its files contain, as a line of Markdown for the docs."""
    folder: bool = False
    """Whether the files of one folder are read together."""

    def __str__(self) -> str:
        """Returns the format as lists show it."""
        return self.about

    def fits(self, source: Any) -> bool:
        """Returns whether the content of one file is of this format. False for formats whose files
        are read together. source: the file, as the reader gets it.
        """
        return not self.folder and imported(str(self.code).replace(":read", ":recognizes"))(source)

    @property
    def names(self) -> tuple[str, ...]:
        """Returns the usual names of files, without the folders before them."""
        return tuple(dict.fromkeys(Path(file).name for file in self.files))


@dataclasses.dataclass(frozen=True)
class CameraFormat(SourceFormat):
    """A format of camera calibrations."""

    up: str = "-y"
    """The axis that points up."""
    pixel_centers: Literal["integer", "half"] = "integer"
    """Where the centre of the first pixel is: at (0, 0) or at (0.5, 0.5)."""
    per_image: bool = False
    """Whether files have an entry for each image. False: they have one for each real camera, which
    may have taken many images.
    """
    unit: float | None = None
    """Metres per unit of length. None: the format states no unit, or its reader converts lengths to
    metres.
    """

    def __str__(self) -> str:
        if self.files:
            return f"{self.about} ({', '.join(self.names)})"
        return self.about


class SourceFormats(Formats[F]):
    """Formats that are known by the content of their files."""

    def found(self, folder: Path) -> tuple[F, Path] | None:
        """Returns the first format that has a file with one of its usual names in the folder, and
        the path of this file. Returns None if the folder has no such file.
        """
        for each in self.values():
            for pattern in each.files:
                file = next(iter(sorted(visible(folder.glob(pattern)))), None)
                if file is not None:
                    return each, file
        return None

    def of_name(self, file: Path) -> F | None:
        """Returns the first format that reads the files of a folder together and has a file of this
        name among its usual names. Returns None if there is no such format.
        """
        named = (
            each
            for each in self.values()
            if each.folder and any(fnmatch(file.name, name) for name in each.names)
        )
        return next(named, None)

    def of_content(self, source: Any) -> F | None:
        """Returns the first format that recognizes the content of one file; None if none does.
        Formats that list the file's suffix are tried before the others. source: the file, as the
        reader gets it.
        """
        asked = sorted(
            self.values(), key=lambda each: source.path.suffix.lower() not in each.suffixes
        )
        return next((each for each in asked if each.fits(source)), None)

    def listed(self) -> str:
        """Returns all formats in one line of text."""
        return "; ".join(map(str, self.values()))


_CAMERAS = "humangs_jax.capture.calibration."
"""The package whose modules read cameras."""
_KEYPOINTS = "humangs_jax.capture.keypoints.formats:read_"
"""The module that reads keypoints, and the beginning of the names of its functions."""
_MODELS = ("", "sparse/0/", "sparse/", "0/")
CAMERAS = SourceFormats(
    colmap=CameraFormat(
        "COLMAP",
        _CAMERAS + "scenes:read_colmap",
        files=tuple(
            place + name
            for place in _MODELS
            for name in ("images.txt", "cameras.txt", "images.bin", "cameras.bin")
        ),
        content="text or binary: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV",
        folder=True,
        pixel_centers="half",
        per_image=True,
    ),
    easymocap=CameraFormat(
        "EasyMocap",
        _CAMERAS + "rigs:read_easymocap",
        files=("intri.yml", "extri.yml"),
        content="`names`, `K_NAME`, `dist_NAME`, `Rot_NAME` or `R_NAME`, `T_NAME`",
        folder=True,
        up="+z",
    ),
    transforms=CameraFormat(
        "NeRF, instant-ngp, nerfstudio or VHAP",
        _CAMERAS + "scenes:read_transforms",
        files=("transforms.json", "transforms_train.json"),
        content="JSON with `frames`: `transform_matrix` is camera-to-world with OpenGL's axes",
        up="+z",
        pixel_centers="half",
        per_image=True,
    ),
    splatting=CameraFormat(
        "3DGS",
        _CAMERAS + "scenes:read_splatting",
        content=(
            "JSON (`cameras.json` beside the splats): a list of `img_name`, `position`, `rotation`,"
            " `fx`, `fy`, `width`, `height`"
        ),
        pixel_centers="half",
        per_image=True,
    ),
    toml=CameraFormat(
        "Caliscope, Anipose or Pose2Sim",
        _CAMERAS + "rigs:read_toml",
        (".toml",),
        files=("camera_array.toml", "calibration.toml", "Calib*.toml"),
        content=(
            "TOML: `matrix`, `distortions`, `rotation`, `translation`, `size` in a table of each"
            " camera"
        ),
        up="+z",
    ),
    qualisys=CameraFormat(
        "Qualisys",
        _CAMERAS + "rigs:read_qualisys",
        files=("*.qca.txt",),
        content="XML: `transform`, `fov_video`, `intrinsic` of each camera",
        up="+z",
    ),
    panoptic=CameraFormat(
        "CMU Panoptic",
        _CAMERAS + "rigs:read_panoptic",
        files=("calibration_[0-9]*.json",),
        content="JSON: a list `cameras` of `K`, `distCoef`, `R`, `t`, `resolution`",
        unit=0.01,
    ),
    multical=CameraFormat(
        "multical",
        _CAMERAS + "rigs:read_multical",
        files=("calibration.json",),
        content=(
            "JSON: `K`, `dist`, `image_size` of each in `cameras`, `R`, `T` in `camera_poses`"
            " (`NAME` or `NAME_to_OTHER`)"
        ),
    ),
    opencv=CameraFormat(
        "OpenCV, AvatarReX or THuman4.0",
        _CAMERAS + "rigs:read_opencv",
        files=("calibration_full.json", "calibration.json", "calibration_shelf.json"),
        content=(
            "YAML or JSON: `K`, `R`, `T` in a map of each camera, or `K_NAME`, `R_NAME`, `T_NAME`;"
            " lens as `dist...` or `D`, size as `imgSize`, `image_size` or `width`, `height`"
        ),
    ),
)
"""The formats of camera calibrations, by name."""
KEYPOINTS = SourceFormats(
    humangs=SourceFormat(
        "humangs detect",
        _KEYPOINTS + "own",
        suffixes=(".npz",),
        files=("keypoints.json", "keypoints.npz"),
        content="33 points of BlazePose; `save_keypoints` (.npz): any set",
    ),
    openpose=SourceFormat(
        "OpenPose",
        _KEYPOINTS + "openpose",
        files=("openpose",),
        content=(
            "`--write_json`, a file an image: BODY_25, BODY_25B, COCO (18), hands; a list of frames"
            " of ControlNet's nodes"
        ),
    ),
    easymocap=SourceFormat(
        "EasyMocap",
        _KEYPOINTS + "easymocap",
        files=("annots",),
        content="`annots`, a file an image: BODY_25, hands",
    ),
    coco=SourceFormat(
        "COCO, COCO-WholeBody or AlphaPose",
        _KEYPOINTS + "coco",
        files=("alphapose-results.json", "alphapose.json"),
        content="results, or images and annotations: 17, 26, 133 or 136 points",
    ),
    mmpose=SourceFormat(
        "MMPose",
        _KEYPOINTS + "mmpose",
        files=("rtmpose", "mmpose", "predictions"),
        content="inferencer or demo scripts, a file an image or a video: 17, 26, 133 or 136 points",
    ),
)
"""The formats of detected keypoints, by name. Some names in `files` are names of folders."""


# Motions
# --------------------------------------------------------------------------------------------------

ARRAYS = "humangs_jax.motion.arrays:read_arrays"
ARRAY_SUFFIXES = (".npz", ".pkl", ".pickle", ".pt", ".pth", ".npy", ".smpl", ".json", FOLDER)
PLACES = {
    "all": (0, 55),
    "body": (0, 22),
    "root": (0, 1),
    "limbs": (1, 21),
    "jaw": (22, 1),
    "left_eye": (23, 1),
    "right_eye": (24, 1),
    "eyes": (23, 2),
    "face": (22, 3),
    "left_hand": (25, 15),
    "right_hand": (40, 15),
    "hands": (25, 30),
}
"""Each part of the body -> the index of its first joint among the joints of SMPL-X, and its number
of joints.

In SMPL the parts "body" and "limbs" have two further joints at the end, one for each whole hand.
"""


@dataclasses.dataclass(frozen=True)
class ArrayKeys:
    """The keys of the arrays of one person's motion, and the conventions of these arrays."""

    keys: tuple[str, ...]
    """A file that has all of these keys is of this format, unless it fits an earlier one in
    `MOTIONS`.
    """
    poses: dict[str, str]
    """Name of a part in `PLACES` -> key of the part's rotations in the file. The rotations are
    axis-angles or rotation matrices, unless `six` or `kind` says otherwise.
    """
    moves: tuple[str, ...] = ("trans", "transl")
    """The keys that positions may have. The first of these keys that the file has is used. If the
    file has none of them, see `stays`.
    """
    rates: tuple[str, ...] = ("mocap_framerate", "mocap_frame_rate", "fps", "frame_rate")
    """The keys that frames per second may have. The first of these keys that the file has is used.
    """
    fps: float | None = None
    """Frames per second if neither the user nor the file says them. None: one of the two must."""
    up: str = "y"
    """The axis that points up in files of this format, see `fixed`."""
    fixed: bool = False
    """Whether `up` is certain. If not, the poses may show that another axis is up."""
    also: tuple[str, ...] = ()
    """Other axes that point up in some files, see `rules.up_axis`."""
    scaling: str | None = None
    """The key of the number by which translations are divided to get metres. If the file does not
    have the key, the number is 1000. None: translations are in metres.
    """
    pivot: str = "pelvis"
    """The point whose positions the file has. "joint": the root joint. "head": the joint of the
    head. "pelvis": the positions are displacements of the pelvis from its place in the T-pose, as
    in SMPL. "origin": the person first turns about the origin, then the positions are added.
    """
    six: bool = False
    """Whether rotations are six numbers each, (j, 6, m) or (m, j, 6) for m frames."""
    stays: bool = False
    """Whether a person stays in place if the file has no positions. If not, such files are
    refused.
    """
    kind: str = "poses"
    """The kind of reader: "poses" for rotations of parts, "ours" for whole rotations, "points" for
    joints in space.
    """
    page: bool = True
    """Whether the viewer's web page reads this format, too."""


@dataclasses.dataclass(frozen=True)
class MotionFormat(Format):
    """A format of motion files.

    Its code is called as code(path, options), where options is a `motion.Reading`. It returns
    `motion.Poses` or a `skeleton.Clip`.
    """

    arrays: ArrayKeys | None = None
    """The keys of a format of arrays. A file is read by the first format with fitting keys,
    whichever of `ARRAY_SUFFIXES` it has. None: the files do not hold arrays.
    """


def _arrays(
    about: str, keys: str, poses: str, use: dict[str, Any] | None = None, **more: Any
) -> MotionFormat:
    """Returns a format of arrays. keys: separated by spaces. poses: PART=KEY, separated by spaces,
    as in "root=global_orient limbs=body_pose". use, more: further fields of `ArrayKeys`.
    """
    places = dict(each.split("=") for each in poses.split())
    return MotionFormat(
        about,
        ARRAYS,
        ARRAY_SUFFIXES,
        arrays=ArrayKeys(tuple(keys.split()), places, **(use or {}), **more),
    )


_FACE = "jaw=jaw_pose left_eye=leye_pose right_eye=reye_pose "
_PARTS = (
    f"root=global_orient limbs=body_pose {_FACE}left_hand=left_hand_pose right_hand=right_hand_pose"
)
_OF_CAMERA = (
    *("trans", "transl", "cam_t", "pred_cam_t_full", "pred_cam_t"),
    *("camera", "cam_trans", "translation", "orig_cam"),
)
CAMERA_MOVES = ("cam_t", "pred_cam_t_full", "pred_cam_t", "camera", "cam_trans", "orig_cam")
"""Keys of positions in the coordinates of a camera, whose y axis points down."""
_FOUND: dict[str, Any] = {"fps": DEFAULT_FPS, "also": ("-y",), "moves": _OF_CAMERA}
"""Fields of the formats of pose estimators. They write motions in the coordinates of a camera or in
a world. In either, the y axis may point down.
"""
_ALONE: dict[str, Any] = _FOUND | {"page": False}
MOTIONS = Formats(
    humangs=_arrays(
        *("ours", "rotations", "all=rotations"),
        moves=("translations",),
        rates=("fps",),
        fixed=True,
        kind="ours",
    ),
    aist=_arrays(
        *("AIST++", "smpl_poses", "all=smpl_poses"),
        use={
            "moves": ("smpl_trans",),
            "rates": ("fps",),
            "fps": 60.0,
            "fixed": True,
            "scaling": "smpl_scaling",
        },
    ),
    wham=_arrays(
        "WHAM", "pose_world trans_world", "all=pose_world", use=_ALONE | {"moves": ("trans_world",)}
    ),
    tram=_arrays(
        "TRAM", "pred_rotmat pred_trans", "all=pred_rotmat", use=_ALONE | {"moves": ("pred_trans",)}
    ),
    human3r=_arrays(
        "Human3R",
        "rotvec transl",
        "all=rotvec",
        use=_ALONE | {"up": "-y", "also": ("y",), "pivot": "head"},
    ),
    mdm=_arrays(
        *("MDM (_smpl_params.npy)", "thetas root_translation", "all=thetas"),
        use=_ALONE
        | {
            "moves": ("root_translation",),
            "fps": 20.0,
            "also": (),
            "pivot": "joint",
            "six": True,
        },
    ),
    kimodo=_arrays(
        *("Kimodo", "local_rot_mats root_positions", "all=local_rot_mats"),
        use=_ALONE | {"moves": ("root_positions",), "also": (), "pivot": "joint"},
    ),
    motionx=_arrays(
        *("Motion-X, a single array", "(m,322)"),
        "root=root_orient limbs=pose_body jaw=pose_jaw hands=pose_hand",
        use=_ALONE | {"moves": ("trans",), "also": ("z", "-y")},
    ),
    rows=_arrays(
        *("poses in a single array", "(m,165/156/72/66)", "all=(m,165/156/72/66)"),
        use=_ALONE | {"also": ("z", "-y"), "stays": True},
    ),
    sam3d=_arrays(
        "SAM 3D Body",
        "pred_joint_coords",
        "all=pred_joint_coords",
        use=_ALONE | {"moves": ("pred_cam_t",), "kind": "points"},
    ),
    smplcodec=_arrays(
        *(
            "smplcodec",
            "bodyPose",
            "body=bodyPose face=headPose left_hand=leftHandPose right_hand=rightHandPose",
        ),
        use=_FOUND | {"moves": ("bodyTranslation",), "rates": ("frameRate",), "stays": True},
    ),
    easymocap=_arrays(
        *("EasyMocap", "Rh Th poses", "root=Rh all=poses"),
        use=_ALONE | {"moves": ("Th",), "up": "z", "also": ("y", "-y"), "pivot": "origin"},
    ),
    beat=_arrays("BEAT2", "poses expressions", "all=poses"),
    amass=_arrays("AMASS", "poses", "all=poses", up="z"),
    prior=_arrays(
        *(
            "HuMoR, SLAHMR",
            "root_orient pose_body",
            "root=root_orient limbs=pose_body jaw=pose_jaw eyes=pose_eye hands=pose_hand",
        ),
        use={"fps": DEFAULT_FPS, "up": "z", "also": ("y", "-y")},
    ),
    lhm=_arrays(
        *("LHM, a pose a file", "root_pose"),
        f"root=root_pose limbs=body_pose {_FACE}left_hand=lhand_pose right_hand=rhand_pose",
        use=_FOUND | {"moves": ("trans",)},
    ),
    parts=_arrays(
        *("THuman4.0, AvatarReX, GVHMR, 4D-Humans, SMPLer-X", "body_pose", _PARTS),
        use=_FOUND | {"rates": ("fps", "mocap_framerate", "mocap_frame_rate"), "stays": True},
    ),
    smplx=_arrays("SMPL-X (fullpose)", "fullpose", "all=fullpose", up="z"),
    prompthmr=_arrays("PromptHMR", "rotmat shape", "all=rotmat", use=_ALONE),
    camera=_arrays("PromptHMR, CamSMPLify", "pose shape", "all=pose", use=_ALONE),
    vibe=_arrays("VIBE", "pose pred_cam", "all=pose", use=_ALONE | {"stays": True}),
    tcmr=_arrays("TCMR", "pose verts", "all=pose", use=_ALONE | {"stays": True}),
    local=_arrays("WHAM of one camera", "pose frame_ids", "all=pose", use=_ALONE | {"stays": True}),
    smpl=_arrays("SMPL (pose)", "pose", "all=pose", up="z", also=("y", "-y")),
    bvh=MotionFormat("skeletons of other programs", "humangs_jax.motion.clips:read_bvh", (".bvh",)),
    glb=MotionFormat(
        "skeletons of other programs",
        "humangs_jax.motion.clips:read_animation",
        (".glb", ".vrma"),
    ),
    face=MotionFormat(
        "faces of Live Link Face or with ARKit's names",
        "humangs_jax.motion.face_files:read_table",
        (".csv",),
    ),
    scores=MotionFormat(
        "faces of MediaPipe",
        "humangs_jax.motion.face_files:read_scores",
        (".json",),
        "humangs_jax.motion.face_files:has_scores",
    ),
)
"""The formats of motions by name, in the order in which keys and files are compared with them."""

# Data sets
# --------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class DataSetFormat(Format):
    """A data set of captured people.

    Its code is called as code(path, body). It opens one subject, and returns a `subject.Subject`.
    See `lists` and `scans` for exceptions.
    """

    find: str | Callable[[Path], tuple[Path, ...]] = ""
    """The function that finds the subjects below a path, or its name as "package.module:function".
    It returns their sorted paths. If the path is the folder of one subject, a list of people or a
    folder of scans, it returns this path alone. The result is empty if the path has another layout.
    """
    lists: bool = False
    """Whether one file lists many people. The code is then called as code(path, body, size), and
    returns a tuple of `subject.Person`.
    """
    scans: bool = False
    """Whether people are textured scans, of which `humangs preprocess` has to render photos first.
    The code then takes only the path, see `thuman.open_thuman`.
    """


def _data_set(about: str, place: str, **options: bool) -> DataSetFormat:
    """Returns a data set that is read by the functions open_NAME and find_NAME of a module in
    `data.datasets`. place: "MODULE:NAME". options: `lists` and `scans` of the format.
    """
    code, find = (
        f"humangs_jax.data.datasets.{place.replace(':', f':{do}_')}" for do in ("open", "find")
    )
    return DataSetFormat(
        about, code, find=find, lists=options.get("lists", False), scans=options.get("scans", False)
    )


DATASETS: Formats[DataSetFormat] = Formats(
    {
        "scenes": _data_set("scene list", "scene_list:scene_list", lists=True),
        "thuman": _data_set("THuman2.0 and 2.1", "thuman:thuman", scans=True),
        "thuman4": _data_set("THuman4.0", "multiview:thuman4"),
        "avatarrex": _data_set("AvatarReX", "multiview:avatarrex"),
        "actorshq": _data_set("ActorsHQ", "multiview:actorshq"),
        "dna-rendering": _data_set("DNA-Rendering", "multiview:dna_rendering"),
    }
)
"""The data sets by name, in the order in which a folder is compared with them."""
