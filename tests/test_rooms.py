"""The core can be imported without its wings."""

import subprocess
import sys
from pathlib import Path

import pytest
import rooms

ROOT = Path(__file__).parents[1]
MOST_LEFT_OUT = 36
"""Most files of tests in the core's rooms that also look at a wing or a command."""

ALONE = """
import pathlib, sys
sys.path.insert(0, "tests")
import pytest
import rooms

sys.meta_path.insert(0, rooms.HiddenWings())
import humangs_jax as hg

root = pathlib.Path(hg.__file__).parent
for path in root.rglob("*.py"):
    name = ".".join(path.relative_to(root.parent).with_suffix("").parts)
    if name.split(".")[1] in rooms.CORE and not name.endswith("__init__"):
        __import__(name)
ours = [name for name in sys.modules if name.startswith("humangs_jax.")]
hidden = [name for name in ours if name.split(".")[1] in rooms.WINGS]
assert not hidden, hidden
print("alone")
"""


@pytest.mark.slow
def test_every_module_of_the_core_is_imported_with_the_wings_hidden():
    done = subprocess.run([sys.executable, "-c", ALONE], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.endswith("alone\n"), done.stderr[-2000:]


def test_few_tests_of_the_core_need_a_wing():
    """`pytest --core-alone` runs all others with the wings hidden."""
    files = [path for room in rooms.CORE for path in (ROOT / "tests" / room).rglob("test_*.py")]
    left_out = [path.name for path in files if rooms.NEEDS_WINGS.search(path.read_text())]
    assert len(left_out) <= MOST_LEFT_OUT, left_out
