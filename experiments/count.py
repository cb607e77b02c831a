"""Counts from the files how much code there is and how plain it is."""

import ast
import inspect
import io
import subprocess
import sys
import tokenize
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any
from unittest import mock

from experiments.harness import Run, entry
from experiments.results import REPOSITORY, markdown_table

PACKAGE = "humangs_jax"
WINGS = ("capture", "motion", "synthetic", "viewer")
"""Folders of the package that its core does not import."""
FORMER_WINGS = (
    *("data/calibration", "data/keypoints", "data/motion"),
    *("detection", "fitting", "people"),
)
"""Folders that had the files of the wings in earlier revisions."""
COLUMNS = 100
"""Largest width of a line."""
LONG = 30
"""Most lines of a function without a comment."""
LAYOUT = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.INDENT, tokenize.DEDENT),
    *(tokenize.ENCODING, tokenize.ENDMARKER),
}
"""Kinds of tokens that are no code."""
FSTRING_START = getattr(tokenize, "FSTRING_START", None)
"""Kind of the token that begins an f-string. Before Python 3.12 an f-string is one token."""
FSTRING_END = getattr(tokenize, "FSTRING_END", None)
"""Kind of the token that ends an f-string, from Python 3.12 on."""
Function = ast.FunctionDef | ast.AsyncFunctionDef


@entry
def count(run: Run, before: str | None = None, details: bool = False, walks: bool = False) -> None:
    """Counts code tokens, names, assignments, long lines, comments and described fields of the
    package, and code tokens of its tests.

    Only files that git knows are counted. Code tokens do not include comments, docstrings and
    newlines. Names, functions and classes are those of modules, without methods. The lines of a
    function are those of its body with its docstring.

    Tables: size

    Options:
    before: commit, branch or tag whose numbers stand beside those of the present files
    details: print the names of the long functions without a comment, and of the functions of walks
    walks: also count the functions that a datum enters, see `walked`; takes a minute, and is done
    for the present files only
    """
    columns = {} if before is None else {"before": measure(sources(REPOSITORY, before))}
    columns["now"] = measure(sources(REPOSITORY))
    if walks:
        columns["now"] |= all_walks()

    # lists of names are printed, the table has their lengths
    if details:
        for name, value in columns["now"].items():
            if isinstance(value, list):
                print(f"{name}: {', '.join(value) or 'none'}")

    rows = [
        [name, *(_shown(column.get(name)) for column in columns.values())]
        for name in columns["now"]
    ]
    numbers = {
        title: {name: _number(value) for name, value in column.items()}
        for title, column in columns.items()
    }
    run.show(markdown_table(["", *columns], rows), numbers, "size")


def _number(value: int | float | list[str]) -> int | float:
    """Returns a value as a number, for a list of names their number."""
    return len(value) if isinstance(value, list) else value


def _shown(value: int | float | list[str] | None) -> str:
    """Formats a value for the table, a share in percent."""
    if value is None:
        return "-"
    number = _number(value)
    return f"{number:.0%}" if isinstance(number, float) else f"{number:,}"


def sources(root: Path, revision: str | None = None) -> dict[str, str]:
    """Reads the Python files of package and tests, as they are or as a revision has them.

    Raises: ValueError for a revision that git does not know.
    """

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], cwd=root, capture_output=True, encoding="utf-8", check=False
        )
        if done.returncode:
            raise ValueError(f"git {' '.join(arguments)}: {done.stderr.strip()}")
        return done.stdout

    folders = (f"{PACKAGE}/", "tests/")
    if revision is None:
        listed = git("ls-files", "-z", *folders)
    else:
        listed = git("ls-tree", "-r", "-z", "--name-only", revision, *folders)

    texts = {}
    for name in listed.split("\0"):
        if not name.endswith(".py"):
            continue
        if revision is not None:
            texts[name] = git("show", f"{revision}:{name}")
        elif (root / name).is_file():  # else it is removed, and not yet committed
            texts[name] = (root / name).read_text(encoding="utf-8")
    return texts


def measure(texts: dict[str, str]) -> dict[str, Any]:
    """Counts what the table shows: numbers, a share, and a list of names."""
    package = {name: text for name, text in texts.items() if name.startswith(f"{PACKAGE}/")}
    tests = [text for name, text in texts.items() if name.startswith("tests/")]
    outside = tuple(f"{PACKAGE}/{folder}/" for folder in (*WINGS, *FORMER_WINGS))
    core = [text for name, text in package.items() if not name.startswith(outside)]

    # what is a name, a statement or an expression of Python
    trees = {name: ast.parse(text) for name, text in package.items()}
    statements = [node for tree in trees.values() for node in tree.body]
    nodes = [node for tree in trees.values() for node in ast.walk(tree)]
    defined = [node for node in statements if isinstance(node, Function | ast.ClassDef)]
    described = [has for node in defined for has in described_fields(node)]

    # what is a line
    lines = [line for text in package.values() for line in text.splitlines()]
    comments = {name: comment_lines(text) for name, text in package.items()}
    silent = [
        f"{name}:{function}"
        for name, tree in trees.items()
        for function in long_without_comment(tree, comments[name])
    ]

    return {
        "package: code tokens": sum(map(code_tokens, package.values())),
        "package: public names": sum(not node.name.startswith("_") for node in defined),
        "package: functions and classes": len(defined),
        "package: module assignments": _how_many(statements, ast.Assign | ast.AnnAssign),
        f"package without {', '.join(WINGS)}: code tokens": sum(map(code_tokens, core)),
        f"package: lines over {COLUMNS} columns": sum(len(line) > COLUMNS for line in lines),
        "package: conditional expressions": _how_many(nodes, ast.IfExp),
        "package: walruses": _how_many(nodes, ast.NamedExpr),
        "package: lines with a comment": sum(map(len, comments.values())),
        f"package: functions over {LONG} lines without a comment": silent,
        "package: fields of public dataclasses with a sentence": (
            sum(described) / max(1, len(described))
        ),
        "tests: code tokens": sum(map(code_tokens, tests)),
    }


