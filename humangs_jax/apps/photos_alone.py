"""Makes a capture without a body from photos without a calibration: finds the people in the photos,
and from the chosen person the cameras.

`capture.fitting.person_cameras` finds the cameras, and `apps.detect` finds the people. Large
photos may be reduced first, because later steps look at no more than some hundred pixels of a
person.
"""

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from humangs_jax.apps import detect
from humangs_jax.apps.same_people import PhotoPeople, exchanged, same_people
from humangs_jax.apps.start import photo_files
from humangs_jax.capture.calibration.importing import ImportReport, import_calibration
from humangs_jax.capture.calibration.others import others_as_shown
from humangs_jax.capture.calibration.photos import upright_mask
from humangs_jax.capture.calibration.videos import named_after
from humangs_jax.capture.fitting.person_cameras import PersonCameras, cameras_from_person
from humangs_jax.capture.fitting.person_moments import PersonViews
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33
from humangs_jax.capture.keypoints.reading import read_keypoints
from humangs_jax.data.body_and_masks import MASK_THRESHOLD
from humangs_jax.data.cameras import CalibratedCamera, Calibration
from humangs_jax.data.capture_checks import few
from humangs_jax.data.photos import on_white_background, read_description
from humangs_jax.io.images import (
    DIAGONAL_35MM,
    cropped_from,
    focal_length,
    image_size,
    resized,
    write_png,
)

LONGEST = 2048
"""Photos whose longer side exceeds this are reduced to it, pixels."""


@dataclasses.dataclass(frozen=True)
class PhotosImported:
    """What `import_photos` has written and found."""

    lines: tuple[str, ...]
    """What was written and found, one line each."""
    warnings: tuple[str, ...]
    """What a user should know, one line each."""
    people: list[PhotoPeople]
    """The people in each photo, in pixels of the photos that were looked at, which may be
    reduced.
    """
    person: int
    """Number of the chosen person among the people."""
    one_moment: bool
    """Whether there are several photos and all share one pose, so that cameras can be refined."""


def import_photos(
    folder: Path,
    out: Path,
    *,
    person: int | None = None,
    height: float | None = None,
    keypoints: Path | None = None,
    masks: Path | None = None,
    others: Path | None = None,
    own_masks: bool = True,
    reduce: bool = False,
    also: Mapping[str, object] | None = None,
) -> PhotosImported:
    """Writes the capture folder `out`, with keypoints.json and people.png, from photos alone. An
    existing capture folder is replaced.

    Arguments:
        person: number of the person on people.png, needed if photos show several large people. With
            `keypoints`, it is the number in their file.
        height: height of the person, metres. None: the height of an average person.
        keypoints: keypoints of another program. They choose the person in each photo.
        masks: folder of masks of another program. They choose the person if neither keypoints nor a
            number is given.
        others: folder of masks of other people and of things in front of the person. Only some
            photos need to have one.
        own_masks: whether to write the masks of our detector.
        reduce: whether photos may be reduced to `LONGEST` pixels. It has no effect with `masks` or
            `others`, or if the person is small in a photo.
        also: names and contents of JSON files that are written with the capture.
    Raises: ValueError (one line) if no camera is found, or if photos show several large people and
    none is chosen. Also as `import_cameras`.
    """
    images, files = photo_files(folder)
    choice = _Choice(person, keypoints, masks, out, others)
    with tempfile.TemporaryDirectory() as place:
        smaller = None
        if reduce and masks is None and others is None:
            smaller = _reduced(images, files, Path(place))
        if smaller:
            found = _look(Path(place), files, smaller, choice)
            # where the person has fewer pixels photos stay as they are
            if np.ptp(found.seen.points, axis=1).max(axis=-1).min() >= 700:
                with named_after(Path(place), images):
                    return _written(found, Path(place), out, height, None, own_masks, also)
    return _written(
        _look(images, files, files, choice), images, out, height, choice, own_masks, also
    )


def _reduced(images: Path, files: list[Path], place: Path) -> list[Path]:
    """Writes the photos into a folder, upright and with a longer side of at most `LONGEST` pixels,
    and returns the files. If no photo is larger, or if the names of two photos differ in the suffix
    only, it writes nothing and returns an empty list.
    """
    names = {file.relative_to(images).with_suffix(".png") for file in files}
    if max(max(image_size(file)) for file in files) <= LONGEST or len(names) < len(files):
        return []
    found = [place / file.relative_to(images).with_suffix(".png") for file in files]
    for file, smaller in zip(files, found, strict=True):
        photo = detect.upright(file)
        height, width = photo.shape[:2]
        factor = min(1.0, LONGEST / max(height, width))
        smaller.parent.mkdir(parents=True, exist_ok=True)
        write_png(
            smaller, resized(photo, round(factor * width), round(factor * height)), compress_level=1
        )
    return found


