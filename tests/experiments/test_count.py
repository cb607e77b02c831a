"""What `count` counts, on a made-up module."""

import shutil
import subprocess

import pytest

from experiments.count import code_tokens, measure, sources

MODULE = '''"""A module."""

LIMIT = 3  # of something
NAMES: list[str] = []
NAMES += ["a"]


@configuration
class Settings:
    """Settings."""

    steps: int = 1
    """Of the loop."""
    width: int = 2
    _cache: int = 0


@dataclasses.dataclass(frozen=True)
class _Hidden:
    side: int = 1


class Point(NamedTuple):
    x: int

    def far(self):
        return (y := self.x) if self.x > LIMIT else y


def _silent(a):
    """A function."""
LINES    return a


def said(a):
    # why
LINES    return a
'''.replace("LINES", "    a += 1\n" * 29)
"""Has two functions with 31 lines of body, the first with a docstring, the other with a comment."""


def test_a_module_is_counted():
    texts = {
        "humangs_jax/core/a.py": MODULE,
        "humangs_jax/viewer/a.py": "x = 1",
        "humangs_jax/fitting/a.py": f"y = {'1' * 100}",
        "tests/test_a.py": "assert f()",
    }
    tokens = code_tokens(MODULE)
    assert measure(texts) == {
        "package: code tokens": tokens + 6,
        "package: public names": 3,
        "package: functions and classes": 5,
        "package: module assignments": 4,
        "package without capture, motion, synthetic, viewer: code tokens": tokens,
        "package: lines over 100 columns": 1,
        "package: conditional expressions": 1,
        "package: walruses": 1,
        "package: lines with a comment": 2,
        "package: functions over 30 lines without a comment": ["humangs_jax/core/a.py:_silent"],
        "package: fields of public dataclasses with a sentence": 0.5,
        "tests: code tokens": 4,
    }


def test_tokens_are_code_without_comments_docstrings_and_layout():
    text = (
        '"""A module."""\n\nx = 1  # one\n\n\n'
        'def f(a):\n    """A function."""\n    return "a" + a\n'
    )
    assert code_tokens(text) == len(
        ["x", "=", "1", "def", "f", "(", "a", ")", ":", "return", "'a'", "+", "a"]
    )
    assert code_tokens(text.replace("  # one", "").replace("\n\n", "\n")) == code_tokens(text)
    assert code_tokens("x = f'{a} and {b:.{c}f}' + f'{f\"{d}\"}'") == 5  # an f-string is one


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_a_revision_is_read_beside_the_files_as_they_are(tmp_path):
    def git(*arguments):
        identity = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True)

    module, removed = tmp_path / "humangs_jax" / "a.py", tmp_path / "tests" / "test_a.py"
    for file in (module, removed, tmp_path / "docs" / "a.py"):
        file.parent.mkdir()
        file.write_text("x = 1")
    git("init", "--quiet")
    git("add", ".")
    git("commit", "--quiet", "--message", "first")
    module.write_text("x = 2")
    removed.unlink()
    before = {"humangs_jax/a.py": "x = 1", "tests/test_a.py": "x = 1"}
    assert sources(tmp_path, "HEAD") == before
    assert sources(tmp_path) == {"humangs_jax/a.py": "x = 2"}
    with pytest.raises(ValueError, match="nothing"):
        sources(tmp_path, "nothing")
