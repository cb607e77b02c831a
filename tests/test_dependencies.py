"""pyproject.toml declares all that the package and its tests import.

It declares no dependency that the package does not import.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
IMPORT = re.compile(
    r"^\s*(?:from (\w+)[\w.]* import \w|import (\w+)(?:\.\w+)*(?: as \w+)?(?:  #.*)?$)",
    re.MULTILINE,
)
OURS = {"humangs_jax", "tests", "experiments"}
NAMES = {
    "PIL": "pillow",
    "skimage": "scikit-image",
    "orbax": "orbax-checkpoint",
    "jaxlib": "jax",
    "yaml": "PyYAML",
}
# Python 3.14 has it as compression.zstd
NAMES |= dict.fromkeys(("backports", "compression"), "backports.zstd")
"""Distributions that are not called like their module."""
UNTESTED = {"torch", "bpy"}
"""Distributions of scripts that made stored references, and of those that Blender runs."""


def imported(folder):
    """Returns the distributions of modules that a folder's files import, also in functions."""
    found = set()
    for file in folder.rglob("*.py"):
        found |= {first or second for first, second in IMPORT.findall(file.read_text())}
    return {plain(NAMES.get(module, module)) for module in found - sys.stdlib_module_names - OURS}


def plain(requirement):
    return re.sub(r"[-_.]+", "-", re.split(r"[ \[<>=!~;]", requirement)[0]).lower()


def test_imports_are_declared_and_dependencies_imported():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required, extras = (
        {plain(each) for each in project["dependencies"]},
        project["optional-dependencies"],
    )
    assert imported(ROOT / "humangs_jax") == required
    groups = ("dev", "notebooks", "hdf5", "heic", "photos")
    tools = {plain(each) for name in groups for each in extras[name]}
    own = {
        plain(name)
        for folder in ("tests", "experiments")
        for path in (ROOT / folder).rglob("*.py")
        for name in (path.stem, path.parent.name)
    }
    assert imported(ROOT / "tests") - own - required - tools == UNTESTED
