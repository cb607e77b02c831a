"""Frozen dataclasses that are JAX pytrees, and batches of them that can be indexed.

`jax.vmap`, `jax.lax.scan` and friends rebuild pytrees with leaves of other ranks, tracers or plain objects. A rebuild here
never calls `__init__`, so shape checks of the constructor (jaxtyping) hold for what users build and never for what JAX builds.
"""

import dataclasses
import operator
import typing
from collections.abc import Iterator
from typing import Any, TypeVar, dataclass_transform

import jax
from jax.core import Tracer

T = TypeVar("T")
B = TypeVar("B", bound="Batchable")


def static_field(**kwargs: Any) -> Any:
    """A dataclass field that belongs to the tree structure (hashable, compared by `==`), not to its leaves."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static_field, dataclasses.field))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """Class decorator: a frozen, keyword-friendly dataclass registered as a pytree with named leaves.

    With `Batchable` as a base class, batches of it can be indexed and iterated over.
    """
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


class Batchable:
    """Base of the pytree dataclasses whose leaves may share leading batch axes: indexing, length, iteration.

    The annotations of the fields are unbatched, so the batch axes are those that a leaf has in addition: a `Camera`
    whose `K` is (4, 3, 3) is a batch of 4 cameras.
    """

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Sizes of the leading batch axes; () for one example."""
        for field in dataclasses.fields(self):  # ty: ignore[invalid-argument-type]
            value = getattr(self, field.name)
            if isinstance(value, Batchable):
                return value.batch_shape
            rank = _annotated_rank(field.type)
            if rank is not None and hasattr(value, "shape"):
                return tuple(value.shape[: len(value.shape) - rank])
        return ()

    def __len__(self) -> int:
        """Size of the first batch axis. Raises: TypeError for one example."""
        if shape := self.batch_shape:
            return shape[0]
        raise TypeError(
            f"this {type(self).__name__} is not a batch: it has no length and cannot be indexed or iterated"
        )

    def __bool__(self) -> bool:
        """True, whatever the length: `if camera` asks whether there is one."""
        return True

    def __getitem__(self: B, index: Any) -> B:
        """One example of a batch (integer), or some of them (slice, mask or array of integers), along the first axis.

        Raises: TypeError for one example; IndexError for an integer out of range. JAX clamps traced integers and arrays.
        """
        size = len(self)
        if not isinstance(index, slice | Tracer) and getattr(index, "ndim", 0) == 0:
            index = operator.index(index)
            if not -size <= index < size:
                raise IndexError(f"{type(self).__name__}: index {index} is out of range for a batch of {size}")
        return jax.tree.map(lambda leaf: leaf[index], self)

    def __iter__(self: B) -> Iterator[B]:
        """The examples of a batch, one by one. Raises: TypeError for one example."""
        return map(self.__getitem__, range(len(self)))


def _annotated_rank(annotation):
    """Number of axes in a jaxtyping annotation, or in that of an optional array; None for any other annotation."""
    for option in typing.get_args(annotation) or (annotation,):
        dims = getattr(option, "dims", None)
        if isinstance(dims, tuple) and option.index_variadic is None:
            return len(dims)
    return None


def replace(tree: T, **changes: Any) -> T:
    """A copy with some fields exchanged, without shape checks, so that it also works on batched trees."""
    names = {f.name for f in dataclasses.fields(tree)}  # ty: ignore[invalid-argument-type]
    if unknown := set(changes) - names:
        raise TypeError(f"{type(tree).__name__} has no field {sorted(unknown)}; its fields are {sorted(names)}")
    copy = object.__new__(type(tree))
    for name in names:
        object.__setattr__(copy, name, changes.get(name, getattr(tree, name)))
    return copy
