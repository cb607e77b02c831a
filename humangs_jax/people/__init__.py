"""Seeded synthetic clothed people, written as capture folders.

Names are looked up when they are asked for: who needs the seeds alone does not import the generator.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from humangs_jax.people.seeds import SPLITS, split_of
    from humangs_jax.people.subject import SyntheticSubject, make_subject
    from humangs_jax.people.writer import synthesize, write_subject, write_training_subject

__all__ = [
    "SPLITS",
    "SyntheticSubject",
    "make_subject",
    "split_of",
    "synthesize",
    "write_subject",
    "write_training_subject",
]

_MODULES = {"SPLITS": "seeds", "split_of": "seeds", "SyntheticSubject": "subject", "make_subject": "subject"}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES.get(name, 'writer')}"), name)
