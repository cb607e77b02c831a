"""Checks what users hand in: arguments must be of the right class with shapes that fit each other,
and values must be finite and in range.

    render(gaussians, camera, ...): gaussians: expected Gaussians, got Avatar; animate(avatar, pose)
    poses them
    ValueError: render: gaussians.opacities: expected numbers in [0, 1], but 2 of 52375 are not, the
        first at [17]: nan

Classes and shapes are known inside of `jit`, `vmap` and `grad`, too, and checking them computes
nothing. Values are known only outside of these transformations, and are not checked inside. So no
setting is needed that turns the checks off.
"""

import dataclasses
import functools
import inspect
import math
import os
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from humangs_jax.core.array_types import Array, Shaped
from humangs_jax.core.arrays import on_host
from humangs_jax.core.pytree import shape_fault

P = ParamSpec("P")
T = TypeVar("T")
NUMBERS = (int, float, complex, bool)
"""Classes of numbers. An argument that is annotated with one is not checked, because numbers of
numpy and JAX are accepted, too.
"""
SEQUENCES = {list: Sequence, Sequence: Sequence, Iterable: Iterable, os.PathLike: os.PathLike}
"""Generic classes that may be checked in annotations -> the class that a value must have. Items of
sequences are not checked.
"""
HINTS = {
    ("Gaussians", "Avatar"): "animate(avatar, pose) poses them",
    ("Avatar", "Gaussians"): "an Avatar has what they need to be posed",
    ("Avatar", "tuple"): "reconstruct_views returns (avatar, dropped)",
    ("Avatar", "list"): "one at a time",
    ("Avatar", "Reconstructed"): "it has one, .avatar",
    ("Camera", "Capture"): "it has a batch of them, capture.cameras",
    ("Camera", "list"): "stack_cameras makes a batch of them",
    ("BodyPose", "Capture"): "capture.pose(frame) is one",
    ("BodyPose", "Motion"): "motion.pose(frame) is one",
    ("SubjectViews", "Capture"): "stack_captures makes them",
    ("Sequence", "Camera"): "a list of cameras",
    ("Sequence", "Capture"): "a list of captures",
    ("HumanGSConfig", "tuple"): "load_weights returns (variables, config)",
}
"""Advice in an error message, by the names of the expected class and of the given class."""


