"""Compiled functions whose programs stay on disk from one command to the next.

JAX's cache keeps what XLA compiles, but finds it only by the lowered function. So a new process
traces and lowers each function again, which takes longer than reading its program. The program of a
function with the decorator `compiled` is found by the name of the function, the shapes of its
arguments, its static arguments and the source of the package. The function is not traced then.

Programs that come from JAX's own cache are not written, because XLA cannot write what it has read.
After an edit of the source, this concerns all functions whose programs stay the same: each process
traces them. A new version of the package begins with an empty cache, and keeps all programs again.

Programs are kept only in processes that call `core.processes.keep_programs`, as the console script
does, and only if JAX has one device, a CPU. Elsewhere `compiled` works as `jax.jit`. Notebooks
should not call `keep_programs`. A notebook may change a function of the package while it runs, and
the files of the package would not show this change.
"""

import contextlib
import dataclasses
import enum
import functools
import hashlib
import inspect
import os
import pickle
import re
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import serialize_executable

from humangs_jax.core.processes import (
    kept_programs,
    processor,
    source_at_start,
    source_has_changed,
)

T = TypeVar("T")

PACKAGE = Path(__file__).parents[1]
"""The folder of the package."""
MADE_BY = ("jax", "jaxlib", "flax", "numpy", "optax", "optimistix", "equinox", "lineax")
"""Packages whose versions are part of a program's name."""
KNOWN = (PACKAGE.name, "builtins", "types", "collections", *MADE_BY)
"""Packages whose classes and functions may be in the arguments of a program that is kept."""
SETTINGS = ("enable_x64", "default_matmul_precision")
"""Settings of JAX that a program depends on and that a block of code may change."""
DIGEST = hashlib.sha256().digest_size
"""Number of bytes of the hash at the beginning of each file. The hash shows whether the file is
damaged, because XLA would run a damaged program.
"""
HIT = "/jax/compilation_cache/cache_hits"
"""JAX's event for a program that it read from its own cache on disk."""


