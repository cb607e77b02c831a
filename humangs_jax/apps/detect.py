"""People in photos: found, the same one in all of them chosen, and written as keypoints, masks and a numbered sheet.

    keypoints.json   the chosen person, for `humangs fit`
    people.png       the sheet: everybody, with numbers
    masks/NAME.png   of the chosen person

With cameras people are matched by how well they triangulate, over time by where they are; without, by their size in the photo,
and where several are of nearly one size, by the colors of their upper bodies and legs.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from humangs_jax.apps.start import photo_files
from humangs_jax.core.array_types import Bool, Float, Int, UInt
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import bar
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import few
from humangs_jax.data.keypoints.formats import ImagePeople, SeenPerson, seen_person, write_people
from humangs_jax.data.keypoints.keypoints import MEDIAPIPE_33, Keypoints
from humangs_jax.data.masks import box_of
from humangs_jax.data.photos import Photos, load_photos, read_description
from humangs_jax.detection.people import LANDMARK_SIZE, SEEN, DetectedPerson, Networks, detect_people, sharpened
from humangs_jax.fitting.triangulation import Seen, in_order_of_time, match_colors, match_people
from humangs_jax.geometry.camera import Camera
from humangs_jax.io.atomic import add_files
from humangs_jax.io.images import orientation, oriented, read_image, resized, to_uint8, write_png
from humangs_jax.io.reading import write_json

KEYPOINTS_FILE, SHEET_FILE, MASKS = "keypoints.json", "people.png", "masks"
RIVAL = 0.35
"""Somebody with this share of the pixels of the largest person may be meant as well as he."""
THUMBNAIL = 480
"""Pixels of the longest side of a photo on the sheet."""
COLORS = ((46, 160, 67), (31, 111, 235), (219, 109, 40), (163, 113, 247), (207, 34, 46))
"""Of the people on the sheet, by number."""
FAINT = 0.45
"""Share of the color over a person's pixels."""
BEYOND = 0.03
"""Share of a person's size that a landmark outside of the photo is beyond its border."""
PARTS = ((11, 12, 24, 23), (23, 24, 26, 25))
"""Corners of upper body and thighs: landmarks of the left and right."""
LARGE_PEOPLE = 5
"""In a photo, at most, that are told apart by their colors."""


class Found(NamedTuple):
    """A person in a photo. mask: 8 bits, the part of the photo that begins at corner (row, column). area: pixels of the person.
    mirrored: left and right were exchanged, as other views show; it is repaired.
    """

    person: SeenPerson
    mask: UInt[np.ndarray, "h w"]
    corner: tuple[int, int]
    area: float
    mirrored: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class PhotoPeople:
    """A photo. name: of the file. size: (width, height). thumbnail: (h, w, 3) for the sheet. people: None who is not in it.
    colors: several are large, and colors tell who is who. unclear: they do not.
    """

    name: str
    size: tuple[int, int]
    thumbnail: Float[np.ndarray, "h w 3"]
    people: tuple[Found | None, ...]
    colors: bool = False
    unclear: bool = False


def found_in_photos(folder: Path) -> list[PhotoPeople]:
    """The people in the photos of a folder, or of a capture folder, whose cameras are used; see `same_people`.

    Raises: CaptureError without photos; FileError, naming the file, for what is no photo; ValueError without LiteRT.
    """
    if (folder / "capture.json").is_file():
        return found_in_capture(folder)
    images, files = photo_files(folder)
    names = [file.relative_to(images).as_posix() for file in files]
    return same_people(detect_photos(names, map(upright, files)))


def found_in_capture(folder: Path) -> list[PhotoPeople]:
    """The same for the photos of a capture folder; their names are the views'. Raises: see `found_in_photos`."""
    photos = load_photos(folder)  # checked; these are on white where there are masks
    views = read_description(folder / "capture.json")["views"]
    found = detect_photos([f"{name}.png" for name in photos.names], (read_image(folder / view["image"])[0] for view in views))
    return same_people(found, photos.cameras, photos.frames.tolist())


