"""Takes photos out of videos with ffmpeg (imageio-ffmpeg). `photos_of_videos` writes a folder of
frames for each calibrated camera:

    CAMERA.mp4 (.m4v, .mov, .mkv, .avi)    ->    CAMERA/00000000.png, 00000001.png, ...

The step between these frames is `every`: with a step of 3 they are frames 0, 3, 6, and so on.

The videos of several cameras have to begin at the same moment. The frames of several videos that
show one moment are found by time (`moments`), because rates differ and videos lack frames. They get
the same number, and `every` counts moments instead of frames. A video of masks has the same name as
the video of its photos.

What a video says about itself is obeyed. Pixels that are not square are scaled to square ones.
Colors of high dynamic range or of wide primaries are converted to sRGB. Other colors are not
converted.

`write_frames` writes chosen frames of a single video. `frame_choice` chooses them.
"""

import contextlib
import re
import subprocess
import tempfile
import threading
from collections.abc import Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from humangs_jax.capture.calibration.moments import Moments, find_moments, nearest, progressions
from humangs_jax.core.array_types import Float, UInt
from humangs_jax.data.capture_checks import CaptureError
from humangs_jax.data.folders import VIDEO_SUFFIXES, is_video, scan_folder
from humangs_jax.io.color_spaces import Encoding, cube, of_code_points
from humangs_jax.io.images import image_in
from humangs_jax.io.reading import InvalidFileError, check_limit, limits, open_file, reading

_LONGEST_SECONDS = 3600
"""Longest time that one ffmpeg command may take, seconds. A command that takes longer is
stopped.
"""


def find_videos(folder: Path) -> dict[str, Path]:
    """Returns the videos of a folder by the name of their camera, which is the file name without
    suffix. Subfolders are not searched.

    Raises: CaptureError for two videos of one camera. OSError if the folder cannot be read.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if is_video(path):
            if path.stem in found:
                raise CaptureError(
                    path,
                    "",
                    f"camera {path.stem} has {found[path.stem].name} already: expected one video",
                )
            found[path.stem] = path
    return found


class _Shown(NamedTuple):
    """How frames have to be converted so that they look as a player shows them."""

    shape: str = ""
    """ffmpeg filter that makes pixels square. Empty if they are square already."""
    matrix: str = "auto"
    """ffmpeg's name for the matrix from YCbCr to RGB."""
    encoding: Encoding | None = None
    """How the video encodes colors. None if its colors are sRGB."""
    about: str = ""
    """Description of the colors, for a note."""
    rate: float | None = None
    """Mean number of frames per second, or None if unknown."""
    from_zero: bool = False
    """Whether ffmpeg is called with -copyts, so that it prints times as they are in the file. It is
    False for MPEG transport streams.
    """


class VideoPhotos(NamedTuple):
    """Folders of photos and masks, with notes if they were taken out of videos."""

    images: Path
    """Folder of photos."""
    masks: Path | None
    """Folder of masks, or None."""
    notes: tuple[str, ...] = ()
    """How the photos were taken out of the videos, one line each."""
    warnings: tuple[str, ...] = ()
    """What the videos lack, one line each."""