class Compiled(Generic[T]):
    """A function with the decorator `compiled`. It is compiled when it is called with arrays. In a
    transformation it becomes a part of the transformed program.

    As with `jax.jit`, a type checker accepts all arguments, because arrays may be NumPy's.
    """

    def __init__(
        self,
        function: Callable[..., T],
        static: Sequence[str],
        options: Callable[[], dict[str, Any] | None] | None,
    ) -> None:
        functools.update_wrapper(self, function)
        self.function: Any = function
        self.signature = inspect.signature(function)
        self.static = tuple(name for name in static if name in self.signature.parameters)
        self.options = options
        # by the key of a call: its program, and the function that will be compiled for it
        self._programs: dict[Any, Future[Any]] = {}
        self._functions: dict[Any, Any] = {}
        self._lock = threading.Lock()

    @functools.cached_property
    def jitted(self) -> Any:
        """The function as `jax.jit` compiles it. It is made late, because the options may depend on
        the device.
        """
        return self._jit(self.function)

    def _jitted_for(self, call: "_Call") -> Any:
        """Returns the function as `jax.jit` compiles it for the program of one call.

        JAX finds programs in memory by the function and the types of its arguments. Two of our
        calls may be one program to JAX (a number of Python and a weak array). With one function for
        each program, a program that was read from JAX's cache is never taken for one that was
        compiled.
        """
        if call.key in self._functions:
            return self._functions[call.key]

        @functools.wraps(self.function)
        def function(*args: Any, **kwargs: Any) -> Any:
            return self.function(*args, **kwargs)

        return self._functions.setdefault(call.key, self._jit(function))

    def _jit(self, function: Callable[..., Any]) -> Any:
        """Returns a function as `jax.jit` compiles it."""
        options = None if self.options is None else self.options()
        return jax.jit(function, static_argnames=self.static, compiler_options=options)

    def __call__(self, *args: Any, **kwargs: Any) -> T:
        """Returns the result of the function."""
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((args, kwargs))):
            # JAX ignores the compiler options of an inner function
            return (self.function if self.options else self.jitted)(*args, **kwargs)
        call = self._call(args, kwargs)
        program = None if call is None else self._program(call)
        if call is None or program is None:
            return self.jitted(*args, **kwargs)
        return program(*call.args, **call.kwargs)

    def __reduce__(self) -> str:
        """Pickles the function by its name, as Python pickles functions."""
        return self.function.__qualname__

    def lower(self, *args: Any, **kwargs: Any) -> Any:
        """Returns the lowered function, as `lower` of a function of `jax.jit` does."""
        return self.jitted.lower(*args, **kwargs)

    def eval_shape(self, *args: Any, **kwargs: Any) -> Any:
        """Returns the shapes of the result, as `jax.eval_shape`. They are kept on disk if programs
        are.
        """
        call = self._call(args, kwargs)
        file = None if call is None else self._file(call, "shapes")
        if call is None or file is None:
            return self.jitted.eval_shape(*args, **kwargs)
        with contextlib.suppress(Exception):
            return _read(file)
        shapes = self._jitted_for(call).eval_shape(*args, **kwargs)
        with contextlib.suppress(Exception):
            _write(file, pickle.dumps(shapes))
        return shapes

    def prepare(self, *args: Any, **kwargs: Any) -> None:
        """Compiles the program of these arguments, or reads it, so that a later call need not.
        Arrays may be `jax.ShapeDtypeStruct`.
        """
        call = self._call(args, kwargs)
        if call is None or self._program(call) is None:
            self.jitted.lower(*args, **kwargs).compile()

    def _call(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> "_Call | None":
        """Returns the arguments of a call apart from the static ones, and what its program depends
        on. None if programs are not kept, if an argument is neither an array nor a number, or if
        one of JAX's settings `jax_disable_jit` and `jax_debug_nans` is on.
        """
        folder = _folder()
        # under these settings JAX calls the function itself, to find faults
        if folder is None or jax.config.jax_disable_jit or jax.config.jax_debug_nans:
            return None
        bound = self.signature.bind(*args, **kwargs)
        names = tuple(self.signature.parameters)
        static = {name: bound.arguments[name] for name in self.static if name in bound.arguments}
        dynamic = tuple(
            value for name, value in zip(names, bound.args, strict=False) if name not in static
        )
        named = {name: value for name, value in bound.kwargs.items() if name not in static}
        leaves, tree = jax.tree.flatten((dynamic, named))
        shapes = tuple(map(_shape, leaves))
        if None in shapes:
            return None
        # 2 equals 2.0, but their programs differ
        fixed = tuple((name, type(value), value) for name, value in static.items())
        settings = [getattr(jax.config, f"jax_{name}") for name in SETTINGS]
        return _Call(folder, bound, dynamic, named, (tree, shapes, fixed, *settings))

    def _program(self, call: "_Call") -> Callable[..., T] | None:
        """Returns the program of a call. If another thread is making it, waits for it. None if
        `_made` returns None.
        """
        own: Future[Any] = Future()
        # Ctrl-C may come at any time, and must leave nothing that other threads would wait for
        try:
            with self._lock:
                future = self._programs.setdefault(call.key, own)
            if future is own:
                own.set_result(self._made(call))
        except BaseException as error:
            with self._lock:
                if self._programs.get(call.key) is own:
                    del self._programs[call.key]
            if not own.done():
                own.set_exception(error if isinstance(error, Exception) else CancelledError())
            raise
        return future.result()

    def _made(self, call: "_Call") -> Callable[..., T] | None:
        """Reads the program of a call from disk, or compiles it. A compiled program is written to
        disk if other processes can use it. Returns None if the program depends on something that
        has no stable text.
        """
        file = self._file(call, "program")
        if file is None:
            return None
        # a file that cannot be read is made anew
        with contextlib.suppress(Exception):
            return serialize_executable.deserialize_and_load(*_read(file))
        jitted = self._jitted_for(call)
        del self._functions[call.key]  # if this fails, the next attempt gets another function
        lowered = jitted.lower(*call.bound.args, **call.bound.kwargs)
        hits = _hits.count
        program = lowered.compile()
        # XLA cannot write what it has read: the file would lack the functions of the program, and
        # the first call of another process would fail
        if _hits.count == hits and _stands_alone(lowered.as_text()):
            with contextlib.suppress(Exception):
                _write(file, pickle.dumps(serialize_executable.serialize(program)))
        return program

    def _file(self, call: "_Call", kind: str) -> Path | None:
        """Returns the path of the file that keeps the program or the shapes of a call. None if what
        the call depends on has no stable text. kind: "program" or "shapes".
        """
        function = f"{self.function.__module__}.{self.function.__qualname__}"
        options = None if self.options is None else self.options()
        try:
            about = _stable((kind, function, call.key, options))
        except TypeError:
            return None
        name = hashlib.sha256(f"{_surroundings()}\n{about}".encode()).hexdigest()[:32]
        return call.folder / f"{self.function.__name__}-{name}-cache"


def compiled(
    *, static: Sequence[str] = (), options: Callable[[], dict[str, Any] | None] | None = None
) -> Callable[[Callable[..., T]], Compiled[T]]:
    """Returns a decorator that compiles a function when it is called with arrays. If the process
    keeps programs (`core.processes.keep_programs`), those of the function stay on disk where other
    processes can use them.

    The function must depend on nothing but its arguments and the source of the package.

    Args:
        static: names of static parameters. Those that a function does not have are ignored.
        options: a function without arguments that returns the options of XLA. It is called when
            the function is first compiled, lowered or asked for its shapes, and not before.

    Examples:
        >>> @compiled(static=["config"])
        ... def scaled(x, config):
        ...     return config * x
    """
    return lambda function: Compiled(function, static, options)


class _Hits(threading.local):
    """Counts the programs that JAX read from its own cache, for each thread."""

    count = 0

    def note(self, event: str, **kwargs: Any) -> None:
        """Counts an event of JAX."""
        self.count += event == HIT


_hits = _Hits()


@functools.cache
def _folder() -> Path | None:
    """Returns the folder of the programs that this process keeps. None if it keeps none, or if JAX
    has other devices in this process than one CPU.
    """
    folder = kept_programs()
    if folder is None or jax.default_backend() != "cpu" or jax.local_device_count() > 1:
        return None
    jax.monitoring.register_event_listener(_hits.note)
    # jaxlib finds LAPACK when it lowers the first function that calls it: a program that is read
    # would call nothing, and the process would crash
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float32))
    return folder


