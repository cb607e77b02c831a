"""Reads files that nobody trusts, with one set of limits and one error line for every kind of
damage. See docs/security.md.

Readers open files through `open_file` or `read_bytes` and work inside `reading`:

    with reading(path, "npz archive"):
        ...

Any error inside becomes a `FileError` of one line that names the file: `me.npz: not a readable npz
archive: ...`. A helper that does not know the file raises `InvalidFileError`. Its text is not
changed, and follows the name of the file.
"""

import contextlib
import dataclasses
import json
import logging
import math
import numbers
import os
import re
import reprlib
import stat
from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from humangs_jax.core.configuration import ArgumentError, config_from_json
from humangs_jax.core.progress import printable
from humangs_jax.io.atomic import write_text

logger = logging.getLogger(__name__)

ENVIRONMENT = "HUMANGS_LIMITS"
"""Environment variable that changes limits, such as "pixels=2e8,photos_outside=1"."""
OUTSIDE = f"{ENVIRONMENT}=photos_outside=1 allows it"
LONGEST_LINE = 1000
"""Largest number of characters of an error, because errors quote values of files."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits on what a file or a command may cost. Each error line that a limit causes names that
    limit.
    """

    file_bytes: int = 16 << 30
    """Bytes of any file."""
    text_bytes: int = 64 << 20
    """Bytes of JSON and other text, and of the pickle inside of a `.pt`."""
    slow_text_bytes: int = 1 << 19
    """Bytes of YAML, TOML, XML and `.mtl` files, of the JSON of a GLB file with Gaussians, and of
    the header of safetensors, which are slow to read.
    """
    mesh_bytes: int = 512 << 20
    """Bytes of a scan, of its textures together, of a GLB motion, or of a COLMAP file."""
    image_bytes: int = 256 << 20
    """Bytes of a photo before it is decoded."""
    array_bytes: int = 4 << 30
    """Unpacked bytes of all arrays of an archive, bytes of a pickle, an npy file, an HDF5 data set
    or a file of Gaussians, or bytes of an EXR file that is written.
    """
    plain_bytes: int = 256 << 20
    """Bytes to which a file of any size may unpack. Also bytes of a sparse matrix, or of the
    expressions of a face, as a full array.
    """
    ratio: int = 100
    """Largest unpacked size relative to the size of the file. It applies to unpacked sizes beyond
    `plain_bytes`.
    """
    members: int = 65_536
    """Entries of an archive."""
    opcodes: int = 4_000_000
    """Instructions of a pickle."""
    nesting: int = 64
    """Depth of lists and objects within each other in JSON, YAML and TOML."""
    pixels: int = 64_000_000
    """Pixels of a photo."""
    side: int = 32_768
    """Pixels of the longer side of a photo."""
    scans: int = 64
    """Passes of a progressive JPEG."""
    corners: int = 60_000_000
    """Corners of the triangles of a scan, every instance counted."""
    joints: int = 1024
    """Joints of a body or of a moving skeleton."""
    gaussians: int = 20_000_000
    """Gaussians of a file."""
    photos_outside: bool = False
    """1: photos and masks of a capture may lie outside of its folder."""
    capture_pixels: int = 1_000_000_000
    """Pixels of all photos that are read together (16 bytes each in memory), or of a scan's
    textures.
    """
    video_pixels: int = 50_000_000_000
    """Pixels of all frames that are taken out of videos."""
    views: int = 4096
    """Photos that are read together, or cameras of a file."""
    network_views: int = 512
    """Photos that the network looks at together."""
    views_per_photo: int = 16
    """Views of a capture, divided by the photos that they name."""
    frames: int = 250_000
    """Frames of a motion or a capture, read or written."""
    rate: int = 1000
    """Frames per second of a motion. The smallest rate is 0.01."""
    frames_per_photo: int = 100
    """Frames of a capture without poses, divided by its photos."""
    people: int = 100_000
    """People and images in keypoint files, counted together, or people in a motion file."""
    parts: int = 2000
    """Materials of an OBJ file, files of materials and textures that it names, or parts of the
    meshes in a GLB file.
    """
    entries: int = 1_000_000
    """Files and folders in a folder that is searched for photos or keypoints."""


_current: Limits | None = None


def limits() -> Limits:
    """Returns the limits in force. They are the limits that `set_limits` has set. If none were set,
    they are the default limits as changed by the environment variable HUMANGS_LIMITS.

    Raises: ValueError if the variable cannot be parsed.
    """
    global _current
    if _current is None:
        _current = _limits_of_text(os.environ.get(ENVIRONMENT, ""))
    return _current


