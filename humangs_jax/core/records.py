"""Checks records by the annotations of their fields. For example:

    opacities: Annotated[Float[Array, " g"], UNIT]

The array has one axis, its numbers are in [0, 1], and all axes that are named g have one size.
Without a mark such as UNIT, numbers of floating-point arrays only have to be finite. A record may
be a field of another one. It is checked, too, if a mark names its batch axes: `Annotated[Camera,
Batch("v")]`.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jax.core import Tracer

from humangs_jax.core.checks import FINITE, Values, check_values
from humangs_jax.core.pytree import annotated_axes, is_floating, types_and_marks


class Part(NamedTuple):
    """A mark in the annotation of an array. It names a part of the array that has to hold other
    values than the rest.
    """

    words: str
    """Name of the part in an error. It stands after the array's name."""
    take: Callable[[np.ndarray], np.ndarray]
    """Function that returns the part of an array on the host."""
    values: Values
    """The values that the part's entries may have."""


class Batch(NamedTuple):
    """Marks a field that is itself a record, and names the batch axes that all arrays of that
    record have in front: `cameras: Annotated[Camera, Batch("v")]`.
    """

    axes: str
    """Names of the axes, separated by spaces."""


class ArrayField(NamedTuple):
    """What the annotation of a field says about the field's array."""

    axes: tuple[str | int, ...] | None
    """Names and sizes of the axes. None: any axes."""
    values: Values | None
    """Values that the entries may have. None: the entries are not checked, because they are not
    floating-point numbers and have no mark.
    """
    parts: tuple[Part, ...]
    """Parts of the array that are checked in addition."""

    def shape(self, array: Any, sizes: dict[str, int]) -> tuple[int | str, ...]:
        """Returns the shape that an array should have. If the size of an axis is not known, the
        axis's name is in its place.

        sizes: the known sizes of axes by name. If the array has as many axes as expected, the sizes
        of its axes that are not in `sizes` yet are added to it.
        """
        own = np.shape(array)
        if self.axes is None:
            return own
        if len(own) == len(self.axes):
            for axis, size in zip(self.axes, own, strict=True):
                if isinstance(axis, str):
                    sizes.setdefault(axis, size)
        return tuple(sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in self.axes)

    def checks(self, array: Any, label: str) -> dict[str, tuple[Any, Values]]:
        """Returns the array and its parts by name, each with the values that it may have, for
        `check_values`. Empty if the array is None or is not checked.
        """
        if array is None or self.values is None:
            return {}
        found = {label: (array, self.values)}
        if not isinstance(array, Tracer):
            for part in self.parts:
                found[f"{label} {part.words}"] = part.take(np.asarray(array)), part.values
        return found


@functools.cache
def array_fields(record: Any) -> dict[str, ArrayField]:
    """Returns the annotations of all arrays in a class of records, by names such as "images" and
    "cameras.K". If a field holds another record and is marked by a `Batch`, the arrays of that
    record are included.
    """
    found = {}
    for field in dataclasses.fields(record):
        types_, marks = types_and_marks(field.type)
        # a record in the record, whose arrays have some axes more
        for batch in (mark.axes.split() for mark in marks if isinstance(mark, Batch)):
            for name, inner in array_fields(types_[0]).items():
                axes = None if inner.axes is None else (*batch, *inner.axes)
                found[f"{field.name}.{name}"] = inner._replace(axes=axes)

        # an array: its axes, and what its entries may be
        arrays = [each for each in types_ if hasattr(each, "dim_str")]
        if not arrays or field.metadata.get("static"):
            continue
        values = next((mark for mark in marks if isinstance(mark, Values)), None)
        if values is None and is_floating(arrays[0]):
            values = FINITE
        parts = tuple(mark for mark in marks if isinstance(mark, Part))
        found[field.name] = ArrayField(annotated_axes(arrays[0]), values, parts)
    return found


def record_values(
    record: Any, name: str, *, on_host: bool = False
) -> dict[str, tuple[Any, Values]]:
    """Returns the arrays of a record with the values that each may have, by name, for
    `check_values`.

    Arguments: record: a dataclass, or None, which has no arrays. name: name of the record in
    errors. on_host: whether to bring all arrays to the host first. This is faster for small arrays.
    """
    found: dict[str, tuple[Any, Values]] = {}
    if record is None:
        return found
    for field, annotated in array_fields(type(record)).items():
        array = operator.attrgetter(field)(record)
        if on_host and array is not None and not isinstance(array, Tracer):
            array = np.asarray(array)
        found |= annotated.checks(array, f"{name}.{field}")
    return found


def check_record(record: Any, owner: str, sizes: Mapping[str, int] | None = None) -> None:
    """Checks the shapes and the values of a record, and of the records in it that `array_fields`
    includes. Arrays that are None pass.

    Arguments: record: a dataclass whose arrays are annotated. owner: the caller, for the message.
    sizes: known sizes of axes. Other axes are as long as in the first array that has them.

    Raises: ValueError of one line, which names the array, what was expected, and what it has.
    """
    known, values = dict(sizes or {}), {}
    for name, annotated in array_fields(type(record)).items():
        array = operator.attrgetter(name)(record)
        if array is None:
            continue
        expected, found = annotated.shape(array, known), np.shape(array)
        if found != expected:
            shown = f"({', '.join(map(str, expected))}{',' * (len(expected) == 1)})"
            raise ValueError(f"{owner}: {name}: expected shape {shown}, got {found}")
        values |= annotated.checks(array, name)
    check_values(owner, values)
