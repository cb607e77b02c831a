"""Every script in experiments/ answers --help at once, whatever is installed."""

import subprocess
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
SCRIPTS = sorted(path.stem for path in EXPERIMENTS.glob("*.py") if '__name__ == "__main__"' in path.read_text())
TYPED = ("train_small",)
"""Whose options are those of a configuration, which imports jax."""


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_imports_no_jax(script, tmp_path):
    code = f"import sys, runpy; sys.argv = ['{script}.py', '--help']; sys.path.insert(0, {str(EXPERIMENTS)!r})\n"
    code += f"try: runpy.run_path({str(EXPERIMENTS / script)!r} + '.py', run_name='__main__')\n"
    code += "except SystemExit: pass\n"
    code += "" if script in TYPED else "assert 'jax' not in sys.modules"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert result.returncode == 0 and "usage:" in result.stdout, result.stderr
