"""Videos of synchronised cameras -> photos, one folder for each camera; by ffmpeg, through imageio-ffmpeg.

    CAMERA.mp4 (.mov, .mkv, .avi)    ->    CAMERA/00000000.png, 00000001.png, ... : frames 0, every, 2 every ...

All videos have to begin at the same moment and to have the same rate. Masks are videos of the same names.
"""

import contextlib
import subprocess
import tempfile
from collections.abc import Generator
from pathlib import Path

from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.io.images import image_size
from humangs_jax.io.reading import Refused, check_limit, limits, open_file, reading

SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")
CONTAINERS = "mov,matroska,avi,mpegts"
"""Formats that ffmpeg reads, whatever the name says: others are lists of files (ffconcat, playlists)."""
LONGEST_SECONDS = 3600
"""After which ffmpeg is stopped."""


def find_videos(folder: Path) -> dict[str, Path]:
    """Name of the camera -> its video, of the videos in a folder. Raises: CaptureError for two videos of one camera."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() in SUFFIXES and not path.name.startswith("."):
            if path.stem in found:
                raise CaptureError(
                    path, "", f"camera {path.stem} has {found[path.stem].name} already: expected one video"
                )
            found[path.stem] = path
    return found


@contextlib.contextmanager
def photos_of_videos(
    images: Path, masks: Path | None, place: Path, every: int = 1, most: int | None = None
) -> Generator[tuple[Path, Path | None]]:
    """Folders of photos and masks. Those of videos are written beside `place` and removed in the end; others are as given.

    Arguments: every: frame step, from frame 0. most: photos of a camera, None: all.
    Raises: CaptureError naming the video, also if every or most ask something of folders that hold none.
    """
    videos = {
        kind: find_videos(folder) for kind, folder in (("images", images), ("masks", masks)) if folder is not None
    }
    if not any(videos.values()):
        if every != 1 or most is not None:
            raise CaptureError(images, "", f"no video ({', '.join(SUFFIXES)}): frames can be chosen of videos only")
        yield images, masks
        return
    if lonely := sorted(set(videos["images"]) ^ set(videos.get("masks", videos["images"]))):
        raise CaptureError(
            masks or images, lonely[0], "expected a video of photos and one of masks, or folders of both"
        )
    beside = next(folder for folder in place.resolve().parents if folder.is_dir())
    with tempfile.TemporaryDirectory(dir=beside, prefix=f".{place.name}.video-") as temporary:
        folders: dict[str, Path | None] = {"images": images, "masks": masks}
        for kind, found in videos.items():
            folders[kind], pixels = Path(temporary) / kind, 0
            for camera, path in found.items():
                pixels = split_video(path, Path(temporary) / kind / camera, every, most, pixels)
        assert folders["images"] is not None
        yield folders["images"], folders["masks"]


def split_video(path: Path, folder: Path, every: int = 1, most: int | None = None, before: int = 0) -> int:
    """Write frames of a video as 00000000.png, ... into a new folder.

    Arguments: before: pixels of the frames of other videos, which count towards the limit `video_pixels`.
    Returns: pixels of all frames so far. The first frame is written twice: its size tells how many the others may be.
    Raises: CaptureError naming the video.
    """
    with reading(path, "video", CaptureError):
        open_file(path).close()  # no devices, no pipes, not too large
        folder.mkdir(parents=True)
        first = _run(path, folder, every, 1)
        width, height = image_size(next(folder.iterdir()))
        size, room = width * height, max(0, limits().video_pixels - before) // (width * height)
        count = first if most == 1 else _run(path, folder, every, room + 1 if most is None else min(most, room + 1))
        what = f"pixels in the frames of the videos, {count:,} or more of {width} x {height} in this one"
        check_limit("video_pixels", before + count * size, what)
        return before + count * size


def _run(path, folder, every, most):
    """Write at most that many frames; returns how many there are."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-nostdin", "-xerror"]
    # a playlist in disguise may name other files and hosts; pictures may be larger than what is read later
    command += ["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS]
    command += ["-max_pixels", str(limits().pixels), "-i", f"file:{path.resolve()}"]
    command += ["-map", "0:v:0", "-vf", f"select=not(mod(n\\,{every}))", "-fps_mode", "passthrough"]
    command += ["-frames:v", str(most), "-y", "-start_number", "0", "%08d.png"]
    try:
        # in the folder: its path may hold a % of its own
        done = subprocess.run(command, cwd=folder, capture_output=True, timeout=LONGEST_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise Refused(f"its frames take more than {LONGEST_SECONDS:,} seconds: expected a shorter video") from None
    count = sum(1 for _ in folder.iterdir())
    if done.returncode or not count:
        said = " ".join(done.stderr.decode(errors="replace").split()) or "no frame"
        raise ValueError(said.replace(f"file:{path.resolve()}", path.name))
    return count
