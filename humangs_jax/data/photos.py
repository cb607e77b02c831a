"""Reads and writes the photos of a capture folder: capture.json, images, masks, cameras, and the
frame that each view shows.

No body is needed to read the photos. `humangs import cameras` writes such a folder without a body,
and `humangs fit` adds the body. Every fault is a `CaptureError`, one line that names the file, and
the field if a value is wrong. docs/capture_format.md describes the format.
"""

import contextlib
import dataclasses
import logging
import math
import re
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from humangs_jax.core.array_types import Bool, Float, Int
from humangs_jax.data.capture_checks import (
    CaptureError,
    checked_camera,
    checked_frame,
    checked_json,
    expect,
    few,
    members,
    numbers,
)
from humangs_jax.data.formats import START_MARK
from humangs_jax.data.masks import clean_rims, masks_at_edges
from humangs_jax.geometry.camera import Camera, stack_cameras
from humangs_jax.io.images import image_size, orientation, read_grey, read_image
from humangs_jax.io.reading import (
    FileError,
    check_limit,
    inside,
    read_json,
    reading,
    shown,
    write_json,
)

logger = logging.getLogger(__name__)

FORMAT = "humangs-capture"
VERSION = 1
DEMO_CAPTURE = "demo_capture"
"""Name of the capture of a synthetic person that comes with the package."""
TOP_KEYS = {"format", "version", "body", "background", "views"}
OPTIONAL_TOP_KEYS = {"calibrated"}
VIEW_KEYS = {"image", "mask", "unknown", "K", "cam_from_world", "frame"}
Background = Literal["photo", "white"]
LEAST_UNKNOWN = 0.5
"""Least value, in [0, 1], that marks a pixel as unknown in an image of unknown pixels."""
OFF_CENTER = 0.05
"""K belongs to the photo turned by its EXIF orientation if the principal point is nearer to the
middle of the turned photo than to the middle of the stored photo. The two distances have to differ
by more than this, as a share of a side.
"""
LARGEST_LABEL = 20 / 255
"""A mask with no value above this holds labels (0 and 1, or numbers of parts of a person). It does
not hold coverage.
"""
NEARLY_WHITE = 0.9
"""A mask also holds labels if its values are 0 and one other value, and the other value is below
`NEARLY_WHITE`.
"""
LEAST_LABELLED = 1e-3
"""A mask does not count as labels if at most this share of its pixels is not 0. These pixels may be
the rim of somebody outside the photo.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class Photos:
    """Photos of one person. Arrays are numpy's; the cameras are a pytree of JAX."""

    images: Float[np.ndarray, "v h w 3"]
    """The photos, (v, h, w, 3), in [0, 1]. The background is white if there are masks."""
    masks: Float[np.ndarray, "v h w"] | None
    """The coverage by the person, (v, h, w), in [0, 1]; None: there are no masks."""
    cameras: Camera
    """A batch of v cameras, metres."""
    frames: Int[np.ndarray, " v"]
    """The frame that each view shows, (v,)."""
    names: tuple[str, ...]
    """The names of the views."""
    calibrated: bool = True
    """Whether the cameras were calibrated; if not, they were found from the person."""
    unknown: Bool[np.ndarray, "v h w"] | None = None
    """Where somebody or something in front may hide the person, (v, h, w); masks are 0 there. None:
    nowhere.
    """

    @property
    def frame_count(self) -> int:
        """The number of frames: one more than the largest frame number of the views."""
        return int(self.frames.max()) + 1


def load_photos(path: str | Path, *, fit_masks: bool = False) -> Photos:
    """Read the photos of a capture folder. The folder need not have a body.npz. fit_masks: see
    `read_photos`.

    Raises: CaptureError, one line that names the file, and the field if a value is wrong.
    """
    folder = capture_folder(path)
    with reading(folder / "capture.json", "capture", CaptureError):
        return read_photos(folder, read_description(folder / "capture.json"), fit_masks=fit_masks)


def capture_folder(path: str | Path) -> Path:
    """Returns the path of the capture folder that `path` names. If a path begins with
    "demo_capture" and does not exist, it names the capture that comes with the package.
    """
    folder = Path(path)
    if not folder.exists() and folder.parts[:1] == (DEMO_CAPTURE,):
        return Path(str(resources.files("humangs_jax"))) / "assets" / folder
    return folder


# capture.json
# --------------------------------------------------------------------------------------------------


