"""Chooses photos from a video: sharp frames that show the person from all sides.

`capture.calibration.frame_choice` offers frames. The person is followed through these frames, at a
longer side of 640 pixels. Once the person is found in a frame, only the landmark network looks at
the next frame. The landmarks show in which direction the person faces in each frame, and which pose
is the usual one.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.apps.start import has_photos
from humangs_jax.capture.calibration.frame_choice import (
    FRAMES,
    LONGER_SIDE,
    PHOTOS,
    USUAL,
    WORTHLESS,
    choose_by_direction,
    choose_frames,
    directions_of,
    looked_at,
    offered_frames,
    unusual,
)
from humangs_jax.capture.calibration.videos import (
    color_frames,
    find_videos,
    frame_rate,
    grey_frames,
    write_frames,
)
from humangs_jax.capture.detection.people import (
    BELIEVED,
    Landmarks,
    Networks,
    available,
    find_people,
)
from humangs_jax.capture.keypoints.keypoints import MEDIAPIPE_33
from humangs_jax.core.array_types import Float, UInt
from humangs_jax.core.progress import bar
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.folders import is_video
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.reading import read_json, reading, write_json

MARK = "video.json"
"""File in the folder of photos that records the video and the frames that were chosen from it."""
PATIENCE = 8
"""Number of frames in a row without anybody after which the search ends. Searching a whole frame
takes ten times as long as following somebody.
"""


def video_of(place: Path) -> Path | None:
    """Returns the video at a path: the path itself, or the video of a folder without photos. None
    if there is none.

    Raises: CaptureError if the folder has several videos.
    """
    if not place.is_dir():
        if place.is_file() and is_video(place):
            return place
        return None
    if has_photos(place):
        return None
    videos = find_videos(place)
    if not videos:
        return None
    if len(videos) > 1:
        problem = (
            "expected photos or one video (videos of several cameras: `humangs import cameras`)"
        )
        raise CaptureError(place, "", f"{len(videos)} videos and no photo: {problem}")
    return next(iter(videos.values()))


def photos_of_video(video: Path, folder: Path) -> str:
    """Writes the chosen frames into `folder / "images"`, and returns a line that describes them. If
    an earlier run has made the folder from this video, the folder stays as it is.

    Raises: CaptureError if the video cannot be read or shows nothing; the message names the video.
    CaptureError if the folder exists and was not made from the video as it is now; the message
    names the folder. CaptureError, too, if the frames cannot be written. FileError if the folder's
    `MARK` cannot be read. OSError if the folder above cannot be made, or `MARK` cannot be written.
    """
    with reading(video, "video", CaptureError):
        status = video.stat()
    of_video = {"video": video.name, "bytes": status.st_size, "modified": status.st_mtime_ns}
    # frames of the same video are kept; anything else in the folder is left alone
    if folder.exists() or folder.is_symlink():
        known = None
        if (folder / MARK).is_file():
            known = read_json(folder / MARK)
        if not isinstance(known, dict) or {key: known.get(key) for key in of_video} != of_video:
            problem = (
                f"exists, and is not of {video.name} as it is now: expected another folder, or"
                " remove it"
            )
            raise CaptureError(folder, "", problem)
        return _told(video, folder, known["chosen"], known["frames"], known.get("by_direction"))
    # without the detector, or if the person does not turn, frames that look different are taken
    sharpness, thumbnails = looked_at(grey_frames(video, LONGER_SIDE))
    with reading(video, "video", CaptureError):
        chosen = []
        if available():
            chosen = _by_direction(video, sharpness)
        by_direction = bool(chosen)
        chosen = chosen or choose_frames(sharpness, thumbnails, PHOTOS)
    count = len(sharpness)
    about = {"frames": count, "chosen": chosen, "by_direction": by_direction}

    def write(place: Path) -> None:
        write_frames(video, place / "images", chosen)
        write_json(place / MARK, {**of_video, **about, "rate": frame_rate(video)})

    replace_folder(folder, write, mark=MARK)
    return _told(video, folder, chosen, count, by_direction)


def _told(
    video: Path, folder: Path, chosen: Sequence[int], count: int, by_direction: bool | None
) -> str:
    which = "that show different things"
    if by_direction:
        which = "from all sides of the person"
    return (
        f"{video}: {len(chosen)} of {count:,} frames, sharp ones {which}"
        f" ({', '.join(map(str, chosen))}), are the photos in {folder / 'images'}; what is to be"
        f" added goes into {folder}"
    )


def seconds_of_photos(folder: Path, names: Sequence[str]) -> Float[np.ndarray, " v"] | None:
    """Returns the times at which photos were taken in a video, (v,), seconds. They follow from the
    names of the photos.

    Returns None if the photos in the folder were not taken from a video by `photos_of_video`, if
    the video does not have a rate, or if the names do not end in ascending numbers.

    Raises: FileError if the folder's `MARK` is no JSON.
    """
    known = None
    if (folder / MARK).is_file():
        known = read_json(folder / MARK)
    rate = None
    if isinstance(known, dict):
        rate = known.get("rate")
    numbers = [name.rpartition("_")[2] for name in names]
    if not isinstance(rate, int | float) or not rate > 0 or not all(n.isdigit() for n in numbers):
        return None
    seconds = np.asarray([int(number) / rate for number in numbers])
    if np.all(np.diff(seconds) > 0):
        return seconds
    return None


def _by_direction(video: Path, sharpness: Float[np.ndarray, " n"]) -> list[int]:
    """Chooses sharp frames that see the person from different directions, and returns their
    numbers. Returns an empty list if the person does not turn, or is found in less than half of the
    offered frames, or if `followed` ends early.
    """
    offered, worth = offered_frames(sharpness)
    # the person is followed in frames of 640 pixels: twice what the landmark network looks at
    people = list(followed(color_frames(video, 640, offered.tolist()), len(offered)))
    found = np.asarray([person is not None for person in people])
    # directions choose if the person is found in half of the offered frames
    if len(people) != len(offered) or found.mean() < 0.5:
        return []
    seen = [person for person in people if person is not None]
    world = np.stack([person.world for person in seen])
    directions = directions_of(world, MEDIAPIPE_33.names)
    odd = unusual(world, directions, np.stack([person.visibility for person in seen]))
    worth = worth[found] * np.maximum(1 / (1 + (odd / USUAL) ** 2), WORTHLESS)
    chosen = choose_by_direction(directions, worth, FRAMES)
    return offered[found][chosen].tolist()


def followed(frames: Iterable[UInt[np.ndarray, "h w 3"]], count: int) -> Iterable[Landmarks | None]:
    """Follows the largest person of the first frame that shows somebody. Yields the person's
    landmarks in each frame, or None where nobody is found. If the person is lost, the largest
    person who is found next is followed. The generator ends early if nobody is found in `PATIENCE`
    frames in a row.

    Raises: ImportError if LiteRT is not installed.
    """
    networks, last, missed = Networks(), None, 0
    for frame in bar(frames, total=count, desc="following the person", unit="frame"):
        photo = frame.astype(np.float32) / 255
        found = None
        if last is not None:
            found = networks.landmarks(photo, last.again.crop())
        if found is None or found.presence < BELIEVED.presence:
            found = next(iter(find_people(networks, photo)), None)
        last = found
        missed = missed + 1 if found is None else 0
        if missed == PATIENCE:
            return
        yield found
