"""Tables of formats of files, folders and data sets that can be read or written. Each row is a
format.

A row names its code, which is imported when it is first needed. So the command line, its help and
the docs can list all formats without importing any. A new format is one file and one line:
`MOTIONS["mine"] = MotionFormat("my program's", "my.module:read", (".mine",))`.
"""

import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

FOLDER = ""
"""Suffix of formats whose files lie in a folder."""


@dataclasses.dataclass(frozen=True)
class Format:
    """One format of files: a row of a table `Formats`, whose columns are these fields. A table that
    needs more fields uses a subclass.
    """

    about: str
    """The programs or data sets that such files come from, in a few words. `--help` and the docs
    show this.
    """
    code: str | Callable[..., Any]
    """The function that reads or writes such files, or its name as "package.module:function"."""
    suffixes: tuple[str, ...] = ()
    """Suffixes of such files, in lower case, with the dot; FOLDER for a folder. Empty: files of
    this format have no typical suffix.
    """
    recognizes: str | Callable[[Path], bool] | None = None
    """A function that says whether a path with one of the suffixes is of this format, or the
    function's name as "package.module:function". It is needed where formats share a suffix. None:
    every path with one of the suffixes is of this format.
    """

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Calls the code with the arguments and returns its result."""
        return imported(self.code)(*arguments, **options)


F = TypeVar("F", bound=Format)


class Formats(dict[str, F]):
    """Formats by name. `recognized` tries them in this order, those with `recognizes` first."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """All suffixes, each once."""
        return tuple(dict.fromkeys(suffix for each in self.values() for suffix in each.suffixes))

    def of(self, path: Path) -> "Formats[F]":
        """Returns the formats that have the suffix of a path, or the formats of folders if the path
        is a folder.
        """
        suffix = FOLDER
        if not path.is_dir():
            suffix = path.suffix.lower()
        return self.where(lambda each: suffix in each.suffixes)

    def recognized(self, path: Path) -> F | None:
        """Returns the first format that fits the file or folder, or None. Formats with `recognizes`
        are tried first.
        """
        found = sorted(self.of(path).values(), key=lambda each: each.recognizes is None)
        return next(
            (each for each in found if each.recognizes is None or imported(each.recognizes)(path)),
            None,
        )

    def where(self, holds: Callable[[F], bool]) -> "Formats[F]":
        """Returns the formats for which `holds` returns True."""
        return Formats({name: each for name, each in self.items() if holds(each)})

    def listed(self) -> str:
        """Returns all formats in one line, ".npz, .pkl: AMASS, AIST++; .json or a folder: LHM".
        They are listed by suffix, or by name if they have no suffix.
        """
        groups: dict[tuple[str, ...], dict[str, None]] = {}  # each name once
        for name, each in self.items():
            groups.setdefault(each.suffixes or (name,), {}).update(
                dict.fromkeys(each.about.split(", "))
            )
        return "; ".join(
            f"{alternatives(key)}: {', '.join(abouts)}" for key, abouts in groups.items()
        )


def alternatives(suffixes: tuple[str, ...]) -> str:
    """Lists suffixes as errors name them: ".bvh, .glb or a folder"."""
    words = [suffix for suffix in suffixes if suffix] + ["a folder"] * (FOLDER in suffixes)
    if len(words) > 1:
        words = [", ".join(words[:-1]), words[-1]]
    return " or ".join(words)


def imported(code: str | Callable[..., Any]) -> Callable[..., Any]:
    """Returns the function that "package.module:function" names, or `code` itself if it is a
    function.
    """
    if not isinstance(code, str):
        return code
    module, _, name = code.partition(":")
    return getattr(importlib.import_module(module), name)
