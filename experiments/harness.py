"""Runs all measurements by `python -m experiments NAME [options]`. `python -m experiments` lists
them.

An experiment is a function with `@entry`. Its first argument is a `Run`. Its other arguments are
its options. Options without a default are positional. Annotations are numbers, paths, flags,
`Literal` choices and tuples of these. A default that is a dataclass becomes one option for each
field of the dataclass. Lines `name: text` below `Options:` in a docstring are the help.

The table of an experiment has the experiment's name, unless the docstring has a line
`Tables: NAMES`.

Every experiment has the options --json OUT and --publish. --json writes rows, numbers, date,
machine and versions, and keeps finished rows of the same settings. --publish writes
docs/results/TABLE.json and the page that shows the table.
"""

import argparse
import ast
import contextlib
import dataclasses
import functools
import importlib
import inspect
import json
import operator
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
    """Marks a function as an experiment, which `listed` finds by the decorator's name."""
    return function


def summary(docstring: str | None) -> str:
    """Returns the first paragraph of a docstring on one line."""
    paragraph, _, _ = (docstring or "").partition("\n\n")
    return " ".join(paragraph.split())


def listed() -> dict[str, tuple[str, str]]:
    """Returns {name: (module, first paragraph of the docstring)} of all experiments.

    The files are parsed and not imported.
    """
    found = {}
    for path in sorted(FOLDER.rglob("*.py")):
        module = ".".join(("experiments", *path.relative_to(FOLDER).with_suffix("").parts))
        for node in ast.parse(path.read_text()).body:
            if not isinstance(node, ast.FunctionDef):
                continue
            if "entry" in map(ast.unparse, node.decorator_list):
                found[node.name] = module, summary(ast.get_docstring(node))
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit status."""
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
    """Runs an experiment and returns its exit status, 0 where the experiment returns None.

    Wrong options and wrong files end the process with one line and status 2.
    """
    parser, given = parser_of(function)
    asked = parser.parse_args(options)
    run = Run(function.__name__, asked.table, asked.json, asked.publish, list(options))
    try:
        if asked.publish:  # before long work
            named = re.findall(r"^Tables?: ([\w, ]+)", inspect.getdoc(function) or "", re.MULTILINE)
            tables = [asked.table]
            if named and asked.table == function.__name__:
                tables = named[0].split(", ")
            for table in tables:
                page_of(table)
        return function(run, **{name: make(asked) for name, make in given.items()}) or 0
    except (ValueError, OSError) as error:
        traceback.print_exc()
        parser.error(str(error))


def parser_of(
    function: FunctionType,
) -> tuple[argparse.ArgumentParser, dict[str, Callable[[Any], Any]]]:
    """Returns the parser of an experiment, and {parameter: function from the parsed options to the
    value of the parameter}.
    """
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
    """Adds the options of an experiment to its parser.

    Returns {parameter: function from the parsed options to the value of the parameter}.
    """
    given, kinds, texts = {}, typing.get_type_hints(function), _helps(function)
    for name, parameter in list(inspect.signature(function).parameters.items())[1:]:
        default = parameter.default
        if dataclasses.is_dataclass(default):
            fields = [field.name for field in dataclasses.fields(default)]
            kinds_of, texts_of = typing.get_type_hints(type(default)), _helps(type(default))
            for field in fields:
                value = getattr(default, field)
                _add_option(parser, field, kinds_of[field], value, texts_of.get(field, ""))
            given[name] = functools.partial(_dataclass_of, default, fields)
        else:
            _add_option(parser, name, kinds[name], default, texts.get(name, ""))
            given[name] = operator.attrgetter(name)
    return given


def _dataclass_of(default, fields, asked):
    """Returns a dataclass with the values that the parsed options have for its fields."""
    return dataclasses.replace(default, **{name: getattr(asked, name) for name in fields})


def _add_option(parser, name, kind, default, text):
    """Adds one option to a parser, with the action and the type that its annotation asks for."""
    required = default is inspect.Parameter.empty
    options: dict[str, Any] = {} if required else {"default": default}
    # tuples take several values, and `X | None` is an X
    if typing.get_origin(kind) is tuple:
        kind = typing.get_args(kind)[0]
        options["nargs"] = "+" if required else "*"
        options["action"] = _Tuple
    elif isinstance(kind, types.UnionType):
        kind = next(each for each in typing.get_args(kind) if each is not type(None))
    if typing.get_origin(kind) is typing.Literal:
        options["choices"] = typing.get_args(kind)
        kind = type(options["choices"][0])
    if kind is bool:
        options["action"] = argparse.BooleanOptionalAction
    else:
        options["type"] = kind

    # an option that has a default shows it, and has a name with dashes
    if required:
        parser.add_argument(name, help=text, **options)
        return
    shown = "" if default in (None, (), False) else " (default: %(default)s)"
    parser.add_argument(f"--{name.replace('_', '-')}", help=text + shown, **options)


class _Tuple(argparse.Action):
    """Stores several values as a tuple."""

    def __call__(self, parser, namespace, values, option_string=None):
        setattr(namespace, self.dest, tuple(values))


def _helps(documented) -> dict[str, str]:
    """Returns {option: help} from the docstring of a function, or of a class and its bases."""
    found = {}
    for one in reversed(getattr(documented, "__mro__", (documented,))):
        _, _, text = (inspect.getdoc(one) or "").partition("Options:")
        found |= re.findall(r"^ *(\w+): (.*(?:\n(?! *\w+: ).+)*)", text, re.MULTILINE)
    return {name: " ".join(line.split()).replace("%", "%%") for name, line in found.items()}


@dataclasses.dataclass(eq=False)
class Run:
    """Keeps rows, writes files and publishes tables for a running experiment.

    Without `json` and `publish` nothing is written.
    """

    name: str = ""
    table: str = ""
    json: Path | None = None
    publish: bool = False
    options: Sequence[str] = ()
    pictures: dict[str, Any] = dataclasses.field(default_factory=dict)
    """{case: the pictures that it returned beside its row, or None}."""
    _written: dict[str, Any] = dataclasses.field(default_factory=dict)

    def rows(
        self,
        cases: Mapping[str, Callable[[], Row]],
        settings: Mapping[str, Any] | None = None,
        again: bool = False,
    ) -> dict[str, Row]:
        """Returns the rows of all cases, {case: row}.

        Cases whose rows --json OUT has with the same settings are not measured again. OUT is
        written after each case. A case may return (row, pictures): the pictures go to `pictures`.

        Args:
            cases: {case: function that measures it}
            settings: what the rows depend on, written into OUT
            again: measure all cases, because their pictures are needed

        Raises: ValueError if OUT is no file of this harness.
        """
        from humangs_jax.core.progress import bar

        settings = json.loads(json.dumps(settings or {}))
        kept = self._kept(settings)
        self._written |= {"settings": settings, "rows": kept}
        # a row that is made is written at once, so that a run which is stopped loses only one
        for name in bar(list(cases), desc=self.name, unit="case"):
            if name not in kept or again:
                found = cases[name]()
                if not isinstance(found, tuple):
                    found = found, None
                kept[name], self.pictures[name] = found
                self._write()
        return {name: kept[name] for name in cases}

    def _kept(self, settings):
        """Returns the rows that OUT has of an earlier run with the same settings.

        Rows of measurements that failed are left out.
        """
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
        """Prints a section. --json OUT gets its numbers, with --publish the docs get both."""
        print(text)
        table = table or self.table
        self._written.setdefault("numbers", {})[table] = numbers
        self._write()
        if self.publish:
            publish(page_of(table), table, text, numbers, run_record(self.name, self.options))


def means(rows: Sequence[Row]) -> Row:
    """Returns the means of rows, which are numbers or (nested) dicts of numbers.

    The result has the keys that all rows have. A number is None where it is None in a row. A text
    or flag is kept where all rows agree, and is None otherwise.
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
    """Yields the axes of plots side by side, and writes the figure when the block ends.

    Args:
        path: file to write
        columns: number of plots
        size: width and height in inches
        legend: share of the height for one legend below all plots, 0: no legend
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
    """Returns those points (time, quality) that are better than all faster points."""
    steps: list[tuple[float, float]] = []
    for x, y in sorted(points, key=lambda point: (point[0], -point[1])):
        if not steps or y > steps[-1][1]:
            steps.append((x, y))
    return steps
