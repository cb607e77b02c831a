"""Frames -> a video file: .mp4 (H.264, plays everywhere) or .gif (256 colours for all frames, endless loop)."""

import contextlib
import subprocess
from fractions import Fraction
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.atomic import replace_file
from humangs_jax.io.images import to_uint8

CONSTANT_RATE_FACTOR = 17
"""x264's quality; 18 counts as visually lossless."""
LARGEST_GIF_FPS = 50
"""Viewers slow down frames that are shorter than 2/100 s."""
PALETTE_FRAMES = 16
"""The palette of a GIF is chosen from this number of frames, evenly spaced."""


def write_video(path: str | Path, frames: Float[np.ndarray, "m h w 3"], fps: float | int) -> None:
    """Write frames in [0, 1] as .mp4 or .gif; the file appears whole or not at all.

    H.264 wants even sides: odd ones get one more row or column, a copy of the last. A GIF of more than 50 frames a
    second leaves out frames to keep its speed.

    Raises: ValueError if there is no frame, a number is not finite, `fps` is not positive or the suffix another one;
    OSError if the file cannot be written.
    """
    path = Path(path)
    if len(frames) == 0 or 0 in frames.shape:
        raise ValueError(f"{path}: expected at least one frame, got {len(frames)} of {frames.shape[1:3]}")
    if not np.isfinite(frames).all():
        raise ValueError(
            f"{path}: frame {int(np.argwhere(~np.isfinite(frames))[0][0])} has numbers that are not finite"
        )
    if not (np.isfinite(fps) and fps > 0):
        raise ValueError(f"{path}: expected a positive number of frames per second, got {fps}")
    writers = {".mp4": _write_mp4, ".gif": _write_gif}
    if path.suffix.lower() not in writers:
        raise ValueError(f"{path}: expected a name ending in .mp4 or .gif")
    replace_file(path, lambda temporary: writers[path.suffix.lower()](temporary, frames, float(fps)))


def _write_mp4(path, frames, fps):
    """Through ffmpeg itself: imageio's writer does not tell when ffmpeg fails."""
    import imageio_ffmpeg

    height, width = frames.shape[1:3]
    odd = ((0, height % 2), (0, width % 2), (0, 0))
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width + width % 2}x{height + height % 2}"]
    command += ["-r", str(Fraction(fps).limit_denominator(100_000)), "-i", "-", "-an"]
    command += ["-c:v", "libx264", "-crf", str(CONSTANT_RATE_FACTOR), "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    # said and done in BT.709: players guess the matrix of an untagged file by its size
    command += ["-vf", "scale=out_color_matrix=bt709:out_range=tv"]
    command += ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as ffmpeg:
        assert ffmpeg.stdin is not None and ffmpeg.stderr is not None  # pipes, as asked for
        try:
            for frame in frames:
                ffmpeg.stdin.write(np.pad(to_uint8(frame), odd, mode="edge").tobytes())
            ffmpeg.stdin.close()
        except BrokenPipeError:  # ffmpeg has given up: it says why
            with contextlib.suppress(BrokenPipeError):
                ffmpeg.stdin.close()
        problem = ffmpeg.stderr.read().decode(errors="replace")
    if ffmpeg.returncode:
        raise OSError(f"{path}: ffmpeg failed: {' '.join(problem.split())}")


def _write_gif(path, frames, fps):
    from PIL import Image

    step = int(np.ceil(fps / LARGEST_GIF_FPS))
    frames, fps = frames[::step], fps / step
    chosen = frames[np.unique(np.linspace(0, len(frames) - 1, PALETTE_FRAMES).round().astype(int))]
    # one palette for all frames: with one each, still surfaces flicker
    palette = Image.fromarray(np.concatenate([to_uint8(x) for x in chosen])).quantize(256, Image.Quantize.MEDIANCUT)
    images = [Image.fromarray(to_uint8(x)).quantize(palette=palette, dither=Image.Dither.NONE) for x in frames]
    # durations are whole hundredths of a second; rounding the times, not the durations, keeps the speed
    times = np.rint(np.arange(len(images) + 1) * 100 / fps).astype(int)
    durations = [10 * int(x) for x in np.diff(times)]
    first, *rest = images
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=durations, loop=0, optimize=False)