@dataclasses.dataclass(frozen=True, eq=False)
class _Call:
    """A call of a compiled function whose program may be kept."""

    folder: Path
    """The folder of programs."""
    bound: inspect.BoundArguments
    """All arguments."""
    args: tuple[Any, ...]
    """Positional arguments that are not static."""
    kwargs: dict[str, Any]
    """Keyword arguments that are not static."""
    key: tuple[Any, ...]
    """What the program depends on: the tree of the arguments, the shapes and types of its leaves,
    the static arguments, and the values of `SETTINGS`.
    """


def _stands_alone(program: str) -> bool:
    """Returns whether a lowered program calls nothing but XLA and LAPACK. A program that calls
    functions of Python would crash in another process, which does not have these functions.
    """
    called = re.findall(r"custom_call @(\S+)", program)
    return all(name.startswith("lapack_") for name in called)


def _shape(leaf: Any) -> tuple[Any, ...] | None:
    """Returns the shape and the type of an array, and whether the type is weak. For a number of
    Python, returns the name of its class. None for any other argument.
    """
    if isinstance(leaf, jax.Array | jax.ShapeDtypeStruct):
        weak = getattr(leaf, "weak_type", False)  # keys of random numbers have none
        return leaf.shape, str(leaf.dtype), bool(weak)
    if isinstance(leaf, np.ndarray | np.generic):
        return leaf.shape, str(jax.dtypes.canonicalize_dtype(leaf.dtype)), False
    if isinstance(leaf, bool | int | float | complex):
        return (type(leaf).__name__,)
    return None


