"""Finds the photos in a folder and the files that an avatar needs. Says which of these files are
missing, and which well-known tools make them.

The user need not describe the folder, because its files are found by their names.
docs/your_photos.md shows the way. The module also holds a photo out, measures how well an avatar of
the other photos reproduces it, and chooses between two bodies by this measure. `apps.video_photos`
takes the best frames of a video.
"""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from humangs_jax.avatar.avatar import Avatar
from humangs_jax.avatar.reconstruct import reconstruct
from humangs_jax.capture.calibration.photos import (
    MASK_FOLDERS,
    NO_PHOTOS,
    OTHERS_FOLDERS,
    is_transparent,
)
from humangs_jax.core.array_types import Float, PyTree
from humangs_jax.core.processes import Ahead
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.folders import (
    ELSEWHERE,
    VIDEO_SUFFIXES,
    FolderScan,
    Unused,
    scan_folder,
    unused_line,
)
from humangs_jax.data.formats import CAMERAS, KEYPOINTS
from humangs_jax.data.prepared import PreparedCapture, prepare_capture
from humangs_jax.data.view_choice import best_views
from humangs_jax.data.views import cropped
from humangs_jax.evaluation.cases import predict_views
from humangs_jax.io.images import PHOTO_SUFFIXES, image_size
from humangs_jax.io.reading import visible
from humangs_jax.losses.alignment import ASKED, aligned_psnr, photos_agree
from humangs_jax.losses.losses import LARGEST_PSNR
from humangs_jax.network.config import HumanGSConfig
from humangs_jax.refinement.config import RefineConfig
from humangs_jax.refinement.refine import calls_of_refine, refine

_KEYPOINT_FOLDER = "keypoints"
_OWN_DETECTOR = (
    "pip install 'humangs_jax[photos]', and the same command finds them; or with another program:"
)
"""Advice for masks and keypoints if LiteRT is not installed."""


@dataclasses.dataclass(frozen=True)
class PhotoFolder:
    """The photos of a folder, and the files beside them that can be used."""

    folder: Path
    """The folder that was looked at."""
    images: Path
    """The folder in which the photos are: `folder` itself or a folder in it."""
    photos: int
    """Number of the photos."""
    size: tuple[int, int]
    """Width and height of the first photo, pixels."""
    cameras: Path | None = None
    """File or folder of a calibration; None if there is none."""
    masks: Path | None = None
    """Folder of masks; None if there is none."""
    alpha: bool = False
    """Whether photos have masks in alpha channels, as the first photo shows."""
    keypoints: Path | None = None
    """File or folder of keypoints; None if there are none."""
    unused: tuple[Unused, ...] = ()
    """Files that are not used."""
    others: Path | None = None
    """Folder of masks of other people and of things in front of the person; None if there is none.
    """

    def __str__(self) -> str:
        """Returns one line for each kind of file, and one for files that are not used."""
        masks = self.masks or ("in the photos' alpha channel" if self.alpha else None)
        rows = {
            "photos": (
                f"{self.photos} in {self.images}, the first of {self.size[0]} x {self.size[1]}"
                " pixels"
            ),
            "cameras": self.cameras,
            "masks": masks,
            "keypoints": self.keypoints,
        }
        if self.others is not None:
            rows["in front"] = self.others
        lines = [
            f"{name + ':':<11}{'missing' if found is None else found}"
            for name, found in rows.items()
        ]
        left_out = unused_line(self.unused)
        return "\n".join([*lines, *([] if left_out is None else [left_out])])


@dataclasses.dataclass(frozen=True)
class Missing:
    """Something that is missing, and how to make it."""

    name: str
    """What is missing: cameras, masks or keypoints."""
    why: str
    """What it is needed for."""
    how: tuple[str, ...]
    """Command lines and advice, one line each."""

    def __str__(self) -> str:
        """Returns a heading with name and purpose, then indented lines."""
        return "\n".join([f"{self.name}: {self.why}", *(f"    {line}" for line in self.how)])


