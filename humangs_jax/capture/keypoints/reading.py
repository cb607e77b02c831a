"""Keypoints of a capture's views: from a detector's file, the image of each view and the one person
in it.
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
    Keypoints,
    Source,
)
from humangs_jax.capture.keypoints.orders import in_order
from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture_checks import CaptureError, few
from humangs_jax.data.formats import KEYPOINTS
from humangs_jax.io.images import PHOTO_SUFFIXES
from humangs_jax.io.reading import check_limit, reading, walk

NORMALIZED = 2.0
"""If no coordinate of any view reaches this many pixels, they are no pixels but shares of the
image.
"""
OVERSHOOT = 1.1
"""Heat maps overshoot 1 a little (1.02 is common) and undershoot 0. Larger scores are of another
scale, such as the maxima of SimCC heads (RTMPose, RTMW, DWPose), and are divided by the largest of
the file.
"""
LARGEST_SCORE = 20.0
"""Numbers beyond this are no scores."""
SMALLEST_CONFIDENCE = -1.0
"""Numbers below this are no confidences, see `OVERSHOOT`."""
CLEAR_CONFIDENCE = 0.3
"""Mean confidence above which a detection is a person; others are a detector's ghosts."""
CLEAR_SHARE = 0.25
"""Share of the points of `TRUNK_AND_LIMBS` that a person has more of."""
TRUNK_AND_LIMBS = frozenset(COCO_17.names)
"""Points that tell people from ghosts. Hands, face and feet do not count: detectors leave them out
where they are small, or were not asked for them.
"""
FAR_OUTSIDE = 0.5
"""Detectors extrapolate a little beyond the image.

Points further out than this share of its size mean nothing.
"""
LARGEST_PIXEL = 1e6
"""Coordinates beyond it mean nothing, and are not to become inf in float32."""
UNSORTED = {OPENPOSE_67.name: 25, OPENPOSE_60.name: 18}
"""Sets whose files may be of another one with as many points, and their points of the body."""
IMAGE_SUFFIXES = (*PHOTO_SUFFIXES, ".bmp", ".tif", ".tiff")
"""Suffixes of images that detectors read, and that names in their files may have."""