def set_limits(new: Limits | None) -> None:
    """Sets the limits from now on. None restores the limits of the environment."""
    global _current
    _current = new


def _limits_of_text(text: str) -> Limits:
    """Returns the limits that a text such as "pixels=2e8,photos_outside=1" describes.

    Raises: ValueError.
    """
    changes: dict[str, Any] = {}
    kinds: dict[str, Any] = {
        field.name: type(field.default) for field in dataclasses.fields(Limits)
    }
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition("=")
        try:
            changes[name] = kinds[name](float(value))
        except (KeyError, ValueError, OverflowError):
            raise ValueError(
                f"{ENVIRONMENT}: {part!r}: expected NAME=NUMBER with one of {', '.join(kinds)}"
            ) from None
    return Limits(**changes)


# Errors
# --------------------------------------------------------------------------------------------------


class _Shown(reprlib.Repr):
    """Shows values as `repr` does, but shortened. So it can also show values that hold many other
    values, or themselves.
    """

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxdict, self.maxstring, self.maxother = 2, 4, 100, 100
        self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = self.maxdeque = (
            self.maxarray
        ) = 4

    def repr_int(self, x: int, level: int) -> str:
        """Shows integers of more than 40 digits by their size, because Python refuses to write
        integers of thousands of digits.
        """
        if abs(x) < 10**40:
            return repr(x)
        return f"an integer of {x.bit_length():,} bits"

    def repr_instance(self, x: object, level: int) -> str:
        """Shows texts as `repr` does, also texts of subclasses. Shows None and numbers as `str`
        does, also numpy's numbers. Shows any other object by the name of its type.
        """
        if isinstance(x, str):
            return self.repr_str(str(x), level)
        if x is None or isinstance(x, numbers.Number):  # numpy's `repr` also names the type
            return str(x)[: self.maxother]
        return f"a {type(x).__name__}"

    def repr_bool(self, x: object, level: int) -> str:
        """Shows booleans as `str` does. `reprlib` also calls this for numpy's booleans, because
        their type has the same name.
        """
        return str(x)


def shown(value: object) -> str:
    """Returns the beginning of a value of a file as text for an error line.

    This is safe for a list that contains itself or a million lists.
    """
    return _Shown().repr(value)


LARGEST_AMOUNT = 10**15
"""Largest amount that is written out in errors."""


def _one_line(text: object, longest: int = LONGEST_LINE) -> str:
    """Returns a text as one printable line, cut after `longest` characters."""
    line = printable(" ".join(str(text).split()))
    if len(line) <= longest:
        return line
    return f"{line[:longest]} ..."


class FileError(ValueError):
    """An error of one line about a file: file, field, and the problem. Empty parts are left out."""

    def __init__(self, file: object, field: str, problem: object):
        parts = [str(part) for part in (file, field, problem) if part]
        super().__init__(_one_line(": ".join(parts)))


def is_unread(error: BaseException) -> bool:
    """Says whether an error of `reading` means that a file could not be read because of its
    permissions. Nothing is known about the content of such a file.
    """
    return isinstance(error.__cause__, PermissionError)


class InvalidFileError(ValueError):
    """An error about the file that is being read, raised by functions that do not know its name."""


@contextlib.contextmanager
def reading(path: object, kind: str, raises: type[FileError] = FileError) -> Generator[None]:
    """Turns any error inside the block into an error of one line that names the file.

    Arguments: path: the file, for the message. kind: what the file should be, as in "npz archive".
    raises: the class of the error.
    Raises: `raises`; FileNotFoundError for a missing file if `raises` is FileError; ArgumentError,
    which stays as it is.
    """
    try:
        yield
    except (raises, ArgumentError):
        raise
    except FileError as error:  # names its file already
        raise raises("", "", error) from error
    except FileNotFoundError as error:
        missing = f"{error.filename or path}: no such file"
        if raises is FileError:
            raise FileNotFoundError(missing) from error
        raise raises("", "", missing) from error
    except InvalidFileError as error:
        raise raises(path, "", _LEFT_OUT if _is_pointer(path) else error) from error
    except PermissionError as error:
        raise raises(error.filename or path, "", "no permission to read it") from error
    except Exception as error:  # readers of damaged files raise some twenty types
        if str(path) and str(error).startswith(f"{path}: "):
            raise raises("", "", str(error)) from error
        why = _LEFT_OUT if _is_pointer(path) else _why(kind, error)
        raise raises(path, "", why) from error


