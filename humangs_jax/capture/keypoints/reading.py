"""Reads the keypoints of a capture's views from a detector's file. Finds the image of each view,
and the person in it.
"""

import collections
import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from humangs_jax.capture.keypoints.keypoints import (
    COCO_17,
    OPENPOSE_60,
    OPENPOSE_67,
    DetectedImage,
    Detections,
    KeypointFile,
    Keypoints,
    KeypointSet,
)
from humangs_jax.capture.keypoints.orders import in_order
from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture_checks import CaptureError, few
from humangs_jax.data.formats import KEYPOINTS
from humangs_jax.io.images import PHOTO_SUFFIXES
from humangs_jax.io.reading import check_limit, reading, walk

_TRUNK_AND_LIMBS = frozenset(COCO_17.names)
"""Points that distinguish people from ghosts, which are false detections. Points of hands and feet,
and the 68 points of the face, do not count, because detectors leave them out if they are small or
were not asked for.
"""


@dataclasses.dataclass(frozen=True)
class _Plausible:
    """Limits for numbers that can be pixels or scores of keypoints."""

    least_extent: float = 2.0
    """At least one of the coordinates of all views has to reach this, pixels. If none does, the
    coordinates are shares of the image, and are refused.
    """
    largest_pixel: float = 1e6
    """Coordinates of a larger magnitude are limited to this, pixels. They have no meaning, and
    could become inf in float32.
    """
    outside: float = 0.5
    """Largest distance of a point from its image, as a share of the image's size. Detectors
    extrapolate a little beyond the image, but points farther out have no meaning.
    """
    overshoot: float = 1.1
    """If the largest score is at most this, scores are on the scale [0, 1]. Heat maps exceed 1 a
    little (1.02 is common) and can be below 0. If there are larger scores, such as the maxima of
    SimCC heads (RTMPose, RTMW, DWPose), all scores are divided by the largest.
    """
    largest_score: float = 20.0
    """Largest number that can be a score."""
    smallest_score: float = -1.0
    """Smallest number that can be a score."""


_PLAUSIBLE = _Plausible()


def read_detections(path: Path) -> Detections:
    """Returns the people in the images of a file or folder. The format is one of `KEYPOINTS`, and
    is found from the content.

    If `path` is a folder, all JSON files in it and in its subfolders are read together.
    Raises: CaptureError if there is no such file or folder, or if the content is not valid.
    InvalidFileError if a limit is exceeded. OSError if a folder cannot be read.
    """
    if not path.exists():
        raise CaptureError(path, "", "no such file or folder")
    files = (
        sorted(file for file in walk(path) if file.suffix == ".json") if path.is_dir() else [path]
    )
    if not files:
        raise CaptureError(
            path, "", f"no JSON file in this folder: expected those of {KEYPOINTS.listed()}"
        )
    images: list[DetectedImage] = []
    known: tuple[str, Path, Detections] | None = None
    amount = 0
    for file in files:
        name = file.relative_to(path).with_suffix("").as_posix() if path.is_dir() else file.stem
        source = KeypointFile(file, name, alone=len(files) == 1)
        amount += _amount(source.json)
        check_limit("people", amount, "people and images")
        format = KEYPOINTS.of_content(source)
        if format is None:
            raise CaptureError(file, "", f"no keypoints: expected those of {KEYPOINTS.listed()}")
        found = format(source, format)
        images += found.images
        if found.set is not None:  # somebody was found
            what = f"{len(found.set.names)} points of {format.about}"
            known = known or (what, file, found)
            if what != known[0]:
                problem = (
                    f"{what}, but {known[1].name} has {known[0]}: expected one set of one tool"
                )
                raise CaptureError(file, "", problem)
    if known is None:
        return Detections(None, tuple(images))
    detections = dataclasses.replace(known[2], images=tuple(images))
    # OpenPose's files do not tell the order of their points of the body; our npz files do
    unsorted = {OPENPOSE_67.name: 25, OPENPOSE_60.name: 18}
    count = unsorted.get(detections.set.name if detections.set else "")
    if count is None or files[0].suffix.lower() == ".npz":
        return detections
    return in_order(detections, count)


