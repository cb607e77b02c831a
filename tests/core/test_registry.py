"""Tables of formats are listed without the code of the formats, which is imported at a call."""

import sys
from pathlib import Path

import pytest

from humangs_jax.avatar.export import EXPORTS, VIDEOS
from humangs_jax.core.registry import FOLDER, Format, Formats, alternatives
from humangs_jax.data.formats import DATASETS, MOTIONS

TABLE = Formats(
    one=Format("ours", "colorsys:rgb_to_hsv", (".npz", ".pkl")),
    other=Format("theirs", "no.such.module:read", (".npz", ".pkl")),
    folders=Format("a file per frame", lambda path: path.name, (".json", FOLDER)),
)


def test_a_table_lists_its_formats_without_importing_them(tmp_path):
    sys.modules.pop("colorsys", None)
    assert TABLE.listed() == ".npz or .pkl: ours, theirs; .json or a folder: a file per frame"
    assert TABLE.suffixes == (".npz", ".pkl", ".json", "")
    assert list(TABLE.of(Path("A.NPZ"))) == ["one", "other"] and list(TABLE.of(tmp_path)) == [
        "folders"
    ]
    assert "colorsys" not in sys.modules
    assert TABLE["one"](1.0, 0.0, 0.0) == (0.0, 1.0, 1.0) and "colorsys" in sys.modules


def test_a_row_added_in_one_line_is_listed_and_called(monkeypatch):
    monkeypatch.setitem(TABLE, "mine", Format("my own", lambda path: path.stem, (".mine",)))
    assert TABLE.listed().endswith("; .mine: my own")
    assert [each(Path("walk.mine")) for each in TABLE.of(Path("walk.mine")).values()] == ["walk"]
    first = Format("an older version", len, (".mine",), recognizes=lambda path: path.stem == "old")
    table = Formats(**TABLE, first=first)
    assert (
        table.recognized(Path("old.mine")) is first
        and table.recognized(Path("new.mine")) is TABLE["mine"]
    )
    assert table.recognized(Path("a.other")) is None
    assert alternatives(TABLE.suffixes) == ".npz, .pkl, .json, .mine or a folder"
    assert Formats(a=Format("A", len), b=Format("B", len)).listed() == "a: A; b: B"


@pytest.mark.parametrize(
    ("page", "table"),
    [("motions", MOTIONS), ("export", EXPORTS), ("video", VIDEOS), ("datasets", DATASETS)],
)
def test_the_page_of_a_table_has_every_format(page, table):
    text = (Path(__file__).parents[2] / "docs" / f"{page}.md").read_text()
    names = {name: each.suffixes or (each.about.split(" and ")[0],) for name, each in table.items()}
    assert not [
        name
        for name, words in names.items()
        if not any((word or "folder") in text for word in words)
    ]
