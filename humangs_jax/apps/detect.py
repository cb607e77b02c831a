"""Finds the people in photos, and chooses one person, who is the same in all photos. Writes this
person's keypoints and masks, and a sheet of all people with their numbers.

Files that are written:

    keypoints.json   keypoints of the chosen person, for `humangs fit`
    masks/NAME.png   masks of the chosen person
    people.png       the sheet: everybody in every photo, with numbers
    unknown/NAME.png for photos of a capture: where somebody else may hide the person

`apps.same_people` decides which people in different photos are the same person.
"""

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.apps.same_people import (
    PersonInPhoto,
    PhotoPeople,
    inside_photo,
    is_unclear,
    rivals,
    same_people,
)
from humangs_jax.apps.start import photo_files, scan_photos
from humangs_jax.capture.detection.face_and_hands import FaceAndHands, hand_columns
from humangs_jax.capture.detection.painting import painted_over
from humangs_jax.capture.detection.people import (
    LANDMARK_SIZE,
    MARGINS,
    SEEN,
    Landmarks,
    Networks,
    find_people,
    mask_in_window,
    mask_window,
)
from humangs_jax.capture.detection.sharpening import filter_margin, sharpened
from humangs_jax.capture.keypoints.formats import (
    ImagePeople,
    SeenPerson,
    columns_of,
    read_people,
    write_people,
)
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33, MEDIAPIPE_69, Keypoints
from humangs_jax.core.array_types import Bool, Float
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.progress import bar
from humangs_jax.data.capture import Capture
from humangs_jax.data.capture_checks import few
from humangs_jax.data.folders import unused_line
from humangs_jax.data.masks import box_of
from humangs_jax.data.photos import (
    LEAST_UNKNOWN,
    Photos,
    load_photos,
    read_description,
    read_mask,
    unknown_in_capture,
)
from humangs_jax.io.atomic import MOVE_AWAY, add_files, check_ours
from humangs_jax.io.images import (
    MASK,
    mark_of,
    orientation,
    oriented,
    read_grey,
    read_image,
    resized,
    to_uint8,
    write_png,
)
from humangs_jax.io.reading import write_json

KEYPOINTS_FILE = "keypoints.json"
"""File name of the keypoints."""
SHEET_FILE = "people.png"
"""File name of the sheet, a picture of all photos with their people."""
MASKS = "masks"
"""Name of the folder of masks."""


@dataclasses.dataclass(frozen=True)
class _Sheet:
    """How the sheet of people looks."""

    thumbnail: int = 480
    """Photos whose longer side exceeds this are reduced to it on the sheet, pixels."""
    colors: tuple[tuple[int, int, int], ...] = (
        (46, 160, 67),
        (31, 111, 235),
        (219, 109, 40),
        (163, 113, 247),
        (207, 34, 46),
    )
    """Colors of the people on the sheet, by number."""
    faint: float = 0.45
    """Opacity of the color over a person's pixels, 0 to 1. If a person is chosen, all other people
    have half of this opacity.
    """


_SHEET = _Sheet()


_PLAINLY = 0.5
"""Share that decides three comparisons of masks or keypoints. A matched person with less than this
share of the best score gives way to the best. A person found in a cut photo needs this share of the
given mask's area. A person with more than this share of their own mask on another person's mask is
taken for that other person.
"""


def found_in_photos(folder: Path) -> list[PhotoPeople]:
    """Finds the people in the photos of a folder and matches them between photos. In a capture
    folder the calibrated cameras help to match, see `same_people`.

    Raises:
        CaptureError: if there are no photos, or if a capture folder has a fault.
        FileError: for a photo that cannot be read; the message names the file.
        ValueError: if LiteRT is not installed.
    """
    if (folder / "capture.json").is_file():
        return found_in_capture(folder)
    images, files = photo_files(folder)
    names = [file.relative_to(images).as_posix() for file in files]
    return same_people(detect_photos(names, map(upright, files)))


def left_out(folder: Path) -> str | None:
    """Returns one line that names the files of a folder that `found_in_photos` does not use.
    Returns None if it uses all files, and for a capture folder.

    Raises: CaptureError if the folder has no photos.
    """
    if (folder / "capture.json").is_file():
        return None
    return unused_line(scan_photos(folder).unused)