def _how_many(nodes: list[Any], kind: Any) -> int:
    """Counts the nodes of a kind."""
    return sum(isinstance(node, kind) for node in nodes)


def code_tokens(text: str) -> int:
    """Counts words and signs of a module, without comments, docstrings and what only lays it out.

    An f-string is one token on every version of Python.
    """
    total, depth = 0, 0
    line: list[int] = []
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NEWLINE:
            # a string alone is a docstring: of a module, a class, a function or a field
            total += 0 if line == [tokenize.STRING] else len(line)
            line = []
        elif token.type == FSTRING_START:
            if depth == 0:
                line.append(tokenize.STRING)
            depth += 1
        elif token.type == FSTRING_END:
            depth -= 1
        elif depth == 0 and token.type not in LAYOUT:
            line.append(token.type)
    return total


def comment_lines(text: str) -> set[int]:
    """Finds the lines of a module that have a comment, alone or after code."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return {token.start[0] for token in tokens if token.type == tokenize.COMMENT}


def long_without_comment(tree: ast.Module, comments: set[int]) -> Iterator[str]:
    """Names the long functions of a module that have none of its comments."""
    for node in tree.body:
        if isinstance(node, Function):
            end = node.end_lineno or node.lineno
            is_long = end + 1 - node.body[0].lineno > LONG
            if is_long and comments.isdisjoint(range(node.lineno, end + 1)):
                yield node.name


def described_fields(node: ast.stmt) -> Iterator[bool]:
    """Tells of each public field of a public dataclass whether a sentence stands below it.

    A dataclass has a decorator: dataclass, pytree_dataclass, configuration or part.
    """
    if not isinstance(node, ast.ClassDef) or node.name.startswith("_"):
        return
    decorators = [ast.unparse(each).partition("(")[0] for each in node.decorator_list]
    if not any(each.endswith(("dataclass", "configuration", "part")) for each in decorators):
        return
    for field, following in zip(node.body, [*node.body[1:], None], strict=True):
        if isinstance(field, ast.AnnAssign) and not ast.unparse(field.target).startswith("_"):
            below = following.value if isinstance(following, ast.Expr) else None
            yield isinstance(below, ast.Constant) and isinstance(below.value, str)


def walked(call: Callable[[], object], *datum: type) -> list[str]:
    """Runs `call` and returns the functions of the package that a datum enters, each once.

    A datum is an object of one of the classes. It enters a function as an argument, also inside of
    a tuple, list or dict. Methods of the datum do not count, nor do lambdas and the functions that
    JAX calls to flatten pytrees. Calls while JAX traces count too.
    """
    root, found = str(REPOSITORY / PACKAGE), {}

    def holds(value):
        """Whether a value is a datum, or a tuple, list or dict with one inside."""
        inside = ()
        if isinstance(value, dict):
            inside = value.values()
        elif isinstance(value, tuple | list):
            inside = value
        return isinstance(value, datum) or any(
            isinstance(each, (*datum, tuple)) and holds(each) for each in inside
        )

    def watch(frame: FrameType, event: str, _: object) -> None:
        """Notes the function of a frame that is entered with a datum."""
        # only functions of the package with a name
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
    """Returns {walk: functions that a datum enters} for three walks: from photos to an avatar, from
    Gaussians to an image, and from a training example to the loss.
    """
    import jax

    import humangs_jax as hg
    from humangs_jax.data.loading import Example
    from humangs_jax.data.prepared import PreparedCapture
    from humangs_jax.data.views import SubjectViews, gaussian_body, to_network_views
    from humangs_jax.network.parts import Drawn, HumanGSInputs
    from humangs_jax.training import step
    from humangs_jax.training.config import tiny
    from humangs_jax.training.state import init_state

    # a tiny network, small photos and one example
    config, capture = tiny(), hg.load_capture("demo_capture").resized(64)
    state = init_state(config)
    body, views = gaussian_body(capture.body, config.model), to_network_views(capture, 32)
    batch = jax.tree.map(lambda x: x[None], Example(views, hg.replace(views, depths=views.masks)))
    avatar: list[hg.Avatar] = []

    def photos():
        return avatar.append(hg.reconstruct(state.variables, config.model, capture))

    found = {
        "walk: photos through reconstruct": walked(
            photos, hg.Capture, PreparedCapture, SubjectViews, HumanGSInputs
        )
    }
    gaussians = hg.animate(avatar[0], capture.pose(0))

    def image():
        return hg.render(gaussians, capture.cameras[0])

    found["walk: Gaussians through render"] = walked(image, hg.Gaussians)

    def loss():
        return jax.eval_shape(lambda state: step.train_step(state, batch, body, config), state)

    # the step of training has compiler options, with which JAX cannot trace it alone
    traced = jax.jit(step.update, static_argnames=("config", "mesh"))
    with mock.patch.object(step, "compiled_update", lambda: traced):
        found["walk: an example to the loss"] = walked(
            loss, Example, SubjectViews, HumanGSInputs, Drawn
        )
    return found