def inspect_folder(
    folder: Path,
    *,
    cameras: Path | None = None,
    masks: Path | None = None,
    keypoints: Path | None = None,
    others: Path | None = None,
) -> PhotoFolder:
    """Returns the photos of a folder, and the files beside them. A file or folder that an argument
    names is used instead of the one in `folder`.

    Raises: CaptureError (one line) if there is no such folder, if it has no photo, if it is a
    capture already, or if what an argument names does not exist. FileError if the first photo
    cannot be read.
    """
    _expect_folder(folder)
    if (folder / "capture.json").is_file():
        raise CaptureError(folder, "", f"is a capture already: `humangs check {folder}` shows it")
    for path in (cameras, masks, keypoints, others):
        if path is not None and not path.exists():
            raise CaptureError(path, "", "no such file or folder")
    scan = scan_photos(folder)
    images, photos = scan.folder, scan.photos
    # places by their names; what the arguments name goes before them
    mask_folders = [folder / name for name in MASK_FOLDERS if has_photos(folder / name)]
    in_front = [folder / name for name in OTHERS_FOLDERS if has_photos(folder / name)]
    named = []
    if (folder / _KEYPOINT_FOLDER).exists():
        named = [folder / _KEYPOINT_FOLDER]
    found = KEYPOINTS.found(folder)
    if found:
        named.append(found[1])
    # where no name is known: whatever is called keypoints
    further = sorted(
        path for path in visible(folder.glob("*keypoint*")) if path.suffix in ("", ".json", ".npz")
    )
    names = ".", "cameras", "calibration", "calib", "colmap", "colmap/sparse/0"
    places = [folder / name for name in names]
    return PhotoFolder(
        folder=folder,
        images=images,
        photos=len(photos),
        size=image_size(photos[0]),
        cameras=cameras or next((place for place in places if CAMERAS.found(place)), None),
        masks=masks or next(iter([*mask_folders, *([images] if scan.masks else [])]), None),
        alpha=is_transparent(photos[0]),
        keypoints=keypoints or next(iter([*named, *further]), None),
        unused=scan.unused,
        others=others or next(iter(in_front), None),
    )


look = inspect_folder
"""The earlier name of `inspect_folder`. It will be removed in version 0.3."""


def photo_files(folder: Path) -> tuple[Path, list[Path]]:
    """Returns the folder that has the photos, and their files in order.

    Raises: CaptureError (one line) if there is no such folder, or no photo in it.
    """
    scan = scan_photos(folder)
    return scan.folder, list(scan.photos)


def scan_photos(folder: Path) -> FolderScan:
    """Finds the photos of a folder. They may be in a subfolder such as "images" or "photos". The
    result also lists the files of the folder and of the subfolder that are not used.

    Raises: CaptureError (one line) if there is no such folder, or no photo in it.
    """
    _expect_folder(folder)
    places = (folder / name for name in ("images", "photos", "imgs", "rgb"))
    images = next((place for place in places if has_photos(place)), folder)
    whole = _scan(folder)
    if images == folder:
        scan = whole
    else:
        scan = _scan(images)
        others = [
            Unused(photo, ELSEWHERE) for photo in whole.photos if not photo.is_relative_to(images)
        ]
        others += [each for each in whole.unused if not each.path.is_relative_to(images)]
        scan = dataclasses.replace(scan, unused=(*scan.unused, *others))
    if not scan.photos:
        expected = f"expected {', '.join(PHOTO_SUFFIXES)} files in it or in {folder / 'images'}"
        left_out = unused_line(scan.unused)
        others = "" if left_out is None else f" ({left_out})"
        raise CaptureError(folder, "", f"no photo: {expected}{others}")
    return scan


def _expect_folder(folder: Path) -> None:
    if not folder.is_dir():
        wrong = "is a file" if folder.exists() else "no such folder"
        raise CaptureError(
            folder,
            "",
            f"{wrong}: expected a folder of photos, or a video ({', '.join(VIDEO_SUFFIXES)})",
        )


def missing(material: PhotoFolder, images: Path | None = None) -> tuple[Missing, ...]:
    """Returns which of cameras, masks and keypoints are missing, with the commands that make them.

    Arguments: images: folder of the photos for which keypoints are to be made. Give it if an import
    has changed the photos, for example by removing lens distortion. None: the photos of `material`.
    """
    folder, found = material.folder, []
    # two ways to cameras: structure from motion, or a calibrated set
    if material.cameras is None:
        workspace = folder / "colmap"
        model = workspace / "sparse" / "0"
        how = (
            (
                "many overlapping photos of someone who stands still, with COLMAP"
                " (https://colmap.github.io):"
            ),
            (
                f"  mkdir {workspace} && colmap automatic_reconstructor --workspace_path"
                f" {workspace} --image_path {material.images} --single_camera 1 --dense 0"
            ),
            (
                f"  colmap model_converter --input_path {model} --output_path {model}"
                " --output_type TXT"
            ),
            "  its unit is arbitrary: measure something, and add --scale METRES_PER_UNIT",
            (
                "few cameras that stand still: calibrate them with a checkerboard, in OpenCV or"
                " EasyMocap;"
            ),
            f"  put calibration.json, or intri.yml and extri.yml, into {folder} (docs/cameras.md)",
        )
        found.append(Missing("cameras", "where each photo was taken from, and its lens", how))
    # a photo with an alpha channel has its mask already
    if material.masks is None and not material.alpha:
        how = (
            _OWN_DETECTOR,
            'rembg: pip install "rembg[cpu,cli]"',
            f"  rembg p -m u2net_human_seg -om {material.images} {folder / 'masks'}",
            (
                "where it takes something else for the person: SAM 2"
                " (https://github.com/facebookresearch/sam2)"
            ),
            "photos with nothing but white behind the person: --without-masks",
        )
        found.append(Missing("masks", "what of each photo is the person", how))
    # keypoints have to be of the photos that the capture has
    if material.keypoints is None:
        source, target = images or material.images, folder / "keypoints"
        how = (
            _OWN_DETECTOR,
            "RTMPose, in a checkout of MMPose (https://github.com/open-mmlab/mmpose):",
            f"  python demo/inferencer_demo.py {source} --pose2d wholebody --pred-out-dir {target}",
            "or OpenPose (https://github.com/CMU-Perceptual-Computing-Lab/openpose):",
            (
                f"  openpose.bin --image_dir {source} --write_json {target} --hand --display 0"
                " --render_pose 0"
            ),
        )
        found.append(
            Missing("keypoints", "where shoulders, knees and fingers are, for `humangs fit`", how)
        )
    return tuple(found)


