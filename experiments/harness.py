"""`python -m experiments NAME [options]`: one way to run all measurements. `python -m experiments`
lists them.

An experiment is a function with `@entry`. Its first argument is a `Run`, the others are its
options: those without a default are positional, annotations are numbers, paths, flags, `Literal`
choices and tuples of these. A default that is a dataclass becomes one option for each of its
fields. Lines `name: text` below `Options:` in a docstring are the help.

Its table has its name, unless a line `Tables: NAMES` of the docstring says otherwise.

Every experiment has --json OUT (rows, numbers, date, machine, versions; finished rows of the same
settings are kept) and --publish (docs/results/TABLE.json, and the page that shows the table).
"""

import argparse
import ast
import contextlib
import dataclasses
import importlib
import inspect
import json
import re
import traceback
import types
import typing
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from types import FunctionType
from typing import Any

from experiments.results import page_of, publish, run_record, write_json

FOLDER = Path(__file__).parent
Row = Any


def entry(function: FunctionType) -> FunctionType:
    """Marks an experiment: `listed` finds it by the name of the function."""
    return function


def summary(docstring: str | None) -> str:
    """The first paragraph of a docstring, on one line."""
    paragraph, _, _ = (docstring or "").partition("\n\n")
    return " ".join(paragraph.split())


