"""h5py, which is optional."""

import pytest


def h5py():
    """The module, or the test is skipped."""
    return pytest.importorskip("h5py", exc_type=ImportError)