def found_in_capture(folder: Path) -> list[PhotoPeople]:
    """Finds the people in the photos of a capture folder and matches them between photos. Each
    photo has the name of its view, with the suffix .png.

    Raises: see `found_in_photos`.
    """
    photos = load_photos(folder)  # checked; these are on white where there are masks
    unknown = unknown_in_capture(folder)
    if photos.masks is None:
        pictures = without_others(photos.images, unknown)
    else:
        views = read_description(folder / "capture.json")["views"]
        pictures = (read_image(folder / view["image"])[0] for view in views)
    found = detect_photos([f"{name}.png" for name in photos.names], pictures)
    if photos.masks is not None:
        found = with_masked(found, list(photos.masks), list(photos.images))
    found = without_hidden_landmarks(found, unknown)
    return same_people(found, photos.cameras, photos.frames.tolist())


Hidden = Sequence[Bool[np.ndarray, "_h _w"] | None] | Bool[np.ndarray, "v h w"] | None
"""Pixels of each photo that do not show the person, one array (h, w) or None per photo. None: no
photo has such pixels.
"""


def without_hidden_landmarks(photos: list[PhotoPeople], hidden: Hidden) -> list[PhotoPeople]:
    """Sets the confidence of landmarks to 0 where a photo does not show the person, since there the
    detector only guesses them. Returns the photos with these landmarks.
    """
    if hidden is None:
        return photos

    # points of one person under the cover of one photo
    def uncovered(points: Float[np.ndarray, "k c"], cover: Bool[np.ndarray, "h w"]) -> np.ndarray:
        """Returns the points (x, y, confidence, ...) with confidence 0 under the cover."""
        column, row = np.floor(points[:, :2]).astype(int).T
        inside = np.flatnonzero(inside_photo(column, row, *cover.shape[::-1]))
        points = points.copy()
        points[inside[cover[row[inside], column[inside]]], 2] = 0
        return points

    def seen(found: PersonInPhoto | None, cover: Bool[np.ndarray, "h w"]) -> PersonInPhoto | None:
        """Returns the person with confidence 0 for all landmarks under the cover."""
        if found is None:
            return None
        person = found.person
        hands = None if person.hands is None else uncovered(person.hands, cover)
        points = uncovered(person.points, cover)
        return found._replace(person=dataclasses.replace(person, points=points, hands=hands))

    shown = []
    for photo, cover in zip(photos, hidden, strict=True):
        # photos that hide nothing stay the same objects
        if cover is not None and cover.any():
            people = tuple(seen(each, cover) for each in photo.people)
            photo = dataclasses.replace(photo, people=people)
        shown.append(photo)
    return shown


def without_others(
    pictures: Iterable[Float[np.ndarray, "_h _w 3"]], others: Hidden
) -> Iterator[Float[np.ndarray, "h w 3"]]:
    """Paints over other people and things in front of the person with the colors around them, so
    that the detector finds the person alone. Yields the photos.

    Arguments: others: for each photo, the pixels to paint over, or None. Pixels that are pure white
    stay as they are, since an import marks the white that it adds around a photo as unknown, too.
    """
    for i, picture in enumerate(pictures):
        covered = None if others is None else others[i]
        if covered is not None:
            covered = covered & (picture.min(axis=-1) < 1)
        if covered is None or not covered.any():
            yield picture
        else:
            yield painted_over(picture, covered, MARGINS[0])[0]


def with_masked(
    found: list[PhotoPeople],
    masks: Sequence[Float[np.ndarray, "_h _w"]],
    on_white: Sequence[Float[np.ndarray, "_h _w 3"]],
) -> list[PhotoPeople]:
    """Makes sure that the person of each given mask is among the people of its photo, if the
    detector finds this person. Returns the photos.

    Where nobody found in a photo matches the mask, the detector looks again, at the photo cut to
    the mask. There it takes the person who matches the mask best. If this person has at least half
    of the mask's area, the person is added to the photo. People whose masks lie mostly on this
    person's mask are then removed.

    Arguments: masks: one per photo, (h, w), 0 to 1. on_white: the photos cut to their masks, white
    elsewhere.
    Raises: ValueError if LiteRT is not installed.
    """
    # where a given mask and the person found there overlap less, somebody else may have been found
    lost = [
        v
        for v, (photo, mask) in enumerate(zip(found, masks, strict=True))
        if (mask > SEEN).any()
        and max((_overlap(each, mask) for each in photo.people), default=0.0) < 0.6
    ]
    if not lost:
        return found
    alone = detect_photos([found[v].name for v in lost], [on_white[v] for v in lost])
    result = list(found)
    for v, cut in zip(lost, alone, strict=True):
        own = max(cut.people, key=lambda each: _overlap(each, masks[v]), default=None)
        if own is None or own.area < _PLAINLY * float((masks[v] > SEEN).sum()):
            continue
        # whoever had most of the mask before was this person, badly, or somebody in front
        others = [each for each in found[v].people if not _mostly(each, own, found[v].size)]
        people = sorted([own, *others], key=lambda each: -(0.0 if each is None else each.area))
        result[v] = dataclasses.replace(found[v], people=tuple(people))
    return result


