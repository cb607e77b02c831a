"""Lets modules that have moved be imported under their old names, with a warning."""

import importlib
import sys
import warnings
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED = {
    "humangs_jax.avatar.shot": "humangs_jax.avatar.frame_settings",
    "humangs_jax.capture.fitting.refine": "humangs_jax.capture.fitting.silhouette_fit",
    "humangs_jax.fitting.refine": "humangs_jax.capture.fitting.silhouette_fit",
    "humangs_jax.data.calibration.calibration": "humangs_jax.data.cameras",
    "humangs_jax.data.calibration": "humangs_jax.capture.calibration",
    "humangs_jax.data.keypoints": "humangs_jax.capture.keypoints",
    "humangs_jax.data.motion": "humangs_jax.motion",
    "humangs_jax.detection": "humangs_jax.capture.detection",
    "humangs_jax.fitting": "humangs_jax.capture.fitting",
    "humangs_jax.people": "humangs_jax.synthetic",
}
"""New names of modules and packages by their old names. A longer old name comes before a shorter
one with the same beginning.
"""


def new_name(name: str) -> str | None:
    """Returns the present name of a module, given its old name; None for a name that has not moved.

    Examples:
        >>> new_name("humangs_jax.people.bank")
        'humangs_jax.synthetic.bank'
    """
    for old, new in MOVED.items():
        if name == old or name.startswith(f"{old}."):
            return new + name[len(old) :]
    return None


class _MovedModules:
    """Import hook that finds modules by their old names. It gives the same module objects as the
    new names, so that each is imported once.
    """

    def __init__(self) -> None:
        self._specs: dict[str, Any] = {}

    def find_spec(
        self, name: str, path: Any = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Returns a spec that leads to the module under its new name; None for every other name."""
        if not name.startswith("humangs_jax.") or new_name(name) is None:
            return None
        return ModuleSpec(name, self)  # ty: ignore[invalid-argument-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Imports the module under its new name, and warns about the old one.

        Raises: ModuleNotFoundError, with the new name, if there is no such module.
        """
        new = str(new_name(spec.name))
        module = importlib.import_module(new)
        message = f"{spec.name} is {new} now; its old name goes in version 0.3"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        self._specs[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """Does not run the module again, and gives it the spec of its new name."""
        old = getattr(module.__spec__, "name", "")
        module.__spec__ = self._specs.pop(old, module.__spec__)


def find_moved_modules() -> None:
    """Registers the import hook for old names. A second call has no effect."""
    if not any(isinstance(finder, _MovedModules) for finder in sys.meta_path):
        sys.meta_path.insert(0, _MovedModules())
