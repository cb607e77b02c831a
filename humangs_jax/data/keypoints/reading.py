"""Keypoints of a capture's views: from a detector's file, the image of each view and the one person in it."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.data.capture_checks import CaptureError, few
from humangs_jax.data.formats import KEYPOINTS
from humangs_jax.data.keypoints.keypoints import COCO_17, DetectedImage, Detections, Keypoints, Source
from humangs_jax.io.reading import check_limit, reading, walk

NORMALIZED = 2.0
"""If no coordinate of any view reaches this many pixels, they are no pixels but shares of the image."""
OVERSHOOT, LARGEST_SCORE = 1.1, 20.0
"""Heat maps overshoot 1 a little (1.02 is common) and undershoot 0. Larger scores are of another scale, such as the maxima of
SimCC heads (RTMPose, RTMW, DWPose), and are divided by the largest of the file; those beyond that are no scores."""
SMALLEST_CONFIDENCE = -1.0
CLEAR_CONFIDENCE, CLEAR_SHARE = 0.3, 0.25
"""A detection of more than this mean confidence and share of the points of `TRUNK_AND_LIMBS` is a person, others are a detector's
ghosts. Hands, face and feet do not count: detectors leave them out where they are small, or were not asked for them.
"""
TRUNK_AND_LIMBS = frozenset(COCO_17.names)
FAR_OUTSIDE = 0.5
"""Detectors extrapolate a little beyond the image. Points further out than this share of its size mean nothing."""
LARGEST_PIXEL = 1e6
"""Coordinates beyond it mean nothing, and are not to become inf in float32."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".heic", ".heif")


class Person(NamedTuple):
    """values: (k, 3) pixels with centres at +0.5, finite, and confidences in [0, 1], or (k, 6) with `Keypoints.world`. Counts as
    there.
    """

    values: Float[np.ndarray, "k columns"]
    not_finite: int = 0
    far_outside: int = 0


def read_detections(path: Path) -> Detections:
    """The people in the images of a file or folder of one of the `KEYPOINTS`; its content decides which one.

    A folder, with its sub-folders, is all of its JSON files together. Raises: CaptureError.
    """
    if not path.exists():
        raise CaptureError(path, "", "no such file or folder")
    files = sorted(file for file in walk(path) if file.suffix == ".json") if path.is_dir() else [path]
    if not files:
        raise CaptureError(path, "", f"no JSON file in this folder: expected those of {KEYPOINTS.listed()}")
    images: list[DetectedImage] = []
    tool: tuple[str, Path] | None = None
    known: Detections | None = None
    amount = 0
    for file in files:
        name = file.relative_to(path).with_suffix("").as_posix() if path.is_dir() else file.stem
        source = Source(file, name, alone=len(files) == 1)
        amount += _amount(source.json)
        check_limit("people", amount, "people and images")
        if (format := KEYPOINTS.of_content(source)) is None:
            raise CaptureError(file, "", f"no keypoints: expected those of {KEYPOINTS.listed()}")
        if source.json != []:  # which several tools write where nobody is
            tool = tool or (format.about, file)
            if tool[0] != format.about:
                problem = f"of {format.about}, but {tool[1].name} is of {tool[0]}: expected files of one tool"
                raise CaptureError(file, "", problem)
        found = format(source, format)
        images += found.images
        if found.set is not None:
            known = known or found
            if known.set is not found.set:
                problem = f"{len(found.set.names)} points, but another file has {len(known.set.names)}"
                raise CaptureError(file, "", f"{problem}: expected one set of keypoints")
    return Detections(None, tuple(images)) if known is None else dataclasses.replace(known, images=tuple(images))