@contextlib.contextmanager
def photos_of_videos(
    images: Path, masks: Path | None, place: Path, every: int = 1, most: int | None = None
) -> Generator[VideoPhotos]:
    """Yields folders of photos and masks. If a folder holds videos, a temporary folder with their
    frames is yielded instead. It lies beside `place`, and is removed at the end. Folders of photos
    are yielded unchanged.

    Phones store photos and the clips of Live Photos in one folder. If a folder holds both, the
    photos count, unless `every` or `most` is given.

    Args:
        images: folder of photos or videos.
        masks: folder of masks or of their videos. None: no masks.
        place: where the capture will be written.
        every: step between frames, or between moments of several videos. The first frame or moment
            is 0.
        most: largest number of photos of a camera. None: all.
    Raises: CaptureError if `every` or `most` is given and there is no video, if `masks` is given
    and a camera has only a video of photos or only one of masks, if two videos have the same
    camera, or if a video cannot be read. OSError if the temporary folder cannot be made. See
    `named_after` for errors that are raised inside the block.
    """
    # videos of photos, and those of masks, where there are any
    asked = every != 1 or most is not None
    photo_videos = _meant_videos(images, asked)
    mask_videos = {} if masks is None else _meant_videos(masks, asked)
    if not photo_videos and not mask_videos:
        if asked:
            raise CaptureError(
                images,
                "",
                f"no video ({', '.join(VIDEO_SUFFIXES)}): frames can be chosen of videos only",
            )
        yield VideoPhotos(images, masks)
        return
    lonely = sorted(set(photo_videos) ^ set(mask_videos))
    if masks is not None and lonely:
        raise CaptureError(
            masks, lonely[0], "expected a video of photos and one of masks, or folders of both"
        )
    # frames of each camera, those of one moment under one number
    beside = next(folder for folder in place.resolve().parents if folder.is_dir())
    with tempfile.TemporaryDirectory(dir=beside, prefix=f".{place.name}.video-") as temporary:
        own, mattes = Path(temporary) / "images", Path(temporary) / "masks"
        moments, seconds = _moments(photo_videos, every, most)
        pixels = 0
        for camera, path in photo_videos.items():
            chosen = None if moments is None else moments.frames[camera][::every][:most]
            pixels = split_video(path, own / camera, every, most, pixels, chosen=chosen)
        pixels = 0
        for camera, path in mask_videos.items():
            chosen = None
            if moments is not None:
                chosen = _mask_frames(path, camera, moments, seconds)[::every][:most]
            photos = photo_videos[camera]
            pixels = split_video(
                path, mattes / camera, every, most, pixels, chosen=chosen, mask_of=photos
            )
        notes = [note for note in map(_color_note, photo_videos.values()) if note is not None]
        warnings = ()
        if moments is not None:
            notes += moments.notes
            warnings = moments.warnings
        written = None if masks is None else mattes
        found = VideoPhotos(own, written, tuple(dict.fromkeys(notes)), warnings)
        with named_after(own, images), named_after(mattes, masks or images):
            yield found


def _meant_videos(folder: Path, asked: bool) -> dict[str, Path]:
    """Returns the videos of a folder, by the name of their camera. The result is empty if the
    folder also holds photos and `asked` is False. asked: whether the user asked for frames of
    videos.
    """
    if not asked and scan_folder(folder).photos:
        return {}
    return find_videos(folder)


@contextlib.contextmanager
def named_after(temporary: Path, folder: Path) -> Generator[None]:
    """Replaces the path of the temporary folder in error messages by that of `folder`, because the
    temporary folder no longer exists when the user reads the message. This is a context manager.

    Raises: CaptureError with the new message, if a ValueError that names the temporary folder is
    raised inside.
    """
    try:
        yield
    except ValueError as error:
        message = str(error)
        if str(temporary) not in message:
            raise
        raise CaptureError("", "", message.replace(str(temporary), str(folder))) from error


def _moments(
    videos: Mapping[str, Path], every: int, most: int | None
) -> tuple[Moments | None, float | None]:
    """Returns the moments of several videos, and how many seconds at the start of each video were
    read. Both are None for a single video, and if only the first frame of each video is taken. The
    seconds are also None if whole videos were read.
    """
    if len(videos) < 2 or most == 1:
        return None, None
    rates = []
    for path in videos.values():
        with reading(path, "video", CaptureError):
            rates += filter(None, [_shown(path).rate])
    seconds = None if most is None or not rates else (most * every + 1) / min(rates)
    times = {camera: frame_times(path, seconds) for camera, path in videos.items()}
    return find_moments(times), seconds


def _mask_frames(
    path: Path, camera: str, moments: Moments, seconds: float | None
) -> list[int | None]:
    """Returns for each moment the index of the frame in a video of masks. None if the camera has no
    photo or no mask of the moment.

    If the videos of masks and of photos have the same number of frames, or if a time of the masks
    is not known, a mask has the index of its photo. Otherwise masks are found by their times.
    """
    times = frame_times(path, seconds)
    if len(times) == moments.counts[camera] or not np.isfinite(times).all():
        return moments.frames[camera]
    numbers = nearest(times - times[0], moments.times)
    photos = moments.frames[camera]
    return [
        number if photo is not None else None for number, photo in zip(numbers, photos, strict=True)
    ]


