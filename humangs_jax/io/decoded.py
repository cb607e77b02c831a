"""Keeps the pixels of decoded photos in memory, up to a limit. A photo that several steps of a
command read is then decoded once.
"""

import contextlib
import contextvars
import hashlib
from collections.abc import Generator

import numpy as np

from humangs_jax.core.array_types import Float, UInt8

WHOLE_LEVELS = np.float32(255)
"""Largest level of a byte. Pixels that are all whole multiples of 1 / 255 are kept as bytes, and
others as float32.
"""


class Decoded:
    """Keeps the pixels of photos, by the content of their files. A copy of a photo thus counts as
    the same photo. When there is no more room, further photos are not kept. The first ones stay,
    because photos are read in turn, again and again.

    Arguments: most: limit of memory, bytes.
    """

    def __init__(self, most: int) -> None:
        self.room = most
        self.pixels: dict[bytes, UInt8[np.ndarray, "h w c"] | Float[np.ndarray, "h w c"]] = {}

    def find(self, key: bytes) -> Float[np.ndarray, "h w c"] | None:
        """Returns the pixels of a file's content, (h, w, c), float32 from 0 to 1, in a new array.
        Returns None if they are not kept.
        """
        pixels = self.pixels.get(key)
        if pixels is None:
            return None
        if pixels.dtype == np.uint8:
            return pixels.astype(np.float32) / WHOLE_LEVELS
        return pixels.copy()

    def keep(self, key: bytes, pixels: Float[np.ndarray, "h w c"]) -> None:
        """Keeps the pixels of a file's content if there is room."""
        if key in self.pixels or pixels.size > self.room:
            return
        levels = np.rint(pixels * WHOLE_LEVELS).astype(np.uint8)
        exact = np.array_equal(levels.astype(np.float32) / WHOLE_LEVELS, pixels)
        kept = levels if exact else pixels.copy()
        if kept.nbytes <= self.room:
            self.pixels[key] = kept
            self.room -= kept.nbytes


_current: contextvars.ContextVar[Decoded | None] = contextvars.ContextVar("decoded", default=None)


@contextlib.contextmanager
def decoded_once(most: int = 256 << 20) -> Generator[None]:
    """Lets `io.images` decode each photo only once within the block. Pixels are kept as long as
    they fit into `most` bytes. By default that is enough for twenty photos of four megapixels that
    are kept as bytes (see `WHOLE_LEVELS`). At the end of the block all pixels are dropped.
    """
    token = _current.set(Decoded(most))
    try:
        yield
    finally:
        _current.reset(token)


def forget_decoded() -> None:
    """Drops all kept pixels and keeps no more. It is called when no later step reads photos."""
    kept = _current.get()
    if kept is not None:
        kept.pixels, kept.room = {}, 0


def kept_photos() -> Decoded | None:
    """Returns the store of decoded photos; None outside of `decoded_once`."""
    return _current.get()


def content_key(data: bytes, as_stored: bool = False) -> bytes:
    """Returns the key under which the pixels of a file are kept. data: bytes of the file.
    as_stored: whether the pixels are left as stored, not converted to sRGB.
    """
    return hashlib.blake2b(data, salt=bytes([as_stored])).digest()