def _overlap(found: PersonInPhoto | None, mask: Float[np.ndarray, "h w"]) -> float:
    """Returns the intersection over union, 0 to 1, of a found person's mask and a given mask, which
    is as large as the photo. Returns 0 for None.
    """
    if found is None:
        return 0.0
    (top, left), (height, width) = found.corner, found.mask.shape
    own, given = found.mask > 255 * SEEN, mask > SEEN
    shared = np.count_nonzero(own & given[top : top + height, left : left + width])
    either = np.count_nonzero(own) + np.count_nonzero(given) - shared
    return shared / max(either, 1)


def _mostly(found: PersonInPhoto | None, other: PersonInPhoto, size: tuple[int, int]) -> bool:
    """Returns whether more than half of a person's mask lies on the mask of another person. True
    for None. size: width and height of the photo, pixels.
    """
    if found is None:
        return True
    whole = np.zeros(size[::-1], bool)
    (top, left), (height, width) = other.corner, other.mask.shape
    whole[top : top + height, left : left + width] = other.mask > 255 * SEEN
    (top, left), (height, width) = found.corner, found.mask.shape
    own = found.mask > 255 * SEEN
    shared = np.count_nonzero(own & whole[top : top + height, left : left + width])
    return bool(shared > _PLAINLY * max(np.count_nonzero(own), 1))


def person_in_capture(
    folder: Path,
    photos: Photos | Capture,
    keypoints: Keypoints | None = None,
    person: int | None = None,
) -> tuple[list[PhotoPeople], int]:
    """Finds the people in the photos of a capture folder, and returns them with the number of the
    intended person. Keypoints decide who is intended. Without keypoints, the number `person`
    decides. Without a number, the masks decide. Without masks, the only large person is intended.

    Raises: see `found_in_photos`, `choose` and `person_of`. Also ValueError for a photo in which
    people are found, if its keypoints belong to none of them.
    """
    people, sheet = found_in_capture(folder), folder / SHEET_FILE
    if keypoints is None:
        if photos.masks is None or person is not None or not people[0].people:
            return people, choose(people, person, sheet)
        return person_of(people, list(photos.masks), sheet)
    people, number = person_of(people, keypoints, sheet)
    lost = [
        photo.name
        for v, photo in enumerate(people)
        if _has_any(keypoints, v) and photo.people[number] is None and any(photo.people)
    ]
    if lost:
        told = (
            f"{few(lost)}: the keypoints are of nobody who was found there: see {sheet}; give"
            " masks, or leave the photo out"
        )
        raise _refused(told, people, sheet)
    return people, number


Masks = Sequence[Float[np.ndarray, "h w"] | Bool[np.ndarray, "h w"]]
"""One mask per photo, (h, w), as large as its photo."""


