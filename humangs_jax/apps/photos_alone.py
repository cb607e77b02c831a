"""Photos without a calibration -> a capture without a body: the people in them are found, and from the person the cameras.

See `fitting.person_cameras`; who is who in several photos: `apps.detect`.
"""

import dataclasses
from pathlib import Path

import numpy as np

from humangs_jax.apps import detect
from humangs_jax.apps.detect import PhotoPeople
from humangs_jax.apps.start import photo_files
from humangs_jax.data.calibration.calibration import CalibratedCamera, Calibration
from humangs_jax.data.calibration.importing import import_calibration
from humangs_jax.data.keypoints.sets import MEDIAPIPE_33
from humangs_jax.data.photos import read_description
from humangs_jax.fitting.person_cameras import PersonCameras, PersonViews, cameras_from_person
from humangs_jax.io.images import DIAGONAL_35MM, focal_length


@dataclasses.dataclass(frozen=True)
class PhotosImported:
    """What `import_photos` did, a line each; warnings: what a user should know. people, person: who was found in the photos, and
    the number of the one who is meant. one_moment: whether several photos share one pose, so that cameras can be refined.
    """

    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    people: list[PhotoPeople]
    person: int
    one_moment: bool


def import_photos(
    folder: Path,
    out: Path,
    *,
    person: int | None = None,
    height: float | None = None,
    masks: Path | None = None,
    own_masks: bool = True,
) -> PhotosImported:
    """Write the capture folder `out`, with keypoints.json and people.png, from photos alone; what is there is replaced.

    Arguments: person: number on people.png, where several may be meant. height: of the person, metres. masks: folder of masks of
    another program. own_masks: whether the detector's masks are written.
    Raises: ValueError (one line) if no camera is found or several people may be meant; as `import_cameras`.
    """
    images, files = photo_files(folder)
    names = [file.relative_to(images).as_posix() for file in files]
    photos = detect.same_people(detect.detect_photos(names, map(detect.upright, files)))
    # beside `out`, which a refusal leaves as it is
    number = detect.chosen(photos, person, out, out.with_name(f"{out.resolve().name}_{detect.SHEET_FILE}"))
    shown = [i for i, photo in enumerate(photos) if photo.people[number] is not None]
    people = [found for i in shown if (found := photos[i].people[number]) is not None]
    focal = [focal_length(files[i]) for i in shown]
    seen = PersonViews(
        points=np.stack([found.person.points[:, :2] for found in people]),
        visibility=np.stack([found.person.points[:, 2] for found in people]),
        world=np.stack([found.person.world for found in people]),
        names=MEDIAPIPE_33.names,
        sizes=tuple(photos[i].size for i in shown),
        focal=np.asarray([np.nan if each is None else each for each in focal]),
        photos=tuple(names[i] for i in shown),
    )
    found = cameras_from_person(seen, height=height)
    calibration = _calibration(seen, found, images)
    report = import_calibration(calibration, images, out, masks=masks)
    used = [
        _repaired(photos[shown[view]], number, bool(mirrored))
        for view, mirrored in zip(found.views, found.mirrored, strict=True)
    ]
    views = read_description(out / "capture.json")["views"]
    size = (report.width, report.height)
    padded = [
        dataclasses.replace(photo, name=f"{Path(view['image']).stem}.png", size=size)
        for photo, view in zip(used, views, strict=True)
    ]
    detect.add_to_capture(out, padded, number, masks=own_masks)
    warnings = (*found.warnings, *report.checks.warnings)
    return PhotosImported(_lines(seen, found, report), warnings, photos, number, found.moments == 1 < len(used))


def _calibration(seen: PersonViews, found: PersonCameras, images: Path) -> Calibration:
    frames = range(len(found.views)) if found.moments > 1 else [0] * len(found.views)
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
    )


def _repaired(photo: PhotoPeople, number: int, mirrored: bool) -> PhotoPeople:
    """The photo, with left and right of the person changed back."""
    people = list(photo.people)
    if mirrored and (found := people[number]) is not None:
        people[number] = detect.exchanged(found)
    return dataclasses.replace(photo, people=tuple(people))


def _lines(seen, found, report):
    """What was found, for the user."""
    centers = np.asarray([camera.center for camera in found.cameras], float)
    distance = float(np.median(np.hypot(centers[:, 0], centers[:, 2])))
    count = len(found.views)
    if count == 1:
        which = "one photo: what it does not show is a guess"
    elif found.moments == 1:
        which = f"{count} photos of one moment: one pose"
    else:
        which = f"{count} photos of several moments: the person has a pose of its own in each, and one shape"
    diagonals = [np.hypot(*seen.sizes[view]) for view in found.views]
    focal = np.median([float(camera.K[0, 0]) for camera in found.cameras] / np.asarray(diagonals))
    return (
        f"{report.out}: {which}",
        f"cameras from the person: {distance:.1f} m away, {DIAGONAL_35MM * focal:.0f} mm (35-mm equivalent); "
        f"landmarks are off by {np.median(found.errors):.1f} px",
        *report.notes,
    )