def _stable(value: Any) -> str:
    """Returns a text for a value. Values with the same text are equal, also if they are values of
    two processes.

    Raises: TypeError for values of classes that are not in a package of `KNOWN`, because their
    source may change, and for arrays of JAX. Also for functions and classes that were made inside
    of a function.
    """
    # values of Python
    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        return repr(value)
    if isinstance(value, enum.Enum):
        return f"{_name(type(value))}.{value.name}"
    if isinstance(value, tuple | list):
        return f"{_name(type(value))}({','.join(map(_stable, value))})"
    if isinstance(value, set | frozenset):
        return f"{_name(type(value))}({','.join(sorted(map(_stable, value)))})"
    if isinstance(value, Mapping):
        items = ",".join(f"{_stable(key)}:{_stable(item)}" for key, item in value.items())
        return f"{_name(type(value))}({items})"
    # arrays, and the trees that hold them
    if isinstance(value, np.dtype):
        return str(value)
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(value.tobytes()).hexdigest()
        return f"{value.dtype}{value.shape}{digest}"
    if isinstance(value, jax.tree_util.PyTreeDef):
        node = value.node_data()
        if node is None:
            return "*"
        return f"{_stable(node)}({','.join(map(_stable, value.children()))})"
    # what the package defines
    if isinstance(value, type) or inspect.isfunction(value):
        return _name(value)
    if dataclasses.is_dataclass(value):
        fields = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return f"{_name(type(value))}({_stable(fields)})"
    raise TypeError(f"{type(value).__name__}: expected what has a stable text")


def _name(thing: Any) -> str:
    """Returns the name of a class or function of a package in `KNOWN`.

    Raises: TypeError for one of another package, or one that was made inside of a function.
    """
    name = f"{thing.__module__}.{thing.__qualname__}"
    if name.partition(".")[0] not in KNOWN or "<" in name:
        raise TypeError(f"{name}: expected a class or function of the package")
    return name


@functools.cache
def _surroundings() -> str:
    """Returns what all programs depend on: the source of the package, the versions of what compiles
    it, and the settings of JAX and XLA in environment variables.
    """
    settings = {
        name: value
        for name, value in sorted(os.environ.items())
        if name.startswith(("JAX_", "XLA_")) and "CACHE" not in name
    }
    versions = {name: version(name) for name in MADE_BY}
    return f"{source_at_start()} {processor()} {versions} {settings}"


def _read(file: Path) -> Any:
    """Returns what a file holds, and marks the file as used, because `keep_programs` first deletes
    the files that were not used for longest.

    Raises: OSError; ValueError if the file is damaged; anything that pickle raises.
    """
    data = file.read_bytes()
    if hashlib.sha256(data[DIGEST:]).digest() != data[:DIGEST]:
        raise ValueError(f"{file}: damaged")
    value = pickle.loads(data[DIGEST:])
    with contextlib.suppress(OSError):  # a disk that is read only
        os.utime(file)
    return value


def _write(file: Path, data: bytes) -> None:
    """Writes a file under a temporary name and renames it, so that no other process reads a part of
    it. Writes nothing if the source has changed since the process began: the program may be that of
    either source.
    """
    if source_has_changed():
        return
    with tempfile.NamedTemporaryFile(dir=file.parent, suffix="-cache", delete=False) as temporary:
        try:
            temporary.write(hashlib.sha256(data).digest() + data)
            temporary.close()
            os.replace(temporary.name, file)
        except BaseException:
            temporary.close()
            Path(temporary.name).unlink(missing_ok=True)  # Ctrl-C may come when it has its name
            raise
