"""Photos of one video for `humangs start`: its best frames, in a folder to which masks, keypoints and cameras may be added."""

import dataclasses
from pathlib import Path

from humangs_jax.apps.start import find_photos
from humangs_jax.data.calibration.videos import (
    LONGER_SIDE,
    PHOTOS,
    choose_frames,
    find_videos,
    grey_frames,
    looked_at,
    write_frames,
)
from humangs_jax.data.calibration.videos import SUFFIXES as VIDEOS
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.io.atomic import replace_folder
from humangs_jax.io.reading import read_json, reading, write_json

MARK = "video.json"
"""In the folder of photos: the video that they are of."""


@dataclasses.dataclass(frozen=True)
class VideoPhotos:
    """folder: of the photos. chosen: numbers of the frames, from 0. count: of all frames of the video."""

    video: Path
    folder: Path
    chosen: tuple[int, ...]
    count: int

    def __str__(self) -> str:
        frames = ", ".join(map(str, self.chosen))
        return (
            f"{self.video}: {len(self.chosen)} of {self.count:,} frames, sharp ones that show different things ({frames}), "
            f"are the photos in {self.folder / 'images'}; what is to be added goes into {self.folder}"
        )


def video_of(place: Path) -> Path | None:
    """The video that `place` is, or that is in a folder without photos; None if there is none.

    Raises: CaptureError for several videos.
    """
    if not place.is_dir():
        return place if place.is_file() and place.suffix.lower() in VIDEOS else None
    videos = find_videos(place)
    if not videos or next(find_photos(place), None) is not None:
        return None
    if len(videos) > 1:
        problem = "expected photos or one video (videos of several cameras: `humangs import cameras`)"
        raise CaptureError(place, "", f"{len(videos)} videos and no photo: {problem}")
    return next(iter(videos.values()))


def photos_of_video(video: Path, folder: Path) -> VideoPhotos:
    """Write the chosen frames into `folder / "images"`; a folder that an earlier run wrote of this video stays as it is.

    Raises: CaptureError naming the video, or the folder if something else is there.
    """
    with reading(video, "video", CaptureError):
        status = video.stat()
    of_video = {"video": video.name, "bytes": status.st_size, "modified": status.st_mtime_ns}
    if folder.exists() or folder.is_symlink():
        known = read_json(folder / MARK) if (folder / MARK).is_file() else None
        if not isinstance(known, dict) or {key: known.get(key) for key in of_video} != of_video:
            problem = f"exists, and is not of {video.name} as it is now: expected another folder, or remove it"
            raise CaptureError(folder, "", problem)
        return VideoPhotos(video, folder, tuple(known["chosen"]), known["frames"])
    sharpness, thumbnails = looked_at(grey_frames(video, LONGER_SIDE))
    with reading(video, "video", CaptureError):
        chosen = choose_frames(sharpness, thumbnails, PHOTOS)

    def write(place: Path) -> None:
        write_frames(video, place / "images", chosen)
        write_json(place / MARK, {**of_video, "frames": len(sharpness), "chosen": chosen})

    replace_folder(folder, write, mark=MARK)
    return VideoPhotos(video, folder, tuple(chosen), len(sharpness))