def frame_times(path: Path, seconds: float | None = None) -> Float[np.ndarray, " n"]:
    """Returns the time at which each frame of a video is shown, (n,), seconds, in the order of the
    video. NaN if the video does not state the time. seconds: how much of the video is read. None:
    all.

    Raises: CaptureError with the name of the video.
    """
    with reading(path, "video", CaptureError):
        command = _ffmpeg(path, "metadata=mode=add:key=a:value=a,metadata=mode=print:file=-")
        if _shown(path).from_zero:
            command.append("-copyts")
        if seconds is not None:
            command += ["-t", f"{seconds:.6f}"]
        lines = _finished(path, [*command, "-f", "null", "-"]).decode(errors="replace")
        found = re.findall(r"^frame:.*pts_time:(\S+)", lines, re.MULTILINE)
        if not found:
            raise _ffmpeg_error(path, b"")
        return np.asarray([float(each) if each != "NOPTS" else np.nan for each in found])


def split_video(
    path: Path,
    folder: Path,
    every: int = 1,
    most: int | None = None,
    before: int = 0,
    *,
    chosen: Sequence[int | None] | None = None,
    mask_of: Path | None = None,
) -> int:
    """Writes frames of a video as 00000000.png, ... into a new folder. Returns `before` plus the
    number of pixels in the written frames.

    Args:
        path: the video.
        folder: the new folder.
        every: step between frames.
        most: largest number of frames. None: all.
        before: number of pixels in frames of other videos. They count towards the limit
            `video_pixels`.
        chosen: index of the frame for each file, ascending. If given, `every` and `most` are
            ignored. None in this list: the file is not written.
        mask_of: the video of photos, if `path` is a video of their masks. The values of masks are
            not converted as colors. Their pixels are made square, see `_shown_as_mask`.
    Raises: CaptureError with the name of the video.
    """
    with reading(path, "video", CaptureError):
        shown = _shown(path) if mask_of is None else _shown_as_mask(path, mask_of)
        width, height = _frame_size(path, shown)
        folder.mkdir(parents=True)
        if chosen is None:
            # one frame more than there is room for, so that too many are noticed
            room = max(0, limits().video_pixels - before) // (width * height)
            wanted = room + 1 if most is None else min(most, room + 1)
            count = _run(path, folder, f"not(mod(n\\,{every}))", wanted, shown)
        else:
            count = sum(number is not None for number in chosen)
            _check_pixels(before + count * width * height, count, width, height)
            _write_chosen(path, folder, chosen, shown)
        pixels = before + count * width * height
        _check_pixels(pixels, count, width, height)
        return pixels


def _write_chosen(path: Path, folder: Path, chosen: Sequence[int | None], shown: _Shown) -> None:
    places = [place for place, number in enumerate(chosen) if number is not None]
    numbers = [number for number in chosen if number is not None]
    if not numbers:
        raise InvalidFileError("has no frame at the moments of the others")
    if _run(path, folder, _expression(numbers), len(numbers), shown) != len(numbers):
        raise InvalidFileError(
            f"has fewer frames than expected: {numbers[-1] + 1:,}, as many as the video that it"
            " goes with"
        )
    # from the end: a name is free when it is taken
    for i, place in reversed(list(enumerate(places))):
        (folder / f"{i:08d}.png").rename(folder / f"{place:08d}.png")


def _expression(numbers: Sequence[int]) -> str:
    """Returns the ffmpeg expression that selects the frames with these numbers.

    Raises: InvalidFileError if the numbers consist of more than 2000 arithmetic progressions,
    because the expression would be too long for a command line.
    """
    terms = []
    for first, step, last in progressions(numbers):
        if step:
            terms.append(f"between(n\\,{first}\\,{last})*not(mod(n-{first}\\,{step}))")
        else:
            terms.append(f"eq(n\\,{first})")
    # an expression is an argument of a program, which may not be too long
    if len(terms) > 2000:
        count = f"{len(numbers):,} frames to be paired by time with those of other rates"
        raise InvalidFileError(f"{count}: expected a larger step, or fewer frames")
    return "+".join(terms)


