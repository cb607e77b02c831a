"""Writes configurations (frozen dataclasses, nested) as JSON, reads them back, and checks them
against their annotations.

Numbers are annotated with their range. The range is checked whenever a configuration is made:

    @configuration
    class Fit:
        steps: Annotated[int, Range(1, 1000)] = 100

A class variable `renamed_fields` maps the names of fields in earlier files to the names of today.

A field annotated with a subclass of `Part` may hold an object of any class derived from that
subclass. The object's class must have the decorator `part`, or the configuration cannot be written.
The JSON names the class under "kind", as "PatchTransformer". Reading imports nothing: a part of
another package is known once its module is imported.
"""

import dataclasses
import difflib
import functools
import json
import math
import numbers
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

T = TypeVar("T")
KIND = "kind"
"""Key under which the JSON of a part names its class."""
LARGEST = sys.float_info.max
"""Largest magnitude of a number in a configuration."""
LARGEST_INTEGER = 1 << 63
"""Largest magnitude of an integer in a configuration."""


MOST_ITEMS = 256
"""Largest number of items of a list in a configuration."""


class Range(NamedTuple):
    """The range of the numbers of a field, both ends included."""

    low: float
    """Least number."""
    high: float
    """Largest number."""

    def __str__(self) -> str:
        if self.high < LARGEST:
            return f"{self.low:,.15g} to {self.high:,.15g}"
        if self.low > -LARGEST:
            return f"at least {self.low:,.15g}"
        return "a finite number"


def at_least(low: float | int) -> Range:
    """Returns the range of finite numbers from `low` on."""
    return Range(low, LARGEST)


InputSide = Annotated[int, Range(1, 2048)]
"""Side of a photo as a network sees it, pixels."""
Side = Annotated[int, Range(1, 4096)]
"""Side of an image or map that is drawn or computed, pixels."""
PhotoSide = Annotated[int, Range(1, 32_768)]
"""Side of a photo before it is resized, pixels."""
Width = Annotated[int, Range(1, 16_384)]
"""Number of features of a layer."""
Ratio = Annotated[int, Range(1, 64)]
"""Ratio of one width to another."""
Patch = Annotated[int, Range(1, 256)]
"""Side of a patch of a photo, pixels."""
Layers = Annotated[int, Range(1, 256)]
Count = Annotated[int, Range(1, 1024)]
"""Number of views, joints, heads or subjects."""
Capacity = Annotated[int, Range(1, 1 << 31)]
"""Number of slots of a buffer."""
CapacityOrAuto = Annotated[int, Range(0, 1 << 31)]
"""Number of slots of a buffer, or 0 for as many as may be needed."""
Chunk = Annotated[int, Range(1, 65_536)]
"""Number of items that are processed at once."""
Iterations = Annotated[int, Range(0, 1000)]
RefineSteps = Annotated[int, Range(0, 100_000)]
"""Number of steps of a refinement. The largest number takes some hours."""
Steps = Annotated[int, Range(1, 100_000_000)]
Seed = Annotated[int, Range(0, (1 << 32) - 1)]
Share = Annotated[float, Range(0, 1)]
Weight = Annotated[float, Range(0, 1e6)]
"""Weight of a term of a sum."""
Spread = Annotated[float, Range(0, 100)]
"""A standard deviation, distance or bound in any unit."""
Length = Annotated[float, Range(1e-6, 100)]
"""Metres, above 0."""
Bias = Annotated[float, Range(-100, 100)]
Vertices = Annotated[int, Range(1, 10_000_000)]
Edge = Annotated[float, Range(0.005, 10)]
"""Length above which the edges of a body are split, metres. A length below 0.005 would make
millions of Gaussians.
"""


def knob(default: Any, *, cost: str, gain: str, measured: str) -> Any:
    """Returns a field that trades accuracy or memory for speed. docs/knobs.md has a row for each
    such field.

    cost, gain: what a change costs and gains, in a few words. measured: the page of docs/ with the
    measurement.
    """
    return dataclasses.field(
        default=default, metadata={"cost": cost, "gain": gain, "measured": measured}
    )


class ArgumentError(ValueError):
    """An error that names the argument of a function and the problem with it. The command line
    shows the name of the option instead.
    """

    def __init__(self, argument: str, problem: str) -> None:
        self.argument, self.problem = argument, problem
        super().__init__(self.line(argument))

    def line(self, name: str) -> str:
        """Returns the message with `name` as the name of the argument."""
        if self.problem.startswith(":"):
            return f"{name}{self.problem}"
        return f"{name} {self.problem}"