def _amount(content: Any) -> int:
    """How many people and images a JSON file has, before any is looked at."""
    lists = [content]
    if isinstance(content, dict):
        lists = [content.get(key) for key in ("people", "images", "annotations", "instance_info", "annots")]
    entries = [entry for each in lists if isinstance(each, list) for entry in each]
    keys = ("instances", "people")
    inside = [entry[key] for entry in entries if isinstance(entry, dict) for key in keys if key in entry]
    return 1 + len(entries) + sum(len(each) for each in inside if isinstance(each, list))


def read_keypoints(path: str | Path, names: Sequence[str], width: int, height: int, *, person: int | None = None) -> Keypoints:
    """Keypoints of one person in the views of a capture.

    Arguments:
        path: a file or folder of one of the `KEYPOINTS`.
        names: of the capture's views. Images of the file are matched by name, or by the number in the name where the file
            has only numbers; images of no view are ignored.
        width, height: pixels of the capture's photos, which the keypoints have to be of; or of the photos of several sizes that
            were padded to these when they were imported.
        person: which one to take where several people are seen, counted from 0 in the order of the file.

    Returns: v views of k points. Views of which the file has nothing have confidence 0 and are in `missing`.

    Raises: CaptureError, one line naming file and field: a file of no known format, damaged, of no view of this capture,
        of photos of another size, of several people (without `person`), or without any usable point.
    """
    path = Path(path)
    if person is not None and person < 0:
        raise ArgumentError("person", f"{person}: expected 0 for the first person, 1 for the second, ...")
    with reading(path, "keypoint file", CaptureError):
        return _read(path, names, width, height, person)


def _read(path: Path, names: Sequence[str], width: int, height: int, person: int | None) -> Keypoints:
    detections = read_detections(path)
    if (kind := detections.set) is None:
        raise CaptureError(path, "", "nobody in any of its images: expected one person")
    images = _images_of_views(path, detections, names, width, height)
    body = np.asarray([name in TRUNK_AND_LIMBS for name in kind.names])
    largest = _largest_score(detections)
    columns = max((each.shape[1] for image in detections.images for each in image.people), default=3)
    people, most, nobody = [], 0, Person(np.zeros((len(kind.names), columns)))
    for image, name in zip(images, names, strict=True):
        seen = () if image is None else image.people
        found = [_usable(each, largest, detections.offset, width, height, image, name) for each in seen if image is not None]
        most = max(most, len(found))
        if image is not None and person is None and (clear := sum(_is_clear(each.values[body, 2]) for each in found)) > 1:
            choice = "Person I is the I-th of each view, counted from 0 in the order of the file"
            problem = f"{clear} people: expected one. {choice}; or crop the photos, or delete the others from the file"
            raise CaptureError(image.file, f"view {name}", problem)
        if person is not None:
            people.append(found[person] if person < len(found) else nobody)
        else:
            people.append(max(found, key=lambda each: each.values[:, 2].sum(), default=nobody))
    if person is not None and person >= most:
        raise CaptureError(path, f"person {person}", f"no view has this many people: expected 0 to {max(most - 1, 0)}")
    values = np.stack([each.values for each in people]).astype(np.float32)
    keypoints = Keypoints(
        values[..., :2],
        values[..., 2],
        kind,
        missing=tuple(name for name, row in zip(names, values[..., 2], strict=True) if not row.any()),
        not_finite=sum(each.not_finite for each in people),
        far_outside=sum(each.far_outside for each in people),
        shifted=_shifted(images, names),
        largest=largest,
        world=values[..., 3:] if columns > 3 else None,
    )
    _check_pixels(path, keypoints)
    return keypoints


