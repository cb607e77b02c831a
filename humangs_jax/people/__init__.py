"""Seeded synthetic clothed people: written as capture folders, or drawn on the fly for training.

The rest of the package uses the names below and `data.loading.source.Source`; nothing else of this folder. Names are looked up
when they are asked for: `SPLITS` alone does not import the generator.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from humangs_jax.people.bank import PeopleBank, build_bank, load_bank, save_bank
    from humangs_jax.people.manifest import find_people
    from humangs_jax.people.on_the_fly import ON_THE_FLY, OnTheFlyConfig
    from humangs_jax.people.seeds import GENERATOR_VERSION, SPLITS, seeds_of, split_of
    from humangs_jax.people.source import GeneratedSource, on_the_fly_source
    from humangs_jax.people.subject import SyntheticSubject, make_subject
    from humangs_jax.people.writer import Layout, write_set, write_subject, write_training_subject

_MODULES = {
    "bank": ("PeopleBank", "build_bank", "load_bank", "save_bank"),
    "manifest": ("find_people",),
    "on_the_fly": ("ON_THE_FLY", "OnTheFlyConfig"),
    "seeds": ("GENERATOR_VERSION", "SPLITS", "seeds_of", "split_of"),
    "source": ("GeneratedSource", "on_the_fly_source"),
    "subject": ("SyntheticSubject", "make_subject"),
    "writer": ("Layout", "write_set", "write_subject", "write_training_subject"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "GENERATOR_VERSION", "ON_THE_FLY", "SPLITS", "GeneratedSource", "Layout", "OnTheFlyConfig", "PeopleBank",
    "SyntheticSubject", "build_bank", "find_people", "load_bank", "make_subject", "on_the_fly_source", "save_bank", "seeds_of",
    "split_of", "write_set", "write_subject", "write_training_subject",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
