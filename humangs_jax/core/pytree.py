"""Frozen dataclasses that are JAX pytrees.

`jax.vmap`, `jax.lax.scan` and friends rebuild pytrees with leaves of other ranks, tracers or plain objects. A rebuild here
never calls `__init__`, so shape checks of the constructor (jaxtyping) hold for what users build and never for what JAX builds.
"""

import dataclasses
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


def static_field(**kwargs: Any) -> Any:
    """A dataclass field that belongs to the tree structure (hashable, compared by `==`), not to its leaves."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static_field, dataclasses.field))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """Class decorator: a frozen, keyword-friendly dataclass registered as a pytree with named leaves."""
    cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(cls)
    static = tuple(f.name for f in fields if f.metadata.get("static"))
    dynamic = tuple(f.name for f in fields if not f.metadata.get("static"))

    def flatten_with_keys(tree):
        children = [(jax.tree_util.GetAttrKey(name), getattr(tree, name)) for name in dynamic]
        return children, tuple(getattr(tree, name) for name in static)

    def flatten(tree):
        return [getattr(tree, name) for name in dynamic], tuple(getattr(tree, name) for name in static)

    def unflatten(aux, children):
        tree = object.__new__(cls)
        for name, value in zip(dynamic, children, strict=True):
            object.__setattr__(tree, name, value)
        for name, value in zip(static, aux, strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def replace(tree: T, **changes: Any) -> T:
    """A copy with some fields exchanged, without shape checks, so that it also works on batched trees."""
    names = {f.name for f in dataclasses.fields(tree)}  # ty: ignore[invalid-argument-type]
    if unknown := set(changes) - names:
        raise TypeError(f"{type(tree).__name__} has no field {sorted(unknown)}; its fields are {sorted(names)}")
    copy = object.__new__(type(tree))
    for name in names:
        object.__setattr__(copy, name, changes.get(name, getattr(tree, name)))
    return copy