def _amount(content: Any) -> int:
    """Returns 1 plus the number of people and images that a JSON file lists, without checking
    them.
    """
    lists = [content]
    if isinstance(content, dict):
        lists = [
            content.get(key)
            for key in ("people", "images", "annotations", "instance_info", "annots")
        ]
    entries = [entry for each in lists if isinstance(each, list) for entry in each]
    keys = ("instances", "people")
    inside = [
        entry[key] for entry in entries if isinstance(entry, dict) for key in keys if key in entry
    ]
    return 1 + len(entries) + sum(len(each) for each in inside if isinstance(each, list))


def read_keypoints(
    path: str | Path, names: Sequence[str], width: int, height: int, *, person: int | None = None
) -> Keypoints:
    """Reads the keypoints of one person in the views of a capture.

    Arguments:
        path: a file or folder in a format of `KEYPOINTS`.
        names: names of the capture's views. Images of the file are matched by name, or by the
            number in the name if the file has only numbers. Images that match no view are ignored.
        width, height: size of the capture's photos, pixels. The keypoints have to be in photos of
            this size, or in photos of several sizes that were padded to this size when they were
            imported.
        person: number of the person to take if several people are seen, from 0 in the order of the
            file. None: the only person.

    Returns: keypoints of v views and k points. Views without a usable point have confidence 0 and
    are in `missing`.

    Raises: CaptureError, one line with the file, and the field if one is wrong. It is raised if the
    file is damaged or has no known format, if its images match no view or have another size, if it
    shows several people and `person` is None, if no view has the person, or if no point is usable.
    ArgumentError if `person` is negative.
    """
    path = Path(path)
    if person is not None and person < 0:
        raise ArgumentError(
            "person", f"{person}: expected 0 for the first person, 1 for the second, ..."
        )
    with reading(path, "keypoint file", CaptureError):
        return _read(path, names, width, height, person)


def _read(
    path: Path, names: Sequence[str], width: int, height: int, person: int | None
) -> Keypoints:
    """Returns the result of `read_keypoints`, after its arguments were checked."""
    detections = read_detections(path)
    if detections.set is None:
        raise CaptureError(path, "", "nobody in any of its images: expected one person")
    images = _images_of_views(path, detections, names, width, height)
    largest = _largest_score(detections)
    people = [
        _usable_people(image, name, detections.offset, largest, (width, height))
        for image, name in zip(images, names, strict=True)
    ]
    chosen = _chosen_people(path, images, people, names, detections.set, person)
    # points that cannot be used are counted: they may be all of them
    columns = max(each.shape[1] for image in detections.images for each in image.people)
    raw, values = np.zeros((2, len(names), len(detections.set.names), columns))
    for view, (image, usable, which) in enumerate(zip(images, people, chosen, strict=True)):
        if image is not None and usable is not None and which is not None:
            raw[view], values[view] = image.people[which], usable[which]
    finite = np.isfinite(raw).all(axis=-1)
    dropped = int((~finite).sum())
    points, confidences = values[..., :2].astype(np.float32), values[..., 2].astype(np.float32)
    far = int((finite & (raw[..., 2] > 0) & (confidences == 0)).sum())
    _check_pixels(path, detections, points[confidences > 0], dropped, far)
    # what the user should know
    missing = tuple(name for name, row in zip(names, confidences, strict=True) if not row.any())
    warnings = [*detections.warnings]
    if missing:
        warnings.append(f"no keypoints of {len(missing)} views: {few(missing)}")
    shifted = _shifted(images, names)
    if shifted:
        counted = "frames and photos are counted from different numbers and were matched in order"
        warnings.append(f"{counted}: {shifted}")
    if largest > 1:
        scale = "of another scale than [0, 1]: divided by that"
        warnings.append(f"scores of up to {largest:.4g}, {scale}")
    if dropped:
        warnings.append(f"{dropped} keypoints are not finite numbers and are ignored")
    if far:
        where = "far outside of their photo and are ignored: of photos of another size?"
        warnings.append(f"{far} keypoints lie {where}")
    world = values[..., 3:].astype(np.float32) if columns > 3 else None
    return Keypoints(points, confidences, detections.set, missing, world, tuple(warnings))


def _largest_score(detections: Detections) -> float:
    """Returns the score that becomes confidence 1. It is 1 if scores are on the scale [0, 1], else
    the largest of all scores.
    """
    scores = np.concatenate([each[:, 2] for image in detections.images for each in image.people])
    largest = float(scores[np.isfinite(scores)].max(initial=0.0))
    return largest if largest > _PLAUSIBLE.overshoot else 1.0