def listed() -> dict[str, tuple[str, str]]:
    """Name -> (module, first paragraph of the docstring), without importing anything."""
    found = {}
    for path in sorted(FOLDER.rglob("*.py")):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef) and any(
                ast.unparse(d) == "entry" for d in node.decorator_list
            ):
                module = ".".join(("experiments", *path.relative_to(FOLDER).with_suffix("").parts))
                found[node.name] = module, summary(ast.get_docstring(node))
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; the exit status."""
    known = listed()
    parser = argparse.ArgumentParser(prog="python -m experiments", description=summary(__doc__))
    parser.add_argument("name", nargs="?", help="without one, all are listed")
    parser.add_argument("options", nargs=argparse.REMAINDER)
    asked = parser.parse_args(arguments)
    if asked.name is None:
        width = max(map(len, known))
        print("\n".join(f"{name:{width}}  {line}" for name, (_, line) in sorted(known.items())))
        return 0
    if asked.name not in known:
        parser.error(f"no experiment {asked.name}: expected one of {', '.join(sorted(known))}")
    from experiments.timing import prepare_process

    prepare_process()
    return call(getattr(importlib.import_module(known[asked.name][0]), asked.name), asked.options)


def call(function: FunctionType, options: Sequence[str]) -> int:
    """Runs an experiment; what it returns is the exit status (None: 0).

    Wrong options and files: one line, and status 2.
    """
    parser, given = parser_of(function)
    asked = parser.parse_args(options)
    run = Run(function.__name__, asked.table, asked.json, asked.publish, list(options))
    try:
        if asked.publish:  # before long work
            named = re.findall(r"^Tables?: ([\w, ]+)", inspect.getdoc(function) or "", re.MULTILINE)
            own = asked.table == function.__name__ and named
            for table in named[0].split(", ") if own else [asked.table]:
                page_of(table)
        return function(run, **{name: make(asked) for name, make in given.items()}) or 0
    except (ValueError, OSError) as error:
        traceback.print_exc()
        parser.error(str(error))


def parser_of(
    function: FunctionType,
) -> tuple[argparse.ArgumentParser, dict[str, Callable[[Any], Any]]]:
    """The options of an experiment, and for each parameter what makes its value of them."""
    text = inspect.getdoc(function) or ""
    parser = argparse.ArgumentParser(
        prog=f"python -m experiments {function.__name__}",
        description=text.split("Options:")[0],
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    given = _add_parameters(parser, function)
    parser.add_argument(
        "--json", type=Path, metavar="OUT", help="rows and numbers; rows already there are kept"
    )
    parser.add_argument("--publish", action="store_true", help="write docs/results and the page")
    parser.add_argument("--table", default=function.__name__, help="name of the table on the page")
    return parser, given


def _add_parameters(parser, function):
    """Adds options; name of a parameter -> its value from the namespace."""
    given, kinds, texts = {}, typing.get_type_hints(function), _helps(function)
    for name, parameter in list(inspect.signature(function).parameters.items())[1:]:
        default = parameter.default
        if dataclasses.is_dataclass(default):
            fields = [field.name for field in dataclasses.fields(default)]
            kinds_of, texts_of = typing.get_type_hints(type(default)), _helps(type(default))
            for field in fields:
                _add_option(
                    parser, field, kinds_of[field], getattr(default, field), texts_of.get(field, "")
                )
            given[name] = lambda asked, d=default, f=fields: dataclasses.replace(
                d, **{n: getattr(asked, n) for n in f}
            )
        else:
            _add_option(parser, name, kinds[name], default, texts.get(name, ""))
            given[name] = lambda asked, name=name: getattr(asked, name)
    return given


def _add_option(parser, name, kind, default, text):
    required, many = default is inspect.Parameter.empty, typing.get_origin(kind) is tuple
    options: dict[str, Any] = {} if required else {"default": default}
    if many:
        kind, options["nargs"] = typing.get_args(kind)[0], "+" if required else "*"
        options["action"] = _Tuple
    elif isinstance(kind, types.UnionType):
        kind = next(each for each in typing.get_args(kind) if each is not type(None))
    if typing.get_origin(kind) is typing.Literal:
        options["choices"], kind = typing.get_args(kind), type(typing.get_args(kind)[0])
    if kind is bool:
        options["action"] = argparse.BooleanOptionalAction
    else:
        options["type"] = kind
    shown = "" if required or default in (None, (), False) else " (default: %(default)s)"
    parser.add_argument(
        name if required else f"--{name.replace('_', '-')}", help=text + shown, **options
    )


class _Tuple(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        setattr(namespace, self.dest, tuple(values))


def _helps(documented) -> dict[str, str]:
    """Option -> its line; of a class also those of its bases."""
    found = {}
    for one in reversed(getattr(documented, "__mro__", (documented,))):
        _, _, text = (inspect.getdoc(one) or "").partition("Options:")
        found |= re.findall(r"^ *(\w+): (.*(?:\n(?! *\w+: ).+)*)", text, re.MULTILINE)
    return {name: " ".join(line.split()).replace("%", "%%") for name, line in found.items()}


@dataclasses.dataclass(eq=False)
class Run:
    """What the harness does for a running experiment. Without options: nothing is written."""

    name: str = ""
    table: str = ""
    json: Path | None = None
    publish: bool = False
    options: Sequence[str] = ()
    pictures: dict[str, Any] = dataclasses.field(default_factory=dict)
    """What cases gave beside their rows."""
    _written: dict[str, Any] = dataclasses.field(default_factory=dict)

    def rows(
        self,
        cases: Mapping[str, Callable[[], Row]],
        settings: Mapping[str, Any] | None = None,
        again: bool = False,
    ) -> dict[str, Row]:
        """Rows of all cases. Those that --json OUT has with the same settings are not measured
        again; it is written after each.

        A case may give (row, pictures); these go to `pictures`. again: all cases are measured, for
        the pictures.
        Raises: ValueError if OUT is no file of this harness.
        """
        from humangs_jax.core.progress import bar

        settings = json.loads(json.dumps(settings or {}))
        kept = self._kept(settings)
        self._written |= {"settings": settings, "rows": kept}
        for name in bar(list(cases), desc=self.name, unit="case"):
            if name not in kept or again:
                found = cases[name]()
                kept[name], self.pictures[name] = (
                    found if isinstance(found, tuple) else (found, None)
                )
                self._write()
        return {name: kept[name] for name in cases}

    def _kept(self, settings):
        if self.json is None or not self.json.exists():
            return {}
        try:
            stored = json.loads(self.json.read_text())
            old, rows = stored["settings"], stored["rows"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{self.json}: expected the JSON of an earlier run, or no file: {error}"
            ) from error
        if old != settings:
            print(f"{self.json}: made with other settings, so it is replaced")
            return {}
        return {
            name: row
            for name, row in rows.items()
            if not (isinstance(row, dict) and "failed" in row)
        }

    def _write(self):
        if self.json:
            write_json(self.json, run_record(self.name, self.options) | self._written)

    def show(self, text: str, numbers: Any = None, table: str | None = None) -> None:
        """Prints a section; --json OUT gets its numbers, with --publish the docs get both."""
        print(text)
        table = table or self.table
        self._written.setdefault("numbers", {})[table] = numbers
        self._write()
        if self.publish:
            publish(page_of(table), table, text, numbers, run_record(self.name, self.options))


def means(rows: Sequence[Row]) -> Row:
    """Of dicts of dicts of numbers: the same with means, None where one is None.

    Keys: those that all have.
    """
    first = rows[0]
    if isinstance(first, dict):
        keys = [key for key in first if all(key in row for row in rows)]
        return {key: means([row[key] for row in rows]) for key in keys}
    if isinstance(first, str | bool) or any(row is None for row in rows):
        return first if all(row == first for row in rows) else None
    return sum(rows) / len(rows)


@contextlib.contextmanager
def figure(
    path: Path, columns: int = 1, size: tuple[float, float] = (9, 3.5), legend: float = 0
) -> Generator[Any]:
    """Axes of plots side by side, written when the block ends. legend: share of the height for one
    legend below all.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    drawn, axes = plt.subplots(1, columns, figsize=size)
    yield axes
    for axis in drawn.axes:
        axis.grid(alpha=0.3)
    if legend:
        handles = drawn.axes[0].get_legend_handles_labels()
        drawn.legend(*handles, loc="outside lower center", ncols=2, fontsize=7)
    drawn.tight_layout(rect=(0, legend, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=150)
    plt.close(drawn)


def staircase(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Of (time, quality) the points that are better than all that are faster."""
    steps: list[tuple[float, float]] = []
    for x, y in sorted(points, key=lambda point: (point[0], -point[1])):
        if not steps or y > steps[-1][1]:
            steps.append((x, y))
    return steps