def read_description(file: Path) -> dict[str, Any]:
    """Read capture.json, and check its keys and the types of its values. The frames and matrices of
    the views are not checked.

    The paths in it must stay inside the folder. The limit `photos_outside` allows other paths for
    photos, masks and images of unknown pixels. Raises: CaptureError.
    """
    description = checked_json(
        file, missing="no such file: a capture is a folder with a capture.json"
    )
    # what kind of file it is, before anything else is read of it
    for key, wanted in (("format", FORMAT), ("version", VERSION)):
        found = expect(description, dict, file, "").get(key)
        if found != wanted:
            raise CaptureError(file, key, f"expected {wanted!r}, got {shown(found)}")
    check_keys(description, TOP_KEYS | OPTIONAL_TOP_KEYS, TOP_KEYS - {"background"}, file)
    if not isinstance(description.get("calibrated", True), bool):
        raise CaptureError(
            file, "calibrated", f"expected true or false, got {shown(description['calibrated'])}"
        )
    body, views = members(description, file, body=str, views=list)
    if Path(body).suffix != ".npz":  # fits write it: it must not be a photo
        raise CaptureError(file, "body", f"expected the name of an npz file, got {shown(body)}")
    _check_inside(file, "body", body)
    check_background(description.get("background", "photo"), file)
    # the views, one at a time, so that errors name the view
    if not views:
        raise CaptureError(file, "views", "expected a list of at least one view")
    for i, view in enumerate(views):
        field = f"views[{i}]"
        check_keys(
            expect(view, dict, file, field),
            VIEW_KEYS,
            VIEW_KEYS - {"mask", "unknown", "frame"},
            file,
            f"{field}.",
        )
        for key in VIEW_KEYS & {"image", "mask", "unknown"} & view.keys():
            _check_inside(
                file, f"{field}.{key}", expect(view[key], str, file, f"{field}.{key}"), photo=True
            )
    return description


def _check_inside(file: Path, field: str, name: str, photo: bool = False) -> None:
    """Check that a path in `file` stays inside the folder of `file`. photo: see
    `io.reading.inside`.

    Raises: CaptureError.
    """
    with reading(f"{file}: {field}", "path", CaptureError):
        inside(file.parent, name, photo)


def write_description(
    folder: Path,
    views: Sequence[dict[str, Any]],
    background: Background = "photo",
    calibrated: bool = True,
) -> None:
    """Write a capture.json with these views. It names body.npz as the file of the body. views: each
    has the keys of the format.
    """
    description: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "body": "body.npz",
        "background": background,
    }
    if not calibrated:
        description["calibrated"] = False
    write_json(folder / "capture.json", description | {"views": views})


def _is_calibrated(folder: Path, description: dict[str, Any]) -> bool:
    """Returns whether the cameras of a capture were calibrated. This is assumed unless the capture
    says otherwise.

    In older captures, the file `START_MARK` beside capture.json may say that they were not.
    """
    if "calibrated" in description:
        return description["calibrated"]
    mark = folder / START_MARK
    if not mark.is_file():
        return True
    with contextlib.suppress(FileError):
        found = read_json(mark)
        return not (isinstance(found, dict) and found.get("calibrated") is False)
    return True


def check_keys(
    mapping: Iterable[str], known: set[str], required: set[str], file: Path, prefix: str = ""
) -> None:
    """Raise CaptureError for keys that are unknown or missing. Most unknown keys are optional keys
    with a spelling mistake. Without the error, they would have no effect.
    """
    for key in mapping:
        if key not in known:
            raise CaptureError(
                file, f"{prefix}{key}", f"unknown key: expected only {', '.join(sorted(known))}"
            )
    for key in sorted(required):
        if key not in mapping:
            raise CaptureError(file, f"{prefix}{key}", "missing")


def check_background(background: Any, file: object) -> None:
    """Raise CaptureError unless the background is one of `Background`."""
    if background not in get_args(Background):
        raise CaptureError(
            file,
            "background",
            f"expected one of {', '.join(get_args(Background))}, got {shown(background)}",
        )


