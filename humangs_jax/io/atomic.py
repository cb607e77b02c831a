"""Writes files and folders so that no unfinished one appears under its name.

Files and folders are written under a temporary name in the same folder, then renamed.

Temporary names are unique, so several processes may write at once. When a process was killed, a
later process that writes to the same place removes the temporary files of the killed process. It
also puts back old files and folders that the killed process had already moved aside.
"""

import contextlib
import errno
import functools
import os
import platform
import re
import shutil
import tempfile
import time
import uuid
import zlib
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path

from humangs_jax.core.processes import undisturbed

MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"
ABANDONED_SECONDS = 24 * 3600.0
"""A temporary file or folder counts as abandoned after so many seconds without a change, if it is
not known whether its process still runs. On a shared disk, another machine may be writing it.
"""
MOVE_AWAY = "move it away, or choose another folder"
"""Advice in errors about a file that has the name of an output and that humangs did not write."""
_TEMPORARY = re.compile(
    r"\.(?P<name>.+)\.(?P<kind>new|old)-(?P<machine>[0-9a-f]{8})-(?P<pid>\d+)-[0-9a-f]{8}(\.[^.]*)?"
)


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Writes bytes to a file. If writing fails, the path stays as it was. Raises: OSError."""
    replace_file(path, lambda temporary: temporary.write_bytes(data))


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Writes text to a file in UTF-8. If writing fails, the path stays as it was. Bytes of file
    names that Python could not decode (surrogateescape) are written unchanged.

    Raises: OSError.
    """
    write_bytes(path, _encoded(text))


def _encoded(text: str) -> bytes:
    """Returns a text in UTF-8, as `write_text` writes it. Lone surrogates that stand for bytes
    (surrogateescape) become these bytes. If the text has another lone surrogate, all lone
    surrogates are written as escapes.
    """
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        return text.encode("utf-8", "backslashreplace")


def write_texts(texts: Mapping[str | os.PathLike[str], str]) -> None:
    """Writes texts to files in UTF-8, see `replace_files`. Raises: OSError."""
    replace_files(
        {
            path: functools.partial(Path.write_bytes, data=_encoded(text))
            for path, text in texts.items()
        }
    )


def replace_file(path: str | os.PathLike[str], write: Callable[[Path], object]) -> None:
    """Writes one file: write(temporary) makes the file, which is then renamed to `path`. If writing
    fails, the path stays as it was. See `replace_files`.
    """
    replace_files({path: write})


def replace_files(writers: Mapping[str | os.PathLike[str], Callable[[Path], object]]) -> None:
    """Calls write(temporary) for each path, which makes that file, then renames all files to their
    paths.

    Files are renamed only after all of them are written, so none appears if one cannot be written.
    If one cannot be renamed, the files renamed before it are put back as they were. A temporary
    name has the suffix of its path. Folders that do not exist are made.

    Raises: OSError, which names the path, if a file cannot be written or renamed; anything that
    `write` raises.
    """
    temporaries: dict[Path, Path] = {}
    with contextlib.ExitStack() as unfinished:
        for path, write in ((Path(path), write) for path, write in writers.items()):
            unfinished.enter_context(_made_folder(path.parent))
            _sweep(path.parent.resolve())
            temporaries[path] = temporary = path.with_name(
                f".{path.stem}.new-{_tag()}{path.suffix}"
            )
            unfinished.enter_context(_unfinished(temporary))
            with _naming(path, temporary):
                write(temporary)
        with undisturbed():
            _move_all(temporaries)


