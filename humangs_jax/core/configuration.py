"""Configurations (frozen dataclasses, nested) as JSON and back, checked against their annotations."""

import dataclasses
import json
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

T = TypeVar("T")


def config_to_json(config: Any, indent: int | None = None) -> str:
    """A configuration as JSON, sub-configurations nested."""
    return json.dumps(dataclasses.asdict(config), indent=indent)


def config_from_json(cls: type[T], text: str) -> T:
    """Inverse of `config_to_json` for a configuration of class `cls`; missing fields take their defaults.

    Raises: ValueError for a field that the configuration does not have or a value of another type, naming it.
    """
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"configuration is not JSON: {error}") from error
    return _build(cls, values, "config")


def config_from_file(cls: type[T], path: Path) -> T:
    """`config_from_json` of a file. Raises: OSError; ValueError, naming file and field."""
    try:
        return config_from_json(cls, path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _build(annotation: Any, value: Any, path: str) -> Any:
    """A JSON value, converted to its annotation."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if dataclasses.is_dataclass(annotation):
        return _build_dataclass(annotation, value, path)
    if origin in (typing.Union, types.UnionType):
        options = [option for option in arguments if option is not type(None)]
        if value is None and len(options) < len(arguments):
            return None
        if len(options) == 1:
            return _build(options[0], value, path)
    if origin is tuple and isinstance(value, list):
        whole = len(arguments) == 2 and arguments[1] is Ellipsis
        items = [arguments[0]] * len(value) if whole else list(arguments)
        if len(items) == len(value):
            return tuple(_build(item, x, f"{path}[{i}]") for i, (item, x) in enumerate(zip(items, value, strict=True)))
    elif _matches(value, annotation):
        return value
    raise ValueError(f"{path}: expected {_named(annotation)}, got {value!r}")


def _build_dataclass(cls, values, path):
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected an object, got {values!r}")
    annotations = typing.get_type_hints(cls)
    if unknown := sorted(set(values) - set(annotations)):
        raise ValueError(f"{path}.{unknown[0]}: {cls.__name__} has no such field")
    return cls(**{name: _build(annotations[name], value, f"{path}.{name}") for name, value in values.items()})


def _named(annotation):
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


def _matches(value, annotation):
    """Whether a JSON value fits one of the plain annotations that configurations use."""
    origin = typing.get_origin(annotation)
    if origin is Literal:
        return value in typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        return any(_matches(value, option) for option in typing.get_args(annotation))
    if annotation is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is annotation
