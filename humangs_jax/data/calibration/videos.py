"""Videos -> photos: of synchronised cameras, a folder for each; of one camera, its best frames. By ffmpeg (imageio-ffmpeg).

    CAMERA.mp4 (.mov, .mkv, .avi)    ->    CAMERA/00000000.png, 00000001.png, ... : frames 0, every, 2 every ...

All videos of several cameras have to begin at the same moment and to have the same rate. Masks are videos of the same names.

Of one video, of a phone that goes around a person or of a person who turns, frames are taken that are sharp and differ: each of
equal windows of time offers its sharpest one, and that is taken which differs most from all that were taken, until none does.
"""

import contextlib
import subprocess
import tempfile
import threading
from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float, UInt
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.io.images import image_in
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
                raise CaptureError(path, "", f"camera {path.stem} has {found[path.stem].name} already: expected one video")
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
    videos = {kind: find_videos(folder) for kind, folder in (("images", images), ("masks", masks)) if folder is not None}
    if not any(videos.values()):
        if every != 1 or most is not None:
            raise CaptureError(images, "", f"no video ({', '.join(SUFFIXES)}): frames can be chosen of videos only")
        yield images, masks
        return
    if lonely := sorted(set(videos["images"]) ^ set(videos.get("masks", videos["images"]))):
        raise CaptureError(masks or images, lonely[0], "expected a video of photos and one of masks, or folders of both")
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
    Returns: pixels of all frames so far.
    Raises: CaptureError naming the video.
    """
    with reading(path, "video", CaptureError):
        width, height = _frame_size(path)
        folder.mkdir(parents=True)
        room = max(0, limits().video_pixels - before) // (width * height)
        count = _run(path, folder, f"not(mod(n\\,{every}))", room + 1 if most is None else min(most, room + 1))
        pixels = before + count * width * height
        _check_pixels(pixels, count, width, height)
        return pixels


def _frame_size(path: Path) -> tuple[int, int]:
    open_file(path).close()  # no devices, no pipes, not too large
    first = _finished(path, [*_ffmpeg(path, "null"), "-frames:v", "1", "-f", "image2pipe", "-c:v", "png", "pipe:1"])
    if not first:
        raise _said(path, b"")
    with image_in(first) as image:
        return image.size


def _check_pixels(pixels: int, count: int, width: int, height: int) -> None:
    what = f"pixels in the frames of the videos, {count:,} or more of {width} x {height} in this one"
    check_limit("video_pixels", pixels, what)


def write_frames(path: Path, folder: Path, chosen: Sequence[int]) -> None:
    """Write these frames of a video, counted from 0 and in order, as frame_00000017.png, ... into a new folder.

    Raises: CaptureError naming the video.
    """
    with reading(path, "video", CaptureError):
        folder.mkdir(parents=True)
        if _run(path, folder, "+".join(f"eq(n\\,{i})" for i in chosen), len(chosen)) != len(chosen):
            raise Refused("its frames are not the same when they are read again")
        for i, frame in enumerate(chosen):
            (folder / f"{i:08d}.png").rename(folder / f"frame_{frame:08d}.png")


def grey_frames(path: Path, longer_side: int) -> Iterator[UInt[np.ndarray, "h w"]]:
    """All frames of a video, one after the other, grey and no larger than that. Raises: CaptureError naming the video."""
    with reading(path, "video", CaptureError):
        width, height = _frame_size(path)
        room, scale = limits().video_pixels // (width * height), min(1.0, longer_side / max(width, height))
        w, h = (max(1, round(side * scale)) for side in (width, height))
        command = [*_ffmpeg(path, f"scale={w}:{h}:flags=area"), "-frames:v", str(room + 1)]
        command += ["-f", "rawvideo", "-pix_fmt", "gray", "pipe:1"]
        with tempfile.TemporaryFile() as said, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said) as process:
            assert process.stdout is not None
            clock, count = threading.Timer(LONGEST_SECONDS, process.kill), 0
            clock.start()
            try:
                while len(data := process.stdout.read(w * h)) == w * h:
                    count += 1
                    _check_pixels(count * width * height, count, width, height)
                    yield np.frombuffer(data, np.uint8).reshape(h, w)
                if process.wait():
                    said.seek(0)
                    raise _said(path, said.read())
            finally:
                clock.cancel()
                process.kill()


def _ffmpeg(path: Path, filters: str) -> list[str]:
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-nostdin", "-xerror"]
    # a playlist in disguise may name other files and hosts; pictures may be larger than what is read later
    command += ["-protocol_whitelist", "file", "-format_whitelist", CONTAINERS]
    command += ["-max_pixels", str(limits().pixels), "-i", f"file:{path.resolve()}"]
    return [*command, "-map", "0:v:0", "-vf", filters, "-fps_mode", "passthrough"]


def _run(path: Path, folder: Path, select: str, most: int) -> int:
    """Write at most that many frames for which ffmpeg's expression is not 0; returns how many there are."""
    command = [*_ffmpeg(path, f"select={select}"), "-frames:v", str(most), "-y", "-start_number", "0", "%08d.png"]
    _finished(path, command, folder)  # in the folder: its path may hold a % of its own
    if not (count := sum(1 for _ in folder.iterdir())):
        raise _said(path, b"")
    return count


