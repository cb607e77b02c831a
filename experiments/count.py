"""The size and shape of the project, counted from its files."""

import ast
import inspect
import io
import itertools
import os
import re
import subprocess
import sys
import tokenize
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

from experiments.harness import Run, entry
from experiments.results import REPOSITORY, markdown_table

PACKAGE = "humangs_jax"
LONG = 500
"""Lines from which on a module is long."""
GENERATED = ("docs/benchmarks/", "docs/knobs.md", "docs/api/")
"""Pages that scripts write."""


@entry
def count(run: Run, before: Path | None = None, details: bool = False, walks: bool = False) -> None:
    """Lines, modules, words, annotations, importers and circles of imports of package, tests,
    experiments and docs.

    Only files that git knows. "Annotated": all arguments and the result; functions in functions,
    lambdas and __methods__ do not count. "One importer": modules that a single other module
    imports, also inside of functions; tables of names are not read.

    Tables: size

    Options:
    before: another checkout of the project, whose numbers stand beside these
    details: names of long modules, of those with one importer, of circles, and of the functions of
    walks
    walks: also how many functions a datum enters, see `walked`; a minute, and of this checkout
    alone
    """
    columns = {"before": measure(before)} if before else {}
    columns["now"] = measure(REPOSITORY) | (all_walks() if walks else {})
    if details:
        for name, value in columns["now"].items():
            if isinstance(value, list):
                print(f"{name}: {', '.join(map(str, value)) or 'none'}")
    shown = lambda value: (
        f"{len(value) if isinstance(value, list) else value:,}"
        if not isinstance(value, str)
        else value
    )
    rows = [
        [name, *(shown(column.get(name, "")) for column in columns.values())]
        for name in columns["now"]
    ]
    numbers = {
        title: {
            name: len(value) if isinstance(value, list) else value for name, value in column.items()
        }
        for title, column in columns.items()
    }
    run.show(markdown_table(["", *columns], rows), numbers, "size")


def measure(root: Path) -> dict[str, Any]:
    """Numbers, shares as text, and lists of names."""
    files = subprocess.run(
        ["git", "ls-files"], cwd=root, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    known = [name for name in files if (root / name).is_file()]
    python = {name: (root / name).read_text() for name in known if name.endswith(".py")}
    of = lambda *folders: {name: text for name, text in python.items() if name.startswith(folders)}
    lines = lambda texts: sum(text.count("\n") for text in texts.values())
    package, found = of(f"{PACKAGE}/"), {}
    parts = {"package": package, "tests": of("tests/"), "experiments": of("experiments/")}
    for name, texts in parts.items():
        found |= {
            f"{name}: lines": lines(texts),
            f"{name}: modules": sum(1 for text in texts.values() if text.strip()),
        }
    for folder in sorted(
        {name.split("/")[1] for name in parts["experiments"] if name.count("/") > 1}
    ):
        found[f"experiments/{folder}: lines"] = lines(of(f"experiments/{folder}/"))
    pages = [
        name
        for name in known
        if name == "README.md" or (name.startswith("docs/") and name.endswith(".md"))
    ]
    found |= {
        "docs: pages": len(pages),
        "docs: words": sum(len((root / name).read_text().split()) for name in pages),
    }
    by_hand = {
        name: written((root / name).read_text()) for name in pages if not name.startswith(GENERATED)
    }
    found["docs: words by hand, without code and generated tables"] = sum(
        len(text.split()) for text in by_hand.values()
    )
    found["docs: words of README"] = len((root / "README.md").read_text().split())
    found["docs: tables on pages written by hand"] = sum(
        text.count("| --- ") > 0 for text in by_hand.values()
    )
    found |= helps(root)
    found["public functions with arguments, results, errors and an example in the docstring"] = (
        documented(root)
    )
    results = [name for name in known if name.startswith("docs/results/")]
    found["docs/results: lines"] = sum((root / name).read_text().count("\n") for name in results)
    for kind, private in (("public", False), ("private", True)):
        each = [
            annotated(node) for node, hidden in functions(package.values()) if hidden == private
        ]
        found[f"{kind} functions annotated"] = (
            f"{sum(each):,} of {len(each):,}, {sum(each) / max(1, len(each)):.0%}"
        )
    found[f"modules above {LONG} lines"] = [
        name for name, text in package.items() if text.count("\n") > LONG
    ]
    always, anywhere = imports(package, True), imports(package, False)
    importers: dict[str, set[str]] = {}
    for module, targets in anywhere.items():
        for target in targets - {module}:
            importers.setdefault(target, set()).add(module)
    found["modules with one importer"] = [
        f"{name} ({next(iter(by))})"
        for name, by in sorted(importers.items())
        if len(by) == 1 and name != PACKAGE
    ]
    found["public names"] = len(public_names(root))
    found["circles of imports"] = circles(always)
    found["circles with imports inside of functions"] = circles(anywhere)
    return found


def written(text: str) -> str:
    """A page without what scripts write into it, and without code."""
    text = re.sub(r"<!-- (table|formats): .*?<!-- end -->", "", text, flags=re.DOTALL)
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def code_tokens(text: str) -> int:
    """Words and signs of a module, without comments, docstrings and what only lays it out."""
    layout = {
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENCODING,
        tokenize.ENDMARKER,
    }
    kept = [
        token
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type not in layout
    ]
    count, begins = 0, True
    kinds = [token.type for token in kept]
    for kind, following in itertools.pairwise([*kinds, tokenize.NEWLINE]):
        docstring = kind == tokenize.STRING and begins and following == tokenize.NEWLINE
        begins = kind == tokenize.NEWLINE
        count += not (docstring or begins)
    return count


def helps(root: Path) -> dict[str, Any]:
    """Of the command line: lines of all help texts at 80 columns, and lines that are examples."""
    from humangs_jax.cli import COMMANDS

    environment = os.environ | {
        "COLUMNS": "80",
        "NO_COLOR": "1",
        "TERM": "dumb",
        "PYTHONPATH": str(root),
    }
    lines: list[str] = []
    for name in COMMANDS:
        command = [sys.executable, "-m", "humangs_jax.cli", name, "--help"]
        lines += subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True
        ).stdout.splitlines()
    examples = sum(line.startswith("  humangs ") for line in lines)
    return {"command line: lines of help": len(lines), "command line: examples": examples}


