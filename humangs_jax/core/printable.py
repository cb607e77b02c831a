"""Text from files and file names, made safe to show."""

import unicodedata

SHOWN = {"Zs", "Cn", "Co"}
"""Categories that Python escapes in `repr` but that do nothing to a terminal: wide spaces, characters newer than Python."""
JOINERS = "\u200c\u200d"
"""Format characters that words of Persian and Indic languages need."""


def printable(text: object, lines: bool = False) -> str:
    r"""The text with every character that a terminal would act on escaped as in Python (\x1b, \u202e, \n).

    These are control characters, C1 included, marks of direction and other format characters, separators of lines, and bytes of
    file names that are not UTF-8 (\xe9). lines: line feeds and tabs stay, for a report of several lines.
    """
    text = str(text)
    if text.isprintable():
        return text
    kept = "\n\t" if lines else ""
    return "".join(c if c.isprintable() or c in kept or _harmless(c) else _escaped(c) for c in text)


def _harmless(c):
    return c in JOINERS or unicodedata.category(c) in SHOWN


def _escaped(c):
    if "\udc80" <= c <= "\udcff":  # a byte of a file name, as os.fsdecode has it
        return f"\\x{ord(c) - 0xDC00:02x}"
    return c.encode("unicode_escape").decode("ascii")
