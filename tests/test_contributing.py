"""What CONTRIBUTING.md shows can be done as it stands."""

import importlib.util
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from humangs_jax.training.config import PRESETS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


def module_of(file, name):
    """Imports a file as a module."""
    spec = importlib.util.spec_from_file_location(name, file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def changed(tmp_path):
    """Returns a folder with the losses and their tests after the page's change."""
    (change,) = re.findall(r"^```diff\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    for folder in ("humangs_jax/losses", "tests/losses"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    (tmp_path / "change.diff").write_text(change)
    command = ["git", "apply", "-p1", "change.diff"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return tmp_path


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_change_of_a_loss_can_be_applied_and_is_a_weight(changed):
    losses = module_of(changed / "humangs_jax/losses/losses.py", "changed_losses")
    assert losses.LossConfig(edges=0.5).edges == 0.5 and losses.LossConfig().edges == 0.0


def test_the_code_of_the_page_about_changes_runs():
    page = (ROOT / "docs" / "change.md").read_text(encoding="utf-8")
    part, loss, data = re.findall(r"^```python\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    names: dict = {}
    exec(part + loss, names)
    config = names["config"]
    assert config.model.architecture.reader.output_width == 64 and config.loss.opaque == 0.003
    path = {"model.architecture.reader.output_width": 64}
    assert names["hg"].vary(PRESETS["tiny"](), path).model == config.model
    exec(data[: data.index("folders = ")], names)  # what follows needs people on disk


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_the_test_of_the_change_of_a_loss_passes(changed, monkeypatch):
    name = "humangs_jax.losses.losses"
    losses = module_of(changed / "humangs_jax/losses/losses.py", name)
    monkeypatch.setitem(sys.modules, name, losses)
    monkeypatch.syspath_prepend(changed / "tests" / "losses")
    test = module_of(changed / "tests/losses/test_edges.py", "test_edges")
    (run,) = [each for each in vars(test) if each.startswith("test_")]
    getattr(test, run)()