def _chosen_people(
    path: Path,
    images: Sequence[DetectedImage | None],
    people: Sequence[Float[np.ndarray, "_p k columns"] | None],
    names: Sequence[str],
    kind: KeypointSet,
    person: int | None,
) -> list[int | None]:
    """Returns the index of the chosen person in each view. None if the view does not show this
    person. If `person` is given, it is the index. If `person` is None, the person with the largest
    sum of confidences of trunk and limbs is chosen, and all others have to be ghosts.

    Raises: CaptureError if `person` is None and a view shows several people, or if `person` is
    given and no view has that many people.
    """
    body = np.asarray([name in _TRUNK_AND_LIMBS for name in kind.names])
    chosen: list[int | None] = []
    for image, name, usable in zip(images, names, people, strict=True):
        if image is None or usable is None:
            chosen.append(None)
        elif person is not None:
            chosen.append(person if person < len(usable) else None)
        else:
            clear = sum(map(_is_clear, usable[:, body, 2]))
            if clear > 1:
                choice = (
                    "Person I is the I-th of each view, counted from 0 in the order of the file"
                )
                others = "or crop the photos, or delete the others from the file"
                problem = f"{clear} people: expected one. {choice}; {others}"
                raise CaptureError(image.file, f"view {name}", problem)
            # a set may have neither trunk nor limbs
            counted = body if body.any() else np.ones_like(body)
            chosen.append(int(usable[:, counted, 2].sum(axis=1).argmax()))
    if person is not None and all(which is None for which in chosen):
        most = max([1, *(len(usable) for usable in people if usable is not None)])
        problem = f"no view has this many people: expected 0 to {most - 1}"
        raise CaptureError(path, f"person {person}", problem)
    return chosen


def _check_pixels(
    path: Path, detections: Detections, points: Float[np.ndarray, "n 2"], dropped: int, far: int
) -> None:
    """Checks that there are usable points, and that their coordinates are pixels. points: all
    usable points, (n, 2). dropped: number of points that were left out because they are not finite.
    far: number of points that were left out because they are far outside of the photos.

    Raises: CaptureError.
    """
    if not len(points):
        problem = (
            f"no point has a confidence above 0 (not finite: {dropped}, far outside of the photos:"
            f" {far})"
        )
        raise CaptureError(path, "", f"{problem}: expected keypoints of these photos")
    least = _PLAUSIBLE.least_extent
    if np.abs(points).max() < least:
        problem = f"no coordinate exceeds {least:g}: expected pixels, not shares of the image"
        hint = " (OpenPose: --keypoint_scale 0)" if detections.tool else ""
        raise CaptureError(path, "", problem + hint)


def _shifted(images: Sequence[DetectedImage | None], names: Sequence[str]) -> str:
    """Returns a line about the first image with another number than its view. The numbers differ if
    images and views are counted from different numbers. "" if there is no such image.
    """
    for image, name in zip(images, names, strict=True):
        if image is None:
            continue
        label = image.image
        number = label if isinstance(label, int) else _last_number(str(_stem(label)))
        of_view = _last_number(str(_stem(name)))
        if number is not None and of_view is not None and number != of_view:
            return f"{label} is view {name}"
    return ""


def _images_of_views(
    path: Path, detections: Detections, names: Sequence[str], width: int, height: int
) -> list[DetectedImage | None]:
    """Returns the image of each view, or None for a view without an image in the file.

    Raises: CaptureError if an image of a view has another size than the photos (unless an import
    can have padded the images to the size of the photos), if no image matches a view, or if it is
    not clear which image matches a view.
    """
    try:
        views = match_views([image.image for image in detections.images], names)
    except ValueError as error:
        raise CaptureError(path, "", error) from error
    images: list[DetectedImage | None] = [None] * len(names)
    seen = [image for image, view in zip(detections.images, views, strict=True) if view is not None]
    sizes = [image.size for image in seen if image.size is not None]
    # an import pads photos of several sizes, each at its right and below, to the largest: pixels
    # keep their places
    before_padding = bool(sizes) and tuple(max(side) for side in zip(*sizes, strict=True)) == (
        width,
        height,
    )
    for image, view in zip(detections.images, views, strict=True):
        if view is None:
            continue
        if not before_padding and image.size not in (None, (width, height)):
            size = " x ".join(map(str, image.size or ()))
            problem = (
                f"{size}, but the capture's photos have {width} x {height}: expected keypoints of"
                " these"
            )
            raise CaptureError(image.file, f"size of {image.image}", problem)
        images[view] = image
    if not any(images):
        named = few([str(image.image) for image in detections.images])
        raise CaptureError(
            path, "", f"images {named} are none of the views {few(names)}: expected the same names"
        )
    return images


