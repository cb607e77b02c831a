"""Carries the version and the addresses of the project to every file that repeats them.

The version is `__version__` of humangs_jax/__init__.py; the addresses are [project.urls] of
pyproject.toml, where a maintainer replaces OWNER once.

    python .ci/addresses.py             writes them into the files of PLACES
    python .ci/addresses.py --check     says which files disagree; exit status 1 if one does
    python .ci/addresses.py --release   as --check; OWNER is an error, and so is a tag (the variable
                                        GITHUB_REF_NAME) or a first section of the changelog that
                                        is not of this version
"""

import os
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLACEHOLDER = "OWNER"
PLACES = (
    ("CITATION.cff", r"(?m)^version: .*$", "version: {version}"),
    ("CITATION.cff", r"(?m)^repository-code: .*$", "repository-code: {Repository}"),
    ("CITATION.cff", r"(?m)^url: .*$", "url: {Documentation}"),
    ("README.md", r"git clone https://\S+", "git clone {Repository}"),
    ("mkdocs.yml", r"(?m)^repo_url: .*$", "repo_url: {Repository}"),
    ("mkdocs.yml", r"(?m)^site_url: .*$", "site_url: {Documentation}"),
    ("conda/recipe.yaml", r"(?m)^  version: .*$", '  version: "{version}"'),
    ("conda/recipe.yaml", r"(?m)^  homepage: .*$", "  homepage: {Documentation}"),
    ("conda/recipe.yaml", r"(?m)^  repository: .*$", "  repository: {Repository}"),
)
"""Of each file: its name, the text to find in it, and the text to put in its place."""


def facts() -> dict[str, str]:
    """The version, and the addresses by their names in pyproject.toml."""
    source = (ROOT / "humangs_jax" / "__init__.py").read_text(encoding="utf-8")
    version = re.search(r'(?m)^__version__ = "([^"]+)"$', source)
    assert version is not None
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {"version": version[1], **project["urls"]}


def updated() -> dict[str, str]:
    """What each of the files of PLACES has to be."""
    known, texts = facts(), {}
    for name, pattern, line in PLACES:
        text = texts.get(name) or (ROOT / name).read_text(encoding="utf-8")
        texts[name], count = re.subn(pattern, line.format_map(known), text)
        if count == 0:
            raise SystemExit(f"{name}: expected a line like {line!r}")
    return texts


def problems(release: bool) -> list[str]:
    """What disagrees, a line each."""
    found = [
        f"{name}: version or addresses are not those of pyproject.toml: python .ci/addresses.py"
        for name, text in updated().items()
        if text != (ROOT / name).read_text(encoding="utf-8")
    ]
    if not release:
        return found
    known = facts()
    found += [
        f"pyproject.toml: {name}: fill in {PLACEHOLDER}"
        for name, address in known.items()
        if PLACEHOLDER in address
    ]
    version, tag = known["version"], os.environ.get("GITHUB_REF_NAME", "")
    if tag != f"v{version}":
        found.append(f"tag {tag!r}: expected v{version}, the version of humangs_jax/__init__.py")
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"(?m)^## \[(.+?)\] - (\S+)$", changelog)
    if newest is None or newest[1] != version or newest[2] == "unreleased":
        found.append(f"CHANGELOG.md: expected a first section ## [{version}] - DATE")
    return found


def main() -> None:
    """See the head of this file."""
    options = set(sys.argv[1:])
    if options & {"--check", "--release"}:
        found = problems("--release" in options)
        print("\n".join(found))
        raise SystemExit(bool(found))
    for name, text in updated().items():
        (ROOT / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
