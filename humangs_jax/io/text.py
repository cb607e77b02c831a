"""Text and JSON files: written whole or not at all; every kind of damage in one that is read is one line."""

import json
import os
from pathlib import Path
from typing import Any

from humangs_jax.io.atomic import write_text


class FileError(ValueError):
    """Something is wrong with a file; the message is one line: file, field, and what was expected. Empty parts are left out."""

    def __init__(self, file: object, field: str, problem: object):
        parts = [str(part) for part in (file, field, problem) if part]
        super().__init__(" ".join(": ".join(parts).split()))


def read_text(path: str | os.PathLike) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises: FileNotFoundError; OSError, its text one line, if it cannot be read or is not text.
    """
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise OSError(f"not a text file in UTF-8: {error}") from error


def parse_json(text: str) -> Any:
    """The value of a JSON text; NaN and Infinity, which Python's tools write, are accepted.

    Raises: ValueError naming the line.
    """
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"line {error.lineno}: not valid JSON: {error.msg}") from error
    except RecursionError as error:
        raise ValueError("not usable JSON: nested too deeply") from error


def write_json(path: str | os.PathLike, value: Any, indent: int | None = 1) -> None:
    """Write a JSON file, whole or not at all. Raises: TypeError for what JSON cannot hold; OSError."""
    write_text(path, json.dumps(value, indent=indent) + "\n")


def read_json(path: str | os.PathLike) -> Any:
    """The value in a JSON file. Raises: see `read_text` and `parse_json`."""
    return parse_json(read_text(path))
