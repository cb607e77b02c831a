"""Some attacks of every item of the list, in this process. test_hostile.py runs all of them, in one of its own."""

import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), *(str(HERE.parent / name) for name in ("network", "data/datasets", ""))]

from hostile_cases import all_cases  # noqa: E402
from readers import READERS, SEEDS  # noqa: E402
from test_hostile import ITEMS, fault  # noqa: E402

EVERY = 12
HEAVY = (
    "GiB",
    "million",
    "bomb",
    "100,000",
    "100 MB",
    "digits",
    "8,000",
    "13,000",
    "30,000",
    "60,000,000",
    "300,000",
    "5,000 photos",
    "white photos",
    "scans",
    "nodes",
    "MB",
)
"""Files that a reader which has become careless would take minutes or gigabytes for."""


@pytest.mark.parametrize("item", ITEMS)
def test_some_files_of_each_item(item, tmp_path):
    light = [case for case in all_cases() if case.item == item and not any(word in case.name for word in HEAVY)]
    faults = []
    for number, case in enumerate(light[::EVERY] if len(light) > 60 else light):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = case.make(folder)
        result = {"outcome": "read", "message": "", "path": str(path)}
        try:
            READERS[case.reader](path)
        except (ValueError, OSError) as error:
            result |= {"outcome": "refused", "message": str(error)}
        faults.append(fault(case, result))
    assert faults and not any(faults), "\n".join(filter(None, faults))


@pytest.mark.parametrize("name", [name for name, seed in SEEDS.items() if seed is not None])
def test_honest_files_are_read(name, tmp_path):
    READERS[name](SEEDS[name](tmp_path))