def _frame_size(path: Path, shown: _Shown) -> tuple[int, int]:
    open_file(path).close()  # no devices, no pipes, not too large
    filters = shown.shape or "null"
    first = _finished(
        path,
        [*_ffmpeg(path, filters), "-frames:v", "1", "-f", "image2pipe", "-c:v", "png", "pipe:1"],
    )
    if not first:
        raise _ffmpeg_error(path, b"")
    with image_in(first) as image:
        return image.size


# What a video says about itself
# ---------------------------------------------------------------------------------------

_STREAM = re.compile(r"^ *Stream #0:\d+.*?: Video: (.*)$", re.MULTILINE)
"""Regular expression of the line that ffmpeg prints about the video stream."""
COLORS = re.compile(r"\b\w+\((?:\w+, )?([\w-]+)/([\w-]+)/([\w-]+)[,)]")
"""Regular expression of matrix, primaries and transfer curve in the line that ffmpeg prints about
the video stream. They follow the pixel format: yuv420p10le(tv, bt2020nc/bt2020/arib-std-b67,
progressive).
"""
_PIXEL_SHAPE = re.compile(r"\[SAR (\d+):(\d+) ")
"""Regular expression of the sample aspect ratio, a pixel's width to its height."""
RATE = re.compile(r", ([\d.]+)(k?) fps\b")
"""Regular expression of the number of frames per second. A "k" after the number stands for
thousands.
"""
PRIMARIES = {"bt2020": 9, "smpte432": 12}
"""Code points of H.273 for ffmpeg's names of color primaries. All other primaries are taken for
sRGB's, with one exception: unknown primaries of a video of high dynamic range are taken for bt2020.
"""
_TRANSFERS = {"smpte2084": 16, "arib-std-b67": 18}
"""Code points of H.273 for ffmpeg's names of transfer curves of high dynamic range. All other
curves are taken for sRGB's.
"""
_WIDEST_PIXEL = 4
"""Largest ratio of a pixel's longer side to its shorter side. The largest in use is 2."""
_SQUARE = "scale=w=round(iw*max(sar\\,1)):h=round(ih*max(1/sar\\,1)),setsar=1"
"""ffmpeg filter that makes pixels square. It only enlarges frames, so that no detail is lost."""
_TABLE = "colors.cube"
"""Name of the temporary file with the color lookup table."""


def _shown(path: Path) -> _Shown:
    """Returns how the frames of a video have to be converted, from what ffmpeg prints about it.

    Raises: OSError if the file cannot be read. InvalidFileError if it is no regular file or too
    large, or if a pixel's longer side is more than `_WIDEST_PIXEL` times its shorter side.
    """
    open_file(path).close()
    # without an output ffmpeg fails, after it has printed what is there
    printed = subprocess.run(
        _opened(path, "info"), capture_output=True, timeout=_LONGEST_SECONDS, check=False
    ).stderr
    text = printed.decode(errors="replace")
    line = _STREAM.search(text)
    if line is None:
        return _Shown()  # what reads its frames says what is wrong
    rate, shape, colors = RATE.search(line[1]), _PIXEL_SHAPE.search(line[1]), COLORS.search(line[1])
    a_second = None
    if rate is not None:
        unit = 1000 if rate[2] else 1
        a_second = float(rate[1]) * unit
    found = _Shown(rate=a_second, from_zero="Input #0, mpegts" not in text)
    if shape is not None and shape[1] != shape[2]:
        wide, high = int(shape[1]), int(shape[2])
        if max(wide, high) > _WIDEST_PIXEL * min(wide, high):
            problem = (
                f"its pixels are {wide} to {high} wide to high: expected at most {_WIDEST_PIXEL} to"
                " 1, or square ones"
            )
            raise InvalidFileError(problem)
        found = found._replace(shape=_SQUARE)
    return found if colors is None else _with_colors(found, *colors.groups())