class _UnknownPresetError(KeyError):
    """A `KeyError` whose text is its message, not the repr of the message."""

    def __str__(self) -> str:
        return str(self.args[0])


class Presets(dict[str, T]):
    """A dict of presets by name. An unknown name raises a KeyError. Its message lists all names.

    hint: text at the end of that message.
    """

    def __init__(self, presets: dict[str, T], hint: str = "") -> None:
        super().__init__(presets)
        self.hint = hint

    def __missing__(self, name: Any) -> T:
        raise _UnknownPresetError(
            f"no preset {name!r}: expected one of {', '.join(self)}{self.hint}"
        )


def check_fields(cls: type, values: Mapping[str, Any], owner: str) -> None:
    """Checks that the values of fields have the types and ranges of the annotations of a
    configuration.

    An `int` field takes any integer of up to 2^63 in magnitude, and a `float` field takes such
    integers and any finite real number. Booleans are not numbers here. owner: begins the message.

    Raises: ValueError, which names owner and field.
    """
    annotations = _annotations(cls)
    for name, value in values.items():
        check_range(cls, name, value, f"{owner}.{name}")
        if not _fits(value, annotations[name]):
            raise ValueError(
                f"{owner}.{name}: expected {in_words(annotations[name])}, got {value!r}"
            )