def person_in_capture(
    folder: Path, photos: Photos | Capture, keypoints: Keypoints | None = None, person: int | None = None
) -> tuple[list[PhotoPeople], int]:
    """The people in the photos of a capture folder, and the number of the one who is meant: by keypoints, if there are any, else
    by the number asked for, else by masks, else by size. Raises: see `found_in_photos`, `choose`; ValueError for keypoints or
    masks of nobody.
    """
    people, sheet = found_in_capture(folder), folder / SHEET_FILE
    if keypoints is None and (photos.masks is None or person is not None or not people[0].people):
        return people, choose(people, person, sheet)

    def agreement(v: int, number: int) -> float:
        mask = person_mask(people[v], number)
        if keypoints is None:
            assert photos.masks is not None
            return float(np.sum(photos.masks[v] * mask))
        x, y = np.floor(keypoints.points[v]).astype(int).T
        seen = (keypoints.confidences[v] > 0) & _inside(x, y, *mask.shape[::-1])
        return float(np.sum(mask[y[seen], x[seen]]))

    sums = [sum(agreement(v, i) for v in range(len(people))) for i in range(len(people[0].people))]
    if max(sums, default=0.0) <= 0:
        write_sheet(sheet, people)
        given = "masks" if keypoints is None else "keypoints"
        raise ValueError(f"the {given} are of nobody who was found in the photos: see {sheet}")
    return people, int(np.argmax(sums))


def _inside(x: Int[np.ndarray, " n"], y: Int[np.ndarray, " n"], width: int, height: int) -> Bool[np.ndarray, " n"]:
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def keypoints_of(photos: Sequence[PhotoPeople], person: int) -> Keypoints:
    """The keypoints of a person; of photos without the person, none."""
    nobody = np.zeros((len(MEDIAPIPE_33.names), 6))
    seen = [photo.people[person] for photo in photos]
    found = [nobody if each is None else np.column_stack([each.person.points, each.person.world]) for each in seen]
    points = np.asarray(found, np.float32)
    return Keypoints(points[..., :2], points[..., 2], MEDIAPIPE_33, world=points[..., 3:])


def upright(file: Path) -> Float[np.ndarray, "h w 3"]:
    """A photo as its EXIF orientation wants it shown."""
    return oriented(read_image(file)[0], orientation(file))


def detect_photos(names: Sequence[str], photos: Iterable[Float[np.ndarray, "h w 3"]]) -> list[PhotoPeople]:
    """The people of each photo with values in [0, 1], those with the most pixels first. Raises: ValueError without LiteRT."""
    try:
        networks = Networks()
    except ImportError as error:
        raise ValueError(str(error)) from error  # one line
    found = []
    for name, each in zip(names, bar(photos, desc="finding people", unit="photo", total=len(names)), strict=True):
        photo = np.ascontiguousarray(each, np.float32)
        people = sorted((_found(person, photo) for person in detect_people(networks, photo)), key=lambda one: -one.area)
        height, width = photo.shape[:2]
        shrink = min(1.0, THUMBNAIL / max(height, width))
        small = resized(photo, max(1, round(width * shrink)), max(1, round(height * shrink)))
        found.append(PhotoPeople(name, (width, height), small, tuple(people)))
    return found


def _found(person: DetectedPerson, photo: Float[np.ndarray, "h w 3"]) -> Found:
    mask = sharpened(person.mask, photo, person.side / LANDMARK_SIZE)
    (top, bottom), (left, right) = box_of(mask > 0).tolist()
    cut = to_uint8(mask[top:bottom, left:right])
    return Found(seen_person(person), cut, (top, left), float((cut > 255 * SEEN).sum()))


# Who is who ----------------------------------------------------------------------------------------------------------


def same_people(
    photos: Sequence[PhotoPeople], cameras: Camera | None = None, frames: Sequence[int] | None = None
) -> list[PhotoPeople]:
    """The photos with people in such an order that the i-th of each is the same person.

    Arguments: cameras: a batch, of the photos; None: not known, and the order is that of size, or, where several are large, that
    of colors. frames: the moment of each photo. The person with the most pixels in all photos together is the first.
    """
    if cameras is not None and len(photos) > 1:
        rows = _matched(photos, cameras, np.asarray([0] * len(photos) if frames is None else frames))
    else:
        photos = _by_colors(photos) if len(photos) > 1 else photos
        rows = [list(photo.people) for photo in photos]
    most = max((len(row) for row in rows), default=0)
    ordered = [
        dataclasses.replace(photo, people=(*row, *[None] * (most - len(row)))) for photo, row in zip(photos, rows, strict=True)
    ]
    order = np.argsort([-area for area in _areas(ordered)], kind="stable")
    return [dataclasses.replace(photo, people=tuple(photo.people[i] for i in order)) for photo in ordered]


