"""What docstrings and comments refer to exists: `module.name`, `Class.field`, names of files."""

import ast
import functools
import io
import re
import sys
import tokenize
from pathlib import Path

import pytest

import humangs_jax

ROOT = Path(humangs_jax.__file__).parent
SOURCES = sorted(
    path for path in ROOT.rglob("*") if path.suffix in (".py", ".pyi", ".js", ".frag", ".vert")
)
OTHERS = (ROOT.parent / "tests" / "conftest.py",)
POINTER = re.compile(r"(?<![\w./-])([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)(?![\w/-])")
SUFFIXES = {
    "npz",
    "npy",
    "json",
    "ply",
    "html",
    "txt",
    "md",
    "png",
    "jpg",
    "mp4",
    "obj",
    "glb",
    "safetensors",
    "frag",
    "js",
    "py",
}
VARIABLES = {"self", "cls", "hg", "state", "x", "model", "views", "lin0"}
"""Words that stand for objects of any class, parts of configurations, or parts of files."""
FILES_OF_OTHERS = {"three.js", "compute_metrics.py", "simple_trainer.py"}
FILE = re.compile(r"(?<![\w*{}/.-])([\w/]+\.(?:py|js|frag))\b")


def comments(path: Path) -> list[str]:
    """Returns the docstrings and comments of a file."""
    text = path.read_text()
    if path.suffix not in (".py", ".pyi"):
        return re.findall(r"//.*|/\*.*?\*/", text, re.DOTALL)
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    found = [token.string for token in tokens if token.type == tokenize.COMMENT]
    strings = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
    return found + [
        each.value
        for each in strings
        if isinstance(each, ast.Constant) and isinstance(each.value, str)
    ]


def pointers(path: Path) -> list[str]:
    """Returns dotted names between single backticks."""
    quoted = [
        each for text in comments(path) for each in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text)
    ]
    return [name for each in quoted for name in POINTER.findall(each)]


@functools.cache
def namespaces() -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Returns the names in each module, by the last parts of its path, and attributes by class."""
    modules: dict[str, set[str]] = {}
    classes: dict[str, set[str]] = {}
    bases: dict[str, set[str]] = {}
    for path in ROOT.rglob("*.py"):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        tree = ast.parse(path.read_text())
        names = set(defined(tree.body))
        if path.name == "__init__.py":
            names |= {each.stem for each in path.parent.iterdir()}
        for start in range(len(parts)):
            modules.setdefault(".".join(parts[start:]), set()).update(names)
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                classes.setdefault(node.name, set()).update(defined(node.body), set_on_self(node))
                bases.setdefault(node.name, set()).update(
                    ast.unparse(base).split("[")[0] for base in node.bases
                )
    for _ in range(4):  # of bases of bases
        for name, above in bases.items():
            for base in above:
                classes[name] |= classes.get(base, {"*"})  # a class of others may have anything
    return modules, classes


def defined(body: list[ast.stmt]) -> list[str]:
    """Returns the names that statements define."""
    found: list[str] = []
    for node in body:
        match node:
            case (
                ast.FunctionDef(name=name)
                | ast.AsyncFunctionDef(name=name)
                | ast.ClassDef(name=name)
            ):
                found.append(name)
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                found += [(each.asname or each.name).split(".")[0] for each in names]
            case ast.If(body=inner) | ast.Try(body=inner) | ast.With(body=inner):
                found += defined(inner)
            case ast.Assign() | ast.AnnAssign() | ast.AugAssign():
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                found += [
                    each.id
                    for target in targets
                    for each in ast.walk(target)
                    if isinstance(each, ast.Name)
                ]
    return found


def set_on_self(node: ast.ClassDef) -> list[str]:
    return [
        x.attr
        for x in ast.walk(node)
        if isinstance(x, ast.Attribute) and ast.unparse(x.value) == "self"
    ]


@functools.cache
def of_others() -> set[str]:
    """Returns the names that modules import from elsewhere."""
    found = set(sys.stdlib_module_names)
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found.update((each.asname or each.name).split(".")[0] for each in node.names)
            elif isinstance(node, ast.ImportFrom) and not (node.module or "").startswith(
                "humangs_jax"
            ):
                found.update(each.asname or each.name for each in node.names)
    return found


def points_nowhere(name: str) -> bool:
    """Returns whether a dotted name begins with a module or class of ours that lacks the rest.

    A module that no longer exists counts as lacking it, even if another one has the rest.
    """
    modules, classes = namespaces()
    first, *rest = name.split(".")
    if (
        rest[-1] in SUFFIXES
        or first in VARIABLES
        or (first == "humangs_jax" and rest[0] in humangs_jax.__all__)
    ):
        return False
    if first in classes:
        return not {rest[0], "*"} & classes[first]
    # a word may also stand for an object of a class of that name: camera.K, capture.poses,
    # config.max_pairs
    if any(
        rest[0] in attributes
        for owner, attributes in classes.items()
        if owner.lower().endswith(first.lower())
    ):
        return False
    if first not in modules:
        moved = any(rest[0] in names for module, names in modules.items() if "." not in module)
        return moved and first not in of_others()
    head = first
    while rest and f"{head}.{rest[0]}" in modules:
        head = f"{head}.{rest.pop(0)}"
    return bool(rest) and rest[0] not in modules[head]


@pytest.mark.parametrize(
    "path",
    [*(path for path in SOURCES if path.suffix == ".py"), *OTHERS],
    ids=lambda path: str(path.relative_to(ROOT.parent)),
)
def test_what_comments_point_at_exists(path):
    assert [name for name in pointers(path) if points_nowhere(name)] == []


def test_files_that_comments_name_exist():
    names = {
        path.name
        for folder in ("humangs_jax", "tests", "experiments")
        for path in (ROOT.parent / folder).rglob("*")
    }
    missing = [
        (path.name, name)
        for path in (*SOURCES, *OTHERS)
        for text in comments(path)
        for name in FILE.findall(text)
        if Path(name).name not in names | FILES_OF_OTHERS
    ]
    assert missing == []


NOWHERE = (
    "splatting.default_pair",
    "splatting.render_view",
    "avatar.pixel_footprint",
    "Rendering.overflows",
    "seeds.SPLITS",
)
THERE = (
    "buffers.default_pairs",
    "data.views",
    "camera.K",
    "Rendering.overflow",
    "avatar.npz",
    "jnp.where",
    "jax.vmap",
    "a.b",
)


@pytest.mark.parametrize("name", [*NOWHERE, *THERE])
def test_pointers_that_lead_nowhere_are_found(name):
    assert points_nowhere(name) == (name in NOWHERE)
