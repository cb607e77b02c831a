"""The commands `humangs detect`, `import` and `synth`.

They find people in photos, and make capture folders from calibrated photos or from synthetic
people.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from tyro.conf import Positional, arg

from humangs_jax.cli.options import (
    OutputPath,
    UsageError,
    Workers,
    cores,
    require_replaceable,
    tell_deleted,
)
from humangs_jax.cli.screen import stage, suggest, tell, warn, wrote
from humangs_jax.core.configuration import at_least
from humangs_jax.data.formats import CAMERAS

if TYPE_CHECKING:
    from humangs_jax.apps.detect import PhotoPeople


def tell_found(photos: "list[PhotoPeople]", person: int) -> None:
    """Warns about what is doubtful in the photos of a person, see `apps.detect.remarks`."""
    from humangs_jax.apps.detect import remarks

    for line in remarks(photos, person):
        warn(line)


def found_here(capture: Path, person: int | None) -> Path:
    """Returns the file of keypoints in a capture folder.

    If the folder lacks keypoints or masks, or if `person` is given, keypoints are found in its
    photos and written there. So are masks if it has none. person: number of the person on the
    sheet, if the photos show several people.

    Raises: as `load_photos`, `detect.person_in_capture` and `detect.write_found`.
    """
    from humangs_jax.apps import detect
    from humangs_jax.data.photos import capture_folder, load_photos

    folder = capture_folder(capture)
    file = folder / detect.KEYPOINTS_FILE
    photos = load_photos(folder)
    if not file.exists() or person is not None or photos.masks is None:
        detect.check_found_place(
            folder,
            [f"{name}.png" for name in photos.names],
            "move it away, or give keypoints that are there by --keypoints FILE",
            masks=photos.masks is None,
        )
        people, number = detect.person_in_capture(folder, photos, person=person)
        detect.write_found(folder, people, number, masks=photos.masks is None, to_capture=True)
        tell_found(people, number)
        what = "keypoints" if photos.masks is not None else "keypoints and masks"
        tell(f"{what} found in the photos: {folder / detect.SHEET_FILE} shows them")
    return file


@dataclasses.dataclass(frozen=True)
class Detect:
    """Find the person in photos: keypoints and masks.

    people.png shows everybody with a number. Needs `pip install 'humangs_jax[photos]'`. docs:
    your_photos.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs detect photos --out found",
        "humangs detect photos --person 1 --out found",
    )
    photos: Positional[Path]
    """Folder of the photos, or a capture folder, which need not have a body yet."""
    out: Annotated[Path, OutputPath()]
    """Folder for keypoints.json, masks/ and people.png (the sheet)."""
    person: Annotated[int | None, at_least(0)] = None
    """Number of the person on people.png. Default: the only large person. Needed if several people
    are large.
    """
    overwrite: bool = False
    """Also replace keypoints.json, people.png and masks of other programs."""

    def run(self) -> None:
        with stage("starting"):
            from humangs_jax.apps import detect

        if not self.overwrite:
            detect.check_found_place(
                self.out, detect.names_in(self.photos), "choose another folder, or --overwrite"
            )
        with stage("finding people"):
            photos = detect.found_in_photos(self.photos)
            left_out = detect.left_out(self.photos)
        person = detect.choose(photos, self.person, self.out / detect.SHEET_FILE)
        with stage("writing"):
            detect.write_found(self.out, photos, person, overwrite=self.overwrite)
        tell_found(photos, person)
        if left_out is not None:
            tell(left_out)
        wrote(self.out / detect.KEYPOINTS_FILE, f"keypoints of the person in {len(photos)} photos")
        wrote(self.out / detect.MASKS, "what of each photo is the person")
        wrote(self.out / detect.SHEET_FILE, "look at it")
        suggest("humangs fit CAPTURE --keypoints", self.out / detect.KEYPOINTS_FILE)


SIZES = (128, 256, 512)
"""Sides of photos that `humangs synth` can write, pixels. Training reads these sizes."""


