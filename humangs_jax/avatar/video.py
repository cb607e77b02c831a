"""Writes frames as a video: .mp4 (H.264, plays everywhere), .webm (VP9, may be transparent), .gif
(256 colors for all frames, endless loop), or a folder of PNG files (may be transparent). Also
writes sheets of labelled images, and comparisons that show the error in color.
"""

import contextlib
import itertools
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from humangs_jax.avatar.export import VIDEOS, VideoFormat
from humangs_jax.core.array_types import Float, UInt8
from humangs_jax.core.checks import ROUNDING, checked_arguments
from humangs_jax.core.configuration import ArgumentError
from humangs_jax.core.registry import alternatives
from humangs_jax.io.atomic import add_files, check_ours, replace_file
from humangs_jax.io.images import DRAWN, is_own_output, to_uint8, write_png

Frame = Float[np.ndarray, "h w c"] | UInt8[np.ndarray, "h w c"]
CHANNELS = (3, 4)
"""The numbers of channels that a frame may have: colors, or colors and alpha."""
CONSTANT_RATE_FACTOR = 17
"""x264's constant rate factor. Lower is better, and 18 counts as visually lossless."""
VP9_QUALITY = 18
"""libvpx's constant quality, 0 to 63. Lower is better, and 18 is about as good as 18 of x264."""
LARGEST_GIF = 1 << 30
"""The largest size of the frames of a GIF, bytes, with three bytes for each pixel. All frames are
kept in memory, because one palette is chosen for all.
"""
LARGEST_GIF_FPS = 50
"""The largest frame rate of a GIF, frames per second, because viewers slow down frames that are
shorter than 2/100 s.
"""
PALETTE_FRAMES = 16
"""Number of evenly spaced frames from which the palette of a GIF is chosen."""