def read_detections(path: Path) -> Detections:
    """The people in the images of a file or folder of one of the `KEYPOINTS`; its content decides
    which one.

    A folder, with its sub-folders, is all of its JSON files together. Raises: CaptureError.
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
        source = Source(file, name, alone=len(files) == 1)
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
    count = UNSORTED.get(detections.set.name if detections.set else "")
    if count is None or files[0].suffix == ".npz":  # ours tells which order it has
        return detections
    return in_order(detections, count)


def _amount(content: Any) -> int:
    """How many people and images a JSON file has, before any is looked at."""
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
    """Keypoints of one person in the views of a capture.

    Arguments:
        path: a file or folder of one of the `KEYPOINTS`.
        names: of the capture's views. Images of the file are matched by name, or by the number in
            the name where the file has only numbers; images of no view are ignored.
        width, height: pixels of the capture's photos, which the keypoints have to be of; or of the
            photos of several sizes that were padded to these when they were imported.
        person: which one to take where several people are seen, counted from 0 in the order of the
            file.

    Returns: v views of k points. Views of which the file has nothing have confidence 0 and are in
    `missing`.

    Raises: CaptureError, one line naming file and field: a file of no known format, damaged, of no
        view of this capture, of photos of another size, of several people (without `person`), or
        without any usable point.
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
    detections = read_detections(path)
    kind = detections.set
    if kind is None:
        raise CaptureError(path, "", "nobody in any of its images: expected one person")
    # the image of each view; scores of another scale are divided by the largest
    images = _images_of_views(path, detections, names, width, height)
    scores = np.concatenate([each[:, 2] for image in detections.images for each in image.people])
    largest = float(scores[np.isfinite(scores)].max(initial=0.0))
    largest = largest if largest > OVERSHOOT else 1.0
    # the person of each view, or the only one; several need an answer from the user
    body = np.asarray([name in TRUNK_AND_LIMBS for name in kind.names])
    columns = max(each.shape[1] for image in detections.images for each in image.people)
    raw, values = np.zeros((2, len(names), len(kind.names), columns))
    most = 0
    for view, (image, name) in enumerate(zip(images, names, strict=True)):
        if image is None or not image.people:
            continue
        people = np.stack(image.people)
        usable = _usable(people, largest, detections.offset, (width, height), image.file, name)
        clear = sum(map(_is_clear, usable[:, body, 2]))
        if person is None and clear > 1:
            choice = "Person I is the I-th of each view, counted from 0 in the order of the file"
            problem = (
                f"{clear} people: expected one. {choice}; or crop the photos, or delete the others"
                " from the file"
            )
            raise CaptureError(image.file, f"view {name}", problem)
        which = int(usable[..., 2].sum(axis=1).argmax()) if person is None else person
        if which < len(people):
            raw[view], values[view] = people[which], usable[which]
        most = max(most, len(people))
    if person is not None and person >= most:
        raise CaptureError(
            path,
            f"person {person}",
            f"no view has this many people: expected 0 to {max(most - 1, 0)}",
        )
    # what cannot be used is counted, and refused if nothing is left
    points, confidences = values[..., :2].astype(np.float32), values[..., 2].astype(np.float32)
    missing = tuple(name for name, row in zip(names, confidences, strict=True) if not row.any())
    finite = np.isfinite(raw).all(axis=-1)
    dropped = int((~finite).sum())
    far = int((finite & (raw[..., 2] > 0) & (confidences == 0)).sum())
    if not confidences.any():
        problem = (
            f"no point has a confidence above 0 (not finite: {dropped}, far outside of the photos:"
            f" {far})"
        )
        raise CaptureError(path, "", f"{problem}: expected keypoints of these photos")
    if np.abs(points[confidences > 0]).max() < NORMALIZED:
        problem = f"no coordinate exceeds {NORMALIZED:g}: expected pixels, not shares of the image"
        hint = " (OpenPose: --keypoint_scale 0)" if detections.tool else ""
        raise CaptureError(path, "", problem + hint)
    # what the user should know
    shifted = _shifted(images, names)
    lines = (
        (missing, f"no keypoints of {len(missing)} views: {few(missing)}"),
        (
            shifted,
            (
                "frames and photos are counted from different numbers and were matched in order:"
                f" {shifted}"
            ),
        ),
        (
            largest > 1,
            f"scores of up to {largest:.4g}, of another scale than [0, 1]: divided by that",
        ),
        (dropped, f"{dropped} keypoints are not finite numbers and are ignored"),
        (
            far,
            (
                f"{far} keypoints lie far outside of their photo and are ignored: of photos of"
                " another size?"
            ),
        ),
    )
    world = values[..., 3:].astype(np.float32) if columns > 3 else None
    said = (*detections.warnings, *(line for found, line in lines if found))
    return Keypoints(points, confidences, kind, missing, world, said)