@dataclasses.dataclass(frozen=True)
class ImportCameras:
    """Make a capture folder from photos and calibrated cameras.

    Afterwards `humangs fit` finds the body. Conventions of every format: docs: cameras.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs import cameras calibration.json --images photos --masks masks --out me",
        "humangs import cameras sparse/0 --images photos --scale 0.01 --up=-y --out me",
    )
    what: Positional[Literal["cameras"]]
    """The word "cameras"."""
    source: Annotated[
        Positional[Path], arg(help=f"File or folder with the calibration: {CAMERAS.listed()}.")
    ]
    images: Path
    """Folder of the photos, or of one video per camera (CAMERA.mp4). All videos begin at the same
    moment.
    """
    out: Path
    """The capture folder to write."""
    masks: Path | None = None
    """Folder of masks, named like the photos."""
    others: Path | None = None
    """Folder of masks of other people and of things in front of the person, named like the photos.
    Photos that show none need no mask.
    """
    scale: float | None = None
    """Metres per unit of the source. Default: the unit of its format, or one that fits."""
    up: str | None = None
    """Axis of the source's world that points up, like --up=+z or --up=-y. Default: the format's."""
    pixel_centers: Literal["integer", "half"] | None = None
    """Position of the first pixel's centre in the source: 0 (integer) or 0.5 (half).

    Default: the format's.
    """
    every: int = 1
    """Frame step of videos: 10 takes frames 0, 10, 20 and so on."""
    max_frames: int | None = None
    """Take at most this many frames of the videos."""
    overwrite: bool = False
    """Replace an existing capture folder."""

    def run(self) -> None:
        inputs = (self.source, self.images, self.masks, self.others)
        require_replaceable(self.out, self.overwrite, "capture.json", inputs)
        with stage("starting"):
            from humangs_jax.capture.calibration.importing import import_cameras
            from humangs_jax.capture.detection.people import available

        options = {
            name: value for name, value in vars(self).items() if name not in ("what", "max_frames")
        }
        if self.overwrite and (self.out / "capture.json").is_file():
            tell_deleted(self.out)
        with stage("importing"):
            report = import_cameras(**options, frames=self.max_frames)
        tell(report)
        # without a detector keypoints have to come from a file
        if available():
            suggest("humangs fit", self.out)
        else:
            install = "pip install 'humangs_jax[photos]', and they are found in the photos"
            suggest("humangs fit", self.out, f"--keypoints FILE (or {install})")


@dataclasses.dataclass(frozen=True)
class Synth:
    """Make synthetic clothed people and write them as capture folders.

    Can be interrupted and resumed, or added to. docs: synthetic_people.
    """

    examples: ClassVar[tuple[str, ...]] = (
        "humangs synth --subjects 100 --for-training --out people",
        "humangs synth --subjects 8 --split test --held-out 6 --out test_people",
    )
    out: Annotated[Path, OutputPath()] = Path("synthetic_people")
    """Folder for one capture folder per subject and manifest.json."""
    subjects: Annotated[int, at_least(1)] = 8
    """Number of people."""
    split: Literal["train", "validation", "test", "demo"] = "train"
    """Which set of seeds to use. The seeds of different sets never overlap."""
    first: Annotated[int, at_least(0)] = 0
    """Number of the first subject within the split."""
    size: int = 512
    """Side of the photos in pixels: 128, 256, 512 (a set of 512 can be read at all three)."""
    views: Annotated[int | None, at_least(1)] = None
    """Number of photos of each pose, around the person, from 1.8 to 2.2 bounding radii away.
    Default: 60.
    """
    close_views: Annotated[int | None, at_least(0)] = None
    """Number of further photos of each pose that show parts of the person, from 0.8 to 1.7 radii
    away.

    Default: 12, or 0 with --views or --for-training.
    """
    poses: Annotated[int, at_least(1)] = 1
    """Number of poses of each person."""
    sequences: bool = False
    """Take the poses from a motion: a walk, a turn or a reach, which is written as motion.npz."""
    motion_frames: Annotated[int, at_least(1)] = 60
    """Number of frames of the motion of --sequences, 30 per second."""
    for_training: bool = False
    """Short for 2 poses x 12 views at 256 pixels and no close views, which is enough for `humangs
    train`.
    """
    held_out: Annotated[int, at_least(0)] = 0
    """Number of views of the first pose from other cameras, in the sub-folder held_out/."""
    scans: bool = False
    """Also write scan/: the first pose as a textured mesh, OBJ and GLB."""
    workers: Workers = None
    """Number of processes. Default: one for each core."""

    def run(self) -> None:
        if self.size not in SIZES:
            raise UsageError(
                f"--size {self.size}: expected {', '.join(map(str, SIZES[:-1]))} or {SIZES[-1]}"
            )
        if self.sequences and self.poses > self.motion_frames:
            raise UsageError(
                f"--poses {self.poses}: expected at most --motion-frames {self.motion_frames}"
            )
        # --for-training stands for other options, which may not contradict it
        small = {}
        if self.for_training:
            small = {"size": 256, "poses": 2, "views": 12, "close_views": 0}
        defaults = {field.name: field.default for field in dataclasses.fields(self)}
        for name, value in small.items():
            if getattr(self, name) not in (value, defaults[name]):
                option = name.replace("_", "-")
                raise UsageError(
                    f"--{option} {getattr(self, name)}: does not go with --for-training, which"
                    f" means {value}"
                )
        with stage("starting"):
            from humangs_jax.synthetic.writer import Layout, write_set

        # close views are part of the full set, and of another only where they are asked for
        close_views = self.close_views
        if close_views is None:
            close_views = 12 if self.views is None else 0
        layout = Layout(
            small.get("size", self.size),
            small.get("poses", self.poses),
            small.get("views", self.views or 60),
            small.get("close_views", close_views),
            self.held_out,
            frames=self.motion_frames if self.sequences else 0,
            scan_texture=2048 if self.scans else 0,
        )
        with stage("making people"):
            folders = write_set(
                self.out, self.subjects, layout, self.split, self.first, workers=cores(self.workers)
            )
        wrote(self.out, f"{len(folders)} people")
        suggest("humangs train", self.out, "--out runs/train")