def _move_all(sources: Mapping[Path, Path | None], beside: Path | None = None) -> None:
    """Renames the source of each path to the path, in order, or deletes the path if its source is
    None. If one of them fails, the paths changed before it are put back as they were.

    Arguments: beside: the folder in which old files are kept until the end. None: each is kept
    where it lies.
    Raises: OSError, which names the path. If a path is a folder, the error comes before anything is
    changed.
    """
    for path in sources:
        if path.is_dir() and not path.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    final = list(sources)[-1:]  # nothing fails after it
    kept: dict[Path, Path] = {}
    changed: list[Path] = []
    try:
        for path, source in sources.items():
            if path not in final and os.path.lexists(path):
                kept[path] = (beside or path.parent) / f".{path.name}.old-{_tag()}"
                with _naming(path, kept[path]):
                    _keep(path, kept[path])
            if source is None:
                path.unlink(missing_ok=True)
            else:
                with _naming(path, source):
                    source.replace(path)
            changed.append(path)
    except OSError:
        for path in reversed(changed):
            old = kept.pop(path, None)
            with contextlib.suppress(OSError):
                if old is None:
                    path.unlink(missing_ok=True)
                else:
                    old.replace(path)
        raise
    finally:
        for old in kept.values():
            _remove(old)


def _keep(path: Path, second: Path) -> None:
    """Gives a file a second name, or copies it where a disk has no hard links."""
    try:
        os.link(path, second, follow_symlinks=False)
    except (OSError, NotImplementedError):
        shutil.copy2(path, second, follow_symlinks=False)


@contextlib.contextmanager
def _made_folder(folder: Path) -> Generator[None]:
    """Makes a folder and its parents, and removes the new ones again if the block raises and they
    are empty.
    """
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise NotADirectoryError(f"{folder}: is no folder, or lies in a file") from error
    try:
        yield
    except BaseException:
        for each in new:  # the innermost first
            with contextlib.suppress(OSError):
                each.rmdir()
        raise


def replace_folder(
    folder: str | os.PathLike[str], write: Callable[[Path], object], *, mark: str
) -> None:
    """Calls write(temporary), which makes that folder, and renames it to `folder`. An existing
    folder is replaced.

    The existing folder is moved aside first and deleted last, so it is not lost if the new one
    cannot be put in its place. Parents are made.

    Arguments: mark: a file that all folders of this kind hold. A filled folder without that file is
    not replaced.
    Raises: ValueError, see `check_replaceable`; OSError, which names `folder`, if the folder cannot
    be written; anything that `write` raises.
    """
    folder = Path(folder)
    check_replaceable(folder, mark=mark)
    folder.parent.mkdir(parents=True, exist_ok=True)
    _sweep(folder.parent.resolve())
    tag = _tag()
    temporary, aside = (folder.with_name(f".{folder.name}.{kind}-{tag}") for kind in ("new", "old"))
    with _naming(folder, temporary), _unfinished(temporary):
        write(temporary)
        with undisturbed():
            _exchange(folder, temporary, aside)
            shutil.rmtree(aside, ignore_errors=True)


_being_written: set[Path] = set()


@contextlib.contextmanager
def _unfinished(temporary: Path) -> Generator[None]:
    """Removes a temporary file or folder after the block if it still exists. Whoever ends the
    process during the block calls `remove_unfinished`, which removes it, too.
    """
    _being_written.add(temporary.absolute())
    try:
        yield
    finally:
        _being_written.discard(temporary.absolute())
        _remove(temporary)


def _remove(path: Path) -> None:
    """Removes a file or a folder, and ignores errors, so that an error of the write is raised
    instead.
    """
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def remove_unfinished() -> None:
    """Removes the temporary files and folders that this process is still writing. Call it just
    before the process is ended.

    Finished files are not touched.
    """
    for temporary in tuple(_being_written):
        _remove(temporary)


def _exchange(folder: Path, temporary: Path, aside: Path) -> None:
    """Renames `folder` to `aside` and `temporary` to `folder`.

    If another process has put a folder there in the meantime, that folder is replaced, too.
    """
    while True:
        with contextlib.suppress(FileNotFoundError):
            folder.rename(aside)
        try:
            temporary.rename(folder)
            return
        except BaseException as error:
            if isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                shutil.rmtree(aside, ignore_errors=True)  # replaced by the other process
                continue
            with contextlib.suppress(OSError):
                aside.rename(folder)
            raise


