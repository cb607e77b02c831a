"""`python -m experiments`: options from signatures, kept results, written files."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path
from typing import Literal

import pytest

from experiments import harness, results
from experiments.harness import Run, call, listed, means


@dataclasses.dataclass(frozen=True)
class Some:
    """Options:
    people: how many
    """

    people: int = 2


def toy(
    run: Run,
    folder: Path,
    some: Some = Some(3),
    sizes: tuple[float, ...] = (1.5,),
    way: Literal["a", "b"] = "a",
) -> None:
    """A toy.

    Options:
    folder: where it is,
        and more
    sizes: in metres
    """
    rows = run.rows(
        {str(i): lambda i=i: made(i) for i in range(some.people)}, {"way": way, "sizes": sizes}
    )
    run.show(
        f"{folder} {sizes}\n\n| a |\n|---|\n| 1 |", means([{"x": row} for row in rows.values()])
    )


made = float


def test_options_are_those_of_the_signature(capsys):
    assert call(toy, ["there", "--people", "2", "--sizes", "2", "3", "--way", "b"]) == 0
    assert capsys.readouterr().out.startswith("there (2.0, 3.0)")
    with pytest.raises(SystemExit) as exit_:
        call(toy, ["there", "--way", "c"])
    assert exit_.value.code == 2
    with pytest.raises(SystemExit):
        call(toy, ["--help"])
    text = capsys.readouterr().out
    assert "where it is, and more" in text and "how many (default: 3)" in text and "A toy." in text


def test_rows_of_the_same_settings_are_kept(tmp_path, monkeypatch, capsys):
    out, asked = tmp_path / "a.json", []
    monkeypatch.setattr(sys.modules[__name__], "made", lambda i: asked.append(i) or float(i))
    for people in ("1", "3", "2"):
        call(toy, ["x", "--people", people, "--json", str(out)])
    assert asked == [0, 1, 2]
    stored = json.loads(out.read_text())
    assert stored["rows"] == {"0": 0, "1": 1, "2": 2} and stored["numbers"]["toy"] == {"x": 0.5}
    assert (
        stored["script"] == "python -m experiments toy"
        and stored["versions"]["jax"]
        and stored["date"]
    )
    call(toy, ["x", "--people", "1", "--way", "b", "--json", str(out)])
    assert asked == [0, 1, 2, 0] and "other settings" in capsys.readouterr().out
    for text in ("not json", "[]", '{"psnr": 1}'):
        out.write_text(text)
        with pytest.raises(SystemExit):
            call(toy, ["x", "--json", str(out)])
        assert (
            "a.json: expected the JSON of an earlier run"
            in capsys.readouterr().err.splitlines()[-1]
        )


def test_pictures_come_beside_rows_and_are_made_again():
    run, case = Run(), lambda: ({"psnr": 1.0}, "picture")
    assert run.rows({"a": case}) == {"a": {"psnr": 1.0}} and run.pictures == {"a": "picture"}


def test_means_are_of_what_all_rows_have():
    rows = [{"a": {"x": 1.0, "y": None}, "b": 2}, {"a": {"x": 3.0, "y": 1.0}}]
    assert means(rows) == {"a": {"x": 2.0, "y": None}}


def test_a_table_goes_to_the_page_that_shows_it(tmp_path, monkeypatch):
    page = tmp_path / "docs" / "more" / "page.md"
    page.parent.mkdir(parents=True)
    page.write_text("before\n<!-- table: toy -->\n<!-- end -->\nafter\n")
    (tmp_path / "README.md").write_text("")
    monkeypatch.setattr(results, "REPOSITORY", tmp_path)
    assert call(toy, ["x", "--publish", "--people", "1"]) == 0
    assert (
        page.read_text()
        == "before\n<!-- table: toy -->\nx (1.5,)\n\n| a |\n| --- |\n| 1 |\n<!-- end -->\nafter\n"
    )
    written = json.loads((tmp_path / "docs/results/toy.json").read_text())
    assert written["numbers"] == {"x": 0} and written["arguments"] == "x --publish --people 1"
    with pytest.raises(SystemExit):
        call(toy, ["x", "--publish", "--table", "other"])


def test_the_list_imports_nothing_heavy_and_the_readme_has_all_names():
    code = (
        "import sys; sys.argv[1:] = []; from experiments.harness import main; main();"
        " print(sorted(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=results.REPOSITORY,
    )
    assert not {"jax", "numpy", "matplotlib"} & set(
        done.stdout.splitlines()[-1].replace("'", "").strip("[]").split(", ")
    )
    readme = (harness.FOLDER / "README.md").read_text()
    for name, (_, line) in listed().items():
        assert f"{name} " in done.stdout and line, name
        assert f"`{name}" in readme, name
    for folder, pattern in (("results", "*.json"), ("images", "*.*")):
        assert [
            x.name
            for x in (results.REPOSITORY / "docs" / folder).glob(pattern)
            if x.name not in readme
        ] == []