def _shifted(images: Sequence[DetectedImage | None], names: Sequence[str]) -> str:
    """An image and its view whose numbers differ, because one is counted from 0 and the other from 1; "" if there is none."""
    for image, name in zip(images, names, strict=True):
        if image is not None:
            numbers = [re.findall(r"\d+", str(_stem(each) if isinstance(each, str) else each)) for each in (image.image, name)]
            if all(numbers) and int(numbers[0][-1]) != int(numbers[1][-1]):
                return f"{image.image} is view {name}"
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
    # an import pads photos of several sizes, each at its right and below, to the largest: pixels keep their places
    before_padding = bool(sizes) and tuple(max(side) for side in zip(*sizes, strict=True)) == (width, height)
    for image, view in zip(detections.images, views, strict=True):
        if view is None:
            continue
        if not before_padding and image.size not in (None, (width, height)):
            size = " x ".join(map(str, image.size or ()))
            problem = f"{size}, but the capture's photos have {width} x {height}: expected keypoints of these"
            raise CaptureError(image.file, f"size of {image.image}", problem)
        images[view] = image
    if not any(images):
        named = few([str(image.image) for image in detections.images])
        raise CaptureError(path, "", f"images {named} are none of the views {few(names)}: expected the same names")
    return images


def _check_pixels(path: Path, keypoints: Keypoints) -> None:
    seen = keypoints.points[keypoints.confidences > 0]
    if not len(seen):
        problem = f"no point has a confidence above 0 (not finite: {keypoints.not_finite}, far outside of the photos: "
        raise CaptureError(path, "", f"{problem}{keypoints.far_outside}): expected keypoints of these photos")
    if np.abs(seen).max() < NORMALIZED:
        problem = f"no coordinate exceeds {NORMALIZED:g}: expected pixels, not shares of the image"
        raise CaptureError(path, "", f"{problem} (OpenPose: --keypoint_scale 0)")


# Which person ---------------------------------------------------------------------------------------------------------


def _is_clear(confidences: Float[np.ndarray, " k"]) -> bool:
    present = confidences[confidences > 0]
    return len(present) > CLEAR_SHARE * len(confidences) and float(present.mean()) > CLEAR_CONFIDENCE


def _largest_score(detections: Detections) -> float:
    """Of all people, if it is beyond what heat maps overshoot; else 1."""
    scores = [person[:, 2] for image in detections.images for person in image.people if len(person)]
    known = np.concatenate(scores) if scores else np.zeros(0)
    largest = float(known[np.isfinite(known)].max(initial=0.0))
    return largest if largest > OVERSHOOT else 1.0


def _usable(
    values: Float[np.ndarray, "k columns"],
    largest: float,
    offset: float,
    width: int,
    height: int,
    image: DetectedImage,
    view: str,
) -> Person:
    """Raises: CaptureError if confidences are not in [0, 1]."""
    finite = np.logical_and.reduce(np.isfinite(values), axis=1)
    known = values[np.isfinite(values[:, 2]), 2]
    if known.size and (known.min() < SMALLEST_CONFIDENCE or known.max() > LARGEST_SCORE):
        got = f"{known.min():.4g} to {known.max():.4g}"
        raise CaptureError(image.file, f"view {view}", f"expected confidences in [0, 1], got {got}")
    values = np.where(finite[:, None], np.clip(values, -LARGEST_PIXEL, LARGEST_PIXEL), 0.0)
    points, confidences = values[:, :2] + offset, np.clip(values[:, 2] / largest, 0, 1)
    far = (np.abs(points / (width, height) - 0.5) > 0.5 + FAR_OUTSIDE).any(axis=1) & (confidences > 0)
    usable = np.column_stack([points, np.where(far, 0, confidences), values[:, 3:]])
    return Person(usable, int((~finite).sum()), int(far.sum()))


# Which view -----------------------------------------------------------------------------------------------------------


