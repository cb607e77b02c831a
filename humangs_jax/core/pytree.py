"""Defines frozen dataclasses that are JAX pytrees, and batches of them that can be indexed.

`jax.vmap`, `jax.lax.scan` and others rebuild pytrees with leaves of other ranks, tracers or plain
objects. A rebuild here never calls `__init__`. So shape checks of the constructor (jaxtyping) apply
to what users build, and never to what JAX builds.
"""

import dataclasses
import functools
import json
import operator
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from humangs_jax.core.arrays import out_of_range, taken

T = TypeVar("T")
B = TypeVar("B", bound="Batchable")
_PYTREES: set[type] = set()


def static_field(**kwargs: Any) -> Any:
    """Returns a dataclass field that belongs to the tree structure and not to the leaves. Its
    values must be hashable and are compared by `==`.
    """
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(static_field, dataclasses.field))
def pytree_dataclass(cls: type[T]) -> type[T]:
    """Makes a class a frozen dataclass that is registered as a pytree with named leaves.

    With `Batchable` as a base class, batches of it can be indexed and iterated over.

    Raises: TypeError if another module of the package has a pytree of this name.
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
        return [getattr(tree, name) for name in dynamic], tuple(
            getattr(tree, name) for name in static
        )

    def unflatten(aux, children):
        tree = object.__new__(cls)
        for name, value in zip(dynamic, children, strict=True):
            object.__setattr__(tree, name, value)
        for name, value in zip(static, aux, strict=True):
            object.__setattr__(tree, name, value)
        return tree

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    _PYTREES.add(cls)
    _make_exportable(cls)
    return cls


_EXPORTABLE: dict[str, str] = {}
"""Name of each pytree in files of `jax.export` -> module that defines the pytree."""


def _make_exportable(cls: type[Any]) -> None:
    """Registers the class, so that `jax.export` can serialize functions with arguments or results
    of this class.

    Its name in such files consists of the package and the class, so that files stay readable if a
    module moves. Classes that are defined inside functions or in `__main__` are left out.

    Raises: TypeError if another module of the package has a pytree of this name.
    """
    name = f"{cls.__module__.partition('.')[0]}.{cls.__qualname__}"
    if "<locals>" in name or cls.__module__ == "__main__":
        return
    if name in _EXPORTABLE:  # a module that is loaded again keeps its first class there
        if _EXPORTABLE[name] != cls.__module__:
            raise TypeError(
                f"{cls.__module__} and {_EXPORTABLE[name]} both have a pytree {cls.__qualname__}"
            )
        return
    _EXPORTABLE[name] = cls.__module__
    jax.export.register_pytree_node_serialization(
        cls,
        serialized_name=name,
        serialize_auxdata=_static_bytes,
        deserialize_auxdata=_static_values,
    )


def _static_bytes(values: tuple[Any, ...]) -> bytes:
    """Returns static fields as JSON.

    Raises: TypeError if JSON cannot hold a field's value.
    """
    return json.dumps(values).encode()


def _static_values(data: bytes | bytearray) -> tuple[Any, ...]:
    """Returns the static fields that `_static_bytes` wrote. Lists become tuples again, because
    static fields must be hashable.
    """

    def as_tuples(x):
        if isinstance(x, list):
            return tuple(map(as_tuples, x))
        return x

    return as_tuples(json.loads(bytes(data)))


SHORT = 80
"""Largest number of characters at which a value that is no array is printed in full."""


def short_repr(tree: Any) -> str:
    """Returns a dataclass as one line, with arrays by type and shape as equinox prints them:
    "Gaussians(means=f32[100,3], ...)". Texts and None are left out where they are the field's
    default.
    """
    values = {field.name: getattr(tree, field.name) for field in dataclasses.fields(tree)}
    usual = {field.name: field.default for field in dataclasses.fields(tree)}
    shown = [
        f"{name}={_shortened(value)}"
        for name, value in values.items()
        if not (isinstance(value, str | None) and value == usual[name])
    ]
    return f"{type(tree).__name__}({', '.join(shown)})"


def _shortened(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        if isinstance(value, np.ndarray):
            kind = np.dtype(value.dtype)
        else:
            kind = value.dtype
        name = (
            kind.name.replace("bfloat", "bf")
            .replace("float", "f")
            .replace("uint", "u")
            .replace("int", "i")
        )
        return f"{name}[{','.join(map(str, value.shape))}]"
    text = repr(value)
    if len(text) > SHORT and isinstance(value, tuple | list | dict):
        return f"{type(value).__name__} of {len(value)}"
    if dataclasses.is_dataclass(value) or len(text) <= SHORT:
        return text
    return f"{type(value).__name__}(...)"


class Batchable:
    """Base class of pytree dataclasses whose leaves may share leading batch axes. It adds indexing,
    length and iteration.

    The annotations of the fields are unbatched. The batch axes are the axes that a leaf has in
    addition: a `Camera` whose `K` is (4, 3, 3) is a batch of 4 cameras.
    """

    @property
    def batch_shape(self) -> tuple[int, ...]:
        """Sizes of the leading batch axes, or () for one example. The first field with an array
        decides.
        """
        for field in dataclasses.fields(self):  # ty: ignore[invalid-argument-type]
            value = getattr(self, field.name)
            if isinstance(value, Batchable):
                return value.batch_shape
            rank = _annotated_rank(field.type)
            if rank is not None and hasattr(value, "shape"):
                return tuple(value.shape[: len(value.shape) - rank])
        return ()

    def __len__(self) -> int:
        """Returns the size of the first batch axis. Raises: TypeError for one example."""
        shape = self.batch_shape
        if shape:
            return shape[0]
        raise TypeError(
            f"this {type(self).__name__} is not a batch: it has no length and cannot be indexed or"
            " iterated"
        )

    def __bool__(self) -> bool:
        """Returns True, whatever the length, so that `if camera` asks whether there is a camera."""
        return True

    def __getitem__(self: B, index: Any) -> B:
        """Returns one example of a batch (for an integer), or a batch of some examples (for a
        slice, a mask or an array of integers), along the first axis.

        Raises: TypeError if this is no batch, and for an index of another kind, such as a list;
        IndexError for an integer out of range, also in an array. A traced index out of range is
        clamped by JAX.
        """
        size = len(self)
        if not isinstance(index, slice | Tracer) and getattr(index, "ndim", 0) == 0:
            index = operator.index(index)
        wrong = out_of_range(index, size)
        if len(wrong):
            raise IndexError(
                f"{type(self).__name__}: index {wrong[0]} is out of range for a batch of {size}"
            )
        return jax.tree.map(lambda leaf: taken(leaf, index), self)

    def __iter__(self: B) -> Iterator[B]:
        """Yields the examples of a batch, one by one. Raises: TypeError for one example."""
        return map(self.__getitem__, range(len(self)))


def types_and_marks(annotation: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """Returns the types that an annotation stands for, and the marks of its `Annotated` parts."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        options = [types_and_marks(each) for each in typing.get_args(annotation)]
        found = tuple(kind for kinds, _ in options for kind in kinds)
        return found, tuple(mark for _, marks in options for mark in marks)
    marks = getattr(annotation, "__metadata__", ())
    if not marks:
        return (annotation,), ()
    return types_and_marks(annotation.__origin__)[0], marks


