"""Frozen dataclasses that are JAX pytrees, and batches of them that can be indexed.

`jax.vmap`, `jax.lax.scan` and friends rebuild pytrees with leaves of other ranks, tracers or plain objects. A rebuild here
never calls `__init__`, so shape checks of the constructor (jaxtyping) hold for what users build and never for what JAX builds.
"""

import dataclasses
import functools
import operator
import typing
from collections.abc import Iterator
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

T = TypeVar("T")
B = TypeVar("B", bound="Batchable")
_PYTREES: set[type] = set()


def static_field(**kwargs: Any) -> Any:
    """A dataclass field that belongs to the tree structure (hashable, compared by `==`), not to its leaves."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static_field, dataclasses.field))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """Class decorator: a frozen, keyword-friendly dataclass registered as a pytree with named leaves.

    With `Batchable` as a base class, batches of it can be indexed and iterated over.
    """
    cls = dataclasses.dataclass(frozen=True, eq=False, repr=False)(cls)
    if cls.__repr__ is object.__repr__:
        setattr(cls, "__repr__", short_repr)  # noqa: B010 (a class of any kind)
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
    _PYTREES.add(cls)
    return cls


SHORT = 80
"""Characters of a value that is no array, from which on it is left out of a printed pytree."""


def short_repr(tree: Any) -> str:
    """A dataclass on one line, arrays by type and shape, as equinox prints them: "Gaussians(means=f32[100,3], ...)"."""
    shown = [f"{f.name}={_shortened(getattr(tree, f.name))}" for f in dataclasses.fields(tree)]
    return f"{type(tree).__name__}({', '.join(shown)})"


def _shortened(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = np.dtype(value.dtype) if isinstance(value, np.ndarray) else value.dtype
        name = kind.name.replace("bfloat", "bf").replace("float", "f").replace("uint", "u").replace("int", "i")
        return f"{name}[{','.join(map(str, value.shape))}]"
    text = repr(value)
    if len(text) > SHORT and isinstance(value, tuple | list | dict):
        return f"{type(value).__name__} of {len(value)}"
    return text if dataclasses.is_dataclass(value) or len(text) <= SHORT else f"{type(value).__name__}(...)"


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
        raise TypeError(f"this {type(self).__name__} is not a batch: it has no length and cannot be indexed or iterated")

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


def _annotated_rank(annotation: Any) -> int | None:
    """Number of axes in a jaxtyping annotation, or in that of an optional array; None for any other annotation."""
    for option in typing.get_args(annotation) or (annotation,):
        dims = getattr(option, "dims", None)
        if isinstance(dims, tuple) and option.index_variadic is None:
            return len(dims)
    return None


def shape_fault(tree: Any) -> str | None:
    """What is wrong with the shapes of a pytree dataclass, by the annotations of its fields: ".colors: expected shape ...".

    Axes of one name have one size, in a batch behind its own axes. None if all fit, or for anything else.
    """
    cls, sizes = type(tree), {}
    if cls not in _PYTREES:
        return None
    for name, axes in _annotated_axes(cls).items():
        value = getattr(tree, name)
        if axes is None:
            if fault := shape_fault(value):
                return f".{name}{fault}"
            continue
        shape = getattr(value, "shape", None)
        if not isinstance(shape, tuple):
            continue
        batch = len(shape) - len(axes) if issubclass(cls, Batchable) and len(shape) > len(axes) else 0
        wanted = [sizes.get(axis, axis) for axis in axes]
        if len(shape) - batch != len(axes) or any(
            isinstance(want, int) and want != size for want, size in zip(wanted, shape[batch:], strict=True)
        ):
            words = ", ".join(map(str, (*shape[:batch], *wanted))) + ("," if len(wanted) + batch == 1 else "")
            return f".{name}: expected shape ({words}), got {shape}"
        sizes |= {axis: size for axis, size in zip(axes, shape[batch:], strict=True) if isinstance(axis, str)}
    return None


@functools.cache
def _annotated_axes(cls: Any) -> dict[str, list[Any] | None]:
    """By field: its axes, names and sizes, or None where it is no array (a pytree of its own, or static)."""
    fields = [field for field in dataclasses.fields(cls) if not field.metadata.get("static")]
    found = {}
    for field in fields:
        options = typing.get_args(field.type) or (field.type,)
        texts = [str(x.dim_str) for x in options if hasattr(x, "dim_str")]
        axes = [int(axis) if axis.isdigit() else axis for axis in texts[0].split()] if texts else None
        if axes is not None and not all(isinstance(axis, int) or axis.strip("_").isidentifier() for axis in axes):
            continue  # of any shape
        found[field.name] = axes
    return found


def replace(tree: T, **changes: Any) -> T:
    """A copy of a pytree with some fields exchanged, without checks of shapes, so that it works on batches, too.

    Args:
        tree: an instance of a dataclass.
        **changes: new values by field.

    Returns:
        The changed copy.

    Raises:
        TypeError: for a name that is no field.

    Examples:
        >>> grey = hg.replace(gaussians, colors=jnp.full_like(gaussians.colors, 0.5))
    """
    names = {f.name for f in dataclasses.fields(tree)}  # ty: ignore[invalid-argument-type]
    if unknown := set(changes) - names:
        raise TypeError(f"{type(tree).__name__} has no field {sorted(unknown)}; its fields are {sorted(names)}")
    copy = object.__new__(type(tree))
    for name in names:
        object.__setattr__(copy, name, changes.get(name, getattr(tree, name)))
    return copy


def inexact_leaves(tree: Any) -> Iterator[tuple[str, Any]]:
    """(path, leaf) of all floating-point arrays of a tree, as "cameras.K"; "" for a bare array."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact):
            yield jax.tree_util.keystr(path, simple=True, separator="."), leaf