def read_frames_and_matrices(
    views: Sequence[dict[str, Any]], poses: int, file: Path
) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, "v 3 3"], Float[np.ndarray, "v 4 4"]]:
    """Returns the frame of each view of a description, and the matrices K and cam_from_world as
    they are in the file.

    poses: the number of poses. If there is only one pose, a view may leave its frame out. Raises:
    CaptureError.
    """
    frames, matrices = [], []
    for i, view in enumerate(views):
        field = f"views[{i}]"
        if "frame" not in view and poses > 1:
            problem = f"missing: body.npz has {poses} poses, which one does the photo show?"
            raise CaptureError(file, f"{field}.frame", problem)
        frames.append(checked_frame(view.get("frame", 0), poses, file, f"{field}.frame"))
        shapes = (("K", (3, 3)), ("cam_from_world", (4, 4)))
        matrices.append(
            [numbers(view[key], file, f"{field}.{key}", shape) for key, shape in shapes]
        )
    K, cam_from_world = (np.stack(column) for column in zip(*matrices, strict=True))
    return np.asarray(frames, np.int32), K, cam_from_world


# Images
# --------------------------------------------------------------------------------------------------


def read_photos(
    folder: Path,
    description: dict[str, Any],
    chosen: Sequence[int] | Int[np.ndarray, " any"] | None = None,
    poses: int | None = None,
    fit_masks: bool = False,
) -> Photos:
    """Read the photos and cameras that a checked capture.json describes.

    Arguments: chosen: the views to read, in this order; None: all. poses: the number of poses;
    None: one more than the largest frame number of the views. fit_masks: whether masks that are too
    large or too small are moved to the edges in the photos (`data.masks`), with a line in the log.
    A mask is moved only if it is a separate file and its photo shows a background.
    Raises: CaptureError.
    """
    file, views = folder / "capture.json", description["views"]
    # without the number of poses, the views say it; a huge frame number is refused
    if poses is None:
        frames = [
            expect(view.get("frame", 0), int, file, f"views[{i}].frame")
            for i, view in enumerate(views)
        ]
        for i, frame in enumerate(frames):
            if frame < 0:
                raise CaptureError(file, f"views[{i}].frame", f"expected 0 or more, got {frame}")
        poses = 1 + max(frames, default=0)
        with reading(file, "capture", CaptureError):
            check_limit("frames", poses, "frames")
            check_limit(
                "frames_per_photo",
                math.ceil(poses / len(views)),
                f"frames for each of {len(views)} photos",
            )
    # the chosen views: all with masks or none
    if chosen is not None:
        views = [views[i] for i in chosen]
    with_mask = ["mask" in view for view in views]
    if any(with_mask) and not all(with_mask):
        first = with_mask.index(False)
        raise CaptureError(
            file, f"views[{first}].mask", "missing, but other views have one: give all or none"
        )
    check_photos(folder, views, together=True)
    # photos and cameras
    frames, K, cam_from_world = read_frames_and_matrices(views, poses, file)
    images, masks = _read_images(
        folder, views, description.get("background", "photo") == "white", fit_masks
    )
    height, width = images.shape[1:3]
    _check_orientations(folder, views, K, width, height, warns=chosen is None)
    cameras = [
        checked_camera(K[i], cam_from_world[i], width, height, file, f"views[{i}]")
        for i in range(len(views))
    ]
    # what may be hidden counts as background, so that nothing is concluded from it; without masks
    # nothing is background, and it waits for them
    unknown = None
    if masks is not None:
        unknown = _read_unknown(folder, views, images.shape[1:3])
    if masks is not None and unknown is not None:
        images[unknown], masks[unknown] = 1, 0
    names = names_from_paths([view["image"] for view in views])
    calibrated = _is_calibrated(folder, description)
    return Photos(images, masks, stack_cameras(cameras), frames, names, calibrated, unknown)


def unknown_in_capture(folder: Path) -> Bool[np.ndarray, "v h w"] | None:
    """Returns the pixels of each photo of a capture folder where something in front may hide the
    person, (v, h, w); None if there are none. The folder may have no masks yet.

    Raises: CaptureError.
    """
    views = read_description(folder / "capture.json")["views"]
    width, height = read_checked(image_size, folder / views[0]["image"])
    return _read_unknown(folder, views, (height, width))


def _read_unknown(
    folder: Path, views: Sequence[dict[str, Any]], size: tuple[int, int]
) -> Bool[np.ndarray, "v h w"] | None:
    """Returns the pixels of each photo where something in front may hide the person, (v, h, w).
    Returns None if no view names an image of unknown pixels, or if no pixel of these images reaches
    `LEAST_UNKNOWN`. size: height and width of the photos.
    """
    unknown = np.zeros((len(views), *size), bool)
    for i, view in enumerate(views):
        if "unknown" in view:
            found = read_mask(folder / view["unknown"], "its image", size[1], size[0])
            unknown[i] = found >= LEAST_UNKNOWN
    return unknown if unknown.any() else None