def _by_colors(photos: Sequence[PhotoPeople]) -> Sequence[PhotoPeople]:
    """The photos, each with its large people in the order of those in the photo that has the most of them; see `unclear`."""
    found = [[each for each in photo.people if each is not None] for photo in photos]  # the largest first
    large = [[each for each in people if each.area > RIVAL * people[0].area][:LARGE_PEOPLE] for people in found]
    most = max(range(len(photos)), key=lambda v: len(large[v]))
    if len(large[most]) < 2:
        return photos
    first = _colors(photos[most], large[most])
    ordered = []
    for photo, people in zip(photos, large, strict=True):
        order = match_colors(first, _colors(photo, people)) if people else ()
        if order is None:
            ordered.append(dataclasses.replace(photo, unclear=True))
            continue
        row: list[Found | None] = [None] * len(first)
        for i, each in zip(order, people, strict=True):
            row[i] = each
        ordered.append(dataclasses.replace(photo, people=(*row, *photo.people[len(people) :]), colors=True))
    return ordered


def _colors(photo: PhotoPeople, people: Sequence[Found]) -> Float[np.ndarray, "n parts 3"]:
    """Medians over each of the parts of each person, (n, parts, 3); NaN for a part that is not in the photo."""
    height, width = photo.thumbnail.shape[:2]
    u, v = (each.reshape(-1, 1) for each in np.meshgrid(np.linspace(0.2, 0.8, 9), np.linspace(0.2, 0.8, 9)))
    found = np.full((len(people), len(PARTS), 3), np.nan)
    for i, each in enumerate(people):
        for k, part in enumerate(PARTS):
            a, b, c, d = each.person.points[list(part), :2] * width / photo.size[0]
            x, y = np.floor((a * (1 - u) + b * u) * (1 - v) + (d * (1 - u) + c * u) * v).astype(int).T
            inside = _inside(x, y, width, height)
            if inside.any():
                found[i, k] = np.median(photo.thumbnail[y[inside], x[inside]], axis=0)
    return found


def _areas(photos: Sequence[PhotoPeople]) -> list[float]:
    people = zip(*(photo.people for photo in photos), strict=True)
    return [sum(found.area for found in person if found is not None) for person in people]


def _matched(photos: Sequence[PhotoPeople], cameras: Camera, frames: Int[np.ndarray, " v"]) -> list[list[Found | None]]:
    K, transforms = (np.asarray(x, np.float64) for x in (cameras.K, cameras.cam_from_world))
    points = [tuple(each.person.points for each in photo.people if each is not None) for photo in photos]
    times = [np.flatnonzero(frames == frame) for frame in np.unique(frames)]
    matches = [match_people([Seen(K[v], transforms[v], points[v]) for v in own], MEDIAPIPE_33.mirror) for own in times]
    rows: list[list[Found | None]] = [[] for _ in photos]
    for own, people in zip(times, in_order_of_time(matches), strict=True):
        for match in people:
            for i, v in enumerate(own):
                found = None if match is None or (member := match.members[i]) is None else photos[v].people[member]
                mirrored = found is not None and match is not None and match.mirrored[i]
                rows[v].append(exchanged(found) if mirrored else found)
    return rows


def exchanged(found: Found) -> Found:
    """The person with left and right exchanged."""
    order = np.asarray(MEDIAPIPE_33.mirror)
    person = dataclasses.replace(found.person, points=found.person.points[order], world=found.person.world[order])
    return found._replace(person=person, mirrored=True)


def choose(photos: Sequence[PhotoPeople], person: int | None, sheet: Path) -> int:
    """The number of the person that is meant: the one asked for, or the only one who is large.

    Arguments: sheet: where the numbers can be looked up; it is written where this cannot be decided.
    Raises: ValueError if no photo has a person or none has this number, if several may be meant, or if it is unclear who is who.
    """
    try:
        return _chosen(photos, person, sheet)
    except ValueError:
        sheet.parent.mkdir(parents=True, exist_ok=True)
        write_sheet(sheet, photos)
        raise


def _chosen(photos: Sequence[PhotoPeople], person: int | None, sheet: Path) -> int:
    count = len(photos[0].people)
    if not count:
        raise ValueError(f"no person in {few([photo.name for photo in photos])}: expected one who is seen as a whole")
    if person is not None:
        if not 0 <= person < count:
            raise ArgumentError("person", f"{person}: expected 0 to {count - 1}, as on {sheet}")
    else:
        areas = _areas(photos)
        rivals = [i for i in range(1, count) if areas[i] > RIVAL * areas[0]]
        if rivals:
            where = few([photo.name for photo in photos if any(photo.people[i] is not None for i in rivals)])
            raise ValueError(f"{len(rivals) + 1} people in {where}: expected one. Person 0 to {len(rivals)}: numbers on {sheet}")
    if unclear := [photo.name for photo in photos if photo.unclear]:
        raise ValueError(
            f"{few(unclear)}: which of the people of {sheet} is meant? Their colors do not tell: cut these photos down to "
            "one person, or leave them out"
        )
    return person or 0


