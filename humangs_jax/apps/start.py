"""From a folder of photos to an avatar: what is there, what is missing, and which well-known tool makes it.

Nothing is asked: the folder is looked at. docs/your_photos.md shows the way.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from humangs_jax.data.calibration.photos import SUFFIXES, is_photo
from humangs_jax.data.calibration.videos import SUFFIXES as VIDEOS
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.formats import CAMERAS, KEYPOINTS
from humangs_jax.io.images import image_size, open_image
from humangs_jax.io.reading import reading, walk

PHOTO_FOLDERS = ("images", "photos", "imgs", "rgb")
MASK_FOLDERS = ("masks", "mask", "mattes", "matte", "silhouettes")
CAMERA_PLACES = (".", "cameras", "calibration", "calib", "colmap", "colmap/sparse/0")
"""Names that are looked for in the folder of photos, in this order; those of files: `data.formats`."""
KEYPOINT_FOLDER = "keypoints"
OWN_DETECTOR = ("pip install 'humangs_jax[photos]', and the same command finds them; or with another program:",)
"""For masks and keypoints: said where LiteRT is not installed."""


@dataclasses.dataclass(frozen=True)
class Material:
    """What a folder has.

    folder: that was looked at. images: the folder of its photos. photos: their number. size: of the first one, pixels.
    cameras, keypoints: file or folder, masks: folder, None where there is none. alpha: whether photos carry their mask.
    """

    folder: Path
    images: Path
    photos: int
    size: tuple[int, int]
    cameras: Path | None = None
    masks: Path | None = None
    alpha: bool = False
    keypoints: Path | None = None

    def __str__(self) -> str:
        """A line for each kind of thing."""
        masks = self.masks or ("in the photos' alpha channel" if self.alpha else None)
        rows = {
            "photos": f"{self.photos} in {self.images}, the first of {self.size[0]} x {self.size[1]} pixels",
            "cameras": self.cameras,
            "masks": masks,
            "keypoints": self.keypoints,
        }
        return "\n".join(f"{name + ':':<11}{'missing' if found is None else found}" for name, found in rows.items())


@dataclasses.dataclass(frozen=True)
class Missing:
    """Something that is not there. why: what it is for. how: command lines and advice, a line each."""

    name: str
    why: str
    how: tuple[str, ...]

    def __str__(self) -> str:
        """Indented lines under a heading."""
        return "\n".join([f"{self.name}: {self.why}", *(f"    {line}" for line in self.how)])


def look(
    folder: Path, *, cameras: Path | None = None, masks: Path | None = None, keypoints: Path | None = None
) -> Material:
    """What a folder has; what the arguments name is taken from there.

    Raises: CaptureError, one line, if there is no photo, the folder is a capture already, or a named file does not exist.
    """
    _expect_folder(folder)
    if (folder / "capture.json").is_file():
        raise CaptureError(folder, "", f"is a capture already: `humangs check {folder}` shows it")
    for path in (cameras, masks, keypoints):
        if path is not None and not path.exists():
            raise CaptureError(path, "", "no such file or folder")
    images, photos = photo_files(folder)
    named = [folder / KEYPOINT_FOLDER] if (folder / KEYPOINT_FOLDER).exists() else []
    named += [found[1]] if (found := KEYPOINTS.found(folder)) else []
    others = sorted(path for path in folder.glob("*keypoint*") if path.suffix in ("", ".json", ".npz"))
    return Material(
        folder=folder,
        images=images,
        photos=len(photos),
        size=image_size(photos[0]),
        cameras=cameras or next((place for name in CAMERA_PLACES if CAMERAS.found(place := folder / name)), None),
        masks=masks or next((place for name in MASK_FOLDERS if any(find_photos(place := folder / name))), None),
        alpha=_has_alpha(photos[0]),
        keypoints=keypoints or next(iter([*named, *others]), None),
    )


def photo_files(folder: Path) -> tuple[Path, list[Path]]:
    """The folder that the photos are in, and their files in order. Raises: CaptureError, one line, if there is none."""
    _expect_folder(folder)
    images = next((place for name in PHOTO_FOLDERS if any(find_photos(place := folder / name))), folder)
    photos = sorted(find_photos(images))
    if not photos:
        raise CaptureError(
            folder, "", f"no photo: expected {', '.join(SUFFIXES[:4])} files in it or in {folder / 'images'}"
        )
    return images, photos


def _expect_folder(folder: Path) -> None:
    if not folder.is_dir():
        wrong = "is a file" if folder.exists() else "no such folder"
        raise CaptureError(folder, "", f"{wrong}: expected a folder of photos, or a video ({', '.join(VIDEOS)})")


def missing(material: Material, images: Path | None = None) -> tuple[Missing, ...]:
    """What is still to be made, with the commands that make it.

    Arguments: images: where photos without lens distortion are, if they were imported: keypoints have to be of those.
    """
    folder, found = material.folder, []
    if material.cameras is None:
        workspace = folder / "colmap"
        model = workspace / "sparse" / "0"
        found.append(
            Missing(
                "cameras",
                "where each photo was taken from, and its lens",
                (
                    "many overlapping photos of someone who stands still, with COLMAP (https://colmap.github.io):",
                    f"  mkdir {workspace} && colmap automatic_reconstructor --workspace_path {workspace}"
                    f" --image_path {material.images} --single_camera 1 --dense 0",
                    f"  colmap model_converter --input_path {model} --output_path {model} --output_type TXT",
                    "  its unit is arbitrary: measure something, and add --scale METRES_PER_UNIT",
                    "few cameras that stand still: calibrate them with a checkerboard, in OpenCV or EasyMocap;",
                    f"  put calibration.json, or intri.yml and extri.yml, into {folder} (docs/cameras.md)",
                ),
            )
        )
    if material.masks is None and not material.alpha:
        found.append(
            Missing(
                "masks",
                "what of each photo is the person",
                (
                    *OWN_DETECTOR,
                    'rembg: pip install "rembg[cpu,cli]"',
                    f"  rembg p -m u2net_human_seg -om {material.images} {folder / 'masks'}",
                    "where it takes something else for the person: SAM 2 (https://github.com/facebookresearch/sam2)",
                    "photos with nothing but white behind the person: --without-masks",
                ),
            )
        )
    if material.keypoints is None:
        source, target = images or material.images, folder / "keypoints"
        found.append(
            Missing(
                "keypoints",
                "where shoulders, knees and fingers are, for `humangs fit`",
                (
                    *OWN_DETECTOR,
                    "RTMPose, in a checkout of MMPose (https://github.com/open-mmlab/mmpose):",
                    f"  python demo/inferencer_demo.py {source} --pose2d wholebody --pred-out-dir {target}",
                    "or OpenPose (https://github.com/CMU-Perceptual-Computing-Lab/openpose):",
                    f"  openpose.bin --image_dir {source} --write_json {target} --hand --display 0 --render_pose 0",
                ),
            )
        )
    return tuple(found)


def find_photos(folder: Path) -> Iterator[Path]:
    """The photos of a folder and of those in it, except for masks, captures, and what other programs have made of photos."""
    others = (*MASK_FOLDERS, KEYPOINT_FOLDER, *(name for each in KEYPOINTS.values() for name in each.files), "colmap")
    if folder.is_dir():
        with reading(folder, "folder of photos", CaptureError):
            found = walk(folder, lambda path: path.name in others or (path / "capture.json").exists())
            yield from filter(is_photo, found)


def _has_alpha(photo: Path) -> bool:
    """Whether a photo has transparent pixels; an opaque alpha channel is no mask."""
    with open_image(photo) as (image, _):
        if "A" not in image.getbands() and "transparency" not in image.info:
            return False
        return image.convert("RGBA").getchannel("A").getextrema()[0] < 255