def person_of(
    photos: Sequence[PhotoPeople], given: Keypoints | Masks, sheet: Path
) -> tuple[list[PhotoPeople], int]:
    """Finds the person that the given keypoints or masks show. Returns the photos, in which this
    person has the same number everywhere, and the number. Where a photo's keypoints or masks
    contradict the match between photos, the keypoints or masks decide.

    Arguments: sheet: where to write the sheet of people if the call fails.
    Raises: ValueError if the keypoints or masks belong to nobody who was found. Also if a photo has
    no keypoints or mask, and it is unclear who in the photo is intended. OSError if the sheet
    cannot be written.
    """
    kind = "keypoints" if isinstance(given, Keypoints) else "masks"
    scores = [
        [_agreement(each, given, v) for each in photo.people] for v, photo in enumerate(photos)
    ]
    sums = np.sum(np.asarray(scores), axis=0)
    if max(sums, default=0.0) <= 0:
        raise _refused(
            f"the {kind} are of nobody who was found in the photos: see {sheet}", photos, sheet
        )
    number, settled = int(np.argmax(sums)), []
    for photo, row in zip(photos, scores, strict=True):
        people, best = list(photo.people), int(np.argmax(row))
        if row[number] < _PLAINLY * row[best]:
            # the matching put somebody else there, or nobody
            people[number], people[best] = people[best], people[number]
        settled.append(
            dataclasses.replace(photo, people=tuple(people), known=photo.known or max(row) > 0)
        )
    blank = [v for v in range(len(photos)) if not _has_any(given, v)]
    unclear = [photos[v].name for v in blank if is_unclear(settled, v, number)]
    if unclear:
        told = (
            f"{few(unclear)}: which of the people of {sheet} is meant? There are no {kind} of the"
            " person: add them"
        )
        raise _refused(told, settled, sheet)
    return settled, number


def _has_any(given: Keypoints | Masks, view: int) -> bool:
    if isinstance(given, Keypoints):
        return bool(np.any(given.confidences[view]))
    return bool(np.any(given[view]))


def _agreement(found: PersonInPhoto | None, given: Keypoints | Masks, view: int) -> float:
    """Returns how well a found person agrees with the keypoints or the mask of a view. For
    keypoints, it is the sum of the values of the person's mask at the seen keypoints. For a mask,
    it is the sum of the products of the two masks. It is 0 if `found` is None.
    """
    if found is None:
        return 0.0
    mask, (top, left) = found.mask / np.float32(255), found.corner
    height, width = mask.shape
    if not isinstance(given, Keypoints):
        return float(np.sum(given[view][top : top + height, left : left + width] * mask))
    x, y = np.floor(given.points[view]).astype(int).T - np.asarray([[left], [top]])
    seen = (given.confidences[view] > 0) & inside_photo(x, y, width, height)
    return float(np.sum(mask[y[seen], x[seen]]))


def keypoints_of(photos: Sequence[PhotoPeople], person: int) -> Keypoints:
    """Returns the keypoints of the person with this number in all photos. Confidences are 0 in
    photos without the person.
    """
    found = [photo.people[person] for photo in photos]
    seen = [None if each is None else each.person for each in found]
    hands = any(each is not None and each.hands is not None for each in seen)
    points = np.asarray([columns_of(each, hands) for each in seen], np.float32)
    kind = MEDIAPIPE_69 if hands else MEDIAPIPE_33
    return Keypoints(points[..., :2], points[..., 2], kind, world=points[..., 3:])


def upright(file: Path) -> Float[np.ndarray, "h w 3"]:
    """Reads a photo and turns it upright by its EXIF orientation. Returns (h, w, 3), 0 to 1.

    Raises: FileNotFoundError; FileError if the file cannot be read as a photo.
    """
    return oriented(read_image(file)[0], orientation(file))


def detect_photos(
    names: Sequence[str], photos: Iterable[Float[np.ndarray, "h w 3"]]
) -> list[PhotoPeople]:
    """Finds the people in each photo. The people of a photo are in the order of their
    `PersonInPhoto.area`, largest first.

    Arguments: photos: values in [0, 1].
    Raises: ValueError if LiteRT is not installed.
    """
    try:
        networks, parts = Networks(), FaceAndHands()
    except ImportError as error:
        raise ValueError(str(error)) from error  # one line
    found = []
    for name, each in zip(
        names, bar(photos, desc="finding people", unit="photo", total=len(names)), strict=True
    ):
        photo = np.ascontiguousarray(each, np.float32)
        people = sorted(
            (_found(person, photo, parts) for person in find_people(networks, photo)),
            key=lambda one: -one.area,
        )
        height, width = photo.shape[:2]
        shrink = min(1.0, _SHEET.thumbnail / max(height, width))
        small = resized(photo, max(1, round(width * shrink)), max(1, round(height * shrink)))
        found.append(PhotoPeople(name, (width, height), small, tuple(people)))
    return found


