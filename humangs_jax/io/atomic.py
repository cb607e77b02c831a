"""Files and folders that appear whole or not at all: written under a temporary name beside their place, then renamed.

Temporary names are unique, so several processes may write at once. What a killed process left behind is removed when a
later process writes to the same place; an old folder that it had already moved aside is put back.
"""

import contextlib
import functools
import os
import platform
import re
import shutil
import time
import uuid
import zlib
from collections.abc import Callable
from pathlib import Path

MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"
ABANDONED_SECONDS = 24 * 3600.0
"""A temporary file of another machine (on a shared disk) is abandoned when it was not touched for this long."""
_TEMPORARY = re.compile(
    r"\.(?P<name>.+)\.(?P<kind>new|old)-(?P<machine>[0-9a-f]{8})-(?P<pid>\d+)-[0-9a-f]{8}(\.[^.]*)?"
)


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write a file. Raises: OSError."""
    replace_file(path, lambda temporary: temporary.write_bytes(data))


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a file in UTF-8. Raises: OSError."""
    write_bytes(path, text.encode())


def replace_file(path: str | os.PathLike, write: Callable[[Path], object]) -> None:
    """Calls write(temporary), which makes that file, and renames it to `path`. The temporary name has the same suffix.

    Raises: FileNotFoundError if the folder does not exist; whatever `write` raises.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path.parent}: no such folder")
    _sweep(path.parent.resolve())
    temporary = path.with_name(f".{path.stem}.new-{_tag()}{path.suffix}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def replace_folder(folder: str | os.PathLike, write: Callable[[Path], object]) -> None:
    """Calls write(temporary), which makes that folder, and renames it to `folder`; an existing one is replaced.

    The existing folder is moved aside first and deleted last, so its contents are never lost. Parents are made.

    Raises: ValueError, see `check_replaceable`; whatever `write` raises.
    """
    folder = Path(folder)
    check_replaceable(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    _sweep(folder.parent.resolve())
    tag = _tag()
    temporary, aside = (folder.with_name(f".{folder.name}.{kind}-{tag}") for kind in ("new", "old"))
    try:
        write(temporary)
        try:
            if folder.is_dir():
                folder.rename(aside)
            temporary.rename(folder)
        except BaseException:
            if aside.is_dir() and not folder.exists():
                aside.rename(folder)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    shutil.rmtree(aside, ignore_errors=True)


def check_replaceable(folder: str | os.PathLike, overwrite: bool = True, mark: str | None = None) -> None:
    """Raises: ValueError for what `replace_folder` refuses: a symbolic link, a file, the working folder or one above it.

    mark: a file that all folders of this kind hold. Then the folder has to be empty or, with `overwrite`, of this kind.
    """
    folder = Path(folder)
    if folder.is_symlink():
        raise ValueError(f"{folder}: is a symbolic link: expected the folder itself")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: is a file: expected a folder name")
    if Path.cwd().is_relative_to(folder.resolve()):
        raise ValueError(f"{folder}: is the working folder or contains it: expected another folder")
    if mark is None or not folder.is_dir() or not any(folder.iterdir()):
        return
    if not overwrite:
        raise ValueError(f"{folder}: the folder is not empty: choose another one or ask to overwrite it")
    if not (folder / mark).is_file():
        raise ValueError(f"{folder}: the folder holds no {mark}: refusing to overwrite something else")


def add_files(folder: str | os.PathLike, write: Callable[[Path], object]) -> None:
    """Calls write(temporary folder), then moves its files into `folder`, which is made if needed; other files there stay.

    Nothing is moved if `write` raises.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    _sweep(folder.parent.resolve())
    temporary = folder.resolve().with_name(f".{folder.resolve().name}.new-{_tag()}")
    temporary.mkdir()
    try:
        write(temporary)
        folder.mkdir(exist_ok=True)
        for file in temporary.iterdir():
            file.replace(folder / file.name)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _tag():
    return f"{MACHINE}-{os.getpid()}-{uuid.uuid4().hex[:8]}"


@functools.cache
def _sweep(parent: Path) -> None:
    """Remove what killed processes left in a folder. Once per process: folders may have very many files."""
    with contextlib.suppress(OSError):  # another process sweeps too, or the folder cannot be listed
        for entry in list(parent.iterdir()):
            found = _TEMPORARY.fullmatch(entry.name)
            if found is None or not _abandoned(entry, found["machine"], int(found["pid"])):
                continue
            if found["kind"] == "old" and not (original := parent / found["name"]).exists():
                entry.rename(original)  # the process was killed between its two renames
            elif entry.is_dir():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


def _abandoned(path, machine, pid):
    try:
        age = time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return False
    return age > ABANDONED_SECONDS or (machine == MACHINE and not _runs(pid))


def _runs(pid):
    if os.name != "posix":  # os.kill would end the process there
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return True
