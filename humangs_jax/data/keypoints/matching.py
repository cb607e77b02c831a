"""Which view of a capture an image of a keypoint file is.

Views have names like "front", "000012" or, where that would be ambiguous, "images_cam0_000012" (folders joined by _).
Images of keypoint files have names like "front.jpg", "cam0/000012.png" and "cam0_000000000012" (OpenPose counts a video's
frames in twelve digits), or are mere numbers (COCO's image ids, the frames of a video).
"""

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


def match_views(images: Sequence[str | int], names: Sequence[str]) -> list[int | None]:
    """For each image the index of its view, None for images that are of no view.

    Raises: ValueError if two images are of one view, or a number could mean two views.
    """
    numbered = _match_numbers([image for image in images if isinstance(image, int)], names)
    views = [numbered.get(image) if isinstance(image, int) else _match_path(image, names) for image in images]
    owner: dict[int, str | int] = {}
    for image, view in zip(images, views, strict=True):
        if view is None:
            continue
        if view in owner:
            raise ValueError(
                f"{owner[view]!r} and {image!r} are both for view {names[view]!r}: expected one entry a view"
            )
        owner[view] = image
    return views


def _match_path(image: str, names: Sequence[str]) -> int | None:
    """By the file name with as many of its folders as fit; then with numbers compared as numbers."""
    path = PurePosixPath(image.replace("\\", "/"))
    path = path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path
    keys = [_as_name("_".join(path.parts[i:])) for i in range(len(path.parts))]
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
    """By the last number in the names of the views.

    Where a video's frames are counted from 0 and the photos from 1 (ffmpeg), or the other way round, there are as many of
    either, without gaps, and they are matched in order.
    """
    of_view = {i: int(found[-1]) for i, name in enumerate(names) if (found := re.findall(r"\d+", name))}
    shift = _shift(sorted(set(numbers)), sorted(of_view.values()), len(names))
    matched = {}
    for number in set(numbers):
        views = [i for i, value in of_view.items() if value == number + shift]
        if len(views) > 1:
            both = " and ".join(repr(names[i]) for i in views[:2])
            raise ValueError(f"image number {number} could be view {both}: expected file names instead of numbers")
        if views:
            matched[number] = views[0]
    return matched


def _shift(numbers: list[int], of_views: list[int], views: int) -> int:
    if not numbers or len(numbers) != views or len(of_views) != views:
        return 0
    without_gaps = all(each == list(range(each[0], each[0] + views)) for each in (numbers, of_views))
    return of_views[0] - numbers[0] if without_gaps else 0


def _as_name(text: str) -> str:
    """As the names of views are made from paths."""
    return re.sub(r"[^\w.-]", "_", text).lstrip("._")


def _plain(name: str) -> str:
    """Without zeros before numbers."""
    return re.sub(r"(?<!\d)0+(?=\d)", "", name)


def _only(found: list[int]) -> int | None:
    return found[0] if len(found) == 1 else None