def _with_colors(shown: _Shown, matrix: str, primaries: str, transfer: str) -> _Shown:
    bright = transfer in _TRANSFERS
    usual = PRIMARIES["bt2020"] if bright and primaries == "unknown" else 1
    code = PRIMARIES.get(primaries, usual)
    encoding = of_code_points(code, _TRANSFERS.get(transfer, 1))
    if encoding is None:
        return shown
    wide = matrix.startswith("bt2020") or (bright and matrix == "unknown")
    return shown._replace(
        matrix="bt2020" if wide else "auto", encoding=encoding, about=f"{primaries}, {transfer}"
    )


def _shown_as_mask(path: Path, photos: Path) -> _Shown:
    """Returns how the frames of a video of masks have to be converted. Their values are not
    converted as colors.

    Pixels are made square by the shape that the video of masks states. There is one exception: the
    video of masks states square pixels or no shape, the video of photos states another shape, and
    the stored frames of both have the same size. Masks are then scaled to the size that the photos
    get.
    """
    own, theirs = _shown(path), _shown(photos)
    as_stored = _Shown()
    if (
        not own.shape
        and theirs.shape
        and _frame_size(path, as_stored) == _frame_size(photos, as_stored)
    ):
        width, height = _frame_size(photos, theirs)
        return _Shown(shape=f"scale=w={width}:h={height},setsar=1")
    return own._replace(encoding=None)


def _color_note(path: Path) -> str | None:
    with reading(path, "video", CaptureError):
        shown = _shown(path)
    if shown.encoding is None:
        return None
    return f"videos with other colors than sRGB's ({shown.about}): converted"


def _check_pixels(pixels: int, count: int, width: int, height: int) -> None:
    what = (
        f"pixels in the frames of the videos, {count:,} or more of {width} x {height} in this one"
    )
    check_limit("video_pixels", pixels, what)


def write_frames(path: Path, folder: Path, chosen: Sequence[int]) -> None:
    """Writes frames of a video as frame_00000017.png, ... into a new folder. chosen: numbers of the
    frames, counted from 0, ascending.

    Raises: CaptureError with the name of the video.
    """
    with reading(path, "video", CaptureError):
        folder.mkdir(parents=True)
        select = "+".join(f"eq(n\\,{i})" for i in chosen)
        if _run(path, folder, select, len(chosen), _shown(path)) != len(chosen):
            raise InvalidFileError("its frames are not the same when they are read again")
        for i, frame in enumerate(chosen):
            (folder / f"{i:08d}.png").rename(folder / f"frame_{frame:08d}.png")


def grey_frames(path: Path, longer_side: int) -> Iterator[UInt[np.ndarray, "h w"]]:
    """Yields all frames of a video, one after the other, in grey, (h, w). Frames with a longer side
    of more than `longer_side` pixels are shrunk to this size.

    Raises: CaptureError with the name of the video.
    """
    return (frame[..., 0] for frame in _small_frames(path, longer_side, "gray", None))


def color_frames(
    path: Path, longer_side: int, chosen: Sequence[int] | None
) -> Iterator[UInt[np.ndarray, "h w 3"]]:
    """Yields frames of a video in the stored colors, (h, w, 3). Frames with a longer side of more
    than `longer_side` pixels are shrunk to this size. chosen: numbers of the frames, counted from
    0, ascending. None: all.

    Raises: CaptureError with the name of the video.
    """
    return _small_frames(path, longer_side, "rgb24", chosen)