def _check_orientations(
    folder: Path,
    views: Sequence[dict[str, Any]],
    K: Float[np.ndarray, "v 3 3"],
    width: int,
    height: int,
    warns: bool,
) -> None:
    """Check photos with an EXIF orientation, because photos are read as they are stored. If `warns`
    is True, a warning names the first of them.

    Raises: CaptureError if K belongs to the turned photo, see `OFF_CENTER`.
    """
    flagged = []
    for view, camera in zip(views, K, strict=True):
        file = folder / view["image"]
        flag = read_checked(orientation, file)
        if flag == 1:
            continue
        flagged.append(file.name)
        stored, shown = (
            np.abs(camera[:2, 2] / size - 0.5).max() for size in ((width, height), (height, width))
        )
        if flag >= 5 and shown < stored - OFF_CENTER:
            problem = (
                f"EXIF orientation {flag} is ignored, but K is of the turned photo: save it turned,"
                " without the flag"
            )
            raise CaptureError(file, "orientation", problem)
    if flagged and warns:
        advice = (
            "K, mask and keypoints have to be of the pixels as stored (`humangs import cameras`"
            " turns such photos)"
        )
        logger.warning("%s: EXIF orientation of %s is ignored: %s", folder, few(flagged, 1), advice)


def check_photos(folder: Path, views: Sequence[dict[str, Any]], together: bool) -> None:
    """Raise CaptureError if a description has too many views for the number of its photos. With
    `together`, also if it has too many views, or too many pixels in all. No pixels are read.

    together: whether all photos will be in memory at one time. Their size is taken from the first
    photo, since all must have one size.
    """
    file = folder / "capture.json"
    check_repeats(file, [folder / view["image"] for view in views])
    with reading(file, "capture", CaptureError):
        if together:
            check_limit("views", len(views), "photos")
            width, height = read_checked(image_size, folder / views[0]["image"])
            what = f"pixels in {len(views):,} photos of {width} x {height}"
            check_limit("capture_pixels", width * height * len(views), what)


def check_repeats(file: Path, photos: Sequence[Path]) -> None:
    """Raise CaptureError if there are too many views for the number of different photos (the limit
    `views_per_photo`). Links to a photo count as that photo. photos: the photo of each view.
    """
    found = set()
    for photo in photos:
        with contextlib.suppress(OSError, ValueError):  # whoever reads it says what is wrong
            status = photo.stat()
            found.add((status.st_dev, status.st_ino))
    with reading(file, "capture", CaptureError):
        each = math.ceil(len(photos) / max(len(found), 1))
        check_limit(
            "views_per_photo", each, f"views of each photo ({len(photos):,} of {len(found):,})"
        )


def _read_images(
    folder: Path, views: Sequence[dict[str, Any]], on_white: bool, fit_masks: bool
) -> tuple[Float[np.ndarray, "v h w 3"], Float[np.ndarray, "v h w"] | None]:
    """Read the images and the masks of all views. All must have one size. If there are masks, the
    images are put on white. The second result is None if there are no masks, or only opaque alpha
    channels.

    on_white: whether images that have a mask file are on white already. fit_masks: see
    `read_photos`. Raises: CaptureError.
    """
    images, masks, searched = None, None, []
    for i, view in enumerate(views):
        image, mask, on_background = read_view(folder, view, on_white)
        if on_background:
            searched.append(i)
        if images is None:  # in place: a list of photos and an array of them are twice the memory
            height, width = image.shape[:2]
            images = np.empty((len(views), height, width, 3), np.float32)
            masks = None
            if mask is not None:
                masks = np.empty((len(views), height, width), np.float32)
        file = folder / view["image"]
        if image.shape != images.shape[1:]:
            size = f"{image.shape[1]} x {image.shape[0]}"
            raise CaptureError(
                file,
                "size",
                f"{size}, but the first view has {width} x {height}: expected one size",
            )
        if (mask is None) != (masks is None):
            raise CaptureError(file, "alpha", "expected an alpha channel in all images or in none")
        images[i] = image
        if masks is not None:
            masks[i] = mask
    assert images is not None  # a description has views
    moved = []
    if masks is not None and searched:
        photos, own = [images[i] for i in searched], [masks[i] for i in searched]
        if fit_masks:
            fitted = masks_at_edges(photos, own)
        else:
            fitted = [(mask, 0.0) for mask in own]
        for i, (mask, excess) in zip(searched, fitted, strict=True):
            images[i], masks[i] = cut_out(images[i], mask), mask
            if excess:
                moved.append(excess)
    if moved:
        off = float(np.median(moved))
        wrong = f"{abs(off):.1f} pixels too {'large' if off > 0 else 'small'}"
        count = f"{len(moved)} of {len(views)} masks"
        logger.warning(
            "%s: %s were off, the median %s: moved to the edges in the photos", folder, count, wrong
        )
    if "mask" not in views[0] and masks is not None and masks.min() == 1:
        masks = None  # many programs write an opaque alpha channel: it says nothing
    return images, masks


