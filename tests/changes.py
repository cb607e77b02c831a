"""Changes files in one place."""

import json
import pickle

import numpy as np


def edit_bytes(path, change):
    path.write_bytes(change(path.read_bytes()))


def edit_text(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1), errors="replace")


def edit_json(path, change):
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_npz(path, **changes):
    """Replaces entries of an .npz file.

    A function gets the old entry and returns the new one; None removes it.
    """
    with np.load(path) as archive:
        values = changed(dict(archive), changes)
    np.savez(path, **values)


def edit_pickle(path, **changes):
    """Replaces entries of a pickled dict, as `edit_npz` does."""
    path.write_bytes(pickle.dumps(changed(pickle.loads(path.read_bytes()), changes)))


def changed(values, changes):
    new = {
        key: change(values[key]) if callable(change) else change for key, change in changes.items()
    }
    return {key: value for key, value in (values | new).items() if value is not None}
