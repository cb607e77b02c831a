"""Options that several commands share, checks of options, and parsing of their values.

Checks raise an error of one line that names the option.

Places of results are checked before the work begins, and before anything heavy is imported. All
commands have the same rules. A single file that exists is replaced as a whole, once the work is
done. The file of an avatar replaces only an avatar, and no command replaces a file that it reads.
The folder of a capture is replaced only with --overwrite, or by `start` if its earlier run has not
finished. Commands such as `demo`, `detect`, `render`, `synth` and `train` add files to their
folders.
"""

import dataclasses
import functools
import re
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from tyro.conf import Positional, arg

from humangs_jax.core.configuration import Range, at_least, check_range, marks_in
from humangs_jax.core.processes import usable_cores
from humangs_jax.core.progress import say
from humangs_jax.core.registry import alternatives
from humangs_jax.refinement.config import ITERATIONS_ALONE, RefineConfig

if TYPE_CHECKING:
    from humangs_jax.apps.settings import Settings
    from humangs_jax.body.motion import Motion
    from humangs_jax.core.array_types import Array

Side = Annotated[int, Range(16, 8192)]
"""Side of an image, pixels. The largest image takes a gigabyte while it is drawn."""
Workers = Annotated[int | None, at_least(1)]
Preset = Literal["realtime", "balanced", "quality", "best"]
"""Names of `humangs_jax.PRESETS`."""


class UsageError(ValueError):
    """Says what is wrong with a command line, and names the option. The exit code is 2."""


def option_of(argument: str) -> str:
    """Returns the option for an argument of the library: "frame_ms" is --frame-ms.

    The argument "path" is --out.
    """
    if argument == "path":
        return "--out"
    return f"--{argument.replace('_', '-')}"