def read_view(
    folder: Path, view: dict[str, Any], on_white: bool
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None, bool]:
    """Read the image and the mask (or None) of a view.

    The third result is True if there is a mask and the image still shows its background. It is
    False if the image is on white, or if there is no mask. on_white: whether images that have a
    mask file are on white already. Raises: CaptureError.
    """
    image, alpha = read_checked(read_image, folder / view["image"])
    if alpha is not None:
        image = on_white_background(image, alpha)
    if "mask" not in view:
        return image, alpha, False
    mask = read_mask(folder / view["mask"], "its image", image.shape[1], image.shape[0])
    # composited already: the mask file only says what the person is
    if on_white or alpha is not None:
        return image, mask, False
    return image, mask, True


def read_mask(file: Path, owner: str, width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Read a mask, see `io.images.read_grey`. It must have this width and height. owner: what
    errors call the image that has this size.

    Raises: CaptureError, also for a mask of another size, and for a mask that holds labels in place
    of coverage from 0 to 255.
    """
    mask = read_checked(read_grey, file)
    if mask.shape != (height, width):
        sizes = f"{mask.shape[1]} x {mask.shape[0]}, but {owner} has {width} x {height}"
        if mask.shape == (width, height):
            sizes += " (is one of them turned by an EXIF orientation?)"
        raise CaptureError(file, "size", f"{sizes}: expected the same")
    top, some = float(mask.max()), np.count_nonzero(mask) > LEAST_LABELLED * mask.size
    if some and (
        top <= LARGEST_LABEL
        or (top < NEARLY_WHITE and mask.min() == 0 and ((mask == 0) | (mask == top)).all())
    ):
        problem = f"the largest is {255 * top:.3g} of 255: expected 0 (background) to 255 (person)"
        raise CaptureError(file, "values", problem)
    return mask


def read_checked(reader: Callable[[Path], Any], file: Path) -> Any:
    """Read a file by a function of `io.images`. Raises: CaptureError."""
    try:
        return reader(file)
    except FileNotFoundError:
        raise CaptureError(file, "", "no such image file (capture.json names it)") from None
    except FileError as error:
        raise CaptureError("", "", error) from error


def on_white_background(
    image: Float[np.ndarray, "*v h w 3"], mask: Float[np.ndarray, "*v h w"]
) -> Float[np.ndarray, "*v h w 3"]:
    """Returns the image blended over white by the mask."""
    return image * mask[..., None] + (1 - mask[..., None])


def cut_out(
    image: Float[np.ndarray, "h w 3"], mask: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """Returns the photo over white. Along the rim of the person, the background's share is removed
    from the colors first (`clean_rims`).
    """
    return on_white_background(clean_rims(image, mask), mask)


def names_from_paths(paths: Sequence[str]) -> tuple[str, ...]:
    """Returns a unique name for each path, made of letters, digits, '.', '_' and '-'.

    A name is the file name without suffix. If two names are equal, all names get their folders in
    front. If two are still equal, all names also get their position in `paths` in front (000, 001
    and so on).
    """

    def plain(name, i):
        return re.sub(r"[^\w.-]", "_", name).lstrip(".") or f"{i:03d}"

    for name_of in (lambda path: path.stem, lambda path: "_".join(path.with_suffix("").parts)):
        names = tuple(plain(name_of(Path(path)), i) for i, path in enumerate(paths))
        if len(set(names)) == len(names):
            return names
    # one photo used twice, "a b" and "a_b"
    return tuple(f"{i:03d}_{name}" for i, name in enumerate(names))