def has_photos(folder: Path) -> bool:
    """Returns whether a folder or one of its subfolders has a photo."""
    return bool(_scan(folder).photos)


def _scan(folder: Path) -> FolderScan:
    """Scans a folder for photos. Skips masks, keypoints and what other programs have made of
    photos.
    """
    others = (
        *NO_PHOTOS,
        _KEYPOINT_FOLDER,
        *(name for each in KEYPOINTS.values() for name in each.files),
        "colmap",
    )
    return scan_folder(folder, lambda place: place.name in others)


# A held-out photo
# --------------------------------------------------------------------------------------------------


READ = 8
"""Largest number of photos that the network reads if cameras were found from the person. More
photos would take longer and give no sharper avatar. All photos serve for poses and refinement.
"""
SIZE = 512
"""Side of the crop in which bodies are compared, pixels."""
LONGEST = 1024
"""Photos whose longer side exceeds this are reduced to it before one is held out, pixels."""


class HeldOut(NamedTuple):
    """How well an avatar reproduces a photo that was held out of it."""

    name: str
    """Name of the photo that was held out."""
    psnr: float
    """PSNR over the person, dB."""
    aligned: float
    """PSNR of colors and coverage after small moves of the photo, dB, see `losses.alignment`. It
    decides which body is kept.
    """

    def __str__(self) -> str:
        """Returns one line with the photo's name and its PSNR."""
        return (
            f"a photo that was held out ({self.name}) is reproduced with {self.psnr:.1f} dB in the"
            " foreground"
        )


def held_out_psnr(
    variables: PyTree,
    config: HumanGSConfig,
    capture: Capture | PreparedCapture,
    refinement: RefineConfig | None,
    number: int = 0,
    watch: Callable[[Avatar, PreparedCapture], None] | None = None,
) -> HeldOut | None:
    """Holds one photo out, makes an avatar from the other photos, and measures how well the avatar
    reproduces the photo over the person, in a crop of `SIZE` pixels. Returns None for fewer than
    four photos or without masks.

    Body and cameras stay as they were fitted to all photos. A second copy of the nearest photo
    takes the place of the photo that is held out, because the programs for that number of photos
    are compiled already.

    Arguments:
        variables, config: the variables and the configuration of the network.
        refinement: how the avatar is refined, always without steps on the head; None: not at all.
        number: which photo is held out. 0 is the photo with the nearest neighbour, 1 the next in
            this order.
        watch: is called before refinement, with the avatar and the photos from which it was made.
    Raises: as `prepare_capture` and `reconstruct`.
    """
    photos = _photos_to_hold_out(capture)
    capture = photos.capture
    # of fewer than four photos none is held out
    if capture.masks is None or capture.view_count < 4:
        return None
    views = np.arange(capture.view_count)
    apart = _distances(capture)
    view = int(np.argsort(apart.min(axis=1), kind="stable")[number])
    others = photos.select(np.where(views == view, int(apart[view].argmin()), views))
    avatar = reconstruct(variables, config, others)
    if watch is not None:
        watch(avatar, others)
    if refinement is not None:
        # heads hardly change the number
        avatar = refine(avatar, others, dataclasses.replace(refinement, head_steps=0))
    photo = cropped(_with_unknown(capture.select([view])), SIZE)
    assert photo.masks is not None and photo.unknown is not None
    drawn = predict_views(avatar, photo)
    assert drawn.alpha is not None
    psnr = _psnr_of_person(drawn.images[0], photo.images[0], photo.masks[0])
    aligned = aligned_psnr(
        np.concatenate([drawn.images[0], drawn.alpha[0][..., None]], axis=-1),
        np.concatenate([photo.images[0], photo.masks[0][..., None]], axis=-1),
        ~photo.unknown[0],
    )
    return HeldOut(capture.names[view], psnr, aligned)