def documented(root: Path) -> str:
    """Public functions whose docstring has a section for all that they take, return and raise, and
    an example.
    """
    complete = every = 0
    tree = ast.parse((root / PACKAGE / "__init__.pyi").read_text())
    for node in (node for node in tree.body if isinstance(node, ast.ImportFrom)):
        place = root / PACKAGE / str(node.module).replace(".", "/")
        file = (
            place.with_suffix(".py")
            if place.with_suffix(".py").is_file()
            else place / "__init__.py"
        )
        names = {each.name for each in node.names}
        for function in ast.parse(file.read_text()).body:
            if isinstance(function, ast.FunctionDef) and function.name in names:
                text, taken = ast.get_docstring(function) or "", function.args
                wanted = ["Args:"] * bool(taken.args or taken.kwonlyargs or taken.kwarg) + [
                    "Examples:"
                ]
                returned = function.returns
                wanted += ["Returns:"] * (returned is not None and ast.unparse(returned) != "None")
                every += 1
                complete += all(f"\n{section}\n" in text for section in wanted)
    return f"{complete} of {every}"


def functions(
    texts: Iterable[str],
) -> Iterator[tuple[ast.FunctionDef | ast.AsyncFunctionDef, bool]]:
    """Functions and methods of modules, and whether one is private."""

    def inside(body, hidden):
        for node in body:
            if isinstance(node, ast.ClassDef):
                yield from inside(node.body, hidden or node.name.startswith("_"))
            elif isinstance(
                node, ast.FunctionDef | ast.AsyncFunctionDef
            ) and not node.name.startswith("__"):
                yield node, hidden or node.name.startswith("_")

    for text in texts:
        yield from inside(ast.parse(text).body, False)


def annotated(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """All arguments but self and cls, and the result."""
    given = function.args
    named = [
        *given.posonlyargs,
        *given.args,
        *given.kwonlyargs,
        *filter(None, (given.vararg, given.kwarg)),
    ]
    typed = all(each.annotation for each in named if each.arg not in ("self", "cls"))
    return typed and function.returns is not None


def imports(package: dict[str, str], at_import: bool) -> dict[str, set[str]]:
    """Module -> modules of the package that it imports. at_import: without those inside of
    functions and for types alone.
    """
    name_of = lambda path: path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
    modules = {name_of(path): text for path, text in package.items()}

    def statements(body):
        for node in body:
            if isinstance(node, ast.Import | ast.ImportFrom):
                yield node
            elif (
                at_import and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
            ):
                yield from statements(node.orelse)
            elif not (at_import and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)):
                yield from statements(ast.iter_child_nodes(node))

    found: dict[str, set[str]] = {}
    for module, text in modules.items():
        names = []
        for node in statements(ast.parse(text).body):
            if isinstance(node, ast.ImportFrom):
                names += [f"{node.module}.{each.name}" for each in node.names]
            else:
                names += [each.name for each in node.names]
        # a name of a module is an import of that module
        found[module] = {
            each if each in modules else each.rpartition(".")[0] for each in names
        } & set(modules) - {module}
    return found


