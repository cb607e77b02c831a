"""Text and JSON files: written whole or not at all; every kind of damage in one that is read is one line."""

import json
import os
from typing import Any, TypeVar

from humangs_jax.core.configuration import config_from_json
from humangs_jax.io.atomic import write_text
from humangs_jax.io.reading import FileError, Refused, limits, read_bytes, reading

T = TypeVar("T")
__all__ = [
    "FileError",
    "check_nesting",
    "json_text",
    "parse_json",
    "read_configuration",
    "read_json",
    "read_text",
    "write_json",
]


def read_text(path: str | os.PathLike, limit: str = "text_bytes") -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises: FileNotFoundError; FileError if it cannot be read, is too large or is not text.
    """
    with reading(path, "text file in UTF-8"):
        return read_bytes(path, limit).decode("utf-8-sig")


def parse_json(text: str) -> Any:
    """The value of a JSON text; NaN and Infinity, which Python's tools write, are accepted.

    Raises: Refused (a ValueError) naming the line.
    """
    try:
        value = json.loads(text)
    except json.JSONDecodeError as error:
        raise Refused(f"line {error.lineno}: not valid JSON: {error.msg}") from error
    except RecursionError as error:
        raise Refused("not usable JSON: nested too deeply") from error
    except ValueError as error:  # an integer of thousands of digits
        raise Refused(f"not usable JSON: {error}") from error
    check_nesting(value)
    return value


def check_nesting(value: Any) -> None:
    """Raises: Refused if lists and dicts contain each other more than `nesting` times."""
    level = [value]
    for _ in range(limits().nesting):
        level = [item for each in level if isinstance(each, list | dict) for item in _containers(each)]
        if not level:
            return
    raise Refused(f"not usable: nested too deeply, the limit nesting is {limits().nesting} (docs/security.md)")


def _containers(value):
    values = value.values() if isinstance(value, dict) else value
    return [item for item in values if isinstance(item, list | dict)]


def read_configuration(cls: type[T], path: str | os.PathLike) -> T:
    """A configuration of class `cls` from its JSON, see `core.configuration`. Raises: FileNotFoundError; FileError."""
    with reading(path, "configuration"):
        try:
            return config_from_json(cls, read_text(path))
        except ValueError as error:
            raise Refused(str(error)) from error


def write_json(path: str | os.PathLike, value: Any, indent: int | None = 1) -> None:
    """Write a JSON file, whole or not at all. Raises: TypeError for what JSON cannot hold; OSError."""
    write_text(path, json_text(value, indent))


def json_text(value: Any, indent: int | None = 1) -> str:
    """What `write_json` writes. Raises: TypeError for what JSON cannot hold."""
    return json.dumps(value, indent=indent) + "\n"


def read_json(path: str | os.PathLike) -> Any:
    """The value in a JSON file. Raises: FileNotFoundError; FileError, naming file and line."""
    with reading(path, "JSON file"):
        return parse_json(read_text(path))