def check_replaceable(
    folder: str | os.PathLike[str],
    overwrite: bool = True,
    mark: str | None = None,
    inputs: Iterable[str | os.PathLike[str] | None] = (),
) -> None:
    """Checks that a folder can be replaced. Call it before the work begins.

    Arguments: mark: a file that all folders of this kind hold. A folder that is not empty can be
    replaced only if it holds this file and `overwrite` is True. Without a mark it may hold
    anything. inputs: paths that the work reads. They may not lie in the folder, because they would
    be deleted. Paths of None are ignored.
    Raises: ValueError if the content of the folder or an input forbids to replace it. Also if the
    path is a symbolic link, a file, a mount point, the working folder or a folder that contains the
    working folder, or if the nearest existing folder above it cannot be written to.
    """
    # the place can be replaced
    folder = Path(folder)
    if folder.is_symlink():
        raise ValueError(f"{folder}: is a symbolic link: expected the folder itself")
    place = folder.resolve()
    above = next((parent for parent in place.parents if parent.exists()), place)
    for wrong, problem in (
        (folder.is_file(), "is a file: expected a folder name"),
        (
            Path.cwd().is_relative_to(place),
            "is the working folder or contains it: expected another folder",
        ),
        (
            os.path.ismount(folder),
            "is a mount point, which cannot be renamed: expected a folder in it",
        ),
        (
            not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)),
            f"cannot be made: {above} cannot be written to",
        ),
    ):
        if wrong:
            raise ValueError(f"{folder}: {problem}")
    # nothing that the work reads lies in it
    for path in (Path(path) for path in inputs if path is not None):
        # a loop of links ends `Path.resolve` with a RuntimeError
        if place.exists() and any(
            real.is_relative_to(place) for real in (Path(os.path.realpath(path)), path.absolute())
        ):
            raise ValueError(
                f"{folder}: {path} lies in it and would be deleted: expected another folder"
            )
    # what is in it is of this kind
    entries = _entries(folder)
    if mark is None or not entries:
        return
    if mark not in entries:
        raise ValueError(
            f"{folder}: the folder holds no {mark}: refusing to overwrite something else"
        )
    if not overwrite:
        problem = f"{folder}: the folder is not empty: choose another one or ask to overwrite it"
        raise ValueError(f"{problem}, which deletes {contents(folder)}")


def contents(folder: str | os.PathLike[str]) -> str:
    """Returns a short text that lists what a folder holds, such as "capture.json, images (60
    files)". It is empty if the folder holds nothing or does not exist.
    """
    entries, most = _entries(folder), 12
    shown = ", ".join(_described(Path(folder, entry)) for entry in entries[:most])
    if len(entries) > most:
        return f"{shown} and {len(entries) - most} more"
    return shown


def _described(entry: Path) -> str:
    """Returns the name of a folder's entry. The name of a folder is followed by its number of
    files.
    """
    if entry.is_symlink() or not entry.is_dir():
        return entry.name
    count = sum(len(files) for _, _, files in os.walk(entry))
    files = "file" if count == 1 else "files"
    return f"{entry.name} ({count} {files})"


