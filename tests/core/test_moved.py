"""Modules can still be imported under the names that they had."""

import importlib
import sys
import warnings

import pytest

from humangs_jax.core.moved import MOVED, new_name


@pytest.mark.parametrize("old", MOVED)
def test_a_module_is_the_same_under_its_old_name(old, monkeypatch):
    for name in [name for name in sys.modules if name == old or name.startswith(f"{old}.")]:
        monkeypatch.delitem(sys.modules, name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module = importlib.import_module(old)
    assert any(f"{old} is {MOVED[old]} now" in str(each.message) for each in caught)
    assert module is importlib.import_module(MOVED[old])
    assert module.__spec__.name == module.__name__ == MOVED[old]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_modules_inside_are_not_imported_twice():
    from humangs_jax.capture.calibration import importing
    from humangs_jax.data.calibration.importing import import_cameras

    assert import_cameras is importing.import_cameras
    with pytest.raises(ModuleNotFoundError, match=r"humangs_jax\.synthetic\.nobody"):
        importlib.import_module("humangs_jax.people.nobody")


def test_what_has_not_moved_has_no_other_name():
    assert new_name("humangs_jax.data.capture") is None
    assert new_name("humangs_jax.peoples") is None