class _Looked(NamedTuple):
    """The people in the photos, and what is seen of the chosen person."""

    photos: list[PhotoPeople]
    """All photos, with their people."""
    number: int
    """Number of the chosen person."""
    shown: list[int]
    """Indices of the photos that show the person."""
    seen: PersonViews
    """Landmarks of the person in the photos of `shown`."""
    cropped: tuple[str, ...]
    """One line about photos that were cropped; empty if none was."""


class _Choice(NamedTuple):
    """The arguments that choose the person, see `import_photos`, and the place of the capture."""

    person: int | None
    """Number on people.png, or in the keypoint file if there is one."""
    keypoints: Path | None
    """Keypoint file of another program."""
    masks: Path | None
    """Folder of masks of another program."""
    out: Path
    """The capture folder."""
    others: Path | None = None
    """Folder of masks of what is in front of the person."""


def _look(images: Path, files: list[Path], looked_at: list[Path], choice: _Choice) -> _Looked:
    """Finds the people in the photos, chooses the person, and returns what is seen of the person.

    Arguments: images: folder of `looked_at`. files: the photos. looked_at: the pictures in which
    people are looked for, one per photo: the photos themselves, or reduced copies.
    Raises: see `_chosen`.
    """
    photos = _people_in(images, files, looked_at, choice)
    photos, number = _chosen(photos, images, files, choice)
    # cameras are found from photos with the person only
    shown = [i for i, photo in enumerate(photos) if photo.people[number] is not None]
    files_shown = [files[i] for i in shown]
    seen = _views_of_person([photos[i] for i in shown], files_shown, number)
    return _Looked(photos, number, shown, seen, _cropped(files_shown))


def _people_in(
    images: Path, files: list[Path], looked_at: list[Path], choice: _Choice
) -> list[PhotoPeople]:
    """Returns the photos with the people who are found in them. A person has the same number in all
    photos. Arguments: see `_look`.
    """
    names = [file.relative_to(images).as_posix() for file in looked_at]
    # what is in front of the person is painted over, so that the detector does not see it
    others = others_as_shown(choice.others, images, files)
    pictures = detect.without_others(map(detect.upright, looked_at), others)
    photos = detect.detect_photos(names, pictures)
    # where nobody found fits a given mask, the detector looks at the photo cut to it
    if choice.masks is not None:
        masks = [upright_mask(choice.masks, images, file) for file in files]
        cut = [
            on_white_background(detect.upright(file), mask)
            for file, mask in zip(looked_at, masks, strict=True)
        ]
        photos = detect.with_masked(photos, masks, cut)
    photos = detect.without_hidden_landmarks(photos, others)
    return same_people(photos)


def _views_of_person(photos: list[PhotoPeople], files: list[Path], number: int) -> PersonViews:
    """Returns the landmarks of a person in photos that all show the person.

    Arguments: files: file of each photo, whose EXIF may give the focal length. number: number of
    the person.
    """
    detections = [photo.people[number] for photo in photos]
    found = [each.person for each in detections if each is not None]
    focal = [_focal_at_size(file, photo.size) for file, photo in zip(files, photos, strict=True)]
    return PersonViews(
        points=np.stack([person.points[:, :2] for person in found]),
        visibility=np.stack([person.points[:, 2] for person in found]),
        world=np.stack([person.world for person in found]),
        names=MEDIAPIPE_33.names,
        sizes=tuple(photo.size for photo in photos),
        focal=np.asarray(focal),
        photos=tuple(photo.name for photo in photos),
    )


def _focal_at_size(file: Path, size: tuple[int, int]) -> float:
    """Returns the focal length of a photo, in pixels of a copy of the photo. NaN if it is unknown.
    size: width and height of the copy.
    """
    focal = focal_length(file)
    if focal is None:
        return np.nan
    return focal * np.hypot(*size) / np.hypot(*image_size(file))


