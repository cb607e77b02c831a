"""Sizes of static buffers."""

STEPS = 4
"""Sizes per power of two."""


def round_up(size: int, smallest: int = 64) -> int:
    """The next (4, 5, 6 or 7) 2^i, at least `smallest`: similar scenes share one compilation, at most a fifth is spare."""
    size = max(size, smallest)
    unit = 1 << max(0, (size - 1).bit_length() - STEPS.bit_length())
    return -(-size // unit) * unit
