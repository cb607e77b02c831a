"""Files of every reader with a few changed parts are read, or refused in one line.

HUMANGS_FUZZ_INPUTS=N makes N files for each reader, the same ones in each run.
"""

import contextlib
import copy
import gzip
import io
import json
import os
import pickletools
import struct
import sys
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

sys.path.append(str(Path(__file__).parent))

from attacks import PICKLES, glb
from readers import FORMATS
from watch import outcome

INPUTS = int(os.environ.get("HUMANGS_FUZZ_INPUTS", "50"))
VALUES = [0, 1, -1, 255, 2**31, 2**63, -(2**63), 10**30, 0.5, 1e30, 1e400, float("nan"), None, True]
VALUES += ["", "x", "../x", "/", "a\0b", [], {}, [1, [2]], {"a": 1}, [0.0] * 51]
WORDS = [bytes([i]) for i in range(256)] + [
    b"9" * 400,
    b"nan ",
    b"inf ",
    b"1e400 ",
    b"99999999999 ",
]
WORDS += [b"\xff" * 4, b"\x7f" * 8, b"\n", b": ", b"!!opencv-matrix", b"&a ", b"*a "]
INSTRUCTIONS = [each.code.encode("latin1") for each in pickletools.opcodes] + list(PICKLES.values())
SHAPES = st.lists(st.sampled_from((0, 1, 2, 3, 9, 55)), max_size=4)
ARRAYS = st.builds(np.zeros, SHAPES, st.sampled_from(("<f4", "<f8", "<i4", "<u1", "<c8", "<U3")))


def exchanged(draw, pieces, hostile):
    """Returns the pieces, some of them left out, doubled, or replaced by hostile ones."""
    pieces = list(pieces)
    for _ in range(draw(st.integers(1, 4))):
        at, count = draw(st.integers(0, len(pieces))), draw(st.sampled_from((1, 1, 8, 64)))
        way = draw(st.sampled_from(("delete", "double", "insert", "replace")))
        new = [draw(st.sampled_from(hostile))] if way in ("insert", "replace") else []
        if way == "double":
            new = pieces[at : at + count] * 2
        pieces[at : at + (0 if way == "insert" else count)] = new
    return b"".join(pieces)


def of_bytes(draw, data):
    return exchanged(draw, (bytes([byte]) for byte in data), WORDS)


def of_text(draw, data):
    return exchanged(draw, [word + b" " for word in data.split(b" ")], WORDS)


def of_pickle(draw, data):
    ends = [place for _, _, place in pickletools.genops(data)] + [len(data)]
    return exchanged(draw, (data[a:b] for a, b in pairwise(ends)), INSTRUCTIONS)


def places(value, path=()):
    """Paths of keys to a value and to all values within it."""
    yield path
    keys = ()
    if isinstance(value, dict):
        keys = value
    elif isinstance(value, list):
        keys = range(len(value))
    for key in keys:
        yield from places(value[key], (*path, key))


def of_json(draw, data):
    value = json.loads(data)
    for _ in range(draw(st.integers(1, 3))):
        path = draw(st.sampled_from(list(places(value))))
        # a copy: a later change may go into it
        new = copy.deepcopy(draw(st.sampled_from(VALUES)))
        if not path:
            return json.dumps(new).encode()
        parent = value
        for key in path[:-1]:
            parent = parent[key]
        if isinstance(parent, dict) and draw(st.booleans()):
            del parent[path[-1]]
        else:
            parent[path[-1]] = new
    return json.dumps(value).encode()


def of_npz(draw, data):
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    key = draw(st.sampled_from(sorted(arrays)))
    old = arrays[key]
    if draw(st.booleans()):
        arrays[key] = draw(ARRAYS)
    elif old.dtype.kind in "fiu" and old.size:
        bad = (np.nan, np.inf, -1.0, 6e4) if old.dtype.kind == "f" else (0, 9, 99)
        arrays[key] = old.copy()
        arrays[key].reshape(-1)[draw(st.integers(0, old.size - 1))] = draw(st.sampled_from(bad))
    else:
        arrays[key] = np.asarray(of_text(draw, str(old).encode()).decode("utf-8", "replace"))
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def of_zip(draw, data):
    """Returns the zip with its pickle, or any other member, changed."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = draw(st.sampled_from(sorted(members)))
    change = of_pickle if name.endswith(".pkl") else of_bytes
    members[name] = change(draw, members[name])
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def of_glb(draw, data):
    length = struct.unpack_from("<I", data, 12)[0]
    return glb(of_json(draw, data[20 : 20 + length]), data[20 + length :])


def of_safetensors(draw, data):
    length = struct.unpack_from("<Q", data)[0]
    header = of_json(draw, data[8 : 8 + length])
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


def of_gzip(draw, data):
    return gzip.compress(of_bytes(draw, gzip.decompress(data)))


def taken_apart(data):
    """Returns the strategy for a file, chosen by its first bytes."""
    if data.startswith(b"PK"):
        return of_npz if b".npy" in data else of_zip
    for start, change in {b"glTF": of_glb, b"\x1f\x8b": of_gzip}.items():
        if data.startswith(start):
            return change
    if data[8:9] == b"{":
        return of_safetensors
    with contextlib.suppress(ValueError):
        json.loads(data)
        return of_json
    # joblib has arrays between the instructions; a text may have escapes that Python warns of
    with contextlib.suppress(ValueError, DeprecationWarning):
        list(pickletools.genops(data))
        return of_pickle
    return of_text if data.isascii() else of_bytes


@pytest.mark.slow
@pytest.mark.parametrize("reader", FORMATS)
def test_a_file_with_hostile_parts_is_read_or_refused_in_one_line(reader, tmp_path):
    form = FORMATS[reader]
    path = form.make(tmp_path)
    file = form.damaged(path)
    valid = file.read_bytes()
    structured = taken_apart(valid)

    @settings(
        max_examples=INPUTS,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def run(data):
        change = data.draw(st.sampled_from((structured, structured, of_bytes)))
        file.write_bytes(change(data.draw, valid))
        outcome(form.read, path, tmp_path)

    run()
