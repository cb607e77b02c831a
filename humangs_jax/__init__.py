"""Animatable 3D Gaussian humans from a few photos, in functional JAX.

The public interface is the list in `__init__.pyi`, which editors and type checkers read. Each name
is imported when it is first used, so that `import humangs_jax` and `humangs --help` are fast.
The import sets one flag of XLA if the installed version of JAX would compute wrong numbers without
it. Modules that have moved can still be imported under their old names.
"""

import ast
import importlib
from pathlib import Path

from humangs_jax.core.jax_faults import avoid_wrong_sums
from humangs_jax.core.moved import find_moved_modules

__version__ = "0.2.0"

_PUBLIC = {
    name.name: node.module
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text()).body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
}

__all__ = ["__version__", *_PUBLIC]

avoid_wrong_sums()
find_moved_modules()


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'humangs_jax' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"humangs_jax.{_PUBLIC[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
