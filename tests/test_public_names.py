"""The names of `import humangs_jax as hg`: all there, and none imported before it is used."""

import subprocess
import sys

import pytest

import humangs_jax as hg


@pytest.mark.parametrize("name", hg.__all__)
def test_every_public_name_exists(name):
    assert name in hg.__all__ and getattr(hg, name) is not None
    assert name in dir(hg)


def test_other_names_are_refused():
    with pytest.raises(AttributeError, match="no attribute 'rendr'"):
        hg.rendr  # noqa: B018


def test_importing_the_package_imports_nothing_heavy():
    code = "import sys, humangs_jax; print([name for name in ('jax', 'numpy', 'flax') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_there_are_at_most_fifty():
    assert len(hg.__all__) - 1 <= 50


USER = """
import jax
import humangs_jax as hg
capture = hg.load_capture("photos")
avatar = hg.reconstruct(*hg.load_weights(), capture)
reveal_type(hg.render)
reveal_type(hg.animate(avatar, capture.pose(0)))
hg.render(avatar)
"""


def test_type_checkers_see_functions(tmp_path):
    (tmp_path / "user.py").write_text(USER)
    command = ["ty", "check", "--python", sys.prefix, "--output-format", "concise", "user.py"]
    text = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stdout
    for line in ("gaussians: Gaussians, camera: Camera", "Revealed type: `Gaussians`", "Expected `Gaussians`, found `Avatar`"):
        assert line in text, text