def _finished(path: Path, command: Sequence[str], folder: Path | None = None) -> bytes:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, timeout=LONGEST_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise Refused(f"its frames take more than {LONGEST_SECONDS:,} seconds: expected a shorter video") from None
    if done.returncode:
        raise _said(path, done.stderr)
    return done.stdout


def _said(path: Path, text: bytes) -> ValueError:
    said = " ".join(text.decode(errors="replace").split()) or "no frame"
    return ValueError(said.replace(f"file:{path.resolve()}", path.name))


# Which frames become photos -------------------------------------------------------------------------------------------

PHOTOS = 8
"""A person from all sides."""
WINDOWS = 64
LONGER_SIDE = 480
"""Pixels of the frames that are looked at: blur that does not show there does not hurt."""
CELLS = 24
"""Rows and columns of the thumbnails that are compared."""
NOTHING_SHOWN = 3.0
"""Levels of 255: the standard deviation of a frame that is all of one color, but for noise."""
NOTHING_NEW = 0.05
"""Root mean square of the difference of two thumbnails, in standard deviations of one."""


def looked_at(frames: Iterable[UInt[np.ndarray, "h w"]]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n p"]]:
    """Sharpness and thumbnail of each grey frame; the thumbnails have mean 0 and variance 1, or are 0 where nothing is shown.

    Sharpness is the mean square of the Laplacian over the variance of the frame: exposure does not change it.
    """
    sharpness, thumbnails = [], []
    for frame in frames:
        x = frame.astype(np.float32)
        rows, columns = (np.linspace(0, side, CELLS + 1).astype(int)[:-1] for side in x.shape)
        cells = np.add.reduceat(np.add.reduceat(x, rows, axis=0), columns, axis=1)
        cells /= np.add.reduceat(np.add.reduceat(np.ones_like(x), rows, axis=0), columns, axis=1)
        spread = float(x.std())
        if spread < NOTHING_SHOWN or min(x.shape) < 3:
            sharpness.append(0.0)
            thumbnails.append(np.zeros(CELLS * CELLS, np.float32))
            continue
        edges = 4 * x[1:-1, 1:-1] - x[:-2, 1:-1] - x[2:, 1:-1] - x[1:-1, :-2] - x[1:-1, 2:]
        sharpness.append(float((edges**2).mean()) / spread**2)
        thumbnails.append(((cells - cells.mean()) / max(float(cells.std()), NOTHING_SHOWN)).ravel())
    shape = len(sharpness), CELLS * CELLS
    return np.asarray(sharpness, np.float32), np.asarray(thumbnails, np.float32).reshape(shape)


def choose_frames(sharpness: Float[np.ndarray, " n"], thumbnails: Float[np.ndarray, "n p"], most: int) -> list[int]:
    """Numbers of at most `most` frames, in order.

    Raises: Refused if no frame shows anything.
    """
    shown = np.flatnonzero(sharpness > 0)
    if not len(shown):
        raise Refused(f"none of its {len(sharpness):,} frames shows anything: expected a video of a person")
    windows = np.array_split(shown, min(len(shown), WINDOWS))
    offered = np.asarray([window[np.argmax(sharpness[window])] for window in windows])
    worth = np.minimum(1, sharpness[offered] / np.median(sharpness[offered]))  # of a window that is blurred as a whole: less
    chosen, new = [int(np.argmax(worth))], np.full(len(offered), np.inf)
    while len(chosen) < min(most, len(offered)):
        apart = thumbnails[offered] - thumbnails[offered[chosen[-1]]]
        new = np.minimum(new, np.sqrt((apart**2).mean(axis=-1)))
        best = int(np.argmax(worth * new))
        if worth[best] * new[best] < NOTHING_NEW:
            break
        chosen.append(best)
    return sorted(offered[chosen].tolist())
