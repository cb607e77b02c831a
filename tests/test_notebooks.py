"""The committed notebooks run, and their text agrees with their outputs.

Notebooks follow rules that these tests can check:

- A number in digits in the prose stands in an output of the notebook or in its code. With a unit it
  is a result: it stands with that unit in an output. "Some", "about" allow zeros at its end.
  Results are not written in words ("two fifths").
- The first cell ends with how long the notebook takes, a key of `DURATIONS`; the last output has
  the seconds.
- What it reads of docs/ is part of the package.
"""

import json
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TIMEOUT_SECONDS = 1800
MOST_BYTES = 1_500_000
"""Largest size of a notebook: a page of the viewer in it would be larger."""

UNITS = ("dB", "%", "MiB", "MB", "ms", "s", "mm", "m", "times")
NUMBER = r"\d{1,3}(?:,\d{3})+|\d+(?:\.\d+)?(?:e[+-]?\d+)?"
STATED = re.compile(
    rf"(?:\b(some|about) +)?(?<![\w.,/^])({NUMBER})(?![\w/]|[.,]\d)(?:"
    rf" ?({'|'.join(UNITS)})(?![\w^]))?",
    re.I,
)
IN_WORDS = re.compile(
    r"\b(halves|thirds|quarters?|fifths|sixths|eighths|tenths|twice|thrice|percent|half (?:of|as)|"
    r"a (?:half|third|fifth|tenth)"
    r" of|(?:two|three|four|five|six|seven|eight|nine|ten|twenty|hundred|thousand) times)\b",
    re.IGNORECASE,
)
DURATIONS = {
    "About a minute on a CPU with two cores.": (20, 140),
    "A few minutes on a CPU with two cores.": (60, 600),
}
"""Bounds in seconds of CPU time of the committed run, by the duration that the notebook states.

Two cores take between half of them and all.
"""


def cells(notebook, kind):
    """Returns the sources of the cells of one kind."""
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def outputs(notebook):
    """Returns all outputs in order."""
    return [
        out for cell in notebook["cells"] if cell["cell_type"] == "code" for out in cell["outputs"]
    ]


def printed(notebook):
    """Returns the text of all outputs."""
    return "\n".join(
        "".join(out["text"]) for out in outputs(notebook) if out["output_type"] == "stream"
    )


def images(notebook):
    """Returns the number of figures."""
    kinds = {"image/jpeg", "image/png"}
    return sum(bool(kinds & out.get("data", {}).keys()) for out in outputs(notebook))


def prose(notebook):
    """Returns the text without code and the targets of links."""
    text = "\n\n".join(cells(notebook, "markdown"))
    return re.sub(r"`[^`]*`|\]\([^)]*\)", " ", text)


def rounds_to(value, stated, zeros):
    """Returns whether a number rounds to the stated one, by its decimals or by zeros at its end."""
    plain = stated.replace(",", "")
    decimals = len(plain.partition(".")[2])
    if zeros and "." not in plain:
        decimals = -(len(plain) - len(plain.rstrip("0")))
    return round(abs(value), decimals) == float(plain)


def unfounded(notebook):
    """Returns what the prose states and neither outputs nor code have."""
    text, shown, code = prose(notebook), printed(notebook), "\n".join(cells(notebook, "code"))

    def numbers(where, unit=""):
        return [
            float(found.replace(",", ""))
            for found in re.findall(rf"(?<![\w.,])({NUMBER}){unit}", where)
        ]

    wrong = [found[0] for found in IN_WORDS.finditer(text)]
    for found in STATED.finditer(text):
        zeros, number, unit = found.groups()
        if unit:
            known = numbers(shown, rf" ?{re.escape(unit)}(?!\w)")
        else:
            known = numbers(shown) + numbers(code)
        if not any(rounds_to(value, number, zeros) for value in known):
            wrong.append(" ".join(found[0].split()))
    return wrong


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    """Returns the content of a committed notebook."""
    return json.loads(request.param.read_text())


def test_cells_are_executed_in_order(notebook):
    counts = [cell["execution_count"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert not [
        out
        for out in outputs(notebook)
        if out["output_type"] == "error" or out.get("name") == "stderr"
    ]
    assert images(notebook)
    assert len(json.dumps(notebook)) < MOST_BYTES
    assert not re.search(r"/(?:tmp|home|root|work|Users)/", printed(notebook)), (
        "a path of the machine"
    )


def test_numbers_of_the_prose_are_in_the_outputs(notebook):
    assert not unfounded(notebook)


def test_time_of_the_prose_is_the_time_of_the_run(notebook):
    first = " ".join(cells(notebook, "markdown")[0].split())
    least, most = next(bounds for duration, bounds in DURATIONS.items() if first.endswith(duration))
    took = re.search(
        r"this notebook took \d+ s, (\d+) s of CPU", "".join(outputs(notebook)[-1]["text"])
    )
    assert took and least <= int(took[1]) <= most


def test_what_notebooks_need_is_installed_with_the_package():
    code = "\n".join(
        source for path in NOTEBOOKS for source in cells(json.loads(path.read_text()), "code")
    )
    read = {f"docs/{name}" for name in re.findall(r'docs / "([\w./]+)"', code)}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    shipped = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert read
    assert {name: shipped.get(name) for name in read} == {
        name: f"humangs_jax/assets/{name}" for name in read
    }
    assert all((ROOT / name).is_file() for name in read)
    assert any(
        name.startswith("jupyterlab")
        for name in project["project"]["optional-dependencies"]["notebooks"]
    )


@pytest.mark.parametrize(
    ("text", "shown", "wrong"),
    [
        ("It gains 1.5 dB in 9.2 times the time.", "best: +1.48 dB in 9.17 times", []),
        ("It gains 1.5 dB in 10 times the time.", "best: +1.48 dB in 9.17 times", ["10 times"]),
        ("It gains 1.5 dB.", "1.5 is no gain; 12.5 dB, 1.6 dB", ["1.5 dB"]),
        ("Some 20,000 Gaussians, about 50 % of them seen.", "20,376 Gaussians, 51% seen", []),
        ("20,000 Gaussians, 50 % of them seen.", "20,376 Gaussians, 51% seen", ["20,000", "50 %"]),
        ("Two fifths are hidden, a third of them twice.", "", ["fifths", "a third of", "twice"]),
        ("Images of 64 pixels, `K of 512`, 3D, float32, [8](a9.md).", "", ["8"]),
    ],
)
def test_stale_numbers_are_found(text, shown, wrong):
    code = {
        "cell_type": "code",
        "source": "size = 64",
        "outputs": [{"output_type": "stream", "text": [shown]}],
    }
    assert unfounded({"cells": [{"cell_type": "markdown", "source": [text]}, code]}) == wrong


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # the kernel's own libraries warn as they please
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs_from_top_to_bottom(path, tmp_path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    # notebooks run for minutes, and some measure time
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "0")
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    notebook = nbformat.read(path, as_version=4)
    before = images(notebook)
    NotebookClient(
        notebook, timeout=TIMEOUT_SECONDS, resources={"metadata": {"path": tmp_path}}
    ).execute()
    assert images(notebook) == before
