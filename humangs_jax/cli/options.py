"""Options that several commands share: checks, which raise an error of one line that names the option, and parsing."""

import re
from pathlib import Path
from typing import Any


def require_parent(path: Path, option: str = "--out") -> None:
    """A file can be written: its folder exists and is no read-only one, it is no folder itself. Raises: OSError."""
    from humangs_jax.io.atomic import check_writable

    if not path.parent.is_dir():
        raise FileNotFoundError(f"{option} {path}: the folder {path.parent} does not exist")
    if path.is_dir():
        raise IsADirectoryError(f"{option} {path}: is a folder: expected the name of a file")
    check_writable(path)


def tell_deleted(folder: Path, unless: Path | None = None) -> None:
    """Say what --overwrite will delete in a folder that is replaced; nothing where it is the folder `unless`, or empty."""
    from humangs_jax.io.atomic import contents

    if (unless is None or folder.resolve() != unless.resolve()) and (found := contents(folder)):
        print(f"--overwrite: once the work is done, {folder} is replaced; this is deleted: {found}", flush=True)


def require_suffix(path: Path, suffixes: tuple[str, ...], option: str = "--out") -> None:
    """The name of a file ends as its format requires. Raises: ValueError."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{option} {path}: expected a name ending in {' or '.join(suffixes)}")


def require_at_least(least: int, **values: float | int) -> None:
    """Numbers by the name of their option are not too small. Raises: ValueError."""
    for name, value in values.items():
        if not value >= least:
            raise ValueError(f"--{name.replace('_', '-')} {value}: expected at least {least}")


def refine_limits(text: str) -> dict[str, Any]:
    """Fields of `RefineConfig` for "15s", "15" (seconds) or "100steps". Raises: ValueError."""
    match = re.fullmatch(r"(?P<number>\d+(\.\d*)?)(?P<unit>s|steps)?", text.strip())
    number = float(match["number"]) if match else 0.0
    in_steps = match is not None and match["unit"] == "steps"
    if not number > 0 or (in_steps and number != int(number)):
        raise ValueError(f'{text!r}: expected how long to refine, as in "15s" or "100steps"')
    return {"steps": int(number), "seconds": None} if in_steps else {"steps": None, "seconds": number}