def _shifted(images: Sequence[DetectedImage | None], names: Sequence[str]) -> str:
    """An image and its view whose numbers differ, because one is counted from 0 and the other from
    1; "" if there is none.
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
    """The image of each view, None where the file has none."""
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
    present = confidences[confidences > 0]
    return (
        len(present) > CLEAR_SHARE * len(confidences) and float(present.mean()) > CLEAR_CONFIDENCE
    )


def _usable(
    people: Float[np.ndarray, "p k columns"],
    largest: float,
    offset: float,
    size: tuple[int, int],
    file: Path,
    view: str,
) -> Float[np.ndarray, "p k columns"]:
    """Pixels with centres at +0.5, finite, and confidences in [0, 1], 0 for points that cannot be
    used.
    """
    finite = np.logical_and.reduce(np.isfinite(people), axis=-1)
    known = people[np.isfinite(people[..., 2]), 2]
    if known.size and (known.min() < SMALLEST_CONFIDENCE or known.max() > LARGEST_SCORE):
        got = f"{known.min():.4g} to {known.max():.4g}"
        raise CaptureError(file, f"view {view}", f"expected confidences in [0, 1], got {got}")
    values = np.where(finite[..., None], np.clip(people, -LARGEST_PIXEL, LARGEST_PIXEL), 0.0)
    values[..., :2] += offset
    near = (np.abs(values[..., :2] / size - 0.5) <= 0.5 + FAR_OUTSIDE).all(axis=-1)
    values[..., 2] = np.where(near, np.clip(values[..., 2] / largest, 0, 1), 0)
    return values


# Which view
# --------------------------------------------------------------------------------------------------


def match_views(images: Sequence[str | int], names: Sequence[str]) -> list[int | None]:
    """For each image the index of its view, None for images that are of no view.

    Views have names like "front", "000012" or, where that would be ambiguous, "images_cam0_000012"
    (folders joined by _). Images of keypoint files have names like "front.jpg", "cam0/000012.png"
    and "cam0_000000000012" (OpenPose counts a video's frames in twelve digits), or are mere numbers
    (COCO's image ids, the frames of a video).

    Where a video's frames are counted from 0 and its photos from 1 (ffmpeg), or the other way
    round, there are as many of either, without gaps, and they are matched in order, for each video
    by itself. Mere numbers are matched in order, wherever they begin, if there is one for every
    view, and the last numbers in the views' names have no gaps either.

    Raises: ValueError if two images are of one view, or a number could mean two views.
    """
    find = _finder(names)
    # mere numbers in order, if there is one for every view
    numbers = sorted({image for image in images if isinstance(image, int)})
    of_names = sorted(number for number in map(_last_number, names) if number is not None)
    one_for_each = (
        len(numbers) == len(of_names) == len(names) and _no_gaps(numbers) and _no_gaps(of_names)
    )
    shift = of_names[0] - numbers[0] if one_for_each else 0
    found = {image: find(image + shift if isinstance(image, int) else image) for image in images}
    # a number that could be of two views is refused
    for image, views in found.items():
        if len(views) > 1:
            both = " and ".join(repr(names[view]) for view in views[:2])
            raise ValueError(
                f"image number {image} could be view {both}: expected file names instead of numbers"
            )
    # frames of a video that are counted from the other number
    videos: dict[str, list[tuple[int, str | int]]] = {}
    for image in found:
        if isinstance(image, int):
            continue
        prefix, number = _split_number(str(_stem(image)))
        if number is not None:
            videos.setdefault(prefix, []).append((number, image))
    of_view = [_split_number(name)[0] for name in names]
    for prefix, frames in videos.items():
        counts = sorted(number for number, _ in frames)
        matched_already = all(found[image] for _, image in frames)
        if counts[0] > 1 or len(counts) < 2 or not _no_gaps(counts) or matched_already:
            continue
        moved = {image: find(f"{prefix}{number + 1 - 2 * counts[0]}") for number, image in frames}
        prefixes = {of_view[view] for views in moved.values() for view in views}
        all_of_one = all(len(views) == 1 for views in moved.values()) and len(prefixes) == 1
        if all_of_one and sum(each in prefixes for each in of_view) == len(frames):
            found |= moved
    # at most one image for a view
    owner: dict[int, str | int] = {}
    matched = [found[image][0] if found[image] else None for image in images]
    for image, view in zip(images, matched, strict=True):
        if view in owner:
            raise ValueError(
                f"{owner[view]!r} and {image!r} are both for view {names[view]!r}: expected one"
                " entry a view"
            )
        if view is not None:
            owner[view] = image
    return matched


def _finder(names: Sequence[str]) -> Callable[[str | int], list[int]]:
    """A function that finds the view of an image, or none; of a number it may find several."""
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
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def _split_number(name: str) -> tuple[str, int | None]:
    prefix = name.rstrip("0123456789")
    number = name.removeprefix(prefix)
    return prefix, int(number) if number else None


def _last_number(name: str) -> int | None:
    """The last number in a name, None without any."""
    found = re.findall(r"\d+", name)
    return int(found[-1]) if found else None


def _no_gaps(numbers: Sequence[int]) -> bool:
    return len(numbers) > 0 and list(numbers) == list(range(numbers[0], numbers[0] + len(numbers)))


def _plain(name: str) -> str:
    return re.sub(r"(?<!\d)0+(?=\d)", "", name)