def match_views(images: Sequence[str | int], names: Sequence[str]) -> list[int | None]:
    """For each image the index of its view, None for images that are of no view.

    Views have names like "front", "000012" or, where that would be ambiguous, "images_cam0_000012" (folders joined by _).
    Images of keypoint files have names like "front.jpg", "cam0/000012.png" and "cam0_000000000012" (OpenPose counts a video's
    frames in twelve digits), or are mere numbers (COCO's image ids, the frames of a video).

    Where a video's frames are counted from 0 and its photos from 1 (ffmpeg), or the other way round, there are as many of
    either, without gaps, and they are matched in order, for each video by itself.

    Raises: ValueError if two images are of one view, or a number could mean two views.
    """
    numbered = _match_numbers([image for image in images if isinstance(image, int)], names)
    named = _match_paths([image for image in images if isinstance(image, str)], names)
    views = [numbered.get(image) if isinstance(image, int) else named[image] for image in images]
    owner: dict[int, str | int] = {}
    for image, view in zip(images, views, strict=True):
        if view is None:
            continue
        if view in owner:
            raise ValueError(f"{owner[view]!r} and {image!r} are both for view {names[view]!r}: expected one entry a view")
        owner[view] = image
    return views


def _match_paths(images: Sequence[str], names: Sequence[str]) -> dict[str, int | None]:
    views = {image: _match_path(_stem(image), names) for image in images}
    videos: dict[str, list[tuple[int, str]]] = {}
    for image in views:
        video, number = _split_number(str(_stem(image)))
        if number is not None:
            videos.setdefault(video, []).append((number, image))
    of_view = [_split_number(name) for name in names]
    for video, frames in videos.items():
        frames.sort()
        first, count = frames[0][0], len(frames)
        counted = [number for number, _ in frames] == list(range(first, first + count))
        if first > 1 or count < 2 or not counted or None not in (views[image] for _, image in frames):
            continue
        shifted = [_match_path(PurePosixPath(f"{video}{1 - first + i}"), names) for i in range(count)]
        prefixes = {of_view[view][0] for view in shifted if view is not None}
        if None not in shifted and len(prefixes) == 1 and sum(prefix in prefixes for prefix, _ in of_view) == count:
            views |= {image: view for (_, image), view in zip(frames, shifted, strict=True)}
    return views


def _stem(image: str) -> PurePosixPath:
    path = PurePosixPath(image.replace("\\", "/"))
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def _split_number(name: str) -> tuple[str, int | None]:
    prefix = name.rstrip("0123456789")
    return prefix, int(name[len(prefix) :]) if len(prefix) < len(name) else None


def _match_path(path: PurePosixPath, names: Sequence[str]) -> int | None:
    """The view of a file name with as many of its folders as fit; then with numbers compared as numbers."""
    # the names of views are made from paths in this way
    keys = [re.sub(r"[^\w.-]", "_", "_".join(path.parts[i:])).lstrip("._") for i in range(len(path.parts))]
    plain = [_plain(name) for name in names]
    for key in keys:
        if key in names:
            return names.index(key)
        if (view := _only([i for i, name in enumerate(plain) if name == _plain(key)])) is not None:
            return view
        ends = [i for i, name in enumerate(plain) if "_" in key and name.endswith("_" + _plain(key))]
        if (view := _only(ends)) is not None:
            return view
    return None


def _match_numbers(numbers: Sequence[int], names: Sequence[str]) -> dict[int, int]:
    """The views of image numbers, by the last number in the names of the views."""
    of_view = {i: int(found[-1]) for i, name in enumerate(names) if (found := re.findall(r"\d+", name))}
    shift, matched = 0, {}
    known, wanted, count = sorted(set(numbers)), sorted(of_view.values()), len(names)
    if known and all(each == list(range(each[0], each[0] + count)) for each in (known, wanted) if each):
        shift = wanted[0] - known[0] if len(wanted) == count else 0
    for number in set(numbers):
        views = [i for i, value in of_view.items() if value == number + shift]
        if len(views) > 1:
            both = " and ".join(repr(names[i]) for i in views[:2])
            raise ValueError(f"image number {number} could be view {both}: expected file names instead of numbers")
        if views:
            matched[number] = views[0]
    return matched


def _plain(name: str) -> str:
    return re.sub(r"(?<!\d)0+(?=\d)", "", name)


def _only(found: list[int]) -> int | None:
    return found[0] if len(found) == 1 else None
