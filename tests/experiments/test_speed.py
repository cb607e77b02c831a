"""Speed as a ratio to that of a plain product: what is compared, and which ratios fail a change."""

import pytest

from experiments import speed


def times(product, **others):
    """Returns milliseconds of a process; what is not given takes ten products."""
    return {"product": product, **dict.fromkeys(speed.MEASURED, 10 * product), **others}


def test_a_busier_machine_changes_nothing_and_a_slower_program_is_named():
    assert speed._ratios([times(2.0), times(5.0), times(3.0)])["render"] == pytest.approx(10)
    before, now = speed._ratios([times(2.0)]), speed._ratios([times(7.0, render=98.0)])
    (line,) = speed.slower_than(before, now, 1.3)
    assert line.startswith(speed.MEASURED["render"]) and "1.40 times, allowed are 1.3" in line
    assert speed.slower_than(before, now, 1.5) == speed.slower_than({}, now, 1.3) == []
    del before["render"]  # what the other commit cannot do is not compared
    assert speed.slower_than(before, now, 1.3) == []


def test_rooms_are_those_of_the_package(tmp_path):
    files = {"__init__.py": "a = 1", "core/a.py": "b = 2", "core/deep/b.py": "c()"}
    for name, text in files.items():
        (tmp_path / "humangs_jax" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "humangs_jax" / name).write_text(text)
    (tmp_path / "humangs_jax/__init__.pyi").write_text("from humangs_jax.core.a import b as b")
    rooms = speed.code_by_room(tmp_path)
    assert rooms == {"the package itself": 3, "core/": 6, "public names": 1}
