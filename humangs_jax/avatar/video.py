"""Frames -> a video file: .mp4 (H.264, plays everywhere) or .gif (256 colours for all frames, endless loop)."""

import os
import uuid
from pathlib import Path

import numpy as np

from humangs_jax.array_types import Float
from humangs_jax.data.images import to_uint8

CONSTANT_RATE_FACTOR = 17
"""x264's quality; 18 counts as visually lossless."""
LARGEST_GIF_FPS = 50
"""Viewers slow down frames that are shorter than 2/100 s."""
PALETTE_FRAMES = 16
"""Frames, spread evenly, that the palette of a GIF is chosen from."""


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
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: no such folder")
    temporary = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix.lower()}")
    try:
        writers[path.suffix.lower()](temporary, frames, float(fps))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_mp4(path, frames, fps):
    import imageio_ffmpeg

    height, width = frames.shape[1:3]
    odd = ((0, height % 2), (0, width % 2), (0, 0))
    # said and done in BT.709: players guess the matrix of an untagged file by its size
    tags = [f"-{key}" for key in ("colorspace", "color_primaries", "color_trc")]
    output = [
        "-crf",
        str(CONSTANT_RATE_FACTOR),
        "-movflags",
        "+faststart",
        "-vf",
        "scale=out_color_matrix=bt709:out_range=tv",
    ]
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (width + width % 2, height + height % 2),
        fps=fps,
        codec="libx264",
        pix_fmt_out="yuv420p",
        quality=None,
        macro_block_size=1,
        output_params=output + [word for tag in tags for word in (tag, "bt709")],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    try:
        for frame in frames:
            writer.send(np.ascontiguousarray(np.pad(to_uint8(frame), odd, mode="edge")))
    finally:
        writer.close()


def _write_gif(path, frames, fps):
    from PIL import Image

    step = int(np.ceil(fps / LARGEST_GIF_FPS))
    frames, fps = frames[::step], fps / step
    chosen = frames[np.unique(np.linspace(0, len(frames) - 1, PALETTE_FRAMES).round().astype(int))]
    # one palette for all frames: with one each, still surfaces flicker
    palette = Image.fromarray(np.concatenate([to_uint8(x) for x in chosen])).quantize(256, Image.Quantize.MEDIANCUT)
    pictures = [Image.fromarray(to_uint8(x)).quantize(palette=palette, dither=Image.Dither.NONE) for x in frames]
    # durations are whole hundredths of a second; rounding the times, not the durations, keeps the speed
    times = np.rint(np.arange(len(pictures) + 1) * 100 / fps).astype(int)
    durations = [10 * int(x) for x in np.diff(times)]
    first, *rest = pictures
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=durations, loop=0, optimize=False)