def _entries(folder: str | os.PathLike[str]) -> list[str]:
    """Returns the sorted names of a folder's entries. The list is empty for a file, and if the
    folder does not exist, for example because another process is replacing it.
    """
    try:
        return sorted(os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return []


def add_files(
    folder: str | os.PathLike[str],
    write: Callable[[Path], object],
    *,
    without: Iterable[str | os.PathLike[str]] = (),
    invalid: Iterable[str | os.PathLike[str]] = (),
    last: str | os.PathLike[str] | None = None,
    first: str | os.PathLike[str] | None = None,
    ours: Callable[[Path], bool] | None = None,
) -> None:
    """Calls write(temporary folder), then moves the files in it to the same places in `folder`.
    Other files of `folder` stay.

    The folder is made if needed. Nothing is moved if `write` raises. If a file cannot be moved, the
    files moved or deleted before it are put back as they were. The moves follow each other without
    pause, so a kill seldom falls between two of them. A lock keeps the moves of two processes
    apart. The folder may be a mount point or the working folder.

    Arguments: paths of files are relative to `folder`. without: files that are out of date. If no
    new file replaces them, they are deleted after the last move. invalid: files that must never lie
    beside the new ones. They are deleted before the first move. last: the file that is moved last.
    If it was not there before, its presence shows that all others are in place. first: the file
    that is moved first. Its presence shows that the other files are ours. ours: says whether an
    existing file may be replaced or deleted; None: all may be. Files of `without` that are not ours
    stay.
    Raises: ValueError, see `check_ours`, if a file would be replaced or is in `invalid`, and is not
    ours; OSError, which names `folder` or the file, if a file cannot be written; anything that
    `write` raises.
    """
    folder = Path(folder)
    # in it where it exists: then on the same disk, even if others hold what is beside it
    inside = folder.is_dir()
    if inside:
        _sweep(folder.resolve())
    folder.parent.mkdir(parents=True, exist_ok=True)
    _sweep(folder.resolve().parent)  # also of one that was killed after it had made the folder
    beside = folder if inside else folder.parent
    temporary = beside / f".{folder.resolve().name}.new-{_tag()}"
    with _naming(folder, temporary), _unfinished(temporary):
        temporary.mkdir()
        write(temporary)
        with undisturbed():
            folder.mkdir(exist_ok=True)
            with _locked(folder, wait=True):
                # the files in the order in which they are moved
                files = (path for path in temporary.rglob("*") if path.is_file())
                new = sorted(path.relative_to(temporary) for path in files)
                if last is not None:
                    new.sort(key=lambda file: file == Path(last))
                if first is not None:
                    new.sort(key=lambda file: file != Path(first))
                invalid = [Path(file) for file in invalid]
                if ours is not None:
                    check_ours((folder / file for file in (*invalid, *new)), ours)
                    without = [file for file in without if ours(folder / file)]
                # what must not lie beside them goes first, what is out of date last
                moves: dict[Path, Path | None] = {folder / file: None for file in invalid}
                moves |= {folder / file: temporary / file for file in new}
                with contextlib.ExitStack() as made:
                    for parent in sorted({(folder / file).parent for file in new}):
                        made.enter_context(_made_folder(parent))
                    _move_all(moves, beside=temporary)
                for file in {Path(file) for file in without}.difference(new):
                    (folder / file).unlink(missing_ok=True)


def check_ours(
    files: Iterable[Path], ours: Callable[[Path], bool], advice: str = MOVE_AWAY
) -> None:
    """Checks that files can be written without losing what others wrote there. It can also be
    called before the work begins.

    Arguments: ours: says whether an existing file may be replaced. advice: what the user can do.
    Raises: ValueError, which names the first file that may not be replaced.
    """
    foreign = [file for file in files if file.exists() and not ours(file)]
    if foreign:
        more = ""
        if len(foreign) > 1:
            more = f" (and {len(foreign) - 1} more)"
        raise ValueError(f"{foreign[0]}{more}: exists, and was not written by humangs: {advice}")


@contextlib.contextmanager
def only_writer(folder: str | os.PathLike[str], *, replaced: bool = False) -> Generator[None]:
    """Keeps other processes out of a folder while this process writes to it. This works among
    processes that call `only_writer`.

    The lock ends with the process, even if the process is killed. Where there are no locks
    (Windows, some network disks), nothing is checked.

    Arguments: replaced: whether the work makes or replaces the folder. Then a file beside the
    folder is locked, and removed at the end.
    Raises: BlockingIOError, an OSError, if another process holds the folder; OSError, which names
    the folder, if the folder or the file beside it cannot be opened.
    """
    folder = Path(folder)
    if not replaced:
        with _locked(folder, wait=False):
            yield
        return
    lock = _lock_of(folder)
    lock.parent.mkdir(parents=True, exist_ok=True)
    with _locked(folder, wait=False, lock=lock), _unfinished(lock):
        yield


def remove_abandoned_lock(folder: str | os.PathLike[str]) -> None:
    """Removes the lock file that a killed process left beside a folder. A lock that a process holds
    stays.
    """
    lock = _lock_of(Path(folder))
    if not lock.is_file():
        return
    with contextlib.suppress(OSError), _locked(Path(folder), wait=False, lock=lock):
        _remove(lock)


def _lock_of(folder: Path) -> Path:
    """Returns the file beside a folder that `only_writer(replaced=True)` locks."""
    return folder.absolute().with_name(f".{folder.absolute().name}.lock")


@contextlib.contextmanager
def _locked(folder: Path, wait: bool, lock: Path | None = None) -> Generator[None]:
    """Holds the lock of a folder during the block.

    wait: whether to wait until another process releases the lock; False: raise BlockingIOError.
    lock: a file that is made and locked instead of the folder.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    create = os.O_CREAT if lock else 0
    with _naming(folder, lock or folder):
        descriptor = os.open(lock or folder, os.O_RDONLY | create)
    try:
        at_once = 0 if wait else fcntl.LOCK_NB
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | at_once)
        except BlockingIOError:
            raise BlockingIOError(
                f"{folder}: another process is writing here: expected another folder"
            ) from None
        except OSError:  # a disk without locks
            pass
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def _naming(path: Path, temporary: Path) -> Generator[None]:
    """Turns errors of a temporary file or folder, such as a full or read-only disk, into errors
    of `path`.
    """
    try:
        yield
    except OSError as error:
        name = error.filename and os.fsdecode(error.filename)
        if error.errno is not None and (name is None or Path(name).is_relative_to(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        if str(temporary) in str(error):  # a text that the writer made itself
            raise OSError(str(error).replace(str(temporary), str(path))) from error
        raise


def check_writable(path: str | os.PathLike[str]) -> None:
    """Checks that a file can be made, or a folder with its parents. Call it before the work begins.

    The check makes a temporary file, because permissions do not show whether a disk is full or
    read-only, or what a network disk allows.

    Raises: OSError, which names `path`.
    """
    path = Path(path)
    place = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    if place == path and not path.is_dir():
        place = place.parent
    try:
        tempfile.TemporaryFile(dir=place).close()
    except OSError as error:
        raise type(error)(f"{path}: cannot write to {place}: {error.strerror or error}") from error


def _tag() -> str:
    """Returns a part of a temporary name that is unique: machine, process id and random digits."""
    return f"{MACHINE}-{os.getpid()}-{uuid.uuid4().hex[:8]}"


@functools.cache
def _sweep(parent: Path) -> None:
    """Removes the temporary files and folders that killed processes left in a folder. An old file
    or folder that was kept aside is put back if its name is free, else removed.

    This is done once per process and folder, because folders may have very many files.
    """
    with contextlib.suppress(OSError):  # another process sweeps too, or the folder cannot be listed
        for entry in list(parent.iterdir()):
            found = _TEMPORARY.fullmatch(entry.name)
            if found is None or not _abandoned(entry, found["machine"], int(found["pid"])):
                continue
            original = parent / found["name"]
            if found["kind"] == "old" and not original.exists():
                entry.rename(original)  # the process was killed between its two renames
            else:
                _remove(entry)


def _abandoned(path: Path, machine: str, pid: int) -> bool:
    """Says whether a temporary file or folder counts as abandoned. False if it does not exist.

    On POSIX systems, a file of another process on this machine is abandoned once the process has
    ended. All other files are abandoned if nothing in them has changed for `ABANDONED_SECONDS`.
    This holds for files of other machines, and for files with the id of this process: before a
    container was restarted, another process may have had this id. On other systems it holds for all
    files.
    """
    if machine == MACHINE and pid != os.getpid() and os.name == "posix":
        return path.exists() and not _runs(pid)
    try:
        # writing a file does not change the time of the folders that it lies in
        last_change = max(each.lstat().st_mtime for each in (path, *path.rglob("*")))
    except FileNotFoundError:
        return False
    return time.time() - last_change > ABANDONED_SECONDS


def _runs(pid: int) -> bool:
    """Says whether a process with this id runs on this machine. Call it on POSIX systems only:
    elsewhere it would end the process.
    """
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        pass
    return True