def _found(
    person: Landmarks, photo: Float[np.ndarray, "h w 3"], parts: FaceAndHands | None = None
) -> PersonInPhoto:
    """Returns a detected person with a mask that follows the edges in the photo. `parts`, if given,
    finds the hands.

    The mask covers only a part of the photo. Landmarks outside of the photo are guesses of the
    detector, so they are marked as not seen.
    """
    pixel = person.crop.side / LANDMARK_SIZE
    window = mask_window(person, photo.shape[1], photo.shape[0], filter_margin(pixel))
    mask = sharpened(mask_in_window(person, window), photo[window], pixel)
    (top, bottom), (left, right) = box_of(mask > 0).tolist()
    cut = to_uint8(mask[top:bottom, left:right])
    corner = (window[0].start + top, window[1].start + left)
    # the first pixel's centre is at 0 for the network, and at one half here
    places = person.pixels + 0.5
    column, row = np.floor(places).astype(int).T
    height, width = photo.shape[:2]
    seen = inside_photo(column, row, width, height)
    points = np.column_stack([places, np.where(seen, person.visibility, 0.0)]).astype(np.float64)
    both = (None, None)
    if parts is not None:
        both = parts.hands(photo, person.pixels, points[:, 2])
    hands = hand_columns(both, person.world)
    if hands is not None:
        hands[hands[:, 2] > 0, :2] += 0.5
    area = float((cut > 255 * SEEN).sum())
    if person.covered:
        # people who stand free have a tenth of the pixels of the detector's crop
        area = max(area, 0.1 * person.crop.side**2)
    return PersonInPhoto(
        SeenPerson(points, person.world, person.presence, hands),
        cut,
        corner,
        area,
        covered=person.covered,
    )


# Who is meant
# --------------------------------------------------------------------------------------------------


def choose(photos: Sequence[PhotoPeople], person: int | None, sheet: Path) -> int:
    """Returns the number of the intended person: `person` if a number was asked for, else the
    number of the only large person.

    Arguments: person: the number that was asked for; None: none was. sheet: where the numbers can
    be looked up. It is written if the choice fails.
    Raises: ValueError if no photo has a person, if nobody has this number, if photos show several
    large people and no number was asked for, or if it is unclear who is who. OSError if the sheet
    cannot be written.
    """
    try:
        return _chosen(photos, person, sheet)
    except ValueError:
        _write_refused(sheet, photos)
        raise


def _write_refused(sheet: Path, photos: Sequence[PhotoPeople]) -> None:
    """Writes the sheet of people to which an error message refers.

    Raises: ValueError if there is a file of this name that we did not write; OSError.
    """
    sheet.parent.mkdir(parents=True, exist_ok=True)
    check_ours(
        [sheet],
        _is_ours,
        "several people may be meant, and their numbers belong there: move it away",
    )
    _write_sheet(sheet, photos)


def _refused(message: str, photos: Sequence[PhotoPeople], sheet: Path) -> ValueError:
    """Writes the sheet of people, and returns an error with this message. Raises: see
    `_write_refused`.
    """
    _write_refused(sheet, photos)
    return ValueError(message)


def _chosen(photos: Sequence[PhotoPeople], person: int | None, sheet: Path) -> int:
    count = len(photos[0].people)
    if not count:
        raise ValueError(
            f"no person in {few([photo.name for photo in photos])}: expected one who is seen as a"
            " whole"
        )
    if person is not None:
        if not 0 <= person < count:
            raise ArgumentError("person", f"{person}: expected 0 to {count - 1}, as on {sheet}")
    elif all(photo.known for photo in photos) and rivals(photos):
        shown = [sum(each is not None for each in photo.people) for photo in photos]
        where = [photo.name for photo, n in zip(photos, shown, strict=True) if n > 1]
        # people of photos that are matched by cameras may each be alone
        where = where or [photo.name for photo in photos]
        numbers = f"Person 0 to {count - 1}: numbers on {sheet}"
        raise ValueError(f"{max(*shown, 2)} people in {few(where)}: expected one. {numbers}")
    chosen = person or 0
    unclear = [photo.name for i, photo in enumerate(photos) if is_unclear(photos, i, chosen)]
    if unclear:
        raise ValueError(
            f"{few(unclear)}: which of the people of {sheet} is meant? Nothing tells who of one"
            " photo is who of another: cut these photos down to one person, leave them out, or"
            " give masks or keypoints of the one"
        )
    return chosen