def remarks(photos: Sequence[PhotoPeople], person: int) -> list[str]:
    """What should be known about the photos of a person, a line each."""
    told = [f"{photo.name}: the person was not found in it" for photo in photos if photo.people[person] is None]
    if any(photo.colors for photo in photos):
        told.insert(0, f"several people in a photo: number {person} is the same by the colors of upper body and legs alone")
    found = [(photo, each) for photo in photos if (each := photo.people[person]) is not None]
    for photo, each in found:
        points = each.person.points[:, :2]
        beyond = np.maximum(-points, points - np.asarray(photo.size))
        if (beyond > BEYOND * np.ptp(points, axis=0).max()).any():
            told.append(f"{photo.name}: a part of the person is outside of the photo")
    mirrored = "left and right of the person were exchanged, as the other views show: repaired"
    return told + [f"{photo.name}: {mirrored}" for photo, each in found if each.mirrored]


# Writing -------------------------------------------------------------------------------------------------------------


def write_found(
    folder: Path, photos: Sequence[PhotoPeople], person: int, *, masks: bool = True, to_capture: bool = False
) -> None:
    """Keypoints and masks of a person, and the sheet, into a folder; all or nothing.

    Arguments: to_capture: the folder is the capture whose photos these are, which then names the masks.
    Raises: ValueError if two photos have the same name but for the suffix.
    """
    files = [f"{MASKS}/{Path(photo.name).with_suffix('.png').as_posix()}" for photo in photos]
    owners: dict[str, str] = {}
    for photo, file in zip(photos, files, strict=True):
        if (other := owners.setdefault(file, photo.name)) != photo.name:
            raise ValueError(f"{other} and {photo.name}: both masks would be {file}: rename one")

    def write(temporary: Path) -> None:
        shown = [(photo, photo.people[person]) for photo in photos]
        images = [ImagePeople(photo.name, photo.size, (None if each is None else each.person,)) for photo, each in shown]
        write_people(temporary / KEYPOINTS_FILE, images)
        write_sheet(temporary / SHEET_FILE, photos, person)
        for photo, file in zip(photos, files, strict=True) if masks else ():
            (temporary / file).parent.mkdir(parents=True, exist_ok=True)
            write_png(temporary / file, person_mask(photo, person))
        if masks and to_capture:
            description = read_description(folder / "capture.json")
            views = [view | {"mask": file} for view, file in zip(description["views"], files, strict=True)]
            write_json(temporary / "capture.json", description | {"views": views})

    add_files(folder, write)


def person_mask(photo: PhotoPeople, person: int) -> Float[np.ndarray, "h w"]:
    """The mask of a person at the size of the photo; black if the person is not in it."""
    mask = np.zeros(photo.size[::-1], np.float32)
    if (found := photo.people[person]) is not None:
        (top, left), (height, width) = found.corner, found.mask.shape
        mask[top : top + height, left : left + width] = found.mask / np.float32(255)
    return mask


def write_sheet(path: Path, photos: Sequence[PhotoPeople], person: int | None = None) -> None:
    """The photos side by side, everybody in a color and with a number. person: the one who was chosen."""
    from humangs_jax.avatar.video import contact_sheet

    pictures = [_picture(photo, person) for photo in photos]
    height, width = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    padded = np.ones((len(photos), height, width, 3))
    for sheet, picture in zip(padded, pictures, strict=True):
        sheet[: picture.shape[0], : picture.shape[1]] = picture
    contact_sheet(padded, path, labels=[photo.name for photo in photos])


def _picture(photo: PhotoPeople, chosen: int | None) -> Float[np.ndarray, "h w 3"]:
    from PIL import Image, ImageDraw, ImageFont

    picture = np.asarray(photo.thumbnail, np.float64).copy()
    height, width = picture.shape[:2]
    heads = []
    for i, found in enumerate(photo.people):
        if found is None:
            continue
        color = np.asarray(COLORS[i % len(COLORS)]) / 255
        mask = resized(person_mask(photo, i), width, height)[..., None] * (FAINT if chosen in (None, i) else FAINT / 2)
        picture = picture * (1 - mask) + color * mask
        x, y = found.person.points[0, :2] * width / photo.size[0]
        heads.append((float(np.clip(x, 8, width - 24)), float(np.clip(y - 30, 2, height - 26)), i))
    canvas = Image.fromarray(to_uint8(picture))
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(22)
    for x, y, i in heads:
        number = f"{i}?" if photo.unclear else str(i)
        pen.text((x, y), number, fill="white", stroke_width=3, stroke_fill=COLORS[i % len(COLORS)], font=font)
    return np.asarray(canvas) / 255