def _annotated_rank(annotation: Any) -> int | None:
    """Returns the number of axes in the jaxtyping annotation of an array or an optional array. None
    for any other annotation.
    """
    for option in types_and_marks(annotation)[0]:
        dims = getattr(option, "dims", None)
        if isinstance(dims, tuple) and option.index_variadic is None:
            return len(dims)
    return None


def shape_fault(tree: Any) -> str | None:
    """Returns a text that says which field of a pytree dataclass does not fit its annotation:
    ".colors: expected shape ...". Returns None if all fit, or if the tree is no pytree dataclass.

    The rules:

    - Axes with one name have one size.
    - In a batch, arrays have further axes in front. Their number is the most frequent one among
      the arrays. Arrays without batch axes are allowed, too.
    - An array that is annotated as floating-point numbers holds no integers.
    - A static field that is an `int` holds a whole number.
    """
    cls, sizes = type(tree), dict[str, int]()
    if cls not in _PYTREES:
        return None
    fields, ranks = _annotated_fields(cls), []
    # how many axes each array has more than its annotation: a batch has as many as most of them
    for name, field in fields.items():
        shape = getattr(getattr(tree, name), "shape", None)
        if field.axes is not None and isinstance(shape, tuple):
            ranks.append(len(shape) - len(field.axes))
    usual = max(ranks, key=ranks.count, default=0)  # the first of equally many
    batch_rank = 0
    if issubclass(cls, Batchable):
        batch_rank = max(usual, 0)
    for name, field in fields.items():
        value = getattr(tree, name)
        if field.axes is None:
            fault = shape_fault(value)
        else:
            fault = _array_fault(value, field, batch_rank, sizes)
        if fault:
            return f".{name}{fault}"
    # sizes are whole numbers
    for static in dataclasses.fields(tree):
        value = getattr(tree, static.name)
        is_size = static.metadata.get("static") and static.type is int
        if is_size and not isinstance(value, int | np.integer):
            return f".{static.name}: expected a whole number, got {value!r}"
    return None