def checked_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Decorates a function so that each call checks the classes of its arguments, and the shapes of
    the arrays in them.

    A parameter is checked if its annotation names only plain classes and sequences, or only arrays.
    None may be among them. Parameters for numbers and callables are not checked. For an array, only
    the number of axes is checked.

    Raises:
        TypeError: of one line, for an argument of another class, for a value without a shape where
            an array is expected, for an argument that the function does not have, and for a missing
            argument.
        ValueError: for an array with another number of axes, for a pytree that does not fit its
            annotations (`shape_fault`), and for a batch where the function takes one example
            (`one_at_a_time`).
    """
    # annotations are read once, when the function is defined
    signature = inspect.signature(function)
    annotations = {name: p.annotation for name, p in signature.parameters.items()}
    classes_of = {name: _classes(annotation) for name, annotation in annotations.items()}
    arrays_of = {name: _arrays(annotation) for name, annotation in annotations.items()}
    expected = {name: found for name, found in classes_of.items() if found}
    arrays = {name: found for name, found in arrays_of.items() if found}
    call = _call(function, signature)

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise TypeError(
                f"{call}: {_of_a_field(kwargs, signature, expected) or error}"
            ) from None
        # classes first, then whether one or many are expected, then shapes
        for name, classes in expected.items():
            if name not in given:
                continue
            value = given[name]
            if not isinstance(value, classes):
                raise TypeError(f"{call}: {name}: {_other_class(classes, value)}")
            if getattr(value, "one_at_a_time", False) and value.batch_shape:
                raise ValueError(
                    f"{call}: {name}: expected one {type(value).__name__}, got a batch"
                    f" {value.batch_shape}: take one, {name}[0], or use jax.vmap"
                )
            fault = shape_fault(value)
            if fault:
                raise ValueError(f"{call}: {name}{fault}")
        for name in arrays.keys() & given.keys():
            fault = _no_array(arrays[name], given[name])
            if fault:
                error = ValueError if hasattr(given[name], "shape") else TypeError
                raise error(f"{call}: {name}: {fault}")
        return function(*args, **kwargs)

    return checked


def _arrays(annotation: Any) -> tuple[Any, ...]:
    """Returns the array types that an annotation stands for, and NoneType if None is allowed. Empty
    if the annotation allows anything else.
    """
    options = typing.get_args(annotation) or (annotation,)
    known = all(hasattr(x, "dims") or x is type(None) for x in options)
    if known and any(hasattr(x, "dims") for x in options):
        return options
    return ()


def _no_array(options: tuple[Any, ...], value: Any) -> str | None:
    """Returns a text that says why a value is not the expected array. Returns None if the value
    fits. Only the number of axes is compared. A number counts as an array without axes.
    """
    if value is None and type(None) in options:
        return None
    types_ = [x for x in options if hasattr(x, "dims")]
    shape = getattr(value, "shape", None)
    if shape is None and isinstance(value, NUMBERS):
        shape = ()
    ranks = {len(x.dims) for x in types_ if isinstance(x.dims, tuple) and x.index_variadic is None}
    if shape is not None and (len(ranks) < len(types_) or len(shape) in ranks):
        return None
    axes = " or ".join(f"({', '.join(str(x.dim_str).split())})" for x in types_)
    if shape is None:
        given = f"{type(value).__name__}; jnp.asarray makes one"
    else:
        given = str(shape)
    return f"expected an array of shape {axes}, got {given}"


def _classes(annotation: Any) -> tuple[type, ...]:
    """Returns the classes that an annotation stands for. Empty if `isinstance` cannot check the
    annotation, or if one of its classes is in `NUMBERS`.
    """
    union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    options = typing.get_args(annotation) if union else (annotation,)
    options = tuple(SEQUENCES.get(typing.get_origin(x), x) for x in options)
    plain = [
        isinstance(x, type) and not typing.get_args(x) and not hasattr(x, "dims") for x in options
    ]
    known = [x not in (*NUMBERS, inspect.Parameter.empty, object, Any) for x in options]
    protocol = [
        getattr(x, "_is_protocol", False) and not getattr(x, "_is_runtime_protocol", False)
        for x in options
    ]
    if all(plain) and all(known) and not any(protocol):
        return options
    return ()


def _call(function: Callable[..., Any], signature: inspect.Signature) -> str:
    """Returns the call of a function as text: its positional parameters without a default, then
    dots if it has others.
    """
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    parameters = signature.parameters.values()
    needed = [
        p.name for p in parameters if p.kind in kinds and p.default is inspect.Parameter.empty
    ]
    more = []
    if len(needed) < len(parameters):
        more = ["..."]
    return f"{getattr(function, '__name__', 'function')}({', '.join(needed + more)})"


def _other_class(classes: tuple[type, ...], value: Any) -> str:
    names = [x.__name__ for x in classes if x is not type(None)]
    if value is None:
        given = "None"
    elif isinstance(value, type):
        given = value.__name__
    else:
        given = type(value).__name__
    if isinstance(value, str):
        shown = f" {value!r}"
    elif isinstance(value, type):
        shown = f" the class {given}"
    else:
        shown = f" {given}"
    hints = [HINTS[name, given] for name in names if (name, given) in HINTS]
    hint = f"; {hints[0]}" if hints else ""
    return f"expected {' or '.join(names)}, got{shown}{hint}"


def _of_a_field(
    keywords: Any, signature: inspect.Signature, expected: dict[str, tuple[type, ...]]
) -> str | None:
    """Returns a text about the first keyword that is no parameter of the function, or None. If it
    is a field of one of the function's configurations, the text says so.
    """
    for name in keywords:
        if name in signature.parameters:
            continue
        for parameter, classes in expected.items():
            for x in classes:
                if dataclasses.is_dataclass(x) and name in x.__dataclass_fields__:
                    return (
                        f"no argument {name!r}: it is a field of {x.__name__},"
                        f" {parameter}={x.__name__}({name}=...)"
                    )
        return f"no argument {name!r}; its arguments are {', '.join(signature.parameters)}"
    return None


class Values(NamedTuple):
    """The values that the entries of an array may have: finite numbers in [low, high]."""

    words: str
    """Description of these values in an error message."""
    low: float = -math.inf
    """Smallest number."""
    high: float = math.inf
    """Largest number."""


FINITE = Values("finite numbers")
LARGEST = 1e6
"""Largest number in avatars and in their files, in metres or any other unit. No person is larger,
and float32 holds products of several such numbers.
"""
BOUNDED = Values(f"finite numbers of at most {LARGEST:g} in magnitude", -LARGEST, LARGEST)
ROUNDING = 1e-6
"""Distance by which numbers may lie outside of [0, 1] or [-1, 1]. It is a few float32 roundings, as
in resized photos and in opacities from a sigmoid.
"""
UNIT = Values("numbers in [0, 1]", -ROUNDING, 1 + ROUNDING)
SIGNED_UNIT = Values("numbers in [-1, 1]", -1 - ROUNDING, 1 + ROUNDING)
NOT_NEGATIVE = Values("finite numbers >= 0", 0.0)
POSITIVE = Values("finite numbers > 0", math.ulp(0.0))


def check_values(
    owner: str,
    arrays: Mapping[str, tuple[Shaped[Array, "..."] | Shaped[np.ndarray, "..."] | None, Values]],
) -> None:
    """Checks that the numbers in arrays are finite and in their ranges. Nothing is checked if one
    of the arrays is traced.

    Arrays of JAX on an accelerator are reduced there by one program, which returns two numbers for
    each array. Other arrays are checked on the host, without a copy.

    Arguments: owner: the function that was called, for the message. arrays: each array with the
    values that its entries may have, by the name of the array in the message. None and empty arrays
    pass.

    Raises: ValueError if an entry is wrong. The message has the name of the first array with wrong
    entries, their number, and the place of the first of them.
    """
    given = {
        name: (array, values)
        for name, (array, values) in arrays.items()
        if array is not None and array.size
    }
    if any(isinstance(array, Tracer) for array, _ in given.values()):
        return
    on_device, extremes = {}, {}
    for name, (array, _) in given.items():
        if on_host(array):
            numbers = np.asarray(array)
            extremes[name] = numbers.min(), numbers.max()
        else:
            on_device[name] = array
    if on_device:
        extremes |= zip(on_device, np.asarray(_extremes(tuple(on_device.values()))), strict=True)
    for name, (array, values) in given.items():
        low, high = (float(extreme) for extreme in extremes[name])  # NaN if any entry is
        if not (
            math.isfinite(low) and math.isfinite(high) and values.low <= low and high <= values.high
        ):
            raise ValueError(f"{owner}: {name}: {_fault(np.asarray(array, np.float64), values)}")


def require_concrete(owner: str, why: str, *trees: Any) -> None:
    """Checks that no array in some pytrees is traced.

    owner: the function that was called. why: text that says why it needs values. Raises: TypeError
    of one line.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees)):
        raise TypeError(
            f"{owner} {why}: call it outside of jit, vmap and grad, which know shapes only"
        )


@jax.jit
def _extremes(arrays: tuple[Array, ...]) -> Array:
    """Returns the smallest and the largest entry of each array, (arrays, 2). Both are NaN if an
    entry is.
    """
    return jnp.stack([jnp.stack([jnp.min(array), jnp.max(array)]) for array in arrays])


def _fault(array: np.ndarray, values: Values) -> str:
    wrong = ~(np.isfinite(array) & (array >= values.low) & (array <= values.high))
    first = np.argwhere(wrong)[0]
    place = ""
    if array.ndim:
        place = f"the first at {first.tolist()}: "
    return (
        f"expected {values.words}, but {wrong.sum()} of {wrong.size} are not,"
        f" {place}{array[tuple(first)]:.9g}"
    )