# Which person
# --------------------------------------------------------------------------------------------------


def _is_clear(confidences: Float[np.ndarray, " k"]) -> bool:
    """Returns whether a detection is a person and not a ghost. confidences: confidences of the
    points in `_TRUNK_AND_LIMBS`, (k,).
    """
    present = confidences[confidences > 0]
    # a person has more than a quarter of them, with a mean confidence of more than 0.3
    return len(present) > 0.25 * len(confidences) and float(present.mean()) > 0.3


def _usable_people(
    image: DetectedImage | None, view: str, offset: float, largest: float, size: tuple[int, int]
) -> Float[np.ndarray, "p k columns"] | None:
    """Returns the people of an image, (p, k, columns), with pixel centres at +0.5 and all numbers
    finite. Confidences are in [0, 1]. They are 0 for points that cannot be used. None if there is
    nobody.

    Arguments: offset: number that is added to x and y, pixels. largest: score that becomes
    confidence 1. size: width and height of the photo, pixels.
    Raises: CaptureError for numbers that cannot be scores.
    """
    if image is None or not image.people:
        return None
    people = np.stack(image.people)
    finite = np.logical_and.reduce(np.isfinite(people), axis=-1)
    known = people[np.isfinite(people[..., 2]), 2]
    lowest, highest = _PLAUSIBLE.smallest_score, _PLAUSIBLE.largest_score
    if known.size and (known.min() < lowest or known.max() > highest):
        got = f"{known.min():.4g} to {known.max():.4g}"
        raise CaptureError(image.file, f"view {view}", f"expected confidences in [0, 1], got {got}")
    most = _PLAUSIBLE.largest_pixel
    values = np.where(finite[..., None], np.clip(people, -most, most), 0.0)
    values[..., :2] += offset
    near = (np.abs(values[..., :2] / size - 0.5) <= 0.5 + _PLAUSIBLE.outside).all(axis=-1)
    values[..., 2] = np.where(near, np.clip(values[..., 2] / largest, 0, 1), 0)
    return values


# Which view
# --------------------------------------------------------------------------------------------------


def match_views(images: Sequence[str | int], names: Sequence[str]) -> list[int | None]:
    """Returns for each image the index of its view. None if the image matches no view.

    Views have names like "front" or "000012". If these would be ambiguous, the names are like
    "images_cam0_000012", with folders joined by _. Images of keypoint files have names like
    "front.jpg", "cam0/000012.png" and "cam0_000000000012" (OpenPose writes the number of a video's
    frame with twelve digits). Other images are only numbers (COCO's image ids, the frames of a
    video).

    Frames of a video may be counted from 0 and its photos from 1 (ffmpeg), or the reverse. If there
    are as many frames as photos, without gaps, they are matched in order, for each video
    separately.

    An image that is only a number matches the view with this last number in its name. But if there
    is such an image for every view, and neither the images nor the last numbers of the views have
    gaps, they are matched in order, whatever the first numbers are.

    Raises: ValueError if two images match one view, or if a number matches two views.
    """
    find = _finder(names)
    shift = _shift_of_numbers(images, names)
    found = {image: find(image + shift if isinstance(image, int) else image) for image in images}
    for image, views in found.items():
        if len(views) > 1:
            both = " and ".join(repr(names[view]) for view in views[:2])
            raise ValueError(
                f"image number {image} could be view {both}: expected file names instead of numbers"
            )
    found |= _recounted_videos(found, names, find)
    # at most one image for a view
    owner: dict[int, str | int] = {}
    matched: list[int | None] = []
    for image in images:
        view = found[image][0] if found[image] else None
        if view in owner:
            raise ValueError(
                f"{owner[view]!r} and {image!r} are both for view {names[view]!r}: expected one"
                " entry a view"
            )
        if view is not None:
            owner[view] = image
        matched.append(view)
    return matched