@dataclasses.dataclass(frozen=True)
class _Field:
    """What an annotation says about a field of a pytree."""

    axes: tuple[str | int, ...] | None
    """Names and sizes of the axes. None if the field is a pytree and not an array."""
    floating: bool
    """Whether the array must hold floating-point numbers."""
    optional: bool
    """Whether the field may be None."""


def _array_fault(value: Any, field: _Field, batch_rank: int, sizes: dict[str, int]) -> str | None:
    """Returns a text that says what is wrong with one array, or None.

    sizes: the known sizes of axes, by name. The sizes of this array's axes are added to it.
    """
    axes = field.axes
    assert axes is not None
    wanted = [sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in axes]
    if value is None and field.optional:
        return None
    # what is no array
    shape = getattr(value, "shape", None)
    if not isinstance(shape, tuple):
        if not axes and isinstance(value, int | float):
            return None  # a number is an array without axes
        kind = "None" if value is None else f"{type(value).__name__}; jnp.asarray makes one"
        return f": expected an array of shape {_shown_shape(wanted)}, got {kind}"
    # a leaf that a batch shares has no batch axes
    batch = batch_rank if len(shape) == batch_rank + len(axes) else 0
    fits = len(shape) == batch + len(axes)
    for want, size in zip(wanted, shape[batch:], strict=False):
        fits = fits and (isinstance(want, str) or want == size)
    if not fits:
        return f": expected shape {_shown_shape([*shape[:batch], *wanted])}, got {shape}"
    inexact = jnp.issubdtype(value.dtype, jnp.inexact) or value.dtype == jax.dtypes.float0
    if field.floating and not inexact:
        advice = "x.astype(float) makes them"
        if value.dtype == np.uint8:
            advice = "colors of 0 to 255 are divided by 255"
        return f": expected floating-point numbers, got {value.dtype}; {advice}"
    sizes |= {
        axis: size for axis, size in zip(axes, shape[batch:], strict=True) if isinstance(axis, str)
    }
    return None


def _shown_shape(axes: Sequence[str | int]) -> str:
    return f"({', '.join(map(str, axes))}{',' * (len(axes) == 1)})"


@functools.cache
def _annotated_fields(cls: Any) -> dict[str, _Field]:
    """Returns the annotations of the fields that are not static, by name. Arrays are left out if
    their annotation allows any shape.
    """
    found = {}
    for field in dataclasses.fields(cls):
        if field.metadata.get("static"):
            continue
        options, _ = types_and_marks(field.type)
        arrays = [x for x in options if hasattr(x, "dim_str")]
        optional = type(None) in options
        if not arrays:
            found[field.name] = _Field(None, False, optional)
            continue
        axes = annotated_axes(arrays[0])
        if axes is not None:
            found[field.name] = _Field(axes, all(map(is_floating, arrays)), optional)
    return found


def annotated_axes(array: Any) -> tuple[str | int, ...] | None:
    """Returns the names and sizes of the axes in a jaxtyping annotation. None if an axis is neither
    a name nor a number, as in "..." and "*b".
    """
    texts = str(array.dim_str).split()
    axes = tuple(int(text) if text.isdigit() else text for text in texts)
    if all(isinstance(axis, int) or axis.strip("_").isidentifier() for axis in axes):
        return axes
    return None


def is_floating(array: Any) -> bool:
    """Says whether a jaxtyping annotation stands for floating-point numbers only."""
    kinds = array.dtypes
    return isinstance(kinds, list | tuple) and all("float" in str(kind) for kind in kinds)


def replace(tree: T, **changes: Any) -> T:
    """Returns a copy of a pytree with other values of some fields. Shapes are not checked, so this
    also works on batches.

    Args:
        tree: an instance of a dataclass.
        **changes: new values by field.

    Returns:
        The changed copy.

    Raises:
        TypeError: for a name that is no field, and for an object that is no dataclass.

    Examples:
        >>> grey = hg.replace(gaussians, colors=jnp.full_like(gaussians.colors, 0.5))
    """
    names = {f.name for f in dataclasses.fields(tree)}  # ty: ignore[invalid-argument-type]
    unknown = set(changes) - names
    if unknown:
        raise TypeError(
            f"{type(tree).__name__} has no field {sorted(unknown)}; its fields are {sorted(names)}"
        )
    copy = object.__new__(type(tree))
    for name in names:
        object.__setattr__(copy, name, changes.get(name, getattr(tree, name)))
    return copy


def inexact_leaves(tree: Any) -> Iterator[tuple[str, Any]]:
    """Yields (path, leaf) of each floating-point array of a tree. A path looks like "cameras.K",
    and is "" for a bare array.
    """
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.inexact):
            yield jax.tree_util.keystr(path, simple=True, separator="."), leaf