@dataclasses.dataclass(frozen=True)
class PartOfMotion:
    """Options that say which part of the file of --motion is played, and how."""

    motion_fps: Annotated[float | None, Range(0.01, 1000.0)] = None
    """Frames per second of the motion, in place of those in its file. Default: its file's."""
    motion_up: Literal["y", "-y", "z", "-z", "x", "-x"] | None = None
    """The axis that points up in the motion's world, like --motion-up=z.

    Default: the axis that the file names, or along which people stand.
    """
    person: int | None = None
    """Number of the person, in a motion of several people."""
    clip: str | None = None
    """Name or number of the animation, if a .glb has several. Default: the first."""

    def options(self, path: Path | None) -> tuple[str | Path, ...]:
        """Returns the words with which another command plays the same motion.

        path: file of the motion. None: there are no words.
        """
        if path is None:
            return ()
        words: list[str | Path] = ["--motion", path]
        for name, value in self.given().items():
            if str(value).startswith("-"):  # would be taken for an option
                words.append(f"{option_of(name)}={value}")
            else:
                words += [option_of(name), str(value)]
        return tuple(words)

    def given(self) -> dict[str, Any]:
        """Returns the fields that are not None, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def check(self, path: Path | None) -> None:
        """Raises UsageError for options without a file."""
        given = self.given()
        if path is None and given:
            raise UsageError(f"{option_of(next(iter(given)))}: expected --motion with it")

    def load(self, path: Path | None, rest_joints: "Array | None" = None) -> "Motion":
        """Reads the motion of a file, or the shipped walk if `path` is None.

        Raises: UsageError for options without a file; as `load_motion`.
        """
        from humangs_jax.motion import load_motion

        self.check(path)
        up = self.motion_up or "auto"
        return load_motion(
            path,
            up=up,
            fps=self.motion_fps,
            person=self.person,
            clip=self.clip,
            rest_joints=rest_joints,
        )


WHOLE = PartOfMotion()


@dataclasses.dataclass(frozen=True)
class OutputPath:
    """Annotation of an option that names a place for results.

    Without suffixes the place is a folder, which is made if it does not exist.
    """

    suffixes: tuple[str, ...] = ()
    """Suffixes that the file may have; empty for a folder."""
    folder: bool = False
    """Whether a name without suffix is a folder."""
    avatar: bool = False
    """Whether an existing file may be replaced only if it is an avatar."""


AVATAR = OutputPath((".npz",), avatar=True)


def off(what: str) -> Any:
    """Returns the annotation of a switch that is on by default.

    `--help` then shows what --no-SWITCH does: "Do not" and the words of `what`.
    """
    return arg(help=f"Do not {what}.")


@functools.cache
def described(command: type[Any]) -> type[Any]:
    """Annotates the options of a command for --help, and returns the command's dataclass.

    Positional arguments are shown by name, and defaults that are None are not shown. tyro alone
    shows `PATH` for every positional argument, `{None}|PATH`, and `(default: None)`.
    """
    for field, hint, kind, positional in _options(command):
        if dataclasses.is_dataclass(kind):
            described(kind)
            continue
        shown = _value_shown(kind)
        if positional and get_origin(kind) is not Literal:
            name = field.name.upper()
            shown = name
            if field.default is not dataclasses.MISSING:
                shown = f"[{name}]"
        quiet = field.default in (None, ()) or kind is bool
        seen = arg(metavar=shown, help_behavior_hint="" if quiet else None)
        command.__annotations__[field.name] = Annotated[hint, seen]
    return command


def option_names(command: type[Any]) -> set[str]:
    """Returns the options of a command as they are typed.

    A switch that is on by default has only its --no- form.
    """
    names = set()
    for field, _, kind, positional in _options(command):
        if dataclasses.is_dataclass(kind):
            names |= option_names(kind)
        elif not positional:
            names.add(option_of(f"no_{field.name}" if field.default is True else field.name))
    return names


def _options(command: type[Any]) -> Iterator[tuple[dataclasses.Field, Any, Any, bool]]:
    """Yields each field, its annotation, the annotated type, and whether it is positional."""
    hints = get_type_hints(command, include_extras=True)
    for field in dataclasses.fields(command):
        hint = hints[field.name]
        if get_origin(hint) is Annotated:
            kind = get_args(hint)[0]
        else:
            kind = hint
        yield field, hint, kind, Positional in getattr(hint, "__metadata__", ())


def fields_of(command: type[Any]) -> Iterator[tuple[dataclasses.Field, Any]]:
    """Yields each field of a command and of its groups of options, with the annotation."""
    for field, hint, kind, _ in _options(command):
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            yield from fields_of(kind)
        else:
            yield field, hint


def types_in(kind: Any) -> list[Any]:
    """Returns the types inside of an annotation, a union or a tuple. For any other type it returns
    this type.
    """
    if get_origin(kind) is Annotated:
        return types_in(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType, tuple):
        return [part for each in get_args(kind) for part in types_in(each)]
    return [kind]


def _value_shown(kind: Any) -> str | None:
    """Returns the text by which --help shows the values of a type. The text does not list None.
    Returns None where tyro's own text is used.
    """
    if get_origin(kind) is tuple:
        return None
    names = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}
    shown = []
    for part in types_in(kind):
        if get_origin(part) is Literal:
            shown.append("{" + ",".join(map(str, get_args(part))) + "}")
        elif part in names:
            shown.append(names[part])
        elif part is not type(None):
            return None
    return "|".join(shown)


def check_options(command: Any) -> None:
    """Checks that options are in the ranges of their annotations, and that outputs can be written.

    Raises: UsageError if an option is out of its range, or if an output cannot be written.
    """
    cls = type(command)
    hints = {
        name: hint
        for name, hint in get_type_hints(cls, include_extras=True).items()
        if hasattr(command, name)
    }
    places = {name: place for name, hint in hints.items() for place in marks_in(hint, OutputPath)}
    read = [getattr(command, name) for name in hints if name not in places]
    for name in hints:
        value = getattr(command, name)
        if dataclasses.is_dataclass(value):
            check_options(value)
            continue
        try:
            check_range(cls, name, value, option_of(name))
        except ValueError as error:
            raise UsageError(str(error)) from None
    for name, place in places.items():
        path = getattr(command, name)
        if path is not None:
            require_place(
                path, option_of(name), place, [each for each in read if isinstance(each, Path)]
            )


def require_place(path: Path, option: str, place: OutputPath, read: Iterable[Path] = ()) -> None:
    """Checks that results of a kind can be written to a path.

    read: files and folders that the command reads.

    Raises: UsageError if they cannot.
    """
    if not place.suffixes or (place.folder and not path.suffix):
        require_folder(path, option)
        return
    require_file(path, place.suffixes, option, read)
    if place.avatar and path.exists():
        try:
            with zipfile.ZipFile(path) as archive:
                mine = {"header.npy", "skinning_weights.npy"} <= set(archive.namelist())
        except PermissionError:
            raise UsageError(
                f"{option} {path}: exists, and there is no permission to read it"
            ) from None
        except (zipfile.BadZipFile, OSError):
            mine = False
        if not mine:
            raise UsageError(f"{option} {path}: exists and is no avatar: expected another name")


def require_file(
    path: Path, suffixes: tuple[str, ...], option: str = "--out", read: Iterable[Path | None] = ()
) -> None:
    """Checks that a file with one of the suffixes can be written to a path.

    Its folder need not exist. read: files that the command reads.

    Raises: UsageError if it cannot.
    """
    if path.suffix.lower() not in suffixes:
        raise UsageError(f"{option} {path}: expected a name ending in {alternatives(suffixes)}")
    if path.is_dir():
        raise UsageError(f"{option} {path}: is a folder: expected the name of a file")
    above = next(parent for parent in path.absolute().parents if parent.exists())
    if not above.is_dir():
        inside = next(parent for parent in path.parents if parent.absolute() == above)
        raise UsageError(f"{option} {path}: {inside} is no folder")
    if path.exists() and not path.is_file():
        raise UsageError(f"{option} {path}: is no regular file: expected the name of a file")
    for each in read:
        if each is not None and path.exists() and each.exists() and path.samefile(each):
            raise UsageError(f"{option} {path}: is read by this command: expected another name")
    _require_writable(path, option)


def require_folder(path: Path, option: str = "--out") -> None:
    """Checks that files can be written into a folder, which need not exist.

    Raises: UsageError if they cannot.
    """
    if path.exists() and not path.is_dir():
        raise UsageError(f"{option} {path}: is a file: expected the name of a folder")
    _require_writable(path, option)


def require_replaceable(
    folder: Path, overwrite: bool, mark: str, inputs: Iterable[Path | None] = ()
) -> None:
    """Checks that a folder can be made at a path, or replaced with --overwrite.

    mark: name of a file that all folders of this kind have. inputs: what the command reads.

    Raises: UsageError if it cannot.
    """
    from humangs_jax.io.atomic import check_replaceable, remove_abandoned_lock

    require_folder(folder)
    try:
        check_replaceable(folder, overwrite, mark, inputs)
    except ValueError as error:
        remove_abandoned_lock(folder)  # a killed run may have left it after its last file
        raise UsageError(f"--out {error}") from error


def _require_writable(path: Path, option: str) -> None:
    from humangs_jax.io.atomic import check_writable

    try:
        check_writable(path)
    except OSError as error:
        raise UsageError(f"{option} {error}") from error


def tell_deleted(folder: Path, unless: Path | None = None) -> None:
    """Shows what --overwrite will delete in a folder that is going to be replaced, even with
    --quiet.

    Shows nothing if the folder is empty, or if it is the folder `unless`.
    """
    from humangs_jax.io.atomic import contents

    if unless is not None and folder.resolve() == unless.resolve():
        return
    found = contents(folder)
    if found:
        say(f"--overwrite: once the work is done, {folder} is replaced; this is deleted: {found}")


def refine_limits(text: str) -> dict[str, Any]:
    """Parses --refine into fields of `RefineConfig`.

    text: seconds, as in "15s" or "15", or steps, as in "100steps". A number of steps above 0 means
    no steps on the head. "0steps" means iterations and steps on the head only.

    Raises: UsageError for another text.
    """
    match = re.fullmatch(r"(?P<number>\d+(\.\d*)?)(?P<unit>s|steps)?", text.strip())
    number = float(match["number"]) if match else 0.0
    in_steps = match is not None and match["unit"] == "steps"
    if not (number > 0 or in_steps) or (in_steps and number != int(number)):
        raise UsageError(
            f'--refine {text!r}: expected how long to refine, as in "15s" or "100steps"'
        )
    if in_steps and number:  # the head is sharpened only without other steps, as with seconds
        return {"steps": int(number), "seconds": None, "head_steps": 0}
    if in_steps:
        return {"steps": 0, "seconds": None}
    return {"steps": None, "seconds": number}


def first_refinement(text: str | None) -> RefineConfig | None:
    """Parses --refine of a new avatar, as `refine_limits` does.

    Returns None for "0", which means no refinement. Without --refine, returns `ITERATIONS_ALONE`.

    Raises: UsageError, see `refine_limits`; ValueError for a number that is out of range.
    """
    if text is None:
        return ITERATIONS_ALONE
    if text == "0":
        return None
    return RefineConfig(**refine_limits(text))


def chosen_settings(preset: "Preset | None", config: Path | None) -> "Settings | None":
    """Returns the settings of --preset or of the file of --config; None without either.

    Raises: UsageError if both are given; FileNotFoundError if there is no such file; FileError if
    it is no file of settings.
    """
    if preset is not None and config is not None:
        raise UsageError(
            f"--config {config}: does not go with --preset {preset}: expected one of them"
        )
    if preset is not None:
        from humangs_jax.apps.settings import PRESETS

        return PRESETS[preset]
    if config is not None:
        from humangs_jax.apps.settings import load_settings

        return load_settings(config)
    return None


def shard_of(text: str) -> tuple[int, int]:
    """Parses "I/N", part I of N parts, counted from 0, into (I, N). Raises: UsageError."""
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not int(match[1]) < int(match[2]):
        raise UsageError(f"--shard {text}: expected I/N with I from 0 to N - 1, as in 0/8")
    return int(match[1]), int(match[2])


def cores(workers: int | None) -> int:
    """Returns the number of processes: `workers`, or if None one for each core that may be used."""
    return usable_cores() if workers is None else workers
