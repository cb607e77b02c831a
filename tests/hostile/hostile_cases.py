"""What a hostile file is, the list of them, and damage of every kind to every honest file.

`attacks_*.py` add those of each format to the list; `all_cases` imports them.
"""

import dataclasses
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from changes import edit_bytes, edit_text
from honest_files import written as written
from readers import FORMATS

FIRST_SEED = int(os.environ.get("HUMANGS_HOSTILE_SEED", "0"))
"""Added to the seeds of random damage: another number makes other files."""


@dataclasses.dataclass(frozen=True)
class Case:
    """reader: of `readers.FORMATS`. make: writes the file into a folder, returns its path. item: of
    test_hostile.ITEMS.
    """

    name: str
    reader: str
    make: Callable[[Path], Path]
    expect: str = "refused"
    item: int = 0


CASES: list[Case] = []
NAMES: set[str] = set()


def case(name, reader, make, expect="refused", item=0):
    assert f"{reader}: {name}" not in NAMES, f"two cases {reader}: {name}"
    NAMES.add(f"{reader}: {name}")
    CASES.append(Case(f"{reader}: {name}", reader, make, expect, item))


def setting(changes):
    """Changes values of some JSON: each by its path, as in "accessors.0.count"."""

    def change(content):
        for path, value in changes.items():
            *parents, last = [int(part) if part.isdigit() else part for part in path.split(".")]
            place = content
            for part in parents:
                place = place[part]
            place[last] = value
        return content

    return change


def json_case(kind, reader, changes, item=6, expect="refused"):
    """The honest JSON of a reader with some values changed, by path."""
    change = setting(changes)
    case(
        kind,
        reader,
        changed(reader, lambda data: json.dumps(change(json.loads(data))).encode()),
        expect,
        item,
    )


def capture_with(changes=None, prepare=lambda folder: None, photo=None):
    """An honest capture with some values of its description changed, by path, after something else
    was done to its folder.

    changes: values, or a function of the folder that returns them. photo: the bytes of the first
    one.
    """

    def make(folder):
        folder = folder / "me"
        folder.mkdir()
        FORMATS["capture"].make(folder)
        prepare(folder)
        if photo is not None:
            (folder / "images" / "000.png").write_bytes(photo)
        change = setting(changes(folder) if callable(changes) else changes or {})
        edit_bytes(
            folder / "capture.json", lambda data: json.dumps(change(json.loads(data))).encode()
        )
        return folder

    return make


def edited(name, old, new, inside=None):
    """The honest file of a reader, or one in its folder, with another text in one place."""

    def make(folder):
        path = FORMATS[name].make(folder)
        file = path / inside if inside else path
        edit_text(file, old, new)
        return path

    return make


# Damage to every honest file
# ------------------------------------------------------------------------------------------


def changed(name, change):
    """The honest file of a reader, its bytes changed."""

    def make(folder):
        path = FORMATS[name].make(folder)
        edit_bytes(FORMATS[name].damaged(path), change)
        return path

    return make


def replaced(name, place):
    """The honest file of a reader, something else in its place."""

    def make(folder):
        path = FORMATS[name].make(folder)
        file = FORMATS[name].damaged(path)
        file.unlink()
        place(file)
        return path

    return make


def flipped(seed):
    def change(data):
        data, random = bytearray(data), np.random.default_rng(FIRST_SEED + seed)
        for position in random.integers(len(data), size=1 + seed % 3):
            data[position] ^= 1 << int(random.integers(8))
        return bytes(data)

    return change


def huge(file):
    with file.open("wb") as stream:
        stream.truncate(1 << 40)  # takes no space


NONSENSE = {
    "empty": lambda data: b"",
    "one byte": lambda data: b"\0",
    "zeros": lambda data: bytes(4096),
    "noise": lambda data: np.random.default_rng(FIRST_SEED + 7).bytes(4096),
    "a web page": lambda data: b"<!DOCTYPE html><html><body>404 Not Found</body></html>\n",
}
PLACES = {
    "missing": lambda file: None,
    "a folder": lambda file: file.mkdir(),
    "a pipe": os.mkfifo,
    "a link to an endless device": lambda file: file.symlink_to("/dev/zero"),
    "a link to itself": lambda file: file.symlink_to(file),
    "of a terabyte": huge,
}
NOT_NOTICED = {
    "log",
    "missing photos",
    "scene arrays",
    "preprocessed scene",
    "skipped subject",
    "start",
    "splat",
}
"""Files that need not be there: a missing log is that of a run without trouble; what preprocessing
lacks is made again. Zeros are Gaussians of a `.splat`, which has no header."""
READ = {
    *(
        ("manifest", kind)
        for kind in ("missing", "a pipe", "a link to an endless device", "a link to itself")
    ),
    ("easymocap motion", "missing"),
}
"""A set is begun where its manifest is no file, and writing it replaces a link or a pipe; a motion
may begin later.
"""


def expected(reader, kind):
    return "read" if (reader, kind) in READ else "either" if reader in NOT_NOTICED else "refused"


for seed in (name for name, each in FORMATS.items() if each.make is not None):
    for kind, change in NONSENSE.items():
        case(kind, seed, changed(seed, change), expected(seed, kind))
    for kind, place in PLACES.items():
        case(kind, seed, replaced(seed, place), expected(seed, kind))
    for share in (0.02, 0.3, 0.6, 0.9):
        case(
            f"cut at {share:.0%}",
            seed,
            changed(seed, lambda data, s=share: data[: int(s * len(data))]),
            "either",
        )
    case("without its last byte", seed, changed(seed, lambda data: data[:-1]), "either")
    case("with more behind it", seed, changed(seed, lambda data: data + b"\0 more" * 20), "either")
    for i in range(4):
        case(f"flipped bits {i}", seed, changed(seed, flipped(i)), "either")


def all_cases() -> list[Case]:
    """Every case, those of all modules."""
    import attacks_arrays  # noqa: F401
    import attacks_binary  # noqa: F401
    import attacks_paths  # noqa: F401
    import attacks_photos  # noqa: F401
    import attacks_pickles  # noqa: F401
    import attacks_text  # noqa: F401

    return CASES
