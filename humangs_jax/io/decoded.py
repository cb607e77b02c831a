"""Photos that several steps of one command read are decoded once, within a bound on memory."""

import contextlib
import contextvars
import hashlib
from collections.abc import Generator

import numpy as np

from humangs_jax.core.array_types import Float, UInt8

WHOLE_LEVELS = np.float32(255)
"""Pixels that are whole multiples of 1 / 255 are kept as bytes, others as they are."""


class Decoded:
    """Keeps pixels by the content of their files, so that a copy of a photo counts as that photo.
    Photos are read in turn, again and again: what comes first stays, and what does not fit any more
    is left out.
    """

    def __init__(self, most: int) -> None:
        self.room = most
        self.pixels: dict[bytes, UInt8[np.ndarray, "h w c"] | Float[np.ndarray, "h w c"]] = {}

    def find(self, key: bytes) -> Float[np.ndarray, "h w c"] | None:
        """Returns the pixels of a content, in an array that is the caller's; None if they are
        not kept.
        """
        pixels = self.pixels.get(key)
        if pixels is None:
            return None
        if pixels.dtype == np.uint8:
            return pixels.astype(np.float32) / WHOLE_LEVELS
        return pixels.copy()

    def keep(self, key: bytes, pixels: Float[np.ndarray, "h w c"]) -> None:
        """Keep pixels if there is room."""
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
    """Lets `io.images` decode each photo once within the block, as long as its pixels fit into
    `most` bytes (by default those of twenty photos of four megapixels); then all are forgotten.
    """
    token = _current.set(Decoded(most))
    try:
        yield
    finally:
        _current.reset(token)


def forget_decoded() -> None:
    """Free what has been kept, when no step that is left reads photos; none is kept any more."""
    kept = _current.get()
    if kept is not None:
        kept.pixels, kept.room = {}, 0


def kept_photos() -> Decoded | None:
    """Returns what is kept at present; None outside of `decoded_once`."""
    return _current.get()


def content_key(data: bytes, as_stored: bool = False) -> bytes:
    """Returns the key of the pixels of a file. as_stored: whether its color profile is left out."""
    return hashlib.blake2b(data, salt=bytes([as_stored])).digest()