def _small_frames(
    path: Path, longer_side: int, pixels: str, chosen: Sequence[int] | None
) -> Iterator[UInt[np.ndarray, "h w c"]]:
    """Yields frames in ffmpeg's pixel format `pixels`, (h, w, c), see `grey_frames` and
    `color_frames`.
    """
    with reading(path, "video", CaptureError):
        width, height = _frame_size(path, _shown(path))
        # frames of the size that is wanted, raw, through a pipe
        room = limits().video_pixels // (width * height)
        scale = min(1.0, longer_side / max(width, height))
        w, h = (max(1, round(side * scale)) for side in (width, height))
        select = "" if chosen is None else f"select={_expression(chosen)},"
        command = [*_ffmpeg(path, f"{select}scale={w}:{h}:flags=area"), "-frames:v", str(room + 1)]
        command += ["-f", "rawvideo", "-pix_fmt", pixels, "pipe:1"]
        size = w * h * (1 if pixels == "gray" else 3)
        with (
            tempfile.TemporaryFile() as output,
            subprocess.Popen(command, stdout=subprocess.PIPE, stderr=output) as process,
        ):
            assert process.stdout is not None
            # a video that does not end is stopped by the clock, and one of too many pixels while it
            # is read
            clock, count = threading.Timer(_LONGEST_SECONDS, process.kill), 0
            clock.start()
            try:
                data = process.stdout.read(size)
                while len(data) == size:
                    count += 1
                    _check_pixels(count * width * height, count, width, height)
                    yield np.frombuffer(data, np.uint8).reshape(h, w, -1)
                    data = process.stdout.read(size)
                if process.wait():
                    output.seek(0)
                    raise _ffmpeg_error(path, output.read())
            finally:
                clock.cancel()
                process.kill()


def frame_rate(path: Path) -> float | None:
    """Returns the mean number of frames per second of a video. None if the video does not say.

    Raises: CaptureError with the name of the video.
    """
    with reading(path, "video", CaptureError):
        return _shown(path).rate


def _opened(path: Path, verbosity: str = "error") -> list[str]:
    """Returns the beginning of an ffmpeg command: the program, its general options, and the input
    video.
    """
    import imageio_ffmpeg

    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-hide_banner",
        "-v",
        verbosity,
        "-nostdin",
        "-xerror",
    ]
    # a playlist in disguise may name other files and hosts; pictures may be larger than what is
    # read later
    # formats that ffmpeg reads, whatever the name says: others are lists of files (ffconcat,
    # playlists)
    command += ["-protocol_whitelist", "file", "-format_whitelist", "mov,matroska,avi,mpegts"]
    return [*command, "-max_pixels", str(limits().pixels), "-i", f"file:{path.resolve()}"]


def _ffmpeg(path: Path, filters: str) -> list[str]:
    return [*_opened(path), "-map", "0:v:0", "-vf", filters, "-fps_mode", "passthrough"]


def _run(path: Path, folder: Path, select: str, most: int, shown: _Shown) -> int:
    """Writes the frames for which the ffmpeg expression `select` is not 0, at most `most` of them.
    Returns how many were written.
    """
    table, filters = folder / _TABLE, [f"select={select}", *filter(None, [shown.shape])]
    if shown.encoding is not None:
        table.write_text(cube(shown.encoding))
        whole = (
            f"scale=in_color_matrix={shown.matrix}:flags=accurate_rnd+full_chroma_int,format=rgb48"
        )
        filters += [whole, f"lut3d=file={_TABLE}:interp=tetrahedral", "format=rgb24"]
    # a PNG would say for each program in its own words that its values are a video's
    filters += ["setparams=color_primaries=unknown:color_trc=unknown"]
    command = [
        *_ffmpeg(path, ",".join(filters)),
        "-frames:v",
        str(most),
        "-y",
        "-start_number",
        "0",
        "%08d.png",
    ]
    _finished(path, command, folder)  # run in the folder, because its path may hold a %
    table.unlink(missing_ok=True)
    count = sum(1 for _ in folder.iterdir())
    if not count:
        raise _ffmpeg_error(path, b"")
    return count


def _finished(path: Path, command: Sequence[str], folder: Path | None = None) -> bytes:
    try:
        done = subprocess.run(
            command, cwd=folder, capture_output=True, timeout=_LONGEST_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise InvalidFileError(
            f"its frames take more than {_LONGEST_SECONDS:,} seconds: expected a shorter video"
        ) from None
    if done.returncode:
        raise _ffmpeg_error(path, done.stderr)
    return done.stdout


def _ffmpeg_error(path: Path, text: bytes) -> ValueError:
    message = " ".join(text.decode(errors="replace").split()) or "no frame"
    return ValueError(message.replace(f"file:{path.resolve()}", path.name))