@functools.cache
def _annotations(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def _fits(value: Any, annotation: Any) -> bool:
    """Says whether a value has the annotated type. Annotations other than numbers, texts, booleans,
    None, literals, tuples and dataclasses accept any value.
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in arguments)
    if origin is Literal:
        return isinstance(value, str | int | None) and value in arguments
    # True is no number, and numbers are finite
    if annotation in (int, float):
        kind = numbers.Integral if annotation is int else numbers.Real
        if isinstance(value, bool) or not isinstance(value, kind):
            return False
        if isinstance(value, numbers.Integral):
            return abs(int(value)) <= LARGEST_INTEGER
        return math.isfinite(value)
    # a tuple has an item for each argument, or any number of the same
    if origin is tuple:
        items = arguments
        if arguments[-1] is Ellipsis and isinstance(value, tuple):
            items = arguments[:1] * len(value)
        return (
            isinstance(value, tuple) and len(items) == len(value) and all(map(_fits, value, items))
        )
    if annotation in (bool, str, type(None)) or dataclasses.is_dataclass(annotation):
        return isinstance(value, annotation)
    return True


def in_words(annotation: Any) -> str:
    """Returns the types or values that an annotation allows, as text for a message."""
    union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    words = []
    options = typing.get_args(annotation) if union else [annotation]
    for option in options:
        if typing.get_origin(option) is Literal:
            words += map(repr, typing.get_args(option))
        else:
            name = option.__name__ if isinstance(option, type) else str(option)
            words.append(name.replace("NoneType", "None"))
    if len(words) == 1:
        return words[0]
    return f"one of {', '.join(words)}"


@typing.dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, knob))
def configuration(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass whose fields are checked when an instance is made. A
    subclass of `Part` stays the dataclass that Linen made of it.

    A wrong value raises a ValueError that names the class, the field, the value and what is
    expected.
    """
    own = getattr(cls, "__post_init__", None)

    def __post_init__(self):
        cls = type(self)
        check_fields(cls, {name: getattr(self, name) for name in field_names(cls)}, cls.__name__)
        if own is not None:
            own(self)
        if isinstance(self, Part):
            object.__setattr__(self, _MADE, True)

    setattr(cls, "__post_init__", __post_init__)  # noqa: B010 (a class of any kind)
    if issubclass(cls, Part):
        return cls
    return dataclasses.dataclass(frozen=True)(cls)


class Part:
    """Base class of modules of Linen that are fields of configurations. Files name such a module by
    its registered name. Its fields cannot be assigned once it is made.
    """

    def __setattr__(self, name: str, val: Any) -> None:  # the names of Linen's
        if _MADE in self.__dict__ and name in field_names(type(self)):
            raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
        super().__setattr__(name, val)


_MADE = "_made"


@functools.cache
def field_names(cls: Any) -> tuple[str, ...]:
    """Returns the names of the fields of a configuration. `parent` and `name`, which Linen adds to
    a `Part`, are left out.
    """
    # the fields of a `Part` that say where it is are no configuration
    place = ("parent", "name") if issubclass(cls, Part) else ()
    return tuple(field.name for field in dataclasses.fields(cls) if field.name not in place)


_PARTS: dict[str, type] = {}


def part(cls: type[T]) -> type[T]:
    """Registers a subclass of `Part`, so that files may name it. Its fields are checked when an
    instance is made, see `configuration`.

    Raises: ValueError if another module has a part of this name.
    """
    other = _PARTS.get(cls.__name__, cls)
    if other.__module__ != cls.__module__:  # the cell of a notebook may run again
        raise ValueError(
            f"part {cls.__name__} of {cls.__module__}: {other.__module__} has one of this name"
        )
    configuration(cls)  # the class itself
    _PARTS[cls.__name__] = cls
    return cls


def vary(config: T, changes: Mapping[str, Any]) -> T:
    """Returns a copy of a configuration with other values of some fields. Each field is named by
    its path.

    Args:
        config: a frozen dataclass.
        changes: new values by path. docs/knobs.md lists all paths.

    Returns:
        The changed copy.

    Raises:
        ValueError: if a field does not exist. The message names its path, and up to three similar
            ones. Also if the configuration's checks refuse a value.

    Examples:
        >>> class_token = "model.architecture.encoder.transformer.class_token"
        >>> hg.vary(config, {class_token: False, "loss.squared": 0.5})
    """
    for path, value in changes.items():
        known = field_paths(config)
        if path not in known:
            last = path.rpartition(".")[2]
            # a path that ends alike is most likely meant, else one that is spelt alike
            same = [each for each in known if each.rpartition(".")[2] == last]
            like = same or difflib.get_close_matches(path, known, cutoff=0.7)
            meant = ""
            if like:
                meant = f"; did you mean {' or '.join(like[:3])}?"
            raise ValueError(
                f"{path}: {type(config).__name__} has no such field{meant} (all paths:"
                " docs/knobs.md)"
            )
        config = _varied(config, path.split("."), value)
    return config


def field_paths(config: Any, before: str = "") -> dict[str, Any]:
    """Returns the value of each field by its path, such as "loss.squared". A nested configuration
    has an entry, and each of its fields has one, too.

    before: text that begins each path.
    """
    found: dict[str, Any] = {}
    for name in field_names(type(config)):
        value = getattr(config, name)
        found[before + name] = value
        if dataclasses.is_dataclass(value):
            found |= field_paths(value, f"{before}{name}.")
    return found


def _varied(config: Any, names: list[str], value: Any) -> Any:
    changed = value
    if names[1:]:
        changed = _varied(getattr(config, names[0]), names[1:], value)
    return dataclasses.replace(config, **{names[0]: changed})


def check_range(cls: type, name: str, value: Any, path: str) -> None:
    """Checks that the number in a field, or each number of a tuple in it, is in the range of the
    field's annotation. path: names the field in the message.

    Raises: ValueError if a number is out of range, or if the tuple is longer than `MOST_ITEMS`.
    """
    ranges = _ranges(cls).get(name, ())
    values = value
    if not isinstance(value, tuple | list):
        values = (value,)
    if len(values) > MOST_ITEMS:
        raise ValueError(f"{path}: expected at most {MOST_ITEMS} numbers, got {len(values)}")
    for allowed in ranges:
        for each in values:
            within = not isinstance(each, numbers.Real) or allowed.low <= each <= allowed.high
            if not within:  # nor is NaN
                raise ValueError(f"{path} {each:.15g}: expected {allowed}")


@functools.cache
def _ranges(cls: Any) -> dict[str, tuple[Range, ...]]:
    """Returns the ranges of each field that has a range in its annotation."""
    hints = typing.get_type_hints(cls, include_extras=True)
    found = {name: tuple(marks_in(hints[name], Range)) for name in field_names(cls)}
    return {name: ranges for name, ranges in found.items() if ranges}


def marks_in(annotation: Any, kind: type[T]) -> Iterator[T]:
    """Yields the marks of class `kind` in an annotation and in its parts, as in `Annotated[int,
    Range(1, 9)] | None`.
    """
    if typing.get_origin(annotation) is Annotated:
        yield from (each for each in annotation.__metadata__ if isinstance(each, kind))
    for part in typing.get_args(annotation):
        yield from marks_in(part, kind)


def config_to_json(config: Any, indent: int | None = None) -> str:
    """Returns a configuration as JSON, with nested configurations as nested objects.

    Raises: ValueError for a `Part` whose class is not registered; TypeError for a value that JSON
    cannot hold, such as a number of class np.float32.
    """
    return json.dumps(_plain(config), indent=indent)


def _plain(value: Any, kind: bool = False) -> Any:
    """Returns a configuration as dicts and lists that JSON can hold. kind: whether to add the name
    of the class.

    Raises: ValueError if the name is to be added, but the class is no registered part.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        annotations = typing.get_type_hints(type(value))
        if kind and _PARTS.get(type(value).__name__) is not type(value):
            raise ValueError(
                f"{type(value).__name__} is no registered part: decorate its class with `part`"
            )
        named = {KIND: type(value).__name__} if kind else {}

        def plain(name):
            options = annotations[name], *typing.get_args(annotations[name])
            return _plain(getattr(value, name), any(map(_is_part, options)))

        return named | {name: plain(name) for name in field_names(type(value))}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    return value


def _is_part(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Part)


def config_from_json(cls: type[T], text: str) -> T:
    """Returns the configuration of class `cls` that `config_to_json` wrote. Missing fields take
    their defaults.

    Raises: ValueError if the text is not JSON. Also for a field that the configuration does not
    have, for a missing field without a default, for an unknown part, and for a value of a wrong
    type or out of range; these errors name the path of the field. Also if fields do not fit each
    other.
    """
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the configuration is not JSON: {error}") from error
    return _build(cls, values, "config")


def _build(annotation: Any, value: Any, path: str) -> Any:
    """Returns a JSON value converted to the annotated type. Where the annotation says so, objects
    become configurations, lists become tuples, and integers become floats. Any other value is
    returned unchanged, and the caller checks it.

    path: names the value in messages. Raises: ValueError if a configuration cannot be made of an
    object, or if an item of a tuple is wrong.
    """
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    # a part names its class, a dataclass is known by the annotation
    if _is_part(annotation) and isinstance(value, dict):
        cls = _find_part(value.get(KIND), annotation, path)
        return _build_dataclass(cls, {name: x for name, x in value.items() if name != KIND}, path)
    if dataclasses.is_dataclass(annotation):
        return _build_dataclass(annotation, value, path)
    # None, or the only other option
    if origin in (typing.Union, types.UnionType):
        options = [option for option in arguments if option is not type(None)]
        if value is not None and len(options) == 1:
            return _build(options[0], value, path)
        return value
    # lists become tuples, whose items are built and checked one by one
    if origin is tuple and isinstance(value, list):
        items = arguments
        if arguments[-1] is Ellipsis:
            items = [arguments[0]] * len(value)
        if len(value) > MOST_ITEMS:
            raise ValueError(f"{path}: expected at most {MOST_ITEMS} items, got {len(value)}")
        if len(items) != len(value):
            return tuple(value)
        built = tuple(
            _build(item, x, f"{path}[{i}]")
            for i, (item, x) in enumerate(zip(items, value, strict=True))
        )
        for i, item in enumerate(items):
            if not _fits(built[i], item):
                raise ValueError(f"{path}[{i}]: expected {in_words(item)}, got {value[i]!r}")
        return built
    if annotation is float and type(value) is int and abs(value) <= LARGEST_INTEGER:
        return float(value)
    return value


def _find_part(kind: Any, base: Any, path: str) -> type:
    """Returns the registered part with the name `kind`, which must be a subclass of `base`.

    Raises: ValueError if there is none.
    """
    known = {name: cls for name, cls in _PARTS.items() if issubclass(cls, base)}
    name = ""
    if isinstance(kind, str):
        name = kind.rpartition(".")[2]  # the first files say in which module, too
    if name not in known:
        raise ValueError(
            f"{path}.{KIND}: expected the name of a registered {base.__name__}, one of"
            f" {', '.join(sorted(known))} (others: import their module first); got {kind!r}"
        )
    return known[name]


def _build_dataclass(cls: Any, values: Any, path: str) -> Any:
    """Returns the configuration of class `cls` that an object of JSON describes.

    Raises: ValueError if the value is no object, or if it describes no such configuration.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected an object, got {values!r}")
    # fields have today's names, and none is unknown
    values = dict(values)
    for before, now in getattr(cls, "renamed_fields", {}).items():
        if before in values and now not in values:
            values[now] = values.pop(before)
    annotations = {
        name: hint for name, hint in typing.get_type_hints(cls).items() if name in field_names(cls)
    }
    unknown = sorted(set(values) - set(annotations))
    if unknown:
        raise ValueError(f"{path}.{unknown[0]}: {cls.__name__} has no such field")
    # each value as its annotation has it; fields without a default have to be there
    fields = {
        name: _build(annotations[name], value, f"{path}.{name}") for name, value in values.items()
    }

    def required(field):
        return field.default is field.default_factory is dataclasses.MISSING

    needed = [f.name for f in dataclasses.fields(cls) if f.name in annotations and required(f)]
    missing = [name for name in needed if name not in fields]
    if missing:
        raise ValueError(f"{path}.{missing[0]} is missing")
    check_fields(cls, fields, path)
    try:
        return cls(**fields)
    except ArithmeticError as error:  # sizes of 0
        raise ValueError(f"{path}: {cls.__name__}: {error}") from error