def _shift_of_numbers(images: Sequence[str | int], names: Sequence[str]) -> int:
    """Returns the number that has to be added to images that are only numbers, so that they equal
    the last numbers in the views' names. It is 0, unless there is one such image for every view,
    and neither images nor names have gaps in their numbers.
    """
    numbers = sorted({image for image in images if isinstance(image, int)})
    of_names = sorted(number for number in map(_last_number, names) if number is not None)
    one_for_each = len(numbers) == len(of_names) == len(names)
    if one_for_each and _no_gaps(numbers) and _no_gaps(of_names):
        return of_names[0] - numbers[0]
    return 0


def _recounted_videos(
    found: dict[str | int, list[int]],
    names: Sequence[str],
    find: Callable[[str | int], list[int]],
) -> dict[str | int, list[int]]:
    """Returns the views of video frames whose numbers differ from those of the photos by one, by
    name of the image. Frames are counted from 0 and photos from 1, or the reverse. Other images are
    left out. found: the views of each image without this correction.
    """
    videos: dict[str, list[tuple[int, str]]] = {}
    for image in found:
        if isinstance(image, int):
            continue
        prefix, number = _split_number(str(_stem(image)))
        if number is not None:
            videos.setdefault(prefix, []).append((number, image))
    of_view = [_split_number(name)[0] for name in names]
    recounted: dict[str | int, list[int]] = {}
    for prefix, frames in videos.items():
        counts = sorted(number for number, _ in frames)
        matched_already = all(found[image] for _, image in frames)
        if counts[0] > 1 or len(counts) < 2 or not _no_gaps(counts) or matched_already:
            continue
        # from 0 to 1, or from 1 to 0; then every photo of one video has to have a frame
        step = 1 - 2 * counts[0]
        moved: dict[str | int, list[int]] = {
            image: find(f"{prefix}{number + step}") for number, image in frames
        }
        prefixes = {of_view[view] for views in moved.values() for view in views}
        all_of_one = all(len(views) == 1 for views in moved.values()) and len(prefixes) == 1
        if all_of_one and sum(each in prefixes for each in of_view) == len(frames):
            recounted |= moved
    return recounted


def _finder(names: Sequence[str]) -> Callable[[str | int], list[int]]:
    """Returns a function that takes the name or number of an image and returns the indices of its
    views. For a name it returns one view or none. For a number it may return several.
    """
    exact = {name: [i] for i, name in enumerate(names)}
    plain, ends, numbers = (collections.defaultdict(list) for _ in range(3))
    for i, name in enumerate(names):
        plain[_plain(name)].append(i)
        parts = _plain(name).split("_")
        # ends of one part, such as a number, could be of any camera
        for first in range(1, len(parts) - 1):
            ends["_".join(parts[first:])].append(i)
        number = _last_number(name)
        if number is not None:
            numbers[number].append(i)

    def find(image: str | int) -> list[int]:
        if isinstance(image, int):
            return numbers.get(image, [])
        parts = _stem(image).parts
        # the names of views are made from paths in this way; with as many of the folders as fit,
        # then numbers as numbers
        keys = [
            re.sub(r"[^\w.-]", "_", "_".join(parts[i:])).lstrip("._") for i in range(len(parts))
        ]
        for key in keys:
            for table, label in ((exact, key), (plain, _plain(key)), (ends, _plain(key))):
                views = table.get(label, [])
                if len(views) == 1:
                    return views
        return []

    return find


def _stem(image: str) -> PurePosixPath:
    path = PurePosixPath(image.replace("\\", "/"))
    # of images that detectors read
    suffixes = (*PHOTO_SUFFIXES, ".bmp", ".tif", ".tiff")
    return path.with_suffix("") if path.suffix.lower() in suffixes else path


def _split_number(name: str) -> tuple[str, int | None]:
    prefix = name.rstrip("0123456789")
    number = name.removeprefix(prefix)
    return prefix, int(number) if number else None


def _last_number(name: str) -> int | None:
    """Returns the last number in a name. None if the name has no number."""
    found = re.findall(r"\d+", name)
    return int(found[-1]) if found else None


def _no_gaps(numbers: Sequence[int]) -> bool:
    return len(numbers) > 0 and list(numbers) == list(range(numbers[0], numbers[0] + len(numbers)))


def _plain(name: str) -> str:
    return re.sub(r"(?<!\d)0+(?=\d)", "", name)
