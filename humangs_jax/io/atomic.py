"""Files and folders that are there whole or not at all: written aside, then renamed."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path


def replace_folder(folder: str | Path, write: Callable[[Path], None]) -> None:
    """Calls write(temporary), which makes that folder, and renames it to `folder`; an existing one is replaced."""
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        write(temporary)
        if folder.is_dir():
            shutil.rmtree(folder)
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def replace_file(path: str | Path, write: Callable[[Path], object]) -> None:
    """Calls write(temporary), which makes that file, and renames it to `path`. The temporary one has the same ending."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    try:
        write(temporary)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