def remarks(photos: Sequence[PhotoPeople], person: int) -> list[str]:
    """Returns remarks about the photos of a person, a line each: photos without the person, persons
    who are cut off, doubtful calibration, and exchanges of left and right.
    """
    told = [
        f"{photo.name}: the person was not found in it"
        for photo in photos
        if photo.people[person] is None
    ]
    everywhere = [(photo, photo.people[person]) for photo in photos]
    found = [(photo, each) for photo, each in everywhere if each is not None]
    for photo, each in found:
        points = each.person.points[:, :2]
        beyond = np.maximum(-points, points - np.asarray(photo.size))
        # outside of the photo means that a landmark is 3 % of the person's size beyond its border
        if (beyond > 0.03 * np.ptp(points, axis=0).max()).any():
            told.append(f"{photo.name}: a part of the person is outside of the photo")
    apart = [photo.name for photo, each in found if each.apart]
    if apart:
        where = "the person is not where the other photos of the moment show them"
        told.append(f"{few(apart)}: {where}: the calibration is off there, or it is somebody else")
    mirrored = "left and right of the person were exchanged, as the other views show: repaired"
    return told + [f"{photo.name}: {mirrored}" for photo, each in found if each.mirrored]


# Writing
# --------------------------------------------------------------------------------------------------


def check_found_place(
    folder: Path, names: Sequence[str], advice: str = MOVE_AWAY, *, masks: bool = True
) -> None:
    """Checks that results for photos of these names can be written into a folder without replacing
    files that we did not write. masks: whether masks will be written. advice: what the user can do.

    Raises: ValueError, see `io.atomic.check_ours`.
    """
    files = [KEYPOINTS_FILE, SHEET_FILE, *(map(_mask_name, names) if masks else ())]
    check_ours((folder / file for file in files), _is_ours, advice)


def names_in(folder: Path) -> list[str]:
    """Returns the names of the photos that `found_in_photos` looks at.

    Raises: CaptureError if there are no photos, or if a capture folder has a fault.
    """
    if (folder / "capture.json").is_file():
        return [f"{name}.png" for name in load_photos(folder).names]
    images, files = photo_files(folder)
    return [file.relative_to(images).as_posix() for file in files]


def _mask_name(photo: str) -> str:
    """Returns the path of a photo's mask, relative to the folder that is written."""
    return f"{MASKS}/{Path(photo).with_suffix('.png').as_posix()}"


def _is_ours(file: Path) -> bool:
    """Returns whether an existing file is one that `write_found` may replace: keypoints in our
    format, or an image with our mark. capture.json always counts as ours, since it belongs to the
    capture whose photos get the masks.
    """
    if file.name == KEYPOINTS_FILE:
        with contextlib.suppress(OSError, ValueError):
            read_people(file)
            return True
        return False
    return file.name == "capture.json" or mark_of(file) is not None