def _psnr_of_person(
    image: Float[np.ndarray, "h w 3"],
    photo: Float[np.ndarray, "h w 3"],
    mask: Float[np.ndarray, "h w"],
) -> float:
    """Returns the score `psnr_fg` of `evaluation.scores`, dB, without compiling the programs of the
    other scores. mask: (h, w), 0 to 1.
    """
    errors = np.mean(np.square(image - photo), axis=-1)
    mean = float(np.sum(errors * mask) / max(np.sum(mask), 1e-6))
    return min(LARGEST_PSNR, -10 * float(np.log10(max(mean, 1e-30))))


def _photos_to_hold_out(capture: Capture | PreparedCapture) -> PreparedCapture:
    """Returns the prepared photos of which one will be held out. They are the photos that the
    network reads. If their longer side exceeds `LONGEST` pixels, they are reduced to it.
    """
    photos = photos_to_read(prepare_capture(capture))
    large = max(photos.capture.images.shape[1:3]) > LONGEST
    return photos.resized(LONGEST) if large else photos


def _with_unknown(capture: Capture) -> Capture:
    """Returns the capture with unknown areas, empty if it has none. A crop needs them to mark what
    is beyond the photo.
    """
    if capture.unknown is not None:
        return capture
    return dataclasses.replace(capture, unknown=np.zeros(capture.images.shape[:3], bool))


def photos_to_read(photos: PreparedCapture) -> PreparedCapture:
    """Selects the photos that the network reads. Where cameras were found from the person, these
    are the `READ` photos that show the body best; else they are all photos.
    """
    if photos.capture.calibrated or photos.capture.view_count <= READ:
        return photos
    return photos.select(best_views(photos.capture, READ))


def better_body(
    variables: PyTree,
    config: HumanGSConfig,
    first: Capture,
    second: Capture,
    refinement: RefineConfig | None,
    ahead: Ahead | None = None,
) -> tuple[Capture, HeldOut | None]:
    """Chooses between two captures that differ in the body. Returns the one whose avatar reproduces
    held-out photos better, and how well that avatar reproduces the first held-out photo after
    refinement.

    A body that fills the clothes covers more of the masks, but the avatar is not better for it, so
    photos decide. Several photos vote, see `photos_agree`. The second capture has to be better by
    0.1 dB. The avatars are compared without refinement: the better body is already better then, and
    refinement takes most of the time. Without masks or with fewer than four photos, the first
    capture and None are returned.

    Arguments: refinement: as for `held_out_psnr`. ahead: compiles the programs of the refinement in
    the background.
    Raises: as `held_out_psnr`.
    """
    photos = _photos_to_hold_out(first)

    def compile_refinement(avatar: Avatar, read: PreparedCapture) -> None:
        """Queues the programs of refinement for compilation: first for the photos `read`, then for
        all photos. The programs suit all avatars that are compared.
        """
        if ahead is not None and refinement is not None:
            ahead.add(calls_of_refine(avatar, read, refinement))
            ahead.add(calls_of_refine(avatar, photos, refinement))

    begun = held_out_psnr(variables, config, photos, None, watch=compile_refinement)
    if begun is None:
        return first, None
    others = _photos_to_hold_out(second)

    def gains() -> Iterator[float]:
        for number in range(ASKED):
            one = begun
            if number:
                one = held_out_psnr(variables, config, photos, None, number)
            two = held_out_psnr(variables, config, others, None, number)
            if one is None or two is None:
                return
            yield two.aligned - one.aligned

    chosen, shown = first, photos
    # the second body has to be better by a tenth of a decibel in the photos that are asked
    if photos_agree(gains(), 0.1):
        chosen, shown = second, others
    if refinement is None and chosen is first:
        return first, begun
    return chosen, held_out_psnr(variables, config, shown, refinement)


def _distances(capture: Capture) -> Float[np.ndarray, "v v"]:
    """Returns distances between the directions in which the cameras see the person, (v, v).

    Directions are unit vectors in the axes of the pelvis, so they also differ if somebody turns in
    front of one camera. 9 is added on the diagonal, so that no photo is its own nearest neighbour.
    """
    frames = np.asarray(capture.frames)
    pelvis = np.asarray(capture.poses.rotations, np.float64)[frames, 0]
    world_from_pelvis = Rotation.from_rotvec(pelvis).as_matrix()
    cam_from_world = np.asarray(capture.cameras.cam_from_world, np.float64)
    centers = np.linalg.inv(cam_from_world)[:, :3, 3]
    towards = centers - np.asarray(capture.poses.translation, np.float64)[frames]
    towards = np.einsum("vba,vb->va", world_from_pelvis, towards)
    towards = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    return np.linalg.norm(towards[:, None] - towards, axis=-1) + 9 * np.eye(len(towards))