def check_video(
    path: str | Path, frames: int, width: int, height: int, transparent: bool = False
) -> VideoFormat:
    """Check that a video with these frames can be written, before they are drawn. Returns the
    video's format.

    A path without a suffix is a folder of PNG files. Raises: ValueError for another suffix, for
    transparency in a format without it, for a GIF whose frames have more than `LARGEST_GIF` bytes,
    for a video whose path is a folder, or for a folder of PNG files whose path is a file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    form = next((each for each in VIDEOS.values() if suffix in each.suffixes), None)
    if form is None:
        raise ArgumentError(
            "path",
            f"{path}: expected a name ending in {alternatives(VIDEOS.suffixes)} for PNG files",
        )
    # what the format cannot hold
    if transparent and not form.transparent:
        others = alternatives(VIDEOS.where(lambda each: each.transparent).suffixes)
        raise ArgumentError(
            "path",
            f"{path}: {suffix} has no transparency: expected {others} for PNG files, or a color",
        )
    if suffix == ".gif":
        _check_gif(path, frames, width, height)
    # what is there already
    if suffix and path.is_dir():
        raise ArgumentError("path", f"{path}: is a folder: expected a file name")
    if not suffix and path.is_file():
        raise ArgumentError("path", f"{path}: is a file: expected a folder name")
    return form


@checked_arguments
def write_video(
    path: str | Path,
    frames: Float[np.ndarray, "m h w c"] | UInt8[np.ndarray, "m h w c"] | Iterable[Frame],
    fps: float | int,
) -> int:
    """Write frames as a video or as PNG files. No file appears before all frames are written. If
    writing fails, nothing changes.

    Frames are asked for one by one. A .gif keeps one byte for each channel of all its frames in
    memory; other formats keep no frame. .mp4 and .webm need even sides: if a side is odd, the last
    row or column is repeated. If there are more than 50 frames a second, a .gif leaves out frames
    to keep its speed.

    Args:
        path: .mp4, .webm or .gif; without a suffix a folder of frame_00000.png and so on, which
            replace those that are there.
        frames: (h, w, 3) in [0, 1], or with straight alpha (h, w, 4), which only .webm and PNG
            files have. Frames of uint8, as other programs give them, are from 0 to 255.
        fps: frames per second.

    Returns:
        The number of frames that were given.

    Raises:
        ValueError: if there is no frame, if frames differ in shape or have another shape than
            above, or if their numbers are neither uint8 nor finite floats in [0, 1]. Also if `fps`
            is not positive and finite, if the suffix is unknown, if frames have alpha and the
            format has none, or if a GIF would have to keep more than 1 GiB. Also if the path of a
            video is a folder, if that of a folder is a file, or if a PNG file that would be
            replaced was not written by humangs.
        OSError: if the file cannot be written. Errors of the iterator `frames` are passed on.

    Examples:
        >>> images = (hg.render(hg.animate(avatar, pose), camera).rgb for pose in poses)
        >>> hg.write_video("dance.mp4", map(np.asarray, images), fps=30)
    """
    path = Path(path)
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"{path}: expected a positive number of frames per second, got {fps}")
    check_video(path, 0, 0, 0)
    checked = _checked(path, frames)
    first = next(checked, None)
    if first is None:
        raise ValueError(f"{path}: expected at least one frame, got none")
    height, width, channels = first.shape
    form = check_video(path, 0, width, height, channels == 4)
    count = itertools.count()  # of the frames that have been taken
    frames = (frame for frame, _ in zip(itertools.chain([first], checked), count, strict=False))
    if path.suffix:
        replace_file(path, lambda temporary: form(temporary, frames, float(fps), first.shape))
    else:
        old = sorted(path.glob("frame_*.png"))
        check_ours(old, is_own_output)

        def write(folder):
            return form(folder, frames, float(fps), first.shape)

        add_files(path, write, without=[file.name for file in old], ours=is_own_output)
    return next(count)


def video_size(path: str | Path, width: int, height: int) -> tuple[int, int]:
    """Returns the width and height of a video whose frames have this size. Formats with
    `even_sides` add a row or column to odd sides.
    """
    suffix = Path(path).suffix.lower()
    even = any(form.even_sides for form in VIDEOS.values() if suffix in form.suffixes)
    if even:
        return width + width % 2, height + height % 2
    return width, height


def write_images(
    folder: Path, frames: Iterable[np.ndarray], fps: float, shape: tuple[int, ...]
) -> None:
    """Write each frame as a PNG file, frame_00000.png and so on. Raises: OSError."""
    for i, frame in enumerate(frames):
        write_png(folder / f"frame_{i:05d}.png", frame, mark=DRAWN)


def _checked(path: Path, frames: Iterable[Frame]) -> Iterator[np.ndarray]:
    """Yields the frames as arrays, each after a check.

    Raises: ValueError, which names the path. It also names the frame, unless the frame has no
    pixels.
    """
    shape = None
    for i, given in enumerate(frames):
        frame = np.asarray(given)
        if frame.ndim != 3 or frame.shape[-1] not in CHANNELS:
            raise ValueError(
                f"{path}: frame {i}: expected shape (h, w, 3) or (h, w, 4), got {frame.shape}"
            )
        if shape is None:
            shape = frame.shape
        if 0 in frame.shape:
            raise ValueError(
                f"{path}: expected at least one frame of at least one pixel, got {frame.shape[:2]}"
            )
        if frame.shape != shape:
            raise ValueError(
                f"{path}: frame {i} has shape {frame.shape}, expected that of the first, {shape}"
            )
        _check_numbers(f"{path}: frame {i}", frame)
        yield frame


def _check_numbers(name: str, frame: np.ndarray) -> None:
    """Check that the numbers of a frame are colors: uint8, or floats in [0, 1].

    Raises: ValueError.
    """
    if frame.dtype == np.uint8:
        return
    if not jnp.issubdtype(frame.dtype, jnp.floating):  # numpy's own does not know bfloat16
        raise ValueError(
            f"{name}: expected floating-point numbers in [0, 1], or uint8, got {frame.dtype}"
        )
    low, high = float(frame.min()), float(frame.max())  # NaN if any number is
    if not np.isfinite([low, high]).all():
        raise ValueError(f"{name} has numbers that are not finite")
    if low < -ROUNDING or high > 1 + ROUNDING:
        raise ValueError(
            f"{name}: expected numbers in [0, 1], or uint8, got {low:g} to {high:g}: divide those"
            " of 0 to 255 by 255, np.clip others"
        )


def write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float, shape: tuple[int, ...]) -> None:
    """Write a video in H.264. Raises: OSError."""
    quality = [
        "-c:v",
        "libx264",
        "-crf",
        str(CONSTANT_RATE_FACTOR),
        "-pix_fmt",
        "yuv420p",
        "-movflags",
        "+faststart",
    ]
    _write_by_ffmpeg(path, frames, fps, shape, quality)


def write_webm(
    path: Path, frames: Iterable[np.ndarray], fps: float, shape: tuple[int, ...]
) -> None:
    """Write a video in VP9. Raises: OSError."""
    quality = [
        "-c:v",
        "libvpx-vp9",
        "-crf",
        str(VP9_QUALITY),
        "-b:v",
        "0",
        "-deadline",
        "good",
        "-cpu-used",
        "4",
    ]
    quality += ["-fflags", "+bitexact"]  # no random number in the file
    # a second stream beside the colors; alternate reference frames would separate the two
    if shape[-1] == 4:
        quality += ["-pix_fmt", "yuva420p", "-auto-alt-ref", "0"]
    else:
        quality += ["-pix_fmt", "yuv420p"]
    _write_by_ffmpeg(path, frames, fps, shape, quality)


def _write_by_ffmpeg(
    path: Path, frames: Iterable[np.ndarray], fps: float, shape: tuple[int, ...], quality: list[str]
) -> None:
    """Write a video by a call of ffmpeg. imageio's writer does not report when ffmpeg fails.

    Raises: OSError if ffmpeg fails.
    """
    import imageio_ffmpeg

    height, width, channels = shape
    odd = ((0, height % 2), (0, width % 2), (0, 0))  # as `video_size` says
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgba" if channels == 4 else "rgb24"]
    command += ["-s", f"{width + width % 2}x{height + height % 2}"]
    command += ["-r", str(Fraction(fps).limit_denominator(100_000)), "-i", "-", "-an", *quality]
    # encoded and tagged as BT.709: players guess the matrix of an untagged file by its size
    command += ["-vf", "scale=out_color_matrix=bt709:out_range=tv"]
    command += [
        "-colorspace",
        "bt709",
        "-color_primaries",
        "bt709",
        "-color_trc",
        "bt709",
        f"file:{path}",
    ]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None and ffmpeg.stderr is not None  # pipes, as asked for
        try:
            for frame in frames:
                ffmpeg.stdin.write(np.pad(to_uint8(frame), odd, mode="edge").tobytes())
            ffmpeg.stdin.close()
        except BrokenPipeError:  # ffmpeg has given up: it says why
            with contextlib.suppress(BrokenPipeError):
                ffmpeg.stdin.close()
        except BaseException:  # of the frames, or Ctrl-C: the file is not wanted any more
            ffmpeg.kill()
            with contextlib.suppress(BrokenPipeError):
                ffmpeg.stdin.close()
            ffmpeg.wait()
            raise
        problem = ffmpeg.stderr.read().decode(errors="replace")
    if ffmpeg.returncode:
        problem = " ".join(problem.split()) or f"it ended with {ffmpeg.returncode}"
        raise OSError(f"{path}: ffmpeg failed: {problem}")


def _indexed(frame: np.ndarray, palette: Any, background: np.ndarray) -> Any:
    """Returns a frame (h, w, 3) in the colors of a palette. Pixels of the color `background` get
    index 255. Pillow alone might not give it to them, because it looks up colors by their upper 6
    bits, in which 252 and 255 are equal.
    """
    from PIL import Image

    indices = np.array(Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE))
    indices[(frame == background).all(axis=-1)] = 255
    image = Image.fromarray(indices)
    image.putpalette(palette.getpalette())
    return image


def _commonest(pixels: np.ndarray) -> tuple[int, int, int]:
    """Returns the most frequent color (3,) of pixels (h, w, 3). It is the color of the background
    if the background has a single color.
    """
    packed = pixels.reshape(-1, 3).astype(np.int32) @ (1 << 16, 1 << 8, 1)
    values, counts = np.unique(packed, return_counts=True)
    common = int(values[counts.argmax()])
    return common >> 16, common >> 8 & 255, common & 255


def _check_gif(path: Path, frames: int, width: int, height: int) -> None:
    """Raises ArgumentError if the frames of a GIF would have more than `LARGEST_GIF` bytes."""
    if frames * width * height * 3 > LARGEST_GIF:
        raise ArgumentError(
            "path",
            f"{path}: {frames} frames of {width} x {height} are too many for a .gif: use .mp4 or"
            " .webm",
        )


def write_gif(path: Path, frames: Iterable[np.ndarray], fps: float, shape: tuple[int, ...]) -> None:
    """Write a GIF, with one palette for all frames.

    Raises: ArgumentError if the frames have more than `LARGEST_GIF` bytes; OSError.
    """
    from PIL import Image

    # of too many frames a second, every second or third
    step = int(np.ceil(fps / LARGEST_GIF_FPS))
    fps /= step
    kept: list[np.ndarray] = []
    for i, frame in enumerate(frames):
        if i % step == 0:
            kept.append(to_uint8(frame))
            _check_gif(path, len(kept), shape[1], shape[0])
    chosen = np.unique(np.linspace(0, len(kept) - 1, PALETTE_FRAMES).round().astype(int))
    # one palette for all frames: with one each, still surfaces flicker
    sampled = np.concatenate([kept[i] for i in chosen])
    palette = Image.fromarray(sampled).quantize(255, Image.Quantize.MEDIANCUT)
    colors = np.zeros((256, 3), np.uint8)
    known = np.asarray(palette.getpalette(), np.uint8).reshape(-1, 3)[:255]
    colors[: len(known)] = known
    colors[255] = _commonest(sampled)  # else the background would become the mean of colors like it
    palette.putpalette(colors.tobytes())
    images = [_indexed(frame, palette, colors[255]) for frame in kept]
    # durations are whole hundredths of a second; rounding the times, not the durations, keeps the
    # speed
    times = np.rint(np.arange(len(images) + 1) * 100 / fps).astype(int)
    durations = [10 * int(x) for x in np.diff(times)]
    first, *rest = images
    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=durations,
        loop=0,
        optimize=False,
    )


# Sheets
# --------------------------------------------------------------------------------------------------


LARGEST_ERROR = 0.25
"""The error from which on the last of `ERROR_COLORS` is shown: the mean absolute difference of the
channels.
"""
GAP = 4
"""Width of the white gap between tiles, pixels."""
TEXT_SHARE = 1 / 14
"""Height of the letters as a share of the width of a tile."""
SMALLEST_TEXT = 10
"""Least height of the letters, pixels."""
LARGEST_TEXT = 22
"""Largest height of the letters, pixels."""
ERROR_COLORS = ((1, 1, 1), (1, 0.87, 0.35), (0.93, 0.38, 0.13), (0.6, 0.04, 0.2), (0.12, 0, 0.12))
"""Colors of errors from none to the largest, evenly spaced: white first, like the background, then
darker at every step, so that the order is also visible in grey."""


def contact_sheet(
    images: Float[np.ndarray, "v h w 3"],
    path: str | Path,
    *,
    labels: Sequence[str] | None = None,
    headers: Sequence[str] | None = None,
    columns: int | None = None,
) -> None:
    """Write a grid of images as a PNG; see `tile`. Raises: OSError."""
    write_png(path, tile(images, labels=labels, headers=headers, columns=columns), mark=DRAWN)


def side_by_side(
    truth: Float[np.ndarray, "v h w 3"],
    ours: Float[np.ndarray, "v h w 3"],
    path: str | Path,
    *,
    labels: Sequence[str] | None = None,
) -> None:
    """Write a PNG with the truth, our image and the error of every view, and the scale of the error
    below. labels: one for each view. Raises: OSError.
    """
    errors = error_colors(np.abs(truth - ours).mean(axis=-1), LARGEST_ERROR)
    triples = np.stack([truth, ours, errors], axis=1).reshape(-1, *truth.shape[1:])
    headers = ("truth", "ours", "error")
    columns = 3 if len(truth) <= 3 else 6
    texts = None
    if labels is not None:
        texts = [text for label in labels for text in (label, "", "")]
    sheet = tile(triples, labels=texts, headers=headers * (columns // 3), columns=columns)
    legend = _error_legend(sheet.shape[1], _text_height(truth.shape[2]))
    write_png(path, np.concatenate([sheet, legend]), mark=DRAWN)


def tile(
    images: Float[np.ndarray, "v h w 3"],
    *,
    labels: Sequence[str] | None = None,
    headers: Sequence[str] | None = None,
    columns: int | None = None,
) -> Float[np.ndarray, "height width 3"]:
    """Returns a white sheet with the images in rows.

    Arguments:
        labels: one per image, written above it; what does not fit is cut off.
        headers: one per column.
        columns: images in a row. None: about as many as there are rows.
    """
    count, height, width = images.shape[:3]
    if columns is None:
        columns = int(np.ceil(np.sqrt(count)))
    else:
        columns = min(columns, count)
    text = _text_height(width)
    strip = 0 if labels is None else text + 2 * GAP
    top = 0 if headers is None else text + 2 * GAP
    rows = -(-count // columns)
    sheet = np.ones((top + rows * (strip + height + GAP) + GAP, columns * (width + GAP) + GAP, 3))
    corners = [
        (top + GAP + (i // columns) * (strip + height + GAP), GAP + (i % columns) * (width + GAP))
        for i in range(count)
    ]
    for image, (y, x) in zip(images, corners, strict=True):
        sheet[y + strip : y + strip + height, x : x + width] = image
    texts = [(label, x, y, width) for label, (y, x) in zip(labels or (), corners, strict=False)]
    texts += [
        (header, GAP + i * (width + GAP), GAP, width) for i, header in enumerate(headers or ())
    ]
    return write_texts(sheet, texts, text)


def write_texts(
    sheet: Float[np.ndarray, "height width 3"],
    texts: Sequence[tuple[str, int, int, int]],
    text_height: int,
) -> Float[np.ndarray, "height width 3"]:
    """Returns the sheet with black texts. texts: (text, left, top, largest width) of each,
    pixels.
    """
    from PIL import Image, ImageDraw, ImageFont

    if not any(text for text, *_ in texts):
        return sheet
    canvas = Image.fromarray(to_uint8(sheet))
    pen, font = ImageDraw.Draw(canvas), ImageFont.load_default(text_height)
    for text, x, y, room in texts:
        shown = text
        while shown and pen.textlength(shown, font=font) > room:
            shown = shown[:-2] + "…" if len(shown) > 2 else ""
        pen.text((x, y), shown, fill=(0, 0, 0), font=font)
    # only what was written on is rounded to 8 bits
    return np.where(np.asarray(canvas) == to_uint8(sheet), sheet, np.asarray(canvas) / 255)


def error_colors(
    errors: Float[np.ndarray, "*shape"], largest: float | int
) -> Float[np.ndarray, "*shape 3"]:
    """Returns the colors of non-negative errors: `ERROR_COLORS`, linear in between. Errors above
    `largest` get the last color.
    """
    stops = np.linspace(0, largest, len(ERROR_COLORS))
    return np.stack(
        [np.interp(errors, stops, channel) for channel in zip(*ERROR_COLORS, strict=True)], axis=-1
    )


def _error_legend(width: int, text_height: int) -> Float[np.ndarray, "height width 3"]:
    """Returns a strip with the scale of `error_colors`, and the numbers at its ends."""
    legend = np.ones((2 * GAP + text_height, width, 3))
    left, right = width // 3, max(2 * width // 3, width // 3 + 2)
    scale = np.linspace(0, LARGEST_ERROR, right - left)
    legend[GAP : GAP + text_height, left:right] = error_colors(scale, LARGEST_ERROR)
    texts = [("absolute error: 0", max(left - 9 * text_height, GAP), GAP // 2, left - GAP)]
    texts += [(f"{LARGEST_ERROR:g} and more", right + GAP, GAP // 2, width - right - GAP)]
    return write_texts(legend, texts, text_height)


def _text_height(width: int) -> int:
    return int(np.clip(width * TEXT_SHARE, SMALLEST_TEXT, LARGEST_TEXT))