_POINTER = b"version https://git-lfs.github.com/spec/"
"""Beginning of the text that Git LFS leaves in place of a large file."""
_LEFT_OUT = "not the file itself but its pointer of Git LFS: `git lfs pull` fetches the file"


def _is_pointer(path: object) -> bool:
    """Says whether a file is a pointer of Git LFS. False if it cannot be read."""
    try:
        file = Path(str(path))
        if not file.is_file():
            return False
        with file.open("rb") as opened:
            return opened.read(len(_POINTER)) == _POINTER
    except (OSError, ValueError):
        return False


def _why(kind: str, error: Exception) -> str:
    """Returns one line that says why a reader failed."""
    if isinstance(error, MemoryError):
        reason = "out of memory"
    elif isinstance(error, RecursionError):
        reason = "nested too deeply"
    elif isinstance(error, OSError):
        reason = error.strerror or str(error) or type(error).__name__
    else:
        says_little = isinstance(
            error, LookupError | AssertionError | AttributeError | TypeError
        ) or not str(error)
        if says_little:
            reason = f"{type(error).__name__} {error}"
        else:
            reason = str(error)
    return f"not a readable {kind}: {_one_line(reason, longest=300)}"


def check_limit(name: str, amount: float | int, unit: str) -> None:
    """Checks an amount against a limit. name: field of `Limits`. unit: what is counted, for the
    error.

    Raises: InvalidFileError if the amount is larger. The error names the limit. For an amount of at
    most `LARGEST_AMOUNT` it also says how to raise the limit.
    """
    most = getattr(limits(), name)
    if amount > most:
        raised, found = "", f"more than {LARGEST_AMOUNT:,}"
        if amount <= LARGEST_AMOUNT:
            raised = f"{ENVIRONMENT}={name}={math.ceil(amount)} raises it; "
            found = f"{math.ceil(amount):,}"
        raise InvalidFileError(
            f"{found} {unit}: the limit {name} is {most:,} ({raised}docs/security.md)"
        )


# Opening
# --------------------------------------------------------------------------------------------------


def open_file(path: str | os.PathLike[str], limit: str = "file_bytes") -> BinaryIO:
    """Opens a regular file whose size is within a limit. Devices and pipes are refused, because
    they have no end.

    Raises: OSError; InvalidFileError.
    """
    status = os.stat(path)
    if stat.S_ISDIR(status.st_mode):
        raise InvalidFileError("is a folder: expected a file")
    if not stat.S_ISREG(status.st_mode):
        raise InvalidFileError("is no regular file")
    check_limit(limit, status.st_size, "bytes")
    return open(path, "rb")


def read_bytes(path: str | os.PathLike[str], limit: str = "file_bytes") -> bytes:
    """Returns the bytes of a file. Raises: as `open_file`."""
    with open_file(path, limit) as file:
        return file.read()


def walk(
    folder: str | os.PathLike[str], skip: Callable[[Path], bool] = lambda folder: False
) -> Generator[Path]:
    """Yields the files of a folder and of its subfolders, except names that begin with a dot and
    folders that `skip` accepts.

    Each folder is searched once, however many links lead to it. Links to folders outside of the
    folder are not followed, unless the limit `photos_outside` allows it; the first such link is
    logged. Links to files are yielded, wherever they lead.

    Raises: InvalidFileError beyond the limit `entries`; OSError.
    """
    # what links lead to comes last: a folder is found at its proper place
    seen: set[tuple[int, int]] = set()
    waiting, links, count, warned = [Path(folder)], [], 0, False
    while waiting or links:
        place = waiting.pop() if waiting else links.pop()
        status = place.stat()
        if (status.st_dev, status.st_ino) in seen:
            continue
        seen.add((status.st_dev, status.st_ino))
        # files are given at once, folders are looked at later
        with os.scandir(place) as entries:
            for entry in entries:
                count += 1
                check_limit("entries", count, "files and folders")
                path = place / entry.name
                if entry.name.startswith("."):
                    continue
                if not path.is_dir():
                    yield path
                    continue
                if skip(path):
                    continue
                if not entry.is_symlink():
                    waiting.append(path)
                    continue
                root = Path(folder).resolve()
                if limits().photos_outside or path.resolve().is_relative_to(root):
                    links.append(path)
                elif not warned:
                    warned = True
                    logger.warning("%s: leads out of %s: not followed (%s)", path, folder, OUTSIDE)


def visible(paths: Iterable[Path]) -> list[Path]:
    """Returns the paths whose names do not begin with a dot. Files of macOS (`._NAME`) and files
    that are still being written have such names.
    """
    return [path for path in paths if not path.name.startswith(".")]


