"""A set of many items that is made bit by bit. It is one folder. A manifest in it says what the set
is made with. Each finished item has a folder or a file in it.

The same call continues an interrupted set: finished items are kept, and other settings are refused.
Several processes may make parts of one set at the same time. A name alone does not tell what an
item was made from. So code that keeps finished items compares contents, too
(`avatar.recorded_source`, `files_key`).
"""

import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from humangs_jax.core.processes import in_processes
from humangs_jax.data.capture_checks import CaptureError, checked_json
from humangs_jax.io.arrays import checksum
from humangs_jax.io.reading import shown, write_json

MANIFEST = "manifest.json"
"""The file that says what kind of set a folder is."""
SETTINGS = "settings"
"""The key of the manifest for the settings that the folder was made with."""
K = TypeVar("K")


class SetFormat(NamedTuple):
    """The name and version of a kind of sets, the first entries in its manifest."""

    format: str
    """The name of the format."""
    version: int
    """The version of the format."""


SYNTHETIC = SetFormat("humangs-synthetic", 2)
"""People that the package made."""
DATA_SET = SetFormat("humangs-dataset", 1)
"""Scans or videos of a data set."""
AVATARS = SetFormat("humangs-avatars", 2)
"""Avatars that were reconstructed from several captures."""
SCORES = SetFormat("humangs-scores", 1)
"""Scores of an evaluation."""
LOOK = 1 << 16
"""The number of bytes at the beginning of each file that `files_key` reads."""


def read_manifest(folder: Path, kind: SetFormat) -> dict[str, Any]:
    """Read the manifest of a set.

    Raises: CaptureError if there is no manifest of this kind and version, or if its settings are
    missing.
    """
    file = Path(folder) / MANIFEST
    content = checked_json(file)
    if not isinstance(content, dict) or content.get("format") != kind.format:
        raise CaptureError(file, "format", f"expected a manifest of {kind.format!r}")
    if content.get("version") != kind.version:
        raise CaptureError(
            file, "version", f"expected {kind.version}, got {shown(content.get('version'))}"
        )
    if not isinstance(content.get(SETTINGS), dict):
        raise CaptureError(
            file, SETTINGS, f"expected an object, got {shown(content.get(SETTINGS))}"
        )
    return content


def begin_set(
    folder: Path, kind: SetFormat, made_with: Mapping[str, Any], alone: bool = False
) -> None:
    """Start a set in a folder, or check that the set in it can be continued.

    Arguments: made_with: what the whole set is made with; its entry `SETTINGS` is a dictionary.
    alone: whether a new set needs an empty folder. Entries that begin with a dot do not count.
    Raises: CaptureError if the folder has a set of another kind or version, or one that was made
    with something else. ValueError if `alone` is True and the folder of a new set is not empty.
    """
    if not (folder / MANIFEST).is_file():
        if (
            alone
            and folder.is_dir()
            and any(not entry.name.startswith(".") for entry in folder.iterdir())
        ):
            raise ValueError(
                f"{folder}: the folder is not empty and holds no {MANIFEST}: choose another one"
            )
        folder.mkdir(parents=True, exist_ok=True)
        write_manifest(folder, kind, made_with)
        return
    earlier = _flat(read_manifest(folder, kind), made_with)
    asked = _flat(made_with, made_with)
    pairs = {name: (earlier.get(name), asked.get(name)) for name in sorted({**asked, **earlier})}
    changed = [
        f"{name} {shown(old)} -> {shown(new)}" for name, (old, new) in pairs.items() if old != new
    ]
    if changed:
        problem = (
            f"written with settings other than asked for now ({', '.join(changed)}): choose another"
            " folder"
        )
        raise CaptureError(folder / MANIFEST, SETTINGS, problem)


def _flat(content: Mapping[str, Any], keys: Mapping[str, Any]) -> dict[str, Any]:
    return {key: content.get(key) for key in keys if key != SETTINGS} | content[SETTINGS]


def files_key(root: Path, files: Iterable[Path]) -> str:
    """Returns a checksum of files: of their paths relative to `root`, their sizes and their first
    `LOOK` bytes. Files that do not exist are left out.

    The checksum tells data sets apart without reading all of their photos.
    """
    texts = []
    for file in sorted(files):
        if not file.is_file():
            continue
        with open(file, "rb") as opened:
            begin = hashlib.sha256(opened.read(LOOK)).hexdigest()
        texts.append(f"{file.relative_to(root).as_posix()} {file.stat().st_size} {begin}")
    return checksum({}, *texts)


def write_manifest(
    folder: Path, kind: SetFormat, made_with: Mapping[str, Any], **found: Any
) -> dict[str, Any]:
    """Write the manifest of a set. Nobody sees it half written. found: what is in the set.

    Returns the content of the manifest.
    """
    content = {**kind._asdict(), **made_with, **found}
    write_json(folder / MANIFEST, content)
    return content


def finished(folder: Path, mark: str) -> list[str]:
    """Returns the sorted names of the subfolders that hold the file `mark`. A subfolder with this
    file is complete. Names that begin with a dot are left out.
    """
    return sorted(
        path.parent.name
        for path in folder.glob(f"*/{mark}")
        if not path.parent.name.startswith(".")
    )


def made(
    work: Callable[..., object],
    tasks: Mapping[K, tuple[Any, ...]],
    workers: int,
    load: Callable[[], object],
) -> Iterator[tuple[K, Exception | None]]:
    """Run tasks, in parallel if there are several workers. Yields (name, error) for each task as it
    ends. The error is None, or the ValueError, ArithmeticError or LookupError that the task raised.
    Any other error, such as an OSError because the disk is full, ends all tasks and is raised.

    Arguments: work: called as work(loaded, *arguments), with what `load` has returned and the
    arguments of the task. tasks: the arguments by name. workers: the number of processes. Several
    processes use the CPU only. load: called once in each process. With several processes all
    arguments are pickled, and the calling script has to be guarded by `if __name__ == "__main__"`.
    """
    once = functools.partial(_attempt, work)
    if workers > 1 and len(tasks) > 1:
        yield from in_processes(once, tasks, workers, _load, load)
    elif tasks:
        _load(load)
        yield from ((name, once(*arguments)) for name, arguments in tasks.items())


_loaded: list[object] = []


def _load(load: Callable[[], object]) -> None:
    _loaded[:] = [load()]


def _attempt(work: Callable[..., object], *arguments: Any) -> Exception | None:
    try:
        work(_loaded[0], *arguments)
    except (ValueError, ArithmeticError, LookupError) as error:
        return error
    return None
