"""Sizes of static buffers."""


def round_up(size: int, smallest: int = 64) -> int:
    """The next 2^i or 1.5 * 2^i, at least `smallest`: similar scenes share one compilation, and at most a third is spare."""
    power = 1 << (max(size, smallest, 2) - 1).bit_length()
    return 3 * power // 4 if size <= 3 * power // 4 and smallest <= 3 * power // 4 else power