def check_unpacked(size: int, unpacked: int) -> None:
    """Checks that a file of `size` bytes may become `unpacked` bytes in memory.

    Raises: InvalidFileError, which names the limit.
    """
    most = limits()
    check_limit("array_bytes", unpacked, "bytes unpacked")
    if unpacked > max(most.plain_bytes, most.ratio * size):
        raise InvalidFileError(
            f"{size:,} bytes unpack to {unpacked:,}: the limits plain_bytes {most.plain_bytes:,}"
            f" and ratio {most.ratio} (docs/security.md)"
        )


def inside(folder: str | os.PathLike[str], name: str, photo: bool = False) -> Path:
    """Returns the path `folder / name`, after checking that it lies in the folder when symbolic
    links are followed.

    Arguments: name: a path that comes from a file in the folder. photo: whether the path leads to a
    photo or mask. The limit `photos_outside` lets photos and masks lie elsewhere.
    Raises: InvalidFileError, also for a name with control characters.
    """
    path = Path(folder) / name
    # control characters would make several lines, or none, of a path in a report
    if re.search(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]", str(name)):
        raise InvalidFileError(f"{name!r} is no path: expected one without control characters")
    if photo and limits().photos_outside:
        return path
    try:
        contained = path.resolve().is_relative_to(Path(folder).resolve())
    except (
        OSError,
        ValueError,
        RuntimeError,
    ) as error:  # too long, a null character, a loop of links
        raise InvalidFileError(f"{name!r} is no path: {error}") from error
    if not contained:
        how = f" ({OUTSIDE})" if photo else ""
        raise InvalidFileError(
            f"{name!r} lies outside of {folder}: expected a path in that folder{how}"
        )
    return path


T = TypeVar("T")


def read_text(path: str | os.PathLike[str], limit: str = "text_bytes") -> str:
    """Returns the text of a file in UTF-8, with or without a byte order mark.

    Raises: FileNotFoundError; FileError if the file cannot be read, is too large or is not text.
    """
    with reading(path, "text file in UTF-8"):
        return read_bytes(path, limit).decode("utf-8-sig")


def parse_json(text: str) -> Any:
    """Returns the value of a JSON text. NaN and Infinity, which Python's tools write, are accepted.

    Raises: InvalidFileError (a ValueError) if the text is not JSON, is nested too deeply, or has an
    integer of thousands of digits. If the text is not JSON, the error names the line.
    """
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        raise InvalidFileError(f"line {error.lineno}: not valid JSON: {error.msg}") from error
    except RecursionError as error:
        raise InvalidFileError("not usable JSON: nested too deeply") from error
    except ValueError as error:  # an integer of thousands of digits
        raise InvalidFileError(f"not usable JSON: {error}") from error
    check_nesting(value)
    return value


def check_nesting(value: Any) -> None:
    """Checks that lists and dicts lie within each other no deeper than the limit `nesting` allows.

    Raises: InvalidFileError.
    """
    level = [[value]]
    for _ in range(limits().nesting + 1):
        contents = (each.values() if isinstance(each, dict) else each for each in level)
        level = [item for items in contents for item in items if isinstance(item, list | dict)]
        if not level:
            return
    raise InvalidFileError(
        f"not usable: nested too deeply, the limit nesting is {limits().nesting} (docs/security.md)"
    )


def read_configuration(cls: type[T], path: str | os.PathLike[str]) -> T:
    """Returns the configuration of class `cls` in a JSON file, see `core.configuration`.

    Raises: FileNotFoundError; FileError.
    """
    with reading(path, "configuration"):
        try:
            return config_from_json(cls, read_text(path))
        except ValueError as error:
            raise InvalidFileError(str(error)) from error


def write_json(path: str | os.PathLike[str], value: Any, indent: int | None = 1) -> None:
    """Writes a value to a JSON file. If writing fails, the path stays as it was.

    Raises: TypeError if JSON cannot hold the value; ValueError if the value holds itself; OSError.
    """
    write_text(path, json_text(value, indent))


def json_text(value: Any, indent: int | None = 1) -> str:
    """Returns the text that `write_json` writes. Raises: TypeError if JSON cannot hold the value;
    ValueError if the value holds itself.
    """
    return json.dumps(value, indent=indent) + "\n"


def read_json(path: str | os.PathLike[str]) -> Any:
    """Returns the value in a JSON file.

    Raises: FileNotFoundError; FileError, which names the file, and the line if it is not JSON.
    """
    with reading(path, "JSON file"):
        return parse_json(read_text(path))