def circles(graph: dict[str, set[str]]) -> list[str]:
    """Sets of modules that import each other, by way of others."""

    def reached(start):
        seen, todo = set(), [start]
        while todo:
            for each in graph.get(todo.pop(), ()):
                if each not in seen:
                    seen.add(each)
                    todo.append(each)
        return seen

    reach = {module: reached(module) for module in graph}
    found = {
        frozenset(other for other in reach[module] if module in reach[other])
        for module in graph
        if module in reach[module]
    }
    return [" <-> ".join(sorted(each)) for each in found]


def public_names(root: Path) -> list[str]:
    """What `import humangs_jax` offers."""
    tree = ast.parse((root / PACKAGE / "__init__.pyi").read_text())
    return [
        each.asname or each.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for each in node.names
    ]


def walked(call: Callable[[], object], *datum: type) -> list[str]:
    """Functions of the package that a datum enters while `call` runs and JAX traces: each counts
    once, wherever it is called.

    A function counts that gets an object of one of the classes as an argument, also in a tuple,
    list or dict. Methods of the datum itself do not, nor lambdas, nor what only JAX calls, to take
    pytrees apart.
    """
    root, found = str(REPOSITORY / PACKAGE), {}
    holds = lambda value: (
        isinstance(value, datum)
        or any(
            isinstance(each, (*datum, tuple)) and holds(each)
            for each in (
                value.values()
                if isinstance(value, dict)
                else value
                if isinstance(value, tuple | list)
                else ()
            )
        )
    )

    def watch(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        inside = (
            code.co_filename.startswith(root)
            and "<lambda>" not in code.co_qualname
            and "flatten" not in code.co_name
        )
        if event == "call" and inside:
            arguments = (
                code.co_argcount + code.co_kwonlyargcount + bool(code.co_flags & inspect.CO_VARARGS)
            )
            given = code.co_varnames[:arguments]
            if any(name != "self" and holds(frame.f_locals.get(name)) for name in given):
                found[f"{Path(code.co_filename).stem}.{code.co_qualname}"] = None

    sys.setprofile(watch)
    try:
        call()
    finally:
        sys.setprofile(None)
    return list(found)


def all_walks() -> dict[str, list[str]]:
    """The walks of photos to an avatar, of Gaussians to an image, and of a training example to the
    loss.
    """
    import jax

    import humangs_jax as hg
    from humangs_jax.data.loading import Example
    from humangs_jax.data.views import SubjectViews, gaussian_body, standardize
    from humangs_jax.network.parts import Drawn, HumanGSInputs
    from humangs_jax.training import step
    from humangs_jax.training.config import tiny
    from humangs_jax.training.state import init_state

    config, capture = tiny(), hg.load_capture("demo_capture").resized(64)
    state = init_state(config)
    body, views = gaussian_body(capture.body, config.model), standardize(capture, 32)
    batch = jax.tree.map(lambda x: x[None], Example(views, hg.replace(views, depths=views.masks)))
    avatar: list[hg.Avatar] = []
    photos = lambda: avatar.append(hg.reconstruct(state.variables, config.model, capture))
    found = {
        "walk: photos through reconstruct": walked(photos, hg.Capture, SubjectViews, HumanGSInputs)
    }
    gaussians = hg.animate(avatar[0], capture.pose(0))
    image = lambda: hg.render(gaussians, capture.cameras[0])
    found["walk: Gaussians through render"] = walked(image, hg.Gaussians)
    loss = lambda: jax.eval_shape(lambda state: step.train_step(state, batch, body, config), state)
    traced = jax.jit(step.update, static_argnames=("config", "mesh"))
    with mock.patch.object(
        step, "compiled_update", lambda: traced
    ):  # which cannot be traced alone: it has compiler options
        found["walk: an example to the loss"] = walked(
            loss, Example, SubjectViews, HumanGSInputs, Drawn
        )
    return found
