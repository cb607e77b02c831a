"""npz archives, read by many threads."""

import ast
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from humangs_jax.io.npz import read_npz


def test_threads_parse_one_header_at_a_time(tmp_path, monkeypatch):
    """More at once are an error of CPython 3.11 now and then, and healthy captures were left out of a run for it."""
    arrays = {name: np.full((2, 3), i) for i, name in enumerate("abc")}
    np.savez(tmp_path / "some.npz", **arrays)
    inside, most = [], []

    def slow(*arguments, **named):
        inside.append(threading.get_ident())
        time.sleep(1e-3)
        most.append(len(set(inside)))
        inside.remove(threading.get_ident())
        return parse(*arguments, **named)

    parse = ast.parse
    monkeypatch.setattr(ast, "parse", slow)
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda _: read_npz(tmp_path / "some.npz"), range(12)))
    assert len(most) == 36 and max(most) == 1
    for read, pickled in results:
        assert not pickled
        for name, array in arrays.items():
            np.testing.assert_array_equal(read[name], array)