def _cropped(files: list[Path]) -> tuple[str, ...]:
    """Returns one line, in a tuple, that names the photos whose EXIF describes a frame of another
    shape. Such photos were cropped. The tuple is empty if there are no such photos.
    """
    frames = [(file, cropped_from(file)) for file in files]
    found = [(file, frame) for file, frame in frames if frame is not None]
    if not found:
        return ()
    named = [f"{file.name} ({_by(image_size(file))}, EXIF {_by(frame)})" for file, frame in found]
    return (
        (
            f"cropped, as their shape is not that of their EXIF: {few(named)}: their focal length"
            " is taken for unknown"
        ),
    )


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _chosen(
    photos: list[PhotoPeople], images: Path, files: list[Path], choice: _Choice
) -> tuple[list[PhotoPeople], int]:
    """Chooses the person. Returns the photos, in which the person has the same number, and the
    number.

    Raises: see `detect.choose`, `detect.person_of`, `read_keypoints`.
    """
    # beside the capture folder, which a refusal leaves as it is
    sheet = choice.out.with_name(f"{choice.out.resolve().name}_{detect.SHEET_FILE}")
    if choice.keypoints is not None:
        width, height = np.max(
            [photo.size for photo in photos], axis=0
        ).tolist()  # photos are padded to these
        views = [Path(photo.name).with_suffix("").as_posix().replace("/", "_") for photo in photos]
        keypoints = read_keypoints(choice.keypoints, views, width, height, person=choice.person)
        return detect.person_of(photos, keypoints, sheet)
    if choice.masks is not None and choice.person is None and photos[0].people:
        masks = [upright_mask(choice.masks, images, file) > MASK_THRESHOLD for file in files]
        return detect.person_of(photos, masks, sheet)
    return photos, detect.choose(photos, choice.person, sheet)


def _written(
    looked: _Looked,
    images: Path,
    out: Path,
    height: float | None,
    choice: _Choice | None,
    own_masks: bool,
    also: Mapping[str, object] | None,
) -> PhotosImported:
    """Finds the cameras from the person, and writes the capture.

    Arguments: images: folder of the photos. choice: has the folders of the masks to import. None:
    no masks are imported.
    """
    photos, number, shown, seen, cropped = looked
    found = cameras_from_person(seen, height=height)
    if choice is None:
        masks, others = None, None
    else:
        masks, others = choice.masks, choice.others
    calibration = _calibration(seen, found, images)
    report = import_calibration(
        calibration, images, out, masks=masks, others=others, scale=1.0, also=also
    )
    views = read_description(out / "capture.json")["views"]
    written = []
    for view, mirrored, described in zip(found.views, found.mirrored, views, strict=True):
        photo, people = photos[shown[view]], list(photos[shown[view]].people)
        person = people[number]
        if mirrored and person is not None:
            people[number] = exchanged(person)
        name, size = f"{Path(described['image']).stem}.png", (report.width, report.height)  # padded
        written.append(dataclasses.replace(photo, people=tuple(people), name=name, size=size))
    detect.write_found(out, written, number, masks=own_masks, to_capture=True)
    warnings = (*cropped, *found.warnings, *report.warnings)
    return PhotosImported(
        _lines(seen, found, report), warnings, photos, number, found.moments == 1 < len(written)
    )


def _calibration(seen: PersonViews, found: PersonCameras, images: Path) -> Calibration:
    if found.moments > 1:
        frames = range(len(found.views))
    else:
        frames = [0] * len(found.views)
    cameras = [
        CalibratedCamera(
            seen.photos[view],
            np.asarray(camera.K, np.float64),
            np.asarray(camera.cam_from_world, np.float64),
            *seen.sizes[view],
            frame=frame,
        )
        for view, camera, frame in zip(found.views, found.cameras, frames, strict=True)
    ]
    return Calibration(
        format="cameras from the person",
        file=images,
        cameras=tuple(cameras),
        per_image=True,
        pixel_centers="half",
        up="+y",
        stations=None if found.moments == 1 else 1,
        upright=True,
        estimated=True,
    )


def _lines(seen: PersonViews, found: PersonCameras, report: ImportReport) -> tuple[str, ...]:
    matrices = [np.asarray(camera.cam_from_world, float) for camera in found.cameras]
    centers = np.linalg.inv(matrices)[:, :3, 3]
    distance = float(np.median(np.hypot(centers[:, 0], centers[:, 2])))
    count = len(found.views)
    # how many poses the photos show tells how much they determine
    if count == 1:
        which = "one photo: what it does not show is a guess"
    elif found.moments == 1:
        which = f"{count} photos of one moment: one pose"
    else:
        which = (
            f"{count} photos of several moments: the person has another pose in each, and one shape"
        )
    # focal lengths over the diagonal, since photos may differ in size
    focal = np.median(
        [
            np.asarray(c.K)[0, 0] / np.hypot(*seen.sizes[view])
            for view, c in zip(found.views, found.cameras, strict=True)
        ]
    )
    return (
        f"{report.out}: {which}",
        (
            f"cameras from the person: {distance:.1f} m away, {DIAGONAL_35MM * focal:.0f} mm (35-mm"
            f" equivalent); landmarks are off by {np.median(found.errors):.1f} px"
        ),
        *report.notes,
    )
