"""The parts of a release agree: version, addresses, dependencies, tools, and what CI runs."""

import ast
import dataclasses
import importlib.util
import json
import re
import tomllib
from pathlib import Path

import pytest
import yaml

import humangs_jax
from humangs_jax.cli.start import Start

ROOT = Path(__file__).parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture
def addresses():
    """Returns the script that writes version and addresses to other files."""
    spec = importlib.util.spec_from_file_location("addresses", ROOT / ".ci" / "addresses.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_version_and_addresses_are_the_same_everywhere(addresses):
    assert addresses.problems(release=False) == []
    assert addresses.facts()["version"] == humangs_jax.__version__
    assert "version" in PROJECT["dynamic"]  # pyproject.toml reads that one, too
    assert {"Repository", "Documentation", "Issues", "Changelog"} <= PROJECT["urls"].keys()


def test_a_maintainer_fills_in_one_place(addresses, tmp_path, monkeypatch):
    for name in {"pyproject.toml", "humangs_jax/__init__.py", "CHANGELOG.md"} | {
        place for place, *_ in addresses.PLACES
    }:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text())
    monkeypatch.setattr(addresses, "ROOT", tmp_path)
    monkeypatch.setenv("GITHUB_REF_NAME", "v9.8.7")
    assert any("fill in OWNER" in line for line in addresses.problems(release=True))
    project, source = tmp_path / "pyproject.toml", tmp_path / "humangs_jax" / "__init__.py"
    project.write_text(project.read_text().replace("OWNER", "somebody"))
    source.write_text(re.sub('__version__ = ".*"', '__version__ = "9.8.7"', source.read_text()))
    named = "\n".join(addresses.problems(release=False))
    assert "CITATION.cff: version or addresses" in named and "mkdocs.yml" in named
    monkeypatch.setattr("sys.argv", ["addresses.py"])
    addresses.main()
    assert addresses.problems(release=False) == []
    assert "https://github.com/somebody/humangs_jax" in (tmp_path / "CITATION.cff").read_text()
    (line,) = addresses.problems(release=True)
    assert line == "CHANGELOG.md: expected a first section ## [9.8.7] - DATE"
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## [9.8.7] - 2030-01-01\n")
    assert addresses.problems(release=True) == []
    monkeypatch.setenv("GITHUB_REF_NAME", "v9.8.8")
    (line,) = addresses.problems(release=True)
    assert line.startswith("tag 'v9.8.8': expected v9.8.7")


def requirements(lines):
    """Returns {lower-case name: version} of lines such as "jax >=0.11.2" and "Pillow>=11.0;
    marker".
    """
    split = [re.match(r"([\w.-]+)\s*([^;]*)", line) for line in lines]
    return {each[1].lower(): each[2].replace(" ", "") for each in split}


def test_the_conda_recipe_wants_what_pyproject_wants():
    recipe = yaml.safe_load((ROOT / "conda" / "recipe.yaml").read_text())
    found = requirements(recipe["requirements"]["run"])
    assert found.pop("python") == ">=${{python_min}}"
    # of the two lines of jax the one for newer Pythons; conda-forge's openexr is the C++ library
    ours = requirements([line for line in PROJECT["dependencies"] if "< '3.12'" not in line])
    ours["openexr-python"] = ours.pop("openexr")
    assert found == ours
    assert recipe["build"]["python"]["entry_points"] == [
        f"{name} = {place}" for name, place in PROJECT["scripts"].items()
    ]


def test_ruff_and_ty_are_pinned_in_one_place():
    pinned = [line for line in PROJECT["optional-dependencies"]["dev"] if "==" in line]
    assert [line.split("==")[0] for line in pinned] == ["ruff", "ty"]
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]
    assert [each["repo"] for each in hooks] == ["local"]
    elsewhere = [*WORKFLOWS, *(ROOT / ".ci").iterdir(), ROOT / ".pre-commit-config.yaml"]
    files = [file for file in elsewhere if file.is_file()]
    assert not [file.name for file in files if re.search(r"\b(ruff|ty)\s*==", file.read_text())]


def test_workflows_run_scripts_that_are_there():
    assert {file.stem for file in WORKFLOWS} >= {"ci", "release", "docs", "nightly", "gpu"}
    for file in WORKFLOWS:
        text = file.read_text()
        assert yaml.safe_load(text)["permissions"] == {"contents": "read"}, file.name
        for script in re.findall(r"(?:run: |python )(\.ci/[\w.]+)", text):
            assert (ROOT / script).is_file(), f"{file.name}: {script}"
    release = (ROOT / ".github/workflows/release.yml").read_text()
    assert "id-token: write" in release and "password" not in release.replace("no password", "")


def test_notebook_and_page_of_others_machines_use_what_is_there():
    """Neither is part of the package, and both need a released one."""
    cells = json.loads((ROOT / "colab" / "humangs_jax.ipynb").read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert not any(cell.get("outputs") for cell in cells)
    plain = "\n".join(line for text in code for line in text.splitlines() if line[:1] not in "!%")
    used = {
        node.attr
        for node in ast.walk(ast.parse(plain))
        if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "hg"
    }
    assert used and used <= set(humangs_jax.__all__)
    page = ast.parse((ROOT / "space" / "app.py").read_text())
    (command,) = [
        [each.value for each in node.args[1].elts if isinstance(each, ast.Constant)]
        for node in ast.walk(page)
        if isinstance(node, ast.Call)
        and getattr(node.func, "id", "") == "made"
        and isinstance(node.args[1], ast.Tuple)
        and node.args[1].elts[0].value == "start"
    ]
    given = [word for word in command if word.startswith("--")]
    assert given == ["--out", "--height", "--no-browser"]
    assert {"out", "height", "browser"} <= {field.name for field in dataclasses.fields(Start)}