def write_found(
    folder: Path,
    photos: Sequence[PhotoPeople],
    person: int,
    *,
    masks: bool = True,
    to_capture: bool = False,
    overwrite: bool = False,
) -> None:
    """Writes keypoints and masks of a person, and the sheet, into a folder. If one of the files
    cannot be made, no file is written.

    Arguments:
        masks: whether to write masks.
        to_capture: whether the folder is the capture that has the photos. Then capture.json is
            changed to name the masks, and unknown/ gets the places where others may hide the
            person.
        overwrite: whether files that were not written by this function may be replaced, too.
    Raises: ValueError if the names of two photos differ in the suffix only. Without `overwrite`
    also if a file that we did not write is in the way, see `check_found_place`. OSError if a file
    cannot be written. With `to_capture` also FileError if the capture cannot be read.
    """
    # photos that differ in their suffix only would share a mask
    files = [_mask_name(photo.name) for photo in photos]
    owners: dict[str, str] = {}
    for photo, file in zip(photos, files, strict=True):
        other = owners.setdefault(file, photo.name)
        if other != photo.name:
            raise ValueError(f"{other} and {photo.name}: both masks would be {file}: rename one")

    def write(temporary: Path) -> None:
        shown = [(photo, photo.people[person]) for photo in photos]
        images = [
            ImagePeople(photo.name, photo.size, (None if each is None else each.person,))
            for photo, each in shown
        ]
        # the chosen person alone: `humangs fit` need not choose again
        write_people(temporary / KEYPOINTS_FILE, images)
        _write_sheet(temporary / SHEET_FILE, photos, person)
        with_mask = ()
        if masks:
            with_mask = zip(photos, files, strict=True)
        for photo, file in with_mask:
            (temporary / file).parent.mkdir(parents=True, exist_ok=True)
            write_png(temporary / file, person_mask(photo, person), mark=MASK)
        # a capture has to name its masks
        if to_capture:
            description = read_description(folder / "capture.json")
            views = []
            for photo, file, view in zip(photos, files, description["views"], strict=True):
                named = {"mask": file} if masks else {}
                given = None
                if not masks and "mask" in view:
                    given = read_grey(folder / view["mask"])
                hidden = hidden_by_others(photo, person, given)
                if "unknown" in view:  # what was known before anybody was found stays
                    known = read_mask(folder / view["unknown"], "its photo", *photo.size)
                    known = known >= LEAST_UNKNOWN
                    if hidden is not None and (hidden & ~known).any():
                        hidden = hidden | known
                    else:
                        hidden = None
                if hidden is not None:
                    named["unknown"] = f"unknown/{Path(file).relative_to(MASKS).as_posix()}"
                    (temporary / named["unknown"]).parent.mkdir(parents=True, exist_ok=True)
                    write_png(temporary / named["unknown"], hidden.astype(np.float32), mark=MASK)
                views.append(view | named)
            if views != description["views"]:
                write_json(temporary / "capture.json", description | {"views": views})

    if not overwrite:
        check_found_place(folder, [photo.name for photo in photos], masks=masks)
    add_files(folder, write, ours=None if overwrite else _is_ours)


def person_mask(photo: PhotoPeople, person: int) -> Float[np.ndarray, "h w"]:
    """Returns the mask of a person at the size of the photo, (h, w), 0 to 1. It is 0 everywhere if
    the person is not in the photo.
    """
    mask = np.zeros(photo.size[::-1], np.float32)
    found = photo.people[person]
    if found is not None:
        (top, left), (height, width) = found.corner, found.mask.shape
        mask[top : top + height, left : left + width] = found.mask / np.float32(255)
    return mask


def hidden_by_others(
    photo: PhotoPeople, person: int, mask: Float[np.ndarray, "h w"] | None = None
) -> Bool[np.ndarray, "h w"] | None:
    """Returns the pixels where other people in a photo may stand in front of the person, (h, w).
    Returns None if there are no such pixels.

    Arguments: mask: mask of the person that replaces the detected one, (h, w), 0 to 1.
    """
    own = photo.people[person]
    hidden = np.zeros(photo.size[::-1], bool)
    for i, other in enumerate(photo.people):
        if i == person or other is None:
            continue
        # whoever was found only once the person was painted over stands behind
        if own is not None and other.covered and not own.covered:
            continue
        hidden |= person_mask(photo, i) > SEEN
    if mask is None:
        mask = person_mask(photo, person)
    hidden &= mask <= SEEN
    return hidden if hidden.any() else None


def _write_sheet(path: Path, photos: Sequence[PhotoPeople], person: int | None = None) -> None:
    """Draws the photos side by side, with everybody in a color and with a number. person: number of
    the chosen person, who is drawn stronger; None: nobody is chosen.
    """
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
    # color everybody's pixels; those who were not chosen are fainter
    for i, found in enumerate(photo.people):
        if found is None:
            continue
        color = np.asarray(_SHEET.colors[i % len(_SHEET.colors)]) / 255
        opacity = _SHEET.faint if chosen in (None, i) else _SHEET.faint / 2
        mask = opacity * resized(person_mask(photo, i), width, height)[..., None]
        picture = picture * (1 - mask) + color * mask
        # the number stands above the nose, inside the picture
        x, y = found.person.points[0, :2] * width / photo.size[0]
        heads.append((float(np.clip(x, 8, width - 24)), float(np.clip(y - 30, 2, height - 26)), i))
    canvas = Image.fromarray(to_uint8(picture))
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(22)
    # a question mark: the same number in another photo may be somebody else
    for x, y, i in heads:
        number = str(i) if photo.known else f"{i}?"
        pen.text(
            (x, y),
            number,
            fill="white",
            stroke_width=3,
            stroke_fill=_SHEET.colors[i % len(_SHEET.colors)],
            font=font,
        )
    return np.asarray(canvas) / 255
