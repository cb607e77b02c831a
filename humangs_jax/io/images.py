"""Photos on disk <-> float32 arrays in [0, 1]: PNG (8 and 16 bits a channel) and JPEG, values as stored, no gamma.

The orientation flag that phones write into JPEG files (EXIF) is ignored: calibrations refer to the stored pixels.
"""

import subprocess
from pathlib import Path

import numpy as np

from humangs_jax.core.array_types import Float
from humangs_jax.io.atomic import replace_file

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_COLOUR_TYPES = {2: "rgb", 4: "grey and alpha", 6: "rgba"}
"""Colour types of a PNG file that Pillow silently cuts from 16 to 8 bits (grey alone, type 0, it reads in full)."""

_BROKEN = (SyntaxError, ValueError, EOFError)
"""What Pillow raises for broken files, besides OSError and DecompressionBombError."""


def read_image(path: str | Path) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"] | None]:
    """Colours and, where the file has an alpha channel, alpha. Grey images become three equal channels.

    Raises: OSError if the file cannot be read as an image; FileNotFoundError (an OSError) if it is not there.
    """
    pixels = _read_pixels(path)
    if pixels.shape[-1] in (1, 3):
        return np.ascontiguousarray(np.broadcast_to(pixels, (*pixels.shape[:2], 3))), None
    colours = np.broadcast_to(pixels[..., :-1], (*pixels.shape[:2], 3))
    return np.ascontiguousarray(colours), np.ascontiguousarray(pixels[..., -1])


def read_grey(path: str | Path) -> Float[np.ndarray, "h w"]:
    """A one-channel image such as a mask; colour files are averaged.

    Raises: OSError if the file cannot be read; ValueError if it has alpha besides the colours (which is meant?).
    """
    colours, alpha = read_image(path)
    if alpha is not None and alpha.min() < 1:
        raise ValueError("the image has an alpha channel besides its colours: expected one grey channel")
    return colours[..., 0] if (colours == colours[..., :1]).all() else colours.mean(axis=-1)


def write_png(path: str | Path, image: Float[np.ndarray, "h w c"] | Float[np.ndarray, "h w"]) -> None:
    """Write colours or grey in [0, 1] as an 8-bit PNG, rounded to the nearest level; values outside are clipped.

    A fourth channel is alpha. The file appears whole or not at all. Raises: OSError if it cannot be written.
    """
    from PIL import Image

    replace_file(path, lambda temporary: Image.fromarray(to_uint8(image)).save(temporary, format="PNG"))


def to_uint8(image: Float[np.ndarray, "*shape"]) -> np.ndarray:
    """[0, 1] -> 0..255, rounded to nearest and clipped; NaN becomes 0."""
    return np.rint(255 * np.clip(np.nan_to_num(np.asarray(image)), 0, 1)).astype(np.uint8)


def resized(image: Float[np.ndarray, "h w *c"], width: int, height: int) -> Float[np.ndarray, "height width *c"]:
    """A float32 image at another size: box-averaged where it becomes narrower, else bicubic."""
    from PIL import Image

    method = Image.Resampling.BOX if width < image.shape[1] else Image.Resampling.BICUBIC
    channels = np.moveaxis(image.reshape(*image.shape[:2], -1), -1, 0)
    planes = [np.asarray(Image.fromarray(channel).resize((width, height), method)) for channel in channels]
    return np.stack(planes, axis=-1).reshape(height, width, *image.shape[2:])


def check_image(path: str | Path) -> tuple[tuple[int, int], bool]:
    """((width, height), whether there is an alpha channel). PNG files are checked by their checksums, others by decoding.

    Raises: OSError if the file cannot be read as an image.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            found = image.size, "A" in image.getbands() or "transparency" in image.info
            image.verify() if image.format == "PNG" else image.load()
    except (*_BROKEN, Image.DecompressionBombError) as error:
        raise OSError(str(error)) from error
    return found


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height in pixels, from the head of the file. Raises: OSError if it is not an image."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return image.size
    except (*_BROKEN, Image.DecompressionBombError) as error:
        raise OSError(str(error)) from error


def _read_pixels(path):
    """(h, w, channels) float32 with 1 (grey), 2 (grey, alpha), 3 or 4 channels."""
    from PIL import Image

    with open(path, "rb") as file:
        head = file.read(26)
    if head[:8] == PNG_SIGNATURE and len(head) == 26 and head[24] == 16 and head[25] in PNG_COLOUR_TYPES:
        return _read_deep_png(path, has_alpha=head[25] != 2)
    try:
        with Image.open(path) as image:
            if image.mode.startswith("I"):  # 16-bit grey
                return np.asarray(image, np.float32)[..., None] / np.float32(65535)
            has_alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
            pixels = np.asarray(image.convert("RGBA" if has_alpha else "RGB"))
    except (*_BROKEN, Image.DecompressionBombError) as error:
        raise OSError(str(error)) from error
    return pixels.astype(np.float32) / np.float32(255)


def _read_deep_png(path, has_alpha):
    """16 bits a channel through ffmpeg, which comes with imageio-ffmpeg: Pillow keeps the upper 8 bits only."""
    import imageio_ffmpeg
    from PIL import Image

    with Image.open(path) as image:
        width, height = image.size
    channels, layout = (4, "rgba64le") if has_alpha else (3, "rgb48le")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-frames:v", "1"]
    command += ["-f", "rawvideo", "-pix_fmt", layout, "-"]
    done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    if done.returncode or len(done.stdout) != 2 * width * height * channels:
        raise OSError(f"not a readable 16-bit PNG: {done.stderr.decode(errors='replace').strip()}")
    pixels = np.frombuffer(done.stdout, "<u2").reshape(height, width, channels)
    return pixels.astype(np.float32) / np.float32(65535)
