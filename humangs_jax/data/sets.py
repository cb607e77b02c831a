"""A set of many that is made bit by bit: one folder, a manifest of what it is made with, a folder
for each one that is finished.

The same call goes on with an interrupted set: what is finished is kept, other settings are refused.
Several processes may make parts of one set at the same time; each ends by writing the manifest of
what is there. A name alone does not tell what something was made from: whoever keeps what is
finished compares contents, too (`avatar.recorded_source`, `files_key`).
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
"""File that says what a folder is."""
SETTINGS = "settings"
"""Its key of what the folder was made with."""
K = TypeVar("K")


class SetFormat(NamedTuple):
    """The first entries in the manifest of a kind of sets."""

    format: str
    """The name of the format."""
    version: int
    """Its version."""


SYNTHETIC = SetFormat("humangs-synthetic", 2)
"""People that the package made."""
DATA_SET = SetFormat("humangs-dataset", 1)
"""Scans or videos of a data set."""
AVATARS = SetFormat("humangs-avatars", 2)
"""Avatars of an evaluation."""
SCORES = SetFormat("humangs-scores", 1)
"""Scores of an evaluation."""
LOOK = 1 << 16
"""Bytes at the beginning of each file of a data set that `files_key` looks at."""


def read_manifest(folder: Path, kind: SetFormat) -> dict[str, Any]:
    """The manifest of a set. Raises: CaptureError if there is none of this kind."""
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
    """Start a set in a folder, or check that the one that is there can be gone on with.

    Arguments: made_with: what all of it is made with; `SETTINGS` in it is a dictionary. alone: a
    new set needs an empty folder.
    Raises: CaptureError for a set that was made with something else; ValueError.
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
    """A checksum of the names below `root`, the sizes and the first `LOOK` bytes of files; some may
    be missing.

    It tells data sets apart without reading all of their photos.
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
    """Written aside, then renamed, so that it is never half there. found: what is in the set.

    Returns its content.
    """
    content = {**kind._asdict(), **made_with, **found}
    write_json(folder / MANIFEST, content)
    return content


def finished(folder: Path, mark: str) -> list[str]:
    """Names of the folders that hold the file `mark`, which is written with all of them at once."""
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
    """Yields (name, None or what is wrong with it) of tasks by name, as they end; an OSError ends
    all: the disk may be full.

    Arguments: work: called as work(what `load` has made, *arguments of the task). workers:
    processes, which use the CPU; `load` is called once in each. All of it is pickled, and the
    calling script is guarded by `if __name__ == "__main__"`.
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
