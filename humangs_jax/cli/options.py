"""Checks of options that several commands share; each raises an error of one line that names the option."""

from pathlib import Path


def require_parent(path: Path, option: str = "--out") -> None:
    """The folder that a file will be written to exists. Raises: FileNotFoundError."""
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{option} {path}: the folder {path.parent} does not exist")


def require_suffix(path: Path, suffixes: tuple[str, ...], option: str = "--out") -> None:
    """The name of a file ends as its format requires. Raises: ValueError."""
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{option} {path}: expected a name ending in {' or '.join(suffixes)}")


def require_at_least(least: int, **values: float | int) -> None:
    """Numbers by the name of their option are not too small. Raises: ValueError."""
    for name, value in values.items():
        if not value >= least:
            raise ValueError(f"--{name.replace('_', '-')} {value}: expected at least {least}")
