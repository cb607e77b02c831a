"""Every script in experiments/ answers --help quickly, and the README says what it is for."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
TYPED = "training/train_shipped.py"
"""Its options are those of a configuration, which imports jax: run last."""
SCRIPTS = sorted(
    (
        path.relative_to(EXPERIMENTS).as_posix()
        for path in EXPERIMENTS.rglob("*.py")
        if 'if __name__ == "__main__"' in path.read_text()
    ),
    key=lambda name: (name == TYPED, name),
)
DOCS = sorted((EXPERIMENTS.parent / "docs").glob("*.md"))
HEAVY = ("jax", "flax", "scipy", "matplotlib", "imageio", "trimesh", "torch", "libtpu")
CPU_SECONDS = 5

ASK = """
import contextlib, io, json, os, runpy, sys, time
answers = {}
for script in sys.argv[2:]:
    printed, start, path = io.StringIO(), time.process_time(), list(sys.path)
    sys.argv = [script, "--help"]
    try:
        with contextlib.redirect_stdout(printed):
            runpy.run_path(script, run_name="__main__")
    except SystemExit as exit_:
        code = exit_.code
    else:
        code = "no exit"
    sys.path[:] = path  # the next script finds its own modules
    answers[script] = [code, printed.getvalue(), time.process_time() - start, sorted(sys.modules)]
json.dump(answers, sys.__stdout__)
"""


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    """What each script answers to --help, all asked in one process: exit code, text, CPU seconds, modules so far."""
    files = [str(EXPERIMENTS / name) for name in SCRIPTS]
    command = [sys.executable, "-c", ASK, "--", *files]
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path_factory.mktemp("elsewhere"), check=False
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(SCRIPTS, json.loads(done.stdout).values(), strict=True))


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_is_quick_and_imports_nothing_heavy(script, answers):
    code, text, seconds, modules = answers[script]
    assert code in (0, None) and "usage:" in text
    if script != TYPED:
        assert seconds < CPU_SECONDS and not set(HEAVY) & set(modules)


def test_the_readme_names_every_script_table_and_figure():
    text = (EXPERIMENTS / "README.md").read_text()
    named = {name for name in re.findall(r"\b(?:\w+/)?\w+\.py\b", text.replace("experiments/render", "render"))}
    missing = [name for name in SCRIPTS if name not in named]
    assert missing == []
    docs = EXPERIMENTS.parent / "docs"
    for folder, pattern in (("results", "*.json"), ("images", "*.*")):
        assert [path.name for path in (docs / folder).glob(pattern) if path.name not in text] == []


@pytest.mark.parametrize("path", ["README.md", "../README.md", *(f"../docs/{page.name}" for page in DOCS)])
def test_every_script_that_a_page_names_exists(path):
    text = (EXPERIMENTS / path).read_text()
    pattern = (
        r"`(?:python )?((?:\w+/)+\w+\.py)\b" if path == "README.md" else r"\bexperiments/((?:\w+/)*\w+\.(?:py|json))\b"
    )
    roots = EXPERIMENTS, EXPERIMENTS.parent
    missing = [name for name in re.findall(pattern, text) if not any((root / name).is_file() for root in roots)]
    assert missing == []
